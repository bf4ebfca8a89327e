"""The geometry that a dissipation is handed."""

from __future__ import annotations

import math
from abc import abstractmethod

import equinox as eqx
import jax
import jax.numpy as jnp

import manifolds as mf
from manifolds._pytree_module import Module

from ..functions.energy import Energy
from ..tracing.programs import subprogram


class Geometry(Module):
    """What a dissipation may ask of the system that it acts in. Every system has it, whatever its class.

    ``poisson.state_indices`` has the indices of all q, p and S in a state of several bodies.

    Attributes
    ----------
    poisson : manifolds.PoissonStructure
        Its ``sharp(x, dH)`` is the conservative motion.
    energy : Energy
    dim : int
        Components of a state.
    space : manifolds.Space or None
        None on R^n.
    """

    poisson: mf.PoissonStructure
    energy: Energy
    dim: int = eqx.field(static=True)
    space: mf.Space | None = eqx.field(static=True)

    @property
    def lie_algebra(self) -> mf.LieAlgebra | None:
        """The Lie algebra whose dual states are in; None where the system is not on one."""
        return None

    @property
    def matrix_group(self) -> mf.MatrixGroup | None:
        """The group of the attitudes; None where there are none."""
        return None

    @property
    def sites(self) -> tuple[int, ...]:
        """The sites of a system of many equal ones, whose states are shown as arrays of shape ``(*sites, d)``."""
        return ()

    @property
    def shape(self) -> tuple[int, ...]:
        """The shape in which states are shown off manifolds: (n,), or ``(*sites, d)``."""
        return (*self.sites, self.dim // math.prod(self.sites))

    @property
    def heating_sites(self) -> tuple[int, ...]:
        """The sites that may each heat a bath of their own."""
        return self.sites

    @property
    @abstractmethod
    def body_dim(self) -> int:
        """Number of state components, those of baths left out."""

    @abstractmethod
    def drop_baths(self) -> Geometry:
        """The body alone: the geometry that its dissipation acts in. Itself where there are no baths."""

    def points(self, x) -> jax.Array:
        """State vectors, shape (..., n), as they are shown: of shape ``(*sites, d)``, or as points of the space."""
        if self.space is not None:
            return self.space.from_vector(x)
        x = jnp.asarray(x)
        return x.reshape(*x.shape[:-1], *self.shape) if self.sites else x

    # -- the metric of the space --------------------------------------------------------------------------------------

    def raise_index(self, x, alpha) -> jax.Array:
        """The tangent vector that the metric of the space makes of a covector, shape (n,); itself on R^n."""
        if self.space is None:
            return alpha
        return self.space.to_vector(_sharp(self.space, self.points(x), self.points(alpha).conj()))

    def lower_index(self, x, v) -> jax.Array:
        """The covector that the metric of the space makes of a tangent vector: the inverse of :meth:`raised`."""
        if self.space is None:
            return v
        return self.space.to_vector(self.space._flat(self.points(x), self.points(v)).conj())

    def project_tangent(self, x, w) -> jax.Array:
        """The tangent vector nearest to an array, shape (n,); itself on R^n."""
        if self.space is None:
            return w
        return self.space.to_vector(self.space._project_tangent(self.points(x), self.points(w)))

    @property
    def isotropic_size(self) -> int:
        """How many numbers :meth:`isotropic` takes."""
        return self.dim if self.space is None else self.space.isotropic_size

    def isotropic_vector(self, x, w) -> jax.Array:
        """``R w`` with ``R R^T`` the inverse of the metric of the space, shape (n,); w itself on R^n."""
        return w if self.space is None else self.space.to_vector(self.space._isotropic(self.points(x), w))

    def scale_at_sites(self, values, v) -> jax.Array:
        """A vector, shape (n,), times a number for each site, shape (sites,); or times one number."""
        if jnp.ndim(values) == 0:
            return values * v
        return (values[:, None] * v.reshape(len(values), -1)).ravel()

    def dot_at_sites(self, alpha, v) -> jax.Array:
        """``alpha . v`` at each site, shape (sites,)."""
        return jnp.sum((alpha * v).reshape(math.prod(self.sites), -1), axis=1)

    def divergence_terms(self, x, rows) -> jax.Array:
        """What the divergence of vector fields is the sum of, over the first axis.

        ``rows(y, alpha)`` is what a covector alpha at y makes of the field, or of each of several; vectors of shape
        (n,).
        """
        if self.space is None:
            return jax.vmap(lambda e: jax.jvp(lambda y: rows(y, e), (x,), (e,))[1])(jnp.eye(x.shape[0]))
        vector = self.space.to_vector
        return self.space._divergence_terms(self.points(x), lambda y, alpha: rows(vector(y), vector(alpha.conj())))


@subprogram
def _sharp(space: mf.Space, x, alpha) -> jax.Array:
    return space._sharp(x, alpha)
