"""Energies of points of a space, and of states on sites, as energies of flat states."""

from __future__ import annotations

import math
from collections.abc import Callable

import equinox as eqx
import jax

import manifolds as mf
from manifolds._pytree_module import Module

from .energy import Energy, Function, Multiple, Negative, Quadratic, Sum, TimeDependent


class PointEnergy(Energy):
    """A function of the points of a space, as a function of their vectors, shape (n,)."""

    energy: Energy
    space: mf.Space = eqx.field(static=True)

    def value(self, x) -> jax.Array:
        return self.energy.value(self.space.from_vector(x))


def energy_of_vectors(energy: Energy, space: mf.Space | None) -> Energy:
    """Return an energy of the points of a space as one of their vectors; an lt.Quadratic is returned unchanged."""
    if space is None or space.shape == (space.size,):
        return energy
    return energy.map_terms(lambda term: _term_on_state_vectors(term, space))


def _term_on_state_vectors(term: Energy, space: mf.Space) -> Energy:
    if isinstance(term, TimeDependent):
        return TimeDependent(_PointTimeFunction(term.function, space))
    return term if isinstance(term, Quadratic) else PointEnergy(term, space)


class _PointTimeFunction(Module):
    """A function of a point and the time, as a function of the vector of the point and the time."""

    function: Callable
    space: mf.Space = eqx.field(static=True)

    def __call__(self, x, t):
        return self.function(self.space.from_vector(x), t)


def flatten_site_functions(tree, shape: tuple[int, ...]):
    """Return a pytree with plain functions of states of this shape replaced by functions of flat states, shape (n,).

    Energies of other classes and Casimirs of algebras are functions of flat states already.
    """
    if len(shape) == 1:
        return tree
    return jax.tree_util.tree_map(
        lambda node: _flatten_site_energy(node, shape) if isinstance(node, Energy) else node,
        tree,
        is_leaf=lambda node: isinstance(node, Energy),
    )


def _flatten_site_energy(energy: Energy, shape: tuple[int, ...]) -> Energy:
    if isinstance(energy, Sum):
        return Sum(tuple(_flatten_site_energy(term, shape) for term in energy.summands))
    if isinstance(energy, Negative):
        return Negative(_flatten_site_energy(energy.term, shape))
    if isinstance(energy, Multiple):
        return Multiple(_flatten_site_energy(energy.term, shape), energy.factor)
    if isinstance(energy, Function | TimeDependent):
        is_flat = getattr(energy.function, "dim", None) == math.prod(shape)  # a Casimir of the whole algebra
        return energy if is_flat else type(energy)(_FlattenedFunction(energy.function, shape))
    return energy


class _FlattenedFunction(Module):
    """A function of states of some shape, as a function of flat states."""

    function: Callable
    shape: tuple[int, ...] = eqx.field(static=True)

    @property
    def __name__(self) -> str:
        return getattr(self.function, "__name__", type(self.function).__name__)

    def __call__(self, x, *time):
        return self.function(x.reshape(self.shape), *time)
