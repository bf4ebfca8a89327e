"""Runs that examine every step: adaptive steps, events, outputs at given times, dense output.

An engine takes the steps, and locates events. This module stops them at given times. The laws hold in every step.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from ..engines.adaptive_runs import AdaptiveRuns, EventOccurrence, EventRules, PauseHandler
from ..engines.select_engine import EngineWithFallback
from ..engines.status_codes import StatusCode
from ..engines.step import State
from ..engines.step_control import ATTEMPT_FIELDS, StepControl
from ..tracing.scalarize import UnsupportedPrimitive
from .driver import drive_adaptive
from .events import EventSet
from .termination import INTERRUPTING_ERRORS, interruption_reason

ATTEMPTS_PER_CALL = 64
"""Number of attempted steps between two checks of an adaptive run."""

MAX_STORED_VALUES = 2**28
"""Largest number of values that an adaptive run stores (2 GiB)."""


@dataclass
class RunOutcome:
    """Outcome of an adaptive run: its last state, and the reason why it ended."""

    state: Any
    n_rejected: int = 0
    event_time: float | None = None
    underflow_step_size: float | None = None
    interruption: str = ""
    events: list[EventOccurrence] = field(default_factory=list)
    sign_jumps: list[tuple[int, float]] = field(default_factory=list)  # event functions that jump across zero, times
    undefined_ends: list[tuple[int, float]] = field(default_factory=list)  # see PauseHandler
    undefined_events: list[int] = field(default_factory=list)  # numbers of event functions that are NaN at the end
    exhausted_limit: str = ""  # "steps" or "memory"; "sight" if an event function is NaN


class AcceptedSteps(NamedTuple):
    """Consecutive accepted steps of a run.

    Attributes
    ----------
    t : array, shape (m + 1,)
        Times at which the steps start, and the end of the last.
    h : array, shape (m,)
    x : array, shape (m, n)
        States after the steps, with ``energy`` and ``entropy``, shape (m,).
    step_counts : array, shape (m,)
        Number of steps of the run up to and including each, without those that end at an event.
    ends_at_event : bool
        Whether the last step ends at an event.
    state_after : State
        Engine state after the last step.
    """

    t: np.ndarray
    h: np.ndarray
    x: np.ndarray
    energy: np.ndarray
    entropy: np.ndarray
    step_counts: np.ndarray
    ends_at_event: bool
    state_after: State


StepCallback = Callable[[AcceptedSteps], None]
"""Function called with the steps that a run has accepted."""


def advance_to_end(
    engine: EngineWithFallback,
    adaptive_runs: AdaptiveRuns,
    control: StepControl,
    stops: np.ndarray,
    step_callback: StepCallback,
    max_steps: float = MAX_STORED_VALUES,
    events: EventSet | None = None,
    attempts_per_call: int = ATTEMPTS_PER_CALL,
) -> RunOutcome:
    """Advance a run until its end, an event, a failure or Ctrl-C, and return the outcome.

    Parameters
    ----------
    stops : array
        Times at which steps must end, in increasing order; the last is the end of the span.
    step_callback : function of AcceptedSteps
        Called with all accepted steps, several at a time.
    max_steps : float
        Number of steps that fit into memory.
    events : EventSet, optional
        The events whose functions the control has.
    attempts_per_call : int
        Largest number of attempted steps between two checks.
    """
    recorder = _SingleRecorder(
        engine, adaptive_runs, control, stops, step_callback, max_steps, events, attempts_per_call
    )
    try:
        drive_adaptive(recorder.pause_handler, recorder)
        recorder.record_failure()
    except INTERRUPTING_ERRORS as error:
        recorder.outcome.interruption = interruption_reason(error)
    return recorder.outcome


class _SingleRecorder:
    """Recorder of one trajectory, with every accepted step; parameters as for :func:`advance_to_end`."""

    def __init__(
        self,
        engine: EngineWithFallback,
        adaptive_runs: AdaptiveRuns,
        control: StepControl,
        stops: np.ndarray,
        step_callback: StepCallback,
        max_steps: float,
        events: EventSet | None,
        attempts_per_call: int,
    ):
        self.engine, self.control, self.step_callback, self.events = engine, control, step_callback, events
        self.runs, self.max_steps, self.attempts_per_call = adaptive_runs, max_steps, attempts_per_call
        rules = EventRules() if events is None else events.rules
        self.pause_handler = PauseHandler(adaptive_runs, control, engine.method, stops, lambda i: engine.system, rules)
        handler, self.n_event_steps = self.pause_handler, 0
        self.outcome = RunOutcome(
            _clear_pause_status(adaptive_runs.state()),
            events=handler.occurrences,
            sign_jumps=handler.sign_jumps,
            undefined_ends=handler.undefined_ends,
        )

    def _scalar(self, name: str) -> float:
        return float(self.runs.read(name)[0])

    def continues(self) -> bool:
        if self._scalar("status") != StatusCode.COMPLETED:
            return False
        if int(self.outcome.state.step) >= self.max_steps:
            self.outcome.exhausted_limit = "memory"
            return False
        return True

    def attempt(self) -> None:
        outcome, first_step, t = self.outcome, int(self.outcome.state.step), self._scalar("t")
        try:
            attempts = self.runs.attempt_and_record(
                int(min(self.attempts_per_call, max(1.0, self.max_steps - first_step)))
            )
        except UnsupportedPrimitive as error:
            self.runs = self.engine.resume_adaptive_on_array_engine(error, self.control, self.runs)
            self.pause_handler.adaptive_runs = self.runs
            return
        outcome.n_rejected = int(self._scalar("n_rejected"))
        outcome.state = _clear_pause_status(self.runs.state())
        is_accepted = np.diff(attempts["step"], prepend=first_step) > 0
        if is_accepted.any():
            x, energy, entropy, step_counts, end_times, h = (attempts[name][is_accepted] for name in ATTEMPT_FIELDS)
            ends_at_event = bool(self._scalar("status") == StatusCode.PAUSED_AT_EVENT and is_accepted[-1])
            step_counts, times = step_counts - self.n_event_steps, np.append(t, end_times)
            self.n_event_steps += ends_at_event
            self.step_callback(AcceptedSteps(times, h, x, energy, entropy, step_counts, ends_at_event, outcome.state))

    def record_pauses(self) -> None:
        if self.events is not None:
            self.events.raise_error()

    def record_ended_trajectories(self) -> None:
        if self._scalar("status") == StatusCode.EVENT:
            self.outcome.event_time = self._scalar("t")
        if self.events is not None:
            is_undefined = ~np.isfinite(self.runs.read("event_values")[0])
            self.outcome.undefined_events = np.flatnonzero(is_undefined).tolist()

    def record_failure(self) -> None:
        """Record why the run has ended before its end, if it has."""
        outcome, code = self.outcome, int(self._scalar("status"))
        if code == StatusCode.STEP_LIMIT:
            outcome.exhausted_limit = "steps"
        elif code == StatusCode.STEP_UNDERFLOW:
            outcome.underflow_step_size = self._scalar("next_step_size")
            outcome.state = outcome.state._replace(
                status=np.int64(self._scalar("last_attempt_status")), residual=self._scalar("residual")
            )
        elif code not in (StatusCode.COMPLETED, StatusCode.EVENT, StatusCode.REACHED_END):
            outcome.state = outcome.state._replace(status=np.int64(code), residual=self._scalar("residual"))
            is_solved = self._scalar("last_attempt_status") == StatusCode.COMPLETED
            outcome.exhausted_limit = "sight" if is_solved else ""


def _clear_pause_status(state: State) -> State:
    """Return the state of a running trajectory without the code of a pause."""
    return state._replace(status=np.int64(0))  # type: ignore[arg-type]
