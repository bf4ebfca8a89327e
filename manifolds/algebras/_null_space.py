"""Row echelon forms and null spaces: of integer matrices exactly, by primes; of floats with a gap that is checked."""

from __future__ import annotations

import math
from fractions import Fraction
from functools import cache
from itertools import count

import numpy as np

from ..errors import LieAlgebraError

RANK_TOLERANCE = 1e-10
"""Singular values below this, relative to the largest entry, are zeros: the axioms hold to 1e-12 only."""

RANK_GAP = 1e3
"""No singular value may lie between the tolerance and this many times the tolerance."""


def rational_null_space(matrix: np.ndarray) -> list[list[int]]:
    """The reduced row echelon basis of the null space of an integer matrix, scaled to coprime integers; exact.

    Found modulo a prime, then modulo the product of two, three, …, until the fractions with these residues satisfy
    ``matrix @ v == 0`` in integers. None can then be missing: the rank modulo a prime is at most the rank over Q.
    """
    primes = map(large_prime, count())
    residues, modulus, leading = np.zeros((0, 0), dtype=object), 1, None
    while True:
        p = next(primes)
        basis, columns = _null_space_modulo(matrix, p)
        if leading is not None and np.array_equal(columns, leading):
            residues = residues + modulus * ((basis - residues) * pow(modulus, -1, p) % p)
            modulus *= p
        else:  # the first prime, or one of the earlier ones divides a minor
            residues, modulus, leading = basis.astype(object), p, columns
        vectors = [_coprime_integers(row, modulus) for row in residues.tolist()]
        if all(_annihilates(matrix, vector) for vector in vectors):
            return vectors


def _null_space_modulo(matrix: np.ndarray, p: int) -> tuple[np.ndarray, np.ndarray]:
    """The reduced row echelon basis of the null space modulo p, and its leading columns."""
    # With the columns reversed the free variables come last in each relation, hence first in each basis vector.
    size = matrix.shape[1]
    echelon, pivots = row_echelon(matrix[:, ::-1], p)
    free = np.setdiff1d(np.arange(size), pivots)
    basis = np.zeros((len(free), size), dtype=np.int64)
    basis[np.arange(len(free)), free] = 1
    basis[:, pivots] = -echelon[:, free].T % p
    return basis[::-1, ::-1], size - 1 - free[::-1]


def _coprime_integers(residues: list[int], modulus: int) -> list[int]:
    """The multiple by integers without common factor of the smallest fractions that have these residues."""
    # n/d = r modulo m means d r - k m = n: then k/d is a convergent of r/m, if n and d are below sqrt(m/2).
    largest = math.isqrt((modulus - 1) // 2)
    fractions = []
    for r in residues:
        d = Fraction(r, modulus).limit_denominator(largest).denominator
        n = d * r % modulus
        fractions.append(Fraction(n if 2 * n < modulus else n - modulus, d))
    multiple = math.lcm(*(f.denominator for f in fractions))
    integers = [int(f * multiple) for f in fractions]
    divisor = math.gcd(*integers)
    return [i // divisor for i in integers]


def _annihilates(matrix: np.ndarray, vector: list[int]) -> bool:
    largest = int(np.abs(matrix).max(initial=0)) * sum(map(abs, vector))
    dtype = np.int64 if largest < 2**63 else object
    return not (matrix.astype(dtype) @ np.array(vector, dtype=dtype)).any()


def numerical_null_space(matrix: np.ndarray, name: str) -> np.ndarray:
    """The reduced row echelon basis of the null space of a matrix of floats with entries of order 1."""
    _, singular, right = np.linalg.svd(np.linalg.qr(matrix, mode="r"))
    basis, _ = row_echelon(right[numerical_rank(singular, 1.0, name) :], tolerance=1e-8)
    simple = np.rint(24 * basis) / 24  # 0, 1, 1/2, 2/3, … without their rounding
    basis = np.where(np.abs(basis - simple) < 1e-12, simple, basis)
    residual = float(np.abs(matrix @ basis.T).max(initial=0.0) / max(1.0, np.abs(basis).max(initial=0.0)))
    if residual > RANK_TOLERANCE:
        raise LieAlgebraError(
            f"{name}: the Casimirs found hold to {residual:.1e} only (tolerance {RANK_TOLERANCE:.0e}), since their "
            "coefficients differ too much in size; rescale the basis, or give the constants as fractions",
            residual=residual,
            tolerance=RANK_TOLERANCE,
        )
    return basis


def numerical_rank(singular: np.ndarray, scale: float, name: str) -> int:
    smallest = RANK_TOLERANCE * scale
    doubtful = singular[(singular > smallest) & (singular < RANK_GAP * smallest)]
    if doubtful.size:
        raise LieAlgebraError(
            f"{name}: the rank of the conditions on a Casimir is not clear, since there is a singular value of "
            f"{doubtful[0]:.1e} (zero is below {smallest:.0e}, nonzero above {RANK_GAP * smallest:.0e}); rescale the "
            "basis so that the structure constants are of similar size, or give them as fractions",
            residual=float(doubtful[0]),
            tolerance=smallest,
        )
    return int((singular > smallest).sum())


def row_echelon(rows: np.ndarray, modulus: int = 0, tolerance: float = 0) -> tuple[np.ndarray, list[int]]:
    """The nonzero rows of the reduced row echelon form and their leading columns.

    The entries are integers modulo a prime below 2**31; or, without modulus, fractions or floats, and what is below
    ``tolerance`` is zero.
    """
    rows = reduce_modulo(rows.copy(), modulus)
    pivots: list[int] = []
    for column in range(rows.shape[1]):
        rank = len(pivots)
        if rank == len(rows):
            break
        sizes = np.abs(rows[rank:, column])
        best = int(sizes.argmax())
        if sizes[best] <= tolerance:
            rows[rank:, column] = 0
            continue
        rows[[rank, rank + best]] = rows[[rank + best, rank]]
        pivot = rows[rank, column]
        rows[rank] = rows[rank] * pow(int(pivot), -1, modulus) % modulus if modulus else rows[rank] / pivot
        others = np.flatnonzero(rows[:, column])
        others = others[others != rank]
        updated = rows[others, column:] - np.multiply.outer(rows[others, column], rows[rank, column:])
        rows[others, column:] = reduce_modulo(updated, modulus)
        pivots.append(column)
    return rows[: len(pivots)], pivots


def reduce_modulo(values: np.ndarray, modulus: int) -> np.ndarray:
    return values % modulus if modulus else values


@cache
def large_prime(k: int) -> int:
    """The primes below 2**31 in descending order: a product of two residues fits in 64 bits."""
    n = 2**31 - 1 if k == 0 else large_prime(k - 1) - 2
    while any(n % d == 0 for d in range(3, math.isqrt(n) + 1, 2)):
        n -= 2
    return n
