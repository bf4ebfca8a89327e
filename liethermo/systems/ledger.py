"""Systems that receive work and heat from outside: a ledger of both, and the time, behind their state."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

import manifolds as mf
from manifolds._pytree_module import Module
from manifolds.matrices.linear import solve
from manifolds.structures.poisson import ProductPoisson

from ..dissipation.base import LawName, SkewFriction
from ..dissipation.checks import checked_semidefinite
from ..errors import InputError
from ..functions.arguments import ConstantFunction, LastArgumentIgnored, required_argument_count
from ..functions.checks import check_function_shape
from ..functions.conditions import check_numbers, require_condition
from ..functions.energy import Energy, Quadratic
from .base import System

LEDGER_DIM = 3
"""Components of the ledger of a system that is not isolated: work and heat received, and the time."""


class LedgerSystem(System):
    """A system whose state has the work W and the heat Q received so far, and the time t, behind its own components.

    Its energy is ``E - W - Q``, that of system and surroundings. The state of an isolated system has no ledger.
    """

    external: Callable | None
    heat_power: Callable | None

    @property
    def has_ledger(self) -> bool:
        """Whether work or heat comes from outside, so that the state has a ledger."""
        return self.external is not None or self.heat_power is not None

    @property
    def dim_without_ledger(self) -> int:
        """Components of the state without the ledger."""
        return self.dim - LEDGER_DIM if self.has_ledger else self.dim

    def _append_ledger(self, structure, size: int, energy: Energy) -> tuple[mf.PoissonStructure, int, Energy]:
        """The structure, the size and the energy of system and surroundings, from those of the system."""
        if not self.has_ledger:
            return structure, size, energy
        total = size + LEDGER_DIM
        received = Quadratic(jnp.zeros(total), jnp.zeros(total).at[size : size + 2].set(-1.0))
        return ProductPoisson(structure, mf.NoPoisson(LEDGER_DIM)), total, energy.on(range(size)) + received

    def state_array(self, x, batch: bool = False):
        if self.has_ledger and np.ndim(x) > 0 and np.shape(x)[-1] == self.dim_without_ledger:
            x = jnp.concatenate([jnp.asarray(x), jnp.zeros((*np.shape(x)[:-1], LEDGER_DIM))], axis=-1)
        return super().state_array(x, batch)

    def state_time(self, x) -> jax.Array:
        """The time in one state; 0 where it has none."""
        return x[-1] if len(x) > self.dim_without_ledger else jnp.zeros(())

    # what ForcesAndHeat asks for

    @property
    @abstractmethod
    def first_velocity_index(self) -> int:
        """The component of the state where velocities begin."""

    @abstractmethod
    def momentum_jacobians(self, x) -> tuple[jax.Array, jax.Array]:
        """The derivatives of the momentum by v and S at a state, shapes (n, n) and (n,)."""

    @abstractmethod
    def forces_and_power(self, x, v, T) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Friction and external force, shape (n,), and heat power at a state x, with a velocity v and T."""

    def tangential_covector(self, x, covector) -> jax.Array:
        """What of a covector acts on velocities at a state x, shape (n,)."""
        del x
        return covector

    def ledger_rates(self, work, heat) -> jax.Array:
        """The rates of the ledger, shape (3,), or none of an isolated system."""
        return jnp.stack([work, heat, jnp.ones(())])[: self.dim - self.dim_without_ledger]

    @property
    def ledger(self) -> dict[str, Energy]:
        names = ("work received", "heat received") if self.has_ledger else ()
        rows = jnp.eye(self.dim)
        return {name: Quadratic(jnp.zeros(self.dim), rows[self.dim_without_ledger + i]) for i, name in enumerate(names)}


class ForcesAndHeat(SkewFriction):
    """Friction and the heat that it makes, an external force and a heat power, on states (…, v, S) [GBY 2.4].

    ``d/dt l_v = … + F_fr + F_ext`` and ``T S' = P_H - F_fr . v``. With the ledger W' = F_ext . v, Q' = P_H the energy
    ``v . l_v - l - W - Q`` of system and surroundings is constant, for discrete gradients too. The system says where v
    begins (``first_velocity_index``), how its momentum changes with v and S (``momentum_jacobians``), and how it is ``forces_and_power``.
    """

    friction: Callable | None
    external: Callable | None
    heat_power: Callable | None

    @property
    def entropy_law(self) -> LawName | None:
        if self.heat_power is not None:
            return None
        return "conserved" if self.friction is None else "nondecreasing"

    def force(self, system, x, dH, dS, dL):
        first, S = system.first_velocity_index, system.dim_without_ledger - 1
        W, by_S = system.momentum_jacobians(x)
        v = solve(W, system.tangential_covector(x, dH[first:S])[:, None])[
            :, 0
        ]  # the velocity and temperature of the gradient
        T = dH[S] - jnp.dot(by_S, v)
        friction, push, power = system.forces_and_power(x, v, T)
        S_dot = (power - jnp.dot(friction, v)) / jnp.where(T > 0.0, T, jnp.nan)
        v_dot = solve(W, (friction + push - by_S * S_dot)[:, None])[:, 0]
        return jnp.concatenate([jnp.zeros(first), v_dot, S_dot[None], system.ledger_rates(jnp.dot(push, v), power)])


# -- friction by a coefficient -----------------------------------------------------------------------------------------


class LinearFriction(Module):
    """The force ``-R v`` as a function of parts of a state that end with (v, S, t)."""

    R: jax.Array

    def __call__(self, *parts):
        v = parts[-3]
        return -(self.R @ v if self.R.ndim == 2 else self.R * v)


def linear_friction(coefficient, n: int, what: str) -> LinearFriction:
    """Return the friction ``-R v`` of a coefficient R: a number, shape (n,) for a diagonal matrix, or (n, n).

    Raises
    ------
    InputError
        If R has another shape, or the force would inject energy.
    """
    R = check_numbers(coefficient, what)
    R = jnp.full(n, R) if R.ndim == 0 else R
    if R.shape not in ((n,), (n, n)):
        raise InputError(f"{what} has shape (), ({n},) or ({n}, {n}), not {R.shape}")
    if R.ndim == 2:
        return LinearFriction(checked_semidefinite(R, what, symmetric=False))
    require_condition(R.min(), lambda r: r >= 0.0, f"{what} must be >= 0, not {{value:g}}: it would inject energy")
    return LinearFriction(R)


# -- functions of a state and the time --------------------------------------------------------------------------------


def add_time_argument(function: Callable, parts: int = 3) -> Callable:
    """A function of so many parts of a state, or of those and t, as one of those and t."""
    return LastArgumentIgnored(function) if required_argument_count(function) == parts else function


def check_state_function(
    function, parts: tuple[tuple[int, ...], ...], shape: tuple[int, ...], what: str, at: str
) -> Callable:
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
    found = (
        add_time_argument(function, len(parts))
        if callable(function)
        else ConstantFunction(check_numbers(function, what))
    )
    return check_function_shape(found, (*parts, ()), [shape], what, at)[0]
