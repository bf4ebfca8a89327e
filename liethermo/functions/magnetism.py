"""Energies of spins on lattices and graphs: exchange, Dzyaloshinskii-Moriya interaction, anisotropy and Zeeman energy.

Every term is quadratic, so its gradient at a midpoint is a discrete gradient, at a cost proportional to the number of
sites and edges. States begin with the spins, site by site in C order, ``(s_1x, s_1y, s_1z, s_2x, …)``; the other
components do not affect these energies.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy

from manifolds._arrays import is_traced, real_array
from manifolds._names import public_dir
from manifolds.structures.spins import (
    Lattice,
    VectorComponents,
    add_vectors,
    cross,
    cross_vectors,
    dot_vectors,
    reshape_vectors,
    scale_vectors,
    spins_from_state,
    split_vectors,
    state_from_spins,
    sum_of_dots,
)

from ..errors import InputError
from .conditions import checked_numbers
from .each import Each
from .edges import graph_edges
from .energy import Energy, Sum
from .indices import clique_pattern

__all__ = ["anisotropy", "dzyaloshinskii_moriya", "exchange", "zeeman"]
__dir__ = public_dir(__all__)


def exchange(sites, strength=1.0, neighbours=None, periodic=True) -> Energy:
    """Return the Heisenberg exchange, ``-sum J_ij s_i . s_j`` over pairs of sites: J > 0 aligns neighbours.

    Parameters
    ----------
    sites : int or tuple of int
        A tuple, such as ``(64, 64)``, for a lattice.
    strength : float, or array; or graph
        J: one number for all pairs; an array of the shape of the sites, for the pair of each site and its neighbour
        ahead (or a list of such arrays, one for each neighbour). Or, with ``neighbours=None``, the graph: a symmetric
        matrix of all sites, dense or sparse, or a list of edges ``(i, j, J)``, each pair once, sites in C order.
    neighbours : sequence of tuples of int, optional
        Offsets to the neighbours ahead on a lattice, one of each two opposite offsets; by default one along every axis.
    periodic : bool or tuple of bool
        Whether the lattice is periodic, along each axis.

    Returns
    -------
    Energy

    Raises
    ------
    InputError
    """
    shape = lattice_shape(sites)
    if neighbours is None and _is_graph(strength, shape):
        return _graph_exchange(shape, strength)
    return _lattice_bond_energy(shape, strength, None, neighbours, periodic, "an exchange constant")


def dzyaloshinskii_moriya(sites, vectors, neighbours=None, periodic=True) -> Energy:
    """Return the antisymmetric exchange, ``sum D_ij . (s_i x s_j)`` over pairs of sites, which cants neighbours.

    Parameters
    ----------
    sites : int or tuple of int
    vectors : array, shape (3,), or ``(*sites, 3)``; or a list of them, one for each neighbour; or list of edges
        D of the pair of each site and its neighbour ahead, such as ``[(0, D, 0), (-D, 0, 0)]`` on a square lattice; or
        edges ``(i, j, D)``, with D from i to j.
    neighbours, periodic
        See :func:`exchange`.

    Returns
    -------
    Energy

    Raises
    ------
    InputError
    """
    shape = lattice_shape(sites)
    if neighbours is None and _is_edge_list(vectors) and all(np.ndim(edge[2]) == 1 for edge in vectors):
        ends, D = _checked_edges_and_vectors(vectors, math.prod(shape))
        return Each(_antisymmetric_bond_energy, _bond_indices(ends[:, 0], ends[:, 1]), D)
    return _lattice_bond_energy(shape, None, vectors, neighbours, periodic, "a Dzyaloshinskii-Moriya vector")


def anisotropy(sites, strength=1.0, axis=(0.0, 0.0, 1.0)) -> Energy:
    """Return the uniaxial anisotropy, ``-sum K_i (n_i . s_i)^2``: an easy axis for K > 0, a hard axis for K < 0.

    Parameters
    ----------
    sites : int or tuple of int
    strength : float, or array of the shape of the sites
        K_i.
    axis : array, shape (3,) or ``(*sites, 3)``
        n_i, which is not normalised.

    Returns
    -------
    Energy

    Raises
    ------
    InputError
    """
    shape = lattice_shape(sites)
    K = _checked_site_values(strength, shape, (), "an anisotropy constant")
    n = _checked_site_values(axis, shape, (3,), "an axis")
    if not is_traced((K, n)) and not (np.count_nonzero(np.asarray(n), axis=-1) > 1).any():  # every axis is x, y or z
        return SiteEnergy(shape, -2.0 * K[..., None] * n**2, None, None)
    return SiteEnergy(shape, -2.0 * K, None, n)


def zeeman(sites, field, moment=1.0) -> Energy:
    """Return the energy in a magnetic field, ``-sum mu_i B_i . s_i``.

    Parameters
    ----------
    sites : int or tuple of int
    field : array, shape (3,) or ``(*sites, 3)``
        B_i.
    moment : float, or array of the shape of the sites
        mu_i.

    Returns
    -------
    Energy

    Raises
    ------
    InputError
    """
    shape = lattice_shape(sites)
    B, moment = _checked_site_values(field, shape, (3,), "a field"), _checked_site_values(moment, shape, (), "a moment")
    return SiteEnergy(shape, None, -moment[..., None] * B, None)


class SpinEnergy(Energy):
    """A quadratic energy of spins on a lattice, computed component by component on arrays of the shape of the sites.

    Attributes
    ----------
    sites : tuple of int
    interaction_range : tuple of int
        Largest distance, along each axis, of two spins that interact.
    """

    sites: tuple[int, ...] = eqx.field(static=True)

    @property
    def interaction_range(self) -> tuple[int, ...]:
        return (0,) * len(self.sites)

    @abstractmethod
    def lattice_value(self, spins: Lattice) -> jax.Array:
        """Return the energy of the spins, shape ()."""

    @abstractmethod
    def lattice_gradients(self, spins: Lattice) -> VectorComponents:
        """Return the gradients by the spins."""

    is_quadratic = True

    def value(self, x) -> jax.Array:
        return self.lattice_value(Lattice(lattice_spins(x, self.sites)))

    def gradient(self, x) -> jax.Array:
        return flatten_covectors(self.lattice_gradients(Lattice(lattice_spins(x, self.sites))), x)

    def check_components(self, dim: int, role: str) -> None:
        check_spin_count(self.sites, dim, role)


class SiteEnergy(SpinEnergy):
    """The energy ``sum_i A_i (n_i . s_i)^2 / 2 + b_i . s_i``; without n, the first term is ``sum_ic A_ic s_ic^2 / 2``.

    Attributes
    ----------
    A : array, shape () or that of the sites; (3,) or ``(*sites, 3)`` without n; or None
    b, n : array, shape (3,) or ``(*sites, 3)``, or None
    """

    A: jax.Array | None
    b: jax.Array | None
    n: jax.Array | None

    def lattice_value(self, spins: Lattice) -> jax.Array:
        linear = jnp.zeros(()) if self.b is None else sum_of_dots(split_vectors(self.b), spins.site_spins)
        return linear + (
            0.0 if self.A is None else 0.5 * sum_of_dots(self._quadratic_gradient(spins.site_spins), spins.site_spins)
        )

    def lattice_gradients(self, spins: Lattice) -> VectorComponents:
        if self.A is None:
            assert self.b is not None
            a, b, c = (jnp.broadcast_to(component, self.sites) for component in split_vectors(self.b))
            return a, b, c
        quadratic_gradient = self._quadratic_gradient(spins.site_spins)
        return quadratic_gradient if self.b is None else add_vectors(quadratic_gradient, split_vectors(self.b))

    def _quadratic_gradient(self, spins: VectorComponents) -> VectorComponents:
        """Return ``A_i (n_i . s_i) n_i``."""
        assert self.A is not None
        if self.n is None:
            A = split_vectors(self.A)
            return A[0] * spins[0], A[1] * spins[1], A[2] * spins[2]
        n = split_vectors(self.n)
        return scale_vectors(self.A * dot_vectors(n, spins), n)

    def couplings(self, dim: int) -> scipy.sparse.csr_array:
        return clique_pattern(np.arange(3 * math.prod(self.sites)).reshape(-1, 3), dim)


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

    def lattice_value(self, spins: Lattice) -> jax.Array:
        return sum_of_dots(self._neighbour_gradient(spins.at(self.offset), self.J, self.D), spins.site_spins)

    def lattice_gradients(self, spins: Lattice) -> VectorComponents:
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

    def couplings(self, dim: int) -> scipy.sparse.csr_array:
        site_numbers = np.arange(math.prod(self.sites)).reshape(self.sites)
        neighbour_numbers = np.roll(site_numbers, [-shift for shift in self.offset], axis=range(site_numbers.ndim))
        return clique_pattern(_bond_indices(site_numbers.ravel(), neighbour_numbers.ravel()), dim)


def lattice_spins(x, sites: tuple[int, ...], planar: bool = False) -> VectorComponents:
    """Return the components of the spins of a state, each of the shape of the sites."""
    return reshape_vectors(spins_from_state(x, math.prod(sites), planar), sites)


def flatten_covectors(covectors: VectorComponents, x, planar: bool = False) -> jax.Array:
    """Return covectors of the spins as one covector of the state x."""
    return state_from_spins(reshape_vectors(covectors, (-1,)), jnp.zeros(x.size - 3 * covectors[0].size), planar)


def lattice_shape(sites) -> tuple[int, ...]:
    """Return the shape of a lattice as a tuple; an integer becomes a tuple of one entry."""
    shape = tuple(sites) if isinstance(sites, tuple | list) else (sites,)
    is_valid = all(isinstance(n, int | np.integer) and not isinstance(n, bool) and n >= 1 for n in shape)
    if not shape or not is_valid:
        raise InputError(f"sites must be a positive integer, or a tuple for a lattice such as (64, 64), got {sites!r}")
    return tuple(int(n) for n in shape)


def check_spin_count(sites: tuple[int, ...], dim: int, role: str) -> None:
    """Raise InputError if a state has fewer components than the spins of a term."""
    count = math.prod(sites)
    if 3 * count > dim:
        raise InputError(f"{role} has a term of {count} spins, so the state needs {3 * count} components, got {dim}")


def _lattice_bond_energy(shape, strength, vectors, neighbours, periodic, what: str) -> Energy:
    axes = len(shape)
    offsets = np.eye(axes, dtype=int).tolist() if neighbours is None else neighbours
    offsets = [_checked_offset(offset, axes) for offset in offsets]
    if any(opposite in offsets for opposite in ([-o for o in offset] for offset in offsets)):
        raise InputError(f"the neighbours {offsets} name a pair twice. Give one of each two opposite offsets")
    periodic_axes = (periodic,) * axes if isinstance(periodic, bool) else tuple(periodic)
    if len(periodic_axes) != axes:
        raise InputError(f"periodic must be True or False, or one for each of the {axes} axes, got {periodic!r}")
    coupling = strength if vectors is None else vectors
    couplings = (
        coupling
        if isinstance(coupling, list | tuple) and len(coupling) == len(offsets) and np.ndim(coupling[0])
        else [coupling] * len(offsets)
    )
    tail = () if vectors is None else (3,)
    terms = []
    for offset, offset_coupling in zip(offsets, couplings, strict=True):
        value = _checked_site_values(offset_coupling, shape, tail, what)
        has_neighbour = _neighbour_mask(shape, offset, periodic_axes)
        if not has_neighbour.all():  # no pairs across the border
            value = jnp.where(has_neighbour.reshape(*shape, *(1 for _ in tail)), value, 0.0)
        terms.append(
            BondEnergy(shape, tuple(offset), value, None)
            if vectors is None
            else BondEnergy(shape, tuple(offset), None, value)
        )
    return Sum.of(terms)


def _checked_offset(offset, axes: int) -> list[int]:
    components = [offset] if np.ndim(offset) == 0 else list(offset)
    if len(components) != axes or any(int(o) != o for o in components) or not any(components):
        raise InputError(f"a neighbour must be an offset of {axes} integers, not all zero, got {offset!r}")
    return [int(o) for o in components]


def _neighbour_mask(shape, offset, periodic_axes) -> np.ndarray:
    """Return which sites have a neighbour at an offset, as an array of the shape of the sites."""
    has_neighbour = np.ones(shape, dtype=bool)
    for axis, (n, shift, is_periodic) in enumerate(zip(shape, offset, periodic_axes, strict=True)):
        indices = np.arange(n) + shift
        is_inside_axis = (np.ones(n, dtype=bool) if is_periodic else (indices >= 0) & (indices < n)).reshape(
            [-1 if a == axis else 1 for a in range(len(shape))]
        )
        has_neighbour = has_neighbour & is_inside_axis
    return has_neighbour


def _checked_site_values(value, shape, tail: tuple[int, ...], what: str) -> jax.Array:
    """Return a value, given once or for each site, as an array; InputError unless its shape fits and it is finite."""
    array = checked_numbers(value, what)
    if array.shape not in (tail, (*shape, *tail)):
        expected_shapes = f"{tail} or {(*shape, *tail)}" if tail else f"() or {shape}"
        raise InputError(f"{what} must have shape {expected_shapes}, got {array.shape}")
    if not is_traced(array) and not np.isfinite(np.asarray(array)).all():
        raise InputError(f"{what} must be finite, got {np.asarray(array).tolist()}")
    return array


def _is_edge_list(graph) -> bool:
    """Return whether a value is a list of edges ``(i, j, weight)``, and not a list of values."""
    return (
        isinstance(graph, list | tuple)
        and len(graph) > 0
        and all(isinstance(e, tuple) and len(e) == 3 and _is_integer(e[0]) and _is_integer(e[1]) for e in graph)
    )


def _is_integer(value) -> bool:
    return isinstance(value, int | np.integer) and not isinstance(value, bool)


def _is_graph(strength, shape: tuple[int, ...]) -> bool:
    """Return whether an exchange is given as a graph: as edges, or as a square matrix not shaped like the lattice."""
    if scipy.sparse.issparse(strength) or _is_edge_list(strength):
        return True
    if isinstance(strength, list) or np.ndim(strength) != 2:
        return False
    matrix_shape = np.shape(strength)
    return matrix_shape[0] == matrix_shape[1] and matrix_shape != shape


def _graph_exchange(shape, graph) -> Energy:
    count = math.prod(shape)
    edges = graph_edges(graph, count, "the exchange", _SiteNames(), allow_negative=True)
    if len(edges.first) == 0:
        raise InputError("the graph of an exchange has no edges")
    return Each(_exchange_bond_energy, _bond_indices(edges.first, edges.second), edges.weight)


class _SiteNames(Sequence):
    """Names of any number of sites, formatted on demand."""

    def __getitem__(self, i):
        return f"site {i}"

    def __len__(self) -> int:
        return 0


def _checked_edges_and_vectors(edges, count: int) -> tuple[np.ndarray, jax.Array]:
    for i, j, _ in edges:
        if not (0 <= i < count and 0 <= j < count):
            raise InputError(f"the edge ({i}, {j}) must join two of the {count} sites, which are numbered from 0")
        if i == j:
            raise InputError(f"the edge ({i}, {j}) joins a site with itself")
    pairs = [frozenset(edge[:2]) for edge in edges]
    if len(set(pairs)) < len(pairs):
        raise InputError("an edge is given twice, but a pair of sites has one Dzyaloshinskii-Moriya vector")
    D = real_array(np.array([edge[2] for edge in edges], dtype=float))
    if D.shape != (len(pairs), 3):
        raise InputError(f"the vectors D of edges (i, j, D) must have shape ({len(pairs)}, 3) together, got {D.shape}")
    return np.array([edge[:2] for edge in edges], dtype=int), D


def _bond_indices(first, second) -> np.ndarray:
    """Return the indices of the components of two spins, shape (edges, 6)."""
    ends = np.stack([first, second], axis=1)
    return (3 * ends[:, :, None] + np.arange(3)).reshape(len(ends), 6)


def _exchange_bond_energy(y, J):
    return -J * jnp.dot(y[:3], y[3:])


def _antisymmetric_bond_energy(y, D):
    return jnp.dot(D, cross(y[:3], y[3:]))
