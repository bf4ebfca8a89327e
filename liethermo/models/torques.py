"""Torques for ``lt.LiePoissonSystem(..., torque=...)``; their numbers are parameters that can be varied and
differentiated.

Each is a function f(t, mu), or f(t, mu, attitude), to a dual vector of the shape of mu. An attitude is the matrix from
body axes to axes in space, so ``attitude.T @ v`` has the components in the body of a vector v in space. Units are any
consistent ones, such as those of the SI, which are named here.
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from manifolds._arrays import is_traced
from manifolds._names import public_dir
from manifolds._pytree_module import Module

from ..errors import InputError
from ..functions.conditions import checked_numbers, require_condition
from ..functions.piecewise_constant import PiecewiseConstant as FunctionPiecewiseConstant
from .inertia import checked_inertia_tensors
from .parameters import checked_finite, checked_positive

__all__ = [
    "ConstantInBody",
    "ConstantInSpace",
    "GravityGradient",
    "Magnetic",
    "Motor",
    "PiecewiseConstant",
    "Tabulated",
]
__dir__ = public_dir(__all__)

MAX_PERPENDICULAR_COSINE = 1e-8
"""Largest cosine of two directions that count as perpendicular."""


class ConstantInBody(Module):
    """A torque that is fixed in the body, such as that of a thruster that is always on; for any algebra.

    Parameters
    ----------
    moment : array, of the shape of mu
        Torque in body axes (N m, on so(3)).
    """

    moment: jax.Array

    def __init__(self, moment):
        self.moment = checked_finite(moment, "moment")

    def __call__(self, t, mu):
        return self.moment


class ConstantInSpace(Module):
    """A torque on a body on so(3) that is fixed in space.

    Parameters
    ----------
    moment : array, shape (3,)
        Torque in axes fixed in space (N m).
    """

    moment: jax.Array

    def __init__(self, moment):
        self.moment = checked_finite(moment, "moment", 3)

    def __call__(self, t, mu, attitude):
        return attitude.T @ self.moment


class GravityGradient(Module):
    """The gravity-gradient torque on a body on a circular orbit, ``3 (G M / r^3) n × I n``.

    The unit vector n, in body axes, points to the centre, and ``G M / r^3`` is the square of the mean motion [Hughes,
    *Spacecraft Attitude Dynamics*, 1986, 8.1]. In space n turns in the plane of the orbit from ``towards``, where it is
    at t = 0. Its sign does not matter.

    Parameters
    ----------
    inertia : array, shape (3,) or (3, 3)
        Principal moments of inertia, or the tensor, in body axes (kg m^2).
    mean_motion : float, > 0
        Angular velocity of the orbit, ``sqrt(G M / r^3)`` (rad/s).
    towards, normal : array, shape (3,)
        Directions in space, of any length: to the centre at t = 0, and of the angular momentum of the orbit.
    """

    inertia: jax.Array
    mean_motion: jax.Array
    towards: jax.Array
    normal: jax.Array

    def __init__(self, inertia, mean_motion, towards=(1.0, 0.0, 0.0), normal=(0.0, 0.0, 1.0)):
        self.inertia = checked_numbers(inertia, "inertia", (3,), (3, 3))
        if self.inertia.ndim == 2 and not is_traced(inertia):
            self.inertia = jnp.asarray(checked_inertia_tensors(self.inertia))
        self.mean_motion = checked_positive(mean_motion, "mean_motion")
        self.towards, self.normal = _unit_vector(towards, "towards"), _unit_vector(normal, "normal")
        if not is_traced((self.towards, self.normal)):
            cosine = float(np.dot(self.towards, self.normal))
            if abs(cosine) > MAX_PERPENDICULAR_COSINE:
                raise InputError(f"towards and normal must be perpendicular, but their cosine is {cosine:.3g}")

    def __call__(self, t, mu, attitude):
        n = attitude.T @ self.to_centre(t)
        inertia_times_n = self.inertia * n if self.inertia.ndim == 1 else self.inertia @ n
        return 3.0 * self.mean_motion**2 * jnp.cross(n, inertia_times_n)

    def to_centre(self, t) -> jax.Array:
        """Return the unit vector to the centre of the orbit at time t, in axes fixed in space, shape (3,)."""
        angle = self.mean_motion * t
        return jnp.cos(angle) * self.towards + jnp.sin(angle) * jnp.cross(self.normal, self.towards)


class Magnetic(Module):
    """The torque of a magnetic field on a dipole of the body, ``m × B``.

    Parameters
    ----------
    dipole : array, shape (3,)
        m, in body axes (A m^2).
    field : array, shape (3,), or function from t to one
        B, in axes in space (T).
    """

    dipole: jax.Array
    field: jax.Array | Callable

    def __init__(self, dipole, field):
        self.dipole = checked_finite(dipole, "dipole", 3)
        self.field = field if callable(field) else checked_finite(field, "field", 3)

    def __call__(self, t, mu, attitude):
        field = self.field(t) if callable(self.field) else self.field
        return jnp.cross(self.dipole, attitude.T @ field)


class Motor(Module):
    """The torques of motors that drive wheels, on a body with wheels: on ``so(3) + R^k``.

    There mu is ``(Pi, l)``: Pi the angular momentum of the body and its wheels, and l that of each wheel about its own
    axis. A motor turns its wheel by a torque, and the body by the opposite: so it changes l alone, ``l' = u``, and its
    work is u times the rate at which the wheel turns against the body.

    Parameters
    ----------
    moment : array, shape (k,), or function from t to one
        u, about the axes of the wheels (N m).
    """

    moment: jax.Array | Callable

    def __init__(self, moment):
        self.moment = moment if callable(moment) else checked_finite(np.atleast_1d(moment), "moment")

    def __call__(self, t, mu):
        moment = jnp.atleast_1d(self.moment(t) if callable(self.moment) else self.moment)
        return jnp.concatenate([jnp.zeros(mu.shape[0] - moment.shape[0]), moment])


class PiecewiseConstant(Module):
    """Torques in body axes that are constant between given times and zero outside, such as the pulses of thrusters.

    The steps of a run end at these times by themselves. A step that ends there sees the torque from before, the next
    one that from after.

    Parameters
    ----------
    times : sequence of float, length m
        Increasing times at which the torque jumps (s).
    torques : array, shape ``(m - 1, *shape of mu)``
        Torques in body axes between two of the times (N m, on so(3)).

    Examples
    --------
    >>> pulses = lt.torques.PiecewiseConstant([2.0, 2.5, 7.0], [(0.0, 0.0, 0.1), (0.2, 0.0, 0.0)])
    >>> body = lt.LiePoissonSystem(mf.so(3), lt.Quadratic([1.0, 0.5, 0.4]), torque=pulses)
    >>> solution = lt.integrate(body, [0.1, 0.0, 1.0], (0.0, 10.0), lt.Adaptive(1e-9), lt.MetriplecticRungeKutta(8))
    >>> bool(np.isin([2.0, 2.5, 7.0], solution.t).all())
    True
    """

    torque: FunctionPiecewiseConstant

    def __init__(self, times, torques):
        self.torque = FunctionPiecewiseConstant(times, torques)

    def __call__(self, t, mu):
        return self.torque(t)


class Tabulated(Module):
    """A torque in body axes from a table, linear in t between its times and zero outside.

    A step across a time of the table has an error of second order there, whatever the method: let steps end at these
    times by ``breaks=``. The laws hold all the same.

    Parameters
    ----------
    times : array, shape (m,)
        Increasing (s).
    moments : array, shape ``(m, *shape of mu)``
        Torques in body axes at these times (N m, on so(3)).
    """

    times: jax.Array
    moments: jax.Array

    def __init__(self, times, moments):
        self.times, self.moments = checked_finite(times, "times"), checked_finite(moments, "moments")
        if self.times.ndim != 1 or self.times.size < 2 or self.moments.shape[:1] != self.times.shape:
            raise InputError(
                f"times must have shape (m,) with m >= 2, and moments m rows, got {self.times.shape} and "
                f"{self.moments.shape}"
            )
        require_condition(self.times, lambda t: t[1:] > t[:-1], "the times of a table must increase, got {value}")

    def __call__(self, t, mu):
        has_begun = jnp.where(t >= self.times, 1.0, 0.0)
        in_interval = (
            has_begun[:-1] - has_begun[1:]
        )  # 1 in the interval that contains t, else 0, so that no search is needed
        fraction = (t - self.times[:-1]) / (self.times[1:] - self.times[:-1])
        return jnp.tensordot(in_interval * (1.0 - fraction), self.moments[:-1], 1) + jnp.tensordot(
            in_interval * fraction, self.moments[1:], 1
        )


def _unit_vector(value, name: str) -> jax.Array:
    array = checked_finite(value, name, 3)
    require_condition(array, lambda v: (v**2).sum() > 0.0, name + " must be a direction, not zero, got {value}")
    return array / jnp.sqrt(jnp.sum(array**2))
