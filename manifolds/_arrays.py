"""Checks on arrays at the public boundary."""

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from .errors import ComponentError, ShapeError


def is_traced(*values) -> bool:
    """Return True if any leaf is a JAX tracer, whose value is not available."""
    return any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree_util.tree_leaves(values))


def real_components(x, dim: int, label: str) -> jax.Array:
    """Return ``x`` as a real array of doubles, after checking that its last axis has length ``dim``."""
    array = jnp.asarray(numeric_array(x, label))
    if jnp.issubdtype(array.dtype, jnp.complexfloating):
        raise ComponentError(f"{label} must be real, got {array.dtype}. Take its real part if that is meant")
    if array.ndim == 0 or array.shape[-1] != dim:
        raise ShapeError(f"{label} must have last axis {dim}, but its shape is {array.shape}")
    return array.astype(jnp.float64)


def square_matrices(x, size: int, label: str) -> jax.Array:
    """Return ``x`` as an array of (complex) doubles, after checking that its last axes are ``(size, size)``."""
    array = jnp.asarray(numeric_array(x, label))
    if array.shape[-2:] != (size, size):
        raise ShapeError(f"{label} must have last axes ({size}, {size}), but its shape is {array.shape}")
    complex_input = jnp.issubdtype(array.dtype, jnp.complexfloating)
    return array.astype(jnp.complex128 if complex_input else jnp.float64)


def first_true_multi_index(mask: np.ndarray) -> tuple[int, ...] | None:
    """Return the index of the first true entry, or None."""
    return tuple(int(i) for i in np.argwhere(mask)[0]) if mask.any() else None


def format_index(index: tuple[int, ...]) -> str:
    """Return an index as text in brackets, such as ``[0, 2]``, for messages; the empty index gives an empty text."""
    return f"[{', '.join(map(str, index))}]" if index else ""


def numeric_array(x, label: str):
    """Return ``x`` as a NumPy or JAX array of numbers; raise ComponentError if it is none."""
    if isinstance(x, jax.Array):
        return x
    try:
        array = np.asarray(x)
        return array.astype(np.float64) if array.dtype == object else _require_numeric_dtype(array)
    except (TypeError, ValueError) as error:
        raise ComponentError(f"{label} is not a rectangular array of numbers: {error}") from None


def _require_numeric_dtype(array: np.ndarray) -> np.ndarray:
    if not np.issubdtype(array.dtype, np.number) and array.dtype != bool:
        raise TypeError(f"dtype {array.dtype}")
    return array


def real_array(value) -> jax.Array:
    """Return ``value`` as a JAX array of doubles.

    NumPy converts plain numbers, and the type is named, because XLA would compile a program for the conversion.
    """
    if isinstance(value, jax.Array):
        return value if value.dtype == jnp.float64 else value.astype(jnp.float64)
    if is_traced(value):  # a list with traced entries
        return jnp.asarray(value, dtype=jnp.float64)
    return jnp.asarray(np.asarray(value, dtype=np.float64), dtype=jnp.float64)


def host_array(value):
    """Return numbers as a NumPy array, with which NumPy computes; traced ones as they are, with which JAX computes.

    For an operation on a JAX array of numbers XLA would compile a program.
    """
    return value if is_traced(value) else np.asarray(value)


MAX_SELECT_COLUMNS = 4
"""Largest number of columns that :func:`stack_columns` combines by selection."""


def stack_columns(columns: Sequence[jax.Array]) -> jax.Array:
    """Stack arrays of equal shape along a new last axis, shape (..., n_columns).

    Up to MAX_SELECT_COLUMNS columns are combined by selection, since XLA's loop for a concatenation branches at every
    entry.
    """
    if len(columns) > MAX_SELECT_COLUMNS:
        return jnp.stack(columns, axis=-1)
    *leading_columns, stacked_columns = (column[..., None] for column in columns)
    for i, column in enumerate(leading_columns):
        stacked_columns = jnp.where(np.arange(len(columns)) == i, column, stacked_columns)
    return stacked_columns


def first_nonfinite_index(result, n_core_axes: int) -> tuple[int, ...] | None:
    """Return the batch index of the first result that is not finite, or None; None while tracing.

    The last ``n_core_axes`` axes of the result hold one element.
    """
    if is_traced(result):
        return None
    return first_true_multi_index(~np.isfinite(np.asarray(result)).all(axis=tuple(range(-n_core_axes, 0))))
