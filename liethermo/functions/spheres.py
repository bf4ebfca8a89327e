"""Vectors of constant length in a large state: many first integrals of a few components, conserved one by one.

Conserving them together with other first integrals would need a matrix with a row for each. But the gradient of
``|s_i|^2`` by s_i is along s_i, and the gradients of different sites share no component. Each vector is therefore
rescaled by itself, and other corrections are made tangent to the spheres.
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
    """A :class:`.surface.Surface` of states whose first ``count`` vectors of three components have constant lengths.

    Attributes
    ----------
    count : int
    name : str
        Name of the first integral that is the sum of their squares.
    planar : bool
        Whether the state stores the vectors component by component, and not one after another.
    """

    count: int
    name: str
    planar: bool = False
    is_kept_by_collocation = True

    def project_direction(self, x, v) -> jax.Array:
        """Return v, shape (n,), without its radial components at x."""
        s, vectors = self._leading_vectors(x), self._leading_vectors(v)
        return self._replace_vectors(
            v, add_vectors(vectors, scale_vectors(-_safe_quotient(dot_vectors(s, vectors), dot_vectors(s, s)), s))
        )

    def project_displacement(self, x, compensation, d) -> tuple[jax.Array, jax.Array]:
        """Return the displacement rescaled so that its end has the lengths of the start, and an error of zero.

        The correction is computed from the changes of the squares, not from their values, so its error shrinks with d.
        """
        start, step = self._leading_vectors(x + compensation), self._leading_vectors(d)
        end = add_vectors(start, step)
        shrinkage = _safe_quotient(dot_vectors(step, add_vectors(start, end)), dot_vectors(end, end))
        root = jnp.sqrt(jnp.maximum(1.0 - shrinkage, 0.0))
        return self._replace_vectors(d, add_vectors(step, scale_vectors(-shrinkage / (1.0 + root), end))), jnp.zeros(())

    def correct_rounding(self, x, compensation) -> tuple[jax.Array, jax.Array]:
        """Return the state unchanged: the sum of the squares is corrected with the other first integrals."""
        return x, compensation

    def _leading_vectors(self, v) -> VectorComponents:
        return spins_from_state(v, self.count, self.planar)

    def _replace_vectors(self, v, vectors: VectorComponents) -> jax.Array:
        return state_from_spins(vectors, v[3 * self.count :], self.planar)


def _safe_quotient(numerator, square) -> jax.Array:
    return numerator / jnp.where(square > 0.0, square, 1.0)


class HalfSumOfSquares(Energy):
    """The Casimir ``sum |s_i|^2 / 2`` over the sites, which is recorded along a run."""

    count: int = eqx.field(static=True)

    is_quadratic = True

    def value(self, x) -> jax.Array:
        return 0.5 * jnp.sum(x[: 3 * self.count] ** 2)

    def gradient(self, x) -> jax.Array:
        return jnp.where(jnp.arange(x.size) < 3 * self.count, x, 0.0)
