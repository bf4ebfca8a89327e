"""Orientation of a body along a run: quaternions, and the angles of its axis about the angular momentum."""

from __future__ import annotations

import warnings
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from ..errors import InputError
from ..models.inertia import EQUAL_MOMENTS_RTOL
from ..systems.rotations import axis_indices_of_sequence, check_quaternion_order
from .audit_evidence import VELOCITY_AXES, AuditableResult

ROTATION_GROUPS = ("SO(3)", "SE(3)")
"""Groups whose elements begin with a rotation matrix in their first three rows and columns."""


def quaternions(solution: AuditableResult, scalar: Literal["last", "first"] = "last") -> np.ndarray:
    """Return the attitudes as unit quaternions, by default (x, y, z, w), which map body axes to spatial axes.

    The first one has ``w >= 0``, and each later one has the sign that is nearer to the one before. So they are
    continuous, as long as the body turns by less than half a turn between the saved times.

    Parameters
    ----------
    solution : Solution, or Ensemble
        A result of a body with attitudes in SO(3), or in SE(3), of which the rotations are taken.
    scalar : {"last", "first"}
        Place of the real part: (x, y, z, w) as in SciPy, or (w, x, y, z).

    Returns
    -------
    ndarray, shape (times, 4); of an ensemble (B, times, 4), or (B, 4) if it has final states only

    Raises
    ------
    InputError
        If it has no such attitudes.
    """
    check_quaternion_order(scalar)
    g = _require_rotation_matrices(solution)
    has_times = _is_time_series(solution)
    is_finite = np.isfinite(g).all(axis=(-2, -1), keepdims=True)
    q = Rotation.from_matrix(np.where(is_finite, g, np.eye(3)).reshape(-1, 3, 3)).as_quat().reshape(*g.shape[:-2], 4)
    q = np.where(q[..., 3:] < 0.0, -q, q)
    if has_times:
        is_opposite = np.sum(q[..., 1:, :] * q[..., :-1, :], axis=-1) < 0.0
        signs = np.cumprod(np.where(is_opposite, -1.0, 1.0), axis=-1)
        q[..., 1:, :] *= signs[..., None]
    q = np.where(is_finite[..., 0], q, np.nan)
    return q if scalar == "last" else np.roll(q, 1, axis=-1)


def rotation(solution: AuditableResult) -> Rotation:
    """Return the attitudes as a ``scipy.spatial.transform.Rotation``, one for each time.

    ``rotation(solution).apply(v)`` has the components in space of vectors v in body axes; ``.inv()`` maps back.

    Parameters
    ----------
    solution : Solution, or Ensemble
        As for :func:`quaternions`. The rotations of an ensemble of trajectories have the shape (B, times).

    Returns
    -------
    scipy.spatial.transform.Rotation

    Raises
    ------
    InputError
        If it has no such attitudes, or some of them are not known because trajectories have ended early.
    """
    g = _require_rotation_matrices(solution)
    if not np.isfinite(g).all():
        raise InputError("some trajectories have ended early, so not all attitudes are known. Use rotation(e[i])")
    return Rotation.from_matrix(g)


def euler_angles(solution: AuditableResult, sequence: str = "zyx", degrees: bool = False) -> np.ndarray:
    """Return Euler angles of the attitudes, in the convention of ``scipy.spatial.transform.Rotation.as_euler``.

    Parameters
    ----------
    solution : Solution, or Ensemble
        As for :func:`quaternions`.
    sequence : str
        Three of x, y, z: upper-case letters for turns about the axes of the body ("ZYX" is yaw, pitch, roll),
        lower-case letters for turns about axes fixed in space.
    degrees : bool
        If true, the angles are in degrees.

    Returns
    -------
    ndarray, shape (times, 3); of an ensemble (B, times, 3), or (B, 3) if it has final states only
        Angles (rad, or degrees) in the order of the letters. The first and the last are from -pi to pi, the middle one
        from -pi/2 to pi/2, or from 0 to pi if the first and last letter are the same. In gimbal lock, where only the
        sum or difference of two angles is defined, the last is 0.

    Raises
    ------
    InputError
        If it has no such attitudes, or the sequence is not of three letters.
    """
    if len(axis_indices_of_sequence(sequence)) != 3:
        raise InputError(f"sequence must have three letters, got {sequence!r}")
    g = _require_rotation_matrices(solution)
    is_finite = np.isfinite(g).all(axis=(-2, -1), keepdims=True)
    rotations = Rotation.from_matrix(np.where(is_finite, g, np.eye(3)).reshape(-1, 3, 3))
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Gimbal lock")  # the docstring says what is returned there
        angles = rotations.as_euler(sequence, degrees=degrees).reshape(*g.shape[:-2], 3)
    return np.where(is_finite[..., 0], angles, np.nan)


