"""Simple closed systems: positions and one entropy, with friction, and with work and heat from outside [GBY §2]."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import ClassVar, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import manifolds as mf
from manifolds._pytree_module import Module
from manifolds.structures.poisson import ProductPoisson

from ..errors import InputError
from ..functions.arguments import required_argument_count
from ..functions.energy import Energy
from ..tracing.interpret import evaluate_at_points
from .evolution import configuration_space, entropy_component, join_arguments, state_space
from .herglotz import VelocityContactSystem
from .ledger import ForcesAndHeat, LedgerSystem, check_state_function, linear_friction


class SimpleClosedSystem(LedgerSystem, VelocityContactSystem):
    """A simple closed system: a Lagrangian L(q, v, S), friction, an external force and heat from outside [GBY 2.4].

    ``d/dt L_v - L_q = F_ext + F_fr`` and ``T S' = P_H - F_fr . v``, ``T = -L_S > 0``, on R^n or a manifold. The energy
    ``E = v . L_v - L`` changes by the work and heat received, ``E' = F_ext . v + P_H``, and the entropy production
    is ``-F_fr . v / T``: friction has to brake, which :meth:`check` tests.

    The state is (q, v, S), shape (2n + 1,). With an external force or a heat power it has three more components,
    the work W and the heat Q received so far and the time t: (q, v, S, W, Q, t), where the last three may be left
    out of an initial state and then are 0. The energy of such a system is ``E - W - Q``, that of system and
    surroundings: constant again, and what a run loses of it is the defect of its energy balance. The audit has
    both sides of the ledger.

    :class:`liethermo.VariationalIntegrator` discretises its variational principle; the metriplectic schemes run it too.

    With ``space=`` the positions are the points of a manifold Q, and states have the arrays of q and v in one row.
    Forces act along Q: what a function gives across it is what the constraint takes up.

    Parameters
    ----------
    lagrangian : function of (q, v, S), q and v of shape (n,), or of all in one array, to a scalar; or an Energy
        Regular: ``L_vv`` has an inverse. ``lt.Kinetic(mass) - lt.Potential(U)`` where that is its form (energy).
    dim : int
        Components of (q, v, S), 2n + 1; known by itself of an ``lt.Quadratic``.
    friction : function of (q, v, S) or (q, v, S, t), to shape (n,); or a coefficient; optional
        F_fr, with ``F_fr . v <= 0`` (force). A coefficient R means ``F_fr = -R v``: a number, an array of shape (n,)
        for a diagonal matrix, or (n, n), whose symmetric part is positive semidefinite (mass / time).
    external : function likewise, or an array of shape (n,); optional
        F_ext (force).
    heat_power : function likewise to a scalar, or a number; optional
        P_H, the heat received per time (power).
    momentum_maps : dict of functions, or a sequence of them
    validate : bool
        Test the axioms at a few random points, that friction brakes among them. Turn off where a function is not
        defined at normally distributed points, and use ``system.check(points=...)``.
    space : manifolds.Space, optional
        Q: a space of real arrays, of whose shape q, v and forces then are in all of these functions.

    Raises
    ------
    AxiomError, FunctionError, InputError
        InputError for a singular Lagrangian.

    Attributes
    ----------
    contact : manifolds.LagrangianContact
    lagrangian : Energy
    degrees_of_freedom : int
        Components of q.
    configurations : manifolds.Space or None
        Q, where it is not R^n.
    """

    friction: Callable | None
    external: Callable | None
    heat_power: Callable | None

    domain: ClassVar[str] = "a positive temperature"
    production_name: ClassVar[str] = "dS/dt"

    def __init__(
        self,
        lagrangian,
        dim: int | None = None,
        friction=None,
        external=None,
        heat_power=None,
        momentum_maps=(),
        validate: bool = True,
        space: mf.Space | None = None,
    ):
        lagrangian = join_lagrangian_arguments(lagrangian, space)
        structure, dim, energy = self._build_contact_structure(lagrangian, dim, space)
        shape = (dim // 2,) if space is None else space.shape
        self.friction = _make_friction(friction, shape, "friction")
        self.external = None if external is None else _check_flat_function(external, shape, shape, "the external force")
        self.heat_power = None if heat_power is None else _check_flat_function(heat_power, shape, (), "the heat power")
        terms = (self.friction, self.external, self.heat_power)
        forces = None if terms == (None, None, None) else ForcesAndHeat(*terms)
        self._assemble(structure, dim, energy, forces, momentum_maps, validate)

    def _assemble(
        self, structure, dim: int, energy: Energy, forces: ForcesAndHeat | None, momentum_maps, validate
    ) -> None:
        poisson, total_dim, energy = self._append_ledger(structure, dim, energy)
        entropy = entropy_component(total_dim, dim - 1)
        space = state_space(configuration_space(structure.contact), total_dim - dim)
        self._build(poisson, total_dim, energy, entropy, forces, momentum_maps, validate, space)

    # -- the state --------------------------------------------------------------------------------------------------

    @property
    def contact(self) -> mf.LagrangianContact:
        structure = self.poisson.first if isinstance(self.poisson, ProductPoisson) else self.poisson
        return cast(mf.LagrangianContact, cast(mf.Cosymplectic, structure).contact)

    @property
    def degrees_of_freedom(self) -> int:
        return self.dim_without_ledger // 2

    def tangential_part(self, q, v) -> jax.Array:
        """The part of a velocity or a force at q that is along Q, shape (n,); itself on R^n."""
        return self.contact.tangential_part(q, v)

    def split_state(self, x) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
        """q, v, S and t of one state; t = 0 where it has none."""
        n = self.degrees_of_freedom
        return x[:n], x[n : 2 * n], x[2 * n], self.state_time(x)

    def legendre(self, x) -> jax.Array:
        """``FL(q, v, S) = (q, L_v, S)`` at a state or a batch of states, shape (..., 2n + 1)."""
        return jnp.vectorize(self.contact.legendre, signature="(n)->(n)")(self._drop_ledger(x))

    def temperature(self, x) -> jax.Array:
        """``T = -L_S``, shape (...)."""
        return jnp.vectorize(lambda y: -self.lagrangian.gradient(y)[-1], signature="(n)->()")(self._drop_ledger(x))

    def mechanical_energy(self, x) -> jax.Array:
        """``E = v·L_v - L``, without the ledger, shape (...)."""
        return jnp.vectorize(self.contact.energy, signature="(n)->()")(self._drop_ledger(x))

    own_energy = mechanical_energy  # its name in 0.2

    def _drop_ledger(self, x) -> jax.Array:
        return self.state(x, batch=True)[..., : self.dim_without_ledger]

    # -- the functions, at one point ----------------------------------------------------------------------------------

    def lagrangian_value(self, q, v, S) -> jax.Array:
        """``L(q, v, S)``."""
        return self.lagrangian.value(jnp.concatenate([q, v, jnp.reshape(S, 1)]))

    def momentum(self, q, v, S) -> jax.Array:
        """``L_v``, shape (n,)."""
        return jax.grad(self.lagrangian_value, argnums=1)(q, v, S)

    def friction_force(self, q, v, S, t) -> jax.Array:
        """F_fr, shape (n,)."""
        return (
            jnp.zeros_like(v)
            if self.friction is None
            else self.tangential_part(q, jnp.asarray(self.friction(q, v, S, t)))
        )

    def friction_at(self, q, v, S, t, T) -> jax.Array:
        """F_fr where a discretisation has the temperature T, shape (n,)."""
        return self.friction_force(q, v, S, t)

    def external_force(self, q, v, S, t) -> jax.Array:
        """F_ext, shape (n,)."""
        return (
            jnp.zeros_like(v)
            if self.external is None
            else self.tangential_part(q, jnp.asarray(self.external(q, v, S, t)))
        )

    def heating(self, q, v, S, t) -> jax.Array:
        """P_H."""
        return jnp.zeros(()) if self.heat_power is None else jnp.asarray(self.heat_power(q, v, S, t))

    # -- what ForcesAndHeat asks for ----------------------------------------------------------------------------------

    @property
    def first_velocity_index(self) -> int:
        return self.degrees_of_freedom

    def tangential_covector(self, x, covector) -> jax.Array:
        return self.tangential_part(x[: self.degrees_of_freedom], covector)

    def momentum_jacobians(self, x) -> tuple[jax.Array, jax.Array]:
        _, W, S_derivative = self.contact.rates(x[: self.dim_without_ledger])
        return W, S_derivative[:, 0]

    def forces_and_power(self, x, v, T) -> tuple[jax.Array, jax.Array, jax.Array]:
        q, _, S, t = self.split_state(x)
        arguments = q, v, S, t
        return self.friction_at(*arguments, T), self.external_force(*arguments), self.heating(*arguments)

    # -- checks -----------------------------------------------------------------------------------------------------

    def outside(self, x) -> str:
        T = float(evaluate_at_points(_temperature, self, np.atleast_2d(x)).min())
        return "" if T > 0.0 else f"the temperature -dL/dS is {T:.4g}: it has to be positive"

    def domain_margin(self, x):
        return self.temperature(x)

    def specific_residuals(self, x) -> dict[str, jax.Array]:
        q, v, S, t = self.split_state(x)
        force = self.friction_force(q, v, S, t)
        scale = jnp.linalg.norm(force) * jnp.linalg.norm(v)
        positive_power = jnp.maximum(jnp.dot(force, v), 0.0)
        return {"F_fr . v <= 0": positive_power / jnp.where(scale > 0.0, scale, 1.0)}


def _temperature(system: SimpleClosedSystem, x):
    return system.temperature(x)


# -- arguments --------------------------------------------------------------------------------------------------------


def join_lagrangian_arguments(lagrangian, space: mf.Space | None = None):
    """Return a Lagrangian as a function of one array."""
    if callable(lagrangian) and not isinstance(lagrangian, Energy) and required_argument_count(lagrangian) == 4:
        raise InputError(
            "the Lagrangian of a simple closed system is one of (q, v, S); what depends on time is external"
        )
    return join_arguments(lagrangian, space)


def _make_friction(friction, shape: tuple[int, ...], what: str) -> Callable | None:
    if friction is None or callable(friction):
        return None if friction is None else _check_flat_function(friction, shape, shape, what)
    return linear_friction(friction, math.prod(shape), f"a coefficient of {what}")


class FlattenedFunction(Module):
    """A function of flat q and v with flat values, from a function of arrays q and v."""

    function: Callable
    shape: tuple[int, ...] = eqx.field(static=True)

    def __call__(self, q, v, S, t):
        found = jnp.asarray(self.function(q.reshape(self.shape), v.reshape(self.shape), S, t))
        return found.ravel() if found.ndim else found


def _check_flat_function(function, at: tuple[int, ...], shape: tuple[int, ...], what: str) -> Callable:
    """Check a function of (q, v, S, t), q and v of shape ``at``, and return it for flat q and v, with flat values."""
    checked = check_state_function(function, (at, at, ()), shape, what, f"(q, v, S), q and v of shape {at}")
    return checked if len(at) == 1 else FlattenedFunction(checked, at)
