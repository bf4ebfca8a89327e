"""Sparse engine: systems of any size whose sparsity pattern is known.

A step is tried by fixed-point iteration, as in the array engine; a stiff one is solved by Newton's method with a sparse
Jacobian matrix. Its entries come from few derivatives: columns without a common row are computed together, and the rows
of hubs, which have many neighbours, by themselves [Curtis, Powell & Reid 1974; Coleman & Verma 1998]. The Newton
iteration runs on the host, where SciPy factorises; all else is shared with the array engine.
"""

from __future__ import annotations

import itertools
import sys
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import scipy

from ..functions.rounding import value_and_rounding_scale
from ..integrators import OneStepMethod
from ..systems import System
from ..tracing.programs import jit_cached
from .array_engine import EngineTrajectory
from .solver_options import DEFAULT_OPTIONS
from .stage_solver import IterationState, StageEquations, StageSolution, best_guess_and_residual, solve_fixed_point
from .status_codes import StatusCode
from .step import State, finish_step, initial_run_state_program, stage_equations, system_and_state_after_jump

MAX_FRONT_WIDTH = 1_000
"""Largest width of a level of a breadth-first search for which a matrix is factorised.

Such a level cuts the graph in two, and elimination fills about the square of its width: a plane grid of 1e6 nodes is at
the limit, taking seconds. Wider graphs (grids in space, networks of small diameter) are well connected, and Krylov
iteration is quick for them: tens to hundreds of products.
"""

KRYLOV_RTOL = 1e-6
"""Relative residual of a Krylov solution; Newton's iteration corrects the rest.

(1e-12 gave the same laws, at 1.7 times the products.)
"""

MAX_KRYLOV_ITERATIONS = 2_000
"""Largest number of Krylov iterations for one solution."""


class JacobianCompression:
    """Computation of all entries of a sparse Jacobian matrix from few products with vectors.

    Columns without a common row get one colour and are computed together, by a derivative along their sum [Curtis,
    Powell & Reid 1974]. Dense rows (of *hubs*) would need as many colours as they have entries; they are computed one
    by one, by vector-Jacobian products. The limit between both is chosen to need the fewest derivatives.

    Parameters
    ----------
    pattern : scipy.sparse.csr_array, shape (n, n)
        Entries that can be different from zero.
    stages : int
        The function maps (stages, n) to (stages, n), and every stage depends on every other by the same pattern.
    """

    def __init__(self, pattern: scipy.sparse.csr_array, stages: int = 1):
        self.dim, self.stages = pattern.shape[0], stages
        self.front_width = _max_bfs_level_width(pattern)
        row_sizes = np.diff(pattern.indptr)
        self.dense_rows = np.flatnonzero(row_sizes > _max_coloured_row_size(row_sizes))
        self._dense_row_columns = [pattern.indices[pattern.indptr[i] : pattern.indptr[i + 1]] for i in self.dense_rows]
        rows, columns = np.repeat(np.arange(self.dim), row_sizes), pattern.indices
        is_coloured = ~np.isin(rows, self.dense_rows)
        rows, columns = rows[is_coloured], columns[is_coloured]
        coloured_pattern = scipy.sparse.csr_array((np.ones(len(rows), dtype=bool), (rows, columns)), pattern.shape)
        self.colours = _colour_columns(coloured_pattern)
        order = np.argsort(self.colours[columns], kind="stable")
        ends = np.cumsum(np.bincount(self.colours[columns], minlength=self.colours.max(initial=-1) + 1))
        self._colour_entries = list(
            zip(np.split(rows[order], ends[:-1]), np.split(columns[order], ends[:-1]), strict=True)
        )

    @property
    def n_derivatives(self) -> int:
        """Number of products with vectors (jvp and vjp) that one Jacobian matrix takes."""
        return self.stages * (len(self._colour_entries) + len(self.dense_rows))

    def assemble_jacobian(self, jvp: Callable, vjp: Callable) -> scipy.sparse.csc_array:
        """Return the Jacobian matrix, shape (stages n, stages n), from its products with vectors.

        Parameters
        ----------
        jvp, vjp : functions from an array, shape (stages, n), to one
            The product of the matrix, and of its transpose, with a vector.
        """
        n, stages = self.dim, range(self.stages)
        rows, columns, entries = [], [], []
        seed = np.zeros((self.stages, n))
        for colour, (r, c) in enumerate(self._colour_entries):
            has_colour = self.colours == colour
            for j in stages:
                seed[j] = has_colour
                product = np.asarray(jvp(seed))
                seed[j] = 0.0
                for i in stages:
                    rows.append(i * n + r)
                    columns.append(j * n + c)
                    entries.append(product[i, r])
        for dense_row, c in zip(self.dense_rows, self._dense_row_columns, strict=True):
            for i in stages:
                seed[i, dense_row] = 1.0
                product = np.asarray(vjp(seed))
                seed[i, dense_row] = 0.0
                for j in stages:
                    rows.append(np.full(len(c), i * n + dense_row))
                    columns.append(j * n + c)
                    entries.append(product[j, c])
        indices = np.concatenate(rows), np.concatenate(columns)
        return scipy.sparse.csc_array((np.concatenate(entries), indices), (self.stages * n, self.stages * n))


