"""Runs that look at every step: adaptive steps, events, outputs at given times, dense output.

The step itself is an engine's; what is here decides on its size and on where to stop. Nothing here touches the laws:
they hold for every step size.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..engines.codes import Code
from ..errors import InputError
from ..systems import System
from .adaptive import UNDERFLOW, Adaptive, Control, Growth, allowed_error, first_step, judged
from .events import Event, located
from .timetable import Timetable

MOST_KEPT = 2**28
"""Numbers that an adaptive run keeps at most (2 GiB)."""


@dataclass
class Outcome:
    """What a stepwise run leaves: states kept, with times, and how it ended."""

    state: Any
    rejected: int = 0
    event_time: float | None = None
    underflow: float | None = None
    interrupted: bool = False
    limit: str = ""  # what an adaptive run has used up, "steps" or "memory"


def run(
    system: System,
    method,
    advance: Callable,
    state,
    span: tuple[float, float],
    step: float | Adaptive,
    stops: np.ndarray,
    event: Event | None,
    keep: Callable,
    most_kept: float = MOST_KEPT,
) -> Outcome:
    """Step from the start of the span to its end, an event, a failure or Ctrl-C.

    Parameters
    ----------
    advance : function from (state, h) to the state after a step
        As an engine's ``stepping`` gives it.
    state : State
        As its ``begin`` gives it.
    stops : array
        Times at which steps have to end, increasing; the last is the end of the span.
    keep : function of (t, end, h, state before, state after)
        Told of every step taken, between the times t and its end.
    most_kept : float
        Adaptive steps after which there is no room for more.
    """
    t, end = span
    adaptive, shortest = step if isinstance(step, Adaptive) else None, UNDERFLOW * (end - t)
    control, growth = Control(step, method.order, first_step(state, end - t)), Growth(system, method)
    value = event(np.asarray(state.x)) if event else 0.0
    outcome, stop, table, tried = Outcome(state), -1, None, 0
    try:
        if adaptive is not None:
            control.h = min(control.h, judged(growth, system, method, state, state, control.h)[1])
        while t < end:
            if stop < 0 or stops[stop] <= t:
                stop += 1
                continue
            if adaptive is None:
                if table is None or table.end <= t:
                    table, since = Timetable((t, float(stops[stop])), step, None), int(state.step)
                n = int(state.step) - since
                h, reached = table.h if n < table.full else table.last, table.time(n + 1)
            else:
                h, arrives = _fitted(control, t, stops[stop])
                reached = float(stops[stop]) if arrives else t + h
                if tried >= adaptive.most_steps or int(state.step) >= most_kept:
                    outcome.limit = "steps" if tried >= adaptive.most_steps else "memory"
                    return outcome
            new = advance(state, h)
            tried += 1
            if adaptive is not None:
                error, longest = math.inf, math.inf
                if int(new.status) == Code.COMPLETED:
                    found, longest = judged(growth, system, method, state, new, h)
                    error = found / allowed_error(adaptive, state, new)
                if not error <= 1.0 or h > 1.1 * longest:
                    outcome.rejected += 1
                    if not error <= 1.0:
                        control.reject(error, h)
                    control.h = min(control.h, longest)
                    if control.h < shortest:
                        outcome.underflow = control.h
                        outcome.state = new if int(new.status) != Code.COMPLETED else state
                        return outcome
                    continue
                control.accept(error, h)
                control.h = min(control.h, growth.longest(control.h))
            if int(new.status) != Code.COMPLETED:
                outcome.state = new
                return outcome
            after = event(np.asarray(new.x)) if event else 0.0
            if event and event.happens(value, after):
                h, new = located(event, advance, system, method, state, new, h, value, after)
                if h > shortest:
                    keep(t, t + h, h, state, new)
                    outcome.state = new
                outcome.event_time = t + h
                return outcome
            keep(t, reached, h, state, new)
            t = reached
            outcome.state = state = new
            value = after
    except KeyboardInterrupt:
        outcome.interrupted = True
    return outcome


def _fitted(control: Control, t: float, stop: float) -> tuple[float, bool]:
    """The next step, so that none ends just short of a stop; and whether it ends there."""
    left = stop - t
    if left <= control.h * (1 + 1e-12):
        return left, True
    if left < 2.0 * control.h:
        return 0.5 * left, False
    return control.h, False


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
