"""Check the trajectories of the data, compute their scales and noise, and cut them into windows."""

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
"""Degree of the splines through the data, whose derivatives are then of order 5."""


class Trajectory(NamedTuple):
    """Times, shape (m,), and the observations at these times, shape (m, ...)."""

    t: np.ndarray
    x: np.ndarray

    @property
    def flat_trajectory(self) -> Trajectory:
        """The trajectory with each observation as a row of numbers, shape (m, k)."""
        return Trajectory(self.t, self.x.reshape(len(self.t), -1))


def parse_trajectories(data: Any, system: System, observation: Observation) -> list[Trajectory]:
    """Return the trajectories in the user's data: a pair of times and observations, a list of pairs, or solutions.

    Raises
    ------
    InputError
        If data are missing, not finite, or of the wrong shape.
    """
    trajectories = [
        _checked_trajectory(i, t, x, system, observation)
        for i, (t, x) in enumerate(_time_observation_pairs(data, observation))
    ]
    if not trajectories:
        raise InputError("there are no trajectories in the data")
    return trajectories


def _time_observation_pairs(data: Any, observation: Observation) -> list[tuple[Any, Any]]:
    if isinstance(data, Solution):
        return [(data.t, observation.observe_solution(data))]
    if isinstance(data, tuple) and len(data) == 2 and _ndim_or_none(data[0]) == 1:
        t, x = data
        return [(t, x) for x in np.asarray(x)] if _ndim_or_none(x) == 2 + len(observation.shape) else [(t, x)]
    if not isinstance(data, Sequence) or isinstance(data, str):
        raise InputError(
            f"data must be a pair (t, x), t of shape (m,), x of shape (m, n) or (trajectories, m, n), a list of such "
            f"pairs, or solutions, got {type(data).__name__}"
        )
    return [pair for item in data for pair in _time_observation_pairs(item, observation)]


def _ndim_or_none(values: Any) -> int | None:
    """Return the number of dimensions of an array-like, or None for rows of different lengths."""
    try:
        return np.ndim(values)
    except ValueError:
        return None


def _real_array(values: Any) -> np.ndarray:
    """Convert to an array of floats; raise TypeError or ValueError if the values are not real numbers."""
    array = np.asarray(values)
    if array.dtype.kind not in "biufO":
        raise TypeError(f"they are of type {array.dtype}")
    return array.astype(np.float64)


def _checked_trajectory(number: int, t, x, system: System, observation: Observation) -> Trajectory:
    name_of_trajectory = f"trajectory {number}"
    try:
        t, x = _real_array(t), _real_array(x)
    except (TypeError, ValueError) as error:
        raise InputError(f"{name_of_trajectory} is not made of real numbers: {error}") from None
    if t.ndim != 1 or len(t) < 2:
        raise InputError(
            f"{name_of_trajectory} has {t.size} point{'s' if t.size != 1 else ''}: at least 2 tell of a motion"
        )
    if x.ndim == 0 or len(x) != len(t):
        raise InputError(f"{name_of_trajectory} has {len(t)} times and {len(x) if x.ndim else 'no'} states")
    for name, values in (("time", t), ("state", x)):
        non_finite_indices = np.argwhere(~np.isfinite(values))
        if len(non_finite_indices):
            component_text = (
                f"component {', '.join(map(str, non_finite_indices[0][1:]))} of " if values.ndim > 1 else ""
            )
            row = int(non_finite_indices[0][0])
            raise InputError(
                f"{name_of_trajectory}: {component_text}{name} {row} is {values[tuple(non_finite_indices[0])]}. "
                "Leave out this row"
            )
    decreasing_indices = np.flatnonzero(np.diff(t) <= 0.0)
    if len(decreasing_indices):
        i = int(decreasing_indices[0])
        raise InputError(f"{name_of_trajectory}: times must grow, but time {i + 1} is {t[i + 1]:g} after {t[i]:g}")
    if observation.is_full_state:
        try:
            x = np.asarray(system.state_array(x, batch=True))
        except InputError as error:
            raise type(error)(f"{name_of_trajectory}: {error}") from None
    elif x.shape != (len(t), *observation.shape):
        expected_text = (
            f"{len(observation.component_indices)} components are observed"
            if len(observation.component_indices)
            else f"observe returns shape {observation.shape}"
        )
        raise InputError(
            f"{name_of_trajectory} has observations of shape {x.shape}, but {expected_text} at {len(t)} times"
        )
    return Trajectory(t, x)


class DataScales(NamedTuple):
    """Location and scale of each component of the data, and their time scale.

    Attributes
    ----------
    centre, scale : array, shape (n,)
        Mean and standard deviation of each component.
    time_scale : float
        Time in which the components change by their scale.
    """

    centre: np.ndarray
    scale: np.ndarray
    time_scale: float

    def extend_to_states(self, indices: np.ndarray, states: np.ndarray) -> DataScales:
        """Return the scales of full states: the data scales at ``indices``, those of ``states`` elsewhere.

        A component that does not vary has centre 0 and scale 1.
        """
        centre, scale = states.mean(axis=0), states.std(axis=0)
        centre, scale = np.where(scale > 0.0, centre, 0.0), np.where(scale > 0.0, scale, 1.0)
        centre[indices], scale[indices] = self.centre[: len(indices)], self.scale[: len(indices)]
        return DataScales(centre, scale, self.time_scale)


