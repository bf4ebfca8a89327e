"""Euler-Poincaré equations with entropy, and their variational integrator."""

from __future__ import annotations

import functools

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import liethermo as lt
import manifolds as mf
from liethermo.models.body_with_wheels import body_with_wheels_rest
from liethermo.tracing.interpret import evaluate_at_points
from tests.refusals import refusal_test

body = functools.cache(lt.models.body_with_wheels)
X0 = [0.1, 1.0, 0.2, 0.5, -0.3, 0.4, 0.0]
METHOD = lt.LieVariational()


def coupled_lagrangian(xi, S):
    """Return a Lagrangian that is neither quadratic nor a sum of kinetic and internal energy."""
    return (
        0.5 * xi @ (jnp.array([3.0, 2.0, 1.0]) * (1.0 + 0.02 * jnp.tanh(S)) * xi) + 0.05 * (xi @ xi) ** 2 - jnp.exp(S)
    )


def braking_force(xi, S):
    return -(0.1 + 0.05 * S**2) * (1.0 + xi @ xi) * jnp.array([1.0, 0.5, 0.2]) * xi


@functools.cache
def coupled_system():
    return lt.EulerPoincareClosedSystem(mf.so(3), coupled_lagrangian, braking_force)


def residuals(system, x):
    """Return the residuals of d/dt l_xi = ad*_xi l_xi + f, T S' = -f . xi, and E' = 0, and S'."""
    xi, S, rate = x[:-1], x[-1], system.vector_field(x)
    mu, W, dmu_dS = system.poisson.momentum_and_derivatives(x)
    force = system.friction_force(xi, S)
    return {
        "momentum": W @ rate[:-1] + dmu_dS * rate[-1] - system.algebra.ad_star(xi, mu) - force,
        "heat": system.temperature(x) * rate[-1] + force @ xi,
        "energy": system.energy.gradient(x) @ rate,
    }, rate[-1]


@pytest.mark.sampled(1)
@pytest.mark.parametrize("make", [body, coupled_system], ids=["body with wheels", "tangled"])
def test_the_equations(make):
    system = make()
    points = np.random.default_rng(0).standard_normal((8, system.dim))
    residuals_by_name, production = evaluate_at_points(residuals, system, points)
    for name, residual in residuals_by_name.items():
        assert np.abs(residual).max() < 1e-12, name
    assert production.min() > 0.0
    assert system.check(points).passed


@pytest.mark.slow
def test_a_body_that_heats_itself():
    """The energy balance, the sign of the production, and the spatial momentum, which friction does not change."""
    h = 0.1
    solution = lt.integrate(body(), X0, (0.0, 200.0), h, METHOD, engine="array")
    assert solution.stats.least_entropy_increment >= 0.0
    assert (np.diff(solution.x[:200, -1]) > 0.0).all()  # later it is at rest
    assert solution.audit().energy_drift < 1e-3  # 4e-4 measured: of second order, and bounded
    g, mu = METHOD.attitudes(body(), solution.x, h)[:, :3, :3], np.asarray(body().momenta(solution.x))[:, :3]
    spatial = np.einsum("kij,kj->ki", g, mu)  # Ad*_{g^-1} mu = g mu on SO(3)
    assert np.abs(spatial - spatial[0]).max() < 1e-12 * np.linalg.norm(spatial[0])
    assert np.abs(mu - mu[0]).max() > 0.5  # in the body it moves
    assert np.abs(g[-1] @ g[-1].T - np.eye(3)).max() < 1e-12
    # it ends as a spin about the axis of greatest inertia, wheels at rest, at the temperature of the energy balance
    assert np.abs(solution.x[-1, 1:6]).max() < 1e-2
    rest_temperature = body_with_wheels_rest(np.linalg.norm(mu[0]), solution.energy[0])
    assert float(body().temperature(solution.x[-1])) == pytest.approx(rest_temperature, rel=1e-3)


def _errors(system, x0, steps, t=2.0):
    exact, errors = lt.integrate(system, x0, (0.0, t), t, lt.Reference(rtol=1e-12)).x[-1], []
    for n in steps:
        solution = lt.integrate(system, x0, (0.0, t), t / n, METHOD, save_every=n, engine="array")
        assert solution.stats.least_entropy_increment > 0.0
        errors.append(np.abs(solution.x[-1] - exact).max())
    return errors


