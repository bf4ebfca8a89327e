"""Many trajectories at once: initial states and parameters broadcast, one status for each."""

from __future__ import annotations

import math
import os
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

from .audit import Audit, AuditRow, Tolerances
from .engine import array, compiled
from .engine.programs import program
from .engine.scalarize import UnsupportedPrimitive
from .errors import InputError
from .family import Family, common_size
from .integrators import MetriplecticMidpoint, OneStepMethod
from .running import COMPILED_DIM, NO_GROUP, as_run, check_choice, is_small, laws_of, warn_of_fallback
from .solution import Laws
from .systems import AttitudeSystem, System
from .timetable import CHUNK_STEPS, Timetable

LANES = 16
"""Trajectories in a block of the compiled engine: two AVX-512 vectors, enough to hide the latency of arithmetic."""

BATCH = 4096
"""Trajectories that a thread of the compiled engine takes at once: enough to hide the cost of Python."""

ARRAY_BATCH = 65_536
"""Trajectories that the array engine takes at once: bounded memory."""

STATUSES = ("completed", "not_converged", "non_finite", "interrupted")


@dataclass(frozen=True)
class Ensemble:
    """What :func:`ensemble` returns; trajectories come first in every array, and B is their number.

    Attributes
    ----------
    t : ndarray, shape (times,)
        Start, saves and end for ``outputs="trajectory"``; otherwise the end alone, shape (1,).
    x : ndarray or None
        Final states, shape (B, n), or trajectories, shape (B, times, n), with NaN from where one failed; None for
        ``outputs="summary"``.
    energy, entropy : ndarray, shape (B,) or (B, times), as x has
        Final ones for ``"summary"``. ``entropy`` is None for a system without one.
    status : ndarray of int8, shape (B,)
        Places in ``STATUSES``: 0 completed, 1 not converged, 2 not finite, 3 interrupted.
    steps : ndarray of int64, shape (B,)
        Steps taken; where the status is not 0 the one after is the one that failed.
    residual : ndarray, shape (B,)
        ``h |k - slopes(k)| / |x|`` of the last step tried.
    energy_drift : ndarray, shape (B,)
        ``max |H - H0| / |H0|`` over every step (over 1 where H0 = 0).
    largest_energy_increment, least_entropy_increment : ndarray, shape (B,)
        Of one step, over every step.
    entropy_scale : ndarray, shape (B,)
        ``max(|S(0)|, |S(T)|)``, what rounding of the entropy is measured against.
    relaxation_time : ndarray, shape (B,)
        ``int_0^T (S(T) - S(t)) dt / (S(T) - S(0))``, T the end of the trajectory: the time constant of an exponential
        relaxation that is over by T. The energy takes the place of S under a double bracket. NaN where nothing relaxes.
    iterations : ndarray, shape (B,)
        Of the solver, in all.
    laws : Laws
    engine : str
    wall_time : float
        Seconds, compilation included.
    attitude : ndarray, shape (B, m, m) or (B, times, m, m), or None
        Elements of the group, where the system has one and states are kept.
    """

    t: np.ndarray
    x: np.ndarray | None
    energy: np.ndarray
    entropy: np.ndarray | None
    status: np.ndarray
    steps: np.ndarray
    residual: np.ndarray
    energy_drift: np.ndarray
    largest_energy_increment: np.ndarray
    least_entropy_increment: np.ndarray
    entropy_scale: np.ndarray
    relaxation_time: np.ndarray
    iterations: np.ndarray
    laws: Laws
    engine: str
    wall_time: float
    attitude: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.status)

    @property
    def ok(self) -> np.ndarray:
        """Which trajectories were completed, shape (B,)."""
        return self.status == 0

    def __str__(self) -> str:
        counts = [f"{(self.status == code).sum()} {name}" for code, name in enumerate(STATUSES) if code in self.status]
        lines = [f"{len(self)} trajectories to t = {self.t[-1]:g}: {', '.join(counts)}"]
        failed = np.flatnonzero(~self.ok)
        lines += [
            f"  {STATUSES[self.status[i]]}: trajectory {i}, after step {self.steps[i]}, residual {self.residual[i]:.2g}"
            for i in failed[:5]
        ]
        lines += [f"  and {len(failed) - 5} more"] if len(failed) > 5 else []
        return "\n".join(lines)

    def audit(self, energy: float = Tolerances.energy, entropy: float = Tolerances.entropy) -> Audit:
        """The laws at every step of every trajectory, each by the one that kept it worst; printing it gives a table.

        Parameters
        ----------
        energy, entropy : float
            As for :class:`Solution.audit`: relative drift, and fall in one step relative to ``max |S|``.
        """
        allowed = Tolerances(energy=energy, entropy=entropy)
        rows, moved = [], self.steps > 0

        def worst(law, values, tolerance):
            values = np.where(moved, values, 0.0)
            i = int(np.argmax(values))
            rows.append(
                AuditRow(law, float(values[i]), tolerance, bool(values[i] <= tolerance), f"worst is trajectory {i}")
            )

        if self.laws.energy == "conserved":
            worst("energy drift", self.energy_drift, allowed.energy)
        else:
            scale = np.maximum(np.abs(self.energy.reshape(len(self), -1)[:, -1]), np.finfo(float).tiny)
            worst("relative energy increment", self.largest_energy_increment / scale, allowed.energy)
        if self.laws.entropy == "nondecreasing":
            fall = -self.least_entropy_increment / np.where(self.entropy_scale > 0.0, self.entropy_scale, 1.0)
            worst("relative fall of the entropy", fall, allowed.entropy)
        worst("stage residual", np.where(self.ok, self.residual, 0.0), allowed.residual)
        failed = int((~self.ok & (self.status != 3)).sum())
        rows.append(AuditRow("trajectories that failed", float(failed), 0.0, failed == 0))
        least = np.nan if self.entropy is None else float(self.least_entropy_increment.min(initial=0.0, where=moved))
        drift, residual = (float(a.max(initial=0.0, where=moved)) for a in (self.energy_drift, self.residual))
        return Audit(drift, least, np.nan, residual, tuple(rows))


