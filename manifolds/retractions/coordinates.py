"""Coordinates around a point of a state space: a chart, and the orthonormal frame that its vectors refer to.

In coordinates c, shape (dim,), a manifold is R^dim: functions of points become functions of c, and the derivative of
the chart maps tangent vectors and covectors at the point of c to R^dim. Products are treated factor by
factor, so that the work is linear in the number of factors.
"""

from __future__ import annotations

import dataclasses
from abc import abstractmethod
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from .._pytree_module import Module
from ..matrices.linear import inverse
from ..spaces import Power, Product
from .retraction import Chart


class Place(NamedTuple):
    """Point with coordinates c, with the maps of vectors and covectors between it and R^dim.

    Attributes
    ----------
    point : array, shape ``(..., *shape)``
    lift : function
        From a covector of R^dim, shape (..., dim), to the ambient covector with equal products with tangent vectors.
    lower : function
        From a tangent vector, shape ``(..., *shape)``, to the velocity of its coordinates, shape (..., dim).
    """

    point: jax.Array
    lift: Callable
    lower: Callable


class Coordinates(Module):
    """Coordinates c of the points ``chart.point(z, sum_a c_a E_a)`` around z, E the orthonormal frame of z.

    Build them by :func:`coordinates_around`.
    """

    @abstractmethod
    def point(self, c) -> jax.Array:
        """Return the point with the coordinates c, shape ``(..., *shape)``."""

    @abstractmethod
    def components(self, v) -> jax.Array:
        """Return the components of a tangent vector at z in the frame, shape (..., dim): the velocity of c at c = 0."""

    @abstractmethod
    def vector(self, c) -> jax.Array:
        """Return the tangent vector at z with components c: the inverse of :meth:`components`."""

    @abstractmethod
    def at(self, c) -> Place:
        """Return the point with the coordinates c, with the maps of vectors and covectors there."""

    @abstractmethod
    def centre(self) -> Place:
        """Return ``at(0)``, where the derivative of the chart is the identity."""


def coordinates_around(chart: Chart, z) -> Coordinates:
    """Return coordinates around a point, shape ``(*space.shape)``, or around each point of a batch."""
    if isinstance(chart.space, Product):
        factor_points = zip(chart.space.factors, chart.space.split(z), strict=True)
        return _ProductCoordinates(
            chart.space,
            tuple(
                coordinates_around(_chart_on_factor(chart, factor), factor_point)
                for factor, factor_point in factor_points
            ),
        )
    if isinstance(chart.space, Power):
        return _PowerCoordinates(chart.space, coordinates_around(_chart_on_factor(chart, chart.space.base), z))
    return _ChartCoordinates(chart, z)


def _chart_on_factor(chart: Chart, space) -> Chart:
    """Return a chart of equal kind on a factor of the space."""
    return dataclasses.replace(chart, space=space)  # type: ignore[type-var]


class _ChartCoordinates(Coordinates):
    """Coordinates of one chart."""

    chart: Chart
    z: jax.Array

    def point(self, c):
        return self.chart._point(self.z, self.vector(c))

    def components(self, v):
        return self.chart.space._coordinates(self.z, v)

    def vector(self, c):
        return self.chart.space._from_coordinates(self.z, c)

    def at(self, c):
        space = self.chart.space
        axes = np.broadcast_to(np.eye(space.dim)[(slice(None), *(None,) * (c.ndim - 1))], (space.dim, *c.shape))
        x, push_forward = jax.linearize(self.point, c)
        columns = jax.vmap(lambda axis: space._coordinates(x, push_forward(axis)))(jnp.asarray(axes))
        inverse_jacobian = inverse(jnp.moveaxis(columns, 0, -1))  # of the derivative, in the frames of both ends

        def lift(alpha):
            return space._metric_covector(
                x, space._from_coordinates(x, (inverse_jacobian.swapaxes(-1, -2) @ alpha[..., None])[..., 0])
            )

        return Place(x, lift, lambda v: (inverse_jacobian @ space._coordinates(x, v)[..., None])[..., 0])

    def centre(self):
        space = self.chart.space
        return Place(self.z, lambda alpha: space._metric_covector(self.z, self.vector(alpha)), self.components)


class _ProductCoordinates(Coordinates):
    """Coordinates of a product, factor by factor."""

    space: Product
    parts: tuple[Coordinates, ...]

    def point(self, c):
        return self.space.join(
            *(factor.point(component) for factor, component in zip(self.parts, self._split_components(c), strict=True))
        )

    def components(self, v):
        return self._join_components(
            [factor.components(component) for factor, component in zip(self.parts, self.space.split(v), strict=True)]
        )

    def vector(self, c):
        return self.space.join(
            *(factor.vector(component) for factor, component in zip(self.parts, self._split_components(c), strict=True))
        )

    def at(self, c):
        return self._join_places(
            [factor.at(component) for factor, component in zip(self.parts, self._split_components(c), strict=True)]
        )

    def centre(self):
        return self._join_places([factor.centre() for factor in self.parts])

    def _join_places(self, places: list[Place]) -> Place:
        def lift(alpha):
            return self.space.join(
                *(place.lift(component) for place, component in zip(places, self._split_components(alpha), strict=True))
            )

        def lower(v):
            return self._join_components(
                [place.lower(component) for place, component in zip(places, self.space.split(v), strict=True)]
            )

        return Place(self.space.join(*(p.point for p in places)), lift, lower)

    def _split_components(self, c):
        return jnp.split(c, np.cumsum([factor.dim for factor in self.space.factors])[:-1], axis=-1)

    @staticmethod
    def _join_components(components):
        return jnp.concatenate(components, axis=-1)


class _PowerCoordinates(Coordinates):
    """Coordinates of a power of a space, whose copies are a batch of the base."""

    space: Power
    base: Coordinates

    def point(self, c):
        return self.base.point(self._split_components(c))

    def components(self, v):
        return self._join_components(self.base.components(v))

    def vector(self, c):
        return self.base.vector(self._split_components(c))

    def at(self, c):
        return self._join_places(self.base.at(self._split_components(c)))

    def centre(self):
        return self._join_places(self.base.centre())

    def _join_places(self, place: Place) -> Place:
        return Place(
            place.point,
            lambda alpha: place.lift(self._split_components(alpha)),
            lambda v: self._join_components(place.lower(v)),
        )

    def _split_components(self, c):
        return c.reshape(*c.shape[:-1], self.space.count, self.space.base.dim)

    def _join_components(self, c):
        return c.reshape(*c.shape[:-2], self.space.dim)
