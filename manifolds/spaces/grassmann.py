"""Grassmann manifolds: subspaces of R^n of a given dimension, represented by projectors."""

from __future__ import annotations

import math
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from .._sizes import checked_size
from ..errors import ParameterError
from ..matrices.exponential import expm
from ..matrices.linear import max_abs_entry, orthonormal_complement, skew_matrix
from ..matrices.spectral import spectral
from ..matrices.symmetric import eigh, orthonormal_columns, polar, symmetrize
from .base import CUT_MARGIN, Space, register
from .maps import squared_distance_with_cut_locus

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
            raise ParameterError(f"Grassmann(n, p): p must be less than n, not {self.p} >= {self.n}")

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
        upper, lower = values[..., self.n - self.p], values[..., self.n - self.p - 1]
        midpoint, spread = 0.5 * (upper + lower), jnp.maximum(values[..., -1] - lower, upper - values[..., 0])
        sign = (x - midpoint[..., None, None] * np.eye(self.n)) / spread[..., None, None]
        sign = jax.lax.fori_loop(0, _SIGN_NEWTON_STEPS, lambda _, y: 1.5 * y - 0.5 * y @ y @ y, sign)
        return jnp.where(
            (upper - lower > _MIN_EIGENVALUE_GAP * spread)[..., None, None],
            symmetrize(0.5 * (np.eye(self.n) + sign)),
            jnp.nan,
        )

    @property
    def _n_normal_numbers(self):
        return self.n * self.p

    def _point_from_normal_numbers(self, w):
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

    def _explain_missing_log(self, x, y):
        return "the subspaces have a right angle between them, and more than one geodesic leads from x to y"


def _angle_over_sine(half_angle_sine_squared):
    """Return ``t / sin(t)`` for ``square = sin(t/2)^2``, by a series where that is small; NaN at a right angle."""
    use_series = half_angle_sine_squared < _MAX_SERIES_SINE_SQUARED
    series = jnp.polyval(jnp.asarray(_ANGLE_OVER_SINE_SERIES), jnp.where(use_series, half_angle_sine_squared, 0.0))
    sine_squared = jnp.where(
        use_series,
        0.25,
        jnp.where(half_angle_sine_squared < 0.5 - 0.5 * (math.pi / 2 * CUT_MARGIN), half_angle_sine_squared, jnp.nan),
    )
    cosine_squared = 1.0 - sine_squared
    return jnp.where(
        use_series,
        series,
        jnp.arctan2(jnp.sqrt(sine_squared), jnp.sqrt(cosine_squared)) / jnp.sqrt(sine_squared * cosine_squared),
    )


def _commutator(a, b):
    return a @ b - b @ a
