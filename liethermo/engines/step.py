"""One step of any method on any system, in JAX: the state of a run, the step, and the checks at its end."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ..functions.energy import Energy
from ..integrators import OneStepMethod
from ..integrators.base import is_permutation_equivariant, pullback_method
from ..integrators.explicit import StepRow
from ..systems import System
from ..systems.clock import add_energy_jump_to_work, keep_clock_components, system_between_breaks
from ..systems.spins import reorder_spins
from ..tracing.programs import jit_unoptimised
from .solver_options import DEFAULT_OPTIONS, EPS, SolverOptions
from .stage_solver import (
    StageEquations,
    StageSolution,
    explicit_stage_solution,
    make_newton_lineariser,
    slope_rounding_scale,
    solve_fixed_point,
    solve_stages,
)
from .status_codes import StatusCode


class State(NamedTuple):
    """The state of a run that is carried from step to step."""

    x: jax.Array
    compensation: jax.Array  # rounding errors of x so far (compensated summation)
    k: jax.Array  # slopes of the last step
    previous_slopes: jax.Array  # slopes of the step before, to extrapolate from; empty for an explicit method
    energy: jax.Array
    entropy: jax.Array
    status: jax.Array
    step: jax.Array
    fixed_point_iterations: jax.Array
    newton_iterations: jax.Array
    most_iterations: jax.Array
    residual: jax.Array  # h |k - slopes(k)| / max(|x|, h slope_rounding) of the last attempted step
    worst_residual: jax.Array  # largest residual of the accepted steps
    largest_energy: jax.Array  # over all steps, so that the laws can be judged between the saved states
    smallest_energy: jax.Array
    least_entropy_increment: jax.Array
    largest_energy_increment: jax.Array
    relaxation_integral: jax.Array  # time integral of energy_or_entropy_that_relaxes()
    first_energy: jax.Array
    energy_drift_correction: jax.Array  # shift of the next step's end along the energy gradient
    energy_sensitivity: jax.Array  # rounding scale of the energy, the largest over all steps
    entropy_sensitivity: jax.Array


class SavedStates(NamedTuple):
    """The states that one call of an engine saved, up to the last save time that the run reached."""

    x: np.ndarray  # shape (saves, n)
    energy_and_entropy: np.ndarray  # shape (saves, 2)


REPORTED_FIELDS = tuple(
    name for name in State._fields if name not in ("compensation", "k", "previous_slopes", "energy_drift_correction")
)
"""Fields of a state that are reported to the user; only the next step needs the others."""


def initial_run_state(system: System, method: OneStepMethod, x) -> State:
    """Return the state of a run that starts at x, shape (n,)."""
    k = method.start(system, x)
    energy, entropy = energy_and_entropy_at(system, x)
    sensitivities = rounding_sensitivities(system, x)
    zero, zero_count = jnp.zeros(()), jnp.zeros((), dtype=jnp.int64)
    return State(
        x=x,
        compensation=jnp.zeros_like(x),
        k=k,
        previous_slopes=_slopes_for_prediction(method, k),
        energy=energy,
        entropy=entropy,
        status=zero_count,
        step=zero_count,
        fixed_point_iterations=zero_count,
        newton_iterations=zero_count,
        most_iterations=zero_count,
        residual=zero,
        worst_residual=zero,
        largest_energy=energy,
        smallest_energy=energy,
        least_entropy_increment=jnp.asarray(jnp.inf),
        largest_energy_increment=jnp.asarray(-jnp.inf),
        relaxation_integral=zero,
        first_energy=energy,
        energy_drift_correction=zero,
        energy_sensitivity=sensitivities[0],
        entropy_sensitivity=sensitivities[1],
    )


def _slopes_for_prediction(method: OneStepMethod, k) -> jax.Array:
    """Return the slopes k that the next step needs for its prediction; none for an explicit method."""
    return k[:0] if method.explicit else k


initial_run_state_program = jit_unoptimised(initial_run_state)


def reorder_components(
    system: System, method: OneStepMethod, state: State, options: SolverOptions = DEFAULT_OPTIONS
) -> tuple[System, OneStepMethod, State, Callable[[State], State]]:
    """Return system, method and state with the components in the fastest order, and a function that restores states.

    Only systems of more than ``options.rms_norm_dim`` components are reordered.
    """
    can_reorder = is_permutation_equivariant(method) and state.x.size > options.rms_norm_dim
    reordering = reorder_spins(system) if can_reorder else None
    if reordering is None:
        return system, method, state, lambda state: state

    def permute_state(s: State, permute: Callable) -> State:
        k = permute(s.k)
        if method.explicit:  # this row holds values of functions, which have no components
            k = k.at[StepRow.INITIAL_LEVELS].set(s.k[StepRow.INITIAL_LEVELS])
        return s._replace(
            x=permute(s.x), compensation=permute(s.compensation), k=k, previous_slopes=permute(s.previous_slopes)
        )

    return (
        reordering.system,
        pullback_method(method, reordering),
        permute_state(state, reordering.reorder_state),
        lambda s: permute_state(s, reordering.restore_state),
    )


def system_and_state_after_jump(system: System, x, energy_before) -> tuple[System, jax.Array]:
    """Return the system and the state x with which a step starts, after a jump at a break of the time span.

    They differ from those given only in a run with breaks, at which functions of time jump.

    Parameters
    ----------
    system : System
    x : array, shape (n,)
    energy_before : array, shape ()
        The energy at the end of the last step, before a jump.
    """
    step_system = system_between_breaks(system, x)
    if system.clock is not None and system.clock.can_energy_jump:
        x = add_energy_jump_to_work(system.clock, x, step_system.energy.value(x) - energy_before)
    return step_system, x


def take_step(
    system: System,
    method: OneStepMethod,
    state: State,
    h,
    options: SolverOptions = DEFAULT_OPTIONS,
    newton_fallback: Callable | None = None,
) -> State:
    """Return the state after one step of size h; if the step fails, the old state with a failure status.

    An engine that has Newton's method elsewhere passes ``newton_fallback(fixed_point_result, x, compensation, h, k,
    previous_slopes)``, which replaces it.
    """
    system, x = system_and_state_after_jump(system, state.x, state.energy)
    state = state._replace(x=x)
    system, method, state, restore_order = reorder_components(system, method, state, options)
    if not method.carries_compensation:
        state = state._replace(compensation=compensation_from_state(system, method, state.x, state.compensation))
    stage_inputs = state.x, state.compensation, h, state.k, state.previous_slopes
    if method.explicit:
        solution = explicit_stage_solution(system, method, *stage_inputs[:4], options)
    elif newton_fallback is None:
        solution = solve_stages(stage_equations(system, method, *stage_inputs, options), options)
    else:
        solution = newton_fallback(
            solve_fixed_point(stage_equations(system, method, *stage_inputs, options), options), *stage_inputs
        )
    return restore_order(finish_step(system, method, state, h, solution, options))


def stage_equations(
    system: System,
    method: OneStepMethod,
    x,
    compensation,
    h,
    k,
    previous_slopes,
    options: SolverOptions = DEFAULT_OPTIONS,
    map_function: Callable | None = None,
) -> StageEquations:
    """Return the stage equations of a step from x; their initial guess is extrapolated from earlier slopes."""
    components = system.subsystem_to_solve(x)[1]
    norm = options.norm_for_dim(components.size)
    state_rate = norm(components) / jnp.abs(h)  # computed once per step
    return StageEquations(
        slopes=lambda k: method.slopes(system, x, compensation, h, k),
        guess=method.predict(k, previous_slopes),
        scale=lambda k: state_rate + norm(k) + options.tiny,
        newton_solve_at=make_newton_lineariser(system, method, x, compensation, h, options, map_function),
        slope_rounding=lambda: slope_rounding_scale(system, x, options),
    )


def finish_step(
    system: System,
    method: OneStepMethod,
    state: State,
    h,
    solution: StageSolution,
    options: SolverOptions = DEFAULT_OPTIONS,
) -> State:
    """Return the state after a step whose stage equations are solved, or the old state with a failure status."""
    x, compensation = state.x, state.compensation
    end = end_of_step(system, method, x, compensation, h, solution.k)
    new_x, new_compensation, energy, entropy = end.x, end.compensation, end.energy, end.entropy
    correction = state.energy_drift_correction
    if not method.carries_compensation:  # the next step computes its own, as the first step of a run does
        new_compensation = keep_clock_components(system, new_compensation)
    elif can_correct_energy_drift(system, method):  # by the error of the last step: no step waits for its own energy
        new_compensation = compensation_after_drift_correction(system, new_x, new_compensation, correction)
        correction = energy_drift_multiplier(system, new_x, new_compensation, energy, state.first_energy)
    is_taken = solution.converged & jnp.isfinite(end.finite_check)
    failure_code = jnp.where(
        solution.converged | ~solution.is_finite, int(StatusCode.NON_FINITE), int(StatusCode.NOT_CONVERGED)
    )
    components, end_components = system.subsystem_to_solve(x)[1], system.subsystem_to_solve(new_x)[1]
    norm = options.norm_for_dim(components.size)
    # the larger of both ends: a step from rest may start at the state zero
    residual_scale = jnp.maximum(jnp.maximum(norm(components), norm(end_components)), h * solution.slope_rounding)
    residual = h * solution.residual / jnp.where(residual_scale > options.tiny, residual_scale, 1.0)
    iterations = solution.fixed_point_iterations + solution.newton_iterations
    mean_functional = 0.5 * (
        energy_or_entropy_that_relaxes(system, state.energy, state.entropy)
        + energy_or_entropy_that_relaxes(system, energy, entropy)
    )

    new_state = State(
        x=new_x,
        compensation=new_compensation,
        k=solution.k,
        previous_slopes=_slopes_for_prediction(method, state.k),
        energy=energy,
        entropy=entropy,
        status=state.status,
        step=state.step + 1,
        fixed_point_iterations=state.fixed_point_iterations + solution.fixed_point_iterations,
        newton_iterations=state.newton_iterations + solution.newton_iterations,
        most_iterations=jnp.maximum(state.most_iterations, iterations),
        residual=residual,
        worst_residual=jnp.maximum(state.worst_residual, residual),
        largest_energy=jnp.maximum(state.largest_energy, energy),
        smallest_energy=jnp.minimum(state.smallest_energy, energy),
        least_entropy_increment=jnp.minimum(state.least_entropy_increment, entropy - state.entropy),
        largest_energy_increment=jnp.maximum(state.largest_energy_increment, energy - state.energy),
        relaxation_integral=state.relaxation_integral + h * mean_functional,
        first_energy=state.first_energy,
        energy_drift_correction=correction,
        energy_sensitivity=jnp.fmax(state.energy_sensitivity, end.energy_sensitivity),
        entropy_sensitivity=jnp.fmax(state.entropy_sensitivity, end.entropy_sensitivity),
    )
    failed_state = state._replace(status=failure_code.astype(state.status.dtype), residual=residual)
    if x.size > options.matrix_free_dim:  # an entrywise choice would read both states
        return jax.lax.cond(is_taken, lambda: new_state, lambda: failed_state)
    return jax.tree_util.tree_map(lambda a, b: jnp.where(is_taken, a, b), new_state, failed_state)


class StepEnd(NamedTuple):
    """The state vector at the end of a step, with values of functions there."""

    x: jax.Array
    compensation: jax.Array
    energy: jax.Array
    entropy: jax.Array
    finite_check: jax.Array  # a sum that is finite if the state, the energy and the entropy are
    energy_sensitivity: jax.Array
    entropy_sensitivity: jax.Array


def end_of_step(system: System, method: OneStepMethod, x, compensation, h, k) -> StepEnd:
    """Return the state vector and the values of functions at the end of a step with slopes k."""
    new_x, new_compensation = method.move(system, x, compensation, h, k)
    energy, entropy = energy_and_entropy_at(system, new_x)
    finite_check = jnp.sum(new_x) + energy + entropy
    return StepEnd(new_x, new_compensation, energy, entropy, finite_check, *rounding_sensitivities(system, new_x))


def can_correct_energy_drift(system: System, method: OneStepMethod) -> bool:
    """Return whether only rounding changes the energy, so that its drift may be corrected."""
    return system.energy_law == "conserved" and "energy" in method.preserves


def energy_drift_multiplier(system: System, x, compensation, energy, first_energy) -> jax.Array:
    """Return the multiple of ∇H to subtract from x to correct the drift of the energy.

    The shift is at most ``eps |x| / 4``.
    Each step is exact up to a few roundings, whose sum is a random walk: 1e-13 in 1e6 steps for a general energy. A sum
    above a few roundings of H itself is corrected, far below the rounding of the state. If H contains a large constant,
    discrete gradients leave out defects below the rounding of that constant: then up to one such rounding is corrected.
    """
    return drift_correction_multiplier(system, system.energy, x, compensation, energy, first_energy)


MAX_DRIFT_DISPLACEMENT = 1e-10
"""Largest displacement by a drift correction, relative to the state; larger ones are skipped.

