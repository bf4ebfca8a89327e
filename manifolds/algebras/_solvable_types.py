"""Names and parameters of indecomposable solvable algebras of dimension 3 to 5, by their nilradical.

The Jordan blocks of its action are found with exact multiplicities for rational matrices, and refused where unclear.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from fractions import Fraction
from typing import NamedTuple

import numpy as np

from ..errors import LieAlgebraError
from ._subspaces import brackets_of_rows, complement, coordinates, intersection, is_exact, null_space, row_space
from .substructure import WorkingConstants, centralizer

ZERO_TOLERANCE = 1e-9
"""Relative sizes below this count as zero: rounding of a few eigenvalues, amplified by a basis of condition 1e4."""

NONZERO_TOLERANCE = 1e-7
"""Relative sizes above this count as nonzero; between the two a number is unclear."""

CLUSTER_ROUNDING = 1e-12
"""Rounding of a matrix of size 1, whose k-th root bounds the spread of the k values of a defective eigenvalue."""


class AmbiguousRoundingError(LieAlgebraError):
    """Raised when rounding does not allow a decision about a rank or an eigenvalue."""


class JordanBlock(NamedTuple):
    """A Jordan block of a real matrix; the eigenvalue with positive imaginary part stands for a complex pair."""

    eigenvalue: complex
    size: int

    @property
    def is_complex(self) -> bool:
        return self.eigenvalue.imag > 0.0


def is_zero(value: float, scale: float = 1.0) -> bool:
    """Return True if a number is zero relative to a scale; raise AmbiguousRoundingError if rounding does not tell."""
    size = abs(value) / scale
    if ZERO_TOLERANCE < size < NONZERO_TOLERANCE:
        raise AmbiguousRoundingError(f"a value of relative size {size:.1e} may be zero or a rounding error")
    return size <= ZERO_TOLERANCE


def jordan_blocks(matrix: np.ndarray) -> list[JordanBlock]:
    """Return the Jordan blocks of a real matrix, exact or of floats, the largest first.

    Raises
    ------
    AmbiguousRoundingError
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
    for eigenvalue, multiplicity in upper_eigenvalues_and_multiplicities(matrix):
        shifted_matrix = values / scale - eigenvalue / scale * np.eye(n)
        power, ranks = np.eye(n, dtype=complex), [n]
        for _ in range(multiplicity + 1):
            power = power @ shifted_matrix
            ranks.append(_numerical_rank(power))
        if n - ranks[-1] != multiplicity:
            raise AmbiguousRoundingError(
                "the rank of a power of a matrix disagrees with the multiplicity of its eigenvalue"
            )
        drops = [ranks[k] - ranks[k + 1] for k in range(multiplicity + 1)]
        for size in range(multiplicity, 0, -1):
            blocks += [JordanBlock(eigenvalue, size)] * (drops[size - 1] - drops[size])
    return sorted(blocks, key=lambda block: -block.size)


def upper_eigenvalues_and_multiplicities(matrix: np.ndarray) -> list[tuple[complex, int]]:
    """Return the distinct eigenvalues of a real matrix with nonnegative imaginary part, and their multiplicities."""
    if is_exact(matrix):
        groups = []
        for factor, multiplicity in squarefree_factors(characteristic_polynomial(matrix)):
            leading = max(abs(c) for c in factor)
            groups += [(root, multiplicity) for root in np.roots([float(c / leading) for c in factor])]
    else:
        groups = _cluster_eigenvalues(np.linalg.eigvals(matrix), float(np.abs(matrix).max()) or 1.0)
    scale = float(np.abs(matrix.astype(np.float64)).max()) or 1.0
    real_or_upper = [(root.real + 0j if is_zero(root.imag, scale) else root, m) for root, m in groups]
    return [(complex(root), m) for root, m in real_or_upper if root.imag >= 0.0]


