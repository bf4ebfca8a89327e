"""Sample of the steps that an audit checks: all steps of a run, or the steps during the fastest motion.

Each step is compared with the vector field at its ends and at points between, so that it cannot jump over a feature.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from ..systems import System
from ..tracing.interpret import evaluate_at_points

MAX_SAMPLED_VALUES = 500_000
"""Largest number of components in the states of all steps that are checked."""

REPLAY_COST_RATIO = 5
"""Cost of checking a step that must be repeated, relative to one whose end states are saved."""

DEFECT_POINTS_RANGE = (4, 32)
"""Smallest and largest number of points inside a step at which it is compared with the field."""

MAX_FIELD_VALUES_PER_CALL = 200_000
"""Largest number of components in the states at which the field is evaluated in one call, to bound the memory."""

MIN_SAMPLED_STEPS = 8
"""Smallest number of states, and of steps, that are checked, even for a large system."""


class StepSample(NamedTuple):
    """Sample of the steps of one or several trajectories, in any order.

    Attributes
    ----------
    trajectory : array of int, shape (m,)
        Indices of the trajectories to which the steps belong.
    t, h : array, shape (m,)
        Times at which the steps begin, and their sizes.
    x, x_end : array, shape (m, n)
        States at which they begin and end.
    """

    trajectory: np.ndarray
    t: np.ndarray
    h: np.ndarray
    x: np.ndarray
    x_end: np.ndarray

    def select(self, indices: np.ndarray) -> StepSample:
        """Return the steps with these indices."""
        return StepSample(*(values[indices] for values in self))


def sample_steps_of_run(
    system: System,
    saved_states: np.ndarray,
    saved_times: np.ndarray,
    step_sizes: np.ndarray,
    states_after_steps: Callable,
) -> StepSample:
    """Return a sample of the steps of a single run: all, or if these are too many, those with the fastest motion.

    Parameters
    ----------
    saved_states : array, shape (times, n)
    saved_times : array, shape (times,)
    step_sizes : array, shape (times - 1,)
        Size of the steps from each saved time to the next.
    states_after_steps : function of (x, h, steps) to an array, shape (at most steps, n)
        Returns the states after repeated steps.
    """
    gaps = np.diff(saved_times)
    counts = np.rint(gaps / step_sizes)
    # whether ``counts`` steps of equal size lead from a saved state to the next
    is_uniform = (counts > 0) & (np.abs(gaps - counts * step_sizes) <= 1e-6 * step_sizes)
    counts = np.where(is_uniform, counts, 1).astype(int)
    has_both_ends = is_uniform & (counts == 1)
    costs = np.where(has_both_ends, 1, REPLAY_COST_RATIO * counts)
    budget = max(MIN_SAMPLED_STEPS * REPLAY_COST_RATIO, MAX_SAMPLED_VALUES // saved_states.shape[1])
    order = (
        np.arange(len(step_sizes))
        if costs.sum() <= budget
        else _order_by_field_change(system, saved_states, step_sizes, max(MIN_SAMPLED_STEPS, budget // 4))
    )
    cumulative_cost = np.cumsum(costs[order])
    order = order[cumulative_cost - costs[order] < budget]
    if has_both_ends[order].all():
        return StepSample(
            np.zeros_like(order), saved_times[order], step_sizes[order], saved_states[order], saved_states[order + 1]
        )
    samples: list[StepSample] = []
    for i in order:
        states = saved_states[i : i + 2]
        if not has_both_ends[i]:
            states = np.vstack(
                [
                    saved_states[i],
                    states_after_steps(saved_states[i], step_sizes[i], min(counts[i], -(-budget // REPLAY_COST_RATIO))),
                ]
            )
        numbers = np.arange(len(states) - 1)
        sizes = np.full(len(numbers), step_sizes[i])
        samples.append(
            StepSample(np.zeros_like(numbers), saved_times[i] + step_sizes[i] * numbers, sizes, states[:-1], states[1:])
        )
        budget -= costs[i]
    return StepSample(*(np.concatenate(arrays) for arrays in zip(*samples, strict=True)))


def _order_by_field_change(system: System, states: np.ndarray, step_sizes: np.ndarray, max_states: int) -> np.ndarray:
    """Return the indices of all steps in the order of decreasing change of the vector field within a step.

    The change is evaluated at ``max_states`` evenly spaced states at most.
    """
    indices = np.unique(np.linspace(0, len(step_sizes) - 1, min(max_states, len(step_sizes))).astype(int))
    field = vector_field_at(system, states[indices])
    step = step_sizes[indices, None] * field
    change = np.abs(step_sizes[indices, None] * vector_field_at(system, states[indices] + 0.5 * step) - step).max(
        axis=1
    )
    change = np.nan_to_num(change, nan=np.inf)
    interval_change = np.maximum(change, np.append(change[1:], 0.0))  # for the interval between two sampled states
    interval = np.searchsorted(indices, np.arange(len(step_sizes)), side="right") - 1
    return np.lexsort([np.arange(len(step_sizes)), -interval_change[interval]])


def hermite_defects(vector_field: Callable, steps: StepSample) -> np.ndarray:
    """Return the defect of the cubic Hermite interpolant of each step, shape (m,), in units of the state.

    The defect is the mean distance between the slope of the interpolant and the vector field at points inside the step,
    times the step size. It is about the local error of a method of order three, and serves to rank steps. Points where
    the field is NaN count as zero.

    Parameters
    ----------
    vector_field : function of trajectories, shape (steps,), and states, shape (steps, q, n), to an array of that shape
        The vector field.
    """
    n_steps, n = steps.x.shape
    n_points = int(np.clip(MAX_SAMPLED_VALUES // max(n_steps * n, 1), *DEFECT_POINTS_RANGE))
    theta = (np.arange(n_points) + 0.5)[:, None] / n_points
    one_minus_theta = 1.0 - theta
    value_weights = (
        one_minus_theta**2 * (1 + 2 * theta),
        theta * one_minus_theta**2,
        theta**2 * (3 - 2 * theta),
        -(theta**2) * one_minus_theta,
    )
    slope_weights = (
        -6 * theta * one_minus_theta,
        one_minus_theta * (1 - 3 * theta),
        6 * theta * one_minus_theta,
        theta * (3 * theta - 2),
    )
    defects, block_size = np.zeros(n_steps), max(1, MAX_FIELD_VALUES_PER_CALL // (n * n_points))
    for start in range(0, n_steps, block_size):
        indices = np.arange(start, min(start + block_size, n_steps))
        trajectory, _, sizes, x, x_end = steps.select(indices)
        h = sizes[:, None]
        ends = np.stack([x, x_end], axis=1)
        slopes = h[:, None] * vector_field(trajectory, ends)
        ends_and_slopes = [v[:, i : i + 1] for i in (0, 1) for v in (ends, slopes)]
        cubic_states = sum(c * v for c, v in zip(value_weights, ends_and_slopes, strict=True))
        defect = np.abs(
            h[:, None] * vector_field(trajectory, cubic_states)
            - sum(c * v for c, v in zip(slope_weights, ends_and_slopes, strict=True))
        ).max(axis=2)
        defects[indices] = np.nan_to_num(defect, nan=0.0, posinf=1e300).mean(axis=1)
    return defects


def vector_field_at(system: System, states: np.ndarray) -> np.ndarray:
    """Return the vector field of a system at each of several states, shape (m, n), as an array of this shape."""
    with np.errstate(all="ignore"):
        return np.asarray(evaluate_at_points(vector_field, system, states))


def vector_field(system: System, x):
    """Return the vector field of a system at x, shape (n,)."""
    return system.vector_field(x)
