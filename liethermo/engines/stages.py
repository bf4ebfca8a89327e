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

from ..functions.rounding import with_rounding
from ..integrators import OneStepMethod
from ..integrators.explicit import defect
from ..systems import System
from .krylov import krylov
from .rules import RULES, Rules


class Solved(NamedTuple):
    """Outcome of the stage equations.

    ``converged``; whether the last evaluation was finite (``defined``); the last update; iterations of both kinds; and
    ``noise``, the size at which the slopes are rounded, where the iteration did not settle without it, else 0.
    """

    k: jax.Array
    converged: jax.Array
    defined: jax.Array
    residual: jax.Array
    fixed_point: jax.Array
    newton: jax.Array
    noise: jax.Array


class Equations(NamedTuple):
    """What a step has to solve, ``k = slopes(k)``, and what is needed for it."""

    slopes: Callable
    guess: jax.Array
    scale: Callable  # from k to the size that the plateau is measured against
    inverted: Callable  # from k to a function from ``slopes - k`` to what Newton's method takes off k
    noise: Callable = lambda: jnp.zeros(())  # the size at which the slopes are rounded, where it has to be known


class Iteration(NamedTuple):
    """An iteration on the stage equations under way."""

    k: jax.Array
    update: jax.Array
    best: jax.Array
    stalled: jax.Array  # iterations in a row that did not shrink the update
    previous: jax.Array  # the update before the last
    earlier: jax.Array  # the one before that; zero where there is none
    iterations: jax.Array  # iterations so far

    @classmethod
    def begin(cls, k) -> Iteration:
        infinite, none = jnp.asarray(jnp.inf), jnp.zeros((), dtype=jnp.int64)
        return cls(k, infinite, infinite, none, infinite, jnp.zeros(()), none)

    def after(self, k, rules: Rules) -> Iteration:
        update = rules.size(k.shape[-1])(k - self.k)
        earlier = jnp.where(self.iterations > 1, self.previous, 0.0)
        stalled = jnp.where(update < rules.shrinking * self.best, 0, self.stalled + 1)
        best = jnp.where(update < self.best, update, self.best)
        return Iteration(k, update, best, stalled, self.update, earlier, self.iterations + 1)

    def slower(self, rate: float) -> jax.Array:
        """Whether updates shrink by less than a rate of contraction: the last one, and the last two together.

        Two parts of a state that drive each other, such as spins and the bath that they heat, are each corrected in
        every second iteration. Where their units differ, updates then grow and shrink in turn while both converge.
        """
        return (self.update > rate * self.previous) & (self.update > rate * rate * self.earlier)

    def settled(self, scale, rules: Rules, misfit=None, noise=None) -> jax.Array:
        """At the rounding plateau: nothing left to gain, or the update is small and has twice not shrunk.

        Small beside the scale of the slopes and the state; or the misfit is, beside the ``noise`` that slopes have.
        """
        small = self.update <= rules.plateau * scale
        if noise is not None:
            small |= misfit <= rules.plateau * noise
        return (self.update <= rules.floor * scale) | ((self.stalled >= 2) & small)

    def stands(self, scale, rules: Rules) -> tuple[jax.Array, jax.Array]:
        """How a fixed-point iteration that has begun stands: whether it has converged, and whether to go on."""
        slow = (self.iterations >= 3) & self.slower(rules.slow) & (self.best > rules.plateau * scale)
        finite = jnp.isfinite(self.update)
        settled = self.settled(scale, rules)
        return settled & finite, ~settled & ~slow & finite & (self.iterations < rules.fixed_point)


def fixed_point(equations: Equations, rules: Rules = RULES) -> Solved:
    """The first attempt: fixed-point iteration, given up where it is slow."""

    def iterate(carry):
        s = carry[0].after(equations.slopes(carry[0].k), rules)
        return s, *s.stands(equations.scale(s.k), rules)

    begin = Iteration.begin(equations.guess), jnp.asarray(False), jnp.asarray(True)
    s, converged, _ = jax.lax.while_loop(lambda carry: carry[2], iterate, begin)
    return Solved(
        s.k, converged, jnp.isfinite(s.update), s.update, s.iterations, jnp.zeros_like(s.iterations), jnp.zeros(())
    )


def noise_of(system: System, x, rules: Rules = RULES) -> jax.Array:
    """The size at which the motion from a state is rounded, as a whole."""
    system, x = system.solved_for(x)
    return rules.size(x.size)(with_rounding(system.vector_field, x)[1])


def solve_stages(equations: Equations, rules: Rules = RULES) -> Solved:
    """The solution by either attempt."""
    first = fixed_point(equations, rules)
    # a branch, since what is carried to a loop, and back, is copied
    return jax.lax.cond(first.converged, lambda: first, lambda: by_newton(equations, rules, first))


def given_up(first: Solved, *_) -> Solved:
    """No second attempt."""
    return first


