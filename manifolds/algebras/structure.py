"""Protocol of an algebra, bracket and coadjoint action of one fixed element, and brackets of large batches."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Protocol

import jax
import jax.numpy as jnp
import numpy as np

from .._arrays import stack_columns
from ._rational import RationalArray


class AlgebraStructure(Protocol):
    """Operations of an algebra that the search for Casimirs uses; see :class:`manifolds.LieAlgebra`."""

    name: str

    @classmethod
    def from_structure_constants(cls, structure_constants, name: str = "g", basis_names=None) -> AlgebraStructure: ...
    @property
    def dim(self) -> int: ...
    @property
    def structure_constants(self) -> np.ndarray: ...
    @property
    def rational_constants(self) -> RationalArray | None: ...
    @property
    def basis(self) -> np.ndarray | None: ...
    @property
    def _balanced_constants_and_factors(self) -> tuple[np.ndarray, np.ndarray]: ...
    @property
    def invariants(self) -> tuple[Callable, ...]: ...
    def is_semisimple(self) -> bool: ...
    def casimir_count(self) -> int: ...
    def casimirs(self, degree: int) -> list: ...
    def killing_form(self) -> np.ndarray: ...
    def ad_star(self, x, mu) -> jax.Array: ...
    def __hash__(self) -> int: ...


MAX_UNROLLED_TERMS = 64
"""Largest number of nonzero structure constants for which the bracket of a batch is written out term by term."""


class Action(Protocol):
    """Bracket and coadjoint operator of one fixed x; shared work is done once. See :meth:`LieAlgebra.action`.

    Arrays have the shape (dim,).
    """

    def bracket(self, y) -> jax.Array: ...
    def ad_star(self, mu) -> jax.Array: ...


class Operator(Protocol):
    """Linear map that is applied by ``@``: a matrix, or an object that acts like one."""

    def __matmul__(self, other) -> jax.Array: ...


class AdMatrixAction:
    """Action of x by the matrix of ``ad_x``."""

    def __init__(self, ad):
        self.ad = ad

    def bracket(self, y) -> jax.Array:
        return self.ad @ y

    def ad_star(self, mu) -> jax.Array:
        return self.ad.T @ mu


def terms_to_unroll(constants: np.ndarray) -> tuple[tuple[int, int, int, float], ...] | None:
    """Return the nonzero structure constants as tuples (a, b, c, value); None if there are more than
    MAX_UNROLLED_TERMS."""
    indices = np.argwhere(constants)
    if len(indices) > MAX_UNROLLED_TERMS:
        return None
    return tuple((a, b, c, float(constants[a, b, c])) for a, b, c in indices.tolist())


@partial(jax.jit, static_argnames=("terms", "dim"))  # one compiled program for calls outside of a jitted function
def unrolled_bracket(terms: tuple[tuple[int, int, int, float], ...], x, y, dim: int) -> jax.Array:
    """Compute ``sum_ab value x_a y_b`` for each c from terms (a, b, c, value): one pass over a batch, no matrices."""
    columns: list[list[jax.Array]] = [[] for _ in range(dim)]
    for a, b, c, value in terms:
        product = x[..., a] * y[..., b]
        columns[c].append(product if value == 1.0 else value * product)
    zero = jnp.zeros(jnp.broadcast_shapes(x.shape, y.shape)[:-1])
    return stack_columns([sum(column[1:], column[0]) if column else zero for column in columns])
