"""Fixed steps of many trajectories: SIMD lanes over threads (compiled), or one vmapped program per batch (array)."""

from __future__ import annotations

import contextlib
import contextvars
import functools
import math
import os
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait

import jax
import jax.numpy as jnp
import numpy as np

from ..engines import array_engine
from ..engines.compiled.parameters import flat_parameters
from ..engines.compiled.step_loop import cached_step_loop
from ..engines.select_engine import MAX_COMPILED_DIM
from ..engines.solver_options import DEFAULT_OPTIONS
from ..engines.step import REPORTED_FIELDS, State, initial_run_state_program
from ..engines.step_control import StepControl
from ..integrators import OneStepMethod
from ..tracing.programs import jit_cached
from .noise import NoisePaths
from .record import EnsembleRecord
from .schedule import CHUNK_STEPS
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
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
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

    def parameters(self, members: slice, n_members: int) -> np.ndarray:
        if not self.is_per_trajectory.any():
            return self.first_lane_parameters
        return np.hstack(
            [
                self.family.parameter_matrix(members, n_members),
                np.broadcast_to(self.shared_parameters, (n_members, len(self.shared_parameters))),
            ]
        )


def run_fixed_compiled(
    family: Family,
    method: OneStepMethod,
    record: EnsembleRecord,
    progress_counter: ProgressCounter,
    noise: NoisePaths | None = None,
) -> None:
    """Run all trajectories with fixed steps on the compiled engine, in blocks of lanes over threads, and fill the
    record.

    The compiled loop releases the interpreter's lock.
    """
    lanes = LaneParameters(family, method)
    stepper, schedule, record_lock = lanes.step_loop, record.schedule, threading.Lock()

    def work(members: slice, stop: threading.Event) -> None:
        if stop.is_set():
            return
        n_members = members.stop - members.start
        # NumPy releases the interpreter's lock in every operation, and switching threads takes longer than these
        with record_lock:
            blocks = stepper.start_blocks(lanes.parameters(members, n_members), record.x0[members])
            initial = {
                name: value[:n_members].copy("K")
                for name, value in stepper.read_fields(blocks, RECORDED_INITIAL_FIELDS).items()
            }
            record.record_initial(members, initial["x"], initial["energy"], initial["entropy"])
        first_step, first_save = 0, 1
        for h, n_saves, steps_per_save, keep in schedule.engine_calls(
            CHUNK_STEPS * 16 // max(n_members, LANES_PER_BLOCK)
        ):
            if stop.is_set():
                break
            increments = (
                None if noise is None else noise.step_increments(members, first_step, n_saves * steps_per_save, h)
            )
            states, first_step = (
                stepper.run(lanes.first_lane_parameters, blocks, h, n_saves, steps_per_save, increments)[:n_members],
                first_step + n_saves * steps_per_save,
            )
            if keep:
                record.store_states(members, first_save, states)
                first_save += n_saves
            progress_counter.add(n_members * n_saves * steps_per_save / schedule.n_steps)
        with record_lock:
            final = {name: value[:n_members] for name, value in stepper.read_fields(blocks, REPORTED_FIELDS).items()}
            record.finish_fixed_step_members(members, initial, final)

    run_in_threads(work, len(record.x0), schedule.n_steps)


ReplayedSteps = tuple[dict[str, np.ndarray], np.ndarray]
"""Engine fields after some steps, and the states after each step, shape (trajectories, steps, n)."""


def replay_compiled(
    family: Family, method: OneStepMethod, x: np.ndarray, h: np.ndarray, steps: int = 1
) -> ReplayedSteps:
    """Take ``steps`` steps of size h[i] with each member i of a small family, on the compiled engine."""
    lanes, n_members = LaneParameters(family, method), len(x)
    blocks = lanes.step_loop.start_blocks(lanes.parameters(slice(None), n_members), x)
    states = lanes.step_loop.run(
        lanes.first_lane_parameters, blocks, np.resize(h, len(blocks) * LANES_PER_BLOCK), steps, 1
    )
    fields = {name: values[:n_members] for name, values in lanes.step_loop.read_fields(blocks).items()}
    return fields, np.asarray(states)[:n_members, :, :-2]


# -- the array engine -------------------------------------------------------------------------------------------------


def padded_member_indices(start: int, stop: int, dim: int) -> np.ndarray:
    """Return the indices from ``start`` to ``stop``, the last one repeated until they fill whole SIMD vectors.

    A partly filled vector would round differently, so padding makes results independent of the number of trajectories.
    States of large ``dim`` fill vectors by themselves.
    """
    n_padded = (
        LANES_PER_BLOCK * math.ceil((stop - start) / LANES_PER_BLOCK) if dim <= MAX_COMPILED_DIM else stop - start
    )
    return np.minimum(np.arange(start, start + n_padded), stop - 1)