class SparseLinearSolver:
    """Solver of ``matrix @ x = b`` by sparse factors, or by a Krylov iteration if the factors would be dense.

    Parameters
    ----------
    matrix : scipy.sparse.csc_array, shape (n, n)
    front_width : int
        Width of the widest level of its graph: see :data:`MAX_FRONT_WIDTH`.

    Raises
    ------
    numpy.linalg.LinAlgError
        If the matrix is singular or not finite.
    """

    def __init__(self, matrix: scipy.sparse.csc_array, front_width: int):
        if not np.isfinite(matrix.data).all():
            raise np.linalg.LinAlgError("the matrix is not finite")
        if front_width <= MAX_FRONT_WIDTH:
            options = {"SymmetricMode": True}  # pivots on the diagonal, as far as that is stable
            try:
                factors = scipy.sparse.linalg.splu(matrix, "MMD_AT_PLUS_A", diag_pivot_thresh=0.01, options=options)
            except RuntimeError as error:
                raise np.linalg.LinAlgError(str(error)) from error
            self._solve = factors.solve
            return
        diagonal = matrix.diagonal()
        scaling = scipy.sparse.diags_array(1.0 / np.where(diagonal != 0.0, diagonal, 1.0))
        scaled_matrix = scipy.sparse.csr_array(scaling @ matrix)

        def solve_bicgstab(b):
            b_norm = float(np.linalg.norm(scaling @ b)) or 1.0  # SciPy stops at a small absolute residual
            x, _ = scipy.sparse.linalg.bicgstab(
                scaled_matrix, scaling @ b / b_norm, rtol=KRYLOV_RTOL, maxiter=MAX_KRYLOV_ITERATIONS
            )
            return b_norm * x

        self._solve = solve_bicgstab

    def __call__(self, b: np.ndarray) -> np.ndarray:
        """Return the solution x, shape (n,), of ``matrix @ x = b``."""
        return self._solve(b)


def _max_coloured_row_size(row_sizes: np.ndarray) -> int:
    """Return the number of entries up to which a row is coloured, chosen to need the fewest derivatives.

    About as many colours are needed, and a derivative for each larger row: their sum is minimised.
    """
    candidates = np.unique(row_sizes)
    n_larger = len(row_sizes) - np.searchsorted(np.sort(row_sizes), candidates, side="right")
    return int(candidates[np.argmin(candidates + n_larger)])


def _max_bfs_level_width(pattern: scipy.sparse.csr_array) -> int:
    """Return the number of nodes in the widest level of a breadth-first search through a pattern's graph.

    The search starts at a peripheral node.
    """
    graph = scipy.sparse.csr_array(pattern + pattern.T, dtype=float)
    label = scipy.sparse.csgraph.connected_components(graph, directed=False)[1]
    start = int(np.argmax(label == np.bincount(label).argmax()))
    for _ in range(2):  # the second search starts where the first ended
        distance = scipy.sparse.csgraph.dijkstra(graph, directed=False, indices=start, unweighted=True)
        is_reached = np.isfinite(distance)
        start = int(np.argmax(np.where(is_reached, distance, -1.0)))
    return int(np.bincount(distance[is_reached].astype(int)).max())


