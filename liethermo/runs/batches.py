"""Equal steps of many trajectories: in lanes over threads, or all of a batch in one program."""

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

from ..engines import array
from ..engines.choice import MAX_COMPILED_DIM
from ..engines.compiled.form import flat_parameters
from ..engines.compiled.stepper import cached_step_loop
from ..engines.pacing import StepControl
from ..engines.rules import DEFAULT_OPTIONS
from ..engines.stepping import REPORTED_FIELDS, State, initial_run_state_program
from ..integrators import OneStepMethod
from ..tracing.programs import jit_program
from .family import Family
from .fluctuations import NoisePaths
from .record import EnsembleRecord
from .timetable import CHUNK_STEPS

LANES_PER_BLOCK = 8
"""Trajectories in a block of the compiled engine: one AVX-512 vector or two of AVX2."""

THREAD_BATCH_SIZE = 8192
"""Trajectories that a thread of the compiled engine takes at once, at most: enough to hide the cost of Python."""

ARRAY_BATCH_SIZE = 65_536
"""Trajectories that the array engine takes at once: bounded memory."""

ARRAY_MAX_SAVED_VALUES = 2**26
"""Numbers of states that a call of it keeps, about."""

RECORDED_INITIAL_FIELDS = ("x", "energy", "entropy")
"""Fields of the states before a batch that its record is made from; after it those of :data:`.stepping.TELLING`."""


class ProgressCounter:
    """Counts how many trajectories are done, parts of them among them, from any thread."""

    def __init__(self, tell: Callable[[float], None]):
        self._report_total, self._n_finished, self._lock = tell, 0.0, threading.Lock()

    def add(self, trajectories: float) -> None:
        with self._lock:
            self._n_finished += trajectories
            self._report_total(self._n_finished)


# -- the compiled engine ----------------------------------------------------------------------------------------------


MIN_STEPS_FOR_THREADS = 20_000
"""Steps, of all trajectories together, that take less time than starting threads for them."""


def run_in_threads(work: Callable[[slice, threading.Event], None], size: int, steps: float = math.inf) -> None:
    """Portions of trajectories, dealt out to a thread for each core; Ctrl-C sets the event.

    Where each takes few steps, ``steps`` at most, there is one portion, and no thread.
    """
    cores, stop = _available_cores(), threading.Event()
    if size * steps <= MIN_STEPS_FOR_THREADS:
        with contextlib.suppress(KeyboardInterrupt):
            work(slice(0, size), stop)
        return
    portion = LANES_PER_BLOCK * math.ceil(
        size / (LANES_PER_BLOCK * cores * math.ceil(size / (THREAD_BATCH_SIZE * cores)))
    )
    pool, starts = _thread_pool(cores, os.getpid()), range(0, size, portion)
    tasks = [pool.submit(work, slice(first, min(first + portion, size)), stop) for first in starts]
    try:
        for task in tasks:
            task.result()
    except KeyboardInterrupt:
        pass
    finally:
        stop.set()  # those that have not begun have nothing to do
        wait(tasks)


@functools.cache
def _thread_pool(number: int, process: int) -> ThreadPoolExecutor:
    """Threads that stay, since starting them takes as long as many an ensemble; a forked process has none of them."""
    del process
    return ThreadPoolExecutor(number)


MAX_THREADS: contextvars.ContextVar[int | None] = contextvars.ContextVar("THREADS", default=None)
"""Threads of an ensemble at most: for those who run several in several processes of one machine."""


