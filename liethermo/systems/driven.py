"""``DrivenSystem``: an energy that depends on time, or a torque, with clock and work as components of the state."""

from __future__ import annotations

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import manifolds as mf
from manifolds._pytree_module import forward_to, replace_fields
from manifolds.structures.poisson import PoissonBySharp, ProductPoisson

from ..dissipation.base import SkewFriction, dissipation_name, sum_dissipations
from ..errors import InputError
from ..functions.checks import with_polynomial_degrees
from ..functions.energy import ChartEnergy, Energy, Linear, Pullback, Quadratic, StateTimeEnergy, Sum
from ..functions.indices import ComponentMap
from ..functions.time_span import TimeSpan
from .base import System
from .clock import WORK_NAME, Clock
from .interface import WrappedSystem
from .lifted import LiftedSystem

CLOCK_UNIT = 2.0**-100
"""Unit in which time and work are stored. It is so small that they do not count in norms of a state or of its velocity,
which convergence and errors are measured against. It is a power of two, so that scaling rounds nothing."""


class DrivenSystem(LiftedSystem):
    """A system with ``H(x, t)``, made autonomous: ``x' = Pi dH + force``, ``t' = 1``, ``W' = dH/dt`` at fixed x.

    It has the energy ``H(x, t) - W`` and the Poisson tensor ``Pi + [[0, -1], [1, 0]]`` on (t, W); the dissipation acts
    on x alone. Every method conserves ``H - W``, which is the law ``dH = work``, as it conserves the energy of any
    system. K is rebuilt with the discrete gradient by x in its kernel, so the entropy law holds. The correction of the
    discrete gradient of H has components along x and t only (:class:`StateTimeEnergy`), so ``t' = 1`` holds to rounding
    and W is the integral of the power.

    A torque tau does work, ``x' = ... + tau``, ``W' = dH/dt + dH . tau``. It acts by a skew bracket of x and W with the
    energy, so it conserves ``H - W`` for every gradient, continuous or discrete.

    Functions of time may jump at the breaks of the span. There a step ends, which sees the limit from before, and the
    next one sees the limit from after [:func:`.clock.system_between_breaks`]. A jump of H at a fixed state is work.

    A state consists of the state of the body, t and W, in units of ``unit``. :func:`liethermo.integrate` builds it from
    a system whose energy depends on time, or on which a torque acts.

    Attributes
    ----------
    body : System
    unit : float
    attitude : array, shape (m, m), or None
        Attitude at which a torque is evaluated that depends on it: see :meth:`bind_attitude`.
    torque : array, shape (n,), or None
        Fixed torque, which replaces that of the body.
    span : TimeSpan
        Span of a run: functions of time are evaluated at times in it only.
    """

    body: System
    unit: float = eqx.field(static=True)
    attitude: jax.Array | None
    torque: jax.Array | None
    span: TimeSpan

    def __init__(self, body: System, unit: float = CLOCK_UNIT):
        self.span = TimeSpan()
        self.body, self.unit, self.dim, self.attitude, self.torque = body, unit, body.dim + 2, None, None
        self.space = None if body.space is None else mf.Product(body.space, mf.Euclidean(2))
        if body.space is not None and body.space.dtype.kind == "c":
            raise InputError(f"an energy that depends on time needs a real space, but {body.space.name} is complex")
        self.poisson = ProductPoisson(body.poisson, _ClockPoisson(unit))
        energy = Sum((*map(self._lift_energy_term, body.energy.terms), _NegativeWork(unit)))
        self.energy = energy if self.space is not None else with_polynomial_degrees(energy, self.dim)
        self._lift_laws()
        if body.torque_laws.name:
            has_law = body.entropy_law is not None or body.entropy is None
            torque = _TorqueForce(law=body.torque_laws.entropy_law if has_law else None)
            self.dissipation = sum_dissipations((*self.total_dissipation.terms, torque))

    @property
    def kind(self) -> str:
        return f"{self.body.kind} {'with a torque' if self.body.torque_laws.name else 'whose energy depends on time'}"

    # -- the state --------------------------------------------------------------------------------------------------

    @property
    def wrapped_system(self) -> WrappedSystem:
        return WrappedSystem(self.body, DrivenSystem, (self.unit,))

    def initial_state(self, x, t: float = 0.0, attitude=None, batch: bool = False) -> jax.Array:
        """Return the state at the time t with zero work, shape (dim,); several states with ``batch``."""
        x = jnp.asarray(self.body.initial_state(x, t, attitude, batch))
        clock = jnp.broadcast_to(jnp.array([t * self.unit, 0.0]), (*x.shape[:-1], 2))
        return jnp.concatenate([x, clock], axis=-1)

    def user_state(self, x):
        return self.body.points(x[..., :-2])

    @property
    def clock(self) -> Clock:
        return Clock(self.span, self.body.dim, self.unit, self.body.energy.depends_on_time)

    def time(self, x) -> jax.Array:
        """Return the time t of states, shape (...), clipped to the span of the run."""
        return self.clock.time(x)

    def samples(self, count, seed=0, scale=1.0):
        times = scale * np.random.default_rng(seed).standard_normal(count)
        return np.column_stack([self.body.samples(count, seed, scale), self.unit * times, np.zeros(count)])

    def run_conditions(self, x, t, guarantees):
        return self.body.run_conditions(x[:, :-2], t, guarantees)

    def _inner_system_at_first_state(self, x) -> System:
        t = float(np.reshape(x, (-1, self.dim))[0, -2]) / self.unit
        return self._body_at_time(min(max(t, float(self.span.start)), float(self.span.end)))

    def slope_scales(self, slopes):
        clock = jnp.full((*slopes.shape[:-1], 2), self.unit)
        return jnp.concatenate([self.body.slope_scales(slopes[..., :-2]), clock], axis=-1)

    # -- dynamics ---------------------------------------------------------------------------------------------------

    def inner_system_at(self, x) -> System:
        return self._body_at_time(self.time(x))

    body_dim = forward_to("body")

    def field(self, x, dH, dS, dL=()):
        motion = self.inner_system_at(x).drop_torque().field(*self.restrict_to_inner_state(x, dH, dS, dL))
        motion = jnp.concatenate([motion, _clock_velocity(dH, self.unit)])
        return motion + self.torque_velocity(x, dH) if self.torque_laws.name else motion

    def external_torque(self, x):
        return self.inner_system_at(x).external_torque(x[:-2]) if self.torque is None else self.torque

    def torque_velocity(self, x, dH) -> jax.Array:
        """Return the velocity that the torque gives to a state, power included, shape (dim,), at a gradient dH."""
        velocity = self.inner_system_at(x).external_velocity(x[:-2], dH[:-2]) if self.torque is None else self.torque
        assert velocity is not None
        return jnp.concatenate([velocity, jnp.stack([jnp.zeros(()), self.unit * jnp.dot(dH[:-2], velocity)])])

    def bind_attitude(self, attitude) -> DrivenSystem:
        """Return the system with its torque evaluated at a fixed attitude, shape (m, m)."""
        return replace_fields(self, attitude=attitude) if self.torque_laws.needs_attitude else self

    def solve_slopes_at_each_spin(self, x, dH, dS, noise_rates, other_noise_velocity, half_step, k):
        inner, clock_velocity = (
            self.inner_system_at(x).drop_torque(),
            _clock_velocity(dH, self.unit) + other_noise_velocity[-2:],
        )
        if self.torque_laws.name:
            torque_velocity = self.torque_velocity(x, dH)
            other_noise_velocity, clock_velocity = (
                other_noise_velocity + torque_velocity,
                clock_velocity + torque_velocity[-2:],
            )
        x, dH, dS, _ = self.restrict_to_inner_state(x, dH, dS, ())
        slopes = inner.solve_slopes_at_each_spin(x, dH, dS, noise_rates, other_noise_velocity[:-2], half_step, k[:-2])
        return None if slopes is None else jnp.concatenate([slopes, clock_velocity])

    def raise_index(self, x, alpha):
        """Return the direction of a correction along alpha, with zeros for time and work."""
        return jnp.concatenate([self.body.raise_index(x[:-2], alpha[:-2]), jnp.zeros(2)])

    def _body_at_time(self, t) -> System:
        """Return the body with its energy and torque frozen at the time t."""
        return self.body.at_time(t, self.attitude)

    # -- functions ----------------------------------------------------------------------------------------------------

    def pullback(self, energy: Energy) -> Energy:
        return self.lift_energy(self.body.energy_of_flat_states(energy))

    def _lift_energy_term(self, term: Energy) -> Energy:
        """Return a term of the energy of the body as a function of states with time and work."""
        clock = _StateTimeMap(self.body.dim, self.unit)
        return _EnergyOfStateAndTime(term.with_time(), clock) if term.depends_on_time else self.lift_energy(term)

    @property
    def ledger_functions(self):
        return {WORK_NAME: Quadratic(jnp.zeros(self.dim), jnp.zeros(self.dim).at[-1].set(1.0 / self.unit))}

    def to_user_solution(self, solution):
        dense, body = solution.dense, self.body
        dense = None if dense is None else dense.with_output_map(lambda x: x[..., :-2])
        x = np.ascontiguousarray(solution.x[:, :-2])
        entries = {"system": type(body).__name__, "x0": x[0].tolist() if solution.provenance.get("x0") else None}
        if body.lie_algebra is not None:
            entries["algebra"] = body.lie_algebra.name
        entries["dissipation"] = dissipation_name(body.dissipation)
        energy = solution.energy + solution.casimirs[WORK_NAME]
        body_solution = dataclasses.replace(solution, x=x, energy=energy, dense=dense).with_provenance(**entries)
        return body.to_user_solution(body_solution)


