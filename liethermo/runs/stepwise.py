"""Runs that look at every step: adaptive steps, events, outputs at given times, dense output.

The step itself is an engine's; what is here decides on its size and on where to stop. Nothing here touches the laws:
they hold in every step.
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
"""Attempts between looks at an adaptive run."""

MAX_STORED_VALUES = 2**28
"""Numbers that an adaptive run keeps at most (2 GiB)."""


@dataclass
class RunOutcome:
    """What a stepwise run leaves: states kept, with times, and how it ended."""

    state: Any
    n_rejected: int = 0
    event_time: float | None = None
    underflow_step_size: float | None = None
    interruption: str = ""
    sign_jumps: list[float] = field(default_factory=list)  # when the event function changed its sign without a zero
    is_event_undefined: bool = False  # whether the event function is not a number at the end
    unknown_state_error: UnknownStateError | None = None  # what is not known of an event
    exhausted_limit: str = (
        ""  # what an adaptive run has used up, "steps" or "memory"; "sight" where the event is not a number
    )


class AcceptedSteps(NamedTuple):
    """Steps one after another.

    Attributes
    ----------
    t : array, shape (m + 1,)
        When they begin, and when the last ends.
    h : array, shape (m,)
    x : array, shape (m, n)
        The states after them, with ``energy`` and ``entropy``, shape (m,).
    step_counts : array, shape (m,)
        How many steps the run has with each.
    state_before, state_after : State
        Of the engine, before the first and after the last.
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


def advance_to_end(
    engine: EngineWithFallback,
    paces: AdaptiveRuns,
    pacing: StepControl,
    stops: np.ndarray,
    on_steps: StepCallback,
    max_steps: float = MAX_STORED_VALUES,
    events: EventSet | None = None,
    attempts_per_call: int = ATTEMPTS_PER_CALL,
) -> RunOutcome:
    """Follow a run from its start to its end, an event, a failure or Ctrl-C.

    Parameters
    ----------
    stops : array
        Times at which steps have to end, increasing; the last is the end of the span.
    on_steps : function of Steps
        Told of every step taken, of many together.
    max_steps : float
        Steps after which there is no room for more.
    events : Watch, optional
        Looks at each step, and may end the run in it.
    attempts_per_call : int
        Attempts between looks, at most.
    """
    outcome = RunOutcome(_clear_pause_status(paces.state()))
    try:
        _advance_to_end(
            engine, paces, pacing, outcome, stops, on_steps, max_steps, events, 1 if events else attempts_per_call
        )
    except INTERRUPTING_ERRORS as error:
        outcome.interruption = interruption_reason(error)
    return outcome


def _advance_to_end(
    engine,
    paces: AdaptiveRuns,
    pacing,
    outcome: RunOutcome,
    stops,
    keep,
    most_kept,
    watch: EventSet | None,
    together: int,
) -> None:
    guide = PauseHandler(paces, pacing, engine.method, stops, lambda i: engine.system)
    outcome.sign_jumps = guide.sign_jumps

    def scalar(name: str) -> float:
        return float(paces.read(name)[0])

    while True:
        guide.confirm_events()
        guide.resume_paused()
        code, t = int(scalar("status")), scalar("t")
        outcome.is_event_undefined = not math.isfinite(scalar("event_value"))
        if code == StatusCode.EVENT:
            outcome.event_time = t
        if code != StatusCode.COMPLETED:
            break
        if int(outcome.state.step) >= most_kept:
            outcome.exhausted_limit = "memory"
            return
        before = outcome.state
        try:
            rows = paces.attempt_records(int(min(together, max(1.0, most_kept - int(before.step)))))
        except UnsupportedPrimitive as error:
            guide.adaptive_runs = paces = engine.fall_back_adaptive(error, pacing, paces)
            continue
        outcome.n_rejected = int(scalar("n_rejected"))
        outcome.state = _clear_pause_status(paces.state())
        if (taken := np.diff(rows["step"], prepend=int(before.step)) > 0).any():  # some attempts do not count
            x, energy, entropy, number, ends, h = (rows[name][taken] for name in ATTEMPT_FIELDS)
            try:
                caught = watch.find_events(engine, t, h[0], ends[0], before, outcome.state) if watch else None
            except UnknownStateError as error:
                outcome.state, outcome.unknown_state_error = before, error
                return
            if caught:
                outcome.event_time, part, at = caught
                outcome.state = before if at is None else at
                if at is not None:
                    keep(_single_step(t, outcome.event_time, part, before, at))
                return
            keep(AcceptedSteps(np.append(t, ends), h, x, energy, entropy, number, before, outcome.state))
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
    """Return a state of a run that goes on, in place of one with the reason of a pause."""
    return state._replace(status=np.int64(0))  # type: ignore[arg-type]


def _single_step(t: float, end: float, h: float, before: State, after: State) -> AcceptedSteps:
    x, energy, entropy, number = (np.asarray(getattr(after, name))[None] for name in ATTEMPT_FIELDS[:4])
    return AcceptedSteps(np.array([t, end]), np.array([h]), x, energy, entropy, number, before, after)
