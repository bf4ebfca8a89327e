"""Discrete gradients of terms with coordinates: pulled-back, kinetic and potential energies."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import liethermo as lt
from liethermo.functions.gradients import DISCRETE_GRADIENTS
from liethermo.functions.mechanics import is_mechanical_energy
from tests.cases import EPS

seeds = st.integers(0, 10**6)
for_each_gradient = pytest.mark.parametrize("gradient", DISCRETE_GRADIENTS.values(), ids=list(DISCRETE_GRADIENTS))
DIM = 5
N = 2


def distances(x):
    """Return the squared distance of two points on a line, and their mean: quadratic and linear in the state."""
    return jnp.array([(x[1] - x[0]) ** 2, 0.5 * (x[0] + x[1])])


def metric(q):
    return jnp.array([[2.0 + jnp.sin(q[0]), 0.3 * q[1]], [0.3 * q[1], 1.5 + 0.1 * q[1] ** 2]])


def bumpy(y):
    return jnp.cos(jnp.sum(y)) + 0.1 * y[0] ** 4


TERMS = {
    "indices": lt.Function(bumpy).on([0, -1]),
    "quadratic map": lt.Function(bumpy).on(distances),
    "nested": lt.Quadratic([[2.0, 0.5], [0.5, 1.0]], [1.0, -1.0], 0.3).on([1, 0]).on(distances),
    "kinetic": lt.Kinetic([[2.0, 0.5], [0.5, 1.0]]),
    "kinetic of q": lt.Kinetic(metric),
    "potential": lt.Potential(lambda q, S: jnp.exp(S / 2) * jnp.cos(q[0]) + q[1] ** 4),
    "sum": lt.Kinetic(metric) - lt.Potential(lambda q, S: S * q[0] ** 2) + lt.Quadratic(np.ones(DIM)) - bumpy,
}


@eqx.filter_jit
def discrete_and_exact(gradient, term, x, d, compensation=0.0):
    return gradient(term, x, d, compensation), term.value(x + (compensation + d)) - term.value(x), term.gradient(x)


@pytest.mark.sampled(1)
@pytest.mark.parametrize(
    ("name", "gradient"),
    [
        *((name, "gonzalez") for name in TERMS),
        *(("sum", gradient) for gradient in DISCRETE_GRADIENTS if gradient != "gonzalez"),
    ],
)
@given(seed=seeds)
def test_discrete_gradients(name, gradient, seed):
    """Both defining properties (34) hold for steps of every size, from a state with a compensation."""
    term, (x, d) = TERMS[name], np.random.default_rng(seed).standard_normal((2, DIM))
    for scale in (1.0, 1e-3, 1e-7):
        step, compensation = scale * d, 0.4 * EPS * x
        discrete_gradient, difference, slope = (
            np.asarray(a) for a in discrete_and_exact(DISCRETE_GRADIENTS[gradient], term, x, step, compensation)
        )
        values = sum(abs(float(t(x))) + abs(float(t(x + step))) for t in term.terms)
        tolerance = 40 * EPS * (values + np.linalg.norm(slope) * np.linalg.norm(x))
        assert abs(discrete_gradient @ step - difference) <= tolerance
        if scale < 1.0:  # functions of degree eight are not near their linearisation at distance one
            steepness = 1.0 + np.abs(slope).max()
            assert np.abs(discrete_gradient - slope).max() <= 50 * scale * np.linalg.norm(d) * steepness


@pytest.mark.sampled(3)
@for_each_gradient
def test_a_term_is_corrected_along_its_own_coordinates_alone(gradient):
    x, d = np.random.default_rng(0).standard_normal((2, DIM))
    discrete_gradient, _, _ = discrete_and_exact(gradient, TERMS["potential"], x, d)
    assert np.array_equal(discrete_gradient[2:4], [0.0, 0.0])
    if isinstance(gradient, lt.Gonzalez):  # control: an equal function without coordinates
        control_gradient, _, _ = discrete_and_exact(gradient, lt.Function(TERMS["potential"].value), x, d)
        assert np.abs(np.asarray(control_gradient[2:4])).min() > 1e-3


def test_invariances_of_coordinates_are_conserved():
    """Discrete forces of a pair that depend on distances have no sum and no torque, even in a step of size one."""

    def squared_distance(x):  # distance of two points in the plane
        return jnp.sum((x[2:4] - x[:2]) ** 2)[None]

    def sum_and_torque(energy):
        force = np.asarray(discrete_and_exact(lt.Gonzalez(), energy, x, d)[0]).reshape(2, 2)
        torques = [np.linalg.det(pair) for pair in zip((x + d / 2).reshape(2, 2), force, strict=True)]
        return np.abs(force.sum(axis=0)).max(), abs(sum(torques))

    root, (x, d) = lt.Function(lambda y: jnp.sqrt(y[0])), np.random.default_rng(1).standard_normal((2, 4))
    assert max(sum_and_torque(root.on(squared_distance))) < 1e-14
    assert (
        min(sum_and_torque(lt.Function(root.on(squared_distance).value))) > 1e-3
    )  # control: an equal function without coordinates


@pytest.mark.sampled(2)
@for_each_gradient
def test_a_kinetic_energy_by_momenta_is_a_metric_times_their_mean(gradient):
    x, d = np.random.default_rng(2).standard_normal((2, DIM))
    q, p, end = x[:N], x[N : 2 * N] + d[N : 2 * N] / 2, x[:N] + d[:N]
    discrete_gradient = np.asarray(discrete_and_exact(gradient, lt.Kinetic(metric), x, d)[0])
    assert np.allclose(discrete_gradient[N : 2 * N], 0.5 * (metric(q) + metric(end)) @ p, rtol=0, atol=1e-14)
    assert discrete_gradient[-1] == 0.0


def test_arithmetic():
    x = np.random.default_rng(3).standard_normal(DIM)
    for term in TERMS.values():
        assert float((-term)(x)) == -float(term(x))
        assert np.array_equal((-term).gradient(x), -term.gradient(x))
        opposite = -term
        assert float((-opposite)(x)) == float(term(x))
        assert float((bumpy - term)(x)) == pytest.approx(float(bumpy(x) - term(x)), rel=1e-14)
    assert isinstance(-lt.Quadratic(np.ones(3)), lt.Quadratic)


V = lt.Potential(lambda q, S: S * q[0])


@pytest.mark.parametrize(
    ("energy", "expected"),
    [
        (lt.Kinetic([1.0, 2.0]) + V, True),
        (lt.Kinetic(metric) + V, True),
        (lt.Quadratic(np.ones(DIM), [1.0, 0, 0, 0, 1.0]), True),
        (lt.Quadratic(np.diag([-1.0, 1.0, 2.0, 0.0, 1.0])) - V + lt.Function(bumpy).on([4]), True),
        (lt.Kinetic([1.0, -1.0]) + V, False),  # Lorentzian
        (lt.Kinetic(lambda q: jnp.array([1.0, -1.0])), False),
        (lt.Quadratic(np.ones(DIM), [0, 0, 1.0, 0, 0]), False),  # p . H_p may be negative
        (lt.Quadratic(np.ones((DIM, DIM))), False),
        (lt.Kinetic([1.0, 2.0]) + lt.Function(bumpy).on([0, 2]), False),
        (lt.Kinetic([1.0, 2.0]) + lt.Function(lambda x: x[0] * x[4]), False),  # not known to be free of p
        (-lt.Kinetic([1.0, 2.0]), False),
    ],
)
def test_which_energies_are_known_to_produce_entropy(energy, expected):
    assert is_mechanical_energy(energy, DIM) is expected
    assert (
        jax.eval_shape(lambda x: jnp.asarray(is_mechanical_energy(lt.Quadratic(x), DIM)), jnp.ones(DIM)).dtype == bool
    )


@pytest.mark.parametrize(
    ("energy", "error", "words"),
    [
        (lt.Function(bumpy).on([0, 3]), lt.InputError, "component 3, but the state has 3"),
        (lt.Function(bumpy).on([-4]), lt.InputError, "component -4"),
        (lt.Function(bumpy).on(jnp.sin), lt.InputError, r"must be a quadratic function.*miss.*tolerance.*square"),
        (lt.Function(bumpy).on(lambda x: jnp.linalg.norm(x)[None]), lt.InputError, "must be a quadratic function"),
        (lt.Function(bumpy).on(lambda x: x @ jnp.ones(4)), lt.FunctionError, "coordinates of a term"),
    ],
)
def test_invalid_coordinates_are_refused(energy, error, words):
    with pytest.raises(error, match=words):
        lt.EvolutionSystem(energy, 3)
    with pytest.raises(lt.InputError, match="must be symmetric"):
        lt.Kinetic([[1.0, 1.0], [0.0, 1.0]])
