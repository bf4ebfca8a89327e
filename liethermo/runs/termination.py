"""Final status of a run: the cause of a failure, its time, and advice."""

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from ..engines.select_engine import EngineWithFallback
from ..engines.solver_options import DEFAULT_OPTIONS
from ..engines.status_codes import StatusCode
from ..engines.step import State
from ..integrators import OneStepMethod
from ..results.status import Stats, Status
from ..results.step_sampling import vector_field_at
from ..systems import System
from .adaptive import Adaptive

RETRY_DIVISORS = (2.0, 8.0, 64.0, 1024.0, 2.0**14, 2.0**20, 2.0**27)
"""Divisors of a failed step size; the quotients are tried, to advise a smaller step. The largest are for rates that
contain an exponential, as those of jumps in a cold bath do."""

BLOW_UP_SIZE = float(np.finfo(float).max) ** 0.25
"""Norm of a state that counts as unbounded; a quartic function overflows there."""

BLOW_UP_TIME_FRACTION = 1e-6
"""Doubling time of a state, as a fraction of the elapsed time, below which it diverges in finite time."""

BLOW_UP_HORIZON_STEPS = 8.0
"""Time, in lengths of a failed step, in which shorter steps must show that the state blows up."""

BLOW_UP_GROWTH_FACTOR = 1e6
"""Growth of the norm of the state over this time that counts as blow-up."""

BLOW_UP_RATE_FACTOR = 10.0
"""Smallest increase of the relative growth rate over this time. A state that leaves an equilibrium grows at a constant
rate, which ends."""

MAX_PROBE_CALLS = 2_000
"""Largest number of calls of an engine in the search for unbounded growth, a few tenths of a second."""

PROBE_STEPS_PER_CALL = 16
"""Number of shorter steps in one call of the engine."""

MIN_GROWTH_TO_REPORT = 10.0
"""Growth of the norm since the start above which growth is reported."""

BLOW_UP_ADVICE = "No step helps there: does the energy have a lower bound, and do the forces that drive the system end?"
"""Advice at the end of messages about unbounded growth."""


def run_statistics(final_state: State, wall_time: float, n_rejected: int = 0) -> Stats:
    """Return the work counters and extreme values of a run from its final engine state."""
    has_steps = int(final_state.step) > 0
    return Stats(
        steps=int(final_state.step),
        fixed_point_iterations=int(final_state.fixed_point_iterations),
        newton_iterations=int(final_state.newton_iterations),
        rejected=n_rejected,
        wall_time=wall_time,
        most_iterations=int(final_state.most_iterations),
        worst_residual=float(final_state.worst_residual),
        energy_range=(float(final_state.smallest_energy), float(final_state.largest_energy)) if has_steps else None,
        least_entropy_increment=float(final_state.least_entropy_increment) if has_steps else None,
        largest_energy_increment=float(final_state.largest_energy_increment) if has_steps else None,
    )


SUFFICIENT_ORDER = 6
"""Order of a method from which no higher order is advised."""


def higher_order_advice(method: OneStepMethod, step: Adaptive) -> str:
    """Return the advice to use a method of higher order, or "" if the order of the method is high enough."""
    if method.order >= SUFFICIENT_ORDER:
        return ""
    better = "lt.MetriplecticRungeKutta(8)" if method.explicit else "lt.MetriplecticGauss(4)"
    return (
        f"{method} has order {method.order}, too low for rtol={step.rtol:g}. Use {better}, of order 8, which takes far "
        "fewer steps. Otherwise "
    )


