"""Where a run of equal steps arrives when, what it keeps, and in which portions the engines take it."""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Iterator

import numpy as np

from ..engines.array import KEPT_STATES
from ..errors import InputError

CHUNK_STEPS = 100_000
"""Steps per call of the engine at most (about a second), so that Ctrl-C is heard."""


class Timetable:
    """Steps of one size over a span of time, and a shorter one where the span is no multiple of it.

    Parameters
    ----------
    span : (float, float)
    step : float
    every : int or None
        Keep the states of every ``save_every``-th step, and the last; None keeps the last alone.

    Attributes
    ----------
    start, end, h : float
    last : float
        Size of the shorter last step; 0 where there is none.
    full, steps : int
        How many full steps there are, and steps in all.

    Raises
    ------
    InputError
        If the span or the step cannot be used.
    """

    def __init__(self, span, step, every: int | None):
        self.start, self.end = _checked_span(span)
        self.h = _checked_step(step, self.start, self.end)
        if every is not None and (isinstance(every, bool) or not isinstance(every, int) or every < 1):
            raise InputError(f"save_every must be a positive integer, not {every!r}")
        self.every = every
        # The tolerance keeps 0.1 * 1000 from asking for a thousand-and-first step of 1e-14.
        self.full = math.floor((self.end - self.start) / self.h * (1 + 1e-12))
        self.last = self.end - (self.start + self.full * self.h)
        if self.last <= 1e-12 * (self.end - self.start):
            self.last = 0.0
        self.steps = self.full + (self.last > 0.0)

    def time(self, step: int) -> float:
        """The time after so many steps."""
        return float(self.reached(np.asarray(step)))

    def reached(self, steps: np.ndarray) -> np.ndarray:
        """The times after so many steps."""
        return np.where(steps >= self.steps, self.end, self.start + steps * self.h)

    @functools.cached_property
    def counts(self) -> np.ndarray:
        """Steps after which states are kept, 0 (the start) and the last among them."""
        kept = np.arange(0, self.full + 1, self.every or self.steps)
        ends = {self.steps} if self.every is None else {self.full, self.steps}
        return np.append(kept, np.array(sorted(n for n in ends if n > kept[-1]), dtype=kept.dtype))

    @property
    def times(self) -> np.ndarray:
        """The times at :attr:`counts`."""
        return self.reached(self.counts)

    @property
    def longest(self) -> float:
        """The longest of the steps."""
        return self.h if self.full else self.last

    def calls(
        self, limit: int = CHUNK_STEPS, saves: int = KEPT_STATES, each: bool = False
    ) -> Iterator[tuple[float, int, int]]:
        """The run in calls ``(h, saves, every)`` of an engine: so many saves, each after so many steps of size h.

        None has more than ``saves`` saves, nor more than ``limit`` steps unless that is a single save. With ``each``
        every state is saved.
        """
        done, own = 0, 1 if each else self.every
        while done < self.full:
            left = self.full - done
            every = min(own or limit, left)
            kept = 1 if own is None else max(1, min(saves, limit // every, left // every))
            yield self.h, kept, every
            done += kept * every
        if self.last:
            yield self.last, 1, 1


class Course:
    """Equal steps from stop to stop: a :class:`Timetable` for each part of a span, one after another.

    Parameters
    ----------
    span, step, every
        As for :class:`Timetable`.
    stops : array, optional
        Times at which steps end and states are kept, the end of the span the last; without them, every n-th state.

    Attributes
    ----------
    start, end, h : float
    parts : list of Timetable
    """

    def __init__(self, span, step, every: int | None, stops: np.ndarray | None = None):
        whole = Timetable(span, step, every)
        self.start, self.end, self.h = whole.start, whole.end, whole.h
        self.every, self.parts = every, [whole]
        if stops is not None:
            ends = [float(t) for t in stops if t > self.start]
            self.parts = [Timetable(part, step, None) for part in itertools.pairwise([self.start, *ends])]

    def calls(
        self, limit: int = CHUNK_STEPS, saves: int = KEPT_STATES, each: bool = False
    ) -> Iterator[tuple[float, int, int, bool]]:
        """The run in calls of an engine as those of :meth:`Timetable.calls`, and whether what they save is kept."""
        for part in self.parts:
            done = 0
            for h, kept, every in part.calls(limit, saves, each):
                done += kept * every
                yield h, kept, every, each or part.every is not None or done >= part.steps

    def size(self, step: int) -> float:
        """The size of the step after so many; of the last where there are no more."""
        for part in self.parts:
            if step < part.steps or part is self.parts[-1]:
                break
            step -= part.steps
        return part.last if step >= part.full else part.h

    @property
    def longest(self) -> np.ndarray:
        """The longest of the steps after each state that is kept."""
        return np.concatenate([np.full(len(part.counts) - 1, part.longest) for part in self.parts])

    @property
    def steps(self) -> int:
        """How many steps there are."""
        return sum(part.steps for part in self.parts)

    @property
    def counts(self) -> np.ndarray:
        """Steps after which states are kept, 0 (the start) and the last among them."""
        first, *others = self.parts
        before = np.cumsum([part.steps for part in self.parts])
        return np.concatenate([first.counts, *(n + part.counts[1:] for n, part in zip(before, others, strict=False))])

    @property
    def times(self) -> np.ndarray:
        """The times at :attr:`counts`."""
        first, *others = self.parts
        return np.concatenate([first.times, *(part.times[1:] for part in others)])

    def reached(self, steps: np.ndarray) -> np.ndarray:
        """The times after so many steps."""
        if len(self.parts) == 1:
            return self.parts[0].reached(steps)
        before = np.cumsum([0, *(part.steps for part in self.parts)])
        place = np.clip(np.searchsorted(before, steps, side="right") - 1, 0, len(self.parts) - 1)
        starts, ends = (np.array([getattr(part, name) for part in self.parts])[place] for name in ("start", "end"))
        last = steps >= before[place + 1]
        return np.where(last, ends, np.minimum(starts + (steps - before[place]) * self.h, ends))


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


def _checked_span(span) -> tuple[float, float]:
    try:
        start, end = (float(t) for t in span)
    except (TypeError, ValueError):
        raise InputError(f"t_span must be two numbers (start, end), not {span!r}") from None
    if not (math.isfinite(start) and math.isfinite(end) and end > start):
        raise InputError(f"t_span must be finite and increasing, not ({start:g}, {end:g})")
    return start, end


def _checked_step(step, start: float, end: float) -> float:
    try:
        h = float(step)
    except (TypeError, ValueError):
        raise InputError(f"step must be a number, not {step!r}") from None
    if not (math.isfinite(h) and h > 0.0):
        raise InputError(f"step must be positive and finite, not {h:g}: time runs forwards, since entropy grows")
    if start + h == start or end + h == end:
        raise InputError(f"step {h:g} vanishes beside the times {start:g} and {end:g} in double precision")
    return h
