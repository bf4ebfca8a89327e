"""Methods of a Lie algebra that return its characteristic subspaces, or the algebra in another basis."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from fractions import Fraction

import jax
import jax.numpy as jnp
import numpy as np

from .._class_members import ListedType
from ..errors import LieAlgebraError, ShapeError
from . import substructure
from ._rational import rational_array
from ._subspaces import fraction_rows, is_exact, numerical_rank, row_echelon
from .structure import AlgebraStructure


class StructureMethods(metaclass=ListedType):
    """Subspaces of an algebra as arrays whose rows span them, in the basis of the algebra.

    Where the structure constants are rational the rows are coprime integers, and exact. Otherwise they are orthonormal,
    and ranks are decided to a tolerance of 1e-10 of the balanced constants; an unclear rank is an error.
    """

    def centre(self: AlgebraStructure) -> np.ndarray:
        """Return the centre, the elements that commute with all others, as rows that span it, shape (k, dim).

        Examples
        --------
        >>> print(mf.heisenberg(1).centre())
        [[0. 0. 1.]]
        """
        work = substructure.working_constants(self)
        return work.rows_in_algebra_basis(substructure.centre(work))

    def derived_ideals(self: AlgebraStructure) -> list[np.ndarray]:
        """Return g, [g, g], [[g, g], [g, g]], … as rows that span them, each of shape (k, dim).

        The list ends where the dimension no longer falls; the dimensions are those of
        :meth:`manifolds.LieAlgebra.derived_series`.
        """
        work = substructure.working_constants(self)
        return [work.rows_in_algebra_basis(ideal) for ideal in substructure.derived_ideals(work)]

    def lower_central_ideals(self: AlgebraStructure) -> list[np.ndarray]:
        """Return g, [g, g], [g, [g, g]], … as rows that span them, each of shape (k, dim).

        The list ends where the dimension no longer falls; the dimensions are those of
        :meth:`manifolds.LieAlgebra.lower_central_series`.
        """
        work = substructure.working_constants(self)
        return [work.rows_in_algebra_basis(ideal) for ideal in substructure.lower_central_ideals(work)]

    def derivations(self: AlgebraStructure) -> np.ndarray:
        """Return matrices D, shape (k, dim, dim), that span the derivations: ``D [x, y] = [D x, y] + [x, D y]``.

        ``D @ x`` is the image of the components x. Exact integers where the structure constants are rational.

        Examples
        --------
        >>> len(mf.so(3).derivations()), len(mf.heisenberg(1).derivations())
        (3, 6)
        """
        return substructure.derivations(substructure.working_constants(self))

    def radical(self: AlgebraStructure) -> np.ndarray:
        """Return the radical, the largest solvable ideal, as rows that span it, shape (k, dim)."""
        work = substructure.working_constants(self)
        return work.rows_in_algebra_basis(substructure.radical(work))

    def nilradical(self: AlgebraStructure) -> np.ndarray:
        """Return the nilradical, the largest nilpotent ideal, as rows that span it, shape (k, dim).

        Raises
        ------
        LieAlgebraError
            If no element that separates the weights of the radical is found.
        """
        work = substructure.working_constants(self)
        return work.rows_in_algebra_basis(substructure.nilradical(work))

    def levi_decomposition(self: AlgebraStructure) -> tuple[np.ndarray, np.ndarray]:
        """Return a Levi subalgebra and the radical as rows that span them; together they span the algebra.

        The Levi subalgebra is semisimple. It is unique up to an automorphism, and empty for a solvable algebra.

        Returns
        -------
        levi : ndarray, shape (s, dim)
        radical : ndarray, shape (dim - s, dim)

        Examples
        --------
        >>> levi, radical = mf.se(3).levi_decomposition()
        >>> levi.shape, radical.shape
        ((3, 6), (3, 6))
        """
        work = substructure.working_constants(self)
        levi, radical = substructure.levi_subalgebra(work)
        return work.rows_in_algebra_basis(levi), work.rows_in_algebra_basis(radical)

    def index(self: AlgebraStructure) -> int:
        """Return the index: the least dimension of a stabilizer of the coadjoint action.

        It equals the number of independent Casimir functions, ``casimir_count()``; the orbit of a generic mu has the
        dimension ``dim - index()``.
        """
        return self.casimir_count()

    def orbit_dimension(self: AlgebraStructure, mu) -> int:
        """Return the dimension of the coadjoint orbit through mu, the rank of the Poisson tensor there: an even number.

        Exact where the structure constants are rational and every component of mu is a fraction of denominator up to
        1000.

        Parameters
        ----------
        mu : array, shape (dim,)

        Raises
        ------
        ShapeError
            If mu does not have the shape (dim,).
        LieAlgebraError
            If the singular values of the Poisson tensor show no clear gap.
        """
        components = np.asarray(mu)
        if components.shape != (self.dim,):
            raise ShapeError(f"mu must have shape ({self.dim},) for {self.name}, got {components.shape}")
        work = substructure.working_constants(self)
        fractions = rational_array(components)
        if is_exact(work.constants) and fractions is not None:
            tensor = np.tensordot(work.constants, fractions.numerator.astype(object), axes=(2, 0))
            return len(row_echelon(fraction_rows(tensor))[1])
        tensor = work.constants.astype(np.float64) @ (components * work.factors)
        scale = float(np.abs(tensor).max())
        if not np.isfinite(scale):
            raise LieAlgebraError(f"mu must be finite, got {components.tolist()}")
        if scale == 0.0:
            return 0
        return numerical_rank(np.linalg.svd(tensor / scale, compute_uv=False), 1.0, self.name)


@dataclass(frozen=True)
class CasimirInBasis:
    """A Casimir as a function of the components of mu in another basis.

    Attributes
    ----------
    casimir : callable
    rows : tuple of tuple of float
        The matrix from the new components of mu to the old ones.
    """

    casimir: Callable
    rows: tuple[tuple[float, ...], ...]

    def __call__(self, mu) -> jax.Array:
        """Return the value at ``mu``, shape (..., dim) -> (...)."""
        return self.casimir(jnp.asarray(mu) @ np.array(self.rows).T)

    def __str__(self) -> str:
        return f"{self.casimir} in another basis"


def constants_and_inverse_in_basis(g: AlgebraStructure, rows) -> tuple[np.ndarray, np.ndarray]:
    """Return the structure constants in the basis ``sum_b rows[a, b] e_b``, and the inverse matrix of rows.

    Both are fractions (dtype object) if the structure constants and the rows are rational.

    Raises
    ------
    ShapeError
        If the rows are not a finite real matrix of shape (dim, dim).
    LieAlgebraError
        If the rows are linearly dependent.
    """
    matrix = np.asarray(rows)
    if matrix.shape != (g.dim, g.dim) or matrix.dtype.kind not in "iufO":
        raise ShapeError(
            f"the rows of a new basis of {g.name} must be a real matrix of shape ({g.dim}, {g.dim}), got shape "
            f"{matrix.shape} of {matrix.dtype}"
        )
    exact, fractions = g.rational_constants, rational_array(matrix)
    dependent = LieAlgebraError(
        f"the {g.dim} rows of a new basis of {g.name} are linearly dependent. Replace some of them"
    )
    if exact is not None and fractions is not None:
        P = fraction_rows(fractions.numerator) * Fraction(1, fractions.denominator)
        augmented_matrix, pivots = row_echelon(
            np.hstack([P, fraction_rows(np.eye(g.dim, dtype=np.int64).astype(object))])
        )
        if pivots != list(range(g.dim)):
            raise dependent
        inverse, C = augmented_matrix[:, g.dim :], exact.numerator.astype(object) * Fraction(1, exact.denominator)
    else:
        P, C = matrix.astype(np.float64), g.structure_constants
        if not np.isfinite(P).all() or np.linalg.cond(P) > 1e12:
            raise dependent
        inverse = np.linalg.inv(P)
    brackets = np.tensordot(np.tensordot(P, C, axes=(1, 0)), P, axes=(1, 1)).transpose(0, 2, 1)
    constants = brackets @ inverse
    return (constants - constants.swapaxes(0, 1)) * (Fraction(1, 2) if is_exact(constants) else 0.5), inverse
