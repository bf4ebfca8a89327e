"""Functions of the first components of a state, such as a momentum before an attitude, or spins before their baths."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp

from .energy import Energy
from .path import Path


class OfFirst(Energy):
    """A function of the first ``dim`` components of a state."""

    energy: Energy
    dim: int = eqx.field(static=True)

    @property
    def is_quadratic(self) -> bool:
        return self.energy.is_quadratic

    def value(self, x) -> jax.Array:
        return self.energy.value(x[: self.dim])

    def gradient(self, x) -> jax.Array:
        rest = jnp.zeros(x.shape[0] - self.dim)
        return jnp.concatenate([self.energy.gradient(x[: self.dim]), rest])

    def sensitivity(self, x) -> jax.Array:
        return self.energy.sensitivity(x[: self.dim])

    def hidden(self, x) -> jax.Array:
        return sum((term.hidden(x[: self.dim]) for term in self.energy.terms), jnp.zeros(()))

    def discrete_gradient(self, scheme, x, d, compensation) -> jax.Array:
        """That of the function itself: it may have a closed form, and what is behind it has units of its own."""
        if self.is_quadratic:
            return scheme.quadratic(self, x, d, compensation)
        ends, n = (x, d, jnp.zeros_like(x) + compensation), self.dim
        parts = [term.discrete_gradient(scheme, *(v[:n] for v in ends)) for term in self.energy.terms]
        return jnp.concatenate([sum(parts[1:], parts[0]), jnp.zeros(x.shape[0] - n)])

    def stage_gradients(self, scheme, path: Path) -> jax.Array:
        if self.is_quadratic:
            return scheme(self, path)
        own = path.part(slice(None, self.dim))
        parts = [term.stage_gradients(scheme, own) for term in self.energy.terms]
        return jnp.pad(sum(parts[1:], parts[0]), ((0, 0), (0, path.start.shape[0] - self.dim)))
