"""The energy of a body and of the baths that it heats, as one function: its gradient is made in one piece."""

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


class WithBaths(Energy):
    """``H(x) + U(y)`` of a state (x, y): two functions of components that they do not share.

    As a sum of two functions of the whole state each would make a vector as long as that, mostly zeros.

    Attributes
    ----------
    body : Energy
        Of the first ``size`` components. It may depend on the time.
    baths : Energy
        Of the components behind.
    size, dim : int
        The number of components of the body, and of all.
    """

    body: Energy
    baths: Energy
    size: int = eqx.field(static=True)
    dim: int = eqx.field(static=True)

    @property
    def terms(self) -> tuple[Energy, ...]:
        if not self.depends_on_time:
            return (self,)
        of_body = self.body.on(range(self.size)).terms
        return (*of_body, *self.baths.on(range(self.size, self.dim)).terms)

    @property
    def is_quadratic(self) -> bool:
        return self.body.is_quadratic and self.baths.is_quadratic

    @property
    def depends_on_time(self) -> bool:
        return self.body.depends_on_time

    def at_time(self, t) -> Energy:
        return WithBaths(self.body.at_time(t), self.baths, self.size, self.dim)

    def value(self, x) -> jax.Array:
        return self.body.value(x[: self.size]) + self.baths.value(x[self.size :])

    def gradient(self, x) -> jax.Array:
        return jnp.concatenate([self.body.gradient(x[: self.size]), self.baths.gradient(x[self.size :])])

    def sensitivity(self, x) -> jax.Array:
        return self.body.sensitivity(x[: self.size]) + self.baths.sensitivity(x[self.size :])

    def rounded(self, x) -> jax.Array:
        return self.body.rounded(x[: self.size]) + self.baths.rounded(x[self.size :])

    def hidden(self, x) -> jax.Array:
        def of(energy: Energy, part) -> jax.Array:
            return sum((term.hidden(part) for term in energy.terms), jnp.zeros(()))

        return of(self.body, x[: self.size]) + of(self.baths, x[self.size :])

    def discrete_gradient(self, scheme, x, d, compensation) -> jax.Array:
        compensation, n = jnp.zeros_like(x) + compensation, self.size

        def of(energy: Energy, *ends) -> jax.Array:
            return _total(term.discrete_gradient(scheme, *ends) for term in energy.terms)

        if self.body.is_quadratic:  # at points of whole states, which others look at too
            by_body = scheme.quadratic(OfFirst(self.body, n), x, d, compensation)[:n]
        else:
            by_body = of(self.body, x[:n], d[:n], compensation[:n])
        return jnp.concatenate([by_body, of(self.baths, x[n:], d[n:], compensation[n:])])

    def stage_gradients(self, scheme, path: Path) -> jax.Array:
        def of(energy: Energy, components: slice) -> jax.Array:
            part = path.part(components)
            return _total(term.stage_gradients(scheme, part) for term in energy.terms)

        return jnp.concatenate([of(self.body, slice(None, self.size)), of(self.baths, slice(self.size, None))], axis=1)

    def couplings(self, dim: int) -> scipy.sparse.csr_array | None:
        body, baths = self.body.couplings(self.size), self.baths.couplings(dim - self.size)
        if body is None or baths is None:
            return None
        return as_pattern(scipy.sparse.block_diag([body, baths]))

    def check_places(self, dim: int, role: str) -> None:
        for energy, size in ((self.body, self.size), (self.baths, dim - self.size)):
            for term in energy.terms:
                term.check_places(size, role)

    def __neg__(self) -> Energy:
        return WithBaths(-self.body, -self.baths, self.size, self.dim)


def _total(parts: Iterable[jax.Array]) -> jax.Array:
    first, *others = parts
    return sum(others, first)
