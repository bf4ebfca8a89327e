"""A rigid body with damped wheels inside, whose friction heats it until it spins about one axis."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import manifolds as mf
from manifolds._pytree_module import Module

from ..errors import InputError
from ..functions.conditions import positive_condition
from ..systems import EulerPoincareClosedSystem, LiePoissonSystem
from ..systems.torque import (
    MAX_ARGUMENTS_WITHOUT_ATTITUDE,
    evaluate_torque,
    torque_name,
    traced_torque_and_argument_counts,
)
from .inertia import INERTIA_CONDITION, checked_inertia
from .parameters import checked_positive
from .rotors import reaction_wheels


class _Lagrangian(Module):
    inertia: jax.Array = eqx.field(metadata=INERTIA_CONDITION.metadata)
    wheels: jax.Array = eqx.field(metadata=positive_condition("wheels").metadata)
    heat: jax.Array = eqx.field(metadata=positive_condition("heat").metadata)
    temperature: jax.Array = eqx.field(metadata=positive_condition("temperature").metadata)

    def __call__(self, xi, S):
        body, wheel = xi[:3], xi[3:]
        momentum = self.inertia @ body if self.inertia.ndim == 2 else self.inertia * body
        kinetic = 0.5 * jnp.dot(momentum, body) + 0.5 * jnp.dot(self.wheels * (body + wheel), body + wheel)
        return kinetic - self.heat * self.temperature * jnp.exp(S / self.heat)


class _BearingFriction(Module):
    friction: jax.Array = eqx.field(metadata=positive_condition("friction").metadata)

    def __call__(self, xi, S):
        return jnp.concatenate([jnp.zeros(3), -self.friction * xi[3:]])


class _TorqueOfMomentum(Module):
    """An external force: a torque that depends on time and on the momentum ``l_xi``."""

    lagrangian: _Lagrangian
    torque: Any
    counts: tuple[int, ...] = eqx.field(static=True)

    def __call__(self, xi, S, t):
        return evaluate_torque(self.torque, self.counts, t, jax.grad(self.lagrangian)(xi, S), None, xi)


def body_with_wheels(
    inertia: Sequence[float] = (3.0, 2.0, 1.0),
    wheels: Sequence[float] = (0.3, 0.3, 0.3),
    friction: float = 0.2,
    heat: float = 2.0,
    temperature: float = 1.0,
    torque=None,
    attitude: bool = False,
) -> EulerPoincareClosedSystem | LiePoissonSystem:
    """A body with three wheels, one about each body axis, whose bearing friction heats it.

    ``l = sum I_i Omega_i^2 / 2 + sum J_i (Omega_i + w_i)^2 / 2 - C T_0 exp(S / C)`` on so(3) + R^3, ``f = -k w`` on the
    wheels alone, in the state (Omega, w, S). The friction is internal, so the spatial angular momentum is constant. The
    kinetic energy falls to ``|mu|^2 / (2 max(I + J))``, its value in a spin about the axis of greatest inertia with the
    wheels at rest. The lost energy heats the body to ``T = T_0 exp(S / C)``.

    Parameters
    ----------
    inertia : three positive numbers, or array of shape (3, 3)
        Principal moments I of the body without its wheels, or its tensor in body axes (mass * length**2).
    wheels : three numbers, > 0
        J of the wheels, one about each body axis (mass * length**2).
    friction, heat, temperature : float, > 0
        k (mass * length**2 / time), the heat capacity C, and T_0.
    torque : torque of (t, mu), or a list of them; optional
        Torques from outside and of motors on the wheels, where mu is ``l_xi``, the angular momentum of the whole and
        those of the wheels: see :mod:`liethermo.torques`. The state then has the work, the heat and the time behind S.
        Torques that depend on the attitude need ``attitude=True``.
    attitude : bool
        If true, runs follow the attitude of the body, an element of SO(3). The system is then the one of
        :func:`reaction_wheels`, with the state (L, p, y): the angular momentum L of the whole in body axes, the momenta
        of the wheels, ``p_i = J_i (Omega_i + w_i)``, and the entropy y of the bath, whose energy is ``C (T - T_0)``.

    Raises
    ------
    InputError

    Examples
    --------
    >>> body = lt.models.body_with_wheels(attitude=True)
    >>> x0 = body.state(angular_velocity=(0.1, 1.0, 0.1), rotor_rates=(0.0, 0.0, 0.5))
    >>> run = lt.integrate(body, x0, (0.0, 5.0), 0.1)
    >>> lt.bodies.quaternions(run).shape, lt.bodies.euler_angles(run, "zyx").shape
    ((51, 4), (51, 3))
    """
    body, wheel = jnp.asarray(checked_inertia(inertia)), checked_positive(wheels, "wheels", 3)
    lagrangian = _Lagrangian(body, wheel, checked_positive(heat, "heat"), checked_positive(temperature, "temperature"))
    bearing = _BearingFriction(checked_positive(friction, "friction"))
    if attitude:
        total_inertia = jnp.diag(wheel) + (body if body.ndim == 2 else jnp.diag(body))
        arrays: dict[str, Any] = {"inertia": total_inertia, "axes": jnp.eye(3), "wheels": wheel}
        return reaction_wheels(**arrays, friction=friction, capacity=heat, temperature=temperature, torque=torque)
    algebra = mf.direct_sum(mf.so(3), mf.abelian(3))
    external = None
    if torque is not None:
        torque, counts = traced_torque_and_argument_counts(torque, algebra, mf.SO(3))
        if max(counts) > MAX_ARGUMENTS_WITHOUT_ATTITUDE:
            raise InputError(
                f"body_with_wheels follows no attitude, but its torque {torque_name(torque)} needs it. Give "
                "attitude=True"
            )
        external = _TorqueOfMomentum(lagrangian, torque, counts)
    return EulerPoincareClosedSystem(algebra, lagrangian, bearing, external=external)


def body_with_wheels_rest(momentum, energy, inertia=(3.0, 2.0, 1.0), wheels=(0.3, 0.3, 0.3), heat=2.0) -> float:
    """Return the final temperature, from the norm of the angular momentum and the total energy."""
    body, wheel = np.asarray(checked_inertia(inertia)), np.asarray(checked_positive(wheels, "wheels", 3))
    greatest = float(np.linalg.eigvalsh((np.diag(body) if body.ndim == 1 else body) + np.diag(wheel))[-1])
    return (float(energy) - float(momentum) ** 2 / (2 * greatest)) / heat
