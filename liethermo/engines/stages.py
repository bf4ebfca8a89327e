"""The equations of a step, ``k = slopes(k)``, and how they are solved.

By fixed-point iteration from extrapolated slopes and, where that converges slowly or not at all, by simplified Newton
with the exact Jacobian: its matrix, or of large systems products with it. Both stop at the *rounding plateau*, where
the update no longer shrinks, rather than at a tolerance that could lie below it. All loops are ``lax.while_loop``:
unrolling them would make the compiler duplicate work exponentially.
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
from .krylov import solve_krylov
from .rules import DEFAULT_OPTIONS, SolverOptions


class StageSolution(NamedTuple):
    """Outcome of the stage equations.

    ``converged``; whether the last evaluation was finite (``is_finite``); the last update; iterations of both kinds; and
    ``slope_rounding``, the size at which the slopes are rounded, where the iteration did not settle without it, else 0.
    """

    k: jax.Array
    converged: jax.Array
    is_finite: jax.Array
    residual: jax.Array
    fixed_point_iterations: jax.Array
    newton_iterations: jax.Array
    slope_rounding: jax.Array


class StageEquations(NamedTuple):
    """What a step has to solve, ``k = slopes(k)``, and what is needed for it."""

    slopes: Callable
    guess: jax.Array
    scale: Callable  # from k to the size that the plateau is measured against
    newton_solve_at: Callable  # from k to a function from ``slopes - k`` to what Newton's method takes off k
    slope_rounding: Callable = lambda: jnp.zeros(
        ()
    )  # the size at which the slopes are rounded, where it has to be known


class IterationState(NamedTuple):
    """An iteration on the stage equations under way."""

    k: jax.Array
    update: jax.Array
    smallest_update: jax.Array
    n_stalled: jax.Array  # iterations in a row that did not shrink the update
    previous_update: jax.Array  # the update before the last
    earlier_update: jax.Array  # the one before that; zero where there is none
    n_iterations: jax.Array  # iterations so far

    @classmethod
    def initial(cls, k) -> IterationState:
        infinite, none = jnp.asarray(jnp.inf), jnp.zeros((), dtype=jnp.int64)
        return cls(k, infinite, infinite, none, infinite, jnp.zeros(()), none)

    def next_state(self, k, rules: SolverOptions) -> IterationState:
        update = rules.norm_for_dim(k.shape[-1])(k - self.k)
        earlier = jnp.where(self.n_iterations > 1, self.previous_update, 0.0)
        stalled = jnp.where(update < rules.stall_ratio * self.smallest_update, 0, self.n_stalled + 1)
        best = jnp.where(update < self.smallest_update, update, self.smallest_update)
        return IterationState(k, update, best, stalled, self.update, earlier, self.n_iterations + 1)

    def is_slower_than(self, rate: float) -> jax.Array:
        """Whether updates shrink by less than a rate of contraction: the last one, and the last two together.

        Two parts of a state that drive each other, such as spins and the bath that they heat, are each corrected in
        every second iteration. Where their units differ, updates then grow and shrink in turn while both converge.
        """
        return (self.update > rate * self.previous_update) & (self.update > rate * rate * self.earlier_update)

    def is_at_plateau(self, scale, rules: SolverOptions, misfit=None, noise=None) -> jax.Array:
        """At the rounding plateau: nothing left to gain, or the update is small and has twice not shrunk.

        Small beside the scale of the slopes and the state; or the misfit is, beside the ``noise`` that slopes have.
        """
        small = self.update <= rules.plateau_rtol * scale
        if noise is not None:
            small |= misfit <= rules.plateau_rtol * noise
        return (self.update <= rules.update_floor * scale) | ((self.n_stalled >= 2) & small)

    def converged_and_continue(self, scale, rules: SolverOptions) -> tuple[jax.Array, jax.Array]:
        """How a fixed-point iteration that has begun stands: whether it has converged, and whether to go on."""
        slow = (
            (self.n_iterations >= 3)
            & self.is_slower_than(rules.fixed_point_contraction_limit)
            & (self.smallest_update > rules.plateau_rtol * scale)
        )
        finite = jnp.isfinite(self.update)
        settled = self.is_at_plateau(scale, rules)
        return settled & finite, ~settled & ~slow & finite & (self.n_iterations < rules.max_fixed_point_iterations)


def solve_fixed_point(equations: StageEquations, rules: SolverOptions = DEFAULT_OPTIONS) -> StageSolution:
    """The first attempt: fixed-point iteration, given up where it is slow."""

    def iterate(carry):
        s = carry[0].next_state(equations.slopes(carry[0].k), rules)
        return s, *s.converged_and_continue(equations.scale(s.k), rules)

    begin = IterationState.initial(equations.guess), jnp.asarray(False), jnp.asarray(True)
    s, converged, _ = jax.lax.while_loop(lambda carry: carry[2], iterate, begin)
    return StageSolution(
        s.k, converged, jnp.isfinite(s.update), s.update, s.n_iterations, jnp.zeros_like(s.n_iterations), jnp.zeros(())
    )


def slope_rounding_scale(system: System, x, rules: SolverOptions = DEFAULT_OPTIONS) -> jax.Array:
    """The size at which the motion from a state is rounded, as a whole."""
    system, x = system.solved_part(x)
    return rules.norm_for_dim(x.size)(value_and_rounding_scale(system.vector_field, x)[1])


def solve_stages(equations: StageEquations, rules: SolverOptions = DEFAULT_OPTIONS) -> StageSolution:
    """The solution by either attempt."""
    first = solve_fixed_point(equations, rules)
    # a branch, since what is carried to a loop, and back, is copied
    return jax.lax.cond(first.converged, lambda: first, lambda: solve_newton(equations, rules, first))


def keep_fixed_point_result(first: StageSolution, *_) -> StageSolution:
    """No second attempt."""
    return first


def solve_newton(equations: StageEquations, rules: SolverOptions, first: StageSolution | None = None) -> StageSolution:
    """The second attempt; of trajectories side by side it does nothing for those that the first has solved."""
    slopes, guess, scale, inverted, noise = equations
    measure, size, none = rules.norm_for_dim(guess.shape[-1]), noise(), jnp.zeros((), dtype=jnp.int64)
    done, iterations = (False, none) if first is None else (first.converged, first.fixed_point_iterations)

    def residual(k):
        return slopes(k) - k

    def has_failed(s: IterationState, damped):
        return (s.n_iterations >= jnp.where(damped, 2, 1) * rules.max_newton_iterations) | ~jnp.isfinite(jnp.sum(s.k))

    def is_unsolved(s: IterationState, found):
        return jnp.logical_not(done) & ~s.is_at_plateau(scale(s.k), rules, measure(found), size)

    def damp_newton_step(k, step, size, plateau, damped):
        """k less the step, halved until the misfit is smaller than ``size``; at the plateau all of the step."""

        def needs_halving(carry):
            factor, found = carry
            halve = damped & (factor > 0.5**rules.max_newton_halvings) & (factor * measure(step) > plateau)
            return (factor > 1.0) | (~(jnp.linalg.norm(found) < size) & halve)

        def halve_step(carry):
            factor = 0.5 * carry[0]
            return factor, residual(k - factor * step)

        factor, found = jax.lax.while_loop(needs_halving, halve_step, (jnp.asarray(2.0), step))
        return k - factor * step, found, factor == 1.0

    def newton_cycle(carry):
        s, found, damped = carry
        again = has_failed(s, damped)
        restart = IterationState.initial(start)._replace(n_iterations=s.n_iterations), start_misfit
        s, found = jax.tree_util.tree_map(lambda a, b: jnp.where(again, a, b), restart, (s, found))
        damped, step_from, before = damped | again, inverted(s.k), s.n_iterations

        def newton_iteration(carry):
            inner, found, _ = carry
            k, found, whole = damp_newton_step(
                inner.k, step_from(found), jnp.linalg.norm(found), rules.plateau_rtol * scale(inner.k), damped
            )
            inner = inner.next_state(k, rules)
            return inner, found, jnp.where(whole, inner.n_iterations - before, rules.max_jacobian_reuse)

        def can_reuse_jacobian(carry):
            inner, found, used = carry
            # by the last update alone: a matrix that is stale leads astray before two updates show it
            fresh = (used == 0) | (
                (used < rules.max_jacobian_reuse)
                & ~(inner.update > rules.jacobian_contraction_limit * inner.previous_update)
            )
            return fresh & is_unsolved(inner, found) & ~has_failed(inner, damped)

        s, found, _ = jax.lax.while_loop(
            can_reuse_jacobian, newton_iteration, (s, found, jnp.zeros_like(s.n_iterations))
        )
        return s, found, damped

    def is_unfinished(carry):
        s, found, damped = carry
        return is_unsolved(s, found) & ~(damped & has_failed(s, damped))

    start, start_misfit = best_initial_guess(residual, guess)
    s, found, _ = jax.lax.while_loop(
        is_unfinished, newton_cycle, (IterationState.initial(start), start_misfit, jnp.asarray(False))
    )
    converged = ~is_unsolved(s, found) & jnp.isfinite(jnp.sum(s.k))
    size = jnp.where(s.is_at_plateau(scale(s.k), rules), 0.0, size)
    return StageSolution(s.k, converged, jnp.isfinite(s.update), s.update, iterations, s.n_iterations, size)


def best_initial_guess(misfit: Callable, guess: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The guess, or a step of size zero where that solves the equations better, and the misfit there.

    Far out Newton may wander.
    """
    rest, none = jnp.zeros_like(guess), jnp.zeros((), dtype=jnp.int64)

    def try_guess(carry):
        tries, k, found, size = carry
        start = jnp.where(tries == 0, rest, guess)
        defect = misfit(start)
        new = jnp.linalg.norm(defect)
        better = (tries == 0) | (new <= size)
        return tries + 1, *(jnp.where(better, a, b) for a, b in ((start, k), (defect, found), (new, size)))

    # a loop, so that programs hold the equations once
    return jax.lax.while_loop(lambda carry: carry[0] < 2, try_guess, (none, rest, rest, jnp.zeros(())))[1:3]


