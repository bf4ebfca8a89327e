"""Charts of state spaces, those of Stiefel manifolds among them, and retractions by name."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from .._pytree_module import forward_to
from ..errors import ParameterError, SpaceError
from ..groups.matrix_group import MEMBERSHIP_TOLERANCE, MatrixGroup
from ..matrices.exponential import cayley_of
from ..matrices.linear import solve
from ..matrices.symmetric import orthonormal_columns, polar
from ..spaces import GroupSpace
from ..spaces.base import Space
from ..spaces.stiefel import Stiefel
from .retraction import Chart, Retraction


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

    Parameters
    ----------
    space : Space
        The space of the points.
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

    Parameters
    ----------
    space : Space
        The space of the points.
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

    Parameters
    ----------
    space : Space
        The space of the points.
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


@jax.tree_util.register_static
@dataclass(frozen=True, repr=False)
class RiemannianRetraction(Chart):
    """Retraction ``R_h(z, v) = (z, exp_z(h v))`` by the Riemannian exponential map of the space [BFM §4.4].

    It exists on every space that has geodesics. The domain is the ball of the injectivity radius.

    Parameters
    ----------
    space : Space
        The space of the points.
    """

    space: Space

    order = math.inf

    _point = forward_to("space", "_exp")
    _vector = forward_to("space", "_log")
    _middle = forward_to("space", "_midpoint")
    _carry = forward_to("space", "_transport")


@jax.tree_util.register_static
@dataclass(frozen=True, repr=False)
class EuclideanRetraction(Chart):
    """Retraction ``R_h(z, v) = (z, z + h v)`` on open sets of arrays: Euclidean spaces, SPD(n) and their products.

    On SPD(n) the step is bounded to length 1 in the affine-invariant metric, which guarantees that z + h v is positive
    definite.

    Parameters
    ----------
    space : Space
        The space of the points.
    """

    space: Space

    @property
    def order(self):
        return math.inf if self.space.exp_is_group_exp else 1

    def _point(self, z, v):
        return z + v

    def _vector(self, z, x):
        return x - z

    def _middle(self, x, y):
        return 0.5 * (x + y)

    def _carry(self, z, v, u):
        return u + jnp.zeros_like(v)

    _reach = forward_to("space", "_euclidean_reach")

    def _midpoint_reach(self, z, v):
        return 0.5 * self.space._euclidean_reach(z, v)


@jax.tree_util.register_static
@dataclass(frozen=True, repr=False)
class ProjectionRetraction(Chart):
    """Retraction ``R_h(z, v) = (z, project(z + h v))``, on every space, with geodesics or without.

    Newton's method in the frame of z computes its inverse. The order is one with any projection, and two with the
    nearest point [Absil & Malick 2012].

    Parameters
    ----------
    space : Space
        The space of the points.
    """

    space: Space

    order = 1

    def _point(self, z, v):
        return self.space._project(z + v)

    def _vector(self, z, x):
        space = self.space
        z, x = jnp.broadcast_arrays(z, x)

        def residual(c):
            return self._point(z, space._from_coordinates(z, c)) - x

        def newton_step(_, c):
            residual_value, push_forward = jax.linearize(residual, c)
            axes = jnp.broadcast_to(jnp.eye(space.dim), (*c.shape, space.dim))
            columns = jax.vmap(lambda axis: space._coordinates(z, push_forward(axis)), in_axes=-1, out_axes=-1)(axes)
            return c - solve(columns, space._coordinates(z, residual_value)[..., None])[..., 0]

        c = jax.lax.fori_loop(
            0, _MAX_NEWTON_STEPS, newton_step, space._coordinates(z, space._project_tangent(z, x - z))
        )
        defect = jnp.abs(residual(c)).max(axis=space._axes, keepdims=True)
        scale = jnp.maximum(jnp.abs(x).max(axis=space._axes, keepdims=True), 1.0)
        return jnp.where(defect <= MEMBERSHIP_TOLERANCE * scale, space._from_coordinates(z, c), jnp.nan)


_MAX_NEWTON_STEPS = 8
"""Number of Newton steps for the inverse of a projection."""


class _GroupChart(Chart):
    """Chart of a group, whose vectors are carried by left translation."""

    def _middle(self, x, y):
        return self.space._group_exp(x, 0.5 * self.space._group_log(x, y))

    def _carry(self, z, v, u):
        return self.space._left_translate(z, self._point(z, v), u)


@jax.tree_util.register_static
@dataclass(frozen=True, repr=False)
class GroupRetraction(_GroupChart):
    """Retraction ``R_h(z, v) = (z, z exp(h z^-1 v))`` by the group exponential, on groups and their products.

    On SO(n) and SU(n) it is the Riemannian retraction, and on a GroupSpace that of the space. On SE(n) it follows screw
    motions, which agree with geodesics to first order.

    Parameters
    ----------
    space : Space
        The space of the points.
    """

    space: Space

    @property
    def order(self):
        return math.inf if self.space.exp_is_group_exp else 1

    _point = forward_to("space", "_group_exp")
    _vector = forward_to("space", "_group_log")


@jax.tree_util.register_static
@dataclass(frozen=True, repr=False)
class CayleyRetraction(_GroupChart):
    """Retraction ``R_h(z, v) = (z, z cayley(h z^-1 v))``, on groups that Cayley's map stays in, and their products.

    It is rational, so cheaper than the exponential, and one to one on the whole tangent space, which covers the group
    except the half turns. With z in the middle, a step is bounded by 4/pi of the injectivity radius: there it is a half
    turn.

    Parameters
    ----------
    space : Space
        The space of the points.
    """

    space: Space

    @property
    def order(self):
        return 2 if self.space.exp_is_group_exp else 1

    _point = forward_to("space", "_cayley")
    _vector = forward_to("space", "_inverse_cayley")

    def _reach(self, z, v):
        return 0.0 * self.space._reach(z, v)

    def _midpoint_reach(self, z, v):
        return math.pi / 4.0 * self.space._reach(z, v)


@jax.tree_util.register_static
@dataclass(frozen=True, repr=False)
class MidpointRetraction(Retraction):
    """Retraction ``R_h(z, v) = (point(z, -h v/2), point(z, h v/2))``, with z in the middle of the step [BFM 4.8].

    With the Riemannian chart this is the paper's ``exp~_h``, and z is the midpoint of the geodesic from x to y.

    Parameters
    ----------
    chart : Chart
        The chart in which steps are taken.
    """

    chart: Chart
    symmetric = True

    def __post_init__(self):
        if not isinstance(self.chart, Chart):
            raise SpaceError(
                "MidpointRetraction(chart): chart must be a Chart, such as RiemannianRetraction(space), got "
                f"{self.chart!r}"
            )

    space = forward_to("chart")
    order = forward_to("chart")

    def _end_points(self, z, v):
        return self.chart._point(z, -0.5 * v), self.chart._point(z, 0.5 * v)

    def _base_and_vector(self, x, y):
        z = self.chart._middle(x, y)
        return z, self.chart._vector(z, y) - self.chart._vector(z, x)

    _reach = forward_to("chart", "_midpoint_reach")

    def __repr__(self) -> str:
        return f"MidpointRetraction({self.chart!r})"


RETRACTIONS: dict[str, Callable[[Space], Retraction]] = {
    "midpoint": lambda space: MidpointRetraction(RiemannianRetraction(space)),
    "exp": RiemannianRetraction,
    "euclidean": EuclideanRetraction,
    "group_exp": GroupRetraction,
    "cayley": lambda space: StiefelCayleyRetraction(space) if isinstance(space, Stiefel) else CayleyRetraction(space),
    "qr": QRRetraction,
    "polar": PolarRetraction,
    "projection": ProjectionRetraction,
    "midpoint_euclidean": lambda space: MidpointRetraction(EuclideanRetraction(space)),
    "midpoint_group_exp": lambda space: MidpointRetraction(GroupRetraction(space)),
    "midpoint_cayley": lambda space: MidpointRetraction(CayleyRetraction(space)),
}
"""Constructor of each retraction by name."""


def retraction(space: Space | MatrixGroup, kind: str = "midpoint") -> Retraction:
    """Return a retraction of a space by name.

    Parameters
    ----------
    space : Space or MatrixGroup
        A group stands for ``GroupSpace(group)``.
    kind : str
        ``"midpoint"`` is the paper's (4.8), with the Riemannian chart. ``"exp"``, ``"euclidean"``, ``"group_exp"``,
        ``"cayley"`` and ``"projection"`` have their base point at the start of the step, and so do ``"qr"`` and
        ``"polar"`` of Stiefel manifolds; ``"midpoint_euclidean"``,
        ``"midpoint_group_exp"`` and ``"midpoint_cayley"`` have it in the middle.

    Raises
    ------
    SpaceError
        If the space does not have what it takes, such as a group structure or geodesics.
    LieAlgebraError
        If Cayley's map leaves the group.
    ParameterError

    Examples
    --------
    >>> sphere = mf.Sphere(2)
    >>> chart = mf.retraction(sphere, "projection")
    >>> z = sphere.point([0.0, 0.0, 1.0])
    >>> bool(sphere.belongs(chart.point(z, jnp.array([0.3, 0.1, 0.0]))))
    True
    """
    space = GroupSpace(space) if isinstance(space, MatrixGroup) else space
    if kind not in RETRACTIONS:
        raise ParameterError(f"kind must be one of {', '.join(RETRACTIONS)}, got {kind!r}")
    return RETRACTIONS[kind](space)
