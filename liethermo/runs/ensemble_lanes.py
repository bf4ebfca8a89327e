"""Fixed steps of many trajectories: SIMD lanes over threads (compiled), or one vmapped program per batch (array)."""

from __future__ import annotations

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
from ..engines.compiled.parameters import flat_parameters
from ..engines.compiled.step_loop import cached_step_loop
from ..engines.select_engine import MAX_COMPILED_DIM
from ..engines.step import REPORTED_FIELDS
from ..engines.step_control import StepControl
from ..integrators import OneStepMethod
from .driver import drive_fixed
from .record import GroupRecord
from .schedule import CHUNK_STEPS, EngineCall
from .system_family import Family

LANES_PER_BLOCK = 8
"""Number of trajectories in a block of the compiled engine: one AVX-512 vector, or two of AVX2."""

THREAD_BATCH_SIZE = 8192
"""Largest number of trajectories that a thread of the compiled engine runs at once; enough to hide Python's
overhead."""

ARRAY_BATCH_SIZE = 65_536
"""Largest number of trajectories that the array engine runs at once, which bounds memory."""

ARRAY_MAX_SAVED_VALUES = 2**26
"""Approximate number of state components that one call of the array engine saves at most."""

RECORDED_INITIAL_FIELDS = ("x", "energy", "entropy")
"""Fields of the initial engine states that a record needs; of final states it needs
:data:`.step.REPORTED_FIELDS`."""


class ProgressCounter:
    """Thread-safe counter of finished trajectories, fractions included; it reports each new total."""

    def __init__(self, report: Callable[[float], None]):
        self._report_total, self._n_finished, self._lock = report, 0.0, threading.Lock()

    def add(self, trajectories: float) -> None:
        with self._lock:
            self._n_finished += trajectories
            self._report_total(self._n_finished)


# -- the compiled engine ----------------------------------------------------------------------------------------------


MIN_STEPS_FOR_THREADS = 20_000
"""Number of steps, summed over trajectories, below which starting threads takes longer than the steps."""


def run_in_threads(
    work: Callable[[slice, threading.Event], None], n_trajectories: int, max_steps: float = math.inf
) -> None:
    """Call ``work(members, stop)`` for slices of the trajectories, in one thread per core; Ctrl-C sets the event
    ``stop``.

    If each trajectory takes few steps, at most ``max_steps``, one call without threads does all the work.
    """
    cores, stop = _available_cores(), threading.Event()
    if n_trajectories * max_steps <= MIN_STEPS_FOR_THREADS:
        with contextlib.suppress(KeyboardInterrupt):
            work(slice(0, n_trajectories), stop)
        return
    batch_size = LANES_PER_BLOCK * math.ceil(
        n_trajectories / (LANES_PER_BLOCK * cores * math.ceil(n_trajectories / (THREAD_BATCH_SIZE * cores)))
    )
    pool, starts = _thread_pool(cores, os.getpid()), range(0, n_trajectories, batch_size)
    tasks = [pool.submit(work, slice(start, min(start + batch_size, n_trajectories)), stop) for start in starts]
    try:
        for task in tasks:
            task.result()
    except KeyboardInterrupt:
        pass
    finally:
        stop.set()  # slices that have not started return at once
        wait(tasks)


@functools.cache
def _thread_pool(n_threads: int, process_id: int) -> ThreadPoolExecutor:
    """Return a pool of threads that is reused, because starting it takes as long as a small ensemble.

    Each process has its own pool, because a forked process does not inherit threads.
    """
    del process_id
    return ThreadPoolExecutor(n_threads)


MAX_THREADS: contextvars.ContextVar[int | None] = contextvars.ContextVar("THREADS", default=None)
"""Largest number of threads of an ensemble, for running several ensembles in separate processes of one machine."""


def _available_cores() -> int:
    """Return the number of cores that this process may use."""
    cores = available_cores()
    return min(cores, MAX_THREADS.get() or cores)


class LaneParameters:
    """Compiled step loop of a family and a method, with the parameters of its trajectories."""

    def __init__(self, family: Family, method: OneStepMethod, control: StepControl | None = None):
        self.family, self.shared_parameters = family, flat_parameters(method, *([] if control is None else [control]))
        self.first_lane_parameters = np.append(family.parameter_matrix(slice(0, 1), 1)[0], self.shared_parameters)
        self.is_per_trajectory = np.append(family.is_per_trajectory, np.zeros(len(self.shared_parameters), dtype=bool))
        self.step_loop = cached_step_loop(
            family.form, self.first_lane_parameters, method, control, LANES_PER_BLOCK, self.is_per_trajectory
        )

    def start_batch(self, members: slice, x: np.ndarray) -> CompiledBatch:
        """Return the batch of some members of the family, with steps of given sizes, from states x, shape (B, n)."""
        return CompiledBatch(self.step_loop, self.first_lane_parameters, self.parameters(members, len(x)), x)

    def parameters(self, members: slice, n_members: int) -> np.ndarray:
        """Return the parameters that lanes read: of all members, shape (p,), if these agree, else (n_members, p)."""
        if not self.is_per_trajectory.any():
            return self.first_lane_parameters
        return np.hstack(
            [
                self.family.parameter_matrix(members, n_members),
                np.broadcast_to(self.shared_parameters, (n_members, len(self.shared_parameters))),
            ]
        )


