"""Linear algebra that does not unroll: calls of LAPACK, and products of matrices as loops."""

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
    """A function of matrices, on their entries row by row; of complex ones all real parts, then all imaginary ones.

    NaN where an argument is not finite, or the function does not end.

    Attributes
    ----------
    name : str
        A key of :data:`FUNCTIONS`.
    sizes : tuple of int
        What its function learns about the matrices.
    is_complex : bool
    """

    name: str
    sizes: tuple[int, ...]
    is_complex: bool = False

    @property
    def kinds(self) -> tuple[str, ...]:  # type: ignore[override]
        return ("f",) * sum(self.entry_counts(self.result_specs))

    @property
    def argument_shapes(self) -> list[tuple[int, ...]]:
        """Shapes of the matrices that it is given."""
        return LAPACK_FUNCTIONS[self.name].argument_shapes(*self.sizes)

    @property
    def result_specs(self) -> list[tuple[tuple[int, ...], bool]]:
        """Shapes of the arrays that it makes, and whether they are real even where its arguments are not."""
        return LAPACK_FUNCTIONS[self.name].result_specs(*self.sizes)

    def entry_counts(self, results) -> list[int]:
        return [math.prod(shape) * (2 if self.is_complex and not real else 1) for shape, real in results]

    def __call__(self, *args) -> list:
        arrays = np.broadcast_arrays(*(np.asarray(a, dtype=np.float64) for a in args))
        front = arrays[0].shape
        rows = np.stack(arrays, axis=-1).reshape(-1, len(args))
        found = np.stack([self._evaluate_one(row) for row in rows]).reshape(*front, -1)
        return [found[..., i][()] for i in range(found.shape[-1])]

    def _evaluate_one(self, row: np.ndarray) -> np.ndarray:
        if not np.isfinite(row).all():
            return np.full(len(self.kinds), np.nan)
        matrices, start = [], 0
        for shape in self.argument_shapes:
            size = math.prod(shape)
            matrix = row[start : start + size].reshape(shape)
            if self.is_complex:
                matrix = matrix + 1j * row[start + size : start + 2 * size].reshape(shape)
            matrices.append(matrix)
            start += size * (2 if self.is_complex else 1)
        try:
            found = LAPACK_FUNCTIONS[self.name].evaluate(self.sizes, *matrices)
        except np.linalg.LinAlgError:
            return np.full(len(self.kinds), np.nan)
        parts = []
        for x, (_, real) in zip(found, self.result_specs, strict=True):
            parts += [x.real.ravel(), x.imag.ravel()] if self.is_complex and not real else [np.real(x).ravel()]
        return np.concatenate(parts).astype(np.float64)


@dataclass(frozen=True, eq=False)
class MatrixProduct(Block):
    """The product of two real matrices, as a loop; its arguments are two tables.

    Attributes
    ----------
    sizes : (int, int, int)
        m, k, n of an (m, k) and a (k, n) matrix.
    strides : ((int, int), (int, int))
        For both how far apart in their tables entries are of neighbouring rows, and of neighbouring columns.
    """

    sizes: tuple[int, int, int]
    strides: tuple[tuple[int, int], tuple[int, int]]
    name: str = "product"

    @property
    def kinds(self) -> tuple[str, ...]:  # type: ignore[override]
        return ("f",) * (self.sizes[0] * self.sizes[2])

    def __call__(self, *args) -> list:
        m, k, n = self.sizes
        x, y = (
            np.stack(np.broadcast_arrays(*(np.asarray(a, dtype=np.float64) for a in table)))[
                np.add.outer(rows * np.arange(height), columns * np.arange(width))
            ]
            for table, (rows, columns), (height, width) in zip(args, self.strides, ((m, k), (k, n)), strict=True)
        )
        found = np.einsum("mk...,kn...->mn...", x, y)
        return [found[place][()] for place in np.ndindex(m, n)]


@dataclass(frozen=True, eq=False)
class DeferredBlock(Block):
    """What the writer of the code has to fill in, from all arguments: by itself the first of them, as they are.

    Attributes
    ----------
    kinds : tuple of str
        Of its results, and of as many arguments.
    """

    kinds: tuple[str, ...]
    name: str = "deferred"

    def __call__(self, *args) -> list:
        return list(args[: len(self.kinds)])


deferred_p = Primitive("deferred")
"""Makes one: ``deferred.bind(*arrays, results=n)`` gives the first n of the arrays, or what takes their place."""
deferred_p.multiple_results = True
deferred_p.def_abstract_eval(lambda *avals, results: list(avals[:results]))


@dataclass(frozen=True)
class LapackFunction:
    """What a call is of.

    Attributes
    ----------
    argument_shapes, result_specs : functions of the sizes
        See :class:`LapackCall`.
    evaluate : function of the sizes and the matrices to a sequence of arrays
    """

    argument_shapes: Callable[..., list[tuple[int, ...]]]
    result_specs: Callable[..., list[tuple[tuple[int, ...], bool]]]
    evaluate: Callable[..., Any]


def _lu(sizes, a) -> tuple[np.ndarray, np.ndarray]:
    (getrf,) = scipy.linalg.get_lapack_funcs(("getrf",), (a,))
    factors, pivots, _ = getrf(a)
    return factors, pivots.astype(np.float64)


def _qr(sizes, a) -> tuple[np.ndarray, np.ndarray]:
    columns = sizes[2]
    q, r = scipy.linalg.qr(a, mode="full" if columns == sizes[0] else "economic")
    return q, r[: sizes[0] if columns == sizes[0] else columns]


def _svd(sizes, a) -> tuple[np.ndarray, ...]:
    u, s, v = scipy.linalg.svd(a, full_matrices=bool(sizes[2]), lapack_driver="gesdd")
    return s, u, v


def _svd_result_specs(m: int, n: int, full: int) -> list[tuple[tuple[int, ...], bool]]:
    least = min(m, n)
    return [((least,), True), ((m, m if full else least), False), ((n if full else least, n), False)]


LAPACK_FUNCTIONS = {
    "eigh": LapackFunction(
        lambda n: [(n, n)],
        lambda n: [((n, n), False), ((n,), True)],
        lambda sizes, a: scipy.linalg.eigh(a, driver="evd")[::-1],
    ),
    "inverse": LapackFunction(lambda n: [(n, n)], lambda n: [((n, n), False)], lambda sizes, a: [np.linalg.inv(a)]),
    "lu": LapackFunction(lambda m, n: [(m, n)], lambda m, n: [((m, n), False), ((min(m, n),), True)], _lu),
    "qr": LapackFunction(
        lambda m, n, columns: [(m, n)],
        lambda m, n, columns: [((m, columns), False), ((columns, n), False)],
        _qr,
    ),
    "svd": LapackFunction(lambda m, n, full: [(m, n)], _svd_result_specs, _svd),
}
"""``eigh``: eigenvectors and eigenvalues, from the lower triangle; ``inverse``, NaN of a singular
matrix; ``lu``: factors in one matrix, and the row that each
row is exchanged with; ``qr``: with as many columns as are asked for; ``svd``: singular values, left vectors, and right
ones as rows."""
