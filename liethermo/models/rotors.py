"""Bodies with a rotor about an axis fixed in them: damper wheel, ring damper, dual spin."""

from __future__ import annotations

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import manifolds as mf

from ..dissipation.base import Damping, Dissipation
from ..dissipation.checks import RATE_CONDITION, checked_rate
from ..dissipation.factor import Factor
from ..errors import InputError
from ..functions.conditions import checked_numbers, nonnegative_condition, require_condition
from ..functions.energy import Quadratic
from ..functions.frames import sqrt_or_zero
from ..functions.indices import Indices
from ..systems import HeatBaths, LiePoissonSystem
from .inertia import checked_inertia, inverse_inertia
from .parameters import checked_positive

FRICTION_CONDITION = nonnegative_condition("friction")
"""Condition on the friction of bearings."""


class BearingFriction(Damping):
    """Viscous friction ``p_i' = -k_i dH/dp_i`` in the bearings of rotors of momenta p; the total angular momentum is
    conserved.

    Parameters
    ----------
    friction : float, or array, shape (rotors,), >= 0
        k, of one rotor or of each.
    bath : Indices
        The bath that the friction heats.
    """

    friction: jax.Array = eqx.field(metadata=FRICTION_CONDITION.metadata)

    @property
    def _n_rotors(self) -> int:
        return self.friction.size

    def force(self, system, x, dH, dS, dL):
        rates = dH[3 : 3 + self._n_rotors]
        return jnp.zeros_like(x).at[3 : 3 + self._n_rotors].set(-self.friction * rates)

    def added_attitude_velocity(self, system, x, dH, dS, dL):
        return jnp.zeros_like(dH)

    def factor(self, system, x, dH, dL):
        n = self._n_rotors
        zero_velocity = lambda w: jnp.zeros_like(x)  # noqa: E731
        if self.friction.ndim == 0:
            momentum_rate = lambda w: jnp.zeros_like(x).at[3].set(w[0])  # noqa: E731
            return Factor(1, momentum_rate, True, added_attitude_velocity=zero_velocity).scale_by(self.friction)
        roots = sqrt_or_zero(self.friction)
        momentum_rates = lambda w: jnp.zeros_like(x).at[3 : 3 + n].set(roots * w)  # noqa: E731
        return Factor(n, momentum_rates, True, added_attitude_velocity=zero_velocity)


class RotorFriction(Damping):
    """Friction inside the rotor: a double bracket in the axes of the rotor.

    ``L' = L × sigma, p' = a . (L × sigma)`` with ``sigma = rate L × (Omega + w a)`` damps the motion of L in the
    rotor's axes, and ``H' = -rate |L × (Omega + w a)|**2``. With a = 0 it is friction inside the platform.

    Parameters
    ----------
    rate : float, >= 0
    axis : array, shape (3,)
        a, or zeros for friction inside the platform.
    bath : Indices
    """

    rate: jax.Array = eqx.field(metadata=RATE_CONDITION.metadata)
    axis: jax.Array

    def _momentum_rate(self, x, velocity) -> jax.Array:
        torque = jnp.cross(x[:3], velocity)
        return jnp.append(torque, jnp.dot(self.axis, torque))

    def force(self, system, x, dH, dS, dL):
        return self._momentum_rate(x, self.added_attitude_velocity(system, x, dH, dS, dL)[:3])

    def added_attitude_velocity(self, system, x, dH, dS, dL):
        return jnp.append(self.rate * jnp.cross(x[:3], dH[:3] + dH[3] * self.axis), 0.0)

    def factor(self, system, x, dH, dL):
        momentum_rate = lambda w: self._momentum_rate(x, w)  # noqa: E731
        return Factor(3, momentum_rate, added_attitude_velocity=lambda w: jnp.append(w, 0.0)).scale_by(self.rate)


