"""Structure constants: read, checked, and freed from rounding."""

from __future__ import annotations

import numpy as np

from ..errors import (
    AntisymmetryError,
    ClosureError,
    ComponentError,
    JacobiError,
    ShapeError,
)
from ._rational import RationalArray, max_jacobi_residual

AXIOM_TOLERANCE = 1e-12
"""Relative residual allowed in an axiom when the constants are not rational (rounding of a few products)."""


def checked_constants(values) -> np.ndarray:
    try:
        array = np.asarray(values)
        numeric = array.astype(np.complex128 if np.iscomplexobj(array) else np.float64)
    except (TypeError, ValueError) as error:
        raise ComponentError(f"the structure constants are not a rectangular array of numbers: {error}") from None
    if array.ndim != 3 or len(set(array.shape)) != 1 or array.shape[0] == 0:
        raise ShapeError(f"structure constants have shape (dim, dim, dim), not {array.shape}")
    if np.iscomplexobj(numeric):
        raise ComponentError("structure constants must be real: use a real basis of the algebra")
    if not np.isfinite(numeric).all():
        a, b, c = np.argwhere(~np.isfinite(numeric))[0]
        raise ComponentError(f"the structure constant C[{a}, {b}, {c}] is {numeric[a, b, c]}")
    return array


def constants_from_matrices(basis) -> tuple[np.ndarray, np.ndarray]:
    """The structure constants of the algebra that matrices span over the reals, and the matrices as an array.

    Raises what :meth:`manifolds.LieAlgebra.from_matrices` does.
    """
    try:
        matrices = np.asarray(basis)
        matrices = matrices.astype(np.complex128 if np.iscomplexobj(matrices) else np.float64)
    except (TypeError, ValueError) as error:
        raise ComponentError(f"the basis is not a rectangular array of numbers: {error}") from None
    if matrices.ndim != 3 or matrices.shape[1] != matrices.shape[2] or 0 in matrices.shape:
        raise ShapeError(f"a matrix basis has shape (dim, m, m), not {matrices.shape}")
    if not np.isfinite(matrices).all():
        raise ComponentError("the matrix basis has entries that are not finite")
    dim = len(matrices)
    sizes = np.linalg.norm(matrices, axis=(1, 2))
    if not sizes.all():
        raise ClosureError(f"e{sizes.argmin() + 1} is the zero matrix; a basis is linearly independent")
    matrices, given = matrices / sizes[:, None, None], matrices  # of norm 1: what is rounding has one size
    columns = real_columns(matrices)
    singular = np.linalg.svd(columns, compute_uv=False)
    if dim > columns.shape[0] or singular[-1] <= 1e-10 * singular[0]:
        raise ClosureError(
            f"the {dim} matrices are linearly dependent over the reals (smallest over largest singular value "
            f"{singular[-1] / singular[0]:.1e}); remove the superfluous ones",
            residual=float(singular[-1]),
            tolerance=float(1e-10 * singular[0]),
        )
    products = np.einsum("aij,bjk->abik", matrices, matrices)
    commutators = real_columns((products - products.swapaxes(0, 1)).reshape(dim * dim, *matrices.shape[1:]))
    commutators[:, np.linalg.norm(commutators, axis=0) <= AXIOM_TOLERANCE] = 0.0
    coordinates, *_ = np.linalg.lstsq(columns, commutators, rcond=None)
    residuals = np.abs(columns @ coordinates - commutators).max(axis=0)
    tolerance = 1e-10
    if residuals.max() > tolerance:
        a, b = divmod(int(residuals.argmax()), dim)
        raise ClosureError(
            f"[e{a + 1}, e{b + 1}] leaves the span of the {dim} matrices (residual {residuals.max():.3g} "
            f"for matrices of norm 1, tolerance {tolerance:.1g}); add the missing commutators to the basis",
            residual=float(residuals.max()),
            tolerance=tolerance,
            indices=(a, b),
        )
    constants = coordinates.T.reshape(dim, dim, dim)
    constants = (constants - constants.swapaxes(0, 1)) / 2
    scales = sizes[:, None, None] * sizes[:, None] / sizes
    return snap_to_fractions(constants, scales, columns, commutators), given


def check_axioms(constants: np.ndarray, name: str, exact: RationalArray | None) -> None:
    """Antisymmetry and Jacobi; ``constants`` are the integer numerators where ``exact`` is given."""
    unit = 1.0 if exact is None else 1.0 / exact.denominator
    how = "checked exactly" if exact is not None else "tolerance {:.1g}"
    scale = float(np.abs(constants).max())
    symmetric = np.abs(constants + constants.swapaxes(0, 1)).max(axis=2)
    tolerance = 0.0 if exact is not None else AXIOM_TOLERANCE * scale
    if symmetric.max() > tolerance:
        a, b = (int(i) for i in np.unravel_index(symmetric.argmax(), symmetric.shape))
        raise AntisymmetryError(
            f"{name}: [e{a + 1}, e{b + 1}] + [e{b + 1}, e{a + 1}] has a component of size "
            f"{symmetric.max() * unit:.3g} ({how.format(tolerance)}); set C[b, a, :] = -C[a, b, :]",
            residual=float(symmetric.max() * unit),
            tolerance=tolerance,
            indices=(a, b),
        )
    worst, triple = max_jacobi_residual(constants)
    tolerance = 0.0 if exact is not None else AXIOM_TOLERANCE * scale**2 * len(constants)
    if worst > tolerance:
        residual = worst * unit**2
        a, b, c = sorted(triple)
        raise JacobiError(
            f"{name}: the Jacobi identity fails for (e{a + 1}, e{b + 1}, e{c + 1}): "
            f"[[e{a + 1}, e{b + 1}], e{c + 1}] + cyclic has a component of size {residual:.3g} "
            f"({how.format(tolerance)})",
            residual=residual,
            tolerance=tolerance,
            indices=(a, b, c),
        )


def snap_to_fractions(
    constants: np.ndarray, scales: np.ndarray, columns: np.ndarray, commutators: np.ndarray
) -> np.ndarray:
    """The constants, times their scales, snapped to nearby fractions, if the commutators then hold at least as well.

    The constants are those of matrices of norm 1, the ``columns``.
    """

    def defect(constants):
        return np.abs(columns @ constants.reshape(len(constants) ** 2, -1).T - commutators).max()

    scaled = constants * scales
    snapped = _nearest_fractions(scaled, 1e-12 * np.maximum(scales, np.abs(scaled)))
    return snapped if defect(snapped / scales) <= max(4 * np.finfo(float).eps, defect(constants)) else scaled


def _nearest_fractions(values: np.ndarray, within: np.ndarray) -> np.ndarray:
    """Each value, or the nearest fraction of denominator 64 or less where that is nearer than ``within``."""
    found, least = values, within
    for denominator in range(1, 65):
        fractions = np.round(values * denominator) / denominator
        distances = np.abs(fractions - values)
        found = np.where(distances < least, fractions, found)
        least = np.minimum(distances, least)
    return found


def real_columns(matrices: np.ndarray) -> np.ndarray:
    """Each matrix as a column of its real and imaginary parts: linear algebra over the reals."""
    flat = matrices.reshape(len(matrices), -1)
    return np.concatenate([flat.real, flat.imag], axis=1).T
