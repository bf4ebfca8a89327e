"""Bases of classical algebras as tables: each entry of a matrix is one component times a number, off the diagonal.

So components become a matrix, and a matrix components, by reading: O(N^2) operations, without a list of matrices.
On the diagonal, where su(N) has all components in every entry, the table is an N by r matrix.
"""

from __future__ import annotations

import math
from functools import cached_property
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

REAL, IMAGINARY = 0, 1


class EntryTable(NamedTuple):
    """Where components stand off the diagonal, or one to an entry: arrays of one length.

    Attributes
    ----------
    component, part, row, column : array of int
        The part is REAL or IMAGINARY.
    value : array of float
    """

    component: np.ndarray
    part: np.ndarray
    row: np.ndarray
    column: np.ndarray
    value: np.ndarray

    @classmethod
    def concatenate(cls, *parts: tuple) -> EntryTable:
        """From tuples of arrays that are broadcast against each other."""
        rows = [[a.ravel() for a in np.broadcast_arrays(*part)] for part in parts]
        component, part, row, column, value = (np.concatenate(column) for column in zip(*rows, strict=True))
        return cls(component, part, row, column, value.astype(np.float64))


class DiagonalEntries(NamedTuple):
    """Components that are spread over the diagonal: ``diag = table @ x[components]``, in one part of the matrix."""

    components: np.ndarray
    part: int
    coefficients: np.ndarray


class MatrixBasis:
    """A basis of N by N matrices, and the maps between components and matrices, given by their parts.

    A matrix is a tuple of real arrays, shape (..., N, N): the real part and, of complex ones, the imaginary part.
    Orthogonality is that of ``<X, Y> = Re tr(X^H Y)``; elements off the diagonal are orthogonal to all others.

    Parameters
    ----------
    size : int
        N.
    entries : Entries
        Each entry of the matrix at most once.
    diagonal : Diagonal, optional

    Attributes
    ----------
    entry_components, values : array, shape (parts, N * N)
        The component that stands in each entry of a matrix, ``dim`` where none does, and the number that it has there.
    """

    def __init__(self, size: int, entries: EntryTable, diagonal: DiagonalEntries | None = None):
        self.size, self.diagonal = size, diagonal
        self.dim = len(np.unique(entries.component)) + (0 if diagonal is None else len(diagonal.components))
        used = [entries.part] if diagonal is None else [entries.part, np.array([diagonal.part])]
        self.parts = 2 if np.concatenate(used).any() else 1
        place = entries.row * size + entries.column
        self.entry_components = np.full(
            (self.parts, size * size), self.dim, dtype=np.int32
        )  # dim: a component that is zero
        self.values = np.zeros((self.parts, size * size))
        self.entry_components[entries.part, place], self.values[entries.part, place] = entries.component, entries.value
        order = np.argsort(entries.component, kind="stable")
        component, place = entries.component[order], (entries.part * size * size + place)[order]
        rank = np.arange(len(order)) - np.searchsorted(component, component)
        self._component_entries = np.zeros((int(rank.max()) + 1 if len(rank) else 1, self.dim), dtype=np.int32)
        self._weights = np.zeros(self._component_entries.shape)
        self._component_entries[rank, component], self._weights[rank, component] = place, entries.value[order]

    def matrix(self, x) -> tuple[jax.Array, ...]:
        """``sum_a x_a e_a`` by its parts, for x of shape (..., dim)."""
        padded = jnp.concatenate([x, jnp.zeros((*x.shape[:-1], 1))], axis=-1)
        parts = []
        for part in range(self.parts):
            found = padded[..., self.entry_components[part]] * self.values[part]
            found = found.reshape(*x.shape[:-1], self.size, self.size)
            if self.diagonal is not None and self.diagonal.part == part:
                diagonal = x[..., self.diagonal.components] @ self.diagonal.coefficients.T
                found = found + diagonal[..., None] * np.eye(self.size)
            parts.append(found)
        return tuple(parts)

    def inner_products(self, parts: tuple[jax.Array, ...]) -> jax.Array:
        """``<A, e_a>`` for each a, shape (..., dim), of a matrix by its parts: the transpose of :meth:`matrix`."""
        flat = jnp.concatenate([part.reshape(*part.shape[:-2], -1) for part in parts], axis=-1)
        terms = [
            flat[..., places] * weights for places, weights in zip(self._component_entries, self._weights, strict=True)
        ]
        found = sum(terms[1:], terms[0])
        if self.diagonal is not None:
            diagonal = jnp.diagonal(parts[self.diagonal.part], axis1=-2, axis2=-1) @ self.diagonal.coefficients
            found = found.at[..., self.diagonal.components].set(diagonal)
        return found

    def raise_index(self, mu) -> jax.Array:
        """The components of the matrix M of the span with ``<M, e_a> = mu_a`` for each a, shape (..., dim)."""
        found = jnp.asarray(mu) / self.squared_norms
        if self.diagonal is None or self.is_orthogonal:
            return found
        own = jnp.asarray(mu)[..., self.diagonal.components] @ self._inverse_gram
        return found.at[..., self.diagonal.components].set(own)

    def lower_index(self, x) -> jax.Array:
        """``<M, e_a>`` for each a, of the matrix M with the components x: the inverse of :meth:`raised`."""
        return jnp.asarray(x) * self.squared_norms if self.is_orthogonal else self.inner_products(self.matrix(x))

    @cached_property
    def squared_norms(self) -> np.ndarray:
        """``<e_a, e_a>``, shape (dim,)."""
        found = (self._weights**2).sum(axis=0)
        if self.diagonal is not None:
            found[self.diagonal.components] = (self.diagonal.coefficients**2).sum(axis=0)
        return found

    @cached_property
    def is_orthogonal(self) -> bool:
        """Whether ``<e_a, e_b> = 0`` for all a != b."""
        if self.diagonal is None:
            return True
        gram = self.diagonal.coefficients.T @ self.diagonal.coefficients
        return bool(np.abs(gram - np.diag(np.diag(gram))).max() < 1e-12 * np.abs(gram).max())

    @cached_property
    def _inverse_gram(self) -> np.ndarray:
        assert self.diagonal is not None
        gram = self.diagonal.coefficients.T @ self.diagonal.coefficients
        return np.linalg.inv(gram)

    def basis_matrices(self) -> np.ndarray:
        """The e_a, shape (dim, N, N)."""
        flat = np.zeros((self.parts, self.dim + 1, self.size * self.size))
        for part in range(self.parts):
            flat[part, self.entry_components[part], np.arange(self.size * self.size)] = self.values[part]
        found = flat[:, :-1].reshape(self.parts, self.dim, self.size, self.size)
        if self.diagonal is not None:
            on = np.arange(self.size)
            found[self.diagonal.part, self.diagonal.components[:, None], on, on] = self.diagonal.coefficients.T
        return found[0] if self.parts == 1 else found[0] + 1j * found[1]