def damper_wheel(
    inertia: Sequence[float] = (2.0, 1.6, 1.0),
    axis: Sequence[float] = (0.0, 1.0, 0.0),
    wheel: float = 0.1,
    friction: float = 0.05,
    capacity: float = 1.0,
    temperature: float = 1.0,
    attitude: bool = True,
    torque=None,
) -> LiePoissonSystem:
    """A body with a wheel whose bearing is viscous, the simplest nutation damper [Hughes 1986, Likins 1967].

    ``L' = L × Omega``, ``p' = -k w``, ``T y' = k w**2``, with the angular momentum ``L = I Omega + J w a`` of the whole
    in body axes and that of the wheel about its axis, ``p = J (a . Omega + w)``, w its velocity relative to the body.
    The energy ``Omega . I Omega / 2 + J w a . Omega + J w**2 / 2 + C (T - T_0)``, ``|L|`` and the angular momentum in
    space are constant, and the body ends in a spin about the axis of greatest inertia with the wheel at rest: see
    :func:`spin_temperature`.

    Everything is in SI units, or in any other consistent ones. The state is (L, p, y).

    Parameters
    ----------
    inertia : three positive numbers, or array of shape (3, 3)
        Principal moments I of the whole, or its tensor in body axes, the wheel held fast (kg m**2).
    axis : three numbers
        a, the direction of the axis of the wheel in body axes, of any length.
    wheel : float, > 0
        J, the moment of the wheel about its axis (kg m**2), a part of I.
    friction : float, >= 0
        k (N m s).
    capacity, temperature : float, > 0
        Heat capacity C (J / K) of the bath, and its temperature T_0 (K) at y = 0.
    attitude : bool
        If true, runs follow the attitude of the body, an element of SO(3).
    torque : torque, or a list of them; optional
        Torques (N m) on the body from outside, and of motors on the wheel: see :mod:`liethermo.torques`.

    Raises
    ------
    InputError
        If the body without the wheel had an inertia that is not positive, or another parameter cannot be used.
    """
    k, baths = checked_rate(friction), HeatBaths(capacity, temperature)
    return _rotor_system(inertia, axis, wheel, lambda a: BearingFriction(k), baths, attitude, torque)


def ring_damper(
    inertia: Sequence[float] = (2.0, 1.6, 1.0),
    axis: Sequence[float] = (0.0, 1.0, 0.0),
    radius: float = 0.5,
    tube: float = 0.02,
    density: float = 1000.0,
    viscosity: float = 0.05,
    capacity: float = 1.0,
    temperature: float = 1.0,
    attitude: bool = True,
    torque=None,
) -> LiePoissonSystem:
    """A body with a ring of viscous liquid about an axis: a nutation damper [Carrier & Miles 1960].

    The liquid turns in the ring as a wheel does, see :func:`damper_wheel`, with ``J = 2 pi**2 rho a**2 R**3`` and, in
    Poiseuille's flow, ``k = 16 pi**2 eta R**3``. That is for liquids so viscous that the profile of the flow follows
    the nutation: ``a sqrt(omega rho / eta)`` is at most about 1.

    Parameters
    ----------
    inertia, axis, capacity, temperature, attitude, torque
        As for :func:`damper_wheel`, with the liquid as the wheel; ``axis`` is the normal of the ring.
    radius, tube : float, > 0
        R of the ring and a of the tube (m), a thin one: a is far below R.
    density : float, > 0
        rho of the liquid (kg / m**3).
    viscosity : float, > 0
        Dynamic viscosity eta (Pa s).

    Raises
    ------
    InputError
    """
    R, a = checked_positive(radius, "radius"), checked_positive(tube, "tube")
    J = 2.0 * np.pi**2 * checked_positive(density, "density") * a**2 * R**3
    k = 16.0 * np.pi**2 * checked_positive(viscosity, "viscosity") * R**3
    baths = HeatBaths(capacity, temperature)
    return _rotor_system(inertia, axis, J, lambda a: BearingFriction(k), baths, attitude, torque)


