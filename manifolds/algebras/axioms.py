"""Reading and checking of structure constants, removal of their rounding errors, and scaling of the basis."""

from __future__ import annotations

import numpy as np

from ..errors import (
    AntisymmetryError,
    ClosureError,
    ComponentError,
    JacobiError,
    ShapeError,
)
from ._rational import RationalArray, max_jacobi_residual_and_triple

AXIOM_TOLERANCE = 1e-12
"""Largest relative residual of an axiom for constants that are not rational (rounding of a few products)."""


def finite_cubic_array(values) -> np.ndarray:
    """Return structure constants as an array, after checking that it is cubic, real and finite."""
    try:
        array = np.asarray(values)
        numeric = array.astype(np.complex128 if np.iscomplexobj(array) else np.float64)
    except (TypeError, ValueError) as error:
        raise ComponentError(f"the structure constants are not a rectangular array of numbers: {error}") from None
    if array.ndim != 3 or len(set(array.shape)) != 1 or array.shape[0] == 0:
        raise ShapeError(f"structure constants must have shape (dim, dim, dim), got {array.shape}")
    if np.iscomplexobj(numeric):
        raise ComponentError("structure constants must be real. Use a real basis of the algebra")
    if not np.isfinite(numeric).all():
        a, b, c = np.argwhere(~np.isfinite(numeric))[0]
        raise ComponentError(f"the structure constant C[{a}, {b}, {c}] is {numeric[a, b, c]}")
    return array


def constants_and_matrices(basis) -> tuple[np.ndarray, np.ndarray]:
    """Return the structure constants of the algebra that matrices span over the reals, and the matrices as an array.

    Raises the errors of :meth:`manifolds.LieAlgebra.from_matrices`.
    """
    try:
        matrices = np.asarray(basis)
        matrices = matrices.astype(np.complex128 if np.iscomplexobj(matrices) else np.float64)
    except (TypeError, ValueError) as error:
        raise ComponentError(f"the basis is not a rectangular array of numbers: {error}") from None
    if matrices.ndim != 3 or matrices.shape[1] != matrices.shape[2] or 0 in matrices.shape:
        raise ShapeError(f"a matrix basis must have shape (dim, m, m), got {matrices.shape}")
    if not np.isfinite(matrices).all():
        raise ComponentError("the entries of a matrix basis must be finite")
    dim = len(matrices)
    norms = np.linalg.norm(matrices, axis=(1, 2))
    if not norms.all():
        raise ClosureError(
            f"e{norms.argmin() + 1} is the zero matrix. Remove it, since a basis must be linearly independent"
        )
    matrices, input_matrices = (
        matrices / norms[:, None, None],
        matrices,
    )  # of norm 1, so that all rounding errors are of one size
    columns = real_columns(matrices)
    singular_values = np.linalg.svd(columns, compute_uv=False)
    if dim > columns.shape[0] or singular_values[-1] <= 1e-10 * singular_values[0]:
        raise ClosureError(
            f"the {dim} matrices are linearly dependent over the reals (smallest over largest singular value "
            f"{singular_values[-1] / singular_values[0]:.1e}). Remove the superfluous ones",
            residual=float(singular_values[-1]),
            tolerance=float(1e-10 * singular_values[0]),
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
            f"for matrices of norm 1, tolerance {tolerance:.1g}). Add the missing commutators to the basis",
            residual=float(residuals.max()),
            tolerance=tolerance,
            indices=(a, b),
        )
    constants = coordinates.T.reshape(dim, dim, dim)
    constants = (constants - constants.swapaxes(0, 1)) / 2
    scales = norms[:, None, None] * norms[:, None] / norms
    return scale_and_snap_to_fractions(constants, scales, columns, commutators), input_matrices


def check_axioms(
    constants: np.ndarray, name: str, rational_constants: RationalArray | None, basis_names: tuple[str, ...] | None
) -> None:
    """Raise an error if antisymmetry or the Jacobi identity fails; the message has the names of the basis elements.

    With ``rational_constants`` the constants are its integer numerators, and the check is exact.
    """
    labels = basis_names or tuple(f"e{a + 1}" for a in range(len(constants)))
    unit = 1.0 if rational_constants is None else 1.0 / rational_constants.denominator
    check_text = "checked exactly" if rational_constants is not None else "tolerance {:.1g}"
    scale = float(np.abs(constants).max())
    symmetric_parts = np.abs(constants + constants.swapaxes(0, 1)).max(axis=2)
    tolerance = 0.0 if rational_constants is not None else AXIOM_TOLERANCE * scale
    if symmetric_parts.max() > tolerance:
        a, b = (int(i) for i in np.unravel_index(symmetric_parts.argmax(), symmetric_parts.shape))
        raise AntisymmetryError(
            f"{name}: [{labels[a]}, {labels[b]}] + [{labels[b]}, {labels[a]}] has a component of size "
            f"{symmetric_parts.max() * unit:.3g} ({check_text.format(tolerance)}). Set C[b, a, :] = -C[a, b, :]",
            residual=float(symmetric_parts.max() * unit),
            tolerance=tolerance,
            indices=(a, b),
        )
    max_component, triple = max_jacobi_residual_and_triple(constants)
    tolerance = 0.0 if rational_constants is not None else AXIOM_TOLERANCE * scale**2 * len(constants)
    if max_component > tolerance:
        residual = max_component * unit**2
        a, b, c = sorted(triple)
        raise JacobiError(
            f"{name}: the Jacobi identity fails for ({labels[a]}, {labels[b]}, {labels[c]}): "
            f"[[{labels[a]}, {labels[b]}], {labels[c]}] + cyclic has a component of size {residual:.3g} "
            f"({check_text.format(tolerance)})",
            residual=residual,
            tolerance=tolerance,
            indices=(a, b, c),
        )


