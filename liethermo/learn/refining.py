"""The last part of a fit of few numbers: least squares over whole trajectories, which also gives standard errors."""

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
from .observation import Observation, n_coordinates

MAX_PARAMETERS = 64
"""Learned numbers up to which a fit is refined: the cost grows with their number."""

MAX_COLUMN_STEPS = 2e7
"""Steps of all trajectories times columns of the Jacobian, up to which a fit is refined."""

MAX_ITERATIONS = 60
"""Iterations of Levenberg and Marquardt."""

NEWTON_STEP_TOLERANCE = 1e-2
"""Newton step of the learned numbers, in standard errors, below which the iteration has converged."""

SCHUR_RTOL = 1e-12
"""Eigenvalues of the normal matrix, scaled to a diagonal of ones, below which a combination is not determined."""

INITIAL_STATE_PRIOR = 1e-4
"""Weight of a first state staying where it is, in units of the search and of the variance of the residuals: a move by
a hundred units counts as one standard deviation. What the data hardly depend on, as an entropy that is not observed,
would move without bounds. It acts on steps and errors, not on where the minimum is."""

MAX_LOG_STEP = 2.0
"""Largest change of the logarithm of a number in one iteration."""

INITIAL_DAMPING, DAMPING_DECREASE, DAMPING_INCREASE, MAX_DAMPING = 1e-3, 0.2, 10.0, 1e12
"""Damping at first, its factors after a step that is taken and one that is not, and where the iteration gives up."""


class PaddedRuns(NamedTuple):
    """Whole trajectories of any lengths, as arrays of one shape.

    Attributes
    ----------
    initial_states : array, shape (B, N)
        First states of the runs.
    intervals : array, shape (B, m)
        Intervals; behind the end of a trajectory the last one is repeated.
    observations : array, shape (B, m + 1, k)
        What was observed, zeros behind the end.
    is_observed : array of bool, shape (B, m + 1)
    """

    initial_states: jax.Array
    intervals: jax.Array
    observations: jax.Array
    is_observed: jax.Array


