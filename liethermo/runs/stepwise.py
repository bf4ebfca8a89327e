"""Runs that examine every step: adaptive steps, events, outputs at given times, dense output.

An engine takes the steps. This module stops them at given times and locates events. The laws hold in every step.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from ..engines.choice import EngineWithFallback
from ..engines.codes import StatusCode
from ..engines.paced import AdaptiveRuns, PauseHandler
from ..engines.pacing import ATTEMPT_FIELDS, StepControl
from ..engines.stepping import State
from ..tracing.scalarize import UnsupportedPrimitive
from .ending import INTERRUPTING_ERRORS, interruption_reason
from .watch import EventSet, UnknownStateError

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
    sign_jumps: list[float] = field(default_factory=list)  # times at which the event function jumps across zero
    is_event_undefined: bool = False  # the event function is NaN at the end
    unknown_state_error: UnknownStateError | None = None  # a state inside a step could not be computed
    exhausted_limit: str = ""  # "steps" or "memory"; "sight" if the event function is NaN


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
        Number of steps of the run up to and including each.
    state_before, state_after : State
        Engine states before the first step and after the last.
    """

    t: np.ndarray
    h: np.ndarray
    x: np.ndarray
    energy: np.ndarray
    entropy: np.ndarray
    step_counts: np.ndarray
    state_before: State
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
        Examines each step and may end the run in it.
    attempts_per_call : int
        Largest number of attempted steps between two checks.
    """
    outcome = RunOutcome(_clear_pause_status(adaptive_runs.state()))
    try:
        _advance_to_end(
            engine,
            adaptive_runs,
            control,
            outcome,
            stops,
            step_callback,
            max_steps,
            events,
            1 if events else attempts_per_call,
        )
    except INTERRUPTING_ERRORS as error:
        outcome.interruption = interruption_reason(error)
    return outcome


def _advance_to_end(
    engine,
    adaptive_runs: AdaptiveRuns,
    control,
    outcome: RunOutcome,
    stops,
    step_callback,
    max_steps,
    event_set: EventSet | None,
    attempts_per_call: int,
) -> None:
    pause_handler = PauseHandler(adaptive_runs, control, engine.method, stops, lambda i: engine.system)
    outcome.sign_jumps = pause_handler.sign_jumps

    def scalar(name: str) -> float:
        return float(adaptive_runs.read(name)[0])

    while True:
        pause_handler.confirm_events()
        pause_handler.resume_paused()
        code, t = int(scalar("status")), scalar("t")
        outcome.is_event_undefined = not math.isfinite(scalar("event_value"))
        if code == StatusCode.EVENT:
            outcome.event_time = t
        if code != StatusCode.COMPLETED:
            break
        if int(outcome.state.step) >= max_steps:
            outcome.exhausted_limit = "memory"
            return
        previous_state = outcome.state
        try:
            attempts = adaptive_runs.attempt_and_record(
                int(min(attempts_per_call, max(1.0, max_steps - int(previous_state.step))))
            )
        except UnsupportedPrimitive as error:
            pause_handler.adaptive_runs = adaptive_runs = engine.fall_back_adaptive(error, control, adaptive_runs)
            continue
        outcome.n_rejected = int(scalar("n_rejected"))
        outcome.state = _clear_pause_status(adaptive_runs.state())
        is_accepted = np.diff(attempts["step"], prepend=int(previous_state.step)) > 0
        if is_accepted.any():
            x, energy, entropy, step_counts, end_times, h = (attempts[name][is_accepted] for name in ATTEMPT_FIELDS)
            try:
                event = (
                    event_set.find_events(engine, t, h[0], end_times[0], previous_state, outcome.state)
                    if event_set
                    else None
                )
            except UnknownStateError as error:
                outcome.state, outcome.unknown_state_error = previous_state, error
                return
            if event:
                outcome.event_time, event_step_size, event_state = event
                outcome.state = previous_state if event_state is None else event_state
                if event_state is not None:
                    step_callback(_single_step(t, outcome.event_time, event_step_size, previous_state, event_state))
                return
            step_callback(
                AcceptedSteps(
                    np.append(t, end_times), h, x, energy, entropy, step_counts, previous_state, outcome.state
                )
            )
    if code == StatusCode.STEP_LIMIT:
        outcome.exhausted_limit = "steps"
    elif code == StatusCode.STEP_UNDERFLOW:
        outcome.underflow_step_size = scalar("next_step_size")
        outcome.state = outcome.state._replace(
            status=np.int64(scalar("last_attempt_status")), residual=scalar("residual")
        )
    elif code not in (StatusCode.EVENT, StatusCode.REACHED_END):
        outcome.state = outcome.state._replace(status=np.int64(code), residual=scalar("residual"))
        outcome.exhausted_limit = "sight" if scalar("last_attempt_status") == StatusCode.COMPLETED else ""


def _clear_pause_status(state: State) -> State:
    """Return the state of a running trajectory without the code of a pause."""
    return state._replace(status=np.int64(0))  # type: ignore[arg-type]


def _single_step(t: float, end: float, h: float, state_before: State, state_after: State) -> AcceptedSteps:
    x, energy, entropy, step_counts = (np.asarray(getattr(state_after, name))[None] for name in ATTEMPT_FIELDS[:4])
    return AcceptedSteps(np.array([t, end]), np.array([h]), x, energy, entropy, step_counts, state_before, state_after)
