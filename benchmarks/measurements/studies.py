"""What a study costs beside its runs: a million bodies, many chunks of little work, and workers of a cluster."""

from __future__ import annotations

import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

import liethermo as lt

from .. import child as process
from ..machine import available_cores
from ..report import Report, Table, Target
from .memory import peak_resident_bytes

X0, STEP, T_END, RELAXED_TOLERANCE = (1.0, 0.2, 0.3), 0.1, 40.0, 1e-8
METHOD = lt.MetriplecticRungeKutta(4)
N_BODIES, N_CHUNKS, N_CLUSTER_BODIES = 1_000_000, 100_000, 200_000


def run(quick: bool) -> Report:
    """Three tables."""
    bodies, chunks, shared = (2_000, 100, 500) if quick else (N_BODIES, N_CHUNKS, N_CLUSTER_BODIES)
    alone = [process.run_child("studies", what, str(bodies)) for what in ("bare", "kept")]
    share = alone[1]["seconds"] / alone[0]["seconds"] - 1.0
    columns = {"": "text", "Time": "seconds", "Peak memory": "gigabytes"}
    rows = [
        [name, a["seconds"], a["peak"]]
        for name, a in zip(("`ensemble(until=lt.Relaxed(...))`", "`Study`, kept"), alone, strict=True)
    ]
    first = Table(f"The relaxation times of {bodies:,} bodies, each in a process of its own.", columns, rows)
    trivial = process.run_child("studies", "chunks", str(chunks))
    columns = {"Chunks": "count", "Time": "seconds", "A chunk": "seconds"}
    second = Table(
        "Chunks of one point with one step: what a chunk costs.",
        columns,
        [[chunks, trivial["seconds"], trivial["seconds"] / chunks]],
    )
    rows, one = [], None
    for workers in (1, 2, 4):
        found = process.run_child("studies", "workers", str(shared), str(workers))
        one = one or found["seconds"]
        rows.append([workers, found["seconds"], one / found["seconds"]])
    columns = {"Workers": "count", "Time": "seconds", "Speed-up": "ratio"}
    caption = (
        f"The relaxation times of {shared:,} bodies by workers of one thread on {available_cores()} cores, once they are there "
        "and have compiled."
    )
    third = Table(caption, columns, rows)
    targets = [
        Target("10⁶ relaxed bodies as a study: more than the ensemble takes", 0.15, share),
        Target("10⁶ relaxed bodies as a study: memory", 2e9, alone[1]["peak"], "gigabytes"),
        Target("10⁵ chunks of trivial work: a chunk", 5e-3, trivial["seconds"] / chunks, "seconds"),
    ]
    text = "Bodies whose rates of dissipation are the axis of a study, until the entropy production has fallen to 1e-8."
    return Report("Studies", text, [first, second, third], [] if quick else targets)


def child(what: str, number: str, workers: str = "1") -> dict:
    """The part that runs in a process of its own."""
    count = int(number)
    works = {
        "bare": _time_ensemble,
        "kept": _time_stored_study,
        "chunks": _time_small_chunks,
        "workers": lambda n: _time_cluster_study(n, int(workers)),
    }
    seconds = works[what](count)
    return {"seconds": seconds, "peak": peak_resident_bytes()}


def _body(point):
    return lt.models.rigid_body(rate=point["rate"])


def _rates(count: int) -> np.ndarray:
    return np.linspace(0.5, 2.0, count)


def _study(count: int, folder: str, **changes) -> lt.Study:
    arguments: dict[str, Any] = {
        "t_span": (0.0, T_END),
        "step": STEP,
        "measure": {"time": lt.Relaxed(RELAXED_TOLERANCE)},
    } | changes
    return lt.Study(_body, {"rate": _rates(count)}, x0=X0, method=METHOD, store=Path(folder) / "s.zarr", **arguments)


def _time_ensemble(count: int) -> float:
    def timed(n: int) -> float:
        start = time.perf_counter()
        system = lt.models.rigid_body(rate=1.0)
        found = lt.ensemble(
            system,
            np.broadcast_to(X0, (n, 3)),
            (0.0, T_END),
            STEP,
            METHOD,
            parameters={"dissipation.rate": _rates(n)},
            outputs="summary",
            until=lt.Relaxed(RELAXED_TOLERANCE),
        )
        assert found.ok.all()
        return time.perf_counter() - start

    timed(100)
    return timed(count)


def _time_study(study: lt.Study, client=None) -> float:
    start = time.perf_counter()
    study.run(client, progress=False)
    assert study.status().complete
    return time.perf_counter() - start


def _time_stored_study(count: int, **changes) -> float:
    with tempfile.TemporaryDirectory() as first, tempfile.TemporaryDirectory() as folder:
        _time_study(_study(100, first, **changes))
        return _time_study(_study(count, folder, **changes))


def _time_small_chunks(count: int) -> float:
    return _time_stored_study(count, t_span=(0.0, STEP), measure={"final": "final"}, chunk=1)


def _time_cluster_study(count: int, workers: int) -> float:
    from distributed import Client, LocalCluster

    cluster = LocalCluster(n_workers=workers, threads_per_worker=1, dashboard_address=None)
    folders = tempfile.TemporaryDirectory(), tempfile.TemporaryDirectory()
    with cluster, Client(cluster) as client, folders[0] as first, folders[1] as folder:
        _time_study(_study(64 * workers, first, chunk=8), client)
        return _time_study(_study(count, folder, chunk=4096), client)
