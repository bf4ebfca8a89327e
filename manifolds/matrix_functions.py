"""Exponential, logarithm, Cayley map and linear solves for small square matrices; leading axes are batches."""

from __future__ import annotations

import math
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np

from .lie_algebra import LieAlgebra

CAYLEY_CONDITION_LIMIT = 1e12
"""Condition number of I - X/2 above which X counts as a pole of the Cayley map."""


def exp(algebra: LieAlgebra, x) -> jax.Array:
    """``expm(hat(x))``."""
    return expm(algebra.hat(x))


def expm(X) -> jax.Array:
    """Matrix exponential: [13/13] Padé approximant with scaling and squaring [Higham 2005].

    ``jax.scipy.linalg.expm`` (0.10) rounds the number of squarings down, not up, and so loses up to eight digits at
    norms above 5.4. Here norms up to 3e5 are exponentiated and larger ones give NaN.
    """
    identity = jnp.eye(X.shape[-1])
    squarings = jnp.ceil(jnp.log2(jnp.maximum(_norm(jax.lax.stop_gradient(X)) / _PADE_RADIUS, 1.0)))[..., None, None]
    Y, b = X / 2.0**squarings, _PADE
    Y2 = Y @ Y
    Y4 = Y2 @ Y2
    Y6 = Y4 @ Y2
    odd = Y @ (Y6 @ (b[13] * Y6 + b[11] * Y4 + b[9] * Y2) + b[7] * Y6 + b[5] * Y4 + b[3] * Y2 + b[1] * identity)
    even = Y6 @ (b[12] * Y6 + b[10] * Y4 + b[8] * Y2) + b[6] * Y6 + b[4] * Y4 + b[2] * Y2 + b[0] * identity
    g = identity + 2 * solve(even - odd, odd)  # not (even + odd): keeps the digits of a small X

    def square(g, k):
        return jnp.where(k < squarings, g @ g, g), None

    g, _ = jax.lax.scan(square, g, jnp.arange(_MOST_SQUARINGS))
    return jnp.where(squarings <= _MOST_SQUARINGS, g, jnp.nan)


_PADE_RADIUS = 5.371920351148152
_PADE = [math.comb(13, k) * math.factorial(26 - k) / math.factorial(26) for k in range(14)]
_MOST_SQUARINGS = 16


def dexp(algebra: LieAlgebra, x) -> jax.Array:
    """Left-trivialised derivative of exp, ``int_0^1 exp(-s ad x) ds``: a block of a larger exponential [Van Loan 1978].

    ``d exp(x) = exp(x) hat(dexp(x) dx)``; shape (..., dim, dim).
    """
    ad, one = algebra.ad(x), jnp.broadcast_to(jnp.eye(algebra.dim), (*x.shape, algebra.dim))
    top = jnp.concatenate([-ad, one], axis=-1)
    return expm(jnp.concatenate([top, jnp.zeros_like(top)], axis=-2))[..., : algebra.dim, algebra.dim :]


def cayley(algebra: LieAlgebra, x) -> jax.Array:
    """:func:`cayley_of` hat(x)."""
    return cayley_of(algebra.hat(x))


def cayley_of(X) -> jax.Array:
    """``I + (I - X/2)^-1 X``, NaN where I - X/2 is singular."""
    identity = jnp.eye(X.shape[-1])
    denominator = identity - X / 2
    g = identity + solve(denominator, X)
    condition = largest(denominator) * largest(identity + g) / 2  # I + g = 2 (I - X/2)^-1
    return jnp.where((condition < CAYLEY_CONDITION_LIMIT)[..., None, None], g, jnp.nan)


def inverse_cayley(algebra: LieAlgebra, g) -> jax.Array:
    """``2 (g + I)^-1 (g - I)`` in components, NaN where g + I is singular."""
    identity = jnp.eye(g.shape[-1])
    x = algebra.vee(2 * solve(g + identity, g - identity))
    condition = largest(g + identity) * largest(identity - algebra.hat(x) / 2) / 2  # 2 (g + I)^-1 = I - X/2
    return jnp.where((condition < CAYLEY_CONDITION_LIMIT)[..., None], x, jnp.nan)


def adjoint_cayley(algebra: LieAlgebra, x) -> jax.Array:
    """``exp(y)`` with ``exp(ad y) = cay(ad x)``, for any algebra where there is such a y, x its part in the centre.

    ``ad y = 2 artanh(A/2) = int_0^1 A (I - t^2 A^2/4)^-1 dt`` with A = ad(x), by Gauss quadrature: right to rounding
    where the eigenvalues of A are imaginary and below 3, or real and below 1.5; to 1e-13 at 4, and to 1e-11 at 1.8.
    """
    adjoint, identity = _adjoint(algebra), jnp.eye(algebra.dim)
    A = adjoint.hat(x)[..., None, :, :]
    parts = solve_near_identity(identity - _NODES[:, None, None] ** 2 / 4 * (A @ A), A + jnp.zeros((len(_NODES), 1, 1)))
    return exp(algebra, adjoint.vee((_WEIGHTS[:, None, None] * parts).sum(axis=-3)) + central(algebra, x))


