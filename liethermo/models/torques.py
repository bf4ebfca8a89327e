"""Torques for ``torque=`` of systems and models; their numbers are parameters that can be varied and differentiated.

Each is a function f(t, mu), f(t, mu, attitude) or f(t, mu, attitude, velocity), to a dual vector of the shape of mu. An
attitude is the matrix from body axes to axes in space, so ``attitude.T @ v`` has the components in the body of a vector
v in space; the velocity is ``dH/dmu``, which begins with the angular velocity in body axes. On a rigid body a torque of
three components acts on the first three of mu, the angular momentum of the body with all that it carries: wheels,
dampers and rotors feel it through the body. Units are any consistent ones, such as those of the SI, named here.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from manifolds._arguments import module_dir_function
from manifolds._arrays import is_traced
from manifolds._pytree_module import Module

from ..errors import InputError
from ..functions.conditions import (
    checked_numbers,
    nonnegative_condition,
    require_condition,
    semidefinite_condition,
)
from ..functions.time_span import FunctionWithBreaks, Table, TableKind, kinks_of_table
from ..functions.time_span import PiecewiseConstant as FunctionPiecewiseConstant
from .inertia import checked_inertia
from .orbits import DipoleField, Orbit, direction_and_distance_to_centre, unit_vector
from .parameters import checked_finite, checked_positive

__all__ = [
    "BDot",
    "ConstantInBody",
    "ConstantInSpace",
    "DipoleField",
    "GravityGradient",
    "Magnetic",
    "Motor",
    "Orbit",
    "PiecewiseConstant",
    "RayleighDrag",
    "SolarPressurePlates",
    "SolarPressureSphere",
    "Table",
    "Tabulated",
    "Thrusters",
]
__dir__ = module_dir_function(__all__)

SOLAR_PRESSURE = 4.56e-6
"""Pressure of sunlight on a black surface at one astronomical unit from the sun (N / m^2)."""


class ConstantInBody(Module):
    """A torque that is fixed in the body, such as that of a thruster that is always on; for any algebra.

    Parameters
    ----------
    moment : array, of the shape of mu; or of shape (3,) on a rigid body
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
    """The gravity-gradient torque on a body on a Kepler orbit, ``3 (G M / r^3) n × I n``.

    The unit vector n, in body axes, points to the centre, and ``G M / r^3`` is the square of the mean motion on a
    circular orbit, and ``(a / r)**3`` times it on an ellipse [Hughes, *Spacecraft Attitude Dynamics*, 1986, 8.1]. In
    space n turns in the plane of the orbit from ``towards``, where it is at t = 0. Its sign does not matter.

    Parameters
    ----------
    inertia : array, shape (3,) or (3, 3)
        Principal moments of inertia of the body with all that it carries, or the tensor, in body axes (kg m^2).
    mean_motion : float, > 0, or an Orbit
        Mean angular velocity of the orbit, ``sqrt(G M / a^3)`` (rad/s); or the orbit, which has all the rest.
    towards, normal : array, shape (3,); optional
        Directions in space, of any length: to the centre at t = 0, (1, 0, 0) by default, and of the angular momentum
        of the orbit, (0, 0, 1) by default.
    eccentricity : float, 0 <= e < 1, optional
        By default the orbit is circular.
    anomaly : float, optional
        True anomaly at t = 0 (rad), 0 by default.

    Raises
    ------
    InputError
        If an argument cannot be used, or one that an Orbit has is given beside it.
    """

    inertia: jax.Array
    mean_motion: jax.Array
    towards: jax.Array
    normal: jax.Array
    eccentricity: jax.Array | None
    anomaly: jax.Array | None

    def __init__(self, inertia, mean_motion, towards=None, normal=None, eccentricity=None, anomaly=None):
        details = {"towards": towards, "normal": normal, "eccentricity": eccentricity, "anomaly": anomaly}
        details = {name: value for name, value in details.items() if value is not None}
        is_circular = eccentricity is None and not isinstance(mean_motion, Orbit)
        if isinstance(mean_motion, Orbit) and details:
            raise InputError(f"an Orbit has {' and '.join(details)} of its own. Give them to lt.torques.Orbit")
        orbit = mean_motion if isinstance(mean_motion, Orbit) else Orbit(mean_motion, **details)
        self.inertia = jnp.asarray(checked_inertia(inertia, allow_rod=True))
        self.mean_motion, self.towards, self.normal = orbit.mean_motion, orbit.towards, orbit.normal
        self.eccentricity, self.anomaly = (None, None) if is_circular else (orbit.eccentricity, orbit.anomaly)

    def __call__(self, t, mu, attitude):
        direction, distance = self._direction_and_distance(t)
        n = attitude.T @ direction
        inertia_times_n = self.inertia * n if self.inertia.ndim == 1 else self.inertia @ n
        return 3.0 * self.mean_motion**2 / distance**3 * jnp.cross(n, inertia_times_n)

    def to_centre(self, t) -> jax.Array:
        """Return the unit vector to the centre of the orbit at time t, in axes fixed in space, shape (3,)."""
        return self._direction_and_distance(t)[0]

    def _direction_and_distance(self, t) -> tuple[jax.Array, Any]:
        """Return the unit vector to the centre of the orbit, shape (3,), and the distance r / a, at time t."""
        if self.eccentricity is not None:
            return direction_and_distance_to_centre(self, t)
        angle = self.mean_motion * t
        return jnp.cos(angle) * self.towards + jnp.sin(angle) * jnp.cross(self.normal, self.towards), 1.0


