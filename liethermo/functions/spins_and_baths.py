"""The energy of many spins and of what they heat, as one function: its gradient is made in one piece."""

from __future__ import annotations

from collections.abc import Iterable

import equinox as eqx
import jax
import jax.numpy as jnp
import scipy

from .energy import Energy
from .indices import as_pattern
from .of_first import OfFirst
from .path import Path


class SpinsAndBaths(Energy):
    """``H(s) + U(y)`` of a state (s, y): two functions of components that they do not share.

    As a sum of two functions of the whole state each would make a vector as long as that, mostly zeros.

    Attributes
    ----------
    spins : Energy
        Of the first ``size`` components.
    baths : Energy
        Of the components behind.
    """

    spins: Energy
    baths: Energy
    size: int = eqx.field(static=True)

    def value(self, x) -> jax.Array:
        return self.spins.value(x[: self.size]) + self.baths.value(x[self.size :])

    def gradient(self, x) -> jax.Array:
        return jnp.concatenate([self.spins.gradient(x[: self.size]), self.baths.gradient(x[self.size :])])

    def sensitivity(self, x) -> jax.Array:
        return self.spins.sensitivity(x[: self.size]) + self.baths.sensitivity(x[self.size :])

    def discrete_gradient(self, scheme, x, d, low) -> jax.Array:
        low, n = jnp.zeros_like(x) + low, self.size

        def of(energy: Energy, *ends) -> jax.Array:
            return _total(term.discrete_gradient(scheme, *ends) for term in energy.terms)

        if self.spins.is_quadratic:  # at points of whole states, which others look at too
            by_spins = scheme.quadratic(OfFirst(self.spins, n), x, d, low)[:n]
        else:
            by_spins = of(self.spins, x[:n], d[:n], low[:n])
        return jnp.concatenate([by_spins, of(self.baths, x[n:], d[n:], low[n:])])

    def stage_gradients(self, scheme, path: Path) -> jax.Array:
        def of(energy: Energy, components: slice) -> jax.Array:
            part = _part(path, components)
            return _total(term.stage_gradients(scheme, part) for term in energy.terms)

        return jnp.concatenate([of(self.spins, slice(None, self.size)), of(self.baths, slice(self.size, None))], axis=1)

    def couplings(self, dim: int) -> scipy.sparse.csr_array | None:
        spins, baths = self.spins.couplings(self.size), self.baths.couplings(dim - self.size)
        if spins is None or baths is None:
            return None
        return as_pattern(scipy.sparse.block_diag([spins, baths]))

    def check_places(self, dim: int, role: str) -> None:
        for energy, size in ((self.spins, self.size), (self.baths, dim - self.size)):
            for term in energy.terms:
                term.check_places(size, role)

    def __neg__(self) -> Energy:
        return SpinsAndBaths(-self.spins, -self.baths, self.size)


def _part(path: Path, components: slice) -> Path:
    """The path of some components."""
    further = path.further
    return path._replace(
        start=path.start[components],
        low=(jnp.zeros_like(path.start) + path.low)[components],
        step=path.step[components],
        points=path.points[:, components],
        slopes=path.slopes[:, components],
        further=None if further is None else (further[0][:, components], further[1][:, components]),
        symmetries=None if path.symmetries is None else path.symmetries[:, :, components],
    )


def _total(parts: Iterable[jax.Array]) -> jax.Array:
    first, *others = parts
    return sum(others, first)
