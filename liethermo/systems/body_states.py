"""States of rigid bodies from angular velocities, rates of rotors and temperatures."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from manifolds._arrays import is_traced

from ..errors import InputError
from ..functions.bath_energy import BathEnergy
from ..functions.conditions import checked_numbers, require_condition
from ..functions.energy import Energy, Quadratic
from ..functions.newton import inverse_gradient
from .baths import HeatBaths

VELOCITY_RTOL = 1e-12
"""Part of a velocity, relative to its norm, that a body without inertia about an axis may have along it."""

TEMPERATURE_RTOL = 1e-9
"""Relative difference up to which a temperature counts as that of a bath whose temperature cannot change."""


def is_state_given_by_velocity(system, x, angular_velocity, alternative: str, **velocity_arguments) -> bool:
    """Return whether the user gives a state by an angular velocity, and not by x; check that one of them is given.

    Parameters
    ----------
    system : LiePoissonSystem or EulerPoincareClosedSystem
    x, angular_velocity
        Arguments of the user, or None.
    alternative : str
        Argument that the message recommends for a system without an angular velocity.
    **velocity_arguments
        Arguments that belong to an angular velocity, or None.

    Raises
    ------
    InputError
        If neither or both are given, or the system has no angular velocity.
    """
    if angular_velocity is None:
        if x is None:
            raise InputError("state needs x or angular_velocity=")
        if names := [f"{name}=" for name, value in velocity_arguments.items() if value is not None]:
            raise InputError(f"{' and '.join(names)} cannot be combined with x. Give angular_velocity= instead of x")
        return False
    if x is not None:
        raise InputError("state needs x or angular_velocity=, got both")
    if "angular_velocity" not in system.body_kinematics.velocities:
        raise InputError(f"a system on {system.algebra.name} has no angular velocity. Give its {alternative}")
    return True


def checked_velocity(angular_velocity, rotor_rates, dim: int, batch: bool, degrees: bool) -> jax.Array:
    """Return the checked velocity (Omega, w), shape (..., dim), in radians, from the rates of a body and its rotors."""
    omega = checked_numbers(angular_velocity, "angular_velocity")
    if omega.shape[-1:] != (3,) or (omega.ndim > 1 and not batch):
        expected_shape = "(..., 3)" if batch else "(3,)"
        raise InputError(f"angular_velocity must have shape {expected_shape}, in body axes, got {omega.shape}")
    n_rotors = dim - 3
    rates = jnp.zeros(n_rotors) if rotor_rates is None else checked_numbers(rotor_rates, "rotor_rates")
    rates = jnp.broadcast_to(rates, (n_rotors,)) if rates.ndim == 0 and n_rotors else rates
    if rotor_rates is not None and not n_rotors:
        raise InputError("rotor_rates= needs a body with rotors, such as lt.models.reaction_wheels")
    if rates.shape[-1:] != (n_rotors,) or (rates.ndim > 1 and not batch):
        raise InputError(
            f"rotor_rates must have shape ({'..., ' if batch else ''}{n_rotors},), one for each rotor, got "
            f"{rates.shape}"
        )
    velocity = jnp.concatenate(broadcast_batches(omega, rates), axis=-1)
    require_condition(velocity, lambda v: abs(v) < jnp.inf, "velocities must be finite, got {value}")
    return jnp.deg2rad(velocity) if degrees else velocity


def broadcast_batches(*arrays: jax.Array) -> tuple[jax.Array, ...]:
    """Return arrays of shape (..., n_i) broadcast to a common batch shape."""
    batch_shapes = [array.shape[:-1] for array in arrays]
    try:
        shape = jnp.broadcast_shapes(*batch_shapes)
    except ValueError:
        raise InputError(f"the arguments of a state have batches of different lengths: {batch_shapes}") from None
    return tuple(jnp.broadcast_to(array, (*shape, array.shape[-1])) for array in arrays)


def append_bath_entropies(body_state, baths: HeatBaths, temperature) -> jax.Array:
    """Return body states, shape (..., n), followed by the entropies of the baths at a temperature, if it is not None.

    Raises
    ------
    InputError
        If there are no baths, or one has not such a temperature.
    """
    if temperature is None:
        return body_state
    if not baths.number:
        raise InputError("temperature= needs a system with baths. Build the system with baths=lt.HeatBaths(...)")
    return jnp.concatenate(broadcast_batches(body_state, bath_entropies_at_temperature(baths, temperature)), axis=-1)


def momentum_of_velocity(energy: Energy, velocity) -> jax.Array:
    """Return the momentum, shape (..., n), at which the gradient of an energy is a given velocity.

    Raises
    ------
    InputError
        If no momentum belongs to the velocity.
    """
    if isinstance(energy, Quadratic):
        momentum = _momentum_of_quadratic(energy, velocity)
    else:
        momentum = jnp.vectorize(lambda v: inverse_gradient(energy, v), signature="(n)->(n)")(velocity)
    require_condition(
        momentum,
        lambda mu: abs(mu) < jnp.inf,
        "no momentum belongs to this velocity: Newton's method ended at {value}. Give the momentum itself",
    )
    return momentum


def _momentum_of_quadratic(energy: Quadratic, velocity) -> jax.Array:
    """Return the momentum, shape (..., n), at which the gradient of a quadratic energy is a given velocity."""
    A, rest = energy.A, velocity if energy.b is None else velocity - energy.b
    if is_traced(A):
        return rest / A if A.ndim == 1 else jnp.linalg.solve(A, rest[..., None])[..., 0]
    values, axes = np.linalg.eigh(np.diag(A) if A.ndim == 1 else np.asarray(A))
    is_zero = np.abs(values) <= len(values) * np.finfo(float).eps * np.abs(values).max()
    if is_zero.any():  # of a rod, which has no moment about its axis
        rest_size = jnp.sqrt(jnp.sum(rest**2, axis=-1))
        require_condition(
            jnp.max(jnp.abs(rest @ axes[:, is_zero]), axis=-1) <= VELOCITY_RTOL * rest_size,
            lambda v: v,
            "a body without a moment of inertia about an axis cannot turn about it. Give an angular velocity without "
            "a component along that axis",
        )
        inverses = np.where(is_zero, 0.0, 1.0 / np.where(is_zero, 1.0, values))
        return (rest @ axes * inverses) @ axes.T
    return rest / A if A.ndim == 1 else jnp.linalg.solve(A, rest[..., None])[..., 0]


def bath_entropies_at_temperature(baths: HeatBaths, temperature) -> jax.Array:
    """Return the entropies of the baths, shape (..., number), at one temperature for all or one for each.

    Raises
    ------
    InputError
        If a bath has not such a temperature.
    """
    T = checked_numbers(temperature, "temperature")
    T = jnp.broadcast_to(T, (baths.number,)) if T.ndim == 0 else T
    if T.shape[-1:] != (baths.number,):
        raise InputError(f"temperature must be one number, or have shape (..., {baths.number}), got {T.shape}")
    require_condition(T, lambda v: (v > 0.0) & (v < jnp.inf), "temperature must be positive and finite, got {value}")
    if isinstance(baths.energy, BathEnergy):
        logarithm = jnp.log(T / baths.energy.temperature)
        is_finite = jnp.isfinite(baths.energy.capacity)
        y = jnp.where(is_finite, jnp.where(is_finite, baths.energy.capacity, 1.0) * logarithm, 0.0)
    else:
        y = jnp.vectorize(lambda v: inverse_gradient(baths.energy, v), signature="(n)->(n)")(T)
        y = jnp.where(jnp.isfinite(y), y, 0.0)
    actual = jnp.vectorize(baths.energy.gradient, signature="(n)->(n)")(y)
    require_condition(
        jnp.abs(actual - T) <= TEMPERATURE_RTOL * T,
        lambda v: v,
        "a bath has not this temperature: that of a bath of infinite capacity cannot change",
    )
    return y
