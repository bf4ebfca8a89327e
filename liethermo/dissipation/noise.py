"""Noise of a dissipation as a whole: the factors of its summands side by side, and the divergences of their columns."""

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from ..errors import InputError
from .base import Dissipation, terms_with_preserved
from .factor import Factor
from .geometry import Geometry

FACTOR_SQUARE_CHECK, FACTOR_KERNEL_CHECK, FACTOR_DIVERGENCE_CHECK = (
    "B B^T = K",
    "B^T grad H = 0",
    "div B = 0, as stated",
)
"""The rows of a check on noise."""


def terms_with_factors(
    dissipation: Dissipation, system: Geometry, x, dH, dL: Sequence
) -> list[tuple[Dissipation, Factor]]:
    """Each summand with its factor at the given gradients.

    Raises
    ------
    InputError
        If one has none.
    """
    found = []
    for part, own in _noisy_terms(dissipation, dL):
        B = part.factor(system, x, dH, own)
        if B is None:
            where = "" if system.space is None else f" on {system.space.name}"
            raise InputError(
                f"{type(part).__name__} gives no factor of its friction matrix{where}, so there is no noise that "
                "belongs to it: see Dissipation.factor"
            )
        found.append((part, B))
    return found


def factor_divergence(dissipation: Dissipation, system: Geometry, x) -> jax.Array:
    """The divergence of every column of the factors, at the gradients of the functions, shape (columns,)."""
    return jnp.concatenate([jnp.zeros(0), *(part.divergence(system, x) for part, _ in _noisy_terms(dissipation))])


def terms_with_continuous_factors(dissipation: Dissipation, system: Geometry, x) -> list[tuple[Dissipation, Factor]]:
    """Those at the gradients of the functions."""
    dL = [L.gradient(x) for L in dissipation.preserve]
    return terms_with_factors(dissipation, system, x, system.energy.gradient(x), dL)


def factor_residuals(dissipation: Dissipation, system: Geometry, x) -> dict[str, jax.Array]:
    """What the factors miss of what they are to be, at a state and relative to what cancels: the largest of each."""
    dH = system.energy.gradient(x)
    (away,) = generic_covectors(x.shape[0], 1)
    found: dict[str, list[jax.Array]] = {FACTOR_SQUARE_CHECK: [], FACTOR_KERNEL_CHECK: [], FACTOR_DIVERGENCE_CHECK: []}
    parts = terms_with_continuous_factors(dissipation, system, x)
    for (part, B), (_, own) in zip(parts, _noisy_terms(dissipation, dissipation.preserve), strict=True):
        dL, keeps = tuple(L.gradient(x) for L in own), part.energy_law == "conserved"
        force = part.force(system, x, dH, away, dL)
        square = B.times(B.transpose_times(away)) if keeps else -B.times(B.transpose_times(dH))
        found[FACTOR_SQUARE_CHECK].append(_relative_max(square - force, jnp.max(jnp.abs(force))))
        size = jnp.linalg.norm(B.transpose_times(away))
        kernel = [_relative_max(B.transpose_times(v), size * jnp.linalg.norm(v)) for v in ((dH, *dL) if keeps else dL)]
        found[FACTOR_KERNEL_CHECK] += kernel
        if B.solenoidal:
            changes = part.divergence_terms(system, x)
            varies = jnp.max(jnp.abs(changes)) + size / (1.0 + jnp.linalg.norm(x))  # the former may be rounding alone
            found[FACTOR_DIVERGENCE_CHECK].append(_relative_max(jnp.sum(changes, axis=0), varies))
    return {name: jnp.max(jnp.stack(values)) for name, values in found.items() if values}


def generic_covectors(n: int, number: int) -> jax.Array:
    """Covectors in no special direction, shape (number, n): not those of the test points, which are drawn from 0 on."""
    return jnp.asarray(np.random.default_rng(20_241).standard_normal((number, n)))


def _noisy_terms(dissipation: Dissipation, preserved: Sequence | None = None) -> list[tuple[Dissipation, tuple]]:
    """The summands that noise may belong to, each with its portion of what belongs to the functions that they keep."""
    parts = terms_with_preserved(dissipation, dissipation.preserve if preserved is None else preserved)
    return [(part, own) for part, own in parts if not part.is_noiseless]


def _relative_max(defect, size) -> jax.Array:
    return jnp.max(jnp.abs(defect), initial=0.0) / jnp.where(size > 0.0, size, 1.0)
