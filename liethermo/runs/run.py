"""The time loop of ``integrate``: one run, the states that it saves, and its final status."""

from __future__ import annotations

import dataclasses
import functools
import itertools
import math
import time
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from manifolds.errors import warn

from ..engines.status_codes import StatusCode
from ..engines.step import SavedStates, State, energy_and_entropy_at, system_and_state_after_jump
from ..errors import FileError
from ..integrators import Reference
from ..integrators.fluctuating import noise_dimension
from ..results.events import Events
from ..results.solution import DenseOutput, Solution, defer
from ..results.status import Stats, Status
from ..systems import System
from ..systems.clock import system_between_breaks
from ..tracing.interpret import evaluate_at_points
from .adaptive import Adaptive, make_step_control
from .adaptive_run import MAX_STORED_VALUES, AcceptedSteps, AdaptiveRun
from .driver import take_scheduled_steps
from .events import EventSet, collect_events
from .noise import NoisePaths
from .problem import Problem
from .schedule import EngineCall, StepSchedule
from .solution_builder import build_solution, run_provenance
from .termination import (
    INTERRUPTING_ERRORS,
    adaptive_failure_status,
    event_remarks,
    event_status,
    final_status,
    interruption_reason_or_reraise,
    run_statistics,
)

MAX_PROVENANCE_COMPONENTS = 1_000
"""Largest number of components of an initial state that the provenance lists; attributes of a file are limited in
size."""

CHECKPOINT_SECONDS = 60.0
"""Shortest time in seconds between two intermediate writes of the file ``save_to``."""


ENDLESS_SPAN_LENGTH = 1.0
"""Length assumed for an infinite span where the first step is a fraction of the span, as from a state at rest."""


