"""Schedules of fixed steps: their times, the steps whose states are saved, and the calls of an engine."""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from ..engines.array_engine import MAX_SAVES_PER_CALL
from ..errors import InputError
from ..functions.conditions import checked_host_numbers, host_number
from ..functions.gradients import EPS
from ..functions.time_span import BREAK_RTOL, TIMES_OF_SMOOTH_FUNCTIONS, DeclaredTimes, checked_breaks
from .adaptive import Adaptive

CHUNK_STEPS = 100_000
"""Largest number of steps in one call of an engine, about a second of work; Ctrl-C acts between calls."""


TIME_TOLERANCE_ULPS = 4.0
"""Allowed error of the length of a span, in units in the last place of its larger end; the ends are themselves rounded
multiples of a step."""


class ScheduleSegment(NamedTuple):
    """Equal steps from ``start`` to ``end``, with a shorter last step if the equal steps do not reach the end.

    Attributes
    ----------
    start, end : float
    n_full_steps : int
    last_step_size : float
        Size of the shorter last step; 0 if there is none.
    saves_end : bool
        Whether the state at the end is saved.
    """

    start: float
    end: float
    n_full_steps: int
    last_step_size: float
    saves_end: bool = True

    @classmethod
    def from_span(cls, start: float, end: float, h: float, saves_end: bool = True) -> ScheduleSegment:
        """Return the segment of steps of size h over a span, to rounding of the times."""
        if math.isinf(h):
            return cls(start, end, 0, end - start, saves_end)
        # The tolerance keeps 0.1 * 1000 from asking for a thousand-and-first step of 1e-14, and 1024.9 - 1024.8 from
        # asking for a second one: the times themselves are rounded.
        rounding = min(TIME_TOLERANCE_ULPS * EPS * max(abs(start), abs(end)), 0.01 * h)
        tolerance = max(1e-12 * (end - start), rounding)
        n_full_steps = math.floor((end - start + tolerance) / h)
        last_step_size = end - (start + n_full_steps * h)
        return cls(start, end, n_full_steps, last_step_size if last_step_size > tolerance else 0.0, saves_end)

    @property
    def n_steps(self) -> int:
        return self.n_full_steps + (self.last_step_size > 0.0)

    def step_sizes_and_counts(self, h: float) -> list[tuple[float, int]]:
        """Return a list of (step size, number of steps): the equal steps, then the shorter last one."""
        return [(size, n) for size, n in ((h, self.n_full_steps), (self.last_step_size, 1)) if n and size]


class EngineCall(NamedTuple):
    """One call of an engine: ``n_saves`` saves, each after ``steps_per_save`` steps of size h.

    Attributes
    ----------
    are_states_saved : bool
        False if the states of this call are not among the saved states of the run.
    """

    h: float
    n_saves: int
    steps_per_save: int
    are_states_saved: bool


