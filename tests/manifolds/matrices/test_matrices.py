"""Functions of matrices: Hermitian ones compared to mpmath, exponentials of rotations, and solutions of equations."""

from __future__ import annotations

import functools
import itertools
from fractions import Fraction
from math import factorial

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
import scipy.linalg

import manifolds as mf
from manifolds.matrices import linear
from manifolds.matrices.exponential import expm, stumpff
from manifolds.matrices.spectral import GenericFunction, apply_log_mean, scalar_function
from manifolds.matrices.symmetric import eigh, one_sided_jacobi_svd, polar

NAMES = ["exp", "log", "log1p", "sqrt", "reciprocal"]


def hermitian(n, seed=0, is_complex=True):
    rng = np.random.default_rng(seed)
    a = rng.normal(size=(n, n)) + (1j * rng.normal(size=(n, n)) if is_complex else 0.0)
    return (a + a.conj().T) / 2


@pytest.mark.sampled(5)
@pytest.mark.parametrize("points", [(2.0, 2.0), (2.0, 2.0 + 1e-9), (2.0, 2.05, 2.0), (2.0, 7.0, 2.0), (1e-9, 3.0, 0.5)])
@pytest.mark.parametrize("name", NAMES)
def test_divided_differences(name, points):
    """The reference is mpmath with 90 digits, with coincident points separated by 1e-20."""
    exact = {"log1p": lambda x: mpmath.log(1 + x), "reciprocal": lambda x: 1 / x}.get(name) or getattr(mpmath, name)
    with mpmath.workdps(90):
        mp_points = [mpmath.mpf(x) + k * mpmath.mpf(10) ** -20 for k, x in enumerate(points)]
        table = [exact(x) for x in mp_points]
        for k in range(1, len(mp_points)):
            table = [(b - a) / (mp_points[i + k] - mp_points[i]) for i, (a, b) in enumerate(itertools.pairwise(table))]
        expected_value = float(table[0])
    value = float(scalar_function(getattr(jnp, name)).divided_difference(*map(jnp.asarray, points)))
    assert value == pytest.approx(expected_value, rel=3e-14)  # at most 5e-15


def test_what_a_trace_changes_by():
    """The product of the discrete gradient with the step is the difference, to rounding relative to the step."""
    A, B = hermitian(3, 1) @ hermitian(3, 1) + np.eye(3), hermitian(3, 2)

    @jax.jit
    def difference_from_A(b):
        return mf.spectral_difference(jnp.log, A, b)

    for h in (0.5, 1e-3, 1e-10, 0.0):
        difference = np.asarray(difference_from_A(A + h * B))
        assert np.abs(difference - difference.conj().T).max() == 0.0
        change = np.trace(difference @ B).real
        if h > 1e-4:
            exact = (np.log(np.linalg.eigvalsh(A + h * B)).sum() - np.log(np.linalg.eigvalsh(A)).sum()) / h
            assert change == pytest.approx(exact, rel=1e-12)
        else:
            assert change == pytest.approx(np.trace(np.linalg.inv(A + 0.5 * h * B) @ B).real, rel=1e-13)


def test_divided_differences_of_a_function_of_ones_own():
    f = GenericFunction(jnp.tanh)
    for x, y in ((0.3, 0.3), (0.3, 0.3 + 1e-8), (0.0, 1e-9), (0.3, 2.5)):
        expected_value = (
            float(mpmath.tanh(x) - mpmath.tanh(y)) / (x - y) if abs(x - y) > 1 else 1 - np.tanh((x + y) / 2) ** 2
        )
        assert float(f.divided_difference(jnp.asarray(x), jnp.asarray(y))) == pytest.approx(expected_value, rel=1e-14)


