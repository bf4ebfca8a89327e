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
from ..functions.checks import check_function_shape
from ..tracing.interpret import evaluate_at_points
from .herglotz import random_states
from .ledger import ForcesAndHeat
from .simple_closed import FlattenedFunction, SimpleClosedSystem, join_lagrangian_arguments

N_NEWTON_ITERATIONS, CONSTRAINT_RTOL = 12, 1e-12
"""For S' where the form depends on it; and the share of its terms that the constraint may miss then."""

N_TEST_STATES, PRODUCTION_ROUNDING_RTOL = 16, 1e-12
"""Random points at which the production is looked at, and the share of its terms that is rounding."""


class ChetaevSystem(SimpleClosedSystem):
    """``d/dt L_v - L_q = lambda eta_q``, ``-L_S = lambda eta_S``, ``eta_q . q' + eta_S S' = 0`` [SML Def. 3.1, 13-14].

    These are the equations of the generalised Chetaev principle on Q x R, in the state (q, v, S), for a Lagrangian
    L(q, v, S) and a semibasic one-form ``eta = eta_q dq + eta_S dS``. So ``lambda = T / eta_S`` with ``T = -L_S > 0``:
    the form is a force ``T eta_q / eta_S``, and the heat that it makes. The energy ``E = v . L_v - L`` is constant,
    whatever the form is, since ``E' = lambda (eta_q . v + eta_S S') = 0``. The entropy production is
    ``S' = -eta_q . v / eta_S``; where it is not negative at random points, the second law is stated, and held to.

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
        structure, size, energy = self._build_contact_structure(
            join_lagrangian_arguments(lagrangian, space), dim, space
        )
        self.friction = self.external = self.heat_power = None
        self.form = SemibasicForm.from_function(eta, (size // 2,) if space is None else space.shape)
        forces = OneFormForce(None, None, None, _find_entropy_law(self.form, structure.contact))
        self._assemble(structure, size, energy, forces, momentum_maps, validate)

    def friction_at(self, q, v, S, t, T) -> jax.Array:
        del t
        return T * self.tangential_part(q, self.form.force_covector(q, v, S))

    def friction_force(self, q, v, S, t) -> jax.Array:
        """The force ``T eta_q / eta_S``, shape (n,)."""
        return self.friction_at(q, v, S, t, -jax.grad(self.lagrangian_value, argnums=2)(q, v, S))

    def specific_residuals(self, x) -> dict[str, jax.Array]:
        return super().specific_residuals(x) if self.entropy_law == "nondecreasing" else {}


class OneFormForce(ForcesAndHeat):
    """The force of a one-form, with the law of the entropy that it has."""

    law: LawName | None = eqx.field(static=True)

    @property
    def entropy_law(self) -> LawName | None:
        return self.law


class SemibasicForm(Module):
    """A semibasic one-form on Q x R: its components as a function of (q, v, S, S'), shape (n + 1,)."""

    function: Callable
    is_implicit: bool = eqx.field(static=True)

    @classmethod
    def from_function(cls, eta, at: tuple[int, ...]) -> SemibasicForm:
        """From what a user gives, checked; q and v of shape ``at``."""
        if not callable(eta):
            raise InputError(f"eta is a function of (q, v, S) to the components of a one-form, not {eta!r}")
        implicit, n, what = required_argument_count(eta) == 4, math.prod(at), f"(q, v, S), q and v of shape {at}"
        given = eta if implicit else LastArgumentIgnored(eta)
        given = given if len(at) == 1 else FlattenedFunction(given, at)
        function, found = check_function_shape(given, ((n,), (n,), (), ()), ((n + 1,), (n,)), "eta", what)
        return cls(function if found == (n + 1,) else _UnitEntropyForm(function), implicit)

    def entropy_rate(self, q, v, S) -> jax.Array:
        """S' with ``eta_q . v + eta_S S' = 0``; NaN where none is found."""

        def residual(s):
            found = self.function(q, v, S, s)
            return jnp.dot(found[:-1], v) + found[-1] * s, jnp.abs(found[:-1]) @ jnp.abs(v) + jnp.abs(found[-1] * s)

        def newton(_, s):
            (defect, _), (slope, _) = jax.jvp(residual, (s,), (jnp.ones(()),))
            return s - defect / slope

        s = jax.lax.fori_loop(0, N_NEWTON_ITERATIONS if self.is_implicit else 1, newton, jnp.zeros(()))
        if not self.is_implicit:  # linear in S'
            return s
        defect, size = residual(s)
        return jnp.where(jnp.abs(defect) <= CONSTRAINT_RTOL * size, s, jnp.nan)

    def force_covector(self, q, v, S) -> jax.Array:
        """``eta_q / eta_S``, shape (n,), at the S' that goes with (q, v, S)."""
        found = self.function(q, v, S, self.entropy_rate(q, v, S) if self.is_implicit else jnp.zeros(()))
        return found[:-1] / found[-1]


class _UnitEntropyForm(Module):
    """``eta_q`` with ``eta_S = 1`` behind it."""

    function: Callable

    def __call__(self, *arguments):
        return jnp.append(jnp.asarray(self.function(*arguments)), 1.0)


def _find_entropy_law(form: SemibasicForm, contact: mf.SplitContact) -> LawName | None:
    """What a form says of the entropy, from its production at random points."""
    if is_traced(form):
        return None
    rates, sizes = evaluate_at_points(_entropy_production, form, random_states(contact, N_TEST_STATES))
    if (np.abs(rates) <= PRODUCTION_ROUNDING_RTOL * sizes).all():
        return "conserved"
    return "nondecreasing" if (rates >= -PRODUCTION_ROUNDING_RTOL * sizes).all() else None


def _entropy_production(form: SemibasicForm, x):
    """S', and the size of the terms that it is the sum of."""
    n = len(x) // 2
    covector = form.force_covector(x[:n], x[n : 2 * n], x[2 * n])
    return -jnp.dot(covector, x[n : 2 * n]), jnp.abs(covector) @ jnp.abs(x[n : 2 * n])
