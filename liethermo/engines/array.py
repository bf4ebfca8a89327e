"""The array engine: any one-step method on any system, in JAX.

A step solves ``k = slopes(k)`` by fixed-point iteration from extrapolated slopes and, where that converges slowly
or not at all, by simplified Newton with the exact Jacobian: its matrix, or of large systems products with it. Both stop
at the *rounding plateau*, where the update no longer shrinks, rather than at a tolerance that could lie below it. All
loops are ``lax.while_loop``: unrolling them would make the compiler duplicate work exponentially.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from manifolds.matrices.linear import inverse

from ..functions.rounding import with_rounding
from ..integrators import OneStepMethod
from ..systems import System
from ..tracing.programs import program
from .codes import Code
from .krylov import krylov
from .rules import EPS, RULES, Rules


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


class Iteration(NamedTuple):
    """An iteration on the stage equations under way."""

    k: jax.Array
    update: jax.Array
    best: jax.Array
    stalled: jax.Array  # iterations in a row that did not shrink the update
    rate: jax.Array
    made: jax.Array  # iterations so far

    @classmethod
    def begin(cls, k) -> Iteration:
        infinite, zero, none = jnp.asarray(jnp.inf), jnp.zeros(()), jnp.zeros((), dtype=jnp.int64)
        return cls(k, infinite, infinite, none, zero, none)

    def after(self, k, rules: Rules) -> Iteration:
        update = rules.size(k.shape[-1])(k - self.k)
        rate = jnp.where(self.made > 0, update / jnp.where(self.update > 0.0, self.update, 1.0), 0.0)
        if k.shape[-1] > rules.large:
            rate = jnp.where(self.made > 1, jnp.sqrt(rate * self.rate), rate)
        stalled = jnp.where(update < rules.shrinking * self.best, 0, self.stalled + 1)
        return Iteration(k, update, jnp.fmin(update, self.best), stalled, rate, self.made + 1)

    def settled(self, scale, rules: Rules, misfit=jnp.inf, noise=0.0) -> jax.Array:
        """At the rounding plateau: nothing left to gain, or the update is small and has twice not shrunk.

        Small beside the scale of the slopes and the state; or the misfit is, beside the ``noise`` that slopes have.
        """
        small = (self.update <= rules.plateau * scale) | (misfit <= rules.plateau * noise)
        return (self.update <= rules.floor * scale) | ((self.stalled >= 2) & small)

    def stands(self, scale, rules: Rules, noise=0.0) -> tuple[jax.Array, jax.Array]:
        """How a fixed-point iteration stands: whether it has converged, and whether to go on."""
        slow = (self.made >= 3) & (self.rate > rules.slow) & (self.best > rules.plateau * jnp.maximum(scale, noise))
        finite = jnp.isfinite(self.update)
        hopeless = slow | ((self.made > 0) & ~finite)
        settled = self.settled(scale, rules, self.update, noise)
        return settled & finite, ~settled & ~hopeless & (self.made < rules.fixed_point)


def fixed_point(slopes: Callable, guess: jax.Array, scale: Callable, noise=0.0, rules: Rules = RULES) -> Solved:
    """The first attempt on ``k = slopes(k)``: fixed-point iteration, given up where it is slow."""

    def goes_on(s: Iteration):
        return s.stands(scale(s.k), rules, noise)[1]

    s = jax.lax.while_loop(goes_on, lambda s: s.after(slopes(s.k), rules), Iteration.begin(guess))
    converged = s.stands(scale(s.k), rules, noise)[0]
    noise = jnp.zeros(()) + noise
    return Solved(s.k, converged, jnp.isfinite(s.update), s.update, s.made, jnp.zeros_like(s.made), noise)


def noise_of(system: System, x, rules: Rules = RULES) -> jax.Array:
    """The size at which the motion from a state is rounded, as a whole."""
    return rules.size(x.size)(with_rounding(system.vector_field, x)[1])


def solve_stages(
    slopes: Callable,
    guess: jax.Array,
    scale: Callable,
    inverted: Callable,
    noise: Callable = lambda: jnp.zeros(()),
    rules: Rules = RULES,
) -> Solved:
    """Solve ``k = slopes(k)`` from ``guess``.

    ``scale(k)`` is the size that the plateau is measured against, ``inverted(k)`` a function from ``slopes - k`` to
    what Newton's method takes off k, and ``noise()`` the size at which the slopes are rounded, asked for where
    fixed-point iteration fails.
    """
    measure = rules.size(guess.shape[-1])
    first = fixed_point(slopes, guess, scale, rules=rules)
    done = first.converged
    size = jax.lax.cond(done, lambda: jnp.zeros(()), noise)

    def misfit(k):
        return slopes(k) - k

    def lost(s: Iteration, damped):
        return (s.made >= jnp.where(damped, 2, 1) * rules.newton) | ~jnp.isfinite(jnp.sum(s.k))

    def unsolved(s: Iteration, found):
        return ~done & ~s.settled(scale(s.k), rules, measure(found), size)

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
        restart = Iteration.begin(start)._replace(made=s.made), start_misfit
        s, found = jax.tree_util.tree_map(lambda a, b: jnp.where(again, a, b), restart, (s, found))
        damped, step_from, before = damped | again, inverted(s.k), s.made

        def reuse(carry):
            inner, found, _ = carry
            k, found, whole = improved(
                inner.k, step_from(found), jnp.linalg.norm(found), rules.plateau * scale(inner.k), damped
            )
            inner = inner.after(k, rules)
            return inner, found, jnp.where(whole, inner.made - before, rules.reuse)

        def goes_on(carry):
            inner, found, used = carry
            fresh = (used == 0) | ((used < rules.reuse) & (inner.rate < rules.stale))
            return fresh & unsolved(inner, found) & ~lost(inner, damped)

        s, found, _ = jax.lax.while_loop(goes_on, reuse, (s, found, jnp.zeros_like(s.made)))
        return s, found, damped

    def to_do(carry):
        s, found, damped = carry
        return unsolved(s, found) & ~(damped & lost(s, damped))

    start, start_misfit = jax.lax.cond(done, lambda: (guess, guess), lambda: better_start(misfit, guess))
    second, found, _ = jax.lax.while_loop(to_do, newton, (Iteration.begin(start), start_misfit, jnp.asarray(False)))
    k = jnp.where(done, first.k, second.k)
    converged = ~unsolved(second, found) & jnp.isfinite(jnp.sum(k))
    residual = jnp.where(done, first.residual, second.update)
    size = jnp.where(second.settled(scale(second.k), rules), 0.0, size)
    return Solved(k, converged, done | jnp.isfinite(second.update), residual, first.fixed_point, second.made, size)


def better_start(misfit: Callable, guess: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The guess, or a step of nothing where that solves the equations better, and the misfit there.

    Far out Newton may wander.
    """
    starts = jnp.stack([guess, jnp.zeros_like(guess)])
    found = jax.lax.map(misfit, starts)
    predicted = jnp.linalg.norm(found[0]) <= jnp.linalg.norm(found[1])
    return jnp.where(predicted, starts[0], starts[1]), jnp.where(predicted, found[0], found[1])