def ensemble(
    system: System | Callable[[Any], System],
    x0s,
    t_span: tuple[float, float],
    step: float,
    method: OneStepMethod | None = None,
    *,
    parameters=None,
    outputs: Literal["final", "trajectory", "summary"] = "final",
    save_every: int = 1,
    engine: Literal["auto", "array", "compiled"] = "auto",
    attitude=None,
) -> Ensemble:
    """Integrate many trajectories of one system, or of a family of systems.

    A trajectory that fails has its own status and does not stop the others. After Ctrl-C the rest is returned with
    the status "interrupted".

    Parameters
    ----------
    system : System, or function from one set of parameters to a System
    x0s : array, shape (n,) or (B, n)
        Initial states; one for all, or one each.
    t_span, step, method, save_every
        As for :func:`integrate`.
    parameters : optional
        One set for each trajectory: arrays with the trajectories in front. For a function, whatever it takes (an
        array, a dict of arrays, …). For a system, a dict from the names of its parameters, such as
        ``{"dissipation.rate": rates}``, to their values.
    outputs : {"final", "trajectory", "summary"}
        Final states, every ``save_every``-th state, or no states: 10^6 trajectories then need some 100 MB.
    engine : {"auto", "array", "compiled"}
        SIMD lanes over all cores for small systems ("compiled"), or ``vmap`` for any ("array"). "auto" compiles what
        can be compiled, unless JAX has an accelerator.
    attitude : array, shape (m, m) or (B, m, m), optional
        As for :func:`integrate`; one for all, or one each.

    Raises
    ------
    InputError
        If an argument cannot be used; the parameters with the smallest and largest values are tried one by one.
    """
    started = time.perf_counter()
    method = MetriplecticMidpoint() if method is None else method
    if not isinstance(method, OneStepMethod):
        raise InputError(f"the method must be an integrator such as lt.MetriplecticMidpoint(), not {method!r}")
    check_choice("outputs", outputs, ("final", "trajectory", "summary"))
    check_choice("engine", engine, ("auto", "array", "compiled"))
    family = Family.of(system, parameters)
    member = family.member(0)
    states = np.atleast_2d(np.asarray(member.state(x0s, batch=True)))
    if states.ndim > 2:
        raise InputError(f"initial states have shape (n,) or (trajectories, n), not {np.shape(x0s)}")
    attitudes = len(attitude) if np.ndim(attitude) == 3 else 1
    size = common_size(len(states), family.size, attitudes)
    states = np.broadcast_to(states, (size, states.shape[1]))
    times = Timetable(t_span, step, save_every if outputs == "trajectory" else None)
    family.check(states)
    member, method = as_run(member, method)
    if isinstance(member, AttitudeSystem):
        family, states = family.through(AttitudeSystem), np.asarray(member.begin(states, attitude, batch=True))
    elif attitude is not None:
        raise InputError(NO_GROUP)
    method.check(member)
    record = _Record(size, member, times, outputs)

    small = engine == "auto" and is_small(member, COMPILED_DIM)
    chosen = "compiled" if engine == "compiled" or small else "array"
    if chosen == "compiled":
        try:
            _run_compiled(family, method, states, times, record)
        except UnsupportedPrimitive as error:
            if engine == "compiled":
                raise
            warn_of_fallback(error, stacklevel=3)
            chosen = "array"
    if chosen == "array":
        _run_array(family, method, states, times, record)
    return record.result(laws_of(member, method, {}), chosen, time.perf_counter() - started)


