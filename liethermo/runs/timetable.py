"""Where a run of equal steps arrives when, what it keeps, and in which portions the engines take it."""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from ..engines.array import KEPT_STATES
from ..errors import InputError
from ..functions.gradients import EPS
from .adaptive import Adaptive

CHUNK_STEPS = 100_000
"""Steps per call of the engine at most (about a second), so that Ctrl-C is heard."""


ROUNDINGS_OF_TIME = 4.0
"""Roundings of the larger end of a span that its length may be off by, where the ends are multiples of a step."""


class Part(NamedTuple):
    """Equal steps from one time to another, and a shorter one, of size ``last``, where they do not arrive there."""

    start: float
    end: float
    full: int
    last: float

    @classmethod
    def of(cls, start: float, end: float, h: float) -> Part:
        if math.isinf(h):
            return cls(start, end, 0, end - start)
        # The tolerance keeps 0.1 * 1000 from asking for a thousand-and-first step of 1e-14, and 1024.9 - 1024.8 from
        # asking for a second one: the times themselves are rounded.
        rounding = min(ROUNDINGS_OF_TIME * EPS * max(abs(start), abs(end)), 0.01 * h)
        tolerance = max(1e-12 * (end - start), rounding)
        full = math.floor((end - start + tolerance) / h)
        last = end - (start + full * h)
        return cls(start, end, full, last if last > tolerance else 0.0)

    @property
    def steps(self) -> int:
        return self.full + (self.last > 0.0)


