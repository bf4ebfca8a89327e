"""The only time loop: a run under way, what is kept of it, and how it ended."""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from manifolds.errors import warn

from ..engines.choice import EngineWithFallback
from ..engines.codes import StatusCode
from ..engines.stepping import energy_and_entropy_at
from ..errors import FileError
from ..integrators import Reference
from ..integrators.fluctuating import noise_dimension
from ..results.dense import DenseOutput
from ..results.solution import Solution
from ..results.status import Stats, Status
from ..tracing.interpret import evaluate_at_points
from .adaptive import Adaptive, make_step_control
from .ending import INTERRUPTING_ERRORS, adaptive_failure_status, final_status, interruption_reason, run_statistics
from .events import Event
from .fluctuations import Fluctuations, NoisePaths
from .preparation import limit_to_span
from .presented import EngineReplay, build_solution, run_provenance
from .stepwise import MAX_STORED_VALUES, AcceptedSteps, advance_to_end
from .timetable import StepSchedule
from .watch import EventSet

MAX_PROVENANCE_COMPONENTS = 1_000
"""Components up to which the first state is listed in the provenance; an attribute of a file cannot be of any size."""

CHECKPOINT_SECONDS = 60.0
"""A run with ``save_to`` rewrites its file at most this often before the end."""


ENDLESS_SPAN_LENGTH = 1.0
"""The length that an endless span counts for where the first step is a share of it, from a state at rest."""


