"""The energy of a body and of the baths that it heats, as one function with one gradient."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import scipy

from .bath_energy import keeps_temperatures
from .energy import Energy, Pullback
from .frames import sum_terms
from .indices import Components, pattern_of_matrix
from .path import CollocationPath


class BodyBathsEnergy(Energy):
    """The energy ``H(x) + U(y)`` of a state (x, y): two functions that share no component.

    In a sum of two functions of the whole state, each gradient would be a vector of full length, mostly zeros.

    Attributes
    ----------
    body : Energy
        Energy of the first ``body_dim`` components. It may depend on time.
    baths : Energy
        Energy of the other components. It may depend on time too.
    body_dim, dim : int
        Number of components of the body, and of the state.
    """

    body: Energy
    baths: Energy
    body_dim: int = eqx.field(static=True)
    dim: int = eqx.field(static=True)

    @property
    def terms(self) -> tuple[Energy, ...]:
        if not self.depends_on_time:
            return (self,)
        body_terms = self.body.on(range(self.body_dim)).terms
        return (*body_terms, *self.baths.on(range(self.body_dim, self.dim)).terms)

    @property
    def is_quadratic(self) -> bool:
        return self.body.is_quadratic and self.baths.is_quadratic

    @property
    def depends_on_time(self) -> bool:
        return self.body.depends_on_time or self.baths.depends_on_time

    def at_time(self, t) -> Energy:
        return BodyBathsEnergy(self.body.at_time(t), self.baths.at_time(t), self.body_dim, self.dim)

    @property
    def _energies_and_components(self) -> tuple[tuple[Energy, Components], ...]:
        return (self.body, Components(range(self.body_dim))), (self.baths, Components(range(self.body_dim, self.dim)))

    def value(self, x) -> jax.Array:
        return sum_terms(energy.value(components(x)) for energy, components in self._energies_and_components)

    def gradient(self, x) -> jax.Array:
        return jnp.concatenate([energy.gradient(components(x)) for energy, components in self._energies_and_components])

    def sensitivity(self, x) -> jax.Array:
        return sum_terms(energy.sensitivity(components(x)) for energy, components in self._energies_and_components)

    def rounding_scale(self, x) -> jax.Array:
        return sum_terms(energy.rounding_scale(components(x)) for energy, components in self._energies_and_components)

    def difference_rounding_scale(self, x) -> jax.Array:
        return sum_terms(
            term.difference_rounding_scale(components(x))
            for energy, components in self._energies_and_components
            for term in energy.terms
        )

    def discrete_gradient(self, scheme, x, d, compensation) -> jax.Array:
        arrays = x, d, jnp.zeros_like(x) + compensation

        def energy_discrete_gradient(energy: Energy, components: Components) -> jax.Array:
            if (
                energy is self.body and energy.is_quadratic
            ):  # at the midpoint of the whole state, which other terms use too
                return components(scheme.quadratic(Pullback(energy, components), *arrays))
            return sum_terms(term.discrete_gradient(scheme, *map(components, arrays)) for term in energy.terms)

        return jnp.concatenate([energy_discrete_gradient(*pair) for pair in self._energies_and_components])

    def stage_gradients(self, scheme, path: CollocationPath) -> jax.Array:
        def energy_stage_gradients(energy: Energy, components: Components) -> jax.Array:
            component_path, _ = path.path_and_pullback_in(components)
            return sum_terms(term.stage_gradients(scheme, component_path) for term in energy.terms)

        return jnp.concatenate([energy_stage_gradients(*pair) for pair in self._energies_and_components], axis=1)

    def couplings(self, dim: int) -> scipy.sparse.csr_array | None:
        body, baths = self.body.couplings(self.body_dim), self.baths.couplings(dim - self.body_dim)
        if body is None or baths is None:
            return None
        return pattern_of_matrix(scipy.sparse.block_diag([body, baths]))

    def check_components(self, dim: int, role: str) -> None:
        for energy, dim_of_energy in ((self.body, self.body_dim), (self.baths, dim - self.body_dim)):
            for term in energy.terms:
                term.check_components(dim_of_energy, role)

    def __neg__(self) -> Energy:
        return BodyBathsEnergy(-self.body, -self.baths, self.body_dim, self.dim)


def temperature_derivatives_by_entropy(energy: Energy, x, body_dim: int) -> jax.Array | None:
    """Return the derivative of each bath's temperature by its entropy, shape (m,); None for constant temperatures.

    The first ``body_dim`` components belong to the body, the others to the baths.
    """
    if not isinstance(energy, BodyBathsEnergy):
        return jax.jvp(energy.gradient, (x,), (jnp.zeros_like(x).at[body_dim:].set(1.0),))[1][body_dim:]
    if keeps_temperatures(energy.baths):
        return None
    y = x[body_dim:]
    return jax.jvp(energy.baths.gradient, (y,), (jnp.ones_like(y),))[1]
