"""Validation of the parameters of models."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from ..errors import InputError
from ..functions.conditions import checked_numbers, positive_condition, require_condition


def checked_positive(value, name: str, count: int | None = None) -> jax.Array:
    """Return a positive number, or ``count`` positive numbers, as an array; traced values are returned unchanged."""
    array = checked_numbers(value, name, () if count is None else (count,))
    positive_condition(name).require(array)
    return array


def checked_finite(value, name: str, count: int | None = None) -> jax.Array:
    """Return finite numbers as an array, of shape (count,) if a count is given."""
    array = checked_numbers(value, name, *(() if count is None else ((count,),)))
    require_condition(array, lambda a: abs(a) < jnp.inf, name + " must be finite, got {value}")
    return array


def checked_positive_vector(value, name: str) -> jax.Array:
    """Return at least one positive number as an array of shape (m,)."""
    count = checked_numbers(value, name).size
    return checked_positive(value, name, max(count, 1))


def checked_integer(value, name: str, minimum: int = 1) -> int:
    """Return a value after checking that it is an integer >= ``minimum``."""
    if isinstance(value, bool) or not isinstance(value, int) or value < minimum:
        raise InputError(f"{name} must be an integer >= {minimum}, got {value!r}")
    return value
