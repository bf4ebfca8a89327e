"""Direct sums of Lie algebras, and semidirect sums by matrices or by derivations."""

from __future__ import annotations

import numpy as np
import scipy

from ..errors import (
    ComponentError,
    RepresentationError,
    ShapeError,
)
from .axioms import AXIOM_TOLERANCE
from .blocks import direct_sum_by_constants, joined_basis_names, merged_direct_sum
from .killing import row_space_basis
from .lie_algebra import LieAlgebra

MAX_DIM_BY_CONSTANTS = 40
"""Largest dimension in which a direct sum is an array of structure constants."""


def direct_sum(*algebras: LieAlgebra) -> LieAlgebra:
    """Return the direct sum of algebras: the elements of the first, then of the second, …; different summands commute.

    Up to dimension 40 the sum has structure constants; a larger one acts block by block, without them, and consecutive
    copies of one algebra act as one batch. See :func:`manifolds.power`.

    Parameters
    ----------
    algebras : LieAlgebra
        The summands, at least one.

    Examples
    --------
    >>> g = mf.direct_sum(mf.so(3), mf.abelian(1))
    >>> g.dim, g.casimir_count()
    (4, 2)
    """
    if not algebras:
        raise ShapeError("direct_sum needs at least one algebra")
    if sum(g.dim for g in algebras) <= MAX_DIM_BY_CONSTANTS:
        return direct_sum_by_constants(algebras)
    return merged_direct_sum(algebras)


def semidirect_sum(g: LieAlgebra, representation, name: str | None = None, *, ideal=None) -> LieAlgebra:
    """Return the semidirect sum of g with an ideal: ``[(x, u), (y, v)] = ([x, y], rho(x) v - rho(y) u + [u, v])``.

    Parameters
    ----------
    g : LieAlgebra
    representation : array, shape (g.dim, m, m), or callable
        The matrices ``rho(e_a)``, or a function from components x, shape (dim,), to ``rho(x)``. With an ideal these are
        derivations of it: the columns of ``rho(e_a)`` are the images of the basis elements.
    name : str, optional
    ideal : LieAlgebra, of dimension m, optional
        The algebra of u and v; by default the abelian algebra of a vector space.

    Returns
    -------
    LieAlgebra
        Of dimension ``g.dim + m``: the elements of g first, then those of the ideal. On a vector space its matrices are
        the affine ones ``[[rho(x), v], [0, 0]]``, preceded by the matrices of g if rho alone is not faithful. With an
        ideal they are the adjoint matrices if its centre is zero, and unknown otherwise.

    Raises
    ------
    RepresentationError
        If ``[rho(e_a), rho(e_b)] != rho([e_a, e_b])`` for some pair, or ``rho(e_a) [u, v]`` is not
        ``[rho(e_a) u, v] + [u, rho(e_a) v]`` for some pair of the ideal; the message names the pair.
    """
    if ideal is not None and not isinstance(ideal, LieAlgebra):
        raise ComponentError(f"ideal must be a LieAlgebra, got {type(ideal).__name__}")
    if callable(representation):
        representation = [np.asarray(representation(e)) for e in np.eye(g.dim)]
    rho = np.asarray(representation, dtype=np.float64)
    m = ideal.dim if ideal is not None else rho.shape[-1] if rho.ndim else 0
    if rho.shape != (g.dim, m, m):
        raise ShapeError(f"a representation of {g.name} must have shape ({g.dim}, {m}, {m}), got {rho.shape}")
    _check_representation(g, rho)
    dim = g.dim + m
    constants = np.zeros((dim, dim, dim))
    constants[: g.dim, : g.dim, : g.dim] = g.structure_constants
    constants[: g.dim, g.dim :, g.dim :] = rho.swapaxes(1, 2)  # [e_a, v_j] = rho(e_a) v_j
    constants[g.dim :, : g.dim, g.dim :] = -rho.swapaxes(1, 2).swapaxes(0, 1)
    if ideal is None:
        return LieAlgebra(constants, name=name or f"{g.name} x R^{m}", basis=_semidirect_sum_matrices(g, rho))
    _check_derivations(g, rho, ideal)
    constants[g.dim :, g.dim :, g.dim :] = ideal.structure_constants
    total = LieAlgebra(constants, name=name or f"{g.name} x {ideal.name}", basis_names=joined_basis_names(g, ideal))
    adjoint = total._balanced_constants_and_factors[0].reshape(dim, -1)
    is_faithful = adjoint.any() and len(row_space_basis(adjoint)) == dim
    return LieAlgebra(
        constants,
        name=total.name,
        basis=total.structure_constants.swapaxes(1, 2) if is_faithful else None,
        basis_names=total.basis_names,
    )


