"""A rigid body with damped wheels inside, whose friction heats it until it spins about one axis."""

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

import manifolds as mf
from manifolds._pytree_module import Module

from ..errors import InputError
from ..systems import EulerPoincareClosedSystem
from .parameters import checked_positive


class _Lagrangian(Module):
    inertia: jax.Array
    wheels: jax.Array
    heat: jax.Array
    temperature: jax.Array

    def __call__(self, xi, S):
        body, wheel = xi[:3], xi[3:]
        kinetic = 0.5 * jnp.dot(self.inertia * body, body) + 0.5 * jnp.dot(self.wheels * (body + wheel), body + wheel)
        return kinetic - self.heat * self.temperature * jnp.exp(S / self.heat)


class _BearingFriction(Module):
    friction: jax.Array

    def __call__(self, xi, S):
        return jnp.concatenate([jnp.zeros(3), -self.friction * xi[3:]])


def body_with_wheels(
    inertia: Sequence[float] = (3.0, 2.0, 1.0),
    wheels: Sequence[float] = (0.3, 0.3, 0.3),
    friction: float = 0.2,
    heat: float = 2.0,
    temperature: float = 1.0,
) -> EulerPoincareClosedSystem:
    """A body with three wheels, one about each principal axis, whose bearing friction heats it.

    ``l = sum I_i Omega_i^2 / 2 + sum J_i (Omega_i + w_i)^2 / 2 - C T_0 exp(S / C)`` on so(3) + R^3, ``f = -k w`` on the
    wheels alone, in the state (Omega, w, S). No friction acts on the rotation as a whole, so the spatial angular
    momentum is constant; the energy of the motion falls to ``|mu|^2 / (2 max(I + J))``, of a spin about the axis of
    greatest inertia with the wheels at rest, and what is lost heats the body: ``T = T_0 exp(S / C)``.

    Parameters
    ----------
    inertia, wheels : three numbers, > 0
        I of the body, J of the wheels (mass * length**2).
    friction, heat, temperature : float, > 0
        k (mass * length**2 / time), the heat capacity C, and T_0.
    """
    body, wheel = _principal_moments(inertia), checked_positive(wheels, "wheels", 3)
    lagrangian = _Lagrangian(body, wheel, checked_positive(heat, "heat"), checked_positive(temperature, "temperature"))
    algebra = mf.direct_sum(mf.so(3), mf.abelian(3))
    return EulerPoincareClosedSystem(algebra, lagrangian, _BearingFriction(checked_positive(friction, "friction")))


def body_with_wheels_rest(momentum, energy, inertia=(3.0, 2.0, 1.0), wheels=(0.3, 0.3, 0.3), heat=2.0) -> float:
    """Return the final temperature, from the norm of the angular momentum and the total energy."""
    greatest = float(np.max(_principal_moments(inertia) + checked_positive(wheels, "wheels", 3)))
    return (float(energy) - float(momentum) ** 2 / (2 * greatest)) / heat


def _principal_moments(inertia) -> jax.Array:
    """Return the principal moments of the body, shape (3,); a tensor is refused, since the wheels need principal
    axes."""
    if np.shape(inertia) == (3, 3):
        raise InputError(
            "inertia must be three principal moments, since there is a wheel along each principal axis, got an array "
            "of shape (3, 3): give liethermo.bodies.principal_axes(inertia).moments"
        )
    return checked_positive(inertia, "inertia", 3)
