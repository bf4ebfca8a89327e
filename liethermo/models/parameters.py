"""Checks on the parameters of models."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from ..errors import InputError
from ..functions.conditions import require


def positive(value, name: str, count: int | None = None) -> jax.Array:
    """A positive number as an array, or ``count`` of them; traced ones as they are."""
    array = jnp.asarray(value, dtype=jnp.float64)
    if array.shape != (() if count is None else (count,)):
        wanted = "one number" if count is None else f"{count} numbers"
        raise InputError(f"{name} is {wanted}, not an array of shape {array.shape}")
    require(array, lambda a: (a > 0.0) & (a < jnp.inf), name + " must be positive and finite, not {value}")
    return array


def whole(value, name: str, least: int = 1) -> int:
    """An integer from ``least`` up."""
    if isinstance(value, bool) or not isinstance(value, int) or value < least:
        raise InputError(f"{name} must be an integer >= {least}, not {value!r}")
    return value
