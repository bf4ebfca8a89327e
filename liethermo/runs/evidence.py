"""Evidence for audits: rounding scales of functions, and steps that are repeated from the states of a result.

One checker judges the steps of a single run and those of an ensemble; engines repeat the steps. The evidence is
computed when it is first needed, at a bounded number of states.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from ..engines.select_engine import EngineWithFallback
from ..engines.status_codes import StatusCode
from ..functions.energy import Energy
from ..functions.rounding import value_and_rounding_scale
from ..integrators import OneStepMethod
from ..integrators.fluctuating import noise_dimension
from ..results.audit_evidence import Evidence, largest_drifts
from ..results.rounding_scale import InvariantDrift
from ..results.step_sampling import (
    MAX_SAMPLED_VALUES,
    REPLAY_COST_RATIO,
    StepSample,
    hermite_defects,
    sample_steps_of_run,
    vector_field,
)
from ..systems import System
from ..systems.conditions import worst_conditions
from ..tracing.interpret import evaluate_at_points
from ..tracing.scalarize import UnsupportedPrimitive
from .lanes import replay_steps
from .preparation import invariants_and_laws
from .system_family import Family

MAX_SENSITIVITY_STATES = 256
"""Largest number of states of a run at which the sensitivities of its functions are evaluated."""

MAX_LOCAL_ERROR_STEPS = 32
"""Largest number of steps that are repeated for their local errors, each in one piece and in as many substeps."""

MAX_LOCAL_ERROR_VALUES = 2_000
"""Largest number of components in the states of all repeated steps; but at least four steps are repeated."""

CONSISTENCY_STATES = 3
"""Number of states at which short steps are compared with the field, in addition to one state of each trajectory."""

STEP_REFINEMENTS = 7
"""Number of short steps from each of these states, each an eighth of the one before."""

SHORT_STEP_FRACTION = 1e-3
"""Size of the first short step, as a fraction of the time in which the state changes by its norm."""

MIN_MOTION_FRACTION = 0.01
"""Smallest length relative to which the error of a step is judged, as a fraction of the extent of the whole motion.

A body that has come to rest may take long steps.
"""

ROUNDING_SLOPE_RTOL = 1e-10
"""Relative error of slopes and of field differences that rounding can cause.

A slope below this fraction of ``|x| / h`` may be pure rounding. States that differ by this fraction have field
values whose difference may be rounding: so large is the heat of friction of a body whose wheel has come to rest,
whatever the zero of its entropy.
"""

SMALLEST_NORMAL = float(np.finfo(float).tiny)
"""Smallest positive normal float64."""

CONSISTENCY_SKIP_LEVEL = 1e-6
"""Inconsistency below which the rounding of the vector field is not traced, which takes as long as all other checks."""

MIN_RELATIVE_MOTION = 1e-12
"""Relative displacement below which a step is ignored, because it consists of rounding."""

MAX_REPLAYED_STEPS = 256
"""Largest number of steps of a trajectory that an audit replays on the array engine, whose steps are slow."""


@dataclass(frozen=True, eq=False)
class EngineReplay:
    """Replay of steps of a single run, one after another, with the engine of the run."""

    engine: EngineWithFallback

    def replay_displacements_and_success(
        self, trajectory_indices: np.ndarray, initial_states: np.ndarray, step_sizes: np.ndarray, n_steps: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the displacements after ``n_steps`` steps of size step_sizes[i] from each state initial_states[i].

        Parameters
        ----------
        trajectory_indices : array of int, shape (m,)
            The trajectory of each state, whose system takes the steps.
        initial_states : array, shape (m, n)
        step_sizes : array, shape (m,)
        n_steps : int

        Returns
        -------
        array, shape (m, n)
            Displacements of the states.
        array of bool, shape (m,)
            False where a step failed.
        """
        displacements, is_completed = np.zeros_like(initial_states), np.zeros(len(initial_states), dtype=bool)
        for i in range(len(initial_states)):
            try:
                state = self.engine.advance(
                    self.engine.initial_run_state(jnp.asarray(initial_states[i])), float(step_sizes[i]), 1, n_steps
                )[0]
            except UnsupportedPrimitive:  # Newton's method, which the run did not need
                continue
            is_completed[i] = int(state.status) == StatusCode.COMPLETED
            displacements[i] = (np.asarray(state.x) - initial_states[i]) + np.asarray(state.compensation)
        return displacements, is_completed

    def states_after_each_step(self, initial_state: np.ndarray, step_size: float, n_steps: int) -> np.ndarray:
        """Return the states after each of ``n_steps`` steps, shape (n_steps, n); fewer if one fails."""
        state, chunks = self.engine.initial_run_state(jnp.asarray(initial_state)), [np.empty((0, len(initial_state)))]
        while n_steps > 0 and int(state.status) == StatusCode.COMPLETED:
            n_saves = min(n_steps, self.engine.max_saves_per_call)
            state, (states, _, _, is_reached) = self.engine.advance(state, step_size, n_saves, 1)
            chunks.append(np.asarray(states)[:n_saves][np.asarray(is_reached)[:n_saves].astype(bool)])
            n_steps -= n_saves
        return np.concatenate(chunks)