def _cluster_eigenvalues(eigenvalues: np.ndarray, scale: float) -> list[tuple[complex, int]]:
    """Return means of clusters of eigenvalues that rounding may have spread, and the numbers of their members."""
    groups: list[list[complex]] = []
    for value in sorted(eigenvalues, key=lambda z: (z.real, z.imag)):
        groups.append([value])
    max_distance = CLUSTER_ROUNDING ** (1.0 / len(eigenvalues)) * scale
    has_merged = True
    while has_merged:
        has_merged = False
        for i in range(len(groups)):
            for j in range(i):
                if min(abs(a - b) for a in groups[i] for b in groups[j]) < max_distance:
                    groups[j] += groups.pop(i)
                    has_merged = True
                    break
            if has_merged:
                break
    for group in groups:
        mean = sum(group) / len(group)
        max_deviation = max(abs(value - mean) for value in group)
        if max_deviation > CLUSTER_ROUNDING ** (1.0 / len(group)) * scale:
            raise AmbiguousRoundingError(
                f"{len(group)} eigenvalues differ by {max_deviation:.1e}, which may be rounding"
            )
    return [(complex(sum(group) / len(group)), len(group)) for group in groups]


def _numerical_rank(matrix: np.ndarray) -> int:
    """Return the number of singular values that are not zero; raise AmbiguousRoundingError if one is in the gap."""
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
    divisor = _polynomial_gcd(polynomial, _polynomial_derivative(polynomial))
    remaining, multiplicity = _polynomial_divide(polynomial, divisor)[0], 1
    while len(remaining) > 1:
        common_divisor = _polynomial_gcd(remaining, divisor)
        factor = _polynomial_divide(remaining, common_divisor)[0]
        if len(factor) > 1:
            factors.append((factor, multiplicity))
        remaining, divisor = common_divisor, _polynomial_divide(divisor, common_divisor)[0]
        multiplicity += 1
    return factors


def _polynomial_derivative(polynomial: Coefficients) -> Coefficients:
    """Return the coefficients of the derivative of a polynomial."""
    n = len(polynomial) - 1
    return [c * (n - i) for i, c in enumerate(polynomial[:-1])] or [Fraction(0)]


def _polynomial_divide(numerator: Coefficients, denominator: Coefficients) -> tuple[Coefficients, Coefficients]:
    """Return the quotient and the remainder of two polynomials."""
    quotient, remainder = [], list(numerator)
    while len(remainder) >= len(denominator):
        factor = remainder[0] / denominator[0]
        quotient.append(factor)
        for i, c in enumerate(denominator):
            remainder[i] -= factor * c
        remainder.pop(0)
    while remainder and not remainder[0]:
        remainder.pop(0)
    return quotient, remainder


def _polynomial_gcd(p: Coefficients, q: Coefficients) -> Coefficients:
    """Return the greatest common divisor of two polynomials, with leading coefficient 1."""
    q = q if any(q) else []
    while q:
        p, q = q, _polynomial_divide(p, q)[1]
    return [c / p[0] for c in p]


def snapped_ratio(value: float, scale: float) -> float:
    """Return ``value / scale``, replaced by the nearest integer, such as 0, if it equals that to 1e-12."""
    ratio = value / scale
    nearest = float(round(ratio))
    return nearest if math.isclose(ratio, nearest, rel_tol=0.0, abs_tol=1e-12) else ratio


Summand = tuple[str, tuple[tuple[str, float], ...]]
"""Name of an algebra of the list, and the values of its parameters."""


def solvable_type(work: WorkingConstants, nilradical: np.ndarray) -> Summand:
    """Return the type of an indecomposable solvable algebra that is not nilpotent."""
    complement_rows = complement(nilradical, work.full_space_rows, work.name)
    derived_ideal = work.span_of_brackets(nilradical, nilradical)
    if len(complement_rows) == 1:
        if not len(derived_ideal):
            return _type_of_line_acting_on_abelian(
                jordan_blocks(_ad_matrix_on_quotient(work, complement_rows[0], nilradical, derived_ideal))
            )
        if work.dim == 4:
            return _type_of_line_acting_on_heisenberg(
                jordan_blocks(_ad_matrix_on_quotient(work, complement_rows[0], nilradical, derived_ideal))
            )
        if len(derived_ideal) == 2:
            return _type_of_line_acting_on_engel(work, nilradical, derived_ideal, complement_rows[0])
        return _type_of_line_acting_on_heisenberg_plus_line(work, nilradical, derived_ideal, complement_rows[0])
    if len(complement_rows) == 2 and work.dim == 4:
        return ("A4,12", ())
    if len(complement_rows) == 2 and work.dim == 5:
        matrices = [
            _ad_matrix_on_quotient(work, x, nilradical, derived_ideal).astype(np.float64) for x in complement_rows
        ]
        return _type_by_generic_combination(
            matrices, _type_of_plane_acting_on_heisenberg if len(derived_ideal) else _type_of_plane_acting_on_abelian
        )
    raise LieAlgebraError(f"{work.name} has a solvable summand with a nilradical of dimension {len(nilradical)}")


