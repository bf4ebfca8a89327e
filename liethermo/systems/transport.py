"""The motion in two other forms: by the velocity of an attitude that follows it, or by a generator."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from ..dissipation.base import terms_with_preserved_values
from .interface import SystemInterface


def added_attitude_velocities(system: SystemInterface, x, dH, dS, dL) -> list[jax.Array | None]:
    """Return a list of the velocities, shape (n,), that the dissipations add to an attitude; None for a torque."""
    terms = terms_with_preserved_values(system.total_dissipation.terms, dL)
    return [term.added_attitude_velocity(system, x, dH, dS, term_dL) for term, term_dL in terms]


def dissipation_keeps_spatial_momentum(system: SystemInterface) -> bool:
    """Return whether no summand of the dissipation changes the spatial momentum of a body on a Lie algebra.

    Then :meth:`.System.attitude_velocity_from_gradients` contains all of the dissipation, and without external torques
    the spatial momentum is constant.
    """
    while system.inner_system is not None:
        system = system.inner_system
    answers: list[bool] = []

    def record_answer(x):
        velocities = added_attitude_velocities(system, x, x, x, (x,) * len(system.preserved_functions))
        answers.append(all(sigma is not None for sigma in velocities))

    jax.eval_shape(record_answer, jax.ShapeDtypeStruct((system.dim,), jnp.float64))
    return answers[0]


def has_generator(system: SystemInterface) -> bool:
    """Return whether :func:`generator_field` can compute the vector field without the entropy."""
    return system.total_dissipation.has_generator


def generator_field(system: SystemInterface, x) -> jax.Array:
    """Return the vector field at x, shape (n,), from the generator of the dissipation instead of the entropy."""
    dH = system.energy.gradient(x)
    return system.poisson.sharp(x, dH) + system.total_dissipation.generator_field(system, x, dH)
