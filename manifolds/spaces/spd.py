"""Symmetric positive definite matrices with the affine-invariant metric, and correlation matrices with a flat one."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from .._arguments import checked_size
from ..matrices.exponential import expm
from ..matrices.linear import max_abs_entry
from ..matrices.symmetric import cholesky, solve_lower, spd_log, symmetrize
from .base import Space, register
from .maps import inner_by_coordinates, tangential_part_by_projection


class PositiveDefinite(Space):
    """Base class of spaces of symmetric positive definite n x n matrices."""

    n: int

    @property
    def shape(self):
        return (self.n, self.n)

    def _inside(self, x):
        return jnp.isfinite(cholesky(x)).all(axis=(-2, -1))

    def _why_off_space(self, x, residual):
        if np.isfinite(x).all() and not np.isfinite(residual):
            return f"not positive definite, with the least eigenvalue {np.linalg.eigvalsh((x + x.T) / 2)[0]:.3g}"
        return super()._why_off_space(x, residual)


@register((3,))
@jax.tree_util.register_static
@dataclass(frozen=True, repr=False)
class SPD(PositiveDefinite):
    """Symmetric positive definite n x n matrices with ``inner(x, u, v) = tr(x^-1 u x^-1 v)``.

    The metric is invariant under every ``x -> g x g^T``; it makes the space complete and of nonpositive curvature, so
    that exp and log are one to one everywhere [Pennec, Fillard & Ayache 2006]. The formulas use the Cholesky factor L
    of x instead of their square root: ``exp(x, v) = L expm(L^-1 v L^-T) L^T``. The result is known to rounding of its
    largest entry, so eigenvalues smaller than that by 1e16 are lost.

    Parameters
    ----------
    n : int
        The size of the matrices.

    Examples
    --------
    The midpoint of two matrices is their geometric mean:

    >>> space = mf.SPD(2)
    >>> print(np.round(space.midpoint(np.eye(2), np.diag([4.0, 9.0])), 12))
    [[2. 0.]
     [0. 3.]]
    """

    n: int
    metric = "affine-invariant"

    def __post_init__(self):
        checked_size(self.n, 1, "SPD(n)")

    @property
    def name(self):
        return f"SPD({self.n})"

    @property
    def dim(self):
        return self.n * (self.n + 1) // 2

    def _residual(self, x):
        asymmetry = max_abs_entry(x - x.swapaxes(-1, -2)) / max_abs_entry(x)
        return jnp.where(self._inside(x), asymmetry, jnp.inf)

    def _project(self, x):
        x = symmetrize(x)
        return jnp.where(self._inside(x)[..., None, None], x, jnp.nan)

    def _restore(self, x):
        return symmetrize(x)

    @property
    def _n_gaussian_samples(self):
        return self.dim

    def _point_from_gaussian_samples(self, w):
        return symmetrize(expm(jnp.einsum("...a,aij->...ij", 0.5 * w, self._basis)))

    def _project_tangent(self, x, w):
        return symmetrize(w)

    def _frame(self, x):
        L = cholesky(x)[..., None, :, :]
        return L @ self._basis @ L.swapaxes(-1, -2)

    def _inner(self, x, u, v):
        inverse_factor = self._inverse_factor(x)
        return self._pair(_congruence(inverse_factor, u), _congruence(inverse_factor, v))

    def _metric_covector(self, x, v):
        inverse_factor = self._inverse_factor(x)
        return _congruence(inverse_factor.swapaxes(-1, -2), _congruence(inverse_factor, v))

    def _sharp(self, x, alpha):
        return x @ symmetrize(alpha) @ x

    def _exp(self, x, v):
        half = cholesky(x) @ expm(0.5 * _congruence(self._inverse_factor(x), v))
        return symmetrize(half @ half.swapaxes(-1, -2))  # positive definite by its form

    def _log(self, x, y):
        return _congruence(cholesky(x), self._log_transported_to_identity(x, y))

    def _log_transported_to_identity(self, x, y):
        """Return the logarithm of y at x, transported by the isometry that takes x to the identity."""
        inverse_factor = self._inverse_factor(x)
        return spd_log(_congruence(inverse_factor, y), _congruence(inverse_factor, y - x))

    def _squared_distance(self, x, y):
        v = self._log_transported_to_identity(x, y)
        return self._pair(v, v)

    def _transport(self, x, v, u):
        inverse_factor = self._inverse_factor(x)
        return _congruence(cholesky(x) @ expm(0.5 * _congruence(inverse_factor, v)) @ inverse_factor, u)

    def _euclidean_reach(self, x, v):
        return self._norm(x, v)  # x + v = L (I + a) L^T, with a of this norm

    def _inverse_factor(self, x):
        return solve_lower(cholesky(x), jnp.broadcast_to(np.eye(self.n), x.shape))

    @property
    def _basis(self) -> np.ndarray:
        """Orthonormal basis of the symmetric matrices, shape (dim, n, n)."""
        units = np.eye(self.n)
        return np.array(
            [
                (np.outer(units[i], units[j]) + np.outer(units[j], units[i])) / (2.0 if i == j else np.sqrt(2.0))
                for i in range(self.n)
                for j in range(i, self.n)
            ]
        )


def _congruence(g, a):
    """Return ``g a g^T``, symmetric to the last bit."""
    return symmetrize(g @ a @ g.swapaxes(-1, -2))


@register((3,))
@jax.tree_util.register_static
@dataclass(frozen=True, repr=False)
class Correlation(PositiveDefinite):
    """Symmetric positive definite n x n matrices with ones on the diagonal, and the Euclidean-Cholesky metric.

    The Cholesky factor L of x, with each row divided by its entry on the diagonal, is a triangular matrix with ones on
    the diagonal, and any such matrix belongs to one x. Its other entries are coordinates in which the metric is the sum
    of products, so that the space is complete and flat, and geodesics are unique [Thanwerdas & Pennec 2022].

    Parameters
    ----------
    n : int
        The size of the matrices.
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
        """Return x with every diagonal entry replaced by 1."""
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
    def _n_gaussian_samples(self):
        return 2 * self.n**2

    def _point_from_gaussian_samples(self, w):
        rows = w.reshape(*w.shape[:-1], self.n, 2 * self.n)
        return self._project(rows @ rows.swapaxes(-1, -2))

    def _project_tangent(self, x, w):
        return jnp.where(np.eye(self.n, dtype=bool), 0.0, symmetrize(w))

    # -- the coordinates, and back ------------------------------------------------------------------------------------

    def _cholesky_coordinates(self, x):
        """Return the Cholesky factor of x with rows scaled to unit diagonal, below the diagonal, shape (..., dim)."""
        factor = cholesky(x)
        rows = factor / jnp.diagonal(factor, axis1=-2, axis2=-1)[..., None]
        return rows[..., *np.tril_indices(self.n, -1)]

    def _point_from_cholesky_coordinates(self, c):
        """Return the correlation matrix with these Cholesky coordinates, shape (..., n, n)."""
        rows = jnp.zeros((*c.shape[:-1], self.n, self.n)).at[..., *np.tril_indices(self.n, -1)].set(c) + np.eye(self.n)
        rows = rows / jnp.sqrt((rows**2).sum(axis=-1, keepdims=True))
        return self._with_unit_diagonal(rows @ rows.swapaxes(-1, -2))

    def _coordinates(self, x, v):
        x, v = jnp.broadcast_arrays(x, v)
        return jax.jvp(self._cholesky_coordinates, (x,), (v,))[1]

    def _from_coordinates(self, x, c):
        start_coordinates = self._cholesky_coordinates(x)
        start_coordinates, c = jnp.broadcast_arrays(start_coordinates, c)
        return jax.jvp(self._point_from_cholesky_coordinates, (start_coordinates,), (c,))[1]

    def _frame(self, x):
        return jax.vmap(lambda e: self._from_coordinates(x, e), out_axes=-3)(jnp.eye(self.dim))

    _inner = inner_by_coordinates

    def _metric_covector(self, x, v):
        c = self._coordinates(x, v)
        return symmetrize(
            jax.vjp(self._cholesky_coordinates, jnp.broadcast_to(x, (*c.shape[:-1], *self.shape)))[1](c)[0]
        )

    def _sharp(self, x, alpha):
        x, alpha = jnp.broadcast_arrays(x, alpha)
        start_coordinates = self._cholesky_coordinates(x)
        return self._from_coordinates(x, jax.vjp(self._point_from_cholesky_coordinates, start_coordinates)[1](alpha)[0])

    def _exp(self, x, v):
        return self._point_from_cholesky_coordinates(self._cholesky_coordinates(x) + self._coordinates(x, v))

    def _log(self, x, y):
        return self._from_coordinates(x, self._cholesky_coordinates(y) - self._cholesky_coordinates(x))

    def _squared_distance(self, x, y):
        return ((self._cholesky_coordinates(y) - self._cholesky_coordinates(x)) ** 2).sum(axis=-1)

    def _transport(self, x, v, u):
        return self._from_coordinates(self._exp(x, v), self._coordinates(x, u))
