"""Memory of an ensemble of a million bodies that saves only summaries."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from .. import child as process
from .. import laws
from ..ensembles import ensemble_laws, library_ensemble
from ..problems import quadratic_body, random_states
from ..report import Report, Table, Target

RATE = 1.0
"""Dissipation rate."""
T_END = 10.0
"""Duration of the runs."""
STEPS = 200
"""Number of steps."""

PROCESS_STATUS_FILE = Path("/proc/self/status")
"""File in which Linux reports the memory of a process."""


def run(is_quick: bool) -> Report:
    """Measure ensembles of two sizes, each in a process of its own."""
    sizes: tuple[int, ...] = (100,) if is_quick else (10_000, 1_000_000)
    rows: list[list] = []
    skip_reasons: dict[str, str] = {}
    peak = None
    if not PROCESS_STATUS_FILE.is_file():
        sizes, skip_reasons = (), {"all": "this system does not tell a process its largest size"}
    for bodies in sizes:
        results = process.run_in_child_process("memory", str(bodies))
        peak = results["peak"]
        run_laws = laws.Laws(*results["laws"])
        rows.append([bodies, results["before"], peak, results["seconds"], *run_laws.table_cells()])
    columns = {"Bodies": "count", "Memory before": "gigabytes", "Peak": "gigabytes", "Time": "seconds"}
    table = Table(f'`outputs="summary"`, {STEPS} steps each, compiled engine.', columns | laws.COLUMNS, rows)
    text = (
        "The largest resident size of a process of its own: before the ensemble, with the packages loaded and the "
        "initial states made, and at its end."
    )
    targets = [Target("10⁶ bodies, summaries only: memory", 2e9, None if is_quick else peak, "gigabytes")]
    return Report("Memory", text, [table], targets, skip_reasons)


def child(bodies: str) -> dict:
    """Measure one ensemble in the child process."""
    work = library_ensemble(
        quadratic_body(RATE), random_states(int(bodies)), T_END, STEPS, "compiled", outputs="summary"
    )
    initial_bytes, result = peak_resident_bytes(), work()
    run_laws = ensemble_laws(result)
    assert np.all(np.isfinite(result.energy))
    return {
        "before": initial_bytes,
        "peak": peak_resident_bytes(),
        "seconds": result.wall_time,
        "laws": [run_laws.energy_drift, run_laws.least_entropy_increment],
    }


def peak_resident_bytes() -> float:
    """Return the largest resident size of this program so far, in bytes.

    ``getrusage`` is not used, because a process inherits its value from the parent, which may have been larger.
    """
    fields = dict(line.split(":", 1) for line in PROCESS_STATUS_FILE.read_text().splitlines())
    return 1024.0 * int(fields["VmHWM"].split()[0])
