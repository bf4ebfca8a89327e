"""Symmetric matrices: Cholesky factors, Jacobi eigenvectors, roots, and a logarithm; polar decomposition of any matrix.

All are array operations of fixed length, for the reason given at :func:`manifolds.matrices.linear.solve` and so that
small cases can be unrolled into scalar programs. Leading axes are batches.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from .exponential import expm, hyperbolic_stumpff
from .linear import adjoint, max_abs_entry, newton_schulz_step, solve

_MAX_EXCESS_FOR_LOG1P = 0.5
"""Largest entry of w - I for which the logarithm of w uses eigenvalues of w - I, instead of w."""

_RANK_TOLERANCE = 1e-13
"""Eigenvalues and pivots of semidefinite matrices below this, relative to the largest, count as rounding errors."""


def symmetrize(a) -> jax.Array:
    """Return ``(a + a^T) / 2``."""
    return 0.5 * (a + a.swapaxes(-1, -2))


def cholesky(a) -> jax.Array:
    """Return the lower triangular L with ``L L^H = a``, NaN where a is not positive definite."""
    n, columns = a.shape[-1], []
    for k in range(n):
        column = jnp.where(np.arange(n) < k, 0.0, a[..., :, k] / jnp.sqrt(a[..., k, k])[..., None])
        a = a - column[..., :, None] * column.conj()[..., None, :]
        columns.append(column)
    return jnp.stack(columns, axis=-1)


def solve_lower(L, b) -> jax.Array:
    """Solve ``L x = b``, shapes (..., n, n) and (..., n, k), by forward substitution."""
    rows: list[jax.Array] = []
    for i in range(L.shape[-1]):
        remainder = b[..., i, :]
        for j, row in enumerate(rows):
            remainder = remainder - L[..., i, j, None] * row
        rows.append(remainder / L[..., i, i, None])
    return jnp.stack(rows, axis=-2)


def orthonormal_columns(a) -> jax.Array:
    """Return the Q of ``a = Q R``, R upper triangular with positive diagonal, for a of full rank, shape (..., n, p)."""
    q = adjoint(solve_lower(cholesky(adjoint(a) @ a), adjoint(a)))
    for _ in range(3):  # the product squares the condition number of a
        q = newton_schulz_step(q)
    return q


def eigh(a) -> tuple[jax.Array, jax.Array]:
    """Return eigenvalues, shape (..., n), in no order, and orthonormal eigenvectors, as columns: cyclic Jacobi
    rotations.

    The matrices are real symmetric or complex Hermitian. Small eigenvalues come out more accurately than by reduction
    to tridiagonal form [Demmel & Veselic 1992]. Eigenvalues are NaN without convergence. The eigenvectors have no
    derivative where eigenvalues meet.
    """
    n = a.shape[-1]
    # one or two sweeps more than random matrices of size 3, 10, 30, 50 need: 4, 7, 8, 9
    axes = _sweep_plane_axes(n, 1 if n == 2 else 4 + n.bit_length())

    def apply_rotation(state, axes):
        a, vectors = state
        e, f = axes
        J = _jacobi_rotation(axes, *(u @ a @ v for u, v in ((e, e), (f, f), (e, f))))
        return (adjoint(J) @ a @ J, vectors @ J), None

    start = (a + adjoint(a)) / 2, jnp.broadcast_to(np.eye(n, dtype=a.dtype), a.shape)
    (d, vectors), _ = jax.lax.scan(apply_rotation, start, axes)
    values = jnp.diagonal(d, axis1=-2, axis2=-1).real
    is_converged = max_abs_entry(d * (1.0 - np.eye(n))) <= 1e-14 * max_abs_entry(a)
    return jnp.where(is_converged[..., None], values, jnp.nan), vectors


def _sweep_plane_axes(n: int, sweeps: int) -> np.ndarray:
    """Return the axes of the planes of cyclic rotations, as unit vectors, shape (rotations, 2, n)."""
    pairs = np.array([(p, q) for p in range(n) for q in range(p + 1, n)], dtype=int).reshape(-1, 2)
    return np.tile(np.eye(n)[pairs], (sweeps, 1, 1))


def _jacobi_rotation(axes, alpha, beta, entry):
    """Return the rotation in the plane of two axes that makes ``[[alpha, entry], [conj(entry), beta]]`` diagonal."""
    e, f = axes
    alpha, beta, entry = (a[..., None, None] for a in (alpha.real, beta.real, entry))
    is_complex = jnp.iscomplexobj(entry)
    gamma = jnp.abs(entry) if is_complex else entry
    is_diagonal = gamma == 0.0
    divisor = jnp.where(is_diagonal, 1.0, gamma)
    slope = (beta - alpha) / (2 * divisor)
    tangent = jnp.where(slope < 0, -1.0, 1.0) / (jnp.abs(slope) + jnp.sqrt(1.0 + slope**2))
    cosine = 1.0 / jnp.sqrt(1.0 + tangent**2)
    sine = jnp.where(is_diagonal, 0.0, tangent * cosine)
    cosine = jnp.where(is_diagonal, 1.0, cosine)
    plane_projector, upper_unit = jnp.outer(e, e) + jnp.outer(f, f), jnp.outer(e, f)
    turn = (
        upper_unit * (entry / divisor) - upper_unit.T * (entry.conj() / divisor)
        if is_complex
        else upper_unit - upper_unit.T
    )
    return np.eye(len(e)) + (cosine - 1.0) * plane_projector + sine * turn


def one_sided_jacobi_svd(a) -> tuple[jax.Array, jax.Array]:
    """Return ``a V``, shape (..., m, n), with orthogonal columns, and the unitary V, shape (..., n, n): a Jacobi SVD.

    The norms of the columns are the singular values of a, in no order, each accurate to a rounding of the largest:
    no product of a with itself is formed. The columns are rotated by Jacobi's method [Hestenes 1958].
    """
    n = a.shape[-1]
    axes = _sweep_plane_axes(n, 5 + n.bit_length())

    def apply_rotation(state, axes):
        images, vectors = state
        u, v = images @ axes[0], images @ axes[1]
        J = _jacobi_rotation(axes, *((p.conj() * q).sum(axis=-1) for p, q in ((u, u), (v, v), (u, v))))
        return (images @ J, vectors @ J), None

    start = a, jnp.broadcast_to(np.eye(n, dtype=a.dtype), (*a.shape[:-2], n, n))
    return jax.lax.scan(apply_rotation, start, axes)[0]


@jax.custom_jvp
def polar(a) -> jax.Array:
    """Return the nearest matrix with orthonormal columns, ``a (a^H a)^-1/2``, shape (..., n, p); NaN if the rank is
    below p.

    It is accurate to rounding over the sum of the two least singular values, and has derivatives of every order.
    """
    images, vectors = one_sided_jacobi_svd(a)
    norms = jnp.sqrt((jnp.abs(images) ** 2).sum(axis=-2, keepdims=True))
    has_full_rank = norms.min(axis=-1, keepdims=True) > _RANK_TOLERANCE * norms.max(axis=-1, keepdims=True)
    u = newton_schulz_step((images / jnp.where(has_full_rank, norms, 1.0)) @ adjoint(vectors))
    has_full_rank &= (max_abs_entry(adjoint(u) @ u - np.eye(a.shape[-1])) < 1e-12)[..., None, None]
    return jnp.where(has_full_rank, u, jnp.nan)


@polar.defjvp
def _polar_derivative(primals, tangents):
    """With ``a = u h``, return ``u' = u w + (1 - u u^H) a' h^-1``, where w solves ``h w + w h = u^H a' - a'^H u``.

    The operator on the left is self-adjoint, and JAX differentiates a linear solve, so derivatives of higher order
    exist.
    """
    (a,), (da,) = primals, tangents
    u = polar(a)
    tangential_rate = adjoint(u) @ da
    h = adjoint(u) @ a
    h = 0.5 * (h + adjoint(h))
    images, vectors = one_sided_jacobi_svd(jax.lax.stop_gradient(a))
    singular_values = jnp.sqrt((jnp.abs(images) ** 2).sum(axis=-2))
    singular_value_sums = singular_values[..., :, None] + singular_values[..., None, :]

    def solve_in_eigenvectors(vectors, b):
        return vectors @ ((adjoint(vectors) @ b @ vectors) / singular_value_sums) @ adjoint(vectors)

    w = jax.lax.custom_linear_solve(
        lambda w: h @ w + w @ h,
        tangential_rate - adjoint(tangential_rate),
        solve=lambda _, b: solve_in_eigenvectors(vectors, b),
        transpose_solve=lambda _, b: solve_in_eigenvectors(vectors.conj(), b),
    )
    du = u @ w
    if a.shape[-2] > a.shape[-1]:
        du = du + adjoint(solve(h, adjoint(da - u @ tangential_rate)))
    return u, du


@jax.custom_jvp
def spd_log(w, excess) -> jax.Array:
    """Return the logarithm of a symmetric positive definite w, given with its excess ``w - I``; NaN if it is not
    defined.

    With w and its excess no digits are lost, neither for w near I nor near 0. Derivatives of every order, in w, follow
    from ``exp(x) = w``.
    """
    near_identity = max_abs_entry(excess) < _MAX_EXCESS_FOR_LOG1P
    values, vectors = eigh(jnp.where(near_identity[..., None, None], excess, w))
    near_identity = near_identity[..., None]
    logs = jnp.where(
        near_identity, jnp.log1p(jnp.where(near_identity, values, 0.0)), jnp.log(jnp.where(near_identity, 1.0, values))
    )
    return symmetrize((vectors * logs[..., None, :]) @ vectors.swapaxes(-1, -2))


@spd_log.defjvp
def _log_jvp(primals, tangents):
    x, dw = spd_log(*primals), tangents[0]
    values, vectors = eigh(jax.lax.stop_gradient(x))
    mean, half = (values[..., :, None] + values[..., None, :]) / 2, (values[..., :, None] - values[..., None, :]) / 2
    quotients = jnp.exp(mean) * hyperbolic_stumpff(1, half**2)  # (e^s - e^t) / (s - t)

    def derivative_of_exp(dx):
        return jax.jvp(expm, (x,), (dx,))[1]

    def solve_in_eigenvectors(_, b):
        return vectors @ ((vectors.swapaxes(-1, -2) @ b @ vectors) / quotients) @ vectors.swapaxes(-1, -2)

    # The derivative of exp is self-adjoint, and a linear solve has derivatives of its own: hence those of higher order.
    return x, jax.lax.custom_linear_solve(derivative_of_exp, symmetrize(dw), solve_in_eigenvectors, symmetric=True)


def semidefinite_factor(a) -> jax.Array:
    """Return L with ``L L^T = a``, shape (n, n), for a symmetric positive semidefinite a, by Cholesky with pivoting.

    Columns whose pivot is rounding are zero. The factor is not a continuous function of a.
    """
    n, columns = a.shape[-1], []
    threshold = _RANK_TOLERANCE * jnp.max(jnp.diagonal(a), initial=0.0)
    for _ in range(n):
        diagonal = jnp.diagonal(a)
        pivot = jnp.argmax(diagonal)
        is_pivot = np.arange(n) == pivot
        pivot_value = jnp.max(diagonal)
        is_significant = pivot_value > threshold
        column = jnp.where(
            is_significant,
            a @ jnp.where(is_pivot, 1.0, 0.0) / jnp.sqrt(jnp.where(is_significant, pivot_value, 1.0)),
            0.0,
        )
        columns.append(column)
        a = a - column[:, None] * column[None, :]
        a = jnp.where(is_pivot[:, None] | is_pivot[None, :], 0.0, a)
    return jnp.stack(columns, axis=-1)


@jax.custom_jvp
def semidefinite_root(a) -> jax.Array:
    """Return the symmetric positive semidefinite X with ``X X = a``, shape (..., n, n).

    Eigenvalues that are rounding count as zero. As long as their number does not change X is a smooth function of a.
    The first derivative is right also where eigenvalues meet; higher ones are right where no eigenvalue is zero.
    """
    values, vectors = _semidefinite_eigh(a)
    return symmetrize((vectors * jnp.sqrt(values)[..., None, :]) @ vectors.swapaxes(-1, -2))


def _semidefinite_eigh(a) -> tuple[jax.Array, jax.Array]:
    """Return eigenvalues, set to zero where they are rounding, and eigenvectors."""
    values, vectors = eigh(a)
    threshold = _RANK_TOLERANCE * jnp.max(jnp.abs(values), axis=-1, keepdims=True)
    return jnp.where(values > threshold, values, 0.0), vectors


@semidefinite_root.defjvp
def _root_derivative(primals, tangents):
    (a,), (da,) = primals, tangents
    x = semidefinite_root(a)
    values, vectors = _semidefinite_eigh(jax.lax.stop_gradient(a))
    roots = jnp.sqrt(values)
    sums = roots[..., :, None] + roots[..., None, :]
    inverse = jnp.where(sums > 0.0, 1.0 / jnp.where(sums > 0.0, sums, 1.0), 0.0)

    def derivative_of_square(dx):  # the derivative of X X, self-adjoint
        return x @ dx + dx @ x

    def solve_in_eigenvectors(_, b):
        return vectors @ ((vectors.swapaxes(-1, -2) @ b @ vectors) * inverse) @ vectors.swapaxes(-1, -2)

    return x, jax.lax.custom_linear_solve(derivative_of_square, symmetrize(da), solve_in_eigenvectors, symmetric=True)
