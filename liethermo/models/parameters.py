"""Checks on the parameters of models."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from ..errors import InputError
from ..functions.conditions import check_numbers, require_condition


def checked_positive(value, name: str, count: int | None = None) -> jax.Array:
    """A positive number as an array, or ``count`` of them; traced ones as they are."""
    array = check_numbers(value, name, () if count is None else (count,))
    require_condition(array, lambda a: (a > 0.0) & (a < jnp.inf), name + " must be positive and finite, not {value}")
    return array


def checked_finite(value, name: str, count: int | None = None) -> jax.Array:
    """Finite numbers as an array, ``count`` of them in a row if that is said; traced ones as they are."""
    array = check_numbers(value, name, *(() if count is None else ((count,),)))
    require_condition(array, lambda a: abs(a) < jnp.inf, name + " must be finite, not {value}")
    return array


def checked_positive_vector(value, name: str) -> jax.Array:
    """Positive numbers in a row, at least one."""
    count = check_numbers(value, name).size
    return checked_positive(value, name, max(count, 1))


def checked_integer(value, name: str, least: int = 1) -> int:
    """An integer from ``least`` up."""
    if isinstance(value, bool) or not isinstance(value, int) or value < least:
        raise InputError(f"{name} must be an integer >= {least}, not {value!r}")
    return value