def adaptive_failure_status(
    system: System, method: OneStepMethod, x0, outcome, step: Adaptive, span: tuple[float, float], t: float
) -> Status:
    """Return the status of an adaptive run that stopped at time t because step size, step count or memory ran out."""
    (start, end), steps, residual = span, int(outcome.state.step), float(outcome.state.residual)
    x = np.asarray(outcome.state.x)
    if outcome.exhausted_limit != "memory" and (
        text := blow_up_message_or_empty(x, x0, vector_field_at(system, x[None])[0], t - start, t)
    ):
        code = StatusCode.STEP_LIMIT if outcome.exhausted_limit else StatusCode.STEP_UNDERFLOW
        return Status(code, f"after {steps} steps {text}", steps, t, residual)
    if outcome.exhausted_limit == "steps":
        text = f"{step.most_steps} steps were tried and t = {t:g} of {end:g} is reached. "
        text += (
            f"{higher_order_advice(method, step)}Adaptive(rtol, most_steps=...) allows more steps, and a larger rtol "
        )
        text += "takes fewer"
        return Status(StatusCode.STEP_LIMIT, text, steps, t, residual)
    if outcome.exhausted_limit:
        text = f"the saved values of {steps} steps fill the memory and t = {t:g} of {end:g} is reached: "
        return Status(StatusCode.STEP_LIMIT, text + "save_every or save_at keeps fewer states", steps, t, residual)
    text = f"the step fell to {outcome.underflow_step_size:.2g} after step {steps}, t = {t:g}, and "
    if t + outcome.underflow_step_size == t:
        text += "double precision does not tell t + h from t. Measure the time from a start nearer to zero"
    elif int(outcome.state.status) == StatusCode.COMPLETED:
        text += "the error is still too large: the tolerance may be below what rounding allows, or the functions not "
        text += f"smooth there. Try a larger tolerance than {step}"
    else:
        text += "its equations are still not solved, so no step size helps: check that the functions are smooth and "
        text += "finite near that state"
    return Status(StatusCode.STEP_UNDERFLOW, text, steps, t, residual)


def event_status(outcome, event_names: Sequence[str], t: float) -> Status:
    """Return the status of a run that ended at an event, or where an event function is NaN, at time t."""
    steps, residual = int(outcome.state.step), float(outcome.state.residual)
    if outcome.event_time is not None:
        name = event_names[outcome.occurrences[-1].function]
        return Status(StatusCode.EVENT, f"{name}: reached at t = {t:.6g} in {steps} steps", steps, t, residual)
    name = event_names[outcome.undefined_events[0] if outcome.undefined_events else 0]
    text = (
        f"{name} is NaN near t = {t:g} between values of opposite sign, so its zero cannot be located. Define it there"
    )
    return Status(StatusCode.NON_FINITE, text, steps, t, residual)


def event_remarks(outcome, event_names: Sequence[str], terminal_counts: Sequence[int | None]) -> str:
    """Return the sentences on events that did or did not happen, for the message of a run that reached its end."""
    text = ""
    for k, name in enumerate(event_names):
        jumps, n_events = (
            [t for j, t in outcome.sign_jumps if j == k],
            sum(e.function == k for e in outcome.occurrences),
        )
        undefined_ends = [t for j, t in outcome.undefined_ends if j == k]
        if undefined_ends:
            repeats = f" (and {len(undefined_ends) - 1} times more)" if len(undefined_ends) > 1 else ""
            text += f"; {name} is NaN before t = {undefined_ends[0]:g}, between opposite signs{repeats}: no event is "
            text += "reported there. Define it between these times"
        elif terminal_counts[k] is None:
            continue
        elif k in outcome.undefined_events:
            text += f"; whether the event ({name}) happened is unknown, because the function is NaN at the end. Define "
            text += "it for all states of the run"
        elif n_events:
            text += f"; the event ({name}) happened {n_events} times"
        else:
            text += f"; the event ({name}) did not happen"
            if jumps:
                text += f": it changed its sign {len(jumps)} times without being zero, first at t = {jumps[0]:g}"
    return text


def blow_up_message_or_empty(x: np.ndarray, x0: np.ndarray, velocity: np.ndarray, time_elapsed: float, t: float) -> str:
    """Return a message if the state grows without bound, with its norm and the time; otherwise ""."""
    norm = np.abs(x).max()
    if norm > BLOW_UP_SIZE or (
        norm > MIN_GROWTH_TO_REPORT * np.abs(x0).max()
        and _does_norm_double_within(x, velocity, BLOW_UP_TIME_FRACTION * time_elapsed)
    ):
        return f"the state grows without bound: |x| = {norm:.3g} at t = {t:g}. {BLOW_UP_ADVICE}"
    return ""


def _does_norm_double_within(x: np.ndarray, velocity: np.ndarray, time: float) -> bool:
    """Return whether a state moves outwards so fast that its norm doubles within this time."""
    norm = np.abs(x).max()
    with np.errstate(all="ignore"):
        return bool(np.abs(velocity).max() * time > norm > 0.0 and np.dot(x / norm, velocity) > 0.0)


