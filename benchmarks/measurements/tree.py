"""A free chain of ten bodies on nine hinges for 1,000 s: energy, angular momentum in space, and the time of a step."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

import liethermo as lt

from ..peers import import_peer
from ..report import Report, Table, build_available

N_HINGES = 9
"""Number of hinges; their axes are x, y and z in turn."""

BASE_INERTIA = (2.0, 1.5, 1.0)
"""Principal moments of the base, of mass 5 kg (kg m^2)."""

LINK_INERTIA = (0.05, 0.06, 0.07)
"""Principal moments of each link, of mass 1 kg (kg m^2)."""

LINK_CENTRE = (0.2, 0.05, 0.0)
"""Centre of mass of a link from its hinge (m)."""

HINGE_PLACE = (0.4, 0.0, 0.1)
"""Place of a hinge in the body before it (m)."""

STIFFNESS = 0.5
"""Stiffness of each hinge (N m / rad)."""

ANGULAR_VELOCITY = (0.3, 0.1, 0.8)
"""Initial angular velocity of the base in its axes (rad / s)."""

INITIAL_ANGLES = 0.1 * np.arange(N_HINGES)
"""Initial angles of the hinges (rad); their rates are zero."""

COLUMNS = {
    "Solver": "text",
    "Step / s": "number",
    "Seconds / step": "seconds",
    "Energy": "error",
    "Size": "error",
    "Vector in space": "error",
}
"""Columns of the table: the changes of the energy, the size and the vector of the angular momentum are relative."""


def run(is_quick: bool) -> Report:
    """Measure the library and MuJoCo on the chain."""
    t_end = 10.0 if is_quick else 1000.0
    builders = {
        "MetriplecticGauss(2)": lambda: library_row(lt.MetriplecticGauss(2), 0.1, t_end),
        "MetriplecticRungeKutta(4)": lambda: library_row(lt.MetriplecticRungeKutta(4), 0.05, t_end),
        "MuJoCo, RK4": lambda: mujoco_row(0.01, t_end),
    }
    rows, skip_reasons = build_available(builders)
    text = (
        f"A free chain of {N_HINGES + 1} bodies with springs in its hinges, without friction, for {t_end:g} s. The "
        "changes of the energy and of the angular momentum in space are the largest ones, relative to the initial "
        "values. The first run, which compiles, is not timed."
    )
    return Report("A chain of ten bodies", text, [Table("Chain", COLUMNS, [*rows.values()])], skipped=skip_reasons)


def chain() -> lt.bodies.JointedBodies:
    """Return the chain as a system of the library."""
    tree = lt.bodies.Tree()
    tree.add("link 0", mass=5.0, inertia=BASE_INERTIA)
    for i in range(N_HINGES):
        hinge = lt.bodies.Hinge(at=HINGE_PLACE, axis=np.eye(3)[i % 3], stiffness=STIFFNESS)
        tree.add(f"link {i + 1}", 1.0, LINK_CENTRE, LINK_INERTIA, parent=f"link {i}", joint=hinge)
    system = tree.system()
    assert isinstance(system, lt.bodies.JointedBodies)  # it has no ground
    return system


def library_row(method: lt.OneStepMethod, step: float, t_end: float) -> list:
    """Return the row of a method of the library."""
    system = chain()
    angles = {f"link {i + 1}": angle for i, angle in enumerate(INITIAL_ANGLES)}
    x0 = system.state(angular_velocity=ANGULAR_VELOCITY, joints=angles)
    integrate: Callable = lambda t: lt.integrate(  # noqa: E731
        system, x0, (0.0, t), step, method, save_every=round(1.0 / step)
    )
    integrate(min(t_end, 2000.0 * step))  # as many steps as the compiled engine optimises for
    start = time.process_time()
    solution = integrate(t_end)
    seconds = (time.process_time() - start) / round(t_end / step)
    momenta = np.einsum("tij,tj->ti", solution.attitude, solution.x[:, :3])
    return [str(method), step, seconds, *relative_changes(solution.energy, momenta)]


def mujoco_row(step: float, t_end: float) -> list:
    """Return the row of MuJoCo, whose own loop takes the steps."""
    mj = import_peer("mujoco")
    model = mj.MjModel.from_xml_string(mujoco_chain(step))
    data = mj.MjData(model)
    data.qpos[7:], data.qvel[3:6] = INITIAL_ANGLES, ANGULAR_VELOCITY
    energies, momenta, seconds, steps_per_record = [], [], 0.0, round(1.0 / step)
    for i in range(round(t_end) + 1):
        start = time.process_time()
        if i > 0:
            mj.mj_step(model, data, nstep=steps_per_record)
        seconds += time.process_time() - start
        mj.mj_forward(model, data)
        mj.mj_energyPos(model, data)
        mj.mj_energyVel(model, data)
        mj.mj_subtreeVel(model, data)
        energies.append(sum(data.energy))
        momenta.append(data.subtree_angmom[1].copy())
    seconds /= round(t_end / step)
    return ["MuJoCo, RK4", step, seconds, *relative_changes(np.array(energies), np.array(momenta))]


def mujoco_chain(step: float) -> str:
    """Return MuJoCo's description of the chain."""
    links, texts = "", {name: " ".join(map(str, values)) for name, values in (
        ("place", HINGE_PLACE), ("centre", LINK_CENTRE), ("link", LINK_INERTIA), ("base", BASE_INERTIA))}  # fmt: skip
    for i in reversed(range(N_HINGES)):
        axis = " ".join(map(str, np.eye(3)[i % 3]))
        links = (
            f'<body pos="{texts["place"]}"><joint axis="{axis}" stiffness="{STIFFNESS}"/>'
            f'<inertial pos="{texts["centre"]}" mass="1" diaginertia="{texts["link"]}"/>{links}</body>'
        )
    return (
        f'<mujoco><option integrator="RK4" timestep="{step}" gravity="0 0 0"><flag contact="disable"/></option>'
        f'<worldbody><body><freejoint/><inertial pos="0 0 0" mass="5" diaginertia="{texts["base"]}"/>{links}</body>'
        "</worldbody></mujoco>"
    )


def relative_changes(energies: np.ndarray, momenta: np.ndarray) -> list[float]:
    """Return the largest changes of the energy, and of size and vector of a momentum, relative to the first values."""
    sizes = np.linalg.norm(momenta, axis=1)
    changes = (energies / energies[0] - 1.0, sizes / sizes[0] - 1.0, (momenta - momenta[0]) / sizes[0])
    return [float(np.abs(change).max()) for change in changes]
