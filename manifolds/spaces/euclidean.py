"""Euclidean space: arrays of any shape with the sum of products as metric."""

from __future__ import annotations

import math
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from .._sizes import checked_size
from .base import Space, register


@register((3,), (2, 2))
@jax.tree_util.register_static
@dataclass(frozen=True, init=False, repr=False)
class Euclidean(Space):
    """Arrays of a given shape: ``Euclidean(3)`` is R^3, ``Euclidean(2, 4)`` the 2 x 4 matrices."""

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
