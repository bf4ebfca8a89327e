"""Functions of time and state whose zeros are located along a run, in the conventions of SciPy's ``solve_ivp``."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np

from ..engines.choice import EngineWithFallback
from ..engines.codes import StatusCode
from ..engines.rules import EPS
from ..engines.stepping import State
from ..errors import InputError
from ..integrators import OneStepMethod
from ..integrators.base import event_check_fractions
from ..systems import System
from ..tracing.programs import jit_program


class EventSet:
    """Events for ``integrate(until=...)`` with adaptive steps: any number, counted, and only some of them an end.

    A step in which a function changes its sign, at its ends or at the shares between, is taken again in
    parts until one ends at the zero: :attr:`states` are ends of steps, so that the laws hold there.

    Parameters
    ----------
    functions : sequence of functions of (t, y, *args) to a number
        Called with NumPy arrays, y of shape (n,). The attribute ``terminal``, True or a number, ends the run at this
        zero; ``direction`` counts zeros alone at which the function rises, where it is positive, or falls.
    args : tuple

    Attributes
    ----------
    event_times, event_states : list of list
        For each function when it has been zero, and the states then, as the user sees them.
    """

    name = "a terminal event"

    def __init__(self, functions: Sequence[Callable], args: tuple = ()):
        self.functions, self.args = list(functions), args
        self.directions = [float(getattr(f, "direction", 0) or 0) for f in self.functions]
        self.terminal_counts = [_terminal_count(f) for f in self.functions]
        self.event_times: list[list[float]] = [[] for _ in self.functions]
        self.event_states: list[list[np.ndarray]] = [[] for _ in self.functions]
        self.undefined_intervals: list[
            tuple[int, float, float]
        ] = []  # functions that are NaN between other signs, from when on
        self._end_values: np.ndarray | None = None  # at the end of the last step
        self._last_defined_values = [(math.nan, math.nan)] * len(self.functions)  # value and time, where it was no NaN

    def find_events(
        self, engine: EngineWithFallback, t: float, h: float, reached: float, before: State, after: State
    ) -> tuple[float, float, State | None] | None:
        """Note the zeros in a step; of the first that ends the run the time, the size of the step to it and its state.

        No state where that is the start of the run.

        Raises
        ------
        UnknownStateError
            If a state on the way is needed and cannot be found.
        """
        step = _SubdividedStep(engine, t, h, reached, before, after)
        start, first = self._end_values, self._end_values is None
        if start is None:
            start = np.array([self._event_value(j, step, 0.0) for j in range(len(self.functions))])
        self._end_values = np.array([self._event_value(j, step, 1.0) for j in range(len(self.functions))])
        found: list[tuple[float, int]] = []
        for j, (value, end) in enumerate(zip(start, self._end_values, strict=True)):
            if first and value == 0.0 and self._is_requested_initial_zero(j, end):
                found.append((0.0, j))
            found += [(share, j) for share in self._find_zeros(j, step, value, end)]
        for share, j in sorted(found):
            self.event_times[j].append(step.time_at(share))
            self.event_states[j].append(step.user_state_at(share))
            if len(self.event_times[j]) == self.terminal_counts[j]:
                return step.time_at(share), share * h, None if share == 0.0 else step.state_at(share)
        return None

    def find_events_at_state(self, t: float, y: np.ndarray) -> bool:
        """Note the zeros at the only state of a run that takes no step; return whether one of them ends the run."""
        for j, function in enumerate(self.functions):
            if float(function(t, y, *self.args)) == 0.0:
                self.event_times[j].append(t)
                self.event_states[j].append(y)
        return any(len(times) == most for times, most in zip(self.event_times, self.terminal_counts, strict=True))

    @property
    def has_terminal(self) -> bool:
        """Whether a zero of some function ends the run."""
        return any(most is not None for most in self.terminal_counts)

    @property
    def why_undefined(self) -> str:
        """What is not known of the events, in words; empty where there is nothing."""
        if not self.undefined_intervals:
            return ""
        j, start, end = self.undefined_intervals[0]
        name = "the event function" if len(self.functions) == 1 else f"event function {j}"
        more = f" (and {len(self.undefined_intervals) - 1} times more)" if len(self.undefined_intervals) > 1 else ""
        return (
            f"{name} is NaN between t = {start:g} and t = {end:g}, where it has opposite signs{more}: no event is "
            "reported there. Define it there to know"
        )

    def _event_value(self, j: int, step: _SubdividedStep, share: float) -> float:
        return float(self.functions[j](step.time_at(share), step.user_state_at(share), *self.args))

    def _is_requested_crossing(self, j: int, before: float, after: float) -> bool:
        """Whether a change from one value to another is one of those that are asked for."""
        direction = self.directions[j]
        return (before < 0.0 <= after and direction >= 0.0) or (before > 0.0 >= after and direction <= 0.0)

    def _is_requested_initial_zero(self, j: int, after: float) -> bool:
        """Whether a zero at the start of a run is one of those that are asked for."""
        return self.directions[j] == 0.0 or after == 0.0 or self.directions[j] * after > 0.0

    def _find_zeros(self, j: int, step: _SubdividedStep, start: float, end: float) -> list[float]:
        """The shares of a step at which a function is zero: values between show which parts of the step to try."""
        shares = [0.0, *step.fractions, 1.0]
        between = [
            float(self.functions[j](step.time_at(share), y, *self.args))
            for share, y in zip(step.fractions, step.states_between, strict=True)
        ]
        values, known = [start, *between, end], {0, len(shares) - 1}
        while True:
            numbers = [i for i, value in enumerate(values) if not math.isnan(value)]
            changes = [pair for pair in itertools.pairwise(numbers) if _is_sign_change(*(values[i] for i in pair))]
            unsure = ({i for pair in changes for i in pair} | set(range(len(shares))) - set(numbers)) - known
            if not unsure:
                break
            for i in unsure:
                values[i] = self._event_value(j, step, shares[i])
            known |= unsure
        self._note_undefined(j, step, [(shares[i], values[i]) for i in numbers])
        found = []
        for a, b in changes:
            if b > a + 1 and values[b] != 0.0:
                self.undefined_intervals.append((j, step.time_at(shares[a]), step.time_at(shares[b])))
            elif self._is_requested_crossing(j, values[a], values[b]):
                root = shares[b] if values[b] == 0.0 else self._locate_zero(j, step, shares[a], shares[b])
                found += [] if root is None else [root]
        return found

    def _note_undefined(self, j: int, step: _SubdividedStep, numbers: list[tuple[float, float]]) -> None:
        """Note where a function that was NaN at the start of a step has come back with the other sign."""
        if not numbers:
            return
        (first, value), (last, end) = numbers[0], numbers[-1]
        before, time = self._last_defined_values[j]
        if first > 0.0 and _is_sign_change(before, value):
            self.undefined_intervals.append((j, time, step.time_at(first)))
        self._last_defined_values[j] = end, step.time_at(last)

    def _locate_zero(self, j: int, step: _SubdividedStep, low: float, high: float) -> float | None:
        """The share of a step, between two, at which a function changes its sign; None if it is NaN on the way."""
        from scipy.optimize import brentq

        def value(share: float) -> float:
            found = self._event_value(j, step, share)
            if np.isnan(found):
                raise _UndefinedEventError
            return found

        try:
            root = brentq(value, low, high, xtol=EPS**2, rtol=4.0 * EPS)
            value(root)
        except _UndefinedEventError:  # brentq itself says so in an error, or returns, as its version has it
            self.undefined_intervals.append((j, step.time_at(low), step.time_at(high)))
            return None
        return root


class UnknownStateError(Exception):
    """A state between the ends of a step is needed and cannot be found.

    Attributes
    ----------
    code : Code
        Why.
    """

    def __init__(self, code: StatusCode, message: str):
        super().__init__(message)
        self.code = code


class _UndefinedEventError(Exception):
    """A function of an event cannot be evaluated."""


class _SubdividedStep:
    """A step of a run, and states on the way: ends of parts of it, which are steps too."""

    def __init__(self, engine: EngineWithFallback, t: float, h: float, reached: float, before: State, after: State):
        self.engine, self.t, self.h, self.end_time = engine, t, h, reached
        self._engine_states = {0.0: before, 1.0: after}
        self._user_states: dict[float, np.ndarray] = {}
        self.fractions = [float(share) for share in event_check_fractions(engine.method.order)]
        self._states_between: np.ndarray | None = None

    def time_at(self, share: float) -> float:
        return self.end_time if share == 1.0 else min(self.t + share * self.h, self.end_time)

    def state_at(self, share: float) -> State:
        """Return the state after a share of the step; those at its ends are states of the run.

        Raises
        ------
        UnknownStateError
            If the part of the step cannot be taken.
        """
        if share not in self._engine_states:
            state = self.engine.partial_step(self._engine_states[0.0], share * self.h)
            if int(state.status) != StatusCode.COMPLETED:
                code = StatusCode(int(state.status))
                raise UnknownStateError(
                    code,
                    f"whether an event happens in the step from t = {self.t:g} to {self.end_time:g} is not known, since "
                    f"the state at t = {self.time_at(share):g} cannot be found ({code.status_name}). Try max_step="
                    f"{0.5 * self.h:.2g}, or a smaller tolerance",
                )
            self._engine_states[share] = state
        return self._engine_states[share]

    def user_state_at(self, share: float) -> np.ndarray:
        """The state as the user sees it."""
        if share not in self._user_states:
            self._user_states[share] = np.asarray(self.engine.system.user_state(np.asarray(self.state_at(share).x)))
        return self._user_states[share]

    @property
    def states_between(self) -> np.ndarray:
        """About the states at the shares, by the polynomial of the step."""
        if self._states_between is None:
            method, after = self.engine.method, self._engine_states[1.0]
            v = self.h * (np.asarray(method.weights(np.array(self.fractions))) @ np.asarray(after.k))
            x = _displaced_states(self.engine.system, method, np.asarray(self._engine_states[0.0].x), v)
            self._states_between = np.asarray(self.engine.system.user_state(np.asarray(x)))
        return self._states_between


def _is_sign_change(before: float, after: float) -> bool:
    """Whether a zero is crossed, or arrived at."""
    return before * after < 0.0 or (after == 0.0 and before != 0.0 and not np.isnan(before))


def _terminal_count(function: Any) -> int | None:
    """At which of its zeros a function ends the run."""
    terminal = getattr(function, "terminal", None)
    if terminal is None or terminal is False or terminal == 0:
        return None
    if int(terminal) != terminal or terminal < 0:
        raise InputError(f"terminal is True or how many zeros end the run, not {terminal!r}")
    return int(terminal)


@jit_program
def _displaced_states(system: System, method: OneStepMethod, x, v):
    return jax.vmap(lambda v: method.displace(system, x, v))(v)
