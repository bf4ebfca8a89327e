"""The inverse of the gradient of an energy: the point at which the gradient has a given value."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp

from manifolds.matrices.linear import solve

from .energy import Energy

MAX_NEWTON_ITERATIONS = 50
"""Number of Newton steps after which an equation for a gradient counts as having no solution."""


@eqx.filter_custom_jvp
def inverse_gradient(lagrangian: Energy, mu: jax.Array) -> jax.Array:
    """Return xi with ``grad lagrangian (xi) = mu``, shape (n,), by damped Newton; NaN if it finds none."""

    def residual(xi):
        return lagrangian.gradient(xi) - mu

    def refine(carry):
        xi, r, _, k = carry
        step = solve(jax.hessian(lagrangian.value)(xi), r[:, None])[:, 0]

        def shorten(state):
            t, _ = state
            return 0.5 * t, residual(xi - 0.5 * t * step)

        def is_too_long(state):
            t, trial = state
            return (t > 1e-4) & ~(jnp.linalg.norm(trial) <= (1.0 - 0.25 * t) * jnp.linalg.norm(r) + 1e-300)

        t, trial = jax.lax.while_loop(is_too_long, shorten, (1.0, residual(xi - step)))
        shrinking = jnp.linalg.norm(trial) < jnp.linalg.norm(r)
        return jnp.where(shrinking, xi - t * step, xi), jnp.where(shrinking, trial, r), shrinking, k + 1

    def should_continue(carry):
        _, _, shrinking, k = carry
        return shrinking & (k < MAX_NEWTON_ITERATIONS)

    start = jnp.zeros_like(mu)
    xi, r, _, _ = jax.lax.while_loop(should_continue, refine, (start, residual(start), True, 0))
    return jnp.where(jnp.linalg.norm(r) <= 1e-10 * (1.0 + jnp.linalg.norm(mu)), xi, jnp.nan)


@inverse_gradient.def_jvp
def _inverse_gradient_jvp(primals, tangents):
    lagrangian, mu = primals
    lagrangian_dot, mu_dot = tangents
    xi = inverse_gradient(lagrangian, mu)
    # d(grad l)(xi) + l''(xi) dxi = dmu
    change = jnp.zeros_like(mu) if mu_dot is None else mu_dot
    if any(tangent is not None for tangent in jax.tree_util.tree_leaves(lagrangian_dot)):
        _, gradient_dot = eqx.filter_jvp(lambda lagrangian: lagrangian.gradient(xi), (lagrangian,), (lagrangian_dot,))
        change = change - gradient_dot
    return xi, solve(jax.hessian(lagrangian.value)(xi), change[:, None])[:, 0]
