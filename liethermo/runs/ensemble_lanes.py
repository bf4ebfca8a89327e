"""Fixed steps of many trajectories: SIMD lanes over threads (compiled), or one vmapped program per batch (array)."""

from __future__ import annotations

import abc
import contextlib
import contextvars
import functools
import math
import os
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor, wait

import numpy as np

from ..disk import available_cores
from ..engines import array_engine
from ..engines.compiled.engine import CompiledBatch
from ..engines.step import REPORTED_FIELDS
from .driver import take_scheduled_steps
from .lanes import LANES_PER_BLOCK, CompiledLanes, padded_member_indices
from .record import GroupRecord
from .schedule import CHUNK_STEPS, EngineCall

THREAD_BATCH_SIZE = 8192
"""Largest number of trajectories that a thread of the compiled engine runs at once; enough to hide Python's
overhead."""

ARRAY_BATCH_SIZE = 65_536
"""Largest number of trajectories that the array engine runs at once, which bounds memory."""

ARRAY_MAX_SAVED_VALUES = 2**26
"""Approximate upper limit of the number of state components that one call of the array engine saves."""

RECORDED_INITIAL_FIELDS = ("x", "energy", "entropy")
"""Fields of the initial engine states that a record needs; of final states it needs
:data:`.step.REPORTED_FIELDS`."""


class ProgressCounter:
    """Thread-safe counter of finished trajectories, fractions included; it reports each new total."""

    def __init__(self, report_total: Callable[[float], None]):
        self._report_total, self._n_finished, self._lock = report_total, 0.0, threading.Lock()

    def add(self, n_newly_finished: float) -> None:
        with self._lock:
            self._n_finished += n_newly_finished
            self._report_total(self._n_finished)


# -- the compiled engine ----------------------------------------------------------------------------------------------


MIN_STEPS_FOR_THREADS = 20_000
"""Number of steps, summed over trajectories, below which starting threads takes longer than the steps."""


def run_slices_in_threads(
    run_members: Callable[[slice, threading.Event], None], n_trajectories: int, max_steps_each: float = math.inf
) -> None:
    """Call ``run_members(members, stop_signal)`` for slices of the trajectories, in one thread per core.

    Ctrl-C sets the event ``stop_signal``. If each trajectory takes few steps, at most ``max_steps_each``, one call
    without threads does all the work.
    """
    n_threads, stop_signal = _n_usable_cores(), threading.Event()
    if n_trajectories * max_steps_each <= MIN_STEPS_FOR_THREADS:
        with contextlib.suppress(KeyboardInterrupt):
            run_members(slice(0, n_trajectories), stop_signal)
        return
    batch_size = LANES_PER_BLOCK * math.ceil(
        n_trajectories / (LANES_PER_BLOCK * n_threads * math.ceil(n_trajectories / (THREAD_BATCH_SIZE * n_threads)))
    )
    pool, starts = _cached_thread_pool(n_threads, os.getpid()), range(0, n_trajectories, batch_size)
    tasks = [
        pool.submit(run_members, slice(start, min(start + batch_size, n_trajectories)), stop_signal) for start in starts
    ]
    try:
        for task in tasks:
            task.result()
    except KeyboardInterrupt:
        pass
    finally:
        stop_signal.set()  # slices that have not started return at once
        wait(tasks)


@functools.cache
def _cached_thread_pool(n_threads: int, process_id: int) -> ThreadPoolExecutor:
    """Return a thread pool, which is reused because starting one takes as long as a small ensemble.

    Each process has its own pool, because a forked process does not inherit threads.
    """
    del process_id
    return ThreadPoolExecutor(n_threads)


MAX_THREADS: contextvars.ContextVar[int | None] = contextvars.ContextVar("THREADS", default=None)
"""Largest number of threads of an ensemble, for running several ensembles in separate processes of one machine."""


def _n_usable_cores() -> int:
    """Return the number of cores that this process may use."""
    n_cores = available_cores()
    return min(n_cores, MAX_THREADS.get() or n_cores)


