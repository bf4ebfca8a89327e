"""Trajectories as they are given, checked; and what networks and losses are scaled by."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import scipy.interpolate

from ..errors import InputError
from ..results.solution import Solution
from ..systems import System
from .observation import Observation

SPLINE_DEGREE = 5
"""Degree of the splines through the data: their derivatives are of order 5."""


class Trajectory(NamedTuple):
    """Times, shape (m,), and what is observed of the states then, shape (m, ...)."""

    t: np.ndarray
    x: np.ndarray

    @property
    def flat_trajectory(self) -> Trajectory:
        """The same with rows of numbers, shape (m, k)."""
        return Trajectory(self.t, self.x.reshape(len(self.t), -1))


def parse_trajectories(data: Any, system: System, own: Observation) -> list[Trajectory]:
    """What a user gives as data: a pair of times and observations, several of them, or solutions.

    Raises
    ------
    InputError
        If something is missing, is not finite, or does not fit.
    """
    found = [_checked_trajectory(i, t, x, system, own) for i, (t, x) in enumerate(_time_state_pairs(data, own))]
    if not found:
        raise InputError("there are no trajectories in the data")
    return found


def _time_state_pairs(data: Any, own: Observation) -> list[tuple[Any, Any]]:
    if isinstance(data, Solution):
        return [(data.t, own.observe_solution(data))]
    if isinstance(data, tuple) and len(data) == 2 and _ndim_or_none(data[0]) == 1:
        t, x = data
        return [(t, x) for x in np.asarray(x)] if _ndim_or_none(x) == 2 + len(own.shape) else [(t, x)]
    if not isinstance(data, Sequence) or isinstance(data, str):
        raise InputError(
            f"data is a pair (t, x), t of shape (m,), x of shape (m, n) or (trajectories, m, n), a list of such pairs, "
            f"or solutions, not {type(data).__name__}"
        )
    return [pair for part in data for pair in _time_state_pairs(part, own)]


def _ndim_or_none(values: Any) -> int | None:
    """None of rows of different lengths."""
    try:
        return np.ndim(values)
    except ValueError:
        return None


def _real_array(values: Any) -> np.ndarray:
    """Raises TypeError, or ValueError, where they are none."""
    found = np.asarray(values)
    if found.dtype.kind not in "biufO":
        raise TypeError(f"they are of type {found.dtype}")
    return found.astype(np.float64)


def _checked_trajectory(number: int, t, x, system: System, own: Observation) -> Trajectory:
    what = f"trajectory {number}"
    try:
        t, x = _real_array(t), _real_array(x)
    except (TypeError, ValueError) as error:
        raise InputError(f"{what} is not made of real numbers: {error}") from None
    if t.ndim != 1 or len(t) < 2:
        raise InputError(f"{what} has {t.size} point{'s' if t.size != 1 else ''}: at least 2 tell of a motion")
    if x.ndim == 0 or len(x) != len(t):
        raise InputError(f"{what} has {len(t)} times and {len(x) if x.ndim else 'no'} states")
    for name, values in (("time", t), ("state", x)):
        bad = np.argwhere(~np.isfinite(values))
        if len(bad):
            at = f"component {', '.join(map(str, bad[0][1:]))} of " if values.ndim > 1 else ""
            row = int(bad[0][0])
            raise InputError(f"{what}: {at}{name} {row} is {values[tuple(bad[0])]}; leave that row out")
    falls = np.flatnonzero(np.diff(t) <= 0.0)
    if len(falls):
        i = int(falls[0])
        raise InputError(f"{what}: times must grow, but time {i + 1} is {t[i + 1]:g} after {t[i]:g}")
    if own.is_full_state:
        try:
            x = np.asarray(system.state_array(x, batch=True))
        except InputError as error:
            raise type(error)(f"{what}: {error}") from None
    elif x.shape != (len(t), *own.shape):
        seen = (
            f"{len(own.component_indices)} components are observed"
            if len(own.component_indices)
            else f"observe returns shape {own.shape}"
        )
        raise InputError(f"{what} has observations of shape {x.shape}, but {seen} at {len(t)} times")
    return Trajectory(t, x)


class DataScales(NamedTuple):
    """What numbers are of the size of.

    Attributes
    ----------
    centre, scale : array, shape (n,)
        Mean and spread of each.
    time_scale : float
        In which they change by their spread.
    """

    centre: np.ndarray
    scale: np.ndarray
    time_scale: float

    def extend_to_states(self, places: np.ndarray, states: np.ndarray) -> DataScales:
        """Those of states, shape (m, n), of which some components are observed; 0 and 1 of one that does not vary."""
        centre, size = states.mean(axis=0), states.std(axis=0)
        centre, size = np.where(size > 0.0, centre, 0.0), np.where(size > 0.0, size, 1.0)
        centre[places], size[places] = self.centre[: len(places)], self.scale[: len(places)]
        return DataScales(centre, size, self.time_scale)


def data_scales(data: list[Trajectory]) -> DataScales:
    """The mean and the spread of all trajectories together, and the time in which they change."""
    x = np.concatenate([trajectory.x for trajectory in data])
    rates = np.concatenate([np.diff(x, axis=0) / np.diff(t)[:, None] for t, x in data])
    middle, spread = x.mean(axis=0), x.std(axis=0)
    spread = np.where(spread > 1e-12 * np.abs(middle), spread, np.where(middle != 0.0, np.abs(middle), 1.0))
    speed = np.sqrt(np.mean((rates / spread) ** 2, axis=0))
    moving = speed[speed > 0.0]
    if not len(moving):
        raise InputError("nothing moves in the data: all states of a trajectory are the same")
    return DataScales(middle, spread, 1.0 / float(np.median(moving)))


def spline_states_and_rates(trajectory: Trajectory, noise: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
    """States and their rates of change at the times of a trajectory, by a spline, shape (m, k) each.

    Through the points, or as near to them as the noise allows, standard deviations of shape (k,).
    """
    t, x = trajectory
    start, length = t[0], t[-1] - t[0]
    u, degree = (t - start) / length, min(SPLINE_DEGREE, len(t) - 1)
    if noise is None or degree < SPLINE_DEGREE:
        spline = scipy.interpolate.make_interp_spline(u, x, k=degree)
        return x, spline.derivative()(u) / length
    columns = [
        scipy.interpolate.UnivariateSpline(u, y, w=np.full(len(u), 1.0 / sigma), k=degree, s=len(u))
        for y, sigma in zip(x.T, noise, strict=True)
    ]
    return np.stack([f(u) for f in columns], axis=1), np.stack([f.derivative()(u) for f in columns], axis=1) / length


DIFFERENCE_ORDERS = (2, 3, 4, 5, 6)
"""Orders of divided differences that distinguish noise from motion."""

NOISE_PLATEAU_RATIO = 0.7
"""Ratio of the estimates by the highest order and by the one two below it, above which they are of noise: those of a
motion that is resolved fall from order to order."""

MIN_DIFFERENCES = 12
"""Differences of the highest order from which noise is estimated."""

MIN_RELATIVE_NOISE = 1e-3
"""Noise below this part of the spread of the data is left out of account."""


def estimate_noise(data: list[Trajectory], size: np.ndarray) -> np.ndarray | None:
    """Return standard deviations of the errors of data, shape (k,), from their differences; None where none are seen.

    A divided difference of order d of a smooth motion falls with d, and that of independent errors, with weights of
    norm one, does not.
    """
    order = DIFFERENCE_ORDERS[-1]
    if sum(max(len(t) - order, 0) for t, _ in data) < MIN_DIFFERENCES:
        return None
    levels = np.stack([_divided_difference_std(data, d) for d in DIFFERENCE_ORDERS])
    is_noise = (levels[-1] > NOISE_PLATEAU_RATIO * levels[-3]) & (levels[-1] > MIN_RELATIVE_NOISE * size)
    if not is_noise.any():
        return None
    found = np.where(is_noise, levels[-3:].mean(axis=0), levels.min(axis=0))
    return np.maximum(found, MIN_RELATIVE_NOISE * size)


def _divided_difference_std(data: list[Trajectory], order: int) -> np.ndarray:
    """Return the standard deviation of normalised divided differences, shape (k,), by their median."""
    found = []
    for t, x in data:
        if len(t) <= order:
            continue
        times = np.lib.stride_tricks.sliding_window_view(t, order + 1)
        times = (times - times[:, :1]) / (times[:, -1:] - times[:, :1])
        gaps = times[:, :, None] - times[:, None, :] + np.eye(order + 1)
        weights = 1.0 / np.prod(gaps, axis=2)
        weights /= np.linalg.norm(weights, axis=1, keepdims=True)
        found.append(np.einsum("wj,wkj->wk", weights, np.lib.stride_tricks.sliding_window_view(x, order + 1, axis=0)))
    return np.median(np.abs(np.concatenate(found)), axis=0) / MEDIAN_ABS_NORMAL


MEDIAN_ABS_NORMAL = 0.6744897501960817
"""Median of the absolute value of a normal variable, in its standard deviations."""


class Windows(NamedTuple):
    """Short pieces of trajectories, all of the same number m of intervals.

    Attributes
    ----------
    initial_states : array, shape (windows, N)
        The states in which they begin.
    intervals : array, shape (windows, m)
        Of the intervals.
    observations : array, shape (windows, m + 1, k)
        What is observed at their ends, that of the start first.
    next_window : array of int, shape (windows,)
        The window that begins where one ends; -1 where none does.
    first_windows : array of int, shape (trajectories,)
        The window in which each trajectory begins.
    """

    initial_states: np.ndarray
    intervals: np.ndarray
    observations: np.ndarray
    next_window: np.ndarray
    first_windows: np.ndarray


def cut_windows(data: list[Trajectory], states: list[np.ndarray], length: int, apart: bool) -> Windows:
    """The pieces of trajectories; with ``apart`` one begins where another ends, else at every point."""
    length = min(length, *(len(t) - 1 for t, _ in data))
    starts, sizes, shown = [], [], []
    following: list[int] = []
    begins = []
    for (t, x), own in zip(data, states, strict=True):
        last = len(t) - 1 - length
        firsts = list(range(0, last + 1, length if apart else 1))
        if firsts[-1] != last:
            firsts.append(last)
        begins.append(len(following))
        for i in firsts:
            follows = apart and i + length in firsts
            starts.append(own[i])
            sizes.append(np.diff(t[i : i + length + 1]))
            shown.append(x[i : i + length + 1])
            following.append(len(following) + 1 if follows else -1)
    return Windows(np.stack(starts), np.stack(sizes), np.stack(shown), np.array(following), np.array(begins))
