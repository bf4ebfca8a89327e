"""Discrete simple systems: finite difference maps, and what they make of a Lagrangian, of forces and of the constraint.

A pair (q_0, q_1, S_0, S_1) is given to the step equations in the coordinates (q_0, V, S_0, s) with the difference
quotients ``V = (q_1 - q_0)/h``, ``s = (S_1 - S_0)/h``: differences of nearby positions would lose the digits that
the step is about.
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
from manifolds.matrices.linear import solve

from ...errors import InputError
from ...functions.surface import ConstraintSurface
from ...systems import SimpleClosedSystem


class FiniteDifference(Module):
    """The finite difference map of the alpha family, in the form of its q-, v- and S-representatives [GBY 3.5, §5.1].

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
        Beside other maps, with which a discretisation takes the mean of its values.
    """

    alpha: float = eqx.field(static=True)
    beta: float = eqx.field(static=True)
    weight: float = eqx.field(static=True)

    def __init__(self, alpha: float, beta: float | None = None, weight: float = 1.0):
        beta = alpha if beta is None else beta
        for name, value in (("alpha", alpha), ("beta", beta)):
            if not isinstance(value, int | float | np.number) or not 0.0 <= value <= 1.0:
                raise InputError(f"{name} says where between two points a map looks: from 0 to 1, not {value!r}")
        if not isinstance(weight, int | float | np.number) or not 0.0 < weight < np.inf:
            raise InputError(f"the weight of a finite difference map must be > 0 and finite, not {weight!r}")
        self.alpha, self.beta, self.weight = float(alpha), float(beta), float(weight)

    def position(self, q0, V, h) -> jax.Array:
        return q0 + (self.alpha * h) * V

    def velocity(self, q0, V, h) -> jax.Array:
        del q0, h
        return V

    def entropy(self, S0, s, h) -> jax.Array:
        """The entropy between two; a time between two is found in the same way."""
        return S0 + (self.beta * h) * s

    def reversed_map(self) -> FiniteDifference | None:
        """The map that represents (q_1, q_0, S_1, S_0) backward in time as this one does (q_0, …); None if unknown."""
        if type(self) is not FiniteDifference:
            return self if self.is_symmetric else None
        return FiniteDifference(1.0 - self.alpha, 1.0 - self.beta, self.weight)

    @property
    def is_symmetric(self) -> bool:
        """Whether it represents (q_1, q_0, S_1, S_0) backward in time as it does (q_0, q_1, S_0, S_1)."""
        return type(self) is FiniteDifference and self.alpha == self.beta == 0.5


class Curve(Module):
    """A curve on a space from q_0 to q_1, at the parameters 0 to 1: what finite difference maps are made of there.

    The chord in the arrays around, brought to the space by Newton's method: as symmetric as a chord. Or, with a chart,
    that which the chart makes of a straight line, ``point(q_0, alpha vector(q_0, q_1))``: of the Riemannian one the
    geodesic.
    """

    space: mf.Space = eqx.field(static=True)
    chart: mf.Chart | None = eqx.field(static=True, default=None)

    def position_and_velocity(self, alpha: float, q0, V, h) -> tuple[jax.Array, jax.Array]:
        """The point of the curve and its velocity there, from ``V = (q_1 - q_0) / h``; shape (n,) each."""
        vector, point = self.space.to_vector, self.space.from_vector
        if self.chart is None:
            return jax.jvp(self._project_to_space, (q0 + (alpha * h) * V,), (V,))
        start, chart = point(q0), self.chart
        w = chart._vector(start, point(q0 + h * V))
        q, v = jax.jvp(lambda a: chart._point(start, a * w), (jnp.asarray(alpha),), (1.0 / h,))
        return vector(q), vector(v)

    def _project_to_space(self, q) -> jax.Array:
        point = self.space.from_vector(q)
        for _ in range(PROJECTION_NEWTON_STEPS):
            point = self.space._restore(point)
        return self.space.to_vector(point)


PROJECTION_NEWTON_STEPS = 3
"""Steps of Newton's method from a chord to the space: each squares the distance, relative to the curvature."""


