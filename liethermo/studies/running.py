"""The chunks of a study done: here on all cores, or by the workers of a Dask cluster, which write their own."""

from __future__ import annotations

import itertools
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import FileError, LiethermoError
from ..runs.ensemble import THREADS
from .axes import Axes
from .progress import Bar
from .solve import MISSING, Solver, Task, solver_of
from .store import Store, Survey

SECONDS = 2.0
"""What is done between two looks at the clock, by one worker: chunks are taken together up to there."""

TOGETHER = 65_536
"""Points up to which chunks are taken together."""

GROWTH = 4
"""Factor by which so many more chunks are tried together."""


@dataclass(frozen=True)
class Work:
    """The points of a chunk that are to be done.

    Attributes
    ----------
    index : tuple of int
        Of the chunk.
    keep : bool
        Whether other points of the chunk are done.
    places : tuple of ndarray, shape (m,)
        Along each axis.
    points : dict of ndarray, shape (m,)
        The parameters there.
    states : ndarray, shape (m, n), or None
    """

    index: tuple[int, ...]
    keep: bool
    places: tuple[np.ndarray, ...]
    points: dict[str, np.ndarray]
    states: np.ndarray | None

    @classmethod
    def of(cls, store: Store, axes: Axes, number: int, keep: bool) -> Work:
        index = store.index(number)
        wanted = store.chunk("status", index) == MISSING if keep else None
        places = store.places(index, wanted)
        return cls(index, keep, places, axes.points(places), axes.states(places))

    def __len__(self) -> int:
        return len(self.places[0])


def done(solver: Solver, store: Store, works: Sequence[Work]) -> tuple[int, float]:
    """Solve the points of some chunks together, and write each chunk; how many they were, and the seconds taken."""
    started = time.perf_counter()
    names = works[0].points
    points = {name: np.concatenate([work.points[name] for work in works]) for name in names}
    states = None if works[0].states is None else np.concatenate([w.states for w in works if w.states is not None])
    sizes = [len(work) for work in works]
    noise, seeds = solver.task.noise, None
    if noise is not None:
        seeds = noise.at([np.concatenate(column) for column in zip(*(work.places for work in works), strict=True)])
    arrays = solver.columns(points, states, sum(sizes), seeds).arrays()
    start = 0
    for work, size in zip(works, sizes, strict=True):
        own = {name: values[start : start + size] for name, values in arrays.items()}
        store.put(work.index, work.places, own, work.keep)
        start += size
    return sum(sizes), time.perf_counter() - started


class _Portions:
    """Chunks taken together, as many as take about :data:`SECONDS`."""

    def __init__(self, store: Store, axes: Axes, survey: Survey):
        self._store, self._axes, self._todo = store, axes, iter(survey.todo)
        self._number = 1
        chunk = int(np.prod(store.arrays["status"].chunks))
        self._most = max(1, TOGETHER // chunk)

    def __iter__(self) -> Iterator[list[Work]]:
        while True:
            taken = list(itertools.islice(self._todo, self._number))
            if not taken:
                return
            yield [Work.of(self._store, self._axes, number, keep) for number, keep in taken]

    def took(self, chunks: int, seconds: float) -> None:
        """Note how long some chunks took."""
        wanted = int(chunks * SECONDS / max(seconds, 1e-9))
        self._number = max(1, min(wanted, GROWTH * self._number, self._most))


def here(solver: Solver, store: Store, axes: Axes, survey: Survey, bar: Bar) -> None:
    """Do the chunks in this process, on all its cores."""
    portions = _Portions(store, axes, survey)
    for works in portions:
        points, seconds = done(solver, store, works)
        portions.took(len(works), seconds)
        bar.advance(points)


# -- on a cluster -----------------------------------------------------------------------------------------------------


def spread(task: Task, store: Store, axes: Axes, survey: Survey, bar: Bar, client: Any) -> None:
    """Do the chunks on the workers of a cluster, each of which writes its own.

    Raises
    ------
    FileError
        If a worker does not see the store.
    LiethermoError
        If a portion of the chunks has been lost with several workers.
    """
    import cloudpickle
    from distributed import as_completed
    from distributed.scheduler import KilledWorker

    packed = cloudpickle.dumps(task)
    portions = _Portions(store, axes, survey)
    coming = iter(portions)
    running = as_completed()
    chunks: dict[str, int] = {}

    def submit() -> bool:
        works = next(coming, None)
        if works is None:
            return False
        future = client.submit(_on_worker, packed, str(store.root), works, pure=False)
        chunks[future.key] = len(works)
        running.add(future)
        return True

    try:
        while running.count() < 2 * _threads(client) and submit():
            pass
        for future in running:
            try:
                points, seconds = future.result()
            except ImportError as error:
                raise LiethermoError(
                    f"a worker cannot import what builds the systems ({error}): install it where the workers run"
                ) from error
            except KilledWorker as error:
                raise LiethermoError(
                    f"the workers that took the same {chunks[future.key]} chunks died, one after another: they may "
                    f"lack memory; smaller chunks (chunk=...) need less. What is done is kept. {error}"
                ) from error
            portions.took(chunks.pop(future.key), seconds)
            bar.advance(points)
            while running.count() < 2 * _threads(client) and submit():
                pass
    finally:
        client.cancel(list(running.futures))


def _threads(client: Any) -> int:
    return max(1, sum(client.nthreads().values()))


def _on_worker(packed: bytes, root: str, works: list[Work]) -> tuple[int, float]:
    """What a worker does: every one of its threads has one such task, so that each ensemble takes one thread."""
    if not Path(root).is_dir():
        raise FileError(f"this worker does not see {root}: the store must be in a folder that all machines share")
    token = THREADS.set(1)
    try:
        return done(solver_of(packed), Store.open(Path(root)), works)
    finally:
        THREADS.reset(token)
