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
    GroupEvidenceSource,
    LaneReplay,
    evenly_spaced_indices,
    indices_of_largest_and_evenly_spaced,
)
from .noise import NoisePaths
from .preparation import invariants_and_laws
from .problem import Problem
from .schedule import StepSchedule
from .solution_builder import RecordedFunctions, build_solution, velocities_at_states
from .system_family import Family
from .termination import ensemble_blow_up_message_or_empty

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
    """Trajectories of an ensemble that one program runs, with their systems, initial states, schedule and noise.

    Attributes
    ----------
    trajectory_numbers : array of int, shape (B,)
        Numbers of the trajectories in the ensemble, increasing.
    problem : Problem
        The problem of one trajectory, whose method and laws belong to all.
    family : Family
        The systems of the trajectories.
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
        The events, whose functions the control monitors.
    noise : NoisePaths or None
    """

    trajectory_numbers: np.ndarray
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

    The first axis of arrays is that of the trajectories. The entries of trajectories that belong to no group are NaN,
    and their status is inadmissible.

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
                self.x0[group.trajectory_numbers] = group.x0
        self.failure_reasons: dict[int, str] = {}
        self.events: list[EventOccurrence] = []
        self.groups = [GroupRecord(self, group) for group in groups]

    def to_ensemble(
        self, inadmissible_reasons: Mapping[int, str], provenance: Mapping[str, Any], **other_fields: Any
    ) -> Ensemble:
        """Return the recorded trajectories as an :class:`Ensemble`.

        Parameters
        ----------
        inadmissible_reasons : mapping from int to str
            Why trajectories are inadmissible, by their numbers.
        provenance : mapping
            The provenance without the engine.
        **other_fields
            Fields of the ensemble that are not recorded.
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
        events, sources = (
            self.groups[0].group.events,
            [group_record.make_evidence_source() for group_record in self.groups],
        )
        engine = " and ".join(sorted({group_record.engine for group_record in self.groups} - {""}))
        ensemble = Ensemble(
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
            laws=common_laws([group_record.group.problem.laws for group_record in self.groups]),
            engine=engine,
            events=Events() if events is None else collect_events(self.member, events.names, self.events),
            reasons={**inadmissible_reasons, **self.failure_reasons},
            provenance={**provenance, "engine": engine},
            evidence_source=functools.cache(lambda: merge_evidence([source() for source in sources])),
            velocity_sources=self._velocity_getters_by_name(),
            solution_builder=self._build_solution,
            **quantities,
            **other_fields,
        )
        return reshape_to_sites(self.member, ensemble)

    def _velocity_getters_by_name(self) -> dict[str, Callable[[], np.ndarray]]:
        """Return, by the name of each velocity, a function that computes it along all trajectories."""
        if self.x is None and self.trajectories is None:
            return {}
        return {
            name: functools.partial(self._compute_velocities, name) for name in self.member.body_kinematics.velocities
        }

    def _compute_velocities(self, velocity_name: str) -> np.ndarray:
        """Return one kind of velocity of all trajectories, NaN for those in no group."""
        velocities, trajectory_numbers = zip(
            *(
                (group_record.compute_velocities(velocity_name), group_record.trajectory_numbers)
                for group_record in self.groups
            ),
            strict=True,
        )
        values = np.full((len(self.status), *velocities[0].shape[1:]), np.nan)
        values[np.concatenate(trajectory_numbers)] = np.concatenate(velocities)
        return values

    def _build_solution(self, ensemble: Ensemble, i: int) -> Solution:
        """Return the solution of trajectory i of the ensemble with the fields that a single run would have."""
        group_record = next(group_record for group_record in self.groups if i in group_record.trajectory_numbers)
        return group_record.complete_member_solution(
            ensemble.member_solution(i), int(np.searchsorted(group_record.trajectory_numbers, i))
        )


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
        self.record, self.group, self.trajectory_numbers, self.engine = record, group, group.trajectory_numbers, ""
        self._is_all = len(self.trajectory_numbers) == len(record.status)
        rows = self._row_indices_of_members(slice(None))
        record.status[rows] = StatusCode.INTERRUPTED
        record.quantities["first_step"][rows] = group.schedule.longest_step_after_each_save[0]
        record.quantities["end_time"][rows] = group.schedule.start

    def _row_indices_of_members(self, members: MemberSelection) -> MemberSelection:
        """Return the rows of the record for the trajectories with these indices in the group."""
        return members if self._is_all else self.trajectory_numbers[members]

    @property
    def is_interrupted(self) -> bool:
        """True if the run of the group was interrupted: a trajectory has not reached its end, and has not failed."""
        return bool((self.record.status[self._row_indices_of_members(slice(None))] == StatusCode.INTERRUPTED).any())

    def read_quantity(self, quantity_name: str, members: np.ndarray) -> np.ndarray:
        """Return the recorded values of a quantity, one for each of these trajectories."""
        return self.record.quantities[quantity_name][self._row_indices_of_members(members)]

    def store_first_step_sizes(self, members: np.ndarray, step_sizes: np.ndarray) -> None:
        """Store the size of the first step of each of these trajectories."""
        self.record.quantities["first_step"][self._row_indices_of_members(members)] = step_sizes

    def store_initial_states(
        self, members: MemberSelection, x: np.ndarray, energy: np.ndarray, entropy: np.ndarray
    ) -> None:
        """Store the initial states with energy and entropy, if trajectories are saved."""
        if self.record.trajectories is not None:
            self.record.trajectories[self._row_indices_of_members(members), 0] = np.column_stack([x, energy, entropy])

    def store_consecutive_saves(self, members: MemberSelection, first_save: int, states: np.ndarray) -> None:
        """Store saved states with energy and entropy, shape (members, saves, n + 2), from save ``first_save`` on."""
        if self.record.trajectories is not None:
            saves = slice(first_save, first_save + states.shape[1])
            self.record.trajectories[self._row_indices_of_members(members), saves] = states

    def store_states_at_times(self, members: np.ndarray, times: np.ndarray, states: np.ndarray) -> None:
        """Store one state of each trajectory with energy and entropy, shape (members, n + 2), at its time to save."""
        if self.record.trajectories is not None:
            self.record.trajectories[
                self._row_indices_of_members(members), np.searchsorted(self.record.saved_times, times)
            ] = states

    def store_events(self, occurrences: Sequence[EventOccurrence], members: np.ndarray) -> None:
        """Store events of a batch, whose trajectories have the indices ``members`` in the group."""
        for event in occurrences:
            member = int(members[event.trajectory])
            if event.trajectory == 0 or members[event.trajectory - 1] != member:  # no copy that fills a padded batch
                self.record.events.append(event._replace(trajectory=int(self.trajectory_numbers[member])))

    def record_outcome_of_fixed_steps(
        self, members: MemberSelection, initial_fields: Mapping[str, np.ndarray], final_fields: Mapping[str, np.ndarray]
    ) -> None:
        """Record status, end time, final state and audit quantities of trajectories with fixed steps.

        Parameters
        ----------
        initial_fields, final_fields : mapping of arrays
            Fields of :class:`liethermo.engines.step.State`.
        """
        n_steps_taken, schedule = final_fields["step"].astype(np.int64), self.group.schedule
        is_unfinished = (final_fields["status"] == StatusCode.COMPLETED) & (n_steps_taken < schedule.n_steps)
        status = np.where(is_unfinished, StatusCode.INTERRUPTED, final_fields["status"])
        self.record_outcome(members, initial_fields, final_fields, status, schedule.times_after(n_steps_taken))
        if self.record.trajectories is not None:
            counts, rows = schedule.saved_step_counts, self._row_indices_of_members(members)
            is_after_end = np.arange(len(counts)) >= np.searchsorted(counts, n_steps_taken, side="right")[:, None]
            trajectories = self.record.trajectories
            trajectories[rows] = np.where(is_after_end[..., None], np.nan, trajectories[rows])

    @np.errstate(over="ignore", invalid="ignore")  # overflowed states have the status non_finite
    def record_outcome(
        self,
        members: MemberSelection,
        initial_fields: Mapping,
        final_fields: Mapping,
        status_codes: np.ndarray,
        end_times: np.ndarray,
        n_rejected: np.ndarray | None = None,
    ) -> None:
        """Record status, end time, final state and audit quantities of trajectories, from first and last engine
        fields."""
        record, group, rows = self.record, self.group, self._row_indices_of_members(members)
        quantities, energy, initial_energy = record.quantities, final_fields["energy"], initial_fields["energy"]
        quantities["energy"][rows], quantities["entropy"][rows] = energy, final_fields["entropy"]
        drift = np.maximum(
            final_fields["largest_energy"] - initial_energy, initial_energy - final_fields["smallest_energy"]
        )
        quantities["energy_drift"][rows] = (
            drift / RoundingScale(initial_energy, final_fields["energy_sensitivity"]).scale
        )
        for name in ("energy_sensitivity", "entropy_sensitivity", "first_energy", "smallest_energy", "largest_energy"):
            quantities[name][rows] = final_fields[name]
        quantities["entropy_change"][rows] = final_fields["entropy"] - initial_fields["entropy"]
        quantities["distance"][rows] = np.abs(final_fields["x"] - initial_fields["x"]).max(axis=1)
        quantities["largest_energy_increment"][rows] = final_fields["largest_energy_increment"]
        quantities["least_entropy_increment"][rows] = final_fields["least_entropy_increment"]
        quantities["entropy_scale"][rows] = np.maximum(
            np.abs(initial_fields["entropy"]), np.abs(final_fields["entropy"])
        )
        quantities["residual"][rows] = final_fields["residual"]
        quantities["end_time"][rows] = end_times
        start, end = (
            np.asarray(energy_or_entropy_that_relaxes(group.member, f["energy"], f["entropy"]))
            for f in (initial_fields, final_fields)
        )
        change = np.where(np.abs(end - start) > 1e-12 * np.abs(end), end - start, np.nan)
        quantities["relaxation_time"][rows] = (
            end * (end_times - group.schedule.start) - final_fields["relaxation_integral"]
        ) / change
        record.status[rows], record.steps[rows] = status_codes, final_fields["step"]
        record.iterations[rows] = final_fields["fixed_point_iterations"] + final_fields["newton_iterations"]
        if n_rejected is not None:
            record.rejected[rows] = n_rejected
        self._store_reasons_of_unbounded_growth(members, final_fields["x"], status_codes, end_times)
        if record.x is not None:
            record.x[rows] = final_fields["x"]
        if record.clock is not None and record.work is not None:
            record.work[rows] = record.clock.work(final_fields["x"])

    def _store_reasons_of_unbounded_growth(
        self, members: MemberSelection, final_states: np.ndarray, status_codes: np.ndarray, end_times: np.ndarray
    ) -> None:
        """Store a message for each trajectory that grows without bound, among the first ones that fail."""
        status_codes, end_times = (np.broadcast_to(a, len(final_states)) for a in (status_codes, end_times))
        failed_rows = np.flatnonzero(np.isin(status_codes, FAILURE_CODES))[
            : max(0, MAX_EXPLAINED_FAILURES - len(self.record.failure_reasons))
        ]
        if not len(failed_rows):
            return
        group = self.group
        member_indices = np.arange(len(group.x0))[members][failed_rows]
        with np.errstate(all="ignore"):
            velocities = np.asarray(group.family.evaluate(vector_field, member_indices, final_states[failed_rows]))
        for i, j, velocity in zip(failed_rows, member_indices, velocities, strict=True):
            t = float(end_times[i])
            if text := ensemble_blow_up_message_or_empty(
                final_states[i], group.x0[j], velocity, t - group.schedule.start, t, group.h
            ):
                self.record.failure_reasons[int(self.trajectory_numbers[j])] = text

    def make_evidence_source(self) -> GroupEvidenceSource:
        """Return the function that computes the evidence for an audit from a sample of the trajectories.

        Half of the sample took most iterations, half is evenly spaced.
        """
        record, group = self.record, self.group
        n_steps = record.steps[self.trajectory_numbers]
        sample_indices = indices_of_largest_and_evenly_spaced(
            record.iterations[self.trajectory_numbers] / np.fmax(n_steps, 1), MAX_LOCAL_ERROR_STEPS
        )
        n_equal_steps = 1 if np.isnan(group.h) else group.schedule.segments[0].n_full_steps
        return GroupEvidenceSource(
            group.member,
            LaneReplay(self.engine, group.family.select(sample_indices), group.method),
            np.ascontiguousarray(group.x0[sample_indices]),
            group.schedule.start,
            self.read_quantity("first_step", sample_indices),
            np.fmin(n_steps[sample_indices], max(1, n_equal_steps)),
            self.read_quantity("distance", sample_indices),
            *self.saved_states_and_times_of_sample(sample_indices),
        )

    def saved_states_and_times_of_sample(
        self, sample_indices: np.ndarray
    ) -> tuple[Sequence[np.ndarray] | np.ndarray, np.ndarray]:
        """Return saved states of some trajectories, shape (sample, times, n), and their times, spread over the run.

        Both are empty if the run saves no states.
        """
        record, rows = self.record, self.trajectory_numbers[sample_indices]
        if record.trajectories is not None:
            times = evenly_spaced_indices(record.trajectories.shape[1], MAX_SENSITIVITY_STATES)
            return record.trajectories[rows][:, times, :-2], record.saved_times[times]
        if record.x is None:
            return (), np.zeros(0)
        states = np.stack([record.x0[rows], record.x[rows]], axis=1)
        end = np.nanmax(record.quantities["end_time"])
        return states, np.linspace(record.start, end, MAX_SENSITIVITY_STATES)

    def compute_velocities(self, velocity_name: str) -> np.ndarray:
        """Return velocities, shape (members, ..., k), at the recorded states of the group."""
        rows, x, trajectories = self._row_indices_of_members(slice(None)), self.record.x, self.record.trajectories
        if trajectories is None:
            assert x is not None
            states = x[rows]
        else:
            states = trajectories[rows, ..., :-2]
        family = self.group.family
        if not any(family.has_member_axis):
            return velocities_at_states(velocity_name, self.group.member, states)
        return np.stack([velocities_at_states(velocity_name, family.member(i), x) for i, x in enumerate(states)])

    def complete_member_solution(self, member_solution: Solution, member_index: int) -> Solution:
        """Return the solution of a member with the conserved functions and laws that a single run would have.

        ``member_solution`` holds what the ensemble knows of it: states, energy, entropy, status and statistics.
        """
        method, system, row, record = (
            self.group.method,
            self.group.family.member(member_index),
            int(self.trajectory_numbers[member_index]),
            self.record,
        )
        if record.trajectories is None:
            assert record.x is not None
            x = np.stack([self.group.x0[member_index], record.x[row]])
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
    """Return the laws that hold for all groups: the functions that every group conserves, or does not promise."""
    first_laws = laws_of_groups[0]
    commonly_conserved_names = set.intersection(*(set(laws.conserved) for laws in laws_of_groups))
    common_constant_names = set.intersection(*({*laws.conserved, *laws.unpromised} for laws in laws_of_groups))
    names = [name for name in (*first_laws.conserved, *first_laws.unpromised) if name in common_constant_names]
    return replace(
        first_laws,
        conserved=tuple(name for name in names if name in commonly_conserved_names),
        unpromised=tuple(name for name in names if name not in commonly_conserved_names),
        unknown=tuple(dict.fromkeys(name for laws in laws_of_groups for name in laws.unknown)),
    )
