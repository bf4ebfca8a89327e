"""Adaptive runs of one or many trajectories, and the host's handling of their pauses, for every engine."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np

from ..functions.rounding import propagated_rounding_scale
from ..integrators import OneStepMethod
from ..systems import System
from ..tracing.interpret import evaluate_at_points
from ..tracing.programs import jit_cached
from . import searching
from .array import LazyNewton
from .codes import StatusCode
from .compiled.form import ProgramStructure
from .compiled.paced import CompiledAdaptiveRuns
from .growth import DENSE_JACOBIAN_DIM
from .pacing import (
    ATTEMPT_FIELDS,
    AdaptiveState,
    StepControl,
    advance_adaptive,
    advance_adaptive_with,
    growth_rate_at,
    initial_adaptive_state,
    initial_adaptive_state_program,
    max_growth_per_step,
    max_growth_rates,
)
from .rules import DEFAULT_OPTIONS, EPS
from .stepping import State


class ArrayAdaptiveRuns:
    """Adaptive runs of one or many trajectories in the array engine.

    Parameters
    ----------
    method : OneStepMethod
    adaptive_state : AdaptiveState
        State of one trajectory, or of several along a leading axis.
    advance : function of (adaptive_state, max_attempts, with_newton) to an AdaptiveState
        See :func:`.pacing.advance_adaptive`.
    is_single : bool
        Whether there is only one trajectory, without the leading axis.
    """

    def __init__(
        self, method: OneStepMethod, adaptive_state: AdaptiveState, advance: Callable, is_single: bool = False
    ):
        self.adaptive_state, self._advance, self._is_single = adaptive_state, advance, is_single
        self.lazy_newton = LazyNewton(method)

    def read(self, field_name: str, indices: Any = slice(None)) -> np.ndarray:
        """Return a field of ``State`` or ``AdaptiveState`` of the chosen trajectories, trajectories first."""
        value = np.asarray(
            getattr(self.adaptive_state.state if field_name in State._fields else self.adaptive_state, field_name)
        )
        return (value[None] if self._is_single else value)[indices]

    def write(self, field_name: str, indices: np.ndarray | slice, values) -> None:
        values_of_all = self.read(field_name).copy()
        values_of_all[indices] = values
        changes = {field_name: jnp.asarray(values_of_all[0] if self._is_single else values_of_all)}
        is_state_field = field_name in State._fields
        self.adaptive_state = self.adaptive_state._replace(
            **{"state": self.adaptive_state.state._replace(**changes)} if is_state_field else changes
        )

    def advance(self, max_attempts: int) -> None:
        """Make up to ``max_attempts`` attempts of each trajectory, fewer if it pauses."""
        self.adaptive_state = self.lazy_newton.advance_adaptive(
            lambda adaptive_state, newton: self._advance(adaptive_state, max_attempts, newton), self.adaptive_state
        )

    def state(self) -> State:
        """Return the state of the only trajectory."""
        return State(*(self.read(name)[0] for name in State._fields))

    def attempt_and_record(self, max_attempts: int) -> dict[str, np.ndarray]:
        """Make one attempt of the only trajectory and return its record, the fields ATTEMPT_FIELDS."""
        del max_attempts  # a single attempt: this engine does not record several at once
        self.advance(1)
        return {name: self.read(name) for name in ATTEMPT_FIELDS}


AdaptiveRuns: TypeAlias = ArrayAdaptiveRuns | CompiledAdaptiveRuns
"""Adaptive runs that advance together, each as it would alone; the attempts of a single one can be recorded."""


def start_adaptive_run(
    system: System,
    method: OneStepMethod,
    control: StepControl,
    x,
    t,
    stop_time,
    span_length,
    step: Callable | None = None,
) -> ArrayAdaptiveRuns:
    """Start an adaptive run of one trajectory; ``step`` takes the steps of an engine that runs on the host."""
    adaptive_state = initial_adaptive_state_program(
        system, method, control, jnp.asarray(x), *map(jnp.asarray, map(float, (t, stop_time, span_length)))
    )

    def advance_one(adaptive_state: AdaptiveState, max_attempts: int, newton: bool) -> AdaptiveState:
        if step is not None:
            return advance_adaptive_with(step, system, method, control, adaptive_state, max_attempts)
        return advance_adaptive(
            system, method, control, adaptive_state, jnp.asarray(max_attempts), DEFAULT_OPTIONS, newton
        )

    run = ArrayAdaptiveRuns(method, adaptive_state, advance_one, True)
    run.lazy_newton.has_newton |= step is not None  # a host engine has its own Newton's method
    return run


def resume_on_array_engine(
    system: System, method: OneStepMethod, control: StepControl, previous_run: AdaptiveRuns
) -> ArrayAdaptiveRuns:
    """Return an array run that resumes the only trajectory of ``previous_run`` from its current state."""
    run = start_adaptive_run(
        system, method, control, *(previous_run.read(name)[0] for name in ("x", "t", "stop_time", "stop_time"))
    )
    for name in (*State._fields, *AdaptiveState._fields[1:]):
        run.write(name, slice(None), previous_run.read(name).reshape(run.read(name).shape))
    return run


def start_adaptive_runs(
    structure: ProgramStructure,
    parameters,
    axes,
    method: OneStepMethod,
    control: StepControl,
    x,
    t,
    stop_time,
    span_length,
) -> ArrayAdaptiveRuns:
    """Start the adaptive runs of all trajectories of a batch, in one program."""
    static_inputs = structure, parameters, axes, method, control
    adaptive_state = _start_batch_program(
        *static_inputs, jnp.asarray(x), *map(jnp.asarray, map(float, (t, stop_time, span_length)))
    )
    return ArrayAdaptiveRuns(
        method,
        adaptive_state,
        lambda pace, max_attempts, newton: _advance_batch_program(
            *static_inputs, pace, jnp.asarray(max_attempts), newton
        ),
    )


@jit_cached
def _start_batch_program(structure, parameters, axes, method, control, x, t, stop_time, span_length):
    def start_member(p, x):
        return initial_adaptive_state(structure.rebuild(p), method, control, x, t, stop_time, span_length)

    return jax.vmap(start_member, in_axes=(axes, 0))(parameters, x)


@jit_cached
def _advance_batch_program(structure, parameters, axes, method, control, adaptive_states, max_attempts, newton: bool):
    def advance_member(p, adaptive_state):
        return advance_adaptive(
            structure.rebuild(p), method, control, adaptive_state, max_attempts, DEFAULT_OPTIONS, newton
        )

    return jax.vmap(advance_member, in_axes=(axes, 0))(parameters, adaptive_states)


EVENT_ZERO_ULPS = 2.0**10
"""Largest event value, in roundings of the event function, that counts as zero."""


def _event_rounding(model: tuple[System, Any], x) -> jax.Array:
    """Return the rounding error scale of the event function at x, including the rounding of x itself."""
    system, event_function = model
    return propagated_rounding_scale(
        lambda y: event_function(system, y), x, jnp.maximum(jnp.abs(x), system.component_scales(x))
    )


# -- pauses -----------------------------------------------------------------------------------------------------------


class PauseHandler:
    """Host-side handling of the pauses of adaptive runs.

    Parameters
    ----------
    adaptive_runs : AdaptiveRuns
    control : StepControl
    method : OneStepMethod
    stop_times : array
        Times at which steps have to end, increasing; the last is the end of the span.
    system_of : function from the index of a trajectory to its system

    Attributes
    ----------
    sign_jumps : list of float
        Times at which the event function changed its sign without being zero.
    """

    def __init__(
        self,
        adaptive_runs: AdaptiveRuns,
        control: StepControl,
        method: OneStepMethod,
        stop_times: np.ndarray,
        system_of: Callable,
    ):
        self.adaptive_runs = adaptive_runs
        self.control = control
        self.method = method
        self.stop_times = stop_times
        self.system_of = system_of
        self.sign_jumps: list[float] = []

    def paused_indices(self, reason: int) -> np.ndarray:
        """Return the indices of the trajectories that pause for ``reason``."""
        return np.flatnonzero(self.adaptive_runs.read("status") == reason)

    def confirm_events(self) -> None:
        """Decide for each trajectory paused at a sign change whether it is an event: a zero, to rounding.

        A trajectory at a jump or a pole resumes after it, as after a stop. If the function is NaN between the two
        signs, it is unknown whether the event happens, and the run ends. If only falls are events, a jump is an event
        too.
        """
        runs, indices = self.adaptive_runs, self.paused_indices(StatusCode.PAUSED_AT_EVENT)
        if not indices.size:
            return
        value = runs.read("root_bracket", indices)[:, searching.LAST_VALUE_INDEX]
        value_before = runs.read("event_value", indices)
        is_zero = (
            np.isfinite(value) if self.control.falling_only else self._is_zero_to_rounding(indices, value, value_before)
        )
        runs.write("status", indices[is_zero], StatusCode.EVENT)
        is_unknown = ~is_zero & ~np.isfinite(value_before)
        runs.write("status", indices[is_unknown], StatusCode.NON_FINITE)
        is_jump = ~is_zero & ~is_unknown
        indices, t = indices[is_jump], runs.read("t", indices[is_jump])
        if indices.size:
            self.sign_jumps += t.tolist()
            runs.write("event_value", indices, -value_before[is_jump])
            runs.write("last_stop_time", indices, t)
            runs.write("steps_at_last_stop", indices, runs.read("step", indices))
            runs.write(
                "status",
                indices,
                np.where(t >= runs.read("stop_time", indices), StatusCode.PAUSED_AT_STOP, StatusCode.COMPLETED),
            )

    def _is_zero_to_rounding(self, indices: np.ndarray, value: np.ndarray, value_before: np.ndarray) -> np.ndarray:
        """Return whether event values are zero, to rounding, given the values at the start of the steps.

        A value is zero if it is negligible relative to the value before. Otherwise it is compared with the rounding of
        the function, except near a pole, where the value has grown and its rounding is as large as the value.
        """
        magnitude, value_before = np.abs(value), np.abs(value_before)
        is_zero = (magnitude == 0.0) | ((magnitude <= EVENT_ZERO_ULPS * EPS * value_before) & np.isfinite(value_before))
        for group in self._group_by_system(
            indices[~is_zero & np.isfinite(magnitude) & (magnitude <= EVENT_ZERO_ULPS * value_before)]
        ):
            in_group, model = np.isin(indices, group), (self.system_of(int(group[0])), self.control.event_function)
            rounding_scales = evaluate_at_points(_event_rounding, model, self.adaptive_runs.read("x", group))
            is_zero[in_group] = magnitude[in_group] <= EVENT_ZERO_ULPS * EPS * np.where(
                np.isnan(rounding_scales), np.inf, rounding_scales
            )
        return is_zero

    def _group_by_system(self, indices: np.ndarray) -> list[np.ndarray]:
        """Return the indices of trajectories, one array for each system."""
        groups: dict[int, list[int]] = {}
        systems = [self.system_of(int(i)) for i in indices]  # kept alive, so that no id is used twice
        for i, system in zip(indices, systems, strict=True):
            groups.setdefault(id(system), []).append(int(i))
        return [np.array(group) for group in groups.values()]

    def resume_paused(self) -> None:
        """Resume the trajectories at a stop, finish those at their end, and compute missing growth rates."""
        runs, status = self.adaptive_runs, self.adaptive_runs.read("status")
        at_stop = np.flatnonzero(status == StatusCode.PAUSED_AT_STOP)
        if at_stop.size:
            t = runs.read("t", at_stop)
            is_done = t >= self.stop_times[-1]
            runs.write("status", at_stop[is_done], StatusCode.REACHED_END)
            at_stop, t = at_stop[~is_done], t[~is_done]
        if at_stop.size:
            runs.write("last_stop_time", at_stop, t)
            runs.write("steps_at_last_stop", at_stop, runs.read("step", at_stop))
            runs.write("stop_time", at_stop, self.stop_times[np.searchsorted(self.stop_times, t, side="right")])
        waiting = np.concatenate([at_stop, np.flatnonzero(status == StatusCode.PAUSED_FOR_GROWTH_RATE)])
        if not waiting.size:
            return
        without_rate = waiting[np.isnan(runs.read("growth_rate", waiting))]
        if without_rate.size:
            self._update_growth_rates(without_rate)
        is_exhausted = runs.read("n_attempts", waiting) >= float(self.control.max_attempts)
        runs.write("status", waiting, np.where(is_exhausted, StatusCode.STEP_LIMIT, StatusCode.COMPLETED))

    def _update_growth_rates(self, indices: np.ndarray) -> None:
        probes, runs = self.adaptive_runs.read("jacobian_probe", indices), self.adaptive_runs
        if probes.shape[2] <= DENSE_JACOBIAN_DIM:
            rates = max_growth_rates(probes)
        else:
            x = runs.read("x", indices)
            rates = np.array([growth_rate_at(self.system_of(int(i)), self.method, x[j]) for j, i in enumerate(indices)])
        max_steps = np.divide(
            max_growth_per_step(self.method), rates, out=np.full(len(rates), np.inf), where=rates > 0.0
        )
        runs.write("growth_rate", indices, rates)
        runs.write("next_step_size", indices, np.minimum(runs.read("next_step_size", indices), max_steps))
