"""Algebras defined by their bracket; structure constants and matrices are computed on demand."""

from __future__ import annotations

from abc import abstractmethod
from functools import cached_property

import jax
import jax.numpy as jnp

from .._arguments import check_memory, checked_names
from .._pytree_module import forward_to
from .lie_algebra import LieAlgebra


class BracketAlgebra(LieAlgebra):
    """Algebra defined by its bracket; :attr:`algebra_by_constants` serves operations that need structure constants.

    A subclass sets ``name`` and ``dim``, implements :meth:`bracket`, :meth:`ad_star`, ``_key`` and
    :meth:`_build_by_constants`, and overrides the properties that it knows without constants.
    """

    name: str
    dim: int

    def __init__(self, name: str, dim: int, basis_names=None):
        self.name, self.dim = name, dim
        self.basis_names = None if basis_names is None else checked_names(basis_names, dim)

    @cached_property
    def algebra_by_constants(self) -> LieAlgebra:
        """Equal algebra with an array of structure constants.

        Raises
        ------
        SizeError
            If the constants would not fit into memory; they are not computed then.
        """
        check_memory(
            float(self.dim) ** 3,
            f"the {self.dim}**3 structure constants of {self.name}",
            "bracket, ad_star, killing_inner_product and leading_casimirs need none",
        )
        return self._build_by_constants()

    @abstractmethod
    def _build_by_constants(self) -> LieAlgebra: ...

    @property
    @abstractmethod
    def _key(self): ...

    structure_constants = forward_to("algebra_by_constants")
    rational_constants = forward_to("algebra_by_constants")
    basis = forward_to("algebra_by_constants")
    _balanced_constants_and_factors = forward_to("algebra_by_constants")

    def _check_matrix_memory(self, label: str) -> None:
        """Raise SizeError if a dim by dim matrix would not fit into memory."""
        check_memory(float(self.dim) ** 2, f"{label} of {self.name}", "bracket, ad_star and action make no matrices")

    def ad(self, x):
        self._check_matrix_memory("the matrix of ad")
        columns = self.bracket(jnp.asarray(x)[..., None, :], jnp.eye(self.dim))
        return jnp.swapaxes(columns, -1, -2)

    def poisson_tensor(self, mu):
        self._check_matrix_memory("the Poisson tensor")
        return jax.vmap(lambda e: self.ad_star(e, mu), out_axes=1)(jnp.eye(self.dim))

    def __eq__(self, other) -> bool:
        return type(other) is type(self) and self._key == other._key

    def __hash__(self) -> int:
        return hash(self._key)
