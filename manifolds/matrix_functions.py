"""Exponential, logarithm and Cayley map of any square matrix; batches on leading axes."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp

from .lie_algebra import LieAlgebra

CAYLEY_CONDITION_LIMIT = 1e12
"""Condition number of I - X/2 above which X counts as a pole of the Cayley map."""


def matrix_exp(X) -> jax.Array:
    """Matrix exponential, shape (..., m, m), by the [13/13] Padé approximant with scaling and squaring [Higham 2005].

    ``jax.scipy.linalg.expm`` (0.10) rounds the number of squarings down and so loses up to eight digits at norms
    from 5.4 to 11. Norms above 2**19 give NaN.
    """
    identity = jnp.eye(X.shape[-1])
    squarings = jnp.ceil(jnp.log2(jnp.maximum(_norm(jax.lax.stop_gradient(X)) / _PADE_RADIUS, 1.0)))[
        ..., None, None
    ]
    Y = X / 2.0**squarings
    b = _PADE
    Y2 = Y @ Y
    Y4 = Y2 @ Y2
    Y6 = Y4 @ Y2
    odd = Y @ (
        Y6 @ (b[13] * Y6 + b[11] * Y4 + b[9] * Y2) + b[7] * Y6 + b[5] * Y4 + b[3] * Y2 + b[1] * identity
    )
    even = Y6 @ (b[12] * Y6 + b[10] * Y4 + b[8] * Y2) + b[6] * Y6 + b[4] * Y4 + b[2] * Y2 + b[0] * identity
    g = identity + 2 * jnp.linalg.solve(even - odd, odd)

    def square(g, k):
        return jnp.where(k < squarings, g @ g, g), None

    g, _ = jax.lax.scan(square, g, jnp.arange(_MOST_SQUARINGS))
    return jnp.where(squarings <= _MOST_SQUARINGS, g, jnp.nan)


_PADE_RADIUS = 5.371920351148152
_MOST_SQUARINGS = 16
_PADE = [math.factorial(26 - k) / (math.factorial(13 - k) * math.factorial(k)) / 1e9 for k in range(14)]


def general_exp(algebra: LieAlgebra, x) -> jax.Array:
    """``matrix_exp(hat(x))``."""
    return matrix_exp(algebra.hat(x))


def general_cayley(algebra: LieAlgebra, x) -> jax.Array:
    """``I + (I - X/2)^-1 X``, NaN where I - X/2 is singular."""
    X = algebra.hat(x)
    identity = jnp.eye(X.shape[-1])
    denominator = identity - X / 2
    g = identity + jnp.linalg.solve(denominator, X)
    condition = largest(denominator) * largest(identity + g) / 2  # I + g = 2 (I - X/2)^-1
    return jnp.where((condition < CAYLEY_CONDITION_LIMIT)[..., None, None], g, jnp.nan)


def general_log(algebra: LieAlgebra, g) -> jax.Array:
    """Square roots until g is near I, ``log s = 2 artanh (s - I)(s + I)^-1``, and one Newton step on ``exp(x) = g``.

    The artanh keeps to the algebra of a group defined by a quadratic form. The Newton step, taken in components,
    removes the rounding that the square roots amplify.
    """
    identity = jnp.eye(g.shape[-1], dtype=g.dtype)

    def far(state):
        root, _, converged = state
        return converged & (_norm(root - identity) > 0.25)

    def halve(state):
        root, halvings, converged = state
        new, success = _square_root(root)
        act = far(state)
        return (jnp.where(act[..., None, None], new, root), halvings + act, converged & (success | ~act))

    batch = g.shape[:-2]
    size = jnp.linalg.slogdet(g).logabsdet[..., None, None] / g.shape[-1]
    start = (g / jnp.exp(size), jnp.zeros(batch, dtype=jnp.int32), jnp.ones(batch, dtype=bool))
    root, halvings, converged = jax.lax.while_loop(lambda state: far(state).any(), halve, start)
    Z = jnp.linalg.solve(root + identity, root - identity)
    Z2, series = Z @ Z, jnp.zeros_like(g)
    for k in reversed(range(9)):  # |Z| < 1/7: the first term left out is below 1e-16 |Z|
        series = identity / (2 * k + 1) + Z2 @ series
    x = algebra.vee(size * identity + 2.0 ** (halvings + 1.0)[..., None, None] * Z @ series)
    remainder = algebra.vee(matrix_exp(algebra.hat(-x)) @ g - identity)
    x = x + jnp.linalg.solve(dexp(algebra, x), remainder[..., None])[..., 0]
    return jnp.where(converged[..., None], x, jnp.nan)


def _square_root(a):
    """Principal square root and whether it converged: the iteration of Denman and Beavers [Higham 2008, eq. 6.15].

    Next to the negative axis each step doubles the angle that is left and the rounding error is divided by it.
    """

    def unfinished(state):
        _, _, change, steps = state
        return ((change > 1e-8) & (steps < _MOST_ROOT_STEPS)).any()

    def newton(state):
        root, inverse_root, _, steps = state
        new = (root + jnp.linalg.inv(inverse_root)) / 2
        change = largest(new - root) / largest(new)  # quadratic: a step of 1e-8 ends at rounding
        return new, (inverse_root + jnp.linalg.inv(root)) / 2, change, steps + 1

    identity = jnp.broadcast_to(jnp.eye(a.shape[-1], dtype=a.dtype), a.shape)
    start = (a, identity, jnp.full(a.shape[:-2], jnp.inf), 0)
    root, _, change, _ = jax.lax.while_loop(unfinished, newton, start)
    return root, change <= 1e-8


_MOST_ROOT_STEPS = 33
"""So many steps reach the angle pi - HALF_TURN_MARGIN; nearer pi the square root counts as not converged."""


def dexp(algebra: LieAlgebra, x):
    """Left-trivialised derivative of exp, ``int_0^1 exp(-s ad x) ds``: a corner of a larger exponential."""
    ad, one = algebra.ad(x), jnp.broadcast_to(jnp.eye(algebra.dim), (*x.shape, algebra.dim))
    top = jnp.concatenate([-ad, one], axis=-1)
    return matrix_exp(jnp.concatenate([top, jnp.zeros_like(top)], axis=-2))[..., : algebra.dim, algebra.dim :]


def largest(matrix) -> jax.Array:
    """Largest absolute value of the entries."""
    return jnp.abs(matrix).max(axis=(-2, -1))


def _norm(matrix) -> jax.Array:
    return jnp.abs(matrix).sum(axis=-2).max(axis=-1)
