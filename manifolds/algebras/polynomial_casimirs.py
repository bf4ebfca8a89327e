"""Polynomial Casimirs by linear algebra: their number, and all Casimirs of a degree."""

from __future__ import annotations

import math
from collections.abc import Iterator
from fractions import Fraction
from functools import lru_cache
from itertools import combinations_with_replacement

import numpy as np
import scipy

from ..errors import JacobiError, LieAlgebraError
from ._subspaces import (
    large_prime,
    numerical_null_space,
    numerical_rank,
    rational_null_space,
    reduce_modulo,
    row_echelon,
)
from .polynomial import Polynomial
from .structure import AlgebraStructure

MAX_MONOMIAL_COUNT = 20000
"""Largest number of monomials of a degree whose conditions are solved: up to a minute of linear algebra."""

MAX_BLOCK_SIZE = 2000
"""Largest number of monomials that the conditions may couple: up to a minute of linear algebra.

In the bases of the catalogue the blocks are small (su(4), degree 4: 3060 monomials in blocks of 252 at most); in a
random basis all monomials form one block.
"""


@lru_cache(maxsize=256)
def casimir_count(g: AlgebraStructure) -> int:
    """Return the number of independent Casimir functions near a generic point of g*; they need not be polynomials.

    It is dim minus the generic rank of the Lie-Poisson tensor ``Pi(mu)[b, a] = sum_c C[a, b, c] mu_c``, taken as the
    largest rank at three random points. Where the constants can be made rational each of the three is the rank modulo
    another prime: never too large, and too small with a probability of about ``dim / 2**31``.

    Raises
    ------
    LieAlgebraError
        If the constants cannot be made rational and the singular values show no clear gap.
    """
    random = np.random.default_rng(0)
    fractions = _rationally_scaled_algebra(g)[0].rational_constants
    ranks = []
    for draw in range(3):
        if fractions is None:
            tensor = g._balanced_constants_and_factors[0] @ random.standard_normal(g.dim)
            ranks.append(numerical_rank(np.linalg.svd(tensor, compute_uv=False), 1.0, g.name))
        else:
            p = large_prime(draw)
            tensor = (fractions.numerator * random.integers(1, p, g.dim) % p).sum(axis=2)
            ranks.append(len(row_echelon(tensor, p)[1]))
    return g.dim - max(ranks)


@lru_cache(maxsize=256)
def new_casimirs(g: AlgebraStructure, degree: int) -> tuple[Polynomial, ...]:
    """Return the homogeneous polynomial Casimirs of this degree, modulo products of Casimirs of lower degree."""
    if casimir_count(g) == 0:
        return ()
    scaled_algebra, squares = _rationally_scaled_algebra(g)
    if g.rational_constants is None and scaled_algebra.rational_constants is not None:
        return tuple(_from_root_scaled_basis(F, squares) for F in new_casimirs(scaled_algebra, degree))
    if g.rational_constants is None and (scaled_algebra := _balanced_algebra(g)) != g:
        return tuple(
            _from_scaled_basis(F, g._balanced_constants_and_factors[1]) for F in new_casimirs(scaled_algebra, degree)
        )
    invariants = _homogeneous_casimirs(g, degree)
    lower_casimirs = [F for d in range(1, degree) for F in new_casimirs(g, d)]
    products = [dict(F.terms) for F in _products_of_degree(lower_casimirs, degree)]
    # The invariants are in reduced echelon form, so the coordinates of a product are its coefficients at their
    # leading monomials, up to the scale of each; and an invariant vanishes at the leading monomials of the others.
    leading_monomials = [F.terms[0][0] for F in invariants]
    coordinates = np.array([[terms.get(m, Fraction(0)) for m in leading_monomials] for terms in products], dtype=object)
    tolerance = 0 if g.rational_constants is not None else 1e-8
    _, decomposable = row_echelon(coordinates.reshape(len(products), len(leading_monomials)), tolerance=tolerance)
    return tuple(F for i, F in enumerate(invariants) if i not in decomposable)


def _products_of_degree(factors: list[Polynomial], degree: int) -> Iterator[Polynomial]:
    """Yield all products of total degree ``degree`` of one or more of the factors."""
    for i, F in enumerate(factors):
        if F.degree == degree:
            yield F
        elif F.degree < degree:
            yield from (F * cofactor for cofactor in _products_of_degree(factors[i:], degree - F.degree))