class Magnetic(Module):
    """The torque of a magnetic field on a dipole of the body, ``m × B``.

    Parameters
    ----------
    dipole : array, shape (3,)
        m, in body axes (A m^2).
    field : array, shape (3,), or function from t to one
        B, in axes in space (T), such as a :class:`DipoleField` along an orbit, or a :class:`Table`.
    """

    dipole: jax.Array
    field: jax.Array | Callable

    def __init__(self, dipole, field):
        self.dipole = checked_finite(dipole, "dipole", 3)
        self.field = field if callable(field) else checked_finite(field, "field", 3)

    def __call__(self, t, mu, attitude):
        field = self.field(t) if callable(self.field) else self.field
        return jnp.cross(self.dipole, attitude.T @ field)


GAIN_CONDITION = nonnegative_condition("gain")
"""Condition on the gain of coils."""


class BDot(Module):
    """The torque of magnetic coils that are driven by the rate of the field in the body, ``m = -k dB/dt``.

    ``tau = m × B``, with ``dB/dt = g^T B'(t) - Omega × B`` in body axes [Stickler & Alfriend, J. Spacecraft 13 (1976)
    282]. In a field that is constant in space, ``tau = -k |B|^2`` times the part of Omega normal to B: a torque from
    outside that takes energy from the body. The work of the ledger falls by this energy, and energy less work is
    constant. The heat is that of the coils and of the source of the field, which are not part of the system.

    Parameters
    ----------
    gain : float, >= 0, or array, shape (3,)
        k, of all coils or of the coils along the body axes (A m^2 s / T).
    field : array, shape (3,), or function from t to one that JAX can differentiate
        B, in axes in space (T).
    """

    gain: jax.Array = eqx.field(metadata=GAIN_CONDITION.metadata)
    field: jax.Array | Callable

    def __init__(self, gain, field):
        self.gain = checked_numbers(gain, "gain", (), (3,))
        GAIN_CONDITION.require(self.gain)
        self.field = field if callable(field) else checked_finite(field, "field", 3)

    def __call__(self, t, mu, attitude, velocity):
        if callable(self.field):
            field, rate = jax.jvp(self.field, (t,), (jnp.ones_like(t),))
        else:
            field, rate = self.field, jnp.zeros(3)
        field_in_body = attitude.T @ field
        dipole = -self.gain * (attitude.T @ rate - jnp.cross(velocity[:3], field_in_body))
        return jnp.cross(dipole, field_in_body)


