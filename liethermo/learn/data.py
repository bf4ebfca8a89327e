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
from .records import Records, Trajectory, is_readable_table, read_data

SPLINE_DEGREE = 5
"""Degree of the splines through the data, whose derivatives are then of order 5."""


def parse_trajectories(data: Any, system: System, observation: Observation) -> list[Trajectory]:
    """Convert the data of a fit to a list of checked trajectories; data are pairs (t, x), solutions, or a table.

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


def _observed_trajectories(records: Records, observation: Observation) -> list[Trajectory]:
    """Return the trajectories of a table with the observed columns only: by name, or all if the observation has no
    names.

    Raises
    ------
    InputError
        If a column is missing, or the number of columns is not that of the observation.
    """
    records = records.select(observation.names) if observation.names else records
    count = int(np.prod(observation.shape))
    if len(records.names) != count:
        raise InputError(
            f"the data have {len(records.names)} columns ({', '.join(records.names)}), but {count} are observed. "
            f"Choose {count} with lt.learn.read_data(..., columns=[...]), or return a dict by their names from observe"
        )
    return [Trajectory(t, x.reshape(len(t), *observation.shape)) for t, x in records]


def _time_observation_pairs(data: Any, observation: Observation) -> list[tuple[Any, Any]]:
    """Return the pairs (times, observations) in the data of a fit, one for each trajectory, without checking them.

    Raises
    ------
    InputError
        If data are not pairs, solutions, a table, or a sequence of these.
    """
    if is_readable_table(data):
        data = read_data(data, columns=observation.names or None)
    if isinstance(data, Records):
        return list(_observed_trajectories(data, observation))
    if isinstance(data, Solution):
        return [(data.t, observation.observe_solution(data))]
    if isinstance(data, tuple) and len(data) == 2 and _ndim_or_none(data[0]) == 1:
        t, x = data
        return [(t, x) for x in np.asarray(x)] if _ndim_or_none(x) == 2 + len(observation.shape) else [(t, x)]
    if not isinstance(data, Sequence) or isinstance(data, str):
        raise InputError(
            "data must be a pair (t, x), t of shape (m,), x of shape (m, n) or (trajectories, m, n), a list of such "
            f"pairs, solutions, or a table that lt.learn.read_data reads, got {type(data).__name__}"
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


def _checked_trajectory(trajectory_index: int, t, x, system: System, observation: Observation) -> Trajectory:
    """Return a trajectory without the times at which nothing was observed, after checking its times and values.

    Raises
    ------
    InputError
        If values are not finite real numbers (NaN is a missing observation), times do not increase, shapes do not match
        the observation, or a component has no values.
    """
    name_of_trajectory = f"trajectory {trajectory_index}"
    try:
        t, x = _real_array(t), _real_array(x)
    except (TypeError, ValueError) as error:
        raise InputError(f"{name_of_trajectory} is not made of real numbers: {error}") from None
    if t.ndim != 1 or len(t) < 2:
        raise InputError(f"{name_of_trajectory} has {t.size} time{'s' if t.size != 1 else ''}, at least 2 are needed")
    if x.ndim == 0 or len(x) != len(t):
        raise InputError(f"{name_of_trajectory} has {len(t)} times and {len(x) if x.ndim else 'no'} states")
    for name, values, is_invalid in (("time", t, ~np.isfinite(t)), ("state", x, np.isinf(x))):
        if is_invalid.any():
            index = tuple(map(int, np.argwhere(is_invalid)[0]))
            component_text = f"component {', '.join(map(str, index[1:]))} of " if values.ndim > 1 else ""
            raise InputError(
                f"{name_of_trajectory}: {component_text}{name} {index[0]} is {values[index]}. Leave out this row"
                + (", or write NaN for a missing value" if values is x else "")
            )
    decreasing_indices = np.flatnonzero(np.diff(t) <= 0.0)
    if len(decreasing_indices):
        i = int(decreasing_indices[0])
        raise InputError(
            f"{name_of_trajectory}: times must grow, but time {i + 1} is {t[i + 1]:g} after {t[i]:g}. "
            "Sort the rows by time, without repeated times; several trajectories are a list of pairs (t, x)"
        )
    is_missing = np.isnan(x)
    if observation.is_full_state:
        try:
            x = np.asarray(system.state_array(np.where(is_missing, 0.0, x) if is_missing.any() else x, batch=True))
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
    if is_missing.any():
        if is_missing.shape != x.shape:
            raise InputError(f"{name_of_trajectory} has missing values, which need states of shape ({system.dim},)")
        x = np.where(is_missing, np.nan, x)
        if is_missing.all(axis=0).any():
            component = ", ".join(map(str, np.argwhere(is_missing.all(axis=0))[0]))
            raise InputError(
                f"{name_of_trajectory}: component {component} has no values, only NaN. Name the measured components "
                "with observed="
            )
        has_value = ~is_missing.reshape(len(t), -1).all(axis=1)
        t, x = t[has_value], x[has_value]
        if len(t) < 2:
            raise InputError(f"{name_of_trajectory} has 1 time with values, at least 2 are needed. Leave it out")
    return Trajectory(t, x)


def _present_values_of_component(trajectory: Trajectory, component: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the times and values at which a component of a trajectory is not missing, shape (p,) each."""
    values = trajectory.x[:, component]
    is_present = np.isfinite(values)
    return trajectory.t[is_present], values[is_present]


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

    def extend_to_states(self, observed_indices: np.ndarray, states: np.ndarray) -> DataScales:
        """Return the scales of all state components: observed components keep those of the data, the others get those
        of ``states``.

        A component that does not vary has centre 0 and scale 1.
        """
        centre, scale = states.mean(axis=0), states.std(axis=0)
        centre, scale = np.where(scale > 0.0, centre, 0.0), np.where(scale > 0.0, scale, 1.0)
        centre[observed_indices], scale[observed_indices] = (
            self.centre[: len(observed_indices)],
            self.scale[: len(observed_indices)],
        )
        return DataScales(centre, scale, self.time_scale)


