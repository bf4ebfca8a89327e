"""Energies of spins on sites: exchange, Dzyaloshinskii-Moriya, anisotropy, Zeeman, on lattices and on any graph.

Every term is quadratic, so its gradient at a midpoint is a discrete gradient, and costs what there are sites and edges.
States hold the spins first, site by site in C order, ``(s_1x, s_1y, s_1z, s_2x, …)``; what comes behind is left alone.
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
from .conditions import check_numbers
from .each import Each
from .edges import graph_edges
from .energy import Energy, Sum
from .indices import clique_pattern

__all__ = ["anisotropy", "dzyaloshinskii_moriya", "exchange", "zeeman"]
__dir__ = public_dir(__all__)


def exchange(sites, strength=1.0, neighbours=None, periodic=True) -> Energy:
    """Heisenberg exchange, ``-sum J_ij s_i . s_j`` over pairs: J > 0 aligns neighbours.

    Parameters
    ----------
    sites : int or tuple of int
        A tuple, such as ``(64, 64)``, for a lattice.
    strength : float, or array; or graph
        J: one number for all pairs; an array of the shape of the sites, that of the pair of each site with the one
        ahead (or a list of such, one for each neighbour). Or, with ``neighbours=None``, the graph itself: a symmetric
        matrix of all sites, dense or sparse, or a list of edges ``(i, j, J)``, each pair once, sites in C order.
    neighbours : sequence of tuples of int, optional
        Offsets to the sites ahead on a lattice, each pair of opposite ones once: by default one along every axis.
    periodic : bool or tuple of bool
        Whether the lattice closes on itself, along each axis.

    Raises
    ------
    InputError
    """
    shape = lattice_shape(sites)
    if neighbours is None and _is_graph(strength, shape):
        return _graph_exchange(shape, strength)
    return _lattice_energy(shape, strength, None, neighbours, periodic, "an exchange constant")


def dzyaloshinskii_moriya(sites, vectors, neighbours=None, periodic=True) -> Energy:
    """Antisymmetric exchange, ``sum D_ij . (s_i x s_j)`` over pairs: it turns neighbours against each other.

    Parameters
    ----------
    sites : int or tuple of int
    vectors : array, shape (3,), or ``(*sites, 3)``; or a list of them, one for each neighbour; or list of edges
        D of each pair of a site with the one ahead, such as ``[(0, D, 0), (-D, 0, 0)]`` on a square lattice; or edges
        ``(i, j, D)``, D being that from i to j.
    neighbours, periodic
        As of :func:`exchange`.

    Raises
    ------
    InputError
    """
    shape = lattice_shape(sites)
    if neighbours is None and _is_edge_list(vectors) and all(np.ndim(edge[2]) == 1 for edge in vectors):
        ends, D = _directed_edges(vectors, math.prod(shape))
        return Each(_antisymmetric_bond, _bond_indices(ends[:, 0], ends[:, 1]), D)
    return _lattice_energy(shape, None, vectors, neighbours, periodic, "a Dzyaloshinskii-Moriya vector")


def anisotropy(sites, strength=1.0, axis=(0.0, 0.0, 1.0)) -> Energy:
    """Uniaxial anisotropy, ``-sum K_i (n_i . s_i)^2``: an easy axis for K > 0, a hard one for K < 0.

    Parameters
    ----------
    sites : int or tuple of int
    strength : float, or array of the shape of the sites
    axis : array, shape (3,) or ``(*sites, 3)``
        n_i; its length counts.

    Raises
    ------
    InputError
    """
    shape = lattice_shape(sites)
    K = _site_values(strength, shape, (), "an anisotropy constant")
    n = _site_values(axis, shape, (3,), "an axis")
    if not is_traced((K, n)) and not (np.count_nonzero(np.asarray(n), axis=-1) > 1).any():  # along axes of space
        return SiteEnergy(shape, -2.0 * K[..., None] * n**2, None, None)
    return SiteEnergy(shape, -2.0 * K, None, n)


def zeeman(sites, field, moment=1.0) -> Energy:
    """The energy in a field, ``-sum mu_i B_i . s_i``.

    Parameters
    ----------
    sites : int or tuple of int
    field : array, shape (3,) or ``(*sites, 3)``
    moment : float, or array of the shape of the sites

    Raises
    ------
    InputError
    """
    shape = lattice_shape(sites)
    B, moment = _site_values(field, shape, (3,), "a field"), _site_values(moment, shape, (), "a moment")
    return SiteEnergy(shape, None, -moment[..., None] * B, None)


class SpinEnergy(Energy):
    """A quadratic energy of spins on a lattice, written down by their components: arrays of the shape of the sites.

    Attributes
    ----------
    sites : tuple of int
    interaction_range : tuple of int
        How far, along each axis, the spins are that act on one.
    """

    sites: tuple[int, ...] = eqx.field(static=True)

    @property
    def interaction_range(self) -> tuple[int, ...]:
        return (0,) * len(self.sites)

    @abstractmethod
    def lattice_value(self, spins: Lattice) -> jax.Array:
        """The value, shape ()."""

    @abstractmethod
    def lattice_gradients(self, spins: Lattice) -> VectorComponents:
        """The gradients by the spins."""

    is_quadratic = True

    def value(self, x) -> jax.Array:
        return self.lattice_value(Lattice(lattice_spins(x, self.sites)))

    def gradient(self, x) -> jax.Array:
        return flatten_covectors(self.lattice_gradients(Lattice(lattice_spins(x, self.sites))), x)

    def check_components(self, dim: int, role: str) -> None:
        check_spin_count(self.sites, dim, role)


class SiteEnergy(SpinEnergy):
    """``sum_i A_i (n_i . s_i)^2 / 2 + b_i . s_i``; without n ``sum_ic A_ic s_ic^2 / 2``, c a component.

    Attributes
    ----------
    A : array, shape () or that of the sites, (3,) or ``(*sites, 3)`` without n, or None
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
        drawn = self._quadratic_gradient(spins.site_spins)
        return drawn if self.b is None else add_vectors(drawn, split_vectors(self.b))

    def _quadratic_gradient(self, spins: VectorComponents) -> VectorComponents:
        """``A_i (n_i . s_i) n_i``."""
        assert self.A is not None
        if self.n is None:
            A = split_vectors(self.A)
            return A[0] * spins[0], A[1] * spins[1], A[2] * spins[2]
        n = split_vectors(self.n)
        return scale_vectors(self.A * dot_vectors(n, spins), n)

    def couplings(self, dim: int) -> scipy.sparse.csr_array:
        return clique_pattern(np.arange(3 * math.prod(self.sites)).reshape(-1, 3), dim)


