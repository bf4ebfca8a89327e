"""Surfaces on which the states of a system with constraints stay: a step ends on the surface on which it began."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Protocol

import jax
import jax.numpy as jnp
import numpy as np

import manifolds as mf

from ..tracing.interpret import polynomial_degree_bound

EPS = float(np.finfo(np.float64).eps)
"""Spacing of float64 numbers at 1."""

CONSTRAINT_RTOL = 1e-9
"""Largest violation of a constraint, relative to its rounding scale, at which Newton's method stops."""

MAX_NEWTON_STEPS = 5
"""Largest number of Newton steps: a short step needs two, and noise moves a state farther."""

MIN_CORRECTED_RTOL = 4.0 * EPS
"""Smallest violation of a constraint, relative to its rounding scale, that a step corrects."""

MAX_CORRECTED_RTOL = 8.0 * EPS
"""Largest correction of a constraint in one step, relative to its rounding scale."""


class Surface(Protocol):
    """The points at which a step may end. Displacements and directions are arrays of shape (n,).

    Attributes
    ----------
    name : str
        Name of the first integral that is conserved with the surface; "" if there is none.
    is_kept_by_collocation : bool
        Whether the steps of collocation methods end on the surface without projection.
    """

    @property
    def name(self) -> str: ...

    @property
    def is_kept_by_collocation(self) -> bool: ...

    def project_direction(self, x, v) -> jax.Array:
        """Return the direction v of a correction, projected onto the tangent space of the surface."""
        ...

    def project_displacement(self, x, compensation, d) -> tuple[jax.Array, jax.Array]:
        """Return the displacement near d that ends on the surface, and the distance by which it fails to."""
        ...

    def correct_rounding(self, x, compensation) -> tuple[jax.Array, jax.Array]:
        """Return the pair (state, compensation) with rounding errors corrected after a step; NaN outside of the
        domain."""
        ...


