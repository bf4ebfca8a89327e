"""Least-squares refinement of a fit with few parameters, over whole trajectories; it also gives standard errors."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ..integrators import OneStepMethod
from .data import Trajectory
from .losses import ParameterVector, prepare_differentiable_stepper
from .observation import Observation, fast_compile_options, n_displacement_coordinates
from .parts import Perceptron

MAX_PARAMETERS = 64
"""Largest number of learned parameters for a refinement; its cost grows with their number."""

MAX_COLUMN_STEPS = 2e7
"""Largest number of steps of all trajectories times columns of the Jacobian, for a refinement."""

MAX_ITERATIONS = 60
"""Largest number of Levenberg-Marquardt iterations."""

NEWTON_STEP_TOLERANCE = 1e-2
"""Newton step of the learned parameters, in standard errors, below which the iteration has converged."""

EXACT_RTOL = 1e-7
"""Residual, relative to the data, below which the data count as described exactly: rounding in single precision."""

SCHUR_RTOL = 1e-12
"""Eigenvalue of the normal matrix, scaled to a unit diagonal, below which a combination is undetermined."""

INITIAL_STATE_PRIOR = 1e-4
"""Weight of a prior on initial states, in units of the search and of the variance of the residuals: a displacement by a
hundred units counts as one standard deviation. Without it, components on which the data hardly depend, such as an
unobserved entropy, would move without bounds. It acts on steps and errors, not on the position of the minimum."""

MAX_LOG_STEP = 2.0
"""Largest change of the logarithm of a parameter in one iteration."""

MAX_LOG_DECREASE = 25.0
"""Decrease of the logarithm of a parameter at which the iteration stops: the data want it to be zero or negative."""

INITIAL_DAMPING = 1e-3
"""Damping of the first iteration, relative to the diagonal of the normal matrix."""

DAMPING_DECREASE = 0.2
"""Factor of the damping after an accepted step."""

DAMPING_INCREASE = 10.0
"""Factor of the damping after a rejected step."""

MAX_DAMPING = 1e12
"""Damping at which the iteration stops without convergence."""


class PaddedRuns(NamedTuple):
    """Whole trajectories of different lengths, padded to arrays of one shape.

    Attributes
    ----------
    states : array, shape (B, m + 1, N)
        Guesses of the states at all times; a run starts from those at the starts of its segments.
    intervals : array, shape (B, m)
        Time intervals; after the end of a trajectory its last interval is repeated.
    observations : array, shape (B, m + 1, k)
        Observations, zeros where a value is missing and after the end.
    is_observed : array of bool, shape (B, m + 1, k)
    times : array, shape (B, m + 1)
    """

    states: np.ndarray
    intervals: np.ndarray
    observations: np.ndarray
    is_observed: np.ndarray
    times: np.ndarray


class TrajectorySegment(NamedTuple):
    """Consecutive times of a trajectory that are predicted by one run, from an initial state that is fitted.

    Attributes
    ----------
    trajectory_index : int
        Index of the trajectory.
    start, stop : int
        Index of the first time, and of the first time after the segment.
    """

    trajectory_index: int
    start: int
    stop: int


def segments_of_whole_trajectories(runs: PaddedRuns) -> list[TrajectorySegment]:
    """Return one segment for each trajectory, over all its times."""
    n_runs, n_times = runs.times.shape
    return [TrajectorySegment(i, 0, n_times) for i in range(n_runs)]


class LeastSquaresResult(NamedTuple):
    """Parameters at a least-squares minimum, with their covariance and the diagnostics of the fit.

    Attributes
    ----------
    weights : array, shape (p,)
    covariance : array, shape (p, p)
        Covariance of the weights, infinite where a combination is undetermined.
    rank : int
        Number of combinations of the weights that the data determine.
    condition : float
        Ratio of the largest to the smallest singular value of the Jacobian with unit columns, after the initial states
        have been eliminated.
    residual, held_out_residual : float
        Root mean square of the residuals by their degrees of freedom, in the units of the fit. For held-out
        trajectories only the initial states are fitted. NaN without data.
    gradient_norm : float
        Norm of the derivative of ln(loss) by the weights.
    converged : bool
    iterations : int
    degrees_of_freedom : int
        Number of observations minus the number of determined unknowns.
    states : array, shape (B, m + 1, N)
        The states of the runs, fitted at the starts of the segments.
    residual_variances : array, shape (k,)
        Mean square of the residuals of each observed number, by degrees of freedom, in the units of the fit.
    """

    weights: np.ndarray
    covariance: np.ndarray
    rank: int
    condition: float
    residual: float
    held_out_residual: float
    gradient_norm: float
    converged: bool
    iterations: int
    degrees_of_freedom: int
    states: np.ndarray
    residual_variances: np.ndarray


def can_refine_by_least_squares(
    params: ParameterVector, system: Any, trajectories: list[Trajectory], prepared_system, substeps: int
) -> bool:
    """Return True if a least-squares fit over whole trajectories is affordable and can determine the parameters.

    The weights of a perceptron are not determined by its function.
    """
    n_parameters = params.initial_values.size
    if any(map(_is_perceptron, jax.tree_util.tree_leaves(system, is_leaf=_is_perceptron))):
        return False
    steps = substeps * sum(len(t) - 1 for t, _ in trajectories)
    return (
        n_parameters <= MAX_PARAMETERS
        and steps * (n_parameters + n_displacement_coordinates(prepared_system)) <= MAX_COLUMN_STEPS
    )


def _is_perceptron(node: Any) -> bool:
    return isinstance(node, Perceptron)


def pad_runs(trajectories: list[Trajectory], states: list[np.ndarray]) -> PaddedRuns:
    """Pad trajectories, and guesses of their states, shape (m, N) each, to equal length; return them stacked."""
    length = max(len(t) for t, _ in trajectories)
    padded_arrays = []
    for (t, x), trajectory_states in zip(trajectories, states, strict=True):
        n_missing = length - len(t)
        intervals = np.append(np.diff(t), np.full(n_missing, t[-1] - t[-2]))
        padded_arrays.append(
            (
                np.concatenate([trajectory_states, np.repeat(trajectory_states[-1:], n_missing, axis=0)]),
                intervals,
                np.concatenate([np.nan_to_num(x), np.zeros((n_missing, x.shape[1]))]),
                np.concatenate([~np.isnan(x), np.zeros((n_missing, x.shape[1]), bool)]),
                np.concatenate([t, t[-1] + intervals[-1] * np.arange(1, n_missing + 1)]),
            )
        )
    return PaddedRuns(*map(np.stack, zip(*padded_arrays, strict=True)))


class RunModel:
    """Compiled model of a fit that predicts the observations of runs, with derivatives.

    Parameters
    ----------
    params : ParameterVector
    method : OneStepMethod
    observation : Observation
    """

    def __init__(self, params: ParameterVector, method: OneStepMethod, observation: Observation):
        self.params, self.method, self.observation = params, method, observation
        initial_weights = jnp.asarray(params.initial_values)
        system = self._differentiable_stepper(initial_weights, 1).system
        self.n_coordinates = n_displacement_coordinates(system)
        self._evaluate = jax.jit(self._predictions_and_derivatives, compiler_options=fast_compile_options())
        self._displace = jax.jit(
            jax.vmap(lambda x, z: observation.displace(self._differentiable_stepper(initial_weights, 1).system, x, z))
        )

    def _differentiable_stepper(self, weights, substeps):
        has_attitude = self.observation.group is not None
        return prepare_differentiable_stepper(self.params.build_system(weights), self.method, substeps, has_attitude)

    def displace(self, states: np.ndarray, displacements: np.ndarray) -> np.ndarray:
        """Return states displaced by tangent coordinates, both with one row for each state."""
        return np.asarray(self._displace(jnp.asarray(states), jnp.asarray(displacements)))

    def predict_with_derivatives(
        self,
        weights: np.ndarray,
        runs: PaddedRuns,
        states: np.ndarray,
        segments: list[TrajectorySegment],
        substeps: int,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Predict the observations of runs, shape (B, m + 1, k), and their derivatives, shape (B, m + 1, k, p + c).

        The derivatives are by the p weights, and by the c coordinates that displace the initial state of the segment.
        """
        is_start = np.zeros(runs.times.shape, bool)
        for segment in segments:
            is_start[segment.trajectory_index, segment.start] = True
        arrays = states, is_start, runs.intervals, runs.times
        values, derivatives = self._evaluate(jnp.asarray(weights), substeps, *map(jnp.asarray, arrays))
        return np.asarray(values), np.asarray(derivatives)

    def _predictions_of_run(self, weights, displacement, substeps, states, is_start, intervals, times):
        prepared_system, init, advance, get_state = self._differentiable_stepper(weights, substeps)
        values = self.params.parameters_of(weights)

        def next_carry(carry, inputs):
            h, state, starts_here, t = inputs
            restarted_carry = init(self.observation.displace(prepared_system, state, displacement))
            carry = jax.tree_util.tree_map(
                lambda a, b: jnp.where(starts_here, a, b), restarted_carry, advance(carry, h)
            )
            return carry, self.observation.observe(prepared_system, get_state(carry), t, values)

        initial_carry = init(self.observation.displace(prepared_system, states[0], displacement))
        initial_observation = self.observation.observe(prepared_system, get_state(initial_carry), times[0], values)
        inputs_per_time = intervals, states[1:], is_start[1:], times[1:]
        return jnp.concatenate([initial_observation[None], jax.lax.scan(next_carry, initial_carry, inputs_per_time)[1]])

    def _predictions_and_derivatives(self, weights, substeps, *arrays):
        p = weights.size

        def value_and_derivative(arrays):
            def predict_at_displacement(displacement):
                predictions = self._predictions_of_run(weights + displacement[:p], displacement[p:], substeps, *arrays)
                return predictions, predictions

            derivative, value = jax.jacfwd(predict_at_displacement, has_aux=True)(jnp.zeros(p + self.n_coordinates))
            return value, derivative

        return jax.lax.map(value_and_derivative, arrays, batch_size=min(len(arrays[0]), 16))


