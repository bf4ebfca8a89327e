"""The span of time of a run: functions of time are evaluated at times in it, and at no others."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from manifolds._arrays import is_traced
from manifolds._pytree_module import Module


class TimeSpan(Module):
    """From when to when a run lasts; without bounds until a run gives them: see :func:`limit_times`.

    A run adds up its steps, whose sum may end a rounding beyond the end of the span: 0.1 + 0.1 + 0.1 > 0.3. A table or
    a root that ends with the span is not defined there.

    Attributes
    ----------
    start, end : array, shape ()
    """

    start: jax.Array
    end: jax.Array

    def __init__(self, start: float = -np.inf, end: float = np.inf):
        self.start, self.end = _time_scalar(start), _time_scalar(end)

    def clip(self, t) -> jax.Array:
        """Return the times t, shape (...), those outside replaced by the nearest bound."""
        return _clip(t, self.start, self.end)


def _time_scalar(t) -> jax.Array:
    if is_traced(t):
        return t
    with jax.ensure_compile_time_eval():  # a number, even where something else is traced
        return jnp.asarray(t, dtype=jnp.float64)


@jax.custom_jvp
def _clip(t, start, end) -> jax.Array:
    return jnp.where(t > end, end, jnp.where(t < start, start, t))


@_clip.defjvp
def _derivative_of_clip(primals, tangents):
    """The derivative by t is 1 beyond the bounds too: what lies there is there by rounding."""
    return _clip(*primals), tangents[0]


def limit_times(tree, start: float, end: float):
    """Return a pytree, such as a system, whose functions of time are evaluated within a span only."""
    span = TimeSpan(start, end)

    def limit(part):
        return span if isinstance(part, TimeSpan) else part

    return jax.tree_util.tree_map(limit, tree, is_leaf=lambda part: isinstance(part, TimeSpan))
