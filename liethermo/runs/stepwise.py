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

from ..engines import array
from ..errors import FunctionError, InputError
from ..integrators import DEFAULT_METHOD, OneStepMethod
from ..integrators.tableaus import integrated
from ..systems import DrivenSystem, System, driven
from ..tracing.interpret import evaluator
from .timetable import Timetable

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

GROWTH_ERROR = 2e-3
"""Largest relative error of the rate at which a small deviation grows: what falls from an unstable rest does so in its
time, to a few thousandths. The error of the state does not show it, as the deviation is no part of the state yet."""

TURNING = 0.01
"""Rate of growth of an oscillation, relative to its frequency, from which it counts: the derivative of a motion that
goes on varies, and gives oscillations that nothing excites small rates of either sign."""

CHANGED = 0.05
"""Change of the derivative of the motion, relative to it, below which what grows is not looked for again."""

MOST_KEPT = 2**28
"""Numbers that an adaptive run keeps at most (2 GiB)."""


@dataclass(frozen=True)
class Adaptive:
    """Steps chosen by an estimate of the local error, relative to the size of the state.

    Each step's estimate is held below ``atol + rtol * max|x|``. Steps are short enough, too, for what grows near the
    state to grow at its rate, to :data:`GROWTH_ERROR`, however small it is yet: a body spinning about its middle axis
    falls when it has to. The laws hold at every step, whatever its size.

    Parameters
    ----------
    rtol, atol : float
        Not both zero.
    first : float, optional
        First step to try.
    largest : float, optional
        No step is longer.
    most_steps : int
        The run ends with the status "step_limit" after so many, tried ones among them.
    """

    rtol: float = 1e-8
    atol: float = 0.0
    first: float | None = None
    largest: float | None = None
    most_steps: int = 1_000_000

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
        if isinstance(self.most_steps, bool) or not isinstance(self.most_steps, int) or self.most_steps < 1:
            raise InputError(f"most_steps must be a positive integer, not {self.most_steps!r}")


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


class Growth:
    """How long steps may be for what grows near the state to grow at its rate.

    A one-step method that solves a linear equation of rate r multiplies it by R(h r) in a step instead of exp(h r), and
    one that damps or keeps what it does not resolve, as implicit ones do, sleeps through an instability in long steps.

    Parameters
    ----------
    system : System
    method : OneStepMethod
        Its R is taken to be the diagonal Padé approximation of its order.
    """

    def __init__(self, system: System, method: OneStepMethod):
        self._system, self._method = system, method
        s = max(1, method.order // 2)
        constant = math.factorial(2 * s) * math.factorial(2 * s + 1) / math.factorial(s) ** 2
        self._reach = (GROWTH_ERROR * constant) ** (0.5 / s)  # ln R(z) / z = 1 +- z^2s / constant + ...
        self._seen, self._rate = np.full((1, 1), np.nan), 0.0

    def look(self, x, stretch: np.ndarray) -> None:
        """Note what lies around a state, as :func:`.array.error_and_stretch` sees it."""
        self._x, self._stretch = x, stretch
        self._size = math.sqrt(float((stretch * stretch).sum(axis=-1).max()))

    def longest(self, h: float) -> float:
        """The longest step from that state; infinity where a step of size h is short enough for certain."""
        whole, stretch = self._stretch.shape[1] <= array.FEW, self._stretch
        size = self._size * (math.sqrt(len(stretch)) if whole else 1.0)
        if not self._reach < size * h < math.inf:
            return math.inf
        seen = stretch if whole else stretch[:1]
        if not np.linalg.norm(seen - self._seen) <= CHANGED * np.linalg.norm(self._seen):
            matrix = stretch if whole else np.asarray(array.growing(self._system, self._method, self._x))
            self._seen, self._rate = seen, _fastest(matrix)
        return self._reach / self._rate if self._rate > 0.0 else math.inf


def _fastest(matrix: np.ndarray) -> float:
    """The size of the largest eigenvalue among those that grow."""
    if not np.isfinite(matrix).all():
        return 0.0
    rates = np.linalg.eigvals(matrix)
    return float(np.abs(rates[rates.real > TURNING * np.abs(rates)]).max(initial=0.0))


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
    limit: str = ""  # what an adaptive run has used up, "steps" or "memory"


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
    most_kept: float = MOST_KEPT,
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
    most_kept : float
        Adaptive steps after which there is no room for more.
    """
    t, end = span
    adaptive, shortest = step if isinstance(step, Adaptive) else None, UNDERFLOW * (end - t)
    control, growth = Control(step, method.order, _first_step(state, end - t)), Growth(system, method)
    value = event(np.asarray(state.x)) if event else 0.0
    outcome, stop, table, tried = Outcome(state), -1, None, 0
    try:
        if adaptive is not None:
            control.h = min(control.h, _judged(growth, system, method, state, state, control.h)[1])
        while t < end:
            if stop < 0 or stops[stop] <= t:
                stop += 1
                continue
            if adaptive is None:
                if table is None or table.end <= t:
                    table, since = Timetable((t, float(stops[stop])), step, None), int(state.step)
                n = int(state.step) - since
                h, reached = table.h if n < table.full else table.last, table.time(n + 1)
            else:
                h, arrives = _fitted(control, t, stops[stop])
                reached = float(stops[stop]) if arrives else t + h
                if tried >= adaptive.most_steps or int(state.step) >= most_kept:
                    outcome.limit = "steps" if tried >= adaptive.most_steps else "memory"
                    return outcome
            new = advance(state, h)
            tried += 1
            if adaptive is not None:
                error, longest = math.inf, math.inf
                if int(new.status) == array.RUNNING:
                    found, longest = _judged(growth, system, method, state, new, h)
                    error = found / _allowed(adaptive, state, new)
                if not error <= 1.0 or h > 1.1 * longest:
                    outcome.rejected += 1
                    if not error <= 1.0:
                        control.reject(error, h)
                    control.h = min(control.h, longest)
                    if control.h < shortest:
                        outcome.underflow = control.h
                        outcome.state = new if int(new.status) != array.RUNNING else state
                        return outcome
                    continue
                control.accept(error, h)
                control.h = min(control.h, growth.longest(control.h))
            if int(new.status) != array.RUNNING:
                outcome.state = new
                return outcome
            after = event(np.asarray(new.x)) if event else 0.0
            if event and event.happens(value, after):
                h, new = _located(event, advance, system, method, state, new, h, value, after)
                if h > shortest:
                    keep(t, t + h, h, state, new)
                    outcome.state = new
                outcome.event_time = t + h
                return outcome
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
    if left < 2.0 * control.h:
        return 0.5 * left, False
    return control.h, False


def _judged(growth: Growth, system: System, method, state, new, h: float) -> tuple[float, float]:
    """The estimated local error of a step that was taken, and the longest step from its start for what grows there."""
    found, stretch = array.error_and_stretch(system, method, state.x, state.low, h, new.k)
    growth.look(state.x, np.asarray(stretch))
    return float(found), growth.longest(h)


def _allowed(step: Adaptive, state, new) -> float:
    """The largest local error."""
    size = max(float(np.abs(state.x).max()), float(np.abs(new.x).max()))
    return max(step.atol + step.rtol * size, array.VANISHED)


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
