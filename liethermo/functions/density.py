"""Functions of density matrices: von Neumann's entropy, expectation values, and others in terms of the matrix."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp

import manifolds as mf
from manifolds._module import Module

from ..errors import InputError
from .energy import Energy


class VonNeumann(Energy):
    """The entropy ``-tr(rho ln rho)`` of a density matrix; its gradient is ``-ln rho - 1`` (k_B = 1).

    The derivatives of it are by divided differences, so that they are finite where eigenvalues meet
    (``manifolds.spectral``). Where an eigenvalue vanishes, as in a pure state, the gradient is infinite.

    Parameters
    ----------
    floor : float, >= 0
        Eigenvalues up to this count as zero, and have no part in the entropy: for a dissipation that keeps the rank of
        the state, as steepest ascent does. By default zero: then the state has to be positive definite.
    """

    floor: float = eqx.field(static=True)

    def __init__(self, floor: float = 0.0):
        self.floor = float(floor)
        if not 0.0 <= self.floor < 1.0:
            raise InputError(f"the floor of eigenvalues that count is a small number >= 0, not {floor!r}")

    def value(self, x) -> jax.Array:
        matrix = mf.DensityMatrices(math.isqrt(x.shape[-1])).matrix(x)
        return -mf.spectral_trace(Information(self.floor), matrix)

    def gradient(self, x) -> jax.Array:
        structure = mf.DensityMatrices(math.isqrt(x.shape[-1]))
        return -structure.vector(mf.spectral(LogPlusOne(self.floor), structure.matrix(x)))

    def hidden(self, x) -> jax.Array:
        return jnp.zeros(())

    def discrete_gradient(self, scheme, x, d, compensation) -> jax.Array:
        """By divided differences between the eigenvalues at both ends, in place of any other: its rounding vanishes."""
        structure = mf.DensityMatrices(math.isqrt(x.shape[-1]))
        ends = structure.matrix(x + compensation), structure.matrix(x + (compensation + d))
        return -structure.vector(mf.spectral_difference(Information(self.floor), *ends))

    def stage_gradients(self, scheme, path) -> jax.Array:
        """The gradients, corrected along the slopes by what is missed of the change in closed form."""
        h, b, k = path.h, path.b, path.slopes
        gradients = jax.vmap(self.gradient)(path.points)
        change = jnp.dot(self.discrete_gradient(scheme, path.start, path.step, path.compensation), path.step)
        defect, square = change - h * (b @ jnp.sum(gradients * k, axis=1)), h * (b @ jnp.sum(k * k, axis=1))
        still = square < jnp.finfo(jnp.float64).tiny
        return gradients + jnp.where(still, 0.0, defect / jnp.where(still, 1.0, square)) * k


@dataclass(frozen=True)
class LogPlusOne(mf.ScalarFunction):
    """``ln p + 1``; zero up to the floor, where that is not zero."""

    floor: float = 0.0

    def derivative(self, x, order):
        if order:
            return -math.factorial(order - 1) * (-1.0 / x) ** order
        found = jnp.log(self._inside(x)) + 1.0
        return jnp.where(x > self.floor, found, 0.0) if self.floor else found

    def width(self, x):
        return x

    def quotient(self, x, y):
        least, gap = jnp.minimum(x, y), jnp.abs(x - y)
        same = gap == 0.0
        below = least <= self.floor
        safe = jnp.where(below, 1.0, least) if self.floor else least
        found = jnp.where(same, 1.0 / safe, jnp.log1p(gap / safe) / jnp.where(same, 1.0, gap))
        if not self.floor:
            return found
        across = (self.derivative(x, 0) - self.derivative(y, 0)) * jnp.sign(x - y) / jnp.where(same, 1.0, gap)
        return jnp.where(below, across, found)

    def _inside(self, x):
        return jnp.where(x > self.floor, x, 1.0) if self.floor else x


@dataclass(frozen=True)
class Information(mf.ScalarFunction):
    """``p ln p``; zero up to the floor, and where p is zero."""

    floor: float = 0.0

    def derivative(self, x, order):
        if order:
            return LogPlusOne(self.floor).derivative(x, order - 1)
        outside = (x == 0.0) if not self.floor else (x <= self.floor)
        return jnp.where(outside, 0.0, x * jnp.log(jnp.where(outside, 1.0, x)))

    def width(self, x):
        return x

    def quotient(self, x, y):
        """``ln u + l ln(u / l) / (u - l)``, of the larger one u and the smaller one l."""
        least, most = jnp.minimum(x, y), jnp.maximum(x, y)
        gap = most - least
        same, inside = gap == 0.0, least > self.floor
        safe = jnp.where(inside, least, 1.0) if self.floor else least
        share = jnp.where(same, 1.0, safe * jnp.log1p(gap / safe) / jnp.where(same, 1.0, gap))
        across = jnp.where(least == 0.0, 0.0, share)  # of the limit
        if not self.floor:
            return jnp.log(most) + across
        outside = self.derivative(most, 0) / jnp.where(same, 1.0, gap)
        return jnp.where(inside, jnp.log(jnp.where(inside, most, 1.0)) + share, outside)

    @property
    def differentiated(self):
        return LogPlusOne(self.floor)


class OfMatrix(Module):
    """A function of a density matrix, as one of its coordinates, without those of baths behind."""

    function: Callable
    structure: mf.DensityMatrices

    @property
    def __name__(self) -> str:
        return getattr(self.function, "__name__", "preserved")

    def __call__(self, x):
        return self.function(self.structure.matrix(x[: self.structure.dim]))


class Expectation(Module):
    """``tr(rho H(t))`` of the coordinates of rho, for a function of time."""

    hamiltonian: Callable
    structure: mf.DensityMatrices

    def __call__(self, x, t):
        return jnp.dot(self.structure.vector(self.hamiltonian(t)), x)


class Modulated(Module):
    """``tr(rho (H_0 + f_1(t) H_1 + ...))`` of the coordinates of rho, by those of the matrices."""

    constant: jax.Array
    terms: tuple[jax.Array, ...]
    functions: tuple[Callable, ...]

    def __call__(self, x, t):
        moved = [f(t) * term for f, term in zip(self.functions, self.terms, strict=True)]
        return jnp.dot(sum(moved, self.constant), x)
