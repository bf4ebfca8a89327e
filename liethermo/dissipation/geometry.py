"""The geometry that a dissipation is handed."""

from __future__ import annotations

from typing import Protocol

import jax

import manifolds as mf

from ..functions.energy import Energy


class Geometry(Protocol):
    """What a dissipation may ask of the system that it acts in. Every system has it, whatever its class.

    One on the dual of a Lie algebra has the attribute ``algebra`` besides, and ``poisson.places`` says where the bodies
    are in the state of a system of several.

    Attributes
    ----------
    dim : int
        Components of a state.
    energy : Energy
    poisson : manifolds.PoissonStructure
        Its ``sharp(x, dH)`` is the conservative motion.
    space : manifolds.Space or None
        None on R^n.
    sites, shape : tuple of int
        Those of a system of many equal ones, and ``(*sites, d)``; () and (n,) otherwise.
    """

    @property
    def dim(self) -> int: ...
    @property
    def energy(self) -> Energy: ...
    @property
    def poisson(self) -> mf.PoissonStructure: ...
    @property
    def sites(self) -> tuple[int, ...]: ...
    @property
    def shape(self) -> tuple[int, ...]: ...
    @property
    def space(self) -> mf.Space | None: ...

    @property
    def heating_sites(self) -> tuple[int, ...]:
        """The sites that may each heat a bath of their own."""
        ...

    @property
    def body_dim(self) -> int:
        """Components of a state, those of baths left out."""
        ...

    def without_baths(self) -> Geometry:
        """The geometry of the body alone."""
        ...

    def at_sites(self, values, v) -> jax.Array:
        """A vector times a number for each site."""
        ...

    def over_sites(self, alpha, v) -> jax.Array:
        """``alpha . v`` at each site."""
        ...

    def raised(self, x, alpha) -> jax.Array:
        """The tangent vector that the metric of the space makes of a covector, shape (n,)."""
        ...

    def lowered(self, x, v) -> jax.Array:
        """The covector that the metric of the space makes of a tangent vector, shape (n,)."""
        ...

    def tangent(self, x, w) -> jax.Array:
        """The tangent vector nearest to an array, shape (n,)."""
        ...

    @property
    def isotropic_size(self) -> int: ...

    def isotropic(self, x, w) -> jax.Array:
        """``R w`` with ``R R^T`` the inverse of the metric, shape (n,)."""
        ...

    def changes(self, x, rows) -> jax.Array:
        """What the divergence of fields is the sum of, where a covector alpha at y makes ``rows(y, alpha)`` of them."""
        ...
