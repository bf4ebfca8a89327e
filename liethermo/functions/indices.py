"""Indices into a large state as fixed arrays, sparsity patterns, and coordinates of the terms of an energy."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Sequence
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy

from manifolds._arrays import is_traced
from manifolds._pytree_module import Module

from ..errors import FunctionError, InputError
from ..tracing.interpret import evaluate_at_points
from ..tracing.trace_errors import TRACE_ERRORS, trace_error_message


class StaticArray:
    """An array that cannot change and is compared by value, so that it can be a static field of a module.

    It is hashed once; a tuple of 1e5 numbers would be hashed at every call of a compiled function.
    """

    dtype: ClassVar[type]

    def __init__(self, numbers):
        self._array: np.ndarray = np.array(numbers, dtype=self.dtype)
        self._array.flags.writeable = False
        self._hash = hash((self._array.shape, self._array.tobytes()))

    @property
    def shape(self) -> tuple[int, ...]:
        return self._array.shape

    def __array__(self, dtype=None, copy=None) -> np.ndarray:
        return self._array if dtype is None else self._array.astype(dtype)

    def __len__(self) -> int:
        return len(self._array)

    def __hash__(self) -> int:
        return self._hash

    def __eq__(self, other) -> bool:
        if self is other:
            return True
        is_same_kind = type(self) is type(other) and self._hash == other._hash
        return is_same_kind and np.array_equal(self._array, np.asarray(other))

    def __repr__(self) -> str:
        return f"{type(self).__name__}{self.shape}"


class Indices(StaticArray):
    """An immutable array of integers that index a state."""

    dtype = np.int64

    @property
    def contiguous_slice(self) -> slice | None:
        """The slice that equals the indices in order, or None; a slice is read faster than it is gathered."""
        entries = self._array.ravel()
        if entries.size == 0 or not np.array_equal(entries, np.arange(entries[0], entries[0] + entries.size)):
            return None
        return slice(int(entries[0]), int(entries[0]) + entries.size)


def sparsity_pattern(rows, columns, dim: int) -> scipy.sparse.csr_array:
    """Return the sparsity pattern with entries at these rows and columns, as a (dim, dim) sparse matrix of ones."""
    rows, columns = np.asarray(rows).ravel(), np.asarray(columns).ravel()
    return pattern_of_matrix(scipy.sparse.coo_array((np.ones(len(rows), dtype=bool), (rows, columns)), (dim, dim)))


def clique_pattern(members, dim: int) -> scipy.sparse.csr_array:
    """Return the sparsity pattern in which all indices of a row of ``members``, shape (m, r), couple to each other."""
    members = np.asarray(members)
    full = (*members.shape, members.shape[1])
    return sparsity_pattern(np.broadcast_to(members[:, :, None], full), np.broadcast_to(members[:, None, :], full), dim)


def pattern_of_matrix(matrix) -> scipy.sparse.csr_array:
    """Return the sparsity pattern of a sparse matrix: a sparse matrix of ones at its stored entries."""
    pattern = scipy.sparse.csr_array(matrix)
    pattern.sum_duplicates()
    pattern.data = np.ones(pattern.nnz, dtype=bool)
    return pattern


def union_pattern(patterns) -> scipy.sparse.csr_array | None:
    """Return the union of sparsity patterns; None, for an unknown pattern, if one of them is None."""
    known_patterns = list(patterns)
    if any(pattern is None for pattern in known_patterns):
        return None
    return pattern_of_matrix(sum(known_patterns[1:], known_patterns[0]))


COORDINATE_TOLERANCE = 1e-10
"""Largest deviation of a map of coordinates from a quadratic one, relative to its values: a few roundings."""


class ComponentMap(Module):
    """A linear map from a state to some of its components, reordered or scaled by powers of two."""

    @abstractmethod
    def __call__(self, x) -> jax.Array: ...


class Components(ComponentMap):
    """Components of a state by their indices; a range is read as a slice."""

    indices: range | Indices = eqx.field(static=True)

    @classmethod
    def from_indices(cls, indices: Sequence[int] | np.ndarray) -> Components:
        """Return the components with these indices."""
        if isinstance(indices, range) and indices.step == 1 and indices.start >= 0:
            return cls(indices)
        return cls(Indices(np.asarray(indices, dtype=np.int64)))

    def __call__(self, x):
        indices = self.indices
        return x[indices.start : indices.stop] if isinstance(indices, range) else x[np.asarray(indices)]


def check_coordinates_are_quadratic(coordinates: Callable, dim: int, role: str) -> None:
    """Raise an error unless coordinates are components of the state or a map at most quadratic in the state."""
    if isinstance(coordinates, Components):
        invalid_indices = [i for i in np.asarray(coordinates.indices).tolist() if not -dim <= i < dim]
        if invalid_indices:  # JAX would read the last component instead
            raise InputError(f"{role} has a term on component {invalid_indices[0]}, but the state has {dim} components")
    if isinstance(coordinates, ComponentMap) or is_traced(coordinates):
        return
    try:
        start, end, step = evaluate_at_points(
            _coordinate_values_and_quadratic_increment,
            coordinates,
            np.random.default_rng(0).standard_normal((1, 2 * dim)),
        )
    except TRACE_ERRORS as error:
        raise FunctionError(
            trace_error_message(f"the coordinates of a term of {role} could not be evaluated", error)
        ) from error
    if start.ndim != 2:
        raise FunctionError(f"the coordinates of a term of {role} must be a vector, got shape {start.shape[1:]}")
    scale = max(1.0, float(np.abs(start).max() + np.abs(end).max()))
    defect = float(np.abs(end - start - step).max())
    if not defect <= COORDINATE_TOLERANCE * scale:
        raise InputError(
            f"the coordinates of a term of {role} must be a quadratic function of the state, but they miss "
            f"y' - y = Dpi(z)(x' - x) by {defect:.3g} (tolerance {COORDINATE_TOLERANCE * scale:.1g}), so the energy "
            "would not be exact. Use, for example, the square of a distance, and take its root inside the term"
        )


def _coordinate_values_and_quadratic_increment(coordinates: Callable, state_and_increment):
    """Return the coordinates of x and of x + d, and the increment between them that a quadratic map would have.

    The array ``state_and_increment`` is x followed by d.
    """
    x, d = jnp.split(state_and_increment, 2)
    return coordinates(x), coordinates(x + d), jax.jvp(coordinates, (x + 0.5 * d,), (d,))[1]
