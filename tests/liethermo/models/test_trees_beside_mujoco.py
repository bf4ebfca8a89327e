"""Free trees of jointed bodies beside MuJoCo.

The numbers are those of MuJoCo 4.0.0 with ``integrator="RK4"`` and a time step of 5e-4, zero gravity and no contacts,
after the linear momentum was removed by the velocity of the free joint. Between steps of 1e-3 and 5e-4 they change by
less than 2e-11, so by the order of the method their error is about 1e-12. Attitudes are (w, x, y, z), from axes of the
base to axes in space, as in MuJoCo.

The trees that are read from MJCF have been run with a time step of 2.5e-4 and the torques of the motors as
``qfrc_applied``. Between steps of 5e-4 and 2.5e-4 the numbers change by 3e-14 (free) and 2e-12 (on the ground).
"""

import numpy as np
import pytest

import liethermo as lt
from tests.liethermo.models.newton_euler import Body
from tests.liethermo.models.test_jointed_bodies import ANGULAR_VELOCITY, BODIES, NAMES, momentum_in_space, tree_of

END = 3.0
"""End of the runs (s)."""

CHAIN = [
    Body(5.0, np.zeros(3), np.diag([2.0, 1.5, 1.0])),
    *(
        Body(
            *(1.0, np.array([0.2, 0.05, 0.0]), np.diag([0.05, 0.06, 0.07])),
            *(i, False, np.array([0.4, 0.0, 0.1]), np.eye(3)[i % 3], 0.5),
        )
        for i in range(9)
    ),
]
"""A bus and nine links on hinges about three axes in turn, with springs."""

CHAIN_NAMES = tuple(f"link {i}" for i in range(10))

MUJOCO = {
    "three": {
        "angles": [0.4164032774426208, -0.5576446397023627],
        "attitude": [0.1785738375040434, 0.3792682192948711, 0.4718376291888107, 0.775652147598046],
        "energy": 4.017552691971208,
        "momentum": [2.5452685680176743, 2.0968302043044758, 6.76136357715253],
    },
    "ten": {
        "angles": [
            *(-0.7893013679309584, 0.1027253819592319, -0.7699564840272687, 0.1733824160070473, -0.4467253754211046),
            *(-0.1964883743646754, 0.0908427182203624, 0.0017757742042154, -0.5930843852273597),
        ],
        "attitude": [-0.0385309889228892, 0.092315689414012, 0.6824763590750732, 0.7240298306591183],
        "energy": 7.9803363463715975,
        "momentum": [-0.2914291037675298, 0.3970877651824347, 18.735490809194015],
    },
}
"""Joint angles (rad) and attitude at the end; energy (J) and angular momentum in space (N m s)."""


def system_and_state(name):
    """Return a tree that MuJoCo has run, its initial state and the names of its joints."""
    if name == "three":
        tree, names = tree_of(BODIES[:3], NAMES[:3], damping=0.0), NAMES[1:3]
        joints, rates = dict(zip(names, (0.4, -0.7), strict=True)), dict(zip(names, (0.2, 0.5), strict=True))
    else:
        tree, names, rates = tree_of(CHAIN, CHAIN_NAMES), CHAIN_NAMES[1:], None
        joints = dict(zip(names, 0.1 * np.arange(9), strict=True))
    system = tree.system()
    return system, system.state(angular_velocity=ANGULAR_VELOCITY, joints=joints, joint_rates=rates), names


@pytest.mark.slow
@pytest.mark.parametrize("name", ["three", pytest.param("ten", marks=pytest.mark.slow)])
def test_joint_angles_attitude_energy_and_momentum(name):
    system, x0, joints = system_and_state(name)
    reference, errors = MUJOCO[name], []
    for h in (0.05, 0.025):
        run = lt.integrate(system, x0, (0.0, END), h, lt.MetriplecticGauss(3))
        assert run.audit().passed
        angles = np.array([run.joints[joint][-1] for joint in joints])
        attitude = lt.bodies.quaternions(run, scalar="first")[-1]
        attitude = attitude * np.sign(attitude @ reference["attitude"])
        errors.append(max(abs(angles - reference["angles"]).max(), abs(attitude - reference["attitude"]).max()))
    assert errors[-1] < 1e-6
    assert np.log2(errors[0] / errors[1]) > 5.3  # order 6
    np.testing.assert_allclose(run.energy, reference["energy"], rtol=1e-13)
    np.testing.assert_allclose(momentum_in_space(run), np.array([reference["momentum"]] * len(run.t)), atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "end"), [("three", 1000.0), ("ten", 50.0)])
def test_energy_and_momentum_of_long_runs(name, end):
    """MuJoCo's RK4 with steps of 0.01 s changes energy and momentum by 6e-7 and 1e-7 of their values in 1,000 s."""
    system, x0, _ = system_and_state(name)
    run = lt.integrate(system, x0, (0.0, end), 0.05, lt.MetriplecticGauss(2), save_every=100)
    momentum = momentum_in_space(run)
    assert np.abs(run.energy / run.energy[0] - 1.0).max() < 1e-13
    assert np.linalg.norm(momentum - momentum[0], axis=1).max() < 1e-12 * np.linalg.norm(momentum[0])


