"""Factors of friction matrices: their square, their kernel, and the divergence of their columns."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import liethermo as lt
import manifolds as mf
from liethermo.dissipation.noise import factor_divergences, terms_with_factors
from liethermo.models.gases import gas_piston_state
from manifolds.matrices.symmetric import semidefinite_factor, semidefinite_root
from tests.cases import DISSIPATIONS, build, state_of

NAMES_WITHOUT_FACTOR = {"force", "potential_coulomb", "potential_power_law", "potential_activated"}
"""Names of dissipations that have no factor."""
CASES_WITH_FACTOR = [
    pytest.param(g, case, id=f"{g.name}-{case.name}")
    for g in (mf.so(3), mf.se(3))
    for case in DISSIPATIONS
    if case.name not in NAMES_WITHOUT_FACTOR and case.exempt(g) is None
]


@jax.jit
def measure_factors(system, x, dH, dS, dL):
    """Return the relative residual of ``B B^T = K``, ``B^T dH``, and the divergences less those by differentiation."""
    terms, conserves_energy = (
        terms_with_factors(system.dissipation, system, x, dH, dL),
        system.dissipation.energy_law == "conserved",
    )
    covector = dS if conserves_energy else -dH
    product = sum(B.times(B.transpose_times(covector)) for _, B in terms)
    force = system.dissipation.force(system, x, dH, dS, dL)
    kernel = jnp.concatenate(
        [B.transpose_times(v) for _, B in terms for v in ((dH, *dL) if conserves_energy else dL)] or [jnp.zeros(1)]
    )

    def matrix(y):
        terms_at_y = terms_with_factors(
            system.dissipation, system, y, system.energy.gradient(y), [L.gradient(y) for L in system.preserved]
        )
        return jnp.concatenate([jax.vmap(B.times)(jnp.eye(B.size)) for _, B in terms_at_y])

    traces = jnp.einsum("aii->a", jax.jacfwd(matrix)(x))
    scale = jnp.linalg.norm(force)
    return (
        jnp.linalg.norm(product - force) / scale,
        jnp.max(jnp.abs(kernel)),
        factor_divergences(system.dissipation, system, x) - traces,
    )


@pytest.mark.sampled(1)
@pytest.mark.parametrize(("g", "case"), CASES_WITH_FACTOR)
def test_factors(g, case):
    """The factors are right for gradients of functions and for any other vectors, as discrete gradients are."""
    system, rng = build(g, case), np.random.default_rng(1)
    for seed in range(3):
        x = jnp.asarray(state_of(g, seed))
        dH = system.energy.gradient(x) + 0.1 * rng.standard_normal(g.dim)
        dL = tuple(L.gradient(x) + 0.1 * rng.standard_normal(g.dim) for L in system.preserved)
        product, kernel, defect = measure_factors(system, x, dH, rng.standard_normal(g.dim), dL)
        assert product < 1e-13
        assert kernel < 1e-13 * float(jnp.linalg.norm(dH))
        assert np.abs(defect).max() < 1e-12


@pytest.mark.slow
def test_factors_between_bodies():
    """Each flow of heat and each friction has its own column, for any gradient with positive temperatures."""
    system = lt.models.gas_piston()
    x = jnp.asarray(gas_piston_state(0.4, (310.0, 290.0, 300.0), p=0.3))
    rng = np.random.default_rng(0)
    dH = system.energy.gradient(x) * (1.0 + 0.01 * rng.standard_normal(5))
    terms = terms_with_factors(system.dissipation, system, x, dH, ())
    assert sum(B.size for _, B in terms) == 3
    dS = rng.standard_normal(5)
    product = sum(B.times(B.transpose_times(dS)) for _, B in terms)
    assert np.allclose(product, system.dissipation.force(system, x, dH, dS, ()), rtol=1e-13)
    assert max(float(jnp.abs(B.transpose_times(dH)).max()) for _, B in terms) < 1e-12 * float(jnp.abs(dH).max())


def test_a_dissipation_without_a_factor():
    system = build(mf.so(3), next(case for case in DISSIPATIONS if case.name == "force"))
    x = jnp.ones(3)
    with pytest.raises(lt.InputError, match=r"EulerPoincareForce gives no factor"):
        terms_with_factors(system.dissipation, system, x, x, ())
    pairs = np.zeros((3, 3, 3, 3))
    for i, j, sign in ((0, 1, 1.0), (0, 2, -0.5)):
        for a, b in ((i, j), (j, i)):
            for c, d in ((i, j), (j, i)):
                pairs[a, b, c, d] = sign * (1 if (a, b) == (c, d) else -1)
    bracket = lt.FourBracket(pairs)
    with pytest.raises(lt.IndefiniteError, match="pairs of covectors"):
        bracket.factor(system, x, x, ())


@pytest.mark.slow
def test_roots_of_singular_matrices():
    """Roots of rank two of four, and their derivative against differences; eigenvalues that meet do no harm."""
    rng = np.random.default_rng(2)
    A, direction = rng.standard_normal((4, 2)), rng.standard_normal((4, 2))

    @jax.jit
    def K(t):
        return (A + t * direction) @ (A + t * direction).T

    root, h = jax.jit(lambda t: semidefinite_root(K(t))), 1e-5
    for factor in (semidefinite_factor(K(0.0)), root(0.0)):
        assert np.allclose(factor @ factor.T, K(0.0), atol=1e-14)
    assert np.abs(jax.jit(jax.jacfwd(root))(0.0) - (root(h) - root(-h)) / (2 * h)).max() < 1e-8
    derivative = jax.jacfwd(lambda t: semidefinite_root(jnp.eye(3) + t * jnp.diag(jnp.array([1.0, 2.0, 3.0]))))(0.0)
    assert np.allclose(derivative, np.diag([0.5, 1.0, 1.5]), atol=1e-14)
    assert np.isfinite(semidefinite_root(jnp.zeros((2, 2)))).all()
    assert np.isfinite(semidefinite_factor(jnp.zeros((2, 2)))).all()


def body_with_baths(dissipation, baths):
    moments = np.array([1.0, 2.0, 5.0])
    return lt.LiePoissonSystem(
        mf.so(3), lambda m: 0.5 * jnp.sum(m**2 / moments) + 0.1 * m[0] ** 4, dissipation=dissipation, baths=baths
    )


HEATING_SYSTEMS = {
    "one bath": lambda: body_with_baths(lt.DoubleBracket(0.3), lt.HeatBaths(capacity=2.0, temperature=1.3)),
    "friction that varies": lambda: body_with_baths(
        lt.Friction(lambda m: (1.0 + m[1] ** 2) * jnp.diag(jnp.array([1.0, 2.0, 0.5]))), lt.HeatBaths(capacity=2.0)
    ),
    "below zero": lambda: body_with_baths(
        lt.DoubleBracket(0.3), lt.HeatBaths(energy=lambda y: 0.5 * y**2 + 0.1 * y**4)
    ),
    "a bath for each spin": lambda: lt.models.spin_lattice(
        (2, 2), baths=lt.HeatBaths(capacity=[1.0, 2.0], number=2), bath=[[0, 1], [1, 0]]
    ),
    "spins": lambda: lt.models.spin_lattice((2, 2), baths=False),
}
"""Systems with friction that heats baths, by name."""


@pytest.mark.sampled(2)
@pytest.mark.parametrize("make", HEATING_SYSTEMS.values(), ids=HEATING_SYSTEMS)
def test_divergences_of_heating_systems(make):
    """The closed form of the divergence agrees with differentiation of every column by every component."""
    system, rng = make(), np.random.default_rng(2)
    x = jnp.asarray(rng.standard_normal(system.dim))
    if system.baths is not None:
        x = x.at[system.body_dim :].set(-0.4)  # where the energy of a bath may fall
    product, _, defect = measure_factors(system, x, system.energy.gradient(x), rng.standard_normal(system.dim), ())
    if system.baths is not None:
        assert product < 1e-13
    assert np.abs(defect).max() < 1e-12
    if system.baths is not None:
        assert np.abs(factor_divergences(system.dissipation, system, x)).max() > 1e-3