class _ClockPoisson(PoissonBySharp):
    """The Poisson structure of time and work, with the tensor ``[[0, -1], [1, 0]]`` in units of ``unit``."""

    unit: float = eqx.field(static=True)

    dim = 2

    def sharp(self, x, alpha) -> jax.Array:
        return _clock_velocity(alpha, self.unit)

    def stages_on_leaf(self, x, alpha, A) -> jax.Array:
        """Return x for every stage, since the tensor is constant."""
        return jnp.broadcast_to(x, alpha.shape)

    def leaf_covector_rate(self, covector, alpha) -> jax.Array:
        return alpha


def _clock_velocity(dH, unit: float) -> jax.Array:
    """Return the velocities of t and W, shape (2,), for a gradient of the energy."""
    return unit**2 * jnp.stack([-dH[-1], dH[-2]])


class _TorqueForce(SkewFriction):
    """A torque on a body as a force that conserves energy minus work."""

    is_noiseless = True
    preserves_casimirs = True  # but those that :attr:`System.torque_laws` lists as changed

    def force(self, system, x, dH, dS, dL):
        return system.torque_velocity(x, dH)


class _StateTimeMap(ComponentMap):
    """The map from a state with time and work to (x, t), shape (dim + 1,)."""

    dim: int = eqx.field(static=True)
    unit: float = eqx.field(static=True)

    def __call__(self, x):
        return jnp.append(x[: self.dim], x[self.dim] / self.unit)


