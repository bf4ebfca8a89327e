"""Many trajectories with steps of their own, or with events: from pause to pause, each as it would be alone."""

from __future__ import annotations

import threading
from collections.abc import Callable

import numpy as np

from ..engines.codes import StatusCode
from ..engines.compiled.paced import CompiledAdaptiveRuns
from ..engines.paced import AdaptiveRuns, PauseHandler, start_batch
from ..engines.pacing import StepControl
from ..engines.stepping import REPORTED_FIELDS
from ..integrators import OneStepMethod
from .batches import (
    ARRAY_BATCH_SIZE,
    RECORDED_INITIAL_FIELDS,
    LaneParameters,
    ProgressCounter,
    padded_member_indices,
    run_in_threads,
)
from .family import Family
from .record import EnsembleRecord

ATTEMPTS_PER_CALL_RANGE = (16, 2048)
"""Attempts in a call of an engine, at least and at most: those that pause wait for the others' to be made."""

TARGET_ATTEMPTS_PER_CALL = 2**15
"""Attempts in a call, of all trajectories together, between these."""


class AdaptiveEnsembleRun:
    """The paces of an ensemble.

    Parameters
    ----------
    family : Family
    method : OneStepMethod
    control : Pacing
    record : Record
    progress_counter : Tally
    """

    def __init__(
        self, family: Family, method: OneStepMethod, pacing: StepControl, record: EnsembleRecord, tally: ProgressCounter
    ):
        self.family, self.method, self.control, self.record, self.progress_counter = (
            family,
            method,
            pacing,
            record,
            tally,
        )
        self.interrupted = False
        self.stop_times = record.schedule.stop_times

    @property
    def _start_stop_length(self) -> tuple[float, float, float]:
        course = self.record.schedule
        return course.start, float(self.stop_times[0]), course.end - course.start

    def run_compiled(self) -> None:
        """In lanes over threads; those that are at their end leave their lanes to others."""
        lanes, size = LaneParameters(self.family, self.method, self.control), len(self.record.x0)

        def work(chosen: slice, stop: threading.Event) -> None:
            own = lanes.parameters(chosen, chosen.stop - chosen.start)
            paces = CompiledAdaptiveRuns(
                lanes.step_loop, lanes.first_lane_parameters, own, self.record.x0[chosen], *self._start_stop_length
            )
            self._advance_to_end(paces, np.arange(chosen.start, chosen.stop), paces.keep_only, stop.is_set)

        run_in_threads(work, size)

    def run_array(self) -> None:
        """All of a batch in one program."""
        size = len(self.record.x0)
        for start in range(0, size, ARRAY_BATCH_SIZE):
            places = padded_member_indices(start, min(start + ARRAY_BATCH_SIZE, size), self.record.x0.shape[1])
            parameters, axes = self.family.vmap_arguments(places)
            given = self.family.form, parameters, axes, self.method, self.control
            paces = start_batch(*given, self.record.x0[places], *self._start_stop_length)
            self._advance_to_end(paces, places, None, lambda: self.interrupted)

    def _advance_to_end(
        self, paces: AdaptiveRuns, places: np.ndarray, only: Callable | None, stopped: Callable[[], bool]
    ) -> None:
        """Trajectories with these places, to the ends of all."""
        record = self.record
        guide = PauseHandler(
            paces, self.control, self.method, self.stop_times, lambda i: self.family.member(int(places[i]))
        )
        before = {name: paces.read(name).copy() for name in RECORDED_INITIAL_FIELDS}
        record.record_initial(places, before["x"], before["energy"], before["entropy"])
        followed = np.ones(len(places), dtype=bool)
        guide.resume_paused()
        record.quantities["first_step"][places] = np.minimum(paces.read("next_step_size"), self._start_stop_length[2])

        def record_finished(
            ended: np.ndarray, status: np.ndarray, fields: dict[str, np.ndarray], end_time: np.ndarray
        ) -> None:
            at = {name: values[ended] for name, values in before.items()}
            record.finish_members(places[ended], at, fields, status, end_time)
            record.rejected[places[ended]] = paces.read("n_rejected", ended)

        def fields_of(chosen: np.ndarray) -> dict[str, np.ndarray]:
            return {name: paces.read(name, chosen) for name in REPORTED_FIELDS}

        try:
            while followed.any() and not stopped():
                paces.advance(int(np.clip(TARGET_ATTEMPTS_PER_CALL // len(places), *ATTEMPTS_PER_CALL_RANGE)))
                guide.confirm_events()
                there = guide.paused_indices(StatusCode.PAUSED_AT_STOP)
                if there.size:
                    columns = [paces.read("x", there), *(paces.read(n, there)[:, None] for n in ("energy", "entropy"))]
                    record.store_states_at(places[there], paces.read("t", there), np.hstack(columns))
                guide.resume_paused()
                status = paces.read("status")
                ended = np.flatnonzero(
                    followed
                    & ~np.isin(
                        status, (StatusCode.COMPLETED, StatusCode.PAUSED_AT_STOP, StatusCode.PAUSED_FOR_GROWTH_RATE)
                    )
                )
                if ended.size:
                    codes = np.where(status[ended] == StatusCode.REACHED_END, StatusCode.COMPLETED, status[ended])
                    record_finished(ended, codes, fields_of(ended), paces.read("t", ended))
                followed[ended] = False
                self.progress_counter.add(np.unique(places[ended]).size)
                if only is not None and 2 * followed.sum() <= len(places) and followed.any():
                    left = np.flatnonzero(followed)
                    only(left)
                    places, followed = places[left], followed[left]
                    before = {name: values[left] for name, values in before.items()}
        except KeyboardInterrupt:
            self.interrupted = True
        left = np.flatnonzero(followed)
        if left.size:
            record_finished(left, np.full(left.size, StatusCode.INTERRUPTED), fields_of(left), paces.read("t", left))