def _blow_up_text_from_shorter_steps(engine: EngineWithFallback, state, t: float, h: float) -> str:
    """Return a message if shorter steps in place of a failed step of size h show unbounded growth, otherwise ""."""
    x, probe_time, probe_step_size = np.asarray(state.x), 0.0, h / 8.0
    norm, velocity = np.abs(x).max(), vector_field_at(engine.system, x[None])[0]
    if not _does_norm_double_within(x, velocity, BLOW_UP_HORIZON_STEPS * h):
        return ""
    for _ in range(MAX_PROBE_CALLS):
        if not (probe_time < BLOW_UP_HORIZON_STEPS * h and probe_step_size > h / 8.0**8 and t + probe_step_size > t):
            break
        previous_step = int(state.step)
        state = engine.advance(
            state._replace(status=jnp.zeros_like(jnp.asarray(state.status))), probe_step_size, 1, PROBE_STEPS_PER_CALL
        )[0]
        probe_time += (int(state.step) - previous_step) * probe_step_size
        y = np.asarray(state.x)
        probe_norm = np.abs(y).max()
        if probe_norm > BLOW_UP_GROWTH_FACTOR * norm:
            rate = np.abs(vector_field_at(engine.system, y[None])).max() / probe_norm
            if not rate > BLOW_UP_RATE_FACTOR * np.abs(velocity).max() / norm:  # the state leaves an equilibrium
                return ""
            text = f"the state grows without bound: |x| = {norm:.3g} at t = {t:g}, and shorter steps find "
            return f"{text}{probe_norm:.3g} before t = {t + BLOW_UP_HORIZON_STEPS * h:g}. {BLOW_UP_ADVICE}"
        if int(state.status) != StatusCode.COMPLETED:
            probe_step_size /= 8.0
    return ""


def ensemble_blow_up_message_or_empty(
    x: np.ndarray, x0: np.ndarray, velocity: np.ndarray, time_elapsed: float, t: float, h: float
) -> str:
    """Return a message if a failed trajectory of an ensemble grows without bound, otherwise "".

    No shorter steps are tried. The step size h is NaN for adaptive steps.
    """
    if text := blow_up_message_or_empty(x, x0, velocity, time_elapsed if np.isnan(h) else 0.0, t):
        return text
    initial_norm, norm = np.abs(x0).max(), np.abs(x).max()
    if _does_norm_double_within(x, velocity, BLOW_UP_HORIZON_STEPS * h) and norm > MIN_GROWTH_TO_REPORT * initial_norm:
        text = f"|x| has grown from {initial_norm:.3g} to {norm:.3g} at t = {t:g}, and doubles in a few steps"
        return f"{text}: if it grows without bound, no step helps; otherwise try a smaller one"
    return ""


INTERRUPTING_ERRORS = (KeyboardInterrupt, MemoryError, jax.errors.JaxRuntimeError)
"""Errors that stop a run without a fault of the system; the states so far are returned."""


def interruption_reason_or_reraise(error: BaseException) -> str:
    """Return the reason of an interruption as a text, such as "by the user"; raise any other error again."""
    if isinstance(error, KeyboardInterrupt):
        return "by the user"
    if isinstance(error, MemoryError) or "RESOURCE_EXHAUSTED" in str(error):
        return "as there is no memory left (save_every keeps fewer states)"
    raise error


