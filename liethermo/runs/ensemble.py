"""Many trajectories at once: initial states and parameters broadcast, one status for each."""

from __future__ import annotations

import contextvars
import functools
import math
import os
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

from ..engines import array
from ..engines.choice import COMPILED_DIM, is_small, warn_of_fallback
from ..engines.codes import TEXTS, Code
from ..engines.compiled import stepper as compiled
from ..engines.compiled.form import Form, numbers_of
from ..errors import InputError
from ..integrators import DEFAULT_METHOD, OneStepMethod
from ..results.audit import Audit, AuditRow, Rounding, Tolerances, accuracy_row
from ..results.evidence import (
    STEPS_AGAIN,
    STILL,
    WHOLE,
    Evidence,
    error_at,
    has_estimate,
    laws_functions,
    sizes,
    spread,
)
from ..results.many import laws_of_many
from ..results.status import Laws
from ..systems import AttitudeSystem, DrivenSystem, System
from ..tracing.interpret import at_points
from ..tracing.programs import program
from ..tracing.scalarize import UnsupportedPrimitive
from .family import Family, common_size
from .preparation import NO_GROUP, as_run, check_choice, laws_of
from .timetable import CHUNK_STEPS, Timetable

LANES = 8
"""Trajectories in a block of the compiled engine: one AVX-512 vector or two of AVX2."""

BATCH = 4096
"""Trajectories that a thread of the compiled engine takes at once: enough to hide the cost of Python."""

ARRAY_BATCH = 65_536
"""Trajectories that the array engine takes at once: bounded memory."""

STATUSES = TEXTS


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
        ``max |H - H0|`` over every step, relative to the size at which H is rounded: as for :class:`Audit`.
    largest_energy_increment, least_entropy_increment : ndarray, shape (B,)
        Of one step, over every step.
    entropy_scale : ndarray, shape (B,)
        ``max(|S(0)|, |S(T)|)``.
    energy_sensitivity, entropy_sensitivity : ndarray, shape (B,)
        Largest :meth:`liethermo.Energy.sensitivity` over every step: what rounding is measured against.
    first_energy : ndarray, shape (B,)
    entropy_change : ndarray, shape (B,)
        ``S(T) - S(0)``.
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
    work : ndarray, shape (B,) or (B, times), or None
        Done on the system from outside, where its energy depends on time; the drift and the increments of the energy
        are then those of the energy less the work.
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
    energy_sensitivity: np.ndarray
    entropy_sensitivity: np.ndarray
    first_energy: np.ndarray
    entropy_change: np.ndarray
    relaxation_time: np.ndarray
    iterations: np.ndarray
    laws: Laws
    engine: str
    wall_time: float
    attitude: np.ndarray | None = None
    work: np.ndarray | None = None
    witness: Callable[[], Evidence] | None = field(default=None, repr=False, compare=False)

    @functools.cached_property
    def evidence(self) -> Evidence:
        """What an audit needs besides the series: found when first asked for."""
        return Evidence() if self.witness is None else self.witness()

    def __getstate__(self) -> dict[str, Any]:  # a copy in another process knows the evidence, not how to find it
        return {**vars(self), "evidence": self.evidence, "witness": None}

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

    def audit(
        self, energy: float = Tolerances.energy, entropy: float = Tolerances.entropy, **tolerances: float
    ) -> Audit:
        """The laws at every step of every trajectory, each by the one that kept it worst; printing it gives a table.

        The local error is estimated in the first step of at most 32 trajectories.

        Parameters
        ----------
        energy, entropy, casimirs, residual, accuracy : float
            What is accepted: see :class:`liethermo.results.audit.Tolerances`.

        Raises
        ------
        InputError
            If there is no tolerance of a name, or it is negative.
        """
        accepted = Tolerances.of(energy=energy, entropy=entropy, **tolerances)
        moved, terms = self.steps > 0, self.evidence.terms
        rows = []
        for law in laws_of_many(self, self.laws, accepted, terms.get("energy", 0.0), terms.get("entropy", 0.0)):
            i = law.worst
            rows.append(law.as_row(i, f"worst is trajectory {i}"))
        if self.witness is not None or self.evidence.local_error is not None:
            rows.append(accuracy_row(self.evidence, accepted))
        failed = int((~self.ok & (self.status != 3)).sum())
        rows.append(AuditRow("trajectories that failed", float(failed), 0.0, failed == 0))
        least = np.nan if self.entropy is None else float(self.least_entropy_increment.min(initial=0.0, where=moved))
        drift, residual = (float(a.max(initial=0.0, where=moved)) for a in (self.energy_drift, self.residual))
        return Audit(drift, least, np.nan, residual, tuple(rows))


