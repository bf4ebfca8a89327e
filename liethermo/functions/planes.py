"""Functions of many spins, for states that have these component by component, ``(s_1x, s_2x, …, s_1y, …)``.

What is computed of all components x then goes through the memory without gaps, as vector instructions want it.
"""

from __future__ import annotations

import math

import equinox as eqx
import jax
import jax.numpy as jnp

from manifolds.structures.spins import PaddedLattice, add_vectors, reshape_vectors, sum_of_dots

from .coordinates import ComponentMap
from .energy import Energy, Negative, Pullback, Sum
from .magnetism import SpinEnergy, flatten_covectors, lattice_spins
from .with_baths import BodyBathsEnergy


def to_planes(x, count: int) -> jax.Array:
    """States that begin with ``count`` spins site by site, shape (..., n), with these component by component."""
    return _transpose_spins(x, (count, 3))


def to_sites(x, count: int) -> jax.Array:
    """The inverse of :func:`to_planes`."""
    return _transpose_spins(x, (3, count))


def _transpose_spins(x, shape: tuple[int, int]) -> jax.Array:
    front, size = x.shape[:-1], shape[0] * shape[1]
    spins = x if size == x.shape[-1] else x[..., :size]
    spins = jnp.swapaxes(spins.reshape(*front, *shape), -1, -2).reshape(*front, size)
    return spins if size == x.shape[-1] else jnp.concatenate([spins, x[..., size:]], axis=-1)


def planar_energy(energy: Energy, count: int) -> Energy:
    """A function of states that are site by site, as one of states that are component by component."""
    terms: list[Energy] = []
    lattice: list[SpinEnergy] = []
    for term in energy.terms:
        if isinstance(term, SpinEnergy) and math.prod(term.sites) == count:
            lattice.append(term)
        else:
            terms.append(_planar_term(term, count))
    if lattice:
        terms.append(PlanarSpinEnergy(tuple(lattice)))
    return Sum.of(terms)


def _planar_term(term: Energy, count: int) -> Energy:
    if isinstance(term, BodyBathsEnergy):
        return BodyBathsEnergy(planar_energy(term.body, count), term.baths, term.body_dim, term.dim)
    if isinstance(term, Negative):
        return Negative(planar_energy(term.term, count))
    return Pullback(term, SiteOrder(count))


class PlanarSpinEnergy(Energy):
    """Energies of all spins: their gradients are added by components, before these become a state's."""

    spin_energies: tuple[SpinEnergy, ...]

    is_quadratic = True

    def value(self, x) -> jax.Array:
        spins = self._padded_spins(x)
        return sum((part.lattice_value(spins[part.sites]) for part in self.spin_energies), jnp.zeros(()))

    def gradient(self, x) -> jax.Array:
        spins = self._padded_spins(x)
        found, *others = (part.lattice_gradients(spins[part.sites]) for part in self.spin_energies)
        for other in others:
            found = add_vectors(found, reshape_vectors(other, found[0].shape))
        return flatten_covectors(found, x, planar=True)

    def _padded_spins(self, x) -> dict[tuple[int, ...], PaddedLattice]:
        """On the lattice of each part."""
        sites = {part.sites for part in self.spin_energies}
        return {
            shape: PaddedLattice(
                lattice_spins(x, shape, planar=True), interaction_range(Sum(self.spin_energies), shape)
            )
            for shape in sites
        }

    def sensitivity(self, x) -> jax.Array:
        spins, found = self._padded_spins(x), jnp.zeros(())
        for part in self.spin_energies:
            here, gradients = spins[part.sites].site_spins, part.lattice_gradients(spins[part.sites])
            found = found + jnp.sqrt(sum_of_dots(gradients, gradients) * sum_of_dots(here, here))
        return jax.lax.stop_gradient(found)


def interaction_range(energy: Energy, sites: tuple[int, ...]) -> tuple[int, ...]:
    """How far the spins are, along each axis of a lattice, that act on one by its energies."""
    found = [(0,) * len(sites)]
    for term in energy.terms:
        if isinstance(term, BodyBathsEnergy):
            found.append(interaction_range(term.body, sites))
        elif isinstance(term, SpinEnergy) and term.sites == sites:
            found.append(term.interaction_range)
    return tuple(max(along) for along in zip(*found, strict=True))


class SiteOrder(ComponentMap):
    """A state that is component by component, site by site."""

    count: int = eqx.field(static=True)

    def __call__(self, x):
        return to_sites(x, self.count)
