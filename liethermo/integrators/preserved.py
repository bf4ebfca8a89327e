"""Functions that a method is asked to hold exactly, besides what the system is known to conserve."""

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from ..errors import InputError
from ..functions.checks import check_energy, mark_polynomial_degrees
from ..functions.energy import Energy, function_name, make_energy
from ..systems import System


def preserved_functions(preserve) -> tuple[Energy, ...]:
    """Those of ``preserve=``: one function, or a sequence of them."""
    functions = preserve if isinstance(preserve, list | tuple) else (preserve,)
    return tuple(make_energy(C, "a preserved function") for C in functions)


def function_on_states(system: System, C: Energy) -> Energy:
    """A preserved function as one of the state vectors of a system."""
    C = check_energy(system.energy_of_vectors(C), system.dim, "a preserved function")
    return mark_polynomial_degrees(C, system.dim) if system.space is None else C


def check_preserved(system: System, functions: Sequence[Energy]) -> None:
    """Raise InputError where the system does not conserve one of the functions.

    Where that cannot be found out, as outside the domain of an entropy, they count as claimed.
    """
    for C, kept in zip(functions, system.conserves(tuple(functions)), strict=True):
        if kept is False:
            raise InputError(why_not_preserved(C))


def why_not_preserved(C: Energy) -> str:
    """Return the message for a function that a system does not conserve."""
    name = function_name(C) or str(C)
    return (
        f"the system does not conserve the preserved function {name}: holding it would change the "
        "dynamics. Give a dissipation that preserves it too, such as ProjectedMetric(preserve=...)"
    )


CASIMIR_RTOL = 1e-10
"""Largest ``|Pi grad C|``, relative to what Pi does to other covectors, of a function that is a Casimir."""


def casimir_residuals(model: tuple[System, tuple[Energy, ...]], x) -> jax.Array:
    """Return ``|Pi grad C|`` of each function at x, relative to ``|Pi v|`` of another covector v of that length."""
    system, functions = model
    system = system.freeze_at(x)
    shares = []
    for C in functions:
        gradient, random = C.gradient(x), jnp.cos(jnp.arange(1.0, x.shape[0] + 1.0))
        size = jnp.linalg.norm(gradient) * jnp.linalg.norm(system.poisson.sharp(x, random)) / jnp.linalg.norm(random)
        moved = jnp.linalg.norm(system.poisson.sharp(x, gradient))
        shares.append(jnp.where(size > 0.0, moved / jnp.where(size > 0.0, size, 1.0), 0.0))
    return jnp.nan_to_num(jnp.stack(shares))


def is_momentum_map(shares: np.ndarray) -> np.ndarray:
    """Return which functions are no Casimirs, from :func:`casimir_residuals` at points: (..., points, functions)."""
    return shares.max(axis=-2) > CASIMIR_RTOL
