"""What an audit asks of a run besides its series: how its functions are rounded, and steps taken again from its states.

All of it is found when it is first asked for, at a bounded number of states.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
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
from ..tracing.interpret import evaluate_at_points
from ..tracing.scalarize import UnsupportedPrimitive
from .files import SaveableResult
from .looking import StepSample, hermite_defect, sample_steps, vector_field_at

MAX_SENSITIVITY_STATES = 256
"""States of a run at which the sensitivities of its functions are evaluated."""

MAX_LOCAL_ERROR_STEPS, MAX_LOCAL_ERROR_VALUES = 32, 2_000
"""Steps that are taken again for their local errors, each as a whole and in as many parts; fewer of large systems, so
that their states have no more numbers than the second together, but four at least."""

CONSISTENCY_STATES, STEP_REFINEMENTS = 3, 7
"""States at which short steps are compared with the vector field, and how many, each an eighth of the one before."""

SHORT_STEP_FRACTION = 1e-3
"""The first of them, as a fraction of the time in which the state changes by its size."""

MIN_MOTION_FRACTION = 0.01
"""Fraction of the whole motion below which the distance of a step is ignored: a body that has come to rest may take
long steps."""

ROUNDING_SLOPE_RTOL = 1e-10
"""Slope of a step that rounding may have left of none, relative to the state over the step. And the distance of states,
relative to them, between which a field changes by what rounding may have left of none: the heat of friction is that
much in a body whose wheel has come to rest, whatever its entropy is counted from."""

SMALLEST_NORMAL = float(np.finfo(float).tiny)

CONSISTENCY_SKIP_LEVEL = 1e-6
"""What short steps may miss of a field whose rounding is not looked at: to trace it takes as long as the rest."""

MIN_RELATIVE_MOTION = 1e-12
"""A step that moves the state by less, relative to its size, tells nothing: what it does is rounding."""


@dataclass(frozen=True)
class Evidence:
    """What is known of a run besides its series.

    Attributes
    ----------
    energy, entropy : float or None
        Largest sensitivity along the run: the size at which the function is rounded (:meth:`Energy.sensitivity`).
    invariants : dict of float
        The same of the other recorded functions, by name.
    terms : dict of float
        Largest size at which the value of ``"energy"``, of ``"entropy"`` and of the others is rounded along the run:
        that of the largest terms inside, which may cancel in the value.
    local_error : float or None
        Largest local error of a step, measured: the step against short ones in its place, relative to the distance that
        it goes, or to a hundredth of the whole motion where that is more; None where nothing moves.
    error_time : float or None
        Where it is that large.
    looked : int or None
        Steps that were looked at for it: each was compared with the vector field at its ends and at places between, and
        the worst were taken again.
    inconsistency : float or None
        Largest distance between the slope of a step and the vector field, relative to the field, that is left as the
        step gets shorter.
    """

    energy: float | None = None
    entropy: float | None = None
    invariants: Mapping[str, float] = field(default_factory=dict)
    terms: Mapping[str, float] = field(default_factory=dict)
    local_error: float | None = None
    error_time: float | None = None
    looked: int | None = None
    inconsistency: float | None = None

    def __post_init__(self):
        if (self.local_error is None) != (self.error_time is None):
            raise InputError("the largest local error of a step is known with its time, or not at all")


def merge_evidence(parts: Sequence[Evidence]) -> Evidence:
    """Return the evidence of several sets of runs together: the largest of each number."""
    names = dict.fromkeys(name for part in parts for name in part.terms)
    terms = {name: max(part.terms.get(name, 0.0) for part in parts) for name in names}
    measured = [part for part in parts if part.local_error is not None]
    if not measured:
        return Evidence(terms=terms)
    errors = [np.inf if part.local_error is None else np.nan_to_num(part.local_error, nan=np.inf) for part in measured]
    worst = measured[int(np.argmax(errors))]
    looked = sum(part.looked or 0 for part in measured)
    return dataclasses.replace(worst, terms=terms, looked=looked)


class AuditableResult(SaveableResult):
    """A result with the evidence for its audit, or what finds that."""

    state_fields: ClassVar[tuple[str, ...]] = ("x",)
    """The fields that are states, shape (..., n)."""

    t: np.ndarray
    x: Any
    energy: np.ndarray
    attitude: np.ndarray | None
    provenance: dict[str, Any]
    evidence_source: Callable[[], Evidence] | None

    @functools.cached_property
    def evidence(self) -> Evidence:
        """What an audit needs besides the series: found when first asked for."""
        return Evidence() if self.evidence_source is None else self.evidence_source()

    def __getstate__(self) -> dict[str, Any]:  # a copy in another process knows the evidence, not how to find it
        return {**vars(self), "evidence": self.evidence, "evidence_source": None}


class StepReplay(Protocol):
    """Takes steps again."""

    def __call__(self, x: np.ndarray, h: float, steps: int = 1) -> Any:
        """The state of the engine after so many steps of size h from x."""
        ...

    def states_after_steps(self, x: np.ndarray, h: float, steps: int) -> np.ndarray:
        """The states after each of them, shape (steps, n); fewer where one cannot be taken."""
        ...


@dataclass(frozen=True, eq=False)
class EvidenceCollector:
    """Finds the evidence of a run when it is called.

    Attributes
    ----------
    system : System
    method : OneStepMethod or Reference
    functions : dict of Energy
        The recorded ones beside energy and entropy.
    x : ndarray, shape (m, n)
        The states that are kept.
    t, h : ndarray, shape (m,) and at most (m,)
        Their times, and the steps that the run took from them.
    replay : Replay
    """

    system: System
    method: Any
    functions: Mapping[str, Energy]
    x: np.ndarray
    t: np.ndarray
    h: np.ndarray
    replay: StepReplay

    def __call__(self) -> Evidence:
        return self._evidence

    @functools.cached_property
    def _evidence(self) -> Evidence:
        functions = [*energy_and_entropy(self.system), *self.functions.values()]
        names = [*("energy", "entropy")[: len(functions) - len(self.functions)], *self.functions]
        some = self.x[evenly_spaced_indices(len(self.x), MAX_SENSITIVITY_STATES)]
        sensitivities, terms = evaluate_at_points(rounding_scales, tuple(functions), some)
        own = dict(zip(names, _column_maxima(sensitivities), strict=True))
        energy, entropy = own.pop("energy"), own.pop("entropy", None)
        found = Evidence(energy, entropy, own, dict(zip(names, _column_maxima(terms), strict=True)))
        if not isinstance(self.method, OneStepMethod) or noise_dimension(
            self.method
        ):  # noise is what a short step shows
            return found
        count = len(self.h)
        if not count:
            return found
        places = np.asarray(self.system.points(some)).reshape(len(some), -1).view(np.float64)
        whole = MIN_MOTION_FRACTION * float(np.ptp(places, axis=0).max())
        looked = sample_steps(
            self.system, self.x[: count + 1], self.t[: count + 1], self.h, self.replay.states_after_steps
        )
        again, defect = self._select_worst_steps(looked, whole)
        least = self._min_significant_field(looked.x[again])
        for closer in (False, True):
            if closer:
                least = np.maximum(least, self._field_rounding(looked.x[again]))
            tried = [
                self._replay_step(looked.x[i], looked.h[i], looked.t[i], f) for i, f in zip(again, least, strict=True)
            ]
            steps = [step for step in tried if step is not None and step.relative_length > MIN_RELATIVE_MOTION]
            if not steps:  # nothing moves
                return found
            missed = self._inconsistency(steps)
            if len(self.system.state_blocks) == 1 or missed is None or missed <= CONSISTENCY_SKIP_LEVEL:
                break
        found = dataclasses.replace(found, inconsistency=missed)
        moving = [step is None or step.user_distance > MIN_RELATIVE_MOTION * step.user_state_norm for step in tried]
        if not any(moving):
            return found
        errors = np.array([self._local_error(*step, whole) for step in zip(tried, moving, strict=True)])
        errors = np.where(np.isfinite(errors), errors, defect)  # nothing better is known
        worst = int(np.argmax(errors))
        return dataclasses.replace(
            found, local_error=float(errors[worst]), error_time=float(looked.t[again[worst]]), looked=len(looked.h)
        )

    def _min_significant_field(self, x: np.ndarray) -> np.ndarray:
        """The least field at states, shape (m, n), that is more than rounding, of each block, shape (m, blocks)."""
        moved = x.copy()
        signs = np.random.default_rng(0).choice([-1.0, 1.0], x.shape[1])  # in no axes of the system
        for block in self.system.state_blocks:
            moved[:, block] += (
                ROUNDING_SLOPE_RTOL * np.abs(x[:, block]).max(axis=1, initial=0.0, keepdims=True) * signs[block]
            )
        before, after = vector_field_at(self.system, np.concatenate([x, moved])).reshape(2, *x.shape)
        change = np.nan_to_num(np.abs(after - before), nan=0.0, posinf=0.0)
        return self._max_by_block(change)

    def _field_rounding(self, x: np.ndarray) -> np.ndarray:
        """What rounding leaves in the field of each block: a bath takes the sum of what may cancel in the body."""
        with np.errstate(all="ignore"):
            return self._max_by_block(ROUNDING_SLOPE_RTOL * evaluate_at_points(_field_rounding_scale, self.system, x))

    def _max_by_block(self, fields: np.ndarray) -> np.ndarray:
        return np.stack([fields[:, block].max(axis=1, initial=0.0) for block in self.system.state_blocks], axis=1)

    def _select_worst_steps(self, steps: StepSample, whole: float) -> tuple[np.ndarray, np.ndarray]:

        def vector_field(at: np.ndarray, x: np.ndarray) -> np.ndarray:
            return vector_field_at(self.system, x.reshape(-1, x.shape[-1])).reshape(x.shape)

        return select_worst_steps(steps, vector_field, whole, n_replayed_steps(self.system.dim))

    def _local_error(self, step: _ReplayedStep | None, moving: bool, whole: float) -> float:
        """How far from the end of a step the short ones in its place end; NaN where they cannot be taken."""
        if step is None or not moving:
            return np.nan if step is None else 0.0
        parts = n_replayed_steps(self.system.dim)
        short = self._replay_step(step.x, step.h / parts, step.t, step.min_field, parts)
        if short is None:
            return np.nan
        ends = np.asarray(self.system.points(np.stack([step.x + step.displacement, step.x + short.displacement])))
        return float(np.abs(ends[1] - ends[0]).max()) / max(step.user_distance, whole)

    def _inconsistency(self, steps: list[_ReplayedStep]) -> float | None:
        """The largest over a few states of what short steps miss of the field: the least over the steps from one.

        At rest the field of a block may vanish, as the heat of friction does, and grow like a power of time: then a
        step of any size misses the same share of the field at its ends. So where short steps from a state miss it,
        others begin where a first one ends.
        """
        fastest = max(step.relative_length / step.h for step in steps)
        moving = [step for step in steps if step.relative_length > 1e-6 * fastest * step.h]
        some = [moving[i] for i in evenly_spaced_indices(len(moving), CONSISTENCY_STATES)]
        sizes = [min(step.h, SHORT_STEP_FRACTION * step.h / step.relative_length) for step in some]
        missed = self._short_step_defects([step.x for step in some], some, sizes)
        for i in np.flatnonzero(~(missed <= CONSISTENCY_SKIP_LEVEL)):
            if (away := self._replay_step(some[i].x, sizes[i], some[i].t, some[i].min_field)) is not None:
                later = self._short_step_defects([away.x + away.displacement], [some[i]], [sizes[i]])
                missed[i] = np.fmin(missed[i], later[0])
        return float(np.nanmax(missed)) if np.isfinite(missed).any() else None

    def _short_step_defects(self, x: list[np.ndarray], steps: list[_ReplayedStep], sizes: list[float]) -> np.ndarray:
        """The least that ever shorter steps from states miss of the field, shape (states,); NaN where none is known.

        The first step from each state has the given size, and what is rounding is that of ``steps``.
        """
        short = [
            [
                new
                for n in range(STEP_REFINEMENTS)
                if (new := self._replay_step(at, size / 8.0**n, step.t, step.min_field)) is not None
            ]
            for at, step, size in zip(x, steps, sizes, strict=True)
        ]
        starts = [step.x for steps in short for step in steps]
        ends = [step.x + step.displacement for steps in short for step in steps]
        if not starts:
            return np.full(len(x), np.nan)
        found = iter(vector_field_at(self.system, np.array(starts + ends)).reshape(2, len(starts), -1).swapaxes(0, 1))
        defects = [[_slope_defect(step, self.system.state_blocks, *next(found)) for step in steps] for steps in short]
        return np.array([min((d for d in values if np.isfinite(d)), default=np.nan) for values in defects])

    def _replay_step(
        self, x: np.ndarray, h: float, t: float, least: np.ndarray, steps: int = 1
    ) -> _ReplayedStep | None:
        """A step from a state at a time, or so many in its place; None where it cannot be taken."""
        points = self.system.points
        try:
            state = self.replay(x, float(h), steps)
        except UnsupportedPrimitive:  # Newton's method, where the run went without it
            return None
        if int(state.status) != 0:
            return None
        d = (np.asarray(state.x) - x) + np.asarray(state.compensation)
        start = np.asarray(points(x))
        moved = float(np.abs(np.asarray(points(x + d)) - start).max())
        lengths = (
            _relative_norm(d[block], np.append(x[block], d[block]))  # what starts at zero has the size that it gets
            for block, f in zip(self.system.state_blocks, least, strict=True)
            if np.abs(d[block]).max(initial=0.0) > MIN_RELATIVE_MOTION / ROUNDING_SLOPE_RTOL * steps * h * f
        )
        return _ReplayedStep(
            float(t), float(h), x, d, moved, float(np.abs(start).max()), max(lengths, default=0.0), least
        )


class _ReplayedStep(NamedTuple):
    """A step from a state x of the run, which displaces it by d, and what its user sees of it, of a size, by ``user_distance``.

    ``relative_length`` is that of d relative to the state, the largest over its blocks, and ``min_field`` the least field of each
    that is more than rounding.
    """

    t: float
    h: float
    x: np.ndarray
    displacement: np.ndarray
    user_distance: float
    user_state_norm: float
    relative_length: float
    min_field: np.ndarray


def _slope_defect(step: _ReplayedStep, blocks: tuple[slice, ...], before: np.ndarray, after: np.ndarray) -> float:
    """How far the slope of a step is from the mean of the field at its ends, relative to that; the worst of the blocks.

    A block that is all but still is measured by what rounding leaves of its slope and of its field.
    """
    mean, slope = 0.5 * (before + after), step.displacement / step.h
    least = [
        max(ROUNDING_SLOPE_RTOL * np.abs(step.x[block]).max() / step.h, f)
        for block, f in zip(blocks, step.min_field, strict=True)
    ]
    return max(
        _relative_norm(slope[block] - mean[block], mean[block], size) for block, size in zip(blocks, least, strict=True)
    )


def _relative_norm(v: np.ndarray, of: np.ndarray, least: float = 0.0) -> float:
    size = max(float(np.abs(of).max()), least)
    length = float(np.abs(v).max())
    return length / size if size > 0.0 else length


def n_replayed_steps(dim: int) -> int:
    """Steps of a system that are taken again, and the parts of each."""
    return min(MAX_LOCAL_ERROR_STEPS, max(4, MAX_LOCAL_ERROR_VALUES // dim))


def select_worst_steps(steps: StepSample, field: Callable, whole, number: int) -> tuple[np.ndarray, np.ndarray]:
    """The places of some steps, half of them by how far they miss the field, half evenly spread; and how far they do.

    Parameters
    ----------
    field
        As for :func:`misfit`.
    whole : float or array, shape (m,)
        The least distance that what they miss is taken relative to.
    """
    moved = np.abs(steps.x_end - steps.x).max(axis=1)
    defect = hermite_defect(field, steps) / np.fmax(np.fmax(moved, whole), SMALLEST_NORMAL)
    chosen = largest_and_evenly_spaced(defect, number)
    return chosen, defect[chosen]


def largest_and_evenly_spaced(values: np.ndarray, number: int) -> np.ndarray:
    """The places of some values, in order: half of them the largest, half evenly spread among the others."""
    order = np.argsort(-values, kind="stable")
    others = np.sort(order[number // 2 :])
    return np.sort(np.append(order[: number // 2], others[evenly_spaced_indices(len(others), number - number // 2)]))


def evenly_spaced_indices(count: int, most: int) -> np.ndarray:
    """At most so many places among ``count``, the first and the last among them."""
    return np.arange(count) if count <= most else np.arange(most) * (count - 1) // (most - 1)


def _column_maxima(values: np.ndarray) -> list[float]:
    return [float(v) for v in np.nan_to_num(values, nan=0.0, posinf=0.0).max(axis=0)]


def _field_rounding_scale(system: System, x) -> jnp.ndarray:
    """The size at which the vector field is rounded, component by component."""
    return value_and_rounding_scale(system.vector_field, x)[1]


def energy_and_entropy(system: System) -> list[Energy]:
    """The energy, and the entropy where there is one."""
    return [system.energy, *([] if system.entropy is None else [system.entropy])]


def rounding_scales(functions: Sequence[Energy], x) -> tuple[jnp.ndarray, jnp.ndarray]:
    """The sensitivities of functions at a state, and the sizes at which their values are rounded."""
    sensitivities = jnp.stack([f.sensitivity(x) for f in functions])
    return sensitivities, jnp.stack([value_and_rounding_scale(f.value, x)[1] for f in functions])