def _ad_matrix_on_quotient(
    work: WorkingConstants, x: np.ndarray, ideal: np.ndarray, smaller_ideal: np.ndarray
) -> np.ndarray:
    """Return the matrix, rows being images, of ``y -> [y, x]`` on an ideal modulo a smaller ideal."""
    representatives = complement(smaller_ideal, ideal, work.name)
    images = brackets_of_rows(representatives, x[None], work.constants)[:, 0]
    basis = np.vstack([representatives, row_space(smaller_ideal, work.name)])
    return coordinates(basis, images)[:, : len(representatives)]


def _make_summand(name: str, **parameters: float) -> Summand:
    """Return the name of an algebra of the list with its parameters as floats."""
    return (name, tuple((key, float(value)) for key, value in parameters.items()))


def _block_sizes(blocks: list[JordanBlock]) -> tuple[int, ...]:
    """Return the sizes of Jordan blocks in descending order."""
    return tuple(sorted((block.size for block in blocks), reverse=True))


def _max_abs_eigenvalue(blocks: list[JordanBlock]) -> float:
    """Return the largest absolute value of the eigenvalues of Jordan blocks."""
    return max(abs(block.eigenvalue) for block in blocks)


def _canonical_ratios_to_largest(values: list[float]) -> tuple[float, ...]:
    """Return real values divided by one of largest size, without it: the descending list that is largest."""
    top = max(map(abs, values))
    candidates = []
    for i, value in enumerate(values):
        if abs(value) > top * (1.0 - 1e-9):
            ratios = [snapped_ratio(other, value) for j, other in enumerate(values) if j != i]
            candidates.append(tuple(sorted(ratios, reverse=True)))
    return max(candidates)


# -- an abelian nilradical of codimension one --------------------------------------------------------------------


def _type_of_line_acting_on_abelian(blocks: list[JordanBlock]) -> Summand:
    """Return the type of an algebra whose element outside an abelian nilradical acts with these Jordan blocks."""
    real = [block for block in blocks if not block.is_complex]
    pairs = [block for block in blocks if block.is_complex]
    if pairs and not real:
        return _type_of_rotations(pairs)
    if pairs:
        return _type_of_rotation_and_real_blocks(pairs[0], real)
    scale = _max_abs_eigenvalue(blocks)
    values = [block.eigenvalue.real for block in real]
    sizes = tuple(block.size for block in real)
    if set(sizes) == {1}:
        return _type_of_diagonal_action(_canonical_ratios_to_largest(values))
    head = values[0]
    if len(values) == 1:
        return ({2: "A3,2", 3: "A4,4", 4: "A5,12"}[sizes[0]], ())
    if sizes == (2, 2):
        return _make_summand("A5,15", a=_canonical_ratios_to_largest(values)[0])
    if is_zero(head, scale):
        if sizes == (2, 1, 1):
            return _make_summand("A5,8", c=_canonical_ratios_to_largest(values[1:])[0])
        return ({2: "A4,3", 3: "A5,10"}[sizes[0]], ())
    ratios = sorted((snapped_ratio(value, head) for value in values[1:]), reverse=True)
    if sizes == (2, 1):
        return _make_summand("A4,2", a=ratios[0])
    if sizes == (3, 1):
        return _make_summand("A5,11", c=ratios[0])
    return _make_summand("A5,9", b=ratios[0], c=ratios[1])


def _type_of_diagonal_action(ratios: tuple[float, ...]) -> Summand:
    """Return the type for a diagonal action on an abelian nilradical, from the ratios of its eigenvalues."""
    if len(ratios) == 1:
        if is_zero(ratios[0] - 1.0):
            return ("A3,3", ())
        return ("A3,4", ()) if is_zero(ratios[0] + 1.0) else _make_summand("A3,5", a=ratios[0])
    names = "ab" if len(ratios) == 2 else "abc"
    return _make_summand("A4,5" if len(ratios) == 2 else "A5,7", **dict(zip(names, ratios, strict=True)))


