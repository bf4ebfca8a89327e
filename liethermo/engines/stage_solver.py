"""Stage equations of a step, ``k = slopes(k)``, and their solution.

They are solved by fixed-point iteration from extrapolated slopes. If that converges slowly or not at all, simplified
Newton iteration follows, with the exact Jacobian matrix or, for large systems, Jacobian-vector products. Both stop at
the *rounding plateau*, where the update no longer shrinks, rather than at a tolerance that could lie below it. All
loops are ``lax.while_loop``: unrolling them would make the compiler duplicate work exponentially.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.extend.core import Primitive
from jax.interpreters import batching, mlir

from manifolds.matrices.linear import inverse

from ..functions.rounding import value_and_rounding_scale
from ..integrators import OneStepMethod
from ..integrators.explicit import constraint_residual
from ..systems import System
from .solver_options import DEFAULT_OPTIONS, SolverOptions


class StageSolution(NamedTuple):
    """The solution of the stage equations of a step, with how the iteration ended."""

    k: jax.Array
    converged: jax.Array
    is_finite: jax.Array  # whether the last update was finite
    residual: jax.Array  # norm of the last update
    fixed_point_iterations: jax.Array
    newton_iterations: jax.Array
    slope_rounding: jax.Array  # rounding scale of the slopes if the iteration converged only relative to it, else 0


class StageEquations(NamedTuple):
    """The stage equations ``k = slopes(k)`` of one step, with what their solvers need."""

    slopes: Callable
    guess: jax.Array
    scale: Callable  # of k; updates are measured relative to it
    newton_solve_at: Callable  # of k; returns a function from ``slopes(k) - k`` to the step that is subtracted from k
    slope_rounding: Callable = lambda: jnp.zeros(())  # rounding scale of the slopes


class IterationState(NamedTuple):
    """The state of an iteration on the stage equations, carried from update to update."""

    k: jax.Array
    update: jax.Array  # norm of the last update of k
    smallest_update: jax.Array
    n_stalled: jax.Array  # consecutive iterations that did not shrink the update
    previous_update: jax.Array
    earlier_update: jax.Array  # the update before the previous one; 0 if there is none
    n_iterations: jax.Array
    first_update: jax.Array

    @classmethod
    def initial(cls, k) -> IterationState:
        """Return the state of an iteration before its first update, at slopes k."""
        infinite, zero_count = jnp.asarray(jnp.inf), jnp.zeros((), dtype=jnp.int64)
        return cls(k, infinite, infinite, zero_count, infinite, jnp.zeros(()), zero_count, infinite)

    def next_state(self, k, options: SolverOptions) -> IterationState:
        """Return the state of the iteration after an update to slopes k."""
        update = options.norm_for_dim(k.shape[-1])(k - self.k)
        earlier_update = jnp.where(self.n_iterations > 1, self.previous_update, 0.0)
        n_stalled = jnp.where(update < options.stall_ratio * self.smallest_update, 0, self.n_stalled + 1)
        smallest_update = jnp.where(update < self.smallest_update, update, self.smallest_update)
        first_update = jnp.where(self.n_iterations == 0, update, self.first_update)
        return IterationState(
            k, update, smallest_update, n_stalled, self.update, earlier_update, self.n_iterations + 1, first_update
        )

    def shrinks_slower_than(self, rate: float) -> jax.Array:
        """Return whether updates shrink by less than ``rate``, in the last iteration and in the last two together.

        Two components that drive each other, such as spins and the bath that they heat, are each corrected in every
        second iteration. If their units differ, updates then grow and shrink in turn while both converge.
        """
        return (self.update > rate * self.previous_update) & (self.update > rate * rate * self.earlier_update)

    def is_update_small(self, scale, options: SolverOptions, residual_norm=None, slope_rounding=None) -> jax.Array:
        """Return whether the last update is within the size that rounding may leave, relative to ``scale``.

        With ``slope_rounding``, a residual that is small relative to it will do instead.
        """
        is_small = self.update <= options.plateau_rtol * scale
        if slope_rounding is not None:
            is_small |= residual_norm <= options.plateau_rtol * slope_rounding
        return is_small

    def is_update_at_rounding_plateau(
        self, scale, options: SolverOptions, residual_norm=None, slope_rounding=None
    ) -> jax.Array:
        """Return whether the update is negligible, or small and stalled twice (the rounding plateau)."""
        is_small = self.is_update_small(scale, options, residual_norm, slope_rounding)
        return (self.update <= options.update_floor * scale) | ((self.n_stalled >= 2) & is_small)

    def has_newton_converged(
        self, is_at_limit, scale, options: SolverOptions, residual_norm, slope_rounding
    ) -> jax.Array:
        """Return whether a Newton iteration has converged: at the rounding plateau, or small at its limit."""
        criteria = scale, options, residual_norm, slope_rounding
        return self.is_update_at_rounding_plateau(*criteria) | (is_at_limit & self.is_update_small(*criteria))

    def has_fixed_point_converged_and_continues(self, scale, options: SolverOptions) -> tuple[jax.Array, jax.Array]:
        """Return two bools: whether a fixed-point iteration has converged, and whether it goes on."""
        is_slow = (
            (self.n_iterations >= 3)
            & self.shrinks_slower_than(options.fixed_point_contraction_limit)
            & (self.smallest_update > options.plateau_rtol * scale)
        )
        is_finite = jnp.isfinite(self.update)
        at_plateau = self.is_update_at_rounding_plateau(scale, options)
        # From a state at rest the updates of a stiff system begin below the limit, and stall there without a plateau.
        is_rounding = (self.update <= options.min_contraction * self.first_update) | (
            self.update <= options.rounding_rtol * scale
        )
        return at_plateau & is_rounding & is_finite, ~at_plateau & ~is_slow & is_finite & (
            self.n_iterations < options.max_fixed_point_iterations
        )


def solve_fixed_point(equations: StageEquations, options: SolverOptions = DEFAULT_OPTIONS) -> StageSolution:
    """Return the solution of the stage equations by fixed-point iteration, given up if it converges slowly."""

    def iterate(carry):
        s = carry[0].next_state(equations.slopes(carry[0].k), options)
        return s, *s.has_fixed_point_converged_and_continues(equations.scale(s.k), options)

    initial_carry = IterationState.initial(equations.guess), jnp.asarray(False), jnp.asarray(True)
    s, converged, _ = jax.lax.while_loop(lambda carry: carry[2], iterate, initial_carry)
    return StageSolution(
        s.k, converged, jnp.isfinite(s.update), s.update, s.n_iterations, jnp.zeros_like(s.n_iterations), jnp.zeros(())
    )


def slope_rounding_scale(system: System, x, options: SolverOptions = DEFAULT_OPTIONS) -> jax.Array:
    """Return the norm of the rounding errors of the vector field at x, shape ()."""
    system, x = system.subsystem_to_solve(x)
    return options.norm_for_dim(x.size)(value_and_rounding_scale(system.vector_field, x)[1])


def solve_stages(equations: StageEquations, options: SolverOptions = DEFAULT_OPTIONS) -> StageSolution:
    """Return the solution of the stage equations by fixed-point iteration, or by Newton's method if that fails."""
    fixed_point_result = solve_fixed_point(equations, options)
    # a branch, because a loop would copy its carry
    return jax.lax.cond(
        fixed_point_result.converged,
        lambda: fixed_point_result,
        lambda: solve_newton(equations, options, fixed_point_result),
    )


