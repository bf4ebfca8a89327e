"""Stiefel manifold of orthonormal p-frames in R^n, with its canonical metric."""

from __future__ import annotations

import math
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from .._sizes import checked_size
from ..errors import ParameterError
from ..matrices.exponential import expm
from ..matrices.linear import (
    max_abs_entry,
    newton_schulz_step,
    orthonormal_complement,
    skew_matrix,
    solve,
    solve_lyapunov,
    symmetric_matrix,
)
from ..matrices.symmetric import orthonormal_columns, polar
from .base import CUT_MARGIN, Space, register
from .maps import inner_by_flat

_MAX_NEWTON_STEPS = 30
"""Largest number of Newton iterations for the logarithm; at most 11 were needed inside the injectivity radius."""


@register((4, 2))
@jax.tree_util.register_static
@dataclass(frozen=True, repr=False)
class Stiefel(Space):
    """Matrices n x p with orthonormal columns, p < n, and ``inner(x, u, v) = tr(u^T (I - x x^T / 2) v)``.

    This is the metric of SO(n)/SO(n - p), in which a rotation counts once, whether it turns the columns of x among
    themselves or out of their span. A tangent vector v at x is ``W x`` for one skew W of least norm; the geodesic is
    ``expm(t W) x`` [Edelman, Arias & Smith 1998]. Parallel transport solves the linear equation
    ``eta' = -[W, eta]/2``, projected, of a naturally reductive space. The logarithm has no closed form: Gauss and
    Newton's method computes it from the projected chord, and it is accepted inside the injectivity radius only, where
    it is unique. That radius is pi for p = 1 and p = n - 1; otherwise the bound ``2 pi / sqrt 5`` [Rentmeesters 2013].

    Examples
    --------
    >>> space = mf.Stiefel(4, 2)
    >>> x = space.random(0)
    >>> v = 0.1 * space.random_tangent(1, x)
    >>> bool(np.allclose(space.log(x, space.exp(x, v)), v))
    True
    """

    n: int
    p: int
    metric = "canonical"
    has_iterative_log = True

    def __post_init__(self):
        checked_size(self.n, 2, "Stiefel(n, p)")
        checked_size(self.p, 1, "Stiefel(n, p)", "p")
        if self.p >= self.n:
            raise ParameterError(
                f"Stiefel(n, p): p must be less than n, not {self.p} >= {self.n}; for n = p take SpecialOrthogonal(n)"
            )

    @property
    def name(self):
        return f"St({self.n}, {self.p})"

    @property
    def dim(self):
        return self.n * self.p - self.p * (self.p + 1) // 2

    @property
    def shape(self):
        return (self.n, self.p)

    def injectivity_radius(self, x=None):
        return math.pi if self.p in (1, self.n - 1) else 2.0 * math.pi / math.sqrt(5.0)

    def _residual(self, x):
        return max_abs_entry(_transpose_matrix(x) @ x - np.eye(self.p))

    def _project(self, x):
        return polar(x)

    def _constraints(self, x):
        residual = _transpose_matrix(x) @ x - np.eye(self.p)
        return residual[..., *np.triu_indices(self.p)]

    def _minimal_correction(self, x, constraint_change):
        if self.p > 2:
            return super()._minimal_correction(x, constraint_change)
        return x @ solve_lyapunov(_transpose_matrix(x) @ x, symmetric_matrix(constraint_change, self.p))

    def _correction(self, x, constraint_change):
        return 0.5 * x @ symmetric_matrix(constraint_change, self.p)

    def _tangential_part(self, x, w):
        if self.p > 2:
            return super()._tangential_part(x, w)
        product = _transpose_matrix(x) @ w
        return w - x @ solve_lyapunov(_transpose_matrix(x) @ x, product + _transpose_matrix(product))

    def _constraint_rounding_scales(self, x):
        return 2.0 * (_transpose_matrix(jnp.abs(x)) @ jnp.abs(x))[..., *np.triu_indices(self.p)]

    def _point_from_normal_numbers(self, w):
        return orthonormal_columns(self.from_vector(w))

    def _project_tangent(self, x, w):
        product = _transpose_matrix(x) @ w
        return w - x @ (product + _transpose_matrix(product)) / 2

    def _frame(self, x):
        """Return rotations of the columns of x among themselves, then of each column into the complement of their
        span."""
        units = np.eye(self.p)
        pairs = [(i, j) for i in range(self.p) for j in range(i + 1, self.p)]
        skew = [np.outer(units[j], units[i]) - np.outer(units[i], units[j]) for i, j in pairs]
        tangential_vectors = x[..., None, :, :] @ np.array(skew).reshape(-1, self.p, self.p)
        normal_vectors = jnp.einsum("...ni,jp->...ijnp", orthonormal_complement(x), units)
        return jnp.concatenate([tangential_vectors, normal_vectors.reshape(*x.shape[:-2], -1, *self.shape)], axis=-3)

    @property
    def isotropic_size(self):
        return math.comb(self.n, 2)

    def _isotropic(self, x, w):
        """Return the sum of the rotation fields of all coordinate planes at x, weighted by w: a tangent vector."""
        return skew_matrix(w, self.n) @ x

    _inner = inner_by_flat

    def _metric_covector(self, x, v):
        return v - 0.5 * x @ (_transpose_matrix(x) @ v)

    def _sharp(self, x, alpha):
        return alpha @ (_transpose_matrix(x) @ x) - x @ (
            _transpose_matrix(alpha) @ x
        )  # a rotation of x, whatever x^T x is

    def _exp(self, x, v):
        return newton_schulz_step(
            expm(self._least_skew_generator(x, v)) @ x
        )  # one Newton step back, so that rounding does not add up

    def _log(self, x, y):
        return jnp.vectorize(self._single_log, signature="(n,p),(n,p)->(n,p)")(x, y)

    def _transport(self, x, v, u):
        W, base = self._least_skew_generator(x, v), x[..., None, :, :]
        frame = self._least_skew_generator(base, self._frame(x))
        rates = -0.5 * (W[..., None, :, :] @ frame - frame @ W[..., None, :, :]) @ base
        flow = expm(self._coordinates(base, rates))  # rows are images: it acts from the right
        c = (self._coordinates(x, u)[..., None, :] @ flow)[..., 0, :]
        return expm(W) @ self._from_coordinates(x, c)

    def _least_skew_generator(self, x, v):
        """Return the skew n x n matrix W of least norm with ``W x = v``."""
        outer = v @ _transpose_matrix(x)
        return outer - _transpose_matrix(outer) - x @ (_transpose_matrix(x) @ outer)

    def _single_log(self, x, y):
        def residual(c):
            return self._exp(x, self._from_coordinates(x, c)) - y

        def newton_step(state):
            c, _, steps = state
            J, f = jax.jacfwd(lambda c: (residual(c),) * 2, has_aux=True)(c)
            J, f = J.reshape(-1, self.dim), f.ravel()
            direction = solve(J.T @ J, -(J.T @ f)[:, None])[:, 0]
            lengths = 0.5 ** jnp.arange(8)
            squared_residuals = jax.vmap(lambda t: (residual(c + t * direction) ** 2).sum())(lengths)
            move = lengths[jnp.nanargmin(squared_residuals)] * direction
            return c + move, jnp.abs(move).max(), steps + 1

        def newton_solve(_, start):
            is_unfinished = lambda state: (state[1] > 1e-8) & (state[2] < _MAX_NEWTON_STEPS)  # noqa: E731
            c, change, _ = jax.lax.while_loop(is_unfinished, newton_step, (start, jnp.inf, 0))
            is_inside = (c**2).sum() < (self.injectivity_radius() * (1.0 - CUT_MARGIN)) ** 2
            is_solution = (change <= 1e-8) & (
                jnp.abs(residual(c)).max() <= 1e-10
            )  # not just a point where Newton gets stuck
            return jnp.where(is_inside & is_solution, c, jnp.nan)

        chord = self._project_tangent(x, y - x)
        length = jnp.sqrt(self._inner(x, y - x, y - x) / jnp.maximum(self._inner(x, chord, chord), 1e-300))
        start = jax.lax.stop_gradient(self._coordinates(x, length * chord))
        c = jax.lax.custom_root(  # for the derivatives, of every order, by the implicit function theorem
            lambda c: self._coordinates(y, self._project_tangent(y, residual(c))),
            start,
            newton_solve,
            lambda linear, b: solve(jax.jacfwd(linear)(jnp.zeros_like(b)), b[:, None])[:, 0],
        )
        return self._from_coordinates(x, c)


def _transpose_matrix(a):
    return a.swapaxes(-1, -2)