class MapPoint(NamedTuple):
    """What a map makes of a pair: its part in the mean, and the arguments of the functions."""

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

    def _map_points(self, maps, pair: Pair) -> Iterator[MapPoint]:
        total = sum(map.weight for map in maps)
        for map in maps:
            q, v = self._position_and_velocity(map, pair.q0, pair.V)
            S, t = map.entropy(pair.S0, pair.s, self.h), map.entropy(self.t, 1.0, self.h)
            yield MapPoint(map, map.weight / total, q, v, S, t)

    def _position_and_velocity(self, map: FiniteDifference, q0, V) -> tuple[jax.Array, jax.Array]:
        if self.curve is None:
            return map.position(q0, V, self.h), map.velocity(q0, V, self.h)
        return self.curve.position_and_velocity(map.alpha, q0, V, self.h)

    def _split_force(self, map: FiniteDifference, pair: Pair, F) -> tuple[jax.Array, jax.Array]:
        """A force at the representative, as one on q_0 and one on q_1: ``D_1 q·F``, ``D_2 q·F``."""
        if self.curve is None and type(map).position is FiniteDifference.position:
            return (1.0 - map.alpha) * F, map.alpha * F
        _, back = jax.vjp(lambda q0, V: self._position_and_velocity(map, q0, V)[0], pair.q0, pair.V)
        both, second = back(F)  # V grows with q_1 at fixed q_0, at the rate 1/h
        return both - second / self.h, second / self.h

    def action(self, q0, V, S0, s) -> jax.Array:
        """``L_d / h``."""
        points = self._map_points(self.lagrangian_maps, Pair(q0, V, S0, s))
        return _sum_arrays([p.weight * self.system.lagrangian_value(p.q, p.v, p.S) for p in points])

    def impulses(self, pair: Pair, friction: bool = True, external: bool = True) -> tuple[jax.Array, jax.Array]:
        """``F^-_d / h`` and ``F^+_d / h``."""
        first = second = jnp.zeros_like(pair.V)
        for p in self._map_points(self.force_maps, pair):
            F = jnp.zeros_like(p.v)
            F = F + self.system.friction_force(*p[2:]) if friction else F
            F = F + self.system.external_force(*p[2:]) if external else F
            at_first, at_second = self._split_force(p.map, pair, p.weight * F)
            first, second = first + at_first, second + at_second
        return first, second

    def momentum_residual(self, p0, pair: Pair) -> jax.Array:
        """That of ``p_0 = -D_1 L_d - F^-_d``, (3.12) with the momentum of the step before, shape (n,)."""
        by_q, by_V = jax.grad(self.action, argnums=(0, 1))(*pair)
        return p0 - by_V + self.h * (by_q + self.impulses(pair)[0])

    def motion_residual(self, p0, pair: Pair, mass: float | jax.Array = 1.0) -> jax.Array:
        """What has to vanish, shape (n,): the misfit; on a manifold its part along Q, and how far q_1 is off Q.

        The latter is multiplied by a ``mass`` of the size of L_vv, so that all of it is momentum.
        """
        missed = self.momentum_residual(p0, pair)
        if self.curve is None:
            return missed
        surface = ConstraintSurface(self.curve.space, tangent=True)
        off = surface._constraint_change(pair.q0, 0.0, self.h * pair.V) / self.h
        return self.system.tangential_part(pair.q0, missed) + mass * surface._correction_displacement(pair.q0, off)

    def force(self, p0, pair: Pair) -> jax.Array:
        """``(p_1 - p_0) / h = (D_1 L_d + D_2 L_d + F^-_d + F^+_d) / h``, shape (n,), on a manifold along it."""
        first, second = self.impulses(pair)
        force = jax.grad(self.action)(*pair) + (first + second)
        return force if self.curve is None else force - self.momentum_residual(p0, pair) / self.h

    def constraint_residual(self, pair: Pair) -> jax.Array:
        """``-P_d``, the mean of ``T s + F_fr . v - P_H``; NaN where a temperature is not positive [GBY 3.9]."""
        total = jnp.zeros(())
        for p in self._map_points(self.constraint_maps, pair):
            T = -jax.grad(self.system.lagrangian_value, argnums=2)(p.q, p.v, p.S)
            gained = jnp.dot(self.system.friction_force(*p[2:]), p.v) - self.system.heating(*p[2:])
            total = total + p.weight * (jnp.where(T > 0.0, T, jnp.nan) * pair.s + gained)
        return total

    def work_and_heat_rates(self, pair: Pair) -> tuple[jax.Array, jax.Array]:
        """Work and heat from outside, per unit of time."""
        first, second = self.impulses(pair, friction=False)
        heat = _sum_arrays(
            [p.weight * self.system.heating(*p[2:]) for p in self._map_points(self.constraint_maps, pair)]
        )
        return jnp.dot(first + second, pair.V), heat

    def energy(self, pair: Pair) -> jax.Array:
        """``E = v . L_v - L`` at the points of the discrete Lagrangian, the mean."""
        energy = self.system.contact.energy
        points = self._map_points(self.lagrangian_maps, pair)
        return _sum_arrays([p.weight * energy(jnp.concatenate([p.q, p.v, p.S[None]])) for p in points])

    # -- as in the paper ----------------------------------------------------------------------------------------------

    def pair(self, q0, q1, S0, S1) -> Pair:
        return Pair(q0, (q1 - q0) / self.h, S0, (S1 - S0) / self.h)

    def lagrangian(self, q0, q1, S0, S1) -> jax.Array:
        """``L_d`` [GBY 3.10]."""
        return self.h * self.action(*self.pair(q0, q1, S0, S1))

    def forces(self, q0, q1, S0, S1, friction: bool = True, external: bool = True) -> tuple[jax.Array, jax.Array]:
        """``F^-_d`` and ``F^+_d``, shape (n,) each [GBY Definition 3.2]."""
        first, second = self.impulses(self.pair(q0, q1, S0, S1), friction, external)
        return self.h * first, self.h * second

    def constraint(self, q0, q1, S0, S1) -> jax.Array:
        """``P_d``: a pair is on ``C_K^d`` where it vanishes [GBY 3.8]."""
        return -self.constraint_residual(self.pair(q0, q1, S0, S1))

    def momenta(self, q0, q1, S0, S1) -> tuple[jax.Array, jax.Array]:
        """p_0 and p_1 of the discrete Legendre transforms ``FL^-`` and ``FL^+`` with forces [GBY §4.2]."""
        by_first, by_second = jax.grad(self.lagrangian, argnums=(0, 1))(q0, q1, S0, S1)
        first, second = self.forces(q0, q1, S0, S1)
        along = self.system.tangential_part
        return along(q0, -by_first - first), along(q1, by_second + second)

    def regularity_matrix(self, q0, q1, S0, S1) -> jax.Array:
        """The matrix (3.13), shape (n + 1, n + 1): where it is invertible the step from q_1, S_1 is determined."""

        def equations(q1, S1):
            return -self.momenta(q0, q1, S0, S1)[0], self.constraint(q0, q1, S0, S1)

        (A, B), (C, D) = jax.jacfwd(equations, argnums=(0, 1))(q1, S1)
        return jnp.block([[A, B[:, None]], [C[None], D[None, None]]])

    def reduced_matrix(self, q0, q1, S0, S1) -> jax.Array:
        """The matrix (3.15), shape (n, n): (3.13) is invertible where it is and ``D_4 P_d`` is not zero."""
        matrix = self.regularity_matrix(q0, q1, S0, S1)
        return matrix[:-1, :-1] - jnp.outer(matrix[:-1, -1], matrix[-1, :-1]) / matrix[-1, -1]

    def solve_constraint(self, q0, q1, S0, steps: int = 12) -> jax.Array:
        """S_1 with ``P_d(q_0, q_1, S_0, S_1) = 0``, by so many Newton steps; differentiable."""
        V = (q1 - q0) / self.h

        def newton(_, s):
            misfit, slope = jax.jvp(lambda s: self.constraint_residual(Pair(q0, V, S0, s)), (s,), (jnp.ones(()),))
            return s - misfit / slope

        return S0 + self.h * jax.lax.fori_loop(0, steps, newton, jnp.zeros(()))

    def flow(self, q0, q1, S0, S1, steps: int = 12) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
        """The discrete flow on ``C_K^d``, to (q_1, q_2, S_1, S_2), likewise by Newton steps [GBY 3.14]."""
        p1, start = self.momenta(q0, q1, S0, S1)[1], jnp.append((q1 - q0) / self.h, (S1 - S0) / self.h)

        def misfit(y):
            pair = Pair(q1, y[:-1], S1, y[-1])
            return jnp.append(self.motion_residual(p1, pair), self.constraint_residual(pair))

        def newton(_, y):
            return y - solve(jax.jacfwd(misfit)(y), misfit(y)[:, None])[:, 0]

        y = jax.lax.fori_loop(0, steps, newton, start)
        return q1, q1 + self.h * y[:-1], S1, S1 + self.h * y[-1]


def _sum_arrays(parts: list[jax.Array]) -> jax.Array:
    return functools.reduce(operator.add, parts)
