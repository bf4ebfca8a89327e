"""The descent of a fit: Adam, for matrices in the eigenvectors of what their gradients are like."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

MEAN_DECAY = 0.95
"""The share of a mean of gradients, of their squares or of their products that is kept from step to step."""

ADAM_DECAYS = 0.9, 0.99
"""The same of means of gradients and of their squares, of numbers outside matrices, for which Adam is run."""

STEPS_PER_EIGENBASIS = 10
"""Steps between two looks at the eigenvectors."""

MAX_PRECONDITIONED_DIM = 256
"""Rows or columns of a matrix that is turned: of more, eigenvectors cost more than they bring."""

ADAM_EPSILON = 1e-8
"""What is added to the sizes of gradients, as in Adam."""


def soap_optimiser(shapes: Sequence[tuple[int, ...]], rate: Callable) -> Any:
    """An optimiser of optax for a vector: SOAP [Vyas et al. 2025].

    The gradient of a matrix W of weights is turned into the eigenvectors of the means of ``G G^T`` and ``G^T G``. Adam
    works there: the directions in which a layer is steep and flat are apart. All other numbers are left to Adam.

    Parameters
    ----------
    shapes : sequence of tuple of int
        Of the arrays that the vector begins with; what is behind them is one array more.
    rate : function from the number of a step to a number
    """
    import optax

    ends = list(itertools.accumulate(map(math.prod, shapes)))
    matrices = [
        (slice(end - math.prod(shape), end), shape)
        for end, shape in zip(ends, shapes, strict=True)
        if len(shape) == 2 and min(shape) > 1 and max(shape) <= MAX_PRECONDITIONED_DIM
    ]

    def moment_decays(size: int) -> tuple[np.ndarray, np.ndarray]:
        first, second = (np.full(size, memory) for memory in ADAM_DECAYS)
        for at, _ in matrices:
            first[at] = second[at] = MEAN_DECAY
        return first, second

    def init(vector):
        zero = jnp.zeros_like(vector)
        sides = [[(jnp.eye(n), jnp.zeros((n, n))) for n in shape] for _, shape in matrices]
        return jnp.zeros((), int), zero, zero, sides

    def update(slope, state, vector=None):
        count, mean, square, sides = state
        means = [[MEAN_DECAY * S + (1.0 - MEAN_DECAY) * P for (_, S), P in zip(pair, _gram_matrices(slope[at].reshape(shape)),
                  strict=True)] for (at, shape), pair in zip(matrices, sides, strict=True)]  # fmt: skip
        first, second = moment_decays(slope.size)
        turned, mean = _rotate_matrices(slope, matrices, sides), first * mean + (1.0 - first) * slope
        square = second * square + (1.0 - second) * turned**2
        step = _rotate_matrices(mean / (1.0 - first ** (count + 1.0)), matrices, sides)
        step = step / (jnp.sqrt(square / (1.0 - second ** (count + 1.0))) + ADAM_EPSILON)
        step = _rotate_matrices(step, matrices, [[(Q.T, S) for Q, S in pair] for pair in sides])

        def update_bases(_):
            return [[_update_eigenvectors(count, Q, S) for (Q, _), S in zip(pair, own, strict=True)]
                    for pair, own in zip(sides, means, strict=True)]  # fmt: skip

        def keep_bases(_):
            return [[Q for Q, _ in pair] for pair in sides]

        turns = jax.lax.cond(count % STEPS_PER_EIGENBASIS == 0, update_bases, keep_bases, None)
        sides = [list(zip(*both, strict=True)) for both in zip(turns, means, strict=True)]
        return -rate(count) * step, (count + 1, mean, square, sides)

    return optax.GradientTransformation(init, update)


def _gram_matrices(G: jax.Array) -> tuple[jax.Array, jax.Array]:
    return G @ G.T, G.T @ G


def _rotate_matrices(vector: jax.Array, matrices: Sequence, sides: Sequence) -> jax.Array:
    """``Q^T G R`` in place of each matrix G."""
    for (at, shape), ((Q, _), (R, _)) in zip(matrices, sides, strict=True):
        vector = vector.at[at].set((Q.T @ vector[at].reshape(shape) @ R).ravel())
    return vector


def _update_eigenvectors(count: jax.Array, Q: jax.Array, S: jax.Array) -> jax.Array:
    """Those of S: at first, and then one step of orthogonal iteration from those so far."""
    return jax.lax.cond(count == 0, lambda: jnp.linalg.eigh(S)[1][:, ::-1], lambda: jnp.linalg.qr(S @ Q)[0])
