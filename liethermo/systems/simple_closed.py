"""Simple closed systems: positions and one entropy, with friction, work and heat [GBY §2], and Chetaev's [SML §3.2]."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import ClassVar, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import manifolds as mf
from manifolds._arrays import is_traced
from manifolds._pytree_module import Module

from ..dissipation.base import LawName
from ..errors import InputError
from ..functions.checks import traced_function_and_shape
from ..functions.energy import Energy
from ..functions.newton import nan_unless_small, newton_iterate
from ..functions.time_span import LastArgumentIgnored, required_argument_count
from ..tracing.interpret import evaluate_at_points
from .evolution import join_arguments, state_space
from .herglotz import VelocityContactSystem, random_velocity_states
from .ledger import LEDGER_DIM, FlattenedFunction, ForcesAndHeat, LedgerSystem


class SimpleClosedSystem(LedgerSystem, VelocityContactSystem):
    """A simple closed system of a Lagrangian L(q, v, S), with friction, external force and heat [GBY 2.4].

    ``d/dt L_v - L_q = F_ext + F_fr`` and ``T S' = P_H - F_fr . v``, ``T = -L_S > 0``, on R^n or a manifold. The energy
    ``E = v . L_v - L`` changes by the work and heat received, ``E' = F_ext . v + P_H``, and the entropy production
    is ``-F_fr . v / T``: friction has to brake, which :meth:`check` tests.

    The state is (q, v, S), shape (2n + 1,). With an external force or a heat power it has three more components,
    the work W and the heat Q received so far and the time t: (q, v, S, W, Q, t), where the last three may be left
    out of an initial state and then are 0. The energy of such a system is ``E - W - Q``, that of system and
    surroundings: it is constant, and its change in a run is the defect of the energy balance. The audit has both
    sides of the ledger.

    :class:`liethermo.VariationalIntegrator` discretises its variational principle; the metriplectic schemes run it too.

    With ``space=`` the positions are the points of a manifold Q, and states have the arrays of q and v in one row.
    Forces act along Q: the constraint cancels their components normal to Q.

    Parameters
    ----------
    lagrangian : function of (q, v, S), q and v of shape (n,), or of all in one array, to a scalar; or an Energy
        Regular: ``L_vv`` has an inverse. ``lt.Kinetic(mass) - lt.Potential(U)`` where that is its form (energy).
    dim : int
        Components of (q, v, S), 2n + 1; known by itself of an ``lt.Quadratic``.
    friction : function of (q, v, S) or (q, v, S, t), to shape (n,); or a coefficient; optional
        F_fr, with ``F_fr . v <= 0`` (force). A coefficient R means ``F_fr = -R v``: a number, an array of shape (n,)
        for a diagonal matrix, or (n, n), whose symmetric part is positive semidefinite (mass / time).
    external : function of (q, v, S) or (q, v, S, t), to shape (n,); or an array of shape (n,); optional
        F_ext (force).
    heat_power : function of (q, v, S) or (q, v, S, t), to a scalar; or a number; optional
        P_H, the heat received per time (power).
    momentum_maps, validate : dict of functions, or a sequence of them; bool
        Conserved quantities of a symmetry, functions of the state; and whether to test the axioms, and that friction
        brakes, at a few random points. Use ``system.check(points=...)`` instead if a function is not defined there.
    space : manifolds.Space, optional
        Q: a space of real arrays, of whose shape q, v and forces then are in all of these functions.

    Raises
    ------
    AxiomError, FunctionError, InputError
        If an axiom fails, or a function or an argument does not fit; InputError for a singular Lagrangian.

    Attributes
    ----------
    contact, lagrangian : manifolds.LagrangianContact, Energy
    degrees_of_freedom, configurations : int, and manifolds.Space or None
        The number of components of q, and Q if it is not R^n.
    """

    entropy_production_name: ClassVar[str] = "dS/dt"

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
        at = f"(q, v, S), q and v of shape {shape}"
        forces = self._set_forces(friction, external, heat_power, (shape, shape, ()), at)
        self._build_with_ledger(structure, dim, energy, forces, momentum_maps, validate, self._state_space(space))

    def _state_space(self, space: mf.Space | None) -> mf.Space | None:
        """Return the space of states, with the ledger if there is one; None for positions in R^n."""
        return state_space(space, LEDGER_DIM if self.has_ledger else 0)

    # -- the state --------------------------------------------------------------------------------------------------

    @property
    def contact(self) -> mf.LagrangianContact:
        return cast(mf.LagrangianContact, cast(mf.Cosymplectic, self.poisson_without_ledger).contact)

    @property
    def degrees_of_freedom(self) -> int:
        return self.dim_without_ledger // 2

    @property
    def first_velocity_index(self) -> int:
        return self.degrees_of_freedom

    def tangential_part(self, q, v) -> jax.Array:
        return self.contact.tangential_part(q, v)

    def legendre(self, x) -> jax.Array:
        """Return states (q, L_v, S), shape (..., 2n + 1), the Legendre transform of states (q, v, S)."""
        return jnp.vectorize(self.contact.legendre, signature="(n)->(n)")(self.states_without_ledger(x))

    def temperature_at(self, y) -> jax.Array:
        return -self.lagrangian.gradient(y)[-1]

    def mechanical_energy(self, x) -> jax.Array:
        """Return the energy ``E = v·L_v - L`` of states without their ledger, shape (...)."""
        return jnp.vectorize(self.contact.energy, signature="(n)->()")(self.states_without_ledger(x))

    own_energy = mechanical_energy  # its name in 0.2

    # -- the functions, at one point ----------------------------------------------------------------------------------

    def lagrangian_value(self, q, v, S) -> jax.Array:
        """Return the value of the Lagrangian L(q, v, S) at one point, shape ()."""
        return self.lagrangian.value(jnp.concatenate([q, v, jnp.reshape(S, 1)]))

    def momentum(self, q, v, S) -> jax.Array:
        """Return the momentum ``L_v`` at one point, shape (n,)."""
        return jax.grad(self.lagrangian_value, argnums=1)(q, v, S)

    def momentum_jacobians(self, x) -> tuple[jax.Array, jax.Array]:
        _, W, S_derivative = self.contact.rates(x[: self.dim_without_ledger])
        return W, S_derivative[:, 0]


# -- arguments --------------------------------------------------------------------------------------------------------


def join_lagrangian_arguments(lagrangian, space: mf.Space | None = None):
    """Return a Lagrangian L(q, v, S) as a function of the state in one array; InputError for L(q, v, S, t)."""
    if callable(lagrangian) and not isinstance(lagrangian, Energy) and required_argument_count(lagrangian) == 4:
        raise InputError(
            "the Lagrangian of a simple closed system must be a function of (q, v, S). Give forces that depend on time "
            "as external="
        )
    return join_arguments(lagrangian, space)


N_NEWTON_ITERATIONS = 12
"""Number of iterations of Newton's method for S' if the form depends on it."""

CONSTRAINT_RTOL = 1e-12
"""Largest residual of the constraint after these iterations, relative to its terms."""

N_TEST_STATES = 16
"""Number of random states at which the sign of the entropy production is tested."""

PRODUCTION_ROUNDING_RTOL = 1e-12
"""Largest production that counts as rounding, relative to its terms."""


class ChetaevSystem(SimpleClosedSystem):
    """A mechanical system whose friction and heat are given by a one-form that vanishes on its motion [SML §3.2].

    The equations are ``d/dt L_v - L_q = lambda eta_q``, ``-L_S = lambda eta_S``, ``eta_q . q' + eta_S S' = 0`` [SML
    13-14]: those of the generalised Chetaev principle [SML Def. 3.1] on Q x R, in the state (q, v, S), for a Lagrangian
    L(q, v, S) and a semibasic one-form ``eta = eta_q dq + eta_S dS``. So ``lambda = T / eta_S`` with ``T = -L_S > 0``:
    the form is a force ``T eta_q / eta_S``, and the heat that it makes. The energy ``E = v . L_v - L`` is constant,
    whatever the form is, since ``E' = lambda (eta_q . v + eta_S S') = 0``. The entropy production is ``S' = -eta_q . v
    / eta_S``; where it is not negative at random points, the second law is stated, and held to.

    For ``eta = dS - L_v dq`` this is :class:`liethermo.ThermodynamicHerglotz` [SML Prop. 3.3], and for
    ``eta = T dS + F_fr dq`` a :class:`liethermo.SimpleClosedSystem` with the friction F_fr.

    The metriplectic schemes conserve the energy exactly, and S' >= 0 holds exactly in each step.
    :class:`liethermo.VariationalIntegrator` discretises the principle itself: D_1 L_d + D_2 L_d is a multiple of eta at
    the points of its finite difference maps, on which eta vanishes.

    Parameters
    ----------
    lagrangian, dim, momentum_maps, validate, space
        As for :class:`liethermo.SimpleClosedSystem`.
    eta : function of (q, v, S), q and v of shape (n,), to shape (n + 1,), or to shape (n,)
        The components (eta_q, eta_S), or eta_q alone where ``eta_S = 1``. It may be a function of (q, v, S, S'): the
        constraint is then solved for S' by Newton's method, from S' = 0. With a space q, v and eta_q are of its shape,
        and (eta_q, eta_S) is all of them in one row; what eta_q does across Q counts for nothing.

    Raises
    ------
    AxiomError, FunctionError, InputError
    """

    form: SemibasicForm

    entropy_production_name: ClassVar[str] = "S'"

    def __init__(
        self,
        lagrangian,
        eta: Callable,
        dim: int | None = None,
        momentum_maps=(),
        validate: bool = True,
        space: mf.Space | None = None,
    ):
        lagrangian = join_lagrangian_arguments(lagrangian, space)
        structure, dim, energy = self._build_contact_structure(lagrangian, dim, space)
        self.friction = self.external = self.heat_power = None
        self.form = SemibasicForm.from_function(eta, (dim // 2,) if space is None else space.shape)
        forces = ForcesAndHeat(law=_entropy_law_by_sampling(self.form, structure.contact))
        self._build_with_ledger(structure, dim, energy, forces, momentum_maps, validate, self._state_space(space))

    def friction_at_temperature(self, arguments, T) -> jax.Array:
        q, v, S, _ = arguments
        return T * self.tangential_part(q, self.form.force_covector(q, v, S))

    def friction_force(self, *arguments) -> jax.Array:
        """Return the friction force ``T eta_q / eta_S``, shape (n,), at the arguments (q, v, S, t)."""
        return self.friction_at_temperature(arguments, -jax.grad(self.lagrangian_value, argnums=2)(*arguments[:3]))

    def specific_axiom_residuals(self, x) -> dict[str, jax.Array]:
        return super().specific_axiom_residuals(x) if self.entropy_law == "nondecreasing" else {}


class SemibasicForm(Module):
    """A semibasic one-form on Q x R, given by its components as a function of (q, v, S, S'), shape (n + 1,)."""

    function: Callable
    is_implicit: bool = eqx.field(static=True)

    @classmethod
    def from_function(cls, eta, shape: tuple[int, ...]) -> SemibasicForm:
        """Return the one-form of a user's function, checked for q and v of a given shape."""
        if not callable(eta):
            raise InputError(f"eta must be a function of (q, v, S) that returns a one-form, got {eta!r}")
        is_implicit, n = required_argument_count(eta) == 4, math.prod(shape)
        function = eta if is_implicit else LastArgumentIgnored(eta)
        function = function if len(shape) == 1 else FlattenedFunction(function, shape)
        arguments = f"(q, v, S), q and v of shape {shape}"
        function, check_indices_and_return_shapes = traced_function_and_shape(
            function, ((n,), (n,), (), ()), ((n + 1,), (n,)), "eta", arguments
        )
        return cls(function if check_indices_and_return_shapes == (n + 1,) else _UnitEntropyForm(function), is_implicit)

    def entropy_rate(self, q, v, S) -> jax.Array:
        """Return the rate S', shape (), at which the form vanishes on the motion; NaN if Newton's method fails."""

        def residual(s):
            eta = self.function(q, v, S, s)
            return jnp.dot(eta[:-1], v) + eta[-1] * s, jnp.abs(eta[:-1]) @ jnp.abs(v) + jnp.abs(eta[-1] * s)

        n_steps = N_NEWTON_ITERATIONS if self.is_implicit else 1
        s = newton_iterate(lambda s: residual(s)[0], jnp.zeros(()), n_steps)
        if not self.is_implicit:  # linear in S'
            return s
        value, scale = residual(s)
        return nan_unless_small(s, value, CONSTRAINT_RTOL * scale)

    def force_covector(self, q, v, S) -> jax.Array:
        """Return the force per temperature, ``eta_q / eta_S``, shape (n,), at (q, v, S)."""
        eta = self.function(q, v, S, self.entropy_rate(q, v, S) if self.is_implicit else jnp.zeros(()))
        return eta[:-1] / eta[-1]


class _UnitEntropyForm(Module):
    """The components of a one-form with ``eta_S = 1``, computed from a function that returns ``eta_q``."""

    function: Callable

    def __call__(self, *arguments):
        return jnp.append(jnp.asarray(self.function(*arguments)), 1.0)


def _entropy_law_by_sampling(form: SemibasicForm, contact: mf.SplitContact) -> LawName | None:
    """Return the entropy law of a one-form, from the sign of its entropy production at random states."""
    if is_traced(form):
        return None
    rates, scales = evaluate_at_points(_entropy_production, form, random_velocity_states(contact, N_TEST_STATES))
    if (np.abs(rates) <= PRODUCTION_ROUNDING_RTOL * scales).all():
        return "conserved"
    return "nondecreasing" if (rates >= -PRODUCTION_ROUNDING_RTOL * scales).all() else None


def _entropy_production(form: SemibasicForm, x):
    """Return the entropy production S' at one state, and the size of the terms that are added up in it."""
    n = len(x) // 2
    covector = form.force_covector(x[:n], x[n : 2 * n], x[2 * n])
    return -jnp.dot(covector, x[n : 2 * n]), jnp.abs(covector) @ jnp.abs(x[n : 2 * n])
