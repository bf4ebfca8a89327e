"""How a body is turned along a run: quaternions, and the angles of its axis about the angular momentum."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from ..errors import InputError
from ..models.inertia import EQUAL_MOMENTS_RTOL
from .evidence import AuditableResult


def quaternions(solution: AuditableResult) -> np.ndarray:
    """The attitudes as unit quaternions (x, y, z, w), scalar last, that take body axes to those of space.

    The first one has ``w >= 0``, and each other one the sign that is nearer to the one before: so they are
    continuous, as long as the body turns by less than half a turn between the times kept.

    Parameters
    ----------
    solution : Solution, or Ensemble
        Of a body with attitudes in SO(3).

    Returns
    -------
    ndarray, shape (times, 4), or (B, times, 4) of an ensemble of trajectories, (B, 4) of one of final states

    Raises
    ------
    InputError
        If it has no such attitudes.
    """
    g = _attitudes(solution)
    along_time = _is_time_series(solution)
    finite = np.isfinite(g).all(axis=(-2, -1), keepdims=True)
    found = Rotation.from_matrix(np.where(finite, g, np.eye(3)).reshape(-1, 3, 3)).as_quat().reshape(*g.shape[:-2], 4)
    found = np.where(found[..., 3:] < 0.0, -found, found)
    if along_time:
        turned = np.sum(found[..., 1:, :] * found[..., :-1, :], axis=-1) < 0.0
        signs = np.cumprod(np.where(turned, -1.0, 1.0), axis=-1)
        found[..., 1:, :] *= signs[..., None]
    return np.where(finite[..., 0], found, np.nan)


def nutation(solution: AuditableResult, axis=None) -> np.ndarray:
    """The angle between an axis of the body and its angular momentum, ``arctan2(|e × mu|, e . mu)``, from 0 to pi.

    A body that is left to itself ends at 0, or at pi where it spins about the other end of the axis.

    Parameters
    ----------
    solution : Solution, or Ensemble
        Of a body whose state begins with its angular momentum in body axes.
    axis : array, shape (3,), optional
        The axis in body axes, of any length; by default that of greatest inertia, or of least inertia where two are
        the greatest, as of a rod, in the direction in which its first component that is not zero is positive.

    Returns
    -------
    ndarray, shape (times,), or (B, times) of an ensemble of trajectories, (B,) of one of final states
        Angles (rad).

    Raises
    ------
    InputError
        If an axis is needed, or there is no momentum.
    """
    mu, (first, second, third) = _momenta(solution), _body_frame(solution, axis)
    return np.arctan2(np.hypot(mu @ first, mu @ second), mu @ third)


def spin(solution: AuditableResult, axis=None) -> np.ndarray:
    """The angle by which the body has turned about its axis, the third of Euler's angles (z, x, z), continuous.

    With body axes (a, b, e), e the axis: ``arctan2(a . mu, b . mu)``. It is not defined while the nutation is 0 or
    pi. For a free body with two equal moments it grows at ``L cos(nutation) (1/I_3 - 1/I_1)``.

    Parameters
    ----------
    solution, axis
        As for :func:`nutation`.

    Returns
    -------
    ndarray, of the shape of :func:`nutation`
        Angles (rad), whole turns included; less than half a turn may lie between the times kept. Those of
        final states lie from -pi to pi.

    Raises
    ------
    InputError
    """
    mu, (first, second, _) = _momenta(solution), _body_frame(solution, axis)
    return _unwrap_in_time(solution, np.arctan2(mu @ first, mu @ second))


def precession(solution: AuditableResult, axis=None) -> np.ndarray:
    """The angle by which the axis of the body has turned about the angular momentum in space, continuous.

    The first of Euler's angles (z, x, z) in axes of space whose third has the direction of the angular momentum at the
    start. For a free body with two equal moments it grows at ``L / I_1``.

    Parameters
    ----------
    solution, axis
        As for :func:`nutation`, with attitudes.

    Returns
    -------
    ndarray
        As of :func:`spin`.

    Raises
    ------
    InputError
        Likewise, and where there are no attitudes.
    """
    g, mu, e = _attitudes(solution), _momenta(solution), _body_frame(solution, axis)[2]
    L = np.einsum("...ij,...j->...i", g, mu)
    if _is_time_series(solution):
        L = L[..., :1, :]
    first, second = _orthogonal_pair(L)
    pointing = g @ e
    across = np.arctan2(np.sum(first * pointing, axis=-1), -np.sum(second * pointing, axis=-1))
    return _unwrap_in_time(solution, across)


def orientation_series(solution: AuditableResult) -> dict[str, np.ndarray]:
    """All that is known of the orientation of a body, by name; empty where there is no body with attitudes."""
    if not _has_rotations(solution):
        return {}
    found = {"quaternion": quaternions(solution)}
    if _inertia(solution) is not None:
        found |= {"nutation": nutation(solution), "precession": precession(solution), "spin": spin(solution)}
    return found


def _has_rotations(solution: AuditableResult) -> bool:
    """Whether there are attitudes in SO(3)."""
    return solution.attitude is not None and solution.provenance.get("group") == "SO(3)"


def _attitudes(solution: AuditableResult) -> np.ndarray:
    if solution.attitude is None:
        raise InputError("there are no attitudes: give the system a group, such as group=mf.SO(3), and keep states")
    if not _has_rotations(solution):
        raise InputError(f"the attitudes are in {solution.provenance.get('group')}, and rotations are in SO(3)")
    return solution.attitude


def _momenta(solution: AuditableResult) -> np.ndarray:
    if solution.x is None:
        raise InputError('no states were kept: outputs="final" or "trajectory" keeps some')
    if not str(solution.provenance.get("algebra", "")).startswith("so(3)"):
        raise InputError(
            f"angles of a body are for states that begin with a momentum on so(3)*, and this system has the algebra "
            f"{solution.provenance.get('algebra')}"
        )
    return solution.x[..., :3]


def _inertia(solution: AuditableResult) -> np.ndarray | None:
    given = solution.provenance.get("inertia")
    return None if given is None else np.array(given, dtype=float)


def _body_frame(solution: AuditableResult, axis) -> np.ndarray:
    """Body axes, shape (3, 3), as rows, right-handed, of which the last is the one that angles are about."""
    if axis is None:
        inertia = _inertia(solution)
        if inertia is None:
            raise InputError(
                "the axis of greatest inertia is not known, of an energy that is not quadratic in the momentum or of "
                "inertias that differ in an ensemble: give axis=, such as (0, 0, 1)"
            )
        moments, axes = np.linalg.eigh(inertia)
        e = axes[:, 2 if moments[2] - moments[1] > EQUAL_MOMENTS_RTOL * moments[2] else 0]
        e = np.sign(e[np.argmax(np.abs(e) > 1e-8)]) * e
    else:
        e = np.asarray(axis, dtype=float)
        if e.shape != (3,) or not np.isfinite(e).all() or not e.any():
            raise InputError(f"axis is a direction in body axes, three numbers that are not all zero, not {axis!r}")
        e = e / np.linalg.norm(e)
    first, second = _orthogonal_pair(e)
    return np.stack([first, second, e])


def _orthogonal_pair(e) -> tuple[np.ndarray, np.ndarray]:
    """Two directions, shape (..., 3), that make a right-handed frame with vectors: cyclic ones of e_1, e_2 and e_3."""
    size = np.linalg.norm(e, axis=-1, keepdims=True)
    e = np.divide(e, size, where=size > 0.0, out=np.zeros_like(e))
    start = np.eye(3)[(np.argmax(np.abs(e), axis=-1) + 1) % 3]
    first = start - np.sum(start * e, axis=-1, keepdims=True) * e
    first = first / np.linalg.norm(first, axis=-1, keepdims=True)
    return first, np.cross(e, first)


def _is_time_series(solution: AuditableResult) -> bool:
    """Whether the last axis of its series is that of time, and not that of trajectories of which the end is kept."""
    return solution.energy.shape[-1:] == np.shape(solution.t)


def _unwrap_in_time(solution: AuditableResult, found) -> np.ndarray:
    """Angles with whole turns counted along time."""
    return np.unwrap(found, axis=-1) if _is_time_series(solution) else found
