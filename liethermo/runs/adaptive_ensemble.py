"""Ensembles with adaptive steps or events: each trajectory takes the steps that it would take alone."""

from __future__ import annotations

import threading
from collections.abc import Callable

import numpy as np

from ..engines.adaptive_runs import AdaptiveRuns, EventRules, PauseHandler, start_adaptive_runs
from ..engines.compiled.engine import CompiledAdaptiveRuns
from ..engines.status_codes import StatusCode
from ..engines.step import REPORTED_FIELDS
from ..systems import System
from .driver import advance_until_all_end
from .ensemble_lanes import RECORDED_INITIAL_FIELDS, EnsembleRun
from .lanes import CompiledLanes

ATTEMPTS_PER_CALL_RANGE = (16, 2048)
"""Smallest and largest number of attempted steps per engine call; paused trajectories wait until the call ends."""

MAX_FIRST_ATTEMPTS = 20
"""Largest number of attempts after which the size of a first step is recorded; more are hardly ever needed."""

TARGET_ATTEMPTS_PER_CALL = 2**15
"""Target number of attempted steps per engine call, summed over trajectories and clipped to
``ATTEMPTS_PER_CALL_RANGE``."""


RUNNING_CODES = (StatusCode.COMPLETED, StatusCode.PAUSED_AT_STOP, StatusCode.PAUSED_FOR_GROWTH_RATE)
"""Status codes of trajectories that have not ended."""


class AdaptiveEnsembleRun(EnsembleRun):
    """Run of a group of trajectories of an ensemble with adaptive steps or events."""

    @property
    def _start_first_stop_and_span_length(self) -> tuple[float, float, float]:
        schedule = self.group.schedule
        return schedule.start, float(schedule.stop_times[0]), schedule.end - schedule.start

    def _record_compiled_lanes(self, lanes: CompiledLanes, members: slice, stop_signal: threading.Event) -> None:
        parameters, x0 = lanes.parameters_of_members(members, members.stop - members.start), self.group.x0[members]
        adaptive_runs = CompiledAdaptiveRuns(
            lanes.step_loop, lanes.first_lane_parameters, parameters, x0, *self._start_first_stop_and_span_length
        )
        # finished trajectories free their lanes
        indices, keep_only = np.arange(members.start, members.stop), adaptive_runs.keep_trajectories
        self._advance_to_end(_BatchRecorder(self, adaptive_runs, indices, keep_only, stop_signal.is_set))

    def _run_vmapped_batch(self, padded_members: np.ndarray, n_members: int) -> None:
        group = self.group
        assert group.control is not None
        arguments = (
            group.family.program_structure,
            *group.family.vmap_arguments(padded_members),
            group.method,
            group.control,
        )
        adaptive_runs = start_adaptive_runs(
            *arguments, group.x0[padded_members], *self._start_first_stop_and_span_length
        )
        self._advance_to_end(_BatchRecorder(self, adaptive_runs, padded_members, None, lambda: False))

    def _advance_to_end(self, recorder: _BatchRecorder) -> None:
        """Advance the trajectories of a recorder until all have ended, and record their states and ends."""
        try:
            advance_until_all_end(recorder.pause_handler, recorder)
        except KeyboardInterrupt:
            self.is_interrupted = True
        recorder.record_unfinished_as_interrupted()


