"""Least-squares refinement of a fit with few parameters, over whole trajectories; it also gives standard errors."""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ..integrators import OneStepMethod
from .compile_options import fast_compile_options
from .data import Trajectory
from .losses import ParameterVector, differentiable_stepper
from .networks import Perceptron
from .observation import Observation, n_displacement_coordinates

MAX_PARAMETERS = 64
"""Largest number of learned parameters for a refinement; its cost grows with their number."""

MAX_COLUMN_STEPS = 2e7
"""Largest number of steps of all trajectories times columns of the Jacobian, for a refinement."""

MAX_ITERATIONS = 60
"""Largest number of Levenberg-Marquardt iterations."""

NEWTON_STEP_TOLERANCE = 1e-2
"""Newton step of the learned parameters, in standard errors, below which the iteration has converged."""

SCHUR_RTOL = 1e-12
"""Eigenvalue of the normal matrix, scaled to a unit diagonal, below which a combination is undetermined."""

INITIAL_STATE_PRIOR = 1e-4
"""Weight of a prior on initial states, in units of the search and of the variance of the residuals: a displacement by a
hundred units counts as one standard deviation. Without it, components on which the data hardly depend, such as an
unobserved entropy, would move without bounds. It acts on steps and errors, not on the position of the minimum."""

MAX_LOG_STEP = 2.0
"""Largest change of the logarithm of a parameter in one iteration."""

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
    initial_states : array, shape (B, N)
        Initial states of the runs.
    intervals : array, shape (B, m)
        Time intervals; after the end of a trajectory its last interval is repeated.
    observations : array, shape (B, m + 1, k)
        Observations, zeros after the end.
    is_observed : array of bool, shape (B, m + 1)
    """

    initial_states: jax.Array
    intervals: jax.Array
    observations: jax.Array
    is_observed: jax.Array


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


def can_refine(params: ParameterVector, system: Any, data: list[Trajectory], prepared_system, substeps: int) -> bool:
    """Return True if least squares over whole trajectories are affordable and the parameters can be determined.

    The weights of a perceptron are not determined by its function.
    """
    count = params.initial_values.size
    if any(map(_is_perceptron, jax.tree_util.tree_leaves(system, is_leaf=_is_perceptron))):
        return False
    steps = substeps * sum(len(t) - 1 for t, _ in data)
    return count <= MAX_PARAMETERS and steps * (count + n_displacement_coordinates(prepared_system)) <= MAX_COLUMN_STEPS


def _is_perceptron(part: Any) -> bool:
    return isinstance(part, Perceptron)


def pad_runs(data: list[Trajectory], initial_states: list[np.ndarray]) -> PaddedRuns:
    """Return trajectories and their initial states as arrays of one shape."""
    length = max(len(t) for t, _ in data)
    intervals, observations, is_observed = [], [], []
    for t, x in data:
        n_missing = length - len(t)
        intervals.append(np.append(np.diff(t), np.full(n_missing, t[-1] - t[-2])))
        observations.append(np.concatenate([x, np.zeros((n_missing, x.shape[1]))]))
        is_observed.append(np.arange(length) < len(t))
    arrays = np.stack(initial_states), np.stack(intervals), np.stack(observations), np.stack(is_observed)
    return PaddedRuns(*map(jnp.asarray, arrays))


def refine_by_least_squares(
    params: ParameterVector,
    weights: np.ndarray,
    method: OneStepMethod,
    runs: PaddedRuns,
    is_held_out: np.ndarray,
    observation: Observation,
    units: tuple[np.ndarray, np.ndarray],
    substeps: int,
) -> LeastSquaresResult:
    """Minimise the squared residuals of whole runs over the weights and the initial states.

    The method is Levenberg-Marquardt. Each initial state affects one run only, so the normal equations of the weights
    are a Schur complement. Initial states of held-out trajectories are fitted too, without effect on the weights.

    Parameters
    ----------
    weights : array, shape (p,)
        Initial weights.
    is_held_out : array of bool, shape (B,)
    units : two arrays, shapes (k,), (coordinates of a state,)
        Units of the observations, and of the search for initial states.
    """
    evaluate = _normal_equations(params, method, observation, units, substeps)
    displace_states = jax.jit(
        jax.vmap(lambda x, z: observation.displace(_prepared_system(params, method, substeps, observation), x, z))
    )
    search_unit, is_training = np.asarray(units[1]), ~np.asarray(is_held_out)
    p = len(weights)
    point = np.asarray(weights, dtype=np.float64), runs.initial_states
    squares, slopes, costs = map(np.asarray, evaluate(jnp.asarray(point[0]), point[1], *runs[1:]))
    if not np.isfinite(costs[is_training]).all():
        return _failed_result(weights)
    damping, converged, iterations = INITIAL_DAMPING, False, 0
    degrees_of_freedom = _degrees_of_freedom(
        np.asarray(runs.is_observed), runs.observations.shape[-1], squares[:, p:, p:], is_training, p
    )
    variance = costs[is_training].sum() / max(degrees_of_freedom, 1)
    while iterations < MAX_ITERATIONS and damping < MAX_DAMPING:
        squares_with_prior = _add_prior(squares, p, variance)
        schur, _ = _schur_complement(squares_with_prior, slopes, p, is_training)
        newton, _ = _gauss_newton_step(squares_with_prior, slopes, p, is_training, 0.0)
        newton_step_norm = np.sqrt(max(newton @ schur @ newton, 0.0) / variance) if variance > 0.0 else 0.0
        converged = bool(newton_step_norm <= NEWTON_STEP_TOLERANCE)
        if converged and iterations > 0:
            break
        iterations += 1
        step, displacements = _gauss_newton_step(squares_with_prior, slopes, p, is_training, damping)
        log_step_ratio = np.abs(step[params.is_log]).max(initial=0.0) / MAX_LOG_STEP
        step, displacements = step / max(log_step_ratio, 1.0), displacements / max(log_step_ratio, 1.0)
        new_point = point[0] + step, displace_states(point[1], jnp.asarray(displacements * search_unit))
        new_equations = tuple(map(np.asarray, evaluate(jnp.asarray(new_point[0]), new_point[1], *runs[1:])))
        if (
            np.isfinite(new_equations[2][is_training]).all()
            and new_equations[2][is_training].sum() <= costs[is_training].sum()
        ):
            is_invalid = (
                ~np.isfinite(new_equations[2]) & ~is_training
            )  # runs held out that leave the domain stay as they were
            new_point = new_point[0], jnp.where(is_invalid[:, None], point[1], new_point[1])
            point, (squares, slopes, costs) = new_point, new_equations
            variance = costs[is_training].sum() / max(degrees_of_freedom, 1)
            damping *= DAMPING_DECREASE
        elif converged:  # nothing but rounding is left
            break
        else:
            damping *= DAMPING_INCREASE
    schur, slope = _schur_complement(_add_prior(squares, p, variance), slopes, p, is_training)
    total = costs[is_training].sum()
    variance = total / degrees_of_freedom if degrees_of_freedom > 0 else np.nan
    inverse, _, condition = _inverse_rank_and_condition(schur)
    weight_diagonal = np.diag(squares[is_training].sum(axis=0))[:p]  # with the first states known
    without_prior, rank, _ = _inverse_rank_and_condition(
        _schur_complement(squares, slopes, p, is_training)[0], weight_diagonal
    )
    if rank < p:  # the prior alone determines the rest
        inverse, condition = np.where(np.isinf(without_prior), np.inf, inverse), np.inf
    held_out_residual = np.nan
    if not is_training.all() and np.isfinite(costs[~is_training]).all():
        held_out_freedom = _degrees_of_freedom(
            np.asarray(runs.is_observed), runs.observations.shape[-1], squares[:, p:, p:], ~is_training, 0
        )
        held_out_residual = np.sqrt(costs[~is_training].sum() / held_out_freedom) if held_out_freedom > 0 else np.nan
    gradient = 2.0 * float(np.linalg.norm(slope)) / total if total > 0.0 else 0.0
    with np.errstate(invalid="ignore"):
        covariance = inverse * variance
    return LeastSquaresResult(
        point[0],
        covariance,
        rank,
        condition,
        float(np.sqrt(variance)),
        float(held_out_residual),
        gradient,
        converged,
        iterations,
    )


def _failed_result(weights) -> LeastSquaresResult:
    nan = np.full((len(weights),) * 2, np.nan)
    return LeastSquaresResult(np.asarray(weights), nan, 0, np.nan, np.nan, np.nan, np.nan, False, 0)


def _prepared_system(params: ParameterVector, method: OneStepMethod, substeps: int, observation: Observation):
    return differentiable_stepper(
        params.build_system(jnp.asarray(params.initial_values)), method, substeps, observation.group is not None
    ).system


def _normal_equations(params: ParameterVector, method: OneStepMethod, observation: Observation, units, substeps: int):
    """Return a function from weights and runs to ``J^T J``, ``J^T r`` and ``r . r`` of each run, weights first."""
    data_unit, search_unit = map(jnp.asarray, units)
    p, c = params.initial_values.size, len(search_unit)

    def residuals(weights, z, start, intervals, observations, is_observed):
        run, begin, advance, state_of = differentiable_stepper(
            params.build_system(weights), method, substeps, observation.group is not None
        )

        def interval(carry, h):
            carry = advance(carry, h)
            return carry, state_of(carry)

        initial_state = observation.displace(run, start, z * search_unit)
        states = jnp.concatenate([initial_state[None], jax.lax.scan(interval, begin(initial_state), intervals)[1]])
        predictions = jax.vmap(lambda x: observation.observe(run, x))(states)
        return jnp.where(is_observed[:, None], (predictions - observations) / data_unit, 0.0).ravel()

    def normal_equations_of_run(weights, arrays):
        def displaced_residuals(v):
            return residuals(weights + v[:p], v[p:], *arrays)

        r, J = displaced_residuals(jnp.zeros(p + c)), jax.jacfwd(displaced_residuals)(jnp.zeros(p + c))
        return J.T @ J, J.T @ r, r @ r

    @functools.partial(jax.jit, compiler_options=fast_compile_options())
    def normal_equations_of_runs(weights, *arrays):
        return jax.lax.map(
            functools.partial(normal_equations_of_run, weights), arrays, batch_size=min(len(arrays[0]), 16)
        )

    return normal_equations_of_runs


def _add_prior(normal_matrices: np.ndarray, n_weights: int, variance: float) -> np.ndarray:
    prior = np.where(np.arange(normal_matrices.shape[-1]) < n_weights, 0.0, INITIAL_STATE_PRIOR * variance)
    return normal_matrices + np.diag(prior)


def _degrees_of_freedom(
    is_observed, n_observed: int, initial_state_normal_matrices, is_selected, n_weights: int
) -> int:
    """Return the number of observations minus the number of determined unknowns: weights, and parts of initial
    states."""
    n_determined = sum(
        int((np.linalg.eigvalsh(square) > INITIAL_STATE_PRIOR).sum())
        for square in initial_state_normal_matrices[is_selected]
    )
    return int(is_observed[is_selected].sum()) * n_observed - n_weights - n_determined


def _pseudo_inverse(normal_matrix: np.ndarray, damping: float = 0.0) -> np.ndarray:
    """Return the inverse of a normal matrix with damped diagonal, restricted to the combinations that it determines."""
    diagonal = np.diag(normal_matrix)
    scale = 1.0 / np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))
    scaled = normal_matrix * np.outer(scale, scale) + damping * np.eye(len(normal_matrix))
    return np.linalg.pinv(scaled, rcond=SCHUR_RTOL, hermitian=True) * np.outer(scale, scale)


def _schur_complement(
    normal_matrices, gradients, n_weights: int, is_training, damping: float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """Return the normal matrix and the gradient of the weights after eliminating the initial states of all runs."""
    matrix, slope = np.zeros((n_weights, n_weights)), np.zeros(n_weights)
    for S, g in zip(normal_matrices[is_training], gradients[is_training], strict=True):
        elimination = S[:n_weights, n_weights:] @ _pseudo_inverse(S[n_weights:, n_weights:], damping)
        matrix += S[:n_weights, :n_weights] - elimination @ S[n_weights:, :n_weights]
        slope += g[:n_weights] - elimination @ g[n_weights:]
    return 0.5 * (matrix + matrix.T), slope


def _gauss_newton_step(
    normal_matrices, gradients, n_weights: int, is_training, damping: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return the damped Gauss-Newton step of the weights, shape (p,), and of the initial states, shape (B, c)."""
    matrix, slope = _schur_complement(normal_matrices, gradients, n_weights, is_training, damping)
    step = -_pseudo_inverse(matrix, damping) @ slope
    displacements = [
        -_pseudo_inverse(S[n_weights:, n_weights:], damping) @ (g[n_weights:] + S[n_weights:, :n_weights] @ step)
        if np.isfinite(S).all()
        else 0.0 * g[n_weights:]
        for S, g in zip(normal_matrices, gradients, strict=True)
    ]
    return step, np.stack(displacements)


def _inverse_rank_and_condition(schur: np.ndarray, diagonal: np.ndarray | None = None) -> tuple[np.ndarray, int, float]:
    """Return the inverse of a normal matrix, infinite where singular, its rank, and the condition number of its root.

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
    scaled = vectors * scale[:, None]
    inverse = (scaled[:, is_determined] / values[is_determined]) @ scaled[:, is_determined].T
    is_undetermined = (np.abs(vectors[:, ~is_determined]) > 1e-6).any(axis=1)
    inverse[is_undetermined], inverse[:, is_undetermined] = np.inf, np.inf
    return inverse, rank, condition
