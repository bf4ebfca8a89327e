"""Least squares for few parameters from a guess: horizons that grow, weights from residuals, and steps short enough."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from manifolds.errors import warn

from ..integrators import OneStepMethod
from .data import NoiseLevels, Trajectory
from .losses import ParameterVector
from .observation import Observation
from .refining import (
    EXACT_RTOL,
    LeastSquaresResult,
    PaddedRuns,
    RunModel,
    TrajectorySegment,
    pad_runs,
    refine_by_least_squares,
    segments_of_whole_trajectories,
)
from .training import FitWarning

FIRST_HORIZON = 1.0
"""Length of the first runs, in times in which the fastest observation changes by its spread: a sixth of a period of a
sine."""

MIN_HORIZON_INTERVALS = 4
"""Smallest number of intervals of a run."""

HORIZON_GROWTH = 4
"""Ratio of the lengths of runs of two stages: a fit to short runs is accurate enough for runs longer by this ratio."""

STAGE_TOLERANCE = 0.3
"""Newton step of the parameters, in standard errors, at which a stage ends; the next one corrects the rest."""

STAGE_ITERATIONS = 12
"""Largest number of iterations of a stage."""

MAX_WEIGHT_RATIO = 1.1
"""Ratio of the residuals of an observed number to the noise that its weight assumes, above which it is weighted
again."""

MAX_REWEIGHTINGS = 4
"""Largest number of times that observed numbers get new weights."""

MAX_STEP_BIAS = 0.1
"""Largest change of a parameter, in standard errors, when the steps are halved."""

MIN_RELATIVE_BIAS = 1e-6
"""Relative change of all parameters below which the steps are short enough, whatever the standard errors are."""

MAX_AUTOMATIC_SUBSTEPS = 32
"""Largest number of steps between two data that a fit chooses."""


class LeastSquaresFit(NamedTuple):
    """The result of a least-squares fit, with the estimate of the noise.

    Attributes
    ----------
    result : LeastSquaresResult
        Its residual is relative to the noise that differences of the data show.
    noise : array, shape (k,), or None
        Standard deviations by which the observations were weighted.
    """

    result: LeastSquaresResult
    noise: np.ndarray | None


class LeastSquaresProblem(NamedTuple):
    """A least-squares problem: parameters, method, observations and data.

    Attributes
    ----------
    params : ParameterVector
    method : OneStepMethod
    observation : Observation
    training, held_out : list of (Trajectory, array)
        Trajectories with a guess of their states, shape (m, N).
    units_for_noise : function from standard deviations, shape (k,), or None, to the units of observations and of the
    search time_scale : float
        Time in which the fastest observation changes by its spread.
    """

    params: ParameterVector
    method: OneStepMethod
    observation: Observation
    training: list[tuple[Trajectory, np.ndarray]]
    held_out: list[tuple[Trajectory, np.ndarray]]
    units_for_noise: Callable[[np.ndarray | None], tuple[np.ndarray, np.ndarray]]
    time_scale: float


def fit_by_least_squares(
    problem: LeastSquaresProblem, noise: np.ndarray | None, noise_levels: NoiseLevels | None, substeps: int | None
) -> LeastSquaresFit:
    """Fit parameters to trajectories by multiple shooting and least squares; return a :class:`LeastSquaresFit`.

    Least squares over whole trajectories have many minima if the guess is off by more than half a period at their ends.
    So the first runs are short, each from its own initial state, and each stage has runs four times as long (multiple
    shooting). Unless the noise is given, each observed number gets the weight that its residuals have. Without
    ``substeps`` the steps are halved until the parameters change by less than a tenth of their standard errors.

    Parameters
    ----------
    noise : array, shape (k,), or None
        Standard deviations of the errors of the data, given or estimated from their differences.
    noise_levels : NoiseLevels, optional
        The noise that the differences of the data show, unless it is given.
    substeps : int, optional
        Steps between two data.
    """
    n_substeps = 1 if substeps is None else substeps
    model = RunModel(problem.params, problem.method, problem.observation)
    data = [*problem.training, *problem.held_out]
    runs = pad_runs([trajectory for trajectory, _ in data], [states for _, states in data])
    is_held_out = np.arange(len(data)) >= len(problem.training)
    weights, units = np.asarray(problem.params.initial_values), problem.units_for_noise(noise)

    n_iterations = 0

    def refine(weights, states, segments, units, n_substeps: int, **limits) -> LeastSquaresResult:
        nonlocal n_iterations
        result = refine_by_least_squares(
            model, weights, runs._replace(states=states), segments, is_held_out, units, n_substeps, **limits
        )
        n_iterations += result.iterations
        return result

    states, whole_runs = runs.states, segments_of_whole_trajectories(runs)
    for length in _run_lengths_by_stage([trajectory for trajectory, _ in data], problem.time_scale):
        limits = {"tolerance": STAGE_TOLERANCE, "max_iterations": STAGE_ITERATIONS}
        result = refine(weights, states, _split_into_segments(runs, length), units, n_substeps, **limits)
        if np.isfinite(result.residual):
            weights, states = result.weights, result.states
    result = refine(weights, states, whole_runs, units, n_substeps)
    while substeps is None and np.isfinite(result.residual):
        n_substeps *= 2
        finer_result = refine(result.weights, result.states, whole_runs, units, n_substeps)
        is_converged = not np.isfinite(finer_result.residual) or _is_negligible_change(
            finer_result.weights - result.weights, finer_result, problem.params.is_log
        )
        result = finer_result if np.isfinite(finer_result.residual) else result
        if is_converged:
            break
        if n_substeps >= MAX_AUTOMATIC_SUBSTEPS:
            warn(
                f"the parameters still change when the steps are halved, with {n_substeps} steps between two data. "
                f"Give substeps={4 * n_substeps}, or a method= of higher order",
                FitWarning,
            )
            break
    n_observed = np.maximum(runs.is_observed.sum(axis=(0, 1)), 1)
    rms_observations = np.sqrt((runs.observations**2).sum(axis=(0, 1)) / n_observed)
    for _ in range(0 if noise_levels is None else MAX_REWEIGHTINGS):
        new_noise = units[0] * np.sqrt(result.residual_variances)
        if not (new_noise > EXACT_RTOL * rms_observations).all():  # NaN too
            break
        ratio = new_noise / units[0]
        if noise is not None and (np.maximum(ratio, 1.0 / ratio) < MAX_WEIGHT_RATIO).all():
            break
        noise, units = new_noise, problem.units_for_noise(new_noise)
        result = refine(result.weights, result.states, whole_runs, units, n_substeps)
    if noise_levels is not None and noise is not None:
        result = result._replace(residual=_rms_ratio_to_estimated_noise(noise, noise_levels, n_observed))
    return LeastSquaresFit(result._replace(iterations=n_iterations), noise)


def _run_lengths_by_stage(trajectories: list[Trajectory], time_scale: float) -> list[int]:
    """Return the length of the runs, in data intervals, in each stage before the last, which has whole trajectories."""
    max_intervals = max(len(t) - 1 for t, _ in trajectories)
    interval = float(np.median(np.concatenate([np.diff(t) for t, _ in trajectories])))
    length = max(MIN_HORIZON_INTERVALS, round(FIRST_HORIZON * time_scale / interval))
    lengths = []
    while 2 * length <= max_intervals:
        lengths.append(length)
        length *= HORIZON_GROWTH
    return lengths


def _split_into_segments(runs: PaddedRuns, n_times_per_segment: int) -> list[TrajectorySegment]:
    """Cut all trajectories into segments of ``n_times_per_segment`` times; less than half a segment extends the one
    before."""
    segments = []
    for i, is_observed in enumerate(runs.is_observed):
        n_times = 1 + int(np.flatnonzero(is_observed.any(axis=1))[-1])
        starts = list(range(0, n_times, n_times_per_segment))
        if len(starts) > 1 and n_times - starts[-1] < n_times_per_segment / 2:
            starts.pop()
        segments += [TrajectorySegment(i, start, stop) for start, stop in itertools.pairwise([*starts, n_times])]
    return segments


def _rms_ratio_to_estimated_noise(
    residual_stds: np.ndarray, noise_levels: NoiseLevels, n_observed: np.ndarray
) -> float:
    """Return the root mean square of the ratios of residual to estimated noise; 1 if there is no estimate.

    Where the differences show no noise but bound it, residuals below the bound count as noise.
    """
    ratio = residual_stds / noise_levels.std
    ratio = np.where(noise_levels.is_noise, ratio, np.maximum(ratio, 1.0))
    if not noise_levels.is_bound.any():
        return 1.0
    return float(np.sqrt(np.average(ratio**2, weights=n_observed * noise_levels.is_bound)))


def _is_negligible_change(parameter_change: np.ndarray, result: LeastSquaresResult, is_log: np.ndarray) -> bool:
    """Return True if a change of the parameters is small compared with their standard errors or their values."""
    with np.errstate(invalid="ignore"):
        errors = np.sqrt(np.diag(result.covariance))
    is_small_by_error = ~(np.abs(parameter_change) > MAX_STEP_BIAS * errors)  # an infinite error allows any change
    parameter_scale = np.where(is_log, 1.0, np.abs(result.weights))
    return bool((is_small_by_error | (np.abs(parameter_change) <= MIN_RELATIVE_BIAS * parameter_scale)).all())
