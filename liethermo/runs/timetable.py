"""Where a run of equal steps arrives when, what it keeps, and in which portions the engines take it."""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from ..engines.array import MAX_SAVES_PER_CALL
from ..errors import InputError
from ..functions.gradients import EPS
from .adaptive import Adaptive

CHUNK_STEPS = 100_000
"""Steps per call of the engine at most (about a second), so that Ctrl-C is heard."""


TIME_TOLERANCE_ULPS = 4.0
"""Roundings of the larger end of a span that its length may be off by, where the ends are multiples of a step."""


class ScheduleSegment(NamedTuple):
    """Equal steps from one time to another, and a shorter one, of size ``last_step_size``, where they do not arrive there."""

    start: float
    end: float
    n_full_steps: int
    last_step_size: float

    @classmethod
    def from_span(cls, start: float, end: float, h: float) -> ScheduleSegment:
        if math.isinf(h):
            return cls(start, end, 0, end - start)
        # The tolerance keeps 0.1 * 1000 from asking for a thousand-and-first step of 1e-14, and 1024.9 - 1024.8 from
        # asking for a second one: the times themselves are rounded.
        rounding = min(TIME_TOLERANCE_ULPS * EPS * max(abs(start), abs(end)), 0.01 * h)
        tolerance = max(1e-12 * (end - start), rounding)
        full = math.floor((end - start + tolerance) / h)
        last = end - (start + full * h)
        return cls(start, end, full, last if last > tolerance else 0.0)

    @property
    def n_steps(self) -> int:
        return self.n_full_steps + (self.last_step_size > 0.0)

    def equal_steps(self, h: float) -> list[tuple[float, int]]:
        """Return the step sizes, and how many steps of each size follow one another."""
        return [(size, n) for size, n in ((h, self.n_full_steps), (self.last_step_size, 1)) if n and size]