class NormalEquations(NamedTuple):
    """Normal equations of each segment, from its residuals r and their Jacobian J.

    Attributes
    ----------
    matrices : array, shape (segments, p + c, p + c)
        ``J^T J``; the p weights come before the c coordinates of the initial state.
    gradients : array, shape (segments, p + c)
        ``J^T r``.
    column_costs : array, shape (segments, k)
        Sum of the squared residuals of each observed component.
    """

    matrices: np.ndarray
    gradients: np.ndarray
    column_costs: np.ndarray

    @property
    def segment_costs(self) -> np.ndarray:
        """Sum of the squared residuals of each segment, shape (segments,)."""
        return self.column_costs.sum(axis=1)

    @property
    def is_finite(self) -> np.ndarray:
        """True for segments whose residuals and derivatives are finite, shape (segments,)."""
        return np.isfinite(self.segment_costs) & np.isfinite(self.matrices).all(axis=(1, 2))


def _normal_equations(
    predictions: np.ndarray, derivatives: np.ndarray, runs: PaddedRuns, segments: list[TrajectorySegment], units
) -> NormalEquations:
    """Return the normal equations of each segment from predictions, their derivatives and the observations."""
    data_unit, search_unit = units
    n_weights = derivatives.shape[-1] - len(search_unit)
    column_scale = np.append(np.ones(n_weights), search_unit)
    equations = []
    for i, start, stop in segments:
        is_observed = runs.is_observed[i, start:stop]
        time_slice = slice(start, stop)
        r = np.where(is_observed, (predictions[i, time_slice] - runs.observations[i, time_slice]) / data_unit, 0.0)
        J = np.where(is_observed[..., None], derivatives[i, time_slice] * column_scale / data_unit[:, None], 0.0)
        J = J.reshape(-1, len(column_scale))
        with np.errstate(invalid="ignore", over="ignore"):  # runs that leave the domain are refused by their costs
            equations.append((J.T @ J, J.T @ r.ravel(), np.sum(r**2, axis=0)))
    return NormalEquations(*map(np.stack, zip(*equations, strict=True)))


