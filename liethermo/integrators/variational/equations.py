"""One step of Newton's method for the equations of a variational step: for its end, and for the velocity there."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from ...functions.newton import jacobian_and_value, nan_unless_small, newton_correction, newton_iterate
from ...functions.surface import ConstraintSurface
from ...systems import SimpleClosedSystem
from ...tracing.interpret import polynomial_degree_bound
from ...tracing.programs import jit_cached
from .discrete import DiscreteSystem, Pair


def newton_velocity_and_entropy_slope(
    discrete: DiscreteSystem, start_velocity, p0, guess: Pair
) -> tuple[jax.Array, jax.Array]:
    """Return the velocity V and the entropy slope s after one Newton step for (3.12); exact if (3.12) is affine."""
    n, (q0, V, S0, s) = len(guess.V), guess
    mass = mass_scale(discrete.system, q0, start_velocity, S0)
    is_affine = discrete.curve is None and (
        polynomial_degree_bound(_motion_residual_of_V, (discrete, p0, guess), n) <= 1
        and polynomial_degree_bound(_motion_residual_of_s, (discrete, p0, guess), 1) == 0
    )
    if is_affine:
        A, residual = jacobian_and_value(
            lambda V: discrete.motion_residual(p0, Pair(q0, V, S0, jnp.zeros(()))), jnp.zeros(n)
        )
        V = -newton_correction(A, residual)
    else:  # (3.15), s eliminated

        def motion_and_constraint(V, s):
            pair = Pair(q0, V, S0, s)
            return discrete.motion_residual(p0, pair, mass), discrete.constraint_residual(pair)

        ((A, B), (C, D)), (residual, constraint_value) = jacobian_and_value(motion_and_constraint, V, s)
        V = V - newton_correction(A - jnp.outer(B, C) / D, residual - B * (constraint_value / D))
    s = jnp.zeros(()) if polynomial_degree_bound(_constraint_residual_of_s, (discrete, p0, guess), 1) <= 1 else s
    slope, constraint_value = jacobian_and_value(lambda s: discrete.constraint_residual(Pair(q0, V, S0, s)), s)
    return V, s - constraint_value / slope


def _motion_residual_of_V(fixed_arguments, V):
    discrete, p0, guess = fixed_arguments
    return discrete.motion_residual(p0, guess._replace(V=V))


def _motion_residual_of_s(fixed_arguments, s):
    discrete, p0, guess = fixed_arguments
    return discrete.motion_residual(p0, guess._replace(s=s[0]))


def _constraint_residual_of_s(fixed_arguments, s):
    discrete, _, guess = fixed_arguments
    return discrete.constraint_residual(guess._replace(s=s[0]))


def velocity_slope(system: SimpleClosedSystem, start, end, force, h) -> jax.Array:
    """Return the slope ``(v_1 - v_0)/h``, where v_1 has the momentum ``p_0 + h force``, after one Newton step.

    Parameters
    ----------
    start : (q_0, v_0, S_0, p_0)
    end : (q_1, slope, S_1)
        ``slope`` is a guess of the result.
    """
    (_, v0, _, p0), (q1, slope, S1) = start, end
    affine = polynomial_degree_bound(_momentum_of_v, (system, q1, S1), len(v0)) <= 1
    slope = jnp.zeros_like(v0) if affine else slope
    W, p = jacobian_and_value(lambda v: system.momentum(q1, v, S1), v0 + h * slope)
    W, residual = _restrict_to_tangent_space(system, q1, v0 + h * slope, W, (p - p0) / h - force, h)
    return slope - newton_correction(W, residual)


def _restrict_to_tangent_space(
    system: SimpleClosedSystem, q, v, mass_matrix, residual, h=1.0
) -> tuple[jax.Array, jax.Array]:
    """Return matrix and residual (over h) of an equation for a momentum, restricted to velocities tangent to Q."""
    space = system.configurations
    if space is None:
        return mass_matrix, residual
    surface, mass = ConstraintSurface(space, tangent=True), jnp.max(jnp.abs(mass_matrix))

    def normal_residual(w):
        return surface._correction_displacement(
            q, jax.jvp(space._constraints, (space.from_vector(q),), (space.from_vector(w),))[1]
        )

    tangent_columns = jax.vmap(lambda w: system.tangential_part(q, w), in_axes=1, out_axes=1)
    mass_matrix = tangent_columns(mass_matrix) + mass * jax.vmap(normal_residual, out_axes=1)(jnp.eye(len(v)))
    return mass_matrix, system.tangential_part(q, residual) + mass / h * normal_residual(v)


def mass_scale(system: SimpleClosedSystem, q, v, S) -> jax.Array:
    """Return the largest entry of the mass matrix ``L_vv`` by absolute value, shape ()."""
    return jnp.max(jnp.abs(jax.jacfwd(system.momentum, argnums=1)(q, v, S)))


def _momentum_of_v(fixed_arguments, v):
    system, q, S = fixed_arguments
    return system.momentum(q, v, S)


@jit_cached
def velocity_from_momentum(system: SimpleClosedSystem, q, S, p, velocity_guess):
    """Return v with ``L_v(q, v, S) = p``, near a guess; NaN if Newton's method does not converge."""

    def start_momentum_residual(v):
        return system.momentum(q, v, S) - p

    def tangent_jacobian_and_value(function, v):
        return _restrict_to_tangent_space(system, q, v, *jacobian_and_value(function, v))

    v = newton_iterate(start_momentum_residual, velocity_guess, 20, tangent_jacobian_and_value)
    residual = system.tangential_part(q, start_momentum_residual(v))
    return nan_unless_small(v, residual, 1e-12 * (1.0 + jnp.max(jnp.abs(p))))