_NODES, _WEIGHTS = (a[16:] for a in np.polynomial.legendre.leggauss(32))


def from_adjoint_cayley(algebra: LieAlgebra, g) -> jax.Array:
    """The components x, none in the centre, with ``cay(ad x) = g``, for g of the size of the algebra, near I."""
    identity = jnp.eye(algebra.dim)
    return _adjoint(algebra).vee(2 * solve_near_identity(g + identity, g - identity))


def central(algebra: LieAlgebra, x) -> jax.Array:
    """The part of x in the centre of the algebra, the one orthogonal to it left out."""
    adjoint = _adjoint(algebra)
    return x - adjoint.vee(adjoint.hat(x))


@cache
def _adjoint(algebra: LieAlgebra) -> LieAlgebra:
    """The algebra with the matrices ad(e_a); ``vee`` finds the components with none in the centre."""
    constants = algebra.structure_constants
    return LieAlgebra(constants, name=f"ad({algebra.name})", basis=constants.swapaxes(1, 2))


def log(algebra: LieAlgebra, g) -> jax.Array:
    """Principal logarithm in components, NaN where an eigenvalue is on or next to the negative axis.

    Square roots until s is near I; then ``log s = 2 artanh (s - I)(s + I)^-1``, which keeps to the algebra of a group
    with a quadratic form; then one Newton step on ``exp(x) = g`` in components, which removes the rounding that the
    roots amplify.
    """
    identity, batch = jnp.eye(g.shape[-1], dtype=g.dtype), g.shape[:-2]

    def far(state):
        s, _, converged = state
        return converged & (_norm(s - identity) > 0.25)

    def halve(state):
        s, halvings, converged = state
        root, _, success = _square_root(s)
        act = far(state)
        return jnp.where(act[..., None, None], root, s), halvings + act, converged & (success | ~act)

    size = jnp.log(jnp.abs(determinant(g)))[..., None, None] / g.shape[-1]
    start = (g / jnp.exp(size), jnp.zeros(batch), jnp.ones(batch, dtype=bool))
    s, halvings, converged = jax.lax.while_loop(lambda state: far(state).any(), halve, start)
    Z = solve(s + identity, s - identity)
    Z2, series = Z @ Z, jnp.zeros_like(g)
    for k in reversed(range(9)):  # |Z| < 1/7, so the first term left out is below rounding
        series = identity / (2 * k + 1) + Z2 @ series
    x = algebra.vee(size * identity + 2.0 ** (halvings + 1.0)[..., None, None] * Z @ series)
    remainder = algebra.vee(expm(algebra.hat(-x)) @ g - identity)
    x = x + solve(dexp(algebra, x), remainder[..., None])[..., 0]
    return jnp.where(converged[..., None], x, jnp.nan)


def polar(a) -> jax.Array:
    """Nearest matrix with orthonormal columns, ``a (a^H a)^-1/2``, shape (..., n, p); NaN where the rank is below p."""
    _, inverse_root, success = _square_root(a.conj().swapaxes(-1, -2) @ a)
    u = a @ inverse_root
    for _ in range(2):  # the root squares the condition number of a
        u = orthonormalized(u)
    success &= largest(u.conj().swapaxes(-1, -2) @ u - jnp.eye(a.shape[-1])) < 1e-12
    return jnp.where(success[..., None, None], u, jnp.nan)


def orthonormalized(u) -> jax.Array:
    """One step of Newton and Schulz towards :func:`polar`: it squares the distance of ``u^H u`` from I."""
    return 1.5 * u - 0.5 * u @ (u.conj().swapaxes(-1, -2) @ u)


def complement(u) -> jax.Array:
    """Columns that complete the orthonormal ones of u, shape (..., n, p), to a basis, shape (..., n, n - p).

    By Householder reflections, which take u to the first axes; smooth where none of its pivots changes sign.
    """
    n, p = u.shape[-2:]
    axes, normals = jnp.eye(n), []

    def reflect(a, normal):
        normal = normal[..., :, None]
        weights = (normal * a).sum(axis=-2, keepdims=True) * (2 / (normal**2).sum(axis=-2, keepdims=True))
        return a - normal * weights

    for k in range(p):
        column = jnp.where(jnp.arange(n) < k, 0.0, u[..., :, k])
        size = jnp.sqrt((column**2).sum(axis=-1, keepdims=True))
        normals.append(column + jnp.where(column[..., k : k + 1] < 0, -size, size) * axes[k])
        u = reflect(u, normals[-1])
    rest = axes[:, p:]
    for normal in reversed(normals):
        rest = reflect(rest, normal)
    return rest


