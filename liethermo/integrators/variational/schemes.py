"""Variational integrators for simple closed systems [GBY]."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import manifolds as mf

from ...errors import InputError
from ...functions.conditions import checked_numbers
from ...systems import ComposedSystem, EmbeddedSystem, SimpleClosedSystem, System
from ...systems.kind_checks import require_kind, unwrap_user_system
from ...tracing.programs import jit_cached
from ..base import (
    WHY_FIXED_VARIATIONAL_STEP,
    OneStepMethod,
    apply_increment,
    checked_run_states,
    checked_step_size,
    register,
)
from ..charts import resolve_retraction
from .composed import ComposedVariational
from .discrete import Curve, DiscreteSystem, FiniteDifference, Pair
from .equations import newton_velocity_and_entropy_slope, velocity_from_momentum, velocity_slope

CONSTRAINT_TOLERANCE = 1e-10
"""Largest residual of a given first step, relative to its heat ``T |S_1 - S_0|`` plus its work."""

SINGULAR_CONDITION_NUMBER = 1e13
"""Condition number, with rows scaled to 1, from which a matrix counts as singular."""

Maps = FiniteDifference | Sequence[FiniteDifference] | str


class VariationalIntegrator(OneStepMethod):
    """Variational integrator of simple closed systems, from finite difference maps [GBY 3.12].

        D_1 L_d(r_k) + D_2 L_d(r_k-1) + F^-_d(r_k) + F^+_d(r_k-1) = 0,    P_d(r_k) = 0,    r_k = (q_k, q_k+1, S_k,
        S_k+1).

    With finite difference maps phi_i and their weights w_i, of sum 1, ``L_d = h sum w_i L(phi_i)`` (3.10), ``F^±_d`` is
    the portion of ``h sum w_i F(phi_i)`` at either end, and ``P_d = 0`` (3.9) is

        sum w_i T_i (S_k+1 - S_k)/h = sum w_i (P_H - F_fr . v)_i,    T = -L_S.

    The three schemes of the paper are :meth:`verlet`, :meth:`midpoint` (the alpha family) and :meth:`symmetrised`.

    It runs as a one-step method on states (q, v, S) of a :class:`liethermo.SimpleClosedSystem`, from node to node:
    ``p_k = L_v(q_k, v_k, S_k) = -D_1 L_d(r_k) - F^-_d(r_k)`` and ``p_k+1 = D_2 L_d(r_k) + F^+_d(r_k)`` are (3.12), so
    the first step from (q_0, v_0, S_0) is like the others. :meth:`state` starts from (q_0, q_1, S_0).

    The entropy falls at no step, for every L, friction and step size, since temperatures are positive (otherwise the
    run stops). The energy is not conserved: its error oscillates or stays bounded, see the paper. The flow obeys (4.7);
    it is symplectic where nothing depends on S. The order is 2 if the maps are symmetric, else 1. A step solves one
    equation of the size of (q, S) by Newton's method with the matrix (3.13); one Newton step is exact if the motion
    does not depend on S_k+1 and is affine in q_k+1.

    On a manifold Q the maps are evaluated on a curve from q_k to q_k+1, at its parameter alpha. The curve is the chord
    in the arrays around, projected onto Q, or with ``retraction`` a curve of the retraction, such as the geodesic of
    ``"exp"``, whose difference quotients are logarithms. Equation (3.12) holds along Q, and q_k+1 is on Q to rounding.
    The order is that on R^n, but 1 with a chart whose lines differ from both ends ("cayley", "projection").

    It also runs a :class:`liethermo.ComposedSystem`, with several entropies, in the variables (q, p, S) with ``p_k =
    -D_1 L_d - F^-_d``. At the point (q_i, P_i, S_i) of each map, with a momentum of its own, the velocity ``H_p`` is
    ``(q_k+1 - q_k)/h``. The momenta obey ``p_k = sum w_i (P_i - h (1 - alpha_i) (F - H_q)_i)`` and ``p_k+1 = p_k + h
    sum w_i (F - H_q)_i``. Each entropy grows by the mean of the heat that its body receives, over the mean temperature
    ``sum w_i H_S``; forces and heat use this temperature too. The sum of the entropies falls at no step, for every
    energy, friction and conductance.

    Parameters
    ----------
    phi : FiniteDifference, a sequence of them, or one of "verlet", "midpoint", "symmetrised"
        Maps of the discrete Lagrangian.
    forces, constraint : FiniteDifference, a sequence of them, or a name, optional
        Maps of the forces and of the constraint, if they are chosen separately [GBY Remark 3.5]; phi by default.
    retraction : str or manifolds.Retraction, optional
        On a manifold, the retraction of the curves: :func:`manifolds.retraction` has the names. Chords by default.
    """

    systems = "simple closed and composed systems"
    why_fixed_step: ClassVar[str] = WHY_FIXED_VARIATIONAL_STEP

    phi: tuple[FiniteDifference, ...]
    forces: tuple[FiniteDifference, ...]
    constraint: tuple[FiniteDifference, ...]
    retraction: str | mf.Retraction | None = eqx.field(static=True)

    def __init__(
        self,
        phi: Maps,
        forces: Maps | None = None,
        constraint: Maps | None = None,
        retraction: str | mf.Retraction | None = None,
    ):
        self.phi = _checked_maps(phi, "phi")
        self.forces = self.phi if forces is None else _checked_maps(forces, "the maps of the forces")
        self.constraint = self.phi if constraint is None else _checked_maps(constraint, "the maps of the constraint")
        self.retraction = retraction

    @classmethod
    def verlet(cls, retraction: str | mf.Retraction | None = None) -> VariationalIntegrator:
        """Return scheme 1, of order 1, evaluated at (q_k, S_k): explicit for quadratic kinetic energy, linear friction.

        On a manifold ``retraction`` determines the curves between successive points.
        """
        return cls("verlet", retraction=retraction)

    @classmethod
    def midpoint(cls, alpha: float = 0.5, retraction: str | mf.Retraction | None = None) -> VariationalIntegrator:
        """Return the integrator that evaluates L at a fraction alpha of the step: of order 2 for alpha = 1/2, else 1.

        On a manifold ``retraction`` determines the curves between successive points.
        """
        return cls(FiniteDifference(alpha), retraction=retraction)

    @classmethod
    def symmetrised(cls, retraction: str | mf.Retraction | None = None) -> VariationalIntegrator:
        """Return scheme 3, of order 2, which takes the mean of the values at both ends.

        On a manifold ``retraction`` determines the curves between successive points.
        """
        return cls("symmetrised", retraction=retraction)

    stages = 1

    @property
    def order(self) -> int:
        return (
            2
            if all(map(_is_symmetric_set, (self.phi, self.forces, self.constraint))) and self._has_symmetric_curves
            else 1
        )

    @property
    def _has_symmetric_curves(self) -> bool:
        """True if the curve from q_1 to q_0 on a manifold is that from q_0 to q_1, run backward."""
        return self.retraction in SYMMETRIC_RETRACTION_NAMES or isinstance(self.retraction, SYMMETRIC_RETRACTION_TYPES)

    uses_charts = False

    preserves = frozenset({"entropy_law"})

    def __str__(self) -> str:
        maps = ", ".join(
            f"{map.alpha:g}" if map.alpha == map.beta else f"({map.alpha:g}, {map.beta:g})" for map in self.phi
        )
        return f"VariationalIntegrator({maps})"

    def check(self, system: System) -> None:
        """Raise InputError unless the system is simple closed or composed, and the maps suit it."""
        closed = _simple_closed_or_none(unwrap_user_system(system))
        if closed is not None and system.constraint_surface is not None:
            if any(type(map) is not FiniteDifference for map in (*self.phi, *self.forces, *self.constraint)):
                raise InputError(
                    "on a manifold the maps must be lt.FiniteDifference itself, no subclass: they are evaluated on a "
                    "curve of the space, which retraction= determines"
                )
            self.curve(closed)
        elif self.retraction is not None:
            raise InputError(
                f"retraction= needs a manifold of positions, and this {system.kind} has none. Leave retraction= out"
            )
        elif (composed := _composed_or_none(system)) is not None:
            self._check_maps_for_composed_system(composed)
        else:
            require_simple_closed(system, "VariationalIntegrator")

    def _check_maps_for_composed_system(self, system: ComposedSystem) -> None:
        """Raise InputError unless the maps suit a composed system, and its exchange of particles if it has any."""
        if not (self.phi == self.forces == self.constraint):
            raise InputError(f"for several bodies the maps of forces and constraint must be phi, and {self} has others")
        if any(type(map) is not FiniteDifference for map in self.phi):
            raise InputError(
                f"for several bodies every map must be an lt.FiniteDifference, not a subclass, and {self} has "
                "another map"
            )
        if len(self.phi) > 1 and system.poisson.species:
            raise InputError(
                f"bodies that exchange particles need a single finite difference map, and {self} has several. Use "
                "lt.VariationalIntegrator.midpoint() or .verlet()"
            )

    def on(self, system: System, tolerance: float | None = None) -> OneStepMethod:
        is_for_bodies = _composed_or_none(system) is not None and self.retraction is None
        return ComposedVariational(self, self.phi) if is_for_bodies else self

    def discrete_system(self, system: SimpleClosedSystem, h, t=0.0) -> DiscreteSystem:
        """Return the discrete system of a step of size h from the time t: its Lagrangian, forces and constraint."""
        curve = self.curve(system)
        return DiscreteSystem(system, self.phi, self.forces, self.constraint, jnp.asarray(h), jnp.asarray(t), curve)

    def curve(self, system: SimpleClosedSystem) -> Curve | None:
        """Return the curve on a manifold at which the maps are evaluated; None on R^n."""
        space, kind = system.configurations, self.retraction
        if space is None or kind is None:
            return None if space is None else Curve(space)
        return Curve(space, resolve_retraction(space, kind).chart)

    # -- the step ---------------------------------------------------------------------------------------------------

    def slopes(self, system: System, x, compensation, h, k) -> jax.Array:
        system = require_kind(unwrap_user_system(system), SimpleClosedSystem, "VariationalIntegrator")
        n = system.degrees_of_freedom
        q0, v0, S0, t = system.split_state(x + compensation)
        discrete, p0 = self.discrete_system(system, h, t), system.momentum(q0, v0, S0)
        V, s = newton_velocity_and_entropy_slope(discrete, v0, p0, Pair(q0, k[0, :n], S0, k[0, 2 * n]))
        pair = Pair(q0, V, S0, s)
        v_dot = velocity_slope(
            system, (q0, v0, S0, p0), (q0 + h * V, k[0, n : 2 * n], S0 + h * s), discrete.momentum_slope(p0, pair), h
        )
        ledger = jnp.stack([*discrete.work_and_heat_rates(pair), jnp.ones(())])[: system.dim - (2 * n + 1)]
        return jnp.concatenate([V, v_dot, s[None], ledger])[None]

    def residual_jvp(self, system: System, x, compensation, h, k) -> Callable:
        return jnp.negative  # the slopes are Newton's method already: their derivative vanishes at the solution

    def increment(self, h, k) -> jax.Array:
        return h * k[0]

    def move(self, system: System, x, compensation, h, k) -> tuple[jax.Array, jax.Array]:
        return apply_increment(self, system, x, compensation, self.increment(h, k), ends_on_surface=True)

    # -- starts and records -------------------------------------------------------------------------------------------

    def state(self, system: SimpleClosedSystem, q0, q1, S0, h: float, S1=None, t: float = 0.0) -> np.ndarray:
        """Return the state from which the first step leads to q_1, with the time t in its ledger if it has one.

        Parameters
        ----------
        system : SimpleClosedSystem
        q0, q1 : array, shape (n,)
        S0 : float
        h : float
            The step size of the run.
        S1 : float, optional
            Value to check: the constraint determines it.

        Raises
        ------
        InputError
            If no S_1 belongs to q_0, q_1 and S_0, the given S1 is wrong, or no velocity has the momentum.
        """
        require_simple_closed(system, "VariationalIntegrator")
        space = system.configurations
        if space is not None:
            q0, q1 = (space.to_vector(space.point(q)) for q in (q0, q1))
        q0, q1 = jnp.atleast_1d(checked_numbers(q0, "q0")), jnp.atleast_1d(checked_numbers(q1, "q1"))
        if not q0.shape == q1.shape == (system.degrees_of_freedom,):
            raise InputError(f"q0 and q1 must have shape ({system.degrees_of_freedom},), got {q0.shape} and {q1.shape}")
        discrete, S0 = (
            self.discrete_system(system, checked_step_size(h), checked_numbers(t, "t", ())),
            checked_numbers(S0, "S0", ()),
        )
        S1_used = discrete.end_entropy_on_constraint(q0, q1, S0) if S1 is None else checked_numbers(S1, "S1", ())
        residual, scale = (float(a) for a in _constraint_residual_and_scale(discrete, q0, q1, S0, S1_used))
        if not residual <= CONSTRAINT_TOLERANCE * scale:
            raise InputError(
                f"this first step is not on the discrete constraint: |P_d| = {residual:.3g}, with heat and work of "
                f"{scale:.3g} (relative tolerance {CONSTRAINT_TOLERANCE:.0e}). "
                + (
                    "The temperature may be negative there"
                    if S1 is None
                    else "Leave S1 out: q0, q1 and S0 determine it"
                )
            )
        p0 = discrete.momenta(q0, q1, S0, S1_used)[0]
        v0 = velocity_from_momentum(system, q0, S0, p0, (q1 - q0) / h)
        if not bool(jnp.isfinite(v0).all()):
            raise InputError(f"no velocity has the momentum {np.asarray(p0)} of this first step")
        ledger = jnp.array([0.0, 0.0, t]) if system.has_ledger else jnp.zeros(0)
        return np.concatenate([q0, v0, S0[None], ledger])

    def energies(self, system: SimpleClosedSystem, x, h: float) -> np.ndarray:
        """Return the energies ``v·L_v - L`` between consecutive states, at the points of the scheme, as in the paper.

        Parameters
        ----------
        system : SimpleClosedSystem
        x : array, shape (times, dim)
            Every state of a run with steps of size h.

        Returns
        -------
        ndarray, shape (times - 1,)
        """
        system = require_simple_closed(system, "VariationalIntegrator")
        x = checked_run_states(system, x)
        return np.asarray(_step_energies(self, system, checked_step_size(h), x[:-1], x[1:]))

    def why_step_failed(self, system: System, x, k, h) -> str:
        closed = _simple_closed_or_none(system)
        if closed is None or closed.configurations is not None:
            return ""
        system = closed
        n = system.degrees_of_freedom
        q0, _, S0, t = system.split_state(jnp.asarray(x))
        slope = jnp.nan_to_num(jnp.asarray(k)[0])
        matrix = np.asarray(
            _regularity_matrix(self.discrete_system(system, h, t), q0, q0 + h * slope[:n], S0, S0 + h * slope[2 * n])
        )
        if not np.isfinite(matrix).all():
            return ""
        row_scales = np.abs(matrix).max(axis=1, keepdims=True)
        singular_values = np.linalg.svd(matrix / np.where(row_scales > 0.0, row_scales, 1.0), compute_uv=False)
        if singular_values[0] < SINGULAR_CONDITION_NUMBER * singular_values[-1]:
            return ""
        return (
            f"the regularity matrix (3.13) is singular: with rows scaled to 1, its smallest singular value is "
            f"{singular_values[-1]:.2g}. The discrete Lagrangian does not determine the step. Use another step size or "
            "scheme"
        )


# -- helpers ----------------------------------------------------------------------------------------------------------


SYMMETRIC_RETRACTION_NAMES = (
    None,
    "exp",
    "midpoint",
    "euclidean",
    "midpoint_euclidean",
    "group_exp",
    "midpoint_group_exp",
)
"""Names of retractions whose line through two points is the same in the charts around both."""
SYMMETRIC_RETRACTION_TYPES = (
    mf.RiemannianRetraction,
    mf.EuclideanRetraction,
    mf.GroupRetraction,
    mf.MidpointRetraction,
)
"""Classes of retractions whose line through two points is the same in the charts around both."""


def _simple_closed_or_none(system: System) -> SimpleClosedSystem | None:
    """Return the system if it is a simple closed system, else None."""
    return system if isinstance(system, SimpleClosedSystem) else None


def _composed_or_none(system: System) -> ComposedSystem | None:
    """Return the system if it is a composed system, else None."""
    return system if isinstance(system, ComposedSystem) else None


def require_simple_closed(system: System, method_name: str) -> SimpleClosedSystem:
    """Return the system if it is a simple closed system on R^n; otherwise raise InputError with the method's name."""
    if isinstance(system, EmbeddedSystem):
        raise InputError(
            f"{method_name} runs only on R^n. On a manifold use lt.VariationalIntegrator or a metriplectic method"
        )
    return require_kind(system, SimpleClosedSystem, method_name)