class StepSchedule:
    """A schedule of steps of one size over a time span, with stops at which steps must end.

    Parameters
    ----------
    span : (float, float)
    step : float
    save_every : int or None
        Save every ``save_every``-th state between two stops, and the states at the stops; with None save only the
        states at the times ``save_at``.
    save_at : array, optional
        Times to save, increasing, the last of which is the end of the span; the end alone by default.
    allow_infinite_end : bool
        Allow an infinite end, for adaptive steps.
    breaks : sequence of float
        Increasing times at which functions of time jump: steps end at those inside the span too.

    Attributes
    ----------
    start, end, h : float
    breaks, all_breaks : tuple of float
        The breaks inside the span, and all breaks that were given.
    segments : list of ScheduleSegment
        One for each stop: each time to save, and each break.
    n_steps : int
        Number of steps of all segments.

    Raises
    ------
    InputError
        If the span or the step cannot be used.
    """

    def __init__(
        self,
        span,
        step,
        save_every: int | None,
        save_at: np.ndarray | None = None,
        allow_infinite_end: bool = False,
        breaks: Sequence[float] = (),
    ):
        self.start, self.end = checked_span(span, allow_infinite_end)
        self.h = math.inf if math.isinf(self.end) else checked_resolvable_step(step, self.start, self.end)
        if save_every is not None and (
            isinstance(save_every, bool) or not isinstance(save_every, int) or save_every < 1
        ):
            raise InputError(f"save_every must be a positive integer, got {save_every!r}")
        saved_stops = {self.end} if save_at is None else {float(t) for t in save_at if t > self.start}
        self.all_breaks = tuple(breaks)
        rounding = self._break_tolerance
        self.breaks = tuple(t for t in breaks if self.start + rounding < t < self.end - rounding)
        stops = sorted({*saved_stops, *self.breaks})
        self.save_every = save_every
        self.segments = [
            ScheduleSegment.from_span(*ends, self.h, save_every is not None or ends[1] in saved_stops)
            for ends in itertools.pairwise([self.start, *stops])
        ]
        self.n_steps = sum(segment.n_steps for segment in self.segments)

    @classmethod
    def empty_schedule(cls, t: float) -> StepSchedule:
        """Return the schedule of a span of length zero at time t; it has no step."""
        schedule = cls.__new__(cls)
        schedule.start = schedule.end = t
        schedule.h, schedule.save_every, schedule.segments, schedule.n_steps = 0.0, None, [], 0
        schedule.breaks, schedule.all_breaks = (), ()
        return schedule

    @property
    def _break_tolerance(self) -> float:
        """Largest distance at which a break counts as being at an end of the span."""
        return BREAK_RTOL * max(abs(self.start), abs(self.end) if math.isfinite(self.end) else 0.0)

    @property
    def span_of_time_functions(self) -> tuple[float, float]:
        """First and last time at which functions of time are evaluated.

        The span, shortened by a rounding error if there is a break at its start or end, so that functions are evaluated
        after the first break and before the last.
        """
        rounding = self._break_tolerance
        starts_at_break = any(abs(t - self.start) <= rounding for t in self.all_breaks)
        ends_at_break = any(abs(t - self.end) <= rounding for t in self.all_breaks)
        return self.start + rounding * starts_at_break, self.end - rounding * ends_at_break

    def with_more_breaks(self, breaks: Sequence[float]) -> StepSchedule:
        """Return a schedule that also ends steps at these breaks inside the span."""
        if not breaks:
            return self
        save_at = self.saved_stop_times if self.save_every is None else None
        break_times = sorted({*self.all_breaks, *breaks})
        return StepSchedule((self.start, self.end), self.h, self.save_every, save_at, breaks=break_times)

    def has_step_end_at(self, t: float) -> bool:
        """Return whether a time inside the span is a whole number of steps after its start, to rounding."""
        segment = next(segment for segment in self.segments if t <= segment.end)
        n_steps = round((t - segment.start) / self.h)
        rounding = TIME_TOLERANCE_ULPS * EPS * max(abs(self.start), abs(self.end))
        return 0 < n_steps <= segment.n_full_steps and abs(segment.start + n_steps * self.h - t) <= rounding

    def engine_calls(
        self, max_steps: int = CHUNK_STEPS, max_saves: int = MAX_SAVES_PER_CALL, save_all: bool = False
    ) -> Iterator[EngineCall]:
        """Yield the engine calls that take all steps in order.

        A call has at most ``max_saves`` saves, and at most ``max_steps`` steps unless it has a single save. With
        ``save_all`` every step is saved.
        """
        save_every = 1 if save_all else self.save_every
        for segment in self.segments:
            n_done = 0
            while n_done < segment.n_full_steps:
                n_remaining = segment.n_full_steps - n_done
                steps_per_save = min(save_every or max_steps, n_remaining)
                n_saves = (
                    1
                    if save_every is None
                    else max(1, min(max_saves, max_steps // steps_per_save, n_remaining // steps_per_save))
                )
                n_done += n_saves * steps_per_save
                is_end = n_done >= segment.n_steps
                are_states_saved = save_every is not None or (is_end and segment.saves_end)
                yield EngineCall(self.h, n_saves, steps_per_save, are_states_saved)
            if segment.last_step_size:
                yield EngineCall(segment.last_step_size, 1, 1, segment.saves_end)

    @property
    def stop_times(self) -> np.ndarray:
        """Times at which steps must end, in increasing order; the last is the end of the span."""
        return np.array([segment.end for segment in self.segments])

    @property
    def saved_stop_times(self) -> np.ndarray:
        """Times at which steps must end and states are saved, in increasing order."""
        return np.array([segment.end for segment in self.segments if segment.saves_end])

    def step_size_after(self, n_steps: int) -> float:
        """Return the size of the step that follows ``n_steps`` steps; at the end, the size of the last step."""
        for segment in self.segments:
            if n_steps < segment.n_steps or segment is self.segments[-1]:
                break
            n_steps -= segment.n_steps
        return segment.last_step_size if n_steps >= segment.n_full_steps else self.h

    @property
    def longest_step_after_each_save(self) -> np.ndarray:
        """Size of the longest step between each saved state and the next, shape (saved states - 1,)."""
        if not self.segments:
            return np.zeros(0)
        n_full_steps, last_step_sizes = self._full_steps_and_last_step_sizes
        full_steps_before_segments = np.cumsum([0, *n_full_steps])
        segment_index = self._segment_indices_after_steps(self.saved_step_counts)
        steps_in_segment = self.saved_step_counts - self._steps_before_segments[segment_index]
        n_full = full_steps_before_segments[segment_index] + np.minimum(steps_in_segment, n_full_steps[segment_index])
        longest_last_steps = np.maximum.reduceat(last_step_sizes, segment_index[:-1])
        return np.where(np.diff(n_full) > 0, self.h, longest_last_steps)

    @functools.cached_property
    def saved_step_counts(self) -> np.ndarray:
        """Numbers of steps after which states are saved, from 0 (the start) to ``n_steps``."""
        counts = [np.zeros(1, dtype=int)]
        for first_step, segment in zip(self._steps_before_segments, self.segments, strict=False):
            if self.save_every is not None:
                counts.append(first_step + np.arange(0, segment.n_full_steps + 1, self.save_every))
                counts.append(np.array([first_step + segment.n_full_steps]))
            if segment.saves_end:
                counts.append(np.array([first_step + segment.n_steps]))
        return np.unique(np.concatenate(counts))

    @functools.cached_property
    def _full_steps_and_last_step_sizes(self) -> tuple[np.ndarray, np.ndarray]:
        """Number of full steps of each segment, and the size of its last step."""
        return (
            np.array([segment.n_full_steps for segment in self.segments]),
            np.array([segment.last_step_size for segment in self.segments]),
        )

    def _segment_indices_after_steps(self, step_counts: np.ndarray) -> np.ndarray:
        """Return the indices of the segments that contain the steps which follow ``step_counts`` steps."""
        index = np.searchsorted(self._steps_before_segments, step_counts, side="right") - 1
        return np.clip(index, 0, len(self.segments) - 1)

    @functools.cached_property
    def _steps_before_segments(self) -> np.ndarray:
        """Number of steps before each segment; the total is the last entry."""
        return np.cumsum([0, *(segment.n_steps for segment in self.segments)])

    @functools.cached_property
    def saved_times(self) -> np.ndarray:
        """Times of the saved states."""
        return self.times_after(self.saved_step_counts)

    def time_after(self, n_steps: int) -> float:
        """Return the time after ``n_steps`` steps."""
        return self.end if n_steps >= self.n_steps else float(self.times_after(np.asarray(n_steps)))

    def times_after(self, step_counts: np.ndarray) -> np.ndarray:
        """Return the times after ``step_counts`` steps, in an array of the same shape."""
        if len(self.segments) == 1:
            times = np.minimum(_add_steps_to_time(self.start, step_counts, self.h), self.end)
            return np.where(step_counts >= self.n_steps, self.end, times)
        segment_index = self._segment_indices_after_steps(step_counts)
        starts, ends = (
            np.array([getattr(segment, name) for segment in self.segments])[segment_index] for name in ("start", "end")
        )
        is_last_step = step_counts >= self._steps_before_segments[segment_index + 1]
        return np.where(
            is_last_step,
            ends,
            np.minimum(
                _add_steps_to_time(starts, step_counts - self._steps_before_segments[segment_index], self.h), ends
            ),
        )


MAX_KINKS = 1000
"""Largest number of declared kinks in a span at which steps end.

A run that ends 1,000 steps at such times takes 0.7 s, one with 3,000 of them 8.6 s, since each step looks for its
interval among all (order 8 at a tolerance of 1e-9)."""


def make_schedule(
    span,
    step: float | Adaptive,
    save_every: int | None,
    save_at=None,
    allow_infinite_end: bool = False,
    breaks: Sequence[float] = (),
    declared_times: DeclaredTimes = TIMES_OF_SMOOTH_FUNCTIONS,
) -> StepSchedule:
    """Return the schedule of a run; an adaptive run has one nominal step, as long as the span.

    With ``save_at`` the steps end at these times, and only the states there are saved. Steps also end at the user's
    ``breaks`` and at the declared jumps and kinks of the system inside the span. Kinks are left out if they are more
    than MAX_KINKS or more than the fixed steps, or if they would change which states ``save_every`` saves.
    """
    start, end = checked_span(span, allow_infinite_end)
    refuse_span_beyond_known_times(start, end, declared_times.known_span)
    step_size = end - start if isinstance(step, Adaptive) else checked_resolvable_step(step, start, end)
    kinks = [t for t in declared_times.kinks if start < t < end]
    if not isinstance(step, Adaptive) and (save_every not in (None, 1) or len(kinks) * step_size > end - start):
        kinks = []
    kinks = kinks if len(kinks) <= MAX_KINKS else []
    break_times = {*(checked_breaks(breaks) if np.size(breaks) else ()), *declared_times.jumps, *kinks}
    breaks_in_span = tuple(sorted(t for t in break_times if start <= t <= end))
    schedule = StepSchedule(
        (start, end), step_size, save_every, allow_infinite_end=allow_infinite_end, breaks=breaks_in_span
    )
    if save_at is None:
        return schedule
    save_times = _sorted_save_times_and_end(save_at, start, end, schedule.breaks)
    return StepSchedule((start, end), step_size, None, save_times, allow_infinite_end, breaks_in_span)


def refuse_span_beyond_known_times(start: float, end: float, known_span: tuple[float, float]) -> None:
    """Raise InputError if a span exceeds the times at which functions of time are known by more than rounding."""
    rounding = TIME_TOLERANCE_ULPS * EPS * max(abs(t) for t in (start, end, *known_span) if math.isfinite(t))
    if start < known_span[0] - rounding or end > known_span[1] + rounding:
        raise InputError(
            f"t_span = ({start:g}, {end:g}) goes beyond the times of a coefficient that is an array, from "
            f"{known_span[0]:g} to {known_span[1]:g}. Give its values for the whole span in times="
        )


def _sorted_save_times_and_end(save_at, start: float, end: float, breaks: tuple[float, ...]) -> np.ndarray:
    """Return the sorted times of ``save_at`` and the end of the span; times at a break, to rounding, become the break.

    Raises
    ------
    InputError
        If ``save_at`` is not a list of finite times within the span.
    """
    times = np.atleast_1d(checked_host_numbers(save_at, "save_at"))
    if times.ndim != 1 or not np.isfinite(times).all() or times.size == 0:
        raise InputError(f"save_at must be a list of times, got {save_at!r}")
    times = clip_times_to_span(times, start, end, "save_at")
    for t in breaks:
        times = np.where(np.abs(times - t) <= TIME_TOLERANCE_ULPS * EPS * max(abs(start), abs(t)), t, times)
    return np.unique([*times, end])


def clip_times_to_span(times: np.ndarray, start: float, end: float, argument_name: str) -> np.ndarray:
    """Return the times, after moving those outside the span by a rounding error to its ends.

    Such an error arises if a user adds times: ``0.1 + 0.1 + 0.1 > 0.3``.

    Raises
    ------
    InputError
        If a time is outside the span by more than rounding.
    """
    rounding = TIME_TOLERANCE_ULPS * EPS * max(abs(start), abs(end) if math.isfinite(end) else 0.0)
    invalid_times = times[~((times >= start - rounding) & (times <= end + rounding))]
    if invalid_times.size:
        raise InputError(
            f"{argument_name} must be times of t_span = ({start:g}, {end:g}), got {invalid_times[0]:g}, outside of it"
        )
    return np.clip(times, start, end)


MAX_SPLIT_STEP = 1e290
"""Largest step whose products are computed in two parts, which overflow for larger ones."""


def _add_steps_to_time(start, n_steps, h: float) -> np.ndarray:
    """Return ``start + n_steps * h``, rounded once (Dekker's product and Knuth's sum)."""
    if h > MAX_SPLIT_STEP:
        with np.errstate(over="ignore", invalid="ignore"):
            return start + np.asarray(n_steps, dtype=np.float64) * h
    n_steps, (h_high, h_low) = np.asarray(n_steps, dtype=np.float64), _veltkamp_split(np.float64(h))
    steps_high, steps_low = _veltkamp_split(n_steps)
    product = n_steps * h
    rounding_error = ((steps_high * h_high - product) + steps_high * h_low + steps_low * h_high) + steps_low * h_low
    total = start + product
    increment = total - start
    rounding_error = rounding_error + (start - (total - increment)) + (product - increment)
    return total + rounding_error


def _veltkamp_split(number) -> tuple[np.ndarray, np.ndarray]:
    """Return the high and the low part of a number, of at most 26 bits each (Veltkamp's splitting)."""
    scaled_value = number * (2.0**27 + 1.0)
    high_part = scaled_value - (scaled_value - number)
    return high_part, number - high_part


def backward_span_message(start: float, end: float) -> str:
    """Return the message of the error for a span whose end is before its start."""
    return (
        f"t_span must be finite and increasing, got ({start:g}, {end:g}). To find an earlier state, integrate the "
        "equations with SciPy, which conserves no law exactly: scipy.integrate.solve_ivp(lambda t, x: "
        f"system.vector_field(x, t), ({start!r}, {end!r}), x0, rtol=1e-10, atol=1e-12)"
    )


def checked_span(span, allow_infinite_end: bool = False) -> tuple[float, float]:
    """Return start and end of a span as floats; raise InputError unless start < end and both are finite.

    With ``allow_infinite_end`` the end may be infinite.
    """
    try:
        start, end = (host_number(t, "t_span") for t in span)
    except (TypeError, ValueError):
        raise InputError(f"t_span must be two numbers (start, end), got {span!r:.60}") from None
    if not (math.isfinite(start) and end > start and (allow_infinite_end or math.isfinite(end))):
        if -math.inf < end < start < math.inf:
            raise InputError(backward_span_message(start, end))
        cure = "" if end != math.inf else (
            ". An infinite end needs lt.integrate with adaptive steps and an event to stop at: step=lt.Adaptive(rtol), "
            "until=event"
        )  # fmt: skip
        raise InputError(f"t_span must be finite and increasing, got ({start:g}, {end:g}){cure}")
    return start, end


def checked_step_size(step) -> float:
    """Return the step size as a float; raise InputError unless it is positive and finite."""
    h = host_number(step, "step")
    if not (math.isfinite(h) and h > 0.0):
        raise InputError(f"step must be positive and finite, got {h:g}")
    return h


def checked_resolvable_step(step, start: float, end: float) -> float:
    """Return the step size as a float; raise InputError unless it is positive and above the rounding of the times."""
    h = checked_step_size(step)
    if start + h == start or end + h == end:
        raise InputError(
            f"step {h:g} is below the rounding of the times {start:g} and {end:g} in double precision. Give a larger "
            "step, or measure the time from a start nearer to zero"
        )
    return h
