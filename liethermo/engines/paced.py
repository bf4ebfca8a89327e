"""Trajectories with paces of their own, one or many, and what takes them on from pause to pause, for every engine."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np

from ..functions.rounding import propagated_rounding_scale
from ..integrators import OneStepMethod
from ..systems import System
from ..tracing.interpret import evaluate_at_points
from ..tracing.programs import jit_program
from . import searching
from .array import LazyNewton
from .codes import StatusCode
from .compiled.form import ProgramStructure
from .compiled.paced import CompiledAdaptiveRuns
from .growth import DENSE_JACOBIAN_DIM
from .pacing import (
    ATTEMPT_FIELDS,
    AdaptiveState,
    StepControl,
    advance_adaptive,
    advance_adaptive_with,
    growth_rate_at,
    initial_adaptive_state,
    initial_adaptive_state_program,
    max_growth_per_step,
    max_growth_rates,
)
from .rules import DEFAULT_OPTIONS, EPS
from .stepping import State


class ArrayAdaptiveRuns:
    """Trajectories with paces of their own in the array engine; they are read and written with trajectories first.

    Parameters
    ----------
    method : OneStepMethod
    adaptive_state : Pace
        Of one trajectory, or of several in front.
    advance : function from a pace, a count of attempts, and whether there is Newton's method, to a pace
        See :func:`.pacing.follow`.
    alone : bool
        Whether there is one.
    """

    def __init__(self, method: OneStepMethod, pace: AdaptiveState, follow: Callable, alone: bool = False):
        self.adaptive_state, self._advance, self._is_single = pace, follow, alone
        self.lazy_newton = LazyNewton(method)

    def read(self, name: str, chosen: Any = slice(None)) -> np.ndarray:
        """A field of :class:`.stepping.State` or of :class:`.pacing.Pace` of some of them, trajectories first."""
        value = np.asarray(getattr(self.adaptive_state.state if name in State._fields else self.adaptive_state, name))
        return (value[None] if self._is_single else value)[chosen]

    def write(self, name: str, chosen: np.ndarray | slice, values) -> None:
        whole = self.read(name).copy()
        whole[chosen] = values
        changed = {name: jnp.asarray(whole[0] if self._is_single else whole)}
        of_state = name in State._fields
        self.adaptive_state = self.adaptive_state._replace(
            **{"state": self.adaptive_state.state._replace(**changed)} if of_state else changed
        )

    def advance(self, most: int) -> None:
        """So many attempts of each, or as many as it takes until it pauses."""
        self.adaptive_state = self.lazy_newton.advance_adaptive(
            lambda pace, newton: self._advance(pace, most, newton), self.adaptive_state
        )

    def state(self) -> State:
        """That of the only trajectory as it stands."""
        return State(*(self.read(name)[0] for name in State._fields))

    def attempt_records(self, most: int) -> dict[str, np.ndarray]:
        """Make so many attempts of the only trajectory, or fewer.

        Attempts first, what :data:`.pacing.TOLD` names of each.
        """
        del most  # one, which nothing else follows
        self.advance(1)
        return {name: self.read(name) for name in ATTEMPT_FIELDS}


AdaptiveRuns: TypeAlias = ArrayAdaptiveRuns | CompiledAdaptiveRuns
"""Trajectories that are followed together, each as it would be alone; or one, whose attempts can be looked at."""


def start_one(
    system: System, method: OneStepMethod, pacing: StepControl, x, t, stop, length, step: Callable | None = None
) -> ArrayAdaptiveRuns:
    """One trajectory, by programs of its own; ``step`` takes a step of an engine whose steps are no program."""
    pace = initial_adaptive_state_program(
        system, method, pacing, jnp.asarray(x), *map(jnp.asarray, map(float, (t, stop, length)))
    )

    def advance_one(pace: AdaptiveState, most: int, newton: bool) -> AdaptiveState:
        if step is not None:
            return advance_adaptive_with(step, system, method, pacing, pace, most)
        return advance_adaptive(system, method, pacing, pace, jnp.asarray(most), DEFAULT_OPTIONS, newton)

    found = ArrayAdaptiveRuns(method, pace, advance_one, True)
    found.lazy_newton.has_newton |= step is not None  # which has its own
    return found


def resume_on_array_engine(
    system: System, method: OneStepMethod, pacing: StepControl, others: AdaptiveRuns
) -> ArrayAdaptiveRuns:
    """The only trajectory of others from where another engine has come to."""
    found = start_one(system, method, pacing, *(others.read(name)[0] for name in ("x", "t", "stop_time", "stop_time")))
    for name in (*State._fields, *AdaptiveState._fields[1:]):
        found.write(name, slice(None), others.read(name).reshape(found.read(name).shape))
    return found


def start_batch(
    form: ProgramStructure, parameters, axes, method: OneStepMethod, pacing: StepControl, x, t, stop, length
) -> ArrayAdaptiveRuns:
    """All trajectories of a batch in one program."""
    given = form, parameters, axes, method, pacing
    pace = _start_batch_program(*given, jnp.asarray(x), *map(jnp.asarray, map(float, (t, stop, length))))
    return ArrayAdaptiveRuns(
        method, pace, lambda pace, most, newton: _advance_batch_program(*given, pace, jnp.asarray(most), newton)
    )


@jit_program
def _start_batch_program(form, parameters, axes, method, pacing, x, t, stop, length):
    def one(p, x):
        return initial_adaptive_state(form.rebuild(p), method, pacing, x, t, stop, length)

    return jax.vmap(one, in_axes=(axes, 0))(parameters, x)


@jit_program
def _advance_batch_program(form, parameters, axes, method, pacing, paces, most, newton: bool):
    def one(p, own):
        return advance_adaptive(form.rebuild(p), method, pacing, own, most, DEFAULT_OPTIONS, newton)

    return jax.vmap(one, in_axes=(axes, 0))(parameters, paces)


EVENT_ZERO_ULPS = 2.0**10
"""Roundings that a function may be off zero at an event."""


def _event_rounding(model: tuple[System, Any], x) -> jax.Array:
    """The size at which what is watched is rounded at a state, which is rounded itself."""
    system, watched = model
    return propagated_rounding_scale(
        lambda y: watched(system, y), x, jnp.maximum(jnp.abs(x), system.component_scales(x))
    )


# -- from pause to pause ----------------------------------------------------------------------------------------------


class PauseHandler:
    """Takes trajectories on from their pauses.

    Parameters
    ----------
    adaptive_runs : Paces
    control : Pacing
    method : OneStepMethod
    stop_times : array
        Times at which steps have to end, increasing; the last is the end of the span.
    system_of : function from a place to the system of that trajectory

    Attributes
    ----------
    sign_jumps : list of float
        When what is watched has changed its sign without being zero.
    """

    def __init__(
        self, paces: AdaptiveRuns, pacing: StepControl, method: OneStepMethod, stops: np.ndarray, member: Callable
    ):
        self.adaptive_runs, self.control, self.method, self.stop_times, self.system_of = (
            paces,
            pacing,
            method,
            stops,
            member,
        )
        self.sign_jumps: list[float] = []

    def paused_indices(self, why: int) -> np.ndarray:
        """The places of those that pause for a reason."""
        return np.flatnonzero(self.adaptive_runs.read("status") == why)

    def confirm_events(self) -> None:
        """Those where what is watched changes its sign: an event is where it is zero, to rounding.

        Others go on past the jump, or the pole, as if it were a stop. Where it is not known what the function is
        between the two signs, since it is not a number, neither is whether the event happens: the run ends.
        What is watched for a fall alone may jump: it has fallen.
        """
        paces, there = self.adaptive_runs, self.paused_indices(StatusCode.PAUSED_AT_EVENT)
        if not there.size:
            return
        value, before = (
            paces.read("root_bracket", there)[:, searching.LAST_VALUE_INDEX],
            paces.read("event_value", there),
        )
        zero = np.isfinite(value) if self.control.falling_only else self._is_zero_to_rounding(there, value, before)
        paces.write("status", there[zero], StatusCode.EVENT)
        unknown = ~zero & ~np.isfinite(before)
        paces.write("status", there[unknown], StatusCode.NON_FINITE)
        past = ~zero & ~unknown
        there, t = there[past], paces.read("t", there[past])
        if there.size:
            self.sign_jumps += t.tolist()
            paces.write("event_value", there, -before[past])
            paces.write("last_stop_time", there, t)
            paces.write("steps_at_last_stop", there, paces.read("step", there))
            paces.write(
                "status",
                there,
                np.where(t >= paces.read("stop_time", there), StatusCode.PAUSED_AT_STOP, StatusCode.COMPLETED),
            )

    def _is_zero_to_rounding(self, there: np.ndarray, value: np.ndarray, before: np.ndarray) -> np.ndarray:
        """Whether what is watched is zero, to rounding, where its value is this and was that when the step began.

        It is beside a value that much larger. Otherwise its rounding is looked at, but not beside a pole, where it is
        larger than it was and rounded by all that it is.
        """
        size, before = np.abs(value), np.abs(before)
        zero = (size == 0.0) | ((size <= EVENT_ZERO_ULPS * EPS * before) & np.isfinite(before))
        for places in self._group_by_system(there[~zero & np.isfinite(size) & (size <= EVENT_ZERO_ULPS * before)]):
            own, model = np.isin(there, places), (self.system_of(int(places[0])), self.control.event_function)
            rounded = evaluate_at_points(_event_rounding, model, self.adaptive_runs.read("x", places))
            zero[own] = size[own] <= EVENT_ZERO_ULPS * EPS * np.where(np.isnan(rounded), np.inf, rounded)
        return zero

    def _group_by_system(self, places: np.ndarray) -> list[np.ndarray]:
        """The places of trajectories of the same system, together."""
        found: dict[int, list[int]] = {}
        kept = [self.system_of(int(i)) for i in places]  # held, so that no identity is used twice
        for i, system in zip(places, kept, strict=True):
            found.setdefault(id(system), []).append(int(i))
        return [np.array(group) for group in found.values()]

    def resume_paused(self) -> None:
        """Those at a stop are done or go on to the next, and what grows near a state is looked at."""
        paces, status = self.adaptive_runs, self.adaptive_runs.read("status")
        there = np.flatnonzero(status == StatusCode.PAUSED_AT_STOP)
        if there.size:
            t = paces.read("t", there)
            done = t >= self.stop_times[-1]
            paces.write("status", there[done], StatusCode.REACHED_END)
            there, t = there[~done], t[~done]
        if there.size:
            paces.write("last_stop_time", there, t)
            paces.write("steps_at_last_stop", there, paces.read("step", there))
            paces.write("stop_time", there, self.stop_times[np.searchsorted(self.stop_times, t, side="right")])
        waiting = np.concatenate([there, np.flatnonzero(status == StatusCode.PAUSED_FOR_GROWTH_RATE)])
        if not waiting.size:
            return
        unknown = waiting[np.isnan(paces.read("growth_rate", waiting))]
        if unknown.size:
            self._update_growth_rates(unknown)
        spent = paces.read("n_attempts", waiting) >= float(self.control.max_attempts)
        paces.write("status", waiting, np.where(spent, StatusCode.STEP_LIMIT, StatusCode.COMPLETED))

    def _update_growth_rates(self, chosen: np.ndarray) -> None:
        seen, paces = self.adaptive_runs.read("jacobian_probe", chosen), self.adaptive_runs
        if seen.shape[2] <= DENSE_JACOBIAN_DIM:
            rates = max_growth_rates(seen)
        else:
            x = paces.read("x", chosen)
            rates = np.array([growth_rate_at(self.system_of(int(i)), self.method, x[j]) for j, i in enumerate(chosen)])
        longest = np.divide(max_growth_per_step(self.method), rates, out=np.full(len(rates), np.inf), where=rates > 0.0)
        paces.write("growth_rate", chosen, rates)
        paces.write("next_step_size", chosen, np.minimum(paces.read("next_step_size", chosen), longest))
