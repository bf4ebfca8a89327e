"""Overhead of a study: a million bodies, many small chunks, and workers of a cluster."""

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

X0 = (1.0, 0.2, 0.3)
"""Initial angular momentum."""
STEP = 0.1
"""Step size."""
T_END = 40.0
"""Maximum duration of a run."""
RELAXED_TOLERANCE = 1e-8
"""Relaxation rate at which a run ends."""
METHOD = lt.MetriplecticRungeKutta(4)
"""Method of all runs."""
N_BODIES = 1_000_000
"""Number of bodies of the large study."""
N_CHUNKS = 100_000
"""Number of chunks of one point."""
N_CLUSTER_BODIES = 200_000
"""Number of bodies on the cluster."""


def run(is_quick: bool) -> Report:
    """Measure a large study, small chunks, and a cluster."""
    bodies, chunks, n_cluster_bodies = (2_000, 100, 500) if is_quick else (N_BODIES, N_CHUNKS, N_CLUSTER_BODIES)
    single_results = [process.run_in_child_process("studies", part_name, str(bodies)) for part_name in ("bare", "kept")]
    overhead = single_results[1]["seconds"] / single_results[0]["seconds"] - 1.0
    columns = {"": "text", "Time": "seconds", "Peak memory": "gigabytes"}
    rows = [
        [name, a["seconds"], a["peak"]]
        for name, a in zip(("`ensemble(until=lt.Relaxed(...))`", "`Study`, kept"), single_results, strict=True)
    ]
    time_table = Table(f"The relaxation times of {bodies:,} bodies, each in a process of its own.", columns, rows)
    chunk_result = process.run_in_child_process("studies", "chunks", str(chunks))
    columns = {"Chunks": "count", "Time": "seconds", "A chunk": "seconds"}
    chunk_table = Table(
        "Chunks of one point with one step: what a chunk costs.",
        columns,
        [[chunks, chunk_result["seconds"], chunk_result["seconds"] / chunks]],
    )
    rows, one_worker_seconds = [], None
    for workers in (1, 2, 4):
        result = process.run_in_child_process("studies", "workers", str(n_cluster_bodies), str(workers))
        one_worker_seconds = one_worker_seconds or result["seconds"]
        rows.append([workers, result["seconds"], one_worker_seconds / result["seconds"]])
    columns = {"Workers": "count", "Time": "seconds", "Speed-up": "ratio"}
    caption = (
        f"The relaxation times of {n_cluster_bodies:,} bodies by workers of one thread on {available_cores()} "
        "cores, once they are there "
        "and have compiled."
    )
    worker_table = Table(caption, columns, rows)
    targets = [
        Target("10⁶ relaxed bodies as a study: more than the ensemble takes", 0.15, overhead),
        Target("10⁶ relaxed bodies as a study: memory", 2e9, single_results[1]["peak"], "gigabytes"),
        Target("10⁵ chunks of trivial work: a chunk", 5e-3, chunk_result["seconds"] / chunks, "seconds"),
    ]
    text = "Bodies whose rates of dissipation are the axis of a study, until the entropy production has fallen to 1e-8."
    return Report("Studies", text, [time_table, chunk_table, worker_table], [] if is_quick else targets)


def child(part: str, number: str, workers: str = "1") -> dict:
    """Run one part of the measurement in the child process."""
    count = int(number)
    works = {
        "bare": _time_ensemble,
        "kept": _time_stored_study,
        "chunks": _time_small_chunks,
        "workers": lambda n: _time_cluster_study(n, int(workers)),
    }
    seconds = works[part](count)
    return {"seconds": seconds, "peak": peak_resident_bytes()}


def _body_at_point(point):
    return lt.models.rigid_body(rate=point["rate"])


def _linspace_rates(count: int) -> np.ndarray:
    """Return evenly spaced dissipation rates, shape (count,)."""
    return np.linspace(0.5, 2.0, count)


def _make_study(count: int, folder: str, **changes) -> lt.Study:
    arguments: dict[str, Any] = {
        "t_span": (0.0, T_END),
        "step": STEP,
        "measure": {"time": lt.Relaxed(RELAXED_TOLERANCE)},
    } | changes
    return lt.Study(
        _body_at_point,
        {"rate": _linspace_rates(count)},
        x0=X0,
        method=METHOD,
        store=Path(folder) / "s.zarr",
        **arguments,
    )


def _time_ensemble(count: int) -> float:
    def run_seconds(n: int) -> float:
        start = time.perf_counter()
        system = lt.models.rigid_body(rate=1.0)
        result = lt.ensemble(
            system,
            np.broadcast_to(X0, (n, 3)),
            (0.0, T_END),
            STEP,
            METHOD,
            parameters={"dissipation.rate": _linspace_rates(n)},
            outputs="summary",
            until=lt.Relaxed(RELAXED_TOLERANCE),
        )
        assert result.ok.all()
        return time.perf_counter() - start

    run_seconds(100)
    return run_seconds(count)


def _time_study(study: lt.Study, client=None) -> float:
    start = time.perf_counter()
    study.run(client, progress=False)
    assert study.status().complete
    return time.perf_counter() - start


def _time_stored_study(count: int, **changes) -> float:
    with tempfile.TemporaryDirectory() as warmup_folder, tempfile.TemporaryDirectory() as folder:
        _time_study(_make_study(100, warmup_folder, **changes))
        return _time_study(_make_study(count, folder, **changes))


def _time_small_chunks(count: int) -> float:
    return _time_stored_study(count, t_span=(0.0, STEP), measure={"final": "final"}, chunk=1)


def _time_cluster_study(count: int, workers: int) -> float:
    from distributed import Client, LocalCluster

    cluster = LocalCluster(n_workers=workers, threads_per_worker=1, dashboard_address=None)
    folders = tempfile.TemporaryDirectory(), tempfile.TemporaryDirectory()
    with cluster, Client(cluster) as client, folders[0] as warmup_folder, folders[1] as folder:
        _time_study(_make_study(64 * workers, warmup_folder, chunk=8), client)
        return _time_study(_make_study(count, folder, chunk=4096), client)
