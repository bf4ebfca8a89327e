"""Discrete simple systems: finite difference maps, and the discrete Lagrangian, forces and constraint.

The step equations use a pair (q_0, q_1, S_0, S_1) in the coordinates (q_0, V, S_0, s), with the difference quotients
``V = (q_1 - q_0)/h`` and ``s = (S_1 - S_0)/h``: differences of nearby positions would lose digits.
"""

from __future__ import annotations

import functools
import operator
from collections.abc import Iterator
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import manifolds as mf
from manifolds._pytree_module import Module

from ...errors import InputError
from ...functions.newton import newton_iterate
from ...functions.surface import ConstraintSurface
from ...systems import SimpleClosedSystem

NEWTON_STEPS = 12
"""Number of Newton steps to an end entropy or to the next pair of points; they converge quadratically."""


class FiniteDifference(Module):
    """Finite difference map of the alpha family, given by its q-, v- and S-representatives [GBY 3.5, §5.1].

        phi(q_0, q_1, S_0, S_1) = ((1 - alpha) q_0 + alpha q_1, V; (1 - beta) S_0 + beta S_1, s)

    Forces act where q is represented, ``F^-_d = h (1 - alpha) F`` and ``F^+_d = h alpha F``. On a manifold q moves from
    q_0 to q_1 on a curve, :class:`Curve`, of which alpha is the parameter.

    A subclass may represent a pair otherwise: it gives :meth:`position`, :meth:`velocity` or :meth:`entropy`, with
    ``phi(q, q, S, S) = (q, 0; S, 0)``, and says whether it ``is_symmetric`` under exchange of the two points.

    Parameters
    ----------
    alpha : float
        0 to 1.
    beta : float, optional
        0 to 1; alpha by default.
    weight : float, > 0
        Weight of the map in the mean of several maps.
    """

    alpha: float = eqx.field(static=True)
    beta: float = eqx.field(static=True)
    weight: float = eqx.field(static=True)

    def __init__(self, alpha: float, beta: float | None = None, weight: float = 1.0):
        beta = alpha if beta is None else beta
        for name, value in (("alpha", alpha), ("beta", beta)):
            if not isinstance(value, int | float | np.number) or not 0.0 <= value <= 1.0:
                raise InputError(f"{name} must be between 0 and 1, got {value!r}")
        if not isinstance(weight, int | float | np.number) or not 0.0 < weight < np.inf:
            raise InputError(f"the weight of a finite difference map must be > 0 and finite, got {weight!r}")
        self.alpha, self.beta, self.weight = float(alpha), float(beta), float(weight)

    def position(self, q0, V, h) -> jax.Array:
        """Return the position at the map's point, shape (n,), from ``V = (q_1 - q_0) / h``."""
        return q0 + (self.alpha * h) * V

    def velocity(self, q0, V, h) -> jax.Array:
        """Return the velocity at the map's point, shape (n,), from ``V = (q_1 - q_0) / h``."""
        del q0, h
        return V

    def entropy(self, S0, s, h) -> jax.Array:
        """Return the entropy at the map's point between two entropies; a time is interpolated by the same formula."""
        return S0 + (self.beta * h) * s

    def reversed_map(self) -> FiniteDifference | None:
        """Return the map that represents the pair backward in time as this one does forward; None if unknown."""
        if type(self) is not FiniteDifference:
            return self if self.is_symmetric else None
        return FiniteDifference(1.0 - self.alpha, 1.0 - self.beta, self.weight)

    @property
    def is_symmetric(self) -> bool:
        """True if the map represents (q_1, q_0, S_1, S_0) backward in time as it does (q_0, q_1, S_0, S_1)."""
        return type(self) is FiniteDifference and self.alpha == self.beta == 0.5


