"""Hyperbolic space H^n as a hyperboloid in Minkowski space."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from .._sizes import checked_size
from ..matrices.stumpff import hyperbolic_arc, hyperbolic_stumpff
from .base import Space, register
from .maps import by_projection, safe_sqrt


@register((2,))
@jax.tree_util.register_static
@dataclass(frozen=True, repr=False)
class Hyperbolic(Space):
    """Points with ``-x_0^2 + x_1^2 + … + x_n^2 = -1``, ``x_0 > 0``, shape (n + 1,), and the metric of curvature -1.

    Closed forms throughout. A point at distance r from the apex (1, 0, ..., 0) has coordinates of the size e^r, so
    results there are known to about 1e-16 e^(2r): keep the states of interest near the apex.
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
        off = jnp.abs(1.0 + _minkowski(x, x)[..., 0]) / (2.0 * square)
        return jnp.where(x[..., 0] > 0, off, jnp.where(jnp.isfinite(square), jnp.inf, jnp.nan))

    def _project(self, x):
        """The point above the same ``(x_1, ..., x_n)``."""
        space = x[..., 1:]
        return jnp.concatenate([jnp.sqrt(1.0 + (space**2).sum(axis=-1, keepdims=True)), space], axis=-1)

    def _constraints(self, x):
        return 0.5 * (_minkowski(x, x) + 1.0)

    def _inside(self, x):
        return x[..., 0] > 0.0

    def _normal(self, x, c):
        return c * _lowered(x) / (x**2).sum(axis=-1, keepdims=True)

    _along = by_projection

    def _rounded(self, x):
        return (x**2).sum(axis=-1, keepdims=True)

    def _project_tangent(self, x, w):
        normal = _lowered(x)
        return w - normal * ((normal * w).sum(axis=-1, keepdims=True) / (x**2).sum(axis=-1, keepdims=True))

    def _frame(self, x):
        """The images of the axes under the boost that takes the apex to x."""
        axes = np.eye(self.n + 1)
        x = x[..., None, :]
        return axes[1:] + x[..., 0, 1:, None] / (1.0 + x[..., :1]) * (x + axes[0])

    def _inner(self, x, u, v):
        return _minkowski(u, v)[..., 0]

    def _flat(self, x, v):
        return _lowered(v)

    def _sharp(self, x, alpha):
        raised = _lowered(alpha)
        return _minkowski(x, raised) * x - _minkowski(x, x) * raised  # along every hyperboloid

    def _exp(self, x, v):
        z = _minkowski(v, v)
        return self._project(hyperbolic_stumpff(0, z) * x + hyperbolic_stumpff(1, z) * v)

    def _log(self, x, y):
        step = y - x
        w = step + _minkowski(x, step) * x  # of length sinh(distance); free of cancellation for neighbours
        return hyperbolic_arc(_minkowski(w, w)) * w

    def _distance(self, x, y):
        step = y - x
        return 2.0 * jnp.arcsinh(0.5 * safe_sqrt(_minkowski(step, step)[..., 0]))

    def _midpoint(self, x, y):
        total = x + y
        return self._project(total / jnp.sqrt(-_minkowski(total, total)))

    def _transport(self, x, v, u):
        z = _minkowski(v, v)
        return u + _minkowski(v, u) * (hyperbolic_stumpff(2, z) * v + hyperbolic_stumpff(1, z) * x)


def _minkowski(u, v):
    return (_lowered(u) * v).sum(axis=-1, keepdims=True)


def _lowered(v):
    return v * np.array([-1.0] + [1.0] * (v.shape[-1] - 1))
