"""Runs that look at every step: adaptive steps, events, outputs at given times, dense output.

The step itself is an engine's; what is here decides on its size and on where to stop. Nothing here touches the laws:
they hold for every step size.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from .engine import array
from .engine.interpret import evaluator
from .errors import FunctionError, InputError
from .integrators import DEFAULT_METHOD, OneStepMethod
from .integrators.tableaus import integrated
from .systems import DrivenSystem, System, driven

GROWTH = 3.0
"""Largest factor from one step to the next: more, and the prediction of the stages is worth nothing."""

SHRINKAGE = 0.2
UNSOLVED = 0.25
"""Smallest factor after a step of too large an error, and the factor after one that could not be solved."""

SAFETY = 0.8

DEADBAND = (0.9, 1.3)
"""Factors for which the step is kept: changes that small are not worth a worse prediction, and would chatter."""

UNDERFLOW = 1e-14
"""Smallest step, relative to the span."""


@dataclass(frozen=True)
class Adaptive:
    """Steps chosen by an estimate of the local error, relative to the size of the state.

    Each step's estimate is held below ``atol + rtol * max|x|``. The laws hold at every step, whatever its size.

    Parameters
    ----------
    rtol, atol : float
        Not both zero.
    first : float, optional
        First step to try.
    largest : float, optional
        No step is longer.
    """

    rtol: float = 1e-8
    atol: float = 0.0
    first: float | None = None
    largest: float | None = None

    def __post_init__(self):
        for name in ("rtol", "atol"):
            value = getattr(self, name)
            if not (isinstance(value, int | float) and math.isfinite(value) and value >= 0.0):
                raise InputError(f"{name} must be a number >= 0, not {value!r}")
        if max(self.rtol, self.atol) == 0.0:
            raise InputError("rtol and atol are both zero: no step is that exact")
        if self.atol == 0.0 and self.rtol < 1e-14:
            raise InputError(f"rtol = {self.rtol:g} is below the rounding of double precision; take 1e-14 or more")
        for name in ("first", "largest"):
            value = getattr(self, name)
            if value is not None and not (math.isfinite(value) and value > 0.0):
                raise InputError(f"the {name} step must be positive and finite, not {value!r}")


@dataclass(frozen=True)
class Relaxed:
    """The event that the entropy production falls below ``tol`` (per unit of time), for ``integrate(until=...)``.

    A state whose production is below it from the start, such as one near an unstable equilibrium, has to rise above it
    first.
    """

    tol: float

    def __post_init__(self):
        if not (math.isfinite(self.tol) and self.tol > 0.0):
            raise InputError(f"the entropy production to stop at must be positive and finite, not {self.tol!r}")


class Control:
    """The size of the next step, from the error of the last; small changes are left out, so that it does not chatter.

    Parameters
    ----------
    step : float or Adaptive
    order : int
        Of the method; its local error is O(h^(order + 1)).
    first : float
        First step to try.
    """

    def __init__(self, step: float | Adaptive, order: int, first: float):
        self.adaptive = isinstance(step, Adaptive)
        self.h = step.first or first if isinstance(step, Adaptive) else step
        self.largest = (step.largest or math.inf) if isinstance(step, Adaptive) else math.inf
        self.h = min(self.h, self.largest)
        self._power = 1.0 / (order + 1)

    def accept(self, error: float, h: float) -> None:
        """After a step of size h whose error is this fraction of the allowed one, at most 1."""
        factor = SAFETY * max(error, 1e-12) ** -self._power
        if h < 0.99 * self.h:  # cut short to end somewhere: it says little about the next
            factor = max(factor, self.h / h) if factor > 1.0 else 1.0
        factor = min(GROWTH, max(SHRINKAGE, factor))
        if not DEADBAND[0] < factor < DEADBAND[1]:
            self.h = min(h * factor, self.largest)

    def reject(self, error: float, h: float) -> None:
        """After a step with too large an error; infinity where its equations could not be solved."""
        factor = UNSOLVED if not math.isfinite(error) else max(SHRINKAGE, SAFETY * error**-self._power)
        self.h = h * min(factor, 0.9)


class Event:
    """A function of the state whose sign is watched.

    Parameters
    ----------
    until : Relaxed or function from a state, shape (n,), to a scalar
    """

    def __init__(self, until: Relaxed | Callable, system: System):
        self.falling = isinstance(until, Relaxed)
        self.name = f"entropy production below {until.tol:g}" if isinstance(until, Relaxed) else "the event function"
        if isinstance(until, Relaxed):
            if system.entropy_law != "nondecreasing":
                raise InputError("Relaxed(tol) watches the entropy production, and this system produces no entropy")
            self._function = evaluator(_excess, (system, np.float64(until.tol)), system.dim)
        elif callable(until):
            self._function = evaluator(_of_points, (system, until), system.dim)
        else:
            raise InputError(f"until must be lt.Relaxed(tol) or a function of the state, not {until!r}")
        if np.shape(self(system.samples(1)[0])) != ():
            raise FunctionError("the event function must return one number")

    def __call__(self, x: np.ndarray) -> float:
        return self._function(x[None])[0]

    def happens(self, before: float, after: float) -> bool:
        """Whether it happens between two values."""
        return before > 0.0 >= after or (not self.falling and before < 0.0 <= after)


def _excess(model, x):
    system, tol = model
    return system.entropy_production(x) - tol


def _of_points(model, x):
    system, function = model
    return function(system.seen(x))


@dataclass(frozen=True)
class Dense:
    """The collocation polynomials of a run: ``x(t)`` anywhere, to O(h^(s+1)) for s stages.

    That is less than the order 2s of the states at the ends of steps, where alone the laws are exact.

    Attributes
    ----------
    start, h : ndarray, shape (steps,)
    x : ndarray, shape (steps, n)
        States at the starts.
    k : ndarray, shape (steps, s, n)
        Slopes at the stages.
    along : function or None
        On a manifold, from states and displacements, shapes (m, n), to states.
    """

    start: np.ndarray
    h: np.ndarray
    x: np.ndarray
    k: np.ndarray
    along: Callable | None = None

    def __call__(self, t) -> np.ndarray:
        t = np.asarray(t, dtype=np.float64)
        first, last = self.start[0], self.start[-1] + self.h[-1]
        slack = 1e-12 * (last - first)
        if not np.all((t >= first - slack) & (t <= last + slack)):
            raise InputError(f"the solution is known from t = {first:g} to {last:g}, not at {t}")
        i = np.clip(np.searchsorted(self.start, t, side="right") - 1, 0, len(self.start) - 1)
        weights = integrated(self.k.shape[1], (t - self.start[i]) / self.h[i])
        x, v = self.x[i], self.h[i][..., None] * np.einsum("...s,...sn->...n", weights, self.k[i])
        if self.along is None:
            return x + v
        n = x.shape[-1]
        return np.asarray(self.along(x.reshape(-1, n), v.reshape(-1, n))).reshape(*x.shape[:-1], -1)


@dataclass
class Outcome:
    """What a stepwise run leaves: states kept, with times, and how it ended."""

    state: Any
    rejected: int = 0
    event_time: float | None = None
    underflow: float | None = None
    interrupted: bool = False


def run(
    system: System,
    method,
    advance: Callable,
    state,
    span: tuple[float, float],
    step: float | Adaptive,
    stops: np.ndarray,
    event: Event | None,
    keep: Callable,
) -> Outcome:
    """Step from the start of the span to its end, an event, a failure or Ctrl-C.

    Parameters
    ----------
    advance : function from (state, h) to the state after a step
        As an engine's ``stepping`` gives it.
    state : State
        As its ``begin`` gives it.
    stops : array
        Times at which steps have to end, increasing; the last is the end of the span.
    keep : function of (t, end, h, state before, state after)
        Told of every step taken, between the times t and its end.
    """
    t, end = span
    control = Control(step, method.order, _first_step(state, end - t))
    value = event(np.asarray(state.x)) if event else 0.0
    outcome, stop = Outcome(state), 0
    try:
        while t < end:
            while stops[stop] <= t:
                stop += 1
            h, arrives = _fitted(control, t, stops[stop])
            new = advance(state, h)
            if isinstance(step, Adaptive):
                error = _error(system, method, state, new, h, step)
                if not error <= 1.0:
                    outcome.rejected += 1
                    control.reject(error, h)
                    if control.h < UNDERFLOW * (end - span[0]):
                        outcome.underflow = control.h
                        outcome.state = new if int(new.status) != array.RUNNING else state
                        return outcome
                    continue
                control.accept(error, h)
            if int(new.status) != array.RUNNING:
                outcome.state = new
                return outcome
            after = event(np.asarray(new.x)) if event else 0.0
            if event and event.happens(value, after):
                h, new = _located(event, advance, system, method, state, new, h, value, after)
                if h > UNDERFLOW * (end - span[0]):
                    keep(t, t + h, h, state, new)
                    outcome.state = new
                outcome.event_time = t + h
                return outcome
            reached = float(stops[stop]) if arrives else t + h
            keep(t, reached, h, state, new)
            t = reached
            outcome.state = state = new
            value = after
    except KeyboardInterrupt:
        outcome.interrupted = True
    return outcome


def _fitted(control: Control, t: float, stop: float) -> tuple[float, bool]:
    """The next step, so that none ends just short of a stop; and whether it ends there."""
    left = stop - t
    if left <= control.h * (1 + 1e-12):
        return left, True
    if control.adaptive and left < 2.0 * control.h:
        return 0.5 * left, False
    return control.h, False


def _error(system, method, state, new, h: float, step: Adaptive) -> float:
    """The estimated local error as a fraction of what is allowed; infinity where the step could not be taken."""
    if int(new.status) != array.RUNNING:
        return math.inf
    size = max(float(np.abs(state.x).max()), float(np.abs(new.x).max()))
    allowed = step.atol + step.rtol * size
    found = float(array.error_of_step(system, method, state.x, state.low, h, new.k))
    return found / allowed if allowed > 0.0 else math.inf


def _first_step(state, length: float) -> float:
    """A hundredth of the time in which the state would change by its size."""
    speed, size = float(np.abs(state.k).max()), float(np.abs(state.x).max())
    return min(length, 0.01 * size / speed) if speed > 0.0 and size > 0.0 else 1e-3 * length


def _located(event: Event, advance: Callable, system, method, state, new, h: float, before: float, after: float):
    """The step that ends where the event happens, to rounding: its size and the state it leads to.

    Looked for among steps from the same state, so that the event is as accurate as the method and the laws hold there;
    one that fails is replaced by the collocation polynomial of the whole step.
    """
    from scipy.optimize import brentq  # here, as its import takes a tenth of a second, and few runs have events

    if after == 0.0:
        return h, new
    x, k = np.asarray(state.x), np.asarray(new.k)

    def value(theta: float) -> float:
        if theta in (0.0, 1.0):
            return after if theta else before
        end = advance(state, theta * h)
        found = event(np.asarray(end.x)) if int(end.status) == array.RUNNING else math.nan
        if math.isfinite(found):
            return found
        return event(np.asarray(method.along(system, x, h * integrated(len(k), theta) @ k)))

    theta = float(brentq(value, 0.0, 1.0, xtol=1e-15, rtol=8.9e-16))
    return theta * h, advance(state, theta * h)


def stops_of(save_at, start: float, end: float) -> np.ndarray:
    """The times at which steps have to end, the end of the span among them."""
    if save_at is None:
        return np.array([end])
    times = np.atleast_1d(np.asarray(save_at, dtype=np.float64))
    if times.ndim != 1 or not np.isfinite(times).all() or times.size == 0:
        raise InputError(f"save_at is a list of times, not {save_at!r}")
    if times.min() < start or times.max() > end:
        raise InputError(f"save_at has times from {times.min():g} to {times.max():g}, outside ({start:g}, {end:g})")
    return np.unique([*times, end])


def suggest_step(system: System, x0, rtol: float = 1e-8, method: OneStepMethod | None = None, t0: float = 0.0) -> float:
    """A step size for fixed steps whose local error is about ``rtol`` times the state, near x0.

    The smallest of the first thirty that adaptive steps take, once they no longer grow as fast as they are let,
    rounded down to two digits.

    Parameters
    ----------
    system : System
    x0 : array, shape (n,)
    rtol : float
    method : OneStepMethod
        ``MetriplecticGauss(1)`` by default, of order 2.
    t0 : float
        The time, for an energy that depends on it.

    Raises
    ------
    InputError
        Where nothing moves at x0, so that any step will do.
    """
    system = driven(system)
    method = (DEFAULT_METHOD if method is None else method).pulled(system).on(system)
    x = np.asarray(system.begin(x0, t0) if isinstance(system, DrivenSystem) else system.state(x0))
    speed, size = float(np.abs(np.asarray(system.vector_field(x))).max()), float(np.abs(x).max())
    if not speed > 0.0:
        raise InputError("nothing moves at this state, so there is no step to suggest: start elsewhere")
    taken: list[float] = []

    def keep(t, reached, h, before, after):
        taken.append(h)
        if len(taken) == 30:
            raise _EnoughError

    span = (0.0, 1e6 * max(size, 1e-300) / speed)
    with contextlib.suppress(_EnoughError):
        state, advance = array.begin(system, method, x), array.stepping(system, method)
        run(system, method, advance, state, span, Adaptive(rtol), np.array([span[1]]), None, keep)
    if len(taken) < 2:
        raise InputError(f"no step from this state has a local error of {rtol:g}: {len(taken)} steps were taken")
    settled = next((i for i, (a, b) in enumerate(pairwise(taken)) if b < 0.9 * GROWTH * a), len(taken) - 1)
    h = min(taken[settled:])
    digits = 1 - math.floor(math.log10(h))
    return math.floor(h * 10.0**digits) / 10.0**digits


class _EnoughError(Exception):
    """Ends a run that has served its purpose."""