class Curve(Module):
    """A curve on a space from q_0 to q_1, with parameter 0 to 1, at which finite difference maps are evaluated.

    Without a chart it is the chord in the arrays around, projected onto the space by Newton's method, and as symmetric
    as a chord. With a chart it is the image of a straight line, ``point(q_0, alpha vector(q_0, q_1))``: for the
    Riemannian chart the geodesic.
    """

    space: mf.Space = eqx.field(static=True)
    chart: mf.Chart | None = eqx.field(static=True, default=None)

    def position_and_velocity(self, alpha: float, q0, V, h) -> tuple[jax.Array, jax.Array]:
        """Return the point of the curve at alpha and its velocity, shape (n,) each, from ``V = (q_1 - q_0) / h``."""
        vector, point = self.space.to_vector, self.space.from_vector
        if self.chart is None:
            return jax.jvp(self._project_to_space, (q0 + (alpha * h) * V,), (V,))
        start, chart = point(q0), self.chart
        w = chart._vector(start, point(q0 + h * V))
        q, v = jax.jvp(lambda a: chart._point(start, a * w), (jnp.asarray(alpha),), (1.0 / h,))
        return vector(q), vector(v)

    def _project_to_space(self, q) -> jax.Array:
        """Return the point of the space next to the array q, shape (n,), by Newton's method."""
        point = self.space.from_vector(q)
        for _ in range(PROJECTION_NEWTON_STEPS):
            point = self.space._restore(point)
        return self.space.to_vector(point)


PROJECTION_NEWTON_STEPS = 3
"""Newton steps from a chord to the space: each squares the distance, relative to the curvature."""


class MapPoint(NamedTuple):
    """A finite difference map at a pair: its weight in the mean, and the arguments (q, v, S, t) of the functions."""

    map: FiniteDifference
    weight: float
    q: jax.Array
    v: jax.Array
    S: jax.Array
    t: jax.Array


class Pair(NamedTuple):
    """A pair of points in the coordinates of the step equations: (q_0, V, S_0, s)."""

    q0: jax.Array
    V: jax.Array
    S0: jax.Array
    s: jax.Array