_inverse = Primitive("inverse")
"""The inverse of a square matrix, for Newton's method, which corrects what it loses."""


@_inverse.def_abstract_eval
def _same_shape(matrix):
    return jax.core.ShapedArray(matrix.shape, matrix.dtype)


def _inverse_batching_rule(arguments, axes):
    # not by LAPACK, whose batched calls can wait for each other forever: see manifolds.matrices.linear.solve
    (matrices,), (axis,) = arguments, axes
    return inverse(jnp.moveaxis(matrices, axis, 0)), 0


_inverse.def_impl(jnp.linalg.inv)
batching.primitive_batchers[_inverse] = _inverse_batching_rule
mlir.register_lowering(_inverse, mlir.lower_fun(jnp.linalg.inv, multiple_results=False))


def explicit_slopes(
    system: System, method: OneStepMethod, x, compensation, h, k, rules: SolverOptions = DEFAULT_OPTIONS
) -> StageSolution:
    """The slopes of an explicit method, which there is nothing to solve for."""
    k = method.slopes(system, x, compensation, h, k)
    x, none = system.solved_part(x)[1], jnp.zeros((), dtype=jnp.int64)
    size = rules.norm_for_dim(x.size)
    missed = size(jnp.zeros_like(x).at[0].set(constraint_residual(k)))  # it is the length of a vector
    converged = missed <= rules.projection_rtol * size(k[0]) + rules.projection_state_rtol * update_scale(
        x, h, k[0], rules
    )
    return StageSolution(k, converged, jnp.isfinite(missed), missed, none + 1, none, jnp.zeros(()))