def padded_member_indices(start: int, stop: int, dim: int) -> np.ndarray:
    """Return the indices from ``start`` to ``stop``, the last one repeated until they fill whole SIMD vectors.

    A partly filled vector would round differently, so padding makes results independent of the number of trajectories.
    States of large ``dim`` fill vectors by themselves.
    """
    n_padded = (
        LANES_PER_BLOCK * math.ceil((stop - start) / LANES_PER_BLOCK) if dim <= MAX_COMPILED_DIM else stop - start
    )
    return np.minimum(np.arange(start, start + n_padded), stop - 1)


class FixedEnsembleRun:
    """Run of a group of trajectories of an ensemble with fixed steps.

    Parameters
    ----------
    record : GroupRecord
    progress_counter : ProgressCounter
    """

    def __init__(self, record: GroupRecord, progress_counter: ProgressCounter):
        self.family, self.method, self.record, self.noise = record.family, record.method, record, record.noise
        self.progress_counter, self._is_interrupted = progress_counter, False

    def run_compiled(self) -> None:
        """Run all trajectories in blocks of lanes over threads; the compiled loop releases the interpreter's lock."""
        lanes, x0, record_lock = LaneParameters(self.family, self.method), self.record.x0, threading.Lock()

        def work(members: slice, stop: threading.Event) -> None:
            n_members = members.stop - members.start
            if not stop.is_set():
                # NumPy releases the interpreter's lock in every operation; switching threads takes longer than these
                with record_lock:
                    batch = lanes.start_batch(members, x0[members])
                max_steps = CHUNK_STEPS * 16 // max(n_members, LANES_PER_BLOCK)
                calls = self.record.schedule.engine_calls(max_steps)
                self._advance_to_end(batch, members, n_members, calls, stop.is_set, record_lock)

        run_in_threads(work, len(x0), self.record.schedule.n_steps)

    def run_array(self) -> None:
        """Run all trajectories on the array engine, a vmapped program per batch."""
        n_trajectories, dim = self.record.x0.shape
        batch_size = min(ARRAY_BATCH_SIZE, n_trajectories)
        # bounded memory for increments and saved states
        max_steps = CHUNK_STEPS if self.noise is None else max(1, CHUNK_STEPS * 16 // batch_size)
        max_saves = max(1, min(array_engine.MAX_SAVES_PER_CALL, ARRAY_MAX_SAVED_VALUES // (batch_size * dim)))
        for start in range(0, n_trajectories, batch_size):
            n_members = min(batch_size, n_trajectories - start)
            members = padded_member_indices(start, start + n_members, dim)
            arguments = self.family.form, *self.family.vmap_arguments(members), self.method
            batch = array_engine.ArrayBatch(*arguments, self.record.x0[members])
            calls = self.record.schedule.engine_calls(max_steps, max_saves)
            self._advance_to_end(batch, members, n_members, calls, lambda: False, contextlib.nullcontext())
            if self._is_interrupted:
                return

    def _advance_to_end(
        self,
        batch: CompiledBatch | array_engine.ArrayBatch,
        members: slice | np.ndarray,
        n_members: int,
        calls: Iterator[EngineCall],
        is_stopped: Callable[[], bool],
        record_lock: contextlib.AbstractContextManager,
    ) -> None:
        """Advance the trajectories with these member indices by the calls of a schedule, and fill the record."""
        record, first_save = self.record, 1

        def record_call(call: EngineCall, first_step: int, states: np.ndarray) -> bool:
            nonlocal first_save
            if call.keep:
                record.store_states(members, first_save, states)
                first_save += call.n_saves
            self.progress_counter.add(n_members * call.n_saves * call.steps_per_save / record.schedule.n_steps)
            return not is_stopped()

        with record_lock:
            initial = batch.read(RECORDED_INITIAL_FIELDS)
            record.record_initial(members, initial["x"], initial["energy"], initial["entropy"])
        noise = None if self.noise is None else functools.partial(self.noise.step_increments, members)
        try:
            drive_fixed(batch, calls, record_call, noise)
        except KeyboardInterrupt:
            self._is_interrupted = True
        with record_lock:
            record.finish_fixed_step_members(members, initial, batch.read(REPORTED_FIELDS))


REPLAY_STEPS_PER_CALL = 32
"""Largest number of steps that one call of the array engine replays."""


def replay_steps(
    engine: str, family: Family, method: OneStepMethod, x: np.ndarray, h: np.ndarray, steps: int = 1
) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Take ``steps`` steps of size h[i] with each member i of a small family, on an engine, "compiled" or "array".

    Returns
    -------
    dict of arrays
        Engine fields after the steps.
    array, shape (trajectories, steps, n)
        States after each step.
    """
    batch: CompiledBatch | array_engine.ArrayBatch
    if engine == "compiled":
        batch, steps_per_call = LaneParameters(family, method).start_batch(slice(0, len(x)), x), max(1, steps)
    else:
        arguments = family.form, *family.vmap_arguments(slice(None)), method
        batch = array_engine.ArrayBatch(*arguments, x, min_capacity=REPLAY_STEPS_PER_CALL)
        steps_per_call = REPLAY_STEPS_PER_CALL
    counts = [min(steps_per_call, steps - n_done) for n_done in range(0, steps, steps_per_call)]
    states = [batch.advance(h, n_saves, 1)[..., :-2] for n_saves in counts]
    return batch.read(), np.concatenate(states, axis=1)