SCHEMES: dict[str, tuple[FiniteDifference, ...]] = {
    "verlet": (FiniteDifference(0.0),),
    "midpoint": (FiniteDifference(0.5),),
    "symmetrised": (FiniteDifference(0.0), FiniteDifference(1.0)),
}
"""The finite difference maps of the schemes of GBY §3.3, by name."""


def _checked_maps(maps: Maps, argument_name: str) -> tuple[FiniteDifference, ...]:
    """Return one map, several maps, or the maps of a named scheme as a tuple; raise InputError for anything else."""
    map_or_maps = SCHEMES.get(maps, ()) if isinstance(maps, str) else maps
    map_tuple: tuple[Any, ...] = tuple(map_or_maps) if isinstance(map_or_maps, Sequence) else (map_or_maps,)
    if not map_tuple or not all(isinstance(map, FiniteDifference) for map in map_tuple):
        raise InputError(
            f"{argument_name} must be an lt.FiniteDifference, a sequence of them, or one of "
            f"{', '.join(map(repr, SCHEMES))}, got {maps!r}"
        )
    return map_tuple


def _is_symmetric_set(maps: tuple[FiniteDifference, ...]) -> bool:
    """Return True if the reversed maps are the same maps with the same multiplicities."""
    return Counter(maps) == Counter(map.reversed_map() for map in maps)