class LeastSquaresResult(NamedTuple):
    """Learned numbers at a least-squares minimum, and what the data say of them.

    Attributes
    ----------
    weights : array, shape (p,)
    covariance : array, shape (p, p)
        Of the weights, infinite where a combination is not determined.
    rank : int
        Number of combinations of the weights that the data determine.
    condition : float
        Ratio of the largest to the smallest singular value of the Jacobian with columns of norm one, after the first
        states have been eliminated.
    residual, held_out_residual : float
        Root mean square of the residuals by their degrees of freedom, in the units of the fit; of the trajectories held
        out only the first states are found. NaN where there are none.
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


def can_refine(own: ParameterVector, system: Any, data: list[Trajectory], run, substeps: int) -> bool:
    """Return whether least squares over whole trajectories are affordable, and make sense of the numbers learned.

    The weights of a perceptron are not determined by the function that it is.
    """
    count = own.initial_values.size
    if any(map(_is_perceptron, jax.tree_util.tree_leaves(system, is_leaf=_is_perceptron))):
        return False
    steps = substeps * sum(len(t) - 1 for t, _ in data)
    return count <= MAX_PARAMETERS and steps * (count + n_coordinates(run)) <= MAX_COLUMN_STEPS


def _is_perceptron(part: Any) -> bool:
    return isinstance(part, Perceptron)


def pad_runs(data: list[Trajectory], starts: list[np.ndarray]) -> PaddedRuns:
    """Return trajectories and their first states as arrays of one shape."""
    length = max(len(t) for t, _ in data)
    sizes, shown, is_observed = [], [], []
    for t, x in data:
        missing = length - len(t)
        sizes.append(np.append(np.diff(t), np.full(missing, t[-1] - t[-2])))
        shown.append(np.concatenate([x, np.zeros((missing, x.shape[1]))]))
        is_observed.append(np.arange(length) < len(t))
    arrays = np.stack(starts), np.stack(sizes), np.stack(shown), np.stack(is_observed)
    return PaddedRuns(*map(jnp.asarray, arrays))


def refine_by_least_squares(
    own: ParameterVector,
    weights: np.ndarray,
    method: OneStepMethod,
    runs: PaddedRuns,
    is_held_out: np.ndarray,
    seen: Observation,
    units: tuple[np.ndarray, np.ndarray],
    substeps: int,
) -> LeastSquaresResult:
    """Minimise the squares of what whole runs miss of the data, over the weights and the first states.

    Levenberg and Marquardt's method. Each first state moves one run alone, so the normal equations of the weights are
    a Schur complement. The first states of trajectories that are held out are found with it; the weights do not see
    those.

    Parameters
    ----------
    weights : array, shape (p,)
        Where the iteration begins.
    is_held_out : array of bool, shape (B,)
    units : two arrays, shapes (k,), (coordinates of a state,)
        Of what is observed, and of the search for first states.
    """
    evaluate = _normal_equations(own, method, seen, units, substeps)
    moved = jax.jit(jax.vmap(lambda x, z: seen.displace(_run_system(own, method, substeps, seen), x, z)))
    of_search, taken = np.asarray(units[1]), ~np.asarray(is_held_out)
    p = len(weights)
    point = np.asarray(weights, dtype=np.float64), runs.initial_states
    squares, slopes, costs = map(np.asarray, evaluate(jnp.asarray(point[0]), point[1], *runs[1:]))
    if not np.isfinite(costs[taken]).all():
        return _failed_result(weights)
    damping, converged, iterations = INITIAL_DAMPING, False, 0
    freedom = _degrees_of_freedom(
        np.asarray(runs.is_observed), runs.observations.shape[-1], squares[:, p:, p:], taken, p
    )
    variance = costs[taken].sum() / max(freedom, 1)
    while iterations < MAX_ITERATIONS and damping < MAX_DAMPING:
        damped = _add_prior(squares, p, variance)
        schur, _ = _schur_complement(damped, slopes, p, taken)
        newton, _ = _gauss_newton_step(damped, slopes, p, taken, 0.0)
        size = np.sqrt(max(newton @ schur @ newton, 0.0) / variance) if variance > 0.0 else 0.0
        converged = bool(size <= NEWTON_STEP_TOLERANCE)
        if converged and iterations > 0:
            break
        iterations += 1
        step, moves = _gauss_newton_step(damped, slopes, p, taken, damping)
        longest = np.abs(step[own.is_log]).max(initial=0.0) / MAX_LOG_STEP
        step, moves = step / max(longest, 1.0), moves / max(longest, 1.0)
        new = point[0] + step, moved(point[1], jnp.asarray(moves * of_search))
        found = tuple(map(np.asarray, evaluate(jnp.asarray(new[0]), new[1], *runs[1:])))
        if np.isfinite(found[2][taken]).all() and found[2][taken].sum() <= costs[taken].sum():
            worse = ~np.isfinite(found[2]) & ~taken  # runs held out that leave the domain stay as they were
            new = new[0], jnp.where(worse[:, None], point[1], new[1])
            point, (squares, slopes, costs) = new, found
            variance = costs[taken].sum() / max(freedom, 1)
            damping *= DAMPING_DECREASE
        elif converged:  # nothing but rounding is left
            break
        else:
            damping *= DAMPING_INCREASE
    schur, slope = _schur_complement(_add_prior(squares, p, variance), slopes, p, taken)
    total = costs[taken].sum()
    variance = total / freedom if freedom > 0 else np.nan
    inverse, _, condition = _inverse_rank_condition(schur)
    of_weights = np.diag(squares[taken].sum(axis=0))[:p]  # with the first states known
    without_prior, rank, _ = _inverse_rank_condition(_schur_complement(squares, slopes, p, taken)[0], of_weights)
    if rank < p:  # the prior alone determines the rest
        inverse, condition = np.where(np.isinf(without_prior), np.inf, inverse), np.inf
    held = np.nan
    if not taken.all() and np.isfinite(costs[~taken]).all():
        behind = _degrees_of_freedom(
            np.asarray(runs.is_observed), runs.observations.shape[-1], squares[:, p:, p:], ~taken, 0
        )
        held = np.sqrt(costs[~taken].sum() / behind) if behind > 0 else np.nan
    gradient = 2.0 * float(np.linalg.norm(slope)) / total if total > 0.0 else 0.0
    with np.errstate(invalid="ignore"):
        covariance = inverse * variance
    return LeastSquaresResult(
        point[0], covariance, rank, condition, float(np.sqrt(variance)), float(held), gradient, converged, iterations
    )


def _failed_result(weights) -> LeastSquaresResult:
    nan = np.full((len(weights),) * 2, np.nan)
    return LeastSquaresResult(np.asarray(weights), nan, 0, np.nan, np.nan, np.nan, np.nan, False, 0)


def _run_system(own: ParameterVector, method: OneStepMethod, substeps: int, seen: Observation):
    return differentiable_stepper(
        own.build_system(jnp.asarray(own.initial_values)), method, substeps, seen.group is not None
    )[0]


def _normal_equations(own: ParameterVector, method: OneStepMethod, seen: Observation, units, substeps: int):
    """Return a function of weights and runs to ``J^T J``, ``J^T r`` and ``r . r`` of each run, weights first."""
    of_data, of_search = map(jnp.asarray, units)
    p, c = own.initial_values.size, len(of_search)

    def residuals(weights, z, start, sizes, shown, is_observed):
        run, begin, advance, state_of = differentiable_stepper(
            own.build_system(weights), method, substeps, seen.group is not None
        )

        def interval(carry, h):
            carry = advance(carry, h)
            return carry, state_of(carry)

        first = seen.displace(run, start, z * of_search)
        states = jnp.concatenate([first[None], jax.lax.scan(interval, begin(first), sizes)[1]])
        found = jax.vmap(lambda x: seen.observe(run, x))(states)
        return jnp.where(is_observed[:, None], (found - shown) / of_data, 0.0).ravel()

    def run_equations(weights, arrays):
        def displaced_residuals(v):
            return residuals(weights + v[:p], v[p:], *arrays)

        r, J = displaced_residuals(jnp.zeros(p + c)), jax.jacfwd(displaced_residuals)(jnp.zeros(p + c))
        return J.T @ J, J.T @ r, r @ r

    @functools.partial(jax.jit, compiler_options=fast_compile_options())
    def all_equations(weights, *arrays):
        return jax.lax.map(functools.partial(run_equations, weights), arrays, batch_size=min(len(arrays[0]), 16))

    return all_equations


def _add_prior(squares: np.ndarray, p: int, variance: float) -> np.ndarray:
    prior = np.where(np.arange(squares.shape[-1]) < p, 0.0, INITIAL_STATE_PRIOR * variance)
    return squares + np.diag(prior)


def _degrees_of_freedom(is_observed, k: int, by_starts, chosen, p: int) -> int:
    """Return the numbers observed less those that are found: the weights, and what is seen of the first states."""
    seen = sum(int((np.linalg.eigvalsh(square) > INITIAL_STATE_PRIOR).sum()) for square in by_starts[chosen])
    return int(is_observed[chosen].sum()) * k - p - seen


def _pseudo_inverse(square: np.ndarray, damping: float = 0.0) -> np.ndarray:
    """Return the inverse of a normal matrix with its diagonal damped, on the combinations that it determines."""
    diagonal = np.diag(square)
    scale = 1.0 / np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))
    scaled = square * np.outer(scale, scale) + damping * np.eye(len(square))
    return np.linalg.pinv(scaled, rcond=SCHUR_RTOL, hermitian=True) * np.outer(scale, scale)


def _schur_complement(squares, slopes, p: int, taken, damping: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Return the normal matrix and the slope of the weights, the first states of all runs eliminated."""
    matrix, slope = np.zeros((p, p)), np.zeros(p)
    for S, g in zip(squares[taken], slopes[taken], strict=True):
        back = S[:p, p:] @ _pseudo_inverse(S[p:, p:], damping)
        matrix += S[:p, :p] - back @ S[p:, :p]
        slope += g[:p] - back @ g[p:]
    return 0.5 * (matrix + matrix.T), slope