class RayleighDrag(Module):
    """The drag of a thin gas on a turning body in Rayleigh's form, ``-C (Omega - Omega_gas)``.

    It is linear in the angular velocity of the body relative to the gas around it. For a convex body of size d in free
    molecular flow C is of the size ``rho V d**4`` (density rho, orbital velocity V). The torque is one from outside:
    the work of the ledger has the energy that it takes.

    Parameters
    ----------
    coefficient : float, or array of shape (3,), or (3, 3) symmetric positive semidefinite
        C, in body axes (N m s).
    gas : array, shape (3,)
        Angular velocity of the gas in axes in space (rad/s), such as that of the rotating atmosphere.
    """

    coefficient: jax.Array = eqx.field(metadata=semidefinite_condition("coefficient").metadata)
    gas: jax.Array

    def __init__(self, coefficient, gas=(0.0, 0.0, 0.0)):
        self.coefficient = checked_numbers(coefficient, "coefficient", (), (3,), (3, 3))
        if self.coefficient.ndim == 2 and not is_traced(coefficient):
            C = np.asarray(self.coefficient)
            if not np.array_equal(C, C.T) or np.linalg.eigvalsh(C)[0] < -1e-12 * np.abs(C).max():
                raise InputError(f"coefficient must be symmetric and positive semidefinite, got {C.tolist()}")
        else:
            require_condition(
                self.coefficient, lambda c: (c >= 0.0) & (c < jnp.inf), "coefficient must be >= 0, got {value}"
            )
        self.gas = checked_finite(gas, "gas", 3)

    def __call__(self, t, mu, attitude, velocity):
        relative = velocity[:3] - attitude.T @ self.gas
        C = self.coefficient
        return -(C @ relative if C.ndim == 2 else C * relative)


class SolarPressurePlates(Module):
    """The torque of sunlight on flat plates, ``sum_i c_i × F_i``.

    ``F = -P A cos(theta) ((1 - s) u + 2 (s cos(theta) + d / 3) n)`` on a plate that the sun lights from the side of its
    normal n, with ``cos(theta) = n . u > 0``, and zero on others [Markley & Crassidis, *Fundamentals of Spacecraft
    Attitude Determination and Control*, 2014, 3.167]. No plate shades another.

    Parameters
    ----------
    areas : array, shape (k,), > 0
        A (m^2).
    normals : array, shape (k, 3)
        n in body axes, of any length, to the outside.
    centres : array, shape (k, 3)
        c, the centres of the plates relative to the centre of mass, in body axes (m).
    specular, diffuse : float or array, shape (k,)
        Fractions s and d of the light that are reflected, at most 1 together; the rest is absorbed.
    sun : array, shape (3,), or function from t to one
        Direction u from the body to the sun, in axes in space, of any length.
    pressure : float, or function from t to one
        P (N / m^2); a function that is zero in the shadow of the planet has an eclipse.
    """

    areas: jax.Array
    normals: jax.Array
    centres: jax.Array
    specular: jax.Array
    diffuse: jax.Array
    sun: jax.Array | Callable
    pressure: jax.Array | Callable

    def __init__(
        self, areas, normals, centres, specular=0.0, diffuse=0.0, sun=(1.0, 0.0, 0.0), pressure=SOLAR_PRESSURE
    ):
        areas = jnp.atleast_1d(checked_numbers(areas, "areas"))
        self.areas = checked_positive(areas, "areas", areas.size)
        n, shape = self.areas.size, (self.areas.size, 3)
        normals = jnp.atleast_2d(checked_numbers(normals, "normals"))
        self.centres = jnp.atleast_2d(checked_finite(centres, "centres"))
        if normals.shape != shape or self.centres.shape != shape:
            raise InputError(f"normals and centres must have shape {shape}, got {normals.shape}, {self.centres.shape}")
        lengths = jnp.linalg.norm(normals, axis=1, keepdims=True)
        require_condition(lengths, lambda v: (v > 0.0) & (v < jnp.inf), "normals must not be zero, got lengths {value}")
        self.normals = normals / lengths
        self.specular, self.diffuse = (
            jnp.broadcast_to(checked_numbers(value, name, (), (n,)), (n,))
            for name, value in {"specular": specular, "diffuse": diffuse}.items()
        )
        require_condition(
            jnp.stack([self.specular, self.diffuse, 1.0 - self.specular - self.diffuse]),
            lambda v: v >= -1e-12,
            "specular and diffuse must be fractions with a sum of at most 1; [specular, diffuse, rest] = {value}",
        )
        self.sun = sun if callable(sun) else unit_vector(sun, "sun")
        self.pressure = pressure if callable(pressure) else checked_numbers(pressure, "pressure", ())

    def __call__(self, t, mu, attitude):
        u = attitude.T @ _unit_vector_at_time(self.sun, t)
        cosine = jnp.maximum(self.normals @ u, 0.0)
        along_normal = 2.0 * (self.specular * cosine + self.diffuse / 3.0)
        unit_forces = (1.0 - self.specular)[:, None] * u + along_normal[:, None] * self.normals
        forces = -_evaluate_at_time(self.pressure, t) * (self.areas * cosine)[:, None] * unit_forces
        return jnp.sum(jnp.cross(self.centres, forces), axis=0)


