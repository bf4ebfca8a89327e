"""Orientation of a body along a run: quaternions, and the angles of its axis about the angular momentum."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from ..errors import InputError
from ..models.inertia import EQUAL_MOMENTS_RTOL
from .audit_evidence import AuditableResult


def quaternions(solution: AuditableResult) -> np.ndarray:
    """Return the attitudes as unit quaternions (x, y, z, w), scalar last, which map body axes to spatial axes.

    The first one has ``w >= 0``, and each later one has the sign that is nearer to the one before. So they are
    continuous, as long as the body turns by less than half a turn between the saved times.

    Parameters
    ----------
    solution : Solution, or Ensemble
        A result of a body with attitudes in SO(3).

    Returns
    -------
    ndarray, shape (times, 4), or (B, times, 4) of an ensemble of trajectories, (B, 4) of one of final states

    Raises
    ------
    InputError
        If it has no such attitudes.
    """
    g = _attitudes(solution)
    has_times = _is_time_series(solution)
    is_finite = np.isfinite(g).all(axis=(-2, -1), keepdims=True)
    q = Rotation.from_matrix(np.where(is_finite, g, np.eye(3)).reshape(-1, 3, 3)).as_quat().reshape(*g.shape[:-2], 4)
    q = np.where(q[..., 3:] < 0.0, -q, q)
    if has_times:
        is_opposite = np.sum(q[..., 1:, :] * q[..., :-1, :], axis=-1) < 0.0
        signs = np.cumprod(np.where(is_opposite, -1.0, 1.0), axis=-1)
        q[..., 1:, :] *= signs[..., None]
    return np.where(is_finite[..., 0], q, np.nan)


def nutation(solution: AuditableResult, axis=None) -> np.ndarray:
    """Return the angle between a body axis e and the angular momentum, ``arctan2(|e × mu|, e . mu)``, 0 to pi.

    A torque-free body with friction ends at 0, or at pi if it spins about the other end of the axis.

    Parameters
    ----------
    solution : Solution, or Ensemble
        A result of a body whose state begins with its angular momentum in body axes.
    axis : array, shape (3,), optional
        The axis in body axes, of any length. The default is the axis of greatest inertia, or of least inertia if the
        two greatest are equal, as for a rod; its first nonzero component is positive.

    Returns
    -------
    ndarray, shape (times,), or (B, times) of an ensemble of trajectories, (B,) of one of final states
        Angles (rad).

    Raises
    ------
    InputError
        If an axis is needed, or there is no momentum.
    """
    mu, (a, b, e) = _momenta(solution), _body_frame(solution, axis)
    return np.arctan2(np.hypot(mu @ a, mu @ b), mu @ e)


def spin(solution: AuditableResult, axis=None) -> np.ndarray:
    """Return the angle by which the body has turned about its axis, the third of Euler's angles (z, x, z), continuous.

    With body axes (a, b, e), e the axis: ``arctan2(a . mu, b . mu)``. It is not defined while the nutation is 0 or
    pi. For a free body with two equal moments it grows at ``L cos(nutation) (1/I_3 - 1/I_1)``.

    Parameters
    ----------
    solution, axis
        As for :func:`nutation`.

    Returns
    -------
    ndarray, of the shape of :func:`nutation`
        Angles (rad), full turns included; the body must turn by less than half a turn between the saved times. Angles
        of final states are from -pi to pi.

    Raises
    ------
    InputError
        As for :func:`nutation`.
    """
    mu, (a, b, _) = _momenta(solution), _body_frame(solution, axis)
    return _unwrap_in_time(solution, np.arctan2(mu @ a, mu @ b))


def precession(solution: AuditableResult, axis=None) -> np.ndarray:
    """Return the angle by which the axis of the body has turned about the spatial angular momentum, continuous.

    The first of Euler's angles (z, x, z) in spatial axes whose third has the direction of the angular momentum at the
    start. For a free body with two equal moments it grows at ``L / I_1``.

    Parameters
    ----------
    solution, axis
        As for :func:`nutation`, with attitudes.

    Returns
    -------
    ndarray
        As for :func:`spin`.

    Raises
    ------
    InputError
        As for :func:`nutation`, and if there are no attitudes.
    """
    g, mu, e = _attitudes(solution), _momenta(solution), _body_frame(solution, axis)[2]
    L = np.einsum("...ij,...j->...i", g, mu)
    if _is_time_series(solution):
        L = L[..., :1, :]
    a, b = _orthogonal_pair(L)
    space_axis = g @ e
    angle = np.arctan2(np.sum(a * space_axis, axis=-1), -np.sum(b * space_axis, axis=-1))
    return _unwrap_in_time(solution, angle)


def orientation_series(solution: AuditableResult) -> dict[str, np.ndarray]:
    """Return all known series of the orientation of a body by name; empty without attitudes."""
    if not _has_rotations(solution):
        return {}
    series = {"quaternion": quaternions(solution)}
    if _inertia(solution) is not None:
        series |= {"nutation": nutation(solution), "precession": precession(solution), "spin": spin(solution)}
    return series


def _has_rotations(solution: AuditableResult) -> bool:
    """Return whether the result has attitudes in SO(3)."""
    return solution.attitude is not None and solution.provenance.get("group") == "SO(3)"


def _attitudes(solution: AuditableResult) -> np.ndarray:
    if solution.attitude is None:
        raise InputError("there are no attitudes: give the system a group, such as group=mf.SO(3), and keep states")
    if not _has_rotations(solution):
        raise InputError(f"the attitudes must be in SO(3), got {solution.provenance.get('group')}")
    return solution.attitude


def _momenta(solution: AuditableResult) -> np.ndarray:
    if solution.x is None:
        raise InputError('no states were kept: run the ensemble with outputs="final" or "trajectory"')
    if not str(solution.provenance.get("algebra", "")).startswith("so(3)"):
        raise InputError(
            f"the state must begin with an angular momentum on so(3)*, but the algebra of this system is "
            f"{solution.provenance.get('algebra')}"
        )
    return solution.x[..., :3]


def _inertia(solution: AuditableResult) -> np.ndarray | None:
    inertia = solution.provenance.get("inertia")
    return None if inertia is None else np.array(inertia, dtype=float)


def _body_frame(solution: AuditableResult, axis) -> np.ndarray:
    """Return right-handed body axes as rows, shape (3, 3); the last is the axis that angles refer to."""
    if axis is None:
        inertia = _inertia(solution)
        if inertia is None:
            raise InputError(
                "the axis of greatest inertia is unknown, because the energy is not quadratic in the momentum or the "
                "inertias differ in the ensemble. Give axis=, such as (0, 0, 1)"
            )
        moments, axes = np.linalg.eigh(inertia)
        e = axes[:, 2 if moments[2] - moments[1] > EQUAL_MOMENTS_RTOL * moments[2] else 0]
        e = np.sign(e[np.argmax(np.abs(e) > 1e-8)]) * e
    else:
        e = np.asarray(axis, dtype=float)
        if e.shape != (3,) or not np.isfinite(e).all() or not e.any():
            raise InputError(
                f"axis must be three numbers that are not all zero, a direction in body axes, got {axis!r}"
            )
        e = e / np.linalg.norm(e)
    a, b = _orthogonal_pair(e)
    return np.stack([a, b, e])


def _orthogonal_pair(e) -> tuple[np.ndarray, np.ndarray]:
    """Return two unit vectors, shape (..., 3), that complete e to a right-handed frame; cyclic for e_1, e_2 and e_3."""
    norm = np.linalg.norm(e, axis=-1, keepdims=True)
    e = np.divide(e, norm, where=norm > 0.0, out=np.zeros_like(e))
    start = np.eye(3)[(np.argmax(np.abs(e), axis=-1) + 1) % 3]
    a = start - np.sum(start * e, axis=-1, keepdims=True) * e
    a = a / np.linalg.norm(a, axis=-1, keepdims=True)
    return a, np.cross(e, a)


def _is_time_series(solution: AuditableResult) -> bool:
    """Return whether the last axis of the series is time, and not the trajectories of an ensemble of final states."""
    return solution.energy.shape[-1:] == np.shape(solution.t)


def _unwrap_in_time(solution: AuditableResult, angles) -> np.ndarray:
    """Return angles made continuous in time by adding full turns."""
    return np.unwrap(angles, axis=-1) if _is_time_series(solution) else angles