def ensemble(
    system: System | Callable[[Any], System] | Family,
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
    method = DEFAULT_METHOD if method is None else method
    if not isinstance(method, OneStepMethod):
        raise InputError(f"the method must be an integrator such as lt.MetriplecticGauss(), not {method!r}")
    check_choice("outputs", outputs, ("final", "trajectory", "summary"))
    check_choice("engine", engine, ("auto", "array", "compiled"))
    family = Family.of(system, parameters)
    member = family.representative
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
    if isinstance(member, DrivenSystem):
        family, states = family.through(DrivenSystem), np.asarray(member.begin(states, times.start, batch=True))
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
            warn_of_fallback(error)
            chosen = "array"
    if chosen == "array":
        _run_array(family, method, states, times, record)
    witness = _Witness(family, member, method, states, times, record, chosen) if has_estimate(method) else None
    return record.result(laws_of(member, method, {}), chosen, time.perf_counter() - started, witness)


# -- the two engines --------------------------------------------------------------------------------------------------


class _Record:
    """What is kept of each trajectory, filled in part by part."""

    def __init__(self, size: int, system: System, times: Timetable, outputs: str):
        self.system, self.times, self.outputs, self.counts = system, times, outputs, times.counts
        names = "energy entropy energy_drift largest_energy_increment least_entropy_increment entropy_scale"
        names += " relaxation_time residual energy_sensitivity entropy_sensitivity first_energy entropy_change distance"
        self.rows: dict[str, np.ndarray] = {name: np.full(size, np.nan) for name in names.split()}
        self.status = np.full(size, Code.INTERRUPTED, dtype=np.int8)
        self.steps, self.iterations = np.zeros(size, dtype=np.int64), np.zeros(size, dtype=np.int64)
        self.x = self.path = None
        self.work = np.full(size, np.nan)
        if outputs == "final":
            self.x = np.full((size, system.dim), np.nan)
        elif outputs == "trajectory":
            self.path = np.full((size, len(self.counts), system.dim + 2), np.nan)

    def put(self, chosen: slice, before: dict[str, np.ndarray], after: dict[str, np.ndarray], saved) -> None:
        """The outcome of some trajectories: fields of :class:`liethermo.engines.array.State`, and the saves."""
        rows, steps = self.rows, after["step"].astype(np.int64)
        span = np.minimum(steps * self.times.h, self.times.end - self.times.start)
        energy, first = after["energy"], before["energy"]
        rows["energy"][chosen], rows["entropy"][chosen] = energy, after["entropy"]
        drift = np.maximum(after["largest_energy"] - first, first - after["smallest_energy"])
        rows["energy_drift"][chosen] = drift / Rounding(first, after["energy_sensitivity"]).size
        for name in ("energy_sensitivity", "entropy_sensitivity", "first_energy"):
            rows[name][chosen] = after[name]
        rows["entropy_change"][chosen] = after["entropy"] - before["entropy"]
        rows["distance"][chosen] = np.abs(after["x"] - before["x"]).max(axis=1)
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
        if isinstance(self.system, DrivenSystem):
            self.work[chosen] = self.system.work(after["x"])
        if self.path is not None:
            self.path[chosen, 0] = np.column_stack([before["x"], first, before["entropy"]])
            if saved:
                states = np.concatenate(saved, axis=1)
                self.path[chosen, 1 : 1 + states.shape[1]] = states
            reached = np.searchsorted(self.counts, steps, side="right")
            self.path[chosen][np.arange(len(self.counts)) >= reached[:, None]] = np.nan

    def result(self, laws: Laws, engine: str, wall_time: float, witness) -> Ensemble:
        x, energy, entropy, t = self.x, self.rows.pop("energy"), self.rows.pop("entropy"), self.times.times[-1:]
        if self.path is not None:
            x, energy, entropy, t = self.path[..., :-2], self.path[..., -2], self.path[..., -1], self.times.times
        attitude = work = None
        self.rows.pop("distance")
        if isinstance(self.system, AttitudeSystem) and x is not None:
            x, attitude = map(np.asarray, self.system.split(x))
        if isinstance(self.system, DrivenSystem):
            work = self.work if self.path is None else np.asarray(self.system.work(x))
            x, energy = None if x is None else x[..., :-2], energy + work
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
            work=work,
            witness=witness,
            **self.rows,
        )


