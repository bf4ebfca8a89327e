"""Status, results and audit of a study, read from its store alone."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..disk import checked_path
from ..errors import FileError
from ..results.audit import Audit, AuditRow, Tolerances, check_laws
from ..results.netcdf import dataclass_from_json
from ..results.status import Laws
from . import store_metadata
from .progress import StudyStatus, seconds_left
from .solve import EMPTY_POINT_STATUS, LAW_BROKEN, MEASURE_FAILED, STATUSES, SUCCESS_CODES, LawSummary
from .store import StudyStore

if TYPE_CHECKING:
    import xarray


def load_status(path: Any) -> StudyStatus:
    """Return the progress of a study, with the number of points by status, read from the path of its store."""
    return status_of_store(StudyStore.open(checked_path(path)))


def status_of_store(store: StudyStore) -> StudyStatus:
    """Return the progress of the study in an open store, with the number of points by status."""
    counts, running = store.status_counts(), store_metadata.active_run_record(store.root)
    n_done = store.n_points - counts.get("missing", 0)
    time_left = None if running is None or "started" not in running else seconds_left(store.n_points, n_done, running)
    return StudyStatus(store.n_points, n_done, counts, running, time_left)


def load_study(path: Any) -> xarray.Dataset:
    """Return the results in the store of a :class:`Study`, which may be running; values are read on access.

    Parameters
    ----------
    path : path
        The folder of the store.

    Raises
    ------
    FileError
        If there is no store, or it was changed; on access, if a file is missing or damaged.
    """
    return open_results(checked_path(path), None)


def open_results(path: Path, keep_alive: object) -> xarray.Dataset:
    """Return the results in a store as a dataset whose arrays are read at their first use.

    The dataset holds a reference to ``keep_alive``, for example a temporary folder.
    """
    store = StudyStore.open(path)
    import xarray

    from .reader import CheckedZarrReader

    try:
        dataset = xarray.open_zarr(CheckedZarrReader(store, keep_alive), consolidated=True, chunks=None)
    except FileError:
        raise
    except Exception as error:  # zarr and xarray raise many types
        raise FileError(f"{path} cannot be read: {error}") from error
    return dataset.set_coords([name for name in store.arrays if name not in store.chunked_array_names])


def audit_store(path: Any, **tolerances: float) -> Audit:
    """Return an audit of all points of a store, each law by its worst point."""
    accepted_tolerances = Tolerances.with_defaults(**tolerances)
    store = StudyStore.open(checked_path(path))
    axes, laws = store.read_axes(), dataclass_from_json(Laws, store.attributes["laws"])
    worst_rows: dict[str, tuple[float, AuditRow]] = {}
    min_entropy_increment, drift, residual = math.inf, 0.0, 0.0
    counts: dict[int, int] = {}
    for number, status in store.chunk_statuses():
        for code, count in zip(*np.unique(status, return_counts=True), strict=True):
            counts[int(code)] = counts.get(int(code), 0) + int(count)
        index = store.chunk_index(number)
        has_laws = np.isin(status, (*SUCCESS_CODES, LAW_BROKEN, MEASURE_FAILED)).ravel()
        if not has_laws.any():
            continue
        summary = LawSummary(
            status.ravel()[has_laws], store.read_chunk("laws", index).reshape(status.size, -1)[has_laws]
        )
        drift, residual = max(drift, summary.energy_drift.max()), max(residual, summary.residual.max())
        min_entropy_increment = min(
            min_entropy_increment, float(np.nanmin(summary.least_entropy_increment, initial=math.inf))
        )
        terms = {"energy": summary.energy_terms, "entropy": summary.entropy_terms}
        for check in check_laws(summary, laws, accepted_tolerances, terms, has_entropy=False):
            i = int(np.argmax(check.excess))
            if check.law not in worst_rows or check.excess[i] > worst_rows[check.law][0]:
                point_index = tuple(int(p[np.flatnonzero(has_laws)[i]]) for p in store.point_indices(index))
                row = check.audit_row(i, f"worst at {axes.describe_point(point_index)}")
                worst_rows[check.law] = float(check.excess[i]), row
    rows = [row for _, row in worst_rows.values()]
    for name, code in STATUSES.items():
        if code not in (*SUCCESS_CODES, EMPTY_POINT_STATUS) and counts.get(code):
            rows.append(AuditRow(f"points with status {name}", int(counts[code]), 0, False))
    n_failed = sum(count for code, count in counts.items() if code not in (*SUCCESS_CODES, EMPTY_POINT_STATUS))
    if not n_failed:
        rows.append(AuditRow("points that failed", 0, 0, True))
    return Audit(
        drift,
        min_entropy_increment if math.isfinite(min_entropy_increment) else math.nan,
        math.nan,
        residual,
        tuple(rows),
    )