@jax.custom_batching.custom_vmap
def _inverse(matrix):
    """For Newton's method, which corrects what an inverse loses."""
    return jnp.linalg.inv(matrix)


@_inverse.def_vmap
def _inverses(axis_size, batched, matrices):
    # not by LAPACK, whose batched calls can wait for each other forever: see manifolds.matrices.linear.solve
    return inverse(matrices), True


class State(NamedTuple):
    """Everything a run carries from step to step."""

    x: jax.Array
    low: jax.Array  # what rounding has kept from x so far (compensated summation)
    k: jax.Array
    before: jax.Array  # the slopes of the step before the last
    energy: jax.Array
    entropy: jax.Array
    status: jax.Array
    step: jax.Array
    fixed_point: jax.Array
    newton: jax.Array
    most_iterations: jax.Array
    residual: (
        jax.Array
    )  # of the last step tried, as h |k - slopes(k)| / |x|, or h times the noise of the slopes for |x|
    worst_residual: jax.Array  # of the steps taken
    largest_energy: jax.Array  # over all steps, relative to the first: for laws between the saved states
    smallest_energy: jax.Array
    least_entropy_increment: jax.Array
    largest_energy_increment: jax.Array
    integral: jax.Array  # over time, of what relaxes: see relaxing()
    first_energy: jax.Array
    energy_sensitivity: jax.Array  # the largest over all steps: the size at which the function is rounded
    entropy_sensitivity: jax.Array


