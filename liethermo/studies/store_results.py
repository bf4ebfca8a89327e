"""What can be said of a study from its store alone, whoever runs it."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..errors import FileError
from ..results.audit import Audit, AuditRow, Tolerances
from ..results.files import dataclass_from_json
from ..results.many import evaluate_ensemble_laws
from ..results.status import Laws
from . import files
from .progress import StudyStatus, seconds_left
from .solve import LAW_BROKEN, MEASURE_FAILED, NOT_COMPUTED, STATUSES, SUCCESS_CODES, LawSummary
from .store import StudyStore

if TYPE_CHECKING:
    import xarray


def load_status(path: Any) -> StudyStatus:
    """How far the study in a store is."""
    return store_status(StudyStore.open(Path(path)))


def store_status(store: StudyStore) -> StudyStatus:
    counts, running = store.status_counts(), files.active_run(store.root)
    done = store.n_points - counts.get("missing", 0)
    left = None if running is None or "started" not in running else seconds_left(store.n_points, done, running)
    return StudyStatus(store.n_points, done, counts, running, left)


def load_study(path: Any) -> xarray.Dataset:
    """The results in the store of a :class:`Study`, whoever runs it, read when they are looked at.

    Raises
    ------
    FileError
        If there is no store, or it was changed; later, where a file is missing or damaged that is looked at.
    """
    return open_results(Path(path), None)


def open_results(path: Path, owner: object) -> xarray.Dataset:
    """The results in a store; whatever is taken from them, and not read yet, holds the owner of the files."""
    store = StudyStore.open(path)
    import xarray

    from .reader import CheckedZarrReader

    try:
        found = xarray.open_zarr(CheckedZarrReader(store, owner), consolidated=True, chunks=None)
    except FileError:
        raise
    except Exception as error:  # of a dozen kinds
        raise FileError(f"{path} cannot be read: {error}") from error
    return found.set_coords([name for name in store.arrays if name not in store.chunked_arrays])


def audit_store(path: Any, **tolerances: float) -> Audit:
    """The laws over the points of a store."""
    accepted = Tolerances.with_defaults(**tolerances)
    store = StudyStore.open(Path(path))
    axes, laws = store.read_axes(), dataclass_from_json(Laws, store.attributes["laws"])
    worst: dict[str, AuditRow] = {}
    least, drift, residual = math.inf, 0.0, 0.0
    counts: dict[int, int] = {}
    for number, status in store.chunk_statuses():
        if status is None:
            continue
        for code, count in zip(*np.unique(status, return_counts=True), strict=True):
            counts[int(code)] = counts.get(int(code), 0) + int(count)
        index = store.chunk_index(number)
        ended = np.isin(status, (*SUCCESS_CODES, LAW_BROKEN, MEASURE_FAILED)).ravel()
        if not ended.any():
            continue
        summary = LawSummary(status.ravel()[ended], store.read_chunk("laws", index).reshape(status.size, -1)[ended])
        drift, residual = max(drift, summary.energy_drift.max()), max(residual, summary.residual.max())
        least = min(least, float(np.nanmin(summary.least_entropy_increment, initial=math.inf)))
        for law in evaluate_ensemble_laws(summary, laws, accepted, summary.energy_terms, summary.entropy_terms):
            i = law.worst_member
            row = law.audit_row(i)
            if law.law not in worst or _excess_over_tolerance(row) > _excess_over_tolerance(worst[law.law]):
                place = tuple(int(p[np.flatnonzero(ended)[i]]) for p in store.point_indices(index))
                worst[law.law] = dataclasses.replace(row, note=f"worst at {axes.describe_point(place)}")
    rows = list(worst.values())
    for name, code in STATUSES.items():
        if code not in (*SUCCESS_CODES, NOT_COMPUTED) and counts.get(code):
            rows.append(AuditRow(f"points with status {name}", float(counts[code]), 0.0, False))
    failed = sum(count for code, count in counts.items() if code not in (*SUCCESS_CODES, NOT_COMPUTED))
    if not failed:
        rows.append(AuditRow("points that failed", 0.0, 0.0, True))
    return Audit(drift, least if math.isfinite(least) else math.nan, math.nan, residual, tuple(rows))


def _excess_over_tolerance(row: AuditRow) -> float:
    return row.value - (row.tolerance or 0.0)
