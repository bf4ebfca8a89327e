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
    """A bracket of a root in a step: the function has opposite signs at the fractions a and b.

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
    """Return the shape of the array that packs a bracket and one value of each event function."""
    return (len(RootBracket._fields) + event_shape[0],)


def pack_bracket_and_end_values(bracket: RootBracket, end_values) -> jax.Array:
    """Return one array with the fields of a bracket and the event values where a search ended."""
    return jnp.concatenate([jnp.stack([jnp.zeros(()) + value for value in bracket]), end_values])


def unpack_bracket_and_end_values(packed_bracket) -> tuple[RootBracket, Any]:
    """Return the bracket and the event values from an array of :func:`pack_bracket_and_end_values`."""
    n_fields = len(RootBracket._fields)
    return RootBracket(*packed_bracket[:n_fields]), packed_bracket[n_fields:]


def combined_event_value(directions: tuple[int, ...], values_before, values) -> jax.Array:
    """Return the value at a point of a step, shape (), of a function whose first zero is the first event.

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
    """Return the values of :func:`combined_event_value` at the start and at the end of a step with an event.

    Functions that are NaN at the end are left out.
    """
    if len(directions) == 1:
        return values_before[0], values_after[0]
    values_after = jnp.where(jnp.isnan(values_after), values_before, values_after)
    return jnp.ones(()), combined_event_value(directions, values_before, values_after)


def bracket_from_step(step_size, value_before, value_after) -> RootBracket:
    """Return the initial bracket of a root in a step, from the function values at its start and end."""
    zero, one = jnp.zeros(()), jnp.ones(())
    bracket = RootBracket(
        zero + step_size, 0.5 * one, zero, zero + value_before, one, zero + value_after, zero, zero + value_before
    )
    return _select_bracket(value_after == 0.0, _bracket_for_final_trial(step_size, one), bracket)


def narrow_bracket(bracket: RootBracket, value) -> tuple[RootBracket, jax.Array]:
    """Return the bracket narrowed by the value at its trial fraction, and whether that fraction is the root."""
    trial_fraction = bracket.trial_fraction
    has_sign_of_a = jnp.sign(value) == jnp.sign(bracket.fa)
    c, fc = jnp.where(has_sign_of_a, bracket.a, bracket.b), jnp.where(has_sign_of_a, bracket.fa, bracket.fb)
    opposite_fraction = jnp.where(has_sign_of_a, bracket.b, bracket.a)
    f_opposite = jnp.where(has_sign_of_a, bracket.fb, bracket.fa)
    best_fraction = jnp.where(
        (jnp.abs(value) < jnp.abs(f_opposite)) | (value == 0.0), trial_fraction, opposite_fraction
    )
    width, tolerance = jnp.abs(opposite_fraction - trial_fraction), 4.0 * EPS * jnp.abs(best_fraction) + 1e-300
    is_converged = (width <= tolerance) | (value == 0.0)
    next_fraction = trial_fraction + _next_fraction_between_a_and_b(
        trial_fraction, opposite_fraction, c, value, f_opposite, fc, 0.5 * tolerance / jnp.maximum(width, tolerance)
    ) * (opposite_fraction - trial_fraction)
    new_bracket = RootBracket(
        bracket.step_size, next_fraction, trial_fraction, value, opposite_fraction, f_opposite, c, fc
    )
    return _select_bracket(
        is_converged, _bracket_for_final_trial(bracket.step_size, best_fraction), new_bracket
    ), is_converged & (best_fraction == trial_fraction)


def _bracket_for_final_trial(step_size, fraction) -> RootBracket:
    """Return a bracket of width zero at ``fraction``, for a last evaluation there."""
    infinite, fraction = jnp.full((), jnp.inf), jnp.zeros(()) + fraction
    return RootBracket(jnp.zeros(()) + step_size, fraction, fraction, infinite, fraction, infinite, fraction, infinite)


def _next_fraction_between_a_and_b(a, b, c, fa, fb, fc, min_fraction) -> jax.Array:
    """Return the next trial fraction of the way from a to b, by inverse quadratic interpolation or bisection."""
    xi, phi = (a - b) / (c - b), (fa - fb) / (fc - fb)
    is_safe = (phi**2 < xi) & ((1.0 - phi) ** 2 < 1.0 - xi)
    t = fa / (fb - fa) * fc / (fb - fc) + (c - a) / (b - a) * fa / (fc - fa) * fb / (fc - fb)
    return jnp.clip(jnp.where(is_safe & jnp.isfinite(t), t, 0.5), min_fraction, 1.0 - min_fraction)


def _select_bracket(condition, true_bracket: RootBracket, false_bracket: RootBracket) -> RootBracket:
    """Return the first bracket if the condition is true, otherwise the second."""
    return RootBracket(*(jnp.where(condition, u, v) for u, v in zip(true_bracket, false_bracket, strict=True)))
