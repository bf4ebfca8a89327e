"""Ensembles with adaptive steps or events: each trajectory takes the steps that it would take alone."""

from __future__ import annotations

import threading
from collections.abc import Callable

import numpy as np

from ..engines.adaptive_runs import AdaptiveRuns, EventRules, PauseHandler, start_adaptive_runs
from ..engines.compiled.adaptive_runs import CompiledAdaptiveRuns
from ..engines.status_codes import StatusCode
from ..engines.step import REPORTED_FIELDS
from ..engines.step_control import StepControl
from ..integrators import OneStepMethod
from .batches import (
    ARRAY_BATCH_SIZE,
    RECORDED_INITIAL_FIELDS,
    LaneParameters,
    ProgressCounter,
    padded_member_indices,
    run_in_threads,
)
from .events import EventSet
from .record import EnsembleRecord
from .system_family import Family

ATTEMPTS_PER_CALL_RANGE = (16, 2048)
"""Smallest and largest number of attempted steps per engine call; paused trajectories wait until the call ends."""

TARGET_ATTEMPTS_PER_CALL = 2**15
"""Target number of attempted steps per engine call, summed over trajectories and clipped to
``ATTEMPTS_PER_CALL_RANGE``."""


class AdaptiveEnsembleRun:
    """Run of an ensemble with adaptive steps or events.

    Parameters
    ----------
    family : Family
    method : OneStepMethod
    control : StepControl
    record : EnsembleRecord
    progress_counter : ProgressCounter
    events : EventSet, optional
        The events whose functions the control has.
    """

    def __init__(
        self,
        family: Family,
        method: OneStepMethod,
        control: StepControl,
        record: EnsembleRecord,
        progress_counter: ProgressCounter,
        events: EventSet | None = None,
    ):
        self.family, self.method, self.control, self.record, self.progress_counter = (
            family,
            method,
            control,
            record,
            progress_counter,
        )
        self.events = events
        self.interrupted = False
        self.stop_times = record.schedule.stop_times

    @property
    def _start_stop_length(self) -> tuple[float, float, float]:
        schedule = self.record.schedule
        return schedule.start, float(self.stop_times[0]), schedule.end - schedule.start

    def run_compiled(self) -> None:
        """Run all trajectories in SIMD lanes over threads; finished ones free their lanes."""
        lanes, n_members = LaneParameters(self.family, self.method, self.control), len(self.record.x0)

        def work(members: slice, stop: threading.Event) -> None:
            parameters = lanes.parameters(members, members.stop - members.start)
            adaptive_runs = CompiledAdaptiveRuns(
                lanes.step_loop,
                lanes.first_lane_parameters,
                parameters,
                self.record.x0[members],
                *self._start_stop_length,
            )
            self._advance_to_end(
                adaptive_runs, np.arange(members.start, members.stop), adaptive_runs.keep_only, stop.is_set
            )

        run_in_threads(work, n_members)

    def run_array(self) -> None:
        """Run all trajectories on the array engine, one vmapped program per batch."""
        n_members = len(self.record.x0)
        for start in range(0, n_members, ARRAY_BATCH_SIZE):
            members = padded_member_indices(start, min(start + ARRAY_BATCH_SIZE, n_members), self.record.x0.shape[1])
            parameters, axes = self.family.vmap_arguments(members)
            batch_arguments = self.family.form, parameters, axes, self.method, self.control
            adaptive_runs = start_adaptive_runs(*batch_arguments, self.record.x0[members], *self._start_stop_length)
            self._advance_to_end(adaptive_runs, members, None, lambda: self.interrupted)

    def _advance_to_end(
        self,
        adaptive_runs: AdaptiveRuns,
        members: np.ndarray,
        keep_only: Callable | None,
        is_stopped: Callable[[], bool],
    ) -> None:
        """Advance the trajectories with these member indices until all have ended, and fill the record.

        Parameters
        ----------
        keep_only : function of indices, or None
            Removes all other trajectories from the batch.
        is_stopped : function
            Returns True if the user has interrupted the run.
        """
        record = self.record
        rules = EventRules() if self.events is None else self.events.rules
        pause_handler = PauseHandler(
            adaptive_runs,
            self.control,
            self.method,
            self.stop_times,
            lambda i: self.family.member(int(members[i])),
            rules,
        )
        initial = {name: adaptive_runs.read(name).copy() for name in RECORDED_INITIAL_FIELDS}
        record.record_initial(members, initial["x"], initial["energy"], initial["entropy"])
        is_running = np.ones(len(members), dtype=bool)
        pause_handler.resume_paused()
        record.quantities["first_step"][members] = np.minimum(
            adaptive_runs.read("next_step_size"), self._start_stop_length[2]
        )

        def record_finished(
            indices: np.ndarray, status: np.ndarray, fields: dict[str, np.ndarray], end_time: np.ndarray
        ) -> None:
            initial_fields = {name: values[indices] for name, values in initial.items()}
            record.finish_members(members[indices], initial_fields, fields, status, end_time)
            record.rejected[members[indices]] = adaptive_runs.read("n_rejected", indices)

        def fields_of(indices: np.ndarray) -> dict[str, np.ndarray]:
            return {name: adaptive_runs.read(name, indices) for name in REPORTED_FIELDS}

        try:
            while is_running.any() and not is_stopped():
                adaptive_runs.advance(int(np.clip(TARGET_ATTEMPTS_PER_CALL // len(members), *ATTEMPTS_PER_CALL_RANGE)))
                pause_handler.confirm_events()
                if self.events is not None:
                    self.events.raise_error()
                    record.store_events(pause_handler.occurrences, members)
                    pause_handler.occurrences.clear()
                stopped_indices = pause_handler.paused_indices(StatusCode.PAUSED_AT_STOP)
                if stopped_indices.size:
                    columns = [
                        adaptive_runs.read("x", stopped_indices),
                        *(adaptive_runs.read(n, stopped_indices)[:, None] for n in ("energy", "entropy")),
                    ]
                    record.store_states_at(
                        members[stopped_indices], adaptive_runs.read("t", stopped_indices), np.hstack(columns)
                    )
                pause_handler.resume_paused()
                status = adaptive_runs.read("status")
                finished_indices = np.flatnonzero(
                    is_running
                    & ~np.isin(
                        status, (StatusCode.COMPLETED, StatusCode.PAUSED_AT_STOP, StatusCode.PAUSED_FOR_GROWTH_RATE)
                    )
                )
                if finished_indices.size:
                    codes = np.where(
                        status[finished_indices] == StatusCode.REACHED_END,
                        StatusCode.COMPLETED,
                        status[finished_indices],
                    )
                    record_finished(
                        finished_indices, codes, fields_of(finished_indices), adaptive_runs.read("t", finished_indices)
                    )
                is_running[finished_indices] = False
                self.progress_counter.add(np.unique(members[finished_indices]).size)
                if keep_only is not None and 2 * is_running.sum() <= len(members) and is_running.any():
                    running_indices = np.flatnonzero(is_running)
                    keep_only(running_indices)
                    pause_handler.keep_only(running_indices)
                    members, is_running = members[running_indices], is_running[running_indices]
                    initial = {name: values[running_indices] for name, values in initial.items()}
        except KeyboardInterrupt:
            self.interrupted = True
        running_indices = np.flatnonzero(is_running)
        if running_indices.size:
            record_finished(
                running_indices,
                np.full(running_indices.size, StatusCode.INTERRUPTED),
                fields_of(running_indices),
                adaptive_runs.read("t", running_indices),
            )
