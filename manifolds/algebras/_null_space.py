"""Row echelon forms and null spaces: exact for integer matrices, by primes; checked for a gap in rank for floats."""

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
    these
    residues satisfy ``matrix @ v == 0`` in integers. No vector can then be missing: the rank modulo a prime is at most
    the
    rank over Q.
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
    return values % modulus if modulus else values


@cache
def large_prime(k: int) -> int:
    """Return the k-th prime below 2**31, in descending order; a product of two residues then fits in 64 bits."""
    n = 2**31 - 1 if k == 0 else large_prime(k - 1) - 2
    while any(n % d == 0 for d in range(3, math.isqrt(n) + 1, 2)):
        n -= 2
    return n
