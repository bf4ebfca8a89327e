"""Functions that the user asks a method to preserve, besides the known invariants of the system."""

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from ..errors import InputError
from ..functions.checks import checked_energy, with_polynomial_degrees
from ..functions.energy import Energy, function_name, make_energy
from ..systems import System
from ..systems.invariants import are_conserved


def preserved_functions(preserve) -> tuple[Energy, ...]:
    """Return the argument ``preserve``, one function or a sequence of functions, as a tuple of energies."""
    functions = preserve if isinstance(preserve, list | tuple) else (preserve,)
    return tuple(make_energy(C, "a preserved function") for C in functions)


def function_on_states(system: System, C: Energy) -> Energy:
    """Return a preserved function as a function of the state vectors of a system."""
    C = checked_energy(system.energy_of_flat_states(C), system.dim, "a preserved function")
    return with_polynomial_degrees(C, system.dim) if system.space is None else C


def check_preserved(system: System, functions: Sequence[Energy]) -> None:
    """Raise InputError if the system does not conserve one of the functions.

    A function that cannot be tested, for example outside the domain of an entropy, counts as conserved.
    """
    for C, is_conserved in zip(functions, are_conserved(system, tuple(functions)), strict=True):
        if is_conserved is False:
            raise InputError(nonconservation_message(C))


def nonconservation_message(C: Energy) -> str:
    """Return the error message for a function that the system does not conserve."""
    name = function_name(C) or str(C)
    return (
        f"the system does not conserve the preserved function {name}: holding it would change the "
        "dynamics. Give a dissipation that preserves it too, such as ProjectedMetric(preserve=...)"
    )


CASIMIR_RTOL = 1e-10
"""Largest ``|Pi grad C|`` of a Casimir, relative to the image of a generic covector of the same length."""


def casimir_residuals(system_and_functions: tuple[System, tuple[Energy, ...]], x) -> jax.Array:
    """Return ``|Pi grad C|`` of each function at x, relative to ``|Pi v|`` of another covector v of that length."""
    system, functions = system_and_functions
    system = system.cache_tensors_at(x)
    residuals = []
    for C in functions:
        gradient, random = C.gradient(x), jnp.cos(jnp.arange(1.0, x.shape[0] + 1.0))
        scale = jnp.linalg.norm(gradient) * jnp.linalg.norm(system.poisson.sharp(x, random)) / jnp.linalg.norm(random)
        image_norm = jnp.linalg.norm(system.poisson.sharp(x, gradient))
        residuals.append(jnp.where(scale > 0.0, image_norm / jnp.where(scale > 0.0, scale, 1.0), 0.0))
    return jnp.nan_to_num(jnp.stack(residuals))


def non_casimir_mask(residuals: np.ndarray) -> np.ndarray:
    """Return whether each function fails the test of a Casimir, shape (..., functions).

    Parameters
    ----------
    residuals : array, shape (..., points, functions)
        Values of :func:`casimir_residuals` at several points.
    """
    return residuals.max(axis=-2) > CASIMIR_RTOL
