"""The time span of a run: functions of time are evaluated only at times within it."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from manifolds._arrays import is_traced
from manifolds._pytree_module import Module


class TimeSpan(Module):
    """The start and end time of a run, infinite until a run sets them: see :func:`set_time_span`.

    The sum of the steps of a run may exceed the end of the span by a rounding: 0.1 + 0.1 + 0.1 > 0.3. A table or a root
    that ends with the span is not defined there.

    Attributes
    ----------
    start, end : array, shape ()
    """

    start: jax.Array
    end: jax.Array

    def __init__(self, start: float = -np.inf, end: float = np.inf):
        self.start, self.end = _time_scalar(start), _time_scalar(end)

    def clip(self, t) -> jax.Array:
        """Return the times t, shape (...), clipped to the span."""
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
def _clip_jvp(primals, tangents):
    """Return the clipped time and its tangent: the derivative by t is 1 outside too, where t lies by rounding."""
    return _clip(*primals), tangents[0]


def set_time_span(tree, start: float, end: float):
    """Return a pytree, such as a system, whose functions of time are evaluated within a span only."""
    span = TimeSpan(start, end)

    def limit(node):
        return span if isinstance(node, TimeSpan) else node

    return jax.tree_util.tree_map(limit, tree, is_leaf=lambda node: isinstance(node, TimeSpan))
