"""Attitudes from quaternions, Euler angles, matrices and SciPy's rotations, as matrices of SO(3)."""

from __future__ import annotations

import itertools
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

import manifolds as mf
from manifolds._arrays import is_traced
from manifolds.errors import warn

from ..errors import InputError
from ..functions.conditions import checked_numbers

ROTATION_TOLERANCE = 1e-10
"""Largest distance from SO(3), relative, of a matrix in double precision: what the group itself accepts."""

SINGLE_PRECISION_TOLERANCE = 128 * float(np.finfo(np.float32).eps)
"""Largest distance from SO(3) that the rounding of float32 explains, with products of some rotations: 1.5e-5."""

ELEMENTARY_AXES = {"x": 0, "y": 1, "z": 2}
"""Index of each axis that a sequence of Euler angles may name."""


class AttitudeWarning(UserWarning):
    """Warning that attitudes were rotations to single precision only, and have been projected onto SO(3)."""


def attitude(
    *,
    quaternion=None,
    scalar: Literal["last", "first"] = "last",
    euler=None,
    sequence: str = "zyx",
    degrees: bool = False,
    matrix=None,
    rotation: Rotation | None = None,
) -> np.ndarray | jax.Array:
    """Return an attitude as a rotation matrix, which maps components in body axes to components in space.

    Exactly one of ``quaternion``, ``euler``, ``matrix`` and ``rotation`` is given. The result is an ``attitude=`` of
    :func:`liethermo.integrate`, :func:`liethermo.ensemble` and :class:`liethermo.Propagator`. Many data that map space
    to body, such as direction-cosine matrices, are its transpose; of a quaternion that is the conjugate.

    Parameters
    ----------
    quaternion : array, shape (..., 4), optional
        Unit quaternions by Hamilton's rule, ``i j = k``; q and -q are the same attitude.
    scalar : {"last", "first"}
        Place of the real part: (x, y, z, w) as in SciPy, or (w, x, y, z).
    euler : array, shape (..., m), optional
        Euler angles (rad), one for each letter of the sequence; one number for a sequence of one letter.
    sequence : str
        One to three of x, y, z, as in SciPy: upper-case letters turn about the axes of the body as it has been turned
        so far ("ZYX" is yaw, pitch, roll), lower-case letters about axes fixed in space.
    degrees : bool
        If true, ``euler`` is in degrees.
    matrix : array, shape (..., 3, 3), optional
        Rotation matrices.
    rotation : scipy.spatial.transform.Rotation, optional
        The attitude, as SciPy represents it.

    Returns
    -------
    array, shape (..., 3, 3)
        An array of NumPy, or of JAX if JAX traces the numbers.

    Raises
    ------
    InputError
        If none or several are given, or the numbers are not a rotation.

    Warns
    -----
    AttitudeWarning
        If the numbers are a rotation only to single precision. They are then projected onto SO(3).

    Examples
    --------
    >>> g = lt.bodies.attitude(euler=(90.0, 0.0, 0.0), sequence="zyx", degrees=True)
    >>> np.allclose(g @ [1.0, 0.0, 0.0], [0.0, 1.0, 0.0])
    True
    >>> np.allclose(
    ...     lt.bodies.attitude(
    ...         quaternion=(np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)), scalar="first"
    ...     ),
    ...     g,
    ... )
    True
    """
    arguments = {"quaternion": quaternion, "euler": euler, "matrix": matrix, "rotation": rotation}
    given_names = [name for name, value in arguments.items() if value is not None]
    if len(given_names) != 1:
        raise InputError(
            f"attitude needs one of {', '.join(f'{name}=' for name in arguments)}, got "
            f"{' and '.join(given_names) or 'none of them'}"
        )
    if quaternion is not None:
        return _matrices_of_quaternions(quaternion, scalar)
    if euler is not None:
        return _matrices_of_euler_angles(euler, sequence, degrees)
    if rotation is not None and not isinstance(rotation, Rotation):
        raise InputError(f"rotation must be a scipy.spatial.transform.Rotation, got {type(rotation).__name__}")
    return rotation_matrices(matrix if rotation is None else rotation)


