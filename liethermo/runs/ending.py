"""How a run ended, in words: what happened, where, and what to try."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from ..engines.choice import EngineWithFallback
from ..engines.codes import StatusCode
from ..engines.rules import DEFAULT_OPTIONS
from ..engines.stepping import State
from ..integrators import OneStepMethod
from ..results.looking import vector_field_at
from ..results.status import Stats, Status
from ..systems import System
from .adaptive import Adaptive

RETRY_DIVISORS = (2.0, 8.0, 64.0, 1024.0, 16384.0)
"""Parts of a step that could not be solved that are tried, to see whether shorter ones can."""

BLOW_UP_SIZE = float(np.finfo(float).max) ** 0.25
"""Size of a state beyond which a function of the fourth power is no number any more."""

BLOW_UP_TIME_FRACTION = 1e-6
"""Share of the time since the start in which a state doubles at its speed, below which it goes to infinity in finite
time."""

BLOW_UP_HORIZON_STEPS, BLOW_UP_GROWTH_FACTOR, BLOW_UP_RATE_FACTOR, PROBE_STEPS_PER_CALL = 8.0, 1e6, 10.0, 16
"""Where a step has failed, in how many times its length shorter ones have to find what growth, at a rate that grows by
how much, to say the same; how many of them are taken at once."""

MIN_GROWTH_TO_REPORT = 10.0
"""Growth since the start from which anything is said."""

BLOW_UP_ADVICE = "No step helps there: does the energy have a lower bound, and do the forces that drive the system end?"


def run_statistics(state: State) -> Stats:
    """What an engine has counted."""
    followed = int(state.step) > 0
    return Stats(
        steps=int(state.step),
        fixed_point_iterations=int(state.fixed_point_iterations),
        newton_iterations=int(state.newton_iterations),
        most_iterations=int(state.most_iterations),
        worst_residual=float(state.worst_residual),
        energy_range=(float(state.smallest_energy), float(state.largest_energy)) if followed else None,
        least_entropy_increment=float(state.least_entropy_increment) if followed else None,
        largest_energy_increment=float(state.largest_energy_increment) if followed else None,
    )


SUFFICIENT_ORDER = 6
"""Order of a method from which no higher one is recommended."""


def higher_order_advice(method: OneStepMethod, step: Adaptive) -> str:
    """Advice to take a method of higher order, if that of a run is low; otherwise an empty text."""
    if method.order >= SUFFICIENT_ORDER:
        return ""
    better = "lt.MetriplecticRungeKutta(8)" if method.explicit else "lt.MetriplecticGauss(4)"
    return f". {method} has order {method.order}; {better}, of order 8, takes far fewer at rtol={step.rtol:g}"


def adaptive_failure_status(
    system: System, method: OneStepMethod, x0, outcome, step: Adaptive, span: tuple[float, float], now: float
) -> Status:
    """How adaptive steps ended before the end, where none of them failed for good."""
    (start, end), steps, residual = span, int(outcome.state.step), float(outcome.state.residual)
    x = np.asarray(outcome.state.x)
    if outcome.exhausted_limit != "memory" and (
        text := blow_up_message(x, x0, vector_field_at(system, x[None])[0], now - start, now)
    ):
        code = StatusCode.STEP_LIMIT if outcome.exhausted_limit else StatusCode.STEP_UNDERFLOW
        return Status(code, f"after {steps} steps {text}", steps, now, residual)
    if outcome.exhausted_limit == "steps":
        text = f"{step.most_steps} steps were tried and t = {now:g} of {end:g} is reached: "
        text += f"Adaptive(most_steps=...) allows more, and a larger tolerance takes fewer{higher_order_advice(method, step)}"
        return Status(StatusCode.STEP_LIMIT, text, steps, now, residual)
    if outcome.exhausted_limit:
        text = f"what is kept of {steps} steps fills the memory and t = {now:g} of {end:g} is reached: "
        return Status(StatusCode.STEP_LIMIT, text + "save_every or save_at keeps fewer states", steps, now, residual)
    text = f"the step fell to {outcome.underflow_step_size:.2g} after step {steps}, t = {now:g}, and "
    if now + outcome.underflow_step_size == now:
        text += "double precision does not tell t + h from t. Measure the time from a start nearer to zero"
    elif int(outcome.state.status) == StatusCode.COMPLETED:
        text += "the error is still too large: the tolerance may be below what rounding allows, or the functions not "
        text += f"smooth there. Try a larger tolerance than {step}"
    else:
        text += "its equations are still not solved, so no step size helps: check that the functions are smooth and "
        text += "finite near that state"
    return Status(StatusCode.STEP_UNDERFLOW, text, steps, now, residual)


def blow_up_message(x: np.ndarray, x0: np.ndarray, speed: np.ndarray, elapsed: float, now: float) -> str:
    """What is said of a state that grows without bound: that it does, its size and the time; nothing of others."""
    size = np.abs(x).max()
    if size > BLOW_UP_SIZE or (
        size > MIN_GROWTH_TO_REPORT * np.abs(x0).max() and _doubles_within(x, speed, BLOW_UP_TIME_FRACTION * elapsed)
    ):
        return f"the state grows without bound: |x| = {size:.3g} at t = {now:g}. {BLOW_UP_ADVICE}"
    return ""


def _doubles_within(x: np.ndarray, speed: np.ndarray, time: float) -> bool:
    """Whether a state goes outwards so fast that it doubles in a time."""
    size = np.abs(x).max()
    with np.errstate(all="ignore"):
        return bool(np.abs(speed).max() * time > size > 0.0 and np.dot(x / size, speed) > 0.0)


def _blow_up_by_shorter_steps(engine: EngineWithFallback, state, now: float, h: float) -> str:
    """What is said of a state that a step of size h failed from, where shorter ones see it grow without bound."""
    x, t, part = np.asarray(state.x), 0.0, h / 8.0
    size, speed = np.abs(x).max(), vector_field_at(engine.system, x[None])[0]
    if not _doubles_within(x, speed, BLOW_UP_HORIZON_STEPS * h):
        return ""
    while t < BLOW_UP_HORIZON_STEPS * h and part > h / 8.0**8 and now + part > now:
        before = int(state.step)
        state = engine.advance(
            state._replace(status=jnp.zeros_like(jnp.asarray(state.status))), part, 1, PROBE_STEPS_PER_CALL
        )[0]
        t += (int(state.step) - before) * part
        y = np.asarray(state.x)
        later = np.abs(y).max()
        if later > BLOW_UP_GROWTH_FACTOR * size:
            rate = np.abs(vector_field_at(engine.system, y[None])).max() / later
            if not rate > BLOW_UP_RATE_FACTOR * np.abs(speed).max() / size:  # as in leaving a state of rest, which ends
                return ""
            text = (
                f"the state grows without bound: |x| = {size:.3g} at t = {now:g}, and shorter steps find {later:.3g} "
            )
            return f"{text}before t = {now + BLOW_UP_HORIZON_STEPS * h:g}. {BLOW_UP_ADVICE}"
        if int(state.status) != StatusCode.COMPLETED:
            part /= 8.0
    return ""


def ensemble_failure_message(
    x: np.ndarray, x0: np.ndarray, speed: np.ndarray, elapsed: float, now: float, h: float
) -> str:
    """The same of a trajectory of an ensemble, from which no shorter steps are taken; h is NaN of adaptive ones."""
    if text := blow_up_message(x, x0, speed, elapsed if np.isnan(h) else 0.0, now):
        return text
    first, size = np.abs(x0).max(), np.abs(x).max()
    if _doubles_within(x, speed, BLOW_UP_HORIZON_STEPS * h) and size > MIN_GROWTH_TO_REPORT * first:
        text = f"|x| has grown from {first:.3g} to {size:.3g} at t = {now:g}, and doubles in a few steps"
        return f"{text}: if it grows without bound, no step helps; otherwise try a smaller one"
    return ""


INTERRUPTING_ERRORS = (KeyboardInterrupt, MemoryError, jax.errors.JaxRuntimeError)
"""What stops a run without a fault of the system: what there is so far is kept."""


def interruption_reason(error: BaseException) -> str:
    """What stopped a run, in words; raised again where it is something else."""
    if isinstance(error, KeyboardInterrupt):
        return "by the user"
    if isinstance(error, MemoryError) or "RESOURCE_EXHAUSTED" in str(error):
        return "as there is no memory left (save_every keeps fewer states)"
    raise error


def final_status(engine: EngineWithFallback, state, now: float, h: float, stopped: str) -> Status:
    """How fixed steps of size h ended, or a step that could not be taken."""
    code, step, residual = int(state.status), int(state.step), float(state.residual)
    if stopped:
        return Status(StatusCode.INTERRUPTED, f"stopped {stopped} after step {step}, t = {now:g}", step, now)
    if code == StatusCode.COMPLETED:
        return Status(StatusCode.COMPLETED, f"reached t = {now:g} in {step} steps", step, now, residual)
    where = f"step {step + 1}, from t = {now:g} with h = {h:g}"
    x = np.asarray(state.x)
    if text := blow_up_message(x, x, np.zeros_like(x), 0.0, now) or _blow_up_by_shorter_steps(engine, state, now, h):
        return Status(StatusCode(code), f"{where}, could not be taken: {text}", step, now, residual)
    if code == StatusCode.NOT_CONVERGED and engine.method.explicit:
        message = (
            f"the corrections of {where} did not reach the levels that the laws ask for: they miss them by "
            f"{residual:.2g} relative to the state (wanted: rounding, below {DEFAULT_OPTIONS.projection_rtol:.0e} of the step). "
            + _step_size_advice(engine, state, h)
        )
        return Status(StatusCode.NOT_CONVERGED, message, step, now, residual)
    if code == StatusCode.NOT_CONVERGED:
        message = (
            f"the equations of {where} were not solved: the iteration stopped at a residual of {residual:.2g} "
            f"relative to the state (wanted: rounding, below {DEFAULT_OPTIONS.plateau_rtol:.0e}). "
            + _step_size_advice(engine, state, h)
        )
        return Status(StatusCode.NOT_CONVERGED, message, step, now, residual)
    if engine.system.surface is not None and (reason := engine.system.outside(_predicted_state(engine, state, h))):
        text = f"{where}, could not be taken: {reason}. Try a smaller step, where the motion itself stays inside"
        return Status(StatusCode.NON_FINITE, text, step, now, residual)
    message = (
        f"NaN or infinity in {where}: the energy, the entropy or the vector field is not finite there "
        f"({_why_non_finite(engine, state, h)}). Check the domain of your functions along the trajectory, or try "
        "a smaller step"
    )
    return Status(StatusCode.NON_FINITE, message, step, now, residual)


def _step_size_advice(engine: EngineWithFallback, state, h: float) -> str:
    """What helps where a step of size h could not be solved: shorter ones are tried."""
    state = state._replace(status=jnp.zeros_like(jnp.asarray(state.status)))
    for part in RETRY_DIVISORS:
        if int(engine.step(state, h / part).status) == StatusCode.COMPLETED:
            stiff = (
                "; if that is far below what the motion needs, it is stiff or not smooth, and lt.MetriplecticGauss "
                "takes long steps"
            )
            return f"Try a smaller step, for example {h / part:g}{stiff if engine.method.explicit else ''}"
    return (
        f"Steps down to {h / RETRY_DIVISORS[-1]:g} were tried and do not help: the functions may not be smooth there, or "
        "lose more digits than the iteration expects, as differences of large terms do"
    )


def _predicted_state(engine: EngineWithFallback, state, h: float) -> jax.Array:
    """Return the state, shape (n,), to which a step of size h along the last slope leads.

    The method applies the displacement: slopes need not have the shape of a state, as those of a body with an attitude.
    """
    displacement = h * jnp.nan_to_num(jnp.asarray(state.k[0]))
    return engine.method.displace(engine.system, jnp.asarray(state.x), displacement)


def _why_non_finite(engine: EngineWithFallback, state, h: float) -> str:
    """Which function is not finite just ahead of the last good state."""
    system = engine.system
    ahead = _predicted_state(engine, state, h)
    if reason := system.outside(ahead):
        return reason
    if reason := engine.method.why_step_failed(system, state.x, state.k, h):
        return reason
    suspects = {"energy": system.energy.value, "gradient of the energy": system.energy.gradient}
    if system.entropy is not None:
        suspects |= {"entropy": system.entropy.value, "gradient of the entropy": system.entropy.gradient}
    for name, function in suspects.items():
        if not bool(jnp.isfinite(jnp.asarray(function(ahead))).all()):
            near = np.array2string(np.asarray(system.user_state(ahead)), precision=4, threshold=8)
            return f"the {name} first, near x = {near}"
    return f"the iteration overflowed{system.domain and f', or did not find {system.domain}'}"
