"""How a run ended, in words: what happened, where, and what to try."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from ..engines.choice import Chosen
from ..engines.codes import Code
from ..engines.rules import RULES
from ..engines.stepping import State
from ..results.status import Stats, Status
from .adaptive import Adaptive

SHORTER = (2.0, 8.0, 64.0, 1024.0, 16384.0)
"""Parts of a step that could not be solved that are tried, to see whether shorter ones can."""


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


def given_up(outcome, step: Adaptive, end: float, now: float) -> Status:
    """How adaptive steps ended before the end, where none of them failed for good."""
    steps, residual = int(outcome.state.step), float(outcome.state.residual)
    if outcome.limit == "steps":
        text = f"{step.most_steps} steps were tried and t = {now:g} of {end:g} is reached: "
        text += "Adaptive(most_steps=...) allows more, and a larger tolerance takes fewer"
        return Status(Code.STEP_LIMIT, text, steps, now, residual)
    if outcome.limit:
        text = f"what is kept of {steps} steps fills the memory and t = {now:g} of {end:g} is reached: "
        return Status(Code.STEP_LIMIT, text + "save_every or save_at keeps fewer states", steps, now, residual)
    text = f"the step fell to {outcome.underflow:.2g} after step {steps}, t = {now:g}, and "
    if int(outcome.state.status) == Code.COMPLETED:
        text += "the error is still too large: the tolerance may be below what rounding allows, or the functions not "
        text += f"smooth there. Try a larger tolerance than {step}"
    else:
        text += "its equations are still not solved, so no step size helps: check that the functions are smooth and "
        text += "finite near that state"
    return Status(Code.STEP_UNDERFLOW, text, steps, now, residual)


def status_of(engine: Chosen, state, now: float, h: float, interrupted: bool) -> Status:
    """How fixed steps of size h ended, or a step that could not be taken."""
    code, step, residual = int(state.status), int(state.step), float(state.residual)
    if interrupted:
        return Status(Code.INTERRUPTED, f"stopped by the user after step {step}, t = {now:g}", step, now)
    if code == Code.COMPLETED:
        return Status(Code.COMPLETED, f"reached t = {now:g} in {step} steps", step, now, residual)
    where = f"step {step + 1}, from t = {now:g} with h = {h:g}"
    if code == Code.NOT_CONVERGED and engine.method.explicit:
        message = (
            f"the corrections of {where} did not reach the levels that the laws ask for: they miss them by "
            f"{residual:.2g} relative to the state (wanted: rounding, below {RULES.corrected:.0e}). "
            + _advice(engine, state, h)
        )
        return Status(Code.NOT_CONVERGED, message, step, now, residual)
    if code == Code.NOT_CONVERGED:
        message = (
            f"the equations of {where} were not solved: the iteration stopped at a residual of {residual:.2g} "
            f"relative to the state (wanted: rounding, below {RULES.plateau:.0e}). " + _advice(engine, state, h)
        )
        return Status(Code.NOT_CONVERGED, message, step, now, residual)
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


def _culprit(engine: Chosen, state, h: float) -> str:
    """Which function is not finite just ahead of the last good state."""
    system = engine.system
    ahead = jnp.asarray(state.x) + h * jnp.nan_to_num(jnp.asarray(state.k[0]))
    if reason := engine.method.explain(system, state.x, state.k, h):
        return reason
    suspects = {"energy": system.energy.value, "gradient of the energy": system.energy.gradient}
    if system.entropy is not None:
        suspects |= {"entropy": system.entropy.value, "gradient of the entropy": system.entropy.gradient}
    for name, function in suspects.items():
        if not bool(jnp.isfinite(jnp.asarray(function(ahead))).all()):
            near = np.array2string(np.asarray(system.seen(ahead)), precision=4, threshold=8)
            return f"the {name} first, near x = {near}"
    return system.outside(ahead) or f"the iteration overflowed{system.domain and f', or did not find {system.domain}'}"
