"""What can be said of a study from its store alone, whoever runs it."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..errors import FileError
from ..results.audit import Audit, AuditRow, Tolerances
from ..results.files import checked
from ..results.many import laws_of_many
from ..results.status import Laws
from . import files
from .progress import StudyStatus, seconds_left
from .solve import GOOD, LAW_BROKEN, MEASURE_FAILED, MISSING, STATUSES, Summary
from .store import Store

if TYPE_CHECKING:
    import xarray


def status(path: Any) -> StudyStatus:
    """How far the study in a store is."""
    return status_of(Store.open(Path(path)))


def status_of(store: Store) -> StudyStatus:
    counts, running = store.counts(), files.running(store.root)
    done = store.points - counts.get("missing", 0)
    left = None if running is None or "started" not in running else seconds_left(store.points, done, running)
    return StudyStatus(store.points, done, counts, running, left)


def load_study(path: Any) -> xarray.Dataset:
    """The results in the store of a :class:`Study`, whoever runs it, read when they are looked at.

    Raises
    ------
    FileError
        If there is no store, or it was changed; later, where a file is missing or damaged that is looked at.
    """
    return held_results(Path(path), None)


def held_results(path: Path, owner: object) -> xarray.Dataset:
    """The results in a store; whatever is taken from them, and not read yet, holds the owner of the files."""
    store = Store.open(path)
    import xarray

    from .reader import Reader

    try:
        found = xarray.open_zarr(Reader(store, owner), consolidated=True, chunks=None)
    except FileError:
        raise
    except Exception as error:  # of a dozen kinds
        raise FileError(f"{path} cannot be read: {error}") from error
    return found.set_coords([name for name in store.arrays if name not in store.chunked])


def audit(path: Any, **tolerances: float) -> Audit:
    """The laws over the points of a store."""
    accepted = Tolerances.of(**tolerances)
    store = Store.open(Path(path))
    axes, laws = store.axes(), checked(Laws, store.attributes["laws"])
    worst: dict[str, AuditRow] = {}
    least, drift, residual = math.inf, 0.0, 0.0
    counts: dict[int, int] = {}
    for number, status in store.marks():
        if status is None:
            continue
        for code, count in zip(*np.unique(status, return_counts=True), strict=True):
            counts[int(code)] = counts.get(int(code), 0) + int(count)
        index = store.index(number)
        ended = np.isin(status, (*GOOD, LAW_BROKEN, MEASURE_FAILED)).ravel()
        if not ended.any():
            continue
        summary = Summary(status.ravel()[ended], store.chunk("laws", index).reshape(status.size, -1)[ended])
        drift, residual = max(drift, summary.energy_drift.max()), max(residual, summary.residual.max())
        least = min(least, float(np.nanmin(summary.least_entropy_increment, initial=math.inf)))
        for law in laws_of_many(summary, laws, accepted, summary.energy_terms, summary.entropy_terms):
            i = law.worst
            row = law.as_row(i)
            if law.law not in worst or _beyond(row) > _beyond(worst[law.law]):
                place = tuple(int(p[np.flatnonzero(ended)[i]]) for p in store.places(index))
                worst[law.law] = dataclasses.replace(row, note=f"worst at {axes.describe(place)}")
    rows = list(worst.values())
    for name, code in STATUSES.items():
        if code not in (*GOOD, MISSING) and counts.get(code):
            rows.append(AuditRow(f"points with status {name}", float(counts[code]), 0.0, False))
    failed = sum(count for code, count in counts.items() if code not in (*GOOD, MISSING))
    if not failed:
        rows.append(AuditRow("points that failed", 0.0, 0.0, True))
    return Audit(drift, least if math.isfinite(least) else math.nan, math.nan, residual, tuple(rows))


def _beyond(row: AuditRow) -> float:
    return row.value - (row.tolerance or 0.0)
