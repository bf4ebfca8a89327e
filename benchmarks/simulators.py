"""A tumbling body, free or with a damped wheel inside, in simulators of satellites and robots.

The wheel turns about the middle axis of the body, with friction in its bearing. All programs start from equal angular
velocities, have no external forces, and return equal records. One that is not installed raises
:class:`.UnavailableError`.
"""

from __future__ import annotations

import dataclasses
import importlib
import time
from collections.abc import Callable
from dataclasses import dataclass

import numba
import numpy as np
from scipy.integrate import solve_ivp

import liethermo as lt
import manifolds as mf

from .peers import import_peer
from .report import UnavailableError

INITIAL_ANGULAR_VELOCITY = (0.1, 1.0, 0.1)
"""Initial angular velocity, nearly about the middle axis; the wheel is at rest in the body."""

BATH_HEAT_CAPACITY = 2.0
"""Heat capacity of the bath that the wheel heats; its initial temperature is 1."""


@dataclass(frozen=True)
class TumblingBody:
    """Moments of inertia of the body without the wheel's spin, and of the wheel; zero without a wheel."""

    inertia: np.ndarray
    wheel: float = 0.0
    damping: float = 0.0

    @property
    def hub_moments(self) -> np.ndarray:
        """Moments of inertia of the body without the wheel, a disc about the second axis."""
        return self.inertia - 0.5 * self.wheel * np.array([1.0, 0.0, 1.0])

    @property
    def wheel_moments(self) -> np.ndarray:
        return self.wheel * np.array([0.5, 1.0, 0.5])

    def momentum(self, omega, spin) -> np.ndarray:
        """Return the angular momentum in body axes, shape (..., 3), from the angular velocity and the wheel's relative
        spin."""
        return self.inertia * omega + self.wheel * np.multiply.outer(omega[..., 1] + spin, [0.0, 1.0, 0.0])

    def kinetic_energy(self, omega, spin) -> np.ndarray:
        return 0.5 * np.sum(self.inertia * omega**2, axis=-1) + 0.5 * self.wheel * (omega[..., 1] + spin) ** 2

    def angular_velocities(self, momentum, wheel) -> tuple[np.ndarray, np.ndarray]:
        """Return the angular velocity and the wheel's spin, from the angular momenta of the body and of the wheel."""
        rest = momentum - np.multiply.outer(wheel, [0.0, 1.0, 0.0])
        omega = rest / self.inertia
        return omega, (wheel / self.wheel - omega[..., 1] if self.wheel else np.zeros_like(wheel))


@dataclass(frozen=True)
class MotionRecord:
    """A run at equidistant times.

    Attributes
    ----------
    momentum, spatial_momentum : array, shape (times, 3)
    kinetic_energy : array, shape (times,)
    total_energy : array, shape (times,), or None
        Includes the heat, if the program follows it.
    steps : int or None
        Number of steps, if the program chooses them.
    seconds : float or None
        Processor time of the program's own loop, if setting up takes the rest of the work.
    """

    momentum: np.ndarray
    spatial_momentum: np.ndarray
    kinetic_energy: np.ndarray
    total_energy: np.ndarray | None = None
    steps: int | None = None
    seconds: float | None = None


def _motion_record(body: TumblingBody, omega, spin, attitude, total=None) -> MotionRecord:
    momentum = body.momentum(omega, spin)
    return MotionRecord(momentum, np.einsum("tij,tj->ti", attitude, momentum), body.kinetic_energy(omega, spin), total)


def _rotation_matrices(q) -> np.ndarray:
    """Convert quaternions with the scalar first to rotation matrices, shape (..., 3, 3)."""
    w, v = q[..., 0, None, None], q[..., 1:]
    hat = np.cross(v[..., None, :], np.eye(3)).swapaxes(-1, -2)
    return np.eye(3) + (2.0 * w * hat + 2.0 * hat @ hat) / np.sum(q**2, axis=-1)[..., None, None]


# -- this library -----------------------------------------------------------------------------------------------------