def _homogeneous_casimirs(g: AlgebraStructure, degree: int) -> list[Polynomial]:
    """Return the reduced row echelon basis of all homogeneous Casimirs of this degree, leading monomials first."""
    n_monomials = math.comb(g.dim + degree - 1, degree)
    _check_size(n_monomials, MAX_MONOMIAL_COUNT, f"{g.name} has {n_monomials} monomials of degree {degree}")
    fractions = g.rational_constants
    if fractions is None:
        constants = g.structure_constants / np.abs(g.structure_constants).max()
        generators = _generating_basis_indices(constants, tolerance=1e-8)
    else:
        constants = fractions.numerator
        generators = _generating_basis_indices(constants, large_prime(0))
    factors, conditions = _invariance_conditions(constants[:, generators], degree)
    exponents = (factors[:, :, None] == np.arange(g.dim)).sum(axis=1)
    invariants = []
    for columns in _coupled_column_groups(conditions):
        size_text = f"this basis of {g.name} couples {len(columns)} monomials of degree {degree}"
        _check_size(len(columns), MAX_BLOCK_SIZE, size_text)
        block = conditions[:, columns].tocsr()
        block = block[np.flatnonzero(np.diff(block.indptr))].toarray()
        vectors = numerical_null_space(block, g.name) if fractions is None else rational_null_space(block)
        invariants += [Polynomial(exponents[columns], vector) for vector in vectors]
    return sorted(invariants, key=lambda F: F.terms[0][0], reverse=True)


def _check_size(size: int, limit: int, label: str) -> None:
    if size > limit:
        raise TooLargeError(
            f"{label}, more than the {limit} that the search for Casimirs allows, and no traces of powers of matrices "
            "are known to generate them all. Use a lower degree, or build a reductive algebra from matrices"
        )


class TooLargeError(LieAlgebraError):
    """Raised when a degree has more monomials than the search for Casimirs allows."""


def _invariance_conditions(constants: np.ndarray, degree: int) -> tuple[np.ndarray, scipy.sparse.csc_array]:
    """Return the monomials of a degree, and the sparse matrix of the conditions that make them Casimirs.

    Returns the monomials as their sorted factors, shape (n, degree), in lexicographic order, and a sparse
    (b * n, n) array.
    """
    dim, n_maps, _ = constants.shape
    factors = np.array(list(combinations_with_replacement(range(dim), degree)))
    # How many monomials agree with m before its k-th factor i and have a later one there, by k and i.
    top = dim + degree - 2
    n_later = np.array([[math.comb(top - k - i, degree - k) for i in range(dim)] for k in range(degree)])
    a, b, c = np.nonzero(constants)
    rows, columns, values = [], [], []
    for k in range(degree):  # Leibniz: replace the k-th factor mu_a by sum_c C[a, b, c] mu_c
        entry, column = np.nonzero(a[:, None] == factors[:, k])
        image = factors[column]
        image[:, k] = c[entry]
        image.sort(axis=1)
        index = len(factors) - 1 - n_later[np.arange(degree), image].sum(axis=1)
        rows.append(b[entry] * len(factors) + index)
        columns.append(column)
        values.append(constants[a, b, c][entry])
    coordinates = np.concatenate(rows), np.concatenate(columns)
    shape = (n_maps * len(factors), len(factors))
    conditions = scipy.sparse.csc_array(scipy.sparse.coo_array((np.concatenate(values), coordinates), shape=shape))
    conditions.eliminate_zeros()
    return factors, conditions


def _coupled_column_groups(conditions: scipy.sparse.csc_array) -> list[np.ndarray]:
    """Partition the columns into groups that no condition couples: weight spaces, parities and the like."""
    pattern = conditions.astype(bool).astype(np.int64)
    _, block_of = scipy.sparse.csgraph.connected_components(pattern.T @ pattern, directed=False)
    return np.split(np.argsort(block_of, kind="stable"), np.cumsum(np.bincount(block_of))[:-1])


def _generating_basis_indices(constants: np.ndarray, modulus: int = 0, tolerance: float = 0) -> list[int]:
    """Return indices of basis elements that generate the algebra by brackets, chosen greedily in order.

    The span of the brackets is never overestimated: modulo a prime a rank is at most the rank over Q.
    """
    dim = len(constants)
    ad, units = reduce_modulo(constants, modulus), np.eye(dim, dtype=constants.dtype)
    span, generators = units[:0], []
    for e in range(dim):
        extended_span, _ = row_echelon(np.vstack([span, units[e]]), modulus, tolerance)
        if len(extended_span) > len(span):
            generators.append(e)
        while len(extended_span) > len(span):
            span = extended_span
            brackets = [reduce_modulo(span[:, :, None] * ad[x], modulus).sum(axis=1) for x in generators]
            extended_span, _ = row_echelon(np.vstack([span, *brackets]), modulus, tolerance)
    return generators


