"""Many trajectories with steps of their own, or with events: from pause to pause, each as it would be alone."""

from __future__ import annotations

import threading
from collections.abc import Callable

import numpy as np

from ..engines.codes import Code
from ..engines.compiled.paced import LanePaces
from ..engines.paced import Guide, Paces, many
from ..engines.pacing import ARRIVED, FINISHED, LOOKING, Pacing
from ..engines.stepping import TELLING
from ..integrators import OneStepMethod
from .batches import ARRAY_BATCH, KEPT_BEFORE, Lanes, Tally, by_threads, in_whole_vectors
from .family import Family
from .record import Record

ATTEMPTS = (16, 2048)
"""Attempts in a call of an engine, at least and at most: those that pause wait for the others' to be made."""

WORK = 2**15
"""Attempts in a call, of all trajectories together, between these."""


class Many:
    """The paces of an ensemble.

    Parameters
    ----------
    family : Family
    method : OneStepMethod
    pacing : Pacing
    record : Record
    tally : Tally
    """

    def __init__(self, family: Family, method: OneStepMethod, pacing: Pacing, record: Record, tally: Tally):
        self.family, self.method, self.pacing, self.record, self.tally = family, method, pacing, record, tally
        self.interrupted = False
        self.stops = record.course.stops

    @property
    def _times(self) -> tuple[float, float, float]:
        course = self.record.course
        return course.start, float(self.stops[0]), course.end - course.start

    def run_compiled(self) -> None:
        """In lanes over threads; those that are at their end leave their lanes to others."""
        lanes, size = Lanes(self.family, self.method, self.pacing), len(self.record.x0)

        def work(chosen: slice, stop: threading.Event) -> None:
            own = lanes.parameters(chosen, chosen.stop - chosen.start)
            paces = LanePaces(lanes.stepper, lanes.first, own, self.record.x0[chosen], *self._times)
            self._follow(paces, np.arange(chosen.start, chosen.stop), paces.only, stop.is_set)

        by_threads(work, size)

    def run_array(self) -> None:
        """All of a batch in one program."""
        size = len(self.record.x0)
        for start in range(0, size, ARRAY_BATCH):
            places = in_whole_vectors(start, min(start + ARRAY_BATCH, size), self.record.x0.shape[1])
            parameters, axes = self.family.batched(places)
            given = self.family.form, parameters, axes, self.method, self.pacing
            paces = many(*given, self.record.x0[places], *self._times)
            self._follow(paces, places, None, lambda: self.interrupted)

    def _follow(self, paces: Paces, places: np.ndarray, only: Callable | None, stopped: Callable[[], bool]) -> None:
        """Trajectories with these places, to the ends of all."""
        record = self.record
        guide = Guide(paces, self.pacing, self.method, self.stops, lambda i: self.family.member(int(places[i])))
        before = {name: paces.read(name).copy() for name in KEPT_BEFORE}
        record.begin(places, before["x"], before["energy"], before["entropy"])
        followed = np.ones(len(places), dtype=bool)
        guide.resume()
        record.rows["first_step"][places] = np.minimum(paces.read("proposed"), self._times[2])

        def finish(ended: np.ndarray, status: np.ndarray, fields: dict[str, np.ndarray], end_time: np.ndarray) -> None:
            at = {name: values[ended] for name, values in before.items()}
            record.finish(places[ended], at, fields, status, end_time)
            record.rejected[places[ended]] = paces.read("rejected", ended)

        def fields_of(chosen: np.ndarray) -> dict[str, np.ndarray]:
            return {name: paces.read(name, chosen) for name in TELLING}

        try:
            while followed.any() and not stopped():
                paces.follow(int(np.clip(WORK // len(places), *ATTEMPTS)))
                guide.verify()
                there = guide.paused(ARRIVED)
                if there.size:
                    columns = [paces.read("x", there), *(paces.read(n, there)[:, None] for n in ("energy", "entropy"))]
                    record.keep_at(places[there], paces.read("t", there), np.hstack(columns))
                guide.resume()
                status = paces.read("status")
                ended = np.flatnonzero(followed & ~np.isin(status, (Code.COMPLETED, ARRIVED, LOOKING)))
                if ended.size:
                    codes = np.where(status[ended] == FINISHED, Code.COMPLETED, status[ended])
                    finish(ended, codes, fields_of(ended), paces.read("t", ended))
                followed[ended] = False
                self.tally.add(np.unique(places[ended]).size)
                if only is not None and 2 * followed.sum() <= len(places) and followed.any():
                    left = np.flatnonzero(followed)
                    only(left)
                    places, followed = places[left], followed[left]
                    before = {name: values[left] for name, values in before.items()}
        except KeyboardInterrupt:
            self.interrupted = True
        left = np.flatnonzero(followed)
        if left.size:
            finish(left, np.full(left.size, Code.INTERRUPTED), fields_of(left), paces.read("t", left))
