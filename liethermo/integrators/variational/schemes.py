"""Variational integrators for simple closed systems [GBY]."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from manifolds.matrices.linear import solve

from ...errors import InputError
from ...systems import ComposedSystem, SimpleClosedSystem, System
from ...tracing.interpret import polynomial_degree
from ...tracing.programs import program
from ..base import ONE_SIZE, OneStepMethod, register
from .discrete import DiscreteSystem, FiniteDifference, Pair

CONSTRAINT_TOLERANCE = 1e-10
"""Largest misfit of a given first step, relative to the heat ``T |S_1 - S_0|`` and the work that make it up."""

SINGULAR = 1e13
"""Condition number, of rows scaled alike, from which a matrix counts as singular."""

Maps = FiniteDifference | Sequence[FiniteDifference] | str


class VariationalIntegrator(OneStepMethod):
    """``D_1 L_d(r_k) + D_2 L_d(r_k-1) + F^-_d(r_k) + F^+_d(r_k-1) = 0`` and ``P_d(r_k) = 0`` [GBY 3.12].

    Here ``r_k = (q_k, q_k+1, S_k, S_k+1)``. With finite difference maps phi_i and their weights w_i, of sum 1,
    ``L_d = h sum w_i L(phi_i)`` (3.10), ``F^±_d`` is the share of ``h sum w_i F(phi_i)`` at either end, and ``P_d = 0``
    (3.9) is

        sum w_i T_i (S_k+1 - S_k)/h = sum w_i (P_H - F_fr . v)_i,    T = -L_S.

    The three schemes of the paper are :meth:`verlet`, :meth:`midpoint` (the alpha family) and :meth:`symmetrised`.

    It runs as a one-step method on states (q, v, S) of a :class:`liethermo.SimpleClosedSystem`, from node to node:
    ``p_k = L_v(q_k, v_k, S_k) = -D_1 L_d(r_k) - F^-_d(r_k)`` and ``p_k+1 = D_2 L_d(r_k) + F^+_d(r_k)`` are (3.12), and
    make the first step from (q_0, v_0, S_0) one like the others. :meth:`state` starts from (q_0, q_1, S_0).

    The entropy falls at no step, for every L, friction and step size, since temperatures are positive (where one is
    not, the run stops). The energy is not kept: its error oscillates or stays bounded, see the paper. The flow obeys
    (4.7); it is symplectic where nothing depends on S. Order 2 where the maps are symmetric, else 1. One equation of
    the size of (q, S) a step, solved by Newton's method with the matrix (3.13); where the motion does not depend on
    S_k+1 and is affine in q_k+1 it is solved outright.

    It runs a :class:`liethermo.ComposedSystem` too, of several entropies, by one finite difference map (schemes 1, 2
    and their alpha family): with ``p_k = -D_1 L_d - F^-_d`` the equations are, in the variables (q, p, S),

        (q_k+1 - q_k)/h = H_p,  (p_k+1 - p_k)/h = -H_q + F,  T_a (S_a,k+1 - S_a,k)/h = the heat that body a receives,

    all at ``((1 - alpha) q_k + alpha q_k+1, alpha p_k + (1 - alpha) p_k+1, (1 - beta) S_k + beta S_k+1)``. The sum of
    the entropies falls at no step, for every energy, friction and conductance.

    Parameters
    ----------
    phi : FiniteDifference, a sequence of them, or one of "verlet", "midpoint", "symmetrised"
        For the discrete Lagrangian.
    forces, constraint : likewise, optional
        For the forces and the constraint, where they are chosen separately [GBY Remark 3.5]; phi by default.
    """

    systems = "simple closed and composed systems"
    fixed: ClassVar[str] = ONE_SIZE

    phi: tuple[FiniteDifference, ...]
    forces: tuple[FiniteDifference, ...]
    constraint: tuple[FiniteDifference, ...]

    def __init__(self, phi: Maps, forces: Maps | None = None, constraint: Maps | None = None):
        self.phi = _maps(phi, "phi")
        self.forces = self.phi if forces is None else _maps(forces, "the maps of the forces")
        self.constraint = self.phi if constraint is None else _maps(constraint, "the maps of the constraint")

    @classmethod
    def verlet(cls) -> VariationalIntegrator:
        """Scheme 1: everything at (q_k, S_k); order 1, explicit for quadratic kinetic energy and linear friction."""
        return cls("verlet")

    @classmethod
    def midpoint(cls, alpha: float = 0.5) -> VariationalIntegrator:
        """Scheme 2: everything at ``(1 - alpha) (q_k, S_k) + alpha (q_k+1, S_k+1)``; order 1 but for alpha = 1/2."""
        return cls(FiniteDifference(alpha))

    @classmethod
    def symmetrised(cls) -> VariationalIntegrator:
        """Scheme 3: the mean of both ends; order 2."""
        return cls("symmetrised")

    @property
    def stages(self) -> int:
        return 1

    @property
    def order(self) -> int:
        return 2 if all(map(_is_symmetric, (self.phi, self.forces, self.constraint))) else 1

    @property
    def preserves(self) -> frozenset[str]:
        return frozenset({"entropy_law"})

    def __str__(self) -> str:
        maps = ", ".join(
            f"{map.alpha:g}" if map.alpha == map.beta else f"({map.alpha:g}, {map.beta:g})" for map in self.phi
        )
        return f"VariationalIntegrator({maps})"

    def check(self, system: System) -> None:
        """Raise InputError unless the system has a variational principle of this kind."""
        if not isinstance(system, ComposedSystem):
            need_simple_closed(system, "VariationalIntegrator")
        elif not (len(self.phi) == 1 and type(self.phi[0]) is FiniteDifference and self._maps_are_one):
            raise InputError(
                f"{self} takes means over several finite difference maps, and composed systems run by one: take "
                "lt.VariationalIntegrator.midpoint() or .verlet()"
            )

    @property
    def _maps_are_one(self) -> bool:
        return self.phi == self.forces == self.constraint

    def discrete(self, system: SimpleClosedSystem, h, t=0.0) -> DiscreteSystem:
        """L_d, F_d and P_d of a step of size h from the time t on."""
        return DiscreteSystem(system, self.phi, self.forces, self.constraint, jnp.asarray(h), jnp.asarray(t))

    # -- the step ---------------------------------------------------------------------------------------------------

    def slopes(self, system: System, x, compensation, h, k) -> jax.Array:
        if isinstance(system, ComposedSystem):
            return system.vector_field(x + (compensation + h * self._share(system) * k[0]))[None]
        assert isinstance(system, SimpleClosedSystem)
        n = system.degrees_of_freedom
        q0, v0, S0, t = system.parts(x + compensation)
        discrete, p0 = self.discrete(system, h, t), system.momentum(q0, v0, S0)
        V, s = _solved(discrete, p0, Pair(q0, k[0, :n], S0, k[0, 2 * n]))
        pair = Pair(q0, V, S0, s)
        v_dot = velocity_slope(
            system, (q0, v0, S0, p0), (q0 + h * V, k[0, n : 2 * n], S0 + h * s), discrete.force(pair), h
        )
        ledger = jnp.stack([*discrete.received(pair), jnp.ones(())])[: system.dim - (2 * n + 1)]
        return jnp.concatenate([V, v_dot, s[None], ledger])[None]

    def _share(self, system: ComposedSystem) -> np.ndarray:
        """How far on its way each component of a composed system is looked at."""
        (map,), (q, p, _, _) = self.phi, system.poisson.places
        share = np.full(system.dim, map.beta)
        share[q], share[p] = map.alpha, 1.0 - map.alpha
        return share

    def linearised(self, system: System, x, compensation, h, k) -> Callable:
        if isinstance(system, ComposedSystem):
            return super().linearised(system, x, compensation, h, k)
        return jnp.negative  # the slopes are Newton's method already: their derivative vanishes at the solution

    def increment(self, h, k) -> jax.Array:
        return h * k[0]

    # -- starts and records -------------------------------------------------------------------------------------------

    def state(self, system: SimpleClosedSystem, q0, q1, S0, h: float, S1=None, t: float = 0.0) -> np.ndarray:
        """The state from which the first step leads to q_1, with the time t in its ledger if it has one.

        Parameters
        ----------
        system : SimpleClosedSystem
        q0, q1 : array, shape (n,)
        S0 : float
        h : float
            The step that the run will take.
        S1 : float, optional
            To be checked: the constraint determines it.

        Raises
        ------
        InputError
            If there is no S_1 that goes with q_0, q_1 and S_0, or the one given does not, or no velocity goes with the
            momentum.
        """
        need_simple_closed(system, "VariationalIntegrator")
        q0, q1 = (jnp.atleast_1d(jnp.asarray(q, dtype=jnp.float64)) for q in (q0, q1))
        if not q0.shape == q1.shape == (system.degrees_of_freedom,):
            raise InputError(f"q0 and q1 have shape ({system.degrees_of_freedom},), not {q0.shape} and {q1.shape}")
        discrete, S0 = self.discrete(system, h, t), jnp.asarray(S0, dtype=jnp.float64)
        found = discrete.onto_constraint(q0, q1, S0) if S1 is None else jnp.asarray(S1, dtype=jnp.float64)
        misfit, size = (float(a) for a in _misfit(discrete, q0, q1, S0, found))
        if not misfit <= CONSTRAINT_TOLERANCE * size:
            raise InputError(
                f"this first step is not on the discrete constraint: |P_d| = {misfit:.3g} between a heat and a work of "
                f"{size:.3g} (tolerance {CONSTRAINT_TOLERANCE:.0e} of it). "
                + (
                    "The temperature may be negative there"
                    if S1 is None
                    else "Leave S1 out: q0, q1 and S0 determine it"
                )
            )
        p0 = discrete.momenta(q0, q1, S0, found)[0]
        v0 = _velocity(system, q0, S0, p0, (q1 - q0) / h)
        if not bool(jnp.isfinite(v0).all()):
            raise InputError(f"no velocity was found that has the momentum {np.asarray(p0)} of this first step")
        rest = jnp.array([0.0, 0.0, t]) if system.receives else jnp.zeros(0)
        return np.concatenate([q0, v0, S0[None], rest])

    def energies(self, system: SimpleClosedSystem, x, h: float) -> np.ndarray:
        """``E = v·L_v - L`` at the scheme's own points between consecutive states, as the paper records it.

        Parameters
        ----------
        system : SimpleClosedSystem
        x : array, shape (times, dim)
            Every state of a run with steps of size h.

        Returns
        -------
        ndarray, shape (times - 1,)
        """
        x = system.state(x, batch=True)
        return np.asarray(_energies(self, system, jnp.asarray(h), x[:-1], x[1:]))

    def explain(self, system: System, x, k, h) -> str:
        if not isinstance(system, SimpleClosedSystem):
            return ""
        n = system.degrees_of_freedom
        q0, _, S0, t = system.parts(jnp.asarray(x))
        slope = jnp.nan_to_num(jnp.asarray(k)[0])
        matrix = np.asarray(_regularity(self.discrete(system, h, t), q0, q0 + h * slope[:n], S0, S0 + h * slope[2 * n]))
        if not np.isfinite(matrix).all():
            return ""
        size = np.abs(matrix).max(axis=1, keepdims=True)
        singular = np.linalg.svd(matrix / np.where(size > 0.0, size, 1.0), compute_uv=False)
        if singular[0] < SINGULAR * singular[-1]:
            return ""
        return (
            f"the regularity matrix (3.13) is singular: of its singular values, rows scaled to 1, the least is "
            f"{singular[-1]:.2g}. The discrete Lagrangian does not determine the step: take another step size or scheme"
        )


# -- the step equations -----------------------------------------------------------------------------------------------


def _solved(discrete: DiscreteSystem, p0, guess: Pair) -> tuple[jax.Array, jax.Array]:
    """V and s after one step of Newton's method for (3.12), from a guess or, where that is exact, from nothing."""
    n, (q0, V, S0, s) = len(guess.V), guess
    outright = (
        polynomial_degree(_motion_by_V, (discrete, p0, guess), n) <= 1
        and polynomial_degree(_motion_by_s, (discrete, p0, guess), 1) == 0
    )
    if outright:
        A, misfit = _with_jacobian(lambda V: discrete.motion(p0, Pair(q0, V, S0, jnp.zeros(()))), jnp.zeros(n))
        V = -solve(A, misfit[:, None])[:, 0]
    else:  # (3.15), s eliminated
        both = lambda V, s: (discrete.motion(p0, Pair(q0, V, S0, s)), discrete.production(Pair(q0, V, S0, s)))  # noqa: E731
        ((A, B), (C, D)), (misfit, gain) = _with_jacobian(both, V, s)
        V = V - solve(A - jnp.outer(B, C) / D, (misfit - B * (gain / D))[:, None])[:, 0]
    s = jnp.zeros(()) if polynomial_degree(_production_by_s, (discrete, p0, guess), 1) <= 1 else s
    slope, gain = _with_jacobian(lambda s: discrete.production(Pair(q0, V, S0, s)), s)
    return V, s - gain / slope


