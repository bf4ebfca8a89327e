"""Retraction maps R_h: TP -> P x P and their inverses: finite differences on a manifold [BFM §4.4].

A retraction maps a tangent vector v at z to the end points of a step h with velocity v. Two choices define it: a
*chart* ``v -> point(z, v)`` of the space around z, with ``point(z, 0) = z`` and derivative the identity
there, and the position of z in the step. At the start of the step, ``R_h(z, v) = (z, point(z, h v))``, as in every
chart; in its middle, ``(point(z, -h v/2), point(z, h v/2))``, as in :class:`MidpointRetraction`.

All maps can be jitted, vmapped and differentiated. A step that leaves the domain raises; under tracing, where values
are not available, check that :meth:`Retraction.reach` is below 1.
"""

from __future__ import annotations

import dataclasses
from abc import abstractmethod
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from .._arrays import first_true_multi_index, format_index, is_traced
from .._class_members import ListedABCMeta
from .._pytree_module import Module, forward_to
from ..errors import DomainError, SpaceError
from ..matrices.linear import inverse
from ..spaces import Power, Product
from ..spaces.base import Space
from ..spaces.maps import run_kernel

_MIDPOINT_ITERATIONS = 32
"""Number of iterations for the midpoint.

Each iteration multiplies the distance from the middle by the squared distance of the points, relative to the curvature.
"""


class Retraction(metaclass=ListedABCMeta):
    r"""Map ``R_h(z, v) -> (x, y)`` on a state space, with its inverse.

    Attributes
    ----------
    space : Space
    chart : Chart
        The chart it is made with: itself, unless it is a :class:`MidpointRetraction`.
    order : float
        The largest p with ``R_1(z, v)`` within O(\|v\|^(p+1)) of the points that the Riemannian exponential would give;
        infinite if they are equal.
    symmetric : bool
        True if ``R_h(z, -v)`` is ``R_h(z, v)`` with its two points exchanged.
    """

    space: Space
    chart: Chart
    symmetric: bool

    @property
    @abstractmethod
    def order(self) -> float: ...

    def __call__(self, z, v, h=1.0) -> tuple[jax.Array, jax.Array]:
        """Return the points x and y of ``R_h(z, v)``, between which the step leads.

        Parameters
        ----------
        z : array, shape ``(..., *space.shape)``
            Base point.
        v : array, shape ``(..., *space.shape)``
            Tangent vector at z: a velocity, where h is a time.
        h : float

        Returns
        -------
        x, y : array, shape ``(..., *space.shape)``

        Raises
        ------
        DomainError
            If h v is so long that the inverse would not give it back. Not checked under tracing.
        OffManifoldError
        """
        z, v = self._checked_step(z, v, h)
        reach = run_kernel(self, "_reach", (), z, v)
        if not is_traced(reach) and (index := first_true_multi_index(~np.asarray(reach < 1.0))) is not None:
            radius = self.space.injectivity_radius(jnp.broadcast_arrays(z, v)[0][index])
            raise DomainError(
                f"{self}: the step h v{format_index(index)} is {float(reach[index]):.6g} times as long as its inverse "
                f"reaches (injectivity radius of the space {radius:.6g}). Use a smaller step"
            )
        return run_kernel(self, "_end_points", (), z, v)

    def inverse(self, x, y, h=1.0) -> tuple[jax.Array, jax.Array]:
        """Return ``R_h^-1(x, y)``: the base point z, and the tangent vector v there, of the step from x to y.

        Parameters
        ----------
        x, y : array, shape ``(..., *space.shape)``
        h : float

        Returns
        -------
        z, v : array, shape ``(..., *space.shape)``

        Raises
        ------
        DomainError
            If no step leads from x to y inside the domain. Under tracing the result is NaN instead.
        OffManifoldError
        """
        x, y = self.space._checked_point(x, "x"), self.space._checked_point(y, "y")
        z, v = run_kernel(self, "_base_and_vector", (), x, y)
        self.space._raise_if_not_finite(v, len(self.space.shape), x, y, f"the inverse of {type(self).__name__}")
        return z, v / h

    def reach(self, z, v, h=1.0) -> jax.Array:
        """Return the length of h v relative to the domain of the inverse, shape (...); a step is valid if it is below
        1."""
        return run_kernel(self, "_reach", (), *self._checked_step(z, v, h))

    @abstractmethod
    def _end_points(self, z, v): ...

    @abstractmethod
    def _base_and_vector(self, x, y): ...

    @abstractmethod
    def _reach(self, z, v): ...

    def _checked_step(self, z, v, h):
        """Return the base point z and the tangent vector ``h v``, after a check of both."""
        z, v = self.space._checked_point_and_vectors(z, "z", v=v)
        return z, h * v

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.space.name})"


