"""Event functions of time and state whose zeros are located along a run, in the conventions of SciPy's
``solve_ivp``."""

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
from ..tracing.programs import jit_cached


class EventSet:
    """Events for ``integrate(until=...)`` with adaptive steps: all zeros are recorded, and terminal ones end the run.

    The sign of a function is compared at both ends of a step and at a few fractions between. Where it changes, partial
    steps are taken until one ends at the zero. So recorded states are ends of steps, and the laws hold there.

    Parameters
    ----------
    functions : sequence of functions of (t, y, *args) to a number
        They get NumPy arrays, y of shape (n,). The attribute ``terminal``, True or a number m, ends the run at the
        first or m-th zero. A positive ``direction`` counts only zeros at which the function rises, a negative one those
        at which it falls.
    args : tuple

    Attributes
    ----------
    event_times, event_states : list of list
        Times of the zeros of each function, and the states then, in the user's form.
    """

    name = "a terminal event"

    def __init__(self, functions: Sequence[Callable], args: tuple = ()):
        self.functions, self.args = list(functions), args
        self.directions = [float(getattr(f, "direction", 0) or 0) for f in self.functions]
        self.terminal_counts = [_terminal_count(f) for f in self.functions]
        self.event_times: list[list[float]] = [[] for _ in self.functions]
        self.event_states: list[list[np.ndarray]] = [[] for _ in self.functions]
        self.undefined_intervals: list[tuple[int, float, float]] = []  # function number, start, end of NaN values
        self._end_values: np.ndarray | None = None  # at the end of the last step
        self._last_defined_values = [(math.nan, math.nan)] * len(self.functions)  # (value, time), the last not NaN

    def find_events(
        self, engine: EngineWithFallback, t: float, h: float, end_time: float, state_before: State, state_after: State
    ) -> tuple[float, float, State | None] | None:
        """Record the zeros in a step; return time, partial step size and state of the first one that ends the run, or
        None.

        The returned state is None if the run ends at its start.

        Raises
        ------
        UnknownStateError
            If a state inside the step is needed and cannot be computed.
        """
        step = _SubdividedStep(engine, t, h, end_time, state_before, state_after)
        start_values, is_first_step = self._end_values, self._end_values is None
        if start_values is None:
            start_values = np.array([self._event_value(j, step, 0.0) for j in range(len(self.functions))])
        self._end_values = np.array([self._event_value(j, step, 1.0) for j in range(len(self.functions))])
        zeros: list[tuple[float, int]] = []
        for j, (start_value, end_value) in enumerate(zip(start_values, self._end_values, strict=True)):
            if is_first_step and start_value == 0.0 and self._is_requested_initial_zero(j, end_value):
                zeros.append((0.0, j))
            zeros += [(share, j) for share in self._find_zeros(j, step, start_value, end_value)]
        for fraction, j in sorted(zeros):
            self.event_times[j].append(step.time_at(fraction))
            self.event_states[j].append(step.user_state_at(fraction))
            if len(self.event_times[j]) == self.terminal_counts[j]:
                return step.time_at(fraction), fraction * h, None if fraction == 0.0 else step.state_at(fraction)
        return None

    def find_events_at_state(self, t: float, y: np.ndarray) -> bool:
        """Record the zeros at the only state of a run without steps; return True if one of them ends the run."""
        for j, function in enumerate(self.functions):
            if float(function(t, y, *self.args)) == 0.0:
                self.event_times[j].append(t)
                self.event_states[j].append(y)
        return any(
            len(times) == terminal_count
            for times, terminal_count in zip(self.event_times, self.terminal_counts, strict=True)
        )

    @property
    def has_terminal(self) -> bool:
        """True if some function can end the run."""
        return any(terminal_count is not None for terminal_count in self.terminal_counts)

    @property
    def why_undefined(self) -> str:
        """Message about intervals in which an event function is NaN; empty if there is none."""
        if not self.undefined_intervals:
            return ""
        j, start, end = self.undefined_intervals[0]
        name = "the event function" if len(self.functions) == 1 else f"event function {j}"
        repeats = f" (and {len(self.undefined_intervals) - 1} times more)" if len(self.undefined_intervals) > 1 else ""
        return (
            f"{name} is NaN between t = {start:g} and t = {end:g}, where it has opposite signs{repeats}: no event is "
            "reported there. Define it between these times"
        )

    def _event_value(self, j: int, step: _SubdividedStep, fraction: float) -> float:
        return float(self.functions[j](step.time_at(fraction), step.user_state_at(fraction), *self.args))

    def _is_requested_crossing(self, j: int, start_value: float, end_value: float) -> bool:
        """Return True if a change from ``start_value`` to ``end_value`` crosses zero in the requested direction."""
        direction = self.directions[j]
        return (start_value < 0.0 <= end_value and direction >= 0.0) or (
            start_value > 0.0 >= end_value and direction <= 0.0
        )

    def _is_requested_initial_zero(self, j: int, end_value: float) -> bool:
        """Return True if a zero at the start of a run leaves in the requested direction."""
        return self.directions[j] == 0.0 or end_value == 0.0 or self.directions[j] * end_value > 0.0

    def _find_zeros(self, j: int, step: _SubdividedStep, start_value: float, end_value: float) -> list[float]:
        """Return the fractions of a step at which function j is zero.

        Interpolated values find the intervals with a sign change; exact values at their ends confirm them.
        """
        fractions = [0.0, *step.fractions, 1.0]
        values_between = [
            float(self.functions[j](step.time_at(fraction), y, *self.args))
            for fraction, y in zip(step.fractions, step.states_between, strict=True)
        ]
        values, evaluated_indices = [start_value, *values_between, end_value], {0, len(fractions) - 1}
        while True:
            defined_indices = [i for i, value in enumerate(values) if not math.isnan(value)]
            sign_changes = [
                pair for pair in itertools.pairwise(defined_indices) if _is_sign_change(*(values[i] for i in pair))
            ]
            missing_indices = (
                {i for pair in sign_changes for i in pair} | set(range(len(fractions))) - set(defined_indices)
            ) - evaluated_indices
            if not missing_indices:
                break
            for i in missing_indices:
                values[i] = self._event_value(j, step, fractions[i])
            evaluated_indices |= missing_indices
        self._note_undefined(j, step, [(fractions[i], values[i]) for i in defined_indices])
        zeros = []
        for a, b in sign_changes:
            if b > a + 1 and values[b] != 0.0:
                self.undefined_intervals.append((j, step.time_at(fractions[a]), step.time_at(fractions[b])))
            elif self._is_requested_crossing(j, values[a], values[b]):
                root = fractions[b] if values[b] == 0.0 else self._locate_zero(j, step, fractions[a], fractions[b])
                zeros += [] if root is None else [root]
        return zeros

    def _note_undefined(self, j: int, step: _SubdividedStep, defined_values: list[tuple[float, float]]) -> None:
        """Record an interval over which function j was NaN and after which its sign is opposite.

        Parameters
        ----------
        defined_values : list of (fraction, value)
            The values in this step that are not NaN.
        """
        if not defined_values:
            return
        (first_fraction, first_value), (last_fraction, last_value) = defined_values[0], defined_values[-1]
        previous_value, previous_time = self._last_defined_values[j]
        if first_fraction > 0.0 and _is_sign_change(previous_value, first_value):
            self.undefined_intervals.append((j, previous_time, step.time_at(first_fraction)))
        self._last_defined_values[j] = last_value, step.time_at(last_fraction)

    def _locate_zero(self, j: int, step: _SubdividedStep, start_fraction: float, end_fraction: float) -> float | None:
        """Return the fraction of a step at which function j is zero, by Brent's method; None if it is NaN on the
        way."""
        from scipy.optimize import brentq

        def evaluate(fraction: float) -> float:
            function_value = self._event_value(j, step, fraction)
            if np.isnan(function_value):
                raise _UndefinedEventError
            return function_value

        try:
            root = brentq(evaluate, start_fraction, end_fraction, xtol=EPS**2, rtol=4.0 * EPS)
            evaluate(root)
        except _UndefinedEventError:  # without it, brentq raises on NaN or returns, depending on its version
            self.undefined_intervals.append((j, step.time_at(start_fraction), step.time_at(end_fraction)))
            return None
        return root


