"""The exponential, and Cayley's map."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp

from .linear import _norm, largest, solve

CAYLEY_CONDITION_LIMIT = 1e12
"""Condition number of I - X/2 above which X counts as a pole of the Cayley map."""


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


def cayley_of(X) -> jax.Array:
    """``I + (I - X/2)^-1 X``, NaN where I - X/2 is singular."""
    identity = jnp.eye(X.shape[-1])
    denominator = identity - X / 2
    g = identity + solve(denominator, X)
    condition = largest(denominator) * largest(identity + g) / 2  # I + g = 2 (I - X/2)^-1
    return jnp.where((condition < CAYLEY_CONDITION_LIMIT)[..., None, None], g, jnp.nan)
