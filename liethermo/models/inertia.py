"""Moments and tensors of inertia: telling them apart, and the principal axes of a tensor."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from manifolds._arrays import host_array, is_traced, real_array
from manifolds.errors import warn

from ..errors import InputError
from ..functions.conditions import ParameterCondition, checked_numbers, require_condition

SYMMETRY_RTOL = 1e-9
"""Largest asymmetry of a tensor of inertia, relative to its largest entry."""

INEQUALITY_RTOL = 1e-9
"""Relative excess of a moment of inertia over the sum of the other two that counts as rounding."""

EQUAL_MOMENTS_RTOL = 1e-9
"""Difference of two moments of inertia, relative to the greatest, up to which they count as equal."""

PUBLISHED_INERTIAS = ((10.0, 5.0, 1.0), (2.0, 1.0, 2.0 / 3.0))
"""Moments of published examples that no body can have, but that give no warning; the first is Morrison's."""

POSITIVE_MOMENTS_TEXT = "moments of inertia must be positive and finite, got {value}"
"""Error message for moments of inertia that are not positive and finite."""

ROD_RTOL = 1e-14
"""Least principal moment of a tensor, relative to the greatest, that counts as the zero of a slender rod."""


class InertiaWarning(UserWarning):
    """Moments of inertia that no rigid body has."""


class PrincipalAxes(NamedTuple):
    """Principal moments of inertia and their axes.

    Attributes
    ----------
    moments : ndarray, shape (..., 3)
        Principal moments in ascending order (mass * length**2).
    axes : ndarray, shape (..., 3, 3)
        Unit vectors along the principal axes in body axes, as columns of a rotation: column i belongs to moment i, so
        ``axes.T @ mu`` is a momentum in principal axes. Each has its first component that is not zero positive, but for
        the last one, whose direction makes the frame right-handed.
    """

    moments: np.ndarray
    axes: np.ndarray


def checked_inertia(inertia, allow_rod: bool = False) -> np.ndarray | jax.Array:
    """Return the moments, shape (3,), or the tensor, shape (3, 3), of inertia of a body; warn if no body can have them.

    A diagonal tensor is returned as its moments.

    Parameters
    ----------
    inertia : array, shape (3,) or (3, 3)
    allow_rod : bool
        Whether the moments (0, J, J) of a slender rod, in any order, are allowed.

    Raises
    ------
    InputError
        If the shape is another, a tensor is not symmetric, or a moment is not positive.

    Warns
    -----
    InertiaWarning
        If a moment exceeds the sum of the other two.
    """
    checked_array = checked_numbers(inertia, "inertia", (3,), (3, 3))
    if is_traced(inertia):
        moments = jnp.linalg.eigvalsh(checked_array) if checked_array.ndim == 2 else checked_array
        is_allowed = _are_nonnegative if allow_rod else _are_positive
        require_condition(moments, is_allowed, POSITIVE_MOMENTS_TEXT)
        return checked_array
    array = np.asarray(inertia, dtype=np.float64)
    if array.ndim == 2:
        array = checked_inertia_tensors(array, allow_rod)
        if not (array - np.diag(np.diag(array))).any():
            array = np.diag(array).copy()
    moments = array if array.ndim == 1 else np.linalg.eigvalsh(array)
    if allow_rod and np.isfinite(moments).all() and is_slender_rod(moments):
        return array
    require_condition(moments, _are_positive, POSITIVE_MOMENTS_TEXT)
    warn_of_impossible_moments(moments)
    return array


def warn_of_impossible_moments(moments: np.ndarray) -> None:
    """Warn if moments of inertia, shape (..., 3), violate the triangle inequalities, as no rigid body has them."""
    rows = moments.reshape(-1, 3)
    is_impossible = ~_triangle_inequalities_mask(rows)
    if not is_impossible.any():
        return
    row = rows[int(np.argmax(is_impossible))]
    if tuple(row.tolist()) in PUBLISHED_INERTIAS:
        return
    max_moment = float(row.max())
    warn(
        f"no rigid body has the moments of inertia {row.tolist()}: the largest, {max_moment:g}, is more than the sum "
        f"of the others, {float(row.sum()) - max_moment:g}. The equations hold all the same",
        InertiaWarning,
    )


def is_slender_rod(moments: np.ndarray) -> bool:
    """Return True if moments of inertia, shape (3,), are those of a slender rod: one is zero, the others are equal."""
    min_moment, median_moment, max_moment = np.sort(moments).tolist()
    return abs(min_moment) <= ROD_RTOL * max_moment and max_moment - median_moment <= EQUAL_MOMENTS_RTOL * max_moment