class _BatchRecorder:
    """Recorder that stores the states, events and results of a batch of adaptive trajectories of an ensemble.

    Parameters
    ----------
    run : AdaptiveEnsembleRun
    adaptive_runs : AdaptiveRuns
    members : array of int
        Indices of the trajectories in the group.
    keep_only : function of indices in the batch, or None
        Removes the trajectories with other indices from the batch.
    is_stopped : function
        Returns True if the user has interrupted the run.
    """

    def __init__(
        self,
        run: AdaptiveEnsembleRun,
        adaptive_runs: AdaptiveRuns,
        members: np.ndarray,
        keep_only: Callable | None,
        is_stopped: Callable[[], bool],
    ):
        self.runs, self.members, self.group, self.record = adaptive_runs, members, run.group, run.record
        self.progress_counter, self.keep_only, self.is_stopped = run.progress_counter, keep_only, is_stopped
        control, events, stop_times = self.group.control, self.group.events, self.group.schedule.stop_times
        assert control is not None
        rules = EventRules() if events is None else events.rules
        self.pause_handler = PauseHandler(
            adaptive_runs, control, self.group.method, stop_times, self._system_of_trajectory, rules
        )
        self.initial = {name: adaptive_runs.read(name).copy() for name in RECORDED_INITIAL_FIELDS}
        self.record.store_initial_states(members, self.initial["x"], self.initial["energy"], self.initial["entropy"])
        self.is_running = np.ones(len(members), dtype=bool)
        self._is_first_attempt = True

    def _system_of_trajectory(self, i: int) -> System:
        return self.group.family.member(int(self.members[i]))

    def can_continue(self) -> bool:
        return bool(self.is_running.any()) and not self.is_stopped()

    def attempt_steps(self) -> None:
        if self._is_first_attempt:
            self._take_and_record_first_steps()
            self._is_first_attempt = False
        self.runs.advance(int(np.clip(TARGET_ATTEMPTS_PER_CALL // len(self.members), *ATTEMPTS_PER_CALL_RANGE)))

    def _take_and_record_first_steps(self) -> None:
        """Let the trajectories attempt their first step until it is accepted, and record its size for the audit.

        For a trajectory that pauses or ends before its first accepted step, the size of its next attempt is recorded.
        """
        start, runs = self.group.schedule.start, self.runs
        sizes = np.minimum(runs.read("next_step_size"), self.group.schedule.end - start)
        is_pending = np.ones(len(self.members), dtype=bool)
        for _ in range(MAX_FIRST_ATTEMPTS):
            runs.advance(1)
            is_accepted = is_pending & (runs.read("step") > 0)
            sizes[is_accepted] = runs.read("t")[is_accepted] - start
            is_pending &= ~is_accepted
            if not (is_pending & (runs.read("status") == StatusCode.COMPLETED)).any():
                break
        self.record.store_first_step_sizes(self.members, sizes)

    def handle_pauses(self) -> None:
        handler, runs = self.pause_handler, self.runs
        if self.group.events is not None:
            self.group.events.raise_first_error()
            self.record.store_events(handler.occurrences, self.members)
            handler.occurrences.clear()
        indices = handler.paused_indices(StatusCode.PAUSED_AT_STOP)
        indices = indices[np.isin(runs.read("t", indices), self.group.schedule.saved_stop_times)]
        if indices.size:
            columns = [runs.read("x", indices), *(runs.read(n, indices)[:, None] for n in ("energy", "entropy"))]
            self.record.store_states_at_times(self.members[indices], runs.read("t", indices), np.hstack(columns))

    def record_ended_trajectories(self) -> None:
        status = self.runs.read("status")
        indices = np.flatnonzero(self.is_running & ~np.isin(status, RUNNING_CODES))
        if indices.size:
            reached_end = status[indices] == StatusCode.REACHED_END
            self._record_final_fields(indices, np.where(reached_end, StatusCode.COMPLETED, status[indices]))
        self.is_running[indices] = False
        self.progress_counter.add(np.unique(self.members[indices]).size)
        if self.keep_only is not None and 2 * self.is_running.sum() <= len(self.members) and self.is_running.any():
            running_indices = np.flatnonzero(self.is_running)
            self.keep_only(running_indices)
            self.pause_handler.keep_trajectories(running_indices)
            self.members, self.is_running = self.members[running_indices], self.is_running[running_indices]
            self.initial = {name: values[running_indices] for name, values in self.initial.items()}

    def record_unfinished_as_interrupted(self) -> None:
        """Record the unfinished trajectories as interrupted."""
        indices = np.flatnonzero(self.is_running)
        if indices.size:
            self._record_final_fields(indices, np.full(indices.size, StatusCode.INTERRUPTED))

    def _record_final_fields(self, indices: np.ndarray, status_codes: np.ndarray) -> None:
        """Record the outcome of the trajectories with these indices in the batch."""
        runs, members = self.runs, self.members[indices]
        initial = {name: values[indices] for name, values in self.initial.items()}
        final = {name: runs.read(name, indices) for name in REPORTED_FIELDS}
        end_time, n_rejected = runs.read("t", indices), runs.read("n_rejected", indices)
        self.record.record_outcome(members, initial, final, status_codes, end_time, n_rejected)
