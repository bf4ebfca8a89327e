"""Euler-Poincaré equations with entropy, and their variational integrator."""

from __future__ import annotations

import functools

import jax.numpy as jnp
import numpy as np
import pytest

import liethermo as lt
import manifolds as mf
from liethermo.models.body_with_wheels import body_with_wheels_rest
from liethermo.tracing.interpret import at_points

body = functools.cache(lt.models.body_with_wheels)
X0 = [0.1, 1.0, 0.2, 0.5, -0.3, 0.4, 0.0]
METHOD = lt.LieVariational()


def tangled(xi, S):
    """Neither quadratic nor a sum of kinetic and internal energy."""
    return (
        0.5 * xi @ (jnp.array([3.0, 2.0, 1.0]) * (1.0 + 0.02 * jnp.tanh(S)) * xi) + 0.05 * (xi @ xi) ** 2 - jnp.exp(S)
    )


def braking(xi, S):
    return -(0.1 + 0.05 * S**2) * (1.0 + xi @ xi) * jnp.array([1.0, 0.5, 0.2]) * xi


@functools.cache
def tangled_system():
    return lt.EulerPoincareClosedSystem(mf.so(3), tangled, braking)


def residuals(system, x):
    """Of d/dt l_xi = ad*_xi l_xi + f, T S' = -f . xi, and E' = 0."""
    xi, S, rate = x[:-1], x[-1], system.vector_field(x)
    mu, W, by_S = system.poisson.rates(x)
    force = system.friction_force(xi, S)
    return {
        "momentum": W @ rate[:-1] + by_S * rate[-1] - system.algebra.ad_star(xi, mu) - force,
        "heat": system.temperature(x) * rate[-1] + force @ xi,
        "energy": system.energy.gradient(x) @ rate,
    }, rate[-1]


@pytest.mark.sampled(1)
@pytest.mark.parametrize("make", [body, tangled_system], ids=["body with wheels", "tangled"])
def test_the_equations(make):
    system = make()
    points = np.random.default_rng(0).standard_normal((8, system.dim))
    found, production = at_points(residuals, system, points)
    for name, residual in found.items():
        assert np.abs(residual).max() < 1e-12, name
    assert production.min() > 0.0
    assert system.check(points).passed


@pytest.mark.slow
def test_a_body_that_heats_itself():
    """Both ends of the balance, the sign of the production, and the spatial momentum, which friction does not touch."""
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
    expected = body_with_wheels_rest(np.linalg.norm(mu[0]), solution.energy[0])
    assert float(body().temperature(solution.x[-1])) == pytest.approx(expected, rel=1e-3)


def _errors(system, x0, steps, t=2.0):
    exact, errors = lt.integrate(system, x0, (0.0, t), t, lt.Reference(rtol=1e-12)).x[-1], []
    for n in steps:
        solution = lt.integrate(system, x0, (0.0, t), t / n, METHOD, save_every=n, engine="array")
        assert solution.stats.least_entropy_increment > 0.0
        errors.append(np.abs(solution.x[-1] - exact).max())
    return errors


@pytest.mark.slow
@pytest.mark.parametrize(
    ("make", "x0"), [(tangled_system, [0.5, 1.0, -0.4, 0.1]), pytest.param(body, X0, marks=pytest.mark.slow)]
)
def test_observed_order(make, x0):
    """2 by hand: the discrete Lagrangian is symmetric."""
    errors = _errors(make(), x0, (20, 40, 80, 160))
    assert METHOD.order == 2
    assert (np.abs(np.log2(np.array(errors[:-1]) / errors[1:]) - 2) < 0.2).all(), errors


@pytest.mark.slow
def test_without_friction_the_casimirs_and_the_energy_stay():
    """Free rigid body: |mu|^2 to rounding, the energy within a bound that does not grow; in both engines."""
    free = lt.EulerPoincareClosedSystem(
        mf.so(3), lambda xi, S: 0.5 * xi @ (jnp.array([3.0, 2.0, 1.0]) * xi) - jnp.exp(S)
    )
    runs = [
        lt.integrate(free, [0.1, 1.0, 0.3, 0.0], (0.0, 2000.0), 0.1, METHOD, engine=engine)
        for engine in ("array", "compiled")
    ]
    size = np.linalg.norm(np.asarray(free.momenta(runs[0].x)), axis=1)
    assert np.abs(size - size[0]).max() < 1e-12
    error = np.abs(runs[0].energy - runs[0].energy[0])
    assert 1e-7 < error.max() < 1.2 * error[:400].max()
    assert np.abs(runs[0].x[:200] - runs[1].x[:200]).max() < 1e-12


@pytest.mark.slow
def test_a_control_that_does_not_keep_the_spatial_momentum():
    """The same system by a metriplectic scheme, which knows no group: its |mu| drifts."""
    solution = lt.integrate(body(), X0, (0.0, 20.0), 0.1, lt.Reference(rtol=1e-5))
    size = np.linalg.norm(np.asarray(body().momenta(solution.x))[:, :3], axis=1)
    assert np.abs(size - size[0]).max() > 1e-8


@pytest.mark.sampled(1)
@pytest.mark.parametrize(
    ("build", "error", "words"),
    [
        (lambda: lt.EulerPoincareClosedSystem(mf.so(3), lambda xi, S: xi[0] ** 2 - S), lt.InputError, "singular"),
        (
            lambda: lt.EulerPoincareClosedSystem(mf.so(3), tangled, lambda xi, S: 0.1 * xi),
            lt.AxiomError,
            r"entropy law|f \. xi",
        ),
        (lambda: lt.EulerPoincareClosedSystem(mf.so(3), tangled, lambda xi, S: xi[:2]), lt.FunctionError, "friction"),
        (lambda: lt.models.body_with_wheels(wheels=(0.1, 0.0, 0.1)), lt.InputError, "wheels"),
        (
            lambda: METHOD.check(lt.EulerPoincareClosedSystem(mf.sl(3), lambda xi, S: 0.5 * xi @ xi - jnp.exp(S))),
            lt.InputError,
            "Cayley map does not take",
        ),
        (lambda: METHOD.check(lt.models.rigid_body()), lt.InputError, "not a LiePoissonSystem"),
    ],
)
def test_bad_input(build, error, words):
    with pytest.raises(error, match=words):
        build()
