"""How a run ended, in words: what happened, where, and what to try."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from ..engines.choice import Chosen
from ..engines.codes import Code
from ..engines.rules import RULES
from ..engines.stepping import State
from ..integrators import OneStepMethod
from ..results.looking import field_at
from ..results.status import Stats, Status
from ..systems import System
from .adaptive import Adaptive

SHORTER = (2.0, 8.0, 64.0, 1024.0, 16384.0)
"""Parts of a step that could not be solved that are tried, to see whether shorter ones can."""

UNBOUNDED = float(np.finfo(float).max) ** 0.25
"""Size of a state beyond which a function of the fourth power is no number any more."""

RUSHING = 1e-6
"""Share of the time since the start in which a state doubles at its speed, below which it goes to infinity in finite
time."""

SOON, AHEAD, FASTER, TOGETHER = 8.0, 1e6, 10.0, 16
"""Where a step has failed, in how many times its length shorter ones have to find what growth, at a rate that grows by
how much, to say the same; how many of them are taken at once."""

GROWN = 10.0
"""Growth since the start from which anything is said."""

NO_STEP = "No step helps there: does the energy have a lower bound, and do the forces that drive the system end?"


def stats_of(state: State) -> Stats:
    """What an engine has counted."""
    followed = int(state.step) > 0
    return Stats(
        steps=int(state.step),
        fixed_point_iterations=int(state.fixed_point),
        newton_iterations=int(state.newton),
        most_iterations=int(state.most_iterations),
        worst_residual=float(state.worst_residual),
        energy_range=(float(state.smallest_energy), float(state.largest_energy)) if followed else None,
        least_entropy_increment=float(state.least_entropy_increment) if followed else None,
        largest_energy_increment=float(state.largest_energy_increment) if followed else None,
    )


HIGH_ORDER = 6
"""Order of a method from which no higher one is recommended."""


def higher_order(method: OneStepMethod, step: Adaptive) -> str:
    """Advice to take a method of higher order, if that of a run is low; otherwise an empty text."""
    if method.order >= HIGH_ORDER:
        return ""
    better = "lt.MetriplecticRungeKutta(8)" if method.explicit else "lt.MetriplecticGauss(4)"
    return f". {method} has order {method.order}; {better}, of order 8, takes far fewer at rtol={step.rtol:g}"


def given_up(
    system: System, method: OneStepMethod, x0, outcome, step: Adaptive, span: tuple[float, float], now: float
) -> Status:
    """How adaptive steps ended before the end, where none of them failed for good."""
    (start, end), steps, residual = span, int(outcome.state.step), float(outcome.state.residual)
    x = np.asarray(outcome.state.x)
    if outcome.limit != "memory" and (text := runaway(x, x0, field_at(system, x[None])[0], now - start, now)):
        code = Code.STEP_LIMIT if outcome.limit else Code.STEP_UNDERFLOW
        return Status(code, f"after {steps} steps {text}", steps, now, residual)
    if outcome.limit == "steps":
        text = f"{step.most_steps} steps were tried and t = {now:g} of {end:g} is reached: "
        text += f"Adaptive(most_steps=...) allows more, and a larger tolerance takes fewer{higher_order(method, step)}"
        return Status(Code.STEP_LIMIT, text, steps, now, residual)
    if outcome.limit:
        text = f"what is kept of {steps} steps fills the memory and t = {now:g} of {end:g} is reached: "
        return Status(Code.STEP_LIMIT, text + "save_every or save_at keeps fewer states", steps, now, residual)
    text = f"the step fell to {outcome.underflow:.2g} after step {steps}, t = {now:g}, and "
    if now + outcome.underflow == now:
        text += "double precision does not tell t + h from t. Measure the time from a start nearer to zero"
    elif int(outcome.state.status) == Code.COMPLETED:
        text += "the error is still too large: the tolerance may be below what rounding allows, or the functions not "
        text += f"smooth there. Try a larger tolerance than {step}"
    else:
        text += "its equations are still not solved, so no step size helps: check that the functions are smooth and "
        text += "finite near that state"
    return Status(Code.STEP_UNDERFLOW, text, steps, now, residual)


def runaway(x: np.ndarray, x0: np.ndarray, speed: np.ndarray, elapsed: float, now: float) -> str:
    """What is said of a state that grows without bound: that it does, its size and the time; nothing of others."""
    size = np.abs(x).max()
    if size > UNBOUNDED or (size > GROWN * np.abs(x0).max() and _doubles(x, speed, RUSHING * elapsed)):
        return f"the state grows without bound: |x| = {size:.3g} at t = {now:g}. {NO_STEP}"
    return ""


def _doubles(x: np.ndarray, speed: np.ndarray, time: float) -> bool:
    """Whether a state goes outwards so fast that it doubles in a time."""
    size = np.abs(x).max()
    with np.errstate(all="ignore"):
        return bool(np.abs(speed).max() * time > size > 0.0 and np.dot(x / size, speed) > 0.0)


def _chased(engine: Chosen, state, now: float, h: float) -> str:
    """What is said of a state that a step of size h failed from, where shorter ones see it grow without bound."""
    x, t, part = np.asarray(state.x), 0.0, h / 8.0
    size, speed = np.abs(x).max(), field_at(engine.system, x[None])[0]
    if not _doubles(x, speed, SOON * h):
        return ""
    while t < SOON * h and part > h / 8.0**8 and now + part > now:
        before = int(state.step)
        state = engine.advance(state._replace(status=jnp.zeros_like(jnp.asarray(state.status))), part, 1, TOGETHER)[0]
        t += (int(state.step) - before) * part
        y = np.asarray(state.x)
        later = np.abs(y).max()
        if later > AHEAD * size:
            rate = np.abs(field_at(engine.system, y[None])).max() / later
            if not rate > FASTER * np.abs(speed).max() / size:  # as in leaving a state of rest, which ends
                return ""
            text = (
                f"the state grows without bound: |x| = {size:.3g} at t = {now:g}, and shorter steps find {later:.3g} "
            )
            return f"{text}before t = {now + SOON * h:g}. {NO_STEP}"
        if int(state.status) != Code.COMPLETED:
            part /= 8.0
    return ""


def about_many(x: np.ndarray, x0: np.ndarray, speed: np.ndarray, elapsed: float, now: float, h: float) -> str:
    """The same of a trajectory of an ensemble, from which no shorter steps are taken; h is NaN of adaptive ones."""
    if text := runaway(x, x0, speed, elapsed if np.isnan(h) else 0.0, now):
        return text
    first, size = np.abs(x0).max(), np.abs(x).max()
    if _doubles(x, speed, SOON * h) and size > GROWN * first:
        text = f"|x| has grown from {first:.3g} to {size:.3g} at t = {now:g}, and doubles in a few steps"
        return f"{text}: if it grows without bound, no step helps; otherwise try a smaller one"
    return ""


STOPPED = (KeyboardInterrupt, MemoryError, jax.errors.JaxRuntimeError)
"""What stops a run without a fault of the system: what there is so far is kept."""


def stopped_by(error: BaseException) -> str:
    """What stopped a run, in words; raised again where it is something else."""
    if isinstance(error, KeyboardInterrupt):
        return "by the user"
    if isinstance(error, MemoryError) or "RESOURCE_EXHAUSTED" in str(error):
        return "as there is no memory left (save_every keeps fewer states)"
    raise error


def status_of(engine: Chosen, state, now: float, h: float, stopped: str) -> Status:
    """How fixed steps of size h ended, or a step that could not be taken."""
    code, step, residual = int(state.status), int(state.step), float(state.residual)
    if stopped:
        return Status(Code.INTERRUPTED, f"stopped {stopped} after step {step}, t = {now:g}", step, now)
    if code == Code.COMPLETED:
        return Status(Code.COMPLETED, f"reached t = {now:g} in {step} steps", step, now, residual)
    where = f"step {step + 1}, from t = {now:g} with h = {h:g}"
    x = np.asarray(state.x)
    if text := runaway(x, x, np.zeros_like(x), 0.0, now) or _chased(engine, state, now, h):
        return Status(Code(code), f"{where}, could not be taken: {text}", step, now, residual)
    if code == Code.NOT_CONVERGED and engine.method.explicit:
        message = (
            f"the corrections of {where} did not reach the levels that the laws ask for: they miss them by "
            f"{residual:.2g} relative to the state (wanted: rounding, below {RULES.corrected:.0e} of the step). "
            + _advice(engine, state, h)
        )
        return Status(Code.NOT_CONVERGED, message, step, now, residual)
    if code == Code.NOT_CONVERGED:
        message = (
            f"the equations of {where} were not solved: the iteration stopped at a residual of {residual:.2g} "
            f"relative to the state (wanted: rounding, below {RULES.plateau:.0e}). " + _advice(engine, state, h)
        )
        return Status(Code.NOT_CONVERGED, message, step, now, residual)
    if engine.system.surface is not None and (reason := engine.system.outside(_state_ahead(engine, state, h))):
        text = f"{where}, could not be taken: {reason}. Try a smaller step, where the motion itself stays inside"
        return Status(Code.NON_FINITE, text, step, now, residual)
    message = (
        f"NaN or infinity in {where}: the energy, the entropy or the vector field is not finite there "
        f"({_culprit(engine, state, h)}). Check the domain of your functions along the trajectory, or try "
        "a smaller step"
    )
    return Status(Code.NON_FINITE, message, step, now, residual)


def _advice(engine: Chosen, state, h: float) -> str:
    """What helps where a step of size h could not be solved: shorter ones are tried."""
    state = state._replace(status=jnp.zeros_like(jnp.asarray(state.status)))
    for part in SHORTER:
        if int(engine.step(state, h / part).status) == Code.COMPLETED:
            stiff = (
                "; if that is far below what the motion needs, it is stiff or not smooth, and lt.MetriplecticGauss "
                "takes long steps"
            )
            return f"Try a smaller step, for example {h / part:g}{stiff if engine.method.explicit else ''}"
    return (
        f"Steps down to {h / SHORTER[-1]:g} were tried and do not help: the functions may not be smooth there, or "
        "lose more digits than the iteration expects, as differences of large terms do"
    )


def _state_ahead(engine: Chosen, state, h: float) -> jax.Array:
    """Return the state, shape (n,), to which a step of size h along the last slope leads.

    The method applies the displacement: slopes need not have the shape of a state, as those of a body with an attitude.
    """
    displacement = h * jnp.nan_to_num(jnp.asarray(state.k[0]))
    return engine.method.displaced(engine.system, jnp.asarray(state.x), displacement)


def _culprit(engine: Chosen, state, h: float) -> str:
    """Which function is not finite just ahead of the last good state."""
    system = engine.system
    ahead = _state_ahead(engine, state, h)
    if reason := system.outside(ahead):
        return reason
    if reason := engine.method.explain(system, state.x, state.k, h):
        return reason
    suspects = {"energy": system.energy.value, "gradient of the energy": system.energy.gradient}
    if system.entropy is not None:
        suspects |= {"entropy": system.entropy.value, "gradient of the entropy": system.entropy.gradient}
    for name, function in suspects.items():
        if not bool(jnp.isfinite(jnp.asarray(function(ahead))).all()):
            near = np.array2string(np.asarray(system.seen(ahead)), precision=4, threshold=8)
            return f"the {name} first, near x = {near}"
    return f"the iteration overflowed{system.domain and f', or did not find {system.domain}'}"