# -- the classical ones -----------------------------------------------------------------------------------------------


def unitary_basis(n: int, centre: bool) -> MatrixBasis:
    """``-i lambda_a / 2``, lambda the (generalised) Gell-Mann matrices; with the centre ``-i/2 sqrt(2/n) 1`` last."""
    k, j = np.tril_indices(n, -1)
    symmetric, k0 = k * k - 1 + 2 * j, np.arange(1, n)
    table = np.zeros((n, n - 1))
    for m in k0:
        table[:m, m - 1], table[m, m - 1] = 1.0, -float(m)
        table[:, m - 1] *= -0.5 * math.sqrt(2.0 / (m * (m + 1)))
    components = k0 * k0 - 1 + 2 * k0
    if centre:
        components = np.append(components, n * n - 1)
        table = np.column_stack([table, np.full(n, -0.5 * math.sqrt(2.0 / n))])
    entries = EntryTable.concatenate(
        (symmetric, IMAGINARY, j, k, -0.5),
        (symmetric, IMAGINARY, k, j, -0.5),
        (symmetric + 1, REAL, j, k, -0.5),
        (symmetric + 1, REAL, k, j, 0.5),
    )
    return MatrixBasis(n, entries, DiagonalEntries(components, IMAGINARY, table))


def orthogonal_basis(p: int, q: int) -> MatrixBasis:
    """``(E_ij - E_ji) g`` for i < j in lexicographic order, g = diag(1, …, 1, -1, …, -1)."""
    n = p + q
    form = np.where(np.arange(n) < p, 1.0, -1.0)
    i, j = np.triu_indices(n, 1)
    a = np.arange(len(i))
    return MatrixBasis(n, EntryTable.concatenate((a, REAL, i, j, form[j]), (a, REAL, j, i, -form[i])))


def general_linear_basis(n: int) -> MatrixBasis:
    """E_ij row by row."""
    i, j = (index.ravel() for index in np.indices((n, n)))
    return MatrixBasis(n, EntryTable.concatenate((np.arange(n * n), REAL, i, j, 1.0)))


def special_linear_basis(n: int) -> MatrixBasis:
    """``E_ii - E_(i+1)(i+1)`` first, then the E_ij of the upper and, transposed, of the lower triangle."""
    i, j = np.triu_indices(n, 1)
    a = n - 1 + np.arange(len(i))
    table = (np.eye(n) - np.eye(n, k=-1))[:, : n - 1]
    entries = EntryTable.concatenate((a, REAL, i, j, 1.0), (a + len(i), REAL, j, i, 1.0))
    return MatrixBasis(n, entries, DiagonalEntries(np.arange(n - 1), REAL, table))


def symplectic_basis(n: int) -> MatrixBasis:
    """``[[A, B], [C, -A^T]]`` with B and C symmetric: A row by row, then B, then C."""
    i, j = (index.ravel() for index in np.indices((n, n)))
    a = np.arange(n * n)
    s, t = np.triu_indices(n)
    b, off = n * n + np.arange(len(s)), s != t
    c = b + len(s)
    entries = EntryTable.concatenate(
        (a, REAL, i, j, 1.0),
        (a, REAL, n + j, n + i, -1.0),
        (b, REAL, s, n + t, 1.0),
        (b[off], REAL, t[off], n + s[off], 1.0),
        (c, REAL, n + s, t, 1.0),
        (c[off], REAL, n + t[off], s[off], 1.0),
    )
    return MatrixBasis(2 * n, entries)
