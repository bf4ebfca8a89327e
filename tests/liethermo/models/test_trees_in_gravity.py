"""Trees of jointed bodies in gravity: on the ground, falling, and along an orbit, beside Newton-Euler equations."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import ellipk

import liethermo as lt
from tests.liethermo.models.newton_euler import final_state
from tests.liethermo.models.test_jointed_bodies import ANGULAR_VELOCITY, BATHS, BODIES, JOINTS, NAMES, RATES, tree_of

GRAVITY = np.array([0.5, 0.0, -9.81])


def tree_on_ground(bodies, names):
    """Return the tree of bodies whose first one is the ground."""
    tree = lt.bodies.Tree(ground=names[0])
    for name, body in zip(names[1:], bodies[1:], strict=True):
        kind = lt.bodies.Slider if body.slides else lt.bodies.Hinge
        joint = kind(at=body.place, axis=body.axis, stiffness=body.stiffness, damping=body.damping)
        tree.add(name, body.mass, body.centre, body.inertia, parent=names[body.parent], joint=joint)
    return tree


def pendulum(length, inertia=(0.0, 0.0, 0.0), **joint):
    tree = lt.bodies.Tree(ground="ceiling")
    hinge = lt.bodies.Hinge((0.0, 0.0, 0.0), (0.0, 1.0, 0.0), **joint)
    tree.add("bob", 1.5, (0.0, 0.0, -length), inertia, parent="ceiling", joint=hinge)
    return tree


# -- on the ground --------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_tree_on_the_ground_beside_newton_and_euler():
    loads = lambda t, x, R: ([body.mass * GRAVITY for body in BODIES], np.zeros((4, 3)))  # noqa: E731
    _, q, heat = final_state(BODIES, np.zeros(3), [*JOINTS.values()], [*RATES.values()], 2.0, loads, is_fixed=True)
    system = tree_on_ground(BODIES, NAMES).system(baths=BATHS, gravity=GRAVITY)
    x0 = system.state(joints=JOINTS, joint_rates=RATES)
    assert {name: float(rate) for name, rate in system.joint_rates(x0).items()} == pytest.approx(RATES)
    errors = []
    for h in (0.04, 0.02):
        run = lt.integrate(system, x0, (0.0, 2.0), h, lt.MetriplecticGauss(3))
        errors.append(np.abs([run.joints[name][-1] for name in NAMES[1:]] - q).max())
        assert run.audit().passed
        assert np.ptp(run.energy) < 1e-11
        assert 300.0 * 50.0 * np.expm1(run.x[-1, -1] / 50.0) == pytest.approx(heat, rel=1e-5)
    assert errors[-1] < 1e-6
    assert np.log2(errors[0] / errors[1]) > 5.3


def test_period_of_a_pendulum_of_large_amplitude():
    """A point mass: ``T = 4 K(sin^2(a / 2)) sqrt(l / g)``."""
    amplitude, length = 2.0, 0.5
    system = pendulum(length).system(gravity=(0.0, 0.0, -9.81))
    period = 4.0 * ellipk(np.sin(amplitude / 2.0) ** 2) * np.sqrt(length / 9.81)
    run = lt.integrate(
        system, system.state(joints={"bob": amplitude}), (0.0, period), period / 200.0, lt.MetriplecticGauss(3)
    )
    assert run.joints["bob"][-1] == pytest.approx(amplitude, abs=1e-9)
    assert run.joints["bob"][100] == pytest.approx(-amplitude, abs=1e-9)
    assert run.audit().passed


def test_motor_that_holds_a_pendulum_does_no_work():
    angle = 0.7
    holding = 1.5 * 9.81 * 0.5 * np.sin(angle)
    tree = pendulum(0.5, motor=holding)
    system = tree.system(gravity=(0.0, 0.0, -9.81))
    run = lt.integrate(system, system.state(joints={"bob": angle}), (0.0, 2.0), 0.05, lt.MetriplecticGauss(2))
    np.testing.assert_allclose(run.joints["bob"], angle, atol=1e-13)
    driven = tree.system(gravity=(0.0, 0.0, -9.81), motors={"bob": lambda t: holding + 0.3 * jnp.cos(t)})
    run = lt.integrate(driven, driven.state(joints={"bob": angle}), (0.0, 2.0), 0.05, lt.MetriplecticGauss(2))
    assert abs(run.casimirs["work"][-1]) > 1e-2
    assert np.ptp(run.energy - run.casimirs["work"]) < 1e-13
    assert run.audit().passed


def test_forces_of_weights_are_the_slopes_of_their_potential():
    system = tree_on_ground(BODIES, NAMES).system(gravity=GRAVITY)
    weight = system.energy.terms[-1]
    x, step = np.array([0.4, -0.7, 0.2, 0.0, 0.0, 0.0]), 1e-5
    slopes = [float(weight.value(x + step * e) - weight.value(x - step * e)) / (2.0 * step) for e in np.eye(6)[:3]]
    np.testing.assert_allclose(np.asarray(weight.gradient(x)), [*slopes, 0.0, 0.0, 0.0], atol=1e-7)


# -- falling --------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_free_tree_falls_and_turns_as_without_gravity():
    tree = tree_of(BODIES[:2], NAMES[:2])
    falling, free = tree.system(baths=BATHS, gravity=GRAVITY), tree.system(baths=BATHS)
    start = {"angular_velocity": ANGULAR_VELOCITY, "joints": {"panel": 0.4}}
    x0 = falling.state(**start, centre_of_mass=(1.0, 2.0, 3.0), velocity=(0.0, 4.0, 5.0))
    run, other = (
        lt.integrate(system, x, (0.0, 2.0), 0.1, lt.MetriplecticGauss(2))
        for system, x in ((falling, x0), (free, free.state(**start)))
    )
    np.testing.assert_allclose(run.attitude, other.attitude, atol=1e-13)
    np.testing.assert_allclose(run.joints["panel"], other.joints["panel"], atol=1e-13)
    t = run.t[:, None]
    parabola = np.array([1.0, 2.0, 3.0]) + np.array([0.0, 4.0, 5.0]) * t + 0.5 * GRAVITY * t**2
    np.testing.assert_allclose(falling.centre_of_mass(run.x), parabola, atol=1e-12)
    assert np.ptp(run.energy) < 1e-11
    assert run.audit().passed
    # the origin of the base: the centre of mass less the offset of the masses, turned into space
    places = np.array([0.5, 0.1, 0.0])
    q = float(run.joints["panel"][-1])
    c, s = np.cos(q), np.sin(q)
    panel = places + np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]]) @ BODIES[1].centre
    offset = (10.0 * BODIES[0].centre + 2.0 * panel) / 12.0
    np.testing.assert_allclose(
        falling.base_position(run.x, run.attitude)[-1], parabola[-1] - run.attitude[-1] @ offset, atol=1e-12
    )
    np.testing.assert_allclose(
        free.base_position(other.x, other.attitude)[-1], -other.attitude[-1] @ offset, atol=1e-12
    )


# -- along an orbit -------------------------------------------------------------------------------------------------

ORBIT_RATE = 0.4
"""Mean motion of a fast orbit, on which the gradient of gravity competes with springs and spin."""


def tidal_loads(t, x, R):
    """Return the forces and torques of the gradient of gravity on a circular orbit, in the axes in space."""
    n = np.array([np.cos(ORBIT_RATE * t), np.sin(ORBIT_RATE * t), 0.0])
    masses = np.array([body.mass for body in BODIES])
    forces = ORBIT_RATE**2 * masses[:, None] * (3.0 * (x @ n)[:, None] * n - x)
    inertias = [turn @ body.inertia @ turn.T for turn, body in zip(R, BODIES, strict=True)]
    return forces, [3.0 * ORBIT_RATE**2 * np.cross(n, J @ n) for J in inertias]


@pytest.mark.slow
def test_gradient_of_gravity_on_every_body_beside_newton_and_euler():
    start = [*JOINTS.values()], [*RATES.values()]
    R, q, _ = final_state(BODIES, ANGULAR_VELOCITY, *start, 4.0, tidal_loads)
    unloaded, _, _ = final_state(BODIES, ANGULAR_VELOCITY, *start, 4.0)
    assert np.abs(R - unloaded).max() > 0.1  # a control: without the gradient it turns otherwise
    system = tree_of(BODIES, NAMES).system(baths=BATHS, gravity=lt.torques.Orbit(ORBIT_RATE))
    x0 = system.state(angular_velocity=ANGULAR_VELOCITY, joints=JOINTS, joint_rates=RATES)
    errors = []
    for h in (0.1, 0.05):
        run = lt.integrate(system, x0, (0.0, 4.0), h, lt.MetriplecticGauss(2))
        errors.append(max(np.abs(run.attitude[-1] - R).max(), np.abs([run.joints[n][-1] for n in NAMES[1:]] - q).max()))
        assert run.audit().passed
        assert np.ptp(run.energy - run.casimirs["work"]) < 1e-11
    assert errors[-1] < 1e-3
    assert np.log2(errors[0] / errors[1]) > 3.3


def test_torque_of_the_gradient_is_that_of_the_locked_inertia():
    """With the joints held the torque is ``3 n^2 e × J e``, J the inertia of the whole [Hughes 1986, 8.1]."""
    system = tree_of(BODIES, NAMES).system(gravity=lt.torques.Orbit(ORBIT_RATE, eccentricity=0.2))
    x = system.state(angular_velocity=ANGULAR_VELOCITY, joints=JOINTS)
    attitude = lt.bodies.attitude(quaternion=np.array([0.1, 0.5, -0.3, 0.8]) / np.sqrt(0.99))
    J = np.asarray(system.mass_matrix([*JOINTS.values()]))[:3, :3]
    for t in (0.0, 3.0):
        torque = np.asarray(system.at_time(t, attitude).external_torque(x))
        single = lt.torques.GravityGradient(J, lt.torques.Orbit(ORBIT_RATE, eccentricity=0.2))
        np.testing.assert_allclose(torque[:3], np.asarray(single(t, x[:3], attitude)), atol=1e-14)
        np.testing.assert_array_equal(torque[3:6], 0.0)


# -- bad input ------------------------------------------------------------------------------------------------------


def test_bad_input():
    tree = pendulum(0.5)
    with pytest.raises(lt.InputError, match="the ground"):
        tree.system(torque=lt.torques.ConstantInBody((0.0, 0.0, 1.0)))
    with pytest.raises(lt.InputError, match="for a free tree"):
        tree.system(gravity=lt.torques.Orbit(1e-3))
    with pytest.raises(lt.InputError, match="gravity"):
        tree.system(gravity=-9.81)
    with pytest.raises(lt.InputError, match="moves no inertia"):
        pendulum(0.0).system(gravity=GRAVITY)
    with pytest.raises(lt.InputError, match="no joint"):
        lt.bodies.Tree(ground="ceiling").system(gravity=GRAVITY)
    with pytest.raises(lt.InputError, match="not empty"):
        lt.bodies.Tree(ground="")
    free = tree_of(BODIES[:2], NAMES[:2])
    with pytest.raises(lt.InputError, match="gravity"):
        free.system().state(velocity=(0.0, 0.0, 1.0))
    with pytest.raises(lt.InputError, match="attitude"):
        free.system(gravity=lt.torques.Orbit(1e-3), attitude=False)