def _type_of_rotation_and_real_blocks(pair: JordanBlock, real: list[JordanBlock]) -> Summand:
    """Return the type for an action on an abelian nilradical with one complex pair and one or two real eigenvalues."""
    re, im = pair.eigenvalue.real, pair.eigenvalue.imag
    values = [block.eigenvalue.real for block in real]
    if len(values) == 1 and real[0].size == 1:
        candidates = [(snapped_ratio(re, sign * im), snapped_ratio(values[0], sign * im)) for sign in (1, -1)]
        b, a = max(candidates)
        return _make_summand("A4,6", a=a, b=b)
    if len(values) == 1:
        scale = max(abs(pair.eigenvalue), abs(values[0]))
        if is_zero(values[0], scale):
            return _make_summand("A5,14", p=abs(snapped_ratio(re, im)))
        return _make_summand("A5,16", p=snapped_ratio(re, values[0]), s=abs(snapped_ratio(im, values[0])))
    candidates_13 = []
    for value, other in (values, values[::-1]):
        if abs(value) > abs(other) * (1.0 - 1e-9):
            candidates_13.append((snapped_ratio(other, value), snapped_ratio(re, value), abs(snapped_ratio(im, value))))
    a, p, s = max(candidates_13)
    return _make_summand("A5,13", a=a, p=p, s=s)


def _type_of_rotations(pairs: list[JordanBlock]) -> Summand:
    """Return the type for an action on an abelian nilradical whose eigenvalues are complex pairs only."""
    if len(pairs) == 1 and pairs[0].size == 2:
        return _make_summand("A5,18", p=abs(snapped_ratio(pairs[0].eigenvalue.real, pairs[0].eigenvalue.imag)))
    if len(pairs) == 1:
        p = abs(snapped_ratio(pairs[0].eigenvalue.real, pairs[0].eigenvalue.imag))
        return ("A3,6", ()) if is_zero(p) else _make_summand("A3,7", a=p)
    candidates = []
    for pair_1, pair_2 in (pairs, pairs[::-1]):
        z, w = pair_1.eigenvalue, pair_2.eigenvalue
        if z.imag > w.imag * (1.0 - 1e-9):
            for sign in (1, -1):
                scale = sign * z.imag
                candidates.append(
                    (snapped_ratio(z.real, scale), snapped_ratio(w.real, scale), snapped_ratio(w.imag, z.imag))
                )
    p, q, s = max(candidates)
    return _make_summand("A5,17", p=p, q=q, s=s)


# -- a Heisenberg nilradical, or one of its sums with a line ----------------------------------------------------


def _type_of_line_acting_on_heisenberg(blocks: list[JordanBlock]) -> Summand:
    """Return one of A4,7 to A4,11, from the Jordan blocks of an action on the Heisenberg algebra modulo its centre."""
    if blocks[0].size == 2:
        return ("A4,7", ())
    if blocks[0].is_complex:
        a = abs(snapped_ratio(blocks[0].eigenvalue.real, blocks[0].eigenvalue.imag))
        return ("A4,10", ()) if is_zero(a) else _make_summand("A4,11", a=a)
    b = _canonical_ratios_to_largest([block.eigenvalue.real for block in blocks])[0]
    return ("A4,8", ()) if is_zero(b + 1.0) else _make_summand("A4,9", b=b)