def angular_velocity(
    solution: AuditableResult, frame: Literal["body", "space"] = "body", degrees: bool = False
) -> np.ndarray:
    """Return the angular velocity of the rigid body in a system, ``Omega = dH/dPi``.

    With rotors, wheels or dampers inside it is the angular velocity of the body that carries them. A body with internal
    friction as a double bracket turns by ``Omega + sigma``, where sigma is the small velocity of its internal motion.

    Parameters
    ----------
    solution : Solution, or Ensemble
        A result of a body on so(3), with or without internal parts, or on se(3).
    frame : {"body", "space"}
        Axes of the components: axes of the body, or axes fixed in space, which need attitudes.
    degrees : bool
        If true, the unit is degrees / time instead of rad / time.

    Returns
    -------
    ndarray, shape (times, 3); of an ensemble (B, times, 3), or (B, 3) if it has final states only

    Raises
    ------
    InputError
        If the system has no rigid body, no states were kept, or the frame is "space" without attitudes.
    """
    absence = "no angular velocity: its system contains no rigid body on so(3) or se(3)"
    omega = _vectors_in_frame(solution, _require_velocities(solution, "angular_velocity", absence), frame)
    return np.rad2deg(omega) if degrees else omega


def rotor_rates(solution: AuditableResult, degrees: bool = False) -> np.ndarray:
    """Return the rates at which wheels and other rotors turn relative to the body that carries them.

    Parameters
    ----------
    solution : Solution, or Ensemble
        A result of a body with rotors, such as :func:`liethermo.models.reaction_wheels`. A state with given rates is
        ``system.state(angular_velocity=..., rotor_rates=...)``.
    degrees : bool
        If true, the unit is degrees / time instead of rad / time.

    Returns
    -------
    ndarray, shape (times, rotors); in an ensemble trajectories are first

    Raises
    ------
    InputError
        If the system has no rotors, or no states were kept.

    Examples
    --------
    >>> body = lt.models.reaction_wheels(friction=0.01)
    >>> x0 = body.state(angular_velocity=(0, 0, 0.1), rotor_rates=(20.0, 0.0, 5.0))
    >>> run = lt.integrate(body, x0, (0.0, 1.0), 0.5)
    >>> lt.bodies.rotor_rates(run)[0].round(12).tolist()
    [20.0, 0.0, 5.0]
    """
    rates = _require_velocities(solution, "rotor_rates", "no rotor rates: its system is not a rigid body with rotors")
    return np.rad2deg(rates) if degrees else rates


def _require_velocities(solution: AuditableResult, velocity_name: str, absence_message: str) -> np.ndarray:
    """Return velocities at the saved states of a result; raise InputError with ``absence_message`` if it has none."""
    if solution.x is None:
        raise InputError('no states were kept. Run the ensemble with outputs="final" or "trajectory"')
    if velocity_name not in solution.velocity_sources:
        raise InputError(f"the result has {absence_message}")
    return solution.velocity_sources[velocity_name]()


def joint_rates(solution: AuditableResult) -> dict[str, np.ndarray]:
    """Return the rates of the joint coordinates by the name of the body, with the keys of ``solution.joints``.

    Parameters
    ----------
    solution : Solution, or Ensemble
        A result of a tree of jointed bodies, free or on the ground.

    Returns
    -------
    dict of ndarray, shape (times,), or (times, 2) of a universal joint; in an ensemble trajectories are first
        Rates (rad/s, or length / time).

    Raises
    ------
    InputError
        If the system is not a tree of jointed bodies, or no states were kept.

    Examples
    --------
    >>> tree = lt.bodies.Tree()
    >>> bus = tree.add("bus", mass=4.0, inertia=(2.0, 2.0, 3.0))
    >>> wheel = tree.add(
    ...     "wheel",
    ...     1.0,
    ...     inertia=(0.4, 0.4, 0.5),
    ...     parent=bus,
    ...     joint=lt.bodies.Hinge((0, 0, 0), (0, 0, 1)),
    ... )
    >>> system = tree.system()
    >>> solution = lt.integrate(
    ...     system, system.state(joint_rates={"wheel": 0.2}), (0.0, 1.0), 0.5
    ... )
    >>> lt.bodies.joint_rates(solution)["wheel"].round(12).tolist()
    [0.2, 0.2, 0.2]
    """
    rates = _require_velocities(solution, "joint_rates", "no joint rates: its system is not a tree of jointed bodies")
    first_state_index = min(start for start, _ in solution.provenance["joints"].values())
    return solution.split_by_joint(rates, first_state_index)


