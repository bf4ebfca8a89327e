"""The steps of a run that an audit looks at: all of them, or those where the motion is fastest.

Each is compared with the vector field at its ends and at places between, so that what a step jumps over is seen.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from ..systems import System
from ..tracing.interpret import evaluate_at_points

MAX_SAMPLED_VALUES = 500_000
"""Numbers in the states of all steps that are looked at."""

REPLAY_COST_RATIO = 5
"""Cost of a step that has to be taken again to be looked at, over that of one both ends of which are kept."""

DEFECT_POINTS_RANGE = (4, 32)
"""Places between the ends of a step where it is compared with the field, the least and the most."""

MAX_FIELD_VALUES_PER_CALL = 200_000
"""Numbers in the states at which the field is evaluated at once: bounded memory."""

MIN_SAMPLED_STEPS = 8
"""States at which the speed of the motion is looked at, and steps that are looked at, however large the system is."""


class StepSample(NamedTuple):
    """Steps of a run, in any order.

    Attributes
    ----------
    t, h : array, shape (m,)
        When they begin, and their sizes.
    x, x_end : array, shape (m, n)
        The states at their ends.
    """

    t: np.ndarray
    h: np.ndarray
    x: np.ndarray
    x_end: np.ndarray


def sample_steps(system: System, x: np.ndarray, t: np.ndarray, h: np.ndarray, replay: Callable) -> StepSample:
    """All the steps of a run, or as many as can be afforded.

    Parameters
    ----------
    x : array, shape (times, n)
        The states that are kept.
    t, h : array, shape (times,) and (times - 1,)
        Their times; the size of the step from each.
    replay : function of (x, h, steps) to an array, shape (at most steps, n)
        The states after steps that are taken again.
    """
    gaps = np.diff(t)
    counts = np.rint(gaps / h)
    alike = (counts > 0) & (np.abs(gaps - counts * h) <= 1e-6 * h)  # as many steps of that size lead to the next state
    counts = np.where(alike, counts, 1).astype(int)
    kept = alike & (counts == 1)
    costs, left = (
        np.where(kept, 1, REPLAY_COST_RATIO * counts),
        max(MIN_SAMPLED_STEPS * REPLAY_COST_RATIO, MAX_SAMPLED_VALUES // x.shape[1]),
    )
    order = (
        np.arange(len(h))
        if costs.sum() <= left
        else _order_by_field_change(system, x, h, max(MIN_SAMPLED_STEPS, left // 4))
    )
    spent = np.cumsum(costs[order])
    order = order[spent - costs[order] < left]
    if kept[order].all():
        return StepSample(t[order], h[order], x[order], x[order + 1])
    found: list[StepSample] = []
    for i in order:
        path = x[i : i + 2]
        if not kept[i]:
            path = np.vstack([x[i], replay(x[i], h[i], min(counts[i], -(-left // REPLAY_COST_RATIO)))])
        size = np.full(len(path) - 1, h[i])
        found.append(StepSample(t[i] + h[i] * np.arange(len(size)), size, path[:-1], path[1:]))
        left -= costs[i]
    return StepSample(*(np.concatenate(parts) for parts in zip(*found, strict=True)))


def _order_by_field_change(system: System, x: np.ndarray, h: np.ndarray, most: int) -> np.ndarray:
    """The places of all steps, those first near which a step changes the field most: looked at from ``most`` states."""
    some = np.unique(np.linspace(0, len(h) - 1, min(most, len(h))).astype(int))
    before = vector_field_at(system, x[some])
    step = h[some, None] * before
    change = np.abs(h[some, None] * vector_field_at(system, x[some] + 0.5 * step) - step).max(axis=1)
    change = np.nan_to_num(change, nan=np.inf)
    ends = np.maximum(change, np.append(change[1:], 0.0))  # between two states that were seen
    block = np.searchsorted(some, np.arange(len(h)), side="right") - 1
    return np.lexsort([np.arange(len(h)), -ends[block]])


def hermite_defect(field: Callable, steps: StepSample) -> np.ndarray:
    """How far the cubic through the ends of each step, with the field as its slopes, misses the field, shape (m,).

    The mean over places between, times the size of the step: about what the state at the end is off by, for a method of
    order three. It ranks steps. At a place where the field is not finite nothing is known.

    Parameters
    ----------
    field : function of the places of steps and an array, shape (places, q, n), to an array of that shape
        The vector field.
    """
    number, n = steps.x.shape
    places = int(np.clip(MAX_SAMPLED_VALUES // max(number * n, 1), *DEFECT_POINTS_RANGE))
    theta = (np.arange(places) + 0.5)[:, None] / places
    left = 1.0 - theta
    value = left**2 * (1 + 2 * theta), theta * left**2, theta**2 * (3 - 2 * theta), -(theta**2) * left
    slope = -6 * theta * left, left * (1 - 3 * theta), 6 * theta * left, theta * (3 * theta - 2)
    found, size = np.zeros(number), max(1, MAX_FIELD_VALUES_PER_CALL // (n * places))
    for first in range(0, number, size):
        part = np.arange(first, min(first + size, number))
        x, end, h = steps.x[part], steps.x_end[part], steps.h[part, None]
        ends = np.stack([x, end], axis=1)
        slopes = h[:, None] * field(part, ends)
        data = [v[:, i : i + 1] for i in (0, 1) for v in (ends, slopes)]
        between = sum(c * v for c, v in zip(value, data, strict=True))
        defect = np.abs(h[:, None] * field(part, between) - sum(c * v for c, v in zip(slope, data, strict=True))).max(
            axis=2
        )
        found[part] = np.nan_to_num(defect, nan=0.0, posinf=1e300).mean(axis=1)
    return found


def vector_field_at(system: System, x: np.ndarray) -> np.ndarray:
    """The vector field at states, shape (m, n)."""
    with np.errstate(all="ignore"):
        return np.asarray(evaluate_at_points(_vector_field, system, x))


def _vector_field(system: System, x):
    return system.vector_field(x)
