"""Systems that receive work and heat from outside, with a ledger appended to their states: work, heat, time."""

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
from ..functions.checks import traced_function_and_shape
from ..functions.conditions import checked_numbers, require_condition
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
        """True if work or heat comes from outside, so that the state has a ledger."""
        return self.external is not None or self.heat_power is not None

    @property
    def dim_without_ledger(self) -> int:
        """Components of the state without the ledger."""
        return self.dim - LEDGER_DIM if self.has_ledger else self.dim

    def _append_ledger(self, poisson, dim: int, energy: Energy) -> tuple[mf.PoissonStructure, int, Energy]:
        """Return the Poisson structure, dimension and energy of system and ledger, from those of the system."""
        if not self.has_ledger:
            return poisson, dim, energy
        total_dim = dim + LEDGER_DIM
        received = Quadratic(jnp.zeros(total_dim), jnp.zeros(total_dim).at[dim : dim + 2].set(-1.0))
        return ProductPoisson(poisson, mf.NoPoisson(LEDGER_DIM)), total_dim, energy.on(range(dim)) + received

    def state_array(self, x, batch: bool = False):
        if self.has_ledger and np.ndim(x) > 0 and np.shape(x)[-1] == self.dim_without_ledger:
            x = jnp.concatenate([jnp.asarray(x), jnp.zeros((*np.shape(x)[:-1], LEDGER_DIM))], axis=-1)
        return super().state_array(x, batch)

    def state_time(self, x) -> jax.Array:
        """Return the time that is contained in a state; 0 if the state has no ledger."""
        return x[-1] if len(x) > self.dim_without_ledger else jnp.zeros(())

    # members that ForcesAndHeat needs

    @property
    @abstractmethod
    def first_velocity_index(self) -> int:
        """Index of the first velocity in the state."""

    @abstractmethod
    def momentum_jacobians(self, x) -> tuple[jax.Array, jax.Array]:
        """Return the derivatives of the momentum with respect to v and S at a state, shapes (n, n) and (n,)."""

    @abstractmethod
    def forces_and_power(self, x, v, T) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Return friction, external force, shape (n,) each, and heat power at a state x, velocity v, temperature T."""

    def tangential_covector(self, x, covector) -> jax.Array:
        """Return the part of a covector that acts on admissible velocities at a state x, shape (n,)."""
        del x
        return covector

    def ledger_rates(self, work, heat) -> jax.Array:
        """Return the rates of the ledger, shape (3,), or an empty array for an isolated system."""
        return jnp.stack([work, heat, jnp.ones(())])[: self.dim - self.dim_without_ledger]

    @property
    def ledger(self) -> dict[str, Energy]:
        names = ("work received", "heat received") if self.has_ledger else ()
        rows = jnp.eye(self.dim)
        return {name: Quadratic(jnp.zeros(self.dim), rows[self.dim_without_ledger + i]) for i, name in enumerate(names)}


class ForcesAndHeat(SkewFriction):
    """Friction and the heat that it makes, an external force and a heat power, on states (…, v, S) [GBY 2.4].

    ``d/dt l_v = … + F_fr + F_ext`` and ``T S' = P_H - F_fr . v``. With the ledger W' = F_ext . v, Q' = P_H the energy
    ``v . l_v - l - W - Q`` of system and surroundings is constant, for discrete gradients too. The system
    provides ``first_velocity_index``, ``momentum_jacobians`` and ``forces_and_power``.
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
        W, S_derivative = system.momentum_jacobians(x)
        # velocity and temperature that belong to the gradient
        v = solve(W, system.tangential_covector(x, dH[first:S])[:, None])[:, 0]
        T = dH[S] - jnp.dot(S_derivative, v)
        friction, external, power = system.forces_and_power(x, v, T)
        S_dot = (power - jnp.dot(friction, v)) / jnp.where(T > 0.0, T, jnp.nan)
        v_dot = solve(W, (friction + external - S_derivative * S_dot)[:, None])[:, 0]
        return jnp.concatenate([jnp.zeros(first), v_dot, S_dot[None], system.ledger_rates(jnp.dot(external, v), power)])


# -- friction by a coefficient -----------------------------------------------------------------------------------------


class LinearFriction(Module):
    """The force ``-R v`` as a function of arguments that end with (v, S, t)."""

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
    R = checked_numbers(coefficient, what)
    R = jnp.full(n, R) if R.ndim == 0 else R
    if R.shape not in ((n,), (n, n)):
        raise InputError(f"{what} has shape (), ({n},) or ({n}, {n}), not {R.shape}")
    if R.ndim == 2:
        return LinearFriction(checked_semidefinite(R, what, symmetric=False))
    require_condition(R.min(), lambda r: r >= 0.0, f"{what} must be >= 0, not {{value:g}}: it would inject energy")
    return LinearFriction(R)


# -- functions of a state and the time --------------------------------------------------------------------------------


def add_time_argument(function: Callable, n_arguments: int = 3) -> Callable:
    """Return a function of (..., t) from a function with or without the argument t."""
    return LastArgumentIgnored(function) if required_argument_count(function) == n_arguments else function


def check_state_function(
    function, parts: tuple[tuple[int, ...], ...], shape: tuple[int, ...], what: str, at: str
) -> Callable:
    """Return a checked function of (..., t) from a function with or without the argument t, or from a constant.

    Parameters
    ----------
    parts : tuple of shapes
        Shapes of the arguments before t.
    shape : tuple of int
        Shape of the result.
    what, at : str
        Name of the function and of its arguments, for messages.
    """
    if callable(function):
        function = add_time_argument(function, len(parts))
    else:
        function = ConstantFunction(checked_numbers(function, what))
    return traced_function_and_shape(function, (*parts, ()), [shape], what, at)[0]
