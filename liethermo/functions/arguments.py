"""Functions of a state and a time: the number of their arguments, and wrappers with fewer or more arguments."""

from __future__ import annotations

import inspect
from collections.abc import Callable

import jax
import jax.numpy as jnp

from manifolds._pytree_module import Module


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
