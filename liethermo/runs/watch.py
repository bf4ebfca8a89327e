"""Functions of time and state whose zeros are located along a run, in the conventions of SciPy's ``solve_ivp``."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np

from ..engines.choice import Chosen
from ..engines.codes import Code
from ..engines.rules import EPS
from ..engines.stepping import State
from ..errors import InputError
from ..integrators import OneStepMethod
from ..integrators.base import event_shares
from ..systems import System
from ..tracing.programs import program


class Watch:
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
    times, states : list of list
        For each function when it has been zero, and the states then, as the user sees them.
    """

    name = "a terminal event"

    def __init__(self, functions: Sequence[Callable], args: tuple = ()):
        self.functions, self.args = list(functions), args
        self.directions = [float(getattr(f, "direction", 0) or 0) for f in self.functions]
        self.most = [_count(f) for f in self.functions]
        self.times: list[list[float]] = [[] for _ in self.functions]
        self.states: list[list[np.ndarray]] = [[] for _ in self.functions]
        self.undefined: list[tuple[int, float, float]] = []  # functions that are NaN between other signs, from when on
        self._values: np.ndarray | None = None  # at the end of the last step
        self._last_numbers = [(math.nan, math.nan)] * len(self.functions)  # value and time, where it was no NaN

    def of_step(
        self, engine: Chosen, t: float, h: float, reached: float, before: State, after: State
    ) -> tuple[float, float, State | None] | None:
        """Note the zeros in a step; of the first that ends the run the time, the size of the step to it and its state.

        No state where that is the start of the run.

        Raises
        ------
        UnknownStateError
            If a state on the way is needed and cannot be found.
        """
        step = _Step(engine, t, h, reached, before, after)
        start, first = self._values, self._values is None
        if start is None:
            start = np.array([self._value(j, step, 0.0) for j in range(len(self.functions))])
        self._values = np.array([self._value(j, step, 1.0) for j in range(len(self.functions))])
        found: list[tuple[float, int]] = []
        for j, (value, end) in enumerate(zip(start, self._values, strict=True)):
            if first and value == 0.0 and self._leaves(j, end):
                found.append((0.0, j))
            found += [(share, j) for share in self._zeros(j, step, value, end)]
        for share, j in sorted(found):
            self.times[j].append(step.time(share))
            self.states[j].append(step.seen(share))
            if len(self.times[j]) == self.most[j]:
                return step.time(share), share * h, None if share == 0.0 else step.state(share)
        return None

    def of_state(self, t: float, y: np.ndarray) -> bool:
        """Note the zeros at the only state of a run that takes no step; return whether one of them ends the run."""
        for j, function in enumerate(self.functions):
            if float(function(t, y, *self.args)) == 0.0:
                self.times[j].append(t)
                self.states[j].append(y)
        return any(len(times) == most for times, most in zip(self.times, self.most, strict=True))

    @property
    def can_end(self) -> bool:
        """Whether a zero of some function ends the run."""
        return any(most is not None for most in self.most)

    @property
    def remark(self) -> str:
        """What is not known of the events, in words; empty where there is nothing."""
        if not self.undefined:
            return ""
        j, start, end = self.undefined[0]
        name = "the event function" if len(self.functions) == 1 else f"event function {j}"
        more = f" (and {len(self.undefined) - 1} times more)" if len(self.undefined) > 1 else ""
        return (
            f"{name} is NaN between t = {start:g} and t = {end:g}, where it has opposite signs{more}: no event is "
            "reported there. Define it there to know"
        )

    def _value(self, j: int, step: _Step, share: float) -> float:
        return float(self.functions[j](step.time(share), step.seen(share), *self.args))

    def _counts(self, j: int, before: float, after: float) -> bool:
        """Whether a change from one value to another is one of those that are asked for."""
        direction = self.directions[j]
        return (before < 0.0 <= after and direction >= 0.0) or (before > 0.0 >= after and direction <= 0.0)

    def _leaves(self, j: int, after: float) -> bool:
        """Whether a zero at the start of a run is one of those that are asked for."""
        return self.directions[j] == 0.0 or after == 0.0 or self.directions[j] * after > 0.0

    def _zeros(self, j: int, step: _Step, start: float, end: float) -> list[float]:
        """The shares of a step at which a function is zero: values between show which parts of the step to try."""
        shares = [0.0, *step.shares, 1.0]
        between = [
            float(self.functions[j](step.time(share), y, *self.args))
            for share, y in zip(step.shares, step.between, strict=True)
        ]
        values, known = [start, *between, end], {0, len(shares) - 1}
        while True:
            numbers = [i for i, value in enumerate(values) if not math.isnan(value)]
            changes = [pair for pair in itertools.pairwise(numbers) if _changes(*(values[i] for i in pair))]
            unsure = ({i for pair in changes for i in pair} | set(range(len(shares))) - set(numbers)) - known
            if not unsure:
                break
            for i in unsure:
                values[i] = self._value(j, step, shares[i])
            known |= unsure
        self._note_undefined(j, step, [(shares[i], values[i]) for i in numbers])
        found = []
        for a, b in changes:
            if b > a + 1 and values[b] != 0.0:
                self.undefined.append((j, step.time(shares[a]), step.time(shares[b])))
            elif self._counts(j, values[a], values[b]):
                root = shares[b] if values[b] == 0.0 else self._zero(j, step, shares[a], shares[b])
                found += [] if root is None else [root]
        return found

    def _note_undefined(self, j: int, step: _Step, numbers: list[tuple[float, float]]) -> None:
        """Note where a function that was NaN at the start of a step has come back with the other sign."""
        if not numbers:
            return
        (first, value), (last, end) = numbers[0], numbers[-1]
        before, time = self._last_numbers[j]
        if first > 0.0 and _changes(before, value):
            self.undefined.append((j, time, step.time(first)))
        self._last_numbers[j] = end, step.time(last)

    def _zero(self, j: int, step: _Step, low: float, high: float) -> float | None:
        """The share of a step, between two, at which a function changes its sign; None if it is NaN on the way."""
        from scipy.optimize import brentq

        def value(share: float) -> float:
            found = self._value(j, step, share)
            if np.isnan(found):
                raise _NotANumber
            return found

        try:
            root = brentq(value, low, high, xtol=EPS**2, rtol=4.0 * EPS)
            value(root)
        except _NotANumber:  # brentq itself says so in an error, or returns, as its version has it
            self.undefined.append((j, step.time(low), step.time(high)))
            return None
        return root


