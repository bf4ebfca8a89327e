"""Kepler orbits, and the field of a magnetic dipole along them."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

import manifolds as mf
from manifolds._arrays import is_traced
from manifolds._pytree_module import Module

from ..errors import InputError
from ..functions.conditions import checked_numbers, require_condition
from .parameters import checked_finite, checked_positive

MAX_PERPENDICULAR_COSINE = 1e-8
"""Largest cosine of two directions that count as perpendicular."""

KEPLER_ITERATIONS = 6
"""Steps of Danby's iteration for Kepler's equation, of order 4. Five are enough for e <= 0.999, one is a reserve."""


class Orbit(Module):
    """A Kepler orbit about a mass M: a function from time to the position in axes in space.

    Parameters
    ----------
    mean_motion : float, > 0
        ``n = sqrt(G M / a**3)`` (rad/s).
    radius : float, > 0, optional
        Semi-major axis a (m). Gravity does not need it: it follows from the mean motion.
    eccentricity : float, 0 <= e < 1
        Eccentricity of the orbit.
    towards, normal : array, shape (3,)
        Directions in space, of any length and perpendicular: from the body to the centre at t = 0, and of the angular
        momentum of the orbit.
    anomaly : float
        True anomaly at t = 0 (rad): the angle from the periapsis to the body.
    """

    mean_motion: jax.Array
    radius: jax.Array | None
    eccentricity: jax.Array
    towards: jax.Array
    normal: jax.Array
    anomaly: jax.Array

    def __init__(
        self, mean_motion, radius=None, eccentricity=0.0, towards=(1.0, 0.0, 0.0), normal=(0.0, 0.0, 1.0), anomaly=0.0
    ):
        self.mean_motion = checked_positive(mean_motion, "mean_motion")
        self.radius = None if radius is None else checked_positive(radius, "radius")
        self.eccentricity, self.anomaly = checked_eccentricity(eccentricity), checked_numbers(anomaly, "anomaly", ())
        self.towards, self.normal = checked_orbit_directions(towards, normal)

    def __call__(self, t) -> jax.Array:
        """Return the position relative to the centre at time t, shape (3,) (m)."""
        if self.radius is None:
            raise InputError("the orbit needs its radius (m): lt.torques.Orbit(mean_motion, radius=...)")
        direction, distance = direction_and_distance_to_centre(self, t)
        return -self.radius * distance * direction


def direction_and_distance_to_centre(orbit, t) -> tuple[jax.Array, jax.Array]:
    """Return the unit vector from a body on an orbit to the centre, shape (3,), and the distance r / a, at time t.

    Parameters
    ----------
    orbit : module
        With the fields ``mean_motion``, ``eccentricity``, ``towards``, ``normal`` and ``anomaly`` of an orbit.
    """
    e, start = orbit.eccentricity, orbit.anomaly
    root = jnp.sqrt(1.0 - e**2)
    start_eccentric = jnp.arctan2(root * jnp.sin(start), e + jnp.cos(start))
    mean_anomaly = start_eccentric - e * jnp.sin(start_eccentric) + orbit.mean_motion * t
    E = eccentric_anomaly(mean_anomaly, e)
    cos_E, sin_E = jnp.cos(E), jnp.sin(E)
    distance = 1.0 - e * cos_E
    cos_true, sin_true = (cos_E - e) / distance, root * sin_E / distance
    cos_start, sin_start = jnp.cos(start), jnp.sin(start)
    # the angle from the place at t = 0
    cosine = cos_true * cos_start + sin_true * sin_start
    sine = sin_true * cos_start - cos_true * sin_start
    return cosine * orbit.towards + sine * jnp.cross(orbit.normal, orbit.towards), distance


def eccentric_anomaly(mean_anomaly, eccentricity) -> jax.Array:
    """Solve Kepler's equation ``E - e sin E = M`` for E in [-pi, pi] [Danby, Celest. Mech. 40 (1987) 303]."""
    turn = 2.0 * jnp.pi
    M = mean_anomaly - turn * jnp.round(mean_anomaly / turn)
    e = eccentricity
    E = M + 0.85 * e * jnp.where(M < 0.0, -1.0, 1.0)
    for _ in range(KEPLER_ITERATIONS):
        sine, cosine = e * jnp.sin(E), e * jnp.cos(E)
        f, f1, f2, f3 = E - sine - M, 1.0 - cosine, sine, cosine
        newton = -f / f1
        halley = -f / (f1 + 0.5 * newton * f2)
        E = E - f / (f1 + 0.5 * halley * f2 + halley**2 * f3 / 6.0)
    return E


