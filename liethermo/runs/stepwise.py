"""Runs that look at every step: adaptive steps, events, outputs at given times, dense output.

The step itself is an engine's; what is here decides on its size and on where to stop. Nothing here touches the laws:
they hold in every step.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from ..engines.choice import Chosen
from ..engines.codes import Code
from ..engines.paced import Guide
from ..engines.pacing import FINISHED, TOLD
from ..engines.stepping import State
from ..errors import InputError
from .adaptive import Adaptive, pacing_of
from .ending import STOPPED, stopped_by
from .events import Event
from .timetable import Timetable
from .watch import Watch

TOGETHER = 64
"""Attempts between looks at an adaptive run."""

MOST_KEPT = 2**28
"""Numbers that an adaptive run keeps at most (2 GiB)."""


@dataclass
class Outcome:
    """What a stepwise run leaves: states kept, with times, and how it ended."""

    state: Any
    rejected: int = 0
    event_time: float | None = None
    underflow: float | None = None
    stopped: str = ""
    jumps: list[float] = field(default_factory=list)  # when the event function changed its sign without a zero
    limit: str = ""  # what an adaptive run has used up, "steps" or "memory"; "sight" where the event is not a number


class Steps(NamedTuple):
    """Steps one after another.

    Attributes
    ----------
    t : array, shape (m + 1,)
        When they begin, and when the last ends.
    h : array, shape (m,)
    x : array, shape (m, n)
        The states after them, with ``energy`` and ``entropy``, shape (m,).
    number : array, shape (m,)
        How many steps the run has with each.
    before, after : State
        Of the engine, before the first and after the last.
    """

    t: np.ndarray
    h: np.ndarray
    x: np.ndarray
    energy: np.ndarray
    entropy: np.ndarray
    number: np.ndarray
    before: State
    after: State


Keep = Callable[[Steps], None]


def run(
    engine: Chosen,
    state: State,
    span: tuple[float, float],
    step: float | Adaptive,
    stops: np.ndarray,
    event: Event | None,
    keep: Keep,
    most_kept: float = MOST_KEPT,
    watch: Watch | None = None,
) -> Outcome:
    """Step from the start of the span to its end, an event, a failure or Ctrl-C.

    Parameters
    ----------
    state : State
        As the engine's ``begin`` gives it.
    stops : array
        Times at which steps have to end, increasing; the last is the end of the span.
    keep : function of Steps
        Told of every step taken, of many adaptive ones together.
    most_kept : float
        Adaptive steps after which there is no room for more.
    watch : Watch, optional
        Looks at each step, and may end the run in it.
    """
    outcome, stops = Outcome(state), stops[stops > span[0]]
    try:
        if isinstance(step, Adaptive) or event is not None or watch is not None:
            _paced(engine, outcome, span, step, stops, event, keep, most_kept, watch)
        else:
            _fixed(engine, outcome, span, step, stops, keep)
    except STOPPED as error:
        outcome.stopped = stopped_by(error)
    return outcome


def _paced(engine, outcome: Outcome, span, step, stops, event, keep, most_kept, watch: Watch | None) -> None:
    """Adaptive steps or events, by the paces that ensembles have too, so many attempts together."""
    length = span[1] - span[0]
    pacing = pacing_of(step, engine.method, length, event)
    paces = engine.paces(pacing, np.asarray(outcome.state.x), span[0], float(stops[0]), length)
    guide = Guide(paces, pacing, engine.method, stops, lambda i: engine.system)
    outcome.jumps = guide.jumps

    def told(name: str) -> float:
        return float(paces.read(name)[0])

    while True:
        guide.verify()
        guide.resume()
        code, t = int(told("status")), told("t")
        if code == Code.EVENT:
            outcome.event_time = t
        if code != Code.COMPLETED:
            break
        if int(outcome.state.step) >= most_kept:
            outcome.limit = "memory"
            return
        before = outcome.state
        rows = paces.attempts(int(min(1 if watch else TOGETHER, max(1.0, most_kept - int(before.step)))))
        outcome.rejected = int(told("rejected"))
        after: Any = paces.state()
        outcome.state = after._replace(status=np.int64(0))
        if (taken := np.diff(rows["step"], prepend=int(before.step)) > 0).any():  # some attempts do not count
            x, energy, entropy, number, ends, h = (rows[name][taken] for name in TOLD)
            if watch and (caught := watch.of_step(engine, t, h[0], ends[0], before, outcome.state)):
                outcome.event_time, part, at = caught
                outcome.state = before if at is None else at
                if at is not None:
                    keep(_single(t, outcome.event_time, part, before, at))
                return
            keep(Steps(np.append(t, ends), h, x, energy, entropy, number, before, outcome.state))
    if code == Code.STEP_LIMIT:
        outcome.limit = "steps"
    elif code == Code.STEP_UNDERFLOW:
        outcome.underflow = told("wish")
        outcome.state = outcome.state._replace(status=np.int64(told("cause")), residual=told("residual"))
    elif code not in (Code.EVENT, FINISHED):
        outcome.state = outcome.state._replace(status=np.int64(code), residual=told("residual"))
        outcome.limit = "sight" if told("cause") == Code.COMPLETED else ""


def _fixed(engine, outcome: Outcome, span, step: float, stops, keep) -> None:
    t = span[0]
    for stop in map(float, stops):
        table, since = Timetable((t, stop), step, None), int(outcome.state.step)
        while t < table.end:
            n, state = int(outcome.state.step) - since, outcome.state
            h, reached = table.h if n < table.full else table.last, table.time(n + 1)
            new = engine.step(state, h)
            if int(new.status) != Code.COMPLETED:
                outcome.state = new
                return
            keep(_single(t, reached, h, state, new))
            t, outcome.state = reached, new


def _single(t: float, end: float, h: float, before: State, after: State) -> Steps:
    x, energy, entropy, number = (np.asarray(getattr(after, name))[None] for name in TOLD[:4])
    return Steps(np.array([t, end]), np.array([h]), x, energy, entropy, number, before, after)


def stops_of(save_at, start: float, end: float) -> np.ndarray:
    """The times at which steps have to end, the end of the span among them."""
    if save_at is None:
        return np.array([end])
    times = np.atleast_1d(np.asarray(save_at, dtype=np.float64))
    if times.ndim != 1 or not np.isfinite(times).all() or times.size == 0:
        raise InputError(f"save_at is a list of times, not {save_at!r}")
    if times.min() < start or times.max() > end:
        raise InputError(f"save_at has times from {times.min():g} to {times.max():g}, outside ({start:g}, {end:g})")
    return np.unique([*times, end])
