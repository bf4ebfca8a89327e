"""Discrete gradients: the two defining properties (BFM 4.1), stability as d -> 0, and symmetry."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import liethermo as lt
from liethermo.functions.checks import with_polynomial_degrees
from liethermo.functions.energy import make_energy
from liethermo.functions.gradients import (
    DISCRETE_GRADIENTS,
    CorrectionDirection,
    FunctionChange,
    correct_gradients,
    discrete_gradients_at_stages,
)
from liethermo.integrators.tableaus import gauss_tableau, kronrod_rule
from tests.cases import EPS, energy_of

NAMES = list(DISCRETE_GRADIENTS)
seeds = st.integers(0, 10**6)


for_each_gradient = pytest.mark.parametrize("gradient", DISCRETE_GRADIENTS.values(), ids=NAMES)


@pytest.mark.sampled(1)
@for_each_gradient
@pytest.mark.parametrize("distance", [3.0, 0.3, 1e-3, 1e-6, 1e-9, 1e-13])
@given(seed=seeds)
def test_identity_at_every_distance(gradient, distance, seed):
    """The identity dgrad . d = H(x + d) - H(x) holds to the rounding error of its right-hand side."""
    rng = np.random.default_rng(seed)
    energy, x = energy_of(4, seed), rng.standard_normal(4)
    d = distance * rng.standard_normal(4) / 2
    start_value, end_value = float(energy.value(x)), float(energy.value(x + d))
    product = float(jnp.dot(gradient(energy, x, d), d))
    # the rounding of x + d changes H by |grad H| eps |x|
    tolerance = 40 * EPS * (abs(start_value) + abs(end_value) + float(jnp.linalg.norm(energy.gradient(x + d))))
    assert abs(product - (end_value - start_value)) <= tolerance


@pytest.mark.sampled("gonzalez")
@for_each_gradient
@given(seed=seeds)
def test_discrete_gradient_tends_to_the_gradient(gradient, seed):
    """For tiny d, dgrad equals grad H to rounding, without noise of size eps / |d|."""
    rng = np.random.default_rng(seed)
    energy, x = energy_of(4, seed), rng.standard_normal(4)
    direction = rng.standard_normal(4)
    exact = np.asarray(energy.gradient(x))
    curvature = float(np.abs(jax.hessian(energy.value)(x)).sum(axis=1).max())
    for distance in (1e-9, 1e-12, 1e-15, 1e-18, 1e-100, 1e-160, 0.0):
        discrete = np.asarray(gradient(energy, x, distance * direction))
        variation = 1.01 * curvature * distance * np.abs(direction).max()
        assert np.abs(discrete - exact).max() <= variation + 40 * EPS * np.abs(exact).max()


def test_the_printed_quotient_is_noise_near_zero():
    """Control: the formula BFM (4.3) as printed loses the gradient, but the library's version does not."""
    energy, rng = energy_of(4, 0), np.random.default_rng(0)
    x, direction = rng.standard_normal(4), rng.standard_normal(4)
    errors = {"printed": 0.0, "ours": 0.0}
    for distance in np.geomspace(1e-14, 1e-9, 30):
        d = distance * direction
        middle = energy.gradient(x + d / 2)
        quotient = (energy.value(x + d) - energy.value(x) - middle @ d) / (d @ d)
        exact = np.asarray(energy.gradient(x + d / 2))
        errors["printed"] = max(errors["printed"], np.abs(np.asarray(middle + quotient * d) - exact).max())
        errors["ours"] = max(errors["ours"], np.abs(np.asarray(lt.Gonzalez()(energy, x, d)) - exact).max())
    assert errors["printed"] > 1e-4
    assert errors["ours"] < 1e-14


@pytest.mark.sampled(1)
@pytest.mark.parametrize("name", NAMES)
def test_continuous_across_the_gate(name):
    """Along a ray in d the gradient changes continuously, also where the gate opens for the defect."""
    energy, rng = energy_of(4, 3), np.random.default_rng(3)
    x, direction = rng.standard_normal(4), rng.standard_normal(4)
    distances = np.geomspace(1e-8, 1.0, 4001)
    gradients = np.asarray(jax.vmap(lambda r: DISCRETE_GRADIENTS[name](energy, x, r * direction))(distances))
    jumps = np.abs(np.diff(gradients, axis=0)).max(axis=1)
    assert (jumps <= 20 * np.diff(distances) + 1e-12).all()


