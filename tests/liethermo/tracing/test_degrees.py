"""Degrees of polynomials computed on whole arrays, compared with those of the unrolled program."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import liethermo as lt
import manifolds as mf
from liethermo.tracing.interpret import jaxpr_degree_bound
from liethermo.tracing.scalarize import scalarize

A = np.random.default_rng(0).standard_normal((4, 3, 3))

POLYNOMIALS = {
    "exchange on a ring": (lambda s: -jnp.sum(s * jnp.roll(s, 1, axis=0)) - 0.3 * jnp.sum(s[:, 2] ** 2), 2),
    "neighbours by index": (lambda s: jnp.sum(s[jnp.array([0, 1, 2])] * s[jnp.array([1, 2, 3])]) / 2.0, 2),
    "products of vectors": (lambda s: jnp.sum(jnp.cross(s[0], s[1]) * s[2]), 3),
    "matrices": (lambda s: jnp.einsum("ni,nij,nj->", s, A, s) + jnp.trace(s.T @ s), 2),
    "padded and cut": (
        lambda s: jnp.sum(jnp.pad(s, ((0, 1), (0, 0)))[1:] * s) + jnp.sum(jnp.concatenate([s, s]) ** 4),
        4,
    ),
    "a gradient": (lambda s: jnp.sum(jax.grad(lambda v: jnp.sum(v**3))(s)), 2),
    "where": (lambda s: jnp.sum(jnp.where(np.eye(4, 3) > 0, s**2, s)), 2),
    "a constant": (lambda s: jnp.zeros(()), 0),
}
OTHER_FUNCTIONS = {
    "a sine": lambda s: jnp.sum(jnp.sin(s)),
    "a quotient": lambda s: jnp.sum(s[0] / s[1]),
    "a modulus": lambda s: jnp.sum(jnp.abs(s)),
    "a choice": lambda s: jnp.sum(jnp.where(s > 0.0, s**2, s)),
    "a place": lambda s: s[s[0, 0].astype(int), 0],
    "an inverse": lambda s: jnp.sum(s**-2),
}


def trace(function):
    return jax.make_jaxpr(function)(jax.ShapeDtypeStruct((4, 3), np.float64))


@pytest.mark.sampled(4)
@pytest.mark.parametrize("name", POLYNOMIALS)
def test_array_degrees_equal_those_of_the_unrolled_program(name):
    function, expected = POLYNOMIALS[name]
    closed_jaxpr = trace(function)
    assert jaxpr_degree_bound(closed_jaxpr, 0) == expected
    assert scalarize(closed_jaxpr).degree_bound(0) == expected


@pytest.mark.parametrize("name", OTHER_FUNCTIONS)
def test_other_functions_have_infinite_degree(name):
    assert jaxpr_degree_bound(trace(OTHER_FUNCTIONS[name]), 0) == math.inf


def test_a_plain_function_on_many_sites_is_known_as_quadratic():
    """The function is too large to be unrolled, but its degree is found by whole arrays."""
    g = mf.so(3) ** 5_000
    quadratic, quartic = (
        lt.LiePoissonSystem(
            g, lambda s, n=n: -jnp.sum(s * jnp.roll(s, 1, axis=0)) + 0.1 * jnp.sum(s[:, 0] ** n), validate=False
        )
        for n in (2, 4)
    )
    assert quadratic.energy.is_quadratic
    assert not quartic.energy.is_quadratic
