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
from ..engines.choice import COMPILED_DIM
from ..engines.compiled.form import numbers_of
from ..engines.compiled.stepper import stepper_of
from ..engines.pacing import Pacing
from ..engines.rules import RULES
from ..engines.stepping import TELLING, State, begin
from ..integrators import OneStepMethod
from ..tracing.programs import program
from .family import Family
from .fluctuations import Paths
from .record import Record
from .timetable import CHUNK_STEPS

LANES = 8
"""Trajectories in a block of the compiled engine: one AVX-512 vector or two of AVX2."""

BATCH = 8192
"""Trajectories that a thread of the compiled engine takes at once, at most: enough to hide the cost of Python."""

ARRAY_BATCH = 65_536
"""Trajectories that the array engine takes at once: bounded memory."""

ARRAY_NUMBERS = 2**26
"""Numbers of states that a call of it keeps, about."""

KEPT_BEFORE = ("x", "energy", "entropy")
"""Fields of the states before a batch that its record is made from; after it those of :data:`.stepping.TELLING`."""


class Tally:
    """Counts how many trajectories are done, parts of them among them, from any thread."""

    def __init__(self, tell: Callable[[float], None]):
        self._tell, self._done, self._lock = tell, 0.0, threading.Lock()

    def add(self, trajectories: float) -> None:
        with self._lock:
            self._done += trajectories
            self._tell(self._done)


# -- the compiled engine ----------------------------------------------------------------------------------------------


SHORT = 20_000
"""Steps, of all trajectories together, that take less time than starting threads for them."""


def by_threads(work: Callable[[slice, threading.Event], None], size: int, steps: float = math.inf) -> None:
    """Portions of trajectories, dealt out to a thread for each core; Ctrl-C sets the event.

    Where each takes few steps, ``steps`` at most, there is one portion, and no thread.
    """
    cores, stop = _cores(), threading.Event()
    if size * steps <= SHORT:
        with contextlib.suppress(KeyboardInterrupt):
            work(slice(0, size), stop)
        return
    portion = LANES * math.ceil(size / (LANES * cores * math.ceil(size / (BATCH * cores))))
    pool, starts = _threads(cores, os.getpid()), range(0, size, portion)
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
def _threads(number: int, process: int) -> ThreadPoolExecutor:
    """Threads that stay, since starting them takes as long as many an ensemble; a forked process has none of them."""
    del process
    return ThreadPoolExecutor(number)


THREADS: contextvars.ContextVar[int | None] = contextvars.ContextVar("THREADS", default=None)
"""Threads of an ensemble at most: for those who run several in several processes of one machine."""