# -- scaling ------------------------------------------------------------------------------------------------------


@lru_cache(maxsize=256)
def _rationally_scaled_algebra(g: AlgebraStructure) -> tuple[AlgebraStructure, tuple[int, ...]]:
    """Return g in a basis ``sqrt(r_a) e_a`` with rational constants, and the integers r_a; else g and ones.

    The constants become ``C[a, b, c] sqrt(r_a r_b / r_c)``, hence ``C**2 r_a r_b r_c`` must be a square wherever C is
    not zero: for each prime a linear system modulo 2. For su(n) there is such a basis.
    """
    identity_scaling = g, (1,) * g.dim
    if g.rational_constants is not None:
        return identity_scaling
    entries = list(zip(*np.nonzero(g.structure_constants), strict=True))
    values = [float(g.structure_constants[entry]) for entry in entries]
    squares = [Fraction(v * v).limit_denominator(1000) for v in values]
    are_square_roots = all(abs(s - v * v) < 4e-15 * s for v, s in zip(values, squares, strict=True))
    if not are_square_roots or max(squares) > 10**6:
        return identity_scaling
    odd_primes = {
        s: _primes_of_odd_exponent(s.numerator) ^ _primes_of_odd_exponent(s.denominator) for s in set(squares)
    }
    primes = sorted(set().union(*odd_primes.values()))
    unknowns = np.eye(g.dim, dtype=np.int64)[np.array(entries)].sum(axis=1)
    knowns = np.array([[p in odd_primes[s] for p in primes] for s in squares], dtype=np.int64)
    echelon, pivots = row_echelon(np.hstack([unknowns, knowns]), 2)
    if pivots[-1] >= g.dim:
        return identity_scaling
    r = [1] * g.dim
    for row, pivot in zip(echelon, pivots, strict=True):
        r[pivot] = math.prod(p for p, exponent in zip(primes, row[g.dim :], strict=True) if exponent)
    constants = np.full(g.structure_constants.shape, Fraction(0))
    for (a, b, c), v, s in zip(entries, values, squares, strict=True):
        square = s * r[a] * r[b] / r[c]
        root = Fraction(math.isqrt(square.numerator), math.isqrt(square.denominator))
        constants[a, b, c] = root if v > 0 else -root
    try:
        return type(g).from_structure_constants(constants, g.name), tuple(r)
    except JacobiError:  # fractions that were close to the constants by chance
        return identity_scaling


@lru_cache(maxsize=256)
def _balanced_algebra(g: AlgebraStructure) -> AlgebraStructure:
    """Return the algebra in the basis ``factors[a] e_a`` with balanced constants; g itself if they are balanced
    already."""
    constants, factors = g._balanced_constants_and_factors
    if np.abs(np.log(factors)).max() < 1e-12:
        return g
    try:
        return type(g).from_structure_constants(constants, g.name)
    except JacobiError:  # the axiom holds only to rounding of the largest constants
        return g


def _primes_of_odd_exponent(n: int) -> set[int]:
    """Return the primes of odd exponent in n."""
    odd_primes: set[int] = set()
    p = 2
    while n > 1:
        if p * p > n:
            p = n
        while n % p == 0:
            n, odd_primes = n // p, odd_primes ^ {p}
        p += 1
    return odd_primes


def _from_root_scaled_basis(F: Polynomial, radicands: tuple[int, ...]) -> Polynomial:
    """Transform F from the basis ``sqrt(r_a) e_a`` to the basis e_a, with leading coefficient 1."""
    weights = []
    for power, c in F.terms:
        scale: int = math.prod(r**e for r, e in zip(radicands, power, strict=True))
        weights.append(Fraction(c) * abs(Fraction(c)) * scale)
    roots = [math.copysign(math.sqrt(abs(w / weights[0])), w) for w in weights]
    return Polynomial(F.exponents, roots)


def _from_scaled_basis(F: Polynomial, factors: np.ndarray) -> Polynomial:
    """Transform F from the basis ``factors[a] e_a`` to the basis e_a, with leading coefficient 1."""
    logarithms = F.exponents @ np.log(factors)
    weights = np.exp(logarithms - logarithms[0]) / float(F.coefficients[0])
    return Polynomial(F.exponents, (np.array(F.coefficients, dtype=float) * weights).tolist())