def _colour_columns(pattern: scipy.sparse.csr_array) -> np.ndarray:
    """Return a colour number for each column, so that columns of one colour have no row in common."""
    csc_pattern = scipy.sparse.csc_array(pattern)
    rows = csc_pattern.indices.tolist()
    row_colours = [0] * pattern.shape[0]  # for each row, a bit mask of the colours of its columns
    colours = []
    for start, end in itertools.pairwise(csc_pattern.indptr.tolist()):
        column_rows = rows[start:end]
        used_colours = 0
        for row in column_rows:
            used_colours |= row_colours[row]
        free_colour = ~used_colours & (used_colours + 1)  # the lowest bit that is not set
        for row in column_rows:
            row_colours[row] |= free_colour
        colours.append(free_colour.bit_length() - 1)
    return np.array(colours, dtype=int)


SPARSE_SOLVER_OPTIONS = replace(
    DEFAULT_OPTIONS,
    max_newton_iterations=80,
    max_newton_halvings=12,
    jacobian_contraction_limit=0.1,
    matrix_free_dim=sys.maxsize,
)
"""Solver options of the sparse engine.

Newton iterations are cheap: most use factors that are kept from step to step. The matrix is formed for any dimension,
and the norm is the maximum norm, because a root mean square could hide a few stiff components among many.
"""


