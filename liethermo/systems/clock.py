"""``Clock``: the components of a state that only count: a clock, the work done from outside, an impulse."""

from __future__ import annotations

from typing import Protocol, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from manifolds._pytree_module import Module

from ..functions.energy import Energy
from ..functions.time_span import TimeSpan, replace_time_span

WORK_NAME = "work"
"""Name of the work done from outside, an entry of the ledger; the energy of a solution contains it."""


class Clock(Module):
    """Indices of the time and the work in a state, with the span of the run, at whose breaks functions may jump.

    Attributes
    ----------
    span : TimeSpan
    index : int
        Index of the time in a state; the work follows it.
    unit : float
        Unit of both.
    energy_depends_on_time : bool
        Whether the energy depends on time.
    n_trailing_counters : int
        Number of components at the end of a state that only count, such as an impulse.
    """

    span: TimeSpan
    index: int = eqx.field(static=True)
    unit: float = eqx.field(static=True)
    energy_depends_on_time: bool = eqx.field(static=True)
    n_trailing_counters: int = eqx.field(static=True, default=0)

    @property
    def can_energy_jump(self) -> bool:
        """True if the energy may jump at a break of the span."""
        return bool(self.span.breaks.size) and self.energy_depends_on_time

    def time(self, x) -> jax.Array:
        """Return the time t of states, shape (...), clipped to the span of the run."""
        return self.span.clip(x[..., self.index] / self.unit)

    def work(self, x) -> jax.Array:
        """Return the work W of states, shape (...)."""
        return x[..., self.index + 1] / self.unit

    def work_direction(self, dim: int) -> jax.Array:
        """Return the displacement, shape (dim,), that adds one unit to the work done."""
        return jnp.zeros(dim).at[self.index + 1].set(self.unit)


class HasClock(Protocol):
    """A system with an energy, whose states may contain a time and the work."""

    @property
    def energy(self) -> Energy: ...

    @property
    def clock(self) -> Clock | None: ...


AnySystem = TypeVar("AnySystem", bound=HasClock)


def system_between_breaks(system: AnySystem, x) -> AnySystem:
    """Return the system with its functions of time limited to the interval of the step that starts at x.

    Functions of time that jump at the end of this step have their limits from before, and those that jump at its
    start their limits from after.
    """
    clock = system.clock
    if clock is None or not clock.span.breaks.size:
        return system
    return replace_time_span(system, clock.span.interval_between_breaks_at(clock.time(x)))


def add_energy_jump_to_work(clock: Clock, x, energy_jump) -> jax.Array:
    """Return the state x, shape (n,), with a jump of the energy added to its work, if x is at a break of the span.

    ``energy_jump`` is the energy after the jump minus the energy before.
    """
    jump = jnp.where(clock.span.starts_at_break(clock.time(x)), clock.unit * energy_jump, 0.0)
    return x.at[clock.index + 1].add(jump)


def keep_clock_components(system: HasClock, v) -> jax.Array:
    """Return v, shape (n,), with zeros in all components except time, work and other counters."""
    clock, index = system.clock, np.arange(v.shape[0])
    if clock is None:
        return jnp.zeros_like(v)
    is_counter = (index == clock.index) | (index == clock.index + 1) | (index >= len(index) - clock.n_trailing_counters)
    return jnp.where(is_counter, v, 0.0)


def convert_work_error_to_displacement(system: HasClock, x, error, mean_slope) -> jax.Array:
    """Return the error of a step, shape (n,), with the error of the work converted to a displacement of the state.

    A step that is corrected onto the level of the energy less the work moves the state by the error of the work.

    Parameters
    ----------
    system : System
    x : array, shape (n,)
    error, mean_slope : array, shape (n,)
        Estimated error and displacement of the step, both over its size.
    """
    clock = system.clock
    if clock is None:
        return error
    n, work = clock.index, clock.index + 1
    gradient_norm = jnp.linalg.norm(system.energy.gradient(x)[:n])
    speed = jnp.linalg.norm(mean_slope[:n])
    # the mean gradient along the step, which is not zero where the body starts from rest
    mean_gradient = jnp.abs(mean_slope[work]) / (clock.unit * jnp.where(speed > 0.0, speed, jnp.inf))
    gradient_norm = jnp.maximum(gradient_norm, mean_gradient)
    displacement = error[work] / (clock.unit * jnp.where(gradient_norm > 0.0, gradient_norm, jnp.inf))
    return error.at[work].set(displacement)