def first_state(system: System, method: OneStepMethod, x) -> State:
    """The state of a run about to start at x."""
    k = method.start(system, x)
    energy, entropy = values(system, x)
    sizes = sensitivities(system, x)
    zero, count = jnp.zeros(()), jnp.zeros((), dtype=jnp.int64)
    return State(
        x=x,
        low=jnp.zeros_like(x),
        k=k,
        before=k,
        energy=energy,
        entropy=entropy,
        status=count,
        step=count,
        fixed_point=count,
        newton=count,
        most_iterations=count,
        residual=zero,
        worst_residual=zero,
        largest_energy=energy,
        smallest_energy=energy,
        least_entropy_increment=jnp.asarray(jnp.inf),
        largest_energy_increment=jnp.asarray(-jnp.inf),
        integral=zero,
        first_energy=energy,
        energy_sensitivity=sizes[0],
        entropy_sensitivity=sizes[1],
    )


begin = program(first_state)


def take_step(system: System, method: OneStepMethod, state: State, h, rules: Rules = RULES) -> State:
    """One step; where it fails the state is left as it was, with a status."""

    def noise():
        return noise_of(system, state.x, rules)

    if method.explicit:
        solved = explicit(system, method, state.x, state.low, h, state.k, rules)
    else:
        inverted = newton_steps(system, method, state.x, state.low, h, rules)
        solved = solve_stages(*equations(system, method, state, h, rules), inverted, noise, rules)
    return conclude(system, method, state, h, solved, rules)


def explicit(system: System, method: OneStepMethod, x, low, h, k, rules: Rules = RULES) -> Solved:
    """The slopes of an explicit method, which there is nothing to solve for."""
    k = method.slopes(system, x, low, h, k)
    missed, none = method.missed(system, x, low, h, k), jnp.zeros((), dtype=jnp.int64)
    missed = rules.size(x.size)(jnp.zeros_like(x).at[0].set(missed))  # it is the length of a vector
    converged = missed <= rules.corrected * scale_of(x, h, k[0], rules)
    return Solved(k, converged, jnp.isfinite(missed), missed, none + 1, none, jnp.zeros(()))


def newton_steps(system: System, method: OneStepMethod, x, low, h, rules: Rules = RULES) -> Callable:
    """For each k a function from the misfit ``slopes - k`` to the step of Newton's method, linearised there."""

    def linearised(k) -> Callable:
        if k.shape[-1] > rules.large:
            product = jax.linearize(lambda d: method.change(system, x, low, h, k, d), jnp.zeros_like(k))[1]
            return lambda found: krylov(product, found, rules)
        inverse = _inverse(method.jacobian(system, x, low, h, k))
        return lambda found: (inverse @ found.ravel()).reshape(k.shape)

    return linearised


def equations(
    system: System, method: OneStepMethod, state: State, h, rules: Rules = RULES
) -> tuple[Callable, jax.Array, Callable]:
    """What a step has to solve, ``k = slopes(k)``: the slopes, a guess of k, and the size of what is rounded."""

    def slopes(k):
        return method.slopes(system, state.x, state.low, h, k)

    measure = rules.size(state.x.size)
    whole = measure(state.x) / h  # once a step

    return slopes, method.predict(state.k, state.before), lambda k: whole + measure(k) + rules.vanished


def scale_of(x, h, k, rules: Rules = RULES):
    """What updates of slopes are measured against."""
    measure = rules.size(x.size)
    return measure(x) / h + measure(k) + rules.vanished


def conclude(system: System, method: OneStepMethod, state: State, h, solved: Solved, rules: Rules = RULES) -> State:
    """The state after a step whose equations are solved, or as it was, with a status, where they are not."""
    x, low = state.x, state.low
    new, new_low, energy, entropy, check, *sizes = finish(system, method, x, low, h, solved.k, state.first_energy)
    good = solved.converged & jnp.isfinite(check)
    failure = jnp.where(solved.converged | ~solved.defined, int(Code.NON_FINITE), int(Code.NOT_CONVERGED))
    size = jnp.maximum(rules.size(x.size)(x), h * solved.noise)
    residual = h * solved.residual / jnp.where(size > 0.0, size, 1.0)
    iterations = solved.fixed_point + solved.newton
    mean = 0.5 * (relaxing(system, state.energy, state.entropy) + relaxing(system, energy, entropy))

    new_state = State(
        x=new,
        low=new_low,
        k=solved.k,
        before=state.k,
        energy=energy,
        entropy=entropy,
        status=state.status,
        step=state.step + 1,
        fixed_point=state.fixed_point + solved.fixed_point,
        newton=state.newton + solved.newton,
        most_iterations=jnp.maximum(state.most_iterations, iterations),
        residual=residual,
        worst_residual=jnp.maximum(state.worst_residual, residual),
        largest_energy=jnp.maximum(state.largest_energy, energy),
        smallest_energy=jnp.minimum(state.smallest_energy, energy),
        least_entropy_increment=jnp.minimum(state.least_entropy_increment, entropy - state.entropy),
        largest_energy_increment=jnp.maximum(state.largest_energy_increment, energy - state.energy),
        integral=state.integral + h * mean,
        first_energy=state.first_energy,
        energy_sensitivity=jnp.fmax(state.energy_sensitivity, sizes[0]),
        entropy_sensitivity=jnp.fmax(state.entropy_sensitivity, sizes[1]),
    )
    failed = state._replace(status=failure, residual=residual)
    return jax.tree_util.tree_map(lambda a, b: jnp.where(good, a, b), new_state, failed)


