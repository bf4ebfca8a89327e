"""The energy of heat baths of constant heat capacity, and that of a body and its baths as one function."""

from __future__ import annotations

import math
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy

from manifolds._arrays import is_traced

from ..errors import InputError
from .conditions import ParameterCondition
from .energy import Energy, Linear, Pullback, SpanLimitedEnergy, StateTimeEnergy
from .frames import sum_arrays
from .indices import Components, pattern_of_matrix, sparsity_pattern
from .path import CollocationPath
from .time_span import TimeSpan

BATH_CAPACITY_CONDITION = ParameterCondition(lambda a: a > 0.0, "the capacity of a bath must be positive, got {value}")
BATH_TEMPERATURE_CONDITION = ParameterCondition(
    lambda a: (a > 0.0) & (a < np.inf), "the temperature of a bath must be positive and finite, got {value}"
)

MAX_SERIES_ARGUMENT = 1 / 32
"""Largest argument of the series of ``(exp(z) - 1) / z``: its truncation after eight terms is then below rounding."""


class BathEnergy(Energy):
    """The energy of heat baths, ``sum_b C_b T_b (exp(y_b / C_b) - 1)``, as a function of their entropies y.

    The temperatures are ``T_b exp(y_b / C_b)``. The energy vanishes at y = 0; otherwise the heat of a small body would
    be lost in the rounding of the content of a large bath. Over a step that changes y_b by d_b the energy changes by
    ``T_b exp(y_b / C_b) C_b (exp(d_b / C_b) - 1)``. This is not a difference of two values, so it has none of their
    rounding.

    Parameters
    ----------
    capacity, temperature : array, shape (m,)
        C and T.
    """

    capacity: jax.Array = eqx.field(metadata=BATH_CAPACITY_CONDITION.metadata)
    temperature: jax.Array = eqx.field(metadata=BATH_TEMPERATURE_CONDITION.metadata)

    def value(self, x) -> jax.Array:
        return jnp.sum(self.temperature * _exp_and_expm1_quotient(x * self.inverse_capacity)[1] * x)

    def gradient(self, x) -> jax.Array:
        return self.temperature * jnp.exp(x * self.inverse_capacity)

    def difference_rounding_scale(self, x) -> jax.Array:
        return jnp.zeros(())

    def discrete_gradient(self, scheme, x, d, compensation) -> jax.Array:
        """Return the difference quotient of each bath, the only discrete gradient of a function of one number."""
        return self.gradient(x + compensation) * _exp_and_expm1_quotient(d * self.inverse_capacity)[1]

    def stage_gradients(self, scheme, path) -> jax.Array:
        start, k, h, b = path.start + path.compensation, path.slopes, path.h, path.b
        displacements = jnp.concatenate([path.points - start, path.step[None]])
        exponentials, quotients = _exp_and_expm1_quotient(displacements * self.inverse_capacity)
        start_gradient = self.gradient(start)
        gradients, change = start_gradient * exponentials[:-1], start_gradient * quotients[-1] * path.step
        defect, squared_norm = change - h * (b @ (gradients * k)), h * (b @ (k * k))
        is_zero = squared_norm < jnp.finfo(jnp.float64).tiny
        return gradients + jnp.where(is_zero, 0.0, defect / jnp.where(is_zero, 1.0, squared_norm)) * k

    @property
    def inverse_capacity(self) -> jax.Array:
        """Inverse heat capacities 1 / C, shape (m,): the relative change of a temperature per entropy."""
        return 1.0 / self.capacity

    def hessian_pattern(self, dim: int) -> scipy.sparse.csr_array:
        return sparsity_pattern(range(dim), range(dim), dim)


class ReservoirEnergy(Linear):
    """The energy ``sum_b T_b y_b`` of baths of infinite capacity, with entropies y and constant temperatures."""

    b: jax.Array = eqx.field(metadata=BATH_TEMPERATURE_CONDITION.metadata)

    @property
    def temperature(self) -> jax.Array:
        return self.b

    @property
    def capacity(self) -> jax.Array:
        return jnp.full_like(self.b, jnp.inf)


class DrivenReservoirEnergy(Energy):
    """The energy ``T(t) y`` of a bath of infinite capacity, whose temperature is a function of the time.

    A device changes the temperature. At a fixed entropy y it does the work ``y T'(t)``, as for a reservoir whose levels
    are all multiplied by the same factor.

    Attributes
    ----------
    temperature : function of the time to an array of shape ()
    """

    temperature: Callable

    depends_on_time = True

    def at_time(self, t) -> ReservoirEnergy:
        return ReservoirEnergy(self.temperature(t)[None])

    def with_time(self) -> Energy:
        return _ReservoirEnergyOfTime(SpanLimitedEnergy(_TemperatureTimesEntropy(self.temperature), TimeSpan()))

    def value(self, x) -> jax.Array:
        raise InputError("this energy depends on time, so its value needs a time. Call energy(x, t)")


class _TemperatureTimesEntropy(Energy):
    """The energy ``T(t) y`` as a function of (y, t)."""

    temperature: Callable

    def value(self, x) -> jax.Array:
        return self.temperature(x[1]) * x[0]


