"""Tangent bundle of a state space: positions with their velocities, or with their momenta."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp

from .._pytree_module import forward_to
from ..errors import SpaceError
from ..matrices.linear import solve_near_identity
from .base import Space, random_key, register
from .constant_curvature import Sphere


@register((Sphere(2),))
@jax.tree_util.register_static
@dataclass(frozen=True, repr=False)
class TangentBundle(Space):
    """Pairs (q, v) of a point of a space and a tangent vector there, shape ``(2, *base.shape)``.

    It represents the cotangent bundle too: a covector p at q is paired with tangent vectors by ``sum(p * v)``, and
    among
    the arrays with equal products the tangent one is taken. In these arrays the form ``p dq`` is the
    canonical one of T*Q. The metric is that of the ambient arrays.

    Parameters
    ----------
    base : Space
        Space of real arrays.
    """

    base: Space

    def __post_init__(self):
        if not isinstance(self.base, Space):
            raise SpaceError(f"TangentBundle(base): base must be a state space, got {type(self.base).__name__}")
        if self.base.dtype.kind == "c":
            raise SpaceError(
                f"TangentBundle(base): base must be a space of real arrays, but {self.base.name} is complex"
            )

    @property
    def name(self):
        return f"T {self.base.name}"

    @property
    def dim(self):
        return 2 * self.base.dim

    @property
    def shape(self):
        return (2, *self.base.shape)

    can_be_embedded = forward_to("base")
    is_smooth = forward_to("base")
    _has_equations = forward_to("base")

    def tangential_part(self, q, w) -> jax.Array:
        """Return the projection of the flat array w on the tangent space at the flat point q, shape (n,)."""
        base = self.base
        return base.to_vector(base._tangential_part(base.from_vector(q), base.from_vector(w)))

    def tangent_matrices(self, x) -> tuple[jax.Array, jax.Array]:
        """Return matrices P and N, shape (n, n), for which ``(P a, P b + N P a)`` are tangent vectors at flat (q, v).

        P is the projector along Q. Moving q takes v out of the tangent space: ``N q'`` is the component of v' across Q
        that
        compensates for it.
        """
        base, (q, v) = self.base, self._position_and_vector(self.from_vector(x))
        rate_jacobian = jax.jacfwd(lambda y: self._constraint_rates(base.from_vector(y), v))(base.to_vector(q))
        if not self._has_equations:
            P = jax.vmap(lambda w: self.tangential_part(x[: base.size], w), out_axes=1)(jnp.eye(base.size))
            return P, -rate_jacobian
        rows = base._constraint_jacobian(q)
        pseudo_inverse = solve_near_identity(rows @ rows.T, rows).T
        return jnp.eye(base.size) - pseudo_inverse @ rows, -pseudo_inverse @ rate_jacobian

    # -- maps ---------------------------------------------------------------------------------------------------------

    def _constraint_rates(self, q, v):
        """Return the rates of the constraints of Q along v, shape (..., m), which vanish if v is tangent."""
        if self._has_equations:
            return jax.jvp(self.base._constraints, (q,), (v,))[1]
        return self.base.to_vector(v - self.base._tangential_part(q, v))

    def _constraints(self, x):
        q, v = self._position_and_vector(x)
        return jnp.concatenate([self.base._constraints(q), self._constraint_rates(q, v)], axis=-1)

    def _minimal_correction(self, x, constraint_change):
        if self._has_equations:
            return super()._minimal_correction(x, constraint_change)
        return self.from_vector(constraint_change)

    def _inside(self, x):
        return self.base._inside(self._position_and_vector(x)[0])

    def _project(self, x):
        q, v = self._position_and_vector(x)
        q = self.base._project(q)
        return self._stack_pair(q, self.base._project_tangent(q, v))

    def _random(self, key, size):
        point_key, vector_key = jax.random.split(random_key(key))
        q = self.base._random(point_key, size)
        return self._stack_pair(q, self.base._project_tangent(q, jax.random.normal(vector_key, q.shape)))

    def _project_tangent(self, x, w):
        return self._tangential_part(x, w) if self._has_equations else super()._project_tangent(x, w)

    def _sharp(self, x, alpha):
        return self._project_tangent(x, alpha)

    def _metric_covector(self, x, v):
        return v + jnp.zeros_like(x)

    # -- helpers ------------------------------------------------------------------------------------------------------

    def _position_and_vector(self, x):
        axis = -1 - len(self.base.shape)
        return tuple(jnp.take(x, i, axis=axis) for i in (0, 1))

    def _stack_pair(self, q, v):
        return jnp.stack(jnp.broadcast_arrays(q, v), axis=-1 - len(self.base.shape))
