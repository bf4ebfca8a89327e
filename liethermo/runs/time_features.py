"""Features of functions of time, such as pulses, that are not declared and that steps may jump over."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from manifolds.errors import warn

from ..systems import System
from ..tracing.interpret import evaluate_at_points
from .adaptive import Adaptive
from .schedule import StepSchedule

N_SAMPLED_INTERVALS = 4096
"""Number of intervals of a span between whose ends functions of time are compared."""

MAX_SAMPLED_VALUES = 2**22
"""Largest number of values that are compared, which bounds time and memory for large systems."""

MIN_SAMPLED_INTERVALS = 256
"""Smallest number of intervals with which a search makes sense; systems too large for it are not searched."""

FEATURE_CHANGE = 0.1
"""Change within an interval, as a fraction of the range over the span, that makes a feature."""

JUMP_FRACTION = 0.5
"""Fraction of a change that remains in one of 16 parts of an interval, however short it is, if the function jumps."""

N_PARTS = 16
"""Number of parts into which an interval is divided in the search for a jump."""

MAX_FEATURES = 64
"""Largest number of separate features; functions with more of them change everywhere."""


class UndeclaredFeatureWarning(UserWarning):
    """Warning that an energy or a torque changes a lot within a step, at times that are not declared as breaks."""


class TimeFeature(NamedTuple):
    """A short interval in which functions of time change a lot, or a time at which they jump (start = end)."""

    start: float
    end: float

    @property
    def is_jump(self) -> bool:
        return self.start == self.end


def add_breaks_at_features_or_warn(
    schedule: StepSchedule, systems: Sequence[System], initial_states: Iterable, step: float | Adaptive
) -> StepSchedule:
    """Return a schedule whose adaptive steps end at features, and warn if fixed steps skip a feature.

    With fixed steps, jumps become breaks if all are at the ends of steps, unless that changes which states are saved.

    Parameters
    ----------
    schedule : StepSchedule
    systems : sequence of System
        Prepared systems, limited to the span of the schedule.
    initial_states : iterable of array, shape (n,)
        The initial states of these systems.
    step : float or Adaptive
    """
    features = [
        feature
        for system, x in zip(systems, initial_states, strict=True)
        for feature in find_undeclared_features(system, x, schedule)
    ]
    if isinstance(step, Adaptive):
        edges = {t for feature in features for t in feature if schedule.start < t < schedule.end}
        return schedule.with_more_breaks(sorted(edges))
    jumps = sorted({feature.start for feature in features if feature.is_jump})
    if schedule.save_every in (None, 1) and all(schedule.has_step_end_at(t) for t in jumps):
        schedule, features = schedule.with_more_breaks(jumps), [f for f in features if not f.is_jump]
    warn_of_skipped_features(features, schedule.h)
    return schedule


def find_undeclared_features(system: System, initial_state: np.ndarray, schedule: StepSchedule) -> list[TimeFeature]:
    """Return the short intervals and times in which energy or torque of a prepared system change without a declared
    break.

    The gradient of the energy and the torque at the initial state are compared at times all over the span. The time
    of a jump is found up to its rounding error.

    Parameters
    ----------
    system : System
        A prepared system.
    initial_state : array, shape (n,)
        Initial state.
    schedule : StepSchedule
    """
    n_intervals = min(N_SAMPLED_INTERVALS, MAX_SAMPLED_VALUES // (2 * system.dim))
    if not np.isfinite(schedule.end) or n_intervals < MIN_SAMPLED_INTERVALS:
        return []
    times = np.linspace(schedule.start, schedule.end, n_intervals + 1)
    values = _gradient_and_torque_of_state_at_times(system, initial_state, times)
    if not np.isfinite(values).all():
        return []
    scale = np.ptp(values, axis=0)
    # a change below the rounding of the values is none
    scale = np.where(scale > 1e-10 * np.abs(values).max(axis=0), scale, np.inf)
    change = (np.abs(np.diff(values, axis=0)) / scale).max(axis=1, initial=0.0)
    break_intervals = np.searchsorted(times, schedule.breaks) - 1
    change[np.clip([*break_intervals, *(break_intervals + 1)], 0, n_intervals - 1).astype(int)] = 0.0
    edges = np.flatnonzero(np.diff(np.concatenate([[False], change > FEATURE_CHANGE, [False]]).astype(int)))
    groups = edges.reshape(-1, 2)
    if len(groups) > MAX_FEATURES:
        return []
    features = []
    for first_interval, end_interval in groups:
        steepest = first_interval + int(np.argmax(change[first_interval:end_interval]))
        jump = _locate_jump(system, initial_state, scale, times[steepest], times[steepest + 1], change[steepest])
        features += [] if jump is None else [TimeFeature(jump, jump)]
        if jump is None or end_interval - first_interval > 1:
            features.append(TimeFeature(float(times[first_interval]), float(times[end_interval])))
    return features


def _gradient_and_torque_of_state_at_times(system: System, x: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Return the energy gradient and the torque at one state and several times, shape (times, values)."""
    assert system.clock is not None
    states = np.tile(np.asarray(x, dtype=np.float64), (len(times), 1))
    states[:, system.clock.index] = times * system.clock.unit
    return np.asarray(evaluate_at_points(_energy_gradient_and_torque, system, states))


def _locate_jump(system: System, x: np.ndarray, scale: np.ndarray, start: float, end: float, change: float):
    """Return the first time after a jump in an interval, or None if the functions change continuously there."""
    while True:
        times = np.unique(np.linspace(start, end, N_PARTS + 1))
        values = _gradient_and_torque_of_state_at_times(system, x, times)
        changes = (np.abs(np.diff(values, axis=0)) / scale).max(axis=1)
        steepest_part = int(np.argmax(changes))
        if not changes[steepest_part] > JUMP_FRACTION * change:
            return None
        if len(times) <= N_PARTS:  # the parts are as short as the rounding of the times
            return float(times[steepest_part + 1])
        start, end = times[steepest_part], times[steepest_part + 1]


def _energy_gradient_and_torque(system: System, x) -> jax.Array:
    """Return the gradient of the energy by the state of the body, and the torque if there is one, in one array."""
    body, y = system.subsystem_to_solve(x)
    gradient = body.energy.gradient(y)[:-2]
    torque = body.external_torque(y)
    return gradient if torque is None else jnp.concatenate([gradient, torque])


def warn_of_skipped_features(features: Sequence[TimeFeature], h: float) -> None:
    """Warn of jumps, or else of features that are shorter than a step of size h."""
    jumps = sorted({feature.start for feature in features if feature.is_jump})
    short_features = sorted(feature for feature in features if not feature.is_jump and feature.end - feature.start < h)
    if jumps:
        breaks = ", ".join(f"{t:.17g}" for t in jumps[:8]) + (", ..." if len(jumps) > 8 else "")
        warn(
            f"the energy or the torque jumps inside of steps. Let steps end there: breaks=[{breaks}]",
            UndeclaredFeatureWarning,
        )
    elif short_features:
        start, end = short_features[0]
        warn(
            f"the energy or the torque changes a lot between t = {start:g} and t = {end:g}, within a step of {h:g}. "
            "Take shorter steps, or lt.Adaptive",
            UndeclaredFeatureWarning,
        )