def run_fixed_array(
    family: Family,
    method: OneStepMethod,
    record: EnsembleRecord,
    progress_counter: ProgressCounter,
    noise: NoisePaths | None = None,
) -> None:
    """Run all trajectories with fixed steps on the array engine, a vmapped program per batch, and fill the record."""
    n_trajectories, schedule, is_interrupted = len(record.x0), record.schedule, False
    batch_size, lazy_newton = min(ARRAY_BATCH_SIZE, n_trajectories), array_engine.LazyNewton(method)
    max_steps = (
        CHUNK_STEPS if noise is None else max(1, CHUNK_STEPS * 16 // batch_size)
    )  # bounded memory for the increments
    values_per_save = batch_size * record.x0.shape[1]
    max_saves = max(1, min(array_engine.MAX_SAVES_PER_CALL, ARRAY_MAX_SAVED_VALUES // values_per_save))
    for start in range(0, n_trajectories, batch_size):
        n_members = min(batch_size, n_trajectories - start)
        members = padded_member_indices(start, start + n_members, record.x0.shape[1])
        batch_arguments = family.form, *family.vmap_arguments(members), method
        state = initial_state = initial_run_states_vmapped(*batch_arguments, jnp.asarray(record.x0[members]))
        initial = {name: np.asarray(value) for name, value in initial_state._asdict().items()}
        record.record_initial(members, initial["x"], initial["energy"], initial["entropy"])
        first_step, first_save = 0, 1
        try:
            for h, n_saves, steps_per_save, keep in schedule.engine_calls(max_steps, max_saves):
                increments = (
                    None
                    if noise is None
                    else array_engine.pad_noise_increments(
                        noise.step_increments(members, first_step, n_saves * steps_per_save, h)
                    )
                )
                step_sizes, capacity = (
                    np.full(len(members), h),
                    1 << (n_saves - 1).bit_length(),
                )  # few shapes, few programs
                state, saved_states = advance_batch(
                    lazy_newton, batch_arguments, state, step_sizes, n_saves, steps_per_save, capacity, increments
                )
                first_step += n_saves * steps_per_save
                if keep:
                    record.store_states(members, first_save, saved_states)
                    first_save += n_saves
                progress_counter.add(n_members * n_saves * steps_per_save / schedule.n_steps)
        except KeyboardInterrupt:
            is_interrupted = True
        record.finish_fixed_step_members(
            members, initial, {name: np.asarray(value) for name, value in state._asdict().items()}
        )
        if is_interrupted:
            return


REPLAY_STEPS_PER_CALL = 32
"""Largest number of steps that one call replays."""


def replay_array(family: Family, method: OneStepMethod, x: np.ndarray, h: np.ndarray, steps: int = 1) -> ReplayedSteps:
    """Take ``steps`` steps of size h[i] with each member i of a small family, on the array engine."""
    batch_arguments = family.form, *family.vmap_arguments(slice(None)), method
    lazy_newton = array_engine.LazyNewton(method)
    state, chunks = initial_run_states_vmapped(*batch_arguments, jnp.asarray(x)), []
    for n_done in range(0, steps, REPLAY_STEPS_PER_CALL):
        state, saved_states = advance_batch(
            lazy_newton, batch_arguments, state, h, min(REPLAY_STEPS_PER_CALL, steps - n_done), 1, REPLAY_STEPS_PER_CALL
        )
        chunks.append(saved_states[..., :-2])
    return {name: np.asarray(value) for name, value in state._asdict().items()}, np.concatenate(chunks, axis=1)


@jit_cached
def initial_run_states_vmapped(form, parameters, axes, method, x):
    """Return the engine states of a batch of trajectories at their initial states x."""
    return jax.vmap(lambda p, x: initial_run_state_program(form.rebuild(p), method, x), in_axes=(axes, 0))(
        parameters, x
    )


def advance_batch(
    lazy_newton: array_engine.LazyNewton,
    batch_arguments: tuple,
    state: State,
    h,
    n_saves: int,
    steps_per_save: int,
    capacity: int,
    noise=None,
):
    """Advance a batch by steps of sizes h, one size per trajectory; return engine states and saved states.

    Parameters
    ----------
    batch_arguments : tuple
        Program structure, parameters, their vmap axes, and method.

    Returns
    -------
    State
    array, shape (trajectories, n_saves, n + 2)
        Saved states with energy and entropy.
    """
    form, parameters, axes, method = batch_arguments
    system_arguments, step_arguments = (
        (form, parameters, axes, method),
        (jnp.asarray(n_saves), jnp.asarray(steps_per_save), capacity, noise),
    )
    state, saved_fields = lazy_newton.advance(
        lambda s, *newton_arguments: advance_vmapped(
            *system_arguments, s, jnp.asarray(h), *step_arguments, *newton_arguments
        ),
        state,
        steps_per_save,
    )
    x, energy, entropy = (np.asarray(values)[:, :n_saves] for values in saved_fields[:3])
    return state, np.concatenate([x, energy[..., None], entropy[..., None]], axis=-1)


@jit_cached
def advance_vmapped(
    form, parameters, axes, method, state, h, n_saves, steps_per_save, capacity: int, noise, newton: bool, first_steps
):
    def one(p, state, h, noise, first_step):
        return array_engine.advance(
            form.rebuild(p),
            method,
            state,
            h,
            n_saves,
            steps_per_save,
            capacity,
            DEFAULT_OPTIONS,
            noise,
            newton,
            first_step,
        )

    return jax.vmap(one, in_axes=(axes, 0, 0, 0, 0))(parameters, state, h, noise, first_steps)