def refine_by_least_squares(
    model: RunModel,
    weights: np.ndarray,
    runs: PaddedRuns,
    segments: list[TrajectorySegment],
    is_held_out: np.ndarray,
    units: tuple[np.ndarray, np.ndarray],
    substeps: int,
    tolerance: float = NEWTON_STEP_TOLERANCE,
    max_iterations: int = MAX_ITERATIONS,
) -> LeastSquaresResult:
    """Minimise the squared residuals of runs over weights and initial states; return a :class:`LeastSquaresResult`.

    The method is Levenberg-Marquardt. Each initial state affects one segment only, so the normal equations of the
    weights are a Schur complement. Initial states of held-out trajectories are fitted too, without effect on the
    weights.

    Parameters
    ----------
    model : RunModel
    weights : array, shape (p,)
        Initial weights.
    runs : PaddedRuns
    segments : list of TrajectorySegment
        Parts of the trajectories that have separate initial states, such as :func:`segments_of_whole_trajectories`.
    is_held_out : array of bool, shape (B,)
    units : two arrays, shapes (k,), (coordinates of a state,)
        Units of the observations, and of the search for initial states.
    tolerance : float
        Newton step of the weights, in standard errors, below which the iteration has converged.
    """
    search_unit = np.asarray(units[1])
    trajectory_of_segment = np.array([segment.trajectory_index for segment in segments])
    starts = trajectory_of_segment, np.array([segment.start for segment in segments])
    is_training = ~np.asarray(is_held_out)[trajectory_of_segment]
    n_observations = np.array([runs.is_observed[i, start:stop].sum() for i, start, stop in segments])
    n_weights, is_log = len(weights), model.params.is_log

    def evaluate(weights, states) -> NormalEquations:
        return _normal_equations(
            *model.predict_with_derivatives(weights, runs, states, segments, substeps), runs, segments, units
        )

    weights, states = np.asarray(weights, dtype=np.float64), np.asarray(runs.states)
    initial_weights = model.params.initial_values
    equations = evaluate(weights, states)
    if not equations.is_finite[is_training].all():
        return _failed_result(weights, runs)
    damping, is_converged, iterations = INITIAL_DAMPING, False, 0
    degrees_of_freedom = _degrees_of_freedom(
        n_observations, equations.matrices[:, n_weights:, n_weights:], is_training, n_weights
    )
    variance = equations.segment_costs[is_training].sum() / max(degrees_of_freedom, 1)
    exact_variance = EXACT_RTOL**2 * np.mean((runs.observations / units[0]) ** 2)
    while iterations < max_iterations and damping < MAX_DAMPING:
        matrices_with_prior = _add_initial_state_prior(equations.matrices, n_weights, variance)
        schur, _ = _eliminate_initial_states(matrices_with_prior, equations.gradients, n_weights, is_training)
        newton = _gauss_newton_step(matrices_with_prior, equations.gradients, n_weights, is_training, 0.0)
        newton_step_norm = np.sqrt(max(newton @ schur @ newton, 0.0) / variance) if variance > 0.0 else 0.0
        is_converged = bool(newton_step_norm <= tolerance or variance <= exact_variance)
        vanishes = (initial_weights - weights)[is_log].max(initial=0.0) > MAX_LOG_DECREASE
        if (is_converged and iterations > 0) or vanishes:
            break
        iterations += 1
        step = _gauss_newton_step(matrices_with_prior, equations.gradients, n_weights, is_training, damping)
        step[is_log] = np.clip(step[is_log], -MAX_LOG_STEP, MAX_LOG_STEP)
        displacements = _initial_state_steps(matrices_with_prior, equations.gradients, step, damping)
        new_weights, new_states = weights + step, states.copy()
        new_states[starts] = model.displace(states[starts], displacements * search_unit)
        new_equations = evaluate(new_weights, new_states)
        new_costs, costs = new_equations.segment_costs, equations.segment_costs
        is_finite = new_equations.is_finite
        if is_finite[is_training].all() and new_costs[is_training].sum() <= costs[is_training].sum():
            is_invalid = ~is_finite & ~is_training  # runs held out that leave the domain stay as they were
            invalid_starts = tuple(index[is_invalid] for index in starts)
            new_states[invalid_starts] = states[invalid_starts]
            weights, states, equations = new_weights, new_states, new_equations
            variance = new_costs[is_training].sum() / max(degrees_of_freedom, 1)
            damping *= DAMPING_DECREASE
        elif is_converged:  # nothing but rounding is left
            break
        else:
            damping *= DAMPING_INCREASE
    matrices, gradients, costs = equations.matrices, equations.gradients, equations.segment_costs
    schur, slope = _eliminate_initial_states(
        _add_initial_state_prior(matrices, n_weights, variance), gradients, n_weights, is_training
    )
    total_cost = costs[is_training].sum()
    variance = total_cost / degrees_of_freedom if degrees_of_freedom > 0 else np.nan
    inverse, _, condition = _inverse_rank_and_condition(schur)
    weight_diagonal = np.diag(matrices[is_training].sum(axis=0))[:n_weights]  # with the first states known
    inverse_without_prior, rank, _ = _inverse_rank_and_condition(
        _eliminate_initial_states(matrices, gradients, n_weights, is_training)[0], weight_diagonal
    )
    if rank < n_weights:  # the prior alone determines the rest
        inverse, condition = np.where(np.isinf(inverse_without_prior), np.inf, inverse), np.inf
    held_out_residual = np.nan
    if not is_training.all() and equations.is_finite[~is_training].all():
        held_out_freedom = _degrees_of_freedom(n_observations, matrices[:, n_weights:, n_weights:], ~is_training, 0)
        held_out_residual = np.sqrt(costs[~is_training].sum() / held_out_freedom) if held_out_freedom > 0 else np.nan
    gradient = 2.0 * float(np.linalg.norm(slope)) / total_cost if total_cost > 0.0 else 0.0
    with np.errstate(invalid="ignore"):
        covariance = inverse * variance
    is_training_run = ~np.asarray(is_held_out)
    return LeastSquaresResult(
        weights,
        covariance,
        rank,
        condition,
        float(np.sqrt(variance)),
        float(held_out_residual),
        gradient,
        is_converged,
        iterations,
        degrees_of_freedom,
        states,
        _residual_variances(equations.column_costs[is_training], runs.is_observed[is_training_run], degrees_of_freedom),
    )


