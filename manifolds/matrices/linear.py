"""Linear algebra of small matrices: elimination, complements, square roots, determinants, and repeated blocks."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .._pytree_module import Module


def adjoint(a):
    """Return the conjugate transposes of matrices, shape (..., n, m), of NumPy or JAX."""
    return a.conj().swapaxes(-1, -2)


def newton_schulz_step(u) -> jax.Array:
    """Take one Newton-Schulz step towards the nearest matrix with orthonormal columns.

    The step squares the distance of ``u^H u`` from I.
    """
    return 1.5 * u - 0.5 * u @ (adjoint(u) @ u)


def orthonormal_complement(u) -> jax.Array:
    """Return columns that complete the orthonormal columns of u, shape (..., n, p), to a basis, shape (..., n, n - p).

    The columns are images of the last axes under the Householder reflections that take u to the first axes. They are a
    smooth function of u where no pivot changes sign.
    """
    n, p = u.shape[-2:]
    axes, normals = np.eye(n), []

    def reflect(a, normal):
        normal = normal[..., :, None]
        weights = (normal * a).sum(axis=-2, keepdims=True) * (2 / (normal**2).sum(axis=-2, keepdims=True))
        return a - normal * weights

    for k in range(p):
        column = jnp.where(np.arange(n) < k, 0.0, u[..., :, k])
        norm = jnp.sqrt((column**2).sum(axis=-1, keepdims=True))
        normals.append(column + jnp.where(column[..., k : k + 1] < 0, -norm, norm) * axes[k])
        u = reflect(u, normals[-1])
    complement = jnp.asarray(axes[:, p:])
    for normal in reversed(normals):
        complement = reflect(complement, normal)
    return complement


def _matrix_square_root(a):
    """Return the principal square root, its inverse, and a flag of convergence, by Denman and Beavers' iteration.

    The iterates (y, z) tend to (a^1/2, a^-1/2) [Higham 2008, eq. 6.15]. An eigenvalue at the angle pi - d costs
    log2(1/d) more steps and loses as many bits.
    """

    def is_unfinished(state):
        _, change, steps = state
        return ((change > 1e-8) & (steps < _MAX_ROOT_STEPS)).any()

    def denman_beavers_step(state):
        roots, _, steps = state
        new = (roots + inverse(roots[::-1])) / 2
        return new, max_abs_entry(new[0] - roots[0]) / max_abs_entry(new[0]), steps + 1

    roots = jnp.stack([a, jnp.broadcast_to(np.eye(a.shape[-1], dtype=a.dtype), a.shape)])
    roots, change, _ = jax.lax.while_loop(
        is_unfinished, denman_beavers_step, (roots, jnp.full(a.shape[:-2], jnp.inf), 0)
    )
    return *roots, change <= 1e-8  # quadratic convergence: a step of 1e-8 ends at rounding


_MAX_ROOT_STEPS = 33
"""Largest number of iterations; just enough for every angle up to pi - HALF_TURN_MARGIN."""


def solve(a, b) -> jax.Array:
    """Solve ``a x = b``, shapes (..., m, m) and (..., m, k), by Gauss-Jordan elimination with partial pivoting.

    It uses array operations only. ``jnp.linalg.solve`` calls LAPACK, and on a CPU two independent calls
    in one compiled program can wait for each other forever (jax 0.10.2, batches from about 1000).
    """
    return jax.lax.custom_linear_solve(
        lambda x: a @ x,
        b,
        solve=lambda _, b: _solution_and_determinant(a, b)[0],
        transpose_solve=lambda _, b: _solution_and_determinant(a.swapaxes(-1, -2), b)[0],
    )


def solve_without_pivoting(a, b) -> jax.Array:
    """Solve ``a x = b`` without pivoting, for matrices whose symmetric part is positive definite.

    In a program of scalars the search for pivots would be most of the work. Batches broadcast.
    """
    if a.shape[-1] == 1:
        return b / a
    batch = jnp.broadcast_shapes(a.shape[:-2], b.shape[:-2])
    a, b = (jnp.broadcast_to(m, (*batch, *m.shape[-2:])) for m in (a, b))

    def eliminate_column(_, table):
        pivot_row = table[..., :1, :] / table[..., :1, :1]
        lower_rows = table[..., 1:, :] - table[..., 1:, :1] * pivot_row
        table = jnp.concatenate([lower_rows, pivot_row], axis=-2)[..., 1:]
        return jnp.concatenate([table, jnp.zeros_like(table[..., :1])], axis=-1)

    return jax.lax.fori_loop(0, a.shape[-1], eliminate_column, jnp.concatenate([a, b], axis=-1))[..., : b.shape[-1]]


def solve_lyapunov(g, c) -> jax.Array:
    """Solve ``g s + s g = c`` for symmetric s, with g and c symmetric of one or two rows, by Cayley and Hamilton's
    theorem."""
    if g.shape[-1] == 1:
        return c / (2.0 * g)
    (a, b), (_, d) = (tuple(g[..., i, j][..., None, None] for j in range(2)) for i in range(2))
    det, adjugate = a * d - b * b, jnp.block([[d, -b], [-b, a]])
    return (det * c + adjugate @ c @ adjugate) / (2.0 * (a + d) * det)


def inverse(a) -> jax.Array:
    """Return the inverse matrix; its entries are not finite if a is singular."""
    return solve(a, jnp.broadcast_to(np.eye(a.shape[-1], dtype=a.dtype), a.shape))


def conjugate_by_collocation_stages(B, w, A) -> jax.Array:
    """Return ``U_i w U_i^H``, shape (s, n, n), where the U_i are the collocation stages of ``U' = B U`` from U = 1.

    Multiples of the identity are removed from B: they change only the phase of U, and may be large.

    Parameters
    ----------
    B : array, shape (s, n, n)
        Skew-Hermitian matrices at the stages.
    w : array, shape (n, n)
    A : array, shape (s, s)
        The matrix of a Runge-Kutta method, times the step.
    """
    s, n = B.shape[:2]
    table = (A[:, None, :, None] * _remove_trace(B).swapaxes(0, 1)).reshape(s * n, s * n)
    solver = solve_without_pivoting if s == 1 else solve  # whose matrix is 1 less a skew-Hermitian one
    stages = solver(np.eye(s * n) - table, jnp.asarray(np.tile(np.eye(n, dtype=B.dtype), (s, 1)))).reshape(s, n, n)
    return stages @ w @ adjoint(stages)


def _remove_trace(a):
    """Return matrices, shape (..., n, n), minus the multiples of the identity with equal traces."""
    n = a.shape[-1]
    return a - (jnp.trace(a, axis1=-2, axis2=-1) / n)[..., None, None] * np.eye(n)


def inverse_dcayley(k, b) -> jax.Array:
    """Return ``k'`` for which ``U = (1 - k/2)^-1 (1 + k/2)`` moves by ``U' = B U``, for skew-Hermitian k and B, shape
    (n, n).

    The traces of k and B are removed, and k' has none: it moves U by B and a multiple of the identity, which
    changes only the phase of U.
    """
    half, identity = 0.5 * _remove_trace(k), np.eye(k.shape[-1])
    rate, square = (identity - half) @ _remove_trace(b) @ (identity + half), identity - half @ half
    return rate - (jnp.trace(rate) / jnp.trace(square)) * square


def spectral_radius(X) -> jax.Array:
    """Return the upper bound ``|X^64|^(1/64)`` on the moduli of the eigenvalues, which is little above the largest."""
    log_norm_sum = jnp.zeros(X.shape[:-2])
    for k in range(7):
        norm = jnp.sqrt((jnp.abs(X) ** 2).sum(axis=(-2, -1)))
        log_norm_sum = log_norm_sum + jnp.log(norm) / 2.0**k
        X = X / jnp.where(norm > 0.0, norm, 1.0)[..., None, None]
        X = X @ X
    return jnp.exp(log_norm_sum)


def determinant(a) -> jax.Array:
    """Return the determinant: by minors for at most three rows, else the signed product of the pivots."""
    if a.shape[-1] <= 3:
        row, *other_rows = jnp.moveaxis(a, (-2, -1), (0, 1))
        return _determinant_by_minors(row, *other_rows)
    det = _solution_and_determinant(a, a[..., :0])[1]
    # a matrix of numbers leads to NaN only by way of a pivot of zero
    return jnp.where(jnp.isnan(det) & jnp.isfinite(a).all(axis=(-2, -1)), 0.0, det)


def _determinant_by_minors(row, *other_rows):
    """Return the determinant of at most three rows, by minors."""
    if not other_rows:
        return row[0]
    if len(other_rows) == 1:
        return row[0] * other_rows[0][1] - row[1] * other_rows[0][0]
    (a, b, c), (d, e, f) = other_rows
    return row[0] * (b * f - c * e) + row[1] * (c * d - a * f) + row[2] * (a * e - b * d)


def skew_matrix(w, n: int) -> jax.Array:
    """Return the skew matrices with the entries w above the diagonal, row by row, shape (..., n, n)."""
    upper = jnp.zeros((*w.shape[:-1], n, n)).at[..., *np.triu_indices(n, 1)].add(w)
    return upper - upper.swapaxes(-1, -2)


def symmetric_matrix(w, n: int) -> jax.Array:
    """Return the symmetric matrices with the entries w on and above the diagonal, row by row, shape (..., n, n)."""
    indices = np.zeros((n, n), int)
    indices[np.triu_indices(n)] = np.arange(w.shape[-1])
    return w[..., np.maximum(indices, indices.T)]


def max_abs_entry(matrix) -> jax.Array:
    """Return the largest absolute value of the entries, shape (...)."""
    return jnp.abs(matrix).max(axis=(-2, -1))


def _one_norm(matrix) -> jax.Array:
    """Return the 1-norm, the largest sum of the absolute values in a column, shape (...)."""
    return jnp.abs(matrix).sum(axis=-2).max(axis=-1)


def _solution_and_determinant(a, b):
    """Return the solution of ``a x = b`` and the determinant of a.

    In each step the pivot column leaves the table on the left and the pivot row enters at the bottom, so that the
    program needs no variable indices.
    """
    m = a.shape[-1]
    row = np.arange(m)

    def eliminate_column(k, state):
        table, det = state
        column = table[..., 0]
        pivot_index = jnp.argmax(jnp.where(row < m - k, jnp.abs(column), -1.0), axis=-1)[..., None]
        is_pivot = (row == pivot_index)[..., None]
        pivot_row = jnp.where(is_pivot, table, 0.0).sum(axis=-2, keepdims=True)
        pivot = pivot_row[..., :1]
        pivot_row = pivot_row / pivot
        other_rows = jnp.where(is_pivot, table[..., :1, :], table)[..., 1:, :]
        table = jnp.concatenate([other_rows - other_rows[..., :1] * pivot_row, pivot_row], axis=-2)
        table = jnp.concatenate([table[..., 1:], jnp.zeros_like(table[..., :1])], axis=-1)
        return table, det * jnp.where(pivot_index == 0, pivot[..., 0], -pivot[..., 0])[..., 0]

    start = (jnp.concatenate([a, b], axis=-1), jnp.ones(a.shape[:-2], dtype=a.dtype))
    table, det = jax.lax.fori_loop(0, m, eliminate_column, start)
    return table[..., : b.shape[-1]], det


class BlockDiagonal(Module):
    """Linear map of a block diagonal matrix whose blocks may be repeated.

    Attributes
    ----------
    blocks : tuple
        Square matrices, or other linear maps that ``@`` applies to one vector.
    sizes, counts : tuple of int
        Rows of each block, and the number of its consecutive copies.
    """

    blocks: tuple[Any, ...]
    sizes: tuple[int, ...] = eqx.field(static=True)
    counts: tuple[int, ...] = eqx.field(static=True)

    def __matmul__(self, x) -> jax.Array:
        """Return the image of a vector, shape (n,)."""
        images, start = [], 0
        for block, size, count in zip(self.blocks, self.sizes, self.counts, strict=True):
            block_vectors = x[start : start + size * count].reshape(count, size)
            images.append(jax.vmap(lambda v, block=block: block @ v)(block_vectors).ravel())
            start += size * count
        return images[0] if len(images) == 1 else jnp.concatenate(images)


class Diagonal(Module):
    """Linear map of a diagonal matrix; ``entries`` has shape (n,), or () for a multiple of the identity."""

    entries: jax.Array

    def __matmul__(self, x) -> jax.Array:
        return self.entries * x
