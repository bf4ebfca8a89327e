"""Systems that receive work and heat from outside, with a ledger appended to their states: work, heat, time."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Callable

import equinox as eqx
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
from ..functions.checks import traced_function_and_shape
from ..functions.conditions import checked_numbers, require_condition, semidefinite_condition
from ..functions.energy import Energy, Quadratic
from ..functions.time_span import ConstantFunction, LastArgumentIgnored, required_argument_count
from ..tracing.interpret import evaluate_at_points
from .base import System
from .domain import Domain
from .evolution import entropy_component

LEDGER_DIM = 3
"""Components of the ledger of a system that is not isolated: work and heat received, and the time."""


class LedgerSystem(System):
    """Base class of systems of a Lagrangian with friction, work and heat from outside, recorded in the state.

    With work or heat from outside the state has the work W and the heat Q received so far, and the time t, behind its
    own components. Its energy is then ``E - W - Q``, that of system and surroundings.
    """

    friction: Callable | None
    external: Callable | None
    heat_power: Callable | None

    def _set_forces(
        self, friction, external, heat_power, argument_shapes: tuple[tuple[int, ...], ...], arguments_text: str
    ) -> ForcesAndHeat | None:
        """Check and set friction, external force and heat power, and return their dissipation; None without any.

        Parameters
        ----------
        argument_shapes : tuple of shapes
            Shapes of the arguments of the functions before the time: q and v, or xi, and S.
        arguments_text : str
            Name of these arguments, for messages.
        """
        shape = argument_shapes[0]

        def check(function, result_shape, what):
            if function is None:
                return None
            checked_function = checked_state_function(function, argument_shapes, result_shape, what, arguments_text)
            return checked_function if len(shape) == 1 else FlattenedFunction(checked_function, shape)

        if friction is None or callable(friction):
            self.friction = check(friction, shape, "friction")
        else:
            self.friction = linear_friction(friction, math.prod(shape), "a coefficient of friction")
        self.external = check(external, shape, "the external force")
        self.heat_power = check(heat_power, (), "the heat power")
        if self.friction is None and not self.has_ledger:
            return None
        law: LawName = "conserved" if self.friction is None else "nondecreasing"
        return ForcesAndHeat(law=law if self.heat_power is None else None)

    def _build_with_ledger(
        self, structure, dim: int, energy: Energy, forces, momentum_maps, validate, space=None
    ) -> None:
        """Build the system from a Poisson structure and an energy of states without ledger, which is appended."""
        total_dim = dim + (LEDGER_DIM if self.has_ledger else 0)
        if self.has_ledger:
            negative_work_and_heat = Quadratic(jnp.zeros(total_dim), jnp.zeros(total_dim).at[dim : dim + 2].set(-1.0))
            structure, energy = (
                ProductPoisson(structure, mf.NoPoisson(LEDGER_DIM)),
                energy.on(range(dim)) + negative_work_and_heat,
            )
        entropy = entropy_component(total_dim, dim - 1)
        self._build(structure, total_dim, energy, entropy, forces, momentum_maps, validate, space)

    @property
    def poisson_without_ledger(self) -> mf.PoissonStructure:
        """The Poisson structure of states without the ledger."""
        return self.poisson.first if isinstance(self.poisson, ProductPoisson) else self.poisson

    # -- the state ----------------------------------------------------------------------------------------------------

    @property
    def has_ledger(self) -> bool:
        """True if work or heat comes from outside, so that states end with work, heat and time."""
        return self.external is not None or self.heat_power is not None

    @property
    def dim_without_ledger(self) -> int:
        """Number of components of a state without the ledger."""
        return self.dim - LEDGER_DIM if self.has_ledger else self.dim

    @property
    @abstractmethod
    def first_velocity_index(self) -> int:
        """Index of the first velocity in the state."""

    def state_array(self, x, batch: bool = False):
        if self.has_ledger and np.ndim(x) > 0 and np.shape(x)[-1] == self.dim_without_ledger:
            x = jnp.concatenate([jnp.asarray(x), jnp.zeros((*np.shape(x)[:-1], LEDGER_DIM))], axis=-1)
        return super().state_array(x, batch)

    def split_state(self, x) -> tuple[jax.Array, ...]:
        """Return the parts (q, v, S, t), or (xi, S, t), of one state; t = 0 if it has no ledger."""
        first_velocity, S = self.first_velocity_index, self.dim_without_ledger - 1
        positions = (x[:first_velocity],) if first_velocity else ()
        return (*positions, x[first_velocity:S], x[S], x[-1] if len(x) > S + 1 else jnp.zeros(()))

    def states_without_ledger(self, x) -> jax.Array:
        """Return states without the components of the ledger, shape (..., n)."""
        return self.state(x, batch=True)[..., : self.dim_without_ledger]

    def ledger_rates(self, power, heat_power) -> jax.Array:
        """Return the rates (power, heat power, 1) of the ledger, shape (3,); an empty array for an isolated system."""
        return jnp.stack([power, heat_power, jnp.ones(())])[: self.dim - self.dim_without_ledger]

    @property
    def ledger_functions(self) -> dict[str, Energy]:
        names = ("work received", "heat received") if self.has_ledger else ()
        rows = jnp.eye(self.dim)
        return {name: Quadratic(jnp.zeros(self.dim), rows[self.dim_without_ledger + i]) for i, name in enumerate(names)}

    # -- the functions, at one point ----------------------------------------------------------------------------------

    def friction_force(self, *arguments) -> jax.Array:
        """Return the friction force, shape (n,), at the arguments (q, v, S, t) or (xi, S, t); t is 0 by default."""
        return self._evaluate_force(self.friction, arguments)

    def external_force(self, *arguments) -> jax.Array:
        """Return the external force, shape (n,), at the arguments (q, v, S, t) or (xi, S, t); t is 0 by default."""
        return self._evaluate_force(self.external, arguments)

    def heating(self, *arguments) -> jax.Array:
        """Return the heat power P_H, shape (), at the arguments (q, v, S, t) or (xi, S, t); t is 0 by default."""
        return (
            jnp.zeros(())
            if self.heat_power is None
            else jnp.asarray(self.heat_power(*self._append_default_time(arguments)))
        )

    def _evaluate_force(self, function: Callable | None, arguments: tuple) -> jax.Array:
        """Return the value of a force at its arguments, along the manifold of positions; zeros for None."""
        if function is None:
            return jnp.zeros_like(arguments[0])
        return self.tangential_part(arguments[0], jnp.asarray(function(*self._append_default_time(arguments))))

    def _append_default_time(self, arguments: tuple) -> tuple:
        """Return the arguments (q, v, S, t) or (xi, S, t) of a force, with t = 0 if t is missing."""
        names = "(q, v, S, t)" if self.first_velocity_index else "(xi, S, t)"
        count = names.count(",") + 1
        if len(arguments) not in (count - 1, count):
            raise InputError(f"forces and heat are functions of {names}, but {len(arguments)} arguments were given")
        return arguments if len(arguments) == count else (*arguments, 0.0)

    def friction_at_temperature(self, arguments: tuple, T) -> jax.Array:
        """Return the friction force, shape (n,), at ``arguments``, (q, v, S, t) or (xi, S, t), and a temperature T."""
        del T
        return self.friction_force(*arguments)

    def tangential_part(self, q, v) -> jax.Array:
        """Return the part of a velocity or force v tangent to the manifold of positions at q; v itself without one."""
        del q
        return v

    @abstractmethod
    def momentum_jacobians(self, x) -> tuple[jax.Array, jax.Array]:
        """Return the derivatives of the momentum by v and S at a state, shapes (n, n) and (n,)."""

    @abstractmethod
    def temperature_at(self, y) -> jax.Array:
        """Return the temperature, shape (), at one state y without ledger."""

    def temperature(self, x, t=None) -> jax.Array:
        """Return the temperature ``-dL/dS`` at states, shape (...); it does not depend on the time t."""
        del t
        return jnp.vectorize(self.temperature_at, signature="(n)->()")(self.states_without_ledger(x))

    def temperatures(self, x, t=None) -> jax.Array:
        """Return the temperature with an axis of length 1, shape (..., 1): see :meth:`temperature`."""
        return self.temperature(x, t)[..., None]

    # -- checks -------------------------------------------------------------------------------------------------------

    @property
    def domain(self) -> Domain:
        return Domain("a positive temperature", self._why_outside_domain, margin=self.temperature)

    def _why_outside_domain(self, x) -> str:
        """Return that the temperature at a state is not positive, as a text; "" if it is positive."""
        T = float(evaluate_at_points(_temperature, self, np.atleast_2d(x)).min())
        return "" if T > 0.0 else f"the temperature -dL/dS must be positive, got {T:.4g}"

    def specific_axiom_residuals(self, x) -> dict[str, jax.Array]:
        arguments = self.split_state(x)
        v, force = arguments[-3], self.friction_force(*arguments)
        scale = jnp.linalg.norm(force) * jnp.linalg.norm(v)
        return {"F_fr . v <= 0": jnp.maximum(jnp.dot(force, v), 0.0) / jnp.where(scale > 0.0, scale, 1.0)}


def _temperature(system: LedgerSystem, x):
    """Return the temperature at one state, shape ()."""
    return system.temperature(x)


class ForcesAndHeat(SkewFriction):
    """Friction with the heat it makes, an external force and a heat power, on states (…, v, S) [GBY 2.4].

    ``d/dt l_v = … + F_fr + F_ext`` and ``T S' = P_H - F_fr . v``. With the ledger W' = F_ext . v, Q' = P_H the energy
    ``v . l_v - l - W - Q`` of system and surroundings is constant, for discrete gradients too: v and T are those that
    belong to the gradient.
    """

    def force(self, system, x, dH, dS, dL):
        first_velocity, S = system.first_velocity_index, system.dim_without_ledger - 1
        W, S_derivative = system.momentum_jacobians(x)
        v = solve(W, system.tangential_part(x[:first_velocity], dH[first_velocity:S])[:, None])[:, 0]
        T = dH[S] - jnp.dot(S_derivative, v)
        *positions, _, entropy, t = system.split_state(x)
        arguments = (*positions, v, entropy, t)
        friction, external = system.friction_at_temperature(arguments, T), system.external_force(*arguments)
        power = system.heating(*arguments)
        S_dot = (power - jnp.dot(friction, v)) / jnp.where(T > 0.0, T, jnp.nan)
        v_dot = solve(W, (friction + external - S_derivative * S_dot)[:, None])[:, 0]
        return jnp.concatenate(
            [jnp.zeros(first_velocity), v_dot, S_dot[None], system.ledger_rates(jnp.dot(external, v), power)]
        )


# -- friction by a coefficient -----------------------------------------------------------------------------------------


class LinearFriction(Module):
    """The friction force ``-R v`` as a function of arguments that end with (v, S, t)."""

    R: jax.Array = eqx.field(metadata=semidefinite_condition("friction", symmetric=False).metadata)

    def __call__(self, *parts):
        v = parts[-3]
        return -(self.R @ v if self.R.ndim == 2 else self.R * v)


def linear_friction(coefficient, n: int, what: str) -> LinearFriction:
    """Return the friction force ``-R v`` of a coefficient R: a number, shape (n,) for a diagonal matrix, or (n, n).

    Raises
    ------
    InputError
        If R has another shape, or the force would inject energy.
    """
    R = checked_numbers(coefficient, what)
    R = jnp.full(n, R) if R.ndim == 0 else R
    if R.shape not in ((n,), (n, n)):
        raise InputError(f"{what} must have shape (), ({n},) or ({n}, {n}), got {R.shape}")
    if R.ndim == 2:
        return LinearFriction(checked_semidefinite(R, what, symmetric=False))
    require_condition(R.min(), lambda r: r >= 0.0, f"{what} must be >= 0, got {{value:g}}; it would inject energy")
    return LinearFriction(R)


class FlattenedFunction(Module):
    """A function of flat q and v with a flat value, computed from a function of arrays q and v."""

    function: Callable
    shape: tuple[int, ...] = eqx.field(static=True)

    def __call__(self, q, v, S, t):
        value = jnp.asarray(self.function(q.reshape(self.shape), v.reshape(self.shape), S, t))
        return value.ravel() if value.ndim else value


# -- functions of a state and the time --------------------------------------------------------------------------------


def add_time_argument(function: Callable, n_arguments_without_time: int = 3) -> Callable:
    """Return a function of (..., t), computed from one that may lack the argument t."""
    return LastArgumentIgnored(function) if required_argument_count(function) == n_arguments_without_time else function


def checked_state_function(
    function,
    argument_shapes: tuple[tuple[int, ...], ...],
    result_shape: tuple[int, ...],
    what: str,
    arguments_text: str,
) -> Callable:
    """Return a checked and traced function of (..., t), from one that may lack t, or from a constant.

    Parameters
    ----------
    argument_shapes : tuple of shapes
        Shapes of the arguments before t.
    result_shape : tuple of int
        Shape of the result.
    what, arguments_text : str
        Name of the function and of its arguments, for messages.
    """
    if callable(function):
        function = add_time_argument(function, len(argument_shapes))
    else:
        function = ConstantFunction(checked_numbers(function, what))
    return traced_function_and_shape(function, (*argument_shapes, ()), [result_shape], what, arguments_text)[0]
