"""What is asked of an algebra to find its Casimirs."""

from __future__ import annotations

from typing import Protocol

import jax
import numpy as np

from ._exact import RationalArray


class Structure(Protocol):
    """An algebra as its structure constants show it: see :class:`manifolds.LieAlgebra`."""

    name: str
    structure_constants: np.ndarray
    rational_constants: RationalArray | None
    basis: np.ndarray | None

    @classmethod
    def from_structure_constants(cls, structure_constants, name: str = "g", basis_names=None) -> Structure: ...
    @property
    def dim(self) -> int: ...
    @property
    def _balanced(self) -> tuple[np.ndarray, np.ndarray]: ...
    def is_semisimple(self) -> bool: ...
    def killing_form(self) -> np.ndarray: ...
    def ad_star(self, x, mu) -> jax.Array: ...
    def __hash__(self) -> int: ...
