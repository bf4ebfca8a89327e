"""What elements of an algebra do: one to many others, and many to as many others."""

from __future__ import annotations

from functools import partial
from typing import Protocol

import jax
import jax.numpy as jnp
import numpy as np

from .._arrays import stack_columns

MAX_UNROLLED_TERMS = 64
"""Structure constants other than zero up to which the bracket of many copies is written out, term by term."""


class Action(Protocol):
    """What one element x does to others, with what these have in common computed once: see :meth:`LieAlgebra.action`.

    Arrays have the shape (dim,).
    """

    def bracket(self, y) -> jax.Array: ...
    def ad_star(self, mu) -> jax.Array: ...


class Operator(Protocol):
    """A linear map: a matrix, or what acts like one."""

    def __matmul__(self, other) -> jax.Array: ...


class AdMatrixAction:
    """The action of x by the matrix of ``ad_x``."""

    def __init__(self, ad):
        self.ad = ad

    def bracket(self, y) -> jax.Array:
        return self.ad @ y

    def ad_star(self, mu) -> jax.Array:
        return self.ad.T @ mu


def nonzero_terms(constants: np.ndarray) -> tuple[tuple[int, int, int, float], ...] | None:
    """The structure constants that are not zero with their indices; None if there are many."""
    places = np.argwhere(constants)
    if len(places) > MAX_UNROLLED_TERMS:
        return None
    return tuple((a, b, c, float(constants[a, b, c])) for a, b, c in places.tolist())


@partial(jax.jit, static_argnames=("terms", "dim"))  # one program where it is called by itself
def unrolled_bracket(terms: tuple[tuple[int, int, int, float], ...], x, y, dim: int) -> jax.Array:
    """``sum_ab value x_a y_b`` for each c, from (a, b, c, value): one pass over a batch, without matrices."""
    columns: list[list[jax.Array]] = [[] for _ in range(dim)]
    for a, b, c, value in terms:
        product = x[..., a] * y[..., b]
        columns[c].append(product if value == 1.0 else value * product)
    zero = jnp.zeros(jnp.broadcast_shapes(x.shape, y.shape)[:-1])
    return stack_columns([sum(column[1:], column[0]) if column else zero for column in columns])