def final_status(engine: EngineWithFallback, state, t: float, h: float, interruption: str) -> Status:
    """Return the status of a run with steps of size h, from its last engine state."""
    code, step, residual = int(state.status), int(state.step), float(state.residual)
    if interruption:
        return Status(StatusCode.INTERRUPTED, f"stopped {interruption} after step {step}, t = {t:g}", step, t)
    if code == StatusCode.COMPLETED:
        return Status(StatusCode.COMPLETED, f"reached t = {t:g} in {step} steps", step, t, residual)
    step_text = f"step {step + 1}, from t = {t:g} with h = {h:g}"
    x = np.asarray(state.x)
    if text := blow_up_message_or_empty(x, x, np.zeros_like(x), 0.0, t) or _blow_up_text_from_shorter_steps(
        engine, state, t, h
    ):
        return Status(StatusCode(code), f"{step_text}, could not be taken: {text}", step, t, residual)
    if code == StatusCode.NOT_CONVERGED and engine.method.explicit:
        message = (
            f"the corrections of {step_text} did not reach the levels that the laws ask for: they miss them by "
            f"{residual:.2g} relative to the state (wanted: rounding, below {DEFAULT_OPTIONS.projection_rtol:.0e} of "
            "the step). " + _try_shorter_steps_and_advise(engine, state, h)
        )
        return Status(StatusCode.NOT_CONVERGED, message, step, t, residual)
    if code == StatusCode.NOT_CONVERGED:
        message = (
            f"the equations of {step_text} were not solved: the iteration stopped at a residual of {residual:.2g} "
            f"relative to the state (wanted: rounding, below {DEFAULT_OPTIONS.plateau_rtol:.0e}). "
            + _try_shorter_steps_and_advise(engine, state, h)
        )
        return Status(StatusCode.NOT_CONVERGED, message, step, t, residual)
    if engine.system.constraint_surface is not None and (
        reason := engine.system.domain.why_outside(_predicted_state(engine, state, h))
    ):
        text = f"{step_text}, could not be taken: {reason}. Try a smaller step, where the motion itself stays inside"
        return Status(StatusCode.NON_FINITE, text, step, t, residual)
    shorter_step = _step_size_that_succeeds(engine, state, h)
    advice = (
        "Check the domain of your functions along the trajectory, or try a smaller step"
        if shorter_step is None
        else f"Try a smaller step, for example {shorter_step:g}"
    )
    message = (
        f"NaN or infinity in {step_text}: the energy, the entropy or the vector field is not finite there "
        f"({_reason_of_non_finite_step(engine, state, h)}). {advice}"
    )
    return Status(StatusCode.NON_FINITE, message, step, t, residual)


def _try_shorter_steps_and_advise(engine: EngineWithFallback, state, h: float) -> str:
    """Return advice on a failed step of size h, after trying shorter steps: a size that succeeds, or that none does."""
    if (shorter_step := _step_size_that_succeeds(engine, state, h)) is not None:
        stiff = (
            "; if that is far below what the motion needs, it is stiff or not smooth, and lt.MetriplecticGauss "
            "takes long steps"
        )
        return f"Try a smaller step, for example {shorter_step:g}{stiff if engine.method.explicit else ''}"
    return (
        f"Steps down to {h / RETRY_DIVISORS[-1]:g} were tried and do not help: the functions may not be smooth there, "
        "or lose more digits than the iteration expects, as differences of large terms do"
    )


def _step_size_that_succeeds(engine: EngineWithFallback, state, h: float) -> float | None:
    """Return the size of a step from a state that succeeds, shorter than the failed size h; None if none is found."""
    state = state._replace(status=jnp.zeros_like(jnp.asarray(state.status)))
    for divisor in RETRY_DIVISORS:
        if int(engine.step(state, h / divisor).status) == StatusCode.COMPLETED:
            return h / divisor
    return None


def _predicted_state(engine: EngineWithFallback, state, h: float) -> jax.Array:
    """Return the state, shape (n,), at the end of an Euler step of size h along the last slope.

    The method applies the displacement, because slopes may differ in shape from states, for example for a body with an
    attitude.
    """
    displacement = h * jnp.nan_to_num(jnp.asarray(state.k[0]))
    return engine.method.displace(engine.system, jnp.asarray(state.x), displacement)


def _reason_of_non_finite_step(engine: EngineWithFallback, state, h: float) -> str:
    """Return a text that says which function is not finite at the predicted end of a failed step."""
    system = engine.system
    predicted_state = _predicted_state(engine, state, h)
    if reason := system.domain.why_outside(predicted_state):
        return reason
    if reason := engine.method.why_step_failed(system, state.x, state.k, h):
        return reason
    suspects = {"energy": system.energy.value, "gradient of the energy": system.energy.gradient}
    if system.entropy is not None:
        suspects |= {"entropy": system.entropy.value, "gradient of the entropy": system.entropy.gradient}
    for name, function in suspects.items():
        if not bool(jnp.isfinite(jnp.asarray(function(predicted_state))).all()):
            state_text = np.array2string(np.asarray(system.user_state(predicted_state)), precision=4, threshold=8)
            return f"the {name} first, near x = {state_text}"
    condition = system.domain.description
    return f"the iteration overflowed{condition and f', or did not find {condition}'}"