def _type_of_line_acting_on_heisenberg_plus_line(
    work: WorkingConstants, nilradical, derived_ideal, x: np.ndarray
) -> Summand:
    """Return one of A5,19 to A5,29, where x acts on ``nilradical``, the sum of a Heisenberg algebra and a line."""
    inner_centre = row_space(_centre_of_ideal(work, nilradical), work.name)
    plane = jordan_blocks(_ad_matrix_on_quotient(work, x, nilradical, inner_centre))
    with_line = jordan_blocks(_ad_matrix_on_quotient(work, x, nilradical, derived_ideal))
    centre_blocks = jordan_blocks(_ad_matrix_on_quotient(work, x, inner_centre, derived_ideal[:0]))
    line = float(_ad_matrix_on_quotient(work, x, inner_centre, derived_ideal)[0, 0])
    trace = float(_ad_matrix_on_quotient(work, x, derived_ideal, derived_ideal[:0])[0, 0])
    line_moves_centre = centre_blocks[0].size == 2
    plane_moves_line = len(with_line) < len(plane) + 1
    if plane[0].is_complex:
        z = plane[0].eigenvalue
        p, b = max((snapped_ratio(z.real, sign * z.imag), snapped_ratio(line, sign * z.imag)) for sign in (1, -1))
        return _make_summand("A5,26", p=p, eps=1) if line_moves_centre else _make_summand("A5,25", b=b, p=p)
    scale = max(_max_abs_eigenvalue(plane), abs(line))
    if plane[0].size == 2:
        value = plane[0].eigenvalue.real
        if is_zero(value, scale):
            return ("A5,22", ())
        if plane_moves_line:
            return ("A5,21", ())
        return (
            _make_summand("A5,24", eps=1) if line_moves_centre else _make_summand("A5,23", b=snapped_ratio(line, value))
        )
    if plane_moves_line:
        if is_zero(line, scale):
            return ("A5,29", ())
        return ("A5,27", ()) if line_moves_centre else _make_summand("A5,28", a=snapped_ratio(trace, line))
    values = [block.eigenvalue.real for block in plane]
    top = max(map(abs, values))
    candidates = [
        (snapped_ratio(trace, value), snapped_ratio(line, value)) for value in values if abs(value) > top * (1.0 - 1e-9)
    ]
    a, b = max(candidates)
    return _make_summand("A5,20", a=a) if line_moves_centre else _make_summand("A5,19", a=a, b=b)


def _centre_of_ideal(work: WorkingConstants, ideal: np.ndarray) -> np.ndarray:
    """Return rows that span the centre of an ideal."""
    from_inside = brackets_of_rows(ideal, ideal, work.constants).reshape(len(ideal), -1)
    return null_space(from_inside.T, work.name) @ ideal


# -- the nilradical A4,1 ---------------------------------------------------------------------------------------------


def _type_of_line_acting_on_engel(work: WorkingConstants, nilradical, derived_ideal, x: np.ndarray) -> Summand:
    """Return one of A5,30 to A5,32, where x acts on ``nilradical``, which is of type A4,1."""
    commutant = centralizer(work, derived_ideal)
    rows = intersection(commutant, nilradical, work.name)
    outer_action = float(_ad_matrix_on_quotient(work, x, nilradical, rows)[0, 0])
    inner_action = float(_ad_matrix_on_quotient(work, x, rows, derived_ideal)[0, 0])
    blocks = jordan_blocks(_ad_matrix_on_quotient(work, x, nilradical, derived_ideal))
    if not is_zero(outer_action, max(abs(outer_action), abs(inner_action))):
        if blocks[0].size == 2:
            return ("A5,31", ())
        return _make_summand("A5,30", a=snapped_ratio(inner_action, outer_action) + 1.0)
    motion = _ad_matrix_on_quotient(work, x, rows, derived_ideal[:0]).astype(np.float64) / inner_action
    shift = _ad_matrix_on_quotient(work, complement(rows, nilradical, work.name)[0], rows, derived_ideal[:0]).astype(
        np.float64
    )
    shift = shift / np.linalg.norm(shift @ shift) ** 0.5
    square = shift @ shift
    design = np.stack([shift.ravel(), square.ravel()], axis=1)
    weights, *_ = np.linalg.lstsq(design, (motion - np.eye(3)).ravel(), rcond=None)
    return _make_summand(
        "A5,32", a=0.0 if is_zero(weights[1], max(1.0, float(np.abs(motion).max()))) else np.sign(weights[1])
    )


# -- an abelian nilradical of codimension two --------------------------------------------------------------------


GENERIC_ANGLES = (0.61, 1.93, 2.71, 1.17)
"""Angles of the combinations of two matrices that are tried until all decisions are clear."""


def _type_by_generic_combination(
    matrices: list[np.ndarray], recognise: Callable[[list[np.ndarray], np.ndarray], Summand]
) -> Summand:
    """Return the type that a function finds from two matrices and a generic combination of them."""
    matrix_1, matrix_2 = (matrix / (np.abs(matrix).max() or 1.0) for matrix in matrices)
    reasons = []
    for angle in GENERIC_ANGLES:
        try:
            return recognise([matrix_1, matrix_2], np.cos(angle) * matrix_1 + np.sin(angle) * matrix_2)
        except AmbiguousRoundingError as error:
            reasons.append(error)
    raise reasons[0]