def data_scales(data: list[Trajectory]) -> DataScales:
    """Return the mean and standard deviation of all trajectories together, and the time scale of their changes."""
    x = np.concatenate([trajectory.x for trajectory in data])
    rates = np.concatenate([np.diff(x, axis=0) / np.diff(t)[:, None] for t, x in data])
    centre, scale = x.mean(axis=0), x.std(axis=0)
    scale = np.where(scale > 1e-12 * np.abs(centre), scale, np.where(centre != 0.0, np.abs(centre), 1.0))
    speed = np.sqrt(np.mean((rates / scale) ** 2, axis=0))
    positive_speeds = speed[speed > 0.0]
    if not len(positive_speeds):
        raise InputError("nothing moves in the data: all states of each trajectory are equal")
    return DataScales(centre, scale, 1.0 / float(np.median(positive_speeds)))


def spline_states_and_rates(trajectory: Trajectory, noise: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
    """Return states and rates of change at the times of a trajectory by a spline, shape (m, k) each.

    Without noise the spline interpolates; with noise, standard deviations of shape (k,), it smooths by as much.
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
"""Orders of the divided differences that distinguish noise from motion."""

NOISE_PLATEAU_RATIO = 0.7
"""Ratio of the estimates of the highest order and of the order two below, above which they count as noise. For a
resolved motion the estimates fall from order to order."""

MIN_DIFFERENCES = 12
"""Smallest number of differences of the highest order from which noise is estimated."""

MIN_RELATIVE_NOISE = 1e-3
"""Noise, relative to the scale of the data, below which it is ignored."""


def estimate_noise(data: list[Trajectory], scale: np.ndarray) -> np.ndarray | None:
    """Return standard deviations of the errors of data, shape (k,), from their differences; None if no noise is
    detected.

    Divided differences of a smooth motion decrease with their order. Those of independent errors, with weights of norm
    one, do not.
    """
    order = DIFFERENCE_ORDERS[-1]
    if sum(max(len(t) - order, 0) for t, _ in data) < MIN_DIFFERENCES:
        return None
    levels = np.stack([_divided_difference_std(data, d) for d in DIFFERENCE_ORDERS])
    is_noise = (levels[-1] > NOISE_PLATEAU_RATIO * levels[-3]) & (levels[-1] > MIN_RELATIVE_NOISE * scale)
    if not is_noise.any():
        return None
    std = np.where(is_noise, levels[-3:].mean(axis=0), levels.min(axis=0))
    return np.maximum(std, MIN_RELATIVE_NOISE * scale)


def _divided_difference_std(data: list[Trajectory], order: int) -> np.ndarray:
    """Return the standard deviation of normalised divided differences, shape (k,), by their median."""
    differences = []
    for t, x in data:
        if len(t) <= order:
            continue
        times = np.lib.stride_tricks.sliding_window_view(t, order + 1)
        times = (times - times[:, :1]) / (times[:, -1:] - times[:, :1])
        gaps = times[:, :, None] - times[:, None, :] + np.eye(order + 1)
        weights = 1.0 / np.prod(gaps, axis=2)
        weights /= np.linalg.norm(weights, axis=1, keepdims=True)
        differences.append(
            np.einsum("wj,wkj->wk", weights, np.lib.stride_tricks.sliding_window_view(x, order + 1, axis=0))
        )
    return np.median(np.abs(np.concatenate(differences)), axis=0) / MEDIAN_ABS_NORMAL


MEDIAN_ABS_NORMAL = 0.6744897501960817
"""Median of the absolute value of a standard normal variable."""


class Windows(NamedTuple):
    """Short windows of trajectories, each of m intervals.

    Attributes
    ----------
    initial_states : array, shape (windows, N)
        States at the starts of the windows.
    intervals : array, shape (windows, m)
        Lengths of the time intervals.
    observations : array, shape (windows, m + 1, k)
        Observations at the start and at the ends of the intervals.
    next_window : array of int, shape (windows,)
        Index of the window that starts where this one ends; -1 if there is none.
    first_windows : array of int, shape (trajectories,)
        Index of the first window of each trajectory.
    """

    initial_states: np.ndarray
    intervals: np.ndarray
    observations: np.ndarray
    next_window: np.ndarray
    first_windows: np.ndarray


def cut_windows(data: list[Trajectory], states: list[np.ndarray], length: int, is_disjoint: bool) -> Windows:
    """Cut trajectories into windows of ``length`` intervals: consecutive ones if ``is_disjoint``, else one from each
    point."""
    length = min(length, *(len(t) - 1 for t, _ in data))
    initial_states, intervals, observations = [], [], []
    next_window: list[int] = []
    first_windows = []
    for (t, x), trajectory_states in zip(data, states, strict=True):
        last_start = len(t) - 1 - length
        window_starts = list(range(0, last_start + 1, length if is_disjoint else 1))
        if window_starts[-1] != last_start:
            window_starts.append(last_start)
        first_windows.append(len(next_window))
        for i in window_starts:
            has_next = is_disjoint and i + length in window_starts
            initial_states.append(trajectory_states[i])
            intervals.append(np.diff(t[i : i + length + 1]))
            observations.append(x[i : i + length + 1])
            next_window.append(len(next_window) + 1 if has_next else -1)
    return Windows(
        np.stack(initial_states),
        np.stack(intervals),
        np.stack(observations),
        np.array(next_window),
        np.array(first_windows),
    )
