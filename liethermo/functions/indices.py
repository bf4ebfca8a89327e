"""Where things are in a large state: arrays of integers that are fixed, and patterns of what depends on what."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
import scipy


class StaticArray:
    """An array that cannot change and is compared by value, to be a static field of a module.

    A tuple of 1e5 numbers would be hashed anew at every call of a compiled function; this is hashed once.
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
        same = type(self) is type(other) and self._hash == other._hash
        return same and np.array_equal(self._array, np.asarray(other))

    def __repr__(self) -> str:
        return f"{type(self).__name__}{self.shape}"


class Indices(StaticArray):
    """Integers: places."""

    dtype = np.int64

    @property
    def contiguous_slice(self) -> slice | None:
        """The slice that the numbers are, in order, or None: a slice is read faster than it is gathered."""
        flat = self._array.ravel()
        if flat.size == 0 or not np.array_equal(flat, np.arange(flat[0], flat[0] + flat.size)):
            return None
        return slice(int(flat[0]), int(flat[0]) + flat.size)


def sparsity_pattern(rows, columns, dim: int) -> scipy.sparse.csr_array:
    """The pattern of a square matrix with entries in these places; its data are ones."""
    rows, columns = np.asarray(rows).ravel(), np.asarray(columns).ravel()
    return pattern_of_matrix(scipy.sparse.coo_array((np.ones(len(rows), dtype=bool), (rows, columns)), (dim, dim)))


def clique_pattern(members, dim: int) -> scipy.sparse.csr_array:
    """The pattern in which all components of each row of ``members``, shape (m, r), depend on each other."""
    members = np.asarray(members)
    full = (*members.shape, members.shape[1])
    return sparsity_pattern(np.broadcast_to(members[:, :, None], full), np.broadcast_to(members[:, None, :], full), dim)


def pattern_of_matrix(matrix) -> scipy.sparse.csr_array:
    """A sparse matrix with every entry that is stored set to one."""
    found = scipy.sparse.csr_array(matrix)
    found.sum_duplicates()
    found.data = np.ones(found.nnz, dtype=bool)
    return found


def union_pattern(patterns) -> scipy.sparse.csr_array | None:
    """All entries of some patterns; None, for unknown, where one of them is."""
    found = list(patterns)
    if any(one is None for one in found):
        return None
    return pattern_of_matrix(sum(found[1:], found[0]))
