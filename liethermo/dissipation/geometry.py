"""Interface of systems to their dissipations: structure, metric of the space, sites, and isotropic noise."""

from __future__ import annotations

import math
from abc import abstractmethod

import equinox as eqx
import jax
import jax.numpy as jnp

import manifolds as mf
from manifolds._arrays import real_array
from manifolds._pytree_module import Module

from ..functions.energy import Energy
from ..tracing.programs import jit_if_traced


class HeatingSites:
    """Sites that may each heat a bath of their own, with products of vectors at each site.

    Parameters
    ----------
    shape : tuple of int
        Shape of the lattice of the sites; () if there are none.
    """

    def __init__(self, shape: tuple[int, ...]):
        self.shape = shape

    def scale_at_sites(self, values, v) -> jax.Array:
        """Return a vector, shape (n,), times one number for each site, shape (sites,), or times a single number."""
        return values * v if jnp.ndim(values) == 0 else self._scale_each_site(values, v)

    def _scale_each_site(self, values, v) -> jax.Array:
        """Return a vector, shape (n,), times one number for each site, shape (sites,)."""
        return (values[:, None] * v.reshape(len(values), -1)).ravel()

    def dot_at_sites(self, alpha, v) -> jax.Array:
        """Return ``alpha . v`` at each site, shape (sites,)."""
        return jnp.sum((alpha * v).reshape(math.prod(self.shape), -1), axis=1)


class Geometry(Module):
    """Interface of a system for its dissipation; every system class has it.

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
        """The Lie algebra with the states in its dual; None for other systems."""
        return None

    @property
    def matrix_group(self) -> mf.MatrixGroup | None:
        """The group of the attitudes; None without attitudes."""
        return None

    @property
    def sites(self) -> tuple[int, ...]:
        """Shape of the lattice of sites, whose states have the shape ``(*sites, d)``; () for a system without sites."""
        return ()

    @property
    def shape(self) -> tuple[int, ...]:
        """The shape of a state on R^n: (n,), or ``(*sites, d)``."""
        return (*self.sites, self.dim // math.prod(self.sites))

    @property
    def heating_sites(self) -> HeatingSites:
        """The sites that may each heat a bath of their own, with the products of vectors at each of them."""
        return HeatingSites(self.sites)

    @property
    @abstractmethod
    def body_dim(self) -> int:
        """Number of state components without those of baths."""

    @abstractmethod
    def drop_baths(self) -> Geometry:
        """Return the body alone, the geometry of its dissipation; itself if there are no baths."""

    def points(self, x) -> jax.Array:
        """Return state vectors, shape (..., n), in their natural shape: ``(*sites, d)``, or points of the space."""
        if self.space is not None:
            return self.space.from_vector(x)
        x = real_array(x)
        return x.reshape(*x.shape[:-1], *self.shape) if self.sites else x

    # -- the metric of the space --------------------------------------------------------------------------------------

    def raise_index(self, x, alpha) -> jax.Array:
        """Return the tangent vector of a covector by the metric of the space, shape (n,); alpha itself on R^n."""
        if self.space is None:
            return alpha
        return self.space.to_vector(_sharp(self.space, self.points(x), self.points(alpha).conj()))

    def lower_index(self, x, v) -> jax.Array:
        """Return the covector of a tangent vector by the metric of the space: the inverse of :meth:`raise_index`."""
        if self.space is None:
            return v
        return self.space.to_vector(self.space._metric_covector(self.points(x), self.points(v)).conj())


@jit_if_traced
def _sharp(space: mf.Space, x, alpha) -> jax.Array:
    """Return the tangent vector of a covector at a point of a space, by its metric."""
    return space._sharp(x, alpha)


def project_tangent(system: Geometry, x, w) -> jax.Array:
    """Return the tangent vector nearest to an array, shape (n,); the array itself on R^n."""
    if system.space is None:
        return w
    return system.space.to_vector(system.space._project_tangent(system.points(x), system.points(w)))


def isotropic_noise_dim(system: Geometry) -> int:
    """Return the number of independent Gaussian numbers in an isotropic random vector: see :func:`isotropic_noise`."""
    return system.dim if system.space is None else system.space.isotropic_size


def isotropic_noise(system: Geometry, x, w) -> jax.Array:
    """Return the tangent vector ``R w``, shape (n,), with ``R R^T`` the inverse of the metric; w itself on R^n."""
    return w if system.space is None else system.space.to_vector(system.space._isotropic(system.points(x), w))


def divergence_summands_of_fields(system: Geometry, x, contract_fields) -> jax.Array:
    """Return the terms, shape (n, fields), whose sum over the first axis is the divergence of each vector field.

    ``contract_fields(y, alpha)`` is the product of a covector alpha at y with the field, or with each of several.
    """
    if system.space is None:
        return jax.vmap(lambda e: jax.jvp(lambda y: contract_fields(y, e), (x,), (e,))[1])(jnp.eye(x.shape[0]))
    vector = system.space.to_vector
    return system.space._divergence_terms(
        system.points(x), lambda y, alpha: contract_fields(vector(y), vector(alpha.conj()))
    )
