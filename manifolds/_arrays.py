"""Checks on arrays at the public boundary."""

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from .errors import ComponentError, ShapeError


def is_traced(*values) -> bool:
    """Whether any leaf is a JAX tracer, whose value cannot be looked at."""
    return any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree_util.tree_leaves(values))


def real_components(x, dim: int, what: str) -> jax.Array:
    """``x`` as a real array of doubles with last axis ``dim``."""
    array = jnp.asarray(numeric_array(x, what))
    if jnp.issubdtype(array.dtype, jnp.complexfloating):
        raise ComponentError(f"{what} must be real, not {array.dtype}: take its real part if that is meant")
    if array.ndim == 0 or array.shape[-1] != dim:
        raise ShapeError(f"{what} must have last axis {dim}, but its shape is {array.shape}")
    return array.astype(jnp.float64)


def square_matrices(x, size: int, what: str) -> jax.Array:
    """``x`` as an array of doubles (or complex doubles) with last axes ``(size, size)``."""
    array = jnp.asarray(numeric_array(x, what))
    if array.shape[-2:] != (size, size):
        raise ShapeError(f"{what} must have last axes ({size}, {size}), but its shape is {array.shape}")
    complex_input = jnp.issubdtype(array.dtype, jnp.complexfloating)
    return array.astype(jnp.complex128 if complex_input else jnp.float64)


def first_true_index(failed: np.ndarray) -> tuple[int, ...] | None:
    """Index of the first true entry, or None."""
    return tuple(int(i) for i in np.argwhere(failed)[0]) if failed.any() else None


def format_index(index: tuple[int, ...]) -> str:
    """An index as a message shows it after the name of an array: nothing where there is one entry alone."""
    return f"[{', '.join(map(str, index))}]" if index else ""


def numeric_array(x, what: str):
    """``x`` as an array of numbers, of NumPy or JAX."""
    if isinstance(x, jax.Array):
        return x
    try:
        array = np.asarray(x)
        return array.astype(np.float64) if array.dtype == object else _require_numeric_dtype(array)
    except (TypeError, ValueError) as error:
        raise ComponentError(f"{what} is not a rectangular array of numbers: {error}") from None


def _require_numeric_dtype(array: np.ndarray) -> np.ndarray:
    if not np.issubdtype(array.dtype, np.number) and array.dtype != bool:
        raise TypeError(f"dtype {array.dtype}")
    return array


def real_array(value) -> jax.Array:
    """``value`` as a JAX array of doubles, by NumPy where it is a plain number: XLA would compile a conversion."""
    if isinstance(value, jax.Array):
        return value if value.dtype == jnp.float64 else value.astype(jnp.float64)
    if is_traced(value):  # some of its entries
        return jnp.asarray(value, dtype=jnp.float64)
    return jnp.asarray(np.asarray(value, dtype=np.float64))


MAX_SELECT_COLUMNS = 4
"""Arrays up to which the entries of one are selected among them."""


def stack_columns(columns: Sequence[jax.Array]) -> jax.Array:
    """Arrays of one shape as the columns of one, shape (..., columns).

    A few by selection: the loop of a concatenation has a branch for every entry.
    """
    if len(columns) > MAX_SELECT_COLUMNS:
        return jnp.stack(columns, axis=-1)
    *others, found = (column[..., None] for column in columns)
    for i, column in enumerate(others):
        found = jnp.where(np.arange(len(columns)) == i, column, found)
    return found
