"""Location of the first zero of the event functions within a step, one evaluation per attempt [Chandrupatla 1997].

With several event functions the search is for the zero of their minimum, each divided by its value at the start of the
step: it is 1 there, and first zero where the first of them is.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from .solver_options import EPS


class RootBracket(NamedTuple):
    """Bracket of a root: the function has opposite signs at the fractions a and b of a step.

    Attributes
    ----------
    step_size : array, shape ()
        Size of the step; 0 if no root is bracketed.
    trial_fraction : array, shape ()
        Fraction of the step at which the function is evaluated next.
    a, fa, b, fb, c, fc : array, shape ()
        Fractions of the step and the values there; ``a`` is the latest, and ``c`` was replaced by it.
    """

    step_size: jax.Array
    trial_fraction: jax.Array
    a: jax.Array
    fa: jax.Array
    b: jax.Array
    fb: jax.Array
    c: jax.Array
    fc: jax.Array


EMPTY_BRACKET = RootBracket(*np.zeros(len(RootBracket._fields)))
"""Bracket without a root."""


def packed_bracket_shape(event_shape: tuple[int]) -> tuple[int]:
    """Return the shape of a bracket and event values of shape ``event_shape``, packed into one array."""
    return (len(RootBracket._fields) + event_shape[0],)


def pack_bracket_and_end_values(bracket: RootBracket, end_values) -> jax.Array:
    """Pack the fields of a bracket, and the event values where the search ended, into one array."""
    return jnp.concatenate([jnp.stack([jnp.zeros(()) + value for value in bracket]), end_values])


def unpack_bracket_and_end_values(packed) -> tuple[RootBracket, Any]:
    """Unpack the bracket and the event values that :func:`pack_bracket_and_end_values` has packed."""
    n_fields = len(RootBracket._fields)
    return RootBracket(*packed[:n_fields]), packed[n_fields:]


def combined_event_value(directions: tuple[int, ...], values_before, values) -> jax.Array:
    """Return, at a point of a step, the value of a function whose first zero in the step is the first event.

    It is the only event function, or the minimum of them, each divided by its value at the start of the step. Functions
    that are zero or unknown there have no event in the step, nor have those whose events are in the other direction.
    """
    if len(directions) == 1:
        return values[0]
    can_cross = (
        (values_before != 0.0) & ~jnp.isnan(values_before) & (np.asarray(directions) * jnp.sign(values_before) <= 0.0)
    )
    scale = jnp.where(jnp.isinf(values_before), jnp.sign(values_before), jnp.where(can_cross, values_before, 1.0))
    return jnp.min(jnp.where(can_cross, values / scale, 1.0))


def combined_event_values_at_step_ends(
    directions: tuple[int, ...], values_before, values_after
) -> tuple[jax.Array, jax.Array]:
    """Return :func:`combined_event_value` at the start and at the end of a step in which an event happens.

    Functions that are NaN at the end are left out.
    """
    if len(directions) == 1:
        return values_before[0], values_after[0]
    values_after = jnp.where(jnp.isnan(values_after), values_before, values_after)
    return jnp.ones(()), combined_event_value(directions, values_before, values_after)


def bracket_from_step(step_size, value_before, value_after) -> RootBracket:
    """Return the bracket for a step whose event values at its ends are ``value_before`` and ``value_after``."""
    zero, one = jnp.zeros(()), jnp.ones(())
    bracket = RootBracket(
        zero + step_size, 0.5 * one, zero, zero + value_before, one, zero + value_after, zero, zero + value_before
    )
    return _select_bracket(value_after == 0.0, _bracket_for_final_trial(step_size, one), bracket)


def narrow_bracket(bracket: RootBracket, value) -> tuple[RootBracket, jax.Array]:
    """Return the bracket updated by the value at its trial fraction, and whether that is the root, to rounding."""
    t = bracket.trial_fraction
    has_sign_of_a = jnp.sign(value) == jnp.sign(bracket.fa)
    c, fc = jnp.where(has_sign_of_a, bracket.a, bracket.b), jnp.where(has_sign_of_a, bracket.fa, bracket.fb)
    opposite = jnp.where(has_sign_of_a, bracket.b, bracket.a)
    f_opposite = jnp.where(has_sign_of_a, bracket.fb, bracket.fa)
    best_fraction = jnp.where((jnp.abs(value) < jnp.abs(f_opposite)) | (value == 0.0), t, opposite)
    width, tolerance = jnp.abs(opposite - t), 4.0 * EPS * jnp.abs(best_fraction) + 1e-300
    is_converged = (width <= tolerance) | (value == 0.0)
    next_fraction = t + _next_fraction_between_a_and_b(
        t, opposite, c, value, f_opposite, fc, 0.5 * tolerance / jnp.maximum(width, tolerance)
    ) * (opposite - t)
    new_bracket = RootBracket(bracket.step_size, next_fraction, t, value, opposite, f_opposite, c, fc)
    return _select_bracket(
        is_converged, _bracket_for_final_trial(bracket.step_size, best_fraction), new_bracket
    ), is_converged & (best_fraction == t)


def _bracket_for_final_trial(step_size, fraction) -> RootBracket:
    """Return a bracket that is evaluated once more, at ``fraction``, and then closed."""
    infinite, fraction = jnp.full((), jnp.inf), jnp.zeros(()) + fraction
    return RootBracket(jnp.zeros(()) + step_size, fraction, fraction, infinite, fraction, infinite, fraction, infinite)


def _next_fraction_between_a_and_b(a, b, c, fa, fb, fc, min_fraction) -> jax.Array:
    """Return the next trial fraction between a and b: by inverse quadratic interpolation, or halfway."""
    xi, phi = (a - b) / (c - b), (fa - fb) / (fc - fb)
    is_safe = (phi**2 < xi) & ((1.0 - phi) ** 2 < 1.0 - xi)
    t = fa / (fb - fa) * fc / (fb - fc) + (c - a) / (b - a) * fa / (fc - fa) * fb / (fc - fb)
    return jnp.clip(jnp.where(is_safe & jnp.isfinite(t), t, 0.5), min_fraction, 1.0 - min_fraction)


def _select_bracket(condition, if_true: RootBracket, if_false: RootBracket) -> RootBracket:
    return RootBracket(*(jnp.where(condition, u, v) for u, v in zip(if_true, if_false, strict=True)))