@dataclass(frozen=True, eq=False)
class LaneReplay:
    """Replay of steps of the trajectories of an ensemble, many at once, in lanes of an engine.

    Attributes
    ----------
    engine : {"array", "compiled"}
    family : Family
        The systems of the trajectories.
    method : OneStepMethod
    """

    engine: str
    family: Family
    method: OneStepMethod

    def replay_displacements_and_success(
        self, trajectory_indices: np.ndarray, initial_states: np.ndarray, step_sizes: np.ndarray, n_steps: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the displacements after ``n_steps`` steps, and whether all steps succeeded: see
        :class:`EngineReplay`."""
        displacements, is_completed = np.zeros_like(initial_states), np.zeros(len(initial_states), dtype=bool)
        for start in range(0, len(initial_states), MAX_LOCAL_ERROR_STEPS):  # few numbers of lanes, few programs
            rows = slice(start, start + MAX_LOCAL_ERROR_STEPS)
            members = self.family.select(trajectory_indices[rows])
            try:
                final_fields, _ = replay_steps(
                    self.engine, members, self.method, initial_states[rows], step_sizes[rows], n_steps
                )
            except UnsupportedPrimitive:  # Newton's method, which the run did not need
                continue
            is_completed[rows] = final_fields["status"] == StatusCode.COMPLETED
            displacements[rows] = (final_fields["x"] - initial_states[rows]) + final_fields["compensation"]
        return displacements, is_completed

    def replay_first_steps(
        self, initial_states: np.ndarray, step_sizes: np.ndarray, start_time: float, n_steps: np.ndarray
    ) -> StepSample:
        """Return the first n_steps[i] steps of each trajectory i from initial_states[i]; fewer if one fails."""
        final_fields, states = replay_steps(
            self.engine, self.family, self.method, initial_states, step_sizes, int(n_steps.max())
        )
        n_taken = np.fmin(final_fields["step"], n_steps)
        trajectory, step_number = np.nonzero(np.arange(states.shape[1]) < n_taken[:, None])
        path, sizes = np.concatenate([initial_states[:, None], states], axis=1), step_sizes[trajectory]
        ends = (path[trajectory, step_number + k] for k in (0, 1))
        return StepSample(trajectory, start_time + step_number * sizes, sizes, *ends)


class ReplayedSteps(NamedTuple):
    """Steps of a run that an engine has taken once more, with their displacements.

    Attributes
    ----------
    steps : StepSample
        The steps, with the end states that the replay has found.
    displacement : array, shape (m, n)
    is_completed : array of bool, shape (m,)
        False for steps that failed.
    field_rounding_floor : array, shape (m, blocks)
        Norm of the vector field of each block of the state below which it is rounding error.
    """

    steps: StepSample
    displacement: np.ndarray
    is_completed: np.ndarray
    field_rounding_floor: np.ndarray

    def select(self, indices: np.ndarray) -> ReplayedSteps:
        """Return the steps with these indices."""
        return ReplayedSteps(self.steps.select(indices), *(values[indices] for values in self[1:]))


class StepChecker:
    """Check of sampled steps of trajectories: their local errors, and whether they follow the vector field.

    Parameters
    ----------
    system : System
        The system of one of the trajectories; the states of all have the same blocks.
    evaluate : function of (function, trajectory, x)
        Returns ``function(system, x)`` for states, shape (m, n), each in the system of its trajectory.
    replay : EngineReplay or LaneReplay
    min_motion : array, shape (trajectories,)
        Smallest length relative to which the error of a step of each trajectory is taken.
    """

    def __init__(self, system: System, evaluate: Callable, replay: EngineReplay | LaneReplay, min_motion: np.ndarray):
        self.system, self.evaluate, self.replay, self.min_motion = system, evaluate, replay, min_motion
        self.n_substeps = n_replayed_steps(system.dim)

    def with_error_and_inconsistency(self, evidence: Evidence, sample: StepSample) -> Evidence:
        """Return the evidence with local error and inconsistency added, unless the sampled steps do not move.

        At least one step of each trajectory is compared with its vector field.
        """
        indices, defects = self._select_worst_and_spaced_steps(sample)
        trajectories, first_steps = np.unique(sample.trajectory, return_index=True)
        other_indices = first_steps[~np.isin(trajectories, sample.trajectory[indices])]
        steps = sample.select(np.append(indices, other_indices))
        replayed_steps = self._replay_in_substeps(steps, self._field_change_by_rounding(steps))
        for field_rounding in (None, self._rounding_scale_of_field):
            if field_rounding is not None:
                replayed_steps = replayed_steps._replace(
                    field_rounding_floor=np.fmax(replayed_steps.field_rounding_floor, field_rounding(steps))
                )
            relative_displacement = self._displacements_per_state_size(replayed_steps)
            moving_indices = np.flatnonzero(replayed_steps.is_completed & (relative_displacement > MIN_RELATIVE_MOTION))
            if not moving_indices.size:
                return evidence
            inconsistency = self._inconsistency_with_field(
                replayed_steps.select(moving_indices), relative_displacement[moving_indices]
            )
            if len(self.system.state_blocks) == 1 or inconsistency is None or inconsistency <= CONSISTENCY_SKIP_LEVEL:
                break
        evidence = dataclasses.replace(evidence, inconsistency=inconsistency)
        errors = self._local_errors_by_substeps(replayed_steps.select(np.arange(len(indices))), defects)
        if errors is None:
            return evidence
        worst_index = int(np.argmax(errors))
        return dataclasses.replace(
            evidence,
            local_error=float(errors[worst_index]),
            error_time=float(steps.t[worst_index]),
            looked=len(sample.h),
        )

    def _select_worst_and_spaced_steps(self, sample: StepSample) -> tuple[np.ndarray, np.ndarray]:
        """Return the indices and defects of the steps to replay: half have the largest defects, half are evenly
        spaced."""
        distance = np.abs(sample.x_end - sample.x).max(axis=1)
        length = np.fmax(np.fmax(distance, self.min_motion[sample.trajectory]), SMALLEST_NORMAL)
        defect = hermite_defects(self._evaluate_field, sample) / length
        indices = indices_of_largest_and_evenly_spaced(defect, self.n_substeps)
        return indices, defect[indices]

    def _local_errors_by_substeps(
        self, replayed_steps: ReplayedSteps, fallback_errors: np.ndarray
    ) -> np.ndarray | None:
        """Return the relative error of each step, shape (m,), from a replay in substeps; None if no state moves.

        A step whose replay fails has its ``fallback_errors``.
        """
        steps, is_completed = replayed_steps.steps, replayed_steps.is_completed
        start, end = map(self._to_user_states, (steps.x, steps.x_end))
        motion = np.abs(end - start).max(axis=1)
        is_moving = ~is_completed | (motion > MIN_RELATIVE_MOTION * np.abs(start).max(axis=1))
        if not is_moving.any():
            return None
        errors, refined_indices = np.where(is_moving, np.nan, 0.0), np.flatnonzero(is_moving & is_completed)
        if refined_indices.size:
            substeps = self._replay_in_substeps(
                steps.select(refined_indices), replayed_steps.field_rounding_floor[refined_indices], self.n_substeps
            )
            distance = np.abs(self._to_user_states(substeps.steps.x_end) - end[refined_indices]).max(axis=1)
            length = np.fmax(motion, self.min_motion[steps.trajectory])[refined_indices]
            errors[refined_indices] = np.where(substeps.is_completed, distance / length, np.nan)
        return np.where(np.isfinite(errors), errors, fallback_errors)

    def _inconsistency_with_field(
        self, replayed_steps: ReplayedSteps, relative_displacement: np.ndarray
    ) -> float | None:
        """Return the largest distance of short steps from the vector field over a few states; None if none is known.

        At each state, the smallest defect over several step sizes counts. At rest the field of a block may vanish, as
        the heat of friction does, and grow like a power of time: then a step of any size has the same relative defect.
        So if short steps from a state have a defect, others begin at the end of the first.
        """
        h = replayed_steps.steps.h
        moving_indices = np.flatnonzero(relative_displacement > 1e-6 * (relative_displacement / h).max() * h)
        _, first_steps_of_trajectories = np.unique(replayed_steps.steps.trajectory[moving_indices], return_index=True)
        evenly_spaced = evenly_spaced_indices(len(moving_indices), CONSISTENCY_STATES)
        moving_indices = moving_indices[np.union1d(evenly_spaced, first_steps_of_trajectories)]
        h, relative_displacement, field_rounding_floor = (
            h[moving_indices],
            relative_displacement[moving_indices],
            replayed_steps.field_rounding_floor[moving_indices],
        )
        steps = replayed_steps.steps.select(moving_indices)._replace(
            h=np.minimum(h, SHORT_STEP_FRACTION * h / relative_displacement)
        )
        defects, first_steps = self._smallest_defects_of_shorter_steps(steps, field_rounding_floor)
        inconsistent = np.flatnonzero(~(defects <= CONSISTENCY_SKIP_LEVEL) & first_steps.is_completed)
        if inconsistent.size:
            later_steps = steps._replace(x=first_steps.steps.x_end).select(inconsistent)
            later_defects, _ = self._smallest_defects_of_shorter_steps(later_steps, field_rounding_floor[inconsistent])
            defects[inconsistent] = np.fmin(defects[inconsistent], later_defects)
        return float(np.nanmax(defects)) if np.isfinite(defects).any() else None

    def _smallest_defects_of_shorter_steps(
        self, steps: StepSample, field_rounding_floor: np.ndarray
    ) -> tuple[np.ndarray, ReplayedSteps]:
        """Replay each step with sizes h, h/8, ...; return the smallest defects, shape (m,), and the steps of size h.

        A defect is NaN if all these steps fail.
        """
        step_indices = np.repeat(np.arange(len(steps.h)), STEP_REFINEMENTS)
        sizes = steps.h[:, None] / 8.0 ** np.arange(STEP_REFINEMENTS)
        replayed_steps = self._replay_in_substeps(
            steps.select(step_indices)._replace(h=sizes.ravel()), field_rounding_floor[step_indices]
        )
        defects = np.full(len(step_indices), np.nan)
        completed_indices = np.flatnonzero(replayed_steps.is_completed)
        if completed_indices.size:
            defects[completed_indices] = self._slope_defects_relative_to_field(replayed_steps.select(completed_indices))
        finite_defects = np.where(np.isfinite(defects), defects, np.nan).reshape(-1, STEP_REFINEMENTS)
        return np.fmin.reduce(finite_defects, axis=1), replayed_steps.select(
            np.arange(0, len(step_indices), STEP_REFINEMENTS)
        )

    def _slope_defects_relative_to_field(self, replayed_steps: ReplayedSteps) -> np.ndarray:
        """Return the relative distances between slopes of steps and the mean field at their ends, shape (m,).

        The block of the state with the largest distance counts. A block that is almost at rest is measured relative to
        the rounding of its slope and its field.
        """
        steps, h = replayed_steps.steps, replayed_steps.steps.h[:, None]
        field = self._evaluate_field(np.tile(steps.trajectory, 2), np.concatenate([steps.x, steps.x_end]))
        mean_field, slope = 0.5 * np.add(*np.split(field, 2)), replayed_steps.displacement / h
        slope_rounding = ROUNDING_SLOPE_RTOL * self._maximum_over_each_block(np.abs(steps.x)) / h
        min_scales = np.fmax(slope_rounding, replayed_steps.field_rounding_floor)
        scales = np.fmax(self._maximum_over_each_block(np.abs(mean_field)), min_scales)
        return np.fmax.reduce(
            _divide_unless_zero(self._maximum_over_each_block(np.abs(slope - mean_field)), scales), axis=1
        )

    def _displacements_per_state_size(self, replayed_steps: ReplayedSteps) -> np.ndarray:
        """Return the displacements of steps relative to the state, shape (m,), the largest over its blocks.

        A block that starts at zero is measured relative to its norm at the end of the step.
        """
        length = self._maximum_over_each_block(np.abs(replayed_steps.displacement))
        scales = np.maximum(self._maximum_over_each_block(np.abs(replayed_steps.steps.x)), length)
        min_length = (
            MIN_RELATIVE_MOTION
            / ROUNDING_SLOPE_RTOL
            * replayed_steps.steps.h[:, None]
            * replayed_steps.field_rounding_floor
        )
        return np.where(length > min_length, _divide_unless_zero(length, scales), 0.0).max(axis=1)

    def _replay_in_substeps(
        self, steps: StepSample, field_rounding_floor: np.ndarray, n_substeps: int = 1
    ) -> ReplayedSteps:
        """Take steps once more, each in ``n_substeps`` equal substeps."""
        displacement, is_completed = self.replay.replay_displacements_and_success(
            steps.trajectory, steps.x, steps.h / n_substeps, n_substeps
        )
        return ReplayedSteps(
            steps._replace(x_end=steps.x + displacement), displacement, is_completed, field_rounding_floor
        )

    def _field_change_by_rounding(self, steps: StepSample) -> np.ndarray:
        """Return the change of the field of each block, shape (m, blocks), when the state is changed by rounding."""
        signs = np.random.default_rng(0).choice([-1.0, 1.0], steps.x.shape[1])  # a direction along no axis
        perturbed_x, sizes = steps.x.copy(), ROUNDING_SLOPE_RTOL * self._maximum_over_each_block(np.abs(steps.x))
        for block, size in zip(self.system.state_blocks, sizes.T, strict=True):
            perturbed_x[:, block] += size[:, None] * signs[block]
        fields = self._evaluate_field(np.tile(steps.trajectory, 2), np.concatenate([steps.x, perturbed_x]))
        change = np.abs(np.subtract(*np.split(fields, 2)))
        return self._maximum_over_each_block(np.nan_to_num(change, nan=0.0, posinf=0.0))

    def _rounding_scale_of_field(self, steps: StepSample) -> np.ndarray:
        """Return the rounding scale of the field in each block, shape (m, blocks).

        It exceeds the change by rounding of the state where terms of a bath cancel in the field of a body.
        """
        with np.errstate(all="ignore"):
            scales = self.evaluate(_rounding_scale_of_vector_field, steps.trajectory, steps.x)
            return self._maximum_over_each_block(ROUNDING_SLOPE_RTOL * scales)

    def _evaluate_field(self, trajectory_indices: np.ndarray, states: np.ndarray) -> np.ndarray:
        """Return the vector field at states, shape (m, ..., n), of trajectories, shape (m,)."""
        rows = states.reshape(-1, states.shape[-1])
        with np.errstate(all="ignore"):
            field = self.evaluate(
                vector_field, np.repeat(trajectory_indices, len(rows) // len(trajectory_indices)), rows
            )
        return np.asarray(field).reshape(states.shape)

    def _maximum_over_each_block(self, values: np.ndarray) -> np.ndarray:
        return np.stack([values[:, block].max(axis=1, initial=0.0) for block in self.system.state_blocks], axis=1)

    def _to_user_states(self, states: np.ndarray) -> np.ndarray:
        """Convert states, shape (m, n), to flat states in the user's form, shape (m, k)."""
        return np.asarray(self.system.points(states)).reshape(len(states), -1)


def _divide_unless_zero(numerators: np.ndarray, denominators: np.ndarray) -> np.ndarray:
    """Return ``numerators / denominators``, and the numerators themselves where a denominator is zero."""
    return numerators / np.where(denominators > 0.0, denominators, 1.0)


@dataclass(frozen=True, eq=False)
class RunEvidenceSource:
    """Function without arguments that computes the evidence for the audit of a single run.

    Attributes
    ----------
    system : System
    method : OneStepMethod or Reference
    functions : dict of Energy
        Recorded functions besides energy and entropy.
    saved_states : ndarray, shape (m, n)
    saved_times : ndarray, shape (m,)
    step_sizes : function without arguments to an array, shape at most (m,)
        Sizes of the steps that the run took from the states.
    replay : EngineReplay
    """

    system: System
    method: Any
    functions: Mapping[str, Energy]
    saved_states: np.ndarray
    saved_times: np.ndarray
    step_sizes: Callable[[], np.ndarray]
    replay: EngineReplay

    def __call__(self) -> Evidence:
        return self._evidence

    @functools.cached_property
    def _evidence(self) -> Evidence:
        """Evidence of the run, computed at its first use."""
        functions = {**energy_and_entropy_by_name(self.system), **self.functions}
        sample_indices = evenly_spaced_indices(len(self.saved_states), MAX_SENSITIVITY_STATES)
        sampled_x, guarantees = self.saved_states[sample_indices], frozenset(self.method.preserves)
        scales = evaluate_at_points(sensitivities_and_rounding_scales, tuple(functions.values()), sampled_x)
        sensitivities, terms = (dict(zip(functions, finite_column_maxima(columns), strict=True)) for columns in scales)
        energy, entropy = sensitivities.pop("energy"), sensitivities.pop("entropy", None)
        conditions = self.system.run_conditions(sampled_x, np.asarray(self.saved_times)[sample_indices], guarantees)
        evidence = Evidence(energy, entropy, sensitivities, terms, conditions=conditions)
        if not has_noiseless_steps(self.method) or not len(h := self.step_sizes()):
            return evidence
        user_states = np.asarray(self.system.points(sampled_x)).reshape(len(sampled_x), -1).view(np.float64)
        min_motion = MIN_MOTION_FRACTION * np.ptp(user_states, axis=0).max(keepdims=True)
        sample = sample_steps_of_run(
            self.system,
            self.saved_states[: len(h) + 1],
            self.saved_times[: len(h) + 1],
            h,
            self.replay.states_after_each_step,
        )

        def evaluate(function: Callable, trajectory_indices: np.ndarray, states: np.ndarray) -> Any:
            return evaluate_at_points(function, self.system, states)

        return StepChecker(self.system, evaluate, self.replay, min_motion).with_error_and_inconsistency(
            evidence, sample
        )


@dataclass(frozen=True, eq=False)
class GroupEvidenceSource:
    """Function without arguments that computes the evidence for the audit of an ensemble, from replayed steps.

    Attributes
    ----------
    example_member : System
        One member of the family.
    replay : LaneReplay
        Replays steps of the trajectories, with their family and method.
    initial_states : ndarray, shape (B, n)
    start_time : float
    first_step_sizes : ndarray, shape (B,)
    n_equal_steps : ndarray of int, shape (B,)
        Number of consecutive steps of this size that each trajectory took.
    distance : ndarray, shape (B,)
        Distances from the initial to the final states.
    saved_states : sequence of ndarray, shape (times, n)
        Saved states of each trajectory, NaN after its end; empty if none were kept.
    saved_times : ndarray, shape (times,)
    """

    example_member: System
    replay: LaneReplay
    initial_states: np.ndarray
    start_time: float
    first_step_sizes: np.ndarray
    n_equal_steps: np.ndarray
    distance: np.ndarray
    saved_states: Sequence[np.ndarray] | np.ndarray
    saved_times: np.ndarray

    @np.errstate(over="ignore", invalid="ignore")  # overflowed states have the status non_finite
    def __call__(self) -> Evidence:
        family, guarantees = self.replay.family, frozenset(self.replay.method.preserves)
        scales = family.evaluate(energy_and_entropy_rounding_scales, slice(None), self.initial_states).max(axis=0)
        terms = dict(
            zip(energy_and_entropy_by_name(self.example_member), map(float, np.nan_to_num(scales)), strict=True)
        )
        known_states = [states[np.isfinite(states).all(axis=1)] for states in self.saved_states]
        conditions = worst_conditions(
            family.member(i).run_conditions(states, self.saved_times, guarantees)
            for i, states in enumerate(known_states)
        )
        drifts = largest_drifts(self._invariant_drifts_of_member(i, states) for i, states in enumerate(known_states))
        evidence = Evidence(terms=terms, conditions=conditions, drifts=drifts)
        n_steps = np.fmin(
            self.n_equal_steps, max(1, MAX_SAMPLED_VALUES // (REPLAY_COST_RATIO * self.initial_states.size))
        )
        if self.replay.engine != "compiled":
            n_steps = np.fmin(n_steps, MAX_REPLAYED_STEPS)
        if not has_noiseless_steps(self.replay.method) or not n_steps.any():
            return evidence
        sample = self.replay.replay_first_steps(self.initial_states, self.first_step_sizes, self.start_time, n_steps)
        if not len(sample.h):
            return evidence
        checker = StepChecker(self.example_member, family.evaluate, self.replay, MIN_MOTION_FRACTION * self.distance)
        return checker.with_error_and_inconsistency(evidence, sample)

    def _invariant_drifts_of_member(self, i: int, saved_states: np.ndarray) -> dict[str, InvariantDrift]:
        """Return the drifts along trajectory i of the invariants that the method promises to conserve, by name."""
        invariants, laws = invariants_and_laws(self.replay.family.member(i), self.replay.method)
        functions = {name: function for name, (function, _) in invariants.items() if name in laws.conserved}
        if not functions or not len(saved_states):
            return {}
        scales = map(
            finite_column_maxima,
            evaluate_at_points(sensitivities_and_rounding_scales, tuple(functions.values()), saved_states),
        )
        columns = zip(values_by_function_name(functions, saved_states).items(), *scales, strict=True)
        return {name: InvariantDrift.from_series(values, *maxima) for (name, values), *maxima in columns}


def has_noiseless_steps(method: Any) -> bool:
    """Return whether a method takes steps without noise, which approach the vector field as they get shorter."""
    return isinstance(method, OneStepMethod) and not noise_dimension(method)


def n_replayed_steps(dim: int) -> int:
    """Return the number of steps to replay for a system of this dimension; each is replayed in as many substeps."""
    return min(MAX_LOCAL_ERROR_STEPS, max(4, MAX_LOCAL_ERROR_VALUES // dim))


def indices_of_largest_and_evenly_spaced(values: np.ndarray, count: int) -> np.ndarray:
    """Return ``count`` sorted indices: half belong to the largest values, half are evenly spaced among the others."""
    order = np.argsort(-values, kind="stable")
    remaining = np.sort(order[count // 2 :])
    return np.sort(np.append(order[: count // 2], remaining[evenly_spaced_indices(len(remaining), count - count // 2)]))


def evenly_spaced_indices(length: int, max_count: int) -> np.ndarray:
    """Return at most ``max_count`` evenly spaced indices below ``length``, with the first and the last."""
    return np.arange(length) if length <= max_count else np.arange(max_count) * (length - 1) // (max_count - 1)


def finite_column_maxima(values: np.ndarray) -> list[float]:
    """Return the largest value of each column, with NaN and infinity counted as 0."""
    return [float(v) for v in np.nan_to_num(values, nan=0.0, posinf=0.0).max(axis=0)]


def _rounding_scale_of_vector_field(system: System, x) -> jnp.ndarray:
    """Return the rounding scale of each component of the vector field."""
    return value_and_rounding_scale(system.vector_field, x)[1]


def energy_and_entropy_by_name(system: System) -> dict[str, Energy]:
    """Return the functions "energy" and, if the system has one, "entropy", by name."""
    return {"energy": system.energy, **({} if system.entropy is None else {"entropy": system.entropy})}


def sensitivities_and_rounding_scales(functions: Sequence[Energy], x) -> tuple[jnp.ndarray, jnp.ndarray]:
    """Return the sensitivities of functions at x and the rounding scales of their values, shape (functions,) each."""
    sensitivities = jnp.stack([f.sensitivity(x) for f in functions])
    return sensitivities, jnp.stack([value_and_rounding_scale(f.value, x)[1] for f in functions])


def energy_and_entropy_rounding_scales(system: System, x) -> jnp.ndarray:
    """Return the rounding scales of the values of energy and entropy at x, shape (2,), or (1,) without an entropy."""
    return sensitivities_and_rounding_scales(tuple(energy_and_entropy_by_name(system).values()), x)[1]


def values_by_function_name(functions: Mapping[str, Energy], states: np.ndarray) -> dict[str, np.ndarray]:
    """Return the values of functions at states, shape (m, n), as a dict from names to arrays, shape (m,)."""
    return {name: evaluate_at_points(_function_value, function, states) for name, function in functions.items()}


def _function_value(function, x):
    return function.value(x)