@pytest.mark.sampled("symmetric_coordinate_increment")
@pytest.mark.parametrize("name", ["gonzalez", "mean_value", "symmetric_coordinate_increment"])
@given(seed=seeds)
def test_symmetric_in_its_end_points(name, seed):
    rng = np.random.default_rng(seed)
    energy, x, d = energy_of(3, seed), rng.standard_normal(3), 0.5 * rng.standard_normal(3)
    forward = np.asarray(DISCRETE_GRADIENTS[name](energy, x, d))
    backward = np.asarray(DISCRETE_GRADIENTS[name](energy, x + d, -d))
    assert np.abs(forward - backward).max() <= 1e-12 * np.abs(forward).max()


def test_the_printed_coordinate_increment_is_not_symmetric():
    """Control for the test above; the asymmetry is why the scheme has order 1."""
    energy, x, d = energy_of(3, 1), np.ones(3), np.array([0.3, -0.2, 0.5])
    gradient = DISCRETE_GRADIENTS["coordinate_increment"]
    assert np.abs(np.asarray(gradient(energy, x, d) - gradient(energy, x + d, -d))).max() > 1e-3


def _mean_over_step(slope):
    points, weights = np.polynomial.legendre.leggauss(20)
    return 0.5 * sum(w * slope(0.5 * (1.0 + c)) for c, w in zip(points, weights, strict=True))


RESTING_COMPONENTS = {
    "gonzalez": lambda slope: slope(0.5),
    "mean_value": _mean_over_step,
    "coordinate_increment": lambda slope: slope(1.0),
    "symmetric_coordinate_increment": lambda slope: 0.5 * (slope(0.0) + slope(1.0)),
}
"""Component of a coordinate that does not move, from the slope of the energy along it at ``x + t d``."""


@pytest.mark.parametrize("name", NAMES)
def test_component_of_a_coordinate_that_does_not_move(name):
    """The difference quotient of that coordinate is 0/0, which each formula replaces by a limit of its own."""
    energy, x, d = energy_of(3, 1), np.array([0.4, -0.3, 1.0]), np.array([0.3, -0.2, 0.0])
    discrete = jax.jit(lambda x, d: DISCRETE_GRADIENTS[name](energy, x, d))(x, d)
    assert float(discrete[2]) == pytest.approx(
        RESTING_COMPONENTS[name](lambda t: float(energy.gradient(x + t * d)[2])), abs=1e-7
    )
    slopes = [float(energy.gradient(x + t * d)[2]) for t in (0.0, 0.5, 1.0)]
    assert min(np.abs(np.diff(slopes))) > 1e-4


@pytest.mark.sampled(1)
@for_each_gradient
@given(seed=seeds)
def test_quadratic_terms_agree_with_the_general_formula(gradient, seed):
    """The closed form for a Quadratic equals the general formula for an equal function."""
    rng = np.random.default_rng(seed)
    A = rng.standard_normal((4, 4))
    term = lt.Quadratic(A + A.T, rng.standard_normal(4), 0.7)
    general = lt.Function(term.value)
    x, d = rng.standard_normal(4), rng.standard_normal(4)
    assert np.allclose(gradient(term, x, d), gradient(general, x, d), rtol=0, atol=1e-12)


@pytest.mark.sampled(1)
@for_each_gradient
@pytest.mark.parametrize(
    "function", [lambda x: jnp.cos(1000.0 * x[0]) + x[1] ** 2, lambda x: jnp.exp(3.0 * x[0] * x[1])]
)
def test_short_length_scales(gradient, function):
    """The gate is scale free: a function that varies on lengths of 1e-3 satisfies the identity at every distance."""
    energy, x, direction = lt.Function(function), np.array([0.7, 0.4]), np.array([1.0, 0.5])
    for distance in np.geomspace(1e-9, 1.0, 19):
        d = distance * direction
        difference = float(energy.value(x + d) - energy.value(x))
        noise = 40 * EPS * (1.0 + 1000.0 + abs(difference))
        assert abs(float(gradient(energy, x, d) @ d) - difference) <= noise


def test_mean_value_is_exact_on_polynomials_of_its_degree():
    """Quadrature with m nodes integrates the gradient of a polynomial of degree 2m exactly, so there is no defect."""
    for nodes in (1, 2, 3):
        energy = lt.Function(lambda x, degree=2 * nodes: x[0] ** degree + x[0] * x[1] ** (degree - 1))
        x, d = np.array([0.7, -0.4]), np.array([0.9, 1.3])
        points, weights = np.polynomial.legendre.leggauss(12)
        exact = sum(w / 2 * energy.gradient(x + (c + 1) / 2 * d) for c, w in zip(points, weights, strict=True))
        assert np.allclose(lt.MeanValue(nodes=nodes)(energy, x, d), exact, rtol=0, atol=1e-13)