def dual_spin(
    inertia: Sequence[float] = (1.0, 1.0, 0.6),
    axis: Sequence[float] = (0.0, 0.0, 1.0),
    rotor: float = 0.3,
    friction: float = 0.0,
    platform_rate: float = 0.0,
    rotor_rate: float = 0.0,
    capacity: Sequence[float] | float = 1.0,
    temperature: Sequence[float] | float = 1.0,
    attitude: bool = True,
    torque=None,
) -> LiePoissonSystem:
    """Two bodies on a common axis, each with internal friction: a dual-spin satellite [Likins 1967].

    The platform carries body axes; the rotor, round about the axis a, turns by w relative to it. As in
    :func:`damper_wheel`, ``L = I Omega + J w a`` and ``p = J (a . Omega + w)``. Friction inside the platform damps
    what it sees of the motion of L, ``L × Omega``, and friction inside the rotor ``L × (Omega + w a)``: each is a
    double bracket in the axes of its part, so |L| and the angular momentum in space are constant, and each heats its
    own bath. The bearing heats the platform. If the rotor carries most of L along a, the spin about a is stable
    although its moment is not the greatest, as long as the platform damps much more than the rotor.

    Everything is in SI units, or in any other consistent ones. The state is (L, p, y of the platform, y of the rotor).

    Parameters
    ----------
    inertia : three positive numbers, or array of shape (3, 3)
        Principal moments I of the whole, or its tensor, in axes of the platform, the rotor held fast (kg m**2).
    axis : three numbers
        a, the direction of the common axis in those axes, of any length.
    rotor : float, > 0
        J, the moment of the rotor about the axis (kg m**2), a part of I.
    friction : float, >= 0
        k of the bearing (N m s).
    platform_rate, rotor_rate : float, >= 0
        Rates of the internal friction of platform and rotor (s / (kg m**2)), as for :func:`tumbling_body`.
    capacity, temperature : float, > 0, or two
        Heat capacities C (J / K) of the baths, platform first, and their temperatures T_0 (K) at y = 0.
    attitude : bool
        If true, runs follow the attitude of the platform, an element of SO(3).
    torque : torque, or a list of them; optional
        Torques (N m) on the platform from outside, and of a motor between the parts: see :mod:`liethermo.torques`.

    Raises
    ------
    InputError
    """
    k, rates = checked_rate(friction), (checked_rate(platform_rate), checked_rate(rotor_rate))

    def make_dissipations(a) -> list[Dissipation]:
        platform_axis = jnp.zeros(3)
        return [
            BearingFriction(k),
            RotorFriction(rates[0], platform_axis),
            RotorFriction(rates[1], a, bath=Indices(1)),
        ]

    baths = HeatBaths(capacity, temperature, number=2)
    return _rotor_system(inertia, axis, rotor, make_dissipations, baths, attitude, torque)


def reaction_wheels(
    inertia: Sequence[float] = (3.0, 2.0, 1.5),
    axes: Sequence[Sequence[float]] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
    wheels: Sequence[float] | float = 0.1,
    friction: Sequence[float] | float = 0.0,
    capacity: float = 1.0,
    temperature: float = 1.0,
    attitude: bool = True,
    torque=None,
) -> LiePoissonSystem:
    """A body with any number of wheels about axes of any directions, driven by motors and slowed by bearings.

    ``L' = L × Omega + tau, p_i' = u_i - k_i w_i``, with the angular momentum ``L = I Omega + sum J_i w_i a_i`` of the
    whole in body axes and that of each wheel about its axis, ``p_i = J_i (a_i . Omega + w_i)``. The motors are a
    ``lt.torques.Motor(u)`` among the torques. Bearing friction heats a bath. See :func:`damper_wheel`.

    Everything is in SI units, or in any other consistent ones. The state is (L, p_1, ..., p_k, y).

    Parameters
    ----------
    inertia : three positive numbers, or array of shape (3, 3)
        Principal moments I of the whole, or its tensor in body axes, the wheels held fast (kg m**2).
    axes : array, shape (k, 3)
        Directions a_i of the axes of the wheels in body axes, of any length.
    wheels : float, or k numbers, > 0
        J_i, the moments of the wheels about their axes (kg m**2), a part of I.
    friction : float, or k numbers, >= 0
        k_i of the bearings (N m s).
    capacity, temperature : float, > 0
        Heat capacity C (J / K) of the bath, and its temperature T_0 (K) at y = 0.
    attitude : bool
        If true, runs follow the attitude of the body, an element of SO(3).
    torque : torque, or a list of them; optional
        Torques (N m) on the body from outside, and of the motors of the wheels: see :mod:`liethermo.torques`.

    Raises
    ------
    InputError
        If the body without the wheels had an inertia that is not positive, or another parameter cannot be used.

    Examples
    --------
    >>> motors = lt.torques.Motor([0.01, 0.0, 0.0])
    >>> body = lt.models.reaction_wheels(torque=motors)
    >>> run = lt.integrate(
    ...     body, body.state(angular_velocity=(0.0, 0.0, 0.0)), (0.0, 10.0), 0.1
    ... )
    >>> (
    ...     bool(lt.bodies.angular_velocity(run)[-1, 0] < 0.0),
    ...     float(abs(run.x[-1, :3]).max()) < 1e-15,
    ... )
    (True, True)
    """
    directions = jnp.atleast_2d(checked_numbers(axes, "axes"))
    n = directions.shape[0]
    k = jnp.broadcast_to(checked_numbers(friction, "friction", (), (n,)), (n,))
    FRICTION_CONDITION.require(k)
    baths = HeatBaths(capacity, temperature)
    return _rotor_system(inertia, axes, wheels, lambda a: BearingFriction(k), baths, attitude, torque)


