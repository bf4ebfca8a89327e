"""Functions of a state and a time: how many arguments they need, and as functions of fewer."""

from __future__ import annotations

import inspect
from collections.abc import Callable

import jax
import jax.numpy as jnp

from manifolds._pytree_module import Module


def required_argument_count(function: Callable) -> int | None:
    """How many arguments a function needs by position; None where it does not tell."""
    try:
        parameters = inspect.signature(function).parameters.values()
    except (TypeError, ValueError):
        return None
    return sum(p.kind in (p.POSITIONAL_ONLY, p.POSITIONAL_OR_KEYWORD) and p.default is p.empty for p in parameters)


class FixedTimeFunction(Module):
    """A function of both, at a time."""

    function: Callable
    time: jax.Array

    def __call__(self, x):
        return self.function(x, self.time)


class StateTimeFunction(Module):
    """A function of both, of the state with the time behind it."""

    function: Callable

    def __call__(self, z):
        return self.function(z[:-1], z[-1])


class LastArgumentIgnored(Module):
    """A function as one of an argument more, the last, which it does not depend on."""

    function: Callable

    def __call__(self, *arguments):
        return self.function(*arguments[:-1])


class ConstantFunction(Module):
    """A value as a function of anything."""

    value: jax.Array

    def __call__(self, *arguments):
        return self.value


class NegatedFunction(Module):
    """Minus a function of both."""

    function: Callable

    def __call__(self, x, t):
        return -jnp.asarray(self.function(x, t))


class CoordinatesWithTime(Module):
    """Coordinates of a state, and the time behind it."""

    coordinates: Callable

    def __call__(self, z):
        return jnp.append(self.coordinates(z[:-1]), z[-1])