def keep_fixed_point_result(fixed_point_result: StageSolution, *_) -> StageSolution:
    """Return the result of the fixed-point iteration unchanged, in place of Newton's method."""
    return fixed_point_result


def solve_newton(
    equations: StageEquations, options: SolverOptions, fixed_point_result: StageSolution | None = None
) -> StageSolution:
    """Return the solution of the stage equations by simplified Newton iteration, unless they are solved already.

    Under ``vmap`` it leaves the trajectories unchanged whose equations are solved. Full steps are tried first; a failed
    iteration restarts once from the guess with damped steps.
    """
    slopes, guess, scale, newton_solve_at, get_slope_rounding = equations
    norm = options.norm_for_dim(guess.shape[-1])
    slope_rounding = get_slope_rounding()
    zero_count = jnp.zeros((), dtype=jnp.int64)
    is_solved, n_fixed_point = (
        (False, zero_count)
        if fixed_point_result is None
        else (fixed_point_result.converged, fixed_point_result.fixed_point_iterations)
    )

    def evaluate_residual(k):
        return slopes(k) - k

    def is_at_limit(s: IterationState, is_damped):
        return s.n_iterations >= jnp.where(is_damped, 2, 1) * options.max_newton_iterations

    def has_failed(s: IterationState, is_damped):
        return is_at_limit(s, is_damped) | ~jnp.isfinite(jnp.sum(s.k))

    def is_unsolved(s: IterationState, residual, is_damped):
        converged = s.has_newton_converged(
            is_at_limit(s, is_damped), scale(s.k), options, norm(residual), slope_rounding
        )
        return jnp.logical_not(is_solved) & ~converged

    def damp_newton_step(k, step, residual_norm, smallest_step_norm, is_damped):
        """Return k minus the (halved) step, the residual there, and whether the step is a full one."""

        def needs_halving(carry):
            factor, residual = carry
            can_halve = (
                is_damped & (factor > 0.5**options.max_newton_halvings) & (factor * norm(step) > smallest_step_norm)
            )
            return (factor > 1.0) | (~(jnp.linalg.norm(residual) < residual_norm) & can_halve)

        def halve_step(carry):
            factor = 0.5 * carry[0]
            return factor, evaluate_residual(k - factor * step)

        factor, residual = jax.lax.while_loop(needs_halving, halve_step, (jnp.asarray(2.0), step))
        return k - factor * step, residual, factor == 1.0

    def newton_cycle(carry):
        s, residual, is_damped = carry
        needs_restart = has_failed(s, is_damped)
        restart = IterationState.initial(initial_k)._replace(n_iterations=s.n_iterations), initial_residual
        s, residual = jax.tree_util.tree_map(lambda a, b: jnp.where(needs_restart, a, b), restart, (s, residual))
        is_damped, newton_step, n_previous = is_damped | needs_restart, newton_solve_at(s.k), s.n_iterations

        def newton_iteration(carry):
            inner, residual, _ = carry
            k, residual, is_full_step = damp_newton_step(
                inner.k,
                newton_step(residual),
                jnp.linalg.norm(residual),
                options.plateau_rtol * scale(inner.k),
                is_damped,
            )
            inner = inner.next_state(k, options)
            return inner, residual, jnp.where(is_full_step, inner.n_iterations - n_previous, options.max_jacobian_reuse)

        def can_reuse_jacobian(carry):
            inner, residual, n_uses = carry
            # by the last update alone: a stale matrix misleads the iteration before two updates show it
            is_fresh = (n_uses == 0) | (
                (n_uses < options.max_jacobian_reuse)
                & ~(inner.update > options.jacobian_contraction_limit * inner.previous_update)
            )
            return is_fresh & is_unsolved(inner, residual, is_damped) & ~has_failed(inner, is_damped)

        s, residual, _ = jax.lax.while_loop(
            can_reuse_jacobian, newton_iteration, (s, residual, jnp.zeros_like(s.n_iterations))
        )
        return s, residual, is_damped

    def is_unfinished(carry):
        s, residual, is_damped = carry
        return is_unsolved(s, residual, is_damped) & ~(is_damped & has_failed(s, is_damped))

    initial_k, initial_residual = best_guess_and_residual(evaluate_residual, guess)
    s, residual, is_damped = jax.lax.while_loop(
        is_unfinished, newton_cycle, (IterationState.initial(initial_k), initial_residual, jnp.asarray(False))
    )
    converged = ~is_unsolved(s, residual, is_damped) & jnp.isfinite(jnp.sum(s.k))
    slope_rounding = jnp.where(s.is_update_at_rounding_plateau(scale(s.k), options), 0.0, slope_rounding)
    return StageSolution(
        s.k, converged, jnp.isfinite(s.update), s.update, n_fixed_point, s.n_iterations, slope_rounding
    )