class BondEnergy(SpinEnergy):
    """``sum_i -J_i s_i . s_{i+o} + D_i . (s_i x s_{i+o})`` on a lattice, o an offset.

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
        ahead, behind = spins.at(self.offset), spins.at([-o for o in self.offset])
        if self.D is None and self.J is not None and not self.J.ndim:
            return scale_vectors(-self.J, add_vectors(ahead, behind))
        axes = range(len(self.sites))
        J = self.J if self.J is None or not self.J.ndim else jnp.roll(self.J, self.offset, axes)
        D = self.D if self.D is None or self.D.ndim == 1 else jnp.roll(self.D, self.offset, axes)
        return add_vectors(
            self._neighbour_gradient(ahead, self.J, self.D),
            self._neighbour_gradient(behind, J, None if D is None else -D),
        )

    @staticmethod
    def _neighbour_gradient(s: VectorComponents, J: jax.Array | None, D: jax.Array | None) -> VectorComponents:
        """What a neighbour s gives to a site: ``-J s + s x D``."""
        aligned = None if J is None else scale_vectors(-J, s)
        if D is not None:
            turned = cross_vectors(s, split_vectors(D))
            return turned if aligned is None else add_vectors(aligned, turned)
        assert aligned is not None
        return aligned

    def couplings(self, dim: int) -> scipy.sparse.csr_array:
        here = np.arange(math.prod(self.sites)).reshape(self.sites)
        ahead = np.roll(here, [-by for by in self.offset], axis=range(here.ndim))
        return clique_pattern(_bond_indices(here.ravel(), ahead.ravel()), dim)


def lattice_spins(x, sites: tuple[int, ...], planar: bool = False) -> VectorComponents:
    """The components of the spins of a state, each of the shape of the sites."""
    return reshape_vectors(spins_from_state(x, math.prod(sites), planar), sites)


def flatten_covectors(covectors: VectorComponents, x, planar: bool = False) -> jax.Array:
    """Covectors of the spins as one of the state x."""
    return state_from_spins(reshape_vectors(covectors, (-1,)), jnp.zeros(x.size - 3 * covectors[0].size), planar)


def lattice_shape(sites) -> tuple[int, ...]:
    """The shape of a lattice, or (count,)."""
    shape = tuple(sites) if isinstance(sites, tuple | list) else (sites,)
    good = all(isinstance(n, int | np.integer) and not isinstance(n, bool) and n >= 1 for n in shape)
    if not shape or not good:
        raise InputError(f"sites are a positive integer, or some for a lattice such as (64, 64), not {sites!r}")
    return tuple(int(n) for n in shape)


def check_spin_count(sites: tuple[int, ...], dim: int, role: str) -> None:
    """InputError where a state has no room for the spins that a term is of."""
    count = math.prod(sites)
    if 3 * count > dim:
        raise InputError(f"{role} has a term of {count} spins, which a state with {dim} components has no room for")


def _lattice_energy(shape, strength, vectors, neighbours, periodic, what: str) -> Energy:
    axes = len(shape)
    offsets = np.eye(axes, dtype=int).tolist() if neighbours is None else neighbours
    offsets = [_check_offset(offset, axes) for offset in offsets]
    if any(opposite in offsets for opposite in ([-o for o in offset] for offset in offsets)):
        raise InputError(f"the neighbours {offsets} name a pair twice: give one of each two opposite offsets")
    closed = (periodic,) * axes if isinstance(periodic, bool) else tuple(periodic)
    if len(closed) != axes:
        raise InputError(f"periodic is true or false, or such for each of the {axes} axes, not {periodic!r}")
    given = strength if vectors is None else vectors
    each = (
        given
        if isinstance(given, list | tuple) and len(given) == len(offsets) and np.ndim(given[0])
        else [given] * len(offsets)
    )
    tail = () if vectors is None else (3,)
    terms = []
    for offset, one in zip(offsets, each, strict=True):
        value = _site_values(one, shape, tail, what)
        inside = _has_neighbour(shape, offset, closed)
        if not inside.all():  # pairs that a border cuts
            value = jnp.where(inside.reshape(*shape, *(1 for _ in tail)), value, 0.0)
        terms.append(
            BondEnergy(shape, tuple(offset), value, None)
            if vectors is None
            else BondEnergy(shape, tuple(offset), None, value)
        )
    return Sum.of(terms)


def _check_offset(offset, axes: int) -> list[int]:
    found = [offset] if np.ndim(offset) == 0 else list(offset)
    if len(found) != axes or any(int(o) != o for o in found) or not any(found):
        raise InputError(f"a neighbour is an offset of {axes} integers, not all zero, not {offset!r}")
    return [int(o) for o in found]


def _has_neighbour(shape, offset, closed) -> np.ndarray:
    """Which sites have the one ahead, shape of the sites."""
    inside = np.ones(shape, dtype=bool)
    for axis, (n, by, around) in enumerate(zip(shape, offset, closed, strict=True)):
        place = np.arange(n) + by
        here = (np.ones(n, dtype=bool) if around else (place >= 0) & (place < n)).reshape(
            [-1 if a == axis else 1 for a in range(len(shape))]
        )
        inside = inside & here
    return inside


def _site_values(value, shape, tail: tuple[int, ...], what: str) -> jax.Array:
    """A value of all sites, or one for each."""
    array = check_numbers(value, what)
    if array.shape not in (tail, (*shape, *tail)):
        wanted = f"{tail} or {(*shape, *tail)}" if tail else f"of one number, or {shape}"
        raise InputError(f"{what} has the shape {wanted}, not {array.shape}")
    if not is_traced(array) and not np.isfinite(np.asarray(array)).all():
        raise InputError(f"{what} is not finite")
    return array


def _is_edge_list(graph) -> bool:
    """Return whether these are edges ``(i, j, weight)``, two integers first, and not a list of values."""
    return (
        isinstance(graph, list | tuple)
        and len(graph) > 0
        and all(isinstance(e, tuple) and len(e) == 3 and _is_integer(e[0]) and _is_integer(e[1]) for e in graph)
    )


def _is_integer(value) -> bool:
    return isinstance(value, int | np.integer) and not isinstance(value, bool)


def _is_graph(strength, shape: tuple[int, ...]) -> bool:
    """Return whether an exchange is given on a graph: a square matrix, unless it has the shape of a lattice."""
    if scipy.sparse.issparse(strength) or _is_edge_list(strength):
        return True
    if isinstance(strength, list) or np.ndim(strength) != 2:
        return False
    given = np.shape(strength)
    return given[0] == given[1] and given != shape


def _graph_exchange(shape, graph) -> Energy:
    count = math.prod(shape)
    found = graph_edges(graph, count, "the exchange", _SiteNames(), allow_negative=True)
    if len(found.first) == 0:
        raise InputError("the graph of an exchange has no edges")
    return Each(_exchange_bond, _bond_indices(found.first, found.second), found.weight)


class _SiteNames(Sequence):
    """Names of any number of sites, made when one is asked for."""

    def __getitem__(self, i):
        return f"site {i}"

    def __len__(self) -> int:
        return 0


def _directed_edges(listed, count: int) -> tuple[np.ndarray, jax.Array]:
    for i, j, _ in listed:
        if not (0 <= i < count and 0 <= j < count):
            raise InputError(f"the edge ({i}, {j}) leaves the {count} sites, which count from 0")
        if i == j:
            raise InputError(f"the edge ({i}, {j}) joins a site with itself")
    pairs = [frozenset(edge[:2]) for edge in listed]
    if len(set(pairs)) < len(pairs):
        raise InputError("an edge is given twice: a pair of sites has one Dzyaloshinskii-Moriya vector")
    D = real_array(np.array([edge[2] for edge in listed], dtype=float))
    if D.shape != (len(pairs), 3):
        raise InputError(f"an edge (i, j, D) has a vector D, shape (3,), but together they have shape {D.shape}")
    return np.array([edge[:2] for edge in listed], dtype=int), D


def _bond_indices(first, second) -> np.ndarray:
    """The components of two spins, shape (edges, 6)."""
    ends = np.stack([first, second], axis=1)
    return (3 * ends[:, :, None] + np.arange(3)).reshape(len(ends), 6)


def _exchange_bond(y, J):
    return -J * jnp.dot(y[:3], y[3:])


def _antisymmetric_bond(y, D):
    return jnp.dot(D, cross(y[:3], y[3:]))