def _cores() -> int:
    """That this process may use, where the system tells."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return min(cores, THREADS.get() or cores)


class Lanes:
    """The stepper of a family, a method and a pacing, and the parameters of its trajectories."""

    def __init__(self, family: Family, method: OneStepMethod, pacing: Pacing | None = None):
        self.family, self.own = family, numbers_of(method, *([] if pacing is None else [pacing]))
        self.first = np.append(family.flat(slice(0, 1), 1)[0], self.own)
        self.varies = np.append(family.varies, np.zeros(len(self.own), dtype=bool))
        self.stepper = stepper_of(family.form, self.first, method, pacing, LANES, self.varies)

    def parameters(self, chosen: slice, number: int) -> np.ndarray:
        if not self.varies.any():
            return self.first
        return np.hstack([self.family.flat(chosen, number), np.broadcast_to(self.own, (number, len(self.own)))])


def run_compiled(
    family: Family, method: OneStepMethod, record: Record, tally: Tally, noise: Paths | None = None
) -> None:
    """Blocks of lanes; the loop does not hold the interpreter's lock."""
    lanes = Lanes(family, method)
    stepper, course, turn = lanes.stepper, record.course, threading.Lock()

    def work(chosen: slice, stop: threading.Event) -> None:
        if stop.is_set():
            return
        number = chosen.stop - chosen.start
        with turn:  # NumPy lets other threads in at every operation, and each change takes longer than the operation
            blocks = stepper.begin(lanes.parameters(chosen, number), record.x0[chosen])
            before = {name: value[:number].copy("K") for name, value in stepper.fields(blocks, KEPT_BEFORE).items()}
            record.begin(chosen, before["x"], before["energy"], before["entropy"])
        taken, place = 0, 1
        for h, saves, every, kept in course.calls(CHUNK_STEPS * 16 // max(number, LANES)):
            if stop.is_set():
                break
            increments = None if noise is None else noise.rows(chosen, taken, saves * every, h)
            states, taken = (
                stepper.run(lanes.first, blocks, h, saves, every, increments)[:number],
                taken + saves * every,
            )
            if kept:
                record.keep(chosen, place, states)
                place += saves
            tally.add(number * saves * every / course.steps)
        with turn:
            after = {name: value[:number] for name, value in stepper.fields(blocks, TELLING).items()}
            record.put(chosen, before, after)

    by_threads(work, len(record.x0), course.steps)


Followed = tuple[dict[str, np.ndarray], np.ndarray]
"""The fields of states after some steps, and the states after each, shape (trajectories, steps, n)."""


def follow_compiled(family: Family, method: OneStepMethod, x: np.ndarray, h: np.ndarray, steps: int = 1) -> Followed:
    """All members of a small family after so many steps, each of its own size."""
    lanes, number = Lanes(family, method), len(x)
    blocks = lanes.stepper.begin(lanes.parameters(slice(None), number), x)
    states = lanes.stepper.run(lanes.first, blocks, np.resize(h, len(blocks) * LANES), steps, 1)
    after = {name: values[:number] for name, values in lanes.stepper.fields(blocks).items()}
    return after, np.asarray(states)[:number, :, :-2]


# -- the array engine -------------------------------------------------------------------------------------------------


def in_whole_vectors(first: int, last: int, dim: int) -> np.ndarray:
    """Places of trajectories, the last one repeated until they fill vectors: what is left over is rounded otherwise.

    So the numbers of a trajectory do not depend on how many there are. Large states, shape (dim,), fill vectors alone.
    """
    filled = LANES * math.ceil((last - first) / LANES) if dim <= COMPILED_DIM else last - first
    return np.minimum(np.arange(first, first + filled), last - 1)


def run_array(family: Family, method: OneStepMethod, record: Record, tally: Tally, noise: Paths | None = None) -> None:
    """All trajectories of a batch in one program, by ``vmap``."""
    size, course, interrupted = len(record.x0), record.course, False
    portion, on_demand = min(ARRAY_BATCH, size), array.OnDemand(method)
    limit = CHUNK_STEPS if noise is None else max(1, CHUNK_STEPS * 16 // portion)  # bounded memory for the increments
    most = max(1, min(array.KEPT_STATES, ARRAY_NUMBERS // (portion * record.x0.shape[1])))
    for start in range(0, size, portion):
        number = min(portion, size - start)
        chosen = in_whole_vectors(start, start + number, record.x0.shape[1])
        given = family.form, *family.batched(chosen), method
        state = before = begin_all(*given, jnp.asarray(record.x0[chosen]))
        first = {name: np.asarray(value) for name, value in before._asdict().items()}
        record.begin(chosen, first["x"], first["energy"], first["entropy"])
        taken, place = 0, 1
        try:
            for h, saves, every, keep in course.calls(limit, most):
                increments = None if noise is None else array.rows(noise.rows(chosen, taken, saves * every, h))
                sizes, capacity = np.full(len(chosen), h), 1 << (saves - 1).bit_length()  # few shapes, few programs
                state, kept = advanced(on_demand, given, state, sizes, saves, every, capacity, increments)
                taken += saves * every
                if keep:
                    record.keep(chosen, place, kept)
                    place += saves
                tally.add(number * saves * every / course.steps)
        except KeyboardInterrupt:
            interrupted = True
        record.put(chosen, first, {name: np.asarray(value) for name, value in state._asdict().items()})
        if interrupted:
            return


TOGETHER = 32
"""Steps that one call follows at most."""


def follow_array(family: Family, method: OneStepMethod, x: np.ndarray, h: np.ndarray, steps: int = 1) -> Followed:
    """All members of a small family after so many steps, each of its own size."""
    given, on_demand = (family.form, *family.batched(slice(None)), method), array.OnDemand(method)
    state, found = begin_all(*given, jnp.asarray(x)), []
    for done in range(0, steps, TOGETHER):
        state, kept = advanced(on_demand, given, state, h, min(TOGETHER, steps - done), 1, TOGETHER)
        found.append(kept[..., :-2])
    return {name: np.asarray(value) for name, value in state._asdict().items()}, np.concatenate(found, axis=1)


@program
def begin_all(form, parameters, axes, method, x):
    return jax.vmap(lambda p, x: begin(form.rebuild(p), method, x), in_axes=(axes, 0))(parameters, x)


def advanced(
    on_demand: array.OnDemand, given: tuple, state: State, h, saves: int, every: int, capacity: int, noise=None
):
    """States after steps of sizes h, one each, and all that are kept: shape (trajectories, saves, n + 2).

    ``given`` is form, parameters, their axes, and method.
    """
    form, parameters, axes, method = given
    own, count = (form, parameters, axes, method), (jnp.asarray(saves), jnp.asarray(every), capacity, noise)
    state, kept = on_demand.advance(lambda s, *how: advance_all(*own, s, jnp.asarray(h), *count, *how), state, every)
    x, energy, entropy = (np.asarray(values)[:, :saves] for values in kept[:3])
    return state, np.concatenate([x, energy[..., None], entropy[..., None]], axis=-1)


@program
def advance_all(form, parameters, axes, method, state, h, saves, every, capacity: int, noise, newton: bool, first):
    def one(p, state, h, noise, first):
        return array.advance(form.rebuild(p), method, state, h, saves, every, capacity, RULES, noise, newton, first)

    return jax.vmap(one, in_axes=(axes, 0, 0, 0, 0))(parameters, state, h, noise, first)