Where a driven body comes to rest, the gradient of its energy vanishes and the work does not: the rounding of the work
would move the body by any amount."""


def drift_correction_multiplier(system: System, function: Energy, x, compensation, value, level) -> jax.Array:
    """Return the multiple of ∇F to subtract from x so that the function F approaches its value ``level``.

    The shift is about ``eps |x| / 4`` at most, and zero unless value and level differ by more than a few roundings.
    """
    gradient = function.gradient(x)
    error = (value - level) + jnp.dot(gradient, compensation)
    value, sensitivity = jnp.abs(level), function.sensitivity(x)
    max_shift = EPS * jnp.maximum(0.25 * sensitivity, value - DEFAULT_OPTIONS.large_offset_ratio * sensitivity)
    amount = jnp.where(jnp.abs(error) > DEFAULT_OPTIONS.drift_threshold * jnp.maximum(value, sensitivity), error, 0.0)
    direction = system.raise_index(x, gradient)
    squared_norm = jnp.dot(gradient, direction)
    multiplier = jnp.clip(amount, -max_shift, max_shift) / jnp.where(squared_norm > 0.0, squared_norm, 1.0)
    displacement = jnp.abs(multiplier) * jnp.max(jnp.abs(direction))
    return jnp.where(displacement <= MAX_DRIFT_DISPLACEMENT * jnp.max(jnp.abs(x)), multiplier, 0.0)


LEVEL_SPACING_ULPS = 32.0
"""Spacing of the levels of :func:`round_to_nearest_level`, in roundings of the function.

