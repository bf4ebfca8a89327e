"""Conditions on parameters: refused where their values are known, noted for later where they are being traced."""

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
    """What has to hold of a value that is being traced.

    Attributes
    ----------
    holds : traced truth value
    value : traced array
    message : str
        Why a value is refused, with a place for it: ``"a rate must be >= 0, not {value}"``.
    """

    holds: Any
    value: Any
    message: str


_collected_conditions: contextvars.ContextVar[list[TracedCondition] | None] = contextvars.ContextVar(
    "noted", default=None
)


@contextlib.contextmanager
def collect_conditions() -> Iterator[list[TracedCondition]]:
    """Note the conditions on traced values meanwhile: those who sweep parameters evaluate them at every point."""
    found: list[TracedCondition] = []
    token = _collected_conditions.set(found)
    try:
        yield found
    finally:
        _collected_conditions.reset(token)


def require_condition(value, test: Callable, message: str) -> None:
    """Refuse a value of which the test is not true everywhere; note the test where the value is traced.

    Parameters
    ----------
    value : array
    test : function from an array to an array of truth values
    message : str
        With a place for the value, or for its numbers as a list.

    Raises
    ------
    InputError
    """
    if is_traced(value):
        if (noted := _collected_conditions.get()) is not None:
            noted.append(TracedCondition(jnp.all(test(value)), value, message))
    elif not bool(np.all(test(np.asarray(value)))):
        raise InputError(refusal_message(message, value))


def check_numbers(value, what: str, *shapes: tuple[int, ...]) -> jax.Array:
    """What a user gives as numbers, as an array of doubles; of one of these shapes, where any are given.

    Raises
    ------
    InputError
        If it is none.
    """
    try:
        kind = "f" if is_traced(value) else (value if isinstance(value, jax.Array) else np.asarray(value)).dtype.kind
        if kind not in "biufO" or value is None:  # NumPy would make numbers of texts, and NaN of None
            raise TypeError(f"not {kind}")
        array = real_array(value)
    except (TypeError, ValueError) as error:
        shown = repr(value) if isinstance(value, str | complex | None) else type(value).__name__
        raise InputError(f"{what} is made of real numbers, not {shown}") from error
    if shapes == ((),) and array.shape:
        raise InputError(f"{what} is one number, not an array of shape {array.shape}")
    if shapes and array.shape not in shapes:
        raise InputError(f"{what} has shape {' or '.join(map(str, shapes))}, not {array.shape}")
    return array


def refusal_message(message: str, value) -> str:
    """The message of a condition with the value in its place."""
    return message.format(value=np.asarray(value).tolist())
