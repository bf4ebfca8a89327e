"""Adaptive runs of one or many trajectories, and the host's handling of their pauses, for every engine."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np

from ..functions.rounding import propagated_rounding_scale
from ..integrators import OneStepMethod
from ..systems import System
from ..tracing.interpret import evaluate_at_points
from ..tracing.programs import jit_cached
from .adaptive_steps import (
    ATTEMPT_FIELDS,
    advance_adaptive,
    advance_adaptive_on_host,
    initial_adaptive_state,
    initial_adaptive_state_program,
)
from .array_engine import LazyNewton
from .compiled.engine import CompiledAdaptiveRuns
from .compiled.parameters import ProgramStructure
from .solver_options import DEFAULT_OPTIONS, EPS
from .status_codes import StatusCode
from .step import State
from .step_control import (
    DENSE_JACOBIAN_DIM,
    AdaptiveState,
    StepControl,
    largest_growth_rate_by_arnoldi,
    max_moduli_of_growing_eigenvalues,
    max_step_times_growth_rate_for_accuracy,
)


class ArrayAdaptiveRuns:
    """Adaptive runs of one or many trajectories in the array engine.

    Parameters
    ----------
    method : OneStepMethod
    adaptive_state : AdaptiveState
        State of one trajectory, or of several along a leading axis.
    advance : function of (adaptive_state, max_attempts, with_newton) to an AdaptiveState
        See :func:`.adaptive_steps.advance_adaptive`.
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
        """Set a field of ``State`` or ``AdaptiveState`` of the chosen trajectories to values, trajectories first."""
        values_of_all = self.read(field_name).copy()
        values_of_all[indices] = values
        changes = {field_name: jnp.asarray(values_of_all[0] if self._is_single else values_of_all)}
        is_state_field = field_name in State._fields
        self.adaptive_state = self.adaptive_state._replace(
            **{"state": self.adaptive_state.state._replace(**changes)} if is_state_field else changes
        )

    def advance(self, max_attempts: int) -> None:
        """Make up to ``max_attempts`` attempts of a step in each trajectory, fewer if it pauses."""
        self.adaptive_state = self.lazy_newton.advance_adaptive(
            lambda adaptive_state, with_newton: self._advance(adaptive_state, max_attempts, with_newton),
            self.adaptive_state,
        )

    def state_of_only_trajectory(self) -> State:
        """Return the state of the only trajectory."""
        return State(*(self.read(name)[0] for name in State._fields))

    def record_attempts(self, max_attempts: int) -> dict[str, np.ndarray]:
        """Make one attempt of a step of the only trajectory; return its record by the names in ATTEMPT_FIELDS."""
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
    host_step: Callable | None = None,
) -> ArrayAdaptiveRuns:
    """Return the adaptive run of one trajectory from x; ``host_step`` takes the steps of an engine on the host."""
    adaptive_state = initial_adaptive_state_program(
        system, method, control, jnp.asarray(x), *map(jnp.asarray, map(float, (t, stop_time, span_length)))
    )

    def advance_one(adaptive_state: AdaptiveState, max_attempts: int, with_newton: bool) -> AdaptiveState:
        if host_step is not None:
            return advance_adaptive_on_host(host_step, system, method, control, adaptive_state, max_attempts)
        return advance_adaptive(
            system, method, control, adaptive_state, jnp.asarray(max_attempts), DEFAULT_OPTIONS, with_newton
        )

    run = ArrayAdaptiveRuns(method, adaptive_state, advance_one, True)
    run.lazy_newton.has_newton |= host_step is not None  # a host engine has its own Newton's method
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
    """Return the adaptive runs of all trajectories of a batch, shape (trajectories, n), in one program."""
    static_inputs = structure, parameters, axes, method, control
    adaptive_state = _start_batch_program(
        *static_inputs, jnp.asarray(x), *map(jnp.asarray, map(float, (t, stop_time, span_length)))
    )
    return ArrayAdaptiveRuns(
        method,
        adaptive_state,
        lambda adaptive_state, max_attempts, with_newton: _advance_batch_program(
            *static_inputs, adaptive_state, jnp.asarray(max_attempts), with_newton
        ),
    )


