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
"""Spread of points, relative to the width of a function, up to which divided differences are means of derivatives.

Beyond, a quotient of differences loses four bits. Up to it, what four nodes leave out of the mean is rounding.
"""


class ScalarFunction:
    """A function of a number with its derivatives; equal ones can be hashed and are one function."""

    @abstractmethod
    def derivative(self, x, order: int) -> jax.Array:
        """The derivative of an order, entry by entry; of order 0 the function."""

    @abstractmethod
    def width(self, x) -> jax.Array:
        """The distance to the next place where the function has no Taylor series, or over which it changes much."""

    def difference_quotient(self, x, y) -> jax.Array:
        """``f[x, y]``."""
        return self._mean_or_quotient(x, y)

    @property
    def derivative_function(self) -> ScalarFunction:
        """The derivative as such a function."""
        return Derivative(self)

    def divided_difference(self, *points) -> jax.Array:
        """``f[x0, …, xk]``, which no order of the points changes; arrays that are broadcast."""
        if len(points) == 1:
            return self.derivative(points[0], 0)
        alike = jnp.broadcast_arrays(*points)
        return self.difference_quotient(*alike) if len(alike) == 2 else self._mean_or_quotient(*alike)

    def _mean_or_quotient(self, *points) -> jax.Array:
        ordered = _sort_entrywise(points)
        width = jnp.stack([self.width(x) for x in ordered]).min(axis=0)
        gap = ordered[-1] - ordered[0]
        close = gap <= MAX_SPREAD_FOR_MEAN * width
        further = self.divided_difference(*ordered[1:]) - self.divided_difference(*ordered[:-1])
        return jnp.where(close, self._simplex_mean(ordered, 4), further / jnp.where(close, 1.0, gap))

    def _simplex_mean(self, points, nodes: int) -> jax.Array:
        """The mean of a derivative over the simplex of the points [Genocchi & Hermite], by Gauss's quadrature."""
        k = len(points) - 1
        places, weights = _simplex_quadrature(k, nodes)
        at = jnp.tensordot(places, jnp.stack(points), 1)
        return jnp.tensordot(weights, self.derivative(at, k), 1)


def _sort_entrywise(points) -> list[jax.Array]:
    """Points in ascending order, entry by entry; NaN stays."""
    points = list(points)
    for end in range(len(points) - 1, 0, -1):
        for i in range(end):
            points[i], points[i + 1] = jnp.minimum(points[i], points[i + 1]), jnp.maximum(points[i], points[i + 1])
    return points


def _simplex_quadrature(k: int, nodes: int) -> tuple[np.ndarray, np.ndarray]:
    """Barycentric coordinates and weights, which sum to 1 / k!, of Gauss's quadrature in collapsed coordinates."""
    places, weights = np.ones((1, 1)), np.ones(1)
    for i in range(k):
        x, w = scipy.special.roots_jacobi(nodes, k - 1 - i, 0)  # of the weight (1 - u)^(k - 1 - i)
        u, w = (x + 1) / 2, w / 2.0 ** (k - i)
        kept = np.repeat(places, nodes, axis=0)
        own = np.tile(u, len(places))[:, None]
        places = np.concatenate([kept[:, :-1], kept[:, -1:] * own, kept[:, -1:] * (1 - own)], axis=1)
        weights = np.repeat(weights, nodes) * np.tile(w, len(weights))
    return places, weights


@dataclass(frozen=True)
class Exp(ScalarFunction):
    def derivative(self, x, order):
        return jnp.exp(x)

    def width(self, x):
        return jnp.ones_like(x)

    def difference_quotient(self, x, y):
        gap = jnp.abs(x - y)
        same = gap == 0.0
        return jnp.exp(jnp.maximum(x, y)) * jnp.where(same, 1.0, -jnp.expm1(-gap) / jnp.where(same, 1.0, gap))

    @property
    def derivative_function(self):
        return self


@dataclass(frozen=True)
class Log(ScalarFunction):
    """``log(start + x)``."""

    offset: float = 0.0

    def derivative(self, x, order):
        if order == 0:
            return jnp.log1p(x) if self.offset == 1.0 else jnp.log(self.offset + x)
        return -math.factorial(order - 1) * (-1.0 / (self.offset + x)) ** order

    def width(self, x):
        return self.offset + x

    def difference_quotient(self, x, y):
        least, gap = self.offset + jnp.minimum(x, y), jnp.abs(x - y)
        same = gap == 0.0
        return jnp.where(same, 1.0 / least, jnp.log1p(gap / least) / jnp.where(same, 1.0, gap))

    @property
    def derivative_function(self):
        return Reciprocal(self.offset)


@dataclass(frozen=True)
class Reciprocal(ScalarFunction):
    """``1 / (start + x)``."""

    offset: float = 0.0

    def derivative(self, x, order):
        return (-1.0) ** order * math.factorial(order) / (self.offset + x) ** (order + 1)

    def width(self, x):
        return jnp.abs(self.offset + x)

    def divided_difference(self, *points):
        found = self.derivative(points[0], 0)
        for x in points[1:]:
            found = -found * self.derivative(x, 0)
        return found


@dataclass(frozen=True)
class Sqrt(ScalarFunction):
    def derivative(self, x, order):
        factor = math.prod(0.5 - i for i in range(order))
        return factor * jnp.sqrt(x) / x**order if order else jnp.sqrt(x)

    def width(self, x):
        return x

    def difference_quotient(self, x, y):
        return 1.0 / (jnp.sqrt(x) + jnp.sqrt(y))


@dataclass(frozen=True)
class Derivative(ScalarFunction):
    function: ScalarFunction

    def derivative(self, x, order):
        return self.function.derivative(x, order + 1)

    width = forward_to("function")


@dataclass(frozen=True)
class GenericFunction(ScalarFunction):
    """A function that nothing is known of, with as many derivatives as JAX takes."""

    function: Callable

    def derivative(self, x, order):
        if order == 0:
            return self.function(x)
        return jax.jvp(lambda x: self.derivative(x, order - 1), (x,), (jnp.ones_like(x),))[1]

    def width(self, x):
        raise NotImplementedError

    def _mean_or_quotient(self, *points):
        """The more accurate one, by what rounding makes of a quotient, and by what more nodes make of a mean."""
        ordered = _sort_entrywise(points)
        gap = ordered[-1] - ordered[0]
        one, other = self.divided_difference(*ordered[1:]), self.divided_difference(*ordered[:-1])
        same = gap == 0.0
        quotient = (one - other) / jnp.where(same, 1.0, gap)
        rounding = jnp.finfo(jnp.float64).eps * (jnp.abs(one) + jnp.abs(other)) / jnp.where(same, 1.0, gap)
        mean = self._simplex_mean(ordered, 8)
        by_mean = same | (jnp.abs(mean - self._simplex_mean(ordered, 6)) <= rounding)
        return jnp.where(by_mean, mean, quotient)


KNOWN_FUNCTIONS: dict[Callable, ScalarFunction] = {
    jnp.exp: Exp(),
    jnp.log: Log(),
    jnp.log1p: Log(1.0),
    jnp.sqrt: Sqrt(),
    jnp.reciprocal: Reciprocal(),
}


def scalar_function(f: Callable | ScalarFunction) -> ScalarFunction:
    """A function of a number as one with divided differences."""
    return f if isinstance(f, ScalarFunction) else KNOWN_FUNCTIONS.get(f) or GenericFunction(f)