def compute_data_scales(trajectories: list[Trajectory]) -> DataScales:
    """Return mean and standard deviation of each component over all trajectories, shape (k,), and the time scale."""
    columns = [
        [_present_values_of_component(trajectory, k) for trajectory in trajectories]
        for k in range(trajectories[0].x.shape[1])
    ]
    values = [np.concatenate([y for _, y in column]) for column in columns]
    centre, scale = np.array([y.mean() for y in values]), np.array([y.std() for y in values])
    scale = np.where(scale > 1e-12 * np.abs(centre), scale, np.where(centre != 0.0, np.abs(centre), 1.0))
    rates = [np.concatenate([np.zeros(0), *(np.diff(y) / np.diff(t) for t, y in column)]) for column in columns]
    speed = np.array([np.sqrt(np.mean((r / s) ** 2)) if r.size else 0.0 for r, s in zip(rates, scale, strict=True)])
    positive_speeds = speed[speed > 0.0]
    if not len(positive_speeds):
        raise InputError("nothing moves in the data: all states of each trajectory are equal")
    return DataScales(centre, scale, 1.0 / float(np.median(positive_speeds)))


def shortest_time_scale(rates: list[np.ndarray], scales: DataScales) -> float:
    """Return the time in which the fastest component changes by its scale, from rates of change, shapes (m, k)."""
    speed = np.sqrt(np.mean((np.concatenate(rates) / scales.scale) ** 2, axis=0))
    return 1.0 / float(np.max(speed)) if (speed > 0.0).any() else scales.time_scale