@pytest.mark.slow
@pytest.mark.parametrize(("make", "x0"), [(coupled_system, [0.5, 1.0, -0.4, 0.1]), (body, X0)])
def test_observed_order(make, x0):
    """The order is 2, since the discrete Lagrangian is symmetric."""
    errors = _errors(make(), x0, (20, 40, 80, 160))
    assert METHOD.order == 2
    assert (np.abs(np.log2(np.array(errors[:-1]) / errors[1:]) - 2) < 0.2).all(), errors


@pytest.mark.slow
def test_without_friction_the_casimirs_and_the_energy_stay():
    """On a free rigid body |mu|^2 is constant to rounding and the energy error bounded, in both engines."""
    free_body = lt.EulerPoincareClosedSystem(
        mf.so(3), lambda xi, S: 0.5 * xi @ (jnp.array([3.0, 2.0, 1.0]) * xi) - jnp.exp(S)
    )
    runs = [
        lt.integrate(free_body, [0.1, 1.0, 0.3, 0.0], (0.0, 2000.0), 0.1, METHOD, engine=engine)
        for engine in ("array", "compiled")
    ]
    norms = np.linalg.norm(np.asarray(free_body.momenta(runs[0].x)), axis=1)
    assert np.abs(norms - norms[0]).max() < 1e-12
    error = np.abs(runs[0].energy - runs[0].energy[0])
    assert 1e-7 < error.max() < 1.2 * error[:400].max()
    assert np.abs(runs[0].x[:200] - runs[1].x[:200]).max() < 1e-12


def forced_field(t, y):
    """Return the field of a body with an external torque and heat, written out, followed by the ledger."""
    xi, S = y[:3], y[3]
    moments, T = np.array([2.0, 1.0, 1.5]), 0.5 * np.exp(0.5 * S)
    friction, external = -FRICTION_MATRIX @ xi, np.array([0.2 * np.sin(t), 0.1, -0.1 * xi[2]])
    heat = 0.1 + 0.3 * np.cos(t)
    xi_dot = (np.cross(moments * xi, xi) + friction + external) / moments
    return np.concatenate([xi_dot, [(heat - friction @ xi) / T, external @ xi, heat, 1.0]])


FRICTION_MATRIX = np.array([[0.3, 0.1, 0.0], [-0.1, 0.2, 0.0], [0.0, 0.0, 0.1]])


@functools.cache
def forced_system():
    return lt.EulerPoincareClosedSystem(
        mf.so(3),
        lambda xi, S: 0.5 * xi @ (jnp.array([2.0, 1.0, 1.5]) * xi) - jnp.exp(0.5 * S),
        lambda xi, S: -FRICTION_MATRIX @ xi,
        external=lambda xi, S, t: jnp.array([0.2 * jnp.sin(t), 0.1, -0.1 * xi[2]]),
        heat_power=lambda xi, S, t: 0.1 + 0.3 * jnp.cos(t),
    )


@pytest.mark.sampled(1)
@pytest.mark.parametrize(
    ("method", "order"),
    [
        (lt.LieVariational("exp"), 2.0),
        (METHOD, 2.0),
        (lt.MetriplecticGauss(2), 4.0),
        (lt.MetriplecticRungeKutta(6), 6.0),
    ],
    ids=str,
)
def test_forces_and_heat_from_outside(method, order):
    """The ledger is part of the state, so the reference checks both of its sides."""
    system, x0 = forced_system(), np.array([0.5, 0.3, -0.4, 0.2])
    exact = solve_ivp(forced_field, (0.0, 2.0), np.append(x0, np.zeros(3)), method="DOP853", rtol=1e-13, atol=1e-13).y[
        :, -1
    ]
    runs = [lt.integrate(system, x0, (0.0, 2.0), h, method) for h in (0.1, 0.05)]
    errors = [np.abs(run.x[-1] - exact).max() for run in runs]
    assert abs(np.log2(errors[0] / errors[1]) - order) < 0.2, errors
    assert set(system.ledger_functions) == {"work received", "heat received"}
    if "energy" in method.preserves:
        assert runs[0].audit().energy_drift < 1e-14


