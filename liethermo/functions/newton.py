"""Newton's method: roots by a fixed number of steps, and the inverse of the gradient of an energy by damped steps."""

from __future__ import annotations

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp

from manifolds.matrices.linear import solve

from .energy import Energy

MAX_NEWTON_ITERATIONS = 50
"""Number of Newton steps after which an equation for a gradient counts as having no solution."""


def jacobian_and_value(function: Callable, *arguments):
    """Return the derivatives of a function by all of its arguments, and its value."""
    return jax.jacfwd(
        lambda *a: (lambda y: (y, y))(function(*a)),
        argnums=tuple(range(len(arguments))) if len(arguments) > 1 else 0,
        has_aux=True,
    )(*arguments)


def newton_correction(jacobian, residual) -> jax.Array:
    """Return ``jacobian^-1 residual``, the step that Newton's method subtracts.

    The arguments are numbers, or a matrix and a vector, shapes (n, n) and (n,).
    """
    return residual / jacobian if jnp.ndim(residual) == 0 else solve(jacobian, residual[:, None])[:, 0]


def newton_iterate(function: Callable, start, n_steps: int, jacobian_and_value: Callable = jacobian_and_value):
    """Return y, a number or of shape (n,), after ``n_steps`` steps of Newton's method for ``function(y) = 0``.

    Parameters
    ----------
    jacobian_and_value : function of ``function`` and y, optional
    """
    return jax.lax.fori_loop(0, n_steps, lambda _, y: y - newton_correction(*jacobian_and_value(function, y)), start)


def nan_unless_small(y, residual, max_residual) -> jax.Array:
    """Return y, or NaN if an entry of the residual exceeds the bound."""
    return jnp.where(jnp.max(jnp.abs(residual)) <= max_residual, y, jnp.nan)


@eqx.filter_custom_jvp
def inverse_gradient(lagrangian: Energy, mu: jax.Array) -> jax.Array:
    """Return xi with ``grad lagrangian (xi) = mu``, shape (n,), by damped Newton; NaN if it finds none."""

    def residual(xi):
        return lagrangian.gradient(xi) - mu

    def take_damped_newton_step(carry):
        xi, r, _, k = carry
        step = newton_correction(jax.hessian(lagrangian.value)(xi), r)

        def halve_step(state):
            t, _ = state
            return 0.5 * t, residual(xi - 0.5 * t * step)

        def is_too_long(state):
            t, trial_residual = state
            return (t > 1e-4) & ~(jnp.linalg.norm(trial_residual) <= (1.0 - 0.25 * t) * jnp.linalg.norm(r) + 1e-300)

        t, trial_residual = jax.lax.while_loop(is_too_long, halve_step, (1.0, residual(xi - step)))
        is_decreasing = jnp.linalg.norm(trial_residual) < jnp.linalg.norm(r)
        return (
            jnp.where(is_decreasing, xi - t * step, xi),
            jnp.where(is_decreasing, trial_residual, r),
            is_decreasing,
            k + 1,
        )

    def should_continue(carry):
        _, _, is_decreasing, k = carry
        return is_decreasing & (k < MAX_NEWTON_ITERATIONS)

    start = jnp.zeros_like(mu)
    xi, r, _, _ = jax.lax.while_loop(should_continue, take_damped_newton_step, (start, residual(start), True, 0))
    return jnp.where(jnp.linalg.norm(r) <= 1e-10 * (1.0 + jnp.linalg.norm(mu)), xi, jnp.nan)


@inverse_gradient.def_jvp
def _inverse_gradient_jvp(primals, tangents):
    """Return the inverse gradient and its tangent, from the derivative of ``grad l(xi) = mu``."""
    lagrangian, mu = primals
    lagrangian_dot, mu_dot = tangents
    xi = inverse_gradient(lagrangian, mu)
    # d(grad l)(xi) + l''(xi) dxi = dmu
    change = jnp.zeros_like(mu) if mu_dot is None else mu_dot
    if any(tangent is not None for tangent in jax.tree_util.tree_leaves(lagrangian_dot)):
        _, gradient_dot = eqx.filter_jvp(lambda lagrangian: lagrangian.gradient(xi), (lagrangian,), (lagrangian_dot,))
        change = change - gradient_dot
    return xi, newton_correction(jax.hessian(lagrangian.value)(xi), change)
