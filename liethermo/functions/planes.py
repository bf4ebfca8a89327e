"""Functions of many spins, for states that have these component by component, ``(s_1x, s_2x, …, s_1y, …)``.

What is computed of all components x then goes through the memory without gaps, as vector instructions want it.
"""

from __future__ import annotations

import math

import equinox as eqx
import jax
import jax.numpy as jnp

from manifolds.structures.spins import Padded, added, reshaped, summed

from .coordinates import Choice
from .energy import Energy, Negative, Pullback, Sum
from .magnetism import SpinEnergy, off_lattice, on_lattice
from .with_baths import WithBaths


def to_planes(x, count: int) -> jax.Array:
    """States that begin with ``count`` spins site by site, shape (..., n), with these component by component."""
    return _exchanged(x, (count, 3))


def to_sites(x, count: int) -> jax.Array:
    """The inverse of :func:`to_planes`."""
    return _exchanged(x, (3, count))


def _exchanged(x, shape: tuple[int, int]) -> jax.Array:
    front, size = x.shape[:-1], shape[0] * shape[1]
    spins = x if size == x.shape[-1] else x[..., :size]
    spins = jnp.swapaxes(spins.reshape(*front, *shape), -1, -2).reshape(*front, size)
    return spins if size == x.shape[-1] else jnp.concatenate([spins, x[..., size:]], axis=-1)


def by_planes(energy: Energy, count: int) -> Energy:
    """A function of states that are site by site, as one of states that are component by component."""
    terms: list[Energy] = []
    lattice: list[SpinEnergy] = []
    for term in energy.terms:
        if isinstance(term, SpinEnergy) and math.prod(term.sites) == count:
            lattice.append(term)
        else:
            terms.append(_by_planes(term, count))
    if lattice:
        terms.append(InPlanes(tuple(lattice)))
    return Sum.of(terms)


def _by_planes(term: Energy, count: int) -> Energy:
    if isinstance(term, WithBaths):
        return WithBaths(by_planes(term.body, count), term.baths, term.size, term.dim)
    if isinstance(term, Negative):
        return Negative(by_planes(term.term, count))
    return Pullback(term, BySites(count))


class InPlanes(Energy):
    """Energies of all spins: their gradients are added by components, before these become a state's."""

    parts: tuple[SpinEnergy, ...]

    is_quadratic = True

    def value(self, x) -> jax.Array:
        spins = self._spins(x)
        return sum((part.of(spins[part.sites]) for part in self.parts), jnp.zeros(()))

    def gradient(self, x) -> jax.Array:
        spins = self._spins(x)
        found, *others = (part.gradients(spins[part.sites]) for part in self.parts)
        for other in others:
            found = added(found, reshaped(other, found[0].shape))
        return off_lattice(found, x, planar=True)

    def _spins(self, x) -> dict[tuple[int, ...], Padded]:
        """On the lattice of each part."""
        sites = {part.sites for part in self.parts}
        return {shape: Padded(on_lattice(x, shape, planar=True), reach(Sum(self.parts), shape)) for shape in sites}

    def sensitivity(self, x) -> jax.Array:
        spins, found = self._spins(x), jnp.zeros(())
        for part in self.parts:
            here, gradients = spins[part.sites].here, part.gradients(spins[part.sites])
            found = found + jnp.sqrt(summed(gradients, gradients) * summed(here, here))
        return jax.lax.stop_gradient(found)


def reach(energy: Energy, sites: tuple[int, ...]) -> tuple[int, ...]:
    """How far the spins are, along each axis of a lattice, that act on one by its energies."""
    found = [(0,) * len(sites)]
    for term in energy.terms:
        if isinstance(term, WithBaths):
            found.append(reach(term.body, sites))
        elif isinstance(term, SpinEnergy) and term.sites == sites:
            found.append(term.reach)
    return tuple(max(along) for along in zip(*found, strict=True))


class BySites(Choice):
    """A state that is component by component, site by site."""

    count: int = eqx.field(static=True)

    def __call__(self, x):
        return to_sites(x, self.count)
