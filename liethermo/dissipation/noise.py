"""Noise of a sum of dissipations: the factors of its summands side by side, and the divergences of their columns."""

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from ..errors import InputError
from .base import Dissipation, terms_with_preserved_values
from .factor import Factor
from .geometry import Geometry

FACTOR_SQUARE_CHECK = "B B^T = K"
"""Row of ``system.check()``: the square of the noise factor against the friction matrix."""

FACTOR_KERNEL_CHECK = "B^T grad H = 0"
"""Row of ``system.check()``: the noise leaves the energy and the preserved functions unchanged."""

FACTOR_DIVERGENCE_CHECK = "div B = 0, as stated"
"""Row of ``system.check()``: a factor that is declared solenoidal has columns of divergence zero."""


def noisy_terms_with_factors(
    dissipation: Dissipation, system: Geometry, x, dH, dL: Sequence
) -> list[tuple[Dissipation, Factor]]:
    """Return each summand that has noise, with its factor at the given gradients.

    Raises
    ------
    InputError
        If a summand has no factor.
    """
    terms_with_factors = []
    for term, dL_term in _noisy_terms_with_values(dissipation, dL):
        B = term.factor(system, x, dH, dL_term)
        if B is None:
            space_text = "" if system.space is None else f" on {system.space.name}"
            raise InputError(
                f"{type(term).__name__} gives no factor of its friction matrix{space_text}, so it has no noise. Define "
                "Dissipation.factor"
            )
        terms_with_factors.append((term, B))
    return terms_with_factors


def factor_divergences(dissipation: Dissipation, system: Geometry, x) -> jax.Array:
    """Return the divergence of every column of the factors, at the gradients of the functions, shape (columns,)."""
    return jnp.concatenate(
        [jnp.zeros(0), *(term.factor_divergence(system, x) for term, _ in _noisy_terms_with_values(dissipation))]
    )


def terms_with_factors_at_state(dissipation: Dissipation, system: Geometry, x) -> list[tuple[Dissipation, Factor]]:
    """Return each summand that has noise, with its factor by the exact gradients of all functions at x."""
    dL = [L.gradient(x) for L in dissipation.preserve]
    return noisy_terms_with_factors(dissipation, system, x, system.energy.gradient(x), dL)


def factor_property_residuals(dissipation: Dissipation, system: Geometry, x) -> dict[str, jax.Array]:
    """Return the relative residuals at x, by name, of the properties that the factors must have."""
    dH = system.energy.gradient(x)
    (generic,) = generic_covectors(x.shape[0], 1)
    residuals: dict[str, list[jax.Array]] = {
        FACTOR_SQUARE_CHECK: [],
        FACTOR_KERNEL_CHECK: [],
        FACTOR_DIVERGENCE_CHECK: [],
    }
    terms = terms_with_factors_at_state(dissipation, system, x)
    for (term, B), (_, functions) in zip(
        terms, _noisy_terms_with_values(dissipation, dissipation.preserve), strict=True
    ):
        dL, conserves_energy = tuple(L.gradient(x) for L in functions), term.energy_law == "conserved"
        force = term.force(system, x, dH, generic, dL)
        square = B.times(B.transpose_times(generic)) if conserves_energy else -B.times(B.transpose_times(dH))
        residuals[FACTOR_SQUARE_CHECK].append(_relative_max(square - force, jnp.max(jnp.abs(force))))
        size = jnp.linalg.norm(B.transpose_times(generic))
        kernel = [
            _relative_max(B.transpose_times(v), size * jnp.linalg.norm(v))
            for v in ((dH, *dL) if conserves_energy else dL)
        ]
        residuals[FACTOR_KERNEL_CHECK] += kernel
        if B.solenoidal:
            divergence_terms = term.factor_divergence_terms(system, x)
            # The first scale alone would be too small where the terms are mere rounding.
            scale = jnp.max(jnp.abs(divergence_terms)) + size / (1.0 + jnp.linalg.norm(x))
            residuals[FACTOR_DIVERGENCE_CHECK].append(_relative_max(jnp.sum(divergence_terms, axis=0), scale))
    return {name: jnp.max(jnp.stack(values)) for name, values in residuals.items() if values}


def generic_covectors(n: int, count: int) -> jax.Array:
    """Return fixed random covectors, none orthogonal to a column, shape (count, n); test points have other seeds."""
    return jnp.asarray(np.random.default_rng(20_241).standard_normal((count, n)))


def _noisy_terms_with_values(
    dissipation: Dissipation, values: Sequence | None = None
) -> list[tuple[Dissipation, tuple]]:
    """Return the summands that can have noise, each with its portion of ``values``, by default its functions."""
    terms = terms_with_preserved_values(dissipation.terms, dissipation.preserve if values is None else values)
    return [(term, term_values) for term, term_values in terms if not term.is_noiseless]


def _relative_max(residual, scale) -> jax.Array:
    """Return the largest absolute entry of a residual over a scale, shape (); a scale of zero counts as one."""
    return jnp.max(jnp.abs(residual), initial=0.0) / jnp.where(scale > 0.0, scale, 1.0)
