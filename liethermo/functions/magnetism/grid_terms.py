"""Exchange and Dzyaloshinskii-Moriya interaction of spins on simple lattices, crystals and graphs.

Every term is quadratic, so its gradient at a midpoint is a discrete gradient, at a cost proportional to the number of
sites and edges. States begin with the spins, site by site in C order, ``(s_1x, s_1y, s_1z, s_2x, …)``; the other
components do not affect these energies.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy

from manifolds._arguments import is_integer
from manifolds._arrays import real_array
from manifolds.structures.spins import (
    Lattice as PeriodicSpins,
)
from manifolds.structures.spins import (
    VectorComponents,
    add_vectors,
    cross,
    cross_vectors,
    scale_vectors,
    split_vectors,
    sum_of_dots,
)

from ...errors import InputError
from ..edges import graph_edges
from ..energy import Energy, Sum
from ..indices import clique_pattern
from ..mechanics import Each
from .bond_terms import crystal_antisymmetric_exchange, crystal_exchange, refuse_grid_arguments
from .lattices import Bonds, Lattice
from .spin_energy import SpinEnergy, bond_component_indices, checked_site_values, lattice_shape


def exchange(sites, strength=1.0, neighbours=None, periodic=True, images: bool = False) -> Energy:
    """Return the Heisenberg exchange, ``-sum J_ij s_i . s_j`` over pairs of sites: J > 0 aligns neighbours.

    Each pair of sites counts once.

    Parameters
    ----------
    sites : int, tuple of int, Lattice or Bonds
        A tuple, such as ``(64, 64)``, for a simple lattice. For a :func:`lattice` the strength is J of the nearest
        neighbours, or a list of J, one for each shell; or a mapping from the numbers of shells, from 1, to J. For
        bonds of a lattice the strength is one J, or has shape (m,) or ``(m, *cells)``.
    strength : float, or array; or graph
        J: one number for all pairs; an array of the shape of the sites, for the pair of each site and its neighbour
        ahead (or a list of such arrays, one for each neighbour). Or, with ``neighbours=None``, the graph: a symmetric
        matrix of all sites, dense or sparse, or a list of edges ``(i, j, J)``, each pair once, sites in C order.
    neighbours : sequence of tuples of int, optional
        Offsets to the neighbours ahead on a lattice, one of each two opposite offsets; by default one along every axis.
    periodic : bool or tuple of bool
        Whether the lattice is periodic, along each axis. A :func:`lattice` has borders of its own.
    images : bool
        Count bonds to the periodic images of a spin as bonds of their own. By default a spin on a periodic axis of
        length 1 has no neighbour along it, and two spins on a periodic axis of length 2 have one bond. An array with
        one value for each site names every bond.

    Returns
    -------
    Energy

    Raises
    ------
    InputError

    Examples
    --------
    >>> iron = lt.magnetism.lattice("bcc", (3, 3, 3))
    >>> energy = lt.magnetism.exchange(iron, [1.0, 0.5])  # two shells: 4 and 3 bonds a site
    >>> up = np.tile([0.0, 0.0, 1.0], iron.site_count)
    >>> float(energy(up)) / iron.site_count
    -5.5
    """
    if isinstance(sites, Lattice | Bonds):
        refuse_grid_arguments(neighbours, periodic, images)
        return crystal_exchange(sites, strength)
    shape = lattice_shape(sites)
    if neighbours is None and _is_exchange_graph(strength, shape):
        return _graph_exchange(shape, strength)
    return _lattice_bond_energy(shape, strength, None, neighbours, periodic, images, "an exchange constant")


def dzyaloshinskii_moriya(sites, vectors, neighbours=None, periodic=True, images: bool = False) -> Energy:
    """Return the antisymmetric exchange, ``sum D_ij . (s_i x s_j)`` over pairs of sites, which cants neighbours.

    Each pair counts once. D_ij belongs to the direction from i to j: exchanging i and j reverses it.

    Parameters
    ----------
    sites : int, tuple of int, Lattice or Bonds
        For a :func:`lattice` the vectors are those of the nearest neighbours, in the order of ``lattice.shell(1)``; for
        bonds of a lattice they have shape (3,), (m, 3) or ``(m, *cells, 3)``.
    vectors : array, shape (3,), or ``(*sites, 3)``; or a list of them, one for each neighbour; or list of edges
        D of the pair of each site and its neighbour ahead, such as ``[(0, D, 0), (-D, 0, 0)]`` on a square lattice; or
        edges ``(i, j, D)``, with D from i to j.
    neighbours, periodic, images
        See :func:`exchange`. On a periodic axis of length 2 the two bonds of a pair have opposite vectors, so such an
        axis is refused without ``images``.

    Returns
    -------
    Energy

    Raises
    ------
    InputError
    """
    if isinstance(sites, Lattice | Bonds):
        refuse_grid_arguments(neighbours, periodic, images)
        return crystal_antisymmetric_exchange(sites, vectors)
    shape = lattice_shape(sites)
    if neighbours is None and _is_edge_list(vectors) and all(np.ndim(edge[2]) == 1 for edge in vectors):
        ends, D = _checked_edges_and_vectors(vectors, math.prod(shape))
        return Each(_antisymmetric_bond_energy, bond_component_indices(ends[:, 0], ends[:, 1]), D)
    return _lattice_bond_energy(shape, None, vectors, neighbours, periodic, images, "a Dzyaloshinskii-Moriya vector")


class BondEnergy(SpinEnergy):
    """The energy ``sum_i -J_i s_i . s_{i+o} + D_i . (s_i x s_{i+o})`` on a lattice, o an offset.

    Attributes
    ----------
    offset : tuple of int
    J : array, shape () or that of the sites, or None
    D : array, shape (3,) or ``(*sites, 3)``, or None
    """

    offset: tuple[int, ...] = eqx.field(static=True)
    J: jax.Array | None
    D: jax.Array | None

    @property
    def interaction_range(self) -> tuple[int, ...]:
        return tuple(map(abs, self.offset))

    def lattice_value(self, spins: PeriodicSpins) -> jax.Array:
        return sum_of_dots(self._neighbour_gradient(spins.at(self.offset), self.J, self.D), spins.site_spins)

    def lattice_gradients(self, spins: PeriodicSpins) -> VectorComponents:
        spins_ahead, spins_behind = spins.at(self.offset), spins.at([-o for o in self.offset])
        if self.D is None and self.J is not None and not self.J.ndim:
            return scale_vectors(-self.J, add_vectors(spins_ahead, spins_behind))
        axes = range(len(self.sites))
        J = self.J if self.J is None or not self.J.ndim else jnp.roll(self.J, self.offset, axes)
        D = self.D if self.D is None or self.D.ndim == 1 else jnp.roll(self.D, self.offset, axes)
        return add_vectors(
            self._neighbour_gradient(spins_ahead, self.J, self.D),
            self._neighbour_gradient(spins_behind, J, None if D is None else -D),
        )

    @staticmethod
    def _neighbour_gradient(s: VectorComponents, J: jax.Array | None, D: jax.Array | None) -> VectorComponents:
        """Return ``-J s + s x D``, the gradient by a spin that is due to its neighbour s."""
        exchange_gradient = None if J is None else scale_vectors(-J, s)
        if D is not None:
            dmi_gradient = cross_vectors(s, split_vectors(D))
            return dmi_gradient if exchange_gradient is None else add_vectors(exchange_gradient, dmi_gradient)
        assert exchange_gradient is not None
        return exchange_gradient

    def multiple(self, factor) -> Energy:
        J, D = (None if value is None else factor * value for value in (self.J, self.D))
        return BondEnergy(self.sites, self.offset, J, D)

    def hessian_pattern(self, dim: int) -> scipy.sparse.csr_array:
        site_numbers = np.arange(math.prod(self.sites)).reshape(self.sites)
        neighbour_numbers = np.roll(site_numbers, [-shift for shift in self.offset], axis=range(site_numbers.ndim))
        return clique_pattern(bond_component_indices(site_numbers.ravel(), neighbour_numbers.ravel()), dim)


def _lattice_bond_energy(shape, strength, vectors, neighbours, periodic, images: bool, quantity_name: str) -> Energy:
    """Return the exchange or antisymmetric exchange (``vectors``) of sites with neighbours at fixed offsets."""
    n_axes = len(shape)
    offsets = np.eye(n_axes, dtype=int).tolist() if neighbours is None else neighbours
    offsets = [_checked_offset(offset, n_axes) for offset in offsets]
    periodic_axes = (periodic,) * n_axes if isinstance(periodic, bool) else tuple(periodic)
    if len(periodic_axes) != n_axes:
        raise InputError(f"periodic must be True or False, or one for each of the {n_axes} axes, got {periodic!r}")
    for offset_a, offset_b in itertools.combinations(offsets, 2):
        opposite = [-o for o in offset_b]
        wrap = (
            (lambda offset: offset)
            if images
            else functools.partial(_wrap_offset, shape=shape, periodic_axes=periodic_axes)
        )
        if wrap(offset_a) in (wrap(offset_b), wrap(opposite)) and any(wrap(offset_a)):
            raise InputError(
                f"the neighbours {offset_a} and {offset_b} name a pair twice. Give one of each two opposite offsets, "
                "and on a periodic axis shorter ones"
            )
    coupling = strength if vectors is None else vectors
    couplings = (
        coupling
        if isinstance(coupling, list | tuple) and len(coupling) == len(offsets) and np.ndim(coupling[0])
        else [coupling] * len(offsets)
    )
    value_shape = () if vectors is None else (3,)
    terms = []
    for offset, offset_coupling in zip(offsets, couplings, strict=True):
        value = checked_site_values(offset_coupling, shape, value_shape, quantity_name)
        has_neighbour = _neighbour_mask(shape, offset, periodic_axes)
        if not images and value.shape == value_shape:  # values given for each site are bonds that the user has counted
            is_first = _first_bond_of_pair_mask(shape, offset, periodic_axes)
            if (
                vectors is not None
                and (has_neighbour & ~is_first).any()
                and any(_wrap_offset(offset, shape, periodic_axes))
            ):
                raise InputError(
                    f"{quantity_name} has two directions for one pair, because the neighbours {offset} and "
                    f"{[-o for o in offset]} are one site on a periodic lattice of {shape} sites. Use periodic=False "
                    "along the short axis, more sites, or images=True to count both bonds"
                )
            has_neighbour = has_neighbour & is_first
        if not has_neighbour.all():  # no pairs across the border
            value = jnp.where(has_neighbour.reshape(*shape, *(1 for _ in value_shape)), value, 0.0)
        terms.append(
            BondEnergy(shape, tuple(offset), value, None)
            if vectors is None
            else BondEnergy(shape, tuple(offset), None, value)
        )
    return Sum.from_terms(terms)


def _checked_offset(offset, n_axes: int) -> list[int]:
    """Return an offset as a list of integers; raise InputError unless it has one for each axis and is not zero."""
    components = [offset] if np.ndim(offset) == 0 else list(offset)
    if len(components) != n_axes or any(int(o) != o for o in components) or not any(components):
        raise InputError(f"a neighbour must be an offset of {n_axes} integers, not all zero, got {offset!r}")
    return [int(o) for o in components]


def _neighbour_mask(shape, offset, periodic_axes) -> np.ndarray:
    """Return a mask, of the shape of the sites, of the sites that have a neighbour at an offset."""
    has_neighbour = np.ones(shape, dtype=bool)
    for axis, (n, shift, is_periodic) in enumerate(zip(shape, offset, periodic_axes, strict=True)):
        indices = np.arange(n) + shift
        is_inside_axis = (np.ones(n, dtype=bool) if is_periodic else (indices >= 0) & (indices < n)).reshape(
            [-1 if a == axis else 1 for a in range(len(shape))]
        )
        has_neighbour = has_neighbour & is_inside_axis
    return has_neighbour


def _wrap_offset(offset, shape, periodic_axes) -> list[int]:
    """Return an offset modulo the lengths of the periodic axes."""
    return [o % n if is_periodic else o for o, n, is_periodic in zip(offset, shape, periodic_axes, strict=True)]


def _first_bond_of_pair_mask(shape, offset, periodic_axes) -> np.ndarray:
    """Return a mask of the sites whose bond at an offset is the first bond between its two sites.

    On a periodic axis of length 1 or 2 an offset leads from a site to itself, or twice to one neighbour.
    """
    numbers = np.arange(math.prod(shape)).reshape(shape)
    wrapped_offset = _wrap_offset(offset, shape, periodic_axes)
    if wrapped_offset != _wrap_offset([-o for o in offset], shape, periodic_axes):
        return np.ones(shape, dtype=bool)
    return numbers < np.roll(numbers, [-o for o in wrapped_offset], axis=range(len(shape)))


def _is_edge_list(graph) -> bool:
    """Return whether a value is a list of edges ``(i, j, weight)``, and not a list of values."""
    return (
        isinstance(graph, list | tuple)
        and len(graph) > 0
        and all(isinstance(e, tuple) and len(e) == 3 and is_integer(e[0]) and is_integer(e[1]) for e in graph)
    )


def _is_exchange_graph(strength, shape: tuple[int, ...]) -> bool:
    """Return whether an exchange is given as a graph: as edges, or as a square matrix not shaped like the lattice."""
    if scipy.sparse.issparse(strength) or _is_edge_list(strength):
        return True
    if isinstance(strength, list) or np.ndim(strength) != 2:
        return False
    matrix_shape = np.shape(strength)
    return matrix_shape[0] == matrix_shape[1] and matrix_shape != shape


def _graph_exchange(shape, graph) -> Energy:
    """Return the Heisenberg exchange along the edges of a graph of sites."""
    count = math.prod(shape)
    edges = graph_edges(graph, count, "the exchange", _SiteNames(), allow_negative=True)
    if len(edges.first) == 0:
        raise InputError("the graph of an exchange has no edges")
    return Each(_exchange_bond_energy, bond_component_indices(edges.first, edges.second), edges.weight)


class _SiteNames(Sequence):
    """Names of any number of sites, formatted on demand."""

    def __getitem__(self, i):
        return f"site {i}"

    def __len__(self) -> int:
        return 0


def _checked_edges_and_vectors(edges, n_sites: int) -> tuple[np.ndarray, jax.Array]:
    """Return the site numbers, shape (m, 2), and vectors D, shape (m, 3), of checked edges ``(i, j, D)``."""
    for i, j, _ in edges:
        if not (0 <= i < n_sites and 0 <= j < n_sites):
            raise InputError(f"the edge ({i}, {j}) must join two of the {n_sites} sites, which are numbered from 0")
        if i == j:
            raise InputError(f"the edge ({i}, {j}) joins a site with itself")
    pairs = [frozenset(edge[:2]) for edge in edges]
    if len(set(pairs)) < len(pairs):
        raise InputError("an edge is given twice, but a pair of sites has one Dzyaloshinskii-Moriya vector")
    D = real_array(np.array([edge[2] for edge in edges], dtype=float))
    if D.shape != (len(pairs), 3):
        raise InputError(f"the vectors D of edges (i, j, D) must have shape ({len(pairs)}, 3) together, got {D.shape}")
    return np.array([edge[:2] for edge in edges], dtype=int), D


def _exchange_bond_energy(y, J):
    """Return ``-J s_1 . s_2`` of two spins y, shape (6,)."""
    return -J * jnp.dot(y[:3], y[3:])


def _antisymmetric_bond_energy(y, D):
    """Return ``D . (s_1 x s_2)`` of two spins y, shape (6,)."""
    return jnp.dot(D, cross(y[:3], y[3:]))