def best_guess_and_residual(residual_function: Callable, guess: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return the guess of the slopes with the smaller residual, given or zero, and this residual.

    Far from a solution Newton's method may not converge.
    """
    zero_slopes, zero_count = jnp.zeros_like(guess), jnp.zeros((), dtype=jnp.int64)

    def try_guess(carry):
        n_tried, best_k, best_residual, best_norm = carry
        trial_k = jnp.where(n_tried == 0, zero_slopes, guess)
        residual = residual_function(trial_k)
        norm = jnp.linalg.norm(residual)
        is_better = (n_tried == 0) | (norm <= best_norm)
        return n_tried + 1, *(
            jnp.where(is_better, a, b) for a, b in ((trial_k, best_k), (residual, best_residual), (norm, best_norm))
        )

    # a loop, so that the program contains the equations only once
    return jax.lax.while_loop(
        lambda carry: carry[0] < 2, try_guess, (zero_count, zero_slopes, zero_slopes, jnp.zeros(()))
    )[1:3]


_inverse = Primitive("inverse")
"""Primitive for the inverse of a square matrix; Newton's iteration corrects its rounding errors."""


@_inverse.def_abstract_eval
def _inverse_abstract_eval(matrix):
    return jax.core.ShapedArray(matrix.shape, matrix.dtype)


def _inverse_batching_rule(arguments, axes):
    # without LAPACK, whose batched calls can deadlock: see manifolds.matrices.linear.solve
    (matrices,), (axis,) = arguments, axes
    return inverse(jnp.moveaxis(matrices, axis, 0)), 0


_inverse.def_impl(jnp.linalg.inv)
batching.primitive_batchers[_inverse] = _inverse_batching_rule
mlir.register_lowering(_inverse, mlir.lower_fun(jnp.linalg.inv, multiple_results=False))


def explicit_stage_solution(
    system: System, method: OneStepMethod, x, compensation, h, k, options: SolverOptions = DEFAULT_OPTIONS
) -> StageSolution:
    """Return the slopes of an explicit step as a solution, converged if its end satisfies the constraints."""
    k = method.slopes(system, x, compensation, h, k)
    x, zero_count = system.subsystem_to_solve(x)[1], jnp.zeros((), dtype=jnp.int64)
    norm = options.norm_for_dim(x.size)
    residual = norm(jnp.zeros_like(x).at[0].set(constraint_residual(k)))  # the residual is the length of a vector
    converged = residual <= options.projection_rtol * norm(
        k[0]
    ) + options.projection_state_rtol * scale_of_slope_updates(x, h, k[0], options)
    return StageSolution(k, converged, jnp.isfinite(residual), residual, zero_count + 1, zero_count, jnp.zeros(()))


def make_newton_lineariser(
    system: System,
    method: OneStepMethod,
    x,
    compensation,
    h,
    options: SolverOptions = DEFAULT_OPTIONS,
    map_function: Callable | None = None,
) -> Callable:
    """Return a function of k that linearises the stage equations at k and returns the solver of a Newton step.

    ``map_function(function, vectors)`` computes the columns of the Jacobian matrix; without it ``vmap`` does, and large
    systems are solved without a matrix.
    """

    def linearise_at(k) -> Callable:
        jacobian_product = method.residual_jvp(system, x, compensation, h, k)
        if map_function is None and k.shape[-1] > options.matrix_free_dim:
            return lambda residual: solve_krylov(jacobian_product, residual, options)
        matrix = (map_function or _map_with_vmap)(
            lambda d: jacobian_product(d.reshape(k.shape)).ravel(), jnp.eye(k.size)
        ).T
        jacobian_inverse = _inverse.bind(matrix)
        return lambda residual: (jacobian_inverse @ residual.ravel()).reshape(k.shape)

    return linearise_at


def _map_with_vmap(function: Callable, vectors) -> jax.Array:
    return jax.vmap(function)(vectors)


def scale_of_slope_updates(x, h, k, options: SolverOptions = DEFAULT_OPTIONS):
    """Return the scale ``|x|/|h| + |k|``, shape (), relative to which updates of slopes are measured."""
    norm = options.norm_for_dim(x.size)
    return norm(x) / jnp.abs(h) + norm(k) + options.tiny


def solve_krylov(matvec: Callable, b: jax.Array, options: SolverOptions) -> jax.Array:
    """Return x, shaped as b, with ``matvec(x) = b`` to the relative residual ``options.krylov_forcing_term``.

    Conjugate residuals, each direction made orthogonal to the last few [Eisenstat, Elman & Schultz 1983, "Orthomin"].
    With all directions kept, x would have the least residual in the Krylov space; the memory is ``2
    options.krylov_basis_size`` vectors. It converges if the symmetric part of the matrix is definite, which holds for a
    step unless growth is faster than 1/h. After ``options.max_krylov_products`` products the last iterate is returned.
    Clustered eigenvalues are resolved together, so a few stiff components of a large state cost a few products.
    """

    def is_unfinished(carry):
        _, r, _, _, n_products = carry
        return (n_products < options.max_krylov_products) & (
            jnp.linalg.norm(r) > options.krylov_forcing_term * b_norm
        ) | (n_products == 0)

    def orthomin_step(carry):
        x, r, directions, images, n_products = carry
        p, q = r, matvec(r)
        coefficients = jnp.tensordot(images, q, q.ndim)
        p, q = p - jnp.tensordot(coefficients, directions, 1), q - jnp.tensordot(coefficients, images, 1)
        q_norm = jnp.linalg.norm(q)
        inverse_norm = jnp.where(q_norm > 0.0, 1.0 / jnp.where(q_norm > 0.0, q_norm, 1.0), 0.0)
        p, q = inverse_norm * p, inverse_norm * q
        residual_component = jnp.vdot(q, r)
        slot = n_products % options.krylov_basis_size
        directions, images = directions.at[slot].set(p), images.at[slot].set(q)
        return x + residual_component * p, r - residual_component * q, directions, images, n_products + 1

    b_norm = jnp.linalg.norm(b)
    empty_basis = jnp.zeros((options.krylov_basis_size, *b.shape))
    return jax.lax.while_loop(
        is_unfinished, orthomin_step, (jnp.zeros_like(b), b, empty_basis, empty_basis, jnp.zeros((), dtype=jnp.int64))
    )[0]
