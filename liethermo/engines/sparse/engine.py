"""Sparse engine: systems of any size whose sparsity pattern is known.

A step is tried by fixed-point iteration, as in the array engine; a stiff one is solved by Newton's method with a sparse
Jacobian matrix. Its entries come from few derivatives: columns without a common row are computed together, and the rows
of hubs, which have many neighbours, by themselves [Curtis, Powell & Reid 1974; Coleman & Verma 1998]. The Newton
iteration runs on the host, where SciPy factorises; all else is shared with the array engine.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ...functions.rounding import value_and_rounding_scale
from ...integrators import OneStepMethod
from ...systems import System
from ...tracing.programs import jit_cached
from ..array_engine import EngineTrajectory
from ..solver_options import DEFAULT_OPTIONS
from ..stage_solver import IterationState, StageEquations, StageSolution, best_guess_and_residual, solve_fixed_point
from ..status_codes import StatusCode
from ..step import State, finish_step, initial_run_state_program, stage_equations, start_step
from .colouring_and_lu import JacobianCompression, SparseInverse

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
    """Sparse engine for one system and method; the factors of its Jacobian matrix are kept from step to step.

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
        self._inverse: SparseInverse | None = None
        self._factored_step_size = np.nan

    def initial_run_state(self, x) -> State:
        return initial_run_state_program(self.system, self.method, x)

    def advance(self, state, h, saves, save_every, noise=None):
        """Take ``save_every`` steps up to ``saves`` times; the saved arrays have only the saves that were reached."""
        del noise  # this engine takes no steps with noise
        saved_states: list[State] = []
        for _ in range(int(saves)):
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
        return EngineTrajectory(self, self.initial_run_state(x))

    def step_ends(self, x: np.ndarray, h: np.ndarray) -> np.ndarray:
        states = [
            self.step(self.initial_run_state(jnp.asarray(start)), step_size)
            for start, step_size in zip(x, h, strict=True)
        ]
        is_taken = np.array([int(s.status) == StatusCode.COMPLETED for s in states])
        return np.where(is_taken[:, None], np.array([np.asarray(s.x) for s in states]), np.nan)

    def step(self, state: State, h, noise=None) -> State:
        del noise
        h = jnp.asarray(h, dtype=jnp.float64)
        solution = _solve_fixed_point_program(self.system, self.method, state, h)
        if not bool(solution.converged):
            solution = self._solve_newton(state, h, int(solution.fixed_point_iterations))
        return _finish_step_program(self.system, self.method, state, h, solution)

    # -- Newton's method ------------------------------------------------------------------------------------------

    def _solve_newton(self, state: State, h, n_fixed_point: int) -> StageSolution:
        k, residual, scale = _best_guess_with_residual_and_scale(self.system, self.method, state, h)
        s, needs_jacobian = IterationState.initial(k), float(h) != self._factored_step_size
        slope_rounding = jnp.zeros(())
        while (
            not self._has_converged(s, scale, residual, slope_rounding)
            and int(s.n_iterations) < SPARSE_SOLVER_OPTIONS.max_newton_iterations
        ):
            if needs_jacobian or self._inverse is None:
                self._inverse, self._factored_step_size = self._jacobian_inverse(state, h, s.k), float(h)
                if self._inverse is None:
                    break
            newton_step = self._damped_newton_step(
                state,
                h,
                s,
                residual,
                scale,
                self._inverse,
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
            if int(s.n_stalled) >= 2 and not slope_rounding and not bool(s.is_at_plateau(scale, SPARSE_SOLVER_OPTIONS)):
                slope_rounding = _residual_rounding_scale(self.system, self.method, state.x)
        is_finite = bool(jnp.isfinite(residual).all())
        return StageSolution(
            k=s.k,
            converged=jnp.asarray(self._has_converged(s, scale, residual, slope_rounding) and is_finite),
            is_finite=jnp.asarray(is_finite),
            residual=s.update,
            fixed_point_iterations=jnp.asarray(n_fixed_point),
            newton_iterations=s.n_iterations,
            slope_rounding=jnp.where(s.is_at_plateau(scale, SPARSE_SOLVER_OPTIONS), 0.0, slope_rounding),
        )

    @staticmethod
    def _has_converged(s: IterationState, scale, residual, slope_rounding) -> bool:
        is_at_limit = s.n_iterations >= SPARSE_SOLVER_OPTIONS.max_newton_iterations
        residual_norm = jnp.max(jnp.abs(residual))
        return bool(
            s.has_converged_or_ended_small(is_at_limit, scale, SPARSE_SOLVER_OPTIONS, residual_norm, slope_rounding)
        )

    def _damped_newton_step(
        self, state, h, s: IterationState, residual, scale, inverse: SparseInverse, max_trials: int
    ):
        """Return state, residual and scale after a Newton step, halved until the residual decreases, or None.

        At the rounding plateau the residual does not decrease, and a full step is taken.
        """
        step = inverse(np.asarray(residual).ravel()).reshape(s.k.shape)
        if not np.isfinite(step).all():
            return None
        norm = float(jnp.linalg.norm(residual))
        for _ in range(max_trials):
            k = s.k - step
            new_residual, new_scale = _weighted_residual_and_scale(self.system, self.method, state, h, k)
            new_norm = float(jnp.linalg.norm(new_residual))
            is_rounding = float(np.abs(step).max()) <= SPARSE_SOLVER_OPTIONS.plateau_rtol * float(scale)
            if new_norm < norm or (is_rounding and np.isfinite(new_norm)):
                return s.next_state(k, SPARSE_SOLVER_OPTIONS), new_residual, new_scale
            step = 0.5 * step
        return None

    def _jacobian_inverse(self, state, h, k) -> SparseInverse | None:
        """Return the solver of the weighted Newton equations at k; None if its matrix is singular."""
        if self._compression is None:
            self._compression = JacobianCompression(self._pattern, self.method.stages)

        def jvp(seed):
            return _weighted_residual_jvp(self.system, self.method, state, h, k, seed)

        def vjp(seed):
            return _weighted_residual_vjp(self.system, self.method, state, h, k, seed)

        try:
            return SparseInverse(self._compression.assemble_jacobian(jvp, vjp), self._compression.front_width)
        except np.linalg.LinAlgError:
            return None


# -- on the device ----------------------------------------------------------------------------------------------------


@jit_cached
def _solve_fixed_point_program(system: System, method: OneStepMethod, state: State, h) -> StageSolution:
    return solve_fixed_point(_stage_equations(system, method, state, h), SPARSE_SOLVER_OPTIONS)


def _stage_equations(system: System, method: OneStepMethod, state: State, h) -> StageEquations:
    system, x = start_step(system, state.x, state.energy)
    return stage_equations(
        system, method, x, state.compensation, h, state.k, state.previous_slopes, SPARSE_SOLVER_OPTIONS
    )


@jit_cached
def _finish_step_program(system: System, method: OneStepMethod, state: State, h, solution: StageSolution) -> State:
    system, x = start_step(system, state.x, state.energy)
    return finish_step(system, method, state._replace(x=x), h, solution, SPARSE_SOLVER_OPTIONS)


def _weighted_residual_guess_and_scale(system: System, method: OneStepMethod, state: State, h):
    """Return the function ``k -> w (slopes(k) - k)``, a guess of k, and the scale that updates are compared with.

    With the weights w of :attr:`liethermo.System.sparse_newton` a stiff step is nearest to linear.
    """
    slopes, guess, scale, *_ = _stage_equations(system, method, state, h)

    def residual(k):
        midpoint = state.x + (state.compensation + 0.5 * method.increment(h, k))
        return system.sparse_newton.residual_weights(midpoint) * (slopes(k) - k)

    return residual, guess, scale


@jit_cached
def _weighted_residual_and_scale(system: System, method: OneStepMethod, state: State, h, k) -> tuple[Any, Any]:
    residual, _, scale = _weighted_residual_guess_and_scale(system, method, state, h)
    return residual(k), scale(k)


@jit_cached
def _residual_rounding_scale(system: System, method: OneStepMethod, x) -> Any:
    """Return the scale at which the weighted residual is rounded."""
    return jnp.max(
        value_and_rounding_scale(lambda x: system.sparse_newton.residual_weights(x) * system.vector_field(x), x)[1]
    )


@jit_cached
def _best_guess_with_residual_and_scale(system: System, method: OneStepMethod, state: State, h):
    """Return the predicted slopes, or zero slopes if their residual is smaller, with residual and scale."""
    residual_function, guess, scale = _weighted_residual_guess_and_scale(system, method, state, h)
    k, residual = best_guess_and_residual(residual_function, guess)
    return k, residual, scale(k)


@jit_cached
def _weighted_residual_jvp(system: System, method: OneStepMethod, state: State, h, k, seed):
    residual = _weighted_residual_guess_and_scale(system, method, state, h)[0]
    return jax.jvp(residual, (k,), (jnp.asarray(seed),))[1]


@jit_cached
def _weighted_residual_vjp(system: System, method: OneStepMethod, state: State, h, k, seed):
    residual = _weighted_residual_guess_and_scale(system, method, state, h)[0]
    return jax.vjp(residual, k)[1](jnp.asarray(seed))[0]
