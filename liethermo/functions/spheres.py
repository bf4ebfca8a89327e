"""Vectors of constant length in a large state: as many first integrals, each of few components, held one by one.

Held with the others by a system of equations they would need a matrix with a row for each. But the gradient of
``|s_i|^2`` at s_i is s_i, and those of different sites have no component in common: each sphere is returned to along
its own radius, and what else a correction does is done along the spheres.
"""

from __future__ import annotations

from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp

from manifolds.structures.spins import (
    VectorComponents,
    add_vectors,
    dot_vectors,
    scale_vectors,
    spins_from_state,
    state_from_spins,
)

from .energy import Energy


@dataclass(frozen=True)
class Spheres:
    """A :class:`.surface.Surface`: the first ``count`` vectors of three components of a state have constant lengths.

    Attributes
    ----------
    count : int
    name : str
        Of the first integral that is the sum of their squares.
    planar : bool
        Whether the state has them component by component, and not one after another.
    """

    count: int
    name: str
    planar: bool = False
    is_kept_by_collocation = True

    def project_direction(self, x, v) -> jax.Array:
        """v, shape (n,), less its radial components at x."""
        s, part = self._vectors(x), self._vectors(v)
        return self._replace_vectors(
            v, add_vectors(part, scale_vectors(-_safe_quotient(dot_vectors(s, part), dot_vectors(s, s)), s))
        )

    def project_displacement(self, x, compensation, d) -> tuple[jax.Array, jax.Array]:
        """The displacement that ends where d does, but at the lengths of the start; nothing is missed.

        From what the squares change by, not from their values: so it is as exact as d is small.
        """
        start, step = self._vectors(x + compensation), self._vectors(d)
        end = add_vectors(start, step)
        share = _safe_quotient(dot_vectors(step, add_vectors(start, end)), dot_vectors(end, end))
        root = jnp.sqrt(jnp.maximum(1.0 - share, 0.0))
        return self._replace_vectors(d, add_vectors(step, scale_vectors(-share / (1.0 + root), end))), jnp.zeros(())

    def correct_rounding(self, x, compensation) -> tuple[jax.Array, jax.Array]:
        """The state as it is: the sum of the squares is steered with the other first integrals."""
        return x, compensation

    def _vectors(self, v) -> VectorComponents:
        return spins_from_state(v, self.count, self.planar)

    def _replace_vectors(self, v, vectors: VectorComponents) -> jax.Array:
        return state_from_spins(vectors, v[3 * self.count :], self.planar)


def _safe_quotient(numerator, square) -> jax.Array:
    return numerator / jnp.where(square > 0.0, square, 1.0)


class HalfSumOfSquares(Energy):
    """``sum |s_i|^2 / 2`` over the sites: the Casimir that is followed along a run."""

    count: int = eqx.field(static=True)

    is_quadratic = True

    def value(self, x) -> jax.Array:
        return 0.5 * jnp.sum(x[: 3 * self.count] ** 2)

    def gradient(self, x) -> jax.Array:
        return jnp.where(jnp.arange(x.size) < 3 * self.count, x, 0.0)
