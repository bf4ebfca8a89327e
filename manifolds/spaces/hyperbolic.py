"""Hyperbolic space H^n as a hyperboloid in Minkowski space."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from .._sizes import checked_size
from ..matrices.stumpff import arcsinh_over_sinh, hyperbolic_stumpff
from .base import Space, register
from .maps import inner_by_coordinates, tangential_part_by_projection


@register((2,))
@jax.tree_util.register_static
@dataclass(frozen=True, repr=False)
class Hyperbolic(Space):
    """Points with ``-x_0^2 + x_1^2 + … + x_n^2 = -1``, ``x_0 > 0``, shape (n + 1,), and the metric of curvature -1.

    All maps have closed forms. A point at distance r from the apex (1, 0, ..., 0) has coordinates of the size e^r, so
    its
    position, and with it a distance, is known to about 1e-16 e^r. Vectors at it, and geodesics with given velocities,
    are
    known to about 1e-16 e^(2r): keep the states of interest near the apex.
    """

    n: int
    metric = "curvature -1"

    def __post_init__(self):
        checked_size(self.n, 1, "Hyperbolic(n)")

    @property
    def name(self):
        return f"H^{self.n}"

    @property
    def dim(self):
        return self.n

    @property
    def shape(self):
        return (self.n + 1,)

    def _residual(self, x):
        square = (x**2).sum(axis=-1)
        residual = jnp.abs(1.0 + _minkowski_product(x, x)[..., 0]) / (2.0 * square)
        return jnp.where(x[..., 0] > 0, residual, jnp.where(jnp.isfinite(square), jnp.inf, jnp.nan))

    def _project(self, x):
        """Return the point above ``(x_1, ..., x_n)``."""
        space = x[..., 1:]
        return jnp.concatenate([jnp.sqrt(1.0 + (space**2).sum(axis=-1, keepdims=True)), space], axis=-1)

    def _constraints(self, x):
        return 0.5 * (_minkowski_product(x, x) + 1.0)

    def _inside(self, x):
        return x[..., 0] > 0.0

    def _minimal_correction(self, x, constraint_change):
        return constraint_change * _lower_index(x) / (x**2).sum(axis=-1, keepdims=True)

    _tangential_part = tangential_part_by_projection

    def _constraint_rounding_scales(self, x):
        return (x**2).sum(axis=-1, keepdims=True)

    def _project_tangent(self, x, w):
        normal = _lower_index(x)
        return w - normal * ((normal * w).sum(axis=-1, keepdims=True) / (x**2).sum(axis=-1, keepdims=True))

    def _frame(self, x):
        """Return the images of the axes under the boost that takes the apex to x."""
        axes = np.eye(self.n + 1)
        x = x[..., None, :]
        return axes[1:] + x[..., 0, 1:, None] / (1.0 + x[..., :1]) * (x + axes[0])

    def _coordinates(self, x, v):
        """Return the components of v in :meth:`_frame`, computed from all components of v but the first, whose use
        would cancel."""
        x0, space, spatial_vector = x[..., :1], x[..., 1:], v[..., 1:]
        return spatial_vector - space * (_dot(space, spatial_vector) / (x0 * (1.0 + x0)))

    _inner = inner_by_coordinates

    def _metric_covector(self, x, v):
        return _lower_index(v)

    def _sharp(self, x, alpha):
        vector = _lower_index(alpha)
        return _minkowski_product(x, vector) * x - _minkowski_product(x, x) * vector  # along every hyperboloid

    def _exp(self, x, v):
        z = _minkowski_product(v, v)
        return self._project(hyperbolic_stumpff(0, z) * x + hyperbolic_stumpff(1, z) * v)

    def _log(self, x, y):
        z = self._squared_chord(x, y)
        w = y - x - 0.5 * z * x  # of length sinh(distance)
        return arcsinh_over_sinh(z * (1.0 + 0.25 * z)) * w

    def _squared_distance(self, x, y):
        z = self._squared_chord(x, y)[..., 0]
        return z * arcsinh_over_sinh(0.25 * z) ** 2

    def _squared_chord(self, x, y):
        """Return ``<y - x, y - x> = 4 sinh(d/2)^2``, shape (..., 1), without the cancellation of the two squares in it.

        Far from the apex it is the sum ``4 sinh((r - s)/2)^2 + 4 sinh(r) sinh(s) sin(a/2)^2``, with the radii r and s
        and the angle a between them. Nearer it is the difference as it stands for neighbours, else ``-2 - 2 <x, y>``.
        """
        x0, y0, p, q = x[..., :1], y[..., :1], x[..., 1:], y[..., 1:]
        step = y - x
        near_value, separate_value = _minkowski_product(step, step), -2.0 * (1.0 + _minkowski_product(x, y))
        is_far = jnp.minimum(x0, y0) > _MIN_FAR_COSH
        p, q = (jnp.where(is_far, a, 1.0) for a in (p, q))
        a, b = jnp.sqrt(_dot(p, p)), jnp.sqrt(_dot(q, q))
        difference = _dot(q - p, q + p)  # b^2 - a^2
        radial = difference / (a * jnp.where(is_far, y0, 1.0) + b * jnp.where(is_far, x0, 1.0))  # sinh(s - r)
        is_nearer = a < b
        min_sinh, max_sinh, inner_point = (
            jnp.where(is_nearer, a, b),
            jnp.where(is_nearer, b, a),
            jnp.where(is_nearer, p, q),
        )
        direction_difference = (q - p) - inner_point * (difference / (min_sinh * (a + b)))  # exact for neighbours
        direction_difference = jnp.where(max_sinh < 2.0 * min_sinh, direction_difference / max_sinh, q / b - p / a)
        far_value = 2.0 * radial**2 / (1.0 + jnp.sqrt(1.0 + radial**2)) + a * b * _dot(
            direction_difference, direction_difference
        )
        return jnp.where(is_far, far_value, jnp.where(separate_value > 1.0, separate_value, near_value))

    def _midpoint(self, x, y):
        return self._project((x + y) / jnp.sqrt(4.0 + self._squared_chord(x, y)))

    def _transport(self, x, v, u):
        z = _minkowski_product(v, v)
        return u + _minkowski_product(v, u) * (hyperbolic_stumpff(2, z) * v + hyperbolic_stumpff(1, z) * x)


_MIN_FAR_COSH = 2.0
"""Smallest cosh of the radius of points whose directions from the apex are computed."""


def _dot(u, v):
    return (u * v).sum(axis=-1, keepdims=True)


def _minkowski_product(u, v):
    return (_lower_index(u) * v).sum(axis=-1, keepdims=True)


def _lower_index(v):
    return v * np.array([-1.0] + [1.0] * (v.shape[-1] - 1))