def attitude_array(attitude: Any, group: mf.MatrixGroup | None) -> Any:
    """Return a user's ``attitude=`` as an array, shape (..., m, m), checked if the group is SO(3).

    Attitudes in other groups, and None, are returned as they are.
    """
    is_body_attitude = group is not None and group.name == mf.SO(3).name
    if isinstance(attitude, Rotation):
        if group is not None and not is_body_attitude:
            raise InputError(f"the attitude must be an element of {group.name}, but a Rotation is one of SO(3)")
        return rotation_matrices(attitude)
    if not is_body_attitude or attitude is None or is_traced(attitude):
        return attitude
    return rotation_matrices(attitude)


def rotation_matrices(rotations: Any) -> np.ndarray | jax.Array:
    """Return checked rotation matrices, shape (..., 3, 3), projected onto SO(3) if in single precision."""
    if isinstance(rotations, Rotation):
        return np.asarray(rotations.as_matrix(), dtype=np.float64)
    matrices = checked_numbers(rotations, "the attitude")
    if matrices.shape[-2:] != (3, 3):
        raise InputError(
            f"an attitude must be a matrix of shape (3, 3), got shape {matrices.shape}: for quaternions and Euler "
            "angles use lt.bodies.attitude(quaternion=...) or lt.bodies.attitude(euler=..., sequence=...)"
        )
    if is_traced(matrices):
        return matrices
    array = np.array(matrices, dtype=np.float64)
    if not np.isfinite(array).all():
        raise InputError("an attitude must be finite, but it has entries that are not")
    nearest = _nearest_rotations(array)
    distance = float(np.abs(array - nearest).max(initial=0.0))
    if distance > SINGLE_PRECISION_TOLERANCE:
        is_reflection = bool((np.linalg.det(array) < 0.0).any())
        reason = "it is a reflection, with determinant -1" if is_reflection else "its columns must be orthonormal"
        raise InputError(
            f"the attitude is not in SO(3): relative distance {distance:.3g}, tolerance {ROTATION_TOLERANCE:.0e}, or "
            f"{SINGLE_PRECISION_TOLERANCE:.0e} for data in single precision; {reason}"
        )
    if distance <= ROTATION_TOLERANCE:
        return array
    _warn_of_single_precision(distance, "an entry of the matrix")
    return nearest


def _warn_of_single_precision(distance: float, quantity: str) -> None:
    """Warn that attitudes are rotations to single precision only, and that the nearest rotations are used."""
    warn(
        f"the attitude is a rotation to single precision only: {quantity} was off by {distance:.1e}. The nearest "
        "rotation is used",
        AttitudeWarning,
    )


def _nearest_rotations(matrices: np.ndarray) -> np.ndarray:
    """Return the rotation matrices, shape (..., 3, 3), nearest to given matrices in the Frobenius norm."""
    U, _, Vt = np.linalg.svd(matrices)
    sign = np.where(np.linalg.det(U @ Vt) < 0.0, -1.0, 1.0)
    U[..., 2] *= sign[..., None]
    return U @ Vt


def check_quaternion_order(scalar_position: str) -> None:
    """Raise InputError unless the position of the real part of quaternions is "last" or "first"."""
    if scalar_position not in ("last", "first"):
        raise InputError(
            f"scalar must be 'last', for (x, y, z, w), or 'first', for (w, x, y, z), got {scalar_position!r}"
        )


