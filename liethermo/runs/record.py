"""What is kept of the trajectories of an ensemble, and where the evidence for its audit comes from."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from ..engines.choice import EngineWithFallback
from ..engines.codes import StatusCode
from ..engines.compiled.form import ProgramStructure
from ..engines.stepping import relaxation_functional
from ..integrators import OneStepMethod
from ..results.audit import RoundingScale
from ..results.ensemble import Ensemble
from ..results.evidence import (
    MAX_LOCAL_ERROR_STEPS,
    MIN_MOTION_FRACTION,
    MIN_RELATIVE_MOTION,
    SMALLEST_NORMAL,
    Evidence,
    energy_and_entropy,
    largest_and_evenly_spaced,
    n_replayed_steps,
    rounding_scales,
    select_worst_steps,
)
from ..results.looking import MAX_SAMPLED_VALUES, REPLAY_COST_RATIO, StepSample
from ..results.solution import Solution
from ..systems import AttitudeSystem, DrivenSystem, System
from ..tracing.interpret import evaluate_at_points
from .ending import ensemble_failure_message
from .family import Family
from .presented import EngineReplay, build_solution
from .timetable import StepSchedule

RECORDED_QUANTITIES = (
    "energy entropy energy_drift largest_energy_increment least_entropy_increment entropy_scale relaxation_time "
    "residual energy_sensitivity entropy_sensitivity first_energy entropy_change smallest_energy largest_energy "
    "end_time first_step distance"
).split()

FAILURE_CODES = (StatusCode.NOT_CONVERGED, StatusCode.NON_FINITE, StatusCode.STEP_UNDERFLOW, StatusCode.STEP_LIMIT)

MAX_EXPLAINED_FAILURES = 1_000
"""Trajectories that failed of which more is said than that, at most."""

MemberSelection = slice | np.ndarray
"""Which trajectories, of those that are run."""


class EnsembleRecord:
    """What is kept of each trajectory, filled in part by part.

    Parameters
    ----------
    family : Family
        Of the systems that are run.
    member : System
        One of them.
    x0 : array, shape (B, n)
    schedule : Course
    outputs : {"final", "trajectory", "summary"}
    h : float
        The size of the steps; NaN of adaptive ones.
    """

    def __init__(self, family: Family, member: System, x0: np.ndarray, course: StepSchedule, outputs: str, h: float):
        self.h = h
        self.family, self.member, self.x0, self.schedule = family, member, x0, course
        self.saved_times, self.saved_step_counts, self.n_steps = (
            course.saved_times,
            course.saved_step_counts,
            course.n_steps,
        )
        size = len(x0)
        self.quantities: dict[str, np.ndarray] = {name: np.empty(size) for name in RECORDED_QUANTITIES}
        self.is_finished = np.zeros(size, dtype=bool)
        self.status = np.full(size, StatusCode.INTERRUPTED, dtype=np.int8)
        self.steps, self.iterations, self.rejected = (np.zeros(size, dtype=np.int64) for _ in range(3))
        self.quantities["first_step"][:] = course.longest_steps[0]
        self.quantities["end_time"][:] = course.start
        self.x = np.empty((size, member.dim)) if outputs == "final" else None
        self.trajectories = (
            np.full((size, len(self.saved_times), member.dim + 2), np.nan) if outputs == "trajectory" else None
        )
        self.work = np.empty(size)
        self.failure_reasons: dict[int, str] = {}

    def record_initial(self, chosen: MemberSelection, x: np.ndarray, energy: np.ndarray, entropy: np.ndarray) -> None:
        """The states at the start."""
        if self.trajectories is not None:
            self.trajectories[chosen, 0] = np.column_stack([x, energy, entropy])

    def store_states(self, chosen: MemberSelection, first: int, states: np.ndarray) -> None:
        """States at the kept times from a first one on, with energy and entropy, shape (trajectories, m, n + 2)."""
        if self.trajectories is not None:
            self.trajectories[chosen, first : first + states.shape[1]] = states

    def store_states_at(self, chosen: np.ndarray, t: np.ndarray, states: np.ndarray) -> None:
        """The states of some trajectories, each at one of the kept times."""
        if self.trajectories is not None:
            self.trajectories[chosen, np.searchsorted(self.saved_times, t)] = states

    def finish_fixed_step_members(
        self, chosen: MemberSelection, before: Mapping[str, np.ndarray], after: Mapping[str, np.ndarray]
    ) -> None:
        """The outcome of some trajectories of equal steps: fields of :class:`liethermo.engines.stepping.State`."""
        steps = after["step"].astype(np.int64)
        status = np.where((after["status"] == 0) & (steps < self.n_steps), StatusCode.INTERRUPTED, after["status"])
        self.finish_members(chosen, before, after, status, self.schedule.times_after(steps))
        if self.trajectories is not None:
            late = (
                np.arange(len(self.saved_step_counts))
                >= np.searchsorted(self.saved_step_counts, steps, side="right")[:, None]
            )
            self.trajectories[chosen] = np.where(late[..., None], np.nan, self.trajectories[chosen])

    @np.errstate(over="ignore", invalid="ignore")  # what has overflowed is not known
    def finish_members(
        self, chosen: MemberSelection, before: Mapping, after: Mapping, status: np.ndarray, end_time: np.ndarray
    ) -> None:
        """How some trajectories ended, and when."""
        rows, energy, first = self.quantities, after["energy"], before["energy"]
        self.is_finished[chosen] = True
        rows["energy"][chosen], rows["entropy"][chosen] = energy, after["entropy"]
        drift = np.maximum(after["largest_energy"] - first, first - after["smallest_energy"])
        rows["energy_drift"][chosen] = drift / RoundingScale(first, after["energy_sensitivity"]).scale
        for name in ("energy_sensitivity", "entropy_sensitivity", "first_energy", "smallest_energy", "largest_energy"):
            rows[name][chosen] = after[name]
        rows["entropy_change"][chosen] = after["entropy"] - before["entropy"]
        rows["distance"][chosen] = np.abs(after["x"] - before["x"]).max(axis=1)
        rows["largest_energy_increment"][chosen] = after["largest_energy_increment"]
        rows["least_entropy_increment"][chosen] = after["least_entropy_increment"]
        rows["entropy_scale"][chosen] = np.maximum(np.abs(before["entropy"]), np.abs(after["entropy"]))
        rows["residual"][chosen] = after["residual"]
        rows["end_time"][chosen] = end_time
        start, end = (
            np.asarray(relaxation_functional(self.member, f["energy"], f["entropy"])) for f in (before, after)
        )
        change = np.where(np.abs(end - start) > 1e-12 * np.abs(end), end - start, np.nan)
        rows["relaxation_time"][chosen] = (
            end * (end_time - self.schedule.start) - after["relaxation_integral"]
        ) / change
        self.status[chosen], self.steps[chosen] = status, after["step"]
        self.iterations[chosen] = after["fixed_point_iterations"] + after["newton_iterations"]
        self._explain_failures(chosen, after["x"], status, end_time)
        if self.x is not None:
            self.x[chosen] = after["x"]
        if (driven := driven_system(self.member)) is not None:
            self.work[chosen] = driven.work(after["x"][..., : driven.dim])

    def _explain_failures(
        self, chosen: MemberSelection, x: np.ndarray, status: np.ndarray, end_time: np.ndarray
    ) -> None:
        """What is known of trajectories that failed, of the first of them at least."""
        status, end_time = (np.broadcast_to(a, len(x)) for a in (status, end_time))
        failed = np.flatnonzero(np.isin(status, FAILURE_CODES))[
            : max(0, MAX_EXPLAINED_FAILURES - len(self.failure_reasons))
        ]
        if not len(failed):
            return
        places = np.arange(len(self.x0))[chosen][failed]
        own = self.family.select(places).parameter_matrix(slice(None), len(places))
        speeds = _vector_fields((self.family.form, own.shape[1]), np.concatenate([own, x[failed]], axis=1))
        for i, j, speed in zip(failed, places, speeds, strict=True):
            now = float(end_time[i])
            if text := ensemble_failure_message(x[i], self.x0[j], speed, now - self.schedule.start, now, self.h):
                self.failure_reasons[int(j)] = text

    def set_unfinished_to_nan(self) -> None:
        """Nothing is known of trajectories that were not finished."""
        if not self.is_finished.all():
            known = [values for name, values in self.quantities.items() if name not in ("first_step", "end_time")]
            for values in [*known, self.work, *([] if self.x is None else [self.x])]:
                values[~self.is_finished] = np.nan

    # -- the result ---------------------------------------------------------------------------------------------------

    def to_ensemble(self, **fields: Any) -> Ensemble:
        """All trajectories that were run."""
        rows: dict[str, Any] = {
            n: values for n, values in self.quantities.items() if n not in ("distance", "first_step")
        }
        x, energy, entropy, t = self.x, rows.pop("energy"), rows.pop("entropy"), self.saved_times[-1:]
        if self.trajectories is not None:
            x, energy, entropy, t = (
                self.trajectories[..., :-2],
                self.trajectories[..., -2],
                self.trajectories[..., -1],
                self.saved_times,
            )
        x0, attitude, attitude0, work = self.x0, None, None, None
        if isinstance(self.member, AttitudeSystem):
            x0, attitude0 = map(np.asarray, self.member.split_state(x0))
            if x is not None:
                x, attitude = map(np.asarray, self.member.split_state(x))
        if (driven := driven_system(self.member)) is not None:
            work = self.work if self.trajectories is None else np.asarray(driven.work(x))
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
        return self.member.reshape_to_sites(found)


class MemberSolutionBuilder:
    """Finds one trajectory of an ensemble as a run of its own would present it."""

    def __init__(self, record: EnsembleRecord, method: OneStepMethod, run: np.ndarray):
        self.record, self.method, self.trajectory_numbers = record, method, run

    def __call__(self, many: Ensemble, i: int) -> Solution:
        record, j, plain = self.record, int(np.searchsorted(self.trajectory_numbers, i)), many.member_solution(i)
        system = record.family.member(j)
        if record.trajectories is None:
            assert record.x is not None
            x = np.stack([record.x0[j], record.x[j]])
        else:
            x = record.trajectories[j, : len(plain.t), :-2]
        steps = np.minimum(np.diff(plain.t), record.quantities["first_step"][j])
        energy = plain.energy_balance
        found = build_solution(
            system,
            self.method,
            x,
            t=plain.t,
            energy=energy,
            entropy=plain.entropy,
            step_sizes=steps,
            replay=EngineReplay(EngineWithFallback(system, self.method, "auto", 1)),
            status=plain.status,
            stats=plain.stats,
            provenance=plain.provenance,
            event_time=plain.event_time,
        )
        inertia = None if system.inertia is None else system.inertia.tolist()
        return replace(found, provenance={**plain.provenance, "inertia": inertia})


class EnsembleEvidenceCollector:
    """Finds the local errors of steps, and how the laws' functions are rounded, when it is called.

    Some trajectories are followed again from their start: half of them those that took most iterations, half evenly
    spread. Their worst steps are compared with short ones.

    Parameters
    ----------
    replay : function of (family, method, x, h, steps)
        As :func:`.batches.follow_compiled` and :func:`.batches.follow_array`.
    equal : int
        Steps of one size that the run has taken from its start.
    """

    def __init__(self, record: EnsembleRecord, method: OneStepMethod, follow: Callable, equal: int):
        effort = record.iterations / np.fmax(record.steps, 1)
        some = largest_and_evenly_spaced(effort, MAX_LOCAL_ERROR_STEPS)
        self.family, self.member, self.method = record.family.select(some), record.member, method
        self.x, self.distance = np.ascontiguousarray(record.x0[some]), record.quantities["distance"][some]
        self.h, self.start_time, self.replay = record.quantities["first_step"][some], record.schedule.start, follow
        self.n_steps_taken = record.steps[some]
        self.max_replayed_steps = max(1, min(equal, MAX_SAMPLED_VALUES // (REPLAY_COST_RATIO * self.x.size)))

    @np.errstate(over="ignore", invalid="ignore")  # what has overflowed is not known
    def __call__(self) -> Evidence:
        form, number = self.family.form, len(self.x)
        own = self.family.parameter_matrix(slice(None), number)
        found = Evidence(terms=self._rounding_scales(own))
        after, states = self.replay(self.family, self.method, self.x, self.h, self.max_replayed_steps)
        of, place = np.nonzero(np.arange(self.max_replayed_steps) < np.fmin(after["step"], self.n_steps_taken)[:, None])
        if not len(of):
            return found
        path = np.concatenate([self.x[:, None], states], axis=1)
        steps = StepSample(self.start_time + place * self.h[of], self.h[of], path[of, place], path[of, place + 1])
        model, whole = (form, own.shape[1]), MIN_MOTION_FRACTION * self.distance

        def field(at: np.ndarray, x: np.ndarray) -> np.ndarray:
            given = np.broadcast_to(own[of[at], None], (*x.shape[:2], own.shape[1]))
            flat = np.concatenate([given, x], axis=2).reshape(-1, own.shape[1] + x.shape[2])
            return _vector_fields(model, flat).reshape(x.shape)

        again, defect = select_worst_steps(steps, field, whole[of], n_replayed_steps(self.x.shape[1]))
        chosen, x, h = self.family.select(of[again]), steps.x[again], steps.h[again]
        parts = n_replayed_steps(self.x.shape[1])
        (one, _), (short, _) = (self.replay(chosen, self.method, x, h / m, m) for m in (1, parts))
        ends = [self._user_states(after["x"] + after["compensation"]) for after in (one, short)]
        start = self._user_states(x)
        moved = np.abs(ends[0] - start).max(axis=1)
        known = (one["status"] == 0) & (short["status"] == 0)
        moving = ~known | (moved > MIN_RELATIVE_MOTION * np.abs(start).max(axis=1))
        if not moving.any():
            return found
        errors = np.abs(ends[1] - ends[0]).max(axis=1) / np.fmax(np.fmax(moved, whole[of[again]]), SMALLEST_NORMAL)
        errors = np.where(moving, np.where(known, errors, defect), 0.0)
        worst = int(np.argmax(errors))
        return replace(
            found, local_error=float(errors[worst]), error_time=float(steps.t[again[worst]]), looked=len(steps.h)
        )

    def _rounding_scales(self, own: np.ndarray) -> dict[str, float]:
        """The sizes at which the energy and the entropy are rounded, the largest of some trajectories."""
        at = np.concatenate([own, self.x], axis=1)
        largest = evaluate_at_points(_rounding_scales_at, (self.family.form, own.shape[1]), at).max(axis=0)
        return {name: float(size) for name, size in zip(("energy", "entropy"), np.nan_to_num(largest), strict=False)}

    def _user_states(self, x: np.ndarray) -> np.ndarray:
        return np.asarray(self.member.points(x)).reshape(len(x), -1)


def driven_system(system: System) -> DrivenSystem | None:
    """What knows of a system as it is run which work is done on it."""
    found = system.body if isinstance(system, AttitudeSystem) else system
    return found if isinstance(found, DrivenSystem) else None


def _rounding_scales_at(model: tuple[ProgramStructure, int], at):
    form, p = model
    return rounding_scales(energy_and_entropy(form.build(at[:p])), at[p:])[1]


def _vector_fields(model: tuple[ProgramStructure, int], at: np.ndarray) -> np.ndarray:
    """The vector fields of systems at states, shape (m, n), from their parameters and the states, shape (m, p + n)."""
    with np.errstate(all="ignore"):
        return np.asarray(evaluate_at_points(_vector_field, model, at))


def _vector_field(model: tuple[ProgramStructure, int], at):
    form, p = model
    return form.build(at[:p]).vector_field(at[p:])