class UnknownStateError(Exception):
    """A state between the ends of a step is needed and cannot be found.

    Attributes
    ----------
    code : Code
        Why.
    """

    def __init__(self, code: Code, message: str):
        super().__init__(message)
        self.code = code


class _NotANumber(Exception):
    """A function of an event cannot be evaluated."""


class _Step:
    """A step of a run, and states on the way: ends of parts of it, which are steps too."""

    def __init__(self, engine: Chosen, t: float, h: float, reached: float, before: State, after: State):
        self.engine, self.t, self.h, self.reached = engine, t, h, reached
        self._states = {0.0: before, 1.0: after}
        self._seen: dict[float, np.ndarray] = {}
        self.shares = [float(share) for share in event_shares(engine.method.order)]
        self._between: np.ndarray | None = None

    def time(self, share: float) -> float:
        return self.reached if share == 1.0 else min(self.t + share * self.h, self.reached)

    def state(self, share: float) -> State:
        """Return the state after a share of the step; those at its ends are states of the run.

        Raises
        ------
        UnknownStateError
            If the part of the step cannot be taken.
        """
        if share not in self._states:
            state = self.engine.part_of_step(self._states[0.0], share * self.h)
            if int(state.status) != Code.COMPLETED:
                code = Code(int(state.status))
                raise UnknownStateError(
                    code,
                    f"whether an event happens in the step from t = {self.t:g} to {self.reached:g} is not known, since "
                    f"the state at t = {self.time(share):g} cannot be found ({code.text}). Try max_step="
                    f"{0.5 * self.h:.2g}, or a smaller tolerance",
                )
            self._states[share] = state
        return self._states[share]

    def seen(self, share: float) -> np.ndarray:
        """The state as the user sees it."""
        if share not in self._seen:
            self._seen[share] = np.asarray(self.engine.system.seen(np.asarray(self.state(share).x)))
        return self._seen[share]

    @property
    def between(self) -> np.ndarray:
        """About the states at the shares, by the polynomial of the step."""
        if self._between is None:
            method, after = self.engine.method, self._states[1.0]
            v = self.h * (np.asarray(method.weights(np.array(self.shares))) @ np.asarray(after.k))
            x = _along(self.engine.system, method, np.asarray(self._states[0.0].x), v)
            self._between = np.asarray(self.engine.system.seen(np.asarray(x)))
        return self._between


def _changes(before: float, after: float) -> bool:
    """Whether a zero is crossed, or arrived at."""
    return before * after < 0.0 or (after == 0.0 and before != 0.0 and not np.isnan(before))


def _count(function: Any) -> int | None:
    """At which of its zeros a function ends the run."""
    terminal = getattr(function, "terminal", None)
    if terminal is None or terminal is False or terminal == 0:
        return None
    if int(terminal) != terminal or terminal < 0:
        raise InputError(f"terminal is True or how many zeros end the run, not {terminal!r}")
    return int(terminal)


@program
def _along(system: System, method: OneStepMethod, x, v):
    return jax.vmap(lambda v: method.displaced(system, x, v))(v)