def _gauss_newton_step(squares, slopes, p: int, taken, damping: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the damped Gauss-Newton step of the weights, shape (p,), and of the first states, shape (B, c)."""
    matrix, slope = _schur_complement(squares, slopes, p, taken, damping)
    step = -_pseudo_inverse(matrix, damping) @ slope
    moves = [
        -_pseudo_inverse(S[p:, p:], damping) @ (g[p:] + S[p:, :p] @ step) if np.isfinite(S).all() else 0.0 * g[p:]
        for S, g in zip(squares, slopes, strict=True)
    ]
    return step, np.stack(moves)


def _inverse_rank_condition(schur: np.ndarray, diagonal: np.ndarray | None = None) -> tuple[np.ndarray, int, float]:
    """Return the inverse of a normal matrix, infinite where it has none, its rank, and the condition of its root.

    Parameters
    ----------
    schur : array, shape (p, p)
    diagonal : array, shape (p,), optional
        The diagonal before first states were eliminated. What is left of an entry is rounding if the first states make
        up for the weight; by default nothing was eliminated.
    """
    diagonal = np.diag(schur) if diagonal is None else diagonal
    scale = 1.0 / np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))
    values, vectors = np.linalg.eigh(schur * np.outer(scale, scale))
    is_determined = values > SCHUR_RTOL
    rank = int(is_determined.sum())
    condition = float(np.sqrt(values[-1] / values[0])) if rank == len(values) else np.inf
    scaled = vectors * scale[:, None]
    inverse = (scaled[:, is_determined] / values[is_determined]) @ scaled[:, is_determined].T
    lost = (np.abs(vectors[:, ~is_determined]) > 1e-6).any(axis=1)
    inverse[lost], inverse[:, lost] = np.inf, np.inf
    return inverse, rank, condition