class _ReservoirEnergyOfTime(StateTimeEnergy):
    """The energy ``T(t) y`` as a function of (y, t), with its change over a step in closed form."""

    def difference_rounding_scale(self, x) -> jax.Array:
        return jnp.zeros(())

    def discrete_gradient(self, scheme, x, d, compensation) -> jax.Array:
        """Return the mean temperature, and the difference quotient of the temperatures times the mean entropy."""
        (y, start_time), (change, duration) = x + compensation, d
        assert isinstance(self.energy, SpanLimitedEnergy)
        assert isinstance(self.energy.energy, _TemperatureTimesEntropy)
        temperature, clip = self.energy.energy.temperature, self.energy.span.clip
        start_temperature, end_temperature = temperature(clip(start_time)), temperature(clip(start_time + duration))
        _, slope = jax.jvp(temperature, (clip(start_time),), (jnp.ones(()),))
        is_zero = duration == 0.0
        rate = jnp.where(is_zero, slope, (end_temperature - start_temperature) / jnp.where(is_zero, 1.0, duration))
        return jnp.stack([0.5 * (start_temperature + end_temperature), rate * (y + 0.5 * change)])


class ZeroEnergy(Energy):
    """The energy of no baths, a function of no entropies."""

    is_quadratic = True

    def value(self, x) -> jax.Array:
        return jnp.zeros(())

    def gradient(self, x) -> jax.Array:
        return jnp.zeros_like(x)


def bath_energy_terms(baths_energy: Energy) -> list[Energy]:
    """Return the terms of the energy of some baths, each as a function of the entropies of its own baths only."""
    return [term.term if isinstance(term, Pullback) else term for term in baths_energy.terms]


def has_entropy_independent_temperatures(baths_energy: Energy) -> bool:
    """Return whether the temperatures of baths with this energy do not depend on their entropies."""
    return all(isinstance(term, ReservoirEnergy | DrivenReservoirEnergy) for term in bath_energy_terms(baths_energy))


def make_bath_energy(capacity: jax.Array, temperature: jax.Array) -> BathEnergy | ReservoirEnergy:
    """Return the energy of baths with these heat capacities and temperatures, shape (m,) each.

    The capacities are all finite or all infinite.
    """
    if is_traced(capacity) or not np.isinf(np.asarray(capacity)).all():
        return BathEnergy(capacity, temperature)
    return ReservoirEnergy(temperature)


def _exp_and_expm1_quotient(z) -> tuple[jax.Array, jax.Array]:
    """Return ``exp(z)`` and ``(exp(z) - 1) / z`` elementwise, by their series if all z are small, as within a step."""

    def sum_both_series() -> tuple[jax.Array, jax.Array]:
        """Return both values from their series, summed by pairs of terms, which a processor computes in parallel."""
        terms, power = [jnp.full_like(z, 1.0 / math.factorial(n)) for n in range(1, 9)], z
        while len(terms) > 1:
            terms = [a + power * b for a, b in zip(terms[::2], terms[1::2], strict=True)]
            power = power * power
        return 1.0 + z * terms[0], terms[0]

    def compute_both_by_expm1() -> tuple[jax.Array, jax.Array]:
        is_zero = z == 0.0
        return jnp.exp(z), jnp.where(is_zero, 1.0, jnp.expm1(z) / jnp.where(is_zero, 1.0, z))

    return jax.lax.cond(jnp.max(jnp.abs(z)) <= MAX_SERIES_ARGUMENT, sum_both_series, compute_both_by_expm1)


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
        """Energy and components of the state of the body, then of the baths."""
        return (self.body, Components(range(self.body_dim))), (self.baths, Components(range(self.body_dim, self.dim)))

    def value(self, x) -> jax.Array:
        return sum_arrays(energy.value(components(x)) for energy, components in self._energies_and_components)

    def gradient(self, x) -> jax.Array:
        return jnp.concatenate([energy.gradient(components(x)) for energy, components in self._energies_and_components])

    def sensitivity(self, x) -> jax.Array:
        return sum_arrays(energy.sensitivity(components(x)) for energy, components in self._energies_and_components)

    def rounding_scale(self, x) -> jax.Array:
        return sum_arrays(energy.rounding_scale(components(x)) for energy, components in self._energies_and_components)

    def difference_rounding_scale(self, x) -> jax.Array:
        return sum_arrays(
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
            return sum_arrays(term.discrete_gradient(scheme, *map(components, arrays)) for term in energy.terms)

        return jnp.concatenate([energy_discrete_gradient(*pair) for pair in self._energies_and_components])

    def stage_gradients(self, scheme, path: CollocationPath) -> jax.Array:
        def energy_stage_gradients(energy: Energy, components: Components) -> jax.Array:
            component_path, _ = path.path_and_pullback_in(components)
            return sum_arrays(term.stage_gradients(scheme, component_path) for term in energy.terms)

        return jnp.concatenate([energy_stage_gradients(*pair) for pair in self._energies_and_components], axis=1)

    def hessian_pattern(self, dim: int) -> scipy.sparse.csr_array | None:
        body, baths = self.body.hessian_pattern(self.body_dim), self.baths.hessian_pattern(dim - self.body_dim)
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
    if has_entropy_independent_temperatures(energy.baths):
        return None
    y = x[body_dim:]
    return jax.jvp(energy.baths.gradient, (y,), (jnp.ones_like(y),))[1]