@jit_cached
def _start_batch_program(structure, parameters, axes, method, control, x, t, stop_time, span_length):
    """Return the initial adaptive states of a batch, with a leading axis of trajectories."""

    def start_member(p, x):
        return initial_adaptive_state(structure.rebuild(p), method, control, x, t, stop_time, span_length)

    return jax.vmap(start_member, in_axes=(axes, 0))(parameters, x)


@jit_cached
def _advance_batch_program(
    structure, parameters, axes, method, control, adaptive_states, max_attempts, with_newton: bool
):
    """Return the adaptive states of a batch after up to ``max_attempts`` attempts of each trajectory."""

    def advance_member(p, adaptive_state):
        return advance_adaptive(
            structure.rebuild(p), method, control, adaptive_state, max_attempts, DEFAULT_OPTIONS, with_newton
        )

    return jax.vmap(advance_member, in_axes=(axes, 0))(parameters, adaptive_states)


EVENT_ZERO_ULPS = 2.0**10
"""Largest event value, in roundings of the event function, that counts as zero."""


def _event_rounding_scale(event_model: tuple[System, Any], time_and_state) -> jax.Array:
    """Return the scale of the rounding error of an event function at (t, x), including the rounding of x."""
    (system, event_function), t, x = event_model, time_and_state[0], time_and_state[1:]
    return propagated_rounding_scale(
        lambda y: event_function(system, t, y), x, jnp.maximum(jnp.abs(x), system.slope_scales(x))
    )


DIFFERENCE_STEP = 1e-6
"""Relative step of the differences of an event function that cannot be traced."""


def _event_rounding_scale_by_differences(event_model: tuple[System, Any], time_and_state: np.ndarray) -> float:
    """Return the scale of the rounding error of an untraceable event function, due to the rounding of x."""
    (system, event_function), t, x = event_model, time_and_state[0], time_and_state[1:]
    scales, directions = np.maximum(np.abs(x), system.slope_scales(x)), np.random.default_rng(0)
    derivatives = []
    for _ in range(4):
        h = DIFFERENCE_STEP * scales * directions.choice([-1.0, 1.0], len(x))
        ends = [float(event_function(system, t, jnp.asarray(x + s * h))) for s in (1.0, -1.0)]
        derivatives.append(abs(ends[0] - ends[1]) / (2.0 * DIFFERENCE_STEP))
    return max(derivatives)


class EventRules(NamedTuple):
    """For each event function, how many zeros end the run, and whether jumps count as events.

    Attributes
    ----------
    terminal_counts : tuple of int or None
        For each function the number of zeros that ends the run; None if it never ends the run.
    counts_jumps : tuple of bool
        For each function whether a change of sign without a zero is an event too.
    """

    terminal_counts: tuple[int | None, ...] = ()
    counts_jumps: tuple[bool, ...] = ()


class EventOccurrence(NamedTuple):
    """An event of one trajectory, with the indices of trajectory and function, the time and the state, shape (n,)."""

    trajectory: int
    function: int
    t: float
    x: np.ndarray


# -- pauses -----------------------------------------------------------------------------------------------------------