class UnknownStateError(Exception):
    """Error: a state between the ends of a step is needed and cannot be computed.

    Attributes
    ----------
    code : StatusCode
        Status of the failed partial step.
    """

    def __init__(self, code: StatusCode, message: str):
        super().__init__(message)
        self.code = code


class _UndefinedEventError(Exception):
    """Error: an event function is NaN."""


class _SubdividedStep:
    """A step of a run with states inside it, each computed by a partial step from its start."""

    def __init__(
        self, engine: EngineWithFallback, t: float, h: float, end_time: float, state_before: State, state_after: State
    ):
        self.engine, self.t, self.h, self.end_time = engine, t, h, end_time
        self._engine_states = {0.0: state_before, 1.0: state_after}
        self._user_states: dict[float, np.ndarray] = {}
        self.fractions = [float(fraction) for fraction in event_check_fractions(engine.method.order)]
        self._states_between: np.ndarray | None = None

    def time_at(self, fraction: float) -> float:
        return self.end_time if fraction == 1.0 else min(self.t + fraction * self.h, self.end_time)

    def state_at(self, fraction: float) -> State:
        """Return the engine state after a fraction of the step; fractions 0 and 1 are states of the run.

        Raises
        ------
        UnknownStateError
            If the partial step fails.
        """
        if fraction not in self._engine_states:
            state = self.engine.partial_step(self._engine_states[0.0], fraction * self.h)
            if int(state.status) != StatusCode.COMPLETED:
                code = StatusCode(int(state.status))
                raise UnknownStateError(
                    code,
                    f"whether an event happens in the step from t = {self.t:g} to {self.end_time:g} is unknown: the "
                    f"state at t = {self.time_at(fraction):g} cannot be computed ({code.status_name}). Try "
                    f"max_step={0.5 * self.h:.2g}, or a smaller tolerance",
                )
            self._engine_states[fraction] = state
        return self._engine_states[fraction]

    def user_state_at(self, fraction: float) -> np.ndarray:
        """Return the state after a fraction of the step, in the user's form."""
        if fraction not in self._user_states:
            self._user_states[fraction] = np.asarray(
                self.engine.system.user_state(np.asarray(self.state_at(fraction).x))
            )
        return self._user_states[fraction]

    @property
    def states_between(self) -> np.ndarray:
        """User states at ``fractions``, interpolated by the polynomial of the step."""
        if self._states_between is None:
            method, state_after = self.engine.method, self._engine_states[1.0]
            v = self.h * (np.asarray(method.weights(np.array(self.fractions))) @ np.asarray(state_after.k))
            x = _displaced_states(self.engine.system, method, np.asarray(self._engine_states[0.0].x), v)
            self._states_between = np.asarray(self.engine.system.user_state(np.asarray(x)))
        return self._states_between


def _is_sign_change(start_value: float, end_value: float) -> bool:
    """Return True if a function crosses zero, or reaches it, between two values."""
    return start_value * end_value < 0.0 or (end_value == 0.0 and start_value != 0.0 and not np.isnan(start_value))


def _terminal_count(function: Any) -> int | None:
    """Return the number of zeros of a function after which the run ends; None if it never ends the run."""
    terminal = getattr(function, "terminal", None)
    if terminal is None or terminal is False or terminal == 0:
        return None
    if int(terminal) != terminal or terminal < 0:
        raise InputError(f"terminal must be True or the number of zeros that ends the run, got {terminal!r}")
    return int(terminal)


@jit_cached
def _displaced_states(system: System, method: OneStepMethod, x, v):
    return jax.vmap(lambda v: method.displace(system, x, v))(v)
