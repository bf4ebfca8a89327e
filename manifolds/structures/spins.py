"""Many spins, each a vector in space, beside quantities that move with none of them."""

from __future__ import annotations

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .._arrays import real_array
from .._sizes import checked_size
from ..errors import ParameterError
from .poisson import PoissonStructure

Planes = tuple[jax.Array, jax.Array, jax.Array]
"""Vectors in space by components: three arrays of one shape. What is computed from these is put together once."""


class Spins(PoissonStructure):
    """``Pi(x) alpha = (gamma_i s_i x alpha_i, 0)`` for states ``x = (s_1, s_2, …, y)``, s_i in R^3 at each site.

    That of ``so(3)`` at every site, times gyromagnetic ratios, beside ``others`` components y that commute with all.
    Its Casimirs are the functions of the lengths |s_i| and of y. Nothing is formed that is larger than a state.

    Parameters
    ----------
    sites : int or tuple of int
        Sites in C order.
    others : int
        Components behind the spins.
    ratio : float, or array of the shape of the sites
        gamma_i: with ``s' = s x grad H``, the physics of a moment ``-gamma s`` in the field ``-grad H``.

    Raises
    ------
    ParameterError
    """

    ratio: jax.Array
    sites: tuple[int, ...] = eqx.field(static=True)
    others: int = eqx.field(static=True)

    def __init__(self, sites, others: int = 0, ratio=1.0):
        shape = tuple(sites) if isinstance(sites, tuple | list) else (sites,)
        if not shape:
            raise ParameterError("spins need the number of sites")
        self.sites = tuple(checked_size(n, 1, "Spins", "each number of sites") for n in shape)
        self.others = checked_size(others, 0, "Spins", "the number of other components")
        self.ratio = real_array(ratio)
        if self.ratio.shape not in ((), self.sites):
            raise ParameterError(f"the ratio is one number, or has shape {self.sites}, not {self.ratio.shape}")
        if not isinstance(self.ratio, jax.core.Tracer) and not np.isfinite(np.asarray(self.ratio)).all():
            raise ParameterError("gyromagnetic ratios are finite numbers")

    @property
    def count(self) -> int:
        """How many spins there are."""
        return math.prod(self.sites)

    @property
    def dim(self) -> int:
        return 3 * self.count + self.others

    def spins(self, x) -> Planes:
        """The components of the spins of a state, shape (n,): three arrays, shape (count,)."""
        return planes(x[: 3 * self.count].reshape(self.count, 3))

    def joined(self, spins: Planes, others) -> jax.Array:
        """A state, shape (n,), from the components of its spins and the other components, shape (others,)."""
        flat = interleaved(spins).reshape(3 * self.count)
        return flat if self.others == 0 else jnp.concatenate([flat, others])

    def turned(self, x, alpha) -> Planes:
        """The components of ``gamma_i s_i x alpha_i``."""
        ratio, (a, b, c) = self.ratio.reshape(-1), cross_planes(self.spins(x), self.spins(alpha))
        return ratio * a, ratio * b, ratio * c

    def sharp(self, x, alpha) -> jax.Array:
        return self.joined(self.turned(x, alpha), jnp.zeros(self.others))

    def tensor(self, x) -> jax.Array:
        """The matrix Pi(x), shape (n, n): for few spins alone."""
        return jax.vmap(lambda axis: self.sharp(x, axis), out_axes=1)(jnp.eye(self.dim))


def planes(v) -> Planes:
    """The components of vectors in space, shape (..., 3)."""
    return v[..., 0], v[..., 1], v[..., 2]


def interleaved(spins: Planes) -> jax.Array:
    """The vectors of some components, shape (..., 3).

    By selection: the loop of a concatenation has a branch for every entry, and takes three times as long.
    """
    a, b, c = (component[..., None] for component in spins)
    return jnp.where(np.array([True, False, False]), a, jnp.where(np.array([False, True, False]), b, c))


def cross_planes(u: Planes, v: Planes) -> Planes:
    """``u x v``, by components."""
    return u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]


def cross(u, v) -> jax.Array:
    """``u x v`` of vectors in space, shape (..., 3)."""
    return interleaved(cross_planes(planes(u), planes(v)))
