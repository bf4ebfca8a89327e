"""Charts of Stiefel manifolds: by the QR decomposition, by the polar decomposition, and Cayley's.

All three are one to one on the whole tangent space, and their inverses have closed forms.
"""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from ..errors import SpaceError
from ..matrices.exponential import cayley_of
from ..matrices.linear import solve
from ..matrices.symmetric import orthonormal_columns, polar
from ..spaces.base import Space
from ..spaces.stiefel import Stiefel
from .retraction import Chart


class _StiefelChart(Chart):
    """Chart of a Stiefel manifold whose inverse has no bound on the length of the vector."""

    space: Space

    def __post_init__(self):
        if not isinstance(self.space, Stiefel):
            raise SpaceError(f"{type(self).__name__}(space): space must be mf.Stiefel(n, p), got {self.space!r}")
        super().__post_init__()

    def _reach(self, z, v):
        return 0.0 * self.space._reach(z, v)


@jax.tree_util.register_static
@dataclass(frozen=True, repr=False)
class QRRetraction(_StiefelChart):
    """Retraction ``R_h(z, v) = (z, Q)`` with ``z + h v = Q R``, R upper triangular with a positive diagonal.

    Its order is 1, and it is the cheapest chart of a Stiefel manifold. The inverse solves p triangular sets of linear
    equations [Kaneko, Fiori & Tanaka 2013].
    """

    space: Space

    order = 1

    def _point(self, z, v):
        return orthonormal_columns(z + v)

    def _vector(self, z, x):
        M, p = _transpose(z) @ x, x.shape[-1]
        columns: list[jax.Array] = []
        for j in range(p):  # M R + (M R)^T = 2 I, column by column of R
            above = [-(M[..., j, : i + 1] * columns[i][..., : i + 1]).sum(-1) for i in range(j)]
            values = jnp.stack([*above, jnp.ones(M.shape[:-2])], axis=-1)
            column = solve(M[..., : j + 1, : j + 1], values[..., None])[..., 0]
            columns.append(jnp.concatenate([column, jnp.zeros((*M.shape[:-2], p - j - 1))], axis=-1))
        R = jnp.stack(columns, axis=-1)
        diagonal = jnp.diagonal(R, axis1=-2, axis2=-1)
        return jnp.where((diagonal > 0.0).all(axis=-1)[..., None, None], x @ R - z, jnp.nan)


@jax.tree_util.register_static
@dataclass(frozen=True, repr=False)
class PolarRetraction(_StiefelChart):
    """Retraction to the nearest point: ``R_h(z, v) = (z, U)`` with ``z + h v = U S``, S symmetric positive definite.

    Its order is 1 in the canonical metric, and 2 in the metric of the surrounding matrices. The inverse solves a
    Lyapunov equation of p rows.
    """

    space: Space

    order = 1

    def _point(self, z, v):
        return polar(z + v)

    def _vector(self, z, x):
        M, p = _transpose(z) @ x, x.shape[-1]
        identity = np.eye(p)
        operator = jnp.einsum("...ij,kl->...ikjl", M, identity) + jnp.einsum("ij,...kl->...ikjl", identity, M)
        target = jnp.broadcast_to(2.0 * identity.reshape(p * p, 1), (*M.shape[:-2], p * p, 1))
        S = solve(operator.reshape(*M.shape[:-2], p * p, p * p), target).reshape(M.shape)
        S = 0.5 * (S + _transpose(S))
        is_positive = jnp.isfinite(jnp.linalg.cholesky(S)).all(axis=(-2, -1))
        return jnp.where(is_positive[..., None, None], x @ S - z, jnp.nan)


@jax.tree_util.register_static
@dataclass(frozen=True, repr=False)
class StiefelCayleyRetraction(_StiefelChart):
    """Retraction ``R_h(z, v) = (z, (I - h W/2)^-1 (I + h W/2) z)``, W the least skew matrix with ``W z = v``.

    Its order is 2 in the canonical metric [Wen & Yin 2013]. The inverse is
    ``2 x (I + z^T x)^-1 + 2 z (I + x^T z)^-1 - 2 z`` [Zhu & Sato 2020].
    """

    space: Stiefel

    order = 2

    def _point(self, z, v):
        return cayley_of(self.space._least_skew_generator(z, v)) @ z

    def _vector(self, z, x):
        z, x = jnp.broadcast_arrays(z, x)
        sum_matrix = np.eye(x.shape[-1]) + _transpose(z) @ x
        right = _transpose(solve(_transpose(sum_matrix), _transpose(x)))
        left = _transpose(solve(sum_matrix, _transpose(z)))
        return 2.0 * (right + left - z)


def _transpose(a):
    return a.swapaxes(-1, -2)