# -- the two engines --------------------------------------------------------------------------------------------------


class _Record:
    """What is kept of each trajectory, filled in part by part."""

    def __init__(self, size: int, system: System, times: Timetable, outputs: str):
        self.system, self.times, self.outputs, self.counts = system, times, outputs, times.counts
        names = "energy entropy energy_drift largest_energy_increment least_entropy_increment entropy_scale"
        names += " relaxation_time residual"
        self.rows: dict[str, np.ndarray] = {name: np.full(size, np.nan) for name in names.split()}
        self.status = np.full(size, STATUSES.index("interrupted"), dtype=np.int8)
        self.steps, self.iterations = np.zeros(size, dtype=np.int64), np.zeros(size, dtype=np.int64)
        self.x = self.path = None
        if outputs == "final":
            self.x = np.full((size, system.dim), np.nan)
        elif outputs == "trajectory":
            self.path = np.full((size, len(self.counts), system.dim + 2), np.nan)

    def put(self, chosen: slice, before: dict[str, np.ndarray], after: dict[str, np.ndarray], saved) -> None:
        """The outcome of some trajectories: fields of :class:`.engine.array.State`, and the saves."""
        rows, steps = self.rows, after["step"].astype(np.int64)
        span = np.minimum(steps * self.times.h, self.times.end - self.times.start)
        energy, first = after["energy"], before["energy"]
        rows["energy"][chosen], rows["entropy"][chosen] = energy, after["entropy"]
        spread = np.maximum(after["largest_energy"] - first, first - after["smallest_energy"])
        rows["energy_drift"][chosen] = spread / np.where(first == 0.0, 1.0, np.abs(first))
        rows["largest_energy_increment"][chosen] = after["largest_energy_increment"]
        rows["least_entropy_increment"][chosen] = after["least_entropy_increment"]
        rows["entropy_scale"][chosen] = np.maximum(np.abs(before["entropy"]), np.abs(after["entropy"]))
        rows["residual"][chosen] = after["residual"]
        start, end = (np.asarray(array.relaxing(self.system, f["energy"], f["entropy"])) for f in (before, after))
        change = np.where(np.abs(end - start) > 1e-12 * np.abs(end), end - start, np.nan)
        rows["relaxation_time"][chosen] = (end * span - after["integral"]) / change
        self.status[chosen] = np.where((after["status"] == 0) & (steps < self.times.steps), 3, after["status"])
        self.steps[chosen] = steps
        self.iterations[chosen] = after["fixed_point"] + after["newton"]
        if self.x is not None:
            self.x[chosen] = after["x"]
        if self.path is not None:
            self.path[chosen, 0] = np.column_stack([before["x"], first, before["entropy"]])
            if saved:
                states = np.concatenate(saved, axis=1)
                self.path[chosen, 1 : 1 + states.shape[1]] = states
            reached = np.searchsorted(self.counts, steps, side="right")
            self.path[chosen][np.arange(len(self.counts)) >= reached[:, None]] = np.nan

    def result(self, laws: Laws, engine: str, wall_time: float) -> Ensemble:
        x, energy, entropy, t = self.x, self.rows.pop("energy"), self.rows.pop("entropy"), self.times.times[-1:]
        if self.path is not None:
            x, energy, entropy, t = self.path[..., :-2], self.path[..., -2], self.path[..., -1], self.times.times
        attitude = None
        if isinstance(self.system, AttitudeSystem) and x is not None:
            x, attitude = map(np.asarray, self.system.split(x))
        return Ensemble(
            t=t,
            x=x,
            energy=energy,
            entropy=None if self.system.entropy is None else entropy,
            status=self.status,
            steps=self.steps,
            iterations=self.iterations,
            laws=laws,
            engine=engine,
            wall_time=wall_time,
            attitude=attitude,
            **self.rows,
        )


