"""Functions of density matrices: von Neumann's entropy, expectation values, and others in terms of the matrix."""

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
from .energy import Energy, Linear

NEGATIVE_EIGENVALUE_LIMIT = 1e-12
"""Largest size of a negative eigenvalue of a density matrix that is rounding: up to it the matrix is positive."""

SMALLEST_EIGENVALUE = 1e-40
"""Eigenvalue below which the entropy is continued by its tangent, so that its gradient is finite (at most 92)."""


class VonNeumann(Energy):
    """The entropy ``-tr(rho ln rho)`` of a density matrix; its gradient is ``-ln rho - 1`` (k_B = 1).

    The derivatives of it are by divided differences, so that they are finite where eigenvalues meet
    (``manifolds.spectral``). Where an eigenvalue vanishes, as in a pure state, the gradient is infinite: the entropy is
    continued by its tangent there, from eigenvalues of 1e-40 down to -1e-12, which are zero to rounding.

    Parameters
    ----------
    floor : float, >= 0
        Eigenvalues up to this count as zero, and have no part in the entropy: for a dissipation that keeps the rank of
        the state, as steepest ascent does. By default zero: then the state has to be positive definite.
    """

    floor: float = eqx.field(static=True)
    negative_limit: ClassVar[float] = NEGATIVE_EIGENVALUE_LIMIT

    def __init__(self, floor: float = 0.0):
        self.floor = float(floor)
        if not 0.0 <= self.floor < 1.0:
            raise InputError(f"the floor of eigenvalues that count is a small number >= 0, not {floor!r}")

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
        """By divided differences between the eigenvalues at both ends, in place of any other: its rounding vanishes."""
        structure = mf.DensityMatrices(math.isqrt(x.shape[-1]))
        ends = structure.matrix(x + compensation), structure.matrix(x + (compensation + d))
        return -structure.vector(mf.spectral_difference(EntropyIntegrand(self.floor, self.negative_limit), *ends))

    def stage_gradients(self, scheme, path) -> jax.Array:
        """The gradients, corrected along the slopes by what is missed of the change in closed form."""
        h, b, k = path.h, path.b, path.slopes
        gradients = jax.vmap(self.gradient)(path.points)
        change = jnp.dot(self.discrete_gradient(scheme, path.start, path.step, path.compensation), path.step)
        defect, square = change - h * (b @ jnp.sum(gradients * k, axis=1)), h * (b @ jnp.sum(k * k, axis=1))
        still = square < jnp.finfo(jnp.float64).tiny
        return gradients + jnp.where(still, 0.0, defect / jnp.where(still, 1.0, square)) * k


class IsolatedVonNeumann(VonNeumann):
    """The entropy of a system without dissipation, in whose motion it has no part; finite for every Hermitian matrix.

    Steps that conserve eigenvalues to their order alone, as those of the midpoint scheme do, leave the cone of positive
    matrices by their error where an eigenvalue is zero.
    """

    negative_limit = math.inf


@dataclass(frozen=True)
class LogPlusOne(mf.ScalarFunction):
    """``ln p + 1``, constant below :data:`SMALLEST_EIGENVALUE`; zero up to the floor, where that is not zero.

    It is NaN where p is negative beyond a limit, outside the cone of positive matrices.
    """

    floor: float = 0.0
    negative_limit: float = NEGATIVE_EIGENVALUE_LIMIT

    def derivative(self, x, order):
        if order:
            above = x > self._tangent_threshold
            return jnp.where(above, -math.factorial(order - 1) * (-1.0 / jnp.where(above, x, 1.0)) ** order, 0.0)
        value = jnp.log(jnp.maximum(x, self._tangent_threshold)) + 1.0
        return _nan_outside_cone(x, self, jnp.where(x > self.floor, value, 0.0) if self.floor else value)

    def width(self, x):
        return jnp.abs(x - self._tangent_threshold)

    def difference_quotient(self, x, y):
        least, most = jnp.minimum(x, y), jnp.maximum(x, y)
        gap, above = most - least, least > self._tangent_threshold
        safe_gap, safe = jnp.where(gap == 0.0, 1.0, gap), jnp.where(above, least, 1.0)
        logarithm = jnp.where(gap == 0.0, 1.0 / safe, jnp.log1p(gap / safe) / safe_gap)
        return jnp.where(above, logarithm, (self.derivative(most, 0) - self.derivative(least, 0)) / safe_gap)

    @property
    def _tangent_threshold(self) -> float:
        return max(self.floor, SMALLEST_EIGENVALUE)


