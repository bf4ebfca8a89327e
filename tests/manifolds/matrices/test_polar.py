"""The polar decomposition compared to SciPy, and its derivatives by the defining identities."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

from manifolds.matrices.symmetric import orthogonal_images, polar

MAX_ERROR = 1e-14
"""Largest error of entries of order one; at most 2e-15 seen."""


def random_matrix(shape, seed, complex_numbers=False):
    real, imaginary = np.random.default_rng(seed).standard_normal((2, *shape))
    return real + 1j * imaginary if complex_numbers else real


@pytest.mark.parametrize("shape", [(1, 1), (2, 2), (3, 3), (4, 2), (3, 1), (6, 6)], ids=str)
@pytest.mark.parametrize("complex_numbers", [False, True])
def test_the_nearest_matrix_with_orthonormal_columns(shape, complex_numbers):
    a = random_matrix(shape, 0, complex_numbers)
    assert np.abs(polar(a) - scipy.linalg.polar(a)[0]).max() < MAX_ERROR
    images, vectors = orthogonal_images(jnp.asarray(a))
    assert np.abs(a @ vectors - images).max() < MAX_ERROR * np.abs(a).max()
    norms = np.sort(np.linalg.norm(images, axis=0))
    assert np.abs(norms - np.sort(np.linalg.svd(a)[1])).max() < MAX_ERROR * norms.max()


def test_small_singular_values_keep_their_digits():
    """No product of the matrix with itself is formed, whose least singular value would be 1e-20."""
    q, r = (np.linalg.qr(random_matrix((3, 3), seed))[0] for seed in (1, 2))
    for min_singular_value in (1e-4, 1e-8, 1e-10):
        a = q @ np.diag([1.0, 0.5, min_singular_value]) @ r.T
        assert np.abs(polar(a) - q @ r.T).max() < MAX_ERROR
        norms = np.linalg.norm(orthogonal_images(jnp.asarray(a))[0], axis=0)
        assert abs(norms.min() - min_singular_value) < 1e-15


def test_a_matrix_of_less_than_full_rank_has_none():
    for a in (np.zeros((2, 2)), np.ones((3, 3)), np.array([[1.0, 0.0], [0.0, 0.0], [0.0, 0.0]])):
        assert np.isnan(polar(a)).all()


@pytest.mark.parametrize(
    ("shape", "complex_numbers"),
    [
        ((3, 3), False),
        pytest.param((4, 2), False, marks=pytest.mark.slow),
        pytest.param((3, 3), True, marks=pytest.mark.slow),
    ],
    ids=str,
)
@pytest.mark.parametrize("repeated", [pytest.param(False, marks=pytest.mark.slow), True])
def test_derivatives_in_both_modes(shape, complex_numbers, repeated):
    """Along ``a(t)``, ``u^H u = 1`` and ``u^H a = a^H u`` hold with all their derivatives."""
    a, b, c = (random_matrix(shape, seed, complex_numbers) for seed in (3, 4, 5))
    a = scipy.linalg.polar(a)[0] if repeated else a

    def path(t):
        return jnp.asarray(a) + t * b + t**2 * c

    def identities(t):
        u = polar(path(t))
        product = u.conj().T @ path(t)
        return jnp.stack([u.conj().T @ u, product - product.conj().T])

    first_derivative = jax.jacfwd(identities)
    for derivative in (first_derivative, jax.jacfwd(first_derivative)):
        assert np.abs(jax.jit(derivative)(0.0)).max() < 1e-13
    velocity = jax.jit(jax.jacfwd(lambda t: polar(path(t))))(0.0)
    assert np.abs(velocity).max() > 0.1  # control: it moves
    weights = random_matrix(shape, 6, complex_numbers)
    backward = jax.jit(jax.grad(lambda t: jnp.sum(weights * polar(path(t))).real))(0.0)
    assert abs(backward - np.sum(weights * np.asarray(velocity)).real) < 1e-13