@jit_cached
def _constraint_residual_and_scale(discrete: DiscreteSystem, q0, q1, S0, S1):
    """Return the absolute residual of the constraint ``P_d``, and its scale: the heat plus the work of the step."""
    pair = discrete.pair(q0, q1, S0, S1)
    residual, slope = jax.jvp(lambda s: discrete.constraint_residual(pair._replace(s=s)), (pair.s,), (jnp.ones(()),))
    heat = jnp.abs(slope * pair.s)
    return discrete.h * jnp.abs(residual), discrete.h * (heat + jnp.abs(residual - slope * pair.s)) + 1e-300


@jit_cached
def _step_energies(method: VariationalIntegrator, system: SimpleClosedSystem, h, start_states, end_states):
    """Return the energy of each step between the start and the end states, at the points of the scheme."""

    def step_energy(x, y):
        (q0, _, S0, t), (q1, _, S1, _) = system.split_state(x), system.split_state(y)
        discrete = method.discrete_system(system, h, t)
        return discrete.energy(discrete.pair(q0, q1, S0, S1))

    return jax.vmap(step_energy)(start_states, end_states)


@jit_cached
def _regularity_matrix(discrete: DiscreteSystem, q0, q1, S0, S1):
    """Return the Jacobian of the momentum and constraint by (q_1, S_1), (3.13) of the paper, shape (n + 1, n + 1)."""
    return discrete.end_point_jacobian(q0, q1, S0, S1)


register(VariationalIntegrator.verlet(), VariationalIntegrator.midpoint(), VariationalIntegrator.symmetrised())