@dataclass(frozen=True)
class EntropyIntegrand(mf.ScalarFunction):
    """``p ln p``, continued by its tangent below :data:`SMALLEST_EIGENVALUE`; zero up to a floor that is not zero.

    Its derivative is :class:`LogPlusOne`, and it is NaN where that is.
    """

    floor: float = 0.0
    negative_limit: float = NEGATIVE_EIGENVALUE_LIMIT

    def derivative(self, x, order):
        if order:
            return LogPlusOne(self.floor, self.negative_limit).derivative(x, order - 1)
        above = jnp.maximum(x, self._tangent_threshold)
        value = jnp.where(x > self.floor, x * jnp.log(above), 0.0) if self.floor else x * jnp.log(above) + (x - above)
        return _nan_outside_cone(x, self, value)

    def width(self, x):
        return jnp.abs(x - self._tangent_threshold)

    def difference_quotient(self, x, y):
        """``ln u + l ln(u / l) / (u - l)``, of the larger one u and the smaller one l."""
        least, most = jnp.minimum(x, y), jnp.maximum(x, y)
        gap = most - least
        safe_gap, safe = jnp.where(gap == 0.0, 1.0, gap), jnp.where(least > self._tangent_threshold, least, 1.0)
        share = jnp.where(gap == 0.0, 1.0, safe * jnp.log1p(gap / safe) / safe_gap)
        above = jnp.log(jnp.maximum(most, self._tangent_threshold)) + share
        across = (self.derivative(most, 0) - self.derivative(least, 0)) / safe_gap
        below = _nan_outside_cone(
            least, self, self.derivative_function.derivative(most, 0)
        )  # constant, so the quotient is it
        return jnp.where(
            least > self._tangent_threshold, above, jnp.where(most > self._tangent_threshold, across, below)
        )

    @property
    def _tangent_threshold(self) -> float:
        return max(self.floor, SMALLEST_EIGENVALUE)

    @property
    def derivative_function(self):
        return LogPlusOne(self.floor, self.negative_limit)


def _nan_outside_cone(p, function: LogPlusOne | EntropyIntegrand, value) -> jax.Array:
    """The value of a function of an eigenvalue p; NaN where p is negative beyond its limit, and beyond its floor."""
    return jnp.where(p < -max(function.floor, function.negative_limit), jnp.nan, value)


@dataclass(frozen=True)
class PositivePart(mf.ScalarFunction):
    """``max(p, 0)``."""

    def derivative(self, x, order):
        return jnp.maximum(x, 0.0) if order == 0 else jnp.where((x > 0.0) & (order == 1), 1.0, 0.0)

    def width(self, x):
        return jnp.abs(x)

    def difference_quotient(self, x, y):
        gap = x - y
        across = (jnp.maximum(x, 0.0) - jnp.maximum(y, 0.0)) / jnp.where(gap == 0.0, 1.0, gap)
        return jnp.where(gap == 0.0, self.derivative(x, 1), across)


def positive_part(rho) -> jax.Array:
    """Density matrices, shape (..., N, N), with zero instead of eigenvalues that are negative by rounding."""
    return mf.spectral(PositivePart(), rho)


def matrix_logarithm(rho) -> jax.Array:
    """``ln rho`` of density matrices, shape (..., N, N), finite where eigenvalues are zero to rounding."""
    return mf.spectral(LogPlusOne(), rho) - np.eye(rho.shape[-1])


class DensityMatrixFunction(Module):
    """A function of a density matrix, as one of its coordinates, without those of baths behind."""

    function: Callable
    structure: mf.DensityMatrices

    @property
    def __name__(self) -> str:
        return getattr(self.function, "__name__", "preserved")

    def __call__(self, x):
        return self.function(self.structure.matrix(x[: self.structure.dim]))


class MeanEnergy(Linear):
    """``tr(rho H)`` of the coordinates of rho, shape (N^2,), which has trace one, by those of H.

    An energy e that the levels have in common is added as a constant, ``tr(rho (H - e)) + e``. The gradient is then
    that of differences of levels: a constant that is added to H changes neither the motion nor its rounding.

    Parameters
    ----------
    b : array, shape (N^2,)
        The coordinates of H.
    reference_level : array, shape ()
        e: see :func:`choose_reference_level`. It makes no difference but by rounding.
    """

    reference_level: jax.Array

    def value(self, x) -> jax.Array:
        return jnp.dot(self.gradient(x), x) + self.reference_level

    def gradient(self, x) -> jax.Array:
        return subtract_level(self.b, self.reference_level)

    def __neg__(self) -> Energy:
        return MeanEnergy(-self.b, -self.reference_level)


def choose_reference_level(levels: np.ndarray) -> float:
    """The lower one of the two levels that are nearest to each other: their differences then lose no digit.

    It grows by c where all levels, shape (N,), do.
    """
    ordered = np.sort(levels)
    return float(ordered[0 if len(ordered) == 1 else np.argmin(np.diff(ordered))])


def subtract_level(b, common) -> jax.Array:
    """The coordinates of H - e, of those of H, shape (N^2,), and a number e."""
    return b - common * np.where(np.arange(b.shape[-1]) < math.isqrt(b.shape[-1]), 1.0, 0.0)


class ExpectationValue(Module):
    """``tr(rho H(t))`` of the coordinates of rho, for a function of time; ``reference_level`` is as in :class:`MeanEnergy`.

    It is the lowest level at the time zero, so that it grows by c where H does: a discrete gradient weights the state
    and the time by the gradients of the energy by both.
    """

    hamiltonian: Callable
    structure: mf.DensityMatrices
    reference_level: jax.Array

    def __call__(self, x, t):
        b = self.structure.vector(self.hamiltonian(t))
        return jnp.dot(subtract_level(b, self.reference_level), x) + self.reference_level


class ModulatedExpectationValue(Module):
    """``tr(rho (H_0 + f_1(t) H_1 + ...))`` of the coordinates of rho, by those of the matrices; likewise."""

    constant: jax.Array
    terms: tuple[jax.Array, ...]
    functions: tuple[Callable, ...]
    reference_level: jax.Array

    def __call__(self, x, t):
        moved = [f(t) * term for f, term in zip(self.functions, self.terms, strict=True)]
        return jnp.dot(sum(moved, subtract_level(self.constant, self.reference_level)), x) + self.reference_level