class Run:
    """One run of ``integrate``: its engine, the states that it has saved, and its status."""

    def __init__(self, problem: Problem, x0, schedule: StepSchedule, save_to, engine: str, dense: bool = False):
        self.problem, self.method, self.schedule = problem, problem.method, schedule
        self.system = problem.system_limited_to_span(schedule)
        self.save_to, self.start_wall_time = save_to, time.perf_counter()
        self.last_checkpoint_time = self.start_wall_time
        self.saved_times = [np.array([schedule.start])]
        self.saved_states = [np.asarray(x0)[None]]
        self.n_saved = 1
        self.saved_energies_entropies: list[np.ndarray] = []  # shapes (saved states, 2)
        self.status: Status | None = None
        self.stats = Stats()
        self.step: float | Adaptive = schedule.h
        self.event_time: float | None = None
        self.events: Events = Events()
        self.all_states = [(self.saved_times[0], self.saved_states[0])] if dense else None  # for dense output
        self.taken_steps: list[np.ndarray] = []  # rows: step sizes, whether the state after the step is saved
        noise_increments: Callable | None = None
        if problem.noise is not None and (n_increments := noise_dimension(self.method)):
            noise_paths = NoisePaths(problem.noise, n_increments, np.zeros(1, dtype=int), schedule)

            def noise_increments(first_step: int, n_steps: int, h: float) -> np.ndarray:
                return noise_paths.step_increments(slice(None), first_step, n_steps, h)[0]

        self.engine = problem.engine_of_run(engine, self.system, schedule.n_steps, noise_increments)

    @property
    def last_saved_time(self) -> float:
        """Time of the last saved state."""
        return next(float(times[-1]) for times in reversed(self.saved_times) if len(times))

    def _elapsed_seconds(self) -> float:
        """Return the wall time in seconds since the run began."""
        return time.perf_counter() - self.start_wall_time

    # -- the library's own methods ----------------------------------------------------------------------------------

    def run_fixed_steps(self, progress_bar) -> None:
        """Take all steps of the schedule, one engine call after another, until the end, a failure or Ctrl-C."""
        trajectory, interruption = None, ""
        try:
            trajectory = self.engine.start(self.saved_states[0][0])
            self.saved_energies_entropies = [np.array([[trajectory.read("energy"), trajectory.read("entropy")]])]

            def record_call(engine_call: EngineCall, first_step: int, saved_states: SavedStates) -> bool:
                self._save_states_of_call(
                    saved_states, first_step, engine_call.steps_per_save, engine_call.are_states_saved
                )
                progress_bar.update(self.schedule.time_after(int(trajectory.read("step"))))
                if trajectory.read("status") != StatusCode.COMPLETED:
                    return False
                self._write_checkpoint_if_due(lambda: trajectory.state)
                return True

            calls = self.schedule.engine_calls(
                max_saves=self.engine.max_saves_per_call, save_all=self.all_states is not None
            )
            take_scheduled_steps(trajectory, calls, record_call)
        except INTERRUPTING_ERRORS as error:
            interruption = interruption_reason_or_reraise(error)
        if trajectory is None:
            self._set_interrupted_at_start(interruption)
            return
        state = trajectory.state
        step = int(state.step)
        t, h = self.schedule.time_after(step), self.schedule.step_size_after(step)
        if t > self.last_saved_time:  # the run ended between two saved states
            self._append_saved_states(
                np.array([t]), np.asarray(state.x)[None], np.array([[float(state.energy), float(state.entropy)]])
            )
        self.stats = run_statistics(state, self._elapsed_seconds())
        self.status = final_status(self.engine, state, t, h, interruption)

    def _set_interrupted_at_start(self, reason: str) -> None:
        self.saved_energies_entropies = [self._energies_and_entropies(self.saved_states[0])]
        self.status = Status(StatusCode.INTERRUPTED, f"stopped {reason} before the first step", 0, self.schedule.start)

    def complete_without_steps(self) -> None:
        """Complete a run over a span of length zero: record energy and entropy of the initial state and the status."""
        self.saved_energies_entropies = [self._energies_and_entropies(self.saved_states[0])]
        self.status = Status(
            StatusCode.COMPLETED, f"reached t = {self.schedule.end:g} in 0 steps", 0, self.schedule.end
        )

    def run_adaptive_or_until_event(self, progress_bar, step: float | Adaptive, until) -> None:
        """Take adaptive steps, or fixed steps with events, until the end, an event, a failure or Ctrl-C."""
        start, end, save_every = self.schedule.start, self.schedule.end, self.schedule.save_every or 1
        saves_at_stops, stop_times = self.schedule.save_every is None, self.schedule.stop_times
        saved_stop_times = self.schedule.saved_stop_times
        events = None if until is None else EventSet(until, self.system, start, self.saved_states[0][0])
        if events is not None and events.calls_python and self.engine.requested_engine == "auto":
            self.engine = self.problem.engine_of_run("array", self.system, 0)  # machine code does not call Python
        self.step, unsaved_steps = step, None

        def handle_accepted_steps(accepted_steps: AcceptedSteps):
            nonlocal unsaved_steps
            ends = accepted_steps.t[1:]
            is_saved = np.isin(ends, saved_stop_times)
            if not saves_at_stops:
                is_saved |= accepted_steps.step_counts % save_every == 0
            is_saved[-1] &= not accepted_steps.ends_at_event or ends[-1] in saved_stop_times
            self._save_accepted_steps(accepted_steps, is_saved)
            self.taken_steps.append(np.stack([accepted_steps.h, is_saved]))
            unsaved_steps = None if is_saved[-1] else accepted_steps
            if self.all_states is not None:
                self.all_states.append((ends, accepted_steps.x))
            progress_bar.update(ends[-1])
            self._write_checkpoint_if_due(lambda: accepted_steps.state_after)

        length = end - start if math.isfinite(end) else ENDLESS_SPAN_LENGTH
        control = make_step_control(step, self.method, end - start, events)
        try:
            adaptive_runs = self.engine.start_adaptive(
                control, self.saved_states[0][0], start, float(stop_times[0]), length
            )
        except INTERRUPTING_ERRORS as error:
            self._set_interrupted_at_start(interruption_reason_or_reraise(error))
            return
        state = adaptive_runs.state_of_only_trajectory()
        self.saved_energies_entropies = [np.array([[float(state.energy), float(state.entropy)]])]
        values_per_step = self.system.dim * ((0 if saves_at_stops else 1) / save_every + (self.all_states is not None))
        max_steps = MAX_STORED_VALUES / max(values_per_step, 1e-9)
        outcome = AdaptiveRun(self.engine, adaptive_runs, control, stop_times, handle_accepted_steps, max_steps, events)
        outcome.advance_to_end()
        if unsaved_steps is not None:
            self._save_accepted_steps(unsaved_steps, slice(-1, None))
        self.event_time = outcome.event_time
        if events is not None:
            self.events = collect_events(self.system, events.names, outcome.occurrences)
        state, t = outcome.state, self.last_saved_time
        self.stats = run_statistics(state, self._elapsed_seconds(), outcome.n_rejected)
        if isinstance(step, Adaptive) and (
            outcome.underflow_step_size is not None or outcome.exhausted_limit in ("steps", "memory")
        ):
            self.status = adaptive_failure_status(
                self.system, self.method, np.asarray(self.saved_states[0][0]), outcome, step, (start, end), t
            )
        elif events is not None and (outcome.exhausted_limit or outcome.event_time is not None):
            self.status = event_status(outcome, events.names, t)
        else:
            h = step if isinstance(step, float) else float("nan")
            self.status = final_status(self.engine, state, t, h, outcome.interruption)
            if events is not None and self.status.ok:
                text = self.status.message + event_remarks(outcome, events.names, events.rules.terminal_counts)
                self.status = dataclasses.replace(self.status, message=text)

    def _save_accepted_steps(self, accepted_steps: AcceptedSteps, selection: np.ndarray | slice) -> None:
        self._append_saved_states(
            accepted_steps.t[1:][selection],
            accepted_steps.x[selection],
            np.column_stack([accepted_steps.energy, accepted_steps.entropy])[selection],
        )

    def _save_states_of_call(
        self, saved_states: SavedStates, first_step: int, steps_per_save: int, are_states_saved: bool
    ) -> None:
        if self.all_states is not None:
            step_counts = first_step + steps_per_save * np.arange(1, len(saved_states.x) + 1)
            times = self.schedule.times_after(step_counts)
            self.all_states.append((times, saved_states.x))
            is_saved = np.isin(step_counts, self.schedule.saved_step_counts)
            self._append_saved_states(
                times[is_saved], saved_states.x[is_saved], saved_states.energy_and_entropy[is_saved]
            )
        elif are_states_saved:
            times = self.schedule.saved_times[self.n_saved : self.n_saved + len(saved_states.x)]
            self._append_saved_states(times, saved_states.x, saved_states.energy_and_entropy)

    def _append_saved_states(self, times: np.ndarray, states: np.ndarray, energies_entropies: np.ndarray) -> None:
        self.n_saved += len(times)
        self.saved_times.append(times)
        self.saved_states.append(states)
        self.saved_energies_entropies.append(energies_entropies)

    # -- SciPy --------------------------------------------------------------------------------------------------------

    def run_with_scipy(self, progress_bar) -> None:
        """Integrate with SciPy's solver, and save its states at the saved times of the schedule."""
        times = self.schedule.saved_times
        self.saved_energies_entropies = [self._energies_and_entropies(self.saved_states[0])]
        x, n_evaluations, message, was_interrupted = self._scipy_states_between_breaks(times)
        self.saved_times, self.saved_states = [times[: len(x)]], [x]
        self.saved_energies_entropies = [self._energies_and_entropies(x)]
        self.stats = Stats(steps=len(x) - 1, fixed_point_iterations=n_evaluations, wall_time=self._elapsed_seconds())
        t = self.last_saved_time
        progress_bar.update(t)
        if was_interrupted:
            text = f"stopped by the user after t = {t:g}"
            self.status = Status(StatusCode.INTERRUPTED, text, len(x) - 1, t)
        elif message:
            text = f"SciPy's {self.method.scheme} stopped after t = {t:g}: {message}"
            self.status = Status(StatusCode.REFERENCE_FAILED, text, len(x) - 1, t)
        else:
            self.status = Status(StatusCode.COMPLETED, f"reached t = {t:g}", len(x) - 1, t)

    def _scipy_states_between_breaks(self, times: np.ndarray) -> tuple[np.ndarray, int, str, bool]:
        """Return states, evaluations, message and interruption of SciPy's solver, which restarts at each break.

        See :meth:`liethermo.Reference.trajectory`.
        """
        break_indices = np.searchsorted(times, self.schedule.breaks)
        x, n_evaluations, energy = np.array(self.saved_states[0]), 0, self.saved_energies_entropies[0][0, 0]
        clock = self.system.clock
        for first_index, last_index in itertools.pairwise([0, *break_indices.tolist(), len(times) - 1]):
            system, x[-1] = system_and_state_after_jump(self.system, jnp.asarray(x[-1]), energy)
            states, n, message, was_interrupted = self.method.trajectory(
                system, x[-1], times[first_index : last_index + 1]
            )
            x, n_evaluations = np.concatenate([x, states[1:]]), n_evaluations + n
            if message or was_interrupted or len(states) <= last_index - first_index:
                break
            energy = system.energy.value(x[-1]) if clock is not None and clock.can_energy_jump else energy
        return x, n_evaluations, message, was_interrupted

    def _energies_and_entropies(self, x: np.ndarray) -> np.ndarray:
        return np.stack(evaluate_at_points(_energy_and_entropy_after_break, self.system, x), axis=1)

    # -- the result ---------------------------------------------------------------------------------------------------

    def solution_so_far(self) -> Solution:
        """Return the solution from the start to the last saved state."""
        x = np.concatenate(self.saved_states)
        energy, entropy = np.concatenate(self.saved_energies_entropies).T
        return build_solution(
            self.system,
            self.method,
            x,
            t=np.concatenate(self.saved_times),
            energy=energy,
            entropy=entropy,
            step_sizes=functools.partial(_longest_step_after_each_save, self.schedule, self.taken_steps, len(x) - 1),
            engine=self.engine,
            laws=self.problem.laws,
            functions=self.problem.functions,
            status=self.status or Status(StatusCode.INTERRUPTED, "still running", len(x) - 1, self.last_saved_time),
            stats=self.stats,
            provenance=self._deferred_provenance(x[0]),
            event_time=self.event_time,
            events=self.events,
            dense=self._dense_output(),
        )

    def _dense_output(self) -> DenseOutput | None:
        if self.all_states is None:
            return None
        times, states = zip(*self.all_states, strict=True)
        return DenseOutput(np.concatenate(times), np.concatenate(states), self.engine.step_ends)

    def _write_checkpoint_if_due(self, read_state: Callable[[], State]) -> None:
        """Write the solution so far to the file ``save_to``, at most once in ``CHECKPOINT_SECONDS``."""
        if self.save_to is not None and time.perf_counter() - self.last_checkpoint_time > CHECKPOINT_SECONDS:
            self.stats = run_statistics(read_state(), self._elapsed_seconds())
            try:
                self.solution_so_far().save(self.save_to)
            except FileError as error:  # the disk may have space again at the end
                warn(f"{error}. The run goes on")
            self.last_checkpoint_time = time.perf_counter()

    def _deferred_provenance(self, x0: np.ndarray) -> Any:
        noise, schedule = self.problem.noise, self.schedule
        return defer(
            functools.partial(
                run_provenance,
                self.system,
                self.method,
                self.step,
                (schedule.start, schedule.end),
                schedule.save_every,
                end_time=time.time(),
                engine=None if isinstance(self.method, Reference) else self.engine.name,
                noise=None if noise is None else noise.to_provenance(),
                x0=x0.tolist() if self.system.dim <= MAX_PROVENANCE_COMPONENTS else None,
                **({"breaks": list(schedule.all_breaks)} if schedule.all_breaks else {}),
            )
        )


def _energy_and_entropy_after_break(system: System, x) -> tuple[jax.Array, jax.Array]:
    """Return energy and entropy at a state x, shape (n,); at a break, their limits from after it.

    The work in the state includes the jump of the energy at the break.
    """
    return energy_and_entropy_at(system_between_breaks(system, x), x)


def _longest_step_after_each_save(
    schedule: StepSchedule, taken_steps: Sequence[np.ndarray], n_intervals: int
) -> np.ndarray:
    """Return the size of the longest step between each saved state and the next, shape (n_intervals,).

    ``taken_steps`` has the sizes of adaptive steps, and whether the state after each is saved.
    """
    if not taken_steps:
        return schedule.longest_step_after_each_save[:n_intervals]
    h, is_saved = np.concatenate(taken_steps, axis=1)
    return np.maximum.reduceat(h, np.flatnonzero(np.append(1.0, is_saved[:-1])))[:n_intervals]
