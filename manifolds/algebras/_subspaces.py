"""Null spaces, and subspaces by the rows that span them: exact for rational rows, to a rank tolerance for floats.

Rows of dtype object hold integers or fractions, and every function is exact on them. Rows of floats are of order one.
"""

from __future__ import annotations

import math
from fractions import Fraction
from functools import cache
from itertools import count

import numpy as np

from ..errors import LieAlgebraError

RANK_TOLERANCE = 1e-10
"""Singular values below this count as zero, relative to the largest entry; the axioms hold to 1e-12 only."""

RANK_GAP = 1e3
"""Factor above RANK_TOLERANCE within which no singular value may lie, since the rank would be ambiguous."""


def rational_null_space(matrix: np.ndarray) -> list[list[int]]:
    """Return the reduced row echelon basis of the null space of an integer matrix, exact, scaled to coprime integers.

    The basis is computed modulo a prime, then modulo the product of two, three, … primes, until the fractions with
    these residues satisfy ``matrix @ v == 0`` in integers. No vector can then be missing: the rank modulo a prime is at
    most the rank over Q.
    """
    primes = map(large_prime, count())
    residues, modulus, leading_columns = np.zeros((0, 0), dtype=object), 1, None
    while True:
        p = next(primes)
        basis, columns = _null_space_modulo(matrix, p)
        if leading_columns is not None and np.array_equal(columns, leading_columns):
            residues = residues + modulus * ((basis - residues) * pow(modulus, -1, p) % p)
            modulus *= p
        else:  # the first prime, or one of the earlier ones divides a minor
            residues, modulus, leading_columns = basis.astype(object), p, columns
        vectors = [_coprime_integers(row, modulus) for row in residues.tolist()]
        if all(_annihilates(matrix, vector) for vector in vectors):
            return vectors


