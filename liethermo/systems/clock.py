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
    """The place of the time and the work in a state, and the span of the run, at whose breaks functions of time jump.

    Attributes
    ----------
    span : TimeSpan
    index : int
        Index of the time in a state; the work follows it.
    unit : float
        Unit of both.
    energy_depends_on_time : bool
        Whether the energy depends on time.
    n_last_counters : int
        How many of the last components of a state only count too, such as an impulse.
    """

    span: TimeSpan
    index: int = eqx.field(static=True)
    unit: float = eqx.field(static=True)
    energy_depends_on_time: bool = eqx.field(static=True)
    n_last_counters: int = eqx.field(static=True, default=0)

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
    """A system with an energy, whose states may contain the time and the work."""

    @property
    def energy(self) -> Energy: ...

    @property
    def clock(self) -> Clock | None: ...


AnySystem = TypeVar("AnySystem", bound=HasClock)


def system_of_step(system: AnySystem, x) -> AnySystem:
    """Return the system for a step that starts at x, shape (n,).

    Functions of time that jump at the end of this step have their limits from before, and those that jump at its
    start their limits from after.
    """
    clock = system.clock
    if clock is None or not clock.span.breaks.size:
        return system
    return replace_time_span(system, clock.span.interval_between_breaks_at(clock.time(x)))


def add_jump_of_energy(clock: Clock, x, amount) -> jax.Array:
    """Return x, shape (n,), with a jump of the energy added to the work, if a step from x starts at a break.

    ``amount`` is the energy after the jump minus the energy before.
    """
    jump = jnp.where(clock.span.starts_at_break(clock.time(x)), clock.unit * amount, 0.0)
    return x.at[clock.index + 1].add(jump)


def clock_components(system: HasClock, v) -> jax.Array:
    """Return v, shape (n,), with zeros in all components but those that only count."""
    clock, index = system.clock, np.arange(v.shape[0])
    if clock is None:
        return jnp.zeros_like(v)
    is_counter = (index == clock.index) | (index == clock.index + 1) | (index >= len(index) - clock.n_last_counters)
    return jnp.where(is_counter, v, 0.0)


def error_of_step(system: HasClock, x, error, mean_slope) -> jax.Array:
    """Return the error of a step from x, over its size, with the error of the work as one of the state, shape (n,).

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