@pytest.mark.slow
@pytest.mark.parametrize("is_complex", [False, True])
def test_derivatives_of_every_order_where_eigenvalues_meet(is_complex):
    """Both modes agree, and each derivative is the difference quotient of the next lower one."""
    A = np.diag([2.0, 2.0])
    B, C, G = (hermitian(2, seed, is_complex) for seed in range(3))

    def spectral_product(x):
        return jnp.sum(jnp.asarray(G) * mf.spectral(jnp.log, A + x[0] * B + x[1] * C).conj()).real

    gradient, hessian = jax.jit(jax.grad(spectral_product)), jax.jit(jax.hessian(spectral_product))
    third = jax.jit(jax.jacfwd(jax.hessian(spectral_product)))
    x, h = jnp.zeros(2), 1e-4
    reverse = jax.jacrev(jax.grad(spectral_product))(x)
    assert np.abs(reverse - hessian(x)).max() <= 1e-14
    for lower_derivative, derivative in ((spectral_product, gradient(x)), (gradient, hessian(x)), (hessian, third(x))):
        quotient = np.stack(
            [(lower_derivative(x + h * e) - lower_derivative(x - h * e)) / (2 * h) for e in np.eye(2)], axis=-1
        )
        assert np.abs(quotient - derivative).max() <= 1e-6 * np.abs(derivative).max()
    # The control: the derivative of an eigenvector is not finite here.
    eigenvector_derivative = jax.grad(lambda t: jnp.linalg.eigh(A + t * B)[1].real.sum())(0.0)
    assert not np.isfinite(eigenvector_derivative)


def test_gradients_of_traces():
    A, U = np.diag([2.0, 2.0, 5.0]), np.linalg.qr(hermitian(3, 1))[0]
    B = hermitian(3)
    for f, slope in ((jnp.log, np.diag([0.5, 0.5, 0.2])), (jnp.exp, np.diag(np.exp([2.0, 2.0, 5.0])))):
        for frame in (np.eye(3), U):  # in the second the gradient is complex, so its transpose is another matrix
            matrix, gradient = (frame @ diagonal @ frame.conj().T for diagonal in (A, slope))
            derivative = jax.grad(lambda t, f=f, matrix=matrix: mf.spectral_trace(f, matrix + t * B))(0.0)
            assert derivative == pytest.approx(np.trace(gradient @ B).real, rel=1e-13)


def test_the_logarithmic_mean():
    p, s, X = np.array([0.7, 0.3, 1e-12]), 0.4, hermitian(3)
    u, v = np.exp(-s) * p[:, None], np.exp(s) * p[None, :]
    expected_mean = X * (u - v) / np.log(u / v)
    logs = jnp.diag(jnp.log(p)).astype(complex)
    assert np.abs(apply_log_mean(logs, s, X) - expected_mean).max() <= 1e-15
    quotient = (apply_log_mean(logs, s + 1e-5, X) - apply_log_mean(logs, s - 1e-5, X)) / 2e-5
    assert np.abs(jax.jacfwd(lambda s: apply_log_mean(logs, s, X))(s) - quotient).max() <= 1e-9


def test_batches_and_maps():
    batch = jnp.stack([hermitian(3, seed) for seed in range(4)])
    exponentials = mf.spectral(jnp.exp, batch)
    assert np.abs(exponentials - jax.vmap(functools.partial(mf.spectral, jnp.exp))(batch)).max() == 0.0
    derivatives = jax.vmap(lambda B: jax.jvp(functools.partial(mf.spectral, jnp.exp), (batch[0],), (B,))[1])(batch)
    assert (
        np.abs(derivatives[2] - jax.jvp(functools.partial(mf.spectral, jnp.exp), (batch[0],), (batch[2],))[1]).max()
        <= 1e-14
    )


@pytest.mark.parametrize("n", [2, 3, 8])
def test_eigenvectors_of_hermitian_matrices(n):
    a = hermitian(n)
    values, vectors = eigh(a)
    assert np.abs(np.sort(values) - np.linalg.eigvalsh(a)).max() <= 1e-14
    assert np.abs((vectors * values) @ vectors.conj().T - a).max() <= 1e-14


def test_derivatives_of_the_exponential():
    rng = np.random.default_rng(0)
    X, D, E = rng.normal(size=(3, 2, 2))

    def exponential_product(t):
        return jnp.sum(E * expm(X + t[0] * D + t[1] * E))

    t, h = jnp.zeros(2), 1e-5
    hessian, gradient = jax.jit(jax.hessian(exponential_product))(t), jax.jit(jax.grad(exponential_product))
    assert np.abs(jax.jit(jax.jacrev(gradient))(t) - hessian).max() <= 1e-13
    quotient = np.stack([(gradient(t + h * e) - gradient(t - h * e)) / (2 * h) for e in np.eye(2)])
    assert np.abs(quotient - hessian).max() <= 1e-7 * np.abs(hessian).max()


