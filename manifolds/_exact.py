"""Rational arithmetic on arrays: a common denominator and integers, so that axioms can be checked exactly."""

from __future__ import annotations

import math
from dataclasses import dataclass
from fractions import Fraction
from numbers import Rational

import numpy as np
import scipy.sparse as sp

LARGEST_DENOMINATOR = 1000


@dataclass(frozen=True)
class RationalArray:
    """The array ``numerator / denominator``, integers throughout."""

    numerator: np.ndarray
    denominator: int

    def __array__(self, dtype=None, copy=None):
        return np.asarray(self.numerator / self.denominator, dtype=dtype or np.float64)


def rational_array(values) -> RationalArray | None:
    """``values`` as exact fractions, or None where some entry is not recognisably one.

    Integers and :class:`fractions.Fraction` are taken as they are. A float counts as ``p/q`` if it *is* the double
    nearest to ``p/q`` for some ``q <= 1000``; no double of an irrational number met in practice (a square root, a
    multiple of pi) passes that test.
    """
    array = np.asarray(values)
    distinct, inverse = np.unique(array, return_inverse=True) if array.dtype != object else (array.ravel(), None)
    fractions = []
    for value in distinct:
        fraction = _fraction(value)
        if fraction is None:
            return None
        fractions.append(fraction)
    denominator = math.lcm(*(f.denominator for f in fractions)) if fractions else 1
    integers = [int(f * denominator) for f in fractions]
    if max(map(abs, integers), default=0) >= 2**31:
        return None
    numerators = np.array(integers, dtype=np.int64)
    numerators = numerators if inverse is None else numerators[inverse]
    return RationalArray(numerators.reshape(array.shape), denominator)


def _fraction(value) -> Fraction | None:
    if isinstance(value, Rational):
        return Fraction(value)
    if isinstance(value, np.integer):
        return Fraction(int(value))
    number = float(value)
    if not math.isfinite(number):
        return None
    fraction = Fraction(number).limit_denominator(LARGEST_DENOMINATOR)
    return fraction if float(fraction) == number else None


def jacobi_sums(constants: np.ndarray) -> sp.coo_array:
    """``[[a,b],c] + [[b,c],a] + [[c,a],b]`` for all triples, as a sparse (dim^3, dim) array.

    Exact for integer constants below about 1e9 / sqrt(dim), since the products are then summed in 64-bit integers.
    """
    dim = constants.shape[0]
    rows = sp.csr_array(constants.reshape(dim * dim, dim))
    columns = sp.csr_array(constants.reshape(dim, dim * dim))
    nested = (rows @ columns).tocoo()  # entry ((a, b), (c, f)) is the component f of [[e_a, e_b], e_c]
    ab, cf = nested.coords
    (a, b), (c, f) = divmod(ab, dim), divmod(cf, dim)
    triples = np.concatenate([(a * dim + b) * dim + c, (c * dim + a) * dim + b, (b * dim + c) * dim + a])
    sums = sp.coo_array((np.tile(nested.data, 3), (triples, np.tile(f, 3))), shape=(dim**3, dim))
    sums.sum_duplicates()
    return sums
