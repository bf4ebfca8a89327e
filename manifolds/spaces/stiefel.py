"""Stiefel manifolds of orthonormal p-frames in R^n, and Grassmann manifolds of the subspaces that they span."""

from __future__ import annotations

import math
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from .._arguments import checked_size
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
from ..matrices.spectral import spectral
from ..matrices.symmetric import eigh, orthonormal_columns, polar, symmetrize
from .base import CUT_MARGIN, MIN_CUT_ANGLE, Space, register
from .maps import inner_by_flat, squared_distance_with_cut_locus

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

    Parameters
    ----------
    n, p : int
        The numbers of rows and of columns, 0 < p < n.

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
                f"Stiefel(n, p): p must be less than n, got {self.p} >= {self.n}. For n = p use SpecialOrthogonal(n)"
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

    def _point_from_gaussian_samples(self, w):
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
        """Return the logarithm for one pair of points, by Newton's method in coordinates; NaN if it finds none."""

        def residual(c):
            return self._exp(x, self._from_coordinates(x, c)) - y

        def damped_newton_step(state):
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
            c, change, _ = jax.lax.while_loop(is_unfinished, damped_newton_step, (start, jnp.inf, 0))
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


_MIN_EIGENVALUE_GAP = 1e-8
"""Smallest gap between the p largest eigenvalues and the others, relative to the largest, for a projection to exist."""

_SIGN_NEWTON_STEPS = 60
"""Number of Newton steps for the sign of a matrix; enough for the smallest eigenvalue gap."""

_MAX_SERIES_SINE_SQUARED = 1 / 8
"""``sin^2`` of half an angle below which a power series is summed, whose derivatives do not cancel."""

_ANGLE_OVER_SINE_SERIES = [math.factorial(k) / math.prod(j + 1.5 for j in range(k)) for k in reversed(range(24))]
"""Coefficients of ``t / sin(t) = 1 + 2/3 s + 8/15 s^2 + …`` in powers of ``s = sin(t/2)^2``, the highest first."""