class Course:
    """Steps of one size over a span of time, from stop to stop.

    Parameters
    ----------
    span : (float, float)
    step : float
    every : int or None
        Keep the states of every ``save_every``-th step, and the last; None keeps those at the stops alone.
    stops : array, optional
        Times at which steps end, the end of the span the last, which is the only one otherwise.
    endless : bool
        Whether the end may be infinite, for steps that are not of one size.

    Attributes
    ----------
    start, end, h : float
    parts : list of Part
    steps : int
        How many there are.

    Raises
    ------
    InputError
        If the span or the step cannot be used.
    """

    def __init__(self, span, step, every: int | None, stops: np.ndarray | None = None, endless: bool = False):
        self.start, self.end = _checked_span(span, endless)
        self.h = math.inf if math.isinf(self.end) else _checked_step(step, self.start, self.end)
        if every is not None and (isinstance(every, bool) or not isinstance(every, int) or every < 1):
            raise InputError(f"save_every must be a positive integer, not {every!r}")
        ends = [self.end] if stops is None else [float(t) for t in stops if t > self.start]
        self.every, self.parts = every, [Part.of(*ends, self.h) for ends in itertools.pairwise([self.start, *ends])]
        self.steps = sum(part.steps for part in self.parts)

    @classmethod
    def at(cls, t: float) -> Course:
        """Return the course over a span of length zero, without a step."""
        course = cls.__new__(cls)
        course.start = course.end = t
        course.h, course.every, course.parts, course.steps = 0.0, None, [], 0
        return course

    def calls(
        self, limit: int = CHUNK_STEPS, saves: int = KEPT_STATES, each: bool = False
    ) -> Iterator[tuple[float, int, int, bool]]:
        """The run in calls ``(h, saves, every, kept)`` of an engine: so many saves, each after so many steps of size h.

        None has more than ``saves`` saves, nor more than ``limit`` steps unless that is a single save. With ``each``
        every state is saved. ``kept`` is whether what is saved is kept.
        """
        own = 1 if each else self.every
        for part in self.parts:
            done = 0
            while done < part.full:
                left = part.full - done
                every = min(own or limit, left)
                count = 1 if own is None else max(1, min(saves, limit // every, left // every))
                done += count * every
                yield self.h, count, every, own is not None or done >= part.steps
            if part.last:
                yield part.last, 1, 1, True

    @property
    def stops(self) -> np.ndarray:
        """The times at which steps have to end, increasing; the last is the end of the span."""
        return np.array([part.end for part in self.parts])

    def size(self, step: int) -> float:
        """The size of the step after so many; of the last where there are no more."""
        for part in self.parts:
            if step < part.steps or part is self.parts[-1]:
                break
            step -= part.steps
        return part.last if step >= part.full else self.h

    @property
    def longest(self) -> np.ndarray:
        """The longest of the steps after each state that is kept."""
        longest = [self.h if part.full else part.last for part in self.parts]
        return np.array(longest) if self.every is None else np.full(len(self.counts) - 1, longest[0])

    @functools.cached_property
    def counts(self) -> np.ndarray:
        """Steps after which states are kept, 0 (the start) and the last among them."""
        if self.every is None:
            return self._before
        kept = np.arange(0, self.parts[0].full + 1, self.every)
        return np.append(kept, [n for n in sorted({self.parts[0].full, self.steps}) if n > kept[-1]]).astype(int)

    @functools.cached_property
    def _before(self) -> np.ndarray:
        """The steps before each part, and all."""
        return np.cumsum([0, *(part.steps for part in self.parts)])

    @property
    def times(self) -> np.ndarray:
        """The times at :attr:`counts`."""
        return self.reached(self.counts)

    def reached(self, steps: np.ndarray) -> np.ndarray:
        """The times after so many steps."""
        if len(self.parts) == 1:
            return np.where(steps >= self.steps, self.end, np.minimum(_time_after(self.start, steps, self.h), self.end))
        place = np.clip(np.searchsorted(self._before, steps, side="right") - 1, 0, len(self.parts) - 1)
        starts, ends = (np.array([getattr(part, name) for part in self.parts])[place] for name in ("start", "end"))
        last = steps >= self._before[place + 1]
        return np.where(last, ends, np.minimum(_time_after(starts, steps - self._before[place], self.h), ends))


def course_of(span, step: float | Adaptive, every: int | None, save_at=None, endless: bool = False) -> Course:
    """The course of a run whose states are kept at these times, if any are given; adaptive steps are as one."""
    start, end = _checked_span(span, endless)
    size = end - start if isinstance(step, Adaptive) else step
    course = Course((start, end), size, every, endless=endless)
    if save_at is None:
        return course
    return Course((start, end), size, None, _stops(save_at, start, end), endless)


def _stops(save_at, start: float, end: float) -> np.ndarray:
    """The times at which steps have to end, the end of the span among them."""
    times = np.atleast_1d(np.asarray(save_at, dtype=np.float64))
    if times.ndim != 1 or not np.isfinite(times).all() or times.size == 0:
        raise InputError(f"save_at must be a list of times, got {save_at!r}")
    return np.unique([*times_within(times, start, end, "save_at"), end])


def times_within(times: np.ndarray, start: float, end: float, name: str) -> np.ndarray:
    """Return times that are moved to an end of a span if they lie beyond it by rounding: 0.1 + 0.1 + 0.1 > 0.3.

    Raises
    ------
    InputError
        If one lies outside of the span.
    """
    rounding = ROUNDINGS_OF_TIME * EPS * max(abs(start), abs(end) if math.isfinite(end) else 0.0)
    outside = times[~((times >= start - rounding) & (times <= end + rounding))]
    if outside.size:
        raise InputError(f"{name} must be times of t_span = ({start:g}, {end:g}), got {outside[0]:g}, outside of it")
    return np.clip(times, start, end)


def _time_after(start, steps, h: float) -> np.ndarray:
    """Return ``start + steps * h``, rounded once (Dekker's product and Knuth's sum)."""
    steps, (h_high, h_low) = np.asarray(steps, dtype=np.float64), _halves(np.float64(h))
    high, low = _halves(steps)
    product = steps * h
    lost = ((high * h_high - product) + high * h_low + low * h_high) + low * h_low
    found = start + product
    other = found - start
    lost = lost + (start - (found - other)) + (product - other)
    return np.where(np.isfinite(lost), found + lost, found)


def _halves(a) -> tuple[np.ndarray, np.ndarray]:
    """Two numbers of 26 bits whose sum is a."""
    with np.errstate(over="ignore", invalid="ignore"):
        shifted = a * (2.0**27 + 1.0)
        high = shifted - (shifted - a)
        return high, a - high


def _checked_span(span, endless: bool) -> tuple[float, float]:
    try:
        start, end = (float(t) for t in span)
    except (TypeError, ValueError):
        raise InputError(f"t_span must be two numbers (start, end), got {span!r:.60}") from None
    if not (math.isfinite(start) and end > start and (endless or math.isfinite(end))):
        cure = "" if end != math.inf else (
            ". An infinite end needs lt.integrate with adaptive steps and an event to stop at: step=lt.Adaptive(rtol), "
            "until=event"
        )  # fmt: skip
        raise InputError(f"t_span must be finite and increasing, got ({start:g}, {end:g}){cure}")
    return start, end


def _checked_step(step, start: float, end: float) -> float:
    try:
        h = float(step)
    except (TypeError, ValueError):
        raise InputError(f"step must be a number, not {step!r}") from None
    if not (math.isfinite(h) and h > 0.0):
        raise InputError(f"step must be positive and finite, got {h:g}")
    if start + h == start or end + h == end:
        raise InputError(f"step {h:g} vanishes beside the times {start:g} and {end:g} in double precision")
    return h