class EnsembleRun(abc.ABC):
    """Run of a group of trajectories of an ensemble, on either engine.

    Parameters
    ----------
    record : GroupRecord
    progress_counter : ProgressCounter
    """

    def __init__(self, record: GroupRecord, progress_counter: ProgressCounter):
        self.record, self.group, self.progress_counter = record, record.group, progress_counter
        self.is_interrupted, self._record_lock = False, threading.Lock()

    def run_on_compiled_engine(self) -> None:
        """Run all trajectories in SIMD lanes over threads; the compiled loop releases the interpreter's lock."""
        group = self.group
        lanes = CompiledLanes(group.family, group.method, group.control)
        max_steps = group.schedule.n_steps if group.control is None else math.inf
        run_slices_in_threads(functools.partial(self._record_compiled_lanes, lanes), len(group.x0), max_steps)

    def run_on_array_engine(self) -> None:
        """Run all trajectories on the array engine, one vmapped program per batch."""
        n_trajectories, dim = self.group.x0.shape
        for start in range(0, n_trajectories, ARRAY_BATCH_SIZE):
            n_members = min(ARRAY_BATCH_SIZE, n_trajectories - start)
            self._run_vmapped_batch(padded_member_indices(start, start + n_members, dim), n_members)
            if self.is_interrupted:
                return

    @abc.abstractmethod
    def _record_compiled_lanes(self, lanes: CompiledLanes, members: slice, stop_signal: threading.Event) -> None:
        """Run a slice of the trajectories in SIMD lanes, until ``stop_signal`` is set."""

    @abc.abstractmethod
    def _run_vmapped_batch(self, padded_members: np.ndarray, n_members: int) -> None:
        """Run the first ``n_members`` of ``padded_members``; the others are copies of the last of these.

        Ctrl-C sets ``is_interrupted``.
        """


class FixedEnsembleRun(EnsembleRun):
    """Run of a group of trajectories of an ensemble with fixed steps."""

    def _record_compiled_lanes(self, lanes: CompiledLanes, members: slice, stop_signal: threading.Event) -> None:
        n_members = members.stop - members.start
        if not stop_signal.is_set():
            # NumPy releases the interpreter's lock in every operation; switching threads takes longer than these
            with self._record_lock:
                batch = lanes.start_compiled_batch(members, self.group.x0[members])
            calls = self.group.schedule.engine_calls(CHUNK_STEPS * 16 // max(n_members, LANES_PER_BLOCK))
            self._advance_to_end(batch, members, n_members, calls, stop_signal.is_set)

    def _run_vmapped_batch(self, padded_members: np.ndarray, n_members: int) -> None:
        group, dim = self.group, self.group.x0.shape[1]
        batch_size = min(ARRAY_BATCH_SIZE, len(group.x0))
        # bounded memory for increments and saved states
        max_steps = CHUNK_STEPS if group.noise is None else max(1, CHUNK_STEPS * 16 // batch_size)
        max_saves = max(1, min(array_engine.MAX_SAVES_PER_CALL, ARRAY_MAX_SAVED_VALUES // (batch_size * dim)))
        arguments = group.family.program_structure, *group.family.vmap_arguments(padded_members), group.method
        batch = array_engine.ArrayBatch(*arguments, group.x0[padded_members])
        calls = group.schedule.engine_calls(max_steps, max_saves)
        self._advance_to_end(batch, padded_members, n_members, calls, lambda: False)

    def _advance_to_end(
        self,
        batch: CompiledBatch | array_engine.ArrayBatch,
        members: slice | np.ndarray,
        n_members: int,
        engine_calls: Iterator[EngineCall],
        is_stopped: Callable[[], bool],
    ) -> None:
        """Advance a batch of trajectories by the engine calls of a schedule; record the saved states and statuses."""
        record, group, first_save = self.record, self.group, 1

        def record_call(engine_call: EngineCall, first_step: int, saved_states: np.ndarray) -> bool:
            """Store the saved states of an engine call; return False if the user has interrupted the run."""
            nonlocal first_save
            if engine_call.are_states_saved:
                record.store_consecutive_saves(members, first_save, saved_states)
                first_save += engine_call.n_saves
            self.progress_counter.add(
                n_members * engine_call.n_saves * engine_call.steps_per_save / group.schedule.n_steps
            )
            return not is_stopped()

        with self._record_lock:
            initial = batch.read(RECORDED_INITIAL_FIELDS)
            record.store_initial_states(members, initial["x"], initial["energy"], initial["entropy"])
        noise = None if group.noise is None else functools.partial(group.noise.step_increments, members)
        try:
            take_scheduled_steps(batch, engine_calls, record_call, noise)
        except KeyboardInterrupt:
            self.is_interrupted = True
        with self._record_lock:
            record.record_outcome_of_fixed_steps(members, initial, batch.read(REPORTED_FIELDS))