def _type_of_plane_acting_on_heisenberg(matrices: list[np.ndarray], generic: np.ndarray) -> Summand:
    """Return A5,36 or A5,37: a generic element acts on the nilradical with real or with complex eigenvalues."""
    return ("A5,37" if any(block.is_complex for block in jordan_blocks(generic)) else "A5,36", ())


def _type_of_plane_acting_on_abelian(matrices: list[np.ndarray], generic: np.ndarray) -> Summand:
    """Return A5,33, A5,34, A5,35, A5,38 or A5,39: two commuting matrices that act on R^3, rows being images."""
    blocks = jordan_blocks(generic)
    if _block_sizes(blocks) == (2, 1) and not any(block.is_complex for block in blocks):
        return _type_of_shear_and_scaling(matrices, generic, blocks)
    eigenvalues, vectors = np.linalg.eig(generic)
    inverse = np.linalg.inv(vectors)
    weights = np.array([np.diag(inverse @ matrix @ vectors) for matrix in matrices]).T  # of each eigenvector
    if not any(block.is_complex for block in blocks):
        weights = weights.real
        if any(is_zero(float(np.abs(weight).max())) for weight in weights):
            return ("A5,38", ())
        candidates = []
        for i, j, k in itertools.permutations(range(3)):
            basis = weights[[i, j]]
            if abs(np.linalg.det(basis)) > 1e-7:
                b, a = np.linalg.solve(basis.T, weights[k])
                candidates.append((snapped_ratio(a, 1.0), snapped_ratio(b, 1.0)))
        a, b = min(candidates, key=lambda pair: (round(abs(pair[0]) + abs(pair[1]), 9), -pair[0], -pair[1]))
        return _make_summand("A5,33", a=a, b=b)
    pair = int(np.argmax(eigenvalues.imag))
    line = weights[int(np.argmin(np.abs(eigenvalues.imag)))].real
    if is_zero(float(np.abs(line).max())):
        return ("A5,39", ())
    real_and_imaginary = np.array([weights[pair].real, weights[pair].imag])
    if abs(np.linalg.det(real_and_imaginary)) < 1e-7:
        raise AmbiguousRoundingError("the dilation and the rotation of a plane are nearly dependent")
    b, a = np.linalg.solve(real_and_imaginary.T, line)
    return _make_summand("A5,35", a=abs(snapped_ratio(a, 1.0)), b=snapped_ratio(b, 1.0))


def _type_of_shear_and_scaling(matrices: list[np.ndarray], generic: np.ndarray, blocks: list[JordanBlock]) -> Summand:
    """Return A5,34 with its parameter: two commuting matrices shear and dilate a plane, and scale a line."""
    double_eigenvalue = next(block.eigenvalue.real for block in blocks if block.size == 2)
    single_eigenvalue = next(block.eigenvalue.real for block in blocks if block.size == 1)
    identity = np.eye(3)
    nilpotent = (generic - double_eigenvalue * identity) @ (
        generic - single_eigenvalue * identity
    )  # a multiple of the shear
    line_projector = (
        np.linalg.matrix_power(generic - double_eigenvalue * identity, 2) / (single_eigenvalue - double_eigenvalue) ** 2
    )  # projects on the line
    plane_projector = identity - line_projector
    line_weights = np.array([np.trace(line_projector @ matrix) for matrix in matrices])
    plane_weights = np.array([np.trace(plane_projector @ matrix) / 2.0 for matrix in matrices])
    shear = np.array(
        [
            np.sum(nilpotent * (matrix @ plane_projector - weight * plane_projector)) / np.sum(nilpotent**2)
            for matrix, weight in zip(matrices, plane_weights, strict=True)
        ]
    )
    conditions = np.array([shear / np.abs(shear).max(), plane_weights])
    if abs(np.linalg.det(conditions)) < 1e-7:
        raise AmbiguousRoundingError("the shear and the dilation of a plane are nearly dependent")
    a = line_weights @ np.linalg.solve(conditions, [0.0, 1.0])
    return _make_summand("A5,34", a=snapped_ratio(float(a), 1.0))
