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
from manifolds._module import Module
from manifolds.structures.poisson import Beside, PoissonBySharp

from ..dissipation.base import Carried, Dissipation, Several, There
from ..functions.energy import Energy, Function, Pullback, Quadratic, Sum
from ..systems import LiePoissonSystem, MetriplecticSystem, System


@dataclass(frozen=True)
class Change:
    """States ``y = A x`` at times ``time * t``, the energy and the entropy in other units.

    Attributes
    ----------
    matrix : ndarray, shape (n, n)
        A, invertible.
    time, energy, entropy : float, > 0
        What a unit of each becomes.
    """

    matrix: np.ndarray
    time: float = 1.0
    energy: float = 1.0
    entropy: float = 1.0

    def there(self, x) -> np.ndarray:
        """States, shape (..., n), in the new coordinates."""
        return np.asarray(x) @ self.matrix.T

    def back(self, y) -> np.ndarray:
        """The inverse of :meth:`there`."""
        return np.asarray(y) @ np.linalg.inv(self.matrix).T

    @property
    def uniform(self) -> float | None:
        """The factor, where A is a number times the identity."""
        factor = float(self.matrix[0, 0])
        return factor if np.array_equal(self.matrix, factor * np.eye(len(self.matrix))) else None


class _Through(Module):
    """``factor * energy(B y)``."""

    energy: Energy
    matrix: jax.Array
    factor: jax.Array

    def __call__(self, y):
        return self.factor * self.energy.value(self.matrix @ y)


class _Poisson(PoissonBySharp):
    """``A Pi(B y) A^T / (e tau)``, B the inverse of A."""

    part: mf.PoissonStructure
    matrix: jax.Array
    inverse: jax.Array
    factor: jax.Array

    @property
    def dim(self) -> int:
        return self.matrix.shape[0]

    def sharp(self, x, alpha):
        return self.factor * (self.matrix @ self.part.sharp(self.inverse @ x, self.matrix.T @ alpha))


class _Force(Carried):
    """The force of a dissipation in the new coordinates: gradients are taken back to the old ones."""

    system: System
    matrix: jax.Array
    inverse: jax.Array
    units: jax.Array  # of time, energy, entropy

    def there(self, system, x) -> There:
        A = self.matrix
        return There(self.system, self.inverse @ x, lambda alpha: A.T @ alpha, lambda v: A @ v / self.units[0])

    def force(self, system, x, dH, dS, dL):
        return super().force(system, x, dH / self.units[1], None if dS is None else dS / self.units[2], dL)

    def generated(self, system, x, dH):
        return super().generated(system, x, dH / self.units[1])

    def velocity(self, system, x, dH, dS, dL):
        at, (_, energy, entropy) = self.there(system, x), self.units
        given = at.lifted(dH / energy, None if dS is None else dS / entropy, dL)
        found = self.part.velocity(at.system, at.x, *given)
        return None if found is None else energy * (self.inverse.T @ found)

    def factor(self, system, x, dH, dL):
        return None  # noise has units of its own


def changed(system: System, change: Change) -> System:
    """The same motion in other coordinates and units, for a system on R^n.

    A Lie-Poisson system stays one, with its group: in units of the momentum and of time where the energy is measured in
    units of their quotient, and in another basis of its algebra.
    """
    A, B = jnp.asarray(change.matrix), jnp.asarray(np.linalg.inv(change.matrix))
    time, energy, entropy = (jnp.asarray(unit) for unit in (change.time, change.energy, change.entropy))

    def moved(function: Energy, factor=1.0) -> Energy:
        return function.mapped(lambda term: Function(_Through(term, B, jnp.asarray(factor))))

    units = jnp.stack([time, energy, entropy])
    H, S = moved(system.energy, energy), None if system.entropy is None else moved(system.entropy, entropy)
    friction = _Force.of(system.dissipation, moved, system, A, B, units)
    maps = {name: moved(J) for name, J in system.momentum_maps.items()}
    if isinstance(system, LiePoissonSystem) and not system.sites:
        if change.uniform is not None and change.energy == change.uniform / change.time:
            parts = (system.algebra, system.group, system.reconstruction)
            return LiePoissonSystem(parts[0], H, S, friction, maps, False, *parts[1:])
        if change.time == change.energy == 1.0:
            g = mf.LieAlgebra.from_structure_constants(in_basis(system.algebra.structure_constants, change.matrix))
            return LiePoissonSystem(g, H, S, friction, maps, validate=False)
    poisson = _Poisson(system.poisson, A, B, 1.0 / (energy * time))
    functions = system.functions()
    maps |= {name: moved(functions[name]) for name in sorted(system.first_integrals()) if name not in maps}
    return MetriplecticSystem(poisson, H, S, friction, momentum_maps=maps, validate=False)


