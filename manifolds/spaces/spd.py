"""Symmetric positive definite matrices with the affine-invariant metric."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from .._sizes import checked_size
from ..matrices.exponential import expm
from ..matrices.linear import max_abs_entry
from ..matrices.symmetric import cholesky, solve_lower, spd_log, symmetrize
from .base import Space, register


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
    def _n_normal_numbers(self):
        return self.dim

    def _point_from_normal_numbers(self, w):
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
        return _congruence(cholesky(x), self._log_moved_to_identity(x, y))

    def _log_moved_to_identity(self, x, y):
        """Return the logarithm of y at x, carried by the isometry that takes x to the identity."""
        inverse_factor = self._inverse_factor(x)
        return spd_log(_congruence(inverse_factor, y), _congruence(inverse_factor, y - x))

    def _squared_distance(self, x, y):
        v = self._log_moved_to_identity(x, y)
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
