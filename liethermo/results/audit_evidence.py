"""Evidence for the audit of a run: rounding scales of its functions, and steps repeated from its states.

All of it is computed when it is first asked for, at a bounded number of states.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, NamedTuple, Protocol

import jax.numpy as jnp
import numpy as np

from ..errors import InputError
from ..functions.energy import Energy
from ..functions.rounding import value_and_rounding_scale
from ..integrators import OneStepMethod
from ..integrators.fluctuating import noise_dimension
from ..systems import System
from ..systems.conditions import RunCondition, worst_conditions
from ..tracing.interpret import evaluate_at_points
from ..tracing.scalarize import UnsupportedPrimitive
from .netcdf import SaveableResult
from .rounding_scale import InvariantDrift
from .step_sampling import StepSample, hermite_defect, select_step_sample, vector_field_at

MAX_SENSITIVITY_STATES = 256
"""Largest number of states of a run at which the sensitivities of its functions are evaluated."""

MAX_LOCAL_ERROR_STEPS = 32
"""Largest number of steps that are repeated for their local errors, each in one piece and in as many substeps."""

MAX_LOCAL_ERROR_VALUES = 2_000
"""Largest number of components in the states of all repeated steps; but at least four steps are repeated."""

CONSISTENCY_STATES = 3
"""Number of states at which short steps are compared with the vector field."""

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


@dataclass(frozen=True)
class Evidence:
    """Data for the audit of a run besides its series.

    Attributes
    ----------
    energy, entropy : float or None
        Largest sensitivity along the run, at which the function is rounded (:meth:`Energy.sensitivity`).
    invariants : dict of float
        Largest sensitivities of the other recorded functions, by name.
    terms : dict of float
        Largest rounding scale of the value of ``"energy"``, ``"entropy"`` and the others along the run: that of the
        largest terms, which may cancel in the value.
    local_error : float or None
        Largest local error of a step: its distance from short steps that replace it, relative to its length, or to a
        hundredth of the whole motion if that is longer; None if nothing moves.
    error_time : float or None
        Time of the step with the largest local error.
    looked : int or None
        Number of steps that were checked: each was compared with the vector field at its ends and at points between,
        and the worst were repeated.
    inconsistency : float or None
        Largest distance between the slope of a step and the vector field, relative to the field, that remains as the
        step gets shorter.
    conditions : tuple of RunCondition
        Conditions beside the laws, such as the positivity of a density matrix.
    drifts : dict of InvariantDrift
        Of an ensemble: drifts of the conserved functions, by name, each of the trajectory where it is largest.
    """

    energy: float | None = None
    entropy: float | None = None
    invariants: Mapping[str, float] = field(default_factory=dict)
    terms: Mapping[str, float] = field(default_factory=dict)
    local_error: float | None = None
    error_time: float | None = None
    looked: int | None = None
    inconsistency: float | None = None
    conditions: tuple[RunCondition, ...] = ()
    drifts: Mapping[str, InvariantDrift] = field(default_factory=dict)

    def __post_init__(self):
        if (self.local_error is None) != (self.error_time is None):
            raise InputError("local_error and error_time must be given together")


def merge_evidence(evidence_list: Sequence[Evidence]) -> Evidence:
    """Return the joint evidence of several sets of runs: the maximum of each number."""
    names = dict.fromkeys(name for evidence in evidence_list for name in evidence.terms)
    terms = {name: max(evidence.terms.get(name, 0.0) for evidence in evidence_list) for name in names}
    conditions = worst_conditions(evidence.conditions for evidence in evidence_list)
    drifts = largest_drifts(evidence.drifts for evidence in evidence_list)
    with_error = [evidence for evidence in evidence_list if evidence.local_error is not None]
    if not with_error:
        return Evidence(terms=terms, conditions=conditions, drifts=drifts)
    errors = [
        np.inf if evidence.local_error is None else np.nan_to_num(evidence.local_error, nan=np.inf)
        for evidence in with_error
    ]
    worst = with_error[int(np.argmax(errors))]
    n_checked = sum(evidence.looked or 0 for evidence in with_error)
    return dataclasses.replace(worst, terms=terms, looked=n_checked, conditions=conditions, drifts=drifts)


def largest_drifts(runs: Iterable[Mapping[str, InvariantDrift]]) -> dict[str, InvariantDrift]:
    """Return the drifts of several runs, for each function the one that is largest relative to its rounding scale."""
    largest: dict[str, InvariantDrift] = {}
    for name, drift in (item for drifts in runs for item in drifts.items()):
        other = largest.setdefault(name, drift)
        if not drift.change <= other.change:
            largest[name] = drift
    return largest


VELOCITY_AXES = {"angular_velocity": "axis", "rotor_rates": "rotor", "joint_rates": "joint_coordinate"}
"""Velocities that belong to the states of a result, by name, and the name of their last axis in datasets."""


class AuditableResult(SaveableResult):
    """A result with the evidence for its audit, or with the function that computes it."""

    state_fields: ClassVar[tuple[str, ...]] = ("x",)
    """Names of the fields that are states, shape (..., n)."""

    t: np.ndarray
    x: Any
    energy: np.ndarray
    attitude: np.ndarray | None
    provenance: dict[str, Any]
    evidence_source: Callable[[], Evidence] | None
    velocity_sources: Mapping[str, Callable[[], np.ndarray]]

    @property
    def joints(self) -> dict[str, np.ndarray]:
        """Joint coordinates by the name of the body (rad, or length), of a tree of jointed bodies; else empty.

        Each has the shape of the times, (times,), or (times, 2) for a universal joint; in an ensemble trajectories are
        first.
        """
        return {} if self.x is None else self.split_by_joint(self.x, 0)

    def split_by_joint(self, values: np.ndarray, first: int) -> dict[str, np.ndarray]:
        """Return joint coordinates or their rates by the name of the body, from arrays, shape (..., n).

        The values of a joint begin at its index in a state less ``first``.
        """
        return {
            name: values[..., start - first] if end - start == 1 else values[..., start - first : end - first]
            for name, (start, end) in self.provenance.get("joints", {}).items()
        }

    @functools.cached_property
    def evidence(self) -> Evidence:
        """Data that an audit needs besides the series; computed at its first use."""
        return Evidence() if self.evidence_source is None else self.evidence_source()

    def velocities(self) -> dict[str, np.ndarray]:
        """Return the velocities that belong to the states, by name: of a rigid body, its rotors, and of joints."""
        return {name: source() for name, source in self.velocity_sources.items()}

    def __getstate__(self) -> dict[str, Any]:  # a pickled copy has the evidence itself, not the function
        fields = {name: getattr(self, name) for name in vars(self)}
        fields |= {"evidence": self.evidence, "evidence_source": None}
        return fields | {"velocity_sources": copies_of_velocities(self.velocities())}


def copies_of_velocities(series: Mapping[str, np.ndarray]) -> dict[str, Callable[[], np.ndarray]]:
    """Return the functions that copy the velocities among arrays, by name."""
    return {name: functools.partial(np.copy, series[name]) for name in VELOCITY_AXES if name in series}


class StepReplay(Protocol):
    """Function that repeats steps of a run."""

    def __call__(self, x: np.ndarray, h: float, steps: int = 1) -> Any:
        """Return the state of the engine after ``steps`` steps of size h from x."""
        ...

    def states_after_steps(self, x: np.ndarray, h: float, steps: int) -> np.ndarray:
        """Return the states after each of ``steps`` steps, shape (steps, n); fewer if one fails."""
        ...


@dataclass(frozen=True, eq=False)
class EvidenceCollector:
    """Function that computes the evidence of a run.

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
    replay : StepReplay
    """

    system: System
    method: Any
    functions: Mapping[str, Energy]
    x: np.ndarray
    t: np.ndarray
    step_sizes: Callable[[], np.ndarray]
    replay: StepReplay

    @functools.cached_property
    def h(self) -> np.ndarray:
        """Sizes of the steps that the run took from the states."""
        return self.step_sizes()

    def __call__(self) -> Evidence:
        return self._evidence

    @functools.cached_property
    def _evidence(self) -> Evidence:
        functions = [*energy_and_entropy(self.system), *self.functions.values()]
        names = [*("energy", "entropy")[: len(functions) - len(self.functions)], *self.functions]
        sample_indices = evenly_spaced_indices(len(self.x), MAX_SENSITIVITY_STATES)
        sampled_x = self.x[sample_indices]
        sensitivities, terms = evaluate_at_points(rounding_scales, tuple(functions), sampled_x)
        sensitivity_by_name = dict(zip(names, column_maxima(sensitivities), strict=True))
        energy, entropy = sensitivity_by_name.pop("energy"), sensitivity_by_name.pop("entropy", None)
        conditions = self.system.run_conditions(
            sampled_x, np.asarray(self.t)[sample_indices], frozenset(self.method.preserves)
        )
        term_scales = dict(zip(names, column_maxima(terms), strict=True))
        evidence = Evidence(energy, entropy, sensitivity_by_name, term_scales, conditions=conditions)
        # a short step of a stochastic method shows only its noise
        if not isinstance(self.method, OneStepMethod) or noise_dimension(self.method):
            return evidence
        n_steps = len(self.h)
        if not n_steps:
            return evidence
        user_states = np.asarray(self.system.points(sampled_x)).reshape(len(sampled_x), -1).view(np.float64)
        min_motion = MIN_MOTION_FRACTION * float(np.ptp(user_states, axis=0).max())
        sample = select_step_sample(
            self.system, self.x[: n_steps + 1], self.t[: n_steps + 1], self.h, self.replay.states_after_steps
        )
        indices, defects = self._select_worst_steps(sample, min_motion)
        min_field = self._min_significant_field(sample.x[indices])
        for with_field_rounding in (False, True):
            if with_field_rounding:
                min_field = np.maximum(min_field, self._field_rounding(sample.x[indices]))
            replayed = [
                self._replay_step(sample.x[i], sample.h[i], sample.t[i], f)
                for i, f in zip(indices, min_field, strict=True)
            ]
            steps = [step for step in replayed if step is not None and step.relative_length > MIN_RELATIVE_MOTION]
            if not steps:  # nothing moves
                return evidence
            inconsistency = self._inconsistency(steps)
            if len(self.system.state_blocks) == 1 or inconsistency is None or inconsistency <= CONSISTENCY_SKIP_LEVEL:
                break
        evidence = dataclasses.replace(evidence, inconsistency=inconsistency)
        is_moving = [
            step is None or step.user_distance > MIN_RELATIVE_MOTION * step.user_state_norm for step in replayed
        ]
        if not any(is_moving):
            return evidence
        errors = np.array([self._local_error(*step, min_motion) for step in zip(replayed, is_moving, strict=True)])
        errors = np.where(
            np.isfinite(errors), errors, defects
        )  # a step that cannot be refined has the defect as its error
        worst = int(np.argmax(errors))
        return dataclasses.replace(
            evidence, local_error=float(errors[worst]), error_time=float(sample.t[indices[worst]]), looked=len(sample.h)
        )

    def _min_significant_field(self, x: np.ndarray) -> np.ndarray:
        """Return the magnitude, shape (m, blocks), above which the field of a block is more than rounding."""
        perturbed_x = x.copy()
        signs = np.random.default_rng(0).choice([-1.0, 1.0], x.shape[1])  # a direction along no axis of the system
        for block in self.system.state_blocks:
            perturbed_x[:, block] += (
                ROUNDING_SLOPE_RTOL * np.abs(x[:, block]).max(axis=1, initial=0.0, keepdims=True) * signs[block]
            )
        field, perturbed_field = vector_field_at(self.system, np.concatenate([x, perturbed_x])).reshape(2, *x.shape)
        change = np.nan_to_num(np.abs(perturbed_field - field), nan=0.0, posinf=0.0)
        return self._max_by_block(change)

    def _field_rounding(self, x: np.ndarray) -> np.ndarray:
        """Return the rounding scale of the field in each block; a bath adds terms that may cancel in the body."""
        with np.errstate(all="ignore"):
            return self._max_by_block(ROUNDING_SLOPE_RTOL * evaluate_at_points(_field_rounding_scale, self.system, x))

    def _max_by_block(self, fields: np.ndarray) -> np.ndarray:
        return np.stack([fields[:, block].max(axis=1, initial=0.0) for block in self.system.state_blocks], axis=1)

    def _select_worst_steps(self, steps: StepSample, min_motion: float) -> tuple[np.ndarray, np.ndarray]:

        def vector_field(step_indices: np.ndarray, x: np.ndarray) -> np.ndarray:
            return vector_field_at(self.system, x.reshape(-1, x.shape[-1])).reshape(x.shape)

        return select_worst_steps(steps, vector_field, min_motion, n_replayed_steps(self.system.dim))

    def _local_error(self, step: _ReplayedStep | None, is_moving: bool, min_motion: float) -> float:
        """Return the relative distance of the end of a step from the end of short steps; NaN if one cannot be taken."""
        if step is None or not is_moving:
            return np.nan if step is None else 0.0
        n_substeps = n_replayed_steps(self.system.dim)
        refined_step = self._replay_step(step.x, step.h / n_substeps, step.t, step.min_field, n_substeps)
        if refined_step is None:
            return np.nan
        user_ends = np.asarray(
            self.system.points(np.stack([step.x + step.displacement, step.x + refined_step.displacement]))
        )
        return float(np.abs(user_ends[1] - user_ends[0]).max()) / max(step.user_distance, min_motion)

    def _inconsistency(self, steps: list[_ReplayedStep]) -> float | None:
        """Return the largest defect of short steps over a few states, where the smallest over the step sizes counts.

        At rest the field of a block may vanish, as the heat of friction does, and grow like a power of time: then a
        step of any size has the same relative defect. So if short steps from a state have a defect, others begin at the
        end of the first.
        """
        max_rate = max(step.relative_length / step.h for step in steps)
        moving_steps = [step for step in steps if step.relative_length > 1e-6 * max_rate * step.h]
        sampled_steps = [moving_steps[i] for i in evenly_spaced_indices(len(moving_steps), CONSISTENCY_STATES)]
        step_sizes = [min(step.h, SHORT_STEP_FRACTION * step.h / step.relative_length) for step in sampled_steps]
        defects = self._short_step_defects([step.x for step in sampled_steps], sampled_steps, step_sizes)
        for i in np.flatnonzero(~(defects <= CONSISTENCY_SKIP_LEVEL)):
            if (
                first_step := self._replay_step(
                    sampled_steps[i].x, step_sizes[i], sampled_steps[i].t, sampled_steps[i].min_field
                )
            ) is not None:
                later_defects = self._short_step_defects(
                    [first_step.x + first_step.displacement], [sampled_steps[i]], [step_sizes[i]]
                )
                defects[i] = np.fmin(defects[i], later_defects[0])
        return float(np.nanmax(defects)) if np.isfinite(defects).any() else None

    def _short_step_defects(
        self, x: list[np.ndarray], steps: list[_ReplayedStep], step_sizes: list[float]
    ) -> np.ndarray:
        """Return the smallest defect of ever shorter steps from each state, shape (states,); NaN if none is known.

        The first step from each state has the given size; ``steps`` provide the times and the significant field.
        """
        refined_steps = [
            [
                new
                for n in range(STEP_REFINEMENTS)
                if (new := self._replay_step(x_start, step_size / 8.0**n, step.t, step.min_field)) is not None
            ]
            for x_start, step, step_size in zip(x, steps, step_sizes, strict=True)
        ]
        starts = [step.x for steps in refined_steps for step in steps]
        ends = [step.x + step.displacement for steps in refined_steps for step in steps]
        if not starts:
            return np.full(len(x), np.nan)
        fields = iter(vector_field_at(self.system, np.array(starts + ends)).reshape(2, len(starts), -1).swapaxes(0, 1))
        defects = [
            [_slope_defect(step, self.system.state_blocks, *next(fields)) for step in steps] for steps in refined_steps
        ]
        return np.array([min((d for d in values if np.isfinite(d)), default=np.nan) for values in defects])

    def _replay_step(
        self, x: np.ndarray, h: float, t: float, min_field: np.ndarray, steps: int = 1
    ) -> _ReplayedStep | None:
        """Return one step from x at time t, or ``steps`` steps of size h; None if it cannot be taken."""
        points = self.system.points
        try:
            state = self.replay(x, float(h), steps)
        except UnsupportedPrimitive:  # Newton's method, which the run did not need
            return None
        if int(state.status) != 0:
            return None
        d = (np.asarray(state.x) - x) + np.asarray(state.compensation)
        start = np.asarray(points(x))
        user_distance = float(np.abs(np.asarray(points(x + d)) - start).max())
        lengths = (
            _relative_norm(
                d[block], np.append(x[block], d[block])
            )  # a block that starts at zero has the norm that it reaches
            for block, f in zip(self.system.state_blocks, min_field, strict=True)
            if np.abs(d[block]).max(initial=0.0) > MIN_RELATIVE_MOTION / ROUNDING_SLOPE_RTOL * steps * h * f
        )
        return _ReplayedStep(
            float(t), float(h), x, d, user_distance, float(np.abs(start).max()), max(lengths, default=0.0), min_field
        )


class _ReplayedStep(NamedTuple):
    """A repeated step from a state x of the run."""

    t: float
    h: float
    x: np.ndarray
    displacement: np.ndarray
    user_distance: float  # distance between its ends, in the states that the user sees
    user_state_norm: float
    relative_length: float  # of the displacement relative to the state, the largest over the blocks
    min_field: np.ndarray  # field of each block above which it is more than rounding


def _slope_defect(
    step: _ReplayedStep, blocks: tuple[slice, ...], field_before: np.ndarray, field_after: np.ndarray
) -> float:
    """Return the relative distance of the slope of a step from the mean field at its ends, in the worst block.

    A block that is almost at rest is measured relative to the rounding of its slope and its field.
    """
    mean_field, slope = 0.5 * (field_before + field_after), step.displacement / step.h
    min_scales = [
        max(ROUNDING_SLOPE_RTOL * np.abs(step.x[block]).max() / step.h, f)
        for block, f in zip(blocks, step.min_field, strict=True)
    ]
    return max(
        _relative_norm(slope[block] - mean_field[block], mean_field[block], min_scale)
        for block, min_scale in zip(blocks, min_scales, strict=True)
    )


def _relative_norm(v: np.ndarray, reference: np.ndarray, min_scale: float = 0.0) -> float:
    scale = max(float(np.abs(reference).max()), min_scale)
    norm = float(np.abs(v).max())
    return norm / scale if scale > 0.0 else norm


def n_replayed_steps(dim: int) -> int:
    """Return the number of steps that are repeated for a system of this dimension, and of substeps for each."""
    return min(MAX_LOCAL_ERROR_STEPS, max(4, MAX_LOCAL_ERROR_VALUES // dim))


def select_worst_steps(steps: StepSample, field: Callable, min_motion, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the indices of ``count`` steps and their defects: half are the worst, half are evenly spaced.

    Parameters
    ----------
    field
        As for :func:`.step_sampling.hermite_defect`.
    min_motion : float or array, shape (m,)
        Smallest length relative to which the defect of a step is taken.
    """
    distance = np.abs(steps.x_end - steps.x).max(axis=1)
    defect = hermite_defect(field, steps) / np.fmax(np.fmax(distance, min_motion), SMALLEST_NORMAL)
    indices = largest_and_evenly_spaced(defect, count)
    return indices, defect[indices]


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


def energy_and_entropy(system: System) -> list[Energy]:
    """Return a list of the energy and, if there is one, the entropy."""
    return [system.energy, *([] if system.entropy is None else [system.entropy])]


def rounding_scales(functions: Sequence[Energy], x) -> tuple[jnp.ndarray, jnp.ndarray]:
    """Return the sensitivities of functions at x, and the rounding scales of their values."""
    sensitivities = jnp.stack([f.sensitivity(x) for f in functions])
    return sensitivities, jnp.stack([value_and_rounding_scale(f.value, x)[1] for f in functions])