def by_newton(equations: Equations, rules: Rules, first: Solved | None = None) -> Solved:
    """The second attempt; of trajectories side by side it does nothing for those that the first has solved."""
    slopes, guess, scale, inverted, noise = equations
    measure, size, none = rules.size(guess.shape[-1]), noise(), jnp.zeros((), dtype=jnp.int64)
    done, iterations = (False, none) if first is None else (first.converged, first.fixed_point)

    def misfit(k):
        return slopes(k) - k

    def lost(s: Iteration, damped):
        return (s.iterations >= jnp.where(damped, 2, 1) * rules.newton) | ~jnp.isfinite(jnp.sum(s.k))

    def unsolved(s: Iteration, found):
        return jnp.logical_not(done) & ~s.settled(scale(s.k), rules, measure(found), size)

    def improved(k, step, size, plateau, damped):
        """k less the step, halved until the misfit is smaller than ``size``; at the plateau all of the step."""

        def worse(carry):
            factor, found = carry
            halve = damped & (factor > 0.5**rules.halvings) & (factor * measure(step) > plateau)
            return (factor > 1.0) | (~(jnp.linalg.norm(found) < size) & halve)

        def halved(carry):
            factor = 0.5 * carry[0]
            return factor, misfit(k - factor * step)

        factor, found = jax.lax.while_loop(worse, halved, (jnp.asarray(2.0), step))
        return k - factor * step, found, factor == 1.0

    def newton(carry):
        s, found, damped = carry
        again = lost(s, damped)
        restart = Iteration.begin(start)._replace(iterations=s.iterations), start_misfit
        s, found = jax.tree_util.tree_map(lambda a, b: jnp.where(again, a, b), restart, (s, found))
        damped, step_from, before = damped | again, inverted(s.k), s.iterations

        def reuse(carry):
            inner, found, _ = carry
            k, found, whole = improved(
                inner.k, step_from(found), jnp.linalg.norm(found), rules.plateau * scale(inner.k), damped
            )
            inner = inner.after(k, rules)
            return inner, found, jnp.where(whole, inner.iterations - before, rules.reuse)

        def goes_on(carry):
            inner, found, used = carry
            # by the last update alone: a matrix that is stale leads astray before two updates show it
            fresh = (used == 0) | ((used < rules.reuse) & ~(inner.update > rules.stale * inner.previous))
            return fresh & unsolved(inner, found) & ~lost(inner, damped)

        s, found, _ = jax.lax.while_loop(goes_on, reuse, (s, found, jnp.zeros_like(s.iterations)))
        return s, found, damped

    def to_do(carry):
        s, found, damped = carry
        return unsolved(s, found) & ~(damped & lost(s, damped))

    start, start_misfit = better_start(misfit, guess)
    s, found, _ = jax.lax.while_loop(to_do, newton, (Iteration.begin(start), start_misfit, jnp.asarray(False)))
    converged = ~unsolved(s, found) & jnp.isfinite(jnp.sum(s.k))
    size = jnp.where(s.settled(scale(s.k), rules), 0.0, size)
    return Solved(s.k, converged, jnp.isfinite(s.update), s.update, iterations, s.iterations, size)


def better_start(misfit: Callable, guess: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The guess, or a step of size zero where that solves the equations better, and the misfit there.

    Far out Newton may wander.
    """
    rest, none = jnp.zeros_like(guess), jnp.zeros((), dtype=jnp.int64)

    def tried(carry):
        tries, k, found, size = carry
        start = jnp.where(tries == 0, rest, guess)
        defect = misfit(start)
        new = jnp.linalg.norm(defect)
        better = (tries == 0) | (new <= size)
        return tries + 1, *(jnp.where(better, a, b) for a, b in ((start, k), (defect, found), (new, size)))

    # a loop, so that programs hold the equations once
    return jax.lax.while_loop(lambda carry: carry[0] < 2, tried, (none, rest, rest, jnp.zeros(())))[1:3]


_inverse = Primitive("inverse")
"""The inverse of a square matrix, for Newton's method, which corrects what it loses."""


@_inverse.def_abstract_eval
def _same_shape(matrix):
    return jax.core.ShapedArray(matrix.shape, matrix.dtype)


def _inverses(arguments, axes):
    # not by LAPACK, whose batched calls can wait for each other forever: see manifolds.matrices.linear.solve
    (matrices,), (axis,) = arguments, axes
    return inverse(jnp.moveaxis(matrices, axis, 0)), 0


_inverse.def_impl(jnp.linalg.inv)
batching.primitive_batchers[_inverse] = _inverses
mlir.register_lowering(_inverse, mlir.lower_fun(jnp.linalg.inv, multiple_results=False))


def explicit(system: System, method: OneStepMethod, x, compensation, h, k, rules: Rules = RULES) -> Solved:
    """The slopes of an explicit method, which there is nothing to solve for."""
    k = method.slopes(system, x, compensation, h, k)
    x, none = system.solved_for(x)[1], jnp.zeros((), dtype=jnp.int64)
    size = rules.size(x.size)
    missed = size(jnp.zeros_like(x).at[0].set(defect(k)))  # it is the length of a vector
    converged = missed <= rules.corrected * size(k[0]) + rules.corrected_at_rest * scale_of(x, h, k[0], rules)
    return Solved(k, converged, jnp.isfinite(missed), missed, none + 1, none, jnp.zeros(()))


def newton_steps(
    system: System, method: OneStepMethod, x, compensation, h, rules: Rules = RULES, columns: Callable | None = None
) -> Callable:
    """For each k a function from the misfit ``slopes - k`` to the step of Newton's method, linearised there.

    ``columns``, of a function and vectors, makes the columns of the Jacobian matrix; without it there is none of large
    systems.
    """

    def linearised(k) -> Callable:
        product = method.linearised(system, x, compensation, h, k)
        if columns is None and k.shape[-1] > rules.large:
            return lambda found: krylov(product, found, rules)
        matrix = (columns or _side_by_side)(lambda d: product(d.reshape(k.shape)).ravel(), jnp.eye(k.size)).T
        inverse = _inverse.bind(matrix)
        return lambda found: (inverse @ found.ravel()).reshape(k.shape)

    return linearised


def _side_by_side(function: Callable, vectors) -> jax.Array:
    return jax.vmap(function)(vectors)


def scale_of(x, h, k, rules: Rules = RULES):
    """What updates of slopes are measured against, either way in time; x is the part of a state that they are of."""
    measure = rules.size(x.size)
    return measure(x) / jnp.abs(h) + measure(k) + rules.vanished