def advance(
    system: System,
    method: OneStepMethod,
    state: State,
    h,
    saves,
    every,
    capacity: int,
    rules: Rules = RULES,
    noise=None,
):
    """Up to ``saves <= capacity`` times ``every`` steps of size h; stops where a step fails.

    Returns the new state and, for each of ``capacity`` saves, the state vector, energy and entropy, and whether it was
    reached. ``noise`` has the increments of each step, shape (steps, increments); steps without any where it is None.
    """
    h, saves, every = (jnp.asarray(number) for number in (h, saves, every))  # arguments, not constants, to the compiler
    return _advance(system, method, state, h, saves, every, capacity, rules, noise)


@program
def _advance(system: System, method: OneStepMethod, state: State, h, saves, every, capacity: int, rules: Rules, noise):
    first = state.step

    def step(s: State) -> State:
        own = method if noise is None else method.driven_by(noise[s.step - first])
        return take_step(system, own, s, h, rules)

    def one_save(index, carry: tuple[State, tuple]):
        state, kept = carry
        target = state.step + every

        def goes_on(s: State):
            return (s.status == Code.COMPLETED) & (s.step < target)

        state = jax.lax.while_loop(goes_on, step, state)
        saved = state.x, state.energy, state.entropy, state.status == Code.COMPLETED
        return state, jax.tree_util.tree_map(lambda all_of, one: all_of.at[index].set(one), kept, saved)

    one = state.x, state.energy, state.entropy, jnp.zeros((), bool)
    kept = tuple(jnp.zeros((capacity, *a.shape), a.dtype) for a in one)
    return jax.lax.fori_loop(0, saves, one_save, (state, kept))  # as many passes as saves, whatever the capacity


KEPT_STATES, KEPT_NUMBERS = 1024, 2**16
"""States that one call keeps at most, and their components: enough to hide the cost of a call, few enough to show
progress."""


