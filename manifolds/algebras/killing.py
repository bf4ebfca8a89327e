"""The Killing form, the span of brackets, and the Cartan involution."""

from __future__ import annotations

import numpy as np
import scipy

from ..errors import LieAlgebraError
from .axioms import STRUCTURE_TOLERANCE


def killing_form_of(constants: np.ndarray) -> np.ndarray:
    return np.einsum("acd,bdc->ab", constants, constants, optimize=True)


def row_space_basis(rows: np.ndarray) -> np.ndarray:
    """Return an orthonormal basis of the span of rows of size 1; singular values up to STRUCTURE_TOLERANCE are
    rounding."""
    _, singular_values, basis = np.linalg.svd(rows, full_matrices=False)
    return basis[singular_values > STRUCTURE_TOLERANCE]


def cartan_involution_of(constants: np.ndarray, name: str) -> np.ndarray:
    """Return a Cartan involution, shape (dim, dim), from the inner product of least bracket norm.

    See :meth:`LieAlgebra.cartan_involution`.
    """
    dim = len(constants)
    upper = np.triu_indices(dim)
    directions = np.zeros((len(upper[0]), dim, dim))
    directions[np.arange(len(upper[0])), upper[0], upper[1]] = 1.0
    directions = (directions + directions.swapaxes(1, 2)) / 2
    directions -= (
        np.einsum("kaa->k", directions)[:, None, None] * np.eye(dim) / dim
    )  # of trace 0: the volume is preserved
    basis_change = np.eye(dim)  # columns: the current basis in terms of the initial one

    def constants_in_basis(basis: np.ndarray) -> np.ndarray:
        return np.einsum("ai,bj,abc,kc->ijk", basis, basis, constants, np.linalg.inv(basis), optimize=True)

    current_constants = constants_in_basis(basis_change)
    for _ in range(100):
        # d/dt of the constants when the basis moves by exp(t S), for each symmetric direction S
        derivatives = (
            np.einsum("kai,abc->kibc", directions, current_constants, optimize=True)
            + np.einsum("kbj,abc->kajc", directions, current_constants, optimize=True)
            - np.einsum("kdc,abc->kabd", directions, current_constants, optimize=True)
        )
        # |exp(tS) C|^2 = |C|^2 + 2t <C, SC> + 2 t^2 |SC|^2 + …, minimised by -1/2 of a least-squares solution.
        # Near the minimum the derivations in p move nothing (S C -> 0); the cut-off keeps such directions out.
        weights, *_ = np.linalg.lstsq(
            derivatives.reshape(len(derivatives), -1).T, current_constants.ravel(), rcond=1e-3
        )
        newton_direction = -np.einsum("k,kij->ij", weights, directions) / 2
        step_size = np.abs(newton_direction).max()
        if step_size < 1e-15 * dim:
            break
        basis_change = basis_change @ scipy.linalg.expm(newton_direction * min(1.0, 0.5 / step_size))
        current_constants = constants_in_basis(basis_change)
        if step_size < 1e-13:
            break
    # In the adapted basis ad_x^T = -ad_{theta x}: solve for theta, then return to the initial basis.
    ad = current_constants.swapaxes(1, 2)  # ad[a] is the matrix of e_a
    theta, *_ = np.linalg.lstsq(ad.reshape(dim, -1).T, -ad.swapaxes(1, 2).reshape(dim, -1).T, rcond=None)
    theta = basis_change @ theta @ np.linalg.inv(basis_change)
    automorphism = np.einsum("abd,cd->abc", constants, theta) - np.einsum(
        "da,eb,dec->abc", theta, theta, constants, optimize=True
    )
    residual = max(np.abs(automorphism).max(), np.abs(theta @ theta - np.eye(dim)).max())
    tolerance = 1e-9 * max(1.0, float(np.abs(constants).max()), float(np.abs(theta).max()) ** 2)
    if not residual <= tolerance:
        raise LieAlgebraError(
            f"no Cartan involution of {name} was found (residual {residual:.2g}, tolerance {tolerance:.1g}); "
            "rescale the basis so that the structure constants are of order one",
            residual=float(residual),
            tolerance=tolerance,
        )
    return theta
