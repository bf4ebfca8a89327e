"""Audits of bodies at rest, or that start from rest: the motion, rounding, and heat that is missing."""

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
import scipy.optimize

import liethermo as lt
import manifolds as mf
from tests.cases import only_row


class MidpointWithLessWheelHeat(lt.MetriplecticMidpoint):
    """Control: a thousandth of the heat of friction in :func:`body_with_wheel` is missing."""

    def slopes(self, system, x, compensation, h, k):
        return super().slopes(system, x, compensation, h, k).at[:, 4].multiply(0.999)


def body_with_wheel(attitude):
    return lt.models.damper_wheel(inertia=(1.6, 2.0, 1.0), attitude=attitude)


@pytest.mark.parametrize("attitude", [True, False])
@pytest.mark.sampled(1)
@pytest.mark.parametrize(
    "method", [lt.MetriplecticMidpoint(), lt.MetriplecticGauss(2), lt.MetriplecticRungeKutta(4)], ids=["mid", "2", "4"]
)
def test_the_heat_of_a_wheel_at_rest_is_rounding(method, attitude):
    """The wheel turns by 1e-17 relative to the body, and its heat of 1e-34 is not judged."""
    solution = lt.integrate(body_with_wheel(attitude), [1e-17, 1.0, 2e-17, 0.05, 0.0], (0.0, 20.0), 0.1, method)
    assert abs(solution.entropy[-1]) < 1e-30
    assert solution.audit().passed, f"\n{solution.audit()}"
    assert attitude or solution.evidence.inconsistency is None  # nothing moves


@pytest.mark.sampled(1)
@pytest.mark.parametrize("nutation", [1e-3, 1e-9])
@pytest.mark.parametrize(
    ("method", "is_consistent"),
    [(lt.MetriplecticMidpoint(), True), (MidpointWithLessWheelHeat(), False)],
    ids=["", "cold"],
)
def test_heat_that_is_missing_in_a_body_almost_at_rest(method, is_consistent, nutation):
    """Control of the test above: heat as small as the square of the nutation is judged."""
    x0 = [nutation, 1.0, 0.0, 0.05 + nutation, 0.0]
    solution = lt.integrate(body_with_wheel(True), x0, (0.0, 20.0), 0.1, method)
    row = only_row(solution.audit(), "consistency")
    assert row.passed is is_consistent, row
    assert is_consistent or row.value == pytest.approx(1e-3, rel=0.01)


def system_with_drag(name):
    """Return a system with drag that heats a bath, a state at rest, and its field without the bath in NumPy."""
    baths = lt.HeatBaths(2.0, 1.0)
    if name == "heavy top":
        inertia, rate, gravity = np.array([1.0, 1.2, 0.5]), 0.2, np.array([0.0, 0.0, 1.0])
        system = lt.LiePoissonSystem(
            mf.se(3),
            lambda mu: 0.5 * jnp.sum(mu[:3] ** 2 / inertia) + mu[5],
            dissipation=lt.Friction([rate] * 3 + [0.0] * 3),
            baths=baths,
        )

        def field(t, x):
            omega = x[:3] / inertia
            momentum_rate = np.cross(x[:3], omega) + np.cross(x[3:], gravity) - rate * omega
            return np.concatenate([momentum_rate, np.cross(x[3:], omega)])

        return system, [0.0, 0.0, 0.0, 0.6, 0.0, 0.8], field
    potential, force = {
        "spring": (lambda q: 0.5 * q**2, lambda q: -q),
        "pendulum": (lambda q: 1.0 - jnp.cos(q), lambda q: -np.sin(q)),
    }[name]
    system = lt.MetriplecticSystem(
        mf.Canonical(1),
        lambda x: potential(x[0]) + 0.5 * x[1] ** 2,
        dissipation=lt.Friction([0.0, 0.3]),
        baths=baths,
    )
    return system, [1.0, 0.0], lambda t, x: np.array([x[1], force(x[0]) - 0.3 * x[1]])


@pytest.mark.sampled(1)
@pytest.mark.parametrize("step", [0.05, lt.Adaptive(1e-8)], ids=["fixed", "adaptive"])
@pytest.mark.parametrize(
    "method", [lt.MetriplecticGauss(2), lt.MetriplecticRungeKutta(4), lt.MetriplecticTaylor(10)], ids=str
)
@pytest.mark.parametrize("name", ["spring", "pendulum", "heavy top"])
def test_drag_from_rest_is_the_motion(name, method, step):
    """The entropy of the bath begins as t^3, so every step misses the same fraction of its mean rate."""
    system, x0, field = system_with_drag(name)
    solution = lt.integrate(system, x0, (0.0, 10.0), step, method)
    exact_state = scipy.integrate.solve_ivp(field, (0.0, 10.0), x0, method="DOP853", rtol=1e-12, atol=1e-13).y[:, -1]
    assert np.abs(solution.x[-1, : len(x0)] - exact_state).max() < 1e-6
    audit = solution.audit()
    assert audit.verdict == "the laws hold, and the steps resolve the motion", str(audit)
    assert only_row(audit, "consistency").value < 1e-10


@pytest.mark.sampled(1)
@pytest.mark.parametrize("power", [1, 2, 4])
def test_a_force_that_grows_from_zero_is_the_motion(power):
    """A body at rest in equilibrium gets a velocity that begins as t^(power + 1), and its steps are consistent."""
    system = lt.MetriplecticSystem(
        mf.Canonical(1),
        lambda x, t: 0.5 * x[0] ** 2 + 0.5 * x[1] ** 2 - x[0] * t**power,
        dissipation=lt.Friction([0.0, 0.3]),
        baths=lt.HeatBaths(2.0, 1.0),
    )
    audit = lt.integrate(system, [0.0, 0.0], (0.0, 5.0), 0.05, lt.MetriplecticRungeKutta(4)).audit()
    assert audit.passed, str(audit)


class MidpointWithLessBathHeat(lt.MetriplecticMidpoint):
    """Control: a thousandth of the heat of drag on a spring is missing."""

    def slopes(self, system, x, compensation, h, k):
        return super().slopes(system, x, compensation, h, k).at[:, 2].multiply(0.999)


def test_heat_that_is_missing_from_rest_on():
    system, x0, _ = system_with_drag("spring")
    row = only_row(lt.integrate(system, x0, (0.0, 10.0), 0.05, MidpointWithLessBathHeat()).audit(), "consistency")
    assert row.passed is False
    assert row.value == pytest.approx(1e-3, rel=0.01)


def test_members_of_an_ensemble_that_start_at_rest():
    """The audits of an ensemble and of one trajectory, which replays its steps, pass for members that start at rest."""
    system, x0, _ = system_with_drag("spring")
    x0s = np.outer([1.0, 0.5, -2.0], x0)
    ensemble = lt.ensemble(system, x0s, (0.0, 10.0), 0.05, lt.MetriplecticRungeKutta(4), outputs="trajectory")
    assert ensemble.audit().verdict == "the laws hold, and the steps resolve the motion"
    member_audit = ensemble[1].audit()
    assert member_audit.passed, str(member_audit)
    assert only_row(member_audit, "consistency").value < 1e-10
