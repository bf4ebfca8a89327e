"""Rational arithmetic on arrays: a common denominator and integers, so that axioms can be checked exactly."""

from __future__ import annotations

import math
from dataclasses import dataclass
from fractions import Fraction
from numbers import Rational

import numpy as np
import scipy

MAX_DENOMINATOR = 1000

MAX_INT64_NUMERATOR = 2**28
"""Numerators below this are int64: sums of a hundred products of two are then exact. Larger ones are Python's."""


@dataclass(frozen=True)
class RationalArray:
    """The array ``numerator / denominator``, integers throughout: int64, or Python's own where those are too small."""

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
        fraction = _recognize_fraction(value)
        if fraction is None:
            return None
        fractions.append(fraction)
    denominator = math.lcm(*(f.denominator for f in fractions)) if fractions else 1
    integers = [int(f * denominator) for f in fractions]
    small = max(map(abs, integers), default=0) < MAX_INT64_NUMERATOR
    numerators = np.array(integers, dtype=np.int64 if small else object)
    numerators = numerators if inverse is None else numerators[inverse]
    return RationalArray(numerators.reshape(array.shape), denominator)


def _recognize_fraction(value) -> Fraction | None:
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
"""Dimension up to which all triples of elements are looked at in one array."""


def max_jacobi_residual(constants: np.ndarray) -> tuple[float, tuple[int, int, int]]:
    """The largest component of ``[[a,b],c] + [[b,c],a] + [[c,a],b]`` and its triple; exact for integers.

    The constants are antisymmetric. In dimensions above DENSE one a is looked at after another, in memory for one.
    """
    dim = constants.shape[0]
    if constants.dtype == object or dim <= MAX_DENSE_JACOBI_DIM:
        nested = np.tensordot(constants, constants, axes=(2, 0))
        total = np.abs(nested + nested.transpose(2, 0, 1, 3) + nested.transpose(1, 2, 0, 3)).max(axis=3)
        a, b, c = (int(i) for i in np.unravel_index(total.argmax(), total.shape))
        return float(total[a, b, c]), (a, b, c)
    worst, triple = 0.0, (0, 0, 0)
    rows = scipy.sparse.csr_array(constants.reshape(dim * dim, dim))
    columns = scipy.sparse.csr_array(constants.reshape(dim, dim * dim))
    for i in range(dim):
        nested = (scipy.sparse.csr_array(constants[i]) @ columns).tocoo()  # [[e_i, e_b], e_c] in row b, columns (c, f)
        b, (c, f) = nested.coords[0], divmod(nested.coords[1], dim)
        turned = scipy.sparse.coo_array((nested.data, (c, b * dim + f)), shape=nested.shape)
        third = (rows @ scipy.sparse.csr_array(constants[:, i])).reshape(nested.shape)  # [[e_b, e_c], e_i]
        sums = (nested.tocsr() - turned.tocsr() + third.tocsr()).tocoo()
        if sums.nnz and np.abs(sums.data).max() > worst:
            at = int(np.abs(sums.data).argmax())
            worst, triple = abs(float(sums.data[at])), (i, int(sums.coords[0][at]), int(sums.coords[1][at]) // dim)
    return worst, triple
