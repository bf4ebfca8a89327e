"""Systems that receive work and heat from outside: a ledger of both, and the time, behind their state."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

import manifolds as mf
from manifolds.matrices.linear import solve
from manifolds.structures.poisson import Beside

from ..dissipation.base import Law, SkewFriction
from ..functions.arguments import Constant, Steady, needed_arguments
from ..functions.checks import check_shape
from ..functions.energy import Energy, Quadratic
from .base import System

LEDGER = 3
"""Components of the ledger of a system that is not isolated: work and heat received, and the time."""


class WithLedger(System):
    """A system whose state has the work W and the heat Q received so far, and the time t, behind its own components.

    Its energy is ``E - W - Q``, that of system and surroundings. The state of an isolated system has no ledger.
    """

    external: Callable | None
    heat_power: Callable | None

    @property
    def receives(self) -> bool:
        """Whether work or heat comes from outside, so that the state has a ledger."""
        return self.external is not None or self.heat_power is not None

    @property
    def own_size(self) -> int:
        """Components of the state without the ledger."""
        return self.dim - LEDGER if self.receives else self.dim

    def _beside_ledger(self, structure, size: int, energy: Energy) -> tuple[mf.PoissonStructure, int, Energy]:
        """The structure, the size and the energy of system and surroundings, from those of the system."""
        if not self.receives:
            return structure, size, energy
        total = size + LEDGER
        received = Quadratic(jnp.zeros(total), jnp.zeros(total).at[size : size + 2].set(-1.0))
        return Beside(structure, mf.NoPoisson(LEDGER)), total, energy.on(range(size)) + received

    def numbers(self, x, batch: bool = False):
        if self.receives and np.ndim(x) > 0 and np.shape(x)[-1] == self.own_size:
            x = jnp.concatenate([jnp.asarray(x), jnp.zeros((*np.shape(x)[:-1], LEDGER))], axis=-1)
        return super().numbers(x, batch)

    def time_of(self, x) -> jax.Array:
        """The time in one state; 0 where it has none."""
        return x[-1] if len(x) > self.own_size else jnp.zeros(())

    def entries(self, work, heat) -> jax.Array:
        """The rates of the ledger, shape (3,), or none of an isolated system."""
        return jnp.stack([work, heat, jnp.ones(())])[: self.dim - self.own_size]

    @property
    def ledger(self) -> dict[str, Energy]:
        names = ("work received", "heat received") if self.receives else ()
        rows = jnp.eye(self.dim)
        return {name: Quadratic(jnp.zeros(self.dim), rows[self.own_size + i]) for i, name in enumerate(names)}


class ForcesAndHeat(SkewFriction):
    """Friction and the heat that it makes, an external force and a heat power: what such a system is driven by."""

    friction: Callable | None
    external: Callable | None
    heat_power: Callable | None

    @property
    def entropy_law(self) -> Law | None:
        if self.heat_power is not None:
            return None
        return "conserved" if self.friction is None else "nondecreasing"

    @staticmethod
    def slopes(W, by_S, v, T, friction, push, power) -> tuple[jax.Array, jax.Array]:
        """``v'`` and ``S'`` by them, where the momentum changes by ``W v' + by_S S'``; NaN unless T is positive."""
        S_dot = (power - jnp.dot(friction, v)) / jnp.where(T > 0.0, T, jnp.nan)
        return solve(W, (friction + push - by_S * S_dot)[:, None])[:, 0], S_dot


# -- functions of a state and the time --------------------------------------------------------------------------------


def timed(function: Callable, parts: int = 3) -> Callable:
    """A function of so many parts of a state, or of those and t, as one of those and t."""
    return Steady(function) if needed_arguments(function) == parts else function


def field(function, parts: tuple[tuple[int, ...], ...], shape: tuple[int, ...], what: str, at: str) -> Callable:
    """A function of parts of a state, or of those and t, or a constant, as one of those and t, checked.

    Parameters
    ----------
    parts : tuple of shapes
        Of the parts of a state.
    shape : tuple of int
        Of what it has to give.
    what, at : str
        For messages: what it is, and of what.
    """
    found = timed(function, len(parts)) if callable(function) else Constant(jnp.asarray(function, dtype=jnp.float64))
    return check_shape(found, (*parts, ()), shape, what, at)
