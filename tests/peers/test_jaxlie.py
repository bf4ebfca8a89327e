"""The properties that the tests of jaxlie check, on its groups: SO(2), SE(2), SO(3), SE(3).

jaxlie tests random elements against properties and formulas, and has no tables of values. Its tangent vectors of SE(n)
list translations first, ours rotations first. Its tolerance is 1e-8 throughout.
"""

from __future__ import annotations

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import manifolds as mf
from tests.cases import max_abs

EXACT = 2e-14
"""Results of order one; at most 3e-15 seen."""

GROUPS = {"SO(2)": (mf.SO, 2), "SE(2)": (mf.SE, 2), "SO(3)": (mf.SO, 3), "SE(3)": (mf.SE, 3)}


@pytest.fixture(scope="module", params=GROUPS)
def group(request):
    build, n = GROUPS[request.param]
    return build(n)


def vectors(group, seed=0, count=20):
    """Return random tangent vectors: rotations by less than pi, uniform in angle; translations of order one."""
    c = np.random.default_rng(seed).standard_normal((count, group.dim))
    turns = {1: 1, 3: 3 if group.matrix_size == 3 and group.dim == 3 and group.name == "SO(3)" else 1, 6: 3}[group.dim]
    sizes = np.linalg.norm(c[:, :turns], axis=1, keepdims=True)
    radii = 3.1 * np.random.default_rng(seed + 1).random((count, 1))
    c[:, :turns] *= radii / sizes
    return c


@pytest.mark.sampled(1)
def test_log_and_exp_are_inverse(group):
    v = vectors(group)
    g = np.asarray(group.exp(v))
    assert max_abs(group.log(g) - v) < 20 * EXACT  # angles up to 3.1
    assert max_abs(group.exp(group.log(g)) - g) < EXACT


def test_group_axioms(group):
    a, b, c = (np.asarray(group.exp(vectors(group, seed))) for seed in (1, 2, 3))
    one = np.eye(group.matrix_size)
    assert max_abs(group.compose(a, group.inverse(a)) - one) < EXACT
    assert max_abs(np.asarray(group.inverse(group.inverse(a))) - a) < EXACT
    assert max_abs(np.asarray(group.inverse(a)) - np.linalg.inv(a)) < EXACT
    abc = group.compose(group.compose(a, b), c)
    assert max_abs(abc - group.compose(a, group.compose(b, c))) < EXACT
    assert bool(group.belongs(abc, 1e-13).all())


def test_adjoint(group):
    """``g exp(w) = exp(Ad(g) w) g``."""
    g, w = np.asarray(group.exp(vectors(group, 4))), 0.5 * np.random.default_rng(5).standard_normal((20, group.dim))
    adjoint_w = np.einsum("nab,nb->na", group.Ad(g), w)
    assert (
        max_abs(np.asarray(group.compose(g, group.exp(w))) - np.asarray(group.compose(group.exp(adjoint_w), g))) < EXACT
    )


def test_right_plus_and_right_minus(group):
    """``a + (b - a) = b``, with ``b - a = log(a^-1 b)``."""
    a, b = (np.asarray(group.exp(vectors(group, seed))) for seed in (6, 7))
    difference = group.log(group.compose(group.inverse(a), b))
    assert max_abs(np.asarray(group.compose(a, group.exp(difference))) - b) < 5 * EXACT


def cross(w):
    return np.array([[0.0, -w[2], w[1]], [w[2], 0.0, -w[0]], [-w[1], w[0], 0.0]])


def test_jacobian_of_the_logarithm():
    """``d log(g exp(t))`` at t = 0 is the inverse of the right Jacobian of SO(3), as in their ``jlog``."""
    group = mf.SO(3)
    forward = jax.jit(jax.jacfwd(lambda t, g: group.log(group.compose(g, group.exp(t)))))
    backward = jax.jit(jax.jacrev(lambda t, g: group.log(group.compose(g, group.exp(t)))))
    for angle in (1e-10, 1e-6, 1e-3, 0.5, 2.0, 3.0):
        w = angle * np.array([2.0, -1.0, 2.0]) / 3.0
        W = cross(w)
        quotient = (
            1.0 / 12 + angle**2 / 720
            if angle < 0.01
            else 1 / angle**2 - (1 + np.cos(angle)) / (2 * angle * np.sin(angle))
        )
        expected = np.eye(3) + W / 2 + quotient * W @ W
        g = group.exp(w)
        for derivative in (forward, backward):
            assert max_abs(derivative(jnp.zeros(3), g) - expected) < 50 * EXACT


def test_translation_of_the_exponential():
    """Their V: the translation of ``exp(w, u)`` is ``V(w) u``, ``V = 1 + (1 - cos t)/t^2 W + (t - sin t)/t^3 W^2``."""
    group, u = mf.SE(3), np.array([1.0, -2.0, 0.5])
    for angle in (1e-9, 1e-4, 1.0, 3.0):
        w = angle * np.array([1.0, 2.0, -2.0]) / 3.0
        W, t = cross(w), angle
        is_large = t > 0.01
        a = 2 * np.sin(t / 2) ** 2 / t**2 if is_large else 0.5 - t**2 / 24
        b = (t - np.sin(t)) / t**3 if is_large else 1 / 6 - t**2 / 120
        V = np.eye(3) + a * W + b * W @ W
        g = np.asarray(group.exp(np.concatenate([w, u])))
        assert max_abs(g[:3, 3] - V @ u) < 20 * EXACT
        assert max_abs(np.asarray(group.log(g))[3:] - u) < 20 * EXACT  # V^-1


@pytest.mark.slow
def test_descent_in_the_group(group):
    """Their test of gradients: five steps against the gradient of ``|log g|^2`` lower it; here it is known, 2 log g."""
    v = vectors(group, 8, count=1)[0]
    loss = lambda t, g: jnp.sum(group.log(group.compose(g, group.exp(t))) ** 2)  # noqa: E731
    slope = jax.jit(jax.grad(loss))
    g, losses = group.exp(v), []
    for _ in range(5):
        losses.append(float(loss(jnp.zeros(group.dim), g)))
        g = group.compose(g, group.exp(-1e-3 * slope(jnp.zeros(group.dim), g)))
    assert all(a > b for a, b in itertools.pairwise(losses))
    if group.name.startswith("SO"):
        assert abs(losses[1] / losses[0] - (1.0 - 2e-3) ** 2) < 1e-12
