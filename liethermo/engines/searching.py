"""Where in a step a function changes its sign, looked for one attempt after another [Chandrupatla 1997]."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from .rules import EPS


class Search(NamedTuple):
    """What is known of the root: it is between a and b, shares of a step, at which the function has other signs.

    Attributes
    ----------
    whole : array, shape ()
        Size of the step; 0 where nothing is looked for.
    share : array, shape ()
        The one to look at next.
    a, fa, b, fb, c, fc : array, shape ()
        Shares and the values there, that at ``a`` the last one; ``c`` was given up for it.
    """

    whole: jax.Array
    share: jax.Array
    a: jax.Array
    fa: jax.Array
    b: jax.Array
    fb: jax.Array
    c: jax.Array
    fc: jax.Array


NONE = np.zeros(len(Search._fields))
"""No search, as an array."""

VALUE = Search._fields.index("fa")
"""The place of the last value in a search as an array."""


def begun(whole, before, after) -> Search:
    """The search in a step with these values at its ends."""
    zero, one = jnp.zeros(()), jnp.ones(())
    search = Search(zero + whole, 0.5 * one, zero, zero + before, one, zero + after, zero, zero + before)
    return _either(after == 0.0, _last(whole, one), search)


def narrowed(search: Search, value) -> tuple[Search, jax.Array]:
    """The search after the value at its share, and whether this is the root, to rounding: the next look may be last."""
    t = search.share
    same = jnp.sign(value) == jnp.sign(search.fa)
    c, fc = jnp.where(same, search.a, search.b), jnp.where(same, search.fa, search.fb)
    other, fo = jnp.where(same, search.b, search.a), jnp.where(same, search.fb, search.fa)
    best = jnp.where((jnp.abs(value) < jnp.abs(fo)) | (value == 0.0), t, other)
    width, least = jnp.abs(other - t), 4.0 * EPS * jnp.abs(best) + 1e-300
    done = (width <= least) | (value == 0.0)
    share = t + _part(t, other, c, value, fo, fc, 0.5 * least / jnp.maximum(width, least)) * (other - t)
    narrower = Search(search.whole, share, t, value, other, fo, c, fc)
    return _either(done, _last(search.whole, best), narrower), done & (best == t)


def located(value) -> Search:
    """No search any more, but what the function is where one has ended."""
    return Search(*jnp.asarray(NONE))._replace(fa=jnp.zeros(()) + value)


def _last(whole, share) -> Search:
    """One look at a share, whatever is found."""
    infinite, share = jnp.full((), jnp.inf), jnp.zeros(()) + share
    return Search(jnp.zeros(()) + whole, share, share, infinite, share, infinite, share, infinite)


def _part(a, b, c, fa, fb, fc, least) -> jax.Array:
    """Where between a and b to look next: by inverse quadratic interpolation where that is safe, or halfway."""
    xi, phi = (a - b) / (c - b), (fa - fb) / (fc - fb)
    safe = (phi**2 < xi) & ((1.0 - phi) ** 2 < 1.0 - xi)
    t = fa / (fb - fa) * fc / (fb - fc) + (c - a) / (b - a) * fa / (fc - fa) * fb / (fc - fb)
    return jnp.clip(jnp.where(safe & jnp.isfinite(t), t, 0.5), least, 1.0 - least)


def _either(first, one: Search, other: Search) -> Search:
    return Search(*(jnp.where(first, u, v) for u, v in zip(one, other, strict=True)))
