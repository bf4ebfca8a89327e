"""Spaces of constant curvature: Euclidean space, the sphere, and hyperbolic space as a hyperboloid."""

from __future__ import annotations

import math
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from .._arguments import checked_size
from ..matrices.exponential import angle_over_sine, arcsinh_over_sinh, hyperbolic_stumpff, stumpff
from ..matrices.linear import orthonormal_complement, skew_matrix
from .base import MIN_CUT_ANGLE, Space, register
from .maps import inner_by_coordinates, safe_sqrt, tangential_part_by_projection


@register((3,), (2, 2))
@jax.tree_util.register_static
@dataclass(frozen=True, init=False, repr=False)
class Euclidean(Space):
    """Arrays of a given shape: ``Euclidean(3)`` is R^3, ``Euclidean(2, 4)`` the 2 x 4 matrices.

    Parameters
    ----------
    sizes : int
        The shape of a point.
    """

    sizes: tuple[int, ...]
    metric = "flat"
    bi_invariant = True
    exp_is_group_exp = True

    def __init__(self, *sizes: int):
        object.__setattr__(self, "sizes", tuple(checked_size(n, 1, "Euclidean(*sizes)", "a size") for n in sizes))

    @property
    def name(self):
        return "R^" + " x ".join(map(str, self.sizes))

    @property
    def dim(self):
        return math.prod(self.sizes)

    @property
    def shape(self):
        return self.sizes

    def _residual(self, x):
        return 0.0 * x.sum(axis=self._axes)  # NaN for an array that is not finite

    def _project(self, x):
        return x

    def _constraints(self, x):
        return jnp.zeros((*x.shape[: x.ndim - len(self.shape)], 0))

    def _minimal_correction(self, x, constraint_change):
        return jnp.zeros_like(x)

    def _tangential_part(self, x, w):
        return w

    def _constraint_rounding_scales(self, x):
        return self._constraints(x)

    def _project_tangent(self, x, w):
        return w + jnp.zeros_like(x)

    def _frame(self, x):
        batch = x.shape[: x.ndim - len(self.shape)]
        return jnp.broadcast_to(np.eye(self.dim).reshape(self.dim, *self.shape), (*batch, self.dim, *self.shape))

    def _inner(self, x, u, v):
        return self._pair(u, v)

    def _metric_covector(self, x, v):
        return v

    def _sharp(self, x, alpha):
        return alpha

    def _coordinates(self, x, v):
        return v.reshape(*v.shape[: v.ndim - len(self.shape)], self.dim)

    def _from_coordinates(self, x, c):
        return c.reshape(*c.shape[:-1], *self.shape)

    def _exp(self, x, v):
        return x + v

    def _log(self, x, y):
        return y - x

    def _squared_distance(self, x, y):
        return ((y - x) ** 2).sum(axis=self._axes)

    def _midpoint(self, x, y):
        return 0.5 * (x + y)

    def _transport(self, x, v, u):
        return u + jnp.zeros_like(v)

    def _group_exp(self, x, v):
        return x + v

    def _group_log(self, x, y):
        return y - x

    def _left_translate(self, x, y, u):
        return u + jnp.zeros_like(y)

    def _cayley(self, x, v):
        """Return the Cayley map of the translations, as matrices ``[[I, x], [0, 1]]``."""
        return x + v

    def _inverse_cayley(self, x, y):
        return y - x

    def _euclidean_reach(self, x, v):
        return jnp.zeros(jnp.broadcast_shapes(x.shape, v.shape)[: -len(self.shape)])


