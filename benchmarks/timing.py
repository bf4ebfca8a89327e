"""Timing on a busy machine: contestants take turns, and the best time of each counts.

Disturbances only add time, so the minimum is the most robust estimate; taking turns distributes a slow period over all
contestants.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

MIN_TURN_SECONDS = 0.1
"""Minimum duration of a turn in seconds; short work, which disturbances affect most, is repeated and timed each
time."""


@dataclass(frozen=True)
class TimedResult:
    """The best wall and processor time of a callable, and its result.

    Attributes
    ----------
    wall_seconds : float
        Elapsed time.
    cpu_seconds : float
        Processor time, which excludes other processes: for work in one thread it is the elapsed time on an idle
        machine. It is unsuitable for work in several threads: Linux books the time of other threads at its next tick,
        so that the least of many short times is too small.
    result : object
    """

    wall_seconds: float
    cpu_seconds: float
    result: Any


def race(works: Mapping[Any, Callable[[], Any]], *, rounds: int, max_seconds: float = 20.0) -> dict[Any, TimedResult]:
    """Call each work by turns, and return the best time of each with its result.

    Parameters
    ----------
    works : dict of functions without arguments
        Each is called once before the first round, which compiles it and fills the caches.
    rounds : int
    max_seconds : float
        Seconds after which a contestant skips the remaining rounds, but at least two are taken.

    Returns
    -------
    dict of TimedResult
    """
    results = {name: work() for name, work in works.items()}
    best_seconds = dict.fromkeys(works, (float("inf"), float("inf")))
    spent_seconds = dict.fromkeys(works, 0.0)
    for turn in range(rounds):
        for name, work in works.items():
            if turn < 2 or spent_seconds[name] < max_seconds:
                turn_seconds, total = _repeat_and_time(work)
                best_seconds[name] = (
                    min(best_seconds[name][0], turn_seconds[0]),
                    min(best_seconds[name][1], turn_seconds[1]),
                )
                spent_seconds[name] += total
    return {name: TimedResult(*best_seconds[name], results[name]) for name in works}


def time_once(work: Callable[[], Any]) -> TimedResult:
    """Time one call of a work that can be done only once, such as compiling."""
    start, start_processor = time.perf_counter(), time.process_time()
    result = work()
    return TimedResult(time.perf_counter() - start, time.process_time() - start_processor, result)


def _repeat_and_time(work) -> tuple[tuple[float, float], float]:
    seconds = processor = float("inf")
    total = 0.0
    while total < MIN_TURN_SECONDS:
        timed_result = time_once(work)
        seconds, processor = min(seconds, timed_result.wall_seconds), min(processor, timed_result.cpu_seconds)
        total += timed_result.wall_seconds
    return (seconds, processor), total
