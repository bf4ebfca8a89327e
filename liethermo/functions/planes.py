"""Energies of many spins for states that store them component by component, ``(s_1x, s_2x, …, s_1y, …)``.

The components x of all spins are then contiguous in memory, so that they can be computed by vector instructions.
"""

from __future__ import annotations

import math

import equinox as eqx
import jax
import jax.numpy as jnp

from manifolds.structures.spins import PaddedLattice, add_vectors, reshape_vectors, sum_of_dots

from .coordinates import ComponentMap
from .energy import Energy, Multiple, Negative, Pullback, Sum
from .magnetism.spin_energy import SpinEnergy, flatten_covectors, lattice_spins
from .with_baths import BodyBathsEnergy


def to_component_order(x, count: int) -> jax.Array:
    """Return states, shape (..., n), whose first ``count`` spins are reordered component by component."""
    return _transpose_spins(x, (count, 3))


def to_site_order(x, count: int) -> jax.Array:
    """Return states, shape (..., n), whose first ``count`` spins are reordered site by site."""
    return _transpose_spins(x, (3, count))


def _transpose_spins(x, shape: tuple[int, int]) -> jax.Array:
    batch_shape, n_spin_components = x.shape[:-1], shape[0] * shape[1]
    spins = x if n_spin_components == x.shape[-1] else x[..., :n_spin_components]
    spins = jnp.swapaxes(spins.reshape(*batch_shape, *shape), -1, -2).reshape(*batch_shape, n_spin_components)
    return spins if n_spin_components == x.shape[-1] else jnp.concatenate([spins, x[..., n_spin_components:]], axis=-1)


def energy_in_component_order(energy: Energy, count: int) -> Energy:
    """Return a function of states ordered site by site as a function of states ordered component by component."""
    terms: list[Energy] = []
    spin_energies: list[SpinEnergy] = []
    for term in energy.terms:
        if isinstance(term, SpinEnergy) and math.prod(term.sites) == count:
            if term.is_quadratic:
                spin_energies.append(term)
            else:  # each term has a discrete gradient of its own
                terms.append(PlanarSpinEnergy((term,)))
        else:
            terms.append(_term_in_component_order(term, count))
    if spin_energies:
        terms.append(PlanarSpinEnergy(tuple(spin_energies)))
    return Sum.of(terms)


def _term_in_component_order(term: Energy, count: int) -> Energy:
    """Return one summand of an energy as a function of states that are ordered component by component."""
    if isinstance(term, BodyBathsEnergy):
        return BodyBathsEnergy(energy_in_component_order(term.body, count), term.baths, term.body_dim, term.dim)
    if isinstance(term, Negative):
        return Negative(energy_in_component_order(term.term, count))
    if isinstance(term, Multiple):
        return Multiple(energy_in_component_order(term.term, count), term.factor)
    return Pullback(term, SiteOrder(count))


class PlanarSpinEnergy(Energy):
    """A sum of energies of all spins; their gradients are added on the lattice, then copied to the state once."""

    spin_energies: tuple[SpinEnergy, ...]

    @property
    def is_quadratic(self) -> bool:
        return all(energy.is_quadratic for energy in self.spin_energies)

    @property
    def degree(self) -> float:
        return max(energy.degree for energy in self.spin_energies)

    def value(self, x) -> jax.Array:
        spins = self._padded_spins_by_shape(x)
        return sum((energy.lattice_value(spins[energy.sites]) for energy in self.spin_energies), jnp.zeros(()))

    def gradient(self, x) -> jax.Array:
        spins = self._padded_spins_by_shape(x)
        total, *other_gradients = (energy.lattice_gradients(spins[energy.sites]) for energy in self.spin_energies)
        for gradient in other_gradients:
            total = add_vectors(total, reshape_vectors(gradient, total[0].shape))
        return flatten_covectors(jax.lax.optimization_barrier(total), x, planar=True)

    def _padded_spins_by_shape(self, x) -> dict[tuple[int, ...], PaddedLattice]:
        """Return the spins on the lattice of each energy, by the shape of the lattice."""
        sites = {energy.sites for energy in self.spin_energies}
        return {
            shape: PaddedLattice(
                lattice_spins(x, shape, planar=True), interaction_range(Sum(self.spin_energies), shape)
            )
            for shape in sites
        }

    def sensitivity(self, x) -> jax.Array:
        spins, total = self._padded_spins_by_shape(x), jnp.zeros(())
        for energy in self.spin_energies:
            site_spins, gradients = spins[energy.sites].site_spins, energy.lattice_gradients(spins[energy.sites])
            total = total + jnp.sqrt(sum_of_dots(gradients, gradients) * sum_of_dots(site_spins, site_spins))
        return jax.lax.stop_gradient(total)


def interaction_range(energy: Energy, sites: tuple[int, ...]) -> tuple[int, ...]:
    """Return the largest distance, along each axis of a lattice, of two spins that interact through an energy."""
    ranges = [(0,) * len(sites)]
    for term in energy.terms:
        if isinstance(term, BodyBathsEnergy):
            ranges.append(interaction_range(term.body, sites))
        elif isinstance(term, SpinEnergy) and term.sites == sites:
            ranges.append(term.interaction_range)
    return tuple(max(axis_ranges) for axis_ranges in zip(*ranges, strict=True))


class SiteOrder(ComponentMap):
    """A map from states ordered component by component to states ordered site by site."""

    count: int = eqx.field(static=True)

    def __call__(self, x):
        return to_site_order(x, self.count)