class SparseEngine:
    """The sparse engine, which solves steps by sparse Newton iteration, for one system and method.

    Raises
    ------
    ValueError
        If the system has no sparsity pattern.
    """

    name = "sparse"
    max_saves_per_call = 1  # a step may take seconds: show each, and keep each on Ctrl-C

    def __init__(self, system: System, method: OneStepMethod):
        self.system, self.method = system, method
        pattern = system.sparse_newton.find_pattern()
        if pattern is None:
            raise ValueError(f"{type(system).__name__} does not know its sparsity")
        self._pattern = pattern
        self._compression: JacobianCompression | None = None
        self._jacobian_solver: SparseLinearSolver | None = None
        self._factored_step_size = np.nan

    def initial_run_state(self, x) -> State:
        """Return the state of a run that starts at x, shape (n,)."""
        return initial_run_state_program(self.system, self.method, x)

    def advance(self, state, h, n_saves, save_every, noise=None):
        """Return the state after up to ``n_saves`` times ``save_every`` steps, and arrays of the saves reached."""
        del noise  # this engine takes no steps with noise
        saved_states: list[State] = []
        for _ in range(int(n_saves)):
            for _ in range(int(save_every)):
                state = self.step(state, h)
                if int(state.status) != StatusCode.COMPLETED:
                    break
            if int(state.status) != StatusCode.COMPLETED:
                break
            saved_states.append(state)
        x = np.array([np.asarray(s.x) for s in saved_states]).reshape(len(saved_states), self.system.dim)
        energy, entropy = (np.array([float(getattr(s, name)) for s in saved_states]) for name in ("energy", "entropy"))
        return state, (x, energy, entropy, np.ones(len(saved_states), dtype=bool))

    def start(self, x) -> EngineTrajectory:
        """Return a trajectory that starts at x, shape (n,)."""
        return EngineTrajectory(self, self.initial_run_state(x))

    def step_ends(self, x: np.ndarray, h: np.ndarray) -> np.ndarray:
        """Return the states, shape (m, n), after one step of size h from each state of x; NaN if a step fails."""
        states = [
            self.step(self.initial_run_state(jnp.asarray(start)), step_size)
            for start, step_size in zip(x, h, strict=True)
        ]
        is_taken = np.array([int(s.status) == StatusCode.COMPLETED for s in states])
        return np.where(is_taken[:, None], np.array([np.asarray(s.x) for s in states]), np.nan)

    def step(self, state: State, h, noise=None) -> State:
        """Return the state after one step of size h, or the old state with a failure status."""
        del noise
        h = jnp.asarray(h, dtype=jnp.float64)
        solution = _solve_fixed_point_program(self.system, self.method, state, h)
        if not bool(solution.converged):
            solution = self._solve_newton(state, h, int(solution.fixed_point_iterations))
        return _finish_step_program(self.system, self.method, state, h, solution)

    # -- Newton's method ------------------------------------------------------------------------------------------

    def _solve_newton(self, state: State, h, n_fixed_point: int) -> StageSolution:
        """Return the solution of the stage equations by Newton's method, after ``n_fixed_point`` other iterations."""
        k, residual, scale = _best_guess_with_residual_and_scale(self.system, self.method, state, h)
        s, needs_jacobian = IterationState.initial(k), float(h) != self._factored_step_size
        slope_rounding = jnp.zeros(())
        while (
            not self._has_converged(s, scale, residual, slope_rounding)
            and int(s.n_iterations) < SPARSE_SOLVER_OPTIONS.max_newton_iterations
        ):
            if needs_jacobian or self._jacobian_solver is None:
                self._jacobian_solver, self._factored_step_size = self._make_jacobian_solver(state, h, s.k), float(h)
                if self._jacobian_solver is None:
                    break
            newton_step = self._damped_newton_step(
                state,
                h,
                s,
                residual,
                scale,
                self._jacobian_solver,
                SPARSE_SOLVER_OPTIONS.max_newton_halvings if needs_jacobian else 1,
            )
            if newton_step is None and needs_jacobian:
                s = s._replace(n_stalled=jnp.asarray(2))  # no damped step decreases the residual
                slope_rounding = _residual_rounding_scale(self.system, self.method, state.x)
                break
            needs_jacobian = newton_step is None
            if newton_step is not None:
                s, residual, scale = newton_step
                needs_jacobian = bool(
                    s.update > SPARSE_SOLVER_OPTIONS.jacobian_contraction_limit * s.previous_update
                ) and float(s.update) > SPARSE_SOLVER_OPTIONS.plateau_rtol * float(scale)
            if (
                int(s.n_stalled) >= 2
                and not slope_rounding
                and not bool(s.is_update_at_rounding_plateau(scale, SPARSE_SOLVER_OPTIONS))
            ):
                slope_rounding = _residual_rounding_scale(self.system, self.method, state.x)
        is_finite = bool(jnp.isfinite(residual).all())
        return StageSolution(
            k=s.k,
            converged=jnp.asarray(self._has_converged(s, scale, residual, slope_rounding) and is_finite),
            is_finite=jnp.asarray(is_finite),
            residual=s.update,
            fixed_point_iterations=jnp.asarray(n_fixed_point),
            newton_iterations=s.n_iterations,
            slope_rounding=jnp.where(
                s.is_update_at_rounding_plateau(scale, SPARSE_SOLVER_OPTIONS), 0.0, slope_rounding
            ),
        )

    @staticmethod
    def _has_converged(iteration_state: IterationState, scale, residual, slope_rounding) -> bool:
        """Return whether Newton's iteration has converged."""
        is_at_limit = iteration_state.n_iterations >= SPARSE_SOLVER_OPTIONS.max_newton_iterations
        residual_norm = jnp.max(jnp.abs(residual))
        return bool(
            iteration_state.has_newton_converged(
                is_at_limit, scale, SPARSE_SOLVER_OPTIONS, residual_norm, slope_rounding
            )
        )

    def _damped_newton_step(
        self,
        state,
        h,
        iteration_state: IterationState,
        residual,
        scale,
        linear_solver: SparseLinearSolver,
        max_trials: int,
    ):
        """Return iteration state, residual and scale after a Newton step, halved as needed; None if none helps.

        At the rounding plateau the residual does not decrease, and a full step is taken.
        """
        step = linear_solver(np.asarray(residual).ravel()).reshape(iteration_state.k.shape)
        if not np.isfinite(step).all():
            return None
        norm = float(jnp.linalg.norm(residual))
        for _ in range(max_trials):
            k = iteration_state.k - step
            new_residual, new_scale = _weighted_residual_and_scale(self.system, self.method, state, h, k)
            new_norm = float(jnp.linalg.norm(new_residual))
            is_rounding = float(np.abs(step).max()) <= SPARSE_SOLVER_OPTIONS.plateau_rtol * float(scale)
            if new_norm < norm or (is_rounding and np.isfinite(new_norm)):
                return iteration_state.next_state(k, SPARSE_SOLVER_OPTIONS), new_residual, new_scale
            step = 0.5 * step
        return None

    def _make_jacobian_solver(self, state, h, k) -> SparseLinearSolver | None:
        """Return the solver of the linear equations of a Newton step at k; None if the matrix is singular."""
        if self._compression is None:
            self._compression = JacobianCompression(self._pattern, self.method.stages)

        def jvp(seed):
            return _weighted_residual_jvp(self.system, self.method, state, h, k, seed)

        def vjp(seed):
            return _weighted_residual_vjp(self.system, self.method, state, h, k, seed)

        try:
            return SparseLinearSolver(self._compression.assemble_jacobian(jvp, vjp), self._compression.front_width)
        except np.linalg.LinAlgError:
            return None


