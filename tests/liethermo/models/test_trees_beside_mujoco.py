"""Free trees of jointed bodies beside MuJoCo.

The numbers are those of MuJoCo 4.0.0 with ``integrator="RK4"`` and a time step of 5e-4, zero gravity and no contacts,
after the linear momentum was removed by the velocity of the free joint. Between steps of 1e-3 and 5e-4 they change by
less than 2e-11, so by the order of the method their error is about 1e-12. Attitudes are (w, x, y, z), from axes of the
base to axes in space, as in MuJoCo.
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
