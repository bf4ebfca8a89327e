"""Steps of sizes of their own: one attempt, how it is judged and what comes next, as functions that every engine runs.

A run that looks at every step carries a :class:`AdaptiveState`. One attempt takes a step, judges it by its estimated error, and
chooses the next. Where something is wanted that no engine does by itself, the run pauses: at a time where a state is
kept, where what grows near the state has to be looked at, and where an event may be. A step in which what is watched
changes its sign is tried again in shorter and shorter parts, until one ends where it does: at a zero, or at a jump,
which is none (:meth:`.paced.Guide.verify`).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from manifolds._pytree_module import Module

from ..integrators import OneStepMethod
from ..integrators.base import event_check_fractions
from ..systems import System
from ..tracing.programs import jit_program
from . import searching
from .codes import StatusCode
from .growth import DENSE_JACOBIAN_DIM, arnoldi_hessenberg, jacobian_probe
from .rules import DEFAULT_OPTIONS, EPS, SolverOptions
from .stages import keep_fixed_point_result
from .stepping import State, initial_run_state, take_step

MAX_FACTOR_IMPLICIT, MAX_FACTOR_EXPLICIT = 3.0, 10.0
"""Largest factor from one step to the next: more, and the prediction of the stages of an implicit one is worth
nothing."""

MIN_FACTOR = 0.2
FACTOR_AFTER_NONCONVERGENCE = 0.25
"""Smallest factor after a step of too large an error, and the factor after one that could not be solved."""

ERROR_TARGET_FRACTION = 0.4
"""The share of the allowed error that the next step aims at."""

TRUNCATED_STEP_RATIO = 0.99
"""The share of the wanted size below which a step has been cut short."""

DEADBAND = (0.9, 1.3)
"""Factors for which the step is kept: changes that small are not worth a worse prediction, and would chatter."""

MIN_RELATIVE_ERROR = 4.0 * EPS
"""The least error that is allowed in a step, relative to the size of the state."""

GROWTH_RATE_RTOL = 2e-3
"""Largest relative error of the rate at which a small deviation grows: what falls from an unstable rest does so in its
time, to a few thousandths. The error of the state does not show it, as the deviation is no part of the state yet."""

MIN_GROWTH_TO_FREQUENCY = 0.01
"""Rate of growth of an oscillation, relative to its frequency, from which it counts: the derivative of a motion that
goes on varies, and gives oscillations that nothing excites small rates of either sign."""

JACOBIAN_CHANGE_RTOL = 0.05
"""Change of the derivative of the motion, relative to it, below which what grows is not looked for again."""

ATTEMPT_FIELDS = ("x", "energy", "entropy", "step", "t", "last_step_size")
"""What is recorded of each attempt of a trajectory that is watched: fields of its state, its time and its step."""


class StepControl(Module):
    """How steps are chosen and what is watched: parameters of a program, as those of a system are.

    Attributes
    ----------
    rtol, atol, first_step, max_step, min_step, max_attempts : array, shape ()
        Tolerances; the first step to try, 0 where it is found; the longest and the shortest; how many are tried.
    event_function : pytree
        The function ``(system, x)`` whose sign is watched, or None.
    falling_only : bool
        Whether it is watched for a fall alone.
    adaptive : bool
        Otherwise all steps are of the size ``first_step``, but for those that arrive where they have to.
    """

    rtol: jax.Array | np.ndarray
    atol: jax.Array | np.ndarray
    first_step: jax.Array | np.ndarray
    max_step: jax.Array | np.ndarray
    min_step: jax.Array | np.ndarray
    max_attempts: jax.Array | np.ndarray
    event_function: Any
    falling_only: bool = eqx.field(static=True)
    adaptive: bool = eqx.field(static=True)

    def allowed_error(self, size) -> jax.Array:
        """The error that a state of a size may have."""
        return self.atol + self.rtol * size

    def event_value(self, system: System, x) -> jax.Array:
        return jnp.zeros(()) if self.event_function is None else self.event_function(system, x)


class AdaptiveState(NamedTuple):
    """A run under way whose steps are looked at; its status is that of its state, or why it pauses."""

    state: State
    t: jax.Array
    stop_time: jax.Array  # when a step has to end next
    last_stop_time: jax.Array  # when one had to last,
    steps_at_last_stop: jax.Array  # and the steps taken until then
    next_step_size: jax.Array  # size of the next step, unless it has to end somewhere
    last_step_size: jax.Array  # size of the last one tried
    optimal_step_size: (
        jax.Array
    )  # the size with which the last one that counts would have had the allowed error; 0 before
    n_attempts: jax.Array
    n_rejected: jax.Array
    last_attempt_status: jax.Array  # status of the last one tried
    event_value: jax.Array  # of what is watched; infinite, with the last sign that is known, where it is not a number
    max_relative_rate: jax.Array  # the largest at which the state has changed, relative to its size
    growth_rate: jax.Array  # rate of what grows fastest, when it was looked at last,
    jacobian_probe: jax.Array  # and how the motion stretched what lay near
    root_bracket: jax.Array  # for the event in a step: a searching.Search


def initial_adaptive_state(
    system: System, method: OneStepMethod, pacing: StepControl, x, t, stop, length
) -> AdaptiveState:
    """The pace of a run about to start at x; ``length`` is that of its whole span."""
    state, zero = initial_run_state(system, method, x), jnp.zeros(())
    own, at = system.solved_part(x)
    size = jnp.max(jnp.abs(at))
    unit = jnp.where(size > 0.0, size, 1.0)
    speed = jnp.max(jnp.abs(own.vector_field(at))) / unit
    share = jnp.minimum(pacing.allowed_error(size) / unit, 1.0)
    # a step whose error is what is allowed, if each derivative of the motion is faster by the same rate; half of it
    found = 0.5 * share ** (1.0 / method.order) / jnp.where(speed > 0.0, speed, 1.0)
    found = jnp.where((speed > 0.0) & (size > 0.0), jnp.minimum(length, found), 1e-3 * length)
    proposed = jnp.minimum(jnp.where(pacing.first_step > 0.0, pacing.first_step, found), pacing.max_step)
    now = jacobian_probe(own, at) if pacing.adaptive else jnp.zeros((1, 1))
    pace = AdaptiveState(
        state=state,
        t=zero + t,
        stop_time=zero + stop,
        last_stop_time=zero + t,
        steps_at_last_stop=zero,
        next_step_size=proposed,
        last_step_size=zero,
        optimal_step_size=zero,
        n_attempts=zero,
        n_rejected=zero,
        last_attempt_status=zero,
        event_value=pacing.event_value(system, x),
        max_relative_rate=speed,
        growth_rate=zero,
        jacobian_probe=jnp.full_like(now, jnp.nan),
        root_bracket=jnp.asarray(searching.EMPTY_BRACKET),
    )
    return limit_by_growth_rate(method, pace, now) if pacing.adaptive else pace


def jacobian_probe_shape(system: System, method: OneStepMethod, pacing: StepControl) -> tuple[int, ...]:
    """The shape of what a pace knows of the motion nearby."""
    if not pacing.adaptive:
        return 1, 1
    x = jax.ShapeDtypeStruct((system.dim,), jnp.float64)
    return jax.eval_shape(lambda x: jacobian_probe(*system.solved_part(x)), x).shape


def next_step(pacing: StepControl, pace: AdaptiveState) -> tuple[jax.Array, jax.Array]:
    """The size of the next step, and the time after it."""
    h, reached = next_full_step(pacing, pace)
    if pacing.event_function is None:
        return h, reached
    search = searching.RootBracket(*pace.root_bracket)
    part = search.trial_fraction * search.step_size
    end_of_part = jnp.minimum(pace.t + part, pace.stop_time)
    return jnp.where(search.step_size > 0.0, part, h), jnp.where(search.step_size > 0.0, end_of_part, reached)


def next_full_step(pacing: StepControl, pace: AdaptiveState) -> tuple[jax.Array, jax.Array]:
    """The same for one that is not a part of another: none ends just short of where one has to end."""
    if pacing.adaptive:
        left = pace.stop_time - pace.t
        arrives = left <= pace.next_step_size * (1 + 1e-12)
        h = jnp.where(arrives, left, jnp.where(left < 2.0 * pace.next_step_size, 0.5 * left, pace.next_step_size))
        reached = jnp.where(arrives, pace.stop_time, pace.t + h)
        # the step that the clock sees, so that rounding of the times does not add up
        return jnp.where(arrives | ~(reached > pace.t), h, reached - pace.t), reached
    # as a timetable has them
    length, done = pace.stop_time - pace.last_stop_time, pace.state.step - pace.steps_at_last_stop
    full = jnp.floor(length / pace.next_step_size * (1 + 1e-12))
    last = pace.stop_time - (pace.last_stop_time + full * pace.next_step_size)
    short = last > 1e-12 * length
    arrives = done + 1.0 >= jnp.where(short, full + 1.0, full)
    return jnp.where(done < full, pace.next_step_size, last), jnp.where(
        arrives, pace.stop_time, pace.last_stop_time + (done + 1.0) * pace.next_step_size
    )


def attempt_step(
    system: System,
    method: OneStepMethod,
    pacing: StepControl,
    pace: AdaptiveState,
    rules: SolverOptions = DEFAULT_OPTIONS,
    second=None,
) -> AdaptiveState:
    """One attempt; ``second`` as for :func:`.stepping.take_step`."""
    h, reached = next_step(pacing, pace)
    return accept_or_reject(
        system, method, pacing, pace, h, reached, take_step(system, method, pace.state, h, rules, second)
    )


def accept_or_reject(
    system: System, method: OneStepMethod, pacing: StepControl, pace: AdaptiveState, h, reached, new: State
) -> AdaptiveState:
    """The pace after an attempt: the step from it to the state ``new`` counts, or another is to be tried."""
    old, solved, cause = pace.state, new.status == StatusCode.COMPLETED, 1.0 * new.status
    good, proposed, code = solved, pace.next_step_size, new.status
    speed, optimal = pace.max_relative_rate, pace.optimal_step_size
    if pacing.adaptive:
        here, there = (system.solved_part(x)[1] for x in (old.x, new.x))
        size = jnp.maximum(jnp.max(jnp.abs(here)), jnp.max(jnp.abs(there)))
        gone = jnp.max(jnp.abs(there - here)) / jnp.where(size > 0.0, size, 1.0)
        speed = jnp.maximum(speed, jnp.where(solved, gone / h, 0.0))
        part = h * speed  # of the time in which the state, at its fastest, changes by its size
        allowed = jnp.maximum(
            pacing.allowed_error(size) * jnp.minimum(part, 1.0), MIN_RELATIVE_ERROR * size + DEFAULT_OPTIONS.tiny
        )
        error = method.error(system, old.x, old.compensation, h, new.k) / allowed
        error = jnp.where(solved, error, jnp.inf)
        good = error <= 1.0
        power = 1.0 / (method.order + jnp.where(part < 1.0, 0.0, 1.0))
        optimal = h * jnp.maximum(error, 1e-12) ** -power
        longer = step_size_after_acceptance(
            optimal, pace.optimal_step_size, h, proposed, power, pacing.max_step, method.explicit
        )
        optimal = jnp.where(h < TRUNCATED_STEP_RATIO * proposed, pace.optimal_step_size, optimal)
        proposed = jnp.where(good, longer, step_size_after_rejection(error, h, power))
        seen = reached > pace.t  # or else the step is less than the last place of the time
        good = good & seen
        code = jnp.where(good | (seen & (proposed >= pacing.min_step)), StatusCode.COMPLETED, StatusCode.STEP_UNDERFLOW)
    sight = AttemptOutcome(
        is_accepted=good,
        is_at_event=jnp.zeros((), dtype=bool),
        event_value=pace.event_value,
        time_after=reached,
        next_step_size=proposed,
        status=code,
        n_rejected=1.0 * ~good,
        root_bracket=pace.root_bracket,
    )
    if pacing.event_function is not None:
        sight = apply_event_detection(system, method, pacing, pace, h, new, sight)
    good, ends, value, reached, proposed, code, rejected, search = sight
    goes_on = good & ~ends

    def select_if_running(after, before):
        return jnp.where(goes_on, after, before)

    state = jax.tree_util.tree_map(lambda after, before: jnp.where(good, after, before), new, old)
    code = jnp.where(goes_on & (reached >= pace.stop_time), StatusCode.PAUSED_AT_STOP, code)
    tried = pace.n_attempts + 1.0
    after = AdaptiveState(
        state=state._replace(status=code.astype(old.status.dtype), residual=new.residual),
        t=jnp.where(good | ends, reached, pace.t),
        stop_time=pace.stop_time,
        last_stop_time=pace.last_stop_time,
        steps_at_last_stop=pace.steps_at_last_stop,
        next_step_size=proposed,
        last_step_size=h,
        optimal_step_size=select_if_running(optimal, pace.optimal_step_size),
        n_attempts=tried,
        n_rejected=pace.n_rejected + rejected,
        last_attempt_status=cause,
        event_value=select_if_running(value, pace.event_value),
        max_relative_rate=select_if_running(speed, pace.max_relative_rate),
        growth_rate=pace.growth_rate,
        jacobian_probe=pace.jacobian_probe,
        root_bracket=search,
    )
    if not pacing.adaptive:
        return after
    looked = limit_by_growth_rate(method, after, jacobian_probe(*system.solved_part(new.x)))
    after = jax.tree_util.tree_map(select_if_running, looked, after)
    spent = (tried >= pacing.max_attempts) & (after.state.status == StatusCode.COMPLETED)
    status = jnp.where(spent, StatusCode.STEP_LIMIT, after.state.status).astype(old.status.dtype)
    return after._replace(state=after.state._replace(status=status))


# -- events -----------------------------------------------------------------------------------------------------------


class AttemptOutcome(NamedTuple):
    """What an attempt means."""

    is_accepted: jax.Array  # whether its state is the next one
    is_at_event: jax.Array  # whether an event is there
    event_value: jax.Array  # of what is watched
    time_after: jax.Array  # when it ends
    next_step_size: jax.Array  # size of the next
    status: jax.Array  # whether the run goes on, pauses or fails
    n_rejected: jax.Array  # 1 for an attempt in vain, or 0
    root_bracket: jax.Array


def apply_event_detection(
    system: System,
    method: OneStepMethod,
    pacing: StepControl,
    pace: AdaptiveState,
    h,
    new: State,
    sight: AttemptOutcome,
) -> AttemptOutcome:
    """An attempt as it was judged, with a view to the event.

    A step in which it happens begins a search among steps from the same state, so that the event is as accurate as the
    method, and the laws hold there. Where it happens and is undone within a step, as the polynomial of the step tells,
    a shorter one is tried first; and where a part of a step fails of which the whole did not. A step may end where what
    is watched is not a number. The search in one that begins there takes it for what it was, so it ends where it is a
    number again. What the value is where a search ends is left in its place: see :func:`.searching.located`.
    """
    value, search = pacing.event_value(system, new.x), searching.RootBracket(*pace.root_bracket)
    seen = jnp.where(jnp.isnan(value) & jnp.isinf(pace.event_value), pace.event_value, value)
    looking, solved = search.step_size > 0.0, (new.status == StatusCode.COMPLETED) & ~jnp.isnan(seen)
    begins = sight.is_accepted & is_event_crossing(pacing, pace.event_value, value) & ~looking
    cut, first = jnp.zeros((), dtype=bool), jnp.ones(())
    if pacing.adaptive:
        first, undone = first_sign_change_in_step(system, method, pacing, pace, h * new.k, value)
        cut = sight.is_accepted & undone & ~looking
        begins = begins & ~cut
    narrower, found = searching.narrow_bracket(search, seen)
    at_root = looking & solved & found
    at_start = looking & solved & ~found & (narrower.trial_fraction <= 4.0 * EPS)
    later = sight.time_after > pace.t
    lost, ends = looking & ~solved, at_root | at_start
    proposed = jnp.where(cut, first * h, jnp.where(looking | begins, pace.next_step_size, sight.next_step_size))
    code = jnp.where(ends, StatusCode.PAUSED_AT_EVENT, jnp.where(looking, StatusCode.COMPLETED, sight.status))
    if pacing.adaptive:
        proposed = jnp.where(lost, FACTOR_AFTER_NONCONVERGENCE * search.step_size, proposed)
        short = jnp.where(new.status == StatusCode.COMPLETED, StatusCode.NON_FINITE, StatusCode.STEP_UNDERFLOW)
        code = jnp.where(lost & (proposed < pacing.min_step), short, code)
    else:
        code = jnp.where(lost, jnp.where(new.status == StatusCode.COMPLETED, StatusCode.NON_FINITE, new.status), code)
    begun = jnp.stack(searching.bracket_from_step(h, pace.event_value, value))
    there = searching.closed_bracket(jnp.where(at_start, pace.event_value, jnp.where(later, seen, 0.0)))
    goes_on = jnp.where(
        looking & ~lost, jnp.where(ends, jnp.stack(there), jnp.stack(narrower)), searching.EMPTY_BRACKET
    )
    return AttemptOutcome(
        is_accepted=jnp.where(looking, at_root & later, sight.is_accepted & ~cut & ~begins),
        is_at_event=ends,
        event_value=jnp.where(jnp.isnan(value), jnp.inf * pace.event_value, value),
        time_after=jnp.where(at_start, pace.t + narrower.trial_fraction * search.step_size, sight.time_after),
        next_step_size=proposed,
        status=code,
        n_rejected=jnp.where(looking, 1.0 * lost, jnp.where(cut, 1.0, sight.n_rejected)),
        root_bracket=jnp.where(begins, begun, goes_on),
    )


def is_event_crossing(pacing: StepControl, before, after) -> jax.Array:
    """Whether what is watched changes its sign as an event does."""
    falls = (before > 0.0) & (after <= 0.0)
    return falls if pacing.falling_only else falls | ((before < 0.0) & (after >= 0.0))


def first_sign_change_in_step(system: System, method: OneStepMethod, pacing: StepControl, pace: AdaptiveState, d, end):
    """The first share of a step, among `event_check_fractions`, with another sign; and whether a later one undoes that.

    An end at which what is watched is not a number does so too.
    """

    def value(weights) -> jax.Array:
        return pacing.event_value(system, method.displace(system, pace.state.x, weights @ d))

    share, changed, undone = jnp.ones(()), jnp.zeros((), dtype=bool), jnp.zeros((), dtype=bool)
    shares = event_check_fractions(method.order)
    seen = jax.vmap(value)(jnp.asarray(method.weights(shares))) if len(shares) else ()
    for theta, there in zip([*shares, 1.0], [*seen, end], strict=True):
        other = pace.event_value * there < 0.0
        undone = undone | (changed & (pace.event_value * there > 0.0))
        share = jnp.where(other & ~changed, theta, share)
        changed = changed | other
    return share, undone | (changed & jnp.isnan(end))


# -- the size of the next step ----------------------------------------------------------------------------------------


def step_size_after_acceptance(optimal, before, h, proposed, power, largest, explicit: bool) -> jax.Array:
    """The size of the next step, after one of size h that would have had the allowed error with the size ``optimal``.

    Where the optimal size shrinks, from ``before``, it is taken to go on as it does [Gustafsson; Hairer & Wanner 1996,
    IV.8]. The size of an implicit method's steps is kept where the change would be small. A step that is cut short to
    end somewhere says little about the next.
    """
    most = MAX_FACTOR_EXPLICIT if explicit else MAX_FACTOR_IMPLICIT
    trend = jnp.where(optimal < before, optimal / jnp.where(before > 0.0, before, 1.0), 1.0)
    factor = jnp.clip(ERROR_TARGET_FRACTION**power * optimal / h * trend, MIN_FACTOR, most)
    longer = jnp.minimum(h * factor, largest)
    same = (DEADBAND[0] < factor) & (factor < DEADBAND[1]) & (not explicit)
    return jnp.where(
        h < TRUNCATED_STEP_RATIO * proposed, jnp.maximum(proposed, longer), jnp.where(same, proposed, longer)
    )


def step_size_after_rejection(error, h, power) -> jax.Array:
    """The size of the next step after one with too large an error; infinity where its equations are not solved."""
    finite = jnp.isfinite(error)
    factor = jnp.maximum(MIN_FACTOR, (ERROR_TARGET_FRACTION / jnp.where(finite, jnp.maximum(error, 1.0), 1.0)) ** power)
    return h * jnp.minimum(jnp.where(finite, factor, FACTOR_AFTER_NONCONVERGENCE), 0.9)


# -- what grows -------------------------------------------------------------------------------------------------------


def max_growth_per_step(method: OneStepMethod) -> float:
    """Largest product of a step and a rate of growth: what grows near the state then does so to :data:`GROWTH_RATE_RTOL`.

    A step of a one-step method multiplies the solution of a linear equation of rate r by R(h r), instead of exp(h r).
    Implicit ones damp or keep what they do not resolve, so they sleep through an instability in long steps.
    R is taken to be the diagonal Padé approximation of the method's order.
    """
    s = max(1, method.order // 2)
    constant = math.factorial(2 * s) * math.factorial(2 * s + 1) / math.factorial(s) ** 2
    return (GROWTH_RATE_RTOL * constant) ** (0.5 / s)  # ln R(z) / z = 1 +- z^2s / constant + ...


def limit_by_growth_rate(method: OneStepMethod, pace: AdaptiveState, now) -> AdaptiveState:
    """No step longer than what grows near the state allows; a pause where that is not known.

    ``now`` is how the motion stretches what lies near, as :func:`.growth.stretch` finds it.
    """
    short = ~(
        (max_growth_per_step(method) < spectral_radius_bound(now) * pace.next_step_size)
        & jnp.isfinite(spectral_radius_bound(now))
    )
    same = frobenius_norm(now - pace.jacobian_probe) <= JACOBIAN_CHANGE_RTOL * frobenius_norm(pace.jacobian_probe)
    limit = jnp.where(
        pace.growth_rate > 0.0,
        max_growth_per_step(method) / jnp.where(pace.growth_rate > 0.0, pace.growth_rate, 1.0),
        jnp.inf,
    )
    unknown = ~short & ~same
    paused = jnp.where(
        unknown & (pace.state.status == StatusCode.COMPLETED), StatusCode.PAUSED_FOR_GROWTH_RATE, pace.state.status
    )
    return pace._replace(
        state=pace.state._replace(status=paused.astype(pace.state.status.dtype)),
        next_step_size=jnp.where(short | unknown, pace.next_step_size, jnp.minimum(pace.next_step_size, limit)),
        jacobian_probe=jnp.where(unknown, now, pace.jacobian_probe),
        growth_rate=jnp.where(unknown, jnp.nan, pace.growth_rate),
    )


def spectral_radius_bound(stretch) -> jax.Array:
    """No eigenvalue of the linearised motion is larger: from its matrix, or about so from its powers."""
    if stretch.shape[1] > DENSE_JACOBIAN_DIM:
        return jnp.sqrt(jnp.max(jnp.sum(stretch * stretch, axis=1)))
    square = stretch @ stretch
    return jnp.sqrt(jnp.sqrt(frobenius_norm(square @ square)))


def frobenius_norm(matrix) -> jax.Array:
    return jnp.sqrt(jnp.sum(matrix * matrix))


def max_growth_rates(matrices: np.ndarray) -> np.ndarray:
    """The sizes of the largest eigenvalues among those that grow, of matrices of shape (..., n, n)."""
    finite = np.isfinite(matrices).all(axis=(-2, -1))
    rates = np.linalg.eigvals(np.where(finite[..., None, None], matrices, 0.0))
    return np.where(rates.real > MIN_GROWTH_TO_FREQUENCY * np.abs(rates), np.abs(rates), 0.0).max(axis=-1, initial=0.0)


def growth_rate_at(system: System, method: OneStepMethod, x) -> float:
    """How fast what grows near a state does, of a system whose stretch is no matrix."""
    return float(max_growth_rates(np.asarray(arnoldi_hessenberg(system, method, jnp.asarray(x)))))


# -- programs ---------------------------------------------------------------------------------------------------------


@jit_program
def initial_adaptive_state_program(
    system: System, method: OneStepMethod, pacing: StepControl, x, t, stop, length
) -> AdaptiveState:
    return initial_adaptive_state(system, method, pacing, x, t, stop, length)


@jit_program
def advance_adaptive(
    system: System,
    method: OneStepMethod,
    pacing: StepControl,
    pace: AdaptiveState,
    most,
    rules: SolverOptions,
    newton: bool = True,
) -> AdaptiveState:
    """The pace after so many attempts, or where it pauses; without ``newton`` also before one that lacks it."""
    second = None if newton else keep_fixed_point_result

    def goes_on(carry):
        pace, attempts = carry
        return (
            (pace.state.status == StatusCode.COMPLETED)
            & (attempts < most)
            & (newton | (pace.last_attempt_status == StatusCode.COMPLETED))
        )

    def attempt_once(carry):
        pace, attempts = carry
        after = attempt_step(system, method, pacing, pace, rules, second)
        if not newton:
            lacking = (
                pace._replace(last_attempt_status=after.last_attempt_status),
                after.last_attempt_status == StatusCode.COMPLETED,
            )
            after = jax.tree_util.tree_map(lambda a, b: jnp.where(lacking[1], a, b), after, lacking[0])
        return after, attempts + 1

    return jax.lax.while_loop(goes_on, attempt_once, (pace, jnp.zeros((), dtype=jnp.int64)))[0]


def advance_adaptive_with(
    step: Callable, system: System, method: OneStepMethod, pacing: StepControl, pace: AdaptiveState, most: int
) -> AdaptiveState:
    """The same, by an engine whose steps are no program."""
    for _ in range(most):
        if int(pace.state.status) != StatusCode.COMPLETED:
            break
        h, reached = _next_step_program(pacing, pace)
        pace = _accept_or_reject_program(system, method, pacing, pace, h, reached, step(pace.state, h))
    return pace


@jit_program
def _next_step_program(pacing, pace):
    return next_step(pacing, pace)


@jit_program
def _accept_or_reject_program(system, method, pacing, pace, h, reached, new):
    return accept_or_reject(system, method, pacing, pace, h, reached, new)
