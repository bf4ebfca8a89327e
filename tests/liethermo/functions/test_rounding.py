"""Rounding scale of a function to first order: terms and the state are rounded, jumps are not."""

import jax.numpy as jnp
import numpy as np
import pytest

import manifolds as mf
from liethermo.functions.rounding import propagated_rounding_scale, value_and_rounding_scale

X = np.array([0.5, 2.0])
CASES = {
    "a difference": (lambda x: x[0] - 0.5, 0.5),
    "a sum of large terms": (lambda x: (x[0] + 1e6) - 1e6, 1e6),
    "another unit": (lambda x: 1e-20 * (x[0] - 0.5), 0.5e-20),
    "a steep function": (lambda x: jnp.sqrt(jnp.abs(x[0] - 0.5 + 1e-12)), 0.25e6),
    "a jump": (lambda x: jnp.where(2.0 * x[0] > 1.0, 1.0, -1.0), 0.0),
    "beside a hole": (lambda x: jnp.where(x[0] > 0.5, jnp.nan, x[0] - 0.5), 0.5),
}


@pytest.mark.parametrize("name", CASES)
def test_rounding_scale_of_a_function(name):
    """The scale is right up to a factor, as random errors are between 0.5 and 1."""
    function, scale = CASES[name]
    assert 0.3 * scale <= float(propagated_rounding_scale(function, X, np.abs(X))) <= 3.0 * scale


def test_rounding_scale_of_functions_of_matrices():
    """Eigenvalues are iterated to rounding: what is perturbed is their matrix, and their result."""
    space = mf.SPD(2)
    p = np.asarray(space.random(1))

    def half_squared_distance(x):
        v = space.log(p, x.reshape(2, 2))
        return 0.5 * space.inner(p, v, v)

    for seed in range(2, 6):
        x = np.asarray(space.random(seed)).ravel()
        value, scale = value_and_rounding_scale(half_squared_distance, x)
        assert 0.3 * float(value) <= float(scale) <= 100.0 * float(value)
