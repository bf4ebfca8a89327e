"""Discrete Herglotz integrators of the evolution field [SML §6.3], of order 1 as printed, and of orders 2 and 4."""

from __future__ import annotations

from collections.abc import Callable
from typing import ClassVar, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import manifolds as mf
from manifolds._pytree_module import Module
from manifolds.matrices.linear import solve

from ..errors import InputError
from ..functions.checks import traced_function_and_shape
from ..functions.conditions import checked_numbers
from ..functions.energy import Energy, make_energy
from ..functions.surface import ConstraintSurface
from ..functions.time_span import required_argument_count
from ..systems import EvolutionSystem, System
from ..systems.kind_checks import require_kind, unwrap_user_system
from .base import WHY_FIXED_VARIATIONAL_STEP, OneStepMethod, apply_increment, checked_step_size

_SUZUKI_OUTER_FRACTION = 1.0 / (4.0 - 4.0 ** (1.0 / 3.0))
_SUZUKI_FRACTIONS = {
    2: (1.0,),
    4: (
        _SUZUKI_OUTER_FRACTION,
        _SUZUKI_OUTER_FRACTION,
        1.0 - 4.0 * _SUZUKI_OUTER_FRACTION,
        _SUZUKI_OUTER_FRACTION,
        _SUZUKI_OUTER_FRACTION,
    ),
}

SUBSTEPS: dict[int, tuple[tuple[float, bool], ...]] = {1: ((1.0, True),)} | {
    order: tuple((0.5 * fraction, is_forward) for fraction in fractions for is_forward in (True, False))
    for order, fractions in _SUZUKI_FRACTIONS.items()
}
"""Substeps of a step, by order: (fraction of the step, True for the scheme or False for its adjoint)."""


