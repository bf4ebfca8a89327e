"""Observed orders on nonlinear problems, with the order written by hand; bodies that a torque brings to rest."""

import jax.numpy as jnp
import numpy as np
import pytest

import liethermo as lt
import manifolds as mf
from tests.cases import BuiltOnUse

SLACK = 0.2
"""Largest difference between an observed and an expected order."""

ORDERS = [
    ("gonzalez", 2),
    ("mean_value", 2),
    ("coordinate_increment", 1),
    ("symmetric_coordinate_increment", 2),
]


def nonlinear_body():
    # not separable: for a sum of functions of one coordinate each the coordinate increment is symmetric after all
    return lt.LiePoissonSystem(
        mf.so(3),
        lambda p: (
            0.5 * jnp.sum(p * p / jnp.array([3.0, 2.0, 1.0])) + 0.1 * p[0] ** 4 + 0.05 * jnp.cos(p[1] + 2.0 * p[2])
        ),
        lambda p: jnp.log(1.0 + jnp.dot(p, p)),
        lt.ProjectedMetric(rate=0.3),
    )


def nonlinear_top():
    return lt.LiePoissonSystem(
        mf.se(3),
        lambda m: 0.5 * jnp.sum(m[:3] ** 2 / jnp.array([2.0, 1.5, 1.0])) + jnp.sin(m[5] + m[0]) + 0.2 * m[3] ** 4,
        mf.se(3).casimirs(2)[1],
        lt.KillingDissipation(rate=0.05),
    )


NONLINEAR = BuiltOnUse(
    {
        "so(3)": lambda: (nonlinear_body(), np.array([0.8, 0.5, 0.9])),
        "se(3)": lambda: (nonlinear_top(), np.array([0.5, -0.4, 0.8, 0.6, 0.1, 0.7])),
    }
)
"""Systems with initial states, by name."""


@pytest.mark.sampled(1)
@pytest.mark.parametrize(("gradient", "order"), ORDERS)
@pytest.mark.parametrize("name", NONLINEAR)
def test_observed_order(name, gradient, order):
    """The slope of the error at T = 4 over three halvings is the order, above the rounding plateau."""
    system, x0 = NONLINEAR[name]
    method = lt.MetriplecticMidpoint(gradient)
    assert method.order == order
    exact = lt.integrate(system, x0, (0.0, 4.0), 4.0, lt.Reference(rtol=1e-13)).x[-1]
    steps = np.array([40, 80, 160, 320]) * (4 if order == 1 else 1)
    errors = np.array(
        [np.abs(lt.integrate(system, x0, (0.0, 4.0), 4.0 / n, method).x[-1] - exact).max() for n in steps]
    )
    slopes = np.log2(errors[:-1] / errors[1:])
    assert (errors > 1e-11).all()
    assert (np.abs(slopes - order) < SLACK).all(), (errors, slopes)


def test_free_body_reference_values():
    """A free body with I = (2, 1, 2/3) reaches its reference state at t = 10."""
    system = lt.models.free_rigid_body(inertia=(2.0, 1.0, 2.0 / 3.0))
    x0 = np.array([np.cos(1.1), 0.0, np.sin(1.1)])
    reference_state = np.array([0.407066136588041, 0.283007426812844, 0.868449167661562])
    assert float(system.energy(x0)) == pytest.approx(0.647125279313836, abs=1e-15)
    assert float(system.entropy(x0)) == pytest.approx(0.5, abs=1e-16)
    errors = []
    for h in (0.1, 0.05, 0.025, 0.0125):
        solution = lt.integrate(system, x0, (0.0, 10.0), h)
        errors.append(np.abs(solution.x[-1] - reference_state).max())
        assert solution.audit().energy_drift < 2e-15
    ratios = np.array(errors[:-1]) / errors[1:]
    assert (np.abs(ratios - 4.0) < 0.05).all(), ratios
    accurate = lt.integrate(system, x0, (0.0, 10.0), 10.0, lt.Reference(rtol=1e-13)).x[-1]
    assert np.abs(accurate - reference_state).max() < 1e-12


