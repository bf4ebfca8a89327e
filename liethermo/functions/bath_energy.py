"""The energy of baths of constant heat capacity, with what it changes by in closed form."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
import numpy as np
import scipy

from manifolds._arrays import is_traced

from .energy import Energy, Linear
from .indices import sparsity_pattern

MAX_SERIES_ARGUMENT = 1 / 32
"""Largest argument of the series of ``(exp(z) - 1) / z``: what its eight terms leave out is below their rounding."""


class BathEnergy(Energy):
    """``sum_b C_b T_b (exp(y_b / C_b) - 1)`` of the entropies y, so that ``T_b exp(y_b / C_b)`` is the temperature.

    Measured from y = 0: else the heat of a small body would be lost in the rounding of what a large bath holds. Over a
    step that changes y_b by d_b the energy changes by ``T_b exp(y_b / C_b) C_b (exp(d_b / C_b) - 1)``, which is not the
    difference of two values and has none of their rounding.

    Parameters
    ----------
    capacity, temperature : array, shape (m,)
        C and T.
    """

    capacity: jax.Array
    temperature: jax.Array

    def value(self, x) -> jax.Array:
        return jnp.sum(self.temperature * _exponential_and_quotient(x * self.rate)[1] * x)

    def gradient(self, x) -> jax.Array:
        return self.temperature * jnp.exp(x * self.rate)

    def difference_rounding_scale(self, x) -> jax.Array:
        return jnp.zeros(())

    def discrete_gradient(self, scheme, x, d, compensation) -> jax.Array:
        """The one that there is, of functions of one number each."""
        return self.gradient(x + compensation) * _exponential_and_quotient(d * self.rate)[1]

    def stage_gradients(self, scheme, path) -> jax.Array:
        start, k, h, b = path.start + path.compensation, path.slopes, path.h, path.b
        ahead = jnp.concatenate([path.points - start, path.step[None]])
        powers, grown = _exponential_and_quotient(ahead * self.rate)
        first = self.gradient(start)
        gradients, change = first * powers[:-1], first * grown[-1] * path.step
        defect, square = change - h * (b @ (gradients * k)), h * (b @ (k * k))
        still = square < jnp.finfo(jnp.float64).tiny
        return gradients + jnp.where(still, 0.0, defect / jnp.where(still, 1.0, square)) * k

    @property
    def rate(self) -> jax.Array:
        """By which a temperature grows with the entropy, shape (m,)."""
        return 1.0 / self.capacity

    def couplings(self, dim: int) -> scipy.sparse.csr_array:
        return sparsity_pattern(range(dim), range(dim), dim)


class ReservoirEnergy(Linear):
    """``sum_b T_b y_b`` of the entropies y: the energy of baths of infinite capacity, which keep their temperatures."""

    @property
    def temperature(self) -> jax.Array:
        return self.b

    @property
    def capacity(self) -> jax.Array:
        return jnp.full_like(self.b, jnp.inf)


def make_bath_energy(capacity: jax.Array, temperature: jax.Array) -> BathEnergy | ReservoirEnergy:
    """The energy of baths of constant capacities, finite or infinite, shape (m,) each."""
    if is_traced(capacity) or not np.isinf(np.asarray(capacity)).all():
        return BathEnergy(capacity, temperature)
    return ReservoirEnergy(temperature)


def _exponential_and_quotient(z) -> tuple[jax.Array, jax.Array]:
    """``exp(z)`` and ``(exp(z) - 1) / z``, elementwise: by their series where all z are near zero, as within a step."""

    def series() -> tuple[jax.Array, jax.Array]:
        """By pairs, which do not wait for each other."""
        terms, power = [jnp.full_like(z, 1.0 / math.factorial(n)) for n in range(1, 9)], z
        while len(terms) > 1:
            terms = [one + power * other for one, other in zip(terms[::2], terms[1::2], strict=True)]
            power = power * power
        return 1.0 + z * terms[0], terms[0]

    def quotient() -> tuple[jax.Array, jax.Array]:
        zero = z == 0.0
        return jnp.exp(z), jnp.where(zero, 1.0, jnp.expm1(z) / jnp.where(zero, 1.0, z))

    return jax.lax.cond(jnp.max(jnp.abs(z)) <= MAX_SERIES_ARGUMENT, series, quotient)
