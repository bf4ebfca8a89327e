"""Systems of the generalised Chetaev principle: a Lagrangian, and a one-form that constrains the entropy [SML §3.2]."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import manifolds as mf
from manifolds._arrays import is_traced
from manifolds._pytree_module import Module

from ..dissipation.base import LawName
from ..errors import InputError
from ..functions.arguments import LastArgumentIgnored, required_argument_count
from ..functions.checks import traced_function_and_shape
from ..functions.newton import nan_unless_small, newton_iterate
from ..tracing.interpret import evaluate_at_points
from .herglotz import random_states
from .ledger import FlattenedFunction, ForcesAndHeat
from .simple_closed import SimpleClosedSystem, join_lagrangian_arguments

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

    The metriplectic schemes keep the energy, and the sign of S' in each step, exactly.
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

    production_name: ClassVar[str] = "S'"

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
        forces = ForcesAndHeat(law=_find_entropy_law(self.form, structure.contact))
        self._assemble(structure, dim, energy, forces, momentum_maps, validate, self._state_space(space))

    def friction_at(self, arguments, T) -> jax.Array:
        q, v, S, _ = arguments
        return T * self.tangential_part(q, self.form.force_covector(q, v, S))

    def friction_force(self, *arguments) -> jax.Array:
        """Return the force ``T eta_q / eta_S``, shape (n,), at the arguments (q, v, S, t)."""
        return self.friction_at(arguments, -jax.grad(self.lagrangian_value, argnums=2)(*arguments[:3]))

    def specific_residuals(self, x) -> dict[str, jax.Array]:
        return super().specific_residuals(x) if self.entropy_law == "nondecreasing" else {}


class SemibasicForm(Module):
    """A semibasic one-form on Q x R: its components as a function of (q, v, S, S'), shape (n + 1,)."""

    function: Callable
    is_implicit: bool = eqx.field(static=True)

    @classmethod
    def from_function(cls, eta, shape: tuple[int, ...]) -> SemibasicForm:
        """Return the checked form of a user's function, for q and v of a shape."""
        if not callable(eta):
            raise InputError(f"eta is a function of (q, v, S) to the components of a one-form, not {eta!r}")
        is_implicit, n = required_argument_count(eta) == 4, math.prod(shape)
        function = eta if is_implicit else LastArgumentIgnored(eta)
        function = function if len(shape) == 1 else FlattenedFunction(function, shape)
        arguments = f"(q, v, S), q and v of shape {shape}"
        function, checked_result_shapes = traced_function_and_shape(
            function, ((n,), (n,), (), ()), ((n + 1,), (n,)), "eta", arguments
        )
        return cls(function if checked_result_shapes == (n + 1,) else _UnitEntropyForm(function), is_implicit)

    def entropy_rate(self, q, v, S) -> jax.Array:
        """Return S' with ``eta_q . v + eta_S S' = 0``; NaN if Newton's method finds none."""

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
        """Return ``eta_q / eta_S``, shape (n,), at (q, v, S) and the S' that belongs to them."""
        eta = self.function(q, v, S, self.entropy_rate(q, v, S) if self.is_implicit else jnp.zeros(()))
        return eta[:-1] / eta[-1]


class _UnitEntropyForm(Module):
    """The components of a form with ``eta_S = 1``, from a function that returns ``eta_q``."""

    function: Callable

    def __call__(self, *arguments):
        return jnp.append(jnp.asarray(self.function(*arguments)), 1.0)


def _find_entropy_law(form: SemibasicForm, contact: mf.SplitContact) -> LawName | None:
    """Return the entropy law of a form, from the sign of its production at random states."""
    if is_traced(form):
        return None
    rates, scales = evaluate_at_points(_entropy_production, form, random_states(contact, N_TEST_STATES))
    if (np.abs(rates) <= PRODUCTION_ROUNDING_RTOL * scales).all():
        return "conserved"
    return "nondecreasing" if (rates >= -PRODUCTION_ROUNDING_RTOL * scales).all() else None


def _entropy_production(form: SemibasicForm, x):
    """Return S', and a scale of the terms that are added up in it."""
    n = len(x) // 2
    covector = form.force_covector(x[:n], x[n : 2 * n], x[2 * n])
    return -jnp.dot(covector, x[n : 2 * n]), jnp.abs(covector) @ jnp.abs(x[n : 2 * n])
