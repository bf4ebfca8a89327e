"""Evidence for audits: rounding scales of functions, and steps that are repeated from the states of a result.

One checker judges the steps of a single run and those of an ensemble; engines repeat the steps. All is computed when it
is first asked for, at a bounded number of states.
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
    hermite_defect,
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
"""Number of states at which short steps are compared with the vector field, besides one of each other trajectory."""

STEP_REFINEMENTS = 7
"""Number of short steps from each of these states, each an eighth of the one before."""

SHORT_STEP_FRACTION = 1e-3
"""Size of the first short step, as a fraction of the time in which the state changes by its norm."""

MIN_MOTION_FRACTION = 0.01
"""Fraction of the extent of the whole motion below which the length of a step counts as this fraction.

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
"""Inconsistency up to which the rounding of the vector field need not be traced, which takes as long as all else."""

MIN_RELATIVE_MOTION = 1e-12
"""Relative displacement below which a step is ignored, because it consists of rounding."""

MAX_REPLAYED_STEPS = 256
"""Largest number of steps of a trajectory that an audit replays on the array engine, whose steps are slow."""


@dataclass(frozen=True, eq=False)
class EngineReplay:
    """Replays steps of one trajectory with the engine of its run."""

    engine: EngineWithFallback

    def displacements(
        self, trajectory: np.ndarray, x: np.ndarray, h: np.ndarray, steps: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """Take ``steps`` steps of size h[i] from each state x[i] of the trajectory with the index ``trajectory[i]``.

        Returns
        -------
        array, shape (m, n)
            Displacements of the states.
        array of bool, shape (m,)
            Whether each is known; False if a step failed.
        """
        displacements, is_known = np.zeros_like(x), np.zeros(len(x), dtype=bool)
        for i in range(len(x)):
            try:
                state = self.engine.advance(self.engine.initial_run_state(jnp.asarray(x[i])), float(h[i]), 1, steps)[0]
            except UnsupportedPrimitive:  # Newton's method, which the run did not need
                continue
            is_known[i] = int(state.status) == StatusCode.COMPLETED
            displacements[i] = (np.asarray(state.x) - x[i]) + np.asarray(state.compensation)
        return displacements, is_known

    def states_after_steps(self, x: np.ndarray, h: float, steps: int) -> np.ndarray:
        """Return the states after each of ``steps`` steps from x, shape (steps, n); fewer if one fails."""
        state, chunks = self.engine.initial_run_state(jnp.asarray(x)), [np.empty((0, len(x)))]
        while steps > 0 and int(state.status) == StatusCode.COMPLETED:
            n_saves = min(steps, self.engine.max_saves_per_call)
            state, (states, _, _, is_reached) = self.engine.advance(state, h, n_saves, 1)
            chunks.append(np.asarray(states)[:n_saves][np.asarray(is_reached)[:n_saves].astype(bool)])
            steps -= n_saves
        return np.concatenate(chunks)


@dataclass(frozen=True, eq=False)
class LaneReplay:
    """Replays steps of the trajectories of an ensemble, all at once.

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

    def displacements(
        self, trajectory: np.ndarray, x: np.ndarray, h: np.ndarray, steps: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the displacements after ``steps`` steps, and whether each is known: see :class:`EngineReplay`."""
        displacements, is_known = np.zeros_like(x), np.zeros(len(x), dtype=bool)
        for start in range(0, len(x), MAX_LOCAL_ERROR_STEPS):  # few numbers of lanes, few programs
            rows = slice(start, start + MAX_LOCAL_ERROR_STEPS)
            members = self.family.select(trajectory[rows])
            try:
                after, _ = replay_steps(self.engine, members, self.method, x[rows], h[rows], steps)
            except UnsupportedPrimitive:  # Newton's method, which the run did not need
                continue
            is_known[rows] = after["status"] == StatusCode.COMPLETED
            displacements[rows] = (after["x"] - x[rows]) + after["compensation"]
        return displacements, is_known

    def steps_from_start(self, x: np.ndarray, h: np.ndarray, t: float, n_steps: np.ndarray) -> StepSample:
        """Return the first n_steps[i] steps of each trajectory i from x[i] at time t; fewer if one fails."""
        after, states = replay_steps(self.engine, self.family, self.method, x, h, int(n_steps.max()))
        n_taken = np.fmin(after["step"], n_steps)
        trajectory, step_number = np.nonzero(np.arange(states.shape[1]) < n_taken[:, None])
        path, sizes = np.concatenate([x[:, None], states], axis=1), h[trajectory]
        ends = (path[trajectory, step_number + k] for k in (0, 1))
        return StepSample(trajectory, t + step_number * sizes, sizes, *ends)


class ReplayedSteps(NamedTuple):
    """Steps that an engine has repeated.

    Attributes
    ----------
    steps : StepSample
        The steps, which end where they lead now.
    displacement : array, shape (m, n)
    is_known : array of bool, shape (m,)
        False for steps that failed.
    min_field : array, shape (m, blocks)
        Field of each block of the state above which it is more than rounding.
    """

    steps: StepSample
    displacement: np.ndarray
    is_known: np.ndarray
    min_field: np.ndarray

    def select(self, indices: np.ndarray) -> ReplayedSteps:
        """Return the steps with these indices."""
        return ReplayedSteps(self.steps.select(indices), *(values[indices] for values in self[1:]))


class StepChecker:
    """Judges steps of one or several trajectories: their local errors, and whether they follow the vector field.

    Parameters
    ----------
    system : System
        The system of one of the trajectories, whose states are like those of all.
    evaluate : function of (function, trajectory, x)
        Returns ``function(system, x)`` for states, shape (m, n), each in the system of its trajectory.
    replay : EngineReplay or LaneReplay
    min_motion : array, shape (trajectories,)
        Smallest length relative to which the error of a step of each trajectory is taken.
    """

    def __init__(self, system: System, evaluate: Callable, replay: EngineReplay | LaneReplay, min_motion: np.ndarray):
        self.system, self.evaluate, self.replay, self.min_motion = system, evaluate, replay, min_motion
        self.n_substeps = n_replayed_steps(system.dim)

    def complete(self, evidence: Evidence, sample: StepSample) -> Evidence:
        """Return the evidence with local error and inconsistency, as far as the steps of the sample show them.

        Each trajectory of the sample has a step that is compared with its vector field.
        """
        indices, defects = self._select_worst_steps(sample)
        trajectories, first_steps = np.unique(sample.trajectory, return_index=True)
        others = first_steps[~np.isin(trajectories, sample.trajectory[indices])]
        steps = sample.select(np.append(indices, others))
        replayed = self._replay(steps, self._field_change_by_rounding(steps))
        for field_rounding in (None, self._field_rounding):
            if field_rounding is not None:
                replayed = replayed._replace(min_field=np.fmax(replayed.min_field, field_rounding(steps)))
            relative_length = self._relative_length(replayed)
            moving = np.flatnonzero(replayed.is_known & (relative_length > MIN_RELATIVE_MOTION))
            if not moving.size:
                return evidence
            inconsistency = self._inconsistency(replayed.select(moving), relative_length[moving])
            if len(self.system.state_blocks) == 1 or inconsistency is None or inconsistency <= CONSISTENCY_SKIP_LEVEL:
                break
        evidence = dataclasses.replace(evidence, inconsistency=inconsistency)
        errors = self._local_errors(replayed.select(np.arange(len(indices))), defects)
        if errors is None:
            return evidence
        worst = int(np.argmax(errors))
        return dataclasses.replace(
            evidence, local_error=float(errors[worst]), error_time=float(steps.t[worst]), looked=len(sample.h)
        )

    def _select_worst_steps(self, sample: StepSample) -> tuple[np.ndarray, np.ndarray]:
        """Return the indices of the steps to repeat and their defects: half are the worst, half evenly spaced."""
        distance = np.abs(sample.x_end - sample.x).max(axis=1)
        length = np.fmax(np.fmax(distance, self.min_motion[sample.trajectory]), SMALLEST_NORMAL)
        defect = hermite_defect(self._field, sample) / length
        indices = largest_and_evenly_spaced(defect, self.n_substeps)
        return indices, defect[indices]

    def _local_errors(self, replayed: ReplayedSteps, defects: np.ndarray) -> np.ndarray | None:
        """Return the relative distances of the ends of steps from the ends of short steps; None if nothing moves.

        A step that cannot be refined has its defect as its error.
        """
        steps, is_known = replayed.steps, replayed.is_known
        start, end = map(self._user_states, (steps.x, steps.x_end))
        motion = np.abs(end - start).max(axis=1)
        is_moving = ~is_known | (motion > MIN_RELATIVE_MOTION * np.abs(start).max(axis=1))
        if not is_moving.any():
            return None
        errors, refined = np.where(is_moving, np.nan, 0.0), np.flatnonzero(is_moving & is_known)
        if refined.size:
            substeps = self._replay(steps.select(refined), replayed.min_field[refined], self.n_substeps)
            distance = np.abs(self._user_states(substeps.steps.x_end) - end[refined]).max(axis=1)
            length = np.fmax(motion, self.min_motion[steps.trajectory])[refined]
            errors[refined] = np.where(substeps.is_known, distance / length, np.nan)
        return np.where(np.isfinite(errors), errors, defects)

    def _inconsistency(self, replayed: ReplayedSteps, relative_length: np.ndarray) -> float | None:
        """Return the largest defect of short steps over a few states, where the smallest over the step sizes counts.

        At rest the field of a block may vanish, as the heat of friction does, and grow like a power of time: then a
        step of any size has the same relative defect. So if short steps from a state have a defect, others begin at the
        end of the first.
        """
        h = replayed.steps.h
        moving = np.flatnonzero(relative_length > 1e-6 * (relative_length / h).max() * h)
        _, first_steps_of_trajectories = np.unique(replayed.steps.trajectory[moving], return_index=True)
        evenly_spaced = evenly_spaced_indices(len(moving), CONSISTENCY_STATES)
        moving = moving[np.union1d(evenly_spaced, first_steps_of_trajectories)]
        h, relative_length, min_field = h[moving], relative_length[moving], replayed.min_field[moving]
        steps = replayed.steps.select(moving)._replace(h=np.minimum(h, SHORT_STEP_FRACTION * h / relative_length))
        defects, first_steps = self._short_step_defects(steps, min_field)
        inconsistent = np.flatnonzero(~(defects <= CONSISTENCY_SKIP_LEVEL) & first_steps.is_known)
        if inconsistent.size:
            later_steps = steps._replace(x=first_steps.steps.x_end).select(inconsistent)
            later_defects, _ = self._short_step_defects(later_steps, min_field[inconsistent])
            defects[inconsistent] = np.fmin(defects[inconsistent], later_defects)
        return float(np.nanmax(defects)) if np.isfinite(defects).any() else None

    def _short_step_defects(self, steps: StepSample, min_field: np.ndarray) -> tuple[np.ndarray, ReplayedSteps]:
        """Return the smallest defect of ever shorter steps from each state, shape (m,), NaN if none is known.

        The first step from each state, which is returned as well, has the size of the given one.
        """
        repeated = np.repeat(np.arange(len(steps.h)), STEP_REFINEMENTS)
        sizes = steps.h[:, None] / 8.0 ** np.arange(STEP_REFINEMENTS)
        replayed = self._replay(steps.select(repeated)._replace(h=sizes.ravel()), min_field[repeated])
        defects = np.full(len(repeated), np.nan)
        known = np.flatnonzero(replayed.is_known)
        if known.size:
            defects[known] = self._slope_defects(replayed.select(known))
        finite_defects = np.where(np.isfinite(defects), defects, np.nan).reshape(-1, STEP_REFINEMENTS)
        return np.fmin.reduce(finite_defects, axis=1), replayed.select(np.arange(0, len(repeated), STEP_REFINEMENTS))

    def _slope_defects(self, replayed: ReplayedSteps) -> np.ndarray:
        """Return the relative distances of slopes of steps from the mean field at their ends, in the worst block.

        A block that is almost at rest is measured relative to the rounding of its slope and its field.
        """
        steps, h = replayed.steps, replayed.steps.h[:, None]
        field = self._field(np.tile(steps.trajectory, 2), np.concatenate([steps.x, steps.x_end]))
        mean_field, slope = 0.5 * np.add(*np.split(field, 2)), replayed.displacement / h
        slope_rounding = ROUNDING_SLOPE_RTOL * self._max_by_block(np.abs(steps.x)) / h
        min_scales = np.fmax(slope_rounding, replayed.min_field)
        scales = np.fmax(self._max_by_block(np.abs(mean_field)), min_scales)
        return np.fmax.reduce(_ratio(self._max_by_block(np.abs(slope - mean_field)), scales), axis=1)

    def _relative_length(self, replayed: ReplayedSteps) -> np.ndarray:
        """Return the lengths of steps relative to the state, shape (m,), the largest over the blocks of the state.

        A block that starts at zero has the norm that it reaches.
        """
        length = self._max_by_block(np.abs(replayed.displacement))
        scales = np.maximum(self._max_by_block(np.abs(replayed.steps.x)), length)
        least = MIN_RELATIVE_MOTION / ROUNDING_SLOPE_RTOL * replayed.steps.h[:, None] * replayed.min_field
        return np.where(length > least, _ratio(length, scales), 0.0).max(axis=1)

    def _replay(self, steps: StepSample, min_field: np.ndarray, n_substeps: int = 1) -> ReplayedSteps:
        """Repeat steps, each in one piece or in as many substeps."""
        displacement, is_known = self.replay.displacements(steps.trajectory, steps.x, steps.h / n_substeps, n_substeps)
        return ReplayedSteps(steps._replace(x_end=steps.x + displacement), displacement, is_known, min_field)

    def _field_change_by_rounding(self, steps: StepSample) -> np.ndarray:
        """Return the magnitude, shape (m, blocks), above which the field of a block is more than rounding."""
        signs = np.random.default_rng(0).choice([-1.0, 1.0], steps.x.shape[1])  # a direction along no axis
        perturbed_x, sizes = steps.x.copy(), ROUNDING_SLOPE_RTOL * self._max_by_block(np.abs(steps.x))
        for block, size in zip(self.system.state_blocks, sizes.T, strict=True):
            perturbed_x[:, block] += size[:, None] * signs[block]
        fields = self._field(np.tile(steps.trajectory, 2), np.concatenate([steps.x, perturbed_x]))
        change = np.abs(np.subtract(*np.split(fields, 2)))
        return self._max_by_block(np.nan_to_num(change, nan=0.0, posinf=0.0))

    def _field_rounding(self, steps: StepSample) -> np.ndarray:
        """Return the rounding scale of the field in each block; a bath adds terms that may cancel in the body."""
        with np.errstate(all="ignore"):
            scales = self.evaluate(_field_rounding_scale, steps.trajectory, steps.x)
            return self._max_by_block(ROUNDING_SLOPE_RTOL * scales)

    def _field(self, trajectory: np.ndarray, x: np.ndarray) -> np.ndarray:
        """Return the vector field at states, shape (m, ..., n), of trajectories, shape (m,)."""
        rows = x.reshape(-1, x.shape[-1])
        with np.errstate(all="ignore"):
            field = self.evaluate(vector_field, np.repeat(trajectory, len(rows) // len(trajectory)), rows)
        return np.asarray(field).reshape(x.shape)

    def _max_by_block(self, values: np.ndarray) -> np.ndarray:
        return np.stack([values[:, block].max(axis=1, initial=0.0) for block in self.system.state_blocks], axis=1)

    def _user_states(self, x: np.ndarray) -> np.ndarray:
        """Return states as the user sees them, shape (m, k)."""
        return np.asarray(self.system.points(x)).reshape(len(x), -1)


def _ratio(norms: np.ndarray, scales: np.ndarray) -> np.ndarray:
    """Return norms relative to their scales; the norms themselves where a scale is zero."""
    return norms / np.where(scales > 0.0, scales, 1.0)


@dataclass(frozen=True, eq=False)
class RunEvidence:
    """Function that computes the evidence of a single run.

    Attributes
    ----------
    system : System
    method : OneStepMethod or Reference
    functions : dict of Energy
        Recorded functions besides energy and entropy.
    x : ndarray, shape (m, n)
        Saved states.
    t : ndarray, shape (m,)
        Times of the states.
    step_sizes : function without arguments to an array, shape at most (m,)
        Sizes of the steps that the run took from the states.
    replay : EngineReplay
    """

    system: System
    method: Any
    functions: Mapping[str, Energy]
    x: np.ndarray
    t: np.ndarray
    step_sizes: Callable[[], np.ndarray]
    replay: EngineReplay

    def __call__(self) -> Evidence:
        return self._evidence

    @functools.cached_property
    def _evidence(self) -> Evidence:
        functions = {**energy_and_entropy(self.system), **self.functions}
        sample_indices = evenly_spaced_indices(len(self.x), MAX_SENSITIVITY_STATES)
        sampled_x, guarantees = self.x[sample_indices], frozenset(self.method.preserves)
        scales = evaluate_at_points(rounding_scales, tuple(functions.values()), sampled_x)
        sensitivities, terms = (dict(zip(functions, column_maxima(columns), strict=True)) for columns in scales)
        energy, entropy = sensitivities.pop("energy"), sensitivities.pop("entropy", None)
        conditions = self.system.run_conditions(sampled_x, np.asarray(self.t)[sample_indices], guarantees)
        evidence = Evidence(energy, entropy, sensitivities, terms, conditions=conditions)
        if not has_smooth_steps(self.method) or not len(h := self.step_sizes()):
            return evidence
        user_states = np.asarray(self.system.points(sampled_x)).reshape(len(sampled_x), -1).view(np.float64)
        min_motion = MIN_MOTION_FRACTION * np.ptp(user_states, axis=0).max(keepdims=True)
        sample = sample_steps_of_run(
            self.system, self.x[: len(h) + 1], self.t[: len(h) + 1], h, self.replay.states_after_steps
        )

        def evaluate(function: Callable, trajectory: np.ndarray, x: np.ndarray) -> Any:
            return evaluate_at_points(function, self.system, x)

        return StepChecker(self.system, evaluate, self.replay, min_motion).complete(evidence, sample)


@dataclass(frozen=True, eq=False)
class GroupEvidence:
    """Function that computes the evidence of trajectories of an ensemble, whose steps it replays from the start.

    Attributes
    ----------
    member : System
        One member of the family.
    replay : LaneReplay
        Replays steps of the trajectories, with their family and method.
    x : ndarray, shape (B, n)
        Initial states.
    start_time : float
    h : ndarray, shape (B,)
        Sizes of the first steps.
    n_equal_steps : ndarray of int, shape (B,)
        Numbers of steps of these sizes that the trajectories took.
    distance : ndarray, shape (B,)
        Distances from the initial to the final states.
    saved_states : sequence of ndarray, shape (times, n)
        Saved states of each trajectory, NaN after its end; empty if none were kept.
    saved_times : ndarray, shape (times,)
    """

    member: System
    replay: LaneReplay
    x: np.ndarray
    start_time: float
    h: np.ndarray
    n_equal_steps: np.ndarray
    distance: np.ndarray
    saved_states: Sequence[np.ndarray] | np.ndarray
    saved_times: np.ndarray

    @np.errstate(over="ignore", invalid="ignore")  # overflowed states have the status non_finite
    def __call__(self) -> Evidence:
        family, guarantees = self.replay.family, frozenset(self.replay.method.preserves)
        scales = family.evaluate(energy_and_entropy_rounding_scales, slice(None), self.x).max(axis=0)
        terms = dict(zip(energy_and_entropy(self.member), map(float, np.nan_to_num(scales)), strict=True))
        known_states = [states[np.isfinite(states).all(axis=1)] for states in self.saved_states]
        conditions = worst_conditions(
            family.member(i).run_conditions(states, self.saved_times, guarantees)
            for i, states in enumerate(known_states)
        )
        drifts = largest_drifts(self._member_drifts(i, states) for i, states in enumerate(known_states))
        evidence = Evidence(terms=terms, conditions=conditions, drifts=drifts)
        n_steps = np.fmin(self.n_equal_steps, max(1, MAX_SAMPLED_VALUES // (REPLAY_COST_RATIO * self.x.size)))
        if self.replay.engine != "compiled":
            n_steps = np.fmin(n_steps, MAX_REPLAYED_STEPS)
        if not has_smooth_steps(self.replay.method) or not n_steps.any():
            return evidence
        sample = self.replay.steps_from_start(self.x, self.h, self.start_time, n_steps)
        if not len(sample.h):
            return evidence
        checker = StepChecker(self.member, family.evaluate, self.replay, MIN_MOTION_FRACTION * self.distance)
        return checker.complete(evidence, sample)

    def _member_drifts(self, i: int, states: np.ndarray) -> dict[str, InvariantDrift]:
        """Return the drifts along trajectory i of what the method promises to keep."""
        recorded, laws = invariants_and_laws(self.replay.family.member(i), self.replay.method)
        functions = {name: function for name, (function, _) in recorded.items() if name in laws.conserved}
        if not functions or not len(states):
            return {}
        scales = map(column_maxima, evaluate_at_points(rounding_scales, tuple(functions.values()), states))
        columns = zip(series_of_functions(functions, states).items(), *scales, strict=True)
        return {name: InvariantDrift.from_series(values, *maxima) for (name, values), *maxima in columns}


def has_smooth_steps(method: Any) -> bool:
    """Return whether short steps of a method show the field; those with noise show only it."""
    return isinstance(method, OneStepMethod) and not noise_dimension(method)


def n_replayed_steps(dim: int) -> int:
    """Return the number of steps that are repeated for a system of this dimension, and of substeps for each."""
    return min(MAX_LOCAL_ERROR_STEPS, max(4, MAX_LOCAL_ERROR_VALUES // dim))


def largest_and_evenly_spaced(values: np.ndarray, count: int) -> np.ndarray:
    """Return ``count`` sorted indices: half those of the largest values, half evenly spaced among the others."""
    order = np.argsort(-values, kind="stable")
    remaining = np.sort(order[count // 2 :])
    return np.sort(np.append(order[: count // 2], remaining[evenly_spaced_indices(len(remaining), count - count // 2)]))


def evenly_spaced_indices(length: int, max_count: int) -> np.ndarray:
    """Return at most ``max_count`` evenly spaced indices below ``length``, with the first and the last."""
    return np.arange(length) if length <= max_count else np.arange(max_count) * (length - 1) // (max_count - 1)


def column_maxima(values: np.ndarray) -> list[float]:
    """Return the largest value of each column, NaN and infinity left out."""
    return [float(v) for v in np.nan_to_num(values, nan=0.0, posinf=0.0).max(axis=0)]


def _field_rounding_scale(system: System, x) -> jnp.ndarray:
    """Return the rounding scale of each component of the vector field."""
    return value_and_rounding_scale(system.vector_field, x)[1]


def energy_and_entropy(system: System) -> dict[str, Energy]:
    """Return the energy and, if there is one, the entropy, by these names."""
    return {"energy": system.energy, **({} if system.entropy is None else {"entropy": system.entropy})}


def rounding_scales(functions: Sequence[Energy], x) -> tuple[jnp.ndarray, jnp.ndarray]:
    """Return the sensitivities of functions at x, and the rounding scales of their values."""
    sensitivities = jnp.stack([f.sensitivity(x) for f in functions])
    return sensitivities, jnp.stack([value_and_rounding_scale(f.value, x)[1] for f in functions])


def energy_and_entropy_rounding_scales(system: System, x) -> jnp.ndarray:
    """Return the rounding scales of the values of energy and entropy at x, shape (1,) without an entropy or (2,)."""
    return rounding_scales(tuple(energy_and_entropy(system).values()), x)[1]


def series_of_functions(functions: Mapping[str, Energy], x: np.ndarray) -> dict[str, np.ndarray]:
    """Return the values of functions at states, shape (m, n), by their names, shape (m,) each."""
    return {name: evaluate_at_points(_function_value, function, x) for name, function in functions.items()}


def _function_value(function, x):
    return function.value(x)