def _available_cores() -> int:
    """That this process may use, where the system tells."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return min(cores, MAX_THREADS.get() or cores)


class LaneParameters:
    """The stepper of a family, a method and a pacing, and the parameters of its trajectories."""

    def __init__(self, family: Family, method: OneStepMethod, pacing: StepControl | None = None):
        self.family, self.shared_parameters = family, flat_parameters(method, *([] if pacing is None else [pacing]))
        self.first_lane_parameters = np.append(family.parameter_matrix(slice(0, 1), 1)[0], self.shared_parameters)
        self.is_per_trajectory = np.append(family.is_per_trajectory, np.zeros(len(self.shared_parameters), dtype=bool))
        self.step_loop = cached_step_loop(
            family.form, self.first_lane_parameters, method, pacing, LANES_PER_BLOCK, self.is_per_trajectory
        )

    def parameters(self, chosen: slice, number: int) -> np.ndarray:
        if not self.is_per_trajectory.any():
            return self.first_lane_parameters
        return np.hstack(
            [
                self.family.parameter_matrix(chosen, number),
                np.broadcast_to(self.shared_parameters, (number, len(self.shared_parameters))),
            ]
        )


def run_fixed_compiled(
    family: Family,
    method: OneStepMethod,
    record: EnsembleRecord,
    tally: ProgressCounter,
    noise: NoisePaths | None = None,
) -> None:
    """Blocks of lanes; the loop does not hold the interpreter's lock."""
    lanes = LaneParameters(family, method)
    stepper, course, turn = lanes.step_loop, record.schedule, threading.Lock()

    def work(chosen: slice, stop: threading.Event) -> None:
        if stop.is_set():
            return
        number = chosen.stop - chosen.start
        with turn:  # NumPy lets other threads in at every operation, and each change takes longer than the operation
            blocks = stepper.start_blocks(lanes.parameters(chosen, number), record.x0[chosen])
            before = {
                name: value[:number].copy("K")
                for name, value in stepper.read_fields(blocks, RECORDED_INITIAL_FIELDS).items()
            }
            record.record_initial(chosen, before["x"], before["energy"], before["entropy"])
        taken, place = 0, 1
        for h, saves, every, kept in course.engine_calls(CHUNK_STEPS * 16 // max(number, LANES_PER_BLOCK)):
            if stop.is_set():
                break
            increments = None if noise is None else noise.step_increments(chosen, taken, saves * every, h)
            states, taken = (
                stepper.run(lanes.first_lane_parameters, blocks, h, saves, every, increments)[:number],
                taken + saves * every,
            )
            if kept:
                record.store_states(chosen, place, states)
                place += saves
            tally.add(number * saves * every / course.n_steps)
        with turn:
            after = {name: value[:number] for name, value in stepper.read_fields(blocks, REPORTED_FIELDS).items()}
            record.finish_fixed_step_members(chosen, before, after)

    run_in_threads(work, len(record.x0), course.n_steps)


ReplayedSteps = tuple[dict[str, np.ndarray], np.ndarray]
"""The fields of states after some steps, and the states after each, shape (trajectories, steps, n)."""


def replay_compiled(
    family: Family, method: OneStepMethod, x: np.ndarray, h: np.ndarray, steps: int = 1
) -> ReplayedSteps:
    """All members of a small family after so many steps, each of its own size."""
    lanes, number = LaneParameters(family, method), len(x)
    blocks = lanes.step_loop.start_blocks(lanes.parameters(slice(None), number), x)
    states = lanes.step_loop.run(
        lanes.first_lane_parameters, blocks, np.resize(h, len(blocks) * LANES_PER_BLOCK), steps, 1
    )
    after = {name: values[:number] for name, values in lanes.step_loop.read_fields(blocks).items()}
    return after, np.asarray(states)[:number, :, :-2]


# -- the array engine -------------------------------------------------------------------------------------------------


def padded_member_indices(first: int, last: int, dim: int) -> np.ndarray:
    """Places of trajectories, the last one repeated until they fill vectors: what is left over is rounded otherwise.

    So the numbers of a trajectory do not depend on how many there are. Large states, shape (dim,), fill vectors alone.
    """
    filled = LANES_PER_BLOCK * math.ceil((last - first) / LANES_PER_BLOCK) if dim <= MAX_COMPILED_DIM else last - first
    return np.minimum(np.arange(first, first + filled), last - 1)


def run_fixed_array(
    family: Family,
    method: OneStepMethod,
    record: EnsembleRecord,
    tally: ProgressCounter,
    noise: NoisePaths | None = None,
) -> None:
    """All trajectories of a batch in one program, by ``vmap``."""
    size, course, interrupted = len(record.x0), record.schedule, False
    portion, on_demand = min(ARRAY_BATCH_SIZE, size), array.LazyNewton(method)
    limit = CHUNK_STEPS if noise is None else max(1, CHUNK_STEPS * 16 // portion)  # bounded memory for the increments
    most = max(1, min(array.MAX_SAVES_PER_CALL, ARRAY_MAX_SAVED_VALUES // (portion * record.x0.shape[1])))
    for start in range(0, size, portion):
        number = min(portion, size - start)
        chosen = padded_member_indices(start, start + number, record.x0.shape[1])
        given = family.form, *family.vmap_arguments(chosen), method
        state = before = begin_vmapped(*given, jnp.asarray(record.x0[chosen]))
        first = {name: np.asarray(value) for name, value in before._asdict().items()}
        record.record_initial(chosen, first["x"], first["energy"], first["entropy"])
        taken, place = 0, 1
        try:
            for h, saves, every, keep in course.engine_calls(limit, most):
                increments = (
                    None
                    if noise is None
                    else array.padded_increments(noise.step_increments(chosen, taken, saves * every, h))
                )
                sizes, capacity = np.full(len(chosen), h), 1 << (saves - 1).bit_length()  # few shapes, few programs
                state, kept = advance_batch(on_demand, given, state, sizes, saves, every, capacity, increments)
                taken += saves * every
                if keep:
                    record.store_states(chosen, place, kept)
                    place += saves
                tally.add(number * saves * every / course.n_steps)
        except KeyboardInterrupt:
            interrupted = True
        record.finish_fixed_step_members(
            chosen, first, {name: np.asarray(value) for name, value in state._asdict().items()}
        )
        if interrupted:
            return


REPLAY_STEPS_PER_CALL = 32
"""Steps that one call follows at most."""


def replay_array(family: Family, method: OneStepMethod, x: np.ndarray, h: np.ndarray, steps: int = 1) -> ReplayedSteps:
    """All members of a small family after so many steps, each of its own size."""
    given, on_demand = (family.form, *family.vmap_arguments(slice(None)), method), array.LazyNewton(method)
    state, found = begin_vmapped(*given, jnp.asarray(x)), []
    for done in range(0, steps, REPLAY_STEPS_PER_CALL):
        state, kept = advance_batch(
            on_demand, given, state, h, min(REPLAY_STEPS_PER_CALL, steps - done), 1, REPLAY_STEPS_PER_CALL
        )
        found.append(kept[..., :-2])
    return {name: np.asarray(value) for name, value in state._asdict().items()}, np.concatenate(found, axis=1)


@jit_program
def begin_vmapped(form, parameters, axes, method, x):
    return jax.vmap(lambda p, x: initial_run_state_program(form.rebuild(p), method, x), in_axes=(axes, 0))(
        parameters, x
    )


def advance_batch(
    on_demand: array.LazyNewton, given: tuple, state: State, h, saves: int, every: int, capacity: int, noise=None
):
    """States after steps of sizes h, one each, and all that are kept: shape (trajectories, saves, n + 2).

    ``given`` is form, parameters, their axes, and method.
    """
    form, parameters, axes, method = given
    own, count = (form, parameters, axes, method), (jnp.asarray(saves), jnp.asarray(every), capacity, noise)
    state, kept = on_demand.advance(
        lambda s, *how: advance_vmapped(*own, s, jnp.asarray(h), *count, *how), state, every
    )
    x, energy, entropy = (np.asarray(values)[:, :saves] for values in kept[:3])
    return state, np.concatenate([x, energy[..., None], entropy[..., None]], axis=-1)


@jit_program
def advance_vmapped(form, parameters, axes, method, state, h, saves, every, capacity: int, noise, newton: bool, first):
    def one(p, state, h, noise, first):
        return array.advance(
            form.rebuild(p), method, state, h, saves, every, capacity, DEFAULT_OPTIONS, noise, newton, first
        )

    return jax.vmap(one, in_axes=(axes, 0, 0, 0, 0))(parameters, state, h, noise, first)
