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
    Piece,
    RunModel,
    pad_runs,
    refine_by_least_squares,
    whole_trajectories,
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
    """The result of least squares with the noise that they found.

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
    units_for : function from standard deviations, shape (k,), or None, to the units of observations and of the search
    time_scale : float
        Time in which the fastest observation changes by its spread.
    """

    params: ParameterVector
    method: OneStepMethod
    observation: Observation
    training: list[tuple[Trajectory, np.ndarray]]
    held_out: list[tuple[Trajectory, np.ndarray]]
    units_for: Callable[[np.ndarray | None], tuple[np.ndarray, np.ndarray]]
    time_scale: float


def fit_by_least_squares(
    problem: LeastSquaresProblem, noise: np.ndarray | None, levels: NoiseLevels | None, substeps: int | None
) -> LeastSquaresFit:
    """Fit parameters to trajectories from their initial values, without a descent before.

    Least squares over whole trajectories have many minima if the guess is off by more than half a period at their ends.
    So the first runs are short, each from its own initial state, and each stage has runs four times as long (multiple
    shooting). Unless the noise is given, each observed number gets the weight that its residuals have. Without
    ``substeps`` the steps are halved until the parameters change by less than a tenth of their standard errors.

    Parameters
    ----------
    noise : array, shape (k,), or None
        Standard deviations of the errors of the data, given or estimated from their differences.
    levels : NoiseLevels, optional
        The noise that the differences of the data show, unless it is given.
    substeps : int, optional
        Steps between two data.
    """
    n_substeps = 1 if substeps is None else substeps
    model = RunModel(problem.params, problem.method, problem.observation)
    data = [*problem.training, *problem.held_out]
    runs = pad_runs([trajectory for trajectory, _ in data], [states for _, states in data])
    is_held_out = np.arange(len(data)) >= len(problem.training)
    weights, units = np.asarray(problem.params.initial_values), problem.units_for(noise)

    n_iterations = 0

    def refine(weights, states, pieces, units, n_substeps: int, **limits) -> LeastSquaresResult:
        nonlocal n_iterations
        result = refine_by_least_squares(
            model, weights, runs._replace(states=states), pieces, is_held_out, units, n_substeps, **limits
        )
        n_iterations += result.iterations
        return result

    states, whole_runs = runs.states, whole_trajectories(runs)
    for length in _horizons([trajectory for trajectory, _ in data], problem.time_scale):
        limits = {"tolerance": STAGE_TOLERANCE, "max_iterations": STAGE_ITERATIONS}
        result = refine(weights, states, _pieces_of_length(runs, length), units, n_substeps, **limits)
        if np.isfinite(result.residual):
            weights, states = result.weights, result.states
    result = refine(weights, states, whole_runs, units, n_substeps)
    while substeps is None and np.isfinite(result.residual):
        n_substeps *= 2
        finer = refine(result.weights, result.states, whole_runs, units, n_substeps)
        is_enough = not np.isfinite(finer.residual) or _is_negligible(
            finer.weights - result.weights, finer, problem.params.is_log
        )
        result = finer if np.isfinite(finer.residual) else result
        if is_enough:
            break
        if n_substeps >= MAX_AUTOMATIC_SUBSTEPS:
            warn(
                f"the parameters still change when the steps are halved, with {n_substeps} steps between two data. "
                f"Give substeps={4 * n_substeps}, or a method= of higher order",
                FitWarning,
            )
            break
    n_observed = np.maximum(runs.is_observed.sum(axis=(0, 1)), 1)
    data_size = np.sqrt((runs.observations**2).sum(axis=(0, 1)) / n_observed)
    for _ in range(0 if levels is None else MAX_REWEIGHTINGS):
        new_noise = units[0] * np.sqrt(result.mean_squares)
        if not (new_noise > EXACT_RTOL * data_size).all():  # NaN too
            break
        ratio = new_noise / units[0]
        if noise is not None and (np.maximum(ratio, 1.0 / ratio) < MAX_WEIGHT_RATIO).all():
            break
        noise, units = new_noise, problem.units_for(new_noise)
        result = refine(result.weights, result.states, whole_runs, units, n_substeps)
    if levels is not None and noise is not None:
        result = result._replace(residual=_rms_residual_over_noise(noise, levels, n_observed))
    return LeastSquaresFit(result._replace(iterations=n_iterations), noise)


def _horizons(trajectories: list[Trajectory], time_scale: float) -> list[int]:
    """Return the numbers of intervals of the runs of all stages but the last, whose runs are whole trajectories."""
    max_intervals = max(len(t) - 1 for t, _ in trajectories)
    interval = float(np.median(np.concatenate([np.diff(t) for t, _ in trajectories])))
    length = max(MIN_HORIZON_INTERVALS, round(FIRST_HORIZON * time_scale / interval))
    lengths = []
    while 2 * length <= max_intervals:
        lengths.append(length)
        length *= HORIZON_GROWTH
    return lengths


def _pieces_of_length(runs: PaddedRuns, length: int) -> list[Piece]:
    """Return pieces of ``length`` times of all trajectories; a rest shorter than half of it belongs to the last one."""
    pieces = []
    for i, is_observed in enumerate(runs.is_observed):
        n_times = 1 + int(np.flatnonzero(is_observed.any(axis=1))[-1])
        starts = list(range(0, n_times, length))
        if len(starts) > 1 and n_times - starts[-1] < length / 2:
            starts.pop()
        pieces += [Piece(i, start, stop) for start, stop in itertools.pairwise([*starts, n_times])]
    return pieces


def _rms_residual_over_noise(residuals: np.ndarray, levels: NoiseLevels, counts: np.ndarray) -> float:
    """Return the root mean square of residuals over the noise estimated from the data; 1 if there is no estimate.

    Where the differences show no noise but bound it, residuals below the bound count as noise.
    """
    ratio = residuals / levels.std
    ratio = np.where(levels.is_noise, ratio, np.maximum(ratio, 1.0))
    if not levels.is_bound.any():
        return 1.0
    return float(np.sqrt(np.average(ratio**2, weights=counts * levels.is_bound)))


def _is_negligible(shift: np.ndarray, result: LeastSquaresResult, is_log: np.ndarray) -> bool:
    """Return True if a change of the parameters is small by their standard errors, or by their size."""
    with np.errstate(invalid="ignore"):
        errors = np.sqrt(np.diag(result.covariance))
    is_small_by_error = ~(np.abs(shift) > MAX_STEP_BIAS * errors)  # an infinite error allows any change
    size = np.where(is_log, 1.0, np.abs(result.weights))
    return bool((is_small_by_error | (np.abs(shift) <= MIN_RELATIVE_BIAS * size)).all())