def _run_compiled(family: Family, method, states: np.ndarray, times: Timetable, record: _Record) -> None:
    """Blocks of lanes, dealt out to a thread for each core; the loop does not hold the interpreter's lock."""
    cores, stop = len(os.sched_getaffinity(0)), threading.Event()
    size = len(states)
    portion = min(BATCH, LANES * math.ceil(size / (LANES * 4 * cores)))
    own = compiled.numbers_of(method)
    first_member = np.append(family.flat(slice(0, 1), 1)[0], own)
    varies = np.append(family.varies, np.zeros(len(own), dtype=bool))
    stepper = compiled.stepper_of(family.form, first_member, method, LANES, varies)

    def work(first: int) -> None:
        chosen = slice(first, min(first + portion, size))
        if stop.is_set():
            return
        number = chosen.stop - first
        parameters = np.hstack([family.flat(chosen, number), np.broadcast_to(own, (number, len(own)))])
        blocks = stepper.begin(parameters, states[chosen])
        before = {name: value[:number].copy() for name, value in stepper.fields(blocks).items()}
        saved = []
        for h, saves, every in times.calls(CHUNK_STEPS * 16 // portion):
            if stop.is_set():
                break
            saved.append(stepper.run(first_member, blocks, h, saves, every)[:number])
        after = {name: value[:number] for name, value in stepper.fields(blocks).items()}
        record.put(chosen, before, after, saved)

    with ThreadPoolExecutor(cores) as pool:
        tasks = [pool.submit(work, first) for first in range(0, size, portion)]
        try:
            for task in tasks:
                task.result()
        except KeyboardInterrupt:
            stop.set()
        except BaseException:
            stop.set()
            raise


def _run_array(family: Family, method, states: np.ndarray, times: Timetable, record: _Record) -> None:
    """All trajectories of a batch in one program, by ``vmap``."""
    size, interrupted = len(states), False
    portion = min(ARRAY_BATCH, size)
    for start in range(0, size, portion):
        chosen = slice(start, min(start + portion, size))
        parameters, axes = family.batched(chosen)
        saved = []
        state = before = _begin_all(family.form, parameters, axes, method, jnp.asarray(states[chosen]))
        try:
            for h, saves, every in times.calls(CHUNK_STEPS):
                numbers = jnp.asarray(h), saves, jnp.asarray(every)  # the step an argument of the program, no constant
                state, kept = _advance_all(family.form, parameters, axes, method, state, *numbers)
                saved.append(np.concatenate([kept[0], *(np.asarray(v)[..., None] for v in kept[1:3])], axis=-1))
        except KeyboardInterrupt:
            interrupted = True
        first, last = ({name: np.asarray(value) for name, value in vars(s).items()} for s in (before, state))
        record.put(chosen, first, last, saved)
        if interrupted:
            return


@program
def _begin_all(form, parameters, axes, method, x):
    return jax.vmap(lambda p, x: array.begin(form.rebuild(p), method, x), in_axes=(axes, 0))(parameters, x)


@program
def _advance_all(form, parameters, axes, method, state, h, saves: int, every):
    def one(p, state):
        return array.advance(form.rebuild(p), method, state, h, saves, every, saves)

    return jax.vmap(one, in_axes=(axes, 0))(parameters, state)