def spin_temperature(momentum, energy, inertia, capacity=1.0, temperature=1.0) -> float:
    """Return the temperature (K) of an isolated body in its final spin, with one bath and parts at rest.

    Parameters
    ----------
    momentum : float
        Norm of the angular momentum (kg m**2 / s).
    energy : float
        Total energy (J).
    inertia, capacity, temperature
        As for the models.
    """
    moments = np.asarray(checked_inertia(inertia))
    greatest = float(moments.max() if moments.ndim == 1 else np.linalg.eigvalsh(moments)[-1])
    return temperature + (float(energy) - float(momentum) ** 2 / (2.0 * greatest)) / capacity


def _rotor_system(inertia, axes, rotors, make_dissipation, baths, attitude, torque) -> LiePoissonSystem:
    """Return the system ``H = (L - sum p_i a_i) . B (L - sum p_i a_i) / 2 + sum p_i**2 / (2 J_i)`` on so(3) + R^k.

    ``B = (I - sum J_i a_i a_i^T)^-1``, by the formula of Woodbury. ``make_dissipation`` is called with the axis of the
    first rotor.
    """
    inverse = inverse_inertia(checked_inertia(inertia, allow_rod=True))
    inverse = jnp.diag(inverse) if inverse.ndim == 1 else inverse
    a = _unit_axis_columns(axes)  # as columns
    n = a.shape[1]
    J = jnp.broadcast_to(checked_numbers(rotors, "the moment of the rotor", (), (n,)), (n,))
    J = checked_positive(J, "the moment of the rotor", n)
    inverse_times_axes = inverse @ a
    inertia_fractions = jnp.eye(n) - jnp.sqrt(J)[:, None] * (a.T @ inverse_times_axes) * jnp.sqrt(J)
    require_condition(
        1.0 - J * jnp.sum(a * inverse_times_axes, axis=0) if n == 1 else jnp.linalg.eigvalsh(inertia_fractions),
        lambda v: v > 0.0,
        "a rotor must have less than the inertia of the whole about its axis, got 1 - J/I = {value}",
    )
    Ba = inverse_times_axes @ jnp.linalg.inv(jnp.eye(n) - J[:, None] * (a.T @ inverse_times_axes))
    B = inverse + Ba * J @ inverse_times_axes.T
    B = 0.5 * (B + B.T)
    rotor_block = jnp.diag(1.0 / J) + a.T @ Ba
    A = jnp.block([[B, -Ba], [-Ba.T, 0.5 * (rotor_block + rotor_block.T)]])
    algebra = mf.direct_sum(mf.so(3), mf.abelian(n))
    group = mf.SO(3) if attitude else None
    dissipation = make_dissipation(a[:, 0])
    return LiePoissonSystem(algebra, Quadratic(A), dissipation=dissipation, group=group, baths=baths, torque=torque)


def _unit_axis_columns(axes) -> jax.Array:
    """Normalise directions, shape (3,) or (k, 3), and return them as columns, shape (3, k)."""
    checked_numbers(axes, "axis")
    directions = np.atleast_2d(np.asarray(axes, dtype=float))
    if directions.ndim != 2 or directions.shape[1] != 3 or not np.isfinite(directions).all():
        raise InputError(f"axis must be a direction in body axes, three numbers that are not all zero, got {axes!r}")
    if not directions.any(axis=1).all():
        raise InputError(f"axis must be a direction in body axes, three numbers that are not all zero, got {axes!r}")
    return jnp.asarray((directions / np.linalg.norm(directions, axis=1, keepdims=True)).T)