def _with_jacobian(function: Callable, *at):
    """The derivatives of a function by all arguments, and its value."""
    return jax.jacfwd(
        lambda *a: (lambda y: (y, y))(function(*a)), argnums=tuple(range(len(at))) if len(at) > 1 else 0, has_aux=True
    )(*at)


def _motion_by_V(model, V):
    discrete, p0, guess = model
    return discrete.motion(p0, guess._replace(V=V))


def _motion_by_s(model, s):
    discrete, p0, guess = model
    return discrete.motion(p0, guess._replace(s=s[0]))


def _production_by_s(model, s):
    discrete, _, guess = model
    return discrete.production(guess._replace(s=s[0]))


def velocity_slope(system: SimpleClosedSystem, start, end, force, h) -> jax.Array:
    """``(v_1 - v_0)/h`` with ``L_v(q_1, v_1, S_1) = p_0 + h force``, one step of Newton's method.

    Parameters
    ----------
    start : (q_0, v_0, S_0, p_0)
    end : (q_1, slope, S_1)
        With a guess of the result.
    """
    (_, v0, _, p0), (q1, slope, S1) = start, end
    affine = polynomial_degree(_momentum_by_v, (system, q1, S1), len(v0)) <= 1
    slope = jnp.zeros_like(v0) if affine else slope
    W, p = _with_jacobian(lambda v: system.momentum(q1, v, S1), v0 + h * slope)
    return slope - solve(W, ((p - p0) / h - force)[:, None])[:, 0]