def _check_representation(g: LieAlgebra, representation_matrices: np.ndarray) -> None:
    products = np.einsum("aij,bjk->abik", representation_matrices, representation_matrices)
    defect = (
        products - products.swapaxes(0, 1) - np.einsum("abc,cij->abij", g.structure_constants, representation_matrices)
    )
    residuals = np.abs(defect).max(axis=(2, 3))
    images = float(np.abs(g.structure_constants).max() * np.abs(representation_matrices).max())
    tolerance = AXIOM_TOLERANCE * max(float(np.abs(products).max()), images)
    if residuals.max() > tolerance:
        a, b = np.unravel_index(residuals.argmax(), residuals.shape)
        raise RepresentationError(
            f"not a representation of {g.name}: [rho(e{a + 1}), rho(e{b + 1})] differs from rho([e{a + 1}, e{b + 1}]) "
            f"by {residuals.max():.3g} (tolerance {tolerance:.1g})",
            residual=float(residuals.max()),
            tolerance=tolerance,
            indices=(int(a), int(b)),
        )


def _check_derivations(g: LieAlgebra, representation_matrices: np.ndarray, ideal: LieAlgebra) -> None:
    C = ideal.structure_constants
    defect = np.einsum("ijk,alk->aijl", C, representation_matrices)  # D [u_i, u_j] - [D u_i, u_j] - [u_i, D u_j]
    defect -= np.einsum("aki,kjl->aijl", representation_matrices, C) + np.einsum(
        "akj,ikl->aijl", representation_matrices, C
    )
    residuals = np.abs(defect).max(axis=3)
    tolerance = AXIOM_TOLERANCE * float(np.abs(C).max() * np.abs(representation_matrices).max())
    if residuals.max() > tolerance:
        a, i, j = (int(index) for index in np.unravel_index(residuals.argmax(), residuals.shape))
        raise RepresentationError(
            f"rho(e{a + 1}) of {g.name} is not a derivation D of {ideal.name}: D [u{i + 1}, u{j + 1}] differs from "
            f"[D u{i + 1}, u{j + 1}] + [u{i + 1}, D u{j + 1}] by {residuals.max():.3g} (tolerance {tolerance:.1g})",
            residual=float(residuals.max()),
            tolerance=tolerance,
            indices=(a, i, j),
        )


def _semidirect_sum_matrices(g: LieAlgebra, representation_matrices: np.ndarray) -> np.ndarray | None:
    m, dim = representation_matrices.shape[1], g.dim + representation_matrices.shape[1]
    affine = np.zeros((dim, m + 1, m + 1))
    affine[: g.dim, :m, :m] = representation_matrices
    affine[np.arange(g.dim, dim), np.arange(m), m] = 1.0
    norms = np.linalg.norm(representation_matrices, axis=(1, 2))
    if norms.all() and len(row_space_basis(representation_matrices.reshape(g.dim, -1) / norms[:, None])) == g.dim:
        return affine
    if g.basis is None:
        return None
    padded_basis = np.concatenate([g.basis, np.zeros((m, *g.basis.shape[1:]))])
    return np.array([scipy.linalg.block_diag(u, e) for u, e in zip(padded_basis, affine, strict=True)])
