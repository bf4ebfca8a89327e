"""Where in a step a function changes its sign, looked for one attempt after another [Chandrupatla 1997]."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from .rules import EPS


class RootBracket(NamedTuple):
    """What is known of the root: it is between a and b, shares of a step, at which the function has other signs.

    Attributes
    ----------
    step_size : array, shape ()
        Size of the step; 0 where nothing is looked for.
    trial_fraction : array, shape ()
        The one to look at next.
    a, fa, b, fb, c, fc : array, shape ()
        Shares and the values there, that at ``a`` the last one; ``c`` was given up for it.
    """

    step_size: jax.Array
    trial_fraction: jax.Array
    a: jax.Array
    fa: jax.Array
    b: jax.Array
    fb: jax.Array
    c: jax.Array
    fc: jax.Array


EMPTY_BRACKET = np.zeros(len(RootBracket._fields))
"""No search, as an array."""

LAST_VALUE_INDEX = RootBracket._fields.index("fa")
"""The place of the last value in a search as an array."""


def bracket_from_step(whole, before, after) -> RootBracket:
    """The search in a step with these values at its ends."""
    zero, one = jnp.zeros(()), jnp.ones(())
    search = RootBracket(zero + whole, 0.5 * one, zero, zero + before, one, zero + after, zero, zero + before)
    return _select_bracket(after == 0.0, _final_evaluation(whole, one), search)


def narrow_bracket(search: RootBracket, value) -> tuple[RootBracket, jax.Array]:
    """The search after the value at its share, and whether this is the root, to rounding: the next look may be last."""
    t = search.trial_fraction
    same = jnp.sign(value) == jnp.sign(search.fa)
    c, fc = jnp.where(same, search.a, search.b), jnp.where(same, search.fa, search.fb)
    other, fo = jnp.where(same, search.b, search.a), jnp.where(same, search.fb, search.fa)
    best = jnp.where((jnp.abs(value) < jnp.abs(fo)) | (value == 0.0), t, other)
    width, least = jnp.abs(other - t), 4.0 * EPS * jnp.abs(best) + 1e-300
    done = (width <= least) | (value == 0.0)
    share = t + _next_trial_fraction(t, other, c, value, fo, fc, 0.5 * least / jnp.maximum(width, least)) * (other - t)
    narrower = RootBracket(search.step_size, share, t, value, other, fo, c, fc)
    return _select_bracket(done, _final_evaluation(search.step_size, best), narrower), done & (best == t)


def closed_bracket(value) -> RootBracket:
    """No search any more, but what the function is where one has ended."""
    return RootBracket(*jnp.asarray(EMPTY_BRACKET))._replace(fa=jnp.zeros(()) + value)


def _final_evaluation(whole, share) -> RootBracket:
    """One look at a share, whatever is found."""
    infinite, share = jnp.full((), jnp.inf), jnp.zeros(()) + share
    return RootBracket(jnp.zeros(()) + whole, share, share, infinite, share, infinite, share, infinite)


def _next_trial_fraction(a, b, c, fa, fb, fc, least) -> jax.Array:
    """Where between a and b to look next: by inverse quadratic interpolation where that is safe, or halfway."""
    xi, phi = (a - b) / (c - b), (fa - fb) / (fc - fb)
    safe = (phi**2 < xi) & ((1.0 - phi) ** 2 < 1.0 - xi)
    t = fa / (fb - fa) * fc / (fb - fc) + (c - a) / (b - a) * fa / (fc - fa) * fb / (fc - fb)
    return jnp.clip(jnp.where(safe & jnp.isfinite(t), t, 0.5), least, 1.0 - least)


def _select_bracket(first, one: RootBracket, other: RootBracket) -> RootBracket:
    return RootBracket(*(jnp.where(first, u, v) for u, v in zip(one, other, strict=True)))