def test_figure_1_of_the_paper():
    """I = (10, 5, 1), h = 0.1, Pi(0) = (0.001, 1, 0.001): energy to 1e-14, entropy never falls, S -> I_max H."""
    system = lt.models.rigid_body(inertia=(10, 5, 1), rate=1.0)
    solution = lt.integrate(
        system, [0.001, 1.0, 0.001], (0.0, 500.0), 0.1, lt.MetriplecticMidpoint(gradient="gonzalez")
    )
    audit = solution.audit(energy=1e-14)
    assert audit.passed
    assert audit.energy_drift < 1e-14
    assert solution.stats.steps == 5000
    assert audit.entropy_min_increment >= -4 * np.finfo(float).eps * solution.entropy.max()
    # while it relaxes the entropy grows strictly; the noise floor is met only at the end
    assert (np.diff(solution.entropy[: np.argmax(solution.entropy > 0.999999 * solution.entropy[-1])]) > 0).all()
    assert solution.entropy[-1] == pytest.approx(10.0 * solution.energy[0], rel=1e-14)
    assert np.abs(solution.x[-1, 1:]).max() < 1e-15


def test_midpoint_of_the_paper_is_the_midpoint_rule_here():
    """For quadratic H the scheme is exactly the printed midpoint rule (BFM §4.3): one step, solved independently."""
    inertia, h, p = np.array([10.0, 5.0, 1.0]), 0.1, np.array([0.3, 1.0, -0.2])
    P = p.copy()
    for _ in range(200):
        z = 0.5 * (p + P)
        w = z / inertia
        P = p + h * (np.cross(z, w) + (w @ w) * z - (w @ z) * w)
    solution = lt.integrate(lt.models.rigid_body(inertia), p, (0.0, h), h)
    assert np.abs(solution.x[-1] - P).max() < 1e-15


STOP_TIME = 2.0
"""Time at which the torques have taken all of the momentum."""

EXPLICIT_METHODS = (lt.MetriplecticRungeKutta(4), lt.MetriplecticRungeKutta(6), lt.MetriplecticTaylor(6))
"""One explicit method of each kind."""


def braked_body(momentum, profile, moments=(1.0, 2.0, 3.0)) -> lt.System:
    """Return a body whose torque is ``-profile(t)`` times a momentum until the time ``STOP_TIME``, then zero."""

    def torque(t, _):
        return -jnp.asarray(momentum) * profile(t) * (t < STOP_TIME)

    return lt.models.rigid_body(moments, torque=torque)


def constant_profile(_):
    return 1.0 / STOP_TIME


def sine_profile(t):
    return 0.25 * jnp.pi * jnp.sin(0.5 * jnp.pi * t)


@pytest.mark.sampled(1)
@pytest.mark.parametrize("unit", [1.0, 1e-9])
@pytest.mark.parametrize("method", EXPLICIT_METHODS, ids=str)
@pytest.mark.parametrize("step", [0.0625, 0.125])
def test_a_constant_torque_stops_a_body_at_the_end_of_a_step(method, step, unit):
    """The momentum is linear in time, so that every method reaches rest to rounding and stays there."""
    momentum = unit * np.array([0.15, 0.05, 0.35])
    system = braked_body(momentum, constant_profile, moments=(1.0, 1.0, 1.0))

    solution = lt.integrate(system, momentum, (0.0, 3.0), step, method, breaks=[STOP_TIME])

    assert np.abs(solution.x[-1]).max() < 1e-15 * unit
    assert solution.casimirs["work"][-1] == pytest.approx(-0.5 * momentum @ momentum, rel=1e-13)
    assert solution.audit().passed


@pytest.mark.sampled(1)
@pytest.mark.parametrize("method", EXPLICIT_METHODS, ids=str)
def test_the_momentum_at_rest_has_the_order_of_the_method(method):
    """The work is not exact here, and the energy at rest cannot take its error: the work does, and the laws hold."""
    momentum = np.array([0.5, 0.0, 0.0])
    system = braked_body(momentum, sine_profile)

    def momentum_at_rest(step):
        solution = lt.integrate(system, momentum, (0.0, 3.0), step, method, breaks=[STOP_TIME])
        assert solution.audit().passed
        assert solution.casimirs["work"][-1] == pytest.approx(-0.125, abs=1e-11)
        return np.abs(solution.x[-1]).max()

    assert np.log2(momentum_at_rest(0.125) / momentum_at_rest(0.0625)) > method.order - 0.6


def test_a_step_that_is_much_too_long_still_fails():
    """The work takes an error of a hundredth of the energy at most."""
    momentum = np.array([0.5, 0.0, 0.0])
    system = braked_body(momentum, sine_profile)

    with pytest.raises(lt.ConvergenceError, match="Try a smaller step"):
        lt.integrate(system, momentum, (0.0, 3.0), 2.0, lt.MetriplecticRungeKutta(4), breaks=[STOP_TIME])