# -- on the device ----------------------------------------------------------------------------------------------------


@jit_cached
def _solve_fixed_point_program(system: System, method: OneStepMethod, state: State, h) -> StageSolution:
    """Return the solution of the stage equations by fixed-point iteration, in one program."""
    return solve_fixed_point(_stage_equations(system, method, state, h), SPARSE_SOLVER_OPTIONS)


def _stage_equations(system: System, method: OneStepMethod, state: State, h) -> StageEquations:
    """Return the stage equations of a step from a state, after a jump of the energy at a break."""
    system, x = system_and_state_after_jump(system, state.x, state.energy)
    return stage_equations(
        system, method, x, state.compensation, h, state.k, state.previous_slopes, SPARSE_SOLVER_OPTIONS
    )


@jit_cached
def _finish_step_program(system: System, method: OneStepMethod, state: State, h, solution: StageSolution) -> State:
    """Return the state after a step with solved stage equations, in one program."""
    system, x = system_and_state_after_jump(system, state.x, state.energy)
    return finish_step(system, method, state._replace(x=x), h, solution, SPARSE_SOLVER_OPTIONS)


def _weighted_residual_guess_and_scale(system: System, method: OneStepMethod, state: State, h):
    """Return the weighted residual as a function of k, a guess of k, and the scale of updates of k.

    With the weights w of :attr:`liethermo.System.sparse_newton` a stiff step is nearest to linear.
    """
    slopes, guess, scale, *_ = _stage_equations(system, method, state, h)

    def residual(k):
        midpoint = state.x + (state.compensation + 0.5 * method.increment(h, k))
        return system.sparse_newton.residual_weights(midpoint) * (slopes(k) - k)

    return residual, guess, scale


@jit_cached
def _weighted_residual_and_scale(system: System, method: OneStepMethod, state: State, h, k) -> tuple[Any, Any]:
    """Return the weighted residual at k, shape (stages, n), and the scale of updates of k."""
    residual, _, scale = _weighted_residual_guess_and_scale(system, method, state, h)
    return residual(k), scale(k)


@jit_cached
def _residual_rounding_scale(system: System, method: OneStepMethod, x) -> Any:
    """Return the scale of the rounding error of the weighted residual, shape ()."""
    return jnp.max(
        value_and_rounding_scale(lambda x: system.sparse_newton.residual_weights(x) * system.vector_field(x), x)[1]
    )


@jit_cached
def _best_guess_with_residual_and_scale(system: System, method: OneStepMethod, state: State, h):
    """Return the guess of the slopes with the smaller residual, predicted or zero, with residual and scale."""
    residual_function, guess, scale = _weighted_residual_guess_and_scale(system, method, state, h)
    k, residual = best_guess_and_residual(residual_function, guess)
    return k, residual, scale(k)


@jit_cached
def _weighted_residual_jvp(system: System, method: OneStepMethod, state: State, h, k, seed):
    """Return the product of the Jacobian of the weighted residual at k with a vector, shape (stages, n)."""
    residual = _weighted_residual_guess_and_scale(system, method, state, h)[0]
    return jax.jvp(residual, (k,), (jnp.asarray(seed),))[1]


@jit_cached
def _weighted_residual_vjp(system: System, method: OneStepMethod, state: State, h, k, seed):
    """Return the product of the transposed Jacobian of the weighted residual with a vector, shape (stages, n)."""
    residual = _weighted_residual_guess_and_scale(system, method, state, h)[0]
    return jax.vjp(residual, k)[1](jnp.asarray(seed))[0]
