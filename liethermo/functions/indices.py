"""Fixed arrays of integers, such as indices into a large state, and sparsity patterns."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
import scipy


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
    """Return the pattern of a square matrix with entries at these rows and columns; its data are ones."""
    rows, columns = np.asarray(rows).ravel(), np.asarray(columns).ravel()
    return pattern_of_matrix(scipy.sparse.coo_array((np.ones(len(rows), dtype=bool), (rows, columns)), (dim, dim)))


def clique_pattern(members, dim: int) -> scipy.sparse.csr_array:
    """Return the pattern in which all components of each row of ``members``, shape (m, r), depend on each other."""
    members = np.asarray(members)
    full = (*members.shape, members.shape[1])
    return sparsity_pattern(np.broadcast_to(members[:, :, None], full), np.broadcast_to(members[:, None, :], full), dim)


def pattern_of_matrix(matrix) -> scipy.sparse.csr_array:
    """Return a sparse matrix with every stored entry set to one."""
    pattern = scipy.sparse.csr_array(matrix)
    pattern.sum_duplicates()
    pattern.data = np.ones(pattern.nnz, dtype=bool)
    return pattern


def union_pattern(patterns) -> scipy.sparse.csr_array | None:
    """Return the union of some patterns; None, for unknown, if one of them is None."""
    known_patterns = list(patterns)
    if any(pattern is None for pattern in known_patterns):
        return None
    return pattern_of_matrix(sum(known_patterns[1:], known_patterns[0]))