class DipoleField(Module):
    """The magnetic field of a dipole at the centre of an orbit: a function from time to B in axes in space.

    ``B = (3 (k . r) r / r**2 - k) / r**3`` with the position r. For a dipole moment m it is ``k = mu_0 m / (4 pi)``;
    for the earth |k| is about 7.8e15 T m^3, and k points south.

    Parameters
    ----------
    strength : array, shape (3,)
        k at t = 0, in axes in space (T m^3).
    orbit : function from t to the position relative to the centre, shape (3,)
        Such as an :class:`Orbit` (m).
    rotation : array, shape (3,)
        Angular velocity with which the dipole turns in space (rad/s); zero by default.
    """

    strength: jax.Array
    orbit: Callable
    rotation: jax.Array

    def __init__(self, strength, orbit, rotation=(0.0, 0.0, 0.0)):
        if not callable(orbit):
            raise InputError(
                f"orbit must be a function of t, such as lt.torques.Orbit(...), got {type(orbit).__name__}"
            )
        if isinstance(orbit, Orbit) and orbit.radius is None:
            raise InputError(
                "the field depends on the radius of the orbit. Use lt.torques.Orbit(mean_motion, radius=...)"
            )
        self.strength, self.orbit = checked_finite(strength, "strength", 3), orbit
        self.rotation = checked_finite(rotation, "rotation", 3)

    def __call__(self, t) -> jax.Array:
        r, k = self.orbit(t), rotate_by_vector(self.strength, self.rotation * t)
        r_squared = jnp.dot(r, r)
        return (3.0 * jnp.dot(k, r) / r_squared * r - k) / (r_squared * jnp.sqrt(r_squared))


def rotate_by_vector(vector, rotation_vector) -> jax.Array:
    """Rotate a vector, shape (3,), by a rotation vector; derivatives by the rotation vector exist at zero."""
    return mf.SO(3).exp(rotation_vector) @ vector


def checked_eccentricity(value) -> jax.Array:
    """Return the eccentricity of an ellipse as an array, after checking that it is in [0, 1)."""
    e = checked_numbers(value, "eccentricity", ())
    require_condition(e, lambda v: (v >= 0.0) & (v < 1.0), "eccentricity must be at least 0 and below 1, got {value}")
    return e


def unit_vector(value, name: str) -> jax.Array:
    """Return a vector divided by its length, shape (3,), after checking that it is not zero."""
    array = checked_finite(value, name, 3)
    require_condition(array, lambda v: (v**2).sum() > 0.0, name + " must be a direction, not zero, got {value}")
    return array / jnp.sqrt(jnp.sum(array**2))


def checked_orbit_directions(towards, normal) -> tuple[jax.Array, jax.Array]:
    """Return the unit vectors to the centre and along the angular momentum of an orbit, which must be perpendicular."""
    towards_unit, normal_unit = unit_vector(towards, "towards"), unit_vector(normal, "normal")
    if not is_traced((towards_unit, normal_unit)):
        cosine = float(np.dot(towards_unit, normal_unit))
        if abs(cosine) > MAX_PERPENDICULAR_COSINE:
            raise InputError(f"towards and normal must be perpendicular, but their cosine is {cosine:.3g}")
    return towards_unit, normal_unit
