"""Subspaces by the rows that span them: exact for rational rows, to a rank tolerance for floats.

Rows of dtype object hold integers or fractions, and every function is exact on them. Rows of floats are of order one.
"""

from __future__ import annotations

import math
from fractions import Fraction

import numpy as np

from ._null_space import numerical_rank, rational_null_space, row_echelon


def is_exact(rows: np.ndarray) -> bool:
    return rows.dtype == object


def identity_rows(dim: int, exact: bool) -> np.ndarray:
    return np.eye(dim, dtype=np.int64).astype(object) if exact else np.eye(dim)


def null_space(matrix: np.ndarray, name: str) -> np.ndarray:
    """Return rows v, shape (k, n), that span the solutions of ``matrix @ v = 0``: coprime integers, or orthonormal."""
    n = matrix.shape[1]
    if n == 0 or not len(matrix):
        return identity_rows(n, is_exact(matrix))
    if is_exact(matrix):
        vectors = rational_null_space(_small_integers(integer_rows(matrix)))
        return np.array(vectors, dtype=object).reshape(-1, n)
    triangle = np.linalg.qr(matrix, mode="r")
    _, singular_values, right_vectors = np.linalg.svd(triangle)
    return right_vectors[numerical_rank(singular_values, 1.0, name) :]


def row_space(rows: np.ndarray, name: str) -> np.ndarray:
    """Return independent rows with the span of ``rows``: coprime integers in echelon form, or orthonormal."""
    if is_exact(rows):
        return null_space(null_space(rows, name), name)
    if not len(rows):
        return rows
    _, singular_values, right_vectors = np.linalg.svd(np.linalg.qr(rows, mode="r"), full_matrices=False)
    return right_vectors[: numerical_rank(singular_values, 1.0, name)]


def intersection(first: np.ndarray, second: np.ndarray, name: str) -> np.ndarray:
    """Return rows that span the intersection of two row spaces."""
    return null_space(np.vstack([null_space(first, name), null_space(second, name)]), name)


def complement(rows: np.ndarray, within: np.ndarray, name: str) -> np.ndarray:
    """Return rows of the span of ``within`` that span a complement of ``rows`` there: some of ``within``, or normal."""
    if not is_exact(rows):
        projected_rows = within - within @ row_space(rows, name).T @ row_space(rows, name)
        return row_space(projected_rows, name)
    n_rows = len(rows)
    stacked = fraction_rows(np.vstack([rows, within]))
    _, independent = row_echelon(stacked.T)
    return within[[i - n_rows for i in independent if i >= n_rows]]


def coordinates(basis: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Return c, shape (k, len(basis)), with ``c @ basis = vectors``, for vectors in the span of independent rows."""
    if not is_exact(basis):
        return np.linalg.lstsq(basis.T, vectors.T, rcond=None)[0].T
    augmented = np.hstack([fraction_rows(basis).T, fraction_rows(vectors).T])
    echelon, pivots = row_echelon(augmented)
    assert pivots == list(range(len(basis))), "the vectors are in the span of the rows"
    return echelon[:, len(basis) :].T


def solution(matrix: np.ndarray, right_hand_side: np.ndarray) -> np.ndarray:
    """Return one solution v, shape (n,), of the consistent equations ``matrix @ v = right_hand_side``."""
    if not is_exact(matrix):
        return np.linalg.lstsq(matrix, right_hand_side, rcond=None)[0]
    if not matrix.shape[1]:
        return np.zeros(0, dtype=object)
    augmented = np.hstack([matrix, -right_hand_side[:, None]])
    vector = next(v for v in null_space(augmented, "") if v[-1])
    return np.array([Fraction(entry, vector[-1]) for entry in vector[:-1]], dtype=object)


def products(left: np.ndarray, right: np.ndarray, constants: np.ndarray) -> np.ndarray:
    """Return the brackets of all pairs of rows, shape (len(left), len(right), dim)."""
    images = np.tensordot(left, constants, axes=(1, 0))
    return np.tensordot(images, right, axes=(1, 1)).transpose(0, 2, 1)


def fraction_rows(rows: np.ndarray) -> np.ndarray:
    """Return exact rows with every entry a Fraction, so that divisions of integers stay exact."""
    result = np.empty(rows.size, dtype=object)
    result[:] = [Fraction(value) for value in rows.ravel()]
    return result.reshape(rows.shape)


def integer_rows(rows: np.ndarray) -> np.ndarray:
    """Return each exact row multiplied by a positive number that makes it coprime integers."""
    result = np.empty(rows.shape, dtype=object)
    for i, row in enumerate(rows):
        denominator = math.lcm(*(Fraction(value).denominator for value in row))
        integers = [int(value * denominator) for value in row]
        divisor = math.gcd(*integers) or 1
        result[i] = [integer // divisor for integer in integers]
    return result


def _small_integers(rows: np.ndarray) -> np.ndarray:
    """Return integers as int64 where they fit, for which elimination modulo a prime is fast."""
    return rows.astype(np.int64) if max(map(abs, rows.flat), default=0) < 2**62 else rows