@pytest.mark.parametrize("degree", [3, 6, 7])
def test_change_of_a_polynomial_is_computed_without_its_values(degree):
    """Up to degree six three nodes are exact, so a large added constant, which coarsens the values, has no effect."""
    x, d = np.array([0.7, -0.4]), np.array([0.9, 1.3])

    def change(degree_claim=None, constant=0.0):
        energy = make_energy(lambda x: x[0] ** degree + x[0] * x[1] ** (degree - 1) + constant, "H")
        energy = (
            with_polynomial_degrees(energy, 2) if degree_claim is None else lt.Function(energy.function, degree_claim)
        )
        assert energy.degree == (degree_claim or degree)
        return float(DISCRETE_GRADIENTS["gonzalez"](energy, x, d) @ d)

    exact = float(np.diff([y[0] ** degree + y[0] * y[1] ** (degree - 1) for y in (x, x + d)])[0])
    assert change() == pytest.approx(exact, rel=1e-14)
    assert (change(constant=1e9) == pytest.approx(exact, rel=1e-14)) == (degree <= 6)
    assert (change(degree_claim=6) == pytest.approx(exact, rel=1e-9)) == (degree <= 6)  # a control


@for_each_gradient
def test_nan_is_not_hidden(gradient):
    """NaN of a function outside its domain passes a closed gate."""
    energy = lt.Function(lambda x: jnp.sqrt(x[0]))
    assert not np.isfinite(np.asarray(gradient(energy, np.array([0.5]), np.array([-0.6])))).all()


def test_discrete_gradients_have_distinct_names():
    """The provenance of a run contains the name."""
    names = {str(lt.MetriplecticMidpoint(name)) for name in DISCRETE_GRADIENTS} | {
        str(lt.MetriplecticMidpoint(lt.MeanValue(3)))
    }
    assert len(names) == len(DISCRETE_GRADIENTS) + 1
    assert "MetriplecticMidpoint(gradient=CoordinateIncrement(symmetric=True))" in names


def test_unknown_names_and_bad_nodes_are_refused():
    with pytest.raises(lt.InputError, match="'gonzalez', 'mean_value'"):
        lt.MetriplecticMidpoint(gradient="gonzales")
    with pytest.raises(lt.InputError, match="positive integer"):
        lt.MeanValue(nodes=0)


@pytest.mark.sampled(3)
@pytest.mark.parametrize("length", [0.0, 1e-45, 1e-30, 1e-17])
@pytest.mark.parametrize("stages", [1, 2])
def test_derivatives_at_stages_of_a_step_that_vanishes(stages, length):
    """Compiled derivatives by k, with fused products and sums, are ``h A (x) Hess`` for vanishing k."""
    A, b, _ = gauss_tableau(stages)
    x, h, energy = jnp.array([1.0, 2.0]), 0.1, make_energy(lambda u: jnp.log(u[0]) + 2.0 * jnp.log(u[1]), "S")

    @jax.jit
    @jax.jacfwd
    def stage_jacobian(k):
        return discrete_gradients_at_stages(energy, x, jnp.zeros(2), h, k, A, b, kronrod_rule(stages))

    expected = np.einsum("ij,ab->iajb", h * A, np.diag([-1.0, -0.5]))
    np.testing.assert_allclose(stage_jacobian(jnp.full((stages, 2), length)), expected, atol=1e-15)


@pytest.mark.parametrize(("variation", "is_corrected"), [(0.1, True), (1e-5, False)])
def test_a_defect_below_its_noise_is_corrected_where_the_gradient_varies(variation, is_corrected):
    """Over many steps such defects add up; without variation the quadrature is exact and the defect is noise alone."""
    b, h, k = jnp.array([0.5, 0.5]), 0.1, jnp.array([[1.0, 0.2], [0.8, 0.1]])
    gradients = jnp.array([[1.0, 2.0], [1.0, 2.0]])
    quadrature = h * jnp.dot(b, jnp.sum(gradients * k, axis=1))
    change = FunctionChange(quadrature + 1e-15, jnp.asarray(1e-14), gradients)
    corrected = correct_gradients(
        change, gradients, k, CorrectionDirection.from_slopes(k, b), h, b, gradient_variation=variation
    )
    correction = float(h * jnp.dot(b, jnp.sum((corrected - gradients) * k, axis=1)))
    assert correction == pytest.approx(1e-15 if is_corrected else 0.0, abs=3e-16)