class _Witness:
    """Finds the local errors of first steps, and how the laws' functions are rounded there, when it is called."""

    def __init__(self, family: Family, member: System, method, states: np.ndarray, times: Timetable, record, engine):
        some = spread(len(states), STEPS_AGAIN)
        self.family = Family(family.form, [value[some] if len(value) > 1 else value for value in family.values])
        self.member, self.method, self.engine = member, method, engine
        self.x, self.distance = np.ascontiguousarray(states[some]), record.rows["distance"][some]
        self.h, self.start = times.h if times.full else times.last, times.start

    def __call__(self) -> Evidence:
        form, number = self.family.form, len(self.x)
        own = self.family.flat(slice(None), number)
        if self.engine == "compiled":
            first = self.family.flat(slice(0, 1), 1)[0]
            stepper = compiled.stepper_of(form, first, self.method, LANES, self.family.varies)
            blocks = stepper.begin(own, self.x)
            stepper.run(first, blocks, self.h, 1, 1)
            after = {name: values[:number] for name, values in stepper.fields(blocks).items()}
        else:
            parameters, axes = self.family.batched(slice(None))
            state = _begin_all(form, parameters, axes, self.method, jnp.asarray(self.x))
            state, _ = _advance_all(form, parameters, axes, self.method, state, jnp.asarray(self.h), 1, jnp.asarray(1))
            after = {name: np.asarray(value) for name, value in state._asdict().items()}
        moved = np.abs(self._seen(after["x"] + after["low"]) - self._seen(self.x)).max(axis=1)
        found = Evidence(terms=self._terms(own))
        told = (after["status"] == 0) & (moved > STILL * np.abs(self.x).max(axis=1))
        if not told.any():
            return found
        h = np.full((number, 1), self.h)
        steps = np.concatenate([own, self.x, h, after["k"].reshape(number, -1)], axis=1)[told]
        errors = at_points(_first_errors, (form, self.method, len(own[0])), steps)
        relative = errors / np.fmax(moved, WHOLE * self.distance)[told]
        return replace(found, local_error=float(np.nan_to_num(relative).max()), error_time=self.start)

    def _terms(self, own: np.ndarray) -> dict[str, float]:
        """The sizes at which the energy and the entropy are rounded, the largest of some trajectories."""
        at = np.concatenate([own, self.x], axis=1)
        largest = at_points(_first_terms, (self.family.form, own.shape[1]), at).max(axis=0)
        return {name: float(size) for name, size in zip(("energy", "entropy"), np.nan_to_num(largest), strict=False)}

    def _seen(self, x: np.ndarray) -> np.ndarray:
        return np.asarray(self.member.points(x)).reshape(len(x), -1)


def _first_terms(model: tuple[Form, int], at):
    form, p = model
    return sizes(laws_functions(form.build(at[:p])), at[p:])[1]


def _first_errors(model: tuple[Form, OneStepMethod, int], step):
    form, method, p = model
    system = form.build(step[:p])
    return error_at(system, method, step[p:])


KEPT_BEFORE = ("x", "energy", "entropy")
KEPT_AFTER = tuple(name for name in array.State._fields if name not in ("low", "k", "before"))
"""Fields of the states of a batch that its record is made from."""


THREADS: contextvars.ContextVar[int | None] = contextvars.ContextVar("THREADS", default=None)
"""Threads of an ensemble at most: for those who run several in several processes of one machine."""


def _cores() -> int:
    """That this process may use, where the system tells."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return min(cores, THREADS.get() or cores)


def _run_compiled(family: Family, method, states: np.ndarray, times: Timetable, record: _Record) -> None:
    """Blocks of lanes, dealt out to a thread for each core; the loop does not hold the interpreter's lock."""
    cores, stop = _cores(), threading.Event()
    size = len(states)
    portion = min(BATCH, LANES * math.ceil(size / (LANES * 2 * cores)))
    own = numbers_of(method)
    first_member = np.append(family.flat(slice(0, 1), 1)[0], own)
    varies = np.append(family.varies, np.zeros(len(own), dtype=bool))
    stepper = compiled.stepper_of(family.form, first_member, method, LANES, varies)

    def work(first: int) -> None:
        chosen = slice(first, min(first + portion, size))
        if stop.is_set():
            return
        number = chosen.stop - first
        parameters = first_member
        if varies.any():
            parameters = np.hstack([family.flat(chosen, number), np.broadcast_to(own, (number, len(own)))])
        blocks = stepper.begin(parameters, states[chosen])
        before = {name: value[:number].copy() for name, value in stepper.fields(blocks, KEPT_BEFORE).items()}
        saved = []
        for h, saves, every in times.calls(CHUNK_STEPS * 16 // portion):
            if stop.is_set():
                break
            saved.append(stepper.run(first_member, blocks, h, saves, every)[:number])
        after = {name: value[:number] for name, value in stepper.fields(blocks, KEPT_AFTER).items()}
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
        first, last = ({name: np.asarray(value) for name, value in s._asdict().items()} for s in (before, state))
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