def spline_states_and_rates(trajectory: Trajectory, noise: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
    """Fit a spline to a trajectory and return its values and derivatives at the times of the data, shape (m, k) each.

    Without noise the spline interpolates; with noise, standard deviations of shape (k,), it smooths by as much.
    """
    t, x = trajectory
    if np.isnan(x).any():
        return _spline_states_with_missing_values(trajectory, noise)
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


def _spline_states_with_missing_values(
    trajectory: Trajectory, noise: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray]:
    """Fit splines to components with missing values; return their values and derivatives at all times, shape (m, k).

    Before its first value and after its last one, a component is constant.
    """
    states, rates = np.empty_like(trajectory.x), np.zeros_like(trajectory.x)
    for k in range(trajectory.x.shape[1]):
        t, y = _present_values_of_component(trajectory, k)
        if len(t) == 1:
            states[:, k] = y[0]
            continue
        column = Trajectory(t, y[:, None])
        values, slopes = spline_states_and_rates(column, None if noise is None else noise[k : k + 1])
        spline = scipy.interpolate.CubicHermiteSpline(t, values[:, 0], slopes[:, 0])
        is_inside = (trajectory.t >= t[0]) & (trajectory.t <= t[-1])
        states[:, k] = spline(np.clip(trajectory.t, t[0], t[-1]))
        rates[is_inside, k] = spline.derivative()(trajectory.t[is_inside])
    return states, rates


DIFFERENCE_ORDERS = (2, 3, 4, 5, 6)
"""Orders of the divided differences that distinguish noise from motion."""

NOISE_PLATEAU_RATIO = 0.7
"""Ratio of the estimates of the highest order and of the order two below, above which they count as noise. For a
resolved motion the estimates fall from order to order."""

MIN_DIFFERENCES = 12
"""Smallest number of differences of the highest order from which noise is estimated."""

MIN_RELATIVE_NOISE = 1e-3
"""Noise, relative to the scale of the data, below which it is ignored."""


def estimate_noise_if_visible(trajectories: list[Trajectory], scale: np.ndarray) -> np.ndarray | None:
    """Estimate the standard deviation of the measurement noise of each component, shape (k,); return None if no noise
    is visible.

    Divided differences of a smooth motion decrease with their order. Those of independent errors, with weights of norm
    one, do not.
    """
    levels = estimate_noise_levels(trajectories, scale)
    return levels.std if levels.is_noise.any() else None


class NoiseLevels(NamedTuple):
    """Estimates of the measurement noise of each component, from divided differences of the data.

    Attributes
    ----------
    std : array, shape (k,)
        Standard deviation of the errors where they are noise, else an upper bound.
    is_noise : array of bool, shape (k,)
        True if the differences show noise.
    is_bound : array of bool, shape (k,)
        True if there are enough differences, so that ``std`` holds.
    """

    std: np.ndarray
    is_noise: np.ndarray
    is_bound: np.ndarray


def estimate_noise_levels(trajectories: list[Trajectory], scale: np.ndarray) -> NoiseLevels:
    """Estimate the standard deviation of the noise of each component, or an upper bound if no noise is visible."""
    stds_by_order = np.array(
        [
            _noise_stds_by_difference_order(
                [_present_values_of_component(trajectory, k) for trajectory in trajectories]
            )
            for k in range(len(scale))
        ]
    )
    is_noise = (stds_by_order[:, -1] > NOISE_PLATEAU_RATIO * stds_by_order[:, -3]) & (
        stds_by_order[:, -1] > MIN_RELATIVE_NOISE * scale
    )
    std = np.where(is_noise, stds_by_order[:, -3:].mean(axis=1), stds_by_order.min(axis=1))
    return NoiseLevels(np.maximum(std, MIN_RELATIVE_NOISE * scale), is_noise, np.asarray(stds_by_order.any(axis=1)))


def _noise_stds_by_difference_order(component_values: list[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
    """Estimate the noise of a component from its divided differences of each order; return zeros if there are too
    few."""
    if sum(max(len(t) - DIFFERENCE_ORDERS[-1], 0) for t, _ in component_values) < MIN_DIFFERENCES:
        return np.zeros(len(DIFFERENCE_ORDERS))
    return np.array([_noise_std_from_differences(component_values, order) for order in DIFFERENCE_ORDERS])


def _noise_std_from_differences(component_values: list[tuple[np.ndarray, np.ndarray]], order: int) -> float:
    """Estimate the noise of a component from the median of its normalised divided differences of one order."""
    differences = []
    for t, y in component_values:
        if len(t) <= order:
            continue
        times = np.lib.stride_tricks.sliding_window_view(t, order + 1)
        times = (times - times[:, :1]) / (times[:, -1:] - times[:, :1])
        gaps = times[:, :, None] - times[:, None, :] + np.eye(order + 1)
        weights = 1.0 / np.prod(gaps, axis=2)
        weights /= np.linalg.norm(weights, axis=1, keepdims=True)
        differences.append(np.sum(weights * np.lib.stride_tricks.sliding_window_view(y, order + 1), axis=1))
    return float(np.median(np.abs(np.concatenate(differences)))) / MEDIAN_ABS_NORMAL


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
        Observations at the start and at the ends of the intervals, NaN where one is missing.
    times : array, shape (windows, m + 1)
        Times of the observations.
    next_window : array of int, shape (windows,)
        Index of the window that starts where this one ends; -1 if there is none.
    first_windows : array of int, shape (trajectories,)
        Index of the first window of each trajectory.
    """

    initial_states: np.ndarray
    intervals: np.ndarray
    observations: np.ndarray
    times: np.ndarray
    next_window: np.ndarray
    first_windows: np.ndarray


def cut_windows(
    trajectories: list[Trajectory], states: list[np.ndarray], n_intervals: int, is_disjoint: bool
) -> Windows:
    """Cut trajectories into windows of ``n_intervals`` time intervals: disjoint windows, or one from each time."""
    n_intervals = min(n_intervals, *(len(t) - 1 for t, _ in trajectories))
    initial_states, intervals, observations, times = [], [], [], []
    next_window: list[int] = []
    first_windows = []
    for (t, x), trajectory_states in zip(trajectories, states, strict=True):
        last_start = len(t) - 1 - n_intervals
        window_starts = list(range(0, last_start + 1, n_intervals if is_disjoint else 1))
        if window_starts[-1] != last_start:
            window_starts.append(last_start)
        first_windows.append(len(next_window))
        for i in window_starts:
            has_next = is_disjoint and i + n_intervals in window_starts
            initial_states.append(trajectory_states[i])
            intervals.append(np.diff(t[i : i + n_intervals + 1]))
            observations.append(x[i : i + n_intervals + 1])
            times.append(t[i : i + n_intervals + 1])
            next_window.append(len(next_window) + 1 if has_next else -1)
    return Windows(
        np.stack(initial_states),
        np.stack(intervals),
        np.stack(observations),
        np.stack(times),
        np.array(next_window),
        np.array(first_windows),
    )
