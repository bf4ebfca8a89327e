"""Growth of time with the number of bodies: coupled as one system, and as an ensemble."""

from __future__ import annotations

from collections.abc import Callable

from .. import growth
from ..ensembles import library_ensemble
from ..machine import available_cores
from ..native import EnsembleProgram
from ..problems import body_parameters, quadratic_body, random_states
from ..report import Report, Table, build_available, ratio
from ..timing import race

COUPLED_COUNTS = (1, 2, 4, 8, 12)
"""Numbers of bodies in one system."""
ENSEMBLE_COUNTS = (1, 10, 100, 1000, 10_000, 100_000)
"""Numbers of bodies in an ensemble."""
MAX_ARRAY_BODIES = 10_000
"""Largest ensemble that the array engine runs, to save time."""
RATE = 1.0
"""Dissipation rate of the ensembles."""
T_END = 10.0
"""Duration of the ensembles."""
STEPS = 200
"""Number of steps of the ensembles."""


def run(is_quick: bool) -> Report:
    """Measure bodies as one system, and as ensembles."""
    steps, rounds, coupled_counts, ensemble_counts = (
        (2000, 1, (2,), (10,)) if is_quick else (200_000, 3, COUPLED_COUNTS, ENSEMBLE_COUNTS)
    )
    caption = (
        f"Bodies on the direct sum of so(3)s, as one system: runs of {steps:,} steps of size {growth.STEP}, each in a "
        "new process on one core with an empty cache."
    )
    one_system = growth.growth_table(caption, [f"bodies {n}" for n in coupled_counts], steps, rounds, "Bodies")
    rows: list[list] = []
    skip_reasons: dict[str, str] = {}
    for bodies in ensemble_counts:
        row, skip_reasons = _measure_ensemble_row(bodies, rounds)
        rows.append(row)
    columns = {"Bodies": "count"} | dict.fromkeys(["Compiled", "Array", "C with SIMD"], "seconds")
    caption = (
        f"Bodies as an ensemble: the time of a step of a body, in calls of {STEPS} steps. Few bodies show what a call "
        f"costs. (The array engine is left out beyond {MAX_ARRAY_BODIES} bodies, to save time.)"
    )
    ensembles = Table(caption, columns | {"Compiled / C": "ratio"}, rows)
    text = f"Rigid bodies that do not interact, on {available_cores()} cores."
    return Report("Number of bodies", text, [one_system, ensembles], skipped=skip_reasons)


def _measure_ensemble_row(bodies: int, rounds: int) -> tuple[list, dict[str, str]]:
    x0s, system = random_states(bodies), quadratic_body(RATE)
    engines = [e for e in growth.ENGINES if e == "compiled" or bodies <= MAX_ARRAY_BODIES]
    works: dict[str, Callable] = {e: library_ensemble(system, x0s, T_END, STEPS, e) for e in engines}
    c_programs, skip_reasons = build_available({"C": lambda: EnsembleProgram(body_parameters(RATE))})
    if "C" in c_programs:
        works["C"] = lambda: c_programs["C"].integrate(x0s, T_END / STEPS, STEPS, available_cores())
    times = {name: outcome.wall_seconds for name, outcome in race(works, rounds=rounds, max_seconds=5.0).items()}
    step_seconds = [times[name] / (bodies * STEPS) if name in times else None for name in ("compiled", "array", "C")]
    return [bodies, *step_seconds, ratio(step_seconds[0], step_seconds[2])], skip_reasons
