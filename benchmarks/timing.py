"""Timing on a machine that does other things too: contestants take turns, and the best time of each counts.

Disturbances only ever add time, so the minimum is the estimate that they spoil least; taking turns spreads a slow spell
over everyone.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

SLICE = 0.02
"""Seconds that a turn lasts at least: short work is repeated, each repetition timed by itself."""


@dataclass(frozen=True)
class Outcome:
    """The best time, in seconds, and what the work returned."""

    seconds: float
    result: Any


def race(works: Mapping[Any, Callable[[], Any]], *, rounds: int, patience: float = 20.0) -> dict[Any, Outcome]:
    """Time each work by turns.

    Parameters
    ----------
    works : dict of functions without arguments
        Each is called once before the first round, which compiles it and fills the caches.
    rounds : int
    patience : float
        Seconds after which a contestant sits out the remaining rounds, at least two taken.

    Returns
    -------
    dict of Outcome
    """
    results = {name: work() for name, work in works.items()}
    best = dict.fromkeys(works, float("inf"))
    spent = dict.fromkeys(works, 0.0)
    for turn in range(rounds):
        for name, work in works.items():
            if turn < 2 or spent[name] < patience:
                fastest, total = _turn(work)
                best[name] = min(best[name], fastest)
                spent[name] += total
    return {name: Outcome(best[name], results[name]) for name in works}


def once(work: Callable[[], Any]) -> Outcome:
    """Time a work that can only be done once, such as compiling."""
    start = time.perf_counter()
    result = work()
    return Outcome(time.perf_counter() - start, result)


def _turn(work) -> tuple[float, float]:
    fastest, total = float("inf"), 0.0
    while total < SLICE:
        seconds = once(work).seconds
        fastest, total = min(fastest, seconds), total + seconds
    return fastest, total