class DiscreteHerglotz(OneStepMethod):
    """Discrete Herglotz integrator of an evolution field, of order 1, 2 or 4 [SML §6.3].

    It solves ``D_1 L_d(q_1, q_2, S_1) + (1 + D_S L_d(q_1, q_2, S_1)) D_2 L_d(q_0, q_1, S_0) = 0`` for q_2 [SML 40],
    with ``S_1 - S_0 = (q_1 - q_0)·D_2 L_d(q_0, q_1, S_0)`` [SML 41].

    It runs as a one-step method on states (q, p, S) of an :class:`liethermo.EvolutionSystem`, with the momentum ``p_1 =
    D_2 L_d(q_0, q_1, S_0)``: (40) gives q_2 from (q_1, p_1, S_1), for any action S_1. The discrete Lagrangian alone
    determines the step; the system only determines which energy and entropy are recorded.

    The scheme has order 1, since (40) and (41) use the entropy at the start of the step. Its adjoint, the scheme
    backward in time, uses the entropy at the end:

        D_2 L_d(q_1, q_0, S_1; -h) = p_0,  S_1 - S_0 = (q_1 - q_0)·p_0,  p_1 = -D_1 L_d / (1 + D_S L_d).

    Half a step of the scheme and half a step of the adjoint form a symmetric step, of order 2. Five such steps in the
    proportions of Suzuki (1990) have order 4 [Hairer, Lubich & Wanner 2006, II.4]; the third of them goes backward in
    time.

    Neither the energy nor the sign of the entropy production is exact. If L does not depend on S, the scheme is a
    variational integrator. Each substep solves one equation of the size of q by Newton's method; it is explicit if L_d
    is quadratic in q_2.

    On a manifold Q of an evolution system with ``space=`` the equations hold along Q, and q_2 is on Q to rounding. L_d
    is then a function of two arrays of the shape of Q. :meth:`midpoint` evaluates L at the middle of their chord, so
    its Lagrangian has to be defined near Q too.

    Parameters
    ----------
    discrete_lagrangian : function of (q_0, q_1, S_0, h), q of shape (n,) or of a space, to a scalar
        The action of a step, such as ``h L``; :meth:`midpoint` makes one from a Lagrangian.
    order : {1, 2, 4}
        Orders 2 and 4 need the action of a step of size -h too.
    """

    systems = "evolution systems"
    why_fixed_step: ClassVar[str] = WHY_FIXED_VARIATIONAL_STEP

    discrete_lagrangian: Callable
    number: int = eqx.field(static=True)

    def __init__(self, discrete_lagrangian: Callable, order: Literal[1, 2, 4] = 1):
        if order not in tuple(SUBSTEPS):
            raise InputError(f"order must be 1, 2 or 4, got {order!r}")
        if not callable(discrete_lagrangian):
            raise InputError(
                f"the discrete Lagrangian must be a function of (q_0, q_1, S_0, h), got {discrete_lagrangian!r}"
            )
        self.discrete_lagrangian, self.number = discrete_lagrangian, order

    @classmethod
    def midpoint(cls, lagrangian, order: Literal[1, 2, 4] = 1) -> DiscreteHerglotz:
        """Return the integrator of ``L_d(q_0, q_1, S_0) = h L((q_0 + q_1)/2, (q_1 - q_0)/h, S_0)`` [SML Example 7].

        Parameters
        ----------
        lagrangian : function of (q, v, S), or of all in one array, shape (2n + 1,), to a scalar; or an Energy
        order : {1, 2, 4}
        """
        has_three_arguments = (
            callable(lagrangian) and not isinstance(lagrangian, Energy) and required_argument_count(lagrangian) == 3
        )
        return cls(
            _MidpointAction(
                lagrangian
                if has_three_arguments
                else _LagrangianOfThreeArguments(make_energy(lagrangian, "the Lagrangian"))
            ),
            order,
        )

    @property
    def stages(self) -> int:
        return len(SUBSTEPS[self.number])

    @property
    def order(self) -> int:
        return self.number

    preserves = frozenset()

    def __str__(self) -> str:
        return "DiscreteHerglotz" if self.number == 1 else f"DiscreteHerglotz(order={self.number})"

    def state(self, q0, q1, S0, h) -> jax.Array:
        """Return the state (q_1, p_1, S_1) after a known first step, shape (2n + 1,), from which a run can start."""
        q0 = jnp.atleast_1d(checked_numbers(q0, "q0"))
        q1, S0, h = (
            jnp.atleast_1d(checked_numbers(q1, "q1", q0.shape, ())),
            checked_numbers(S0, "S0", ()),
            checked_step_size(h),
        )
        self._check_discrete_lagrangian(q0.shape)
        p1 = jax.grad(self.discrete_lagrangian, argnums=1)(q0, q1, S0, h)
        return jnp.concatenate([q1, p1, (S0 + jnp.dot(q1 - q0, p1))[None]])

    def check(self, system: System) -> None:
        """Raise InputError unless the state has the form (q, p, S)."""
        system = _evolution_system(system)
        space = system.configurations
        self._check_discrete_lagrangian((system.dim // 2,) if space is None else space.shape)

    def _check_discrete_lagrangian(self, position_shape: tuple[int, ...]) -> None:
        """Raise FunctionError unless the discrete Lagrangian returns a number for positions of this shape."""
        arguments_text = f"(q_0, q_1, S_0, h), q_0 and q_1 of shape {position_shape}"
        traced_function_and_shape(
            self.discrete_lagrangian,
            [position_shape, position_shape, (), ()],
            [()],
            "the discrete Lagrangian",
            arguments_text,
        )

    def weights(self, theta) -> np.ndarray:
        return np.asarray(theta)[..., None] * self._substep_fractions

    @property
    def _substep_fractions(self) -> np.ndarray:
        """Sizes of the substeps over that of the step, shape (stages,)."""
        return np.array([fraction for fraction, _ in SUBSTEPS[self.number]])

    def slopes(self, system: System, x, compensation, h, k) -> jax.Array:
        system = _evolution_system(system)
        space, y, slopes, n = system.configurations, x + compensation, [], len(x) // 2
        action = self.discrete_lagrangian if space is None else _ActionOfFlatArrays(self.discrete_lagrangian, space)
        for (fraction, is_forward), guess in zip(SUBSTEPS[self.number], k, strict=True):
            slope = (_forward_substep_slope if is_forward else _adjoint_substep_slope)(
                action, system.contact, y, fraction * h, guess[:n]
            )
            slopes.append(slope)
            y = y + (fraction * h) * slope
        return jnp.stack(slopes)

    def increment(self, h, k) -> jax.Array:
        return h * (self._substep_fractions @ k)

    def move(self, system: System, x, compensation, h, k) -> tuple[jax.Array, jax.Array]:
        return apply_increment(self, system, x, compensation, self.increment(h, k), ends_on_surface=True)


def _forward_substep_slope(action: Callable, contact: mf.SplitContact, y, h, guess) -> jax.Array:
    """Return the slope of a forward substep, by (40) and (41), after one step of Newton's method for its velocity."""
    n = len(guess)
    q, p, S = y[:n], y[n : 2 * n], y[2 * n]

    def start_momentum_residual(q1):
        dL_dq, dL_dS = jax.grad(action, argnums=(0, 2))(q, q1, S, h)
        return dL_dq + (1.0 + dL_dS) * p

    velocity = _newton_velocity(start_momentum_residual, contact, q, h, guess)
    q1 = q + h * velocity
    p1 = contact.tangential_part(q1, jax.grad(action, argnums=1)(q, q1, S, h))
    return jnp.concatenate([velocity, (p1 - p) / h, jnp.dot(velocity, p1)[None]])


def _adjoint_substep_slope(action: Callable, contact: mf.SplitContact, y, h, guess) -> jax.Array:
    """Return the slope of a substep of the adjoint scheme, after one step of Newton's method for its velocity."""
    n = len(guess)
    q, p, S = y[:n], y[n : 2 * n], y[2 * n]

    def backward_action_arguments(q1):
        return q1, q, S + jnp.dot(q1 - q, p), -h

    velocity = _newton_velocity(
        lambda q1: jax.grad(action, argnums=1)(*backward_action_arguments(q1)) - p, contact, q, h, guess
    )
    q1 = q + h * velocity
    dL_dq, dL_dS = jax.grad(action, argnums=(0, 2))(*backward_action_arguments(q1))
    p1 = contact.tangential_part(q1, -dL_dq / (1.0 + dL_dS))
    return jnp.concatenate([velocity, (p1 - p) / h, jnp.dot(velocity, p)[None]])


def _newton_velocity(residual: Callable, contact: mf.SplitContact, q, h, velocity_guess) -> jax.Array:
    """Return the velocity after one Newton step for ``residual(q + h velocity) = 0``.

    On a manifold the equation is solved along it, and ``q + h velocity`` is brought onto it.
    """
    A, residual_value = h * jax.jacfwd(residual)(q + h * velocity_guess), residual(q + h * velocity_guess)
    if isinstance(contact.bundle, mf.TangentBundle):
        surface, mass = ConstraintSurface(contact.bundle.base, tangent=True), jnp.max(jnp.abs(A))

        def scaled_distance_from_manifold(v):  # times a mass, so that it is a momentum
            return mass * surface._correction_displacement(q, surface._constraint_change(q, 0.0, h * v) / h)

        A = jax.vmap(lambda column: contact.tangential_part(q, column), in_axes=1, out_axes=1)(A) + jax.jacfwd(
            scaled_distance_from_manifold
        )(velocity_guess)
        residual_value = contact.tangential_part(q, residual_value) + scaled_distance_from_manifold(velocity_guess)
    return velocity_guess - solve(A, residual_value[:, None])[:, 0]


def _evolution_system(system: System) -> EvolutionSystem:
    """Return the evolution system itself, or the one on a manifold that an embedded system wraps."""
    return require_kind(unwrap_user_system(system), EvolutionSystem, "DiscreteHerglotz")


class _ActionOfFlatArrays(Module):
    """A discrete Lagrangian of two points of a space, called with the flat arrays of the points."""

    action: Callable
    space: mf.Space = eqx.field(static=True)

    def __call__(self, q0, q1, S0, h):
        return self.action(self.space.from_vector(q0), self.space.from_vector(q1), S0, h)


class _MidpointAction(Module):
    """The discrete Lagrangian of the midpoint rule, h times a Lagrangian in the middle of a step."""

    lagrangian: Callable

    def __call__(self, q0, q1, S0, h):
        return h * self.lagrangian(0.5 * (q0 + q1), (q1 - q0) / h, S0)


class _LagrangianOfThreeArguments(Module):
    """A Lagrangian called with three arguments q, v and S, from an Energy of one array."""

    energy: Energy

    def __call__(self, q, v, S):
        return self.energy.value(jnp.concatenate([q.ravel(), v.ravel(), jnp.reshape(S, 1)]))