def library_system(body: TumblingBody) -> lt.LiePoissonSystem:
    """Return the body with its attitude: mu and, with a wheel, its momentum and the heat of its bearing."""
    if not body.wheel:
        return lt.LiePoissonSystem(mf.so(3), lt.Quadratic(1.0 / body.inertia), group=mf.SO(3))
    total_inertia = body.inertia + np.array([0.0, body.wheel, 0.0])
    return lt.models.damper_wheel(total_inertia, (0.0, 1.0, 0.0), body.wheel, body.damping, BATH_HEAT_CAPACITY, 1.0)


def library_run(
    body: TumblingBody, method: lt.OneStepMethod, step: float, t_end: float, times: int
) -> Callable[[], MotionRecord]:
    """Return a run of this library with fixed steps."""
    system, omega = library_system(body), np.array(INITIAL_ANGULAR_VELOCITY)
    start = body.momentum(omega, 0.0)
    x0 = [*start, body.wheel * omega[1], 0.0] if body.wheel else start
    save_every = round(t_end / step / times)

    def work() -> MotionRecord:
        solution = lt.integrate(system, x0, (0.0, t_end), step, method, save_every=save_every)
        x, g = np.asarray(solution.x), np.asarray(solution.attitude)[:, :3, :3]
        omega, spin = body.angular_velocities(x[:, :3], x[:, 3] if body.wheel else np.zeros(len(x)))
        return _motion_record(body, omega, spin, g, np.asarray(solution.energy))

    return work


# -- SciPy ------------------------------------------------------------------------------------------------------------