class SolarPressureSphere(Module):
    """The torque of sunlight on a sphere whose centre of pressure is off the centre of mass, ``-P C A c × u``.

    Parameters
    ----------
    area : float, > 0
        A, the cross-section (m^2).
    centre : array, shape (3,)
        c, the centre of pressure relative to the centre of mass, in body axes (m).
    sun : array, shape (3,), or function from t to one
        Direction u from the body to the sun, in axes in space, of any length.
    coefficient : float
        C, from 1 for a body that absorbs light to 1.44 for one that scatters it.
    pressure : float, or function from t to one
        P (N / m^2).
    """

    area: jax.Array
    centre: jax.Array
    sun: jax.Array | Callable
    coefficient: jax.Array
    pressure: jax.Array | Callable

    def __init__(self, area, centre, sun=(1.0, 0.0, 0.0), coefficient=1.0, pressure=SOLAR_PRESSURE):
        self.area, self.centre = checked_positive(area, "area"), checked_finite(centre, "centre", 3)
        self.sun = sun if callable(sun) else unit_vector(sun, "sun")
        self.coefficient = checked_positive(coefficient, "coefficient")
        self.pressure = pressure if callable(pressure) else checked_numbers(pressure, "pressure", ())

    def __call__(self, t, mu, attitude):
        force = (
            -_evaluate_at_time(self.pressure, t)
            * self.coefficient
            * self.area
            * (attitude.T @ _unit_vector_at_time(self.sun, t))
        )
        return jnp.cross(self.centre, force)