def _momentum_by_v(model, v):
    system, q, S = model
    return system.momentum(q, v, S)


# -- helpers ----------------------------------------------------------------------------------------------------------


def need_simple_closed(system: System, name: str) -> None:
    if not isinstance(system, SimpleClosedSystem):
        raise InputError(f"{name} runs an lt.SimpleClosedSystem, not a {system.kind}")


SCHEMES: dict[str, tuple[FiniteDifference, ...]] = {
    "verlet": (FiniteDifference(0.0),),
    "midpoint": (FiniteDifference(0.5),),
    "symmetrised": (FiniteDifference(0.0), FiniteDifference(1.0)),
}
"""The schemes of GBY §3.3 by name."""


def _maps(maps: Maps, what: str) -> tuple[FiniteDifference, ...]:
    named = SCHEMES.get(maps, ()) if isinstance(maps, str) else maps
    found: tuple[Any, ...] = tuple(named) if isinstance(named, Sequence) else (named,)
    if not found or not all(isinstance(map, FiniteDifference) for map in found):
        raise InputError(
            f"{what} must be an lt.FiniteDifference, a sequence of them, or one of {', '.join(map(repr, SCHEMES))}, "
            f"not {maps!r}"
        )
    return found


def _is_symmetric(maps: tuple[FiniteDifference, ...]) -> bool:
    return Counter(maps) == Counter(map.mirrored() for map in maps)