def _are_positive(moments):
    return (moments > 0.0) & (moments < np.inf)


def _are_nonnegative(moments):
    return (moments >= 0.0) & (moments < np.inf)


def _allowed_moments_mask(moments):
    """Return True for each moment, shape (..., 3), that is positive, or zero and of a slender rod."""
    xp = np if isinstance(moments, np.ndarray) else jnp
    _, median, largest = xp.moveaxis(xp.sort(moments, axis=-1), -1, 0)
    is_rod = (largest - median <= EQUAL_MOMENTS_RTOL * largest)[..., None]
    return ((moments > 0.0) | (is_rod & (moments == 0.0))) & (moments < np.inf)


def _valid_tensors_mask(tensors):
    """Return a mask, shape (...), of the tensors, shape (..., 3, 3), that are symmetric and positive definite."""
    xp = np if isinstance(tensors, np.ndarray) else jnp
    asymmetry = xp.abs(tensors - xp.swapaxes(tensors, -1, -2)).max(axis=(-2, -1))
    is_symmetric = asymmetry <= SYMMETRY_RTOL * xp.abs(tensors).max(axis=(-2, -1))
    return is_symmetric & (xp.linalg.eigvalsh(tensors)[..., 0] > 0.0)


INERTIA_CONDITION = ParameterCondition(
    _allowed_moments_mask,
    POSITIVE_MOMENTS_TEXT,
    _valid_tensors_mask,
    "a tensor of inertia must be symmetric and positive definite, got {value}",
)
"""Condition on the moments or the tensor of inertia of a body."""


def principal_axes(inertia) -> PrincipalAxes:
    """Return the principal moments of inertia and the principal axes of one tensor, or of many.

    Parameters
    ----------
    inertia : array, shape (..., 3, 3) symmetric, positive definite; or three positive numbers
        Tensors of inertia in body axes (mass * length**2), or the moments about these axes.

    Returns
    -------
    PrincipalAxes

    Raises
    ------
    InputError
        If an array is not a symmetric positive definite tensor.

    Examples
    --------
    >>> moments, axes = lt.bodies.principal_axes(
    ...     [[2.0, 0.0, 0.0], [0.0, 2.5, 0.5], [0.0, 0.5, 2.5]]
    ... )
    >>> (
    ...     np.allclose(moments, [2.0, 2.0, 3.0]),
    ...     np.allclose(np.abs(axes[:, 2]), [0.0, 0.5**0.5, 0.5**0.5]),
    ... )
    (True, True)
    """
    tensors = np.asarray(checked_numbers(inertia, "inertia"), dtype=np.float64)
    tensors = np.diag(tensors) if tensors.shape == (3,) else tensors
    if tensors.shape[-2:] != (3, 3):
        raise InputError(f"inertia must have shape (3,) or (..., 3, 3), got {tensors.shape}")
    moments, axes = np.linalg.eigh(checked_inertia_tensors(tensors))
    warn_of_impossible_moments(moments)
    leading_entries = np.take_along_axis(axes, np.argmax(np.abs(axes) > 1e-8, axis=-2)[..., None, :], axis=-2)
    axes = axes * np.where(leading_entries < 0.0, -1.0, 1.0)
    axes[..., 2] *= np.linalg.det(axes)[..., None]
    return PrincipalAxes(moments, axes)


def are_inertia_tensors(inertia) -> bool:
    """Return True if an array of shape (..., 3) holds tensors of inertia, shape (..., 3, 3), rather than moments.

    Symmetric positive definite blocks whose principal moments obey ``I_i <= I_j + I_k`` are tensors. Their rows are
    then never the moments of three bodies. Proof: let the rows obey these inequalities. Then the trace is at most twice
    the sum s of the three entries above the diagonal. The quotient ``v . I v / v . v`` at ``v = (1, 1, 1)`` is
    ``(tr I + 2 s) / 3``, at least 2/3 of the trace. So the greatest principal moment exceeds the sum of the others.

    Raises
    ------
    InputError
        If neither reading is that of rigid bodies, or the values are not known because the array is traced.
    """
    if inertia.shape[-2:] != (3, 3):
        return False
    if is_traced(inertia):
        raise InputError(
            f"inertia of shape {inertia.shape} may hold tensors or moments, which cannot be decided from a traced "
            "array. Give the moments of one body, shape (3,), and use jax.vmap for many"
        )
    blocks = np.asarray(inertia, dtype=np.float64)
    if not np.isfinite(blocks).all() or not are_symmetric_to_rounding(blocks):
        return False
    principal = np.linalg.eigvalsh(blocks)
    is_positive_definite = bool((principal > 0.0).all())
    if is_positive_definite and satisfies_triangle_inequalities(principal):
        return True
    if (blocks > 0.0).all() and (not is_positive_definite or satisfies_triangle_inequalities(blocks)):
        return False
    if is_positive_definite and (blocks > 0.0).all():
        raise InputError(
            f"inertia must be moments or tensors of rigid bodies, got the symmetric array {blocks.tolist()}, which is "
            "neither. Give principal moments, shape (3,), one body at a time"
        )
    return True