class Thrusters(Module):
    """The torque of thrusters that are fixed in the body, ``sum_i u_i(t) r_i × F_i``.

    Parameters
    ----------
    positions : array, shape (k, 3)
        r, relative to the centre of mass, in body axes (m).
    forces : array, shape (k, 3)
        F, the forces on the body at full thrust, in body axes (N): opposite to the jets.
    levels : array, shape (k,), or function from t to one
        u, the thrust as a part of full thrust; all are on by default.
    """

    positions: jax.Array
    forces: jax.Array
    levels: jax.Array | Callable

    def __init__(self, positions, forces, levels=None):
        self.positions = jnp.atleast_2d(checked_finite(positions, "positions"))
        self.forces = jnp.atleast_2d(checked_finite(forces, "forces"))
        n = len(self.positions)
        if self.positions.shape != (n, 3) or self.forces.shape != (n, 3):
            raise InputError(
                f"positions and forces must have shape (k, 3), got {self.positions.shape} and {self.forces.shape}"
            )
        levels = jnp.ones(n) if levels is None else levels
        self.levels = levels if callable(levels) else checked_finite(jnp.atleast_1d(jnp.asarray(levels)), "levels", n)

    def __call__(self, t, mu):
        moments = jnp.cross(self.positions, self.forces)
        return jnp.atleast_1d(_evaluate_at_time(self.levels, t)) @ moments


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
        self.moment = moment if callable(moment) else jnp.atleast_1d(checked_finite(moment, "moment"))

    def __call__(self, t, mu):
        moment = jnp.atleast_1d(self.moment(t) if callable(self.moment) else self.moment)
        n_wheels = mu.shape[0] - 3
        if moment.shape != (n_wheels,):
            raise InputError(
                f"Motor needs one torque for each wheel of the body, which has {n_wheels}, but got shape {moment.shape}"
            )
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
    >>> pulses = lt.torques.PiecewiseConstant(
    ...     [2.0, 2.5, 7.0], [(0.0, 0.0, 0.1), (0.2, 0.0, 0.0)]
    ... )
    >>> body = lt.LiePoissonSystem(mf.so(3), lt.Quadratic([1.0, 0.5, 0.4]), torque=pulses)
    >>> solution = lt.integrate(
    ...     body,
    ...     [0.1, 0.0, 1.0],
    ...     (0.0, 10.0),
    ...     lt.Adaptive(1e-9),
    ...     lt.MetriplecticRungeKutta(8),
    ... )
    >>> bool(np.isin([2.0, 2.5, 7.0], solution.t).all())
    True
    """

    torque: FunctionPiecewiseConstant

    def __init__(self, times, torques):
        self.torque = FunctionPiecewiseConstant(times, torques)

    def __call__(self, t, mu):
        return self.torque(t)


class Tabulated(FunctionWithBreaks):
    """A torque in body axes from a table, linear or cubic in t between its times and zero outside.

    Steps end at the times of a linear table by themselves, unless it has more than 1,000 of them in the span of the run
    or more than the run has steps of a given size. A step across such a time has an error of second order there,
    whatever the method, but the laws hold all the same. See :class:`Table`.

    Parameters
    ----------
    times : array, shape (m,), or a spline of SciPy
        Increasing (s); of a spline such as ``CubicSpline`` the polynomials are taken.
    moments : array, shape ``(m, *shape of mu)``, or (m, 3) on a rigid body
        Torques in body axes at these times (N m, on so(3)); not with a spline.
    kind : {"linear", "cubic"}
        Interpolation between the times.
    """

    times: jax.Array
    moments: jax.Array | None
    coefficients: jax.Array | None

    def __init__(self, times, moments=None, kind: TableKind = "linear"):
        if moments is None and not callable(times):
            raise InputError("a table needs times and moments, or a spline of SciPy alone")
        table = Table(times, moments, kind, name="moments")
        self.times, self.moments, self.coefficients = table.times, table.values, table.coefficients

    @property
    def kink_times(self) -> tuple[float, ...]:
        return kinks_of_table(self.times, self.moments is None)

    def __call__(self, t, mu):
        return Table.from_parts(self.times, self.moments, self.coefficients)(t)


def _evaluate_at_time(quantity, t) -> jax.Array:
    """Return the value of a quantity at time t, from a constant or a function of time."""
    return quantity(t) if callable(quantity) else quantity


def _unit_vector_at_time(quantity, t) -> jax.Array:
    """Return a unit vector at time t, from a constant unit vector or a function of time."""
    if not callable(quantity):
        return quantity
    vector = quantity(t)
    return vector / jnp.sqrt(jnp.sum(vector**2))