def scipy_run(body: TumblingBody, tolerance: float, t_end: float, times: int) -> Callable[[], MotionRecord]:
    """Return a run by DOP853 on momentum, wheel, quaternion and heat."""
    omega, field = np.array(INITIAL_ANGULAR_VELOCITY), _scipy_field(body)
    x0 = np.array([*body.momentum(omega, 0.0), body.wheel * omega[1], 1.0, 0.0, 0.0, 0.0, 0.0])
    saved_times = np.linspace(0.0, t_end, times + 1)

    def work() -> MotionRecord:
        solution = solve_ivp(
            field, (0.0, t_end), x0, method="DOP853", rtol=tolerance, atol=tolerance, t_eval=saved_times
        )
        if not solution.success:
            raise RuntimeError(solution.message)
        x = solution.y.T
        omega, spin = body.angular_velocities(x[:, :3], x[:, 3])
        heat = x[:, 8]
        record = _motion_record(
            body, omega, spin, _rotation_matrices(x[:, 4:8]), body.kinetic_energy(omega, spin) + heat
        )
        return dataclasses.replace(record, steps=solution.nfev // 12)

    return work


def _scipy_field(body: TumblingBody) -> Callable:
    (I1, I2, I3), J, damping, turns = body.inertia, body.wheel or 1.0, body.damping, bool(body.wheel)

    @numba.njit
    def field(t, x):
        p = x[3] if turns else 0.0
        a, b, c = x[0] / I1, (x[1] - p) / I2, x[2] / I3
        s = p / J - b if turns else 0.0
        w, u, v, z = x[4], x[5], x[6], x[7]
        return np.array(
            [
                x[1] * c - x[2] * b,
                x[2] * a - x[0] * c,
                x[0] * b - x[1] * a,
                -damping * s,
                -0.5 * (u * a + v * b + z * c),
                0.5 * (w * a + v * c - z * b),
                0.5 * (w * b + z * a - u * c),
                0.5 * (w * c + u * b - v * a),
                damping * s * s,
            ]
        )

    return field


# -- MuJoCo -----------------------------------------------------------------------------------------------------------

MUJOCO_MODEL = """
<mujoco>
  <option gravity="0 0 0" timestep="{step}" integrator="{integrator}"><flag contact="disable"/></option>
  <worldbody><body><freejoint/><inertial pos="0 0 0" mass="1" diaginertia="{hub_moments}"/>{wheel}</body></worldbody>
</mujoco>
"""
"""MuJoCo's description of the body."""
MUJOCO_WHEEL = """
<body><inertial pos="0 0 0" mass="1e-6" diaginertia="{wheel_moments}"/>
  <joint type="hinge" axis="0 1 0" damping="{damping}"/></body>
"""
"""MuJoCo's description of the wheel."""


def mujoco_run(
    body: TumblingBody, integrator: str, step: float, t_end: float, times: int
) -> Callable[[], MotionRecord]:
    """Return a run of MuJoCo with a free body and a wheel on a hinge; MuJoCo's own loop takes the steps."""
    mj = import_peer("mujoco")
    numbers = {name: " ".join(map(str, getattr(body, name))) for name in ("hub_moments", "wheel_moments")}
    wheel = MUJOCO_WHEEL.format(damping=body.damping, **numbers) if body.wheel else ""
    model = mj.MjModel.from_xml_string(MUJOCO_MODEL.format(step=step, integrator=integrator, wheel=wheel, **numbers))
    steps_per_record = round(t_end / step / times)

    def work() -> MotionRecord:
        data = mj.MjData(model)
        data.qvel[3:6] = INITIAL_ANGULAR_VELOCITY
        states = [np.concatenate([data.qvel, data.qpos[3:7]])]
        for _ in range(times):
            mj.mj_step(model, data, nstep=steps_per_record)
            states.append(np.concatenate([data.qvel, data.qpos[3:7]]))
        x = np.array(states)
        spin = x[:, 6] if body.wheel else np.zeros(len(x))
        return _motion_record(body, x[:, 3:6], spin, _rotation_matrices(x[:, -4:]))

    return work


# -- Basilisk ---------------------------------------------------------------------------------------------------------


BASILISK_MODULES = (
    "Basilisk.simulation.spacecraft",
    "Basilisk.simulation.spinningBodyOneDOFStateEffector",
    "Basilisk.utilities.RigidBodyKinematics",
    "Basilisk.utilities.macros",
    "Basilisk.utilities.SimulationBaseClass",
)
"""Modules of Basilisk that are used."""


def basilisk_run(body: TumblingBody, step: float, t_end: float, times: int) -> Callable[[], MotionRecord]:
    """Return a run of Basilisk: a spacecraft with the default integrator, RK4, and a wheel as a spinning body.

    Setting up messages and modules is not timed, as a simulation runs once.
    """
    try:
        spacecraft, spinning_body, tools, macros, simulations = map(importlib.import_module, BASILISK_MODULES)
    except ImportError:
        reason = "Basilisk is not installed; `pip install bsk` in an environment of its own, since it holds pandas back"
        raise UnavailableError(reason) from None

    def work() -> MotionRecord:
        simulation = simulations.SimBaseClass()
        simulation.CreateNewProcess("process").addTask(simulation.CreateNewTask("task", macros.sec2nano(step)))
        craft = spacecraft.Spacecraft()
        craft.hub.mHub, craft.hub.IHubPntBc_B = 1.0, np.diag(body.hub_moments).tolist()
        craft.hub.omega_BN_BInit = [[w] for w in INITIAL_ANGULAR_VELOCITY]
        simulation.AddModelToTask("task", craft)
        record_interval = macros.sec2nano(t_end / times)
        spins = None
        if body.wheel:
            wheel = spinning_body.SpinningBodyOneDOFStateEffector()
            wheel.mass, wheel.k, wheel.c = 1e-6, 0.0, body.damping
            wheel.IPntSc_S, wheel.dcm_S0B = np.diag(body.wheel_moments).tolist(), np.eye(3).tolist()
            wheel.sHat_S = [[0.0], [1.0], [0.0]]
            craft.addStateEffector(wheel)
            simulation.AddModelToTask("task", wheel)
            spins = wheel.spinningBodyOutMsg.recorder(record_interval)
            simulation.AddModelToTask("task", spins)
        states = craft.scStateOutMsg.recorder(record_interval)
        simulation.AddModelToTask("task", states)
        simulation.InitializeSimulation()
        simulation.ConfigureStopTime(macros.sec2nano(t_end))
        start = time.process_time()
        simulation.ExecuteSimulation()
        seconds = time.process_time() - start
        omega = np.array(states.omega_BN_B)
        attitude = np.array([tools.MRP2C(sigma).T for sigma in states.sigma_BN])
        spin = np.zeros(len(omega)) if spins is None else np.array(spins.thetaDot)
        return dataclasses.replace(_motion_record(body, omega, spin, attitude), seconds=seconds)

    return work
