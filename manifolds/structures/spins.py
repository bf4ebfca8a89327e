"""Poisson structure of many spins, each a vector in space, beside components that commute with all."""

from __future__ import annotations

import math
from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .._arguments import checked_size
from .._arrays import real_array, stack_columns
from ..errors import ParameterError
from .poisson import PoissonBySharp

VectorComponents = tuple[jax.Array, jax.Array, jax.Array]
"""Vectors in space by components: three arrays of one shape, which are joined only after a computation."""


class Spins(PoissonBySharp):
    """Structure ``Pi(x) alpha = (gamma_i s_i x alpha_i, 0)`` on states ``x = (s_1, s_2, …, y)``, s_i in R^3 at each
    site.

    It is that of ``so(3)`` at every site, times gyromagnetic ratios, beside ``others`` components y that commute with
    all. Its Casimirs are the functions of the lengths |s_i| and of y. No array is larger than a state.

    Parameters
    ----------
    sites : int or tuple of int
        Sites in C order.
    others : int
        Number of components behind the spins.
    ratio : float, or array of the shape of the sites
        gamma_i: with ``s' = s x grad H``, the physics of a moment ``-gamma s`` in the field ``-grad H``.
    margins : tuple of int, optional
        If given, states have the spins component by component, ``(s_1x, s_2x, …, s_1y, …)``, which makes memory access
        of large states faster. Energies then use a halo of this many sites along each axis, see :class:`PaddedLattice`.

    Raises
    ------
    ParameterError
    """

    ratio: jax.Array
    sites: tuple[int, ...] = eqx.field(static=True)
    others: int = eqx.field(static=True)
    margins: tuple[int, ...] | None = eqx.field(static=True)

    def __init__(self, sites, others: int = 0, ratio=1.0, margins: tuple[int, ...] | None = None):
        shape = tuple(sites) if isinstance(sites, tuple | list) else (sites,)
        if not shape:
            raise ParameterError("sites must not be empty")
        self.sites = tuple(checked_size(n, 1, "Spins", "each number of sites") for n in shape)
        self.others = checked_size(others, 0, "Spins", "the number of other components")
        self.ratio, self.margins = real_array(ratio), margins
        if self.ratio.shape not in ((), self.sites):
            raise ParameterError(f"ratio must be one number, or have shape {self.sites}, got {self.ratio.shape}")
        if not isinstance(self.ratio, jax.core.Tracer) and not np.isfinite(np.asarray(self.ratio)).all():
            raise ParameterError("gyromagnetic ratios must be finite")

    @property
    def count(self) -> int:
        """Number of spins."""
        return math.prod(self.sites)

    @property
    def dim(self) -> int:
        return 3 * self.count + self.others

    @property
    def is_component_major(self) -> bool:
        """True if states have the spins component by component."""
        return self.margins is not None

    def spins(self, x) -> VectorComponents:
        """Return the components of the spins of a state, shape (n,): three arrays, shape (count,)."""
        return spin_components_from_state(x, self.count, self.is_component_major)

    def split_covectors(self, alpha) -> VectorComponents:
        """Return the components of covectors of the spins: three arrays, shape (count,)."""
        return spin_components_from_state(alpha, self.count, self.is_component_major)

    def join_state(self, spins: VectorComponents, others) -> jax.Array:
        """Return a state, shape (n,), from the components of its spins and the other components, shape (others,)."""
        return state_from_spin_components(spins, others, self.is_component_major)

    def precession_rates(self, x, alpha) -> VectorComponents:
        """Return the components of ``gamma_i s_i x alpha_i``."""
        return scale_vectors(self.ratio.reshape(-1), cross_vectors(self.spins(x), self.split_covectors(alpha)))

    def sharp(self, x, alpha) -> jax.Array:
        return self.join_state(self.precession_rates(x, alpha), jnp.zeros(self.others))