@jax.tree_util.register_static
@dataclass(frozen=True)
class ConstraintSurface:
    """The level sets of the constraints of a space, of which the first components of a state are a point.

    Attributes
    ----------
    space : manifolds.Space
    tangent : bool
        Whether the motion is tangent to the level sets of the constraints near the space too.
    """

    space: mf.Space
    tangent: bool
    name = ""

    @property
    def is_kept_by_collocation(self) -> bool:
        """True if the constraints are at most quadratic first integrals, which collocation conserves."""
        return self.tangent and _constraint_degree(self.space) <= 2

    def project_direction(self, x, v) -> jax.Array:
        """Return v: gradients that are raised in the surrounding space are tangent already."""
        return v

    def project_displacement(self, x, compensation, d) -> tuple[jax.Array, jax.Array]:
        """Return the displacement projected by Newton's method, and the distance by which it still misses the
        surface."""
        if _constraint_count(self.space) == 0:
            return d, jnp.zeros(())

        def newton_step_and_error(d) -> tuple[jax.Array, jax.Array]:
            change, end = self._constraint_change(x, compensation, d), x + (compensation + d)
            constraint_error = jnp.max(
                jnp.abs(change) / (self.space._constraint_rounding_scales(self._point(end)) + TINY)
            )
            return d - self._correction_displacement(end, change), constraint_error

        def iterate(carry, _):
            return jax.lax.cond(
                carry[1] <= CONSTRAINT_RTOL, lambda: carry, lambda: newton_step_and_error(carry[0])
            ), None

        if _constraint_degree(self.space) <= 1:
            return newton_step_and_error(d)[0], jnp.zeros(())
        (d, constraint_error), _ = jax.lax.scan(iterate, (d, jnp.asarray(jnp.inf)), length=MAX_NEWTON_STEPS)
        return d, jnp.where(constraint_error <= CONSTRAINT_RTOL, 0.0, constraint_error) * jnp.linalg.norm(x)

    def correct_rounding(self, x, compensation) -> tuple[jax.Array, jax.Array]:
        if _constraint_count(self.space) == 0:
            return jnp.where(self.is_in_space(x), x, jnp.nan), compensation
        point = self._point(x)
        values, slopes = jax.jvp(self.space._constraints, (point,), (self._point(compensation),))
        scale, violation = self.space._constraint_rounding_scales(point), values + slopes
        violation = jnp.where(
            jnp.abs(violation) > MIN_CORRECTED_RTOL * scale,
            jnp.clip(violation, -MAX_CORRECTED_RTOL * scale, MAX_CORRECTED_RTOL * scale),
            0.0,
        )
        return jnp.where(self.is_in_space(x), x, jnp.nan), compensation - self._correction_displacement(x, violation)

    def is_in_space(self, x) -> jax.Array:
        """Return whether a state that satisfies the equations of the space satisfies its inequalities too."""
        return self.space._inside(self._point(x))

    def project_state(self, x) -> jax.Array:
        """Return the state after one step of a projection onto the surface, for functions that are defined only
        there."""
        return (
            x
            if _constraint_count(self.space) == 0
            else x - self._correction_displacement(x, self.space._constraints(self._point(x)))
        )

    def _constraint_change(self, x, compensation, d) -> jax.Array:
        """Return the change of the constraints from x to x + d, by a quadrature that is exact up to degree ten.

        If its error exceeds rounding, in long steps with other constraints, the difference of values is returned.
        """
        nodes, weights = _gauss_rule(
            int(min(np.ceil(0.5 * max(_constraint_degree(self.space), 2)), MAX_QUADRATURE_NODES))
        )
        direction = self._point(d)
        rates = [
            jax.jvp(self.space._constraints, (self._point(x + (compensation + c * d)),), (direction,))[1] for c in nodes
        ]
        change = sum(w * rate for w, rate in zip(weights[1:], rates[1:], strict=True)) + weights[0] * rates[0]
        if _constraint_degree(self.space) <= 2 * MAX_QUADRATURE_NODES:
            return change
        end = self._point(x + (compensation + d))
        difference = self.space._constraints(end) - self.space._constraints(self._point(x + compensation))
        return jnp.where(
            jnp.abs(difference - change) > QUADRATURE_RTOL * self.space._constraint_rounding_scales(end),
            difference,
            change,
        )

    def _correction_displacement(self, x, constraint_change) -> jax.Array:
        """Return the displacement of x, shape (n,), that changes the constraints by ``constraint_change``."""
        v = self.space.to_vector(self.space._correction(self._point(x), constraint_change))
        return v if v.shape == x.shape else jnp.pad(v, (0, x.shape[0] - v.shape[0]))

    def _point(self, x) -> jax.Array:
        """Return the point of the space that the first components of a state hold."""
        return self.space.from_vector(x[: self.space.size])


TINY = float(np.finfo(np.float64).tiny)
"""Smallest normal float64 number, which keeps a divisor from vanishing."""

MAX_QUADRATURE_NODES = 5
"""Largest number of quadrature nodes, used for constraints of high degree; the error is O(h^11)."""

QUADRATURE_RTOL = 64.0 * EPS
"""Error of the quadrature, relative to the rounding scale of a constraint, above which values are subtracted."""


def _gauss_rule(n_nodes: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the nodes and weights of Gauss quadrature on [0, 1]."""
    nodes, weights = np.polynomial.legendre.leggauss(n_nodes)
    return 0.5 * (nodes + 1.0), 0.5 * weights


@functools.lru_cache
def _constraint_count(space: mf.Space) -> int:
    """Return the number of constraints of a space; zero for an open set."""
    return jax.eval_shape(space._constraints, jax.ShapeDtypeStruct(space.shape, space.dtype)).shape[-1]


@functools.lru_cache
def _constraint_degree(space: mf.Space) -> float:
    """Return the degree of the constraints as polynomials, or infinity."""
    if _constraint_count(space) == 0:
        return 0
    return polynomial_degree_bound(_weighted_constraint_sum, space, space.size)


def _weighted_constraint_sum(space: mf.Space, x):
    """Return a sum of the constraints of a space at a vector, with fixed weights that let no degrees cancel."""
    values = space._constraints(space.from_vector(x))
    return jnp.sum(values * jnp.cos(jnp.arange(1.0, values.shape[-1] + 1.0)))
