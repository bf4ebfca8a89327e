"""A system written down in another way: in other coordinates and units, with other functions, beside another."""

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
from ..systems import LiePoissonSystem, MetriplecticSystem, System


@dataclass(frozen=True)
class CoordinateChange:
    """States ``y = A x`` at times ``time * t``, the energy and the entropy in other units.

    Attributes
    ----------
    matrix : ndarray, shape (n, n)
        A, invertible.
    time_unit, energy_unit, entropy_unit : float, > 0
        What a unit of each becomes.
    """

    matrix: np.ndarray
    time_unit: float = 1.0
    energy_unit: float = 1.0
    entropy_unit: float = 1.0

    def to_new(self, x) -> np.ndarray:
        """States, shape (..., n), in the new coordinates."""
        return np.asarray(x) @ self.matrix.T

    def to_old(self, y) -> np.ndarray:
        """The inverse of :meth:`there`."""
        return np.asarray(y) @ np.linalg.inv(self.matrix).T

    @property
    def uniform_factor(self) -> float | None:
        """The factor, where A is a number times the identity."""
        factor = float(self.matrix[0, 0])
        return factor if np.array_equal(self.matrix, factor * np.eye(len(self.matrix))) else None


class _TransformedEnergy(Module):
    """``factor * energy(B y)``."""

    energy: Energy
    matrix: jax.Array
    factor: jax.Array

    def __call__(self, y):
        return self.factor * self.energy.value(self.matrix @ y)


class _TransformedPoisson(PoissonBySharp):
    """``A Pi(B y) A^T / (e tau)``, B the inverse of A."""

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
    """The force of a dissipation in the new coordinates: gradients are taken back to the old ones."""

    system: System
    matrix: jax.Array
    inverse: jax.Array
    units: jax.Array  # of time, energy, entropy

    def lifted_geometry(self, system, x) -> LiftedGeometry:
        A = self.matrix
        return LiftedGeometry(self.system, self.inverse @ x, lambda alpha: A.T @ alpha, lambda v: A @ v / self.units[0])

    def force(self, system, x, dH, dS, dL):
        return super().force(system, x, dH / self.units[1], None if dS is None else dS / self.units[2], dL)

    def generator_field(self, system, x, dH):
        return super().generator_field(system, x, dH / self.units[1])

    def velocity(self, system, x, dH, dS, dL):
        at, (_, energy, entropy) = self.lifted_geometry(system, x), self.units
        given = at.lift_gradients(dH / energy, None if dS is None else dS / entropy, dL)
        found = self.inner.velocity(at.system, at.x, *given)
        return None if found is None else energy * (self.inverse.T @ found)

    def factor(self, system, x, dH, dL):
        return None  # noise has units of its own


def transform_system(system: System, change: CoordinateChange) -> System:
    """The same motion in other coordinates and units, for a system on R^n.

    A Lie-Poisson system stays one, with its group: in units of the momentum and of time where the energy is measured in
    units of their quotient, and in another basis of its algebra.
    """
    A, B = jnp.asarray(change.matrix), jnp.asarray(np.linalg.inv(change.matrix))
    time, energy, entropy = (jnp.asarray(unit) for unit in (change.time_unit, change.energy_unit, change.entropy_unit))

    def moved(function: Energy, factor=1.0) -> Energy:
        return function.map_terms(lambda term: Function(_TransformedEnergy(term, B, jnp.asarray(factor))))

    units = jnp.stack([time, energy, entropy])
    H, S = moved(system.energy, energy), None if system.entropy is None else moved(system.entropy, entropy)
    friction = _TransformedDissipation.lift_terms(system.dissipation, moved, system, A, B, units)
    maps = {name: moved(J) for name, J in system.momentum_maps.items()}
    if isinstance(system, LiePoissonSystem) and not system.sites:
        if change.uniform_factor is not None and change.energy_unit == change.uniform_factor / change.time_unit:
            parts = (system.algebra, system.group, system.reconstruction)
            return LiePoissonSystem(parts[0], H, S, friction, maps, False, *parts[1:])
        if change.time_unit == change.energy_unit == 1.0:
            g = mf.LieAlgebra.from_structure_constants(
                transform_structure_constants(system.algebra.structure_constants, change.matrix)
            )
            return LiePoissonSystem(g, H, S, friction, maps, validate=False)
    poisson = _TransformedPoisson(system.poisson, A, B, 1.0 / (energy * time))
    functions = system.functions()
    maps |= {name: moved(functions[name]) for name in sorted(system.first_integrals()) if name not in maps}
    return MetriplecticSystem(poisson, H, S, friction, momentum_maps=maps, validate=False)


