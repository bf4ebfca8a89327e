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
from ..runs.ensemble import MAX_THREADS
from .axes import Axes
from .progress import StudyProgressBar
from .solve import NOT_COMPUTED, PointSolver, StudyTask, cached_solver
from .store import StoreSurvey, StudyStore

TARGET_PORTION_SECONDS = 2.0
"""What is done between two looks at the clock, by one worker: chunks are taken together up to there."""

MAX_POINTS_PER_PORTION = 65_536
"""Points up to which chunks are taken together."""

MAX_PORTION_GROWTH = 4
"""Factor by which so many more chunks are tried together."""


@dataclass(frozen=True)
class ChunkTask:
    """The points of a chunk that are to be done.

    Attributes
    ----------
    chunk_index : tuple of int
        Of the chunk.
    is_partial : bool
        Whether other points of the chunk are done.
    point_indices : tuple of ndarray, shape (m,)
        Along each axis.
    parameters : dict of ndarray, shape (m,)
        The parameters there.
    states : ndarray, shape (m, n), or None
    """

    chunk_index: tuple[int, ...]
    is_partial: bool
    point_indices: tuple[np.ndarray, ...]
    parameters: dict[str, np.ndarray]
    states: np.ndarray | None

    @classmethod
    def from_chunk(cls, store: StudyStore, axes: Axes, number: int, keep: bool) -> ChunkTask:
        index = store.chunk_index(number)
        wanted = store.read_chunk("status", index) == NOT_COMPUTED if keep else None
        places = store.point_indices(index, wanted)
        return cls(index, keep, places, axes.parameters_at(places), axes.states_at(places))

    def __len__(self) -> int:
        return len(self.point_indices[0])


def solve_chunks(solver: PointSolver, store: StudyStore, works: Sequence[ChunkTask]) -> tuple[int, float]:
    """Solve the points of some chunks together, and write each chunk; how many they were, and the seconds taken."""
    started = time.perf_counter()
    names = works[0].parameters
    points = {name: np.concatenate([work.parameters[name] for work in works]) for name in names}
    states = None if works[0].states is None else np.concatenate([w.states for w in works if w.states is not None])
    sizes = [len(work) for work in works]
    noise, seeds = solver.task.noise, None
    if noise is not None:
        seeds = noise.grid_seeds(
            [np.concatenate(column) for column in zip(*(work.point_indices for work in works), strict=True)]
        )
    arrays = solver.solve(points, states, sum(sizes), seeds).as_arrays()
    start = 0
    for work, size in zip(works, sizes, strict=True):
        own = {name: values[start : start + size] for name, values in arrays.items()}
        store.write_chunk(work.chunk_index, work.point_indices, own, work.is_partial)
        start += size
    return sum(sizes), time.perf_counter() - started


class _ChunkPortions:
    """Chunks taken together, as many as take about :data:`TARGET_PORTION_SECONDS`."""

    def __init__(self, store: StudyStore, axes: Axes, survey: StoreSurvey):
        self._store, self._axes, self._remaining_chunks = store, axes, iter(survey.remaining_chunks)
        self._n_chunks = 1
        chunk = int(np.prod(store.arrays["status"].chunks))
        self._max_chunks = max(1, MAX_POINTS_PER_PORTION // chunk)

    def __iter__(self) -> Iterator[list[ChunkTask]]:
        while True:
            taken = list(itertools.islice(self._remaining_chunks, self._n_chunks))
            if not taken:
                return
            yield [ChunkTask.from_chunk(self._store, self._axes, number, keep) for number, keep in taken]

    def record_duration(self, chunks: int, seconds: float) -> None:
        """Note how long some chunks took."""
        wanted = int(chunks * TARGET_PORTION_SECONDS / max(seconds, 1e-9))
        self._n_chunks = max(1, min(wanted, MAX_PORTION_GROWTH * self._n_chunks, self._max_chunks))


def run_locally(solver: PointSolver, store: StudyStore, axes: Axes, survey: StoreSurvey, bar: StudyProgressBar) -> None:
    """Do the chunks in this process, on all its cores."""
    portions = _ChunkPortions(store, axes, survey)
    for works in portions:
        points, seconds = solve_chunks(solver, store, works)
        portions.record_duration(len(works), seconds)
        bar.advance(points)


# -- on a cluster -----------------------------------------------------------------------------------------------------


def run_on_cluster(
    task: StudyTask, store: StudyStore, axes: Axes, survey: StoreSurvey, bar: StudyProgressBar, client: Any
) -> None:
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
    portions = _ChunkPortions(store, axes, survey)
    coming = iter(portions)
    running = as_completed()
    chunks: dict[str, int] = {}

    def submit() -> bool:
        works = next(coming, None)
        if works is None:
            return False
        future = client.submit(_solve_on_worker, packed, str(store.root), works, pure=False)
        chunks[future.key] = len(works)
        running.add(future)
        return True

    try:
        while running.count() < 2 * _n_cluster_threads(client) and submit():
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
            portions.record_duration(chunks.pop(future.key), seconds)
            bar.advance(points)
            while running.count() < 2 * _n_cluster_threads(client) and submit():
                pass
    finally:
        client.cancel(list(running.futures))


def _n_cluster_threads(client: Any) -> int:
    return max(1, sum(client.nthreads().values()))


def _solve_on_worker(packed: bytes, root: str, works: list[ChunkTask]) -> tuple[int, float]:
    """What a worker does: every one of its threads has one such task, so that each ensemble takes one thread."""
    if not Path(root).is_dir():
        raise FileError(f"this worker does not see {root}: the store must be in a folder that all machines share")
    token = MAX_THREADS.set(1)
    try:
        return solve_chunks(cached_solver(packed), StudyStore.open(Path(root)), works)
    finally:
        MAX_THREADS.reset(token)
