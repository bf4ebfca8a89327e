"""Energies of points of a space, and of coordinates around a point."""

from __future__ import annotations

from collections.abc import Callable

import equinox as eqx
import jax

import manifolds as mf

from .energy import Energy, Quadratic, Sum, TimeDependent


class OfPoint(Energy):
    """A function of the points of a space, as a function of their vectors, shape (n,)."""

    energy: Energy
    space: mf.Space = eqx.field(static=True)

    def value(self, x) -> jax.Array:
        return self.energy.value(self.space.from_vector(x))


def on_points(energy: Energy, space: mf.Space | None) -> Energy:
    """An energy of the points of a space as one of their vectors; an lt.Quadratic is one of vectors already."""
    if space is None or space.shape == (space.size,):
        return energy
    terms = tuple(_on_points(term, space) for term in energy.terms)
    return terms[0] if len(terms) == 1 else Sum(terms)


def _on_points(term: Energy, space: mf.Space) -> Energy:
    if isinstance(term, TimeDependent):
        return TimeDependent(_OfPointAndTime(term.function, space))
    return term if isinstance(term, Quadratic) else OfPoint(term, space)


class _OfPointAndTime(eqx.Module):
    function: Callable
    space: mf.Space = eqx.field(static=True)

    def __call__(self, x, t):
        return self.function(self.space.from_vector(x), t)