def transform_structure_constants(constants: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """Structure constants where dual elements have the coordinates ``A mu``: the basis is then ``sum_i A_ai e_i``."""
    C = np.einsum("ai,bj,ijk,kc->abc", matrix, matrix, np.asarray(constants), np.linalg.inv(matrix), optimize=True)
    return 0.5 * (C - C.swapaxes(0, 1))


# -- other functions ----------------------------------------------------------------------------------------------


class _ShiftedEnergy(Module):
    energy: Energy
    constant: jax.Array

    def __call__(self, x):
        return self.energy.value(x) + self.constant


class _LocalFunction(Module):
    """A function that is not a number away from some states, nor is its gradient."""

    energy: Energy
    states: jax.Array
    radius: jax.Array
    negligible_factor: jax.Array  # too small to count, and no zero, whose products programs leave out

    def __call__(self, x):
        away = jnp.min(jnp.sum(((x - self.states) / self.radius) ** 2, axis=1))
        return self.energy.value(x) + self.negligible_factor * jnp.sqrt(1.0 - away)


def add_constant(energy: Energy, constant: float) -> Energy:
    """An energy with a constant added to its last term, as one writes it down."""
    *others, last = energy.terms
    if isinstance(last, Quadratic):
        last = Quadratic(last.A, last.b, last.c + constant)
    else:
        last = Function(_ShiftedEnergy(last, jnp.asarray(constant)), degree=last.degree)
    return Sum((*others, last)) if others else last


def restrict_near_states(energy: Energy, states, radius: float) -> Energy:
    """A function that is known within a radius of some states alone, shape (m, n)."""
    return Function(_LocalFunction(energy, jnp.asarray(states), jnp.asarray(radius), jnp.asarray(1e-300)))


def as_closure(energy: Energy) -> Energy:
    """A plain function whose parameters are numbers that it closes over."""
    return energy.map_terms(lambda term: term if isinstance(term, Pullback) else Function(lambda x: term.value(x)))


def replace_parts(system: System, **parts: Any) -> System:
    """A system with other parts, named as its attributes are."""
    names = list(parts)
    found = eqx.tree_at(
        lambda s: [getattr(s, name) for name in names], system, list(parts.values()), is_leaf=lambda part: part is None
    )
    if "dissipation" in parts:  # the constructor of a system finds names for what its dissipation preserves
        object.__setattr__(found, "preserved_labels", found._find_preserved_names() if found.preserved else None)
    return found


# -- other dissipations ---------------------------------------------------------------------------------------------


class _ScaledDissipation(LiftedDissipation):
    """A share of a dissipation."""

    fraction: jax.Array

    def lifted_geometry(self, system, x) -> LiftedGeometry:
        return LiftedGeometry(system, x, lambda alpha: alpha, lambda v: self.fraction * v)

    def factor(self, system, x, dH, dL):
        B = self.inner.factor(system, x, dH, dL)
        return None if B is None else B.scale_by(self.fraction)

    def velocity(self, system, x, dH, dS, dL):
        found = self.inner.velocity(system, x, dH, dS, dL)
        return None if found is None else self.fraction * found


def split_in_halves(dissipation: Dissipation) -> Dissipation:
    """The sum of two, each with half of the rate."""
    rate = getattr(dissipation, "rate", None)
    if isinstance(rate, jax.Array | np.ndarray | float):
        half = eqx.tree_at(lambda d: d.rate, dissipation, rate / 2)
        return half + half
    half = _ScaledDissipation.lift_terms(dissipation, lambda L: L, jnp.asarray(0.5))
    assert half is not None
    return DissipationSum((*half.terms, *half.terms))


# -- two of them ------------------------------------------------------------------------------------------------------


class _EmbeddedDissipation(LiftedDissipation):
    system: System
    start: int = eqx.field(static=True)

    def lifted_geometry(self, system, x) -> LiftedGeometry:
        n, i = self.system.dim, self.start
        own = slice(i, i + n)
        return LiftedGeometry(self.system, x[own], lambda alpha: alpha[own], lambda v: jnp.pad(v, (i, n - i)))


class UncoupledPair(System):
    """Two copies of a system that know nothing of each other, in the states (x, y)."""

    def __init__(self, system: System):
        n = system.dim

        def on(i: int) -> Callable[[Energy], Energy]:
            return lambda energy: energy.on(range(i, i + n))

        first, second, functions = on(0), on(n), system.functions()
        parts: list[Dissipation] = []
        for i, pulled in ((0, first), (n, second)):
            own = _EmbeddedDissipation.lift_terms(system.dissipation, pulled, system, i)
            parts += () if own is None else own.terms
        self.dim, self.space, self.poisson = 2 * n, None, ProductPoisson(system.poisson, system.poisson)
        self.energy = first(system.energy) + second(system.energy)
        self.entropy = None if system.entropy is None else first(system.entropy) + second(system.entropy)
        self.dissipation = DissipationSum(tuple(parts)) if parts else None
        self.momentum_maps = {
            f"{name} of {which}": pulled(functions[name])
            for name in sorted(system.first_integrals())
            for which, pulled in (("one", first), ("the other", second))
        }
