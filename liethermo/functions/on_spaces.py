"""Energies of points of a space, of states on sites, and of many spins, as energies of flat states."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp

import manifolds as mf
from manifolds._pytree_module import Module
from manifolds.structures.spins import (
    PaddedLattice,
    VectorComponents,
    add_vectors,
    dot_vectors,
    reshape_vectors,
    scale_vectors,
    spin_components_from_state,
    state_from_spin_components,
    sum_of_dots,
)

from .bath_energy import BodyBathsEnergy
from .energy import Energy, Multiple, Negative, Pullback, Quadratic, Sum, TimeDependent, map_operands
from .indices import ComponentMap
from .magnetism.spin_energy import SpinEnergy, flatten_covectors, lattice_spin_components


class PointEnergyOnVectors(Energy):
    """An energy of points of a space, evaluated on the vectors that hold the points, shape (n,)."""

    energy: Energy
    space: mf.Space = eqx.field(static=True)

    def value(self, x) -> jax.Array:
        return self.energy.value(self.space.from_vector(x))


def energy_of_vectors(energy: Energy, space: mf.Space | None) -> Energy:
    """Return an energy of points of a space as an energy of the vectors that hold the points.

    An lt.Quadratic is a function of vectors already, and is returned unchanged.
    """
    if space is None or space.shape == (space.size,):
        return energy
    return energy.map_terms(lambda term: _term_on_state_vectors(term, space))


def _term_on_state_vectors(term: Energy, space: mf.Space) -> Energy:
    """Return one term of an energy of points of a space as an energy of their vectors."""
    if isinstance(term, TimeDependent):
        return TimeDependent(_PointTimeFunctionOnVectors(term.function, space))
    return term if isinstance(term, Quadratic) else PointEnergyOnVectors(term, space)


class _PointTimeFunctionOnVectors(Module):
    """A function of a point of a space and the time, evaluated on the vector that holds the point."""

    function: Callable
    space: mf.Space = eqx.field(static=True)

    def __call__(self, x, t):
        return self.function(self.space.from_vector(x), t)


@dataclass(frozen=True)
class SphereLengths:
    """A :class:`.surface.Surface` of states whose first ``count`` vectors of three components have constant lengths.

    Attributes
    ----------
    count : int
    name : str
        Name of the first integral that is the sum of their squares.
    planar : bool
        Whether the state stores the vectors component by component, and not one after another.
    """

    count: int
    name: str
    planar: bool = False
    is_kept_by_collocation = True

    def project_direction(self, x, v) -> jax.Array:
        """Return v, shape (n,), without its radial components at x."""
        s, vectors = self._leading_vectors(x), self._leading_vectors(v)
        return self._replace_vectors(
            v, add_vectors(vectors, scale_vectors(-_safe_quotient(dot_vectors(s, vectors), dot_vectors(s, s)), s))
        )

    def project_displacement(self, x, compensation, d) -> tuple[jax.Array, jax.Array]:
        """Return the displacement rescaled so that its end has the lengths of the start, and an error of zero.

        The correction is computed from the changes of the squares, not from their values, so its error shrinks with d.
        """
        start, step = self._leading_vectors(x + compensation), self._leading_vectors(d)
        end = add_vectors(start, step)
        shrinkage = _safe_quotient(dot_vectors(step, add_vectors(start, end)), dot_vectors(end, end))
        root = jnp.sqrt(jnp.maximum(1.0 - shrinkage, 0.0))
        return self._replace_vectors(d, add_vectors(step, scale_vectors(-shrinkage / (1.0 + root), end))), jnp.zeros(())

    def correct_rounding(self, x, compensation) -> tuple[jax.Array, jax.Array]:
        """Return the state unchanged: the sum of the squares is corrected with the other first integrals."""
        return x, compensation

    def _leading_vectors(self, v) -> VectorComponents:
        """Return the first ``count`` vectors of three components of a flat array, by components."""
        return spin_components_from_state(v, self.count, self.planar)

    def _replace_vectors(self, v, vectors: VectorComponents) -> jax.Array:
        """Return a flat array with its first ``count`` vectors replaced."""
        return state_from_spin_components(vectors, v[3 * self.count :], self.planar)


def _safe_quotient(numerator, square) -> jax.Array:
    """Return a quotient; a divisor that is not positive is replaced by 1."""
    return numerator / jnp.where(square > 0.0, square, 1.0)


class HalfSumOfSquares(Energy):
    """The Casimir ``sum |s_i|^2 / 2`` over the sites, which is recorded along a run."""

    count: int = eqx.field(static=True)

    is_quadratic = True

    def value(self, x) -> jax.Array:
        return 0.5 * jnp.sum(x[: 3 * self.count] ** 2)

    def gradient(self, x) -> jax.Array:
        return jnp.where(jnp.arange(x.size) < 3 * self.count, x, 0.0)


class HalfSquareOfSpin(Energy):
    """The Casimir ``|s_i|^2 / 2`` of one site, numbered from 0."""

    site: int = eqx.field(static=True)

    is_quadratic = True

    def value(self, x) -> jax.Array:
        return 0.5 * jnp.sum(x[3 * self.site : 3 * self.site + 3] ** 2)


def spins_to_component_order(x, n_spins: int) -> jax.Array:
    """Return states, shape (..., n), whose first ``n_spins`` spins are reordered component by component."""
    return _transpose_spins(x, (n_spins, 3))


def spins_to_site_order(x, n_spins: int) -> jax.Array:
    """Return states, shape (..., n), whose first ``n_spins`` spins are reordered site by site."""
    return _transpose_spins(x, (3, n_spins))


def _transpose_spins(x, stored_shape: tuple[int, int]) -> jax.Array:
    """Return states, shape (..., n), with the leading matrix of spins, stored in this shape, transposed."""
    batch_shape, n_spin_components = x.shape[:-1], stored_shape[0] * stored_shape[1]
    spins = x if n_spin_components == x.shape[-1] else x[..., :n_spin_components]
    spins = jnp.swapaxes(spins.reshape(*batch_shape, *stored_shape), -1, -2).reshape(*batch_shape, n_spin_components)
    return spins if n_spin_components == x.shape[-1] else jnp.concatenate([spins, x[..., n_spin_components:]], axis=-1)


def energy_in_component_order(energy: Energy, n_spins: int) -> Energy:
    """Return an energy of states whose spins are ordered site by site as an energy of states ordered by component."""
    terms: list[Energy] = []
    spin_energies: list[SpinEnergy] = []
    for term in energy.terms:
        if isinstance(term, SpinEnergy) and math.prod(term.sites) == n_spins:
            if term.is_quadratic:
                spin_energies.append(term)
            else:  # each term has a discrete gradient of its own
                terms.append(PlanarSpinEnergy((term,)))
        else:
            terms.append(_term_in_component_order(term, n_spins))
    if spin_energies:
        terms.append(PlanarSpinEnergy(tuple(spin_energies)))
    return Sum.from_terms(terms)


def _term_in_component_order(term: Energy, n_spins: int) -> Energy:
    """Return one summand of an energy as a function of states that are ordered component by component."""
    if isinstance(term, BodyBathsEnergy):
        return BodyBathsEnergy(energy_in_component_order(term.body, n_spins), term.baths, term.body_dim, term.dim)
    if isinstance(term, Negative | Multiple):
        return map_operands(term, lambda operand: energy_in_component_order(operand, n_spins))
    return Pullback(term, ComponentToSiteOrder(n_spins))


class PlanarSpinEnergy(Energy):
    """A sum of spin energies, as a function of states whose spins are ordered component by component.

    The gradients are added on the lattice, then copied to the state once.
    """

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
                lattice_spin_components(x, shape, planar=True), interaction_range(Sum(self.spin_energies), shape)
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


class ComponentToSiteOrder(ComponentMap):
    """A map from states ordered component by component to states ordered site by site."""

    count: int = eqx.field(static=True)

    def __call__(self, x):
        return spins_to_site_order(x, self.count)