def _square_root(a):
    """Principal square root, its inverse, whether they converged: Denman and Beavers' iteration.

    The iterates (y, z) tend to (a^1/2, a^-1/2) [Higham 2008, eq. 6.15]. An eigenvalue at the angle pi - d costs
    log2(1/d) steps more and loses as many bits.
    """

    def unfinished(state):
        _, change, steps = state
        return ((change > 1e-8) & (steps < _MOST_ROOT_STEPS)).any()

    def newton(state):
        roots, _, steps = state
        new = (roots + inverse(roots[::-1])) / 2
        return new, largest(new[0] - roots[0]) / largest(new[0]), steps + 1

    roots = jnp.stack([a, jnp.broadcast_to(jnp.eye(a.shape[-1], dtype=a.dtype), a.shape)])
    roots, change, _ = jax.lax.while_loop(unfinished, newton, (roots, jnp.full(a.shape[:-2], jnp.inf), 0))
    return *roots, change <= 1e-8  # quadratic convergence: a step of 1e-8 ends at rounding


_MOST_ROOT_STEPS = 33
"""Enough for every angle up to pi - HALF_TURN_MARGIN, and little more."""


def solve(a, b) -> jax.Array:
    """Solution x of ``a x = b``, shapes (..., m, m) and (..., m, k): Gauss-Jordan elimination with partial pivoting.

    Plain array operations, on purpose. ``jnp.linalg.solve`` calls LAPACK, and on a CPU two calls that do not depend on
    each other, in one compiled program, can wait for each other forever (jax 0.10.2, batches from about 1000).
    """
    return jax.lax.custom_linear_solve(
        lambda x: a @ x,
        b,
        solve=lambda _, b: _eliminate(a, b)[0],
        transpose_solve=lambda _, b: _eliminate(a.swapaxes(-1, -2), b)[0],
    )


def solve_near_identity(a, b) -> jax.Array:
    """Solution x of ``a x = b`` without a search for pivots, for matrices whose symmetric part is positive definite.

    In a program of scalars that search is most of the work.
    """

    def step(_, table):
        pivot_row = table[..., :1, :] / table[..., :1, :1]
        rest = table[..., 1:, :] - table[..., 1:, :1] * pivot_row
        table = jnp.concatenate([rest, pivot_row], axis=-2)[..., 1:]
        return jnp.concatenate([table, jnp.zeros_like(table[..., :1])], axis=-1)

    return jax.lax.fori_loop(0, a.shape[-1], step, jnp.concatenate([a, b], axis=-1))[..., : b.shape[-1]]


def inverse(a) -> jax.Array:
    """Inverse matrix, with entries that are not finite where a is singular."""
    return solve(a, jnp.broadcast_to(jnp.eye(a.shape[-1], dtype=a.dtype), a.shape))


def spectral_radius(X) -> jax.Array:
    """Upper bound ``|X^64|^(1/64)`` on the size of the eigenvalues, and little above it."""
    total = jnp.zeros(X.shape[:-2])
    for k in range(7):
        size = jnp.sqrt((jnp.abs(X) ** 2).sum(axis=(-2, -1)))
        total = total + jnp.log(size) / 2.0**k
        X = X / jnp.where(size > 0.0, size, 1.0)[..., None, None]
        X = X @ X
    return jnp.exp(total)


def determinant(a) -> jax.Array:
    """Determinant, the signed product of the pivots."""
    det = _eliminate(a, a[..., :0])[1]
    # a matrix of numbers leads to NaN only by way of a pivot of zero
    return jnp.where(jnp.isnan(det) & jnp.isfinite(a).all(axis=(-2, -1)), 0.0, det)


def largest(matrix) -> jax.Array:
    """Largest absolute value of the entries."""
    return jnp.abs(matrix).max(axis=(-2, -1))


def _norm(matrix) -> jax.Array:
    return jnp.abs(matrix).sum(axis=-2).max(axis=-1)


def _eliminate(a, b):
    """Solution of ``a x = b`` and determinant of a.

    In each step the pivot column leaves the table on the left and the pivot row enters at the bottom, so that the
    program needs no indices that vary.
    """
    m = a.shape[-1]
    row = jnp.arange(m)

    def step(k, state):
        table, det = state
        column = table[..., 0]
        best = jnp.argmax(jnp.where(row < m - k, jnp.abs(column), -1.0), axis=-1)[..., None]
        chosen = (row == best)[..., None]
        pivot_row = jnp.where(chosen, table, 0.0).sum(axis=-2, keepdims=True)
        pivot = pivot_row[..., :1]
        pivot_row = pivot_row / pivot
        rest = jnp.where(chosen, table[..., :1, :], table)[..., 1:, :]
        table = jnp.concatenate([rest - rest[..., :1] * pivot_row, pivot_row], axis=-2)
        table = jnp.concatenate([table[..., 1:], jnp.zeros_like(table[..., :1])], axis=-1)
        return table, det * jnp.where(best == 0, pivot[..., 0], -pivot[..., 0])[..., 0]

    start = (jnp.concatenate([a, b], axis=-1), jnp.ones(a.shape[:-2], dtype=a.dtype))
    table, det = jax.lax.fori_loop(0, m, step, start)
    return table[..., : b.shape[-1]], det
