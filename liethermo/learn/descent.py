"""The optimiser of a fit: SOAP, which is Adam in the eigenvectors of each layer's gradients."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

MEAN_DECAY = 0.95
"""Decay per step of the running means of gradients, of their squares and of their products, for matrices."""

ADAM_DECAYS = 0.9, 0.99
"""Decays per step of the running means of gradients and of their squares, for parameters outside of matrices (Adam)."""

STEPS_PER_EIGENBASIS = 10
"""Number of steps between two updates of the eigenvectors."""

MAX_PRECONDITIONED_DIM = 256
"""Largest number of rows or columns of a preconditioned matrix; for larger ones eigenvectors cost more than they
gain."""

ADAM_EPSILON = 1e-8
"""Number added to the root of the mean squares, as in Adam."""


def soap_optimiser(array_shapes: Sequence[tuple[int, ...]], learning_rate: Callable) -> Any:
    """Return the optax optimiser SOAP [Vyas et al. 2025] for a parameter vector.

    The gradient of a weight matrix W is rotated into the eigenvectors of the running means of ``G G^T`` and ``G^T G``,
    which separate steep from flat directions of a layer. Adam works in these coordinates. All other parameters are
    updated by Adam directly.

    Parameters
    ----------
    array_shapes : sequence of tuple of int
        Shapes of the arrays at the start of the vector; the rest of the vector is one more array.
    learning_rate : function from the number of a step to a number
        Learning rate.
    """
    import optax

    ends = list(itertools.accumulate(map(math.prod, array_shapes)))
    matrices = [
        (slice(end - math.prod(shape), end), shape)
        for end, shape in zip(ends, array_shapes, strict=True)
        if len(shape) == 2 and min(shape) > 1 and max(shape) <= MAX_PRECONDITIONED_DIM
    ]

    def mean_and_square_decays(n_parameters: int) -> tuple[np.ndarray, np.ndarray]:
        mean_decays, square_decays = (np.full(n_parameters, decay) for decay in ADAM_DECAYS)
        for indices, _ in matrices:
            mean_decays[indices] = square_decays[indices] = MEAN_DECAY
        return mean_decays, square_decays

    def init(vector):
        zero = jnp.zeros_like(vector)
        bases_and_means = [[(jnp.eye(n), jnp.zeros((n, n))) for n in shape] for _, shape in matrices]
        return jnp.zeros((), int), zero, zero, bases_and_means

    def update(gradient, state, vector=None):
        count, mean, square, bases_and_means = state
        grams = [_left_and_right_gram_matrices(gradient[indices].reshape(shape)) for indices, shape in matrices]
        means = [
            [MEAN_DECAY * S + (1.0 - MEAN_DECAY) * P for (_, S), P in zip(pair, products, strict=True)]
            for pair, products in zip(bases_and_means, grams, strict=True)
        ]
        mean_decays, square_decays = mean_and_square_decays(gradient.size)
        rotated_slope, mean = (
            _rotate_matrices(gradient, matrices, bases_and_means),
            mean_decays * mean + (1.0 - mean_decays) * gradient,
        )
        square = square_decays * square + (1.0 - square_decays) * rotated_slope**2
        step = _rotate_matrices(mean / (1.0 - mean_decays ** (count + 1.0)), matrices, bases_and_means)
        step = step / (jnp.sqrt(square / (1.0 - square_decays ** (count + 1.0))) + ADAM_EPSILON)
        step = _rotate_matrices(step, matrices, [[(Q.T, S) for Q, S in pair] for pair in bases_and_means])

        def update_bases(_):
            return [[_update_eigenbasis(count, Q, S) for (Q, _), S in zip(pair, gram_means, strict=True)]
                    for pair, gram_means in zip(bases_and_means, means, strict=True)]  # fmt: skip

        def keep_bases(_):
            return [[Q for Q, _ in pair] for pair in bases_and_means]

        bases = jax.lax.cond(count % STEPS_PER_EIGENBASIS == 0, update_bases, keep_bases, None)
        bases_and_means = [list(zip(*basis_and_mean, strict=True)) for basis_and_mean in zip(bases, means, strict=True)]
        return -learning_rate(count) * step, (count + 1, mean, square, bases_and_means)

    return optax.GradientTransformation(init, update)


def _left_and_right_gram_matrices(gradient_matrix: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return the Gram matrices ``G G^T`` and ``G^T G`` of the gradient G by a weight matrix."""
    return gradient_matrix @ gradient_matrix.T, gradient_matrix.T @ gradient_matrix


def _rotate_matrices(vector: jax.Array, matrix_slices: Sequence, basis_pairs: Sequence) -> jax.Array:
    """Return a vector in which each weight-matrix block G is replaced by ``Q^T G R``, Q and R its eigenbases."""
    for (indices, shape), ((Q, _), (R, _)) in zip(matrix_slices, basis_pairs, strict=True):
        vector = vector.at[indices].set((Q.T @ vector[indices].reshape(shape) @ R).ravel())
    return vector


def _update_eigenbasis(step_index: jax.Array, basis: jax.Array, gram_mean: jax.Array) -> jax.Array:
    """Return eigenvectors of ``gram_mean``, shape (n, n): exact at step 0, then iterated from ``basis``."""
    exact_basis = lambda: jnp.linalg.eigh(gram_mean)[1][:, ::-1]  # noqa: E731
    return jax.lax.cond(step_index == 0, exact_basis, lambda: jnp.linalg.qr(gram_mean @ basis)[0])
