"""Characteristic subspaces of a Lie algebra: centre, ideals, derivations, radicals and a Levi subalgebra.

Every function takes the structure constants in a form in which linear algebra is reliable, see
:func:`working_constants`: integers, on which everything is exact, or floats in a balanced basis.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from ..errors import LieAlgebraError
from ._subspaces import (
    brackets_of_rows,
    complement,
    coordinates,
    identity_rows,
    integer_rows,
    is_exact,
    null_space,
    row_space,
    solution,
)
from .structure import AlgebraStructure

MAX_NILRADICAL_DRAWS = 8
"""Largest number of random elements that are tried; one fails with a probability of about dim**2 / 10**3."""

RANDOM_INTEGER_BOUND = 999
"""Bound of the random integer coefficients of a generic element of an exact algebra."""


@dataclass(frozen=True)
class WorkingConstants:
    """Structure constants for linear algebra, with the way back to the basis of the algebra.

    Attributes
    ----------
    constants : ndarray, shape (dim, dim, dim)
        Integers (dtype object), a multiple of the rational structure constants; or floats in the balanced basis.
    factors : ndarray, shape (dim,)
        The balanced basis elements are ``factors[a] e_a``; ones where the constants are integers.
    name : str
    """

    constants: np.ndarray
    factors: np.ndarray
    name: str

    @property
    def dim(self) -> int:
        return len(self.factors)

    @property
    def full_space_rows(self) -> np.ndarray:
        """Rows of the identity matrix, which span the algebra, shape (dim, dim)."""
        return identity_rows(self.dim, is_exact(self.constants))

    def span_of_brackets(self, rows_a: np.ndarray, rows_b: np.ndarray) -> np.ndarray:
        """Return rows that span the brackets of two subspaces."""
        return row_space(brackets_of_rows(rows_a, rows_b, self.constants).reshape(-1, self.dim), self.name)

    def ad_matrices(self, rows: np.ndarray) -> np.ndarray:
        """Return the matrices of ad of each row, shape (k, dim, dim)."""
        return np.tensordot(rows, self.constants, axes=(1, 0)).transpose(0, 2, 1)

    def rows_in_algebra_basis(self, rows: np.ndarray) -> np.ndarray:
        """Return rows in the basis of the algebra as floats: coprime integers, or orthonormal rows."""
        if is_exact(rows):
            return integer_rows(rows).astype(np.float64).reshape(-1, self.dim)
        scaled_rows = rows * self.factors
        return np.linalg.qr(scaled_rows.T)[0].T if len(rows) else scaled_rows


def working_constants(g: AlgebraStructure) -> WorkingConstants:
    """Return the constants of an algebra as integers if they are rational, else as floats in the balanced basis."""
    exact = g.rational_constants
    if exact is not None:
        return WorkingConstants(exact.numerator.astype(object), np.ones(g.dim), g.name)
    constants, factors = g._balanced_constants_and_factors
    return WorkingConstants(constants, factors, g.name)


def centralizer(work: WorkingConstants, rows: np.ndarray) -> np.ndarray:
    """Return rows x with ``[x, y] = 0`` for every y in a subspace."""
    images = brackets_of_rows(work.full_space_rows, rows, work.constants)
    return null_space(images.reshape(work.dim, -1).T, work.name)


def centre(work: WorkingConstants) -> np.ndarray:
    return centralizer(work, work.full_space_rows)


def derived_ideals(work: WorkingConstants, ideal: np.ndarray | None = None) -> list[np.ndarray]:
    """Return rows that span h, [h, h], [[h, h], [h, h]], … while the dimension falls; h is ``ideal``, by default g."""
    ideals = [work.full_space_rows if ideal is None else ideal]
    while len(ideals[-1]):
        next_ideal = work.span_of_brackets(ideals[-1], ideals[-1])
        if len(next_ideal) == len(ideals[-1]):
            break
        ideals.append(next_ideal)
    return ideals


def lower_central_ideals(work: WorkingConstants, ideal: np.ndarray | None = None) -> list[np.ndarray]:
    """Return rows that span h, [h, h], [h, [h, h]], … while the dimension falls; h is ``ideal``, by default g."""
    full_ideal = work.full_space_rows if ideal is None else ideal
    ideals = [full_ideal]
    while len(ideals[-1]):
        next_ideal = work.span_of_brackets(full_ideal, ideals[-1])
        if len(next_ideal) == len(ideals[-1]):
            break
        ideals.append(next_ideal)
    return ideals


def radical(work: WorkingConstants) -> np.ndarray:
    """Return rows of the largest solvable ideal: the complement of [g, g] by the Killing form (Cartan)."""
    killing = np.tensordot(work.constants, work.constants, axes=([1, 2], [2, 1]))
    derived_rows = work.span_of_brackets(work.full_space_rows, work.full_space_rows)
    return null_space(derived_rows @ killing, work.name) if len(derived_rows) else work.full_space_rows


def nilradical(work: WorkingConstants) -> np.ndarray:
    """Return rows of the largest nilpotent ideal.

    On g the radical has weights, and the nilradical is the set of its elements at which all weights vanish. That is
    ``tr(ad x (ad y)**k) = 0`` for k = 0, 1, …, if the weights have different values at y, which is drawn at random.

    Raises
    ------
    LieAlgebraError
        If no element of the radical that was tried separates the weights.
    """
    solvable_ideal = radical(work)
    if not len(solvable_ideal):
        return solvable_ideal
    random, exact = np.random.default_rng(0), is_exact(work.constants)
    ad = work.ad_matrices(solvable_ideal)
    for _ in range(MAX_NILRADICAL_DRAWS):
        if exact:
            draws = random.integers(-RANDOM_INTEGER_BOUND, RANDOM_INTEGER_BOUND, len(solvable_ideal))
            generic_ad = np.tensordot(draws.astype(object), ad, axes=(0, 0))
        else:
            generic_ad = np.tensordot(random.standard_normal(len(solvable_ideal)), ad, axes=(0, 0))
            generic_ad = generic_ad / (np.linalg.norm(generic_ad, 2) or 1.0)
        power, traces = identity_rows(work.dim, exact), []
        for _ in range(work.dim):
            traces.append(np.tensordot(ad, power, axes=([1, 2], [1, 0])))
            power = power @ generic_ad
        rows = null_space(np.array(traces, dtype=object if exact else np.float64), work.name) @ solvable_ideal
        ideal = row_space(rows, work.name)
        if not len(lower_central_ideals(work, ideal)[-1]):
            return ideal
    raise LieAlgebraError(
        f"{work.name}: no element of the radical was found that separates its weights, so the nilradical is not "
        "known. Give the structure constants as fractions, or rescale the basis"
    )


def levi_subalgebra(work: WorkingConstants) -> tuple[np.ndarray, np.ndarray]:
    """Return rows of a semisimple subalgebra and of the radical, which together span the algebra.

    A complement of the radical is corrected along each factor of the derived series of the radical, by linear
    equations [de Graaf 2000, section 4.13].
    """
    solvable_ideal = radical(work)
    rows = complement(solvable_ideal, work.full_space_rows, work.name)
    n = len(rows)
    if n == 0 or not len(solvable_ideal):
        return rows, solvable_ideal
    modulo_radical = null_space(solvable_ideal, work.name)
    brackets = brackets_of_rows(rows, rows, work.constants).reshape(-1, work.dim)
    levi_constants = coordinates(rows @ modulo_radical.T, brackets @ modulo_radical.T).reshape(n, n, n)
    layers = derived_ideals(work, solvable_ideal)
    for layer, next_layer in itertools.pairwise(layers):
        functionals = null_space(next_layer, work.name) if len(next_layer) else work.full_space_rows
        directions = complement(next_layer, layer, work.name)
        m = len(directions)
        actions = brackets_of_rows(rows, directions, work.constants) @ functionals.T
        images = directions @ functionals.T
        brackets = brackets_of_rows(rows, rows, work.constants)
        defects = (brackets - np.tensordot(levi_constants, rows, axes=(2, 0))) @ functionals.T
        equations, values = [], []
        for i in range(n):
            for j in range(i + 1, n):
                block = np.zeros((n, m, len(functionals)), dtype=rows.dtype)
                block[j] = block[j] + actions[i]
                block[i] = block[i] - actions[j]
                block = block - levi_constants[i, j][:, None, None] * images
                equations.append(block.reshape(n * m, -1).T)
                values.append(-defects[i, j])
        weights = solution(np.vstack(equations), np.concatenate(values)).reshape(n, m)
        rows = rows + weights @ directions
    return rows, solvable_ideal


def derivations(work: WorkingConstants) -> np.ndarray:
    """Return matrices D, shape (k, dim, dim), that span the solutions of ``D [x, y] = [D x, y] + [x, D y]``."""
    dim, constants = work.dim, work.constants
    equations = []
    for a in range(dim):
        for b in range(a + 1, dim):
            block = np.zeros((dim, dim, dim), dtype=constants.dtype)  # the component d of the condition, by D[p, q]
            for d in range(dim):
                block[d, d, :] = block[d, d, :] + constants[a, b]
                block[d, :, a] = block[d, :, a] - constants[:, b, d]
                block[d, :, b] = block[d, :, b] - constants[a, :, d]
            equations.append(block.reshape(dim, dim * dim))
    matrix = np.vstack(equations) if equations else np.zeros((0, dim * dim), dtype=constants.dtype)
    matrix = matrix[[bool(row.any()) for row in matrix]]
    solutions = null_space(matrix, work.name)
    if is_exact(solutions):
        return solutions.astype(np.float64).reshape(-1, dim, dim)
    return solutions.reshape(-1, dim, dim) * work.factors[:, None] / work.factors
