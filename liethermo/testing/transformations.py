"""Equivalent forms of a system: in other coordinates and units, with other functions, or as an uncoupled pair."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import manifolds as mf
from manifolds._pytree_module import Module
from manifolds.structures.poisson import PoissonBySharp, ProductPoisson

from ..dissipation.base import Dissipation, DissipationSum, LiftedDissipation, LiftedGeometry
from ..functions.energy import Energy, Function, Pullback, Quadratic, Sum
from ..runs.named_parameters import named_parameters, replace_parameters
from ..systems import LiePoissonSystem, MetriplecticSystem, System
from ..systems.invariants import find_preserved_function_names


@dataclass(frozen=True)
class CoordinateChange:
    """A linear change of coordinates ``y = A x``, with other units of time, energy and entropy.

    Attributes
    ----------
    matrix : ndarray, shape (n, n)
        A, invertible.
    time_unit, energy_unit, entropy_unit : float, > 0
        The value of one old unit in new units.
    """

    matrix: np.ndarray
    time_unit: float = 1.0
    energy_unit: float = 1.0
    entropy_unit: float = 1.0

    def to_new(self, x) -> np.ndarray:
        """Return states, shape (..., n), in the new coordinates."""
        return np.asarray(x) @ self.matrix.T

    def to_old(self, y) -> np.ndarray:
        """Return states, shape (..., n), in the old coordinates."""
        return np.asarray(y) @ np.linalg.inv(self.matrix).T

    @property
    def uniform_factor(self) -> float | None:
        """The number c if the matrix is c times the identity, else None."""
        factor = float(self.matrix[0, 0])
        return factor if np.array_equal(self.matrix, factor * np.eye(len(self.matrix))) else None


class _TransformedEnergy(Module):
    """An energy in the new coordinates, ``factor * energy(B y)``."""

    energy: Energy
    matrix: jax.Array
    factor: jax.Array

    def __call__(self, y):
        return self.factor * self.energy.value(self.matrix @ y)


class _TransformedPoisson(PoissonBySharp):
    """The Poisson tensor ``A Pi(B y) A^T / (e tau)``, B the inverse of A."""

    original: mf.PoissonStructure
    matrix: jax.Array
    inverse: jax.Array
    factor: jax.Array

    @property
    def dim(self) -> int:
        return self.matrix.shape[0]

    def sharp(self, x, alpha):
        return self.factor * (self.matrix @ self.original.sharp(self.inverse @ x, self.matrix.T @ alpha))


class _TransformedDissipation(LiftedDissipation):
    """A dissipation in the new coordinates, which is evaluated in the old coordinates."""

    system: System
    matrix: jax.Array
    inverse: jax.Array
    units: jax.Array  # new units of time, energy and entropy

    def lifted_geometry(self, system, x) -> LiftedGeometry:
        A = self.matrix
        return LiftedGeometry(self.system, self.inverse @ x, lambda alpha: A.T @ alpha, lambda v: A @ v / self.units[0])

    def force(self, system, x, dH, dS, dL):
        return super().force(system, x, dH / self.units[1], None if dS is None else dS / self.units[2], dL)

    def generator_field(self, system, x, dH):
        return super().generator_field(system, x, dH / self.units[1])

    def added_attitude_velocity(self, system, x, dH, dS, dL):
        original, (_, energy, entropy) = self.lifted_geometry(system, x), self.units
        gradients = original.inner_gradients(dH / energy, None if dS is None else dS / entropy, dL)
        sigma = self.inner.added_attitude_velocity(original.system, original.x, *gradients)
        return None if sigma is None else energy * (self.inverse.T @ sigma)

    def factor(self, system, x, dH, dL):
        return None  # the amplitude of noise would scale differently


def transform_coordinates_and_units(system: System, change: CoordinateChange) -> System:
    """Return a system on R^n that is equivalent to another in other coordinates and units.

    A Lie-Poisson system remains one in two cases: with its group if the momentum is scaled uniformly and the energy
    unit is the momentum unit per time unit, and with another basis of its algebra if time and energy keep their units.
    """
    A, B = jnp.asarray(change.matrix), jnp.asarray(np.linalg.inv(change.matrix))
    time, energy, entropy = (jnp.asarray(unit) for unit in (change.time_unit, change.energy_unit, change.entropy_unit))

    def transform(function: Energy, factor=1.0) -> Energy:
        return function.map_terms(lambda term: Function(_TransformedEnergy(term, B, jnp.asarray(factor))))

    units = jnp.stack([time, energy, entropy])
    H, S = transform(system.energy, energy), None if system.entropy is None else transform(system.entropy, entropy)
    friction = _TransformedDissipation.lift_terms(system.dissipation, transform, system, A, B, units)
    maps = {name: transform(J) for name, J in system.momentum_maps.items()}
    if isinstance(system, LiePoissonSystem) and system.dim == system.algebra.dim and not system.sites:
        if change.uniform_factor is not None and change.energy_unit == change.uniform_factor / change.time_unit:
            attributes = (system.algebra, system.group, system.reconstruction)
            return LiePoissonSystem(attributes[0], H, S, friction, maps, False, *attributes[1:])
        if change.time_unit == change.energy_unit == 1.0:
            g = mf.LieAlgebra.from_structure_constants(
                transform_structure_constants(system.algebra.structure_constants, change.matrix)
            )
            return LiePoissonSystem(g, H, S, friction, maps, validate=False)
    poisson = _TransformedPoisson(system.poisson, A, B, 1.0 / (energy * time))
    functions = system.functions()
    maps |= {name: transform(functions[name]) for name in sorted(system.first_integrals()) if name not in maps}
    return MetriplecticSystem(poisson, H, S, friction, momentum_maps=maps, validate=False)


def transform_structure_constants(constants: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """Return the structure constants of an algebra in the basis ``sum_i A_ai e_i``, with dual coordinates ``A mu``."""
    C = np.einsum("ai,bj,ijk,kc->abc", matrix, matrix, np.asarray(constants), np.linalg.inv(matrix), optimize=True)
    return 0.5 * (C - C.swapaxes(0, 1))


# -- other functions ----------------------------------------------------------------------------------------------


class _ShiftedEnergy(Module):
    energy: Energy
    constant: jax.Array

    def __call__(self, x):
        return self.energy.value(x) + self.constant


class _LocalFunction(Module):
    """A function that is NaN, with its gradient, at distances above ``radius`` from the given states."""

    energy: Energy
    states: jax.Array
    radius: jax.Array
    negligible_factor: jax.Array  # tiny, but not zero, because a compiler may drop products with zero

    def __call__(self, x):
        squared_distance = jnp.min(jnp.sum(((x - self.states) / self.radius) ** 2, axis=1))
        return self.energy.value(x) + self.negligible_factor * jnp.sqrt(1.0 - squared_distance)


def add_constant(energy: Energy, constant: float) -> Energy:
    """Return the sum of an energy and a constant, which is added to the last term of the energy."""
    *leading_terms, last_term = energy.terms
    if isinstance(last_term, Quadratic):
        last_term = Quadratic(last_term.A, last_term.b, last_term.c + constant)
    else:
        last_term = Function(_ShiftedEnergy(last_term, jnp.asarray(constant)), degree=last_term.degree)
    return Sum((*leading_terms, last_term)) if leading_terms else last_term


def restrict_function_to_neighbourhood(energy: Energy, states, radius: float) -> Energy:
    """Return a function that is NaN at distances above ``radius`` from all of some states, shape (m, n)."""
    return Function(_LocalFunction(energy, jnp.asarray(states), jnp.asarray(radius), jnp.asarray(1e-300)))


def hide_parameters_in_closures(energy: Energy) -> Energy:
    """Return an energy whose terms are plain functions with the parameters as constants in closures."""
    return energy.map_terms(lambda term: term if isinstance(term, Pullback) else Function(lambda x: term.value(x)))


def replace_system_attributes(system: System, **attributes: Any) -> System:
    """Return a copy of a system with some attributes replaced, such as ``energy``."""
    names = list(attributes)
    changed_system = eqx.tree_at(
        lambda s: [getattr(s, name) for name in names],
        system,
        list(attributes.values()),
        is_leaf=lambda part: part is None,
    )
    if "dissipation" in attributes:  # the constructor sets these names from the dissipation
        object.__setattr__(
            changed_system,
            "preserved_labels",
            find_preserved_function_names(changed_system) if changed_system.preserved_functions else None,
        )
    return changed_system


# -- other dissipations ---------------------------------------------------------------------------------------------


class _ScaledDissipation(LiftedDissipation):
    """A dissipation multiplied by a fraction."""

    fraction: jax.Array

    def lifted_geometry(self, system, x) -> LiftedGeometry:
        return LiftedGeometry(system, x, lambda alpha: alpha, lambda v: self.fraction * v)

    def factor(self, system, x, dH, dL):
        B = self.inner.factor(system, x, dH, dL)
        return None if B is None else B.scale_by(self.fraction)

    def added_attitude_velocity(self, system, x, dH, dS, dL):
        sigma = self.inner.added_attitude_velocity(system, x, dH, dS, dL)
        return None if sigma is None else self.fraction * sigma


def dissipation_in_two_halves(system: System) -> Dissipation:
    """Return the dissipation of a system as the sum of two dissipations with half of the rate each."""
    rate = named_parameters(system).get("dissipation.rate")
    if rate is not None:
        half = replace_parameters(system, {"dissipation.rate": rate / 2}).dissipation
    else:
        half = _ScaledDissipation.lift_terms(system.dissipation, lambda L: L, jnp.asarray(0.5))
    assert half is not None
    return DissipationSum((*half.terms, *half.terms))


# -- pairs of systems -------------------------------------------------------------------------------------------------


class _EmbeddedDissipation(LiftedDissipation):
    system: System
    start: int = eqx.field(static=True)

    def lifted_geometry(self, system, x) -> LiftedGeometry:
        n, i = self.system.dim, self.start
        block = slice(i, i + n)
        return LiftedGeometry(self.system, x[block], lambda alpha: alpha[block], lambda v: jnp.pad(v, (i, n - i)))


class UncoupledPair(System):
    """Two uncoupled copies of a system, with states (x, y)."""

    def __init__(self, system: System):
        n = system.dim

        def restriction_to(i: int) -> Callable[[Energy], Energy]:
            return lambda energy: energy.on(range(i, i + n))

        restrict_first, restrict_second, functions = restriction_to(0), restriction_to(n), system.functions()
        terms: list[Dissipation] = []
        for i, restrict in ((0, restrict_first), (n, restrict_second)):
            embedded = _EmbeddedDissipation.lift_terms(system.dissipation, restrict, system, i)
            terms += () if embedded is None else embedded.terms
        self.dim, self.space, self.poisson = 2 * n, None, ProductPoisson(system.poisson, system.poisson)
        self.energy = restrict_first(system.energy) + restrict_second(system.energy)
        self.entropy = (
            None if system.entropy is None else restrict_first(system.entropy) + restrict_second(system.entropy)
        )
        self.dissipation = DissipationSum(tuple(terms)) if terms else None
        self.momentum_maps = {
            f"{name} of {which}": pulled(functions[name])
            for name in sorted(system.first_integrals())
            for which, pulled in (("one", restrict_first), ("the other", restrict_second))
        }