def _null_space_modulo(matrix: np.ndarray, p: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the reduced row echelon basis of the null space modulo p, and its leading columns."""
    # With the columns reversed the free variables come last in each relation, hence first in each basis vector.
    n_columns = matrix.shape[1]
    echelon, pivots = row_echelon(matrix[:, ::-1], p)
    free_columns = np.setdiff1d(np.arange(n_columns), pivots)
    basis = np.zeros((len(free_columns), n_columns), dtype=np.int64)
    basis[np.arange(len(free_columns)), free_columns] = 1
    basis[:, pivots] = -echelon[:, free_columns].T % p
    return basis[::-1, ::-1], n_columns - 1 - free_columns[::-1]


def _coprime_integers(residues: list[int], modulus: int) -> list[int]:
    """Return coprime integers in proportion to the smallest fractions with these residues."""
    # n/d = r modulo m means d r - k m = n: then k/d is a convergent of r/m, if n and d are below sqrt(m/2).
    max_fraction_part = math.isqrt((modulus - 1) // 2)
    fractions = []
    for r in residues:
        d = Fraction(r, modulus).limit_denominator(max_fraction_part).denominator
        n = d * r % modulus
        fractions.append(Fraction(n if 2 * n < modulus else n - modulus, d))
    common_denominator = math.lcm(*(f.denominator for f in fractions))
    integers = [int(f * common_denominator) for f in fractions]
    divisor = math.gcd(*integers)
    return [i // divisor for i in integers]


def _annihilates(matrix: np.ndarray, vector: list[int]) -> bool:
    """Return True if ``matrix @ vector`` is zero, in exact integers."""
    max_product = int(np.abs(matrix).max(initial=0)) * sum(map(abs, vector))
    dtype = np.int64 if max_product < 2**63 else object
    return not (matrix.astype(dtype) @ np.array(vector, dtype=dtype)).any()


def numerical_null_space(matrix: np.ndarray, name: str) -> np.ndarray:
    """Return the reduced row echelon basis of the null space of a matrix of floats with entries of order 1."""
    _, singular_values, right_vectors = np.linalg.svd(np.linalg.qr(matrix, mode="r"))
    basis, _ = row_echelon(right_vectors[numerical_rank(singular_values, 1.0, name) :], tolerance=1e-8)
    simple_fractions = np.rint(24 * basis) / 24  # 0, 1, 1/2, 2/3, … without rounding errors
    basis = np.where(np.abs(basis - simple_fractions) < 1e-12, simple_fractions, basis)
    residual = float(np.abs(matrix @ basis.T).max(initial=0.0) / max(1.0, np.abs(basis).max(initial=0.0)))
    if residual > RANK_TOLERANCE:
        raise LieAlgebraError(
            f"{name}: the Casimirs found hold to {residual:.1e} only (tolerance {RANK_TOLERANCE:.0e}), since their "
            "coefficients differ too much in size; rescale the basis, or give the constants as fractions",
            residual=residual,
            tolerance=RANK_TOLERANCE,
        )
    return basis


def numerical_rank(singular_values: np.ndarray, scale: float, name: str) -> int:
    """Return the number of nonzero singular values; raise LieAlgebraError if one lies in the gap."""
    threshold = RANK_TOLERANCE * scale
    ambiguous_values = singular_values[(singular_values > threshold) & (singular_values < RANK_GAP * threshold)]
    if ambiguous_values.size:
        raise LieAlgebraError(
            f"{name}: the rank of the linear conditions is not clear, since there is a singular value of "
            f"{ambiguous_values[0]:.1e} (zero is below {threshold:.0e}, nonzero above {RANK_GAP * threshold:.0e}); "
            "rescale the basis so that the structure constants are of similar size, or give them as fractions",
            residual=float(ambiguous_values[0]),
            tolerance=threshold,
        )
    return int((singular_values > threshold).sum())


def row_echelon(rows: np.ndarray, modulus: int = 0, tolerance: float = 0) -> tuple[np.ndarray, list[int]]:
    """Return the nonzero rows of the reduced row echelon form, and their leading columns.

    The entries are integers modulo a prime below 2**31; or, if ``modulus`` is 0, fractions or floats, and pivots up to
    ``tolerance`` count as zero.
    """
    rows = reduce_modulo(rows.copy(), modulus)
    pivots: list[int] = []
    for column in range(rows.shape[1]):
        rank = len(pivots)
        if rank == len(rows):
            break
        magnitudes = np.abs(rows[rank:, column])
        pivot_offset = int(magnitudes.argmax())
        if magnitudes[pivot_offset] <= tolerance:
            rows[rank:, column] = 0
            continue
        rows[[rank, rank + pivot_offset]] = rows[[rank + pivot_offset, rank]]
        pivot = rows[rank, column]
        rows[rank] = rows[rank] * pow(int(pivot), -1, modulus) % modulus if modulus else rows[rank] / pivot
        other_rows = np.flatnonzero(rows[:, column])
        other_rows = other_rows[other_rows != rank]
        new_entries = rows[other_rows, column:] - np.multiply.outer(rows[other_rows, column], rows[rank, column:])
        rows[other_rows, column:] = reduce_modulo(new_entries, modulus)
        pivots.append(column)
    return rows[: len(pivots)], pivots


def reduce_modulo(values: np.ndarray, modulus: int) -> np.ndarray:
    """Return integers modulo ``modulus``; unchanged values if it is 0."""
    return values % modulus if modulus else values


@cache
def large_prime(k: int) -> int:
    """Return the k-th prime below 2**31, in descending order; a product of two residues then fits in 64 bits."""
    n = 2**31 - 1 if k == 0 else large_prime(k - 1) - 2
    while any(n % d == 0 for d in range(3, math.isqrt(n) + 1, 2)):
        n -= 2
    return n


def is_exact(rows: np.ndarray) -> bool:
    """Return True if the entries are Python integers or fractions, and False if they are floats."""
    return rows.dtype == object


def identity_rows(dim: int, exact: bool) -> np.ndarray:
    """Return the rows of the identity matrix, shape (dim, dim), as Python integers or as floats."""
    return np.eye(dim, dtype=np.int64).astype(object) if exact else np.eye(dim)


def null_space(matrix: np.ndarray, name: str) -> np.ndarray:
    """Return rows v, shape (k, n), that span the solutions of ``matrix @ v = 0``: coprime integers, or orthonormal."""
    n = matrix.shape[1]
    if n == 0 or not len(matrix):
        return identity_rows(n, is_exact(matrix))
    if is_exact(matrix):
        vectors = rational_null_space(_to_int64_if_possible(integer_rows(matrix)))
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


def intersection(rows_a: np.ndarray, rows_b: np.ndarray, name: str) -> np.ndarray:
    """Return rows that span the intersection of two row spaces."""
    return null_space(np.vstack([null_space(rows_a, name), null_space(rows_b, name)]), name)


def complement(rows: np.ndarray, space_rows: np.ndarray, name: str) -> np.ndarray:
    """Return rows that span a complement of ``rows`` in the span of ``space_rows``: some of these, or orthogonal."""
    if not is_exact(rows):
        projected_rows = space_rows - space_rows @ row_space(rows, name).T @ row_space(rows, name)
        return row_space(projected_rows, name)
    n_rows = len(rows)
    stacked_rows = fraction_rows(np.vstack([rows, space_rows]))
    _, independent = row_echelon(stacked_rows.T)
    return space_rows[[i - n_rows for i in independent if i >= n_rows]]


def coordinates(basis: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Return c, shape (k, len(basis)), with ``c @ basis = vectors``, for vectors in the span of independent rows."""
    if not is_exact(basis):
        return np.linalg.lstsq(basis.T, vectors.T, rcond=None)[0].T
    augmented_matrix = np.hstack([fraction_rows(basis).T, fraction_rows(vectors).T])
    echelon, pivots = row_echelon(augmented_matrix)
    assert pivots == list(range(len(basis))), "the vectors are in the span of the rows"
    return echelon[:, len(basis) :].T


def solution(matrix: np.ndarray, right_hand_side: np.ndarray) -> np.ndarray:
    """Return one solution v, shape (n,), of the consistent linear equations ``matrix @ v = right_hand_side``."""
    if not is_exact(matrix):
        return np.linalg.lstsq(matrix, right_hand_side, rcond=None)[0]
    if not matrix.shape[1]:
        return np.zeros(0, dtype=object)
    augmented_matrix = np.hstack([matrix, -right_hand_side[:, None]])
    vector = next(v for v in null_space(augmented_matrix, "") if v[-1])
    return np.array([Fraction(entry, vector[-1]) for entry in vector[:-1]], dtype=object)


def brackets_of_rows(rows_a: np.ndarray, rows_b: np.ndarray, constants: np.ndarray) -> np.ndarray:
    """Return the brackets of all pairs of rows, shape (len(rows_a), len(rows_b), dim)."""
    ad_matrices = np.tensordot(rows_a, constants, axes=(1, 0))
    return np.tensordot(ad_matrices, rows_b, axes=(1, 1)).transpose(0, 2, 1)


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


def _to_int64_if_possible(rows: np.ndarray) -> np.ndarray:
    """Return integers as int64 where they fit, for which elimination modulo a prime is fast."""
    return rows.astype(np.int64) if max(map(abs, rows.flat), default=0) < 2**62 else rows
