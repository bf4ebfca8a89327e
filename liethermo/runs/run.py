"""The only time loop: a run under way, what is kept of it, and how it ended."""

from __future__ import annotations

import dataclasses
import time
from typing import Any

import numpy as np

from manifolds.errors import warn

from ..engines.choice import Chosen
from ..engines.codes import Code
from ..engines.stepping import values
from ..errors import FileError
from ..integrators import Reference
from ..results.dense import Dense
from ..results.solution import Solution
from ..results.status import Stats, Status
from ..tracing.interpret import at_points
from .adaptive import Adaptive
from .ending import STOPPED, given_up, stats_of, status_of, stopped_by
from .events import Event
from .fluctuations import Fluctuations, Path
from .presented import Again, presented, provenance_of
from .stepwise import MOST_KEPT, Steps, stops_of
from .stepwise import run as run_stepwise
from .timetable import Timetable
from .watch import Watch

MOST_LISTED = 1_000
"""Components up to which the first state is listed in the provenance; an attribute of a file cannot be of any size."""

CHECKPOINT_SECONDS = 60.0
"""A run with ``save_to`` rewrites its file at most this often before the end."""


class Run:
    """A run under way: what has been saved, and how it stands."""

    def __init__(self, system, method, x0, table: Timetable, save_to, engine, noise: Fluctuations | None = None):
        self.system, self.method, self.table = system, method, table
        self.save_to, self.started = save_to, time.perf_counter()
        self.written = self.started
        self.times = [np.array([table.start])]
        self.states = [np.asarray(x0)[None]]
        self.values: list[np.ndarray] = []  # energies and entropies of the states
        self.status: Status | None = None
        self.stats = Stats()
        self.step: float | Adaptive = table.h
        self.event_time: float | None = None
        self.dense: Dense | None = None
        self.taken: list[np.ndarray] = []  # sizes of steps that are looked at, and whether states after them are kept
        self.noise = noise
        path = None if noise is None or not method.increments else Path(noise, method.increments)
        self.engine = Chosen(system, method, engine, table.steps, path)

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
            for h, saves, every in self.table.calls(saves=self.engine.portion):
                state = self._advance(state, h, saves, every)
                bar.update(self.now)
                if int(state.status) != Code.COMPLETED:
                    break
                self._checkpoint(state)
        except STOPPED as error:
            stopped = stopped_by(error)
        if state is None:
            self.values = [self._energies(self.states[0])]
            self.status = Status(Code.INTERRUPTED, f"stopped {stopped} before the first step", 0, self.table.start)
            return
        step = int(state.step)
        now, h = self.table.time(step), self.table.last if step >= self.table.full else self.table.h
        self.stats, self.status = stats_of(state), status_of(self.engine, state, now, h, stopped)

    def by_single_steps(self, bar, step: float | Adaptive, save_at, until, dense: bool) -> None:
        """Look at every step: adaptive ones, events, outputs at given times, dense output."""
        start, end, every = self.table.start, self.table.end, self.table.every or 1
        stops, watch = stops_of(save_at, start, end), until if isinstance(until, Watch) else None
        event = None if until is None or watch else Event(until, self.system)
        self.step, all_times, all_states, last = step, [self.times[0]], [self.states[0]], None

        def keep(steps: Steps):
            nonlocal last
            ends = steps.t[1:]
            kept = np.isin(ends, stops) if save_at is not None else steps.number % every == 0
            self._append(steps, kept)
            self.taken.append(np.stack([steps.h, kept]))
            last = None if kept[-1] else steps
            if dense:
                all_times.append(ends)
                all_states.append(steps.x)
            bar.update(ends[-1])
            self._checkpoint(steps.after)

        state = None
        try:
            state = self.engine.begin(self.states[0][0])
        except STOPPED as error:
            self.values = [self._energies(self.states[0])]
            self.status = Status(Code.INTERRUPTED, f"stopped {stopped_by(error)} before the first step", 0, start)
            return
        self.values = [np.array([[float(state.energy), float(state.entropy)]])]
        numbers = self.system.dim * ((1 if save_at is None else 0) / every + (1 if dense else 0))
        outcome = run_stepwise(
            self.engine,
            state,
            (start, end),
            step,
            stops,
            event,
            keep,
            most_kept=MOST_KEPT / max(numbers, 1e-9),
            watch=watch,
        )
        if last is not None:
            self._append(last, slice(-1, None))
        self.event_time = outcome.event_time
        if dense:
            self.dense = Dense(np.concatenate(all_times), np.concatenate(all_states), self.engine.ends)
        state, now = outcome.state, self.now
        self.stats = dataclasses.replace(stats_of(state), rejected=outcome.rejected)
        steps = int(state.step)
        if isinstance(step, Adaptive) and (outcome.underflow is not None or outcome.limit in ("steps", "memory")):
            self.status = given_up(self.system, np.asarray(self.states[0][0]), outcome, step, (start, end), now)
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
            if event is not None and self.status.ok:
                text = f"{self.status.message}; the event ({event.name}) did not happen"
                if outcome.jumps:
                    text += f": it changed its sign {len(outcome.jumps)} times without being zero, first at t = "
                    text += f"{outcome.jumps[0]:g}"
                self.status = dataclasses.replace(self.status, message=text)

    def _append(self, steps: Steps, kept: np.ndarray | slice) -> None:
        values = np.column_stack([steps.energy, steps.entropy])[kept]
        times, states = steps.t[1:][kept], steps.x[kept]  # before any is kept: there may be no memory left
        self.times.append(times)
        self.states.append(states)
        self.values.append(values)

    def _advance(self, state, h, saves, every):
        before = int(state.step)
        state, (x, energy, entropy, reached) = self.engine.advance(state, h, saves, every)
        kept = int(np.asarray(reached).sum())
        states, steps = np.asarray(x)[:kept], before + every * np.arange(1, kept + 1)
        values = np.stack([np.asarray(energy)[:kept], np.asarray(entropy)[:kept]], axis=1)
        if int(state.step) > before + every * kept:  # it failed between two saves: keep what there is
            states, steps = np.concatenate([states, np.asarray(state.x)[None]]), np.append(steps, int(state.step))
            values = np.append(values, [[float(state.energy), float(state.entropy)]], axis=0)
        self.states.append(states)
        self.values.append(values)
        self.times.append(self.table.reached(steps))
        return state

    # -- SciPy --------------------------------------------------------------------------------------------------------

    def by_scipy(self, bar) -> None:
        """One call of the reference solver, its output at the times a fixed step would have."""
        times = self.table.times
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
            status=self.status or Status(Code.INTERRUPTED, "still running", len(x) - 1, self.now),
            stats=dataclasses.replace(self.stats, wall_time=time.perf_counter() - self.started),
            provenance=self._provenance(),
            event_time=self.event_time,
            dense=self.dense,
        )

    def _longest(self, number: int) -> np.ndarray:
        """The longest of the steps after each state that is kept."""
        if not self.taken:
            return np.full(number, self.table.h if self.table.full else self.table.last)
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
            **provenance_of(self.system, self.method, self.step, (self.table.start, self.table.end), self.table.every),
            "engine": None if isinstance(self.method, Reference) else self.engine.name,
            "noise": None if self.noise is None else self.noise.listed(),
            "x0": np.asarray(self.states[0][0]).tolist() if self.system.dim <= MOST_LISTED else None,
        }
