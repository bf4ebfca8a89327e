"""Record of an ensemble run: outcome and saved states of each trajectory, and evidence for the audit."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from ..engines.adaptive_runs import EventOccurrence
from ..engines.select_engine import EngineWithFallback
from ..engines.status_codes import StatusCode
from ..engines.step import energy_or_entropy_that_relaxes
from ..engines.step_control import StepControl
from ..integrators import OneStepMethod
from ..results.audit_evidence import merge_evidence
from ..results.ensemble import Ensemble
from ..results.events import Events
from ..results.rounding_scale import RoundingScale
from ..results.solution import Solution
from ..results.status import Laws
from ..results.step_sampling import vector_field
from ..systems import System
from ..systems.states import reshape_to_sites
from .events import EventSet, collect_events
from .evidence import (
    MAX_LOCAL_ERROR_STEPS,
    MAX_SENSITIVITY_STATES,
    GroupEvidence,
    LaneReplay,
    evenly_spaced_indices,
    largest_and_evenly_spaced,
)
from .noise import NoisePaths
from .preparation import invariants_and_laws
from .problem import Problem
from .schedule import StepSchedule
from .solution_builder import RecordedFunctions, build_solution, velocities_at_states
from .system_family import Family
from .termination import ensemble_failure_message

RECORDED_QUANTITIES = (
    "energy entropy energy_drift largest_energy_increment least_entropy_increment entropy_scale relaxation_time "
    "residual energy_sensitivity entropy_sensitivity first_energy entropy_change smallest_energy largest_energy "
    "end_time first_step distance"
).split()
"""Names of the arrays, one number per trajectory, that an ensemble record holds."""

FAILURE_CODES = (StatusCode.NOT_CONVERGED, StatusCode.NON_FINITE, StatusCode.STEP_UNDERFLOW, StatusCode.STEP_LIMIT)
"""Status codes of failed trajectories."""

MAX_EXPLAINED_FAILURES = 1_000
"""Largest number of failed trajectories that are checked for unbounded growth."""

MemberSelection = slice | np.ndarray
"""Indices of trajectories in a record."""


class TrajectoryGroup(NamedTuple):
    """Trajectories of an ensemble that one program runs, as they are run.

    Attributes
    ----------
    numbers : array of int, shape (B,)
        Numbers of the trajectories in the ensemble, increasing.
    problem : Problem
        The problem of one of them, whose method and laws belong to all.
    family : Family
        Their systems.
    member : System
        One member of the family.
    x0 : array, shape (B, n)
        Initial states.
    schedule : StepSchedule
    h : float
        Step size; NaN for adaptive steps.
    control : StepControl or None
        The control of adaptive steps, and of steps of a given size with events.
    events : EventSet or None
        The events whose functions the control has.
    noise : NoisePaths or None
    """

    numbers: np.ndarray
    problem: Problem
    family: Family
    member: System
    x0: np.ndarray
    schedule: StepSchedule
    h: float
    control: StepControl | None
    events: EventSet | None
    noise: NoisePaths | None

    @property
    def method(self) -> OneStepMethod:
        """The method of all trajectories."""
        return self.problem.method


class EnsembleRecord:
    """Outcomes and saved states of all trajectories of an ensemble, filled in group by group.

    Arrays have the trajectories first. Those of trajectories in no group are NaN, and their status is inadmissible.

    Parameters
    ----------
    groups : sequence of TrajectoryGroup
        At least one.
    n_trajectories : int
        Number of trajectories of the ensemble.
    outputs : {"final", "trajectory", "summary"}

    Attributes
    ----------
    groups : list of GroupRecord
        The parts of the record that the runs of the groups fill.
    """

    def __init__(self, groups: Sequence[TrajectoryGroup], n_trajectories: int, outputs: str):
        first_group = groups[0]
        self.member, self.saved_times = first_group.member, first_group.schedule.saved_times
        self.start, dim = first_group.schedule.start, self.member.dim
        self.quantities = {name: np.full(n_trajectories, np.nan) for name in RECORDED_QUANTITIES}
        self.status = np.full(n_trajectories, StatusCode.INADMISSIBLE, dtype=np.int8)
        self.steps, self.iterations, self.rejected = (np.zeros(n_trajectories, dtype=np.int64) for _ in range(3))
        self.x = np.full((n_trajectories, dim), np.nan) if outputs == "final" else None
        self.trajectories = (
            np.full((n_trajectories, len(self.saved_times), dim + 2), np.nan) if outputs == "trajectory" else None
        )
        self.clock = self.member.clock
        self.work = None if self.clock is None else np.full(n_trajectories, np.nan)
        self.x0 = first_group.x0
        if len(self.x0) < n_trajectories:
            self.x0 = np.full((n_trajectories, dim), np.nan)
            for group in groups:
                self.x0[group.numbers] = group.x0
        self.failure_reasons: dict[int, str] = {}
        self.events: list[EventOccurrence] = []
        self.groups = [GroupRecord(self, group) for group in groups]

    def to_ensemble(self, reasons: Mapping[int, str], provenance: Mapping[str, Any], **fields: Any) -> Ensemble:
        """Return the recorded trajectories as an :class:`Ensemble`, with further fields of it.

        Parameters
        ----------
        reasons : mapping from int to str
            Why trajectories are inadmissible.
        provenance : mapping
            Without the engine.
        """
        quantities: dict[str, Any] = {
            n: values for n, values in self.quantities.items() if n not in ("distance", "first_step")
        }
        x, energy, entropy, t = self.x, quantities.pop("energy"), quantities.pop("entropy"), self.saved_times[-1:]
        if self.trajectories is not None:
            x, energy, entropy, t = (
                self.trajectories[..., :-2],
                self.trajectories[..., -2],
                self.trajectories[..., -1],
                self.saved_times,
            )
        x0, attitude, attitude0, work = self.x0, None, None, self.work
        if (layout := self.member.attitude_layout) is not None:
            x0, attitude0 = map(np.asarray, layout.split_state(x0))
            if x is not None:
                x, attitude = map(np.asarray, layout.split_state(x))
        if self.clock is not None:
            if self.trajectories is not None:
                work = np.asarray(self.clock.work(x))
            x, x0, energy = None if x is None else x[..., :-2], x0[..., :-2], energy + work
        events, sources = self.groups[0].group.events, [part.evidence_source() for part in self.groups]
        engine = " and ".join(sorted({part.engine for part in self.groups} - {""}))
        result = Ensemble(
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
            laws=common_laws([part.group.problem.laws for part in self.groups]),
            engine=engine,
            events=Events() if events is None else collect_events(self.member, events.names, self.events),
            reasons={**reasons, **self.failure_reasons},
            provenance={**provenance, "engine": engine},
            evidence_source=functools.cache(lambda: merge_evidence([source() for source in sources])),
            velocity_sources=self._velocity_getters_by_name(),
            solution_builder=self._build_solution,
            **quantities,
            **fields,
        )
        return reshape_to_sites(self.member, result)

    def _velocity_getters_by_name(self) -> dict[str, Callable[[], np.ndarray]]:
        """Return functions that compute the velocities of all trajectories, by the names of the velocities."""
        if self.x is None and self.trajectories is None:
            return {}
        return {name: functools.partial(self._velocities, name) for name in self.member.motion_quantities.velocities}

    def _velocities(self, name: str) -> np.ndarray:
        velocities, numbers = zip(*((part.velocities(name), part.numbers) for part in self.groups), strict=True)
        values = np.full((len(self.status), *velocities[0].shape[1:]), np.nan)
        values[np.concatenate(numbers)] = np.concatenate(velocities)
        return values

    def _build_solution(self, ensemble: Ensemble, i: int) -> Solution:
        """Return the solution of a trajectory, as a single run would present it."""
        part = next(part for part in self.groups if i in part.numbers)
        return part.build_solution(ensemble.member_solution(i), int(np.searchsorted(part.numbers, i)))


class GroupRecord:
    """The part of the record of an ensemble that belongs to a group of trajectories, which the run of the group fills.

    Trajectories are selected by their indices in the group.

    Parameters
    ----------
    record : EnsembleRecord
    group : TrajectoryGroup

    Attributes
    ----------
    engine : str
        The engine that has run the group.
    """

    def __init__(self, record: EnsembleRecord, group: TrajectoryGroup):
        self.record, self.group, self.numbers, self.engine = record, group, group.numbers, ""
        self._is_all = len(self.numbers) == len(record.status)
        rows = self._rows(slice(None))
        record.status[rows] = StatusCode.INTERRUPTED
        record.quantities["first_step"][rows] = group.schedule.longest_steps[0]
        record.quantities["end_time"][rows] = group.schedule.start

    def _rows(self, members: MemberSelection) -> MemberSelection:
        """Return the rows of the record for the trajectories with these indices in the group."""
        return members if self._is_all else self.numbers[members]

    @property
    def is_interrupted(self) -> bool:
        """True if the run of the group was interrupted: a trajectory has not reached its end, and has not failed."""
        return bool((self.record.status[self._rows(slice(None))] == StatusCode.INTERRUPTED).any())

    def quantity(self, name: str, members: np.ndarray) -> np.ndarray:
        """Return the recorded values of a quantity for trajectories of the group."""
        return self.record.quantities[name][self._rows(members)]

    def store_first_steps(self, members: np.ndarray, sizes: np.ndarray) -> None:
        """Store the sizes of the first steps of trajectories."""
        self.record.quantities["first_step"][self._rows(members)] = sizes

    def record_initial(self, members: MemberSelection, x: np.ndarray, energy: np.ndarray, entropy: np.ndarray) -> None:
        """Store the initial states with energy and entropy, if trajectories are saved."""
        if self.record.trajectories is not None:
            self.record.trajectories[self._rows(members), 0] = np.column_stack([x, energy, entropy])

    def store_states(self, members: MemberSelection, first_save: int, states: np.ndarray) -> None:
        """Store states from save number ``first_save`` on, with energy and entropy, shape (members, saves, n + 2)."""
        if self.record.trajectories is not None:
            saves = slice(first_save, first_save + states.shape[1])
            self.record.trajectories[self._rows(members), saves] = states

    def store_states_at(self, members: np.ndarray, t: np.ndarray, states: np.ndarray) -> None:
        """Store states with energy and entropy, shape (members, n + 2), each at its saved time t."""
        if self.record.trajectories is not None:
            self.record.trajectories[self._rows(members), np.searchsorted(self.record.saved_times, t)] = states

    def store_events(self, occurrences: Sequence[EventOccurrence], members: np.ndarray) -> None:
        """Store events of trajectories whose indices in the group are ``members[trajectory]``."""
        for event in occurrences:
            member = int(members[event.trajectory])
            if event.trajectory == 0 or members[event.trajectory - 1] != member:  # no copy that fills a padded batch
                self.record.events.append(event._replace(trajectory=int(self.numbers[member])))

    def finish_fixed_step_members(
        self, members: MemberSelection, initial: Mapping[str, np.ndarray], final: Mapping[str, np.ndarray]
    ) -> None:
        """Record the outcome of trajectories with fixed steps, from their first and last engine states.

        Parameters
        ----------
        initial, final : mapping of arrays
            Fields of :class:`liethermo.engines.step.State`.
        """
        steps, schedule = final["step"].astype(np.int64), self.group.schedule
        is_unfinished = (final["status"] == StatusCode.COMPLETED) & (steps < schedule.n_steps)
        status = np.where(is_unfinished, StatusCode.INTERRUPTED, final["status"])
        self.finish_members(members, initial, final, status, schedule.times_after(steps))
        if self.record.trajectories is not None:
            counts, rows = schedule.saved_step_counts, self._rows(members)
            is_after_end = np.arange(len(counts)) >= np.searchsorted(counts, steps, side="right")[:, None]
            trajectories = self.record.trajectories
            trajectories[rows] = np.where(is_after_end[..., None], np.nan, trajectories[rows])

    @np.errstate(over="ignore", invalid="ignore")  # overflowed states have the status non_finite
    def finish_members(
        self,
        members: MemberSelection,
        initial: Mapping,
        final: Mapping,
        status: np.ndarray,
        end_time: np.ndarray,
        n_rejected: np.ndarray | None = None,
    ) -> None:
        """Record the outcome of trajectories: status, end time, final state and the quantities of the audit."""
        record, group, rows = self.record, self.group, self._rows(members)
        quantities, energy, initial_energy = record.quantities, final["energy"], initial["energy"]
        quantities["energy"][rows], quantities["entropy"][rows] = energy, final["entropy"]
        drift = np.maximum(final["largest_energy"] - initial_energy, initial_energy - final["smallest_energy"])
        quantities["energy_drift"][rows] = drift / RoundingScale(initial_energy, final["energy_sensitivity"]).scale
        for name in ("energy_sensitivity", "entropy_sensitivity", "first_energy", "smallest_energy", "largest_energy"):
            quantities[name][rows] = final[name]
        quantities["entropy_change"][rows] = final["entropy"] - initial["entropy"]
        quantities["distance"][rows] = np.abs(final["x"] - initial["x"]).max(axis=1)
        quantities["largest_energy_increment"][rows] = final["largest_energy_increment"]
        quantities["least_entropy_increment"][rows] = final["least_entropy_increment"]
        quantities["entropy_scale"][rows] = np.maximum(np.abs(initial["entropy"]), np.abs(final["entropy"]))
        quantities["residual"][rows] = final["residual"]
        quantities["end_time"][rows] = end_time
        start, end = (
            np.asarray(energy_or_entropy_that_relaxes(group.member, f["energy"], f["entropy"]))
            for f in (initial, final)
        )
        change = np.where(np.abs(end - start) > 1e-12 * np.abs(end), end - start, np.nan)
        quantities["relaxation_time"][rows] = (
            end * (end_time - group.schedule.start) - final["relaxation_integral"]
        ) / change
        record.status[rows], record.steps[rows] = status, final["step"]
        record.iterations[rows] = final["fixed_point_iterations"] + final["newton_iterations"]
        if n_rejected is not None:
            record.rejected[rows] = n_rejected
        self._store_failure_reasons(members, final["x"], status, end_time)
        if record.x is not None:
            record.x[rows] = final["x"]
        if record.clock is not None and record.work is not None:
            record.work[rows] = record.clock.work(final["x"])

    def _store_failure_reasons(
        self, members: MemberSelection, x: np.ndarray, status: np.ndarray, end_time: np.ndarray
    ) -> None:
        """Store a message for each trajectory that grows without bound, among the first ones that fail."""
        status, end_time = (np.broadcast_to(a, len(x)) for a in (status, end_time))
        failed_rows = np.flatnonzero(np.isin(status, FAILURE_CODES))[
            : max(0, MAX_EXPLAINED_FAILURES - len(self.record.failure_reasons))
        ]
        if not len(failed_rows):
            return
        group = self.group
        member_indices = np.arange(len(group.x0))[members][failed_rows]
        with np.errstate(all="ignore"):
            velocities = np.asarray(group.family.evaluate(vector_field, member_indices, x[failed_rows]))
        for i, j, velocity in zip(failed_rows, member_indices, velocities, strict=True):
            t = float(end_time[i])
            if text := ensemble_failure_message(x[i], group.x0[j], velocity, t - group.schedule.start, t, group.h):
                self.record.failure_reasons[int(self.numbers[j])] = text

    def evidence_source(self) -> GroupEvidence:
        """Return the function that computes the evidence for an audit, of a sample of the trajectories.

        Half of them are those that took most iterations, half are evenly spaced.
        """
        record, group = self.record, self.group
        n_steps = record.steps[self.numbers]
        sample = largest_and_evenly_spaced(record.iterations[self.numbers] / np.fmax(n_steps, 1), MAX_LOCAL_ERROR_STEPS)
        n_equal_steps = 1 if np.isnan(group.h) else group.schedule.segments[0].n_full_steps
        return GroupEvidence(
            group.member,
            LaneReplay(self.engine, group.family.select(sample), group.method),
            np.ascontiguousarray(group.x0[sample]),
            group.schedule.start,
            self.quantity("first_step", sample),
            np.fmin(n_steps[sample], max(1, n_equal_steps)),
            self.quantity("distance", sample),
            *self.sampled_states(sample),
        )

    def sampled_states(self, sample: np.ndarray) -> tuple[Sequence[np.ndarray] | np.ndarray, np.ndarray]:
        """Return saved states of these trajectories, shape (sample, times, n), at times spread over the run.

        Both are empty if the run keeps no states.
        """
        record, rows = self.record, self.numbers[sample]
        if record.trajectories is not None:
            times = evenly_spaced_indices(record.trajectories.shape[1], MAX_SENSITIVITY_STATES)
            return record.trajectories[rows][:, times, :-2], record.saved_times[times]
        if record.x is None:
            return (), np.zeros(0)
        states = np.stack([record.x0[rows], record.x[rows]], axis=1)
        end = np.nanmax(record.quantities["end_time"])
        return states, np.linspace(record.start, end, MAX_SENSITIVITY_STATES)

    def velocities(self, name: str) -> np.ndarray:
        """Return the velocities of a name at the recorded states of the group, trajectories first."""
        rows, x, trajectories = self._rows(slice(None)), self.record.x, self.record.trajectories
        if trajectories is None:
            assert x is not None
            states = x[rows]
        else:
            states = trajectories[rows, ..., :-2]
        family = self.group.family
        if not any(family.has_member_axis):
            return velocities_at_states(name, self.group.member, states)
        return np.stack([velocities_at_states(name, family.member(i), x) for i, x in enumerate(states)])

    def build_solution(self, member_solution: Solution, j: int) -> Solution:
        """Return the solution of trajectory j of the group, as a single run would present it.

        ``member_solution`` is the one that the ensemble has, without conserved functions.
        """
        method, system, row, record = self.group.method, self.group.family.member(j), int(self.numbers[j]), self.record
        if record.trajectories is None:
            assert record.x is not None
            x = np.stack([self.group.x0[j], record.x[row]])
        else:
            x = record.trajectories[row, : len(member_solution.t), :-2]
        steps = np.minimum(np.diff(member_solution.t), record.quantities["first_step"][row])
        invariants, laws = invariants_and_laws(system, method)
        solution = build_solution(
            system,
            method,
            x,
            laws=laws,
            functions=RecordedFunctions.from_system(system, invariants),
            t=member_solution.t,
            energy=member_solution.energy_balance,
            entropy=member_solution.entropy,
            step_sizes=lambda: steps,
            engine=EngineWithFallback(system, method, "auto", 1),
            status=member_solution.status,
            stats=member_solution.stats,
            provenance=member_solution.provenance,
            event_time=member_solution.event_time,
            events=member_solution.events,
        )
        inertia = None if system.inertia is None else system.inertia.tolist()
        return replace(solution, provenance={**member_solution.provenance, "inertia": inertia})


def common_laws(laws_of_groups: Sequence[Laws]) -> Laws:
    """Return the laws that hold for all groups: a function is conserved or not promised only if each group has it."""
    first = laws_of_groups[0]
    promised = set.intersection(*(set(laws.conserved) for laws in laws_of_groups))
    constants = set.intersection(*({*laws.conserved, *laws.unpromised} for laws in laws_of_groups))
    names = [name for name in (*first.conserved, *first.unpromised) if name in constants]
    return replace(
        first,
        conserved=tuple(name for name in names if name in promised),
        unpromised=tuple(name for name in names if name not in promised),
        unknown=tuple(dict.fromkeys(name for laws in laws_of_groups for name in laws.unknown)),
    )