def _residual_variances(column_costs: np.ndarray, is_observed: np.ndarray, degrees_of_freedom: int) -> np.ndarray:
    """Return the residual variance of each observed component, with the degrees of freedom divided among them."""
    counts = is_observed.sum(axis=(0, 1))
    share = degrees_of_freedom / counts.sum() if degrees_of_freedom > 0 else np.nan
    return column_costs.sum(axis=0) / (np.maximum(counts, 1) * share)


def _failed_result(weights, runs: PaddedRuns) -> LeastSquaresResult:
    """Return a result that has not converged, with the initial weights and NaN for all estimates."""
    nan, start = np.full((len(weights),) * 2, np.nan), np.asarray(runs.states)
    nan_squares = np.full(runs.observations.shape[-1], np.nan)
    return LeastSquaresResult(
        np.asarray(weights), nan, 0, np.nan, np.nan, np.nan, np.nan, False, 0, 0, start, nan_squares
    )


def _add_initial_state_prior(normal_matrices: np.ndarray, n_weights: int, variance: float) -> np.ndarray:
    """Return normal matrices with a weak prior added to the diagonal entries of the initial states."""
    prior = np.where(np.arange(normal_matrices.shape[-1]) < n_weights, 0.0, INITIAL_STATE_PRIOR * variance)
    return normal_matrices + np.diag(prior)


