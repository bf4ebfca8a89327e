"""The collocation polynomial of a step, in the coordinates of a term of an energy."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np


class KronrodRule(NamedTuple):
    """Additional nodes between those of a Gauss rule, which extend it to a Kronrod rule.

    Attributes
    ----------
    A, slope_matrix : ndarray, shape (s + 1, s)
        ``x + h A @ k`` and ``slope_matrix @ k`` are the collocation polynomial and its slope at the additional nodes.
    b, weight_change : ndarray, shapes (s + 1,) and (s,)
        Weights of the additional nodes, and the change of the weights of the Gauss nodes.
    """

    A: np.ndarray
    slope_matrix: np.ndarray
    b: np.ndarray
    weight_change: np.ndarray


class CollocationPath(NamedTuple):
    """The collocation polynomial of a step, in the coordinates on which a term of an energy depends.

    Attributes
    ----------
    start, compensation, step : array, shape (m,)
        The path leads from start + compensation to start + compensation + step.
    points, slopes : array, shape (s, m)
        The polynomial and its slope at the stages.
    kronrod_samples : two arrays, shape (r, m), or None
        Points and slopes at the nodes of ``kronrod``.
    symmetries : array, shape (s, r, m), or None
        Vectors at the stages to which corrections must be orthogonal.
    h, b
        Step size and weights of the method.
    kronrod : KronrodRule or None
    """

    start: jax.Array
    compensation: jax.Array
    step: jax.Array
    points: jax.Array
    slopes: jax.Array
    kronrod_samples: tuple[jax.Array, jax.Array] | None
    symmetries: jax.Array | None
    h: jax.Array
    b: np.ndarray
    kronrod: KronrodRule | None

    def path_and_pullback_in(self, coordinates: Callable) -> tuple[CollocationPath, Callable]:
        """Return the path in coordinates y(x), at most quadratic, and the function that pulls covectors back to x.

        That function takes covectors at the stages, shape (s, number of coordinates).
        """

        def push_forward(x, d):
            return jax.jvp(coordinates, (x,), (d,))

        def push_directions(x, directions):
            return jax.vmap(lambda d: push_forward(x, d)[1])(directions)

        def pull_back(covectors):
            return jax.vmap(lambda x, g: jax.vjp(coordinates, x)[1](g)[0])(self.points, covectors)

        compensation = jnp.zeros_like(self.start) + self.compensation
        (mapped_points, slopes), step = jax.vmap(push_forward)(self.points, self.slopes), self.step
        path = self._replace(
            start=coordinates(self.start),
            compensation=push_forward(self.start + 0.5 * compensation, compensation)[1],
            step=push_forward(self.start + (compensation + 0.5 * step), step)[1],
            points=mapped_points,
            slopes=slopes,
            kronrod_samples=None if self.kronrod_samples is None else jax.vmap(push_forward)(*self.kronrod_samples),
            symmetries=None if self.symmetries is None else jax.vmap(push_directions)(self.points, self.symmetries),
        )
        return path, pull_back


class DiscreteGradientScheme(Protocol):
    """The methods of :class:`liethermo.functions.gradients.DiscreteGradient` that a term calls."""

    def quadratic(self, term: Any, x, d, compensation) -> jax.Array: ...
    def general(self, term: Any, x, d, compensation) -> jax.Array: ...
