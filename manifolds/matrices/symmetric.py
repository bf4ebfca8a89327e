"""Symmetric matrices: Cholesky factors, eigenvectors by Jacobi's rotations, and a logarithm with all its derivatives.

Beside them the polar decomposition of any matrix, by rotations of the same kind.

Plain array operations of fixed length, for the reason given at :func:`manifolds.matrices.linear.solve` and so that
small cases can be unrolled into scalar programs. Leading axes are batches.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from .exponential import expm
from .linear import adjoint, max_abs_entry, newton_schulz_step, solve
from .stumpff import hyperbolic_stumpff

_MAX_EXCESS_FOR_LOG1P = 0.5
"""Largest entry of w - I up to which the logarithm of w takes the eigenvalues of w - I, not those of w."""

_RANK_TOLERANCE = 1e-13
"""Eigenvalues and pivots of semidefinite matrices, relative to the largest, that rounding alone may have made."""


def symmetrize(a) -> jax.Array:
    """``(a + a^T) / 2``."""
    return 0.5 * (a + a.swapaxes(-1, -2))


def cholesky(a) -> jax.Array:
    """Lower triangular L with ``L L^H = a``, NaN where a is not positive definite."""
    n, columns = a.shape[-1], []
    for k in range(n):
        column = jnp.where(np.arange(n) < k, 0.0, a[..., :, k] / jnp.sqrt(a[..., k, k])[..., None])
        a = a - column[..., :, None] * column.conj()[..., None, :]
        columns.append(column)
    return jnp.stack(columns, axis=-1)


def solve_lower(L, b) -> jax.Array:
    """Solution x of ``L x = b``, shapes (..., n, n) and (..., n, k), by forward substitution."""
    rows: list[jax.Array] = []
    for i in range(L.shape[-1]):
        rest = b[..., i, :]
        for j, row in enumerate(rows):
            rest = rest - L[..., i, j, None] * row
        rows.append(rest / L[..., i, i, None])
    return jnp.stack(rows, axis=-2)


def orthonormal_columns(a) -> jax.Array:
    """The Q of ``a = Q R`` with R upper triangular and its diagonal positive, for a of full rank, shape (..., n, p)."""
    q = adjoint(solve_lower(cholesky(adjoint(a) @ a), adjoint(a)))
    for _ in range(3):  # the product squares the condition number of a
        q = newton_schulz_step(q)
    return q


def eigh(a) -> tuple[jax.Array, jax.Array]:
    """Eigenvalues, shape (..., n), in no order, and orthonormal eigenvectors, as columns: cyclic Jacobi rotations.

    The matrices are real symmetric or complex Hermitian. Small eigenvalues come out more accurately than by reduction
    to tridiagonal form [Demmel & Veselic 1992]. NaN where it has not converged. The eigenvectors have no derivative
    where eigenvalues meet.
    """
    n = a.shape[-1]
    # one or two sweeps more than random matrices of size 3, 10, 30, 50 need: 4, 7, 8, 9
    axes = _sweep_plane_axes(n, 1 if n == 2 else 4 + n.bit_length())

    def rotate(state, axes):
        a, vectors = state
        e, f = axes
        J = _jacobi_rotation(axes, *(u @ a @ v for u, v in ((e, e), (f, f), (e, f))))
        return (adjoint(J) @ a @ J, vectors @ J), None

    start = (a + adjoint(a)) / 2, jnp.broadcast_to(np.eye(n, dtype=a.dtype), a.shape)
    (d, vectors), _ = jax.lax.scan(rotate, start, axes)
    values = jnp.diagonal(d, axis1=-2, axis2=-1).real
    converged = max_abs_entry(d * (1.0 - np.eye(n))) <= 1e-14 * max_abs_entry(a)
    return jnp.where(converged[..., None], values, jnp.nan), vectors


def _sweep_plane_axes(n: int, sweeps: int) -> np.ndarray:
    """The axes of the planes of cyclic rotations, as unit vectors, shape (rotations, 2, n)."""
    pairs = np.array([(p, q) for p in range(n) for q in range(p + 1, n)], dtype=int).reshape(-1, 2)
    return np.tile(np.eye(n)[pairs], (sweeps, 1, 1))


def _jacobi_rotation(axes, alpha, beta, entry):
    """The rotation in the plane of two axes that makes ``[[alpha, entry], [conj(entry), beta]]`` diagonal."""
    e, f = axes
    alpha, beta, entry = (a[..., None, None] for a in (alpha.real, beta.real, entry))
    is_complex = jnp.iscomplexobj(entry)
    gamma = jnp.abs(entry) if is_complex else entry
    done = gamma == 0.0
    divisor = jnp.where(done, 1.0, gamma)
    slope = (beta - alpha) / (2 * divisor)
    tangent = jnp.where(slope < 0, -1.0, 1.0) / (jnp.abs(slope) + jnp.sqrt(1.0 + slope**2))
    cosine = 1.0 / jnp.sqrt(1.0 + tangent**2)
    sine = jnp.where(done, 0.0, tangent * cosine)
    cosine = jnp.where(done, 1.0, cosine)
    plane, upper = jnp.outer(e, e) + jnp.outer(f, f), jnp.outer(e, f)
    turn = upper * (entry / divisor) - upper.T * (entry.conj() / divisor) if is_complex else upper - upper.T
    return np.eye(len(e)) + (cosine - 1.0) * plane + sine * turn


def orthogonal_images(a) -> tuple[jax.Array, jax.Array]:
    """``a V``, shape (..., m, n), with orthogonal columns, and the unitary V, shape (..., n, n).

    The norms of the columns are the singular values of a, in no order, each accurate to a rounding of the largest:
    no product of a with itself is formed. By Jacobi rotations of the columns [Hestenes 1958].
    """
    n = a.shape[-1]
    axes = _sweep_plane_axes(n, 5 + n.bit_length())

    def rotate(state, axes):
        images, vectors = state
        u, v = images @ axes[0], images @ axes[1]
        J = _jacobi_rotation(axes, *((p.conj() * q).sum(axis=-1) for p, q in ((u, u), (v, v), (u, v))))
        return (images @ J, vectors @ J), None

    start = a, jnp.broadcast_to(np.eye(n, dtype=a.dtype), (*a.shape[:-2], n, n))
    return jax.lax.scan(rotate, start, axes)[0]


@jax.custom_jvp
def polar(a) -> jax.Array:
    """Nearest matrix with orthonormal columns, ``a (a^H a)^-1/2``, shape (..., n, p); NaN where the rank is below p.

    It is accurate to rounding over the sum of the two least singular values, and has derivatives of every order.
    """
    images, vectors = orthogonal_images(a)
    sizes = jnp.sqrt((jnp.abs(images) ** 2).sum(axis=-2, keepdims=True))
    full = sizes.min(axis=-1, keepdims=True) > _RANK_TOLERANCE * sizes.max(axis=-1, keepdims=True)
    u = newton_schulz_step((images / jnp.where(full, sizes, 1.0)) @ adjoint(vectors))
    full &= (max_abs_entry(adjoint(u) @ u - np.eye(a.shape[-1])) < 1e-12)[..., None, None]
    return jnp.where(full, u, jnp.nan)


@polar.defjvp
def _polar_derivative(primals, tangents):
    """With ``a = u h``: ``u' = u w + (1 - u u^H) a' h^-1``, and w solves ``h w + w h = u^H a' - a'^H u``.

    The operator on the left is its own adjoint, and a linear solve has derivatives of its own: those of higher order.
    """
    (a,), (da,) = primals, tangents
    u = polar(a)
    along = adjoint(u) @ da
    h = adjoint(u) @ a
    h = 0.5 * (h + adjoint(h))
    images, vectors = orthogonal_images(jax.lax.stop_gradient(a))
    sizes = jnp.sqrt((jnp.abs(images) ** 2).sum(axis=-2))
    sums = sizes[..., :, None] + sizes[..., None, :]

    def solved(vectors, b):
        return vectors @ ((adjoint(vectors) @ b @ vectors) / sums) @ adjoint(vectors)

    w = jax.lax.custom_linear_solve(
        lambda w: h @ w + w @ h,
        along - adjoint(along),
        solve=lambda _, b: solved(vectors, b),
        transpose_solve=lambda _, b: solved(vectors.conj(), b),
    )
    du = u @ w
    if a.shape[-2] > a.shape[-1]:
        du = du + adjoint(solve(h, adjoint(da - u @ along)))
    return u, du


@jax.custom_jvp
def spd_log(w, excess) -> jax.Array:
    """Logarithm of a symmetric positive definite matrix, given along with its excess ``w - I``; NaN where not defined.

    With both at hand neither a w next to I nor one next to 0 loses digits. Derivatives of every order, in w, through
    ``exp(x) = w``.
    """
    near = max_abs_entry(excess) < _MAX_EXCESS_FOR_LOG1P
    values, vectors = eigh(jnp.where(near[..., None, None], excess, w))
    near = near[..., None]
    logs = jnp.where(near, jnp.log1p(jnp.where(near, values, 0.0)), jnp.log(jnp.where(near, 1.0, values)))
    return symmetrize((vectors * logs[..., None, :]) @ vectors.swapaxes(-1, -2))


@spd_log.defjvp
def _log_derivative(primals, tangents):
    x, dw = spd_log(*primals), tangents[0]
    values, vectors = eigh(jax.lax.stop_gradient(x))
    mean, half = (values[..., :, None] + values[..., None, :]) / 2, (values[..., :, None] - values[..., None, :]) / 2
    quotients = jnp.exp(mean) * hyperbolic_stumpff(1, half**2)  # (e^s - e^t) / (s - t)

    def derivative_of_exp(dx):
        return jax.jvp(expm, (x,), (dx,))[1]

    def in_eigenvectors(_, b):
        return vectors @ ((vectors.swapaxes(-1, -2) @ b @ vectors) / quotients) @ vectors.swapaxes(-1, -2)

    # The derivative of exp is self-adjoint, and a linear solve has derivatives of its own: hence those of higher order.
    return x, jax.lax.custom_linear_solve(derivative_of_exp, symmetrize(dw), in_eigenvectors, symmetric=True)


def semidefinite_factor(a) -> jax.Array:
    """A matrix L with ``L L^T = a``, shape (n, n), for a symmetric positive semidefinite a: Cholesky's, with pivots.

    What is left when the pivots are rounding is dropped: columns of zeros. The factor is no continuous function of a.
    """
    n, columns = a.shape[-1], []
    least = _RANK_TOLERANCE * jnp.max(jnp.diagonal(a), initial=0.0)
    for _ in range(n):
        diagonal = jnp.diagonal(a)
        pivot = jnp.argmax(diagonal)
        chosen = np.arange(n) == pivot
        largest_left = jnp.max(diagonal)
        good = largest_left > least
        column = jnp.where(good, a @ jnp.where(chosen, 1.0, 0.0) / jnp.sqrt(jnp.where(good, largest_left, 1.0)), 0.0)
        columns.append(column)
        a = a - column[:, None] * column[None, :]
        a = jnp.where(chosen[:, None] | chosen[None, :], 0.0, a)
    return jnp.stack(columns, axis=-1)


@jax.custom_jvp
def semidefinite_root(a) -> jax.Array:
    """The symmetric positive semidefinite X with ``X X = a``, shape (..., n, n).

    Eigenvalues that are rounding count as zero. As long as their number does not change X is a smooth function of a.
    The first derivative is right also where eigenvalues meet; further ones are where none is zero.
    """
    values, vectors = _semidefinite_eigh(a)
    return symmetrize((vectors * jnp.sqrt(values)[..., None, :]) @ vectors.swapaxes(-1, -2))


def _semidefinite_eigh(a) -> tuple[jax.Array, jax.Array]:
    """Eigenvalues, zero where they are rounding, and eigenvectors."""
    values, vectors = eigh(a)
    least = _RANK_TOLERANCE * jnp.max(jnp.abs(values), axis=-1, keepdims=True)
    return jnp.where(values > least, values, 0.0), vectors


@semidefinite_root.defjvp
def _root_derivative(primals, tangents):
    (a,), (da,) = primals, tangents
    x = semidefinite_root(a)
    values, vectors = _semidefinite_eigh(jax.lax.stop_gradient(a))
    roots = jnp.sqrt(values)
    sums = roots[..., :, None] + roots[..., None, :]
    inverse = jnp.where(sums > 0.0, 1.0 / jnp.where(sums > 0.0, sums, 1.0), 0.0)

    def of_square(dx):  # the derivative of X X, self-adjoint
        return x @ dx + dx @ x

    def in_eigenvectors(_, b):
        return vectors @ ((vectors.swapaxes(-1, -2) @ b @ vectors) * inverse) @ vectors.swapaxes(-1, -2)

    return x, jax.lax.custom_linear_solve(of_square, symmetrize(da), in_eigenvectors, symmetric=True)