def in_basis(constants: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """Structure constants where dual elements have the coordinates ``A mu``: the basis is then ``sum_i A_ai e_i``."""
    C = np.einsum("ai,bj,ijk,kc->abc", matrix, matrix, np.asarray(constants), np.linalg.inv(matrix), optimize=True)
    return 0.5 * (C - C.swapaxes(0, 1))


# -- other functions ----------------------------------------------------------------------------------------------


class _Shifted(Module):
    energy: Energy
    constant: jax.Array

    def __call__(self, x):
        return self.energy.value(x) + self.constant


class _Inside(Module):
    """A function that is not a number away from some states, nor is its gradient."""

    energy: Energy
    states: jax.Array
    radius: jax.Array
    nothing: jax.Array  # too small to count, and no zero, whose products programs leave out

    def __call__(self, x):
        away = jnp.min(jnp.sum(((x - self.states) / self.radius) ** 2, axis=1))
        return self.energy.value(x) + self.nothing * jnp.sqrt(1.0 - away)


def shifted(energy: Energy, constant: float) -> Energy:
    """An energy with a constant added to its last term, as one writes it down."""
    *others, last = energy.terms
    if isinstance(last, Quadratic):
        last = Quadratic(last.A, last.b, last.c + constant)
    else:
        last = Function(_Shifted(last, jnp.asarray(constant)), degree=last.degree)
    return Sum((*others, last)) if others else last


def inside(energy: Energy, states, radius: float) -> Energy:
    """A function that is known within a radius of some states alone, shape (m, n)."""
    return Function(_Inside(energy, jnp.asarray(states), jnp.asarray(radius), jnp.asarray(1e-300)))


def closed_over(energy: Energy) -> Energy:
    """A plain function whose parameters are numbers that it closes over."""
    return energy.mapped(lambda term: term if isinstance(term, Pullback) else Function(lambda x: term.value(x)))


def replaced(system: System, **parts: Any) -> System:
    """A system with other parts, named as its attributes are."""
    names = list(parts)
    found = eqx.tree_at(
        lambda s: [getattr(s, name) for name in names], system, list(parts.values()), is_leaf=lambda part: part is None
    )
    if "dissipation" in parts:  # the constructor of a system finds names for what its dissipation preserves
        object.__setattr__(found, "preserved_as", found._preserved_names() if found.preserved else None)
    return found


# -- other dissipations ---------------------------------------------------------------------------------------------


class _Share(Carried):
    """A share of a dissipation."""

    share: jax.Array

    def there(self, system, x) -> There:
        return There(system, x, lambda alpha: alpha, lambda v: self.share * v)

    def factor(self, system, x, dH, dL):
        B = self.part.factor(system, x, dH, dL)
        return None if B is None else B.scaled(self.share)

    def velocity(self, system, x, dH, dS, dL):
        found = self.part.velocity(system, x, dH, dS, dL)
        return None if found is None else self.share * found


def halved(dissipation: Dissipation) -> Dissipation:
    """The sum of two, each with half of the rate."""
    rate = getattr(dissipation, "rate", None)
    if isinstance(rate, jax.Array | np.ndarray | float):
        half = eqx.tree_at(lambda d: d.rate, dissipation, rate / 2)
        return half + half
    half = _Share.of(dissipation, lambda L: L, jnp.asarray(0.5))
    assert half is not None
    return Several((*half.terms, *half.terms))


# -- two of them ------------------------------------------------------------------------------------------------------


class _OnOne(Carried):
    system: System
    start: int = eqx.field(static=True)

    def there(self, system, x) -> There:
        n, i = self.system.dim, self.start
        own = slice(i, i + n)
        return There(self.system, x[own], lambda alpha: alpha[own], lambda v: jnp.pad(v, (i, n - i)))


class Pair(System):
    """Two copies of a system that know nothing of each other, in the states (x, y)."""

    def __init__(self, system: System):
        n = system.dim

        def on(i: int) -> Callable[[Energy], Energy]:
            return lambda energy: energy.on(range(i, i + n))

        first, second, functions = on(0), on(n), system.functions()
        parts: list[Dissipation] = []
        for i, pulled in ((0, first), (n, second)):
            own = _OnOne.of(system.dissipation, pulled, system, i)
            parts += () if own is None else own.terms
        self.dim, self.space, self.poisson = 2 * n, None, Beside(system.poisson, system.poisson)
        self.energy = first(system.energy) + second(system.energy)
        self.entropy = None if system.entropy is None else first(system.entropy) + second(system.entropy)
        self.dissipation = Several(tuple(parts)) if parts else None
        self.momentum_maps = {
            f"{name} of {which}": pulled(functions[name])
            for name in sorted(system.first_integrals())
            for which, pulled in (("one", first), ("the other", second))
        }
