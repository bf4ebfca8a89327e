"""Joints between rigid bodies: hinges, sliders and universal joints, with springs, dampers and motors."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ..functions.conditions import checked_numbers, require_condition
from .parameters import checked_finite


class JointCoordinate(NamedTuple):
    """One degree of freedom of a joint.

    Attributes
    ----------
    axis : array, shape (3,)
        Unit vector of the axis.
    slides : bool
        True for a translation along the axis, False for a rotation about it.
    stiffness, rest, damping : array, shape ()
    """

    axis: jax.Array
    slides: bool
    stiffness: jax.Array
    rest: jax.Array
    damping: jax.Array


class Hinge:
    """A hinge: the body turns about one axis relative to its parent.

    Parameters
    ----------
    at : array, shape (3,)
        A point of the axis, in axes of the parent from its origin (length). It is the origin of the body.
    axis : array, shape (3,)
        Direction of the axis in axes of the parent, of any length. A positive angle turns the body by the right hand.
    stiffness : float, >= 0
        Torque per angle of a spring (N m / rad).
    damping : float, >= 0
        Torque per angular velocity of a viscous damper (N m s / rad).
    rest_angle : float
        Angle (rad) at which the spring is relaxed.
    motor : float, or function from the time t, shape (), to one; optional
        Torque on the body about the axis (N m); the parent gets the opposite. Motors may also be given by
        :meth:`Tree.system`.

    Raises
    ------
    InputError

    Examples
    --------
    >>> hinge = lt.bodies.Hinge(
    ...     at=(0.5, 0.1, 0.0), axis=(0.0, 1.0, 0.0), stiffness=4.0, damping=0.3
    ... )
    >>> hinge.size
    1
    """

    size = 1

    def __init__(self, at, axis, stiffness=0.0, damping=0.0, rest_angle=0.0, motor: Any = None):
        self.at = checked_finite(at, "at of a hinge", 3)
        self.motor = _checked_motor(motor, "a hinge")
        self.coordinates = (
            _make_joint_coordinate(axis, False, stiffness, rest_angle, damping, "a hinge", "rest_angle"),
        )


class Slider:
    """A slider: the body moves along one axis against its parent, without turning.

    Parameters
    ----------
    at : array, shape (3,)
        Origin of the body if the displacement is zero, in axes of the parent from its origin (length).
    axis : array, shape (3,)
        Direction of the axis in axes of the parent, of any length.
    stiffness : float, >= 0
        Force per displacement of a spring (N / m).
    damping : float, >= 0
        Force per velocity of a viscous damper (N s / m).
    rest_displacement : float
        Displacement (m) at which the spring is relaxed.
    motor : float, or function from the time t, shape (), to one; optional
        Force on the body along the axis (N); the parent gets the opposite.

    Raises
    ------
    InputError

    Examples
    --------
    >>> lt.bodies.Slider(at=(0.0, 0.0, 0.2), axis=(0.0, 0.0, 1.0), stiffness=10.0).size
    1
    """

    size = 1

    def __init__(self, at, axis, stiffness=0.0, damping=0.0, rest_displacement=0.0, motor: Any = None):
        self.at = checked_finite(at, "at of a slider", 3)
        self.motor = _checked_motor(motor, "a slider")
        rest_name = "rest_displacement"
        self.coordinates = (
            _make_joint_coordinate(axis, True, stiffness, rest_displacement, damping, "a slider", rest_name),
        )


class Universal:
    """A universal joint: two hinges at one point, the first fixed in the parent, the second in the body.

    The body turns by ``R(axes[0], q[0]) R(axes[1], q[1])`` against its parent.

    Parameters
    ----------
    at : array, shape (3,)
        The point where the axes meet, in axes of the parent from its origin (length). It is the origin of the body.
    axes : array, shape (2, 3)
        Directions of the two axes in axes of the parent if both angles are zero, not parallel.
    stiffness, damping : float, >= 0, or two
        Of each axis, as for :class:`Hinge`.
    rest_angles : float, or two
        Angles (rad) at which the springs are relaxed.
    motor : two numbers, or function from the time t, shape (), to an array of shape (2,); optional
        Torques about the axes (N m).

    Raises
    ------
    InputError

    Examples
    --------
    >>> lt.bodies.Universal(
    ...     at=(0.0, 0.0, 1.0), axes=[(1.0, 0.0, 0.0), (0.0, 1.0, 0.0)], stiffness=2.0
    ... ).size
    2
    """

    size = 2

    def __init__(self, at, axes, stiffness=0.0, damping=0.0, rest_angles=0.0, motor: Any = None):
        self.at = checked_finite(at, "at of a universal joint", 3)
        self.motor = _checked_motor(motor, "a universal joint")
        directions = checked_numbers(axes, "axes of a universal joint", (2, 3))
        pairs = {"stiffness": stiffness, "damping": damping, "rest_angles": rest_angles}
        values = {name: _checked_pair(value, f"{name} of a universal joint") for name, value in pairs.items()}
        self.coordinates = tuple(
            _make_joint_coordinate(
                directions[i],
                False,
                values["stiffness"][i],
                values["rest_angles"][i],
                values["damping"][i],
                "a universal joint",
                "rest_angles",
            )
            for i in range(2)
        )
        sine = jnp.linalg.norm(jnp.cross(self.coordinates[0].axis, self.coordinates[1].axis))
        require_condition(
            sine, lambda s: s > MIN_AXES_SINE, "the axes of a universal joint must not be parallel, got a sine {value}"
        )


Joint = Hinge | Slider | Universal
"""Types of joints."""

MIN_AXES_SINE = 1e-8
"""Least sine of the angle between the axes of a universal joint: the rounding of directions given to eight digits."""


def _make_joint_coordinate(
    axis, slides: bool, stiffness, rest, damping, joint_text: str, rest_name: str
) -> JointCoordinate:
    direction = checked_finite(axis, f"axis of {joint_text}", 3)
    require_condition(
        direction,
        lambda a: jnp.any(a != 0.0),
        f"the axis of {joint_text} must be a direction, not zero, got {{value}}. Give one such as (0, 0, 1)",
    )
    return JointCoordinate(
        direction / jnp.linalg.norm(direction),
        slides,
        _checked_coefficient(stiffness, f"stiffness of {joint_text}"),
        checked_finite(checked_numbers(rest, f"{rest_name} of {joint_text}", ()), f"{rest_name} of {joint_text}"),
        _checked_coefficient(damping, f"damping of {joint_text}"),
    )


def _checked_coefficient(value, name: str) -> jax.Array:
    number = checked_numbers(value, name, ())
    require_condition(number, lambda c: (c >= 0.0) & (c < jnp.inf), name + " must be finite and >= 0, got {value}")
    return number


def _checked_pair(value, name: str) -> jax.Array:
    return jnp.broadcast_to(checked_numbers(value, name, (), (2,)), (2,))


def _checked_motor(motor: Any, joint_text: str) -> Callable | jax.Array | None:
    """Return a motor as a function of time or as a finite array; None if the joint has no motor."""
    if motor is None or callable(motor):
        return motor
    return checked_finite(np.atleast_1d(motor), f"motor of {joint_text}")
