"""Transport covectors: the velocities with which dissipations carry a momentum along its orbit."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from ..dissipation.base import terms_with_preserved_values
from .interface import SystemInterface


def dissipation_velocities(system: SystemInterface, x, dH, dS, dL) -> list[jax.Array | None]:
    """Return the velocity of each dissipation; None for a dissipation that acts as a torque."""
    terms = terms_with_preserved_values(system.total_dissipation.terms, dL)
    return [term.velocity(system, x, dH, dS, term_dL) for term, term_dL in terms]


def is_torque_free(system: SystemInterface) -> bool:
    """Return whether ``x' = Pi(x) transport``, so that on a Lie algebra the momentum in space is constant."""
    while system.inner is not None:
        system = system.inner
    answers: list[bool] = []

    def record_answer(x):
        velocities = dissipation_velocities(system, x, x, x, (x,) * len(system.preserved))
        answers.append(all(sigma is not None for sigma in velocities))

    jax.eval_shape(record_answer, jax.ShapeDtypeStruct((system.dim,), jnp.float64))
    return answers[0]


def has_generator(system: SystemInterface) -> bool:
    """Return whether :func:`generator_field` computes the motion without the gradient of the entropy."""
    return system.total_dissipation.has_generator


def generator_field(system: SystemInterface, x) -> jax.Array:
    """Return the vector field at x, shape (n,), by the generator of the dissipation, without the entropy."""
    dH = system.energy.gradient(x)
    return system.poisson.sharp(x, dH) + system.total_dissipation.generator_field(system, x, dH)
