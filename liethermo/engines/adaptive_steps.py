"""Adaptive steps: one attempt, its acceptance and the search for events, as functions that every engine runs.

An adaptive run carries an :class:`.AdaptiveState`. One attempt takes a step, estimates its error, and chooses the size
of the next step. The run pauses when the host has to act: at a stop time, if the growth rate must be computed, and at a
possible event. A step in which the event function changes its sign is repeated with shorter sizes, until it ends at
the sign change: at a zero, which is an event, or at a jump
(:meth:`.adaptive_runs.PauseHandler.end_or_resume_at_sign_changes`).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ..integrators import OneStepMethod
from ..integrators.base import event_check_fractions
from ..systems import System
from ..systems.clock import system_between_breaks
from ..tracing.programs import jit_cached
from . import root_bracket
from .solver_options import DEFAULT_OPTIONS, EPS, SolverOptions
from .stage_solver import keep_fixed_point_result
from .status_codes import StatusCode
from .step import State, initial_run_state, take_step
from .step_control import (
    FACTOR_AFTER_NONCONVERGENCE,
    MIN_RELATIVE_ERROR,
    TRUNCATED_STEP_RATIO,
    AdaptiveState,
    StepControl,
    limit_next_step_by_growth_rate,
    max_step_for_attitude,
    next_step_size_and_end_time,
    probe_jacobian,
    step_size_after_acceptance,
    step_size_after_rejection,
)

ATTEMPT_FIELDS = ("x", "energy", "entropy", "step", "t", "last_step_size")
"""Fields copied to the host after every attempted step of a single trajectory."""


def initial_adaptive_state(
    system: System, method: OneStepMethod, control: StepControl, x, t, stop_time, span_length
) -> AdaptiveState:
    """Return the adaptive state at the start of a run from x, at time t, with the first step size chosen."""
    state, zero = initial_run_state(system, method, x), jnp.zeros(())
    solved_system, components = system.subsystem_to_solve(x)
    norm = jnp.max(jnp.abs(components))
    scale = jnp.where(norm > 0.0, norm, 1.0)
    relative_rate = jnp.max(jnp.abs(solved_system.vector_field(components))) / scale
    relative_tolerance = jnp.minimum(control.allowed_error(norm) / scale, 1.0)
    # half of the step with the allowed error, if each derivative of the motion is larger by the same rate
    estimated_step = (
        0.5 * relative_tolerance ** (1.0 / method.order) / jnp.where(relative_rate > 0.0, relative_rate, 1.0)
    )
    estimated_step = jnp.where(
        (relative_rate > 0.0) & (norm > 0.0), jnp.minimum(span_length, estimated_step), 1e-3 * span_length
    )
    first_step = jnp.minimum(jnp.where(control.first_step > 0.0, control.first_step, estimated_step), control.max_step)
    if control.adaptive:
        first_step = jnp.minimum(first_step, max_step_for_attitude(method, system, x, relative_tolerance))
    probe = probe_jacobian(solved_system, components) if control.adaptive else jnp.zeros((1, 1))
    adaptive_state = AdaptiveState(
        state=state,
        t=zero + t,
        stop_time=zero + stop_time,
        last_stop_time=zero + t,
        steps_at_last_stop=zero,
        next_step_size=first_step,
        last_step_size=zero,
        optimal_step_size=zero,
        n_attempts=zero,
        n_rejected=zero,
        last_attempt_status=zero,
        event_values=control.event_values(system, t, x),
        max_relative_rate=relative_rate,
        growth_rate=zero,
        jacobian_probe=jnp.full_like(probe, jnp.nan),
        root_bracket=jnp.zeros(root_bracket.packed_bracket_shape(control.event_shape)),
    )
    return limit_next_step_by_growth_rate(method, adaptive_state, probe) if control.adaptive else adaptive_state


def attempt_step(
    system: System,
    method: OneStepMethod,
    control: StepControl,
    adaptive_state: AdaptiveState,
    options: SolverOptions = DEFAULT_OPTIONS,
    newton_fallback=None,
) -> AdaptiveState:
    """Return the adaptive state after an attempted step; ``newton_fallback`` as for :func:`.step.take_step`."""
    h, time_after = next_step_size_and_end_time(control, adaptive_state)
    return accept_or_reject(
        system,
        method,
        control,
        adaptive_state,
        h,
        time_after,
        take_step(system, method, adaptive_state.state, h, options, newton_fallback),
    )


def accept_or_reject(
    system: System,
    method: OneStepMethod,
    control: StepControl,
    adaptive_state: AdaptiveState,
    h,
    time_after,
    new_state: State,
) -> AdaptiveState:
    """Return the adaptive state after an attempt that led to ``new_state``, with the next step size chosen."""
    old_state, is_solved = adaptive_state.state, new_state.status == StatusCode.COMPLETED
    attempt_status = 1.0 * new_state.status
    is_accepted, next_step_size, code = is_solved, adaptive_state.next_step_size, new_state.status
    max_rate, optimal_step = adaptive_state.max_relative_rate, adaptive_state.optimal_step_size
    if control.adaptive:
        x_before, x_after = (system.subsystem_to_solve(x)[1] for x in (old_state.x, new_state.x))
        norm = jnp.maximum(jnp.max(jnp.abs(x_before)), jnp.max(jnp.abs(x_after)))
        scale = jnp.where(norm > 0.0, norm, 1.0)
        relative_change = jnp.max(jnp.abs(x_after - x_before)) / scale
        max_rate = jnp.maximum(max_rate, jnp.where(is_solved, relative_change / h, 0.0))
        time_fraction = h * max_rate  # of the time in which the state, at its fastest, changes by its norm
        allowed_error = jnp.maximum(
            control.allowed_error(norm) * jnp.minimum(time_fraction, 1.0),
            MIN_RELATIVE_ERROR * norm + DEFAULT_OPTIONS.tiny,
        )
        error = method.error(
            system_between_breaks(system, old_state.x), old_state.x, old_state.compensation, h, new_state.k
        )
        error = error / allowed_error
        error = jnp.where(is_solved, error, jnp.inf)
        is_accepted = error <= 1.0
        power = 1.0 / (method.order + jnp.where(time_fraction < 1.0, 0.0, 1.0))
        optimal_step = h * jnp.maximum(error, 1e-12) ** -power
        accepted_step_size = step_size_after_acceptance(
            optimal_step, adaptive_state.optimal_step_size, h, next_step_size, power, control.max_step, method.explicit
        )
        max_step = max_step_for_attitude(method, system, new_state.x, control.allowed_error(norm) / scale)
        accepted_step_size = jnp.minimum(accepted_step_size, max_step)
        optimal_step = jnp.where(
            h < TRUNCATED_STEP_RATIO * next_step_size, adaptive_state.optimal_step_size, optimal_step
        )
        next_step_size = jnp.where(is_accepted, accepted_step_size, step_size_after_rejection(error, h, power))
        time_advances = time_after > adaptive_state.t  # unless the step is below the rounding of the time
        is_accepted = is_accepted & time_advances
        code = jnp.where(
            is_accepted | (time_advances & (next_step_size >= control.min_step)),
            StatusCode.COMPLETED,
            StatusCode.STEP_UNDERFLOW,
        )
    outcome = AttemptOutcome(
        is_accepted=is_accepted,
        is_at_event=jnp.zeros((), dtype=bool),
        event_values=adaptive_state.event_values,
        time_after=time_after,
        next_step_size=next_step_size,
        status=code,
        n_rejected=1.0 * ~is_accepted,
        root_bracket=adaptive_state.root_bracket,
    )
    if control.event_functions:
        outcome = apply_event_detection(system, method, control, adaptive_state, h, new_state, outcome)
    is_accepted, is_at_event, event_values, time_after, next_step_size, code, n_rejected, root_bracket = outcome
    continues = is_accepted & ~is_at_event

    def select_if_running(new_value, old_value):
        return jnp.where(continues, new_value, old_value)

    state = jax.tree_util.tree_map(lambda after, before: jnp.where(is_accepted, after, before), new_state, old_state)
    code = jnp.where(continues & (time_after >= adaptive_state.stop_time), StatusCode.PAUSED_AT_STOP, code)
    n_attempts = adaptive_state.n_attempts + 1.0
    new_adaptive_state = AdaptiveState(
        state=state._replace(status=code.astype(old_state.status.dtype), residual=new_state.residual),
        t=jnp.where(is_accepted | is_at_event, time_after, adaptive_state.t),
        stop_time=adaptive_state.stop_time,
        last_stop_time=adaptive_state.last_stop_time,
        steps_at_last_stop=adaptive_state.steps_at_last_stop,
        next_step_size=next_step_size,
        last_step_size=h,
        optimal_step_size=select_if_running(optimal_step, adaptive_state.optimal_step_size),
        n_attempts=n_attempts,
        n_rejected=adaptive_state.n_rejected + n_rejected,
        last_attempt_status=attempt_status,
        event_values=select_if_running(event_values, adaptive_state.event_values),
        max_relative_rate=select_if_running(max_rate, adaptive_state.max_relative_rate),
        growth_rate=adaptive_state.growth_rate,
        jacobian_probe=adaptive_state.jacobian_probe,
        root_bracket=root_bracket,
    )
    if not control.adaptive:
        return new_adaptive_state
    limited_state = limit_next_step_by_growth_rate(
        method, new_adaptive_state, probe_jacobian(*system.subsystem_to_solve(new_state.x))
    )
    new_adaptive_state = jax.tree_util.tree_map(select_if_running, limited_state, new_adaptive_state)
    is_exhausted = (n_attempts >= control.max_attempts) & (new_adaptive_state.state.status == StatusCode.COMPLETED)
    status = jnp.where(is_exhausted, StatusCode.STEP_LIMIT, new_adaptive_state.state.status).astype(
        old_state.status.dtype
    )
    return new_adaptive_state._replace(state=new_adaptive_state.state._replace(status=status))


class AttemptOutcome(NamedTuple):
    """The outcome of an attempted step: whether it is accepted, and what is tried next."""

    is_accepted: jax.Array  # whether the new state is accepted
    is_at_event: jax.Array  # whether the first sign change of an event function is at the time after
    event_values: jax.Array
    time_after: jax.Array  # time at the end of the attempt
    next_step_size: jax.Array
    status: jax.Array  # the run continues (COMPLETED), pauses or fails
    n_rejected: jax.Array  # 1 for a rejected attempt, or 0
    root_bracket: jax.Array


def apply_event_detection(
    system: System,
    method: OneStepMethod,
    control: StepControl,
    adaptive_state: AdaptiveState,
    h,
    new_state: State,
    outcome: AttemptOutcome,
) -> AttemptOutcome:
    """Return the outcome of an attempt, changed if event functions change sign in the step.

    A step in which events happen starts a search for the first of them among steps from the same state, so the event is
    as accurate as the method, and the laws hold there. If the dense output shows that a sign change is undone within
    the step, a shorter step is tried first, and likewise if a trial step fails although the full step did not. A step
    may end where an event function is NaN. A search that starts there assumes the previous value, so it ends where the
    function is a number again. The values at the end of a search are stored beside the empty bracket.
    """
    values_before, values = adaptive_state.event_values, control.event_values(system, outcome.time_after, new_state.x)
    bracket, _ = root_bracket.unpack_bracket_and_end_values(adaptive_state.root_bracket)
    signed_values = jnp.where(jnp.isnan(values) & jnp.isinf(values_before), values_before, values)
    combined_value = root_bracket.combined_event_value(control.event_directions, values_before, signed_values)
    is_searching = bracket.step_size > 0.0
    is_solved = (new_state.status == StatusCode.COMPLETED) & ~jnp.isnan(combined_value)
    has_event = jnp.any(are_event_crossings(control, values_before, values))
    starts_search = outcome.is_accepted & has_event & ~is_searching
    is_shortened, first_fraction = jnp.zeros((), dtype=bool), jnp.ones(())
    if control.adaptive:
        first_fraction, is_undone = first_undone_sign_change_in_step(
            system, method, control, adaptive_state, h, new_state.k, values
        )
        is_shortened = outcome.is_accepted & is_undone & ~is_searching
        starts_search = starts_search & ~is_shortened
    next_bracket, is_root = root_bracket.narrow_bracket(bracket, combined_value)
    ends_at_root = is_searching & is_solved & is_root
    ends_at_start = is_searching & is_solved & ~is_root & (next_bracket.trial_fraction <= 4.0 * EPS)
    time_advances = outcome.time_after > adaptive_state.t
    has_failed, is_at_event = is_searching & ~is_solved, ends_at_root | ends_at_start
    next_step_size = jnp.where(
        is_shortened,
        first_fraction * h,
        jnp.where(is_searching | starts_search, adaptive_state.next_step_size, outcome.next_step_size),
    )
    status = jnp.where(
        is_at_event, StatusCode.PAUSED_AT_EVENT, jnp.where(is_searching, StatusCode.COMPLETED, outcome.status)
    )
    if control.adaptive:
        next_step_size = jnp.where(has_failed, FACTOR_AFTER_NONCONVERGENCE * bracket.step_size, next_step_size)
        failure_code = jnp.where(
            new_state.status == StatusCode.COMPLETED, StatusCode.NON_FINITE, StatusCode.STEP_UNDERFLOW
        )
        status = jnp.where(has_failed & (next_step_size < control.min_step), failure_code, status)
    else:
        status = jnp.where(
            has_failed,
            jnp.where(new_state.status == StatusCode.COMPLETED, StatusCode.NON_FINITE, new_state.status),
            status,
        )
    initial_bracket = root_bracket.bracket_from_step(
        h, *root_bracket.combined_event_values_at_step_ends(control.event_directions, values_before, values)
    )
    end_values = jnp.where(ends_at_start, values_before, jnp.where(time_advances, signed_values, 0.0))
    updated_search = jnp.where(
        is_searching & ~has_failed & ~is_at_event,
        root_bracket.pack_bracket_and_end_values(next_bracket, jnp.zeros_like(values)),
        root_bracket.pack_bracket_and_end_values(root_bracket.EMPTY_BRACKET, jnp.where(is_at_event, end_values, 0.0)),
    )
    return AttemptOutcome(
        is_accepted=jnp.where(
            is_searching, ends_at_root & time_advances, outcome.is_accepted & ~is_shortened & ~starts_search
        ),
        is_at_event=is_at_event,
        event_values=jnp.where(jnp.isnan(values), jnp.inf * values_before, values),
        time_after=jnp.where(
            ends_at_start, adaptive_state.t + next_bracket.trial_fraction * bracket.step_size, outcome.time_after
        ),
        next_step_size=next_step_size,
        status=status,
        n_rejected=jnp.where(is_searching, 1.0 * has_failed, jnp.where(is_shortened, 1.0, outcome.n_rejected)),
        root_bracket=jnp.where(
            starts_search,
            root_bracket.pack_bracket_and_end_values(initial_bracket, jnp.zeros_like(values)),
            updated_search,
        ),
    )


def are_event_crossings(control: StepControl, values_before, values_after) -> jax.Array:
    """Return for each event function whether its values change sign in the direction of its events."""
    directions = np.asarray(control.event_directions)
    is_falling = (values_before > 0.0) & (values_after <= 0.0) & (directions <= 0)
    return is_falling | ((values_before < 0.0) & (values_after >= 0.0) & (directions >= 0))


def first_undone_sign_change_in_step(
    system: System, method: OneStepMethod, control: StepControl, adaptive_state: AdaptiveState, h, slopes, end_values
) -> tuple[jax.Array, jax.Array]:
    """Return the fraction of the first sign change in a step that a later one undoes, and whether there is one.

    A NaN at the end of the step also undoes a sign change.
    """
    fractions, increments = event_check_fractions(method.order), h * slopes

    def values_at(theta, weights) -> jax.Array:
        x = method.displace(system, adaptive_state.state.x, weights @ increments)
        return control.event_values(system, adaptive_state.t + theta * h, x)

    shape, values_before = end_values.shape, adaptive_state.event_values
    fraction, has_changed, is_undone = jnp.ones(shape), jnp.zeros(shape, dtype=bool), jnp.zeros(shape, dtype=bool)
    weights = jnp.asarray(method.weights(fractions))
    values = jax.vmap(values_at)(jnp.asarray(fractions), weights) if len(fractions) else ()
    for theta, values_there in zip([*fractions, 1.0], [*values, end_values], strict=True):
        is_undone = is_undone | (has_changed & (values_before * values_there > 0.0))
        is_opposite = values_before * values_there < 0.0
        fraction = jnp.where(is_opposite & ~has_changed, theta, fraction)
        has_changed = has_changed | is_opposite
    is_undone = is_undone | (has_changed & jnp.isnan(end_values))
    return jnp.min(jnp.where(is_undone, fraction, 1.0)), jnp.any(is_undone)


@jit_cached
def initial_adaptive_state_program(
    system: System, method: OneStepMethod, control: StepControl, x, t, stop_time, span_length
) -> AdaptiveState:
    """Return :func:`initial_adaptive_state`, computed by one compiled program."""
    return initial_adaptive_state(system, method, control, x, t, stop_time, span_length)


@jit_cached
def advance_adaptive(
    system: System,
    method: OneStepMethod,
    control: StepControl,
    adaptive_state: AdaptiveState,
    max_attempts,
    options: SolverOptions,
    with_newton: bool = True,
) -> AdaptiveState:
    """Return the adaptive state after up to ``max_attempts`` attempts; the run stops where it pauses.

    Without ``with_newton`` it also stops before the first attempt that needs Newton's method.
    """
    newton_fallback = None if with_newton else keep_fixed_point_result

    def should_continue(carry):
        adaptive_state, n_attempts = carry
        return (
            (adaptive_state.state.status == StatusCode.COMPLETED)
            & (n_attempts < max_attempts)
            & (with_newton | (adaptive_state.last_attempt_status == StatusCode.COMPLETED))
        )

    def attempt_once(carry):
        adaptive_state, n_attempts = carry
        next_state = attempt_step(system, method, control, adaptive_state, options, newton_fallback)
        if not with_newton:
            is_solved = next_state.last_attempt_status == StatusCode.COMPLETED
            unsolved_state = adaptive_state._replace(last_attempt_status=next_state.last_attempt_status)
            next_state = jax.tree_util.tree_map(lambda a, b: jnp.where(is_solved, a, b), next_state, unsolved_state)
        return next_state, n_attempts + 1

    return jax.lax.while_loop(should_continue, attempt_once, (adaptive_state, jnp.zeros((), dtype=jnp.int64)))[0]


def advance_adaptive_on_host(
    step_function: Callable,
    system: System,
    method: OneStepMethod,
    control: StepControl,
    adaptive_state: AdaptiveState,
    max_attempts: int,
) -> AdaptiveState:
    """Return the adaptive state after up to ``max_attempts`` attempts of ``step_function(state, h)`` on the host."""
    for _ in range(max_attempts):
        if int(adaptive_state.state.status) != StatusCode.COMPLETED:
            break
        h, time_after = _next_step_size_and_end_time_program(control, adaptive_state)
        adaptive_state = _accept_or_reject_program(
            system, method, control, adaptive_state, h, time_after, step_function(adaptive_state.state, h)
        )
    return adaptive_state


@jit_cached
def _next_step_size_and_end_time_program(control, adaptive_state):
    """Return :func:`next_step_size_and_end_time`, computed by one compiled program."""
    return next_step_size_and_end_time(control, adaptive_state)


@jit_cached
def _accept_or_reject_program(system, method, control, adaptive_state, h, time_after, new_state):
    """Return :func:`accept_or_reject`, computed by one compiled program."""
    return accept_or_reject(system, method, control, adaptive_state, h, time_after, new_state)
