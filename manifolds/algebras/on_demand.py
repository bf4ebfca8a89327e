"""Algebras that know what they do; their structure constants and matrices are made when they are asked for."""

from __future__ import annotations

from abc import abstractmethod
from functools import cached_property

import jax
import jax.numpy as jnp

from .._module import forwarded
from .._names import checked_names
from .._sizes import check_memory
from .lie_algebra import LieAlgebra


class OnDemand(LieAlgebra):
    """An algebra given by its bracket. What its constants alone tell is asked of :attr:`by_constants`.

    A subclass sets ``name`` and ``dim``, gives :meth:`bracket`, :meth:`ad_star`, ``_key`` and
    :meth:`_made_by_constants`, and whatever else it knows without constants.
    """

    name: str
    dim: int

    def __init__(self, name: str, dim: int, basis_names=None):
        self.name, self.dim = name, dim
        self.basis_names = None if basis_names is None else checked_names(basis_names, dim)

    @cached_property
    def by_constants(self) -> LieAlgebra:
        """The same algebra, given by its structure constants.

        Raises
        ------
        SizeError
            If they would not fit into memory; nothing is tried then.
        """
        check_memory(
            float(self.dim) ** 3,
            f"the {self.dim}**3 structure constants of {self.name}",
            "bracket, ad_star, killing_inner_product and leading_casimirs need none",
        )
        return self._made_by_constants()

    @abstractmethod
    def _made_by_constants(self) -> LieAlgebra: ...

    @property
    @abstractmethod
    def _key(self): ...

    structure_constants = forwarded("by_constants")
    rational_constants = forwarded("by_constants")
    basis = forwarded("by_constants")
    _balanced = forwarded("by_constants")

    def _check_square(self, what: str) -> None:
        """Raise SizeError where a dim by dim matrix would not fit."""
        check_memory(float(self.dim) ** 2, f"{what} of {self.name}", "bracket, ad_star and action make no matrices")

    def ad(self, x):
        self._check_square("the matrix of ad")
        columns = self.bracket(jnp.asarray(x)[..., None, :], jnp.eye(self.dim))
        return jnp.swapaxes(columns, -1, -2)

    def poisson_tensor(self, mu):
        self._check_square("the Poisson tensor")
        return jax.vmap(lambda e: self.ad_star(e, mu), out_axes=1)(jnp.eye(self.dim))

    def __eq__(self, other) -> bool:
        return type(other) is type(self) and self._key == other._key

    def __hash__(self) -> int:
        return hash(self._key)