@program
def _misfit(discrete: DiscreteSystem, q0, q1, S0, S1):
    """``h |P_d|``, and the heat and work between which it is one."""
    pair = discrete.pair(q0, q1, S0, S1)
    misfit, slope = jax.jvp(lambda s: discrete.production(pair._replace(s=s)), (pair.s,), (jnp.ones(()),))
    heat = jnp.abs(slope * pair.s)
    return discrete.h * jnp.abs(misfit), discrete.h * (heat + jnp.abs(misfit - slope * pair.s)) + 1e-300


@program
def _velocity(system: SimpleClosedSystem, q, S, p, v):
    """v with ``L_v(q, v, S) = p``, near a guess; NaN where Newton's method finds none."""

    def newton(_, v):
        W, found = _with_jacobian(lambda v: system.momentum(q, v, S), v)
        return v - solve(W, (found - p)[:, None])[:, 0]

    v = jax.lax.fori_loop(0, 20, newton, v)
    defect = jnp.max(jnp.abs(system.momentum(q, v, S) - p))
    return jnp.where(defect <= 1e-12 * (1.0 + jnp.max(jnp.abs(p))), v, jnp.nan)


@program
def _energies(method: VariationalIntegrator, system: SimpleClosedSystem, h, before, after):
    def one(x, y):
        (q0, _, S0, t), (q1, _, S1, _) = system.parts(x), system.parts(y)
        discrete = method.discrete(system, h, t)
        return discrete.energy(discrete.pair(q0, q1, S0, S1))

    return jax.vmap(one)(before, after)


@program
def _regularity(discrete: DiscreteSystem, q0, q1, S0, S1):
    return discrete.regularity_matrix(q0, q1, S0, S1)


register(VariationalIntegrator.verlet(), VariationalIntegrator.midpoint(), VariationalIntegrator.symmetrised())
