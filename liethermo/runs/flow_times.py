"""States of a flow at any times, traced ones too, and a system with other parameters, for :func:`liethermo.flow`."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import jax
import jax.numpy as jnp
import numpy as np

from manifolds._arrays import is_traced

from ..errors import InputError
from ..integrators import OneStepMethod
from ..systems import System
from .named_parameters import replace_parameters
from .schedule import StepSchedule, clip_times_to_span


def system_with_parameters(system, parameters) -> System:
    """Return the system with other parameters: a function of them that builds it, or a system and a dict by name.

    Raises
    ------
    InputError
        If a name or a shape is not that of a parameter of the system.
    """
    if parameters is None:
        return system
    if not isinstance(system, System):
        if not callable(system):
            raise InputError(f"system must be a system, or a function of parameters=, got {type(system).__name__}")
        return system(parameters)
    if not isinstance(parameters, Mapping):
        raise InputError(
            "parameters of a system must be a dict by the names of its parameters. For parameters of another form, "
            "give a function of them that builds the system"
        )
    return replace_parameters(system, parameters)


def checked_save_times(save_at, schedule: StepSchedule) -> jax.Array | np.ndarray:
    """Return the times of ``save_at`` as an array, shape (times,); times that are traced are not checked."""
    times = jnp.asarray(save_at, dtype=jnp.float64) if is_traced(save_at) else np.asarray(save_at, dtype=np.float64)
    if times.ndim != 1 or not times.size:
        raise InputError(f"save_at must be a list of times, got an array of shape {times.shape}")
    if isinstance(times, jax.Array):
        return times
    if not np.isfinite(times).all():
        raise InputError("save_at must be a list of finite times")
    return clip_times_to_span(times, schedule.start, schedule.end, "save_at")


def states_at_times(
    system: System, method: OneStepMethod, path, grid, times, span: tuple[float, float], step: Callable
) -> jax.Array:
    """Return the states at times, shape (times, n), each by one step from the last state of the path before its time.

    Parameters
    ----------
    path : array, shape (steps + 1, n)
        The states at the ends of steps.
    grid : array, shape (steps + 1,)
        Their times.
    times : array, shape (times,)
    span : (float, float)
        Start and end of the run; the state at a time outside of it is NaN.
    step : function from the system, the method, a state and a step size to a state
    """
    start, end = span
    is_inside = (times >= start) & (times <= end)
    # The step has a length h > 0 where it can, for its derivative by h: the last state strictly before the time.
    index = jnp.clip(jnp.searchsorted(grid, times, side="left") - 1, 0, len(grid) - 2)

    def end_state(x, h):
        # A step of size zero, at the start of the run, divides by zero; its derivative by the time is the velocity.
        is_zero = h == 0.0
        moved = step(system, method, x, jnp.where(is_zero, grid[1] - grid[0], h))
        return jnp.where(is_zero, x + h * system._vector_field(x), moved)

    states = jax.vmap(end_state)(path[index], times - grid[index])
    return jnp.where(is_inside[:, None], states, jnp.nan)