def scale_and_snap_to_fractions(
    constants: np.ndarray, scales: np.ndarray, columns: np.ndarray, commutators: np.ndarray
) -> np.ndarray:
    """Return ``constants * scales`` rounded to nearby fractions, if the commutators then hold at least as well.

    The constants are those of the matrices of norm 1 in ``columns``.
    """

    def max_commutator_residual(constants):
        return np.abs(columns @ constants.reshape(len(constants) ** 2, -1).T - commutators).max()

    scaled_constants = constants * scales
    rounded_constants = _nearest_fractions(scaled_constants, 1e-12 * np.maximum(scales, np.abs(scaled_constants)))
    return (
        rounded_constants
        if max_commutator_residual(rounded_constants / scales)
        <= max(4 * np.finfo(float).eps, max_commutator_residual(constants))
        else scaled_constants
    )


def _nearest_fractions(values: np.ndarray, max_distances: np.ndarray) -> np.ndarray:
    """Round each value to the nearest fraction of denominator at most 64, if that is closer than ``max_distances``."""
    snapped_values, min_distances = values, max_distances
    for denominator in range(1, 65):
        fractions = np.round(values * denominator) / denominator
        distances = np.abs(fractions - values)
        snapped_values = np.where(distances < min_distances, fractions, snapped_values)
        min_distances = np.minimum(distances, min_distances)
    return snapped_values


def real_columns(matrices: np.ndarray) -> np.ndarray:
    """Return each matrix as a column of its real and imaginary parts, for linear algebra over the reals."""
    flat_matrices = matrices.reshape(len(matrices), -1)
    return np.concatenate([flat_matrices.real, flat_matrices.imag], axis=1).T


STRUCTURE_TOLERANCE = 1e-10
"""Values below this count as rounding errors, relative to balanced constants.

In random bases of condition number 1e2, scaled by 1e-6 … 1e6, zeros come out below 1e-13, and nonzero values above
1e-5 (Killing forms) and 1e-4 (brackets).
"""

_MIN_RELATIVE_CONSTANT = 1e-12
"""Constants below this, relative to the largest, are left out of the balance, so that rounding errors do not grow."""

_MAX_ROUNDS = 20
"""Largest number of rounds in which the set of constants taken as nonzero is updated."""


def balance_constants(constants: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the constants in the basis ``factors[a] e_a``, the largest of size 1, and the factors.

    The factors minimise the sum of squares of the logarithms of the nonzero constants,
    ``log |C[a, b, c]| + x_a + x_b - x_c``. Multiples of the basis elements therefore lead to equal balanced constants.
    """
    magnitudes = np.abs(constants)
    if not magnitudes.any():
        return constants, np.ones(len(constants))
    mask, scaled_constants = np.zeros(constants.shape, dtype=bool), constants
    for _ in range(_MAX_ROUNDS):
        new_mask = mask | (np.abs(scaled_constants) > _MIN_RELATIVE_CONSTANT * np.abs(scaled_constants).max())
        if (new_mask == mask).all():
            break
        mask = new_mask  # constants that stand out from rounding only after scaling take part from then on
        logarithms = np.log(magnitudes, where=mask, out=np.zeros(magnitudes.shape))
        x, *_ = np.linalg.lstsq(_balancing_normal_matrix(mask), -_balancing_right_hand_side(logarithms), rcond=1e-10)
        exponents = x[:, None, None] + x[:, None] - x
        max_exponent = (logarithms + exponents)[mask].max()
        x, exponents = x - max_exponent, exponents - max_exponent
        scaled_constants = constants * np.exp(exponents)
    return scaled_constants, np.exp(x)


def _balancing_right_hand_side(logarithms: np.ndarray) -> np.ndarray:
    """Return the right-hand side, shape (dim,), of the normal equations of :func:`balance_constants`."""
    return logarithms.sum(axis=(1, 2)) + logarithms.sum(axis=(0, 2)) - logarithms.sum(axis=(0, 1))


def _balancing_normal_matrix(mask: np.ndarray) -> np.ndarray:
    """Return the matrix, shape (dim, dim), of the normal equations of :func:`balance_constants`.

    ``mask`` is True for the constants that take part.
    """
    pair_counts = mask.sum(axis=2) - mask.sum(axis=1) - mask.sum(axis=0)  # of a and b, of a and c, of b and c
    return pair_counts + pair_counts.T + np.diag(mask.sum(axis=(1, 2)) + mask.sum(axis=(0, 2)) + mask.sum(axis=(0, 1)))
