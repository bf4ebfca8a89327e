"""Sphere S^n with its round metric."""

from __future__ import annotations

import math
from dataclasses import dataclass

import jax
import jax.numpy as jnp

from .._sizes import checked_size
from ..matrices.linear import orthonormal_complement, skew_matrix
from ..matrices.stumpff import angle_over_sine, stumpff
from .base import CUT_MARGIN, Space, register
from .maps import safe_sqrt


@register((1,), (2,), (3,))
@jax.tree_util.register_static
@dataclass(frozen=True, repr=False)
class Sphere(Space):
    """Unit vectors of R^(n+1), shape (n + 1,), with the metric induced by R^(n+1).

    Distances are angles. All maps have closed forms, accurate to rounding up to the antipode; there the direction of
    the
    logarithm is known to 1e-16 over the distance from the antipode, as its arguments are.

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
        is_defined = (cosine > 0) | (z > (math.pi * CUT_MARGIN) ** 2)
        return jnp.where(is_defined, angle_over_sine(z, cosine) * w, jnp.nan)

    def _squared_distance(self, x, y):
        chord, cochord = (((y + s * x) ** 2).sum(axis=-1) for s in (-1.0, 1.0))
        return 4.0 * chord * angle_over_sine(chord, safe_sqrt(cochord)) ** 2

    def _midpoint(self, x, y):
        chord_sum = x + y
        z = _dot(chord_sum, chord_sum)
        return jnp.where(z > (math.pi * CUT_MARGIN) ** 2, chord_sum / jnp.sqrt(z), jnp.nan)

    def _transport(self, x, v, u):
        z = _dot(v, v)
        return u - _dot(v, u) * (stumpff(2, z) * v + stumpff(1, z) * x)

    def _explain_missing_log(self, x, y):
        gap = float(jnp.sqrt(((x + y) ** 2).sum()))
        return (
            f"y is within {gap:.2g} of the antipode of x (margin {math.pi * CUT_MARGIN:.1e}), to which every direction "
            "leads; go by a point between them"
        )


def _dot(u, v):
    return (u * v).sum(axis=-1, keepdims=True)
