"""The energy of a body and of the baths that it heats, as one function: its gradient is made in one piece."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import scipy

from manifolds._pytree_module import forward_to

from .bath_energy import ReservoirEnergy
from .coordinates import Components
from .energy import Energy, Pullback
from .frames import sum_terms
from .indices import pattern_of_matrix
from .path import CollocationPath


class BodyBathsEnergy(Energy):
    """``H(x) + U(y)`` of a state (x, y): two functions of components that they do not share.

    As a sum of two functions of the whole state each would make a vector as long as that, mostly zeros.

    Attributes
    ----------
    body : Energy
        Of the first ``body_dim`` components. It may depend on the time.
    baths : Energy
        Of the components behind.
    body_dim, dim : int
        The number of components of the body, and of all.
    """

    body: Energy
    baths: Energy
    body_dim: int = eqx.field(static=True)
    dim: int = eqx.field(static=True)

    @property
    def terms(self) -> tuple[Energy, ...]:
        if not self.depends_on_time:
            return (self,)
        of_body = self.body.on(range(self.body_dim)).terms
        return (*of_body, *self.baths.on(range(self.body_dim, self.dim)).terms)

    @property
    def is_quadratic(self) -> bool:
        return self.body.is_quadratic and self.baths.is_quadratic

    depends_on_time = forward_to("body")

    def at_time(self, t) -> Energy:
        return BodyBathsEnergy(self.body.at_time(t), self.baths, self.body_dim, self.dim)

    @property
    def _energies_and_components(self) -> tuple[tuple[Energy, Components], ...]:
        return (self.body, Components(range(self.body_dim))), (self.baths, Components(range(self.body_dim, self.dim)))

    def value(self, x) -> jax.Array:
        return sum_terms(energy.value(of(x)) for energy, of in self._energies_and_components)

    def gradient(self, x) -> jax.Array:
        return jnp.concatenate([energy.gradient(of(x)) for energy, of in self._energies_and_components])

    def sensitivity(self, x) -> jax.Array:
        return sum_terms(energy.sensitivity(of(x)) for energy, of in self._energies_and_components)

    def rounding_scale(self, x) -> jax.Array:
        return sum_terms(energy.rounding_scale(of(x)) for energy, of in self._energies_and_components)

    def difference_rounding_scale(self, x) -> jax.Array:
        return sum_terms(
            term.difference_rounding_scale(of(x))
            for energy, of in self._energies_and_components
            for term in energy.terms
        )

    def discrete_gradient(self, scheme, x, d, compensation) -> jax.Array:
        ends = x, d, jnp.zeros_like(x) + compensation

        def component_gradient(energy: Energy, of: Components) -> jax.Array:
            if energy is self.body and energy.is_quadratic:  # at points of whole states, which others look at too
                return of(scheme.quadratic(Pullback(energy, of), *ends))
            return sum_terms(term.discrete_gradient(scheme, *map(of, ends)) for term in energy.terms)

        return jnp.concatenate([component_gradient(*one) for one in self._energies_and_components])

    def stage_gradients(self, scheme, path: CollocationPath) -> jax.Array:
        def component_gradients(energy: Energy, of: Components) -> jax.Array:
            seen, _ = path.map_coordinates(of)
            return sum_terms(term.stage_gradients(scheme, seen) for term in energy.terms)

        return jnp.concatenate([component_gradients(*one) for one in self._energies_and_components], axis=1)

    def couplings(self, dim: int) -> scipy.sparse.csr_array | None:
        body, baths = self.body.couplings(self.body_dim), self.baths.couplings(dim - self.body_dim)
        if body is None or baths is None:
            return None
        return pattern_of_matrix(scipy.sparse.block_diag([body, baths]))

    def check_components(self, dim: int, role: str) -> None:
        for energy, size in ((self.body, self.body_dim), (self.baths, dim - self.body_dim)):
            for term in energy.terms:
                term.check_components(size, role)

    def __neg__(self) -> Energy:
        return BodyBathsEnergy(-self.body, -self.baths, self.body_dim, self.dim)


def temperature_slopes(energy: Energy, x, size: int) -> jax.Array | None:
    """The derivative of each bath's temperature by its own entropy, shape (m,); None where temperatures are constant.

    The baths are the components behind the first ``size``.
    """
    if not isinstance(energy, BodyBathsEnergy):
        return jax.jvp(energy.gradient, (x,), (jnp.zeros_like(x).at[size:].set(1.0),))[1][size:]
    if isinstance(energy.baths, ReservoirEnergy):
        return None
    y = x[size:]
    return jax.jvp(energy.baths.gradient, (y,), (jnp.ones_like(y),))[1]
