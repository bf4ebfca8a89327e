"""Noise of a dissipation as a whole: the factors of its summands side by side, and the divergences of their columns."""

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp

from ..errors import InputError
from .base import Dissipation, portions
from .factor import Factor
from .geometry import Geometry


def factors(dissipation: Dissipation, system: Geometry, x, dH, dL: Sequence) -> list[tuple[Dissipation, Factor]]:
    """Each summand with its factor at the given gradients.

    Raises
    ------
    InputError
        If one has none.
    """
    found = []
    for part, own in portions(dissipation, dL):
        B = part.factor(system, x, dH, own)
        if B is None:
            where = "" if system.space is None else f" on {system.space.name}"
            raise InputError(
                f"{type(part).__name__} gives no factor of its friction matrix{where}, so there is no noise that "
                "belongs to it: see Dissipation.factor"
            )
        found.append((part, B))
    return found


def divergence(dissipation: Dissipation, system: Geometry, x) -> jax.Array:
    """The divergence of every column of the factors, at the gradients of the functions, shape (columns,).

    By differentiation, except where the construction makes it vanish.
    """

    def at(y) -> list[tuple[Dissipation, Factor]]:
        dL = [L.gradient(y) for L in dissipation.preserve]
        return factors(dissipation, system, y, system.energy.gradient(y), dL)

    def of(i: int) -> jax.Array:
        def row(y, axis):
            return at(y)[i][1].transposed(axis)

        def changes(axis):
            return jax.jvp(lambda y: row(y, axis), (x,), (axis,))[1]

        return jnp.sum(jax.vmap(changes)(jnp.eye(x.shape[0])), axis=0)

    here = at(x)
    parts = [jnp.zeros(B.size) if B.solenoidal else of(i) for i, (_, B) in enumerate(here)]
    return jnp.concatenate([jnp.zeros(0), *parts])