def portion_of(system: System) -> int:
    """The states that one call keeps at most: one number for all runs of a system, so that one program serves them."""
    return min(KEPT_STATES, max(1, KEPT_NUMBERS // system.dim))


class ArrayEngine:
    """The array engine for one system and method: an :class:`.choice.Engine`."""

    name = "array"

    def __init__(self, system: System, method: OneStepMethod, rules: Rules = RULES):
        self.system, self.method, self.rules = system, method, rules
        self.portion = portion_of(system)

    def begin(self, x) -> State:
        return begin(self.system, self.method, x)

    def advance(self, state: State, h, saves: int, every: int, noise=None):
        return advance(self.system, self.method, state, h, saves, every, self.portion, self.rules, rows(noise))

    def step(self, state: State, h, noise=None) -> State:
        return self.advance(state, h, 1, 1, noise)[0]


def rows(noise) -> jax.Array | None:
    """Increments, shape (..., steps, increments), with as many steps as a power of two: few shapes, few programs."""
    if noise is None:
        return None
    missing = (1 << max(0, noise.shape[-2] - 1).bit_length()) - noise.shape[-2]
    return jnp.asarray(np.pad(noise, [(0, 0)] * (noise.ndim - 2) + [(0, missing), (0, 0)]))


def error_of_step(system: System, method: OneStepMethod, x, low, h, k):
    """The method's estimate of its local error, a number; for both engines."""
    return _error(system, method, jnp.asarray(x), jnp.asarray(low), jnp.asarray(h), jnp.asarray(k))


@program
def _error(system, method, x, low, h, k):
    return method.error(system, x, low, h, k)


FEW, KRYLOV = 8, 24
"""Components up to which the whole Jacobian matrix of the motion is looked at at every step, and vectors from which its
growing modes are found otherwise."""

POWERS = 4
"""Times that the Jacobian matrix is applied to see how large it is."""


def stretch(system: System, x) -> jax.Array:
    """How the motion stretches what lies near a state.

    The Jacobian matrix, shape (n, n), of a few components; otherwise its first :data:`POWERS` powers times a vector,
    each over the size of the one before, shape (POWERS, n).
    """
    stretched, n = _linearised(system, x), x.shape[0]
    if n <= FEW:
        return jax.vmap(stretched)(jnp.eye(n)).T

    def power(v, _):
        v = stretched(v)
        return _unit(v), v

    return jax.lax.scan(power, _unit(_uneven(n)), length=POWERS)[1]


@program
def growing(system, method, x):
    """The matrix of the Jacobian in a Krylov space, shape (m, m): its eigenvalues lie near the outer ones [Arnoldi]."""
    system, x = method.judged(system, x)
    stretched, n = _linearised(system, x), x.shape[0]
    m = min(n, KRYLOV)

    def extended(carry, i):
        frame, matrix = carry
        v = stretched(frame[i])
        parts, rest = without(frame, v)
        length = jnp.linalg.norm(rest)
        closed = length <= 1e-10 * jnp.linalg.norm(v)  # a space that the motion keeps: go on outside of it
        length, rest = jnp.where(closed, 0.0, length), jnp.where(closed, jnp.roll(_uneven(n), i + 1), rest)
        matrix = matrix.at[:m, i].set(parts[:m]).at[i + 1, i].set(length)
        return (frame.at[i + 1].set(_unit(without(frame, _unit(rest))[1])), matrix), None

    def without(frame, v):
        parts = frame @ v
        v = v - parts @ frame
        again = frame @ v  # the second pass removes what rounding left of the first
        return parts + again, v - again @ frame

    frame = jnp.zeros((m + 1, n)).at[0].set(_unit(_uneven(n)))
    (_, matrix), _ = jax.lax.scan(extended, (frame, jnp.zeros((m + 1, m))), jnp.arange(m))
    return matrix[:m]


def _linearised(system: System, x) -> Callable:
    """The derivative of the motion at x, on tangent vectors."""
    return lambda v: system.tangent(x, jax.jvp(system.vector_field, (x,), (system.tangent(x, v),))[1])


def _uneven(n: int) -> np.ndarray:
    """A vector that has a part in every direction of interest."""
    return np.random.default_rng(0).standard_normal(n)


def _unit(v):
    length = jnp.linalg.norm(v)
    return v / jnp.where(length > 0.0, length, 1.0)


def finish(system: System, method: OneStepMethod, x, low, h, k, first_energy):
    """The end of a step: new state, what rounding keeps from it, energy, entropy, a sum that is finite if they are.

    And the sizes at which energy and entropy are rounded there.
    """
    new, new_low = method.move(system, x, low, h, k)
    energy, entropy = values(system, new)
    if system.energy_law == "conserved" and "energy" in method.preserves:
        new_low = new_low + _steering(system, new, new_low, energy, first_energy)
    return new, new_low, energy, entropy, jnp.sum(new) + energy + entropy, *sensitivities(system, new)


def _steering(system: System, x, low, energy, first_energy):
    """A shift of the state far below its rounding, at most ``eps |x| / 4``, along the gradient of the energy.

    Each step is exact but for a few roundings, whose sum walks at random: by 1e-13 in 1e6 steps for a general energy.
    Where it has come to more than a few roundings of H itself, it is taken back.
    """
    gradient = system.energy.gradient(x)
    error = (energy - first_energy) + jnp.dot(gradient, low)
    size = system.energy.sensitivity(x)
    most = 0.25 * EPS * size
    amount = jnp.where(jnp.abs(error) > RULES.steered * jnp.maximum(jnp.abs(first_energy), size), error, 0.0)
    direction = system.raised(x, gradient)
    square = jnp.dot(gradient, direction)
    return -direction * (jnp.clip(amount, -most, most) / jnp.where(square > 0.0, square, 1.0))


def values(system: System, x) -> tuple[jax.Array, jax.Array]:
    """Energy and entropy at one state, shape (n,); zero in place of an entropy that the system does not have."""
    entropy = jnp.zeros(()) if system.entropy is None else system.entropy.value(x)
    return system.energy.value(x), entropy


def sensitivities(system: System, x) -> tuple[jax.Array, jax.Array]:
    """The sizes at which energy and entropy are rounded at a state: see :meth:`liethermo.Energy.sensitivity`."""
    entropy = jnp.zeros(()) if system.entropy is None else system.entropy.sensitivity(x)
    return system.energy.sensitivity(x), entropy


def relaxing(system: System, energy, entropy):
    """The one of the two whose approach to equilibrium is timed: the energy under a double bracket, or the entropy."""
    return energy if system.energy_law == "nonincreasing" else entropy
