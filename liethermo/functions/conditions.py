"""Conditions on parameters: checked at once for known values, recorded for a later check of traced values."""

from __future__ import annotations

import contextlib
import contextvars
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from manifolds._arrays import is_traced, real_array

from ..errors import InputError


class TracedCondition(NamedTuple):
    """A condition on a value that is being traced, recorded for a check with numbers.

    Attributes
    ----------
    holds : traced truth value
    value : traced array
    message : str
        The message of the error, with a placeholder: ``"a rate must be >= 0, got {value}"``.
    """

    holds: Any
    value: Any
    message: str


_collected_conditions: contextvars.ContextVar[list[TracedCondition] | None] = contextvars.ContextVar(
    "collected_conditions", default=None
)


@contextlib.contextmanager
def collect_conditions() -> Iterator[list[TracedCondition]]:
    """Collect the conditions on traced values inside a ``with`` block; a sweep evaluates them at every point."""
    conditions: list[TracedCondition] = []
    token = _collected_conditions.set(conditions)
    try:
        yield conditions
    finally:
        _collected_conditions.reset(token)


def require_condition(value, test: Callable, message_template: str) -> None:
    """Raise InputError unless a test is true for all entries of a value; record the test of a traced value.

    Parameters
    ----------
    value : array
    test : function from an array to an array of truth values
    message_template : str
        The message, with a placeholder ``{value}`` for the value as a list.

    Raises
    ------
    InputError
    """
    if is_traced(value):
        if (conditions := _collected_conditions.get()) is not None:
            conditions.append(TracedCondition(jnp.all(test(value)), value, message_template))
    elif not bool(np.all(test(np.asarray(value)))):
        raise InputError(condition_message(message_template, value))


def checked_numbers(value, quantity_name: str, *shapes: tuple[int, ...]) -> jax.Array:
    """Return a user's numbers as an array of float64; check its shape if shapes are given.

    Raises
    ------
    InputError
        If the value is not made of real numbers, or has another shape.
    """
    try:
        kind = "f" if is_traced(value) else (value if isinstance(value, jax.Array) else np.asarray(value)).dtype.kind
        if kind not in "biufO" or value is None:  # NumPy would convert strings to numbers, and None to NaN
            raise TypeError(f"not {kind}")
        array = real_array(value)
    except (TypeError, ValueError) as error:
        description = repr(value) if isinstance(value, str | complex | None) else type(value).__name__
        raise InputError(f"{quantity_name} must be made of real numbers, got {description}") from error
    if shapes == ((),) and array.shape:
        raise InputError(f"{quantity_name} must be one number, got an array of shape {array.shape}")
    if shapes and array.shape not in shapes:
        raise InputError(f"{quantity_name} must have shape {' or '.join(map(str, shapes))}, got {array.shape}")
    return array


def condition_message(message_template: str, value) -> str:
    """Return the error message of a condition, from its template with a placeholder for the value."""
    return message_template.format(value=np.asarray(value).tolist())
