"""Transport covectors: the velocities with which dissipations carry a momentum along its orbit."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from ..dissipation.base import terms_with_preserved_values
from .interface import SystemInterface


def dissipation_velocities(system: SystemInterface, x, dH, dS, dL) -> list[jax.Array | None]:
    """Return a list with the velocity of each dissipation, shape (n,); None for one that acts as a torque."""
    terms = terms_with_preserved_values(system.total_dissipation.terms, dL)
    return [term.velocity(system, x, dH, dS, term_dL) for term, term_dL in terms]


def moves_by_transport_alone(system: SystemInterface) -> bool:
    """Return whether Pi times :meth:`.System.driving_covector` is the whole motion, without external torques.

    If so, the spatial momentum of a body on a Lie algebra is constant.
    """
    while system.inner_system is not None:
        system = system.inner_system
    answers: list[bool] = []

    def record_answer(x):
        velocities = dissipation_velocities(system, x, x, x, (x,) * len(system.preserved_functions))
        answers.append(all(sigma is not None for sigma in velocities))

    jax.eval_shape(record_answer, jax.ShapeDtypeStruct((system.dim,), jnp.float64))
    return answers[0]


def has_generator(system: SystemInterface) -> bool:
    """Return whether a generator gives the motion without the entropy: see :func:`generator_field`."""
    return system.total_dissipation.has_generator


def generator_field(system: SystemInterface, x) -> jax.Array:
    """Return the vector field at x, shape (n,), from the generator of the dissipation instead of the entropy."""
    dH = system.energy.gradient(x)
    return system.poisson.sharp(x, dH) + system.total_dissipation.generator_field(system, x, dH)