def checked_inertia_tensors(tensors, allow_rod: bool = False) -> np.ndarray:
    """Return tensors of inertia, shape (..., 3, 3), made exactly symmetric, after checking that they are valid."""
    blocks = np.asarray(tensors, dtype=np.float64)
    if not np.isfinite(blocks).all():
        raise InputError(f"a tensor of inertia must be finite, got {blocks.tolist()}")
    if not are_symmetric_to_rounding(blocks):
        asymmetry = np.abs(blocks - blocks.swapaxes(-1, -2)).max()
        raise InputError(
            f"a tensor of inertia must be symmetric, but it differs from its transpose by {asymmetry:.3g}: "
            f"{blocks.tolist()}. Use (I + I.T) / 2 if this is an error of measurement"
        )
    blocks = 0.5 * (blocks + blocks.swapaxes(-1, -2))
    principal = np.linalg.eigvalsh(blocks)
    min_moment = float(principal.min())
    if allow_rod and blocks.ndim == 2 and is_slender_rod(principal):
        return blocks
    if min_moment <= 0.0:
        raise InputError(f"a tensor of inertia must be positive definite, got the principal moment {min_moment:g}")
    return blocks


def principal_moments(inertia) -> jax.Array:
    """Return principal moments, shape (..., 3), of moments in any order or of tensors (then in ascending order)."""
    array = checked_numbers(inertia, "inertia")
    if array.shape[-1:] != (3,):
        raise InputError(f"inertia must have shape (..., 3), or (..., 3, 3) for tensors, got {array.shape}")
    moments = jnp.linalg.eigvalsh(checked_inertia_tensors(array)) if are_inertia_tensors(array) else array
    require_condition(
        moments, lambda m: (m > 0.0) & (m < np.inf), "moments of inertia must be positive and finite, got {value}"
    )
    if not is_traced(moments):
        warn_of_impossible_moments(np.asarray(moments))
    return moments


def inverse_inertia(inertia) -> jax.Array:
    """Return the inverse of a tensor of inertia, shape (3, 3), or the reciprocals of three moments, shape (3,).

    About the axis of a slender rod, where the moment is zero, the inverse is zero: the rod does not turn about it.
    """
    inertia = host_array(real_array(inertia))
    if inertia.ndim == 1:
        return real_array(inverse_moments(inertia))
    if not is_traced(inertia):
        moments, axes = np.linalg.eigh(np.asarray(inertia))
        if is_slender_rod(moments):
            inverse_of_rod = np.append(0.0, 1.0 / moments[1:])
            return real_array(axes * inverse_of_rod @ axes.T)
    inverse = jnp.linalg.inv(inertia)
    return 0.5 * (inverse + inverse.T)


def inverse_moments(moments):
    """Return the reciprocal of each moment of inertia, and 0 for a moment of 0; NumPy arrays stay NumPy arrays."""
    xp, is_zero = np if isinstance(moments, np.ndarray) else jnp, moments == 0.0
    return xp.where(is_zero, 0.0, 1.0 / xp.where(is_zero, 1.0, moments))


def are_symmetric_to_rounding(matrices: np.ndarray) -> bool:
    """Return True if all matrices, shape (..., 3, 3), are symmetric to rounding, relative to their largest entry."""
    asymmetry = np.abs(matrices - matrices.swapaxes(-1, -2)).max(axis=(-2, -1))
    return bool((asymmetry <= SYMMETRY_RTOL * np.abs(matrices).max(axis=(-2, -1))).all())


def satisfies_triangle_inequalities(moments: np.ndarray) -> bool:
    """Return True if moments of shape (..., 3) obey ``I_i <= I_j + I_k``, as the moments of every rigid body do."""
    return bool(_triangle_inequalities_mask(moments).all())


def _triangle_inequalities_mask(moments: np.ndarray) -> np.ndarray:
    """Return a mask, shape (...), of the moments, shape (..., 3), that a rigid body can have; False if one is NaN."""
    max_moments = moments.max(axis=-1)
    return max_moments <= (moments.sum(axis=-1) - max_moments) * (1.0 + INEQUALITY_RTOL)
