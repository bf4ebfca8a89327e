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

from ..engines.choice import Chosen
from ..engines.codes import Code
from ..engines.paced import Guide, Paces
from ..engines.pacing import FINISHED, TOLD, Pacing
from ..engines.stepping import State
from ..tracing.scalarize import UnsupportedPrimitive
from .ending import STOPPED, stopped_by
from .watch import UnknownStateError, Watch

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
    undefined: bool = False  # whether the event function is not a number at the end
    unknown: UnknownStateError | None = None  # what is not known of an event
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


def follow(
    engine: Chosen,
    paces: Paces,
    pacing: Pacing,
    stops: np.ndarray,
    keep: Keep,
    most_kept: float = MOST_KEPT,
    watch: Watch | None = None,
    together: int = TOGETHER,
) -> Outcome:
    """Follow a run from its start to its end, an event, a failure or Ctrl-C.

    Parameters
    ----------
    stops : array
        Times at which steps have to end, increasing; the last is the end of the span.
    keep : function of Steps
        Told of every step taken, of many together.
    most_kept : float
        Steps after which there is no room for more.
    watch : Watch, optional
        Looks at each step, and may end the run in it.
    together : int
        Attempts between looks, at most.
    """
    outcome = Outcome(_running(paces.state()))
    try:
        _follow(engine, paces, pacing, outcome, stops, keep, most_kept, watch, 1 if watch else together)
    except STOPPED as error:
        outcome.stopped = stopped_by(error)
    return outcome


def _follow(
    engine, paces: Paces, pacing, outcome: Outcome, stops, keep, most_kept, watch: Watch | None, together: int
) -> None:
    guide = Guide(paces, pacing, engine.method, stops, lambda i: engine.system)
    outcome.jumps = guide.jumps

    def scalar(name: str) -> float:
        return float(paces.read(name)[0])

    while True:
        guide.verify()
        guide.resume()
        code, t = int(scalar("status")), scalar("t")
        outcome.undefined = not math.isfinite(scalar("value"))
        if code == Code.EVENT:
            outcome.event_time = t
        if code != Code.COMPLETED:
            break
        if int(outcome.state.step) >= most_kept:
            outcome.limit = "memory"
            return
        before = outcome.state
        try:
            rows = paces.attempts(int(min(together, max(1.0, most_kept - int(before.step)))))
        except UnsupportedPrimitive as error:
            guide.paces = paces = engine.instead(error, pacing, paces)
            continue
        outcome.rejected = int(scalar("rejected"))
        outcome.state = _running(paces.state())
        if (taken := np.diff(rows["step"], prepend=int(before.step)) > 0).any():  # some attempts do not count
            x, energy, entropy, number, ends, h = (rows[name][taken] for name in TOLD)
            try:
                caught = watch.of_step(engine, t, h[0], ends[0], before, outcome.state) if watch else None
            except UnknownStateError as error:
                outcome.state, outcome.unknown = before, error
                return
            if caught:
                outcome.event_time, part, at = caught
                outcome.state = before if at is None else at
                if at is not None:
                    keep(_single(t, outcome.event_time, part, before, at))
                return
            keep(Steps(np.append(t, ends), h, x, energy, entropy, number, before, outcome.state))
    if code == Code.STEP_LIMIT:
        outcome.limit = "steps"
    elif code == Code.STEP_UNDERFLOW:
        outcome.underflow = scalar("proposed")
        outcome.state = outcome.state._replace(status=np.int64(scalar("cause")), residual=scalar("residual"))
    elif code not in (Code.EVENT, FINISHED):
        outcome.state = outcome.state._replace(status=np.int64(code), residual=scalar("residual"))
        outcome.limit = "sight" if scalar("cause") == Code.COMPLETED else ""


def _running(state: State) -> State:
    """Return a state of a run that goes on, in place of one with the reason of a pause."""
    return state._replace(status=np.int64(0))  # type: ignore[arg-type]


def _single(t: float, end: float, h: float, before: State, after: State) -> Steps:
    x, energy, entropy, number = (np.asarray(getattr(after, name))[None] for name in TOLD[:4])
    return Steps(np.array([t, end]), np.array([h]), x, energy, entropy, number, before, after)