class PauseHandler:
    """Handler of the pauses of adaptive runs on the host: it records events, and ends or resumes trajectories.

    Parameters
    ----------
    adaptive_runs : AdaptiveRuns
    control : StepControl
    method : OneStepMethod
    stop_times : array
        Times at which steps have to end, increasing; the last is the end of the span.
    system_of : function from the index of a trajectory to its system
    rules : EventRules

    Attributes
    ----------
    occurrences : list of EventOccurrence
        Events since the list was last emptied.
    sign_jumps : list of (int, float)
        Numbers of event functions that changed their sign without being zero, and the times.
    undefined_ends : list of (int, float)
        Numbers of event functions that were NaN between opposite signs, and the times at which they are numbers again.
    """

    def __init__(
        self,
        adaptive_runs: AdaptiveRuns,
        control: StepControl,
        method: OneStepMethod,
        stop_times: np.ndarray,
        system_of: Callable,
        rules: EventRules,
    ):
        self.adaptive_runs = adaptive_runs
        self.control = control
        self.method = method
        self.stop_times = stop_times
        self.system_of = system_of
        self.rules = rules
        self.occurrences: list[EventOccurrence] = []
        self.sign_jumps: list[tuple[int, float]] = []
        self.undefined_ends: list[tuple[int, float]] = []
        self._event_counts = np.zeros((len(adaptive_runs.read("t")), len(rules.counts_jumps)), dtype=int)

    def keep_trajectories(self, indices: np.ndarray) -> None:
        """Drop the counts of all trajectories except the chosen ones, after the runs have dropped them."""
        self._event_counts = self._event_counts[indices]

    def paused_indices(self, reason: int) -> np.ndarray:
        """Return the indices of the trajectories that pause for a reason, a StatusCode."""
        return np.flatnonzero(self.adaptive_runs.read("status") == reason)

    def end_or_resume_at_sign_changes(self) -> None:
        """End or resume each trajectory that has paused at a sign change of an event function; record events.

        A zero, to rounding, is an event, and so is a jump or a pole if jumps count as events. The run ends at the last
        event that it waits for; otherwise it resumes. If a function is NaN between the two signs, it is unknown whether
        the event happens, and the run ends, unless jumps count as events.
        """
        runs, indices = self.adaptive_runs, self.paused_indices(StatusCode.PAUSED_AT_EVENT)
        if not indices.size:
            return
        values_before = runs.read("event_values", indices)
        values = runs.read("root_bracket", indices)[:, -values_before.shape[1] :]
        t, status = runs.read("t", indices), np.full(len(indices), StatusCode.COMPLETED)
        has_changed = self._has_changed_sign(values_before, values)
        for function_index, counts_jumps in enumerate(self.rules.counts_jumps):
            rows = np.flatnonzero(has_changed[:, function_index])
            old_values, new_values = values_before[rows, function_index], values[rows, function_index]
            is_known = np.isfinite(old_values)
            is_zero = is_known & (
                counts_jumps | self._is_zero_to_rounding(indices[rows], function_index, new_values, old_values)
            )
            self.sign_jumps += [(function_index, time) for time in t[rows[is_known & ~is_zero]].tolist()]
            if counts_jumps:
                self.undefined_ends += [(function_index, time) for time in t[rows[~is_known]].tolist()]
            else:
                status[rows[~is_known]] = StatusCode.NON_FINITE
            for row in rows[is_zero]:
                trajectory = int(indices[row])
                x = runs.read("x", indices[row : row + 1])[0]
                self.occurrences.append(EventOccurrence(trajectory, function_index, float(t[row]), x))
                self._event_counts[trajectory, function_index] += 1
                if self._event_counts[trajectory, function_index] == self.rules.terminal_counts[function_index]:
                    status[row] = StatusCode.EVENT
        resumes = status == StatusCode.COMPLETED
        status[resumes & (t >= runs.read("stop_time", indices))] = StatusCode.PAUSED_AT_STOP
        runs.write("status", indices, status)
        signed_values = np.where(has_changed, -np.sign(values_before) * np.fmin(np.abs(values_before), 1e300), values)
        next_values = np.where(np.isnan(signed_values), values_before, signed_values)
        if not resumes.any():
            return
        runs.write("event_values", indices[resumes], next_values[resumes])
        if not self.control.adaptive:  # the steps go on to the times at which they would have ended
            start, step = runs.read("last_stop_time", indices), float(self.control.first_step)
            n_done = np.floor((t - start) / step * (1 + 1e-12))
            runs.write("steps_at_last_stop", indices[resumes], (runs.read("step", indices) - n_done)[resumes])

    def _has_changed_sign(self, values_before: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Return whether each event function has changed sign at a pause: bools, shape (trajectories, functions).

        At least one has: the one that is nearest to its zero may still have the sign before.
        """
        is_in_direction = np.asarray(self.control.event_directions) * np.sign(values_before) <= 0.0
        with np.errstate(invalid="ignore", divide="ignore"):
            ratios = values / np.where(np.isinf(values_before), np.sign(values_before), values_before)
        can_change = (values_before != 0.0) & is_in_direction & ~np.isnan(ratios)
        ratios = np.where(can_change, ratios, np.inf)
        return can_change & ((ratios <= 0.0) | (ratios == ratios.min(axis=1, keepdims=True)))

    def _is_zero_to_rounding(
        self, indices: np.ndarray, function_index: int, value: np.ndarray, value_before: np.ndarray
    ):
        """Return whether values of an event function, shape (m,), are zero to rounding: bools, shape (m,).

        A value is zero if it is negligible relative to the value before. Otherwise it is compared with the rounding of
        the function, except near a pole, where the value has grown and its rounding is as large as the value.
        """
        magnitude, value_before = np.abs(value), np.abs(value_before)
        is_zero = (magnitude == 0.0) | ((magnitude <= EVENT_ZERO_ULPS * EPS * value_before) & np.isfinite(value_before))
        for group in self._group_by_system(
            indices[~is_zero & np.isfinite(magnitude) & (magnitude <= EVENT_ZERO_ULPS * value_before)]
        ):
            is_in_group = np.isin(indices, group)
            model = self.system_of(int(group[0])), self.control.event_functions[function_index]
            times_and_states = np.column_stack([self.adaptive_runs.read(name, group) for name in ("t", "x")])
            rounding_scales = (
                np.array([_event_rounding_scale_by_differences(model, row) for row in times_and_states])
                if model[1].calls_python
                else evaluate_at_points(_event_rounding_scale, model, times_and_states)
            )
            is_zero[is_in_group] = magnitude[is_in_group] <= EVENT_ZERO_ULPS * EPS * np.where(
                np.isnan(rounding_scales), np.inf, rounding_scales
            )
        return is_zero

    def _group_by_system(self, indices: np.ndarray) -> list[np.ndarray]:
        """Return the indices of trajectories grouped by system, a list with one array for each system."""
        groups: dict[int, list[int]] = {}
        systems = [self.system_of(int(i)) for i in indices]  # kept alive, so that no id is used twice
        for i, system in zip(indices, systems, strict=True):
            groups.setdefault(id(system), []).append(int(i))
        return [np.array(group) for group in groups.values()]

    def resume_paused(self) -> None:
        """Resume paused trajectories, finish those at their end, and compute the growth rates that they lack."""
        runs, status = self.adaptive_runs, self.adaptive_runs.read("status")
        stopped_indices = np.flatnonzero(status == StatusCode.PAUSED_AT_STOP)
        if stopped_indices.size:
            t = runs.read("t", stopped_indices)
            is_done = t >= self.stop_times[-1]
            runs.write("status", stopped_indices[is_done], StatusCode.REACHED_END)
            stopped_indices, t = stopped_indices[~is_done], t[~is_done]
        if stopped_indices.size:
            runs.write("last_stop_time", stopped_indices, t)
            runs.write("steps_at_last_stop", stopped_indices, runs.read("step", stopped_indices))
            runs.write("stop_time", stopped_indices, self.stop_times[np.searchsorted(self.stop_times, t, side="right")])
        resumable_indices = np.concatenate(
            [stopped_indices, np.flatnonzero(status == StatusCode.PAUSED_FOR_GROWTH_RATE)]
        )
        if not resumable_indices.size:
            return
        indices_lacking_rate = resumable_indices[np.isnan(runs.read("growth_rate", resumable_indices))]
        if indices_lacking_rate.size:
            self._update_growth_rates_and_step_sizes(indices_lacking_rate)
        is_exhausted = runs.read("n_attempts", resumable_indices) >= float(self.control.max_attempts)
        runs.write("status", resumable_indices, np.where(is_exhausted, StatusCode.STEP_LIMIT, StatusCode.COMPLETED))

    def _update_growth_rates_and_step_sizes(self, indices: np.ndarray) -> None:
        """Compute the growth rates of trajectories, and limit their next steps by them."""
        probes, runs = self.adaptive_runs.read("jacobian_probe", indices), self.adaptive_runs
        if probes.shape[2] <= DENSE_JACOBIAN_DIM:
            rates = max_moduli_of_growing_eigenvalues(probes)
        else:
            x = runs.read("x", indices)
            rates = np.array(
                [
                    largest_growth_rate_by_arnoldi(self.system_of(int(i)), self.method, x[j])
                    for j, i in enumerate(indices)
                ]
            )
        max_steps = np.divide(
            max_step_times_growth_rate_for_accuracy(self.method),
            rates,
            out=np.full(len(rates), np.inf),
            where=rates > 0.0,
        )
        runs.write("growth_rate", indices, rates)
        runs.write("next_step_size", indices, np.minimum(runs.read("next_step_size", indices), max_steps))