FREE_MJCF = """<mujoco><compiler angle="radian"/><compiler autolimits="true"/><option gravity="0 0 0"/>
  <default><joint damping="0.1"/></default><worldbody>
  <body name="bus" quat="1 2 3 4"><freejoint/>
    <inertial pos="0.1 0 0.05" mass="5" diaginertia="2 1.5 1" euler="0.3 0.2 0.1"/>
    <body name="panel" pos="0.5 0.1 0" euler="0.1 -0.4 0.7">
      <joint axis="0 1 1" pos="0.1 0 0" stiffness="4" springref="0.2"/>
      <inertial pos="0.8 0 0" mass="2" fullinertia="0.05 0.4 0.42 0.01 -0.02 0.005"/>
      <body name="dish" pos="1 0 0.1" axisangle="1 1 0 0.5"><joint axis="1 0 0" stiffness="1"/>
        <joint axis="0 1 0" damping="0.05"/>
        <inertial pos="0 0.1 0.3" mass="1" diaginertia="0.1 0.13 0.15"/></body></body>
    <body name="mass" pos="-0.4 0 0.2"><joint type="slide" axis="1 2 2" stiffness="9" springref="0.05"/>
      <inertial pos="0 0 0" mass="0.7" diaginertia="0.01 0.01 0.01"/></body>
  </body></worldbody></mujoco>"""
"""A bus, a panel on a hinge with a universal joint at its end, and a mass on a slider; springs, dampers and motors."""

GROUND_MJCF = """<mujoco><option gravity="0 0 -9.81"/><default><joint damping="0.2"/></default><worldbody>
  <body name="cart" pos="0 0 1"><joint type="slide" axis="2 0 0" stiffness="3"/>
    <inertial pos="0 0 0" mass="2" diaginertia="0.1 0.1 0.1"/>
    <body name="upper" euler="10 0 20"><joint axis="0 1 0.2" stiffness="0.5" springref="30"/>
      <inertial pos="0 0.05 -0.5" mass="1" diaginertia="0.08 0.08 0.01"/>
      <body name="lower" pos="0 0 -1" euler="0 0 -20"><joint axis="0 1 0" damping="0.05"/>
        <inertial pos="0 0 -0.4" mass="0.7" diaginertia="0.05 0.05 0.01"/></body></body></body></worldbody></mujoco>"""
"""A cart on a spring that carries two links."""


def free_run(method, step):
    system = lt.bodies.Tree.from_mjcf(FREE_MJCF).system(motors={"panel": 0.3, "dish": (0.0, -0.1), "mass": 0.5})
    x0 = system.state(
        angular_velocity=ANGULAR_VELOCITY,
        joints={"panel": 0.4, "dish": (0.3, -0.2), "mass": 0.1},
        joint_rates={"panel": 0.2, "dish": (-0.5, 0.1), "mass": 0.3},
    )
    run = lt.integrate(system, x0, (0.0, 2.0), step, method)
    q = lt.bodies.quaternions(run, scalar="first")[-1]
    return run, np.hstack([q, *(run.joints[name][-1] for name in ("panel", "dish", "mass"))])


def ground_run(method, step):
    tree = lt.bodies.Tree.from_mjcf(GROUND_MJCF)
    system = tree.system(gravity=(0.0, 0.0, -9.81), motors={"cart": 1.5, "upper": 0.4})
    x0 = system.state(
        joints={"cart": 0.2, "upper": 0.8, "lower": -0.5}, joint_rates={"cart": 0.1, "upper": -0.3, "lower": 0.6}
    )
    run = lt.integrate(system, x0, (0.0, 2.0), step, method)
    return run, np.hstack([run.joints[name][-1] for name in ("cart", "upper", "lower")])


FREE_END = [
    *(0.6234370137450976, 0.09119300339367789, 0.2968200602559082, 0.7175708869890924),
    *(0.29645678025921834, 0.27096203504776123, 0.7198430312715867, 0.13092815514764347),
]
"""Attitude and joint coordinates after 2 s."""

GROUND_END = [0.8803438931502012, 0.487864526106403, 0.015078640007421592]
"""Joint coordinates after 2 s."""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("make_run", "end", "method", "order"),
    [
        (ground_run, GROUND_END, lt.MetriplecticRungeKutta(6), 6),
        (ground_run, GROUND_END, lt.MetriplecticGauss(2), 4),
        (free_run, FREE_END, lt.MetriplecticRungeKutta(6), 6),
    ],
    ids=["ground, RungeKutta(6)", "ground, Gauss(2)", "free, RungeKutta(6)"],
)
def test_files_with_springs_dampers_and_motors(make_run, end, method, order):
    """The pose of a free base and the gravity of a file are not taken over, so the runs state them."""
    errors = []
    for step in (0.05, 0.025):
        run, values = make_run(method, step)
        assert run.audit().passed
        errors.append(np.abs(values - end).max())
    assert errors[-1] < 1e-5
    assert np.log2(errors[0] / errors[1]) > order - 0.4