def angular_momentum(solution: AuditableResult, frame: Literal["body", "space"] = "body") -> np.ndarray:
    """Return the total angular momentum of a body and its internal parts.

    Its components in space are constant, unless a torque acts from outside.

    Parameters
    ----------
    solution : Solution, or Ensemble
        A result of a body whose state begins with its angular momentum in body axes.
    frame : {"body", "space"}
        Axes of the components: axes of the body, or axes fixed in space, which need attitudes.

    Returns
    -------
    ndarray, shape (times, 3); of an ensemble (B, times, 3), or (B, 3) if it has final states only
        Momenta (mass * length**2 / time).

    Raises
    ------
    InputError
        If there is no momentum, or the frame is "space" without attitudes.

    Examples
    --------
    >>> body = lt.models.tumbling_body((3.0, 2.0, 1.0), rate=0.5)
    >>> run = lt.integrate(body, [0.1, 0.2, 1.0], (0.0, 10.0), 0.1)
    >>> momentum = lt.bodies.angular_momentum(run, frame="space")
    >>> np.allclose(momentum, momentum[0], atol=1e-14)
    True
    """
    return _vectors_in_frame(solution, _require_angular_momenta(solution), frame)


def _vectors_in_frame(solution: AuditableResult, vectors: np.ndarray, frame: str) -> np.ndarray:
    """Return the components of vectors, given in body axes, shape (..., 3), in axes of the body or fixed in space."""
    if frame not in ("body", "space"):
        raise InputError(f"frame must be 'body' or 'space', got {frame!r}")
    return vectors if frame == "body" else np.einsum("...ij,...j->...i", _require_rotation_matrices(solution), vectors)


def nutation(solution: AuditableResult, axis=None, degrees: bool = False) -> np.ndarray:
    """Return the angle between a body axis e and the angular momentum, ``arctan2(|e × mu|, e . mu)``, 0 to pi.

    A torque-free body with friction ends at 0, or at pi if it spins about the other end of the axis.

    Parameters
    ----------
    solution : Solution, or Ensemble
        A result of a body whose state begins with its angular momentum in body axes.
    axis : array, shape (3,), optional
        The axis in body axes, of any length. The default is the axis of greatest inertia, or of least inertia if the
        two greatest are equal, as for a rod; its first nonzero component is positive.
    degrees : bool
        If true, the unit is degrees instead of rad.

    Returns
    -------
    ndarray, shape (times,); of an ensemble (B, times), or (B,) if it has final states only
        Angles.

    Raises
    ------
    InputError
        If an axis is needed, or there is no momentum.

    Examples
    --------
    >>> body = lt.models.tumbling_body((3.0, 2.0, 1.0), rate=0.5)
    >>> run = lt.integrate(body, [0.1, 0.2, 1.0], (0.0, 100.0), 0.1)
    >>> angle = lt.bodies.nutation(run, axis=[1.0, 0.0, 0.0])
    >>> bool(angle[0] > 1.0), bool(min(angle[-1], 3.1416 - angle[-1]) < 0.1)
    (True, True)
    """
    mu, (a, b, e) = _require_angular_momenta(solution), _body_frame(solution, axis)
    angles = np.arctan2(np.hypot(mu @ a, mu @ b), mu @ e)
    return np.rad2deg(angles) if degrees else angles


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
    mu, (a, b, _) = _require_angular_momenta(solution), _body_frame(solution, axis)
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
    g, mu, e = _require_rotation_matrices(solution), _require_angular_momenta(solution), _body_frame(solution, axis)[2]
    L = np.einsum("...ij,...j->...i", g, mu)
    if _is_time_series(solution):
        L = L[..., :1, :]
    a, b = _orthogonal_pair(L)
    space_axis = g @ e
    angle = np.arctan2(np.sum(a * space_axis, axis=-1), -np.sum(b * space_axis, axis=-1))
    return _unwrap_in_time(solution, angle)


