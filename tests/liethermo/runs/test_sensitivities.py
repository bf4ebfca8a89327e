"""Derivatives of paths whose steps are known, beside those that JAX takes of the implicit function that a step is."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import liethermo as lt
import manifolds as mf
from liethermo.runs.flow_derivatives import _inverse_or_nan
from tests.liethermo.runs.test_flow_derivatives import METHODS

IMPLICIT = [method for method in METHODS if not method.explicit]
P = jnp.array([0.7, 0.4])


def body(p):
    energy = lambda m: 0.5 * m[0] ** 2 / 3.0 + 0.25 * m[1] ** 2 + 0.5 * m[2] ** 2 + p[0] * m[0] ** 4  # noqa: E731
    return lt.LiePoissonSystem(mf.so(3), energy, lambda m: jnp.log(1.0 + p[1] * m @ m), lt.KillingDissipation(0.5))


def sphere_system(p):
    return lt.MetriplecticSystem(
        None,
        lambda x: p[0] * x[2] ** 3 + 0.5 * x[0] * x[1],
        lambda x: jnp.cos(p[1] * x[0]),
        lt.ProjectedMetric(rate=0.5),
        space=mf.Sphere(2),
    )


STARTS = {body: jnp.array([0.3, 1.0, 0.2]), sphere_system: jnp.array([0.6, 0.0, 0.8])}


def both_ways(function, order, y):
    """The derivative of a function outside of ``jax.jit``, and inside, where steps are not known when it is traced."""
    for _ in range(order):
        function = jax.jacfwd(function)
    return np.asarray(function(y)), np.asarray(jax.jit(function)(y))


@pytest.mark.slow
@pytest.mark.parametrize("build", STARTS, ids=lambda build: build.__name__)
@pytest.mark.parametrize("order", [1, 2])
def test_all_states_of_a_path(build, order):
    """By the first state and by parameters; the last step is shorter."""

    def path(y):
        return lt.flow(build(y[3:]), y[:3], (0.0, 0.55), 0.1, save_every=2)

    derivatives, expected = both_ways(path, order, jnp.concatenate([STARTS[build], P]))
    assert derivatives.shape == (5, 3) + order * (5,)  # at 0, 0.2, 0.4, 0.5 and 0.55
    assert np.abs(derivatives - expected).max() < 1e-12 * np.abs(expected).max()
    assert np.abs(expected[-1]).max(axis=0).min() > 1e-3 if order == 1 else np.abs(expected[-1]).max() > 0.1


@pytest.mark.sampled(1)
@pytest.mark.parametrize("method", IMPLICIT, ids=str)
def test_every_method(method):
    """Alone by the parameters, then by the state: what does not move is no direction."""
    x = STARTS[body]
    for function, y in (
        (lambda p: lt.flow(body(p), x, (0.0, 0.2), 0.1, method), P),
        (lambda x: lt.flow(body(P), x, (0.0, 0.2), 0.1, method), x),
    ):
        derivatives, expected = both_ways(function, 1, y)
        assert np.abs(derivatives - expected).max() < 1e-12 * np.abs(expected).max()
        assert np.abs(expected).max() > 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("build", STARTS, ids=lambda build: build.__name__)
def test_the_third_derivative_is_the_difference_of_second_ones(build):
    """A test that knows no other way to take derivatives."""
    second, size = jax.jit(jax.hessian(lambda x: lt.flow(build(P), x, (0.0, 0.3), 0.1))), 1e-4
    third = jax.jacfwd(jax.jacfwd(jax.jacfwd(lambda x: lt.flow(build(P), x, (0.0, 0.3), 0.1))))(STARTS[build])
    x = STARTS[build]
    differences = np.stack([(second(x + size * e) - second(x - size * e)) / (2 * size) for e in np.eye(3)], axis=-1)
    assert np.abs(third - differences).max() < 1e-6 * np.abs(third).max()
    for axes in ((0, 1, 3, 2), (0, 3, 2, 1)):
        assert np.array_equal(third, np.transpose(third, axes))


@pytest.mark.slow
def test_a_step_that_fails_has_no_derivative():
    """NaN, as the state is, from there on."""
    long_step_path = lambda x: lt.flow(body(P), x, (0.0, 300.0), 100.0, save_every=1)  # noqa: E731
    x = 10.0 * STARTS[body]
    state, derivative = np.asarray(long_step_path(x)), np.asarray(jax.jacfwd(long_step_path)(x))
    assert np.isnan(state[1:]).all()
    assert np.isnan(derivative[1:]).all()
    assert np.array_equal(derivative[0], np.eye(3))


def test_equations_without_an_inverse():
    matrices = np.stack([np.eye(2), np.ones((2, 2)), np.diag([2.0, 4.0])])
    inverse = _inverse_or_nan(matrices)
    assert np.isnan(inverse[1]).all()
    assert np.array_equal(inverse[[0, 2]], [np.eye(2), np.diag([0.5, 0.25])])
