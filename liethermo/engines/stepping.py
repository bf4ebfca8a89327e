"""One step of any method on any system, in JAX: the state of a run, the step, and what is judged at its end."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from ..functions.energy import Energy
from ..integrators import OneStepMethod
from ..integrators.base import orderless, pulled
from ..integrators.explicit import LEVELS
from ..systems import System
from ..tracing.programs import hasty_program
from .codes import Code
from .rules import EPS, RULES, Rules
from .stages import Equations, Solved, explicit, fixed_point, newton_steps, noise_of, solve_stages


class State(NamedTuple):
    """Everything a run carries from step to step."""

    x: jax.Array
    compensation: jax.Array  # what rounding has kept from x so far (compensated summation)
    k: jax.Array
    before: jax.Array  # the slopes of the step before the last; none of an explicit method, which guesses nothing
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
    steering: jax.Array  # what the end of the next step is to be shifted by: see steering()
    energy_sensitivity: jax.Array  # the largest over all steps: the size at which the function is rounded
    entropy_sensitivity: jax.Array


TELLING = tuple(name for name in State._fields if name not in ("compensation", "k", "before", "steering"))
"""The fields that tell of a run: those that the next step alone needs are left out."""


def first_state(system: System, method: OneStepMethod, x) -> State:
    """The state of a run about to start at x."""
    k = method.start(system, x)
    energy, entropy = values(system, x)
    sizes = sensitivities(system, x)
    zero, count = jnp.zeros(()), jnp.zeros((), dtype=jnp.int64)
    return State(
        x=x,
        compensation=jnp.zeros_like(x),
        k=k,
        before=_of_guesses(method, k),
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
        steering=zero,
        energy_sensitivity=sizes[0],
        entropy_sensitivity=sizes[1],
    )


def _of_guesses(method: OneStepMethod, k) -> jax.Array:
    return k[:0] if method.explicit else k


begin = hasty_program(first_state)


def in_order(
    system: System, method: OneStepMethod, state: State, rules: Rules = RULES
) -> tuple[System, OneStepMethod, State, Callable[[State], State]]:
    """The three with many components in the order in which steps are fastest, and what takes states back."""
    found = system.arranged() if orderless(method) and state.x.size > rules.many else None
    if found is None:
        return system, method, state, lambda state: state

    def changed(s: State, change: Callable) -> State:
        k = change(s.k)
        k = k.at[LEVELS].set(s.k[LEVELS]) if method.explicit else k  # which are values of functions
        return s._replace(x=change(s.x), compensation=change(s.compensation), k=k, before=change(s.before))

    return found.system, pulled(method, found), changed(state, found.there), lambda s: changed(s, found.back)


def take_step(
    system: System, method: OneStepMethod, state: State, h, rules: Rules = RULES, second: Callable | None = None
) -> State:
    """One step; where it fails the state is left as it was, with a status.

    ``second(first, x, compensation, h, k, before)`` is asked in place of Newton's method, with what the first attempt
    on the equations has come to, by an engine that has it elsewhere.
    """
    system, method, state, back = in_order(system, method, state, rules)
    if not method.carries_rounding:
        state = state._replace(compensation=compensation_of(system, method, state.x, state.compensation))
    given = state.x, state.compensation, h, state.k, state.before
    if method.explicit:
        solved = explicit(system, method, *given[:4], rules)
    elif second is None:
        solved = solve_stages(equations(system, method, *given, rules), rules)
    else:
        solved = second(fixed_point(equations(system, method, *given, rules), rules), *given)
    return back(conclude(system, method, state, h, solved, rules))


def equations(
    system: System,
    method: OneStepMethod,
    x,
    compensation,
    h,
    k,
    before,
    rules: Rules = RULES,
    columns: Callable | None = None,
) -> Equations:
    """What a step from a state has to solve, with a guess from the slopes of the steps before."""
    own = system.solved_for(x)[1]
    measure = rules.size(own.size)
    whole = measure(own) / jnp.abs(h)  # once a step
    return Equations(
        slopes=lambda k: method.slopes(system, x, compensation, h, k),
        guess=method.predict(k, before),
        scale=lambda k: whole + measure(k) + rules.vanished,
        inverted=newton_steps(system, method, x, compensation, h, rules, columns),
        noise=lambda: noise_of(system, x, rules),
    )


def conclude(system: System, method: OneStepMethod, state: State, h, solved: Solved, rules: Rules = RULES) -> State:
    """The state after a step whose equations are solved, or as it was, with a status, where they are not."""
    x, compensation = state.x, state.compensation
    new, new_compensation, energy, entropy, check, *sizes = finish(system, method, x, compensation, h, solved.k)
    pending = state.steering
    if not method.carries_rounding:  # the next step makes its own, as it would if it were the first of a run
        new_compensation = system.of_clock(new_compensation)
    elif holds_energy(system, method):  # by what the last step left: so no step waits for its own
        new_compensation = shifted(system, new, new_compensation, pending)
        pending = steering(system, new, new_compensation, energy, state.first_energy)
    good = solved.converged & jnp.isfinite(check)
    failure = jnp.where(solved.converged | ~solved.defined, int(Code.NON_FINITE), int(Code.NOT_CONVERGED))
    own = system.solved_for(x)[1]
    size = jnp.maximum(rules.size(own.size)(own), h * solved.noise)
    residual = h * solved.residual / jnp.where(size > rules.vanished, size, 1.0)
    iterations = solved.fixed_point + solved.newton
    mean = 0.5 * (relaxing(system, state.energy, state.entropy) + relaxing(system, energy, entropy))

    new_state = State(
        x=new,
        compensation=new_compensation,
        k=solved.k,
        before=_of_guesses(method, state.k),
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
        steering=pending,
        energy_sensitivity=jnp.fmax(state.energy_sensitivity, sizes[0]),
        entropy_sensitivity=jnp.fmax(state.entropy_sensitivity, sizes[1]),
    )
    failed = state._replace(status=failure.astype(state.status.dtype), residual=residual)
    if x.size > rules.large:  # a choice entry by entry would read both
        return jax.lax.cond(good, lambda: new_state, lambda: failed)
    return jax.tree_util.tree_map(lambda a, b: jnp.where(good, a, b), new_state, failed)


def finish(system: System, method: OneStepMethod, x, compensation, h, k):
    """The end of a step: new state, what rounding keeps from it, energy, entropy, a sum that is finite if they are.

    And the sizes at which energy and entropy are rounded there.
    """
    new, new_compensation = method.move(system, x, compensation, h, k)
    energy, entropy = values(system, new)
    return new, new_compensation, energy, entropy, jnp.sum(new) + energy + entropy, *sensitivities(system, new)


def holds_energy(system: System, method: OneStepMethod) -> bool:
    """Whether rounding is all that moves the energy, so that it can be steered back."""
    return system.energy_law == "conserved" and "energy" in method.preserves


def steering(system: System, x, compensation, energy, first_energy) -> jax.Array:
    """How far along the gradient of the energy a state is to be shifted back: by ``eps |x| / 4`` at most.

    Each step is exact but for a few roundings, whose sum walks at random: by 1e-13 in 1e6 steps for a general energy.
    Where it has come to more than a few roundings of H itself, it is taken back, far below the rounding of the state.
    Beside a large constant in H discrete gradients leave out defects below its rounding: there as much as one rounding
    of it is taken back.
    """
    return shift_to_level(system, system.energy, x, compensation, energy, first_energy)


def shift_to_level(system: System, function: Energy, x, compensation, value, level) -> jax.Array:
    """Return how far along the gradient of a function x is to be shifted back, so that its value comes nearer a level.

    By ``eps |x| / 4`` at most, and only if value and level differ by more than a few roundings.
    """
    gradient = function.gradient(x)
    error = (value - level) + jnp.dot(gradient, compensation)
    value, size = jnp.abs(level), function.sensitivity(x)
    most = EPS * jnp.maximum(0.25 * size, value - RULES.constant * size)
    amount = jnp.where(jnp.abs(error) > RULES.steered * jnp.maximum(value, size), error, 0.0)
    square = jnp.dot(gradient, system.raised(x, gradient))
    return jnp.clip(amount, -most, most) / jnp.where(square > 0.0, square, 1.0)


LEVEL_SPACING = 32.0
"""Spacing of the levels of :func:`nearest_level`, in roundings of the function. A value that is off by half of it may
go over to the next level. In 1e6 steps rounding does not come so far, as :func:`shift_to_level` takes it back. With
half of this spacing it does, and drifts by 6e-14."""


def nearest_level(value, size) -> jax.Array:
    """Return the number next to a value that is a multiple of 16 to 32 roundings of a function of some size.

    These are the levels that a run is held on that knows its present state alone: what is near a level stays there.
    """
    large = LEVEL_SPACING * size
    return (value + large) - large


def compensation_of(system: System, method: OneStepMethod, x, of_clock) -> jax.Array:
    """Return the compensation of a step that starts from x, shape (n,), where nothing is known but x and its clock's.

    It shifts the state by less than its rounding: to the surface that it belongs to, and to a level of each function
    that the method conserves. Without, the rounding of states would add up, and not to zero in the mean.
    """
    compensation = of_clock + method.resumed(system, x)
    functions = [C for name, C in system.functions().items() if name in method.held_names]
    for function in [*([system.energy] if holds_energy(system, method) else []), *functions]:
        value, gradient = function.value(x), function.gradient(x)
        level = nearest_level(value, jnp.maximum(jnp.abs(value), function.sensitivity(x)))
        amount = shift_to_level(system, function, x, compensation, value, level)
        compensation = compensation - amount * system.raised(x, gradient)
    return compensation


def shifted(system: System, x, compensation, amount) -> jax.Array:
    """``compensation`` of a state that is shifted back along the gradient of the energy."""
    return compensation - amount * system.raised(x, system.energy.gradient(x))


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