def orientation_and_velocity_variables(solution: AuditableResult, dims: tuple[str, ...]) -> dict[str, tuple]:
    """Return the variables of a dataset that describe the orientation of a body, and velocities of body and joints.

    Parameters
    ----------
    dims : tuple of str
        Names of the axes before the components.
    """
    variables = {
        name: ((*dims, "quaternion_component")[: values.ndim], values)
        for name, values in orientation_series_by_name(solution).items()
    }
    velocities = {} if solution.x is None else solution.velocities()
    return variables | {name: ((*dims, VELOCITY_AXES[name]), values) for name, values in velocities.items()}


def orientation_series_by_name(solution: AuditableResult) -> dict[str, np.ndarray]:
    """Return a dict of a run's quaternions and, if the inertia is known, its nutation, precession and spin.

    The result is empty without attitudes in SO(3).
    """
    if solution.attitude is None or solution.provenance.get("group") != "SO(3)":
        return {}
    series = {"quaternion": quaternions(solution)}
    if _inertia_or_none(solution) is not None:
        series |= {"nutation": nutation(solution), "precession": precession(solution), "spin": spin(solution)}
    return series


def _require_rotation_matrices(solution: AuditableResult) -> np.ndarray:
    """Return the attitudes of a result, shape (..., 3, 3); raise InputError if it has none in SO(3) or SE(3)."""
    if not isinstance(solution, AuditableResult):
        raise InputError(f"attitudes need a solution or an ensemble, got {solution!r:.60}")
    if solution.attitude is None:
        raise InputError(
            "there are no attitudes. Give the system a group, such as group=mf.SO(3), or a model of a body "
            "attitude=True, and keep states"
        )
    if solution.provenance.get("group") not in ROTATION_GROUPS:
        raise InputError(f"the attitudes must be in SO(3) or SE(3), got {solution.provenance.get('group')}")
    return solution.attitude[..., :3, :3]


def _require_angular_momenta(solution: AuditableResult) -> np.ndarray:
    """Return the first three components of the states, shape (..., 3); raise InputError unless these are on so(3)*."""
    if solution.x is None:
        raise InputError('no states were kept. Run the ensemble with outputs="final" or "trajectory"')
    if not str(solution.provenance.get("algebra", "")).startswith("so(3)"):
        raise InputError(
            f"the state must begin with an angular momentum on so(3)*, but the algebra of this system is "
            f"{solution.provenance.get('algebra')}"
        )
    return solution.x[..., :3]


def _inertia_or_none(solution: AuditableResult) -> np.ndarray | None:
    inertia = solution.provenance.get("inertia")
    return None if inertia is None else np.array(inertia, dtype=float)


def _body_frame(solution: AuditableResult, axis) -> np.ndarray:
    """Return right-handed body axes as rows, shape (3, 3), of which the last is ``axis`` or an axis of inertia."""
    if axis is None:
        inertia = _inertia_or_none(solution)
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
    """Return two unit vectors a, b, shape (..., 3), such that (a, b, e) is a right-handed frame.

    For e = e_1, e_2 or e_3 they are the next two basis vectors in cyclic order.
    """
    norm = np.linalg.norm(e, axis=-1, keepdims=True)
    e = np.divide(e, norm, where=norm > 0.0, out=np.zeros_like(e))
    start = np.eye(3)[(np.argmax(np.abs(e), axis=-1) + 1) % 3]
    a = start - np.sum(start * e, axis=-1, keepdims=True) * e
    a = a / np.linalg.norm(a, axis=-1, keepdims=True)
    return a, np.cross(e, a)


def _is_time_series(solution: AuditableResult) -> bool:
    """Return whether the last axis of the series is time; in an ensemble of final states it is the trajectory."""
    return solution.energy.shape[-1:] == np.shape(solution.t)


def _unwrap_in_time(solution: AuditableResult, angles) -> np.ndarray:
    """Return angles made continuous in time by adding full turns."""
    return np.unwrap(angles, axis=-1) if _is_time_series(solution) else angles
