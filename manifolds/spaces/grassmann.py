"""Grassmann manifolds: the subspaces of R^n of one dimension, as projectors."""

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
from .maps import extended_squared_distance

_MIN_EIGENVALUE_GAP = 1e-8
"""Least distance of the eigenvalues that are taken from those that are not, relative to the largest."""

_SIGN_NEWTON_STEPS = 60
"""Newton's steps for the sign of a matrix: enough for that gap."""

_MAX_SERIES_SINE_SQUARED = 1 / 8
"""``sin^2`` of half an angle below which a series in it is summed, whose derivatives do not cancel."""

_ANGLE_OVER_SINE_SERIES = [math.factorial(k) / math.prod(j + 1.5 for j in range(k)) for k in reversed(range(24))]
"""``t / sin(t) = 1 + 2/3 s + 8/15 s^2 + …`` in powers of ``s = sin(t/2)^2``, the highest first."""


@register((3, 1), (4, 2))
@jax.tree_util.register_static
@dataclass(frozen=True, repr=False)
class Grassmann(Space):
    """The p-dimensional subspaces of R^n, each as its orthogonal projector x, shape (n, n), ``inner = tr(u v)``.

    A tangent vector v at x is ``[W, x]`` for the skew ``W = [v, x]``, and the geodesic ``expm(W) x expm(-W)``. Its
    length is sqrt(2) times the root of the sum of the squared principal angles [Bendokat, Zimmermann & Absil 2024]. The
    logarithm is unique where no angle is a right one.
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
        """The point with the span of the columns of ``basis``, shape (..., n, p)."""
        q = orthonormal_columns(jnp.asarray(basis, dtype=jnp.float64))
        return q @ q.swapaxes(-1, -2)

    def _residual(self, x):
        square = max_abs_entry(x @ x - x)
        rank = jnp.abs(jnp.trace(x, axis1=-2, axis2=-1) - self.p)
        return jnp.maximum(jnp.maximum(square, max_abs_entry(x - x.swapaxes(-1, -2))), rank)

    def _constraints(self, x):
        """``x^2 - x``, symmetric, and what of x is skew: of their n^2 derivatives those off the tangents are left."""
        y = symmetrize(x)
        return self.to_vector(y @ y - y + (x - y))

    def _correction(self, x, c):
        """A symmetric matrix that commutes with x changes ``x^2 - x`` by ``(2 x - 1)`` times itself."""
        c = self.from_vector(c)
        own = symmetrize(c)
        turned = x @ own
        return turned + turned.swapaxes(-1, -2) - own + (c - own)

    _minimal_correction = _correction

    def _tangential_part(self, x, w):
        return self._project_tangent(symmetrize(x), w)

    def _constraint_scales(self, x):
        return self.to_vector(jnp.abs(x) @ jnp.abs(x) + jnp.abs(x))

    def _inside(self, x):
        return jnp.abs(jnp.trace(x, axis1=-2, axis2=-1) - self.p) < 0.5

    def _project(self, x):
        """The projector to the eigenvectors with the largest eigenvalues."""
        x = symmetrize(x)
        values = jnp.sort(eigh(jax.lax.stop_gradient(x))[0], axis=-1)
        upper, under = values[..., self.n - self.p], values[..., self.n - self.p - 1]
        middle, size = 0.5 * (upper + under), jnp.maximum(values[..., -1] - under, upper - values[..., 0])
        sign = (x - middle[..., None, None] * np.eye(self.n)) / size[..., None, None]
        sign = jax.lax.fori_loop(0, _SIGN_NEWTON_STEPS, lambda _, y: 1.5 * y - 0.5 * y @ y @ y, sign)
        return jnp.where(
            (upper - under > _MIN_EIGENVALUE_GAP * size)[..., None, None],
            symmetrize(0.5 * (np.eye(self.n) + sign)),
            jnp.nan,
        )

    @property
    def _n_normals(self):
        return self.n * self.p

    def _point_from_normals(self, w):
        return self.subspace(w.reshape(*w.shape[:-1], self.n, self.p))

    def _project_tangent(self, x, w):
        w = symmetrize(w)
        along = x @ w @ (np.eye(self.n) - x)
        return along + along.swapaxes(-1, -2)

    def _frame(self, x):
        """Turns of a basis of the subspace into one of its complement."""
        basis = self._basis(x)
        inner, outer = basis[..., : self.p], basis[..., self.p :]
        turns = jnp.einsum("...ia,...jb->...abij", inner, outer)
        turns = (turns + turns.swapaxes(-1, -2)) / math.sqrt(2.0)
        return turns.reshape(*x.shape[:-2], self.dim, self.n, self.n)

    def _basis(self, x):
        """An orthonormal basis of R^n that begins with one of the subspace: of its longest projected axes."""
        rest, columns = x, []
        for _ in range(self.p):
            squares = (rest**2).sum(axis=-2)
            best = jnp.argmax(squares, axis=-1)[..., None] == jnp.arange(self.n)
            e = jnp.where(best[..., None, :], rest, 0.0).sum(axis=-1)
            e = e / jnp.sqrt((e**2).sum(axis=-1, keepdims=True))
            rest = rest - e[..., :, None] * (e[..., None, :] @ rest)
            columns.append(e)
        q = jnp.stack(columns, axis=-1)
        return jnp.concatenate([q, orthonormal_complement(q)], axis=-1)

    @property
    def isotropic_size(self):
        return math.comb(self.n, 2)

    def _isotropic(self, x, w):
        """By the rotations of every plane."""
        return _commutator(skew_matrix(w, self.n), x) / math.sqrt(2.0)

    def _inner(self, x, u, v):
        return self._pair(u, v)

    def _flat(self, x, v):
        return v

    def _sharp(self, x, alpha):
        x = symmetrize(x)
        product = symmetrize(alpha) @ x
        turned = (product - product.swapaxes(-1, -2)) @ x  # [[alpha, x], x], whose products are transposes of others
        return turned + turned.swapaxes(-1, -2)

    def _exp(self, x, v):
        turn = expm(_commutator(v, x))
        return symmetrize(turn @ x @ turn.swapaxes(-1, -2))

    def _log(self, x, y):
        """From bases of both subspaces that are turned to each other: the one of y as near to that of x as it can be.

        With the principal angles t, their difference has the singular values ``2 sin(t/2)``: nothing cancels, for
        neighbours nor at a right angle [Zimmermann & Huper 2022].
        """
        at, to = self._smooth_basis(x), self._smooth_basis(y)
        step = to @ polar(to.swapaxes(-1, -2) @ at) - at
        square = 0.25 * step.swapaxes(-1, -2) @ step
        across = step - at @ (at.swapaxes(-1, -2) @ step)  # its singular values are sin(t)
        half = across @ spectral(_angle_over_sine, symmetrize(square)) @ at.swapaxes(-1, -2)
        return half + half.swapaxes(-1, -2)

    def _smooth_basis(self, x):
        """An orthonormal basis of the subspace, shape (..., n, p), that is a smooth function of x near this one."""
        basis = jax.lax.stop_gradient(self._basis(x)[..., : self.p])
        return polar(x @ basis)

    def _squared_distance(self, x, y):
        return extended_squared_distance(self, x, y)

    def _squared_distance_value(self, x, y):
        """Also at a right angle: eigenvalues of ``x + y - 1`` are cosines of the angles, each of them twice, or 1."""
        cosines, vectors = eigh(x + y - np.eye(self.n))
        sines = jnp.sqrt((((x - y) @ vectors) ** 2).sum(axis=-2))
        return (jnp.arctan2(sines, jnp.abs(cosines)) ** 2).sum(axis=-1)

    def _transport(self, x, v, u):
        turn = expm(_commutator(v, x))
        return symmetrize(turn @ u @ turn.swapaxes(-1, -2))

    def _why_no_log(self, x, y):
        return "the subspaces have a right angle between them, and more than one geodesic leads from x to y"


def _angle_over_sine(square):
    """``t / sin(t)`` for a square of ``sin(t/2)``, by its series where it is small; NaN at a right angle."""
    small = square < _MAX_SERIES_SINE_SQUARED
    series = jnp.polyval(jnp.asarray(_ANGLE_OVER_SINE_SERIES), jnp.where(small, square, 0.0))
    sine = jnp.where(small, 0.25, jnp.where(square < 0.5 - 0.5 * (math.pi / 2 * CUT_MARGIN), square, jnp.nan))
    cosine = 1.0 - sine
    return jnp.where(small, series, jnp.arctan2(jnp.sqrt(sine), jnp.sqrt(cosine)) / jnp.sqrt(sine * cosine))


def _commutator(a, b):
    return a @ b - b @ a
