"""The generalised Chetaev principle [SML Def. 3.1]: equations, laws, and its discretisations."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import liethermo as lt
from liethermo.tracing.interpret import evaluate_at_points

X0 = np.array([0.3, -0.2, 0.5, 0.4, 0.1])


def L(q, v, S):
    """The mass depends on q and couples the velocities; the temperature is exp(S/2)/2."""
    kinetic = 0.5 * (1.0 + 0.3 * q[0] ** 2) * v[0] ** 2 + 0.5 * v[1] ** 2 + 0.2 * v[0] * v[1]
    return kinetic - 0.5 * q @ q - 0.1 * q[0] ** 4 - jnp.exp(0.5 * S)


def eta(q, v, S):
    """Not linear in v, not symmetric, and with an eta_S of its own."""
    turned = jnp.array([-0.5 * v[1], 0.5 * v[0]])
    return jnp.append(turned - jnp.array([1.0 + v @ v, jnp.exp(q[1])]) * v, 2.0 + jnp.sin(S))


@functools.cache
def chetaev_system():
    return lt.ChetaevSystem(L, eta, 5, validate=False)


def field_by_hand(t, y):
    """(14), written out."""
    q, v, S = y[:2], y[2:4], y[4]
    mass, T = np.array([[1.0 + 0.3 * q[0] ** 2, 0.2], [0.2, 1.0]]), 0.5 * np.exp(0.5 * S)
    form = np.array([-v[0] * (1.0 + v @ v) - 0.5 * v[1], 0.5 * v[0] - v[1] * np.exp(q[1])])
    by_q = np.array([0.3 * q[0] * v[0] ** 2 - q[0] - 0.4 * q[0] ** 3, -q[1]])
    turned = np.array([0.6 * q[0] * v[0] ** 2, 0.0])  # of d/dt L_v
    at_S = 2.0 + np.sin(S)
    return np.concatenate([v, np.linalg.solve(mass, T / at_S * form + by_q - turned), [-(form @ v) / at_S]])


def test_the_equations_and_their_laws():
    points = np.random.default_rng(1).standard_normal((8, 5))
    field = evaluate_at_points(lambda system, x: system.vector_field(x), chetaev_system(), points)
    expected = np.array([field_by_hand(0.0, x) for x in points])
    assert np.abs(field - expected).max() < 1e-12 * np.abs(expected).max()
    assert (chetaev_system().energy_law, chetaev_system().entropy_law) == ("conserved", "nondecreasing")
    assert chetaev_system().check(points).passed


def test_it_is_the_thermodynamic_herglotz_system_for_eta_L():
    """SML Prop. 3.3; and for ``T dS + F dq`` a simple closed system with that friction."""
    points = np.random.default_rng(2).standard_normal((8, 5))
    field = lambda system: evaluate_at_points(lambda system, x: system.vector_field(x), system, points)  # noqa: E731
    by_L = lt.ChetaevSystem(L, lambda q, v, S: jnp.append(-jax.grad(L, argnums=1)(q, v, S), 1.0), 5, validate=False)
    herglotz = lt.ThermodynamicHerglotz(lambda x: L(x[:2], x[2:4], x[4]), 5, validate=False)
    assert np.abs(field(by_L) - field(herglotz)).max() < 1e-12 * np.abs(field(herglotz)).max()
    R = jnp.array([[0.3, 0.2], [-0.1, 0.4]])
    by_force = lt.ChetaevSystem(L, lambda q, v, S: 2.0 / jnp.exp(0.5 * S) * (R @ v), 5, validate=False)
    assert by_force.entropy_law is None, "a form that pushes has no law of the entropy"
    braking = lt.ChetaevSystem(L, lambda q, v, S: -2.0 / jnp.exp(0.5 * S) * (R @ v), 5, validate=False)
    closed = lt.SimpleClosedSystem(L, 5, friction=R, validate=False)
    assert np.abs(field(braking) - field(closed)).max() < 1e-12 * np.abs(field(closed)).max()


@pytest.mark.sampled(1)
@pytest.mark.parametrize(
    ("method", "order"),
    [
        (lt.MetriplecticGauss(2), 4.0),
        (lt.MetriplecticMidpoint(), 2.0),
        (lt.MetriplecticRungeKutta(6), 6.0),
        (lt.VariationalIntegrator.midpoint(), 2.0),
        (lt.VariationalIntegrator.verlet(), 1.0),
        (lt.VariationalGauss(2), 4.0),
    ],
    ids=str,
)
def test_methods_and_their_orders(method, order):
    exact = solve_ivp(field_by_hand, (0.0, 2.0), X0, method="DOP853", rtol=1e-13, atol=1e-13).y[:, -1]
    runs = [lt.integrate(chetaev_system(), X0, (0.0, 2.0), h, method) for h in (0.1, 0.05)]
    errors = [np.abs(run.x[-1] - exact).max() for run in runs]
    assert abs(np.log2(errors[0] / errors[1]) - order) < 0.2, errors
    assert np.diff(runs[0].entropy).min() > 0.0
    if "energy" in method.preserves:
        assert runs[0].audit().energy_drift < 1e-14


def test_a_form_of_the_entropy_rate():
    """``eta_q . v + eta_S S' = 0``, solved for S'."""

    def form_with_entropy_rate(q, v, S, S_dot):
        return jnp.append(-v * (1.0 + 0.1 * S_dot**2), 1.0 + 0.2 * S_dot)

    system = lt.ChetaevSystem(L, form_with_entropy_rate, 5, validate=False)
    rate = np.asarray(system.vector_field(X0))
    form = np.asarray(form_with_entropy_rate(X0[:2], X0[2:4], X0[4], rate[4]))
    assert rate[4] > 0.3
    assert abs(form[:2] @ X0[2:4] + form[2] * rate[4]) < 1e-15
    assert abs(float(system.energy.gradient(X0) @ rate)) < 1e-15


@pytest.mark.parametrize(
    ("given", "error", "words"),
    [
        (3.0, lt.InputError, "a function"),
        (lambda q, v, S: jnp.ones(5), lt.FunctionError, r"shape \(3,\) or \(2,\), got \(5,\)"),
        (lambda q: q, lt.FunctionError, "could not be evaluated"),
    ],
)
def test_bad_input(given, error, words):
    with pytest.raises(error, match=words):
        lt.ChetaevSystem(L, given, 5)