A value that is off by half of the spacing may go to the next level. In 1e6 steps rounding does not accumulate so far,
since :func:`drift_correction_multiplier` removes it. With half of this spacing it does, and the energy drifts by 6e-14.
"""


def round_to_nearest_level(value, sensitivity) -> jax.Array:
    """Return ``value`` rounded to a level: a multiple of 16 to 32 rounding errors of a function.

    A run that knows only its present state is held on these levels: a value near a level stays there.
    """
    shift = LEVEL_SPACING_ULPS * sensitivity
    return (value + shift) - shift


def compensation_from_state(system: System, method: OneStepMethod, x, clock_compensation) -> jax.Array:
    """Return the compensation of a step, shape (n,), from its state x and the compensation of its clock.

    It shifts the state by less than its rounding: onto its constraint surface, and to a level of each function that the
    method conserves. Without it the roundings of the states would add up, with a mean that is not zero.
    """
    compensation = clock_compensation + method.initial_compensation(system, x)
    functions = [C for name, C in system.functions().items() if name in method.invariant_names]
    for function in [*([system.energy] if can_correct_energy_drift(system, method) else []), *functions]:
        value, gradient = function.value(x), function.gradient(x)
        level = round_to_nearest_level(value, jnp.maximum(jnp.abs(value), function.sensitivity(x)))
        amount = drift_correction_multiplier(system, function, x, compensation, value, level)
        compensation = compensation - amount * system.raise_index(x, gradient)
    return compensation


def compensation_after_drift_correction(system: System, x, compensation, multiplier) -> jax.Array:
    """Return the compensation of a state shifted by ``-multiplier`` along the gradient of the energy."""
    return compensation - multiplier * system.raise_index(x, system.energy.gradient(x))


def energy_and_entropy_at(system: System, x) -> tuple[jax.Array, jax.Array]:
    """Return energy and entropy at x, shape (n,); the entropy is zero if the system has none."""
    entropy = jnp.zeros(()) if system.entropy is None else system.entropy.value(x)
    return system.energy.value(x), entropy


def rounding_sensitivities(system: System, x) -> tuple[jax.Array, jax.Array]:
    """Return the scales of the rounding errors of energy and entropy at x: see :meth:`liethermo.Energy.sensitivity`."""
    entropy = jnp.zeros(()) if system.entropy is None else system.entropy.sensitivity(x)
    return system.energy.sensitivity(x), entropy


def energy_or_entropy_that_relaxes(system: System, energy, entropy):
    """Return the value that relaxes to equilibrium: the energy under a double bracket, else the entropy."""
    return energy if system.energy_law == "nonincreasing" else entropy
