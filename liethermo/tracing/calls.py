"""Linear algebra that is not unrolled: calls of LAPACK, and products of matrices as loops."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.linalg
from jax.extend.core import Primitive

from .builder import Block


@dataclass(frozen=True, eq=False)
class LapackCall(Block):
    """A block that calls a LAPACK function of matrices.

    Matrices are passed row by row; complex ones pass all real parts, then all imaginary parts.
    The results are NaN if an argument is not finite or the function does not converge.

    Attributes
    ----------
    name : str
        A key of :data:`LAPACK_FUNCTIONS`.
    sizes : tuple of int
        Sizes of the matrices and flags, as the entry of :data:`LAPACK_FUNCTIONS` expects them.
    is_complex : bool
    """

    name: str
    sizes: tuple[int, ...]
    is_complex: bool = False

    @property
    def result_kinds(self) -> tuple[str, ...]:  # type: ignore[override]
        return ("f",) * sum(self.real_entry_counts(self.result_specs))

    @property
    def argument_shapes(self) -> list[tuple[int, ...]]:
        """Shapes of the argument matrices."""
        return LAPACK_FUNCTIONS[self.name].argument_shapes(*self.sizes)

    @property
    def result_specs(self) -> list[tuple[tuple[int, ...], bool]]:
        """Return the shape of each result, and whether it is real even for complex arguments."""
        return LAPACK_FUNCTIONS[self.name].result_specs(*self.sizes)

    def real_entry_counts(self, result_specs) -> list[int]:
        """Return the number of real entries of each result; a complex entry counts twice."""
        return [math.prod(shape) * (2 if self.is_complex and not is_real else 1) for shape, is_real in result_specs]

    def __call__(self, *args) -> list:
        arrays = np.broadcast_arrays(*(np.asarray(a, dtype=np.float64) for a in args))
        batch_shape = arrays[0].shape
        rows = np.stack(arrays, axis=-1).reshape(-1, len(args))
        results = np.stack([self._evaluate_flat_arguments(row) for row in rows]).reshape(*batch_shape, -1)
        return [results[..., i][()] for i in range(results.shape[-1])]

    def _evaluate_flat_arguments(self, real_entries: np.ndarray) -> np.ndarray:
        """Evaluate the function for matrices that are passed as one flat array of real entries; return flat results."""
        if not np.isfinite(real_entries).all():
            return np.full(len(self.result_kinds), np.nan)
        matrices, start = [], 0
        for shape in self.argument_shapes:
            n_entries = math.prod(shape)
            matrix = real_entries[start : start + n_entries].reshape(shape)
            if self.is_complex:
                matrix = matrix + 1j * real_entries[start + n_entries : start + 2 * n_entries].reshape(shape)
            matrices.append(matrix)
            start += n_entries * (2 if self.is_complex else 1)
        try:
            results = LAPACK_FUNCTIONS[self.name].evaluate(self.sizes, *matrices)
        except np.linalg.LinAlgError:
            return np.full(len(self.result_kinds), np.nan)
        components = []
        for x, (_, is_real) in zip(results, self.result_specs, strict=True):
            components += [x.real.ravel(), x.imag.ravel()] if self.is_complex and not is_real else [np.real(x).ravel()]
        return np.concatenate(components).astype(np.float64)


@dataclass(frozen=True, eq=False)
class MatrixProduct(Block):
    """A block that multiplies two real matrices in a loop; its arguments are two tables.

    Attributes
    ----------
    sizes : (int, int, int)
        m, k, n of an (m, k) and a (k, n) matrix.
    strides : ((int, int), (int, int))
        For both matrices the distance, in their tables, of neighbouring rows and of neighbouring columns.
    """

    sizes: tuple[int, int, int]
    strides: tuple[tuple[int, int], tuple[int, int]]
    name: str = "product"

    @property
    def result_kinds(self) -> tuple[str, ...]:  # type: ignore[override]
        return ("f",) * (self.sizes[0] * self.sizes[2])

    def __call__(self, *args) -> list:
        m, k, n = self.sizes
        x, y = (
            np.stack(np.broadcast_arrays(*(np.asarray(a, dtype=np.float64) for a in table)))[
                np.add.outer(rows * np.arange(height), columns * np.arange(width))
            ]
            for table, (rows, columns), (height, width) in zip(args, self.strides, ((m, k), (k, n)), strict=True)
        )
        products = np.einsum("mk...,kn...->mn...", x, y)
        return [products[index][()] for index in np.ndindex(m, n)]


@dataclass(frozen=True, eq=False)
class DeferredBlock(Block):
    """A placeholder block that the writer of machine code fills in; evaluated by NumPy, it returns its first arguments.

    Attributes
    ----------
    result_kinds : tuple of str
        Kinds of the results, and of the first arguments.
    """

    result_kinds: tuple[str, ...]
    name: str = "deferred"

    def __call__(self, *args) -> list:
        return list(args[: len(self.result_kinds)])


deferred_p = Primitive("deferred")
"""Primitive of a :class:`DeferredBlock`: ``deferred_p.bind(*arrays, results=n)`` returns n arrays."""
deferred_p.multiple_results = True
deferred_p.def_abstract_eval(lambda *avals, results: list(avals[:results]))


@dataclass(frozen=True)
class LapackFunction:
    """Argument shapes, result shapes and implementation of a function that :class:`LapackCall` calls.

    Attributes
    ----------
    argument_shapes, result_specs : functions of the sizes
        See :class:`LapackCall`.
    evaluate : function of the sizes and the matrices to a sequence of arrays
    """

    argument_shapes: Callable[..., list[tuple[int, ...]]]
    result_specs: Callable[..., list[tuple[tuple[int, ...], bool]]]
    evaluate: Callable[..., Any]


def _lu_factors_and_pivots(sizes, matrix) -> tuple[np.ndarray, np.ndarray]:
    """Return both LU factors in one matrix, and the row with which each row is exchanged."""
    (getrf,) = scipy.linalg.get_lapack_funcs(("getrf",), (matrix,))
    factors, pivots, _ = getrf(matrix)
    return factors, pivots.astype(np.float64)


def _qr_factors(sizes, matrix) -> tuple[np.ndarray, np.ndarray]:
    """Return the factors Q and R, with as many columns of Q as ``sizes`` asks for."""
    columns = sizes[2]
    q, r = scipy.linalg.qr(matrix, mode="full" if columns == sizes[0] else "economic")
    return q, r[: sizes[0] if columns == sizes[0] else columns]


def _singular_values_and_vectors(sizes, matrix) -> tuple[np.ndarray, ...]:
    """Return singular values, left singular vectors as columns, and right ones as rows."""
    u, s, v = scipy.linalg.svd(matrix, full_matrices=bool(sizes[2]), lapack_driver="gesdd")
    return s, u, v


def _svd_result_specs(m: int, n: int, full_matrices: int) -> list[tuple[tuple[int, ...], bool]]:
    k = min(m, n)
    return [((k,), True), ((m, m if full_matrices else k), False), ((n if full_matrices else k, n), False)]


LAPACK_FUNCTIONS = {
    "eigh": LapackFunction(
        lambda n: [(n, n)],
        lambda n: [((n, n), False), ((n,), True)],
        lambda sizes, a: scipy.linalg.eigh(a, driver="evd")[::-1],
    ),
    "inverse": LapackFunction(lambda n: [(n, n)], lambda n: [((n, n), False)], lambda sizes, a: [np.linalg.inv(a)]),
    "lu": LapackFunction(
        lambda m, n: [(m, n)], lambda m, n: [((m, n), False), ((min(m, n),), True)], _lu_factors_and_pivots
    ),
    "qr": LapackFunction(
        lambda m, n, columns: [(m, n)],
        lambda m, n, columns: [((m, columns), False), ((columns, n), False)],
        _qr_factors,
    ),
    "svd": LapackFunction(lambda m, n, full: [(m, n)], _svd_result_specs, _singular_values_and_vectors),
}
"""Functions of matrices, by name.

- ``eigh``: eigenvectors and eigenvalues, from the lower triangle.
- ``inverse``: the inverse; NaN if the matrix is singular.
- ``lu``: both factors in one matrix, and the row with which each row is exchanged.
- ``qr``: factors with the requested number of columns.
- ``svd``: singular values, left singular vectors, and right ones as rows.
"""
