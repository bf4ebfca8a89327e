"""Divided differences of functions of one number, of any order, at points that may coincide."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
import scipy.special

from .._pytree_module import forward_to

MAX_SPREAD_FOR_MEAN = 1 / 16
"""Largest spread of points, relative to the width of a function, for which divided differences are means of
derivatives.

Beyond, a quotient of differences loses four bits. Up to it, the error of a mean over four nodes is rounding.
"""


class ScalarFunction:
    """Function of a number with its derivatives; instances must be hashable, and equal ones must be one function."""

    @abstractmethod
    def derivative(self, x, order: int) -> jax.Array:
        """Return the derivative of an order, entry by entry; order 0 is the function itself."""

    @abstractmethod
    def width(self, x) -> jax.Array:
        """Return the distance from x to the nearest singularity, or the length over which the function changes much."""

    def difference_quotient(self, x, y) -> jax.Array:
        """Return the first divided difference ``f[x, y]``."""
        return self._mean_or_quotient(x, y)

    @property
    def derivative_function(self) -> ScalarFunction:
        """Derivative as a :class:`ScalarFunction`."""
        return Derivative(self)

    def divided_difference(self, *points) -> jax.Array:
        """Return ``f[x0, …, xk]`` of arrays that broadcast; it does not depend on the order of the points."""
        if len(points) == 1:
            return self.derivative(points[0], 0)
        broadcast_points = jnp.broadcast_arrays(*points)
        return (
            self.difference_quotient(*broadcast_points)
            if len(broadcast_points) == 2
            else self._mean_or_quotient(*broadcast_points)
        )

    def _mean_or_quotient(self, *points) -> jax.Array:
        sorted_points = _sort_entrywise(points)
        width = jnp.stack([self.width(x) for x in sorted_points]).min(axis=0)
        gap = sorted_points[-1] - sorted_points[0]
        use_mean = gap <= MAX_SPREAD_FOR_MEAN * width
        difference = self.divided_difference(*sorted_points[1:]) - self.divided_difference(*sorted_points[:-1])
        return jnp.where(use_mean, self._simplex_mean(sorted_points, 4), difference / jnp.where(use_mean, 1.0, gap))

    def _simplex_mean(self, points, n_nodes: int) -> jax.Array:
        """Return the mean of the k-th derivative over the simplex of k + 1 points [Genocchi & Hermite], by Gauss
        quadrature."""
        k = len(points) - 1
        barycentric, weights = _simplex_quadrature(k, n_nodes)
        nodes_at = jnp.tensordot(barycentric, jnp.stack(points), 1)
        return jnp.tensordot(weights, self.derivative(nodes_at, k), 1)


def _sort_entrywise(points) -> list[jax.Array]:
    """Sort points in ascending order, entry by entry; NaN propagates."""
    points = list(points)
    for end in range(len(points) - 1, 0, -1):
        for i in range(end):
            points[i], points[i + 1] = jnp.minimum(points[i], points[i + 1]), jnp.maximum(points[i], points[i + 1])
    return points


def _simplex_quadrature(k: int, n_nodes: int) -> tuple[np.ndarray, np.ndarray]:
    """Return barycentric coordinates and weights of Gauss quadrature on a simplex; the weights sum to 1 / k!.

    The rule is a product rule in collapsed coordinates.
    """
    barycentric, weights = np.ones((1, 1)), np.ones(1)
    for i in range(k):
        x, w = scipy.special.roots_jacobi(n_nodes, k - 1 - i, 0)  # of the weight (1 - u)^(k - 1 - i)
        u, w = (x + 1) / 2, w / 2.0 ** (k - i)
        repeated = np.repeat(barycentric, n_nodes, axis=0)
        node_column = np.tile(u, len(barycentric))[:, None]
        barycentric = np.concatenate(
            [repeated[:, :-1], repeated[:, -1:] * node_column, repeated[:, -1:] * (1 - node_column)], axis=1
        )
        weights = np.repeat(weights, n_nodes) * np.tile(w, len(weights))
    return barycentric, weights


@dataclass(frozen=True)
class Exp(ScalarFunction):
    """Exponential function."""

    def derivative(self, x, order):
        return jnp.exp(x)

    def width(self, x):
        return jnp.ones_like(x)

    def difference_quotient(self, x, y):
        gap = jnp.abs(x - y)
        is_equal = gap == 0.0
        return jnp.exp(jnp.maximum(x, y)) * jnp.where(is_equal, 1.0, -jnp.expm1(-gap) / jnp.where(is_equal, 1.0, gap))

    @property
    def derivative_function(self):
        return self


@dataclass(frozen=True)
class Log(ScalarFunction):
    """Function ``log(offset + x)``."""

    offset: float = 0.0

    def derivative(self, x, order):
        if order == 0:
            return jnp.log1p(x) if self.offset == 1.0 else jnp.log(self.offset + x)
        return -math.factorial(order - 1) * (-1.0 / (self.offset + x)) ** order

    def width(self, x):
        return self.offset + x

    def difference_quotient(self, x, y):
        smaller_argument, gap = self.offset + jnp.minimum(x, y), jnp.abs(x - y)
        is_equal = gap == 0.0
        return jnp.where(
            is_equal, 1.0 / smaller_argument, jnp.log1p(gap / smaller_argument) / jnp.where(is_equal, 1.0, gap)
        )

    @property
    def derivative_function(self):
        return Reciprocal(self.offset)


@dataclass(frozen=True)
class Reciprocal(ScalarFunction):
    """Function ``1 / (offset + x)``."""

    offset: float = 0.0

    def derivative(self, x, order):
        return (-1.0) ** order * math.factorial(order) / (self.offset + x) ** (order + 1)

    def width(self, x):
        return jnp.abs(self.offset + x)

    def divided_difference(self, *points):
        quotient = self.derivative(points[0], 0)
        for x in points[1:]:
            quotient = -quotient * self.derivative(x, 0)
        return quotient


@dataclass(frozen=True)
class Sqrt(ScalarFunction):
    """Square root."""

    def derivative(self, x, order):
        factor = math.prod(0.5 - i for i in range(order))
        return factor * jnp.sqrt(x) / x**order if order else jnp.sqrt(x)

    def width(self, x):
        return x

    def difference_quotient(self, x, y):
        return 1.0 / (jnp.sqrt(x) + jnp.sqrt(y))


@dataclass(frozen=True)
class Derivative(ScalarFunction):
    """Derivative of a :class:`ScalarFunction`."""

    function: ScalarFunction

    def derivative(self, x, order):
        return self.function.derivative(x, order + 1)

    width = forward_to("function")


@dataclass(frozen=True)
class GenericFunction(ScalarFunction):
    """Function without a known formula, with as many derivatives as JAX takes."""

    function: Callable

    def derivative(self, x, order):
        if order == 0:
            return self.function(x)
        return jax.jvp(lambda x: self.derivative(x, order - 1), (x,), (jnp.ones_like(x),))[1]

    def width(self, x):
        raise NotImplementedError

    def _mean_or_quotient(self, *points):
        """Return the more accurate of two estimates: a quotient of differences, or a mean of derivatives.

        The rounding error of the quotient is compared to the change of the mean from six nodes to eight.
        """
        sorted_points = _sort_entrywise(points)
        gap = sorted_points[-1] - sorted_points[0]
        upper_difference, lower_difference = (
            self.divided_difference(*sorted_points[1:]),
            self.divided_difference(*sorted_points[:-1]),
        )
        is_equal = gap == 0.0
        quotient = (upper_difference - lower_difference) / jnp.where(is_equal, 1.0, gap)
        rounding = (
            jnp.finfo(jnp.float64).eps
            * (jnp.abs(upper_difference) + jnp.abs(lower_difference))
            / jnp.where(is_equal, 1.0, gap)
        )
        mean = self._simplex_mean(sorted_points, 8)
        use_mean = is_equal | (jnp.abs(mean - self._simplex_mean(sorted_points, 6)) <= rounding)
        return jnp.where(use_mean, mean, quotient)


KNOWN_FUNCTIONS: dict[Callable, ScalarFunction] = {
    jnp.exp: Exp(),
    jnp.log: Log(),
    jnp.log1p: Log(1.0),
    jnp.sqrt: Sqrt(),
    jnp.reciprocal: Reciprocal(),
}
"""Functions of ``jax.numpy`` with divided differences in closed form."""


def scalar_function(f: Callable | ScalarFunction) -> ScalarFunction:
    """Return ``f`` as a :class:`ScalarFunction`."""
    return f if isinstance(f, ScalarFunction) else KNOWN_FUNCTIONS.get(f) or GenericFunction(f)
