"""The memory of a million bodies of which only summaries are kept."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from .. import child as process
from .. import laws
from ..ensembles import ensemble_laws as ensemble_laws
from ..ensembles import library_ensemble
from ..problems import quadratic_body, random_states
from ..report import Report, Table, Target

RATE, T_END, STEPS = 1.0, 10.0, 200

PROCESS_STATUS_FILE = Path("/proc/self/status")


def run(quick: bool) -> Report:
    """Ensembles of two sizes, each in a process of its own."""
    sizes: tuple[int, ...] = (100,) if quick else (10_000, 1_000_000)
    rows: list[list] = []
    skipped: dict[str, str] = {}
    peak = None
    if not PROCESS_STATUS_FILE.is_file():
        sizes, skipped = (), {"all": "this system does not tell a process its largest size"}
    for bodies in sizes:
        found = process.run_child("memory", str(bodies))
        peak = found["peak"]
        kept = laws.Laws(*found["laws"])
        rows.append([bodies, found["before"], peak, found["seconds"], *kept.table_cells()])
    columns = {"Bodies": "count", "Memory before": "gigabytes", "Peak": "gigabytes", "Time": "seconds"}
    table = Table(f'`outputs="summary"`, {STEPS} steps each, compiled engine.', columns | laws.COLUMNS, rows)
    text = (
        "The largest resident size of a process of its own: before the ensemble, with the packages loaded and the "
        "initial states made, and at its end."
    )
    targets = [Target("10⁶ bodies, summaries only: memory", 2e9, None if quick else peak, "gigabytes")]
    return Report("Memory", text, [table], targets, skipped)


def child(bodies: str) -> dict:
    """The part that runs in a process of its own."""
    work = library_ensemble(
        quadratic_body(RATE), random_states(int(bodies)), T_END, STEPS, "compiled", outputs="summary"
    )
    before, result = peak_resident_bytes(), work()
    kept = ensemble_laws(result)
    assert np.all(np.isfinite(result.energy))
    return {
        "before": before,
        "peak": peak_resident_bytes(),
        "seconds": result.wall_time,
        "laws": [kept.energy_drift, kept.least_entropy_increment],
    }


def peak_resident_bytes() -> float:
    """Largest resident size of this program so far, in bytes.

    Not ``getrusage``: a process inherits its figure from the one that started it, which may have been larger.
    """
    fields = dict(line.split(":", 1) for line in PROCESS_STATUS_FILE.read_text().splitlines())
    return 1024.0 * int(fields["VmHWM"].split()[0])
