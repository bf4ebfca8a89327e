"""One step of Newton's method for the equations of a variational step: for its end, and for the velocity there."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp

from manifolds.matrices.linear import solve

from ...functions.surface import ConstraintSurface
from ...systems import SimpleClosedSystem
from ...tracing.interpret import polynomial_degree
from ...tracing.programs import jit_program
from .discrete import DiscreteSystem, Pair


def newton_step(discrete: DiscreteSystem, v0, p0, guess: Pair) -> tuple[jax.Array, jax.Array]:
    """V and s after one step of Newton's method for (3.12), from a guess or, where that is exact, from nothing."""
    n, (q0, V, S0, s) = len(guess.V), guess
    mass = mass_scale(discrete.system, q0, v0, S0)
    outright = discrete.curve is None and (
        polynomial_degree(_motion_residual_of_V, (discrete, p0, guess), n) <= 1
        and polynomial_degree(_motion_residual_of_s, (discrete, p0, guess), 1) == 0
    )
    if outright:
        A, misfit = _jacobian_and_value(
            lambda V: discrete.motion_residual(p0, Pair(q0, V, S0, jnp.zeros(()))), jnp.zeros(n)
        )
        V = -solve(A, misfit[:, None])[:, 0]
    else:  # (3.15), s eliminated

        def motion_and_constraint(V, s):
            pair = Pair(q0, V, S0, s)
            return discrete.motion_residual(p0, pair, mass), discrete.constraint_residual(pair)

        ((A, B), (C, D)), (misfit, gain) = _jacobian_and_value(motion_and_constraint, V, s)
        V = V - solve(A - jnp.outer(B, C) / D, (misfit - B * (gain / D))[:, None])[:, 0]
    s = jnp.zeros(()) if polynomial_degree(_constraint_residual_of_s, (discrete, p0, guess), 1) <= 1 else s
    slope, gain = _jacobian_and_value(lambda s: discrete.constraint_residual(Pair(q0, V, S0, s)), s)
    return V, s - gain / slope


def _jacobian_and_value(function: Callable, *at):
    """The derivatives of a function by all arguments, and its value."""
    return jax.jacfwd(
        lambda *a: (lambda y: (y, y))(function(*a)), argnums=tuple(range(len(at))) if len(at) > 1 else 0, has_aux=True
    )(*at)


def _motion_residual_of_V(model, V):
    discrete, p0, guess = model
    return discrete.motion_residual(p0, guess._replace(V=V))


def _motion_residual_of_s(model, s):
    discrete, p0, guess = model
    return discrete.motion_residual(p0, guess._replace(s=s[0]))


def _constraint_residual_of_s(model, s):
    discrete, _, guess = model
    return discrete.constraint_residual(guess._replace(s=s[0]))


def velocity_slope(system: SimpleClosedSystem, start, end, force, h) -> jax.Array:
    """``(v_1 - v_0)/h`` with ``L_v(q_1, v_1, S_1) = p_0 + h force``, one step of Newton's method.

    Parameters
    ----------
    start : (q_0, v_0, S_0, p_0)
    end : (q_1, slope, S_1)
        With a guess of the result.
    """
    (_, v0, _, p0), (q1, slope, S1) = start, end
    affine = polynomial_degree(_momentum_of_v, (system, q1, S1), len(v0)) <= 1
    slope = jnp.zeros_like(v0) if affine else slope
    W, p = _jacobian_and_value(lambda v: system.momentum(q1, v, S1), v0 + h * slope)
    W, missed = _restrict_to_tangents(system, q1, v0 + h * slope, W, (p - p0) / h - force, h)
    return slope - solve(W, missed[:, None])[:, 0]


def _restrict_to_tangents(system: SimpleClosedSystem, q, v, W, missed, h=1.0) -> tuple[jax.Array, jax.Array]:
    """The matrix and the misfit, over h, of an equation for a momentum at v; on a manifold along Q, and v tangent."""
    space = system.configurations
    if space is None:
        return W, missed
    surface, mass = ConstraintSurface(space, tangent=True), jnp.max(jnp.abs(W))

    def normal_residual(w):
        return surface._correction_displacement(
            q, jax.jvp(space._constraints, (space.from_vector(q),), (space.from_vector(w),))[1]
        )

    along = jax.vmap(lambda w: system.tangential_part(q, w), in_axes=1, out_axes=1)
    W = along(W) + mass * jax.vmap(normal_residual, out_axes=1)(jnp.eye(len(v)))
    return W, system.tangential_part(q, missed) + mass / h * normal_residual(v)


def mass_scale(system: SimpleClosedSystem, q, v, S) -> jax.Array:
    """The size of ``L_vv``."""
    return jnp.max(jnp.abs(jax.jacfwd(system.momentum, argnums=1)(q, v, S)))


def _momentum_of_v(model, v):
    system, q, S = model
    return system.momentum(q, v, S)


@jit_program
def velocity_from_momentum(system: SimpleClosedSystem, q, S, p, v):
    """v with ``L_v(q, v, S) = p``, near a guess; NaN where Newton's method finds none."""

    def newton(_, v):
        W, found = _jacobian_and_value(lambda v: system.momentum(q, v, S), v)
        W, missed = _restrict_to_tangents(system, q, v, W, found - p)
        return v - solve(W, missed[:, None])[:, 0]

    v = jax.lax.fori_loop(0, 20, newton, v)
    defect = jnp.max(jnp.abs(system.tangential_part(q, system.momentum(q, v, S) - p)))
    return jnp.where(defect <= 1e-12 * (1.0 + jnp.max(jnp.abs(p))), v, jnp.nan)