class DiscreteSystem(Module):
    """A discrete thermodynamical system [GBY 3.2]: ``L_d``, ``F_d``, ``P_d`` of one step.

    Attributes
    ----------
    system : SimpleClosedSystem
    lagrangian_maps, force_maps, constraint_maps : tuple of FiniteDifference
    h : step (time)
    t : time at its start
    curve : Curve, optional
        On a manifold.
    """

    system: SimpleClosedSystem
    lagrangian_maps: tuple[FiniteDifference, ...]
    force_maps: tuple[FiniteDifference, ...]
    constraint_maps: tuple[FiniteDifference, ...]
    h: jax.Array
    t: jax.Array
    curve: Curve | None = None

    # -- in difference quotients, per unit of time ------------------------------------------------------------------

    def _points_of_maps(self, maps, pair: Pair) -> Iterator[MapPoint]:
        """Yield the point at which each map evaluates the functions, with its weight in the mean."""
        total = sum(map.weight for map in maps)
        for map in maps:
            q, v = self._position_and_velocity(map, pair.q0, pair.V)
            S, t = map.entropy(pair.S0, pair.s, self.h), map.entropy(self.t, 1.0, self.h)
            yield MapPoint(map, map.weight / total, q, v, S, t)

    def _position_and_velocity(self, map: FiniteDifference, q0, V) -> tuple[jax.Array, jax.Array]:
        if self.curve is None:
            return map.position(q0, V, self.h), map.velocity(q0, V, self.h)
        return self.curve.position_and_velocity(map.alpha, q0, V, self.h)

    def _split_force_between_ends(self, map: FiniteDifference, pair: Pair, F) -> tuple[jax.Array, jax.Array]:
        """Return the forces ``D_1 q·F`` on q_0 and ``D_2 q·F`` on q_1 that represent a force F at the map's point."""
        if self.curve is None and type(map).position is FiniteDifference.position:
            return (1.0 - map.alpha) * F, map.alpha * F
        _, pullback = jax.vjp(lambda q0, V: self._position_and_velocity(map, q0, V)[0], pair.q0, pair.V)
        force_on_q0, force_on_V = pullback(F)  # V grows with q_1 at fixed q_0, at the rate 1/h
        return force_on_q0 - force_on_V / self.h, force_on_V / self.h

    def mean_lagrangian(self, q0, V, S0, s) -> jax.Array:
        """Return ``L_d / h``, the weighted mean of the Lagrangian at the points of ``lagrangian_maps``."""
        points = self._points_of_maps(self.lagrangian_maps, Pair(q0, V, S0, s))
        return _sum_arrays([p.weight * self.system.lagrangian_value(p.q, p.v, p.S) for p in points])

    def mean_end_forces(self, pair: Pair, friction: bool = True, external: bool = True) -> tuple[jax.Array, jax.Array]:
        """Return the forces at the two ends of a step, ``F^-_d / h`` and ``F^+_d / h``, shape (n,) each."""
        force_at_start = force_at_end = jnp.zeros_like(pair.V)
        for p in self._points_of_maps(self.force_maps, pair):
            F = jnp.zeros_like(p.v)
            F = F + self.system.friction_force(*p[2:]) if friction else F
            F = F + self.system.external_force(*p[2:]) if external else F
            force_minus, force_plus = self._split_force_between_ends(p.map, pair, p.weight * F)
            force_at_start, force_at_end = force_at_start + force_minus, force_at_end + force_plus
        return force_at_start, force_at_end

    def start_momentum_residual(self, p0, pair: Pair) -> jax.Array:
        """Return the residual of ``p_0 = -D_1 L_d - F^-_d``, (3.12) with the momentum of the last step, shape (n,)."""
        dL_dq, dL_dV = jax.grad(self.mean_lagrangian, argnums=(0, 1))(*pair)
        return p0 - dL_dV + self.h * (dL_dq + self.mean_end_forces(pair)[0])

    def motion_residual(self, p0, pair: Pair, mass: float | jax.Array = 1.0) -> jax.Array:
        """Return the momentum residual, shape (n,); on a manifold along Q, plus the distance of q_1 from Q.

        The distance is multiplied by a ``mass`` of the size of L_vv, so that the sum is a momentum.
        """
        residual = self.start_momentum_residual(p0, pair)
        if self.curve is None:
            return residual
        surface = ConstraintSurface(self.curve.space, tangent=True)
        constraint_rate = surface._constraint_change(pair.q0, 0.0, self.h * pair.V) / self.h
        return self.system.tangential_part(pair.q0, residual) + mass * surface._correction_displacement(
            pair.q0, constraint_rate
        )

    def momentum_slope(self, p0, pair: Pair) -> jax.Array:
        """Return the slope of the momentum ``(p_1 - p_0) / h = (D_1 L_d + D_2 L_d + F^-_d + F^+_d) / h``, shape (n,).

        On a manifold it is the component tangent to the manifold.
        """
        force_at_start, force_at_end = self.mean_end_forces(pair)
        force = jax.grad(self.mean_lagrangian)(*pair) + (force_at_start + force_at_end)
        return force if self.curve is None else force - self.start_momentum_residual(p0, pair) / self.h

    def constraint_residual(self, pair: Pair) -> jax.Array:
        """Return the residual of the constraint, the mean of ``T s + F_fr . v - P_H``; NaN if T <= 0 [GBY 3.9]."""
        total = jnp.zeros(())
        for p in self._points_of_maps(self.constraint_maps, pair):
            T = -jax.grad(self.system.lagrangian_value, argnums=2)(p.q, p.v, p.S)
            power = jnp.dot(self.system.friction_force(*p[2:]), p.v) - self.system.heating(*p[2:])
            total = total + p.weight * (jnp.where(T > 0.0, T, jnp.nan) * pair.s + power)
        return total

    def work_and_heat_rates(self, pair: Pair) -> tuple[jax.Array, jax.Array]:
        """Return the work and the heat received from outside, per unit of time."""
        force_at_start, force_at_end = self.mean_end_forces(pair, friction=False)
        heat = _sum_arrays(
            [p.weight * self.system.heating(*p[2:]) for p in self._points_of_maps(self.constraint_maps, pair)]
        )
        return jnp.dot(force_at_start + force_at_end, pair.V), heat

    def energy(self, pair: Pair) -> jax.Array:
        """Return ``E = v . L_v - L``, the mean over the points of the discrete Lagrangian."""
        energy = self.system.contact.energy
        points = self._points_of_maps(self.lagrangian_maps, pair)
        return _sum_arrays([p.weight * energy(jnp.concatenate([p.q, p.v, p.S[None]])) for p in points])

    # -- as in the paper ----------------------------------------------------------------------------------------------

    def pair(self, q0, q1, S0, S1) -> Pair:
        """Return two points in the coordinates of the step equations, (q_0, V, S_0, s)."""
        return Pair(q0, (q1 - q0) / self.h, S0, (S1 - S0) / self.h)

    def lagrangian(self, q0, q1, S0, S1) -> jax.Array:
        """Return the discrete Lagrangian ``L_d`` of a step, shape () [GBY 3.10]."""
        return self.h * self.mean_lagrangian(*self.pair(q0, q1, S0, S1))

    def forces(self, q0, q1, S0, S1, friction: bool = True, external: bool = True) -> tuple[jax.Array, jax.Array]:
        """Return the discrete forces ``F^-_d`` and ``F^+_d``, impulses of shape (n,) each [GBY Definition 3.2]."""
        force_at_start, force_at_end = self.mean_end_forces(self.pair(q0, q1, S0, S1), friction, external)
        return self.h * force_at_start, self.h * force_at_end

    def constraint(self, q0, q1, S0, S1) -> jax.Array:
        """Return the value ``P_d`` of the discrete constraint, zero for a pair on ``C_K^d``, shape () [GBY 3.8]."""
        return -self.constraint_residual(self.pair(q0, q1, S0, S1))

    def momenta(self, q0, q1, S0, S1) -> tuple[jax.Array, jax.Array]:
        """Return p_0 and p_1 of the discrete Legendre transforms ``FL^-`` and ``FL^+`` with forces [GBY §4.2]."""
        dL_dq0, dL_dq1 = jax.grad(self.lagrangian, argnums=(0, 1))(q0, q1, S0, S1)
        force_minus, force_plus = self.forces(q0, q1, S0, S1)
        tangential_part = self.system.tangential_part
        return tangential_part(q0, -dL_dq0 - force_minus), tangential_part(q1, dL_dq1 + force_plus)

    def end_point_jacobian(self, q0, q1, S0, S1) -> jax.Array:
        """Return the Jacobian (3.13) of momentum and constraint by (q_1, S_1), shape (n + 1, n + 1).

        If it is invertible, the momentum and the constraint determine q_1 and S_1, and so the step.
        """

        def momentum_and_constraint(q1, S1):
            return -self.momenta(q0, q1, S0, S1)[0], self.constraint(q0, q1, S0, S1)

        (A, B), (C, D) = jax.jacfwd(momentum_and_constraint, argnums=(0, 1))(q1, S1)
        return jnp.block([[A, B[:, None]], [C[None], D[None, None]]])

    def reduced_regularity_matrix(self, q0, q1, S0, S1) -> jax.Array:
        """Return the Schur complement (3.15) of the Jacobian (3.13), with S_1 eliminated, shape (n, n).

        (3.13) is invertible if (3.15) is, and ``D_4 P_d`` is not zero.
        """
        matrix = self.end_point_jacobian(q0, q1, S0, S1)
        return matrix[:-1, :-1] - jnp.outer(matrix[:-1, -1], matrix[-1, :-1]) / matrix[-1, -1]

    def end_entropy_on_constraint(self, q0, q1, S0) -> jax.Array:
        """Return S_1 with ``P_d(q_0, q_1, S_0, S_1) = 0``, after NEWTON_STEPS Newton steps; it is differentiable."""
        V = (q1 - q0) / self.h
        return S0 + self.h * newton_iterate(
            lambda s: self.constraint_residual(Pair(q0, V, S0, s)), jnp.zeros(()), NEWTON_STEPS
        )

    def flow(
        self, q0, q1, S0, S1, newton_steps: int = NEWTON_STEPS
    ) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
        """Return (q_1, q_2, S_1, S_2), the discrete flow on ``C_K^d``, after ``newton_steps`` iterations [GBY 3.14]."""
        p1, start = self.momenta(q0, q1, S0, S1)[1], jnp.append((q1 - q0) / self.h, (S1 - S0) / self.h)

        def residual(y):
            pair = Pair(q1, y[:-1], S1, y[-1])
            return jnp.append(self.motion_residual(p1, pair), self.constraint_residual(pair))

        y = newton_iterate(residual, start, newton_steps)
        return q1, q1 + self.h * y[:-1], S1, S1 + self.h * y[-1]


def _sum_arrays(arrays: list[jax.Array]) -> jax.Array:
    return functools.reduce(operator.add, arrays)
