"""Jordan blocks of small real matrices: exact multiplicities for rational matrices, or refusal where unclear."""

from __future__ import annotations

import math
from fractions import Fraction
from typing import NamedTuple

import numpy as np

from ..errors import LieAlgebraError
from ._subspaces import is_exact

ZERO_TOLERANCE = 1e-9
"""Relative sizes below this count as zero: rounding of a few eigenvalues, amplified by a basis of condition 1e4."""

NONZERO_TOLERANCE = 1e-7
"""Relative sizes above this count as nonzero; between the two a number is unclear."""

CLUSTER_ROUNDING = 1e-12
"""Rounding of a matrix of size 1, whose k-th root bounds the spread of the k values of a defective eigenvalue."""


class UnclearError(LieAlgebraError):
    """Raised when rounding does not allow a decision about a rank or an eigenvalue."""


class JordanBlock(NamedTuple):
    """A Jordan block of a real matrix; the eigenvalue with positive imaginary part stands for a complex pair."""

    eigenvalue: complex
    size: int

    @property
    def is_complex(self) -> bool:
        return self.eigenvalue.imag > 0.0


def is_zero(value: float, scale: float = 1.0) -> bool:
    """Return whether a number is zero relative to a scale; raise UnclearError in the gap between the tolerances."""
    size = abs(value) / scale
    if ZERO_TOLERANCE < size < NONZERO_TOLERANCE:
        raise UnclearError(f"a value of relative size {size:.1e} may be zero or rounding")
    return size <= ZERO_TOLERANCE


def jordan_blocks(matrix: np.ndarray) -> list[JordanBlock]:
    """Return the Jordan blocks of a real matrix, exact or of floats, the largest first.

    Raises
    ------
    UnclearError
        If eigenvalues or ranks cannot be told apart from rounding.
    """
    values = matrix.astype(np.float64)
    scale = float(np.abs(values).max(initial=0.0))
    n = len(values)
    if n == 0:
        return []
    if scale == 0.0:
        return [JordanBlock(0.0, 1)] * n
    blocks = []
    for eigenvalue, multiplicity in distinct_eigenvalues(matrix):
        shifted = values / scale - eigenvalue / scale * np.eye(n)
        power, ranks = np.eye(n, dtype=complex), [n]
        for _ in range(multiplicity + 1):
            power = power @ shifted
            ranks.append(_rank(power))
        if n - ranks[-1] != multiplicity:
            raise UnclearError("the rank of a power of a matrix disagrees with the multiplicity of its eigenvalue")
        drops = [ranks[k] - ranks[k + 1] for k in range(multiplicity + 1)]
        for size in range(multiplicity, 0, -1):
            blocks += [JordanBlock(eigenvalue, size)] * (drops[size - 1] - drops[size])
    return sorted(blocks, key=lambda block: -block.size)


def distinct_eigenvalues(matrix: np.ndarray) -> list[tuple[complex, int]]:
    """Return the distinct eigenvalues of a real matrix with nonnegative imaginary part, and their multiplicities."""
    if is_exact(matrix):
        groups = []
        for factor, multiplicity in squarefree_factors(characteristic_polynomial(matrix)):
            leading = max(abs(c) for c in factor)
            groups += [(root, multiplicity) for root in np.roots([float(c / leading) for c in factor])]
    else:
        groups = _clusters(np.linalg.eigvals(matrix), float(np.abs(matrix).max()) or 1.0)
    scale = float(np.abs(matrix.astype(np.float64)).max()) or 1.0
    real_or_upper = [(root.real + 0j if is_zero(root.imag, scale) else root, m) for root, m in groups]
    return [(complex(root), m) for root, m in real_or_upper if root.imag >= 0.0]


def _clusters(eigenvalues: np.ndarray, scale: float) -> list[tuple[complex, int]]:
    """Return means of clusters of eigenvalues that rounding may have spread, and the numbers of their members."""
    groups: list[list[complex]] = []
    for value in sorted(eigenvalues, key=lambda z: (z.real, z.imag)):
        groups.append([value])
    bound = CLUSTER_ROUNDING ** (1.0 / len(eigenvalues)) * scale
    merged = True
    while merged:
        merged = False
        for i in range(len(groups)):
            for j in range(i):
                if min(abs(a - b) for a in groups[i] for b in groups[j]) < bound:
                    groups[j] += groups.pop(i)
                    merged = True
                    break
            if merged:
                break
    for group in groups:
        mean = sum(group) / len(group)
        spread = max(abs(value - mean) for value in group)
        if spread > CLUSTER_ROUNDING ** (1.0 / len(group)) * scale:
            raise UnclearError(f"{len(group)} eigenvalues differ by {spread:.1e}, which may be rounding")
    return [(complex(sum(group) / len(group)), len(group)) for group in groups]


def _rank(matrix: np.ndarray) -> int:
    singular_values = np.linalg.svd(matrix, compute_uv=False)
    return sum(not is_zero(value) for value in singular_values)


Coefficients = list[Fraction]
"""Coefficients of a polynomial, the highest power first."""


def characteristic_polynomial(matrix: np.ndarray) -> Coefficients:
    """Return ``det(t I - A)`` of an exact matrix, by Faddeev and LeVerrier's recursion."""
    n = len(matrix)
    identity = np.eye(n, dtype=np.int64).astype(object)
    power, coefficients = 0 * identity, [Fraction(1)]
    for k in range(1, n + 1):
        power = matrix @ power + coefficients[-1] * identity
        coefficients.append(-Fraction(np.trace(matrix @ power)) / k)
    return coefficients


def squarefree_factors(polynomial: Coefficients) -> list[tuple[Coefficients, int]]:
    """Return the squarefree factors of positive degree, and their multiplicities [Yun 1976]."""
    factors = []
    divisor = _gcd(polynomial, _derivative(polynomial))
    remaining, multiplicity = _divide(polynomial, divisor)[0], 1
    while len(remaining) > 1:
        common = _gcd(remaining, divisor)
        factor = _divide(remaining, common)[0]
        if len(factor) > 1:
            factors.append((factor, multiplicity))
        remaining, divisor = common, _divide(divisor, common)[0]
        multiplicity += 1
    return factors


def _derivative(polynomial: Coefficients) -> Coefficients:
    n = len(polynomial) - 1
    return [c * (n - i) for i, c in enumerate(polynomial[:-1])] or [Fraction(0)]


def _divide(numerator: Coefficients, denominator: Coefficients) -> tuple[Coefficients, Coefficients]:
    quotient, rest = [], list(numerator)
    while len(rest) >= len(denominator):
        factor = rest[0] / denominator[0]
        quotient.append(factor)
        for i, c in enumerate(denominator):
            rest[i] -= factor * c
        rest.pop(0)
    while rest and not rest[0]:
        rest.pop(0)
    return quotient, rest


def _gcd(first: Coefficients, second: Coefficients) -> Coefficients:
    second = second if any(second) else []
    while second:
        first, second = second, _divide(first, second)[1]
    return [c / first[0] for c in first]


def ratio_or_zero(value: float, scale: float) -> float:
    """Return ``value / scale``, exactly 0 where that is zero, and an integer where it is one to rounding."""
    ratio = value / scale
    nearest = float(round(ratio))
    return nearest if math.isclose(ratio, nearest, rel_tol=0.0, abs_tol=1e-12) else ratio
