"""Functions of a state and a time: their arguments, the time span of a run, and times within it at which they jump."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from manifolds._arrays import is_traced
from manifolds._pytree_module import Module

from ..errors import InputError

BREAK_RTOL = 8.0 * float(np.finfo(np.float64).eps)
"""Largest rounding of the times of a run, relative to the largest: a step starts at a break if it starts so near."""


class TimeSpan(Module):
    """The start and end time of a run, infinite until a run sets them: see :func:`set_time_span`.

    The sum of the steps of a run may exceed the end of the span by a rounding: 0.1 + 0.1 + 0.1 > 0.3. A table or a root
    that ends with the span is not defined there.

    Attributes
    ----------
    start, end : array, shape ()
    breaks : array, shape (m,)
        Times in the span at which functions of time jump; steps end there. It has shape (0,) if there are none.
    """

    start: jax.Array
    end: jax.Array
    breaks: jax.Array

    def __init__(self, start=-np.inf, end=np.inf, breaks=()):
        self.start, self.end, self.breaks = (_time_array(t) for t in (start, end, breaks))

    def interval_at(self, t) -> TimeSpan:
        """Return the interval between two breaks in which a step lies that starts at time t, shape ().

        The interval ends a rounding before a break, and starts a rounding after one. So a function that jumps at the
        break has one of its two limits there, whether it is defined with ``t >= time`` or with ``t > time``.
        """
        tolerance = self._break_tolerance
        is_past = self.breaks <= t + tolerance
        start = jnp.max(jnp.where(is_past, self.breaks + tolerance, self.start))
        end = jnp.min(jnp.where(is_past, self.end, self.breaks - tolerance))
        return TimeSpan(start, end)

    def starts_at_break(self, t) -> jax.Array:
        """Return whether a step that starts at time t, shape (), starts at a break."""
        return jnp.any(jnp.abs(self.breaks - t) <= self._break_tolerance)

    @property
    def _break_tolerance(self) -> jax.Array:
        largest_time = jnp.maximum(jnp.abs(self.start), jnp.max(jnp.abs(self.breaks)))
        return BREAK_RTOL * largest_time

    def clip(self, t) -> jax.Array:
        """Return the times t, shape (...), clipped to the span."""
        return _clip(t, self.start, self.end)


def _time_array(t) -> jax.Array:
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


def set_time_span(tree, start: float, end: float, *breaks: float):
    """Return a pytree, such as a system, whose functions of time are evaluated within a span only.

    Parameters
    ----------
    tree : pytree
    start, end : float
    *breaks : float
        Times within the span at which functions of time jump.
    """
    times = jnp.stack([_time_array(t) for t in breaks]) if breaks else ()
    return replace_time_span(tree, TimeSpan(start, end, times))


def replace_time_span(tree, span: TimeSpan):
    """Return a pytree with another span in every place."""

    def replace_span(node):
        return span if isinstance(node, TimeSpan) else node

    return jax.tree_util.tree_map(replace_span, tree, is_leaf=lambda node: isinstance(node, TimeSpan))


class FunctionWithBreaks(Module):
    """Base class of functions of time that are not smooth at known times, where the steps of a run end."""

    @property
    def break_times(self) -> tuple[float, ...]:
        """Times at which the function jumps."""
        return ()

    @property
    def kink_times(self) -> tuple[float, ...]:
        """Times at which a derivative of the function jumps, as far as they depend on no parameter."""
        return ()


class DeclaredTimes(NamedTuple):
    """Times at which functions of time in a pytree, such as a system, say that they are not smooth.

    Attributes
    ----------
    jumps, kinks : tuple of float
        Times at which a function, or one of its derivatives, jumps; in increasing order.
    """

    jumps: tuple[float, ...]
    kinks: tuple[float, ...]

    @classmethod
    def from_tree(cls, tree: Any) -> DeclaredTimes:
        """Return the times that the functions of time in a pytree declare."""
        leaves = jax.tree_util.tree_leaves(tree, is_leaf=lambda node: isinstance(node, FunctionWithBreaks))
        functions = [leaf for leaf in leaves if isinstance(leaf, FunctionWithBreaks)]
        jumps, kinks = {t for f in functions for t in f.break_times}, {t for f in functions for t in f.kink_times}
        return cls(tuple(sorted(jumps)), tuple(sorted(kinks)))


TIMES_OF_SMOOTH_FUNCTIONS = DeclaredTimes((), ())
"""The declared times of functions that are smooth."""


def checked_breaks(breaks) -> tuple[float, ...]:
    """Return the increasing times at which functions of time jump.

    Raises
    ------
    InputError
        Unless they are finite times that depend on no parameter.
    """
    try:
        times = np.asarray(breaks, dtype=np.float64)
    except jax.errors.TracerArrayConversionError as error:
        raise InputError(
            "the times at which a function jumps must be the same for all trajectories of an ensemble, because their "
            "steps end there; got times that depend on the parameters. Run each trajectory with lt.integrate"
        ) from error
    except (TypeError, ValueError):
        times = np.array(np.nan)
    if times.ndim != 1 or not np.isfinite(times).all():
        raise InputError(f"breaks must be a list of finite times, got {breaks!r:.60}")
    return tuple(np.unique(times).tolist())


def required_argument_count(function: Callable) -> int | None:
    """Return the number of positional arguments without a default; None if a function has no signature."""
    try:
        parameters = inspect.signature(function).parameters.values()
    except (TypeError, ValueError):
        return None
    return sum(p.kind in (p.POSITIONAL_ONLY, p.POSITIONAL_OR_KEYWORD) and p.default is p.empty for p in parameters)


class FixedTimeFunction(Module):
    """A function of the state and the time, at a fixed time."""

    function: Callable
    time: jax.Array

    def __call__(self, x):
        return self.function(x, self.time)


class StateTimeFunction(Module):
    """A function of the state and the time, as a function of the state with the time appended."""

    function: Callable

    def __call__(self, z):
        return self.function(z[:-1], z[-1])


class LastArgumentIgnored(Module):
    """A function that accepts one more argument, the last, and ignores it."""

    function: Callable

    def __call__(self, *arguments):
        return self.function(*arguments[:-1])


class ConstantFunction(Module):
    """A function that returns a constant for any arguments."""

    value: jax.Array

    def __call__(self, *arguments):
        return self.value


class NegatedFunction(Module):
    """The negative of a function of the state and the time."""

    function: Callable

    def __call__(self, x, t):
        return -jnp.asarray(self.function(x, t))


class MultipleFunction(Module):
    """A function of the state and the time, times a number."""

    function: Callable
    factor: jax.Array

    def __call__(self, x, t):
        return self.factor * jnp.asarray(self.function(x, t))


class CoordinatesWithTime(Module):
    """Coordinates of a state, with the time appended to the state and to the coordinates."""

    coordinates: Callable

    def __call__(self, z):
        return jnp.append(self.coordinates(z[:-1]), z[-1])