@pytest.mark.slow
def test_su3_by_the_exponential():
    """The Cayley map leaves SU(3); with exp the Casimirs are constant, the order is 2, and the group is kept."""
    weights, x0 = np.linspace(1.0, 2.0, 8), np.append(np.linspace(0.1, 0.5, 8), 0.1)
    system = lt.EulerPoincareClosedSystem(mf.su(3), lambda xi, S: 0.5 * xi @ (weights * xi) - jnp.exp(0.5 * S))
    with pytest.raises(lt.InputError, match=r"LieVariational\('exp'\)"):
        METHOD.check(system)
    method, exact = lt.LieVariational("exp"), lt.integrate(system, x0, (0.0, 2.0), 0.02, lt.MetriplecticGauss(3)).x[-1]
    runs = [lt.integrate(system, x0, (0.0, 2.0), h, method) for h in (0.1, 0.05)]
    errors = [np.abs(run.x[-1] - exact).max() for run in runs]
    assert abs(np.log2(errors[0] / errors[1]) - 2.0) < 0.1, errors
    for C in system.casimirs().values():
        values = np.asarray(C(runs[0].x))
        assert np.ptp(values) < 1e-13 * max(1.0, np.abs(values).max())
    g = method.attitudes(system, runs[0].x, 0.1)
    assert np.abs(g[-1] @ g[-1].conj().T - np.eye(3)).max() < 1e-13


@pytest.mark.slow
@pytest.mark.parametrize(
    "R", [0.2, [0.2, 0.1, 0.3], [[0.2, 0.1, 0.0], [-0.1, 0.3, 0.0], [0.0, 0.0, 0.1]]], ids=["number", "array", "matrix"]
)
def test_a_number_for_the_friction_is_a_coefficient(R):
    """A number is a friction coefficient, as for a simple closed system; once it was read as a constant force."""
    matrix = np.diag(np.broadcast_to(R, 3)) if np.ndim(R) < 2 else np.array(R)
    system = lt.EulerPoincareClosedSystem(mf.so(3), coupled_lagrangian, friction=R)
    matrix_system = lt.EulerPoincareClosedSystem(mf.so(3), coupled_lagrangian, lambda xi, S: -matrix @ xi)
    x = np.array([0.5, -0.3, 0.4, 0.1])
    np.testing.assert_allclose(system.vector_field(x), matrix_system.vector_field(x), rtol=0, atol=1e-15)
    driven = lt.EulerPoincareClosedSystem(mf.so(3), coupled_lagrangian, friction=R, heat_power=lambda xi, S, t: 0.1 * t)
    np.testing.assert_allclose(driven.friction_force(x[:3], x[3], 2.0), -matrix @ x[:3], atol=1e-15)
    run = lt.integrate(system, x, (0.0, 2.0), 0.05, METHOD)
    matrix_run = lt.integrate(matrix_system, x, (0.0, 2.0), 0.05, METHOD)
    np.testing.assert_allclose(run.x, matrix_run.x, atol=1e-13)
    with pytest.raises(lt.InputError, match=r"must be >= 0, got -0\.1; it would inject energy"):
        lt.EulerPoincareClosedSystem(mf.so(3), coupled_lagrangian, friction=-0.1)
    with pytest.raises(lt.InputError, match=r"must have shape \(\), \(3,\) or \(3, 3\), got \(2,\)"):
        lt.EulerPoincareClosedSystem(mf.so(3), coupled_lagrangian, friction=[0.1, 0.2])


@pytest.mark.slow
def test_an_ordinary_solver_does_not_conserve_spatial_momentum():
    """Control: the |mu| of an ordinary solver, which knows no group, drifts."""
    solution = lt.integrate(body(), X0, (0.0, 20.0), 0.1, lt.Reference(rtol=1e-5))
    norms = np.linalg.norm(np.asarray(body().momenta(solution.x))[:, :3], axis=1)
    assert np.abs(norms - norms[0]).max() > 1e-8


test_bad_input = pytest.mark.sampled(1)(
    refusal_test(
        (lambda: lt.EulerPoincareClosedSystem(mf.so(3), lambda xi, S: xi[0] ** 2 - S), "singular"),
        (
            lambda: lt.EulerPoincareClosedSystem(mf.so(3), coupled_lagrangian, lambda xi, S: 0.1 * xi),
            r"entropy law|f \. xi",
            lt.AxiomError,
        ),
        (
            lambda: lt.EulerPoincareClosedSystem(mf.so(3), coupled_lagrangian, lambda xi, S: xi[:2]),
            "friction",
            lt.FunctionError,
        ),
        (lambda: lt.models.body_with_wheels(wheels=(0.1, 0.0, 0.1)), "wheels"),
        (
            lambda: METHOD.check(lt.EulerPoincareClosedSystem(mf.sl(3), lambda xi, S: 0.5 * xi @ xi - jnp.exp(S))),
            "Cayley map does not take",
        ),
        (lambda: METHOD.check(lt.models.rigid_body()), "got a LiePoissonSystem"),
    )
)
