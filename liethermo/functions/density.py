"""Functions of density matrices: von Neumann's entropy, expectation values, and other functions of the matrix."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import manifolds as mf
from manifolds._pytree_module import Module

from ..errors import InputError
from ..tracing.short_form import callable_name
from .energy import Energy, Linear

NEGATIVE_EIGENVALUE_LIMIT = 1e-12
"""Largest modulus of a negative eigenvalue of a density matrix that counts as rounding of a zero."""

SMALLEST_EIGENVALUE = 1e-40
"""Eigenvalue below which the entropy is continued by its tangent, which bounds its gradient by 92."""

REST_RTOL = 4.0 * float(np.finfo(np.float64).eps)
"""Length of a step, relative to the state, below which it is rounding: its gradients are not corrected along it."""


DEFECT_RTOL = float(np.finfo(np.float64).eps)
"""Largest defect of the entropy in a step, relative to |gradient| |state|, that is left without a correction."""


class VonNeumann(Energy):
    """The entropy ``-tr(rho ln rho)`` of a density matrix; its gradient is ``-ln rho - 1`` (k_B = 1).

    Its derivatives use divided differences, so they are finite where eigenvalues cross (``manifolds.spectral``). The
    gradient is infinite where an eigenvalue vanishes, as in a pure state. There the entropy is continued by its
    tangent, for eigenvalues from 1e-40 down to -1e-12, which are zero to rounding.

    Parameters
    ----------
    floor : float, >= 0
        Eigenvalues up to this value count as zero and do not contribute to the entropy. Use it with a dissipation that
        preserves the rank of the state, such as steepest ascent. With the default, zero, the state must be positive
        definite.
    """

    floor: float = eqx.field(static=True)
    negative_limit: ClassVar[float] = NEGATIVE_EIGENVALUE_LIMIT

    def __init__(self, floor: float = 0.0):
        self.floor = float(floor)
        if not 0.0 <= self.floor < 1.0:
            raise InputError(f"floor must be a number from 0 to 1, got {floor!r}")

    def value(self, x) -> jax.Array:
        matrix = mf.DensityMatrices(math.isqrt(x.shape[-1])).matrix(x)
        return -mf.spectral_trace(EntropyIntegrand(self.floor, self.negative_limit), matrix)

    def gradient(self, x) -> jax.Array:
        structure = mf.DensityMatrices(math.isqrt(x.shape[-1]))
        return -structure.vector(mf.spectral(LogPlusOne(self.floor, self.negative_limit), structure.matrix(x)))

    def __eq__(self, other) -> bool:
        return isinstance(other, VonNeumann) and self.floor == other.floor

    def __hash__(self) -> int:
        return hash(self.floor)

    def difference_rounding_scale(self, x) -> jax.Array:
        return jnp.zeros(())

    def discrete_gradient(self, scheme, x, d, compensation) -> jax.Array:
        """Return the divided difference between the eigenvalues at both ends; its rounding error vanishes with d.

        It replaces the discrete gradient of every scheme.
        """
        structure = mf.DensityMatrices(math.isqrt(x.shape[-1]))
        ends = structure.matrix(x + compensation), structure.matrix(x + (compensation + d))
        return -structure.vector(mf.spectral_difference(EntropyIntegrand(self.floor, self.negative_limit), *ends))

    def stage_gradients(self, scheme, path) -> jax.Array:
        """Return the gradients at the stages, corrected along the slopes to give the exact change over the step."""
        h, b, k = path.h, path.b, path.slopes
        gradients = jax.vmap(self.gradient)(path.points)
        change = jnp.dot(self.discrete_gradient(scheme, path.start, path.step, path.compensation), path.step)
        defect, squared_norm = change - h * (b @ jnp.sum(gradients * k, axis=1)), h * (b @ jnp.sum(k * k, axis=1))
        is_at_rest = h * squared_norm <= (REST_RTOL**2) * jnp.sum(path.start * path.start)
        # Rounding of an eigenvalue near zero changes its logarithm by up to 50, and its rate by rounding. The defect
        # then consists of rounding that does not vanish with the step, so the correction would exceed the slope.
        rounding = DEFECT_RTOL * jnp.max(jnp.linalg.norm(gradients, axis=1)) * jnp.linalg.norm(path.start)
        defect = defect - jnp.clip(defect, -rounding, rounding)
        return gradients + jnp.where(is_at_rest, 0.0, defect / jnp.where(is_at_rest, 1.0, squared_norm)) * k


class IsolatedVonNeumann(VonNeumann):
    """The entropy of a system without dissipation, which does not affect its motion; finite for every Hermitian matrix.

    Steps that conserve eigenvalues only to their order, such as those of the midpoint scheme, leave the cone of
    positive matrices by their error if an eigenvalue is zero.
    """

    negative_limit = math.inf


@dataclass(frozen=True)
class LogPlusOne(mf.ScalarFunction):
    """The function ``ln p + 1``, constant below :data:`SMALLEST_EIGENVALUE`; zero up to a positive floor.

    It is NaN if p is negative beyond the limit, outside the cone of positive matrices.
    """

    floor: float = 0.0
    negative_limit: float = NEGATIVE_EIGENVALUE_LIMIT

    def derivative(self, x, order):
        if order:
            is_above = x > self._tangent_threshold
            return jnp.where(is_above, -math.factorial(order - 1) * (-1.0 / jnp.where(is_above, x, 1.0)) ** order, 0.0)
        value = jnp.log(jnp.maximum(x, self._tangent_threshold)) + 1.0
        return _nan_if_negative(x, self, jnp.where(x > self.floor, value, 0.0) if self.floor else value)

    def width(self, x):
        return jnp.abs(x - self._tangent_threshold)

    def difference_quotient(self, x, y):
        lower, upper = jnp.minimum(x, y), jnp.maximum(x, y)
        gap, is_above = upper - lower, lower > self._tangent_threshold
        safe_gap, safe_lower = jnp.where(gap == 0.0, 1.0, gap), jnp.where(is_above, lower, 1.0)
        logarithm = jnp.where(gap == 0.0, 1.0 / safe_lower, jnp.log1p(gap / safe_lower) / safe_gap)
        return jnp.where(is_above, logarithm, (self.derivative(upper, 0) - self.derivative(lower, 0)) / safe_gap)

    @property
    def _tangent_threshold(self) -> float:
        return max(self.floor, SMALLEST_EIGENVALUE)


@dataclass(frozen=True)
class EntropyIntegrand(mf.ScalarFunction):
    """The function ``p ln p``, continued by its tangent below :data:`SMALLEST_EIGENVALUE`; zero up to a positive floor.

    Its derivative is :class:`LogPlusOne`; both are NaN for the same p.
    """

    floor: float = 0.0
    negative_limit: float = NEGATIVE_EIGENVALUE_LIMIT

    def derivative(self, x, order):
        if order:
            return LogPlusOne(self.floor, self.negative_limit).derivative(x, order - 1)
        clipped_x = jnp.maximum(x, self._tangent_threshold)
        value = (
            jnp.where(x > self.floor, x * jnp.log(clipped_x), 0.0)
            if self.floor
            else x * jnp.log(clipped_x) + (x - clipped_x)
        )
        return _nan_if_negative(x, self, value)

    def width(self, x):
        return jnp.abs(x - self._tangent_threshold)

    def difference_quotient(self, x, y):
        """Return ``ln u + l ln(u / l) / (u - l)`` of the larger argument u and the smaller argument l."""
        lower, upper = jnp.minimum(x, y), jnp.maximum(x, y)
        gap = upper - lower
        safe_gap, safe_lower = jnp.where(gap == 0.0, 1.0, gap), jnp.where(lower > self._tangent_threshold, lower, 1.0)
        log_quotient = jnp.where(gap == 0.0, 1.0, safe_lower * jnp.log1p(gap / safe_lower) / safe_gap)
        quotient_above = jnp.log(jnp.maximum(upper, self._tangent_threshold)) + log_quotient
        quotient_across = (self.derivative(upper, 0) - self.derivative(lower, 0)) / safe_gap
        # the derivative is constant below the threshold, so it is the quotient
        quotient_below = _nan_if_negative(lower, self, self.derivative_function.derivative(upper, 0))
        return jnp.where(
            lower > self._tangent_threshold,
            quotient_above,
            jnp.where(upper > self._tangent_threshold, quotient_across, quotient_below),
        )

    @property
    def _tangent_threshold(self) -> float:
        return max(self.floor, SMALLEST_EIGENVALUE)

    @property
    def derivative_function(self):
        return LogPlusOne(self.floor, self.negative_limit)


def _nan_if_negative(p, function: LogPlusOne | EntropyIntegrand, value) -> jax.Array:
    """Return the value of a function of an eigenvalue p, or NaN if p is negative beyond its limit and floor."""
    return jnp.where(p < -max(function.floor, function.negative_limit), jnp.nan, value)


@dataclass(frozen=True)
class PositivePart(mf.ScalarFunction):
    """The function ``max(p, 0)``."""

    def derivative(self, x, order):
        return jnp.maximum(x, 0.0) if order == 0 else jnp.where((x > 0.0) & (order == 1), 1.0, 0.0)

    def width(self, x):
        return jnp.abs(x)

    def difference_quotient(self, x, y):
        gap = x - y
        quotient = (jnp.maximum(x, 0.0) - jnp.maximum(y, 0.0)) / jnp.where(gap == 0.0, 1.0, gap)
        return jnp.where(gap == 0.0, self.derivative(x, 1), quotient)


def positive_part(rho) -> jax.Array:
    """Return density matrices, shape (..., N, N), with eigenvalues that are negative by rounding set to zero."""
    return mf.spectral(PositivePart(), rho)


def matrix_logarithm(rho) -> jax.Array:
    """Return ``ln rho`` of density matrices, shape (..., N, N), finite if eigenvalues are zero to rounding."""
    return mf.spectral(LogPlusOne(), rho) - np.eye(rho.shape[-1])


class DensityMatrixFunction(Module):
    """A function of the state of a quantum system that evaluates a function of its density matrix.

    The state has the coordinates of the matrix first, then those of baths.
    """

    function: Callable
    structure: mf.DensityMatrices

    @property
    def __name__(self) -> str:
        return callable_name(self.function, "preserved")

    def __call__(self, x):
        return self.function(self.structure.matrix(x[: self.structure.dim]))


class MeanEnergy(Linear):
    """The mean energy ``tr(rho H)`` as a function of the coordinates of rho, shape (N^2,), which has trace one.

    An energy e that the levels have in common is added as a constant: ``tr(rho (H - e)) + e``. The gradient then
    depends on differences of levels only, so a constant added to H changes neither the motion nor its rounding.

    Parameters
    ----------
    b : array, shape (N^2,)
        The coordinates of H.
    reference_level : array, shape ()
        The energy e: see :func:`lower_level_of_smallest_gap`. It affects rounding only.
    """

    reference_level: jax.Array

    def value(self, x) -> jax.Array:
        return jnp.dot(self.gradient(x), x) + self.reference_level

    def gradient(self, x) -> jax.Array:
        return subtract_level(self.b, self.reference_level)

    def __neg__(self) -> Energy:
        return MeanEnergy(-self.b, -self.reference_level)


def lower_level_of_smallest_gap(levels: np.ndarray) -> float:
    """Return the lower one of the two levels, among levels of shape (N,), that are separated by the smallest gap.

    With this level as the zero of energy, the gap keeps all its digits. The result grows by c if all levels do.
    """
    sorted_levels = np.sort(levels)
    return float(sorted_levels[0 if len(sorted_levels) == 1 else np.argmin(np.diff(sorted_levels))])


def subtract_level(hamiltonian_coordinates, level) -> jax.Array:
    """Return the coordinates of H - level, from those of H, shape (N^2,), and a number."""
    return hamiltonian_coordinates - level * np.where(
        np.arange(hamiltonian_coordinates.shape[-1]) < math.isqrt(hamiltonian_coordinates.shape[-1]), 1.0, 0.0
    )


class ExpectationValue(Module):
    """The mean energy ``tr(rho H(t))`` as a function of the coordinates of rho and the time.

    The ``reference_level``, as in :class:`MeanEnergy`, is the lowest level at time zero, so it grows by c if H does: a
    discrete gradient weights the state and the time by the two gradients of the energy.
    """

    hamiltonian: Callable
    structure: mf.DensityMatrices
    reference_level: jax.Array

    def __call__(self, x, t):
        b = self.structure.vector(self.hamiltonian(t))
        return jnp.dot(subtract_level(b, self.reference_level), x) + self.reference_level


class ModulatedExpectationValue(Module):
    """The mean energy ``tr(rho (H_0 + f_1(t) H_1 + ...))`` as a function of the coordinates of rho and the time.

    The ``reference_level`` is chosen as in :class:`ExpectationValue`.
    """

    constant: jax.Array
    terms: tuple[jax.Array, ...]
    functions: tuple[Callable, ...]
    reference_level: jax.Array

    def __call__(self, x, t):
        time_terms = [f(t) * term for f, term in zip(self.functions, self.terms, strict=True)]
        return jnp.dot(sum(time_terms, subtract_level(self.constant, self.reference_level)), x) + self.reference_level