# -- the polar decomposition compared to SciPy, and its derivatives by the defining identities -------------------------


MAX_ERROR = 1e-14
"""Largest error of entries of order one; at most 2e-15 seen."""


def random_matrix(shape, seed, complex_numbers=False):
    real, imaginary = np.random.default_rng(seed).standard_normal((2, *shape))
    return real + 1j * imaginary if complex_numbers else real


@pytest.mark.sampled(5)
@pytest.mark.parametrize("shape", [(1, 1), (2, 2), (3, 3), (4, 2), (3, 1), (6, 6)], ids=str)
@pytest.mark.parametrize("complex_numbers", [False, True])
def test_the_nearest_matrix_with_orthonormal_columns(shape, complex_numbers):
    a = random_matrix(shape, 0, complex_numbers)
    assert np.abs(polar(a) - scipy.linalg.polar(a)[0]).max() < MAX_ERROR
    images, vectors = one_sided_jacobi_svd(jnp.asarray(a))
    assert np.abs(a @ vectors - images).max() < MAX_ERROR * np.abs(a).max()
    norms = np.sort(np.linalg.norm(images, axis=0))
    assert np.abs(norms - np.sort(np.linalg.svd(a)[1])).max() < MAX_ERROR * norms.max()


def test_small_singular_values_keep_their_digits():
    """No product of the matrix with itself is formed, whose least singular value would be 1e-20."""
    q, r = (np.linalg.qr(random_matrix((3, 3), seed))[0] for seed in (1, 2))
    for min_singular_value in (1e-4, 1e-8, 1e-10):
        a = q @ np.diag([1.0, 0.5, min_singular_value]) @ r.T
        assert np.abs(polar(a) - q @ r.T).max() < MAX_ERROR
        norms = np.linalg.norm(one_sided_jacobi_svd(jnp.asarray(a))[0], axis=0)
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


STUMPFF_RTOL = 1e-15
"""For arguments up to 8; at most 3e-16 was seen."""


def test_stumpff_functions():
    for order, z in itertools.product(range(4), (0.0, 1e-20, 0.3, 0.999999, 1.0, 1.000001, 2.0, 8.0)):
        exact = float(sum(Fraction(-z) ** k / factorial(2 * k + order) for k in range(30)))
        assert abs(float(stumpff(order, z)) - exact) <= STUMPFF_RTOL * max(abs(exact), 0.5 / factorial(order))
    for order in range(4):
        assert float(jax.grad(stumpff, argnums=1)(order, 0.0)) == -1.0 / factorial(order + 2)


def test_matrix_exponential_of_rotations():
    """``jax.scipy.linalg.expm`` is wrong by 1e-8 at 10.6."""
    compiled_expm = jax.jit(expm)
    for angle in (1e-5, 1.0, 5.3, 5.5, 10.6, 21.0, 1000.0):
        g = compiled_expm(np.array([[0.0, -angle], [angle, 0.0]]))
        exact = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        assert np.abs(g - exact).max() <= 5e-15 * max(1.0, angle / 5)
    assert bool(jnp.isnan(compiled_expm(1e6 * np.eye(2))).all())
    assert bool(jnp.isnan(compiled_expm(np.full((2, 2), np.nan))).all())


def test_solve_and_determinant():
    rng = np.random.default_rng(0)
    a, b = rng.standard_normal((2, 3, 5, 5)) + 1j * rng.standard_normal((2, 3, 5, 5))
    a[0, 0, 0] = 0.0  # needs a row exchange
    assert np.abs(a @ jax.jit(linear.solve)(a, b) - b).max() < 1e-13
    assert np.allclose(jax.jit(linear.determinant)(a), np.linalg.det(a), rtol=1e-13, atol=0.0)
    assert not np.isfinite(jax.jit(linear.inverse)(np.zeros((2, 2)))).any()

    def gradient(solver):
        return jax.jit(jax.grad(lambda a, b: jnp.abs(solver(a, b)).sum(), argnums=(0, 1)))

    ours, theirs = gradient(linear.solve), gradient(jnp.linalg.solve)
    for x, y in zip(ours(a, b), theirs(a, b), strict=True):
        assert np.allclose(x, y, rtol=1e-11, atol=1e-11)
    assert "lapack" not in ours.lower(a, b).as_text()
    assert "lapack" in theirs.lower(a, b).as_text()  # control