def make_newton_solve(
    system: System,
    method: OneStepMethod,
    x,
    compensation,
    h,
    rules: SolverOptions = DEFAULT_OPTIONS,
    columns: Callable | None = None,
) -> Callable:
    """For each k a function from the misfit ``slopes - k`` to the step of Newton's method, linearised there.

    ``columns``, of a function and vectors, makes the columns of the Jacobian matrix; without it there is none of large
    systems.
    """

    def linearise_at(k) -> Callable:
        product = method.residual_jvp(system, x, compensation, h, k)
        if columns is None and k.shape[-1] > rules.matrix_free_dim:
            return lambda found: solve_krylov(product, found, rules)
        matrix = (columns or _apply_vmapped)(lambda d: product(d.reshape(k.shape)).ravel(), jnp.eye(k.size)).T
        inverse = _inverse.bind(matrix)
        return lambda found: (inverse @ found.ravel()).reshape(k.shape)

    return linearise_at


def _apply_vmapped(function: Callable, vectors) -> jax.Array:
    return jax.vmap(function)(vectors)


def update_scale(x, h, k, rules: SolverOptions = DEFAULT_OPTIONS):
    """What updates of slopes are measured against, either way in time; x is the part of a state that they are of."""
    measure = rules.norm_for_dim(x.size)
    return measure(x) / jnp.abs(h) + measure(k) + rules.tiny