@register((3, 1), (4, 2))
@jax.tree_util.register_static
@dataclass(frozen=True, repr=False)
class Grassmann(Space):
    """The p-dimensional subspaces of R^n, each as its orthogonal projector x, shape (n, n), ``inner = tr(u v)``.

    A tangent vector v at x is ``[W, x]`` for the skew ``W = [v, x]``, and the geodesic ``expm(W) x expm(-W)``. Its
    length is sqrt(2) times the root of the sum of the squared principal angles [Bendokat, Zimmermann & Absil 2024]. The
    logarithm is unique if no principal angle is a right angle.

    Parameters
    ----------
    n, p : int
        The dimensions of the space R^n and of the subspaces.

    Examples
    --------
    The distance of two lines in the plane at an angle of 0.3 is ``sqrt(2) * 0.3``:

    >>> space = mf.Grassmann(2, 1)
    >>> line = lambda angle: np.outer(*2 * [[np.cos(angle), np.sin(angle)]])
    >>> round(float(space.distance(line(0.0), line(0.3)) / np.sqrt(2.0)), 12)
    0.3
    """

    n: int
    p: int
    metric = "canonical"

    def __post_init__(self):
        checked_size(self.n, 2, "Grassmann(n, p)")
        checked_size(self.p, 1, "Grassmann(n, p)", "p")
        if self.p >= self.n:
            raise ParameterError(f"Grassmann(n, p): p must be less than n, got {self.p} >= {self.n}")

    @property
    def name(self):
        return f"Gr({self.n}, {self.p})"

    @property
    def dim(self):
        return self.p * (self.n - self.p)

    @property
    def shape(self):
        return (self.n, self.n)

    def injectivity_radius(self, x=None):
        return math.pi / math.sqrt(2.0)

    def subspace(self, basis) -> jax.Array:
        """Return the point of the span of the columns of ``basis``, shape (..., n, p)."""
        q = orthonormal_columns(jnp.asarray(basis, dtype=jnp.float64))
        return q @ q.swapaxes(-1, -2)

    def _residual(self, x):
        square = max_abs_entry(x @ x - x)
        rank = jnp.abs(jnp.trace(x, axis1=-2, axis2=-1) - self.p)
        return jnp.maximum(jnp.maximum(square, max_abs_entry(x - x.swapaxes(-1, -2))), rank)

    def _constraints(self, x):
        """Return the symmetric part of ``x^2 - x`` and the skew part of x, as one vector.

        Their n^2 derivatives vanish just on the tangent vectors.
        """
        y = symmetrize(x)
        return self.to_vector(y @ y - y + (x - y))

    def _correction(self, x, constraint_change):
        """Return the least displacement at a projector x that changes the constraints by ``constraint_change``.

        A symmetric matrix that commutes with x changes ``x^2 - x`` by ``(2 x - 1)`` times itself.
        """
        constraint_change = self.from_vector(constraint_change)
        symmetric_part = symmetrize(constraint_change)
        product = x @ symmetric_part
        return product + product.swapaxes(-1, -2) - symmetric_part + (constraint_change - symmetric_part)

    _minimal_correction = _correction

    def _tangential_part(self, x, w):
        return self._project_tangent(symmetrize(x), w)

    def _constraint_rounding_scales(self, x):
        return self.to_vector(jnp.abs(x) @ jnp.abs(x) + jnp.abs(x))

    def _inside(self, x):
        return jnp.abs(jnp.trace(x, axis1=-2, axis2=-1) - self.p) < 0.5

    def _project(self, x):
        """Return the projector onto the eigenvectors of the p largest eigenvalues."""
        x = symmetrize(x)
        values = jnp.sort(eigh(jax.lax.stop_gradient(x))[0], axis=-1)
        upper, lower_values = values[..., self.n - self.p], values[..., self.n - self.p - 1]
        midpoint, eigenvalue_gap = (
            0.5 * (upper + lower_values),
            jnp.maximum(values[..., -1] - lower_values, upper - values[..., 0]),
        )
        sign = (x - midpoint[..., None, None] * np.eye(self.n)) / eigenvalue_gap[..., None, None]
        sign = jax.lax.fori_loop(0, _SIGN_NEWTON_STEPS, lambda _, y: 1.5 * y - 0.5 * y @ y @ y, sign)
        return jnp.where(
            (upper - lower_values > _MIN_EIGENVALUE_GAP * eigenvalue_gap)[..., None, None],
            symmetrize(0.5 * (np.eye(self.n) + sign)),
            jnp.nan,
        )

    @property
    def _n_gaussian_samples(self):
        return self.n * self.p

    def _point_from_gaussian_samples(self, w):
        return self.subspace(w.reshape(*w.shape[:-1], self.n, self.p))

    def _project_tangent(self, x, w):
        w = symmetrize(w)
        product = x @ w @ (np.eye(self.n) - x)
        return product + product.swapaxes(-1, -2)

    def _frame(self, x):
        """Return rotations of each basis vector of the subspace into each one of its complement."""
        basis = self._adapted_basis(x)
        subspace_basis, complement_basis = basis[..., : self.p], basis[..., self.p :]
        vectors = jnp.einsum("...ia,...jb->...abij", subspace_basis, complement_basis)
        vectors = (vectors + vectors.swapaxes(-1, -2)) / math.sqrt(2.0)
        return vectors.reshape(*x.shape[:-2], self.dim, self.n, self.n)

    def _adapted_basis(self, x):
        """Return an orthonormal basis of R^n that begins with one of the subspace, made of its longest projected
        axes."""
        remainder, columns = x, []
        for _ in range(self.p):
            squares = (remainder**2).sum(axis=-2)
            is_longest = jnp.argmax(squares, axis=-1)[..., None] == jnp.arange(self.n)
            e = jnp.where(is_longest[..., None, :], remainder, 0.0).sum(axis=-1)
            e = e / jnp.sqrt((e**2).sum(axis=-1, keepdims=True))
            remainder = remainder - e[..., :, None] * (e[..., None, :] @ remainder)
            columns.append(e)
        q = jnp.stack(columns, axis=-1)
        return jnp.concatenate([q, orthonormal_complement(q)], axis=-1)

    @property
    def isotropic_size(self):
        return math.comb(self.n, 2)

    def _isotropic(self, x, w):
        """Return the sum of the rotation fields of all coordinate planes at x, weighted by w: a tangent vector."""
        return _commutator(skew_matrix(w, self.n), x) / math.sqrt(2.0)

    def _inner(self, x, u, v):
        return self._pair(u, v)

    def _metric_covector(self, x, v):
        return v

    def _sharp(self, x, alpha):
        x = symmetrize(x)
        product = symmetrize(alpha) @ x
        half_bracket = (
            product - product.swapaxes(-1, -2)
        ) @ x  # [[alpha, x], x], whose products are transposes of others
        return half_bracket + half_bracket.swapaxes(-1, -2)

    def _exp(self, x, v):
        rotation = expm(_commutator(v, x))
        return symmetrize(rotation @ x @ rotation.swapaxes(-1, -2))

    def _log(self, x, y):
        """Return the logarithm from bases of both subspaces, with the basis of y rotated as near to that of x as
        possible.

        With the principal angles t, their difference has the singular values ``2 sin(t/2)``: nothing cancels, for
        neighbours nor at a right angle [Zimmermann & Huper 2022].
        """
        x_basis, y_basis = self._smooth_subspace_basis(x), self._smooth_subspace_basis(y)
        step = y_basis @ polar(y_basis.swapaxes(-1, -2) @ x_basis) - x_basis
        square = 0.25 * step.swapaxes(-1, -2) @ step
        normal_step = step - x_basis @ (x_basis.swapaxes(-1, -2) @ step)  # its singular values are sin(t)
        half = normal_step @ spectral(_angle_over_sine, symmetrize(square)) @ x_basis.swapaxes(-1, -2)
        return half + half.swapaxes(-1, -2)

    def _smooth_subspace_basis(self, x):
        """Return an orthonormal basis of the subspace, shape (..., n, p), that is a smooth function of x near this
        point."""
        basis = jax.lax.stop_gradient(self._adapted_basis(x)[..., : self.p])
        return polar(x @ basis)

    def _squared_distance(self, x, y):
        return squared_distance_with_cut_locus(self, x, y)

    def _squared_distance_value(self, x, y):
        """Return the squared distance, also at right angles.

        Eigenvalues of ``x + y - 1`` are cosines of the principal angles, each of them twice, or 1.
        """
        cosines, vectors = eigh(x + y - np.eye(self.n))
        sines = jnp.sqrt((((x - y) @ vectors) ** 2).sum(axis=-2))
        return (jnp.arctan2(sines, jnp.abs(cosines)) ** 2).sum(axis=-1)

    def _transport(self, x, v, u):
        rotation = expm(_commutator(v, x))
        return symmetrize(rotation @ u @ rotation.swapaxes(-1, -2))

    def _why_log_is_undefined(self, x, y):
        return "the subspaces have a right angle between them, and more than one geodesic leads from x to y"


def _angle_over_sine(half_angle_sine_squared):
    """Return ``t / sin(t)``, given ``sin(t/2)^2``, by a series where that is small; NaN at a right angle."""
    use_series = half_angle_sine_squared < _MAX_SERIES_SINE_SQUARED
    series = jnp.polyval(jnp.asarray(_ANGLE_OVER_SINE_SERIES), jnp.where(use_series, half_angle_sine_squared, 0.0))
    sine_squared = jnp.where(
        use_series,
        0.25,
        jnp.where(half_angle_sine_squared < 0.5 - 0.5 * MIN_CUT_ANGLE, half_angle_sine_squared, jnp.nan),
    )
    cosine_squared = 1.0 - sine_squared
    return jnp.where(
        use_series,
        series,
        jnp.arctan2(jnp.sqrt(sine_squared), jnp.sqrt(cosine_squared)) / jnp.sqrt(sine_squared * cosine_squared),
    )


def _commutator(a, b):
    return a @ b - b @ a
