"""Runs that examine every step: adaptive steps, events, outputs at given times, dense output.

An engine takes the steps, and locates events. This module stops them at given times. The laws hold in every step.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from ..engines.adaptive_runs import AdaptiveRuns, EventRules, PauseHandler
from ..engines.adaptive_steps import ATTEMPT_FIELDS
from ..engines.select_engine import EngineWithFallback
from ..engines.status_codes import StatusCode
from ..engines.step import State
from ..engines.step_control import StepControl
from ..tracing.scalarize import UnsupportedPrimitive
from .driver import advance_until_all_end
from .events import EventSet
from .termination import INTERRUPTING_ERRORS, interruption_reason_or_reraise

ATTEMPTS_PER_CALL = 64
"""Number of attempted steps between two checks of an adaptive run."""

MAX_STORED_VALUES = 2**28
"""Largest number of values that an adaptive run stores (2 GiB)."""


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


class AdaptiveRun:
    """A run of one trajectory in which every step is examined, with its last state and the reason why it ended.

    Parameters
    ----------
    engine : EngineWithFallback
    adaptive_runs : AdaptiveRuns
        The trajectory at its start.
    control : StepControl
    stop_times : array
        Times at which steps must end, in increasing order; the last is the end of the span.
    step_callback : function of AcceptedSteps
        Called with all accepted steps, several at a time.
    max_steps : float
        Number of steps that fit into memory.
    events : EventSet, optional
        The events whose functions the control has.
    attempts_per_call : int, optional
        Largest number of attempted steps between two checks; by default ATTEMPTS_PER_CALL.

    Attributes
    ----------
    state : State
        The last state.
    n_rejected : int
    event_time : float or None
        Time of the event that has ended the run.
    underflow_step_size : float or None
        Size of a step that is too short.
    interruption : str
        Why the run was interrupted.
    exhausted_limit : str
        "steps" or "memory"; "sight" if an event function is NaN.
    occurrences, sign_jumps, undefined_ends : list
        See :class:`..engines.adaptive_runs.PauseHandler`.
    undefined_events : list of int
        Numbers of event functions that are NaN at the end.
    """

    def __init__(
        self,
        engine: EngineWithFallback,
        adaptive_runs: AdaptiveRuns,
        control: StepControl,
        stop_times: np.ndarray,
        step_callback: Callable[[AcceptedSteps], None],
        max_steps: float = MAX_STORED_VALUES,
        events: EventSet | None = None,
        attempts_per_call: int | None = None,
    ):
        self.engine, self.control, self.step_callback, self.event_set = engine, control, step_callback, events
        self.runs, self.max_steps, self.attempts_per_call = adaptive_runs, max_steps, attempts_per_call
        rules = EventRules() if events is None else events.rules
        self.pause_handler = PauseHandler(
            adaptive_runs, control, engine.method, stop_times, lambda i: engine.system, rules
        )
        handler, self.n_event_steps = self.pause_handler, 0
        self.occurrences, self.sign_jumps = handler.occurrences, handler.sign_jumps
        self.undefined_ends, self.undefined_events = handler.undefined_ends, list[int]()
        self.state: Any = _clear_pause_status(adaptive_runs.state_of_only_trajectory())
        self.n_rejected = 0
        self.event_time: float | None = None
        self.underflow_step_size: float | None = None
        self.interruption = self.exhausted_limit = ""

    def advance_to_end(self) -> None:
        """Advance the run until its end, an event, a failure or Ctrl-C."""
        try:
            advance_until_all_end(self.pause_handler, self)
            self._record_failure()
        except INTERRUPTING_ERRORS as error:
            self.interruption = interruption_reason_or_reraise(error)

    def _read_scalar(self, field_name: str) -> float:
        return float(self.runs.read(field_name)[0])

    def can_continue(self) -> bool:
        if self._read_scalar("status") != StatusCode.COMPLETED:
            return False
        if int(self.state.step) >= self.max_steps:
            self.exhausted_limit = "memory"
            return False
        return True

    def attempt_steps(self) -> None:
        first_step, t = int(self.state.step), self._read_scalar("t")
        try:
            max_attempts = self.attempts_per_call or ATTEMPTS_PER_CALL
            attempts = self.runs.record_attempts(int(min(max_attempts, max(1.0, self.max_steps - first_step))))
        except UnsupportedPrimitive as error:
            self.runs = self.engine.resume_adaptive_on_array_engine(error, self.control, self.runs)
            self.pause_handler.adaptive_runs = self.runs
            return
        self.n_rejected = int(self._read_scalar("n_rejected"))
        self.state = _clear_pause_status(self.runs.state_of_only_trajectory())
        is_accepted = np.diff(attempts["step"], prepend=first_step) > 0
        if is_accepted.any():
            x, energy, entropy, step_counts, end_times, h = (attempts[name][is_accepted] for name in ATTEMPT_FIELDS)
            ends_at_event = bool(self._read_scalar("status") == StatusCode.PAUSED_AT_EVENT and is_accepted[-1])
            step_counts, times = step_counts - self.n_event_steps, np.append(t, end_times)
            self.n_event_steps += ends_at_event
            self.step_callback(AcceptedSteps(times, h, x, energy, entropy, step_counts, ends_at_event, self.state))

    def handle_pauses(self) -> None:
        if self.event_set is not None:
            self.event_set.raise_first_error()

    def record_ended_trajectories(self) -> None:
        """Record the time of the event that ended the run, and the event functions that are undefined at its end."""
        if self._read_scalar("status") == StatusCode.EVENT:
            self.event_time = self._read_scalar("t")
        if self.event_set is not None:
            is_undefined = ~np.isfinite(self.runs.read("event_values")[0])
            self.undefined_events = np.flatnonzero(is_undefined).tolist()

    def _record_failure(self) -> None:
        """If the run has stopped early, record why."""
        code = int(self._read_scalar("status"))
        if code == StatusCode.STEP_LIMIT:
            self.exhausted_limit = "steps"
        elif code == StatusCode.STEP_UNDERFLOW:
            self.underflow_step_size = self._read_scalar("next_step_size")
            self.state = self.state._replace(
                status=np.int64(self._read_scalar("last_attempt_status")), residual=self._read_scalar("residual")
            )
        elif code not in (StatusCode.COMPLETED, StatusCode.EVENT, StatusCode.REACHED_END):
            self.state = self.state._replace(status=np.int64(code), residual=self._read_scalar("residual"))
            is_solved = self._read_scalar("last_attempt_status") == StatusCode.COMPLETED
            self.exhausted_limit = "sight" if is_solved else ""


def _clear_pause_status(state: State) -> State:
    """Return the state of a running trajectory without the code of a pause."""
    return state._replace(status=np.int64(0))  # type: ignore[arg-type]
