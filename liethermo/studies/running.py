"""Execution of the chunks of a study: in this process on all cores, or by the workers of a Dask cluster."""

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
from .solve import EMPTY_POINT_STATUS, PointSolver, StudyTask, cached_solver
from .store import StoreSurvey, StudyStore

TARGET_PORTION_SECONDS = 2.0
"""Target duration in seconds of a portion, the chunks that a worker solves together."""

MAX_POINTS_PER_PORTION = 65_536
"""Maximum number of points in a portion."""

MAX_PORTION_GROWTH = 4
"""Maximum factor by which the number of chunks grows from one portion to the next."""


@dataclass(frozen=True)
class ChunkTask:
    """The points of a chunk that have to be solved.

    Attributes
    ----------
    chunk_index : tuple of int
    is_partial : bool
        True if other points of the chunk are finished and have to be preserved.
    point_indices : tuple of ndarray, shape (m,)
        Indices of the points along each axis.
    parameters : dict of ndarray, shape (m,)
    states : ndarray, shape (m, n), or None
        Initial states from an axis of replicas.
    """

    chunk_index: tuple[int, ...]
    is_partial: bool
    point_indices: tuple[np.ndarray, ...]
    parameters: dict[str, np.ndarray]
    states: np.ndarray | None

    @classmethod
    def from_chunk(cls, store: StudyStore, axes: Axes, chunk_number: int, is_partial: bool) -> ChunkTask:
        """Return the task that solves all points of a chunk, or only the missing points if the chunk is partial."""
        chunk_index = store.chunk_index(chunk_number)
        is_missing = store.read_chunk("status", chunk_index) == EMPTY_POINT_STATUS if is_partial else None
        point_indices = store.point_indices(chunk_index, is_missing)
        return cls(
            chunk_index, is_partial, point_indices, axes.parameters_at(point_indices), axes.states_at(point_indices)
        )

    def __len__(self) -> int:
        return len(self.point_indices[0])


def solve_and_write_chunks(solver: PointSolver, store: StudyStore, tasks: Sequence[ChunkTask]) -> tuple[int, float]:
    """Solve the points of several chunks together and write the chunks; return the number of points and the elapsed
    seconds."""
    start_time = time.perf_counter()
    names = tasks[0].parameters
    points = {name: np.concatenate([task.parameters[name] for task in tasks]) for name in names}
    states = (
        None if tasks[0].states is None else np.concatenate([task.states for task in tasks if task.states is not None])
    )
    counts = [len(task) for task in tasks]
    noise, seeds = solver.task.noise, None
    if noise is not None:
        seeds = noise.grid_seeds(
            [np.concatenate(column) for column in zip(*(task.point_indices for task in tasks), strict=True)]
        )
    arrays = solver.solve(points, states, sum(counts), seeds).arrays_by_name()
    start = 0
    for task, count in zip(tasks, counts, strict=True):
        chunk_arrays = {name: values[start : start + count] for name, values in arrays.items()}
        store.write_chunk(task.chunk_index, task.point_indices, chunk_arrays, task.is_partial)
        start += count
    return sum(counts), time.perf_counter() - start_time


class _ChunkPortions:
    """Iterator over lists of chunks, each of which takes about :data:`TARGET_PORTION_SECONDS`."""

    def __init__(self, store: StudyStore, axes: Axes, survey: StoreSurvey):
        self._store, self._axes, self._remaining_chunks = store, axes, iter(survey.remaining_chunks)
        self._n_chunks = 1
        chunk_size = int(np.prod(store.arrays["status"].chunks))
        self._max_chunks = max(1, MAX_POINTS_PER_PORTION // chunk_size)

    def __iter__(self) -> Iterator[list[ChunkTask]]:
        while True:
            chunks = list(itertools.islice(self._remaining_chunks, self._n_chunks))
            if not chunks:
                return
            yield [
                ChunkTask.from_chunk(self._store, self._axes, chunk_number, is_partial)
                for chunk_number, is_partial in chunks
            ]

    def adapt_portion_size(self, n_chunks: int, seconds: float) -> None:
        """Set the number of chunks in the next portion from the time that ``n_chunks`` chunks took."""
        target_chunks = int(n_chunks * TARGET_PORTION_SECONDS / max(seconds, 1e-9))
        self._n_chunks = max(1, min(target_chunks, MAX_PORTION_GROWTH * self._n_chunks, self._max_chunks))


def solve_chunks_locally(
    solver: PointSolver, store: StudyStore, axes: Axes, survey: StoreSurvey, progress_bar: StudyProgressBar
) -> None:
    """Solve the remaining chunks of a study in this process, on all cores, and write them to the store."""
    portions = _ChunkPortions(store, axes, survey)
    for tasks in portions:
        n_points, seconds = solve_and_write_chunks(solver, store, tasks)
        portions.adapt_portion_size(len(tasks), seconds)
        progress_bar.advance(n_points)


# -- on a cluster -----------------------------------------------------------------------------------------------------


def solve_chunks_on_cluster(
    study_task: StudyTask,
    store: StudyStore,
    axes: Axes,
    survey: StoreSurvey,
    progress_bar: StudyProgressBar,
    client: Any,
) -> None:
    """Solve the remaining chunks of a study on the workers of a Dask cluster; each worker writes its chunks itself.

    Raises
    ------
    FileError
        If a worker cannot access the store.
    LiethermoError
        If several workers died while they solved a portion.
    """
    import cloudpickle
    from distributed import as_completed
    from distributed.scheduler import KilledWorker

    pickled_task = cloudpickle.dumps(study_task)
    portions = _ChunkPortions(store, axes, survey)
    task_lists = iter(portions)
    pending_futures = as_completed()
    n_chunks_by_future: dict[str, int] = {}

    def submit_next_portion() -> bool:
        tasks = next(task_lists, None)
        if tasks is None:
            return False
        future = client.submit(_solve_and_write_on_worker, pickled_task, str(store.root), tasks, pure=False)
        n_chunks_by_future[future.key] = len(tasks)
        pending_futures.add(future)
        return True

    try:
        while pending_futures.count() < 2 * _n_cluster_threads(client) and submit_next_portion():
            pass
        for future in pending_futures:
            try:
                n_points, seconds = future.result()
            except ImportError as error:
                raise LiethermoError(
                    f"a worker cannot import the module that builds the systems: {error}. Install it on the workers"
                ) from error
            except KilledWorker as error:
                raise LiethermoError(
                    f"several workers died while they solved {n_chunks_by_future[future.key]} chunks, perhaps for "
                    "lack of memory. "
                    f"Use smaller chunks (chunk=...). Finished chunks are saved. {error}"
                ) from error
            portions.adapt_portion_size(n_chunks_by_future.pop(future.key), seconds)
            progress_bar.advance(n_points)
            while pending_futures.count() < 2 * _n_cluster_threads(client) and submit_next_portion():
                pass
    finally:
        client.cancel(list(pending_futures.futures))


def _n_cluster_threads(client: Any) -> int:
    return max(1, sum(client.nthreads().values()))


def _solve_and_write_on_worker(pickled_task: bytes, store_root: str, tasks: list[ChunkTask]) -> tuple[int, float]:
    """Solve and write chunks on a Dask worker, with one thread per ensemble, as every thread of the worker runs a
    task."""
    if not Path(store_root).is_dir():
        raise FileError(f"this worker does not see {store_root}: the store must be in a folder that all machines share")
    token = MAX_THREADS.set(1)
    try:
        return solve_and_write_chunks(cached_solver(pickled_task), StudyStore.open(Path(store_root)), tasks)
    finally:
        MAX_THREADS.reset(token)
