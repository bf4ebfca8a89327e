"""Bases of classical algebras as tables: each entry of a matrix off the diagonal is one component times a number.

Components are therefore gathered into a matrix, and matrices into components, in O(N^2) operations, without a list of
basis matrices. On the diagonal, where su(N) has all components in every entry, the table is an N by r matrix.
"""

from __future__ import annotations

import math
from functools import cached_property
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

REAL = 0
"""Index of the real part of a matrix."""

IMAGINARY = 1
"""Index of the imaginary part of a matrix."""


class EntryTable(NamedTuple):
    """Sparse table of the matrix entries that are a component times a number, as arrays of equal length.

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
    def concatenate(cls, *entry_groups: tuple) -> EntryTable:
        """Build a table from tuples (component, part, row, column, value), each broadcast to one length."""
        rows = [[a.ravel() for a in np.broadcast_arrays(*part)] for part in entry_groups]
        component, group, row, column, value = (np.concatenate(column) for column in zip(*rows, strict=True))
        return cls(component, group, row, column, value.astype(np.float64))


class DiagonalEntries(NamedTuple):
    """Components that contribute to all diagonal entries of one part: ``diag = coefficients @ x[components]``."""

    components: np.ndarray
    part: int
    coefficients: np.ndarray


class MatrixBasis:
    """Basis of N by N matrices, with the maps between components and matrices.

    A matrix is a tuple of real arrays, shape (..., N, N): the real part and, if complex, the imaginary part.
    Orthogonality refers to ``<X, Y> = Re tr(X^H Y)``; elements off the diagonal are orthogonal to all others.

    Parameters
    ----------
    size : int
        The size N.
    entries : EntryTable
        Each entry of the matrix at most once.
    diagonal : DiagonalEntries, optional

    Attributes
    ----------
    entry_components, values : array, shape (parts, N * N)
        The component in each entry of a matrix, ``dim`` for none, and its factor there.
    """

    def __init__(self, size: int, entries: EntryTable, diagonal: DiagonalEntries | None = None):
        self.size, self.diagonal = size, diagonal
        self.dim = len(np.unique(entries.component)) + (0 if diagonal is None else len(diagonal.components))
        matrix_parts = [entries.part] if diagonal is None else [entries.part, np.array([diagonal.part])]
        self.parts = 2 if np.concatenate(matrix_parts).any() else 1
        position = entries.row * size + entries.column
        self.entry_components = np.full(
            (self.parts, size * size), self.dim, dtype=np.int32
        )  # dim: a component that is zero
        self.values = np.zeros((self.parts, size * size))
        self.entry_components[entries.part, position], self.values[entries.part, position] = (
            entries.component,
            entries.value,
        )
        order = np.argsort(entries.component, kind="stable")
        component, position = entries.component[order], (entries.part * size * size + position)[order]
        occurrence = np.arange(len(order)) - np.searchsorted(component, component)
        self._component_entries = np.zeros(
            (int(occurrence.max()) + 1 if len(occurrence) else 1, self.dim), dtype=np.int32
        )
        self._weights = np.zeros(self._component_entries.shape)
        self._component_entries[occurrence, component], self._weights[occurrence, component] = (
            position,
            entries.value[order],
        )

    def matrix(self, x) -> tuple[jax.Array, ...]:
        """Return the real and, if complex, imaginary part of ``sum_a x_a e_a``; x has shape (..., dim)."""
        components_and_zero = jnp.concatenate([x, jnp.zeros((*x.shape[:-1], 1))], axis=-1)
        parts = []
        for part in range(self.parts):
            entries = components_and_zero[..., self.entry_components[part]] * self.values[part]
            entries = entries.reshape(*x.shape[:-1], self.size, self.size)
            if self.diagonal is not None and self.diagonal.part == part:
                diagonal = x[..., self.diagonal.components] @ self.diagonal.coefficients.T
                entries = entries + diagonal[..., None] * np.eye(self.size)
            parts.append(entries)
        return tuple(parts)

    def inner_products(self, parts: tuple[jax.Array, ...]) -> jax.Array:
        """Return ``<A, e_a>`` for each a, shape (..., dim); A is given by its real and, if complex, imaginary part.

        This is the transpose of :meth:`matrix`.
        """
        entries = jnp.concatenate([part.reshape(*part.shape[:-2], -1) for part in parts], axis=-1)
        terms = [
            entries[..., indices] * weights
            for indices, weights in zip(self._component_entries, self._weights, strict=True)
        ]
        products = sum(terms[1:], terms[0])
        if self.diagonal is not None:
            diagonal = jnp.diagonal(parts[self.diagonal.part], axis1=-2, axis2=-1) @ self.diagonal.coefficients
            products = products.at[..., self.diagonal.components].set(diagonal)
        return products

    def raise_index(self, mu) -> jax.Array:
        """Return the components of the matrix M in the span with ``<M, e_a> = mu_a`` for each a, shape (..., dim)."""
        components = jnp.asarray(mu) / self.squared_norms
        if self.diagonal is None or self.is_orthogonal:
            return components
        diagonal_components = jnp.asarray(mu)[..., self.diagonal.components] @ self._inverse_gram
        return components.at[..., self.diagonal.components].set(diagonal_components)

    def lower_index(self, x) -> jax.Array:
        """Return ``<M, e_a>`` for each a, for the matrix M with components x: the inverse of :meth:`raise_index`."""
        return jnp.asarray(x) * self.squared_norms if self.is_orthogonal else self.inner_products(self.matrix(x))

    @cached_property
    def squared_norms(self) -> np.ndarray:
        """Squared norms ``<e_a, e_a>``, shape (dim,)."""
        norms_squared = (self._weights**2).sum(axis=0)
        if self.diagonal is not None:
            norms_squared[self.diagonal.components] = (self.diagonal.coefficients**2).sum(axis=0)
        return norms_squared

    @cached_property
    def is_orthogonal(self) -> bool:
        """True if ``<e_a, e_b> = 0`` for all a != b."""
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
        """Return the matrices e_a, shape (dim, N, N)."""
        entries = np.zeros((self.parts, self.dim + 1, self.size * self.size))
        for part in range(self.parts):
            entries[part, self.entry_components[part], np.arange(self.size * self.size)] = self.values[part]
        matrices = entries[:, :-1].reshape(self.parts, self.dim, self.size, self.size)
        if self.diagonal is not None:
            diagonal = np.arange(self.size)
            matrices[self.diagonal.part, self.diagonal.components[:, None], diagonal, diagonal] = (
                self.diagonal.coefficients.T
            )
        return matrices[0] if self.parts == 1 else matrices[0] + 1j * matrices[1]


# -- bases of the classical algebras ----------------------------------------------------------------------------------


def unitary_basis(n: int, has_centre: bool) -> MatrixBasis:
    """Return the basis ``-i lambda_a / 2`` of generalised Gell-Mann matrices; with the centre ``-i/2 sqrt(2/n) 1``
    last."""
    k, j = np.tril_indices(n, -1)
    symmetric, k0 = k * k - 1 + 2 * j, np.arange(1, n)
    table = np.zeros((n, n - 1))
    for m in k0:
        table[:m, m - 1], table[m, m - 1] = 1.0, -float(m)
        table[:, m - 1] *= -0.5 * math.sqrt(2.0 / (m * (m + 1)))
    components = k0 * k0 - 1 + 2 * k0
    if has_centre:
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
    """Return the basis ``(E_ij - E_ji) g`` for i < j in lexicographic order, g = diag(1, …, 1, -1, …, -1)."""
    n = p + q
    form = np.where(np.arange(n) < p, 1.0, -1.0)
    i, j = np.triu_indices(n, 1)
    a = np.arange(len(i))
    return MatrixBasis(n, EntryTable.concatenate((a, REAL, i, j, form[j]), (a, REAL, j, i, -form[i])))


def general_linear_basis(n: int) -> MatrixBasis:
    """Return the basis E_ij row by row."""
    i, j = (index.ravel() for index in np.indices((n, n)))
    return MatrixBasis(n, EntryTable.concatenate((np.arange(n * n), REAL, i, j, 1.0)))


def special_linear_basis(n: int) -> MatrixBasis:
    """Return the basis ``E_ii - E_(i+1)(i+1)``, then E_ij of the upper triangle, then E_ji of the lower triangle."""
    i, j = np.triu_indices(n, 1)
    a = n - 1 + np.arange(len(i))
    table = (np.eye(n) - np.eye(n, k=-1))[:, : n - 1]
    entries = EntryTable.concatenate((a, REAL, i, j, 1.0), (a + len(i), REAL, j, i, 1.0))
    return MatrixBasis(n, entries, DiagonalEntries(np.arange(n - 1), REAL, table))


def symplectic_basis(n: int) -> MatrixBasis:
    """Return the basis of ``[[A, B], [C, -A^T]]`` with B and C symmetric: A row by row, then B, then C."""
    i, j = (index.ravel() for index in np.indices((n, n)))
    a = np.arange(n * n)
    s, t = np.triu_indices(n)
    b, off_diagonal = n * n + np.arange(len(s)), s != t
    c = b + len(s)
    entries = EntryTable.concatenate(
        (a, REAL, i, j, 1.0),
        (a, REAL, n + j, n + i, -1.0),
        (b, REAL, s, n + t, 1.0),
        (b[off_diagonal], REAL, t[off_diagonal], n + s[off_diagonal], 1.0),
        (c, REAL, n + s, t, 1.0),
        (c[off_diagonal], REAL, n + t[off_diagonal], s[off_diagonal], 1.0),
    )
    return MatrixBasis(2 * n, entries)
