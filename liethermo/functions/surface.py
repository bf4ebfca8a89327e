"""Where states have to stay that have equations of their own: a step ends on the surface that it began on."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Protocol

import jax
import jax.numpy as jnp
import numpy as np

import manifolds as mf

from ..tracing.interpret import polynomial_degree

EPS = float(np.finfo(np.float64).eps)

CONSTRAINT_RTOL = 1e-9
"""Largest change of a constraint, relative to the size at which it is rounded, that one more step takes off."""

MAX_NEWTON_STEPS = 5
"""Steps of Newton's method at most: a short step needs two, noise moves a state farther."""

MIN_CORRECTED_RTOL, MAX_CORRECTED_RTOL = 4.0 * EPS, 8.0 * EPS
"""What a constraint has to be off, relative to that size, for a step to take it back, and the most that one takes."""


class Surface(Protocol):
    """The points that a step may end at. Displacements are arrays of shape (n,), and so are directions.

    Attributes
    ----------
    name : str
        Of the first integral that is held with it; empty where there is none.
    is_kept_by_collocation : bool
        Whether the steps of collocation methods end on it by themselves.
    """

    @property
    def name(self) -> str: ...

    @property
    def is_kept_by_collocation(self) -> bool: ...

    def project_direction(self, x, v) -> jax.Array:
        """v, the direction of a correction, along the surface."""
        ...

    def project_displacement(self, x, compensation, d) -> tuple[jax.Array, jax.Array]:
        """The displacement that ends near where d does, on the surface; and the length by which it fails to."""
        ...

    def correct_rounding(self, x, compensation) -> tuple[jax.Array, jax.Array]:
        """A state x + compensation at the end of a step, less what rounding has moved it; NaN outside of the domain."""
        ...


@jax.tree_util.register_static
@dataclass(frozen=True)
class ConstraintSurface:
    """The first components of a state are a point of a space, on the levels of its constraints.

    Attributes
    ----------
    space : manifolds.Space
    tangent : bool
        Whether the motion is along the level sets of the constraints near the space too.
    """

    space: mf.Space
    tangent: bool
    name = ""

    @property
    def is_kept_by_collocation(self) -> bool:
        """Collocation keeps quadratic first integrals."""
        return self.tangent and _constraint_degree(self.space) <= 2

    def project_direction(self, x, v) -> jax.Array:
        """v itself: gradients that are raised in the space around are along it."""
        return v

    def project_displacement(self, x, compensation, d) -> tuple[jax.Array, jax.Array]:
        """By Newton's method, from what the constraints change by along d: as exact as d is small."""
        if _constraint_count(self.space) == 0:
            return d, jnp.zeros(())

        def newton_step(d) -> tuple[jax.Array, jax.Array]:
            change, end = self._constraint_change(x, compensation, d), x + (compensation + d)
            left = jnp.max(jnp.abs(change) / (self.space._constraint_scales(self._point(end)) + TINY))
            return d - self._correction_displacement(end, change), left

        def iterate(carry, _):
            return jax.lax.cond(carry[1] <= CONSTRAINT_RTOL, lambda: carry, lambda: newton_step(carry[0])), None

        if _constraint_degree(self.space) <= 1:
            return newton_step(d)[0], jnp.zeros(())
        (d, left), _ = jax.lax.scan(iterate, (d, jnp.asarray(jnp.inf)), length=MAX_NEWTON_STEPS)
        return d, jnp.where(left <= CONSTRAINT_RTOL, 0.0, left) * jnp.linalg.norm(x)

    def correct_rounding(self, x, compensation) -> tuple[jax.Array, jax.Array]:
        if _constraint_count(self.space) == 0:
            return jnp.where(self.is_in_space(x), x, jnp.nan), compensation
        point = self._point(x)
        values, slopes = jax.jvp(self.space._constraints, (point,), (self._point(compensation),))
        size, off = self.space._constraint_scales(point), values + slopes
        off = jnp.where(
            jnp.abs(off) > MIN_CORRECTED_RTOL * size,
            jnp.clip(off, -MAX_CORRECTED_RTOL * size, MAX_CORRECTED_RTOL * size),
            0.0,
        )
        return jnp.where(self.is_in_space(x), x, jnp.nan), compensation - self._correction_displacement(x, off)

    def is_in_space(self, x) -> jax.Array:
        """Whether a state on the surface is in the space."""
        return self.space._inside(self._point(x))

    def project_state(self, x) -> jax.Array:
        """A state nearer to the surface, for functions that are defined on it alone."""
        return (
            x
            if _constraint_count(self.space) == 0
            else x - self._correction_displacement(x, self.space._constraints(self._point(x)))
        )

    def _constraint_change(self, x, compensation, d) -> jax.Array:
        """What the constraints change by along d, by a quadrature that is exact for polynomials of degree ten.

        Where it misses more than rounding, in long steps on other constraints, it is the difference of their values.
        """
        nodes, weights = _gauss_rule(
            int(min(np.ceil(0.5 * max(_constraint_degree(self.space), 2)), MAX_QUADRATURE_NODES))
        )
        way = self._point(d)
        rates = [jax.jvp(self.space._constraints, (self._point(x + (compensation + c * d)),), (way,))[1] for c in nodes]
        change = sum(w * rate for w, rate in zip(weights[1:], rates[1:], strict=True)) + weights[0] * rates[0]
        if _constraint_degree(self.space) <= 2 * MAX_QUADRATURE_NODES:
            return change
        end = self._point(x + (compensation + d))
        difference = self.space._constraints(end) - self.space._constraints(self._point(x + compensation))
        return jnp.where(
            jnp.abs(difference - change) > QUADRATURE_RTOL * self.space._constraint_scales(end), difference, change
        )

    def _correction_displacement(self, x, c) -> jax.Array:
        """The displacement, shape (n,), that changes the constraints by c."""
        v = self.space.to_vector(self.space._correction(self._point(x), c))
        return v if v.shape == x.shape else jnp.pad(v, (0, x.shape[0] - v.shape[0]))

    def _point(self, x) -> jax.Array:
        return self.space.from_vector(x[: self.space.size])


TINY = float(np.finfo(np.float64).tiny)

MAX_QUADRATURE_NODES = 5
"""Nodes of the quadrature for constraints of higher degree: it misses the eleventh power of the step."""

QUADRATURE_RTOL = 64.0 * EPS
"""What it misses, relative to the size at which a constraint is rounded, beyond the rounding of differences."""


def _gauss_rule(number: int) -> tuple[np.ndarray, np.ndarray]:
    """Gauss' quadrature on [0, 1]."""
    nodes, weights = np.polynomial.legendre.leggauss(number)
    return 0.5 * (nodes + 1.0), 0.5 * weights


@functools.lru_cache
def _constraint_count(space: mf.Space) -> int:
    """How many constraints there are: none in an open set."""
    return jax.eval_shape(space._constraints, jax.ShapeDtypeStruct(space.shape, space.dtype)).shape[-1]


@functools.lru_cache
def _constraint_degree(space: mf.Space) -> float:
    """The degree of the constraints as polynomials; infinity where they are none."""
    if _constraint_count(space) == 0:
        return 0
    return polynomial_degree(_combine_constraints, space, space.size)


def _combine_constraints(space: mf.Space, x):
    values = space._constraints(space.from_vector(x))
    return jnp.sum(values * jnp.cos(jnp.arange(1.0, values.shape[-1] + 1.0)))
