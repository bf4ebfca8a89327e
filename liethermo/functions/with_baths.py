"""The energy of a body and of the baths that it heats, as one function: its gradient is made in one piece."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import scipy

from manifolds._module import forwarded

from .coordinates import Components
from .energy import Energy, Pullback
from .frames import total
from .indices import as_pattern
from .path import Path
from .warmth import Reservoir


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

    depends_on_time = forwarded("body")

    def at_time(self, t) -> Energy:
        return WithBaths(self.body.at_time(t), self.baths, self.size, self.dim)

    @property
    def _parts(self) -> tuple[tuple[Energy, Components], ...]:
        return (self.body, Components(range(self.size))), (self.baths, Components(range(self.size, self.dim)))

    def value(self, x) -> jax.Array:
        return total(energy.value(of(x)) for energy, of in self._parts)

    def gradient(self, x) -> jax.Array:
        return jnp.concatenate([energy.gradient(of(x)) for energy, of in self._parts])

    def sensitivity(self, x) -> jax.Array:
        return total(energy.sensitivity(of(x)) for energy, of in self._parts)

    def rounded(self, x) -> jax.Array:
        return total(energy.rounded(of(x)) for energy, of in self._parts)

    def hidden(self, x) -> jax.Array:
        return total(term.hidden(of(x)) for energy, of in self._parts for term in energy.terms)

    def discrete_gradient(self, scheme, x, d, compensation) -> jax.Array:
        ends = x, d, jnp.zeros_like(x) + compensation

        def part(energy: Energy, of: Components) -> jax.Array:
            if energy is self.body and energy.is_quadratic:  # at points of whole states, which others look at too
                return of(scheme.quadratic(Pullback(energy, of), *ends))
            return total(term.discrete_gradient(scheme, *map(of, ends)) for term in energy.terms)

        return jnp.concatenate([part(*one) for one in self._parts])

    def stage_gradients(self, scheme, path: Path) -> jax.Array:
        def part(energy: Energy, of: Components) -> jax.Array:
            seen, _ = path.through(of)
            return total(term.stage_gradients(scheme, seen) for term in energy.terms)

        return jnp.concatenate([part(*one) for one in self._parts], axis=1)

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


def temperature_slopes(energy: Energy, x, size: int) -> jax.Array | None:
    """The derivative of each bath's temperature by its own entropy, shape (m,); None where temperatures are constant.

    The baths are the components behind the first ``size``.
    """
    if not isinstance(energy, WithBaths):
        return jax.jvp(energy.gradient, (x,), (jnp.zeros_like(x).at[size:].set(1.0),))[1][size:]
    if isinstance(energy.baths, Reservoir):
        return None
    y = x[size:]
    return jax.jvp(energy.baths.gradient, (y,), (jnp.ones_like(y),))[1]
