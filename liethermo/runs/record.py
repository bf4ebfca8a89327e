"""What is kept of the trajectories of an ensemble, and where the evidence for its audit comes from."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from ..engines.choice import Chosen
from ..engines.codes import Code
from ..engines.compiled.form import Form
from ..engines.stepping import relaxing
from ..integrators import OneStepMethod
from ..results.audit import Rounding
from ..results.ensemble import Ensemble
from ..results.evidence import (
    STEPS_AGAIN,
    STILL,
    TINY,
    WHOLE,
    Evidence,
    laws_functions,
    most_and_others,
    sizes,
    taken_again,
    worst_of,
)
from ..results.looking import LOOKED_NUMBERS, REPLAY, Steps
from ..results.solution import Solution
from ..systems import AttitudeSystem, DrivenSystem, System
from ..tracing.interpret import at_points
from .ending import about_many
from .family import Family
from .presented import Again, presented
from .timetable import Course

NUMBERS = (
    "energy entropy energy_drift largest_energy_increment least_entropy_increment entropy_scale relaxation_time "
    "residual energy_sensitivity entropy_sensitivity first_energy entropy_change smallest_energy largest_energy "
    "end_time first_step distance"
).split()

FAILED = (Code.NOT_CONVERGED, Code.NON_FINITE, Code.STEP_UNDERFLOW, Code.STEP_LIMIT)

EXPLAINED = 1_000
"""Trajectories that failed of which more is said than that, at most."""

Part = slice | np.ndarray
"""Which trajectories, of those that are run."""


class Record:
    """What is kept of each trajectory, filled in part by part.

    Parameters
    ----------
    family : Family
        Of the systems that are run.
    member : System
        One of them.
    x0 : array, shape (B, n)
    course : Course
    outputs : {"final", "trajectory", "summary"}
    h : float
        The size of the steps; NaN of adaptive ones.
    """

    def __init__(self, family: Family, member: System, x0: np.ndarray, course: Course, outputs: str, h: float):
        self.h = h
        self.family, self.member, self.x0, self.course = family, member, x0, course
        self.times, self.counts, self.total = course.times, course.counts, course.steps
        size = len(x0)
        self.rows: dict[str, np.ndarray] = {name: np.empty(size) for name in NUMBERS}
        self.finished = np.zeros(size, dtype=bool)
        self.status = np.full(size, Code.INTERRUPTED, dtype=np.int8)
        self.steps, self.iterations, self.rejected = (np.zeros(size, dtype=np.int64) for _ in range(3))
        self.rows["first_step"][:] = course.longest[0]
        self.rows["end_time"][:] = course.start
        self.x = np.empty((size, member.dim)) if outputs == "final" else None
        self.path = np.full((size, len(self.times), member.dim + 2), np.nan) if outputs == "trajectory" else None
        self.work = np.empty(size)
        self.reasons: dict[int, str] = {}

    def begin(self, chosen: Part, x: np.ndarray, energy: np.ndarray, entropy: np.ndarray) -> None:
        """The states at the start."""
        if self.path is not None:
            self.path[chosen, 0] = np.column_stack([x, energy, entropy])

    def keep(self, chosen: Part, first: int, states: np.ndarray) -> None:
        """States at the kept times from a first one on, with energy and entropy, shape (trajectories, m, n + 2)."""
        if self.path is not None:
            self.path[chosen, first : first + states.shape[1]] = states

    def keep_at(self, chosen: np.ndarray, t: np.ndarray, states: np.ndarray) -> None:
        """The states of some trajectories, each at one of the kept times."""
        if self.path is not None:
            self.path[chosen, np.searchsorted(self.times, t)] = states

    def put(self, chosen: Part, before: Mapping[str, np.ndarray], after: Mapping[str, np.ndarray]) -> None:
        """The outcome of some trajectories of equal steps: fields of :class:`liethermo.engines.stepping.State`."""
        steps = after["step"].astype(np.int64)
        status = np.where((after["status"] == 0) & (steps < self.total), Code.INTERRUPTED, after["status"])
        self.finish(chosen, before, after, status, self.course.reached(steps))
        if self.path is not None:
            late = np.arange(len(self.counts)) >= np.searchsorted(self.counts, steps, side="right")[:, None]
            self.path[chosen] = np.where(late[..., None], np.nan, self.path[chosen])

    @np.errstate(over="ignore", invalid="ignore")  # what has overflowed is not known
    def finish(self, chosen: Part, before: Mapping, after: Mapping, status: np.ndarray, end_time: np.ndarray) -> None:
        """How some trajectories ended, and when."""
        rows, energy, first = self.rows, after["energy"], before["energy"]
        self.finished[chosen] = True
        rows["energy"][chosen], rows["entropy"][chosen] = energy, after["entropy"]
        drift = np.maximum(after["largest_energy"] - first, first - after["smallest_energy"])
        rows["energy_drift"][chosen] = drift / Rounding(first, after["energy_sensitivity"]).size
        for name in ("energy_sensitivity", "entropy_sensitivity", "first_energy", "smallest_energy", "largest_energy"):
            rows[name][chosen] = after[name]
        rows["entropy_change"][chosen] = after["entropy"] - before["entropy"]
        rows["distance"][chosen] = np.abs(after["x"] - before["x"]).max(axis=1)
        rows["largest_energy_increment"][chosen] = after["largest_energy_increment"]
        rows["least_entropy_increment"][chosen] = after["least_entropy_increment"]
        rows["entropy_scale"][chosen] = np.maximum(np.abs(before["entropy"]), np.abs(after["entropy"]))
        rows["residual"][chosen] = after["residual"]
        rows["end_time"][chosen] = end_time
        start, end = (np.asarray(relaxing(self.member, f["energy"], f["entropy"])) for f in (before, after))
        change = np.where(np.abs(end - start) > 1e-12 * np.abs(end), end - start, np.nan)
        rows["relaxation_time"][chosen] = (end * (end_time - self.course.start) - after["integral"]) / change
        self.status[chosen], self.steps[chosen] = status, after["step"]
        self.iterations[chosen] = after["fixed_point"] + after["newton"]
        self._explain(chosen, after["x"], status, end_time)
        if self.x is not None:
            self.x[chosen] = after["x"]
        if (driven := driven_part(self.member)) is not None:
            self.work[chosen] = driven.work(after["x"][..., : driven.dim])

    def _explain(self, chosen: Part, x: np.ndarray, status: np.ndarray, end_time: np.ndarray) -> None:
        """What is known of trajectories that failed, of the first of them at least."""
        status, end_time = (np.broadcast_to(a, len(x)) for a in (status, end_time))
        failed = np.flatnonzero(np.isin(status, FAILED))[: max(0, EXPLAINED - len(self.reasons))]
        if not len(failed):
            return
        places = np.arange(len(self.x0))[chosen][failed]
        own = self.family.select(places).flat(slice(None), len(places))
        speeds = _fields((self.family.form, own.shape[1]), np.concatenate([own, x[failed]], axis=1))
        for i, j, speed in zip(failed, places, speeds, strict=True):
            now = float(end_time[i])
            if text := about_many(x[i], self.x0[j], speed, now - self.course.start, now, self.h):
                self.reasons[int(j)] = text

    def close(self) -> None:
        """Nothing is known of trajectories that were not finished."""
        if not self.finished.all():
            known = [values for name, values in self.rows.items() if name not in ("first_step", "end_time")]
            for values in [*known, self.work, *([] if self.x is None else [self.x])]:
                values[~self.finished] = np.nan

    # -- the result ---------------------------------------------------------------------------------------------------

    def result(self, **fields: Any) -> Ensemble:
        """All trajectories that were run."""
        rows: dict[str, Any] = {n: values for n, values in self.rows.items() if n not in ("distance", "first_step")}
        x, energy, entropy, t = self.x, rows.pop("energy"), rows.pop("entropy"), self.times[-1:]
        if self.path is not None:
            x, energy, entropy, t = self.path[..., :-2], self.path[..., -2], self.path[..., -1], self.times
        x0, attitude, attitude0, work = self.x0, None, None, None
        if isinstance(self.member, AttitudeSystem):
            x0, attitude0 = map(np.asarray, self.member.split(x0))
            if x is not None:
                x, attitude = map(np.asarray, self.member.split(x))
        if (driven := driven_part(self.member)) is not None:
            work = self.work if self.path is None else np.asarray(driven.work(x))
            x, x0, energy = None if x is None else x[..., :-2], x0[..., :-2], energy + work
        found = Ensemble(
            t=t,
            x=x,
            energy=energy,
            entropy=None if self.member.entropy is None else entropy,
            status=self.status,
            steps=self.steps,
            iterations=self.iterations,
            rejected=self.rejected,
            x0=x0,
            attitude=attitude,
            attitude0=attitude0,
            work=work,
            **rows,
            **fields,
        )
        return self.member.on_sites(found)


class Alone:
    """Finds one trajectory of an ensemble as a run of its own would present it."""

    def __init__(self, record: Record, method: OneStepMethod, run: np.ndarray):
        self.record, self.method, self.run = record, method, run

    def __call__(self, many: Ensemble, i: int) -> Solution:
        record, j, plain = self.record, int(np.searchsorted(self.run, i)), many.member(i)
        system = record.family.member(j)
        if record.path is None:
            assert record.x is not None
            x = np.stack([record.x0[j], record.x[j]])
        else:
            x = record.path[j, : len(plain.t), :-2]
        steps = np.minimum(np.diff(plain.t), record.rows["first_step"][j])
        energy = plain.energy_balance
        found = presented(
            system,
            self.method,
            x,
            t=plain.t,
            energy=energy,
            entropy=plain.entropy,
            steps=steps,
            again=Again(Chosen(system, self.method, "auto", 1)),
            status=plain.status,
            stats=plain.stats,
            provenance=plain.provenance,
            event_time=plain.event_time,
        )
        inertia = None if system.inertia is None else system.inertia.tolist()
        return replace(found, provenance={**plain.provenance, "inertia": inertia})


class Followed:
    """Finds the local errors of steps, and how the laws' functions are rounded, when it is called.

    Some trajectories are followed again from their start: half of them those that took most iterations, half evenly
    spread. Their worst steps are compared with short ones.

    Parameters
    ----------
    follow : function of (family, method, x, h, steps)
        As :func:`.batches.follow_compiled` and :func:`.batches.follow_array`.
    equal : int
        Steps of one size that the run has taken from its start.
    """

    def __init__(self, record: Record, method: OneStepMethod, follow: Callable, equal: int):
        effort = record.iterations / np.fmax(record.steps, 1)
        some = most_and_others(effort, STEPS_AGAIN)
        self.family, self.member, self.method = record.family.select(some), record.member, method
        self.x, self.distance = np.ascontiguousarray(record.x0[some]), record.rows["distance"][some]
        self.h, self.start, self.follow = record.rows["first_step"][some], record.course.start, follow
        self.taken = record.steps[some]
        self.most = max(1, min(equal, LOOKED_NUMBERS // (REPLAY * self.x.size)))

    @np.errstate(over="ignore", invalid="ignore")  # what has overflowed is not known
    def __call__(self) -> Evidence:
        form, number = self.family.form, len(self.x)
        own = self.family.flat(slice(None), number)
        found = Evidence(terms=self._terms(own))
        after, states = self.follow(self.family, self.method, self.x, self.h, self.most)
        of, place = np.nonzero(np.arange(self.most) < np.fmin(after["step"], self.taken)[:, None])
        if not len(of):
            return found
        path = np.concatenate([self.x[:, None], states], axis=1)
        steps = Steps(self.start + place * self.h[of], self.h[of], path[of, place], path[of, place + 1])
        model, whole = (form, own.shape[1]), WHOLE * self.distance

        def field(at: np.ndarray, x: np.ndarray) -> np.ndarray:
            given = np.broadcast_to(own[of[at], None], (*x.shape[:2], own.shape[1]))
            flat = np.concatenate([given, x], axis=2).reshape(-1, own.shape[1] + x.shape[2])
            return _fields(model, flat).reshape(x.shape)

        again, defect = worst_of(steps, field, whole[of], taken_again(self.x.shape[1]))
        chosen, x, h = self.family.select(of[again]), steps.x[again], steps.h[again]
        parts = taken_again(self.x.shape[1])
        (one, _), (short, _) = (self.follow(chosen, self.method, x, h / m, m) for m in (1, parts))
        ends = [self._seen(after["x"] + after["compensation"]) for after in (one, short)]
        start = self._seen(x)
        moved = np.abs(ends[0] - start).max(axis=1)
        known = (one["status"] == 0) & (short["status"] == 0)
        moving = ~known | (moved > STILL * np.abs(start).max(axis=1))
        if not moving.any():
            return found
        errors = np.abs(ends[1] - ends[0]).max(axis=1) / np.fmax(np.fmax(moved, whole[of[again]]), TINY)
        errors = np.where(moving, np.where(known, errors, defect), 0.0)
        worst = int(np.argmax(errors))
        return replace(
            found, local_error=float(errors[worst]), error_time=float(steps.t[again[worst]]), looked=len(steps.h)
        )

    def _terms(self, own: np.ndarray) -> dict[str, float]:
        """The sizes at which the energy and the entropy are rounded, the largest of some trajectories."""
        at = np.concatenate([own, self.x], axis=1)
        largest = at_points(_first_terms, (self.family.form, own.shape[1]), at).max(axis=0)
        return {name: float(size) for name, size in zip(("energy", "entropy"), np.nan_to_num(largest), strict=False)}

    def _seen(self, x: np.ndarray) -> np.ndarray:
        return np.asarray(self.member.points(x)).reshape(len(x), -1)


def driven_part(system: System) -> DrivenSystem | None:
    """What knows of a system as it is run which work is done on it."""
    found = system.body if isinstance(system, AttitudeSystem) else system
    return found if isinstance(found, DrivenSystem) else None


def _first_terms(model: tuple[Form, int], at):
    form, p = model
    return sizes(laws_functions(form.build(at[:p])), at[p:])[1]


def _fields(model: tuple[Form, int], at: np.ndarray) -> np.ndarray:
    """The vector fields of systems at states, shape (m, n), from their parameters and the states, shape (m, p + n)."""
    with np.errstate(all="ignore"):
        return np.asarray(at_points(_field, model, at))


def _field(model: tuple[Form, int], at):
    form, p = model
    return form.build(at[:p]).vector_field(at[p:])