class StepSchedule:
    """Steps of one size over a span of time, from stop to stop.

    Parameters
    ----------
    span : (float, float)
    step : float
    save_every : int or None
        Keep the states of every ``save_every``-th step, and the last; None keeps those at the stops alone.
    stop_times : array, optional
        Times at which steps end, the end of the span the last, which is the only one otherwise.
    allow_infinite_end : bool
        Whether the end may be infinite, for steps that are not of one size.

    Attributes
    ----------
    start, end, h : float
    segments : list of Part
    n_steps : int
        How many there are.

    Raises
    ------
    InputError
        If the span or the step cannot be used.
    """

    def __init__(
        self, span, step, save_every: int | None, stop_times: np.ndarray | None = None, allow_infinite_end: bool = False
    ):
        self.start, self.end = checked_span(span, allow_infinite_end)
        self.h = math.inf if math.isinf(self.end) else checked_step(step, self.start, self.end)
        if save_every is not None and (
            isinstance(save_every, bool) or not isinstance(save_every, int) or save_every < 1
        ):
            raise InputError(f"save_every must be a positive integer, not {save_every!r}")
        ends = [self.end] if stop_times is None else [float(t) for t in stop_times if t > self.start]
        self.save_every, self.segments = (
            save_every,
            [ScheduleSegment.from_span(*ends, self.h) for ends in itertools.pairwise([self.start, *ends])],
        )
        self.n_steps = sum(part.n_steps for part in self.segments)

    @classmethod
    def of_zero_length(cls, t: float) -> StepSchedule:
        """Return the course over a span of length zero, without a step."""
        course = cls.__new__(cls)
        course.start = course.end = t
        course.h, course.save_every, course.segments, course.n_steps = 0.0, None, [], 0
        return course

    def engine_calls(
        self, max_steps: int = CHUNK_STEPS, max_saves: int = MAX_SAVES_PER_CALL, save_all: bool = False
    ) -> Iterator[tuple[float, int, int, bool]]:
        """The run in calls ``(h, saves, every, kept)`` of an engine: so many saves, each after so many steps of size h.

        None has more than ``max_saves`` saves, nor more than ``max_steps`` steps unless that is a single save. With ``save_all``
        every state is saved. ``kept`` is whether what is saved is kept.
        """
        own = 1 if save_all else self.save_every
        for part in self.segments:
            done = 0
            while done < part.n_full_steps:
                left = part.n_full_steps - done
                every = min(own or max_steps, left)
                count = 1 if own is None else max(1, min(max_saves, max_steps // every, left // every))
                done += count * every
                yield self.h, count, every, own is not None or done >= part.n_steps
            if part.last_step_size:
                yield part.last_step_size, 1, 1, True

    @property
    def stop_times(self) -> np.ndarray:
        """The times at which steps have to end, increasing; the last is the end of the span."""
        return np.array([part.end for part in self.segments])

    def step_size_after(self, step: int) -> float:
        """The size of the step after so many; of the last where there are no more."""
        for part in self.segments:
            if step < part.n_steps or part is self.segments[-1]:
                break
            step -= part.n_steps
        return part.last_step_size if step >= part.n_full_steps else self.h

    @property
    def longest_steps(self) -> np.ndarray:
        """The longest of the steps after each state that is kept."""
        longest = [self.h if part.n_full_steps else part.last_step_size for part in self.segments]
        return np.array(longest) if self.save_every is None else np.full(len(self.saved_step_counts) - 1, longest[0])

    @functools.cached_property
    def saved_step_counts(self) -> np.ndarray:
        """Steps after which states are kept, 0 (the start) and the last among them."""
        if self.save_every is None:
            return self._steps_before_segments
        kept = np.arange(0, self.segments[0].n_full_steps + 1, self.save_every)
        return np.append(
            kept, [n for n in sorted({self.segments[0].n_full_steps, self.n_steps}) if n > kept[-1]]
        ).astype(int)

    @functools.cached_property
    def _steps_before_segments(self) -> np.ndarray:
        """The steps before each part, and all."""
        return np.cumsum([0, *(part.n_steps for part in self.segments)])

    @property
    def saved_times(self) -> np.ndarray:
        """The times at :attr:`counts`."""
        return self.times_after(self.saved_step_counts)

    def times_after(self, steps: np.ndarray) -> np.ndarray:
        """The times after so many steps."""
        if len(self.segments) == 1:
            return np.where(
                steps >= self.n_steps, self.end, np.minimum(_time_after(self.start, steps, self.h), self.end)
            )
        place = np.clip(
            np.searchsorted(self._steps_before_segments, steps, side="right") - 1, 0, len(self.segments) - 1
        )
        starts, ends = (np.array([getattr(part, name) for part in self.segments])[place] for name in ("start", "end"))
        last = steps >= self._steps_before_segments[place + 1]
        return np.where(
            last, ends, np.minimum(_time_after(starts, steps - self._steps_before_segments[place], self.h), ends)
        )


def make_schedule(
    span, step: float | Adaptive, save_every: int | None, save_at=None, allow_infinite_end: bool = False
) -> StepSchedule:
    """The course of a run whose states are kept at these times, if any are given; adaptive steps are as one."""
    start, end = checked_span(span, allow_infinite_end)
    size = end - start if isinstance(step, Adaptive) else step
    course = StepSchedule((start, end), size, save_every, allow_infinite_end=allow_infinite_end)
    if save_at is None:
        return course
    return StepSchedule((start, end), size, None, _stop_times(save_at, start, end), allow_infinite_end)


def _stop_times(save_at, start: float, end: float) -> np.ndarray:
    """The times at which steps have to end, the end of the span among them."""
    times = np.atleast_1d(np.asarray(save_at, dtype=np.float64))
    if times.ndim != 1 or not np.isfinite(times).all() or times.size == 0:
        raise InputError(f"save_at must be a list of times, got {save_at!r}")
    return np.unique([*clip_times_to_span(times, start, end, "save_at"), end])


def clip_times_to_span(times: np.ndarray, start: float, end: float, name: str) -> np.ndarray:
    """Return times that are moved to an end of a span if they lie beyond it by rounding: 0.1 + 0.1 + 0.1 > 0.3.

    Raises
    ------
    InputError
        If one lies outside of the span.
    """
    rounding = TIME_TOLERANCE_ULPS * EPS * max(abs(start), abs(end) if math.isfinite(end) else 0.0)
    outside = times[~((times >= start - rounding) & (times <= end + rounding))]
    if outside.size:
        raise InputError(f"{name} must be times of t_span = ({start:g}, {end:g}), got {outside[0]:g}, outside of it")
    return np.clip(times, start, end)


def _time_after(start, steps, h: float) -> np.ndarray:
    """Return ``start + steps * h``, rounded once (Dekker's product and Knuth's sum)."""
    steps, (h_high, h_low) = np.asarray(steps, dtype=np.float64), _split_double(np.float64(h))
    high, low = _split_double(steps)
    product = steps * h
    lost = ((high * h_high - product) + high * h_low + low * h_high) + low * h_low
    found = start + product
    other = found - start
    lost = lost + (start - (found - other)) + (product - other)
    return np.where(np.isfinite(lost), found + lost, found)


def _split_double(a) -> tuple[np.ndarray, np.ndarray]:
    """Two numbers of 26 bits whose sum is a."""
    with np.errstate(over="ignore", invalid="ignore"):
        shifted = a * (2.0**27 + 1.0)
        high = shifted - (shifted - a)
        return high, a - high


def checked_span(span, endless: bool = False) -> tuple[float, float]:
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


def checked_step(step, start: float, end: float) -> float:
    try:
        h = float(step)
    except (TypeError, ValueError):
        raise InputError(f"step must be a number, not {step!r}") from None
    if not (math.isfinite(h) and h > 0.0):
        raise InputError(f"step must be positive and finite, got {h:g}")
    if start + h == start or end + h == end:
        raise InputError(f"step {h:g} vanishes beside the times {start:g} and {end:g} in double precision")
    return h
