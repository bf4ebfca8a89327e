"""Correlation matrices of full rank, with a flat metric."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from .._sizes import checked_size
from ..matrices.linear import max_abs_entry
from ..matrices.symmetric import cholesky, symmetrize
from .base import register
from .maps import inner_by_coordinates, tangential_part_by_projection
from .spd import PositiveDefinite


@register((3,))
@jax.tree_util.register_static
@dataclass(frozen=True, repr=False)
class Correlation(PositiveDefinite):
    """Symmetric positive definite n x n matrices with ones on the diagonal, and the Euclidean-Cholesky metric.

    The Cholesky factor L of x, with each row divided by its entry on the diagonal, is a triangular matrix with ones on
    the diagonal, and any such matrix belongs to one x. Its other entries are coordinates in which the metric is the sum
    of products, so that the space is complete and flat, and geodesics are unique [Thanwerdas & Pennec 2022].
    """

    n: int
    metric = "Euclidean-Cholesky"

    def __post_init__(self):
        checked_size(self.n, 2, "Correlation(n)")

    @property
    def name(self):
        return f"Corr({self.n})"

    @property
    def dim(self):
        return self.n * (self.n - 1) // 2

    def _residual(self, x):
        return jnp.where(self._inside(x), max_abs_entry(self._constraint_residual(x)), jnp.inf)

    def _project(self, x):
        """Return the correlation matrix of a covariance matrix."""
        scale = 1.0 / jnp.sqrt(jnp.diagonal(x, axis1=-2, axis2=-1))
        y = self._with_unit_diagonal(symmetrize(x) * scale[..., :, None] * scale[..., None, :])
        return jnp.where(self._inside(y)[..., None, None], y, jnp.nan)

    def _with_unit_diagonal(self, x):
        return jnp.where(np.eye(self.n, dtype=bool), 1.0, x)

    def _constraint_residual(self, x):
        """Return the skew part of x off the diagonal, and x - 1 on it."""
        return jnp.where(np.eye(self.n, dtype=bool), x - 1.0, 0.5 * (x - x.swapaxes(-1, -2)))

    def _constraints(self, x):
        return self.to_vector(self._constraint_residual(x))

    def _minimal_correction(self, x, constraint_change):
        return self.from_vector(constraint_change)

    _tangential_part = tangential_part_by_projection

    def _constraint_rounding_scales(self, x):
        return self.to_vector(jnp.abs(x))

    @property
    def _n_normal_numbers(self):
        return 2 * self.n**2

    def _point_from_normal_numbers(self, w):
        rows = w.reshape(*w.shape[:-1], self.n, 2 * self.n)
        return self._project(rows @ rows.swapaxes(-1, -2))

    def _project_tangent(self, x, w):
        return jnp.where(np.eye(self.n, dtype=bool), 0.0, symmetrize(w))

    # -- the coordinates, and back ------------------------------------------------------------------------------------

    def _chart(self, x):
        factor = cholesky(x)
        rows = factor / jnp.diagonal(factor, axis1=-2, axis2=-1)[..., None]
        return rows[..., *np.tril_indices(self.n, -1)]

    def _inverse_chart(self, c):
        rows = jnp.zeros((*c.shape[:-1], self.n, self.n)).at[..., *np.tril_indices(self.n, -1)].set(c) + np.eye(self.n)
        rows = rows / jnp.sqrt((rows**2).sum(axis=-1, keepdims=True))
        return self._with_unit_diagonal(rows @ rows.swapaxes(-1, -2))

    def _coordinates(self, x, v):
        x, v = jnp.broadcast_arrays(x, v)
        return jax.jvp(self._chart, (x,), (v,))[1]

    def _from_coordinates(self, x, c):
        start_coordinates = self._chart(x)
        start_coordinates, c = jnp.broadcast_arrays(start_coordinates, c)
        return jax.jvp(self._inverse_chart, (start_coordinates,), (c,))[1]

    def _frame(self, x):
        return jax.vmap(lambda e: self._from_coordinates(x, e), out_axes=-3)(jnp.eye(self.dim))

    _inner = inner_by_coordinates

    def _metric_covector(self, x, v):
        c = self._coordinates(x, v)
        return symmetrize(jax.vjp(self._chart, jnp.broadcast_to(x, (*c.shape[:-1], *self.shape)))[1](c)[0])

    def _sharp(self, x, alpha):
        x, alpha = jnp.broadcast_arrays(x, alpha)
        start_coordinates = self._chart(x)
        return self._from_coordinates(x, jax.vjp(self._inverse_chart, start_coordinates)[1](alpha)[0])

    def _exp(self, x, v):
        return self._inverse_chart(self._chart(x) + self._coordinates(x, v))

    def _log(self, x, y):
        return self._from_coordinates(x, self._chart(y) - self._chart(x))

    def _squared_distance(self, x, y):
        return ((self._chart(y) - self._chart(x)) ** 2).sum(axis=-1)

    def _transport(self, x, v, u):
        return self._from_coordinates(self._exp(x, v), self._coordinates(x, u))