class _NegativeWork(Pullback):
    """The energy ``-W``, where W is the last component of a state."""

    def __init__(self, unit: float):
        super().__init__(Linear(jnp.array([-1.0 / unit])), [-1])

    def pullback_to_chart(self, coordinates, space, start=None):
        value = self.value(space.to_vector(coordinates.centre().point))
        return Quadratic(jnp.zeros(space.dim), self.gradient(jnp.zeros(space.dim)), value)


class _EnergyOfStateAndTime(Pullback):
    """A function of states with time and work, computed from a function of (x, t), shape (n + 1,)."""

    coordinates: _StateTimeMap

    def pullback_to_chart(self, coordinates, space, start=None):
        clock = _StateTimeMap(space.dim - 2, self.coordinates.unit)
        return Pullback(
            StateTimeEnergy(_ChartEnergyOfTime(ChartEnergy(self, coordinates, space, start), clock.unit)), clock
        )


class _ChartEnergyOfTime(Energy):
    """A function of (c, t), computed from a function of chart coordinates, time and work."""

    energy: Energy
    unit: float = eqx.field(static=True)

    def value(self, x) -> jax.Array:
        return self.energy.value(jnp.concatenate([x[:-1], jnp.stack([x[-1] * self.unit, jnp.zeros(())])]))


def make_autonomous(system: System, unit: float = CLOCK_UNIT) -> System:
    """Return a driven system extended by time and work, so that it is autonomous; other systems unchanged.

    Raises
    ------
    InputError
        If the torque of the system is frozen at one time: its work would be left out.
    """
    if system.torque_laws.name and not system.is_driven:
        raise InputError(
            f"a run needs the torque {system.torque_laws.name} as a function of the time, but system.at_time(...) has "
            "frozen it. Run the system itself; for a torque that is constant give torque=lambda t: ..."
        )
    return DrivenSystem(system, unit) if system.is_driven else system
