"""The only time loop: a run under way, what is kept of it, and how it ended."""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from manifolds.errors import warn

from ..engines.choice import Chosen
from ..engines.codes import Code
from ..engines.stepping import values
from ..errors import FileError
from ..integrators import Reference
from ..integrators.fluctuating import noise_dimension
from ..results.dense import Dense
from ..results.solution import Solution
from ..results.status import Stats, Status
from ..tracing.interpret import at_points
from .adaptive import Adaptive, pacing_of
from .ending import STOPPED, given_up, stats_of, status_of, stopped_by
from .events import Event
from .fluctuations import Fluctuations, Paths
from .preparation import within_span
from .presented import Again, presented, provenance_of
from .stepwise import MOST_KEPT, Steps, follow
from .timetable import Course
from .watch import Watch

MOST_LISTED = 1_000
"""Components up to which the first state is listed in the provenance; an attribute of a file cannot be of any size."""

CHECKPOINT_SECONDS = 60.0
"""A run with ``save_to`` rewrites its file at most this often before the end."""


UNIT_LENGTH = 1.0
"""The length that an endless span counts for where the first step is a share of it, from a state at rest."""


class Run:
    """A run under way: what has been saved, and how it stands."""

    def __init__(
        self,
        system,
        method,
        x0,
        course: Course,
        save_to,
        engine: str,
        noise: Fluctuations | None = None,
        dense: bool = False,
    ):
        self.prepared, self.system = system, within_span(system, course.start, course.end)
        self.method, self.course = method, course
        self.save_to, self.started = save_to, time.perf_counter()
        self.written = self.started
        self.times = [np.array([course.start])]
        self.states = [np.asarray(x0)[None]]
        self.values: list[np.ndarray] = []  # energies and entropies of the states
        self.status: Status | None = None
        self.stats = Stats()
        self.step: float | Adaptive = course.h
        self.event_time: float | None = None
        self.path = [(self.times[0], self.states[0])] if dense else None  # all states
        self.taken: list[np.ndarray] = []  # sizes of steps that are looked at, and whether states after them are kept
        self.noise = noise
        path: Callable | None = None
        if noise is not None and (increments := noise_dimension(method)):
            only = Paths(noise, increments, np.zeros(1, dtype=int), course)
            path = lambda first, steps, h: only.rows(slice(None), first, steps, h)[0]  # noqa: E731
        self.engine = Chosen(self.system, method, engine, course.steps, path)

    @property
    def now(self) -> float:
        """The time of the last state that is kept."""
        return next(float(times[-1]) for times in reversed(self.times) if len(times))

    # -- the library's own methods ----------------------------------------------------------------------------------

    def by_steps(self, bar) -> None:
        """Drive the engine call by call, to the end, a failure or Ctrl-C."""
        state, stopped = None, ""
        try:
            state = self.engine.begin(self.states[0][0])
            self.values = [np.array([[float(state.energy), float(state.entropy)]])]
            for h, saves, every, kept in self.course.calls(saves=self.engine.portion, each=self.path is not None):
                state = self._advance(state, h, saves, every, kept)
                bar.update(float(self.course.reached(np.asarray(int(state.step)))))
                if int(state.status) != Code.COMPLETED:
                    break
                self._checkpoint(state)
        except STOPPED as error:
            stopped = stopped_by(error)
        if state is None:
            self._not_begun(stopped)
            return
        step = int(state.step)
        now, h = float(self.course.reached(np.asarray(step))), self.course.size(step)
        if now > self.now:  # it ended between two states that are kept
            self._keep(
                np.array([now]), np.asarray(state.x)[None], np.array([[float(state.energy), float(state.entropy)]])
            )
        self.stats, self.status = stats_of(state), status_of(self.engine, state, now, h, stopped)

    def _not_begun(self, stopped: str) -> None:
        self.values = [self._energies(self.states[0])]
        self.status = Status(Code.INTERRUPTED, f"stopped {stopped} before the first step", 0, self.course.start)

    def take_no_step(self) -> None:
        """Complete a run over a span of length zero."""
        self.values = [self._energies(self.states[0])]
        self.status = Status(Code.COMPLETED, f"reached t = {self.course.end:g} in 0 steps", 0, self.course.end)

    def by_paces(self, bar, step: float | Adaptive, until) -> None:
        """Look at every step: adaptive ones, and those with events."""
        start, end, every = self.course.start, self.course.end, self.course.every or 1
        at_stops, watch = self.course.every is None, until if isinstance(until, Watch) else None
        stops = self.course.stops
        event = None if until is None or watch else Event(until, self.system)
        self.step, last = step, None

        def keep(steps: Steps):
            nonlocal last
            ends = steps.t[1:]
            kept = np.isin(ends, stops) if at_stops else steps.number % every == 0
            self._append(steps, kept)
            self.taken.append(np.stack([steps.h, kept]))
            last = None if kept[-1] else steps
            if self.path is not None:
                self.path.append((ends, steps.x))
            bar.update(ends[-1])
            self._checkpoint(steps.after)

        length = end - start if math.isfinite(end) else UNIT_LENGTH
        pacing = pacing_of(step, self.method, end - start, event)
        try:
            paces = self.engine.paces(pacing, self.states[0][0], start, float(stops[0]), length)
        except STOPPED as error:
            self._not_begun(stopped_by(error))
            return
        state = paces.state()
        self.values = [np.array([[float(state.energy), float(state.entropy)]])]
        numbers = self.system.dim * ((0 if at_stops else 1) / every + (self.path is not None))
        room = MOST_KEPT / max(numbers, 1e-9)
        outcome = follow(self.engine, paces, pacing, stops, keep, room, watch)
        if last is not None:
            self._append(last, slice(-1, None))
        self.event_time = outcome.event_time
        state, now = outcome.state, self.now
        self.stats = dataclasses.replace(stats_of(state), rejected=outcome.rejected)
        steps = int(state.step)
        if isinstance(step, Adaptive) and (outcome.underflow is not None or outcome.limit in ("steps", "memory")):
            self.status = given_up(
                self.system, self.method, np.asarray(self.states[0][0]), outcome, step, (start, end), now
            )
        elif outcome.unknown is not None:
            self.status = Status(outcome.unknown.code, str(outcome.unknown), steps, now, float(state.residual))
        elif event is not None and outcome.limit:
            text = f"{event.name} is not a number at some states near t = {now:g}, and has other signs before and "
            text += "after: whether it is zero there is not known, so extend the function"
            self.status = Status(Code.NON_FINITE, text, steps, now, float(state.residual))
        elif outcome.event_time is not None:
            text = f"{Watch.name if event is None else event.name}: reached at t = {now:.15g} in {steps} steps"
            self.status = Status(Code.EVENT, text, steps, now, float(state.residual))
        else:
            h = step if isinstance(step, float) else float("nan")
            self.status = status_of(self.engine, state, now, h, outcome.stopped)
            if watch and watch.remark and self.status.ok:
                self.status = dataclasses.replace(self.status, message=f"{self.status.message}; {watch.remark}")
            if event is not None and self.status.ok:
                text = f"{self.status.message}; the event ({event.name}) did not happen"
                if outcome.jumps:
                    text += f": it changed its sign {len(outcome.jumps)} times without being zero, first at t = "
                    text += f"{outcome.jumps[0]:g}"
                if outcome.undefined:
                    text = f"{self.status.message}; whether the event ({event.name}) happened is not known, since the "
                    text += "function is NaN at the end. Define it for all states of the run"
                self.status = dataclasses.replace(self.status, message=text)

    def _append(self, steps: Steps, kept: np.ndarray | slice) -> None:
        self._keep(steps.t[1:][kept], steps.x[kept], np.column_stack([steps.energy, steps.entropy])[kept])

    def _advance(self, state, h, saves, every, kept: bool):
        before = int(state.step)
        state, (x, energy, entropy, reached) = self.engine.advance(state, h, saves, every)
        number = int(np.asarray(reached).sum())
        steps, x = before + every * np.arange(1, number + 1), np.asarray(x)[:number]
        times, values = self.course.reached(steps), np.column_stack([energy, entropy])[:number]
        if self.path is not None:
            self.path.append((times, x))
            chosen = np.isin(steps, self.course.counts)
            times, x, values = times[chosen], x[chosen], values[chosen]
        if kept:
            self._keep(times, x, values)
        return state

    def _keep(self, times: np.ndarray, x: np.ndarray, values: np.ndarray) -> None:
        self.times.append(times)
        self.states.append(x)
        self.values.append(values)

    # -- SciPy --------------------------------------------------------------------------------------------------------

    def by_scipy(self, bar) -> None:
        """One call of the reference solver, its output at the times a fixed step would have."""
        times = self.course.times
        self.values = [self._energies(self.states[0])]
        x, evaluations, message, interrupted = self.method.trajectory(self.system, self.states[0][0], times)
        self.times, self.states = [times[: len(x)]], [x]
        self.values = [self._energies(x)]
        self.stats = Stats(steps=len(x) - 1, fixed_point_iterations=evaluations)
        now = self.now
        bar.update(now)
        if interrupted:
            text = f"stopped by the user after t = {now:g}"
            self.status = Status(Code.INTERRUPTED, text, len(x) - 1, now)
        elif message:
            text = f"SciPy's {self.method.scheme} stopped after t = {now:g}: {message}"
            self.status = Status(Code.REFERENCE_FAILED, text, len(x) - 1, now)
        else:
            self.status = Status(Code.COMPLETED, f"reached t = {now:g}", len(x) - 1, now)

    def _energies(self, x: np.ndarray) -> np.ndarray:
        return np.stack(at_points(values, self.system, x), axis=1)

    # -- the result ---------------------------------------------------------------------------------------------------

    def solution(self) -> Solution:
        """What there is so far."""
        x = np.concatenate(self.states)
        energy, entropy = np.concatenate(self.values).T
        return presented(
            self.system,
            self.method,
            x,
            t=np.concatenate(self.times),
            energy=energy,
            entropy=entropy,
            steps=self._longest(len(x) - 1),
            again=Again(self.engine),
            prepared_as=self.prepared,
            status=self.status or Status(Code.INTERRUPTED, "still running", len(x) - 1, self.now),
            stats=dataclasses.replace(self.stats, wall_time=time.perf_counter() - self.started),
            provenance=self._provenance(),
            event_time=self.event_time,
            dense=self._dense(),
        )

    def _dense(self) -> Dense | None:
        if self.path is None:
            return None
        times, states = zip(*self.path, strict=True)
        return Dense(np.concatenate(times), np.concatenate(states), self.engine.ends)

    def _longest(self, number: int) -> np.ndarray:
        """The longest of the steps after each state that is kept."""
        if not self.taken:
            return self.course.longest[:number]
        h, kept = np.concatenate(self.taken, axis=1)
        return np.maximum.reduceat(h, np.flatnonzero(np.append(1.0, kept[:-1])))[:number]

    def _checkpoint(self, state) -> None:
        if self.save_to is not None and time.perf_counter() - self.written > CHECKPOINT_SECONDS:
            self.stats = stats_of(state)
            try:
                self.solution().save(self.save_to)
            except FileError as error:  # there may be room at the end
                warn(f"{error}. The run goes on")
            self.written = time.perf_counter()

    def _provenance(self) -> dict[str, Any]:
        return {
            **provenance_of(
                self.system, self.method, self.step, (self.course.start, self.course.end), self.course.every
            ),
            "engine": None if isinstance(self.method, Reference) else self.engine.name,
            "noise": None if self.noise is None else self.noise.listed(),
            "x0": np.asarray(self.states[0][0]).tolist() if self.system.dim <= MOST_LISTED else None,
        }