def _matrices_of_quaternions(quaternion, scalar: str) -> np.ndarray | jax.Array:
    """Return the rotation matrices, shape (..., 3, 3), of unit quaternions, shape (..., 4)."""
    check_quaternion_order(scalar)
    q: Any = checked_numbers(quaternion, "a quaternion")
    if q.shape[-1:] != (4,):
        raise InputError(f"a quaternion must have shape (..., 4), got {q.shape}")
    if not is_traced(q):
        q = np.array(q, dtype=np.float64)
        norm = np.linalg.norm(q, axis=-1)
        distance = float(np.abs(norm - 1.0).max(initial=0.0))
        if not distance <= SINGLE_PRECISION_TOLERANCE:
            worst_norm = float(norm.flat[int(np.argmax(np.abs(np.ravel(norm) - 1.0)))])
            raise InputError(f"a quaternion must have norm 1, got {worst_norm:.6g}. Give q / np.linalg.norm(q)")
        if distance > ROTATION_TOLERANCE:
            _warn_of_single_precision(distance, "the norm of the quaternion")
    xp: Any = jnp if is_traced(q) else np
    q = q / xp.sqrt(xp.sum(q**2, axis=-1, keepdims=True))
    vector, w = (q[..., :3], q[..., 3]) if scalar == "last" else (q[..., 1:], q[..., 0])
    x, y, z = vector[..., 0], vector[..., 1], vector[..., 2]
    rows = [
        [w * w + x * x - y * y - z * z, 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
        [2.0 * (x * y + w * z), w * w - x * x + y * y - z * z, 2.0 * (y * z - w * x)],
        [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), w * w - x * x - y * y + z * z],
    ]
    return xp.stack([xp.stack(row, axis=-1) for row in rows], axis=-2)


def _matrices_of_euler_angles(euler, sequence: str, degrees: bool) -> np.ndarray | jax.Array:
    """Return the rotation matrices, shape (..., 3, 3), of Euler angles about the axes of a sequence."""
    axes = axis_indices_of_sequence(sequence)
    angles: Any = checked_numbers(euler, "Euler angles")
    if len(axes) == 1 and angles.shape[-1:] != (1,):
        angles = angles[..., None]
    if angles.shape[-1:] != (len(axes),):
        raise InputError(
            f"Euler angles by the sequence {sequence!r} must have shape (..., {len(axes)}), got {angles.shape}"
        )
    xp: Any = jnp if is_traced(angles) else np
    angles = angles if xp is jnp else np.asarray(angles, dtype=np.float64)
    if xp is np and not np.isfinite(angles).all():
        raise InputError("Euler angles must be finite, but some are not")
    angles = xp.deg2rad(angles) if degrees else angles
    turns = [_elementary_rotation(xp, axis, angles[..., i]) for i, axis in enumerate(axes)]
    result = turns[0]
    for turn in turns[1:]:
        result = result @ turn if sequence.isupper() else turn @ result
    return result


def axis_indices_of_sequence(sequence: str) -> list[int]:
    """Return the indices of the rotation axes, 0 to 2, that a sequence such as "zyx" names.

    Raises
    ------
    InputError
        If it is not one to three of x, y, z in one case, or turns twice in succession about one axis.
    """
    is_word = isinstance(sequence, str) and 1 <= len(sequence) <= 3 and (sequence.islower() or sequence.isupper())
    letters = sequence.lower() if is_word else ""
    is_valid = is_word and set(letters) <= set(ELEMENTARY_AXES)
    if not is_valid or any(a == b for a, b in itertools.pairwise(letters)):
        raise InputError(
            "sequence must be one to three of x, y, z, all in lower case (axes in space) or all in upper case (axes of "
            f"the body), no axis twice in succession, got {sequence!r}"
        )
    return [ELEMENTARY_AXES[letter] for letter in letters]


def _elementary_rotation(xp: Any, axis: int, angle) -> Any:
    """Return the rotation matrices about a coordinate axis by angles, shape (..., 3, 3)."""
    c, s, one, zero = xp.cos(angle), xp.sin(angle), xp.ones_like(angle), xp.zeros_like(angle)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    entries = [[zero] * 3 for _ in range(3)]
    entries[axis][axis] = one
    entries[i][i], entries[i][j], entries[j][i], entries[j][j] = c, -s, s, c
    return xp.stack([xp.stack(row, axis=-1) for row in entries], axis=-2)
