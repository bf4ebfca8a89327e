"""Timing on a machine that does other things too: contestants take turns, and the best time of each counts.

Disturbances only ever add time, so the minimum is the estimate that they spoil least; taking turns spreads a slow spell
over everyone.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

MIN_TURN_SECONDS = 0.1
"""Seconds that a turn lasts at least: short work, which a disturbance spoils most, is repeated and timed each time."""


@dataclass(frozen=True)
class TimedResult:
    """The best times, and what the work returned.

    Attributes
    ----------
    wall_seconds : float
        By the clock on the wall.
    cpu_seconds : float
        Of the processor: what other processes do is not counted, so that for work in one thread it is what the wall
        would show on an idle machine. Not to be used for work in several: Linux books the time of other threads at its
        next tick, so that the least of many short times is too small.
    result : object
    """

    wall_seconds: float
    cpu_seconds: float
    result: Any


def race(works: Mapping[Any, Callable[[], Any]], *, rounds: int, max_seconds: float = 20.0) -> dict[Any, TimedResult]:
    """Time each work by turns.

    Parameters
    ----------
    works : dict of functions without arguments
        Each is called once before the first round, which compiles it and fills the caches.
    rounds : int
    max_seconds : float
        Seconds after which a contestant sits out the remaining rounds, at least two taken.

    Returns
    -------
    dict of Outcome
    """
    results = {name: work() for name, work in works.items()}
    best = dict.fromkeys(works, (float("inf"), float("inf")))
    spent = dict.fromkeys(works, 0.0)
    for turn in range(rounds):
        for name, work in works.items():
            if turn < 2 or spent[name] < max_seconds:
                fastest, total = _time_turn(work)
                best[name] = (min(best[name][0], fastest[0]), min(best[name][1], fastest[1]))
                spent[name] += total
    return {name: TimedResult(*best[name], results[name]) for name in works}


def time_once(work: Callable[[], Any]) -> TimedResult:
    """Time a work that can only be done once, such as compiling."""
    start, start_processor = time.perf_counter(), time.process_time()
    result = work()
    return TimedResult(time.perf_counter() - start, time.process_time() - start_processor, result)


def _time_turn(work) -> tuple[tuple[float, float], float]:
    seconds = processor = float("inf")
    total = 0.0
    while total < MIN_TURN_SECONDS:
        one = time_once(work)
        seconds, processor = min(seconds, one.wall_seconds), min(processor, one.cpu_seconds)
        total += one.wall_seconds
    return (seconds, processor), total
