"""Matrix exponential and Cayley's map."""

from __future__ import annotations

import math
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from .chains import chain
from .linear import _one_norm, max_abs_entry, solve

CAYLEY_CONDITION_LIMIT = 1e12
"""Condition number of I - X/2 above which X counts as a pole of the Cayley map."""


def expm(X) -> jax.Array:
    """Return the matrix exponential: [13/13] Padé approximant with scaling and squaring [Higham 2005].

    Derivatives of every order, in both modes, are blocks of the exponential of a larger matrix (:mod:`.chains`).
    ``jax.scipy.linalg.expm`` (0.10) rounds the number of squarings down, not up, and so loses up to eight digits at
    norms above 5.4. This function takes norms up to 3e5; larger ones give NaN.
    """
    return chain(Exponential(), [jnp.asarray(X)], (0,), np.zeros(1))


@dataclass(frozen=True)
class Exponential:
    """Exponential of any matrix, with its chains: see :class:`.chains.MatrixFunction`."""

    def decompose(self, a, unrolled: bool) -> tuple[jax.Array, ...]:
        return (a,)

    def chain(self, decompositions, slots, shifts, directions, unrolled: bool) -> jax.Array:
        """Return the last block of the first row of the exponential of a matrix with the directions beside its
        diagonal.

        The directions are scaled to the size of the matrices, so that they need no more squarings [Al-Mohy & Higham
        2009].
        """
        matrices = [a for (a,) in decompositions]
        k, dtype = len(directions), matrices[0].dtype
        diagonal = [
            matrices[slot] + shifts[..., j, None, None].astype(dtype) * np.eye(matrices[slot].shape[-1])
            for j, slot in enumerate(slots)
        ]
        if k == 0:
            return _pade_exponential(diagonal[0], unrolled)
        scales = [max_abs_entry(E)[..., None, None] for E in directions]
        scales = [jnp.where(size > 0.0, size, 1.0) for size in scales]
        batch = jnp.broadcast_shapes(*(a.shape[:-2] for a in (*diagonal, *directions)))
        rows = []
        for i, a in enumerate(diagonal):
            blocks = [jnp.zeros((*batch, a.shape[-1], b.shape[-1]), dtype) for b in diagonal]
            blocks[i] = jnp.broadcast_to(a, (*batch, *a.shape[-2:]))
            if i < k:
                E = directions[i] / scales[i]
                blocks[i + 1] = jnp.broadcast_to(E, (*batch, *E.shape[-2:]))
            rows.append(jnp.concatenate(blocks, axis=-1))
        block_exponential = _pade_exponential(jnp.concatenate(rows, axis=-2), unrolled)
        last_block = block_exponential[..., : diagonal[0].shape[-1], -diagonal[-1].shape[-1] :]
        for scale in scales:
            last_block = last_block * scale
        return last_block


def _pade_exponential(X, is_unrolled: bool) -> jax.Array:
    identity = np.eye(X.shape[-1])
    squarings = jnp.ceil(jnp.log2(jnp.maximum(_one_norm(X) / _PADE_RADIUS, 1.0)))[..., None, None]
    Y, b = X / 2.0**squarings, _PADE_COEFFICIENTS
    Y2 = Y @ Y
    Y4 = Y2 @ Y2
    Y6 = Y4 @ Y2
    odd_terms = Y @ (Y6 @ (b[13] * Y6 + b[11] * Y4 + b[9] * Y2) + b[7] * Y6 + b[5] * Y4 + b[3] * Y2 + b[1] * identity)
    even_terms = Y6 @ (b[12] * Y6 + b[10] * Y4 + b[8] * Y2) + b[6] * Y6 + b[4] * Y4 + b[2] * Y2 + b[0] * identity
    quotient = jnp.linalg.solve if is_unrolled else solve
    g = identity + 2 * quotient(even_terms - odd_terms, odd_terms)  # not (even + odd): keeps the digits of a small X

    def square(state):
        k, g = state
        return k + 1.0, jnp.where(k < squarings, g @ g, g)

    n_squarings = jnp.minimum(jnp.max(squarings), _MAX_SQUARINGS)
    g = jax.lax.while_loop(lambda state: state[0] < n_squarings, square, (jnp.zeros(()), g))[1]
    return jnp.where(squarings <= _MAX_SQUARINGS, g, jnp.nan)


_PADE_RADIUS = 5.371920351148152
"""Largest 1-norm at which the [13/13] approximant is accurate to rounding [Higham 2005]."""
_PADE_COEFFICIENTS = [math.comb(13, k) * math.factorial(26 - k) / math.factorial(26) for k in range(14)]
_MAX_SQUARINGS = 16
"""Largest number of squarings, for norms up to 3e5."""


def cayley_of(X) -> jax.Array:
    """Return ``I + (I - X/2)^-1 X``, NaN where I - X/2 is singular."""
    identity = jnp.eye(X.shape[-1])
    denominator = identity - X / 2
    g = identity + solve(denominator, X)
    condition = max_abs_entry(denominator) * max_abs_entry(identity + g) / 2  # I + g = 2 (I - X/2)^-1
    return jnp.where((condition < CAYLEY_CONDITION_LIMIT)[..., None, None], g, jnp.nan)