class Run:
    """A run under way: what has been saved, and how it stands."""

    def __init__(
        self,
        system,
        method,
        x0,
        course: StepSchedule,
        save_to,
        engine: str,
        noise: Fluctuations | None = None,
        dense: bool = False,
    ):
        self.system_without_span, self.system = system, limit_to_span(system, course.start, course.end)
        self.method, self.schedule = method, course
        self.save_to, self.start_wall_time = save_to, time.perf_counter()
        self.last_checkpoint_time = self.start_wall_time
        self.saved_times = [np.array([course.start])]
        self.saved_states = [np.asarray(x0)[None]]
        self.saved_energies_entropies: list[np.ndarray] = []  # energies and entropies of the states
        self.status: Status | None = None
        self.stats = Stats()
        self.step: float | Adaptive = course.h
        self.event_time: float | None = None
        self.all_states = [(self.saved_times[0], self.saved_states[0])] if dense else None  # all states
        self.taken_steps: list[
            np.ndarray
        ] = []  # sizes of steps that are looked at, and whether states after them are kept
        self.noise = noise
        path: Callable | None = None
        if noise is not None and (increments := noise_dimension(method)):
            only = NoisePaths(noise, increments, np.zeros(1, dtype=int), course)
            path = lambda first, steps, h: only.step_increments(slice(None), first, steps, h)[0]  # noqa: E731
        self.engine = EngineWithFallback(self.system, method, engine, course.n_steps, path)

    @property
    def last_saved_time(self) -> float:
        """The time of the last state that is kept."""
        return next(float(times[-1]) for times in reversed(self.saved_times) if len(times))

    # -- the library's own methods ----------------------------------------------------------------------------------

    def run_fixed(self, bar) -> None:
        """Drive the engine call by call, to the end, a failure or Ctrl-C."""
        state, stopped = None, ""
        try:
            state = self.engine.initial_run_state(self.saved_states[0][0])
            self.saved_energies_entropies = [np.array([[float(state.energy), float(state.entropy)]])]
            for h, saves, every, kept in self.schedule.engine_calls(
                max_saves=self.engine.max_saves_per_call, save_all=self.all_states is not None
            ):
                state = self._advance_and_save(state, h, saves, every, kept)
                bar.update(float(self.schedule.times_after(np.asarray(int(state.step)))))
                if int(state.status) != StatusCode.COMPLETED:
                    break
                self._checkpoint(state)
        except INTERRUPTING_ERRORS as error:
            stopped = interruption_reason(error)
        if state is None:
            self._set_interrupted_at_start(stopped)
            return
        step = int(state.step)
        now, h = float(self.schedule.times_after(np.asarray(step))), self.schedule.step_size_after(step)
        if now > self.last_saved_time:  # it ended between two states that are kept
            self._save_states(
                np.array([now]), np.asarray(state.x)[None], np.array([[float(state.energy), float(state.entropy)]])
            )
        self.stats, self.status = run_statistics(state), final_status(self.engine, state, now, h, stopped)

    def _set_interrupted_at_start(self, stopped: str) -> None:
        self.saved_energies_entropies = [self._energies_and_entropies(self.saved_states[0])]
        self.status = Status(StatusCode.INTERRUPTED, f"stopped {stopped} before the first step", 0, self.schedule.start)

    def take_no_step(self) -> None:
        """Complete a run over a span of length zero."""
        self.saved_energies_entropies = [self._energies_and_entropies(self.saved_states[0])]
        self.status = Status(
            StatusCode.COMPLETED, f"reached t = {self.schedule.end:g} in 0 steps", 0, self.schedule.end
        )

    def run_with_step_control(self, bar, step: float | Adaptive, until) -> None:
        """Look at every step: adaptive ones, and those with events."""
        start, end, every = self.schedule.start, self.schedule.end, self.schedule.save_every or 1
        at_stops, watch = self.schedule.save_every is None, until if isinstance(until, EventSet) else None
        stops = self.schedule.stop_times
        event = None if until is None or watch else Event(until, self.system)
        self.step, last = step, None

        def save_steps(steps: AcceptedSteps):
            nonlocal last
            ends = steps.t[1:]
            kept = np.isin(ends, stops) if at_stops else steps.step_counts % every == 0
            self._save_steps(steps, kept)
            self.taken_steps.append(np.stack([steps.h, kept]))
            last = None if kept[-1] else steps
            if self.all_states is not None:
                self.all_states.append((ends, steps.x))
            bar.update(ends[-1])
            self._checkpoint(steps.state_after)

        length = end - start if math.isfinite(end) else ENDLESS_SPAN_LENGTH
        pacing = make_step_control(step, self.method, end - start, event)
        try:
            paces = self.engine.start_adaptive(pacing, self.saved_states[0][0], start, float(stops[0]), length)
        except INTERRUPTING_ERRORS as error:
            self._set_interrupted_at_start(interruption_reason(error))
            return
        state = paces.state()
        self.saved_energies_entropies = [np.array([[float(state.energy), float(state.entropy)]])]
        numbers = self.system.dim * ((0 if at_stops else 1) / every + (self.all_states is not None))
        room = MAX_STORED_VALUES / max(numbers, 1e-9)
        outcome = advance_to_end(self.engine, paces, pacing, stops, save_steps, room, watch)
        if last is not None:
            self._save_steps(last, slice(-1, None))
        self.event_time = outcome.event_time
        state, now = outcome.state, self.last_saved_time
        self.stats = dataclasses.replace(run_statistics(state), rejected=outcome.n_rejected)
        steps = int(state.step)
        if isinstance(step, Adaptive) and (
            outcome.underflow_step_size is not None or outcome.exhausted_limit in ("steps", "memory")
        ):
            self.status = adaptive_failure_status(
                self.system, self.method, np.asarray(self.saved_states[0][0]), outcome, step, (start, end), now
            )
        elif outcome.unknown_state_error is not None:
            self.status = Status(
                outcome.unknown_state_error.code, str(outcome.unknown_state_error), steps, now, float(state.residual)
            )
        elif event is not None and outcome.exhausted_limit:
            text = f"{event.name} is not a number at some states near t = {now:g}, and has other signs before and "
            text += "after: whether it is zero there is not known, so extend the function"
            self.status = Status(StatusCode.NON_FINITE, text, steps, now, float(state.residual))
        elif outcome.event_time is not None:
            text = f"{EventSet.name if event is None else event.name}: reached at t = {now:.15g} in {steps} steps"
            self.status = Status(StatusCode.EVENT, text, steps, now, float(state.residual))
        else:
            h = step if isinstance(step, float) else float("nan")
            self.status = final_status(self.engine, state, now, h, outcome.interruption)
            if watch and watch.why_undefined and self.status.ok:
                self.status = dataclasses.replace(self.status, message=f"{self.status.message}; {watch.why_undefined}")
            if event is not None and self.status.ok:
                text = f"{self.status.message}; the event ({event.name}) did not happen"
                if outcome.sign_jumps:
                    text += f": it changed its sign {len(outcome.sign_jumps)} times without being zero, first at t = "
                    text += f"{outcome.sign_jumps[0]:g}"
                if outcome.is_event_undefined:
                    text = f"{self.status.message}; whether the event ({event.name}) happened is not known, since the "
                    text += "function is NaN at the end. Define it for all states of the run"
                self.status = dataclasses.replace(self.status, message=text)

    def _save_steps(self, steps: AcceptedSteps, kept: np.ndarray | slice) -> None:
        self._save_states(steps.t[1:][kept], steps.x[kept], np.column_stack([steps.energy, steps.entropy])[kept])

    def _advance_and_save(self, state, h, saves, every, kept: bool):
        before = int(state.step)
        state, (x, energy, entropy, reached) = self.engine.advance(state, h, saves, every)
        number = int(np.asarray(reached).sum())
        steps, x = before + every * np.arange(1, number + 1), np.asarray(x)[:number]
        times, values = self.schedule.times_after(steps), np.column_stack([energy, entropy])[:number]
        if self.all_states is not None:
            self.all_states.append((times, x))
            chosen = np.isin(steps, self.schedule.saved_step_counts)
            times, x, values = times[chosen], x[chosen], values[chosen]
        if kept:
            self._save_states(times, x, values)
        return state

    def _save_states(self, times: np.ndarray, x: np.ndarray, values: np.ndarray) -> None:
        self.saved_times.append(times)
        self.saved_states.append(x)
        self.saved_energies_entropies.append(values)

    # -- SciPy --------------------------------------------------------------------------------------------------------

    def run_reference(self, bar) -> None:
        """One call of the reference solver, its output at the times a fixed step would have."""
        times = self.schedule.saved_times
        self.saved_energies_entropies = [self._energies_and_entropies(self.saved_states[0])]
        x, evaluations, message, interrupted = self.method.trajectory(self.system, self.saved_states[0][0], times)
        self.saved_times, self.saved_states = [times[: len(x)]], [x]
        self.saved_energies_entropies = [self._energies_and_entropies(x)]
        self.stats = Stats(steps=len(x) - 1, fixed_point_iterations=evaluations)
        now = self.last_saved_time
        bar.update(now)
        if interrupted:
            text = f"stopped by the user after t = {now:g}"
            self.status = Status(StatusCode.INTERRUPTED, text, len(x) - 1, now)
        elif message:
            text = f"SciPy's {self.method.scheme} stopped after t = {now:g}: {message}"
            self.status = Status(StatusCode.REFERENCE_FAILED, text, len(x) - 1, now)
        else:
            self.status = Status(StatusCode.COMPLETED, f"reached t = {now:g}", len(x) - 1, now)

    def _energies_and_entropies(self, x: np.ndarray) -> np.ndarray:
        return np.stack(evaluate_at_points(energy_and_entropy_at, self.system, x), axis=1)

    # -- the result ---------------------------------------------------------------------------------------------------

    def solution(self) -> Solution:
        """What there is so far."""
        x = np.concatenate(self.saved_states)
        energy, entropy = np.concatenate(self.saved_energies_entropies).T
        return build_solution(
            self.system,
            self.method,
            x,
            t=np.concatenate(self.saved_times),
            energy=energy,
            entropy=entropy,
            step_sizes=self._longest_steps_between_saves(len(x) - 1),
            replay=EngineReplay(self.engine),
            system_without_span=self.system_without_span,
            status=self.status or Status(StatusCode.INTERRUPTED, "still running", len(x) - 1, self.last_saved_time),
            stats=dataclasses.replace(self.stats, wall_time=time.perf_counter() - self.start_wall_time),
            provenance=self._provenance(),
            event_time=self.event_time,
            dense=self._dense_output(),
        )

    def _dense_output(self) -> DenseOutput | None:
        if self.all_states is None:
            return None
        times, states = zip(*self.all_states, strict=True)
        return DenseOutput(np.concatenate(times), np.concatenate(states), self.engine.step_ends)

    def _longest_steps_between_saves(self, number: int) -> np.ndarray:
        """The longest of the steps after each state that is kept."""
        if not self.taken_steps:
            return self.schedule.longest_steps[:number]
        h, kept = np.concatenate(self.taken_steps, axis=1)
        return np.maximum.reduceat(h, np.flatnonzero(np.append(1.0, kept[:-1])))[:number]

    def _checkpoint(self, state) -> None:
        if self.save_to is not None and time.perf_counter() - self.last_checkpoint_time > CHECKPOINT_SECONDS:
            self.stats = run_statistics(state)
            try:
                self.solution().save(self.save_to)
            except FileError as error:  # there may be room at the end
                warn(f"{error}. The run goes on")
            self.last_checkpoint_time = time.perf_counter()

    def _provenance(self) -> dict[str, Any]:
        return {
            **run_provenance(
                self.system, self.method, self.step, (self.schedule.start, self.schedule.end), self.schedule.save_every
            ),
            "engine": None if isinstance(self.method, Reference) else self.engine.name,
            "noise": None if self.noise is None else self.noise.as_provenance(),
            "x0": np.asarray(self.saved_states[0][0]).tolist()
            if self.system.dim <= MAX_PROVENANCE_COMPONENTS
            else None,
        }