@register((1,), (2,), (3,))
@jax.tree_util.register_static
@dataclass(frozen=True, repr=False)
class Sphere(Space):
    """Unit vectors of R^(n+1), shape (n + 1,), with the metric induced by R^(n+1).

    Distances are angles. All maps have closed forms, accurate to rounding up to the antipode; there the direction of
    the logarithm is known to 1e-16 over the distance from the antipode, as its arguments are.

    Parameters
    ----------
    n : int
        The dimension of the sphere; points have n + 1 dimensionless entries.

    Examples
    --------
    >>> sphere = mf.Sphere(2)
    >>> x = sphere.point([1.0, 2.0, 2.0], project=True)
    >>> v = sphere.project_tangent(x, jnp.array([0.0, 0.0, 1.0]))
    >>> bool(sphere.belongs(sphere.exp(x, v)))
    True
    """

    n: int
    metric = "round"

    def __post_init__(self):
        checked_size(self.n, 1, "Sphere(n)")

    @property
    def name(self):
        return f"S^{self.n}"

    @property
    def dim(self):
        return self.n

    @property
    def shape(self):
        return (self.n + 1,)

    def injectivity_radius(self, x=None):
        return math.pi

    def _residual(self, x):
        return jnp.abs(jnp.sqrt((x**2).sum(axis=-1)) - 1.0)

    def _project(self, x):
        return x / jnp.sqrt(_dot(x, x))

    def _constraints(self, x):
        return 0.5 * (_dot(x, x) - 1.0)

    def _minimal_correction(self, x, constraint_change):
        return constraint_change * x / _dot(x, x)

    def _tangential_part(self, x, w):
        return w - _dot(x, w) / _dot(x, x) * x

    def _constraint_rounding_scales(self, x):
        return _dot(x, x)

    def _project_tangent(self, x, w):
        return w - _dot(x, w) * x

    def _frame(self, x):
        return orthonormal_complement(x[..., None]).swapaxes(-1, -2)

    @property
    def isotropic_size(self):
        return math.comb(self.n + 1, 2)

    def _isotropic(self, x, w):
        """Return the sum of the rotation fields of all coordinate planes at x, weighted by w: a tangent vector."""
        return (skew_matrix(w, self.n + 1) @ x[..., None])[..., 0]

    def _inner(self, x, u, v):
        return (u * v).sum(axis=-1)

    def _metric_covector(self, x, v):
        return v

    def _sharp(self, x, alpha):
        return _dot(x, x) * alpha - _dot(x, alpha) * x  # along every sphere around the origin

    def _exp(self, x, v):
        z = _dot(v, v)
        y = stumpff(0, z) * x + stumpff(1, z) * v
        return y * (1.5 - 0.5 * _dot(y, y))  # a Newton step to |y| = 1, so that rounding does not add up

    def _log(self, x, y):
        step = y - x
        w = step - _dot(x, step) * x  # of length sin(angle); free of cancellation for neighbours
        w = w - _dot(x, w) * x  # near the antipode the first pass leaves rounding that is not tangent
        z, cosine = _dot(w, w), _dot(x, y)
        is_defined = (cosine > 0) | (z > MIN_CUT_ANGLE**2)
        return jnp.where(is_defined, angle_over_sine(z, cosine) * w, jnp.nan)

    def _squared_distance(self, x, y):
        chord, cochord = (((y + s * x) ** 2).sum(axis=-1) for s in (-1.0, 1.0))
        return 4.0 * chord * angle_over_sine(chord, safe_sqrt(cochord)) ** 2

    def _midpoint(self, x, y):
        chord, chord_sum = y - x, x + y
        z, w = _dot(chord_sum, chord_sum), _dot(chord, chord)
        # near the antipode the sum is all rounding along the chord, which would bring the midpoint nearer to one end
        direction = chord_sum - _dot(chord_sum, chord) / jnp.where(w > 1.0, w, 1.0) * chord
        return jnp.where(z > MIN_CUT_ANGLE**2, direction / jnp.sqrt(_dot(direction, direction)), jnp.nan)

    def _transport(self, x, v, u):
        z = _dot(v, v)
        return u - _dot(v, u) * (stumpff(2, z) * v + stumpff(1, z) * x)

    def _why_log_is_undefined(self, x, y):
        gap = float(jnp.sqrt(((x + y) ** 2).sum()))
        return (
            f"y is within {gap:.2g} of the antipode of x (margin {MIN_CUT_ANGLE:.1e}), to which every direction "
            "leads; go by a point between them"
        )


def _dot(u, v):
    """Return the Euclidean product of vectors, shape (..., 1)."""
    return (u * v).sum(axis=-1, keepdims=True)


@register((2,))
@jax.tree_util.register_static
@dataclass(frozen=True, repr=False)
class Hyperbolic(Space):
    """Points with ``-x_0^2 + x_1^2 + … + x_n^2 = -1``, ``x_0 > 0``, shape (n + 1,), and the metric of curvature -1.

    All maps have closed forms. A point at distance r from the apex (1, 0, ..., 0) has coordinates of the size e^r, so
    its position, and with it a distance, is known to about 1e-16 e^r. From r = 35 on, this is more than the unit of
    length: directions from the apex that agree to rounding are taken as equal there, so that points on one ray have the
    difference of their radii as distance. Points with r > 354 are refused, since squares of coordinates overflow.
    Vectors at a point, and geodesics with given velocities, are known to about 1e-16 e^(2r): keep the states of
    interest near the apex.

    Parameters
    ----------
    n : int
        The dimension; a point has n + 1 components.
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
        residual = jnp.where(jnp.abs(x).max(axis=-1) <= _MAX_COORDINATE, residual, jnp.nan)
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
        Where rounding of the coordinates alone makes more than 1 of the second term, directions equal to rounding are
        equal.
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
        square = _dot(direction_difference, direction_difference)
        is_same_direction = (square < _DIRECTION_ROUNDING**2) & (a * b * _DIRECTION_ROUNDING**2 > 1.0)
        square = jnp.where(is_same_direction, 0.0, square)
        far_value = 2.0 * radial**2 / (1.0 + jnp.sqrt(1.0 + radial**2)) + a * b * square
        return jnp.where(is_far, far_value, jnp.where(separate_value > 1.0, separate_value, near_value))

    def _midpoint(self, x, y):
        return self._project((x + y) / jnp.sqrt(4.0 + self._squared_chord(x, y)))

    def _why_overflow(self, x):
        size = float(np.abs(x).max())
        if not _MAX_COORDINATE < size < math.inf:
            return ""
        return (
            f"it is {math.log(size) + math.log(2.0):.4g} from the apex or farther, where squares of coordinates "
            f"overflow. Use points within {_MAX_RADIUS:g} of the apex"
        )

    def _transport(self, x, v, u):
        z = _minkowski_product(v, v)
        return u + _minkowski_product(v, u) * (hyperbolic_stumpff(2, z) * v + hyperbolic_stumpff(1, z) * x)


_MAX_RADIUS = 354.0
"""Distance from the apex up to which squares of coordinates, and sums of two of them, do not overflow."""

_MAX_COORDINATE = math.cosh(_MAX_RADIUS)

_MIN_FAR_COSH = 2.0
"""Smallest cosh of the radius of points whose directions from the apex are computed."""

_DIRECTION_ROUNDING = 8 * np.finfo(float).eps
"""Largest difference of two computed directions from the apex that may come from rounding alone."""


def _minkowski_product(u, v):
    """Return ``-u_0 v_0 + u_1 v_1 + … + u_n v_n``, shape (..., 1)."""
    return (_lower_index(u) * v).sum(axis=-1, keepdims=True)


def _lower_index(v):
    """Return the covector of v by the Minkowski metric: the first component changes its sign."""
    return v * np.array([-1.0] + [1.0] * (v.shape[-1] - 1))