def _degrees_of_freedom(n_observations, initial_state_normal_matrices, is_selected, n_weights: int) -> int:
    """Return the number of observations minus the number of unknowns: weights, and determined components of initial
    states."""
    n_determined = sum(
        int((np.linalg.eigvalsh(square) > INITIAL_STATE_PRIOR).sum())
        for square in initial_state_normal_matrices[is_selected]
    )
    return int(n_observations[is_selected].sum()) - n_weights - n_determined


def _pseudo_inverse(normal_matrix: np.ndarray, damping: float = 0.0) -> np.ndarray:
    """Return the pseudo-inverse of a scaled normal matrix with a damped diagonal."""
    diagonal = np.diag(normal_matrix)
    scale = 1.0 / np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))
    scaled_matrix = normal_matrix * np.outer(scale, scale) + damping * np.eye(len(normal_matrix))
    return np.linalg.pinv(scaled_matrix, rcond=SCHUR_RTOL, hermitian=True) * np.outer(scale, scale)


def _eliminate_initial_states(
    normal_matrices, gradients, n_weights: int, is_training, damping: float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """Eliminate the initial states from the normal equations; return the normal matrix and the gradient of the
    weights."""
    matrix, gradient = np.zeros((n_weights, n_weights)), np.zeros(n_weights)
    for S, g in zip(normal_matrices[is_training], gradients[is_training], strict=True):
        elimination = S[:n_weights, n_weights:] @ _pseudo_inverse(S[n_weights:, n_weights:], damping)
        matrix += S[:n_weights, :n_weights] - elimination @ S[n_weights:, :n_weights]
        gradient += g[:n_weights] - elimination @ g[n_weights:]
    return 0.5 * (matrix + matrix.T), gradient


def _gauss_newton_step(normal_matrices, gradients, n_weights: int, is_training, damping: float) -> np.ndarray:
    """Return the damped Gauss-Newton step of the weights, shape (p,)."""
    matrix, gradient = _eliminate_initial_states(normal_matrices, gradients, n_weights, is_training, damping)
    return -_pseudo_inverse(matrix, damping) @ gradient


def _initial_state_steps(normal_matrices, gradients, weight_step: np.ndarray, damping: float) -> np.ndarray:
    """Return the damped Gauss-Newton step of the initial states, shape (segments, c), for a given step of the
    weights."""
    p = len(weight_step)
    state_steps = [
        -_pseudo_inverse(S[p:, p:], damping) @ (g[p:] + S[p:, :p] @ weight_step)
        if np.isfinite(S).all()
        else 0.0 * g[p:]
        for S, g in zip(normal_matrices, gradients, strict=True)
    ]
    return np.stack(state_steps)


def _inverse_rank_and_condition(schur: np.ndarray, diagonal: np.ndarray | None = None) -> tuple[np.ndarray, int, float]:
    """Return the inverse of a normal matrix, infinite where it is singular, its rank, and the condition of the
    Jacobian.

    Parameters
    ----------
    schur : array, shape (p, p)
    diagonal : array, shape (p,), optional
        The diagonal before initial states were eliminated. If the initial states can replace a weight, its remaining
        entry is rounding. By default nothing was eliminated.
    """
    diagonal = np.diag(schur) if diagonal is None else diagonal
    scale = 1.0 / np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))
    values, vectors = np.linalg.eigh(schur * np.outer(scale, scale))
    is_determined = values > SCHUR_RTOL
    rank = int(is_determined.sum())
    condition = float(np.sqrt(values[-1] / values[0])) if rank == len(values) else np.inf
    scaled_vectors = vectors * scale[:, None]
    inverse = (scaled_vectors[:, is_determined] / values[is_determined]) @ scaled_vectors[:, is_determined].T
    is_undetermined = (np.abs(vectors[:, ~is_determined]) > 1e-6).any(axis=1)
    inverse[is_undetermined], inverse[:, is_undetermined] = np.inf, np.inf
    return inverse, rank, condition