class Lattice:
    """Spins on a periodic lattice, by components."""

    def __init__(self, site_spins: VectorComponents):
        self.site_spins = site_spins

    def at(self, offset: Sequence[int]) -> VectorComponents:
        """Return for each site the spin ``offset`` sites ahead; the lattice is periodic."""
        a, b, c = (jnp.roll(component, [-o for o in offset], range(len(offset))) for component in self.site_spins)
        return a, b, c


class PaddedLattice(Lattice):
    """Large periodic lattice stored with a halo, so that neighbours are contiguous slices of one array.

    Parameters
    ----------
    reach : sequence of int
        Largest distance of neighbours along each axis.
    """

    def __init__(self, spins: VectorComponents, reach: Sequence[int]):
        self.reach, self.sites = reach, spins[0].shape
        margins = [(r, r) for r in reach]
        self.padded_spins = jax.lax.optimization_barrier(
            [jnp.pad(component, margins, mode="wrap") for component in spins]
        )
        super().__init__(self.at([0 for _ in reach]))

    def at(self, offset: Sequence[int]) -> VectorComponents:
        slices = tuple(slice(r + o, r + o + n) for r, o, n in zip(self.reach, offset, self.sites, strict=True))
        a, b, c = (component[slices] for component in self.padded_spins)
        return a, b, c


def spin_components_from_state(x, count: int, is_component_major: bool = False) -> VectorComponents:
    """Return the components of the first ``count`` vectors of a state, shape (n,): three arrays, shape (count,)."""
    if is_component_major:
        return x[:count], x[count : 2 * count], x[2 * count : 3 * count]
    return split_vectors(x[: 3 * count].reshape(count, 3))


def state_from_spin_components(spins: VectorComponents, others, is_component_major: bool = False) -> jax.Array:
    """Return the state, shape (n,), of spins by components, with the other components behind."""
    # without the barrier, the program that joins the columns would compute what they share once for each
    columns = jax.lax.optimization_barrier(spins) if is_component_major else (stack_columns(spins).reshape(-1),)
    return jnp.concatenate([*columns, others]) if is_component_major or others.size else columns[0]


def split_vectors(v) -> VectorComponents:
    """Return the components of vectors in space, shape (..., 3)."""
    return v[..., 0], v[..., 1], v[..., 2]


def cross_vectors(u: VectorComponents, v: VectorComponents) -> VectorComponents:
    """Return ``u x v``, by components."""
    return u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]


def add_vectors(u: VectorComponents, v: VectorComponents) -> VectorComponents:
    """Return ``u + v``, by components."""
    return u[0] + v[0], u[1] + v[1], u[2] + v[2]


def scale_vectors(factor, vectors: VectorComponents) -> VectorComponents:
    """Return vectors times a factor, or times one factor each, by components."""
    return factor * vectors[0], factor * vectors[1], factor * vectors[2]


def dot_vectors(u: VectorComponents, v: VectorComponents) -> jax.Array:
    """Return ``u . v`` of each pair of vectors."""
    return u[0] * v[0] + u[1] * v[1] + u[2] * v[2]


def sum_of_dots(u: VectorComponents, v: VectorComponents) -> jax.Array:
    """Return ``sum u_i . v_i`` over all vectors."""
    # without the barrier, the sum would evaluate the expression of v in a loop that has no vector instructions
    return jnp.sum(jax.lax.optimization_barrier(dot_vectors(u, v).reshape(-1)))


def reshape_vectors(vectors: VectorComponents, shape: tuple[int, ...]) -> VectorComponents:
    """Return vectors by components, on an array of sites of another shape."""
    return vectors[0].reshape(shape), vectors[1].reshape(shape), vectors[2].reshape(shape)


def cross(u, v) -> jax.Array:
    """Return ``u x v`` of vectors in space, shape (..., 3)."""
    return stack_columns(cross_vectors(split_vectors(u), split_vectors(v)))