class Chart(Retraction):
    """Retraction with its base point at the start of the step: ``R_h(z, v) = (z, point(z, h v))``.

    A subclass is a frozen dataclass with a ``space``, decorated with ``jax.tree_util.register_static``. It implements
    ``_point``, ``_vector`` and ``order``, plain JAX functions of checked arrays with leading batch axes. It may
    override ``_reach``, if the chart does not reach as far as the geodesics of the space do, ``_carry``, which
    :class:`MidpointRetraction` needs in integrators, and ``_middle``, which is found by iteration otherwise.
    """

    symmetric = False

    @property
    def chart(self) -> Chart:  # type: ignore[override]
        return self

    def point(self, z, v) -> jax.Array:
        """Return the point that the chart around z assigns to the tangent vector v, shape ``(..., *space.shape)``.

        It is defined beyond the domain of :meth:`vector` too.
        """
        return run_kernel(self, "_point", (), *self._checked_step(z, v, 1.0))

    def vector(self, z, x) -> jax.Array:
        """Return the tangent vector at z that the chart assigns to the point x: the inverse of :meth:`point`.

        Raises
        ------
        DomainError
            Outside its domain. Under tracing the result is NaN instead.
        """
        return self.inverse(z, x)[1]

    def differential(self, z, v, w) -> jax.Array:
        """Return the derivative of ``v -> point(z, v)`` along w, a tangent vector at ``point(z, v)``."""
        return run_kernel(self, "_differential", (), *self.space._checked_point_and_vectors(z, "z", v=v, w=w))

    def carry(self, z, v, u) -> jax.Array:
        """Carry the tangent vector u from z to ``x = point(z, v)``, such that ``point(x, -carry(z, v, v))`` is z.

        The Riemannian chart carries by parallel transport; charts of groups preserve the left-trivialised velocity.
        With ``w = carry(z, v, u)``, ``carry(x, -carry(z, v, v), w)`` is u again.
        """
        return run_kernel(self, "_carry", (), *self.space._checked_point_and_vectors(z, "z", v=v, u=u))

    @abstractmethod
    def _point(self, z, v):
        """Return the point of the chart around z for the tangent vector v: z for 0, with the derivative the identity
        there."""

    @abstractmethod
    def _vector(self, z, x):
        """Return the inverse of :meth:`_point`, NaN where it is not defined."""

    def _middle(self, x, y):
        """Return the z with ``vector(z, x) = -vector(z, y)``."""

        def improve_midpoint(_, z):
            return self._point(z, 0.5 * (self._vector(z, x) + self._vector(z, y)))

        return jax.lax.fori_loop(0, _MIDPOINT_ITERATIONS, improve_midpoint, self._point(x, 0.5 * self._vector(x, y)))

    def _carry(self, z, v, u):
        """Return the vector u carried from z to ``point(z, v)``; SpaceError for a chart that cannot carry vectors."""
        raise SpaceError(
            f"{self} gives no _carry, so its base point cannot lie in the middle of a step. Use retraction='exp', "
            "which has it at the start"
        )

    _reach = forward_to("space")

    def _midpoint_reach(self, z, v):
        """Return the reach of the step v with z in its middle."""
        return self.space._reach(z, v)

    def _differential(self, z, v, w):
        v, w = jnp.broadcast_arrays(v, w)
        return jax.jvp(lambda v: self._point(z, v), (v,), (w,))[1]

    def _end_points(self, z, v):
        y = self._point(z, v)
        return jnp.broadcast_to(z, y.shape), y

    def _base_and_vector(self, x, y):
        v = self._vector(x, y)
        return jnp.broadcast_to(x, v.shape), v

    def __post_init__(self):
        if not isinstance(self.space, Space):
            raise SpaceError(
                f"{type(self).__name__}(space): space must be a state space, got {type(self.space).__name__}. For a "
                "group, use GroupSpace(group)"
            )
        struct = jax.ShapeDtypeStruct(self.space.shape, self.space.dtype)
        for kernel in ("_point", "_vector", "_reach"):  # a space that lacks one refuses here
            jax.eval_shape(getattr(self, kernel), struct, struct)


class Place(NamedTuple):
    """Point with coordinates c, with the maps of vectors and covectors between it and R^dim.

    Attributes
    ----------
    point : array, shape ``(..., *shape)``
        A point of the space.
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
        """Return the point with the coordinates c, with the maps that lift covectors and lower vectors there."""

    @abstractmethod
    def centre(self) -> Place:
        """Return ``at(0)``, where the derivative of the chart is the identity."""


def coordinates_around(chart: Chart, z) -> Coordinates:
    """Return coordinates around a point, shape ``(*space.shape)``, or around each point of a batch.

    Parameters
    ----------
    chart : Chart
        The chart of the space.
    z : array, shape ``(*space.shape)``, or ``(..., *space.shape)``
        The point, or a batch of points.
    """
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
    factor_coordinates: tuple[Coordinates, ...]

    def point(self, c):
        return self.space.join(
            *(
                factor.point(component)
                for factor, component in zip(self.factor_coordinates, self._split_components(c), strict=True)
            )
        )

    def components(self, v):
        return self._join_components(
            [
                factor.components(component)
                for factor, component in zip(self.factor_coordinates, self.space.split(v), strict=True)
            ]
        )

    def vector(self, c):
        return self.space.join(
            *(
                factor.vector(component)
                for factor, component in zip(self.factor_coordinates, self._split_components(c), strict=True)
            )
        )

    def at(self, c):
        return self._join_places(
            [
                factor.at(component)
                for factor, component in zip(self.factor_coordinates, self._split_components(c), strict=True)
            ]
        )

    def centre(self):
        return self._join_places([factor.centre() for factor in self.factor_coordinates])

    def _join_places(self, places: list[Place]) -> Place:
        """Return the place on the product from the places on its factors."""

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
        return self._join_copies(self.base.at(self._split_components(c)))

    def centre(self):
        return self._join_copies(self.base.centre())

    def _join_copies(self, stacked_place: Place) -> Place:
        """Return the place on the power from the places of its copies, stacked along an axis."""
        return Place(
            stacked_place.point,
            lambda alpha: stacked_place.lift(self._split_components(alpha)),
            lambda v: self._join_components(stacked_place.lower(v)),
        )

    def _split_components(self, c):
        return c.reshape(*c.shape[:-1], self.space.count, self.space.base.dim)

    def _join_components(self, c):
        return c.reshape(*c.shape[:-2], self.space.dim)
