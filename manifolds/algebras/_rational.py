"""Rational arrays with a common denominator, on which axioms are checked exactly."""

from __future__ import annotations

import math
from dataclasses import dataclass
from fractions import Fraction
from numbers import Rational

import numpy as np
import scipy

MAX_DENOMINATOR = 1000
"""Largest denominator of a fraction that is recognised in a float."""

MAX_INT64_NUMERATOR = 2**28
"""Numerators below this are stored as int64, larger ones as Python integers.

Sums of a hundred products of two such numerators are exact in int64.
"""


@dataclass(frozen=True)
class RationalArray:
    """Exact array ``numerator / denominator`` of integers: int64, or Python integers where those are too small."""

    numerator: np.ndarray
    denominator: int

    def __array__(self, dtype=None, copy=None):
        return np.asarray(self.numerator / self.denominator, dtype=dtype or np.float64)


def rational_array(values) -> RationalArray | None:
    """Return ``values`` as exact fractions, or None if an entry is not recognised as a fraction.

    Integers and :class:`fractions.Fraction` are taken as they are. A float counts as ``p/q`` if it *is* the double
    nearest to ``p/q`` for some ``q <= 1000``; no double of an irrational number met in practice (a square root, a
    multiple of pi) passes that test.
    """
    array = np.asarray(values)
    distinct_values, inverse = np.unique(array, return_inverse=True) if array.dtype != object else (array.ravel(), None)
    fractions = []
    for value in distinct_values:
        fraction = _recognize_fraction(value)
        if fraction is None:
            return None
        fractions.append(fraction)
    denominator = math.lcm(*(f.denominator for f in fractions)) if fractions else 1
    integers = [int(f * denominator) for f in fractions]
    fits_int64 = max(map(abs, integers), default=0) < MAX_INT64_NUMERATOR
    numerators = np.array(integers, dtype=np.int64 if fits_int64 else object)
    numerators = numerators if inverse is None else numerators[inverse]
    return RationalArray(numerators.reshape(array.shape), denominator)


def _recognize_fraction(value) -> Fraction | None:
    """Return a number as a fraction if it equals one of denominator up to MAX_DENOMINATOR; otherwise None."""
    if isinstance(value, Rational):
        return Fraction(value)
    if isinstance(value, np.integer):
        return Fraction(int(value))
    number = float(value)
    if not math.isfinite(number):
        return None
    fraction = Fraction(number).limit_denominator(MAX_DENOMINATOR)
    return fraction if float(fraction) == number else None


MAX_DENSE_JACOBI_DIM = 12
"""Largest dimension in which the Jacobi identity is checked for all triples in one dense array."""


def max_jacobi_residual_and_triple(constants: np.ndarray) -> tuple[float, tuple[int, int, int]]:
    """Return the largest component of ``[[a,b],c] + [[b,c],a] + [[c,a],b]`` and its triple; exact for integers.

    The constants must be antisymmetric. Above MAX_DENSE_JACOBI_DIM sparse arrays of one element a at a time save
    memory.
    """
    dim = constants.shape[0]
    if constants.dtype == object or dim <= MAX_DENSE_JACOBI_DIM:
        double_brackets = np.tensordot(constants, constants, axes=(2, 0))
        cyclic_sums = np.abs(
            double_brackets + double_brackets.transpose(2, 0, 1, 3) + double_brackets.transpose(1, 2, 0, 3)
        ).max(axis=3)
        a, b, c = (int(i) for i in np.unravel_index(cyclic_sums.argmax(), cyclic_sums.shape))
        return float(cyclic_sums[a, b, c]), (a, b, c)
    max_residual, triple = 0.0, (0, 0, 0)
    rows = scipy.sparse.csr_array(constants.reshape(dim * dim, dim))
    columns = scipy.sparse.csr_array(constants.reshape(dim, dim * dim))
    for i in range(dim):
        # [[e_i, e_b], e_c] in row b, columns (c, f)
        double_brackets = (scipy.sparse.csr_array(constants[i]) @ columns).tocoo()
        b, (c, f) = double_brackets.coords[0], divmod(double_brackets.coords[1], dim)
        swapped_brackets = scipy.sparse.coo_array((double_brackets.data, (c, b * dim + f)), shape=double_brackets.shape)
        # [[e_b, e_c], e_i]
        remaining_brackets = (rows @ scipy.sparse.csr_array(constants[:, i])).reshape(double_brackets.shape)
        sums = (double_brackets.tocsr() - swapped_brackets.tocsr() + remaining_brackets.tocsr()).tocoo()
        if sums.nnz and np.abs(sums.data).max() > max_residual:
            argmax = int(np.abs(sums.data).argmax())
            max_residual, triple = (
                abs(float(sums.data[argmax])),
                (i, int(sums.coords[0][argmax]), int(sums.coords[1][argmax]) // dim),
            )
    return max_residual, triple
