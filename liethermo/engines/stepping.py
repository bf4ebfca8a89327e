"""One step of any method on any system, in JAX: the state of a run, the step, and what is judged at its end."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from ..functions.energy import Energy
from ..integrators import OneStepMethod
from ..integrators.base import is_permutation_equivariant, pullback_method
from ..integrators.explicit import StepRow
from ..systems import System
from ..tracing.programs import jit_unoptimised
from .codes import StatusCode
from .rules import DEFAULT_OPTIONS, EPS, SolverOptions
from .stages import (
    StageEquations,
    StageSolution,
    explicit_slopes,
    make_newton_solve,
    slope_rounding_scale,
    solve_fixed_point,
    solve_stages,
)


class State(NamedTuple):
    """Everything a run carries from step to step."""

    x: jax.Array
    compensation: jax.Array  # what rounding has kept from x so far (compensated summation)
    k: jax.Array
    previous_slopes: (
        jax.Array
    )  # the slopes of the step before the last; none of an explicit method, which guesses nothing
    energy: jax.Array
    entropy: jax.Array
    status: jax.Array
    step: jax.Array
    fixed_point_iterations: jax.Array
    newton_iterations: jax.Array
    most_iterations: jax.Array
    residual: (
        jax.Array
    )  # of the last step tried, as h |k - slopes(k)| / |x|, or h times the noise of the slopes for |x|
    worst_residual: jax.Array  # of the steps taken
    largest_energy: jax.Array  # over all steps, relative to the first: for laws between the saved states
    smallest_energy: jax.Array
    least_entropy_increment: jax.Array
    largest_energy_increment: jax.Array
    relaxation_integral: jax.Array  # over time, of what relaxes: see relaxing()
    first_energy: jax.Array
    energy_drift_correction: jax.Array  # what the end of the next step is to be shifted by: see steering()
    energy_sensitivity: jax.Array  # the largest over all steps: the size at which the function is rounded
    entropy_sensitivity: jax.Array


REPORTED_FIELDS = tuple(
    name for name in State._fields if name not in ("compensation", "k", "previous_slopes", "energy_drift_correction")
)
"""The fields that tell of a run: those that the next step alone needs are left out."""


def initial_run_state(system: System, method: OneStepMethod, x) -> State:
    """The state of a run about to start at x."""
    k = method.start(system, x)
    energy, entropy = energy_and_entropy_at(system, x)
    sizes = rounding_sensitivities(system, x)
    zero, count = jnp.zeros(()), jnp.zeros((), dtype=jnp.int64)
    return State(
        x=x,
        compensation=jnp.zeros_like(x),
        k=k,
        previous_slopes=_slopes_for_prediction(method, k),
        energy=energy,
        entropy=entropy,
        status=count,
        step=count,
        fixed_point_iterations=count,
        newton_iterations=count,
        most_iterations=count,
        residual=zero,
        worst_residual=zero,
        largest_energy=energy,
        smallest_energy=energy,
        least_entropy_increment=jnp.asarray(jnp.inf),
        largest_energy_increment=jnp.asarray(-jnp.inf),
        relaxation_integral=zero,
        first_energy=energy,
        energy_drift_correction=zero,
        energy_sensitivity=sizes[0],
        entropy_sensitivity=sizes[1],
    )


def _slopes_for_prediction(method: OneStepMethod, k) -> jax.Array:
    return k[:0] if method.explicit else k


initial_run_state_program = jit_unoptimised(initial_run_state)


def reorder_components(
    system: System, method: OneStepMethod, state: State, rules: SolverOptions = DEFAULT_OPTIONS
) -> tuple[System, OneStepMethod, State, Callable[[State], State]]:
    """The three with many components in the order in which steps are fastest, and what takes states back."""
    found = (
        system.reorder_components()
        if is_permutation_equivariant(method) and state.x.size > rules.rms_norm_dim
        else None
    )
    if found is None:
        return system, method, state, lambda state: state

    def permute_state(s: State, change: Callable) -> State:
        k = change(s.k)
        k = (
            k.at[StepRow.INITIAL_LEVELS].set(s.k[StepRow.INITIAL_LEVELS]) if method.explicit else k
        )  # which are values of functions
        return s._replace(
            x=change(s.x), compensation=change(s.compensation), k=k, previous_slopes=change(s.previous_slopes)
        )

    return (
        found.system,
        pullback_method(method, found),
        permute_state(state, found.reorder_state),
        lambda s: permute_state(s, found.restore_state),
    )


def take_step(
    system: System,
    method: OneStepMethod,
    state: State,
    h,
    options: SolverOptions = DEFAULT_OPTIONS,
    newton_fallback: Callable | None = None,
) -> State:
    """One step; where it fails the state is left as it was, with a status.

    ``second(first, x, compensation, h, k, before)`` is asked in place of Newton's method, with what the first attempt
    on the equations has come to, by an engine that has it elsewhere.
    """
    system, method, state, back = reorder_components(system, method, state, options)
    if not method.carries_compensation:
        state = state._replace(compensation=compensation_from_state(system, method, state.x, state.compensation))
    given = state.x, state.compensation, h, state.k, state.previous_slopes
    if method.explicit:
        solved = explicit_slopes(system, method, *given[:4], options)
    elif newton_fallback is None:
        solved = solve_stages(stage_equations(system, method, *given, options), options)
    else:
        solved = newton_fallback(solve_fixed_point(stage_equations(system, method, *given, options), options), *given)
    return back(finish_step(system, method, state, h, solved, options))


def stage_equations(
    system: System,
    method: OneStepMethod,
    x,
    compensation,
    h,
    k,
    before,
    rules: SolverOptions = DEFAULT_OPTIONS,
    columns: Callable | None = None,
) -> StageEquations:
    """What a step from a state has to solve, with a guess from the slopes of the steps before."""
    own = system.solved_part(x)[1]
    measure = rules.norm_for_dim(own.size)
    whole = measure(own) / jnp.abs(h)  # once a step
    return StageEquations(
        slopes=lambda k: method.slopes(system, x, compensation, h, k),
        guess=method.predict(k, before),
        scale=lambda k: whole + measure(k) + rules.tiny,
        newton_solve_at=make_newton_solve(system, method, x, compensation, h, rules, columns),
        slope_rounding=lambda: slope_rounding_scale(system, x, rules),
    )


def finish_step(
    system: System,
    method: OneStepMethod,
    state: State,
    h,
    solved: StageSolution,
    rules: SolverOptions = DEFAULT_OPTIONS,
) -> State:
    """The state after a step whose equations are solved, or as it was, with a status, where they are not."""
    x, compensation = state.x, state.compensation
    new, new_compensation, energy, entropy, check, *sizes = end_of_step(system, method, x, compensation, h, solved.k)
    pending = state.energy_drift_correction
    if not method.carries_compensation:  # the next step makes its own, as it would if it were the first of a run
        new_compensation = system.clock_components(new_compensation)
    elif can_correct_energy_drift(system, method):  # by what the last step left: so no step waits for its own
        new_compensation = apply_drift_correction(system, new, new_compensation, pending)
        pending = energy_drift_correction(system, new, new_compensation, energy, state.first_energy)
    good = solved.converged & jnp.isfinite(check)
    failure = jnp.where(solved.converged | ~solved.is_finite, int(StatusCode.NON_FINITE), int(StatusCode.NOT_CONVERGED))
    own = system.solved_part(x)[1]
    size = jnp.maximum(rules.norm_for_dim(own.size)(own), h * solved.slope_rounding)
    residual = h * solved.residual / jnp.where(size > rules.tiny, size, 1.0)
    iterations = solved.fixed_point_iterations + solved.newton_iterations
    mean = 0.5 * (
        relaxation_functional(system, state.energy, state.entropy) + relaxation_functional(system, energy, entropy)
    )

    new_state = State(
        x=new,
        compensation=new_compensation,
        k=solved.k,
        previous_slopes=_slopes_for_prediction(method, state.k),
        energy=energy,
        entropy=entropy,
        status=state.status,
        step=state.step + 1,
        fixed_point_iterations=state.fixed_point_iterations + solved.fixed_point_iterations,
        newton_iterations=state.newton_iterations + solved.newton_iterations,
        most_iterations=jnp.maximum(state.most_iterations, iterations),
        residual=residual,
        worst_residual=jnp.maximum(state.worst_residual, residual),
        largest_energy=jnp.maximum(state.largest_energy, energy),
        smallest_energy=jnp.minimum(state.smallest_energy, energy),
        least_entropy_increment=jnp.minimum(state.least_entropy_increment, entropy - state.entropy),
        largest_energy_increment=jnp.maximum(state.largest_energy_increment, energy - state.energy),
        relaxation_integral=state.relaxation_integral + h * mean,
        first_energy=state.first_energy,
        energy_drift_correction=pending,
        energy_sensitivity=jnp.fmax(state.energy_sensitivity, sizes[0]),
        entropy_sensitivity=jnp.fmax(state.entropy_sensitivity, sizes[1]),
    )
    failed = state._replace(status=failure.astype(state.status.dtype), residual=residual)
    if x.size > rules.matrix_free_dim:  # a choice entry by entry would read both
        return jax.lax.cond(good, lambda: new_state, lambda: failed)
    return jax.tree_util.tree_map(lambda a, b: jnp.where(good, a, b), new_state, failed)


def end_of_step(system: System, method: OneStepMethod, x, compensation, h, k):
    """The end of a step: new state, what rounding keeps from it, energy, entropy, a sum that is finite if they are.

    And the sizes at which energy and entropy are rounded there.
    """
    new, new_compensation = method.move(system, x, compensation, h, k)
    energy, entropy = energy_and_entropy_at(system, new)
    return new, new_compensation, energy, entropy, jnp.sum(new) + energy + entropy, *rounding_sensitivities(system, new)


def can_correct_energy_drift(system: System, method: OneStepMethod) -> bool:
    """Whether rounding is all that moves the energy, so that it can be steered back."""
    return system.energy_law == "conserved" and "energy" in method.preserves


def energy_drift_correction(system: System, x, compensation, energy, first_energy) -> jax.Array:
    """How far along the gradient of the energy a state is to be shifted back: by ``eps |x| / 4`` at most.

    Each step is exact but for a few roundings, whose sum walks at random: by 1e-13 in 1e6 steps for a general energy.
    Where it has come to more than a few roundings of H itself, it is taken back, far below the rounding of the state.
    Beside a large constant in H discrete gradients leave out defects below its rounding: there as much as one rounding
    of it is taken back.
    """
    return drift_correction(system, system.energy, x, compensation, energy, first_energy)


def drift_correction(system: System, function: Energy, x, compensation, value, level) -> jax.Array:
    """Return how far along the gradient of a function x is to be shifted back, so that its value comes nearer a level.

    By ``eps |x| / 4`` at most, and only if value and level differ by more than a few roundings.
    """
    gradient = function.gradient(x)
    error = (value - level) + jnp.dot(gradient, compensation)
    value, size = jnp.abs(level), function.sensitivity(x)
    most = EPS * jnp.maximum(0.25 * size, value - DEFAULT_OPTIONS.large_offset_ratio * size)
    amount = jnp.where(jnp.abs(error) > DEFAULT_OPTIONS.drift_threshold * jnp.maximum(value, size), error, 0.0)
    square = jnp.dot(gradient, system.raise_index(x, gradient))
    return jnp.clip(amount, -most, most) / jnp.where(square > 0.0, square, 1.0)


LEVEL_SPACING_ULPS = 32.0
"""Spacing of the levels of :func:`nearest_level`, in roundings of the function. A value that is off by half of it may
go over to the next level. In 1e6 steps rounding does not come so far, as :func:`drift_correction` takes it back. With
half of this spacing it does, and drifts by 6e-14."""


def nearest_level(value, size) -> jax.Array:
    """Return the number next to a value that is a multiple of 16 to 32 roundings of a function of some size.

    These are the levels that a run is held on that knows its present state alone: what is near a level stays there.
    """
    large = LEVEL_SPACING_ULPS * size
    return (value + large) - large


def compensation_from_state(system: System, method: OneStepMethod, x, of_clock) -> jax.Array:
    """Return the compensation of a step that starts from x, shape (n,), where nothing is known but x and its clock's.

    It shifts the state by less than its rounding: to the surface that it belongs to, and to a level of each function
    that the method conserves. Without, the rounding of states would add up, and not to zero in the mean.
    """
    compensation = of_clock + method.initial_compensation(system, x)
    functions = [C for name, C in system.functions().items() if name in method.invariant_names]
    for function in [*([system.energy] if can_correct_energy_drift(system, method) else []), *functions]:
        value, gradient = function.value(x), function.gradient(x)
        level = nearest_level(value, jnp.maximum(jnp.abs(value), function.sensitivity(x)))
        amount = drift_correction(system, function, x, compensation, value, level)
        compensation = compensation - amount * system.raise_index(x, gradient)
    return compensation


def apply_drift_correction(system: System, x, compensation, amount) -> jax.Array:
    """``compensation`` of a state that is shifted back along the gradient of the energy."""
    return compensation - amount * system.raise_index(x, system.energy.gradient(x))


def energy_and_entropy_at(system: System, x) -> tuple[jax.Array, jax.Array]:
    """Energy and entropy at one state, shape (n,); zero in place of an entropy that the system does not have."""
    entropy = jnp.zeros(()) if system.entropy is None else system.entropy.value(x)
    return system.energy.value(x), entropy


def rounding_sensitivities(system: System, x) -> tuple[jax.Array, jax.Array]:
    """The sizes at which energy and entropy are rounded at a state: see :meth:`liethermo.Energy.sensitivity`."""
    entropy = jnp.zeros(()) if system.entropy is None else system.entropy.sensitivity(x)
    return system.energy.sensitivity(x), entropy


def relaxation_functional(system: System, energy, entropy):
    """The one of the two whose approach to equilibrium is timed: the energy under a double bracket, or the entropy."""
    return energy if system.energy_law == "nonincreasing" else entropy
