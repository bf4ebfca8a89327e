"""Growth with the number of bodies: together as one system, and apart as an ensemble."""

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
ENSEMBLE_COUNTS = (1, 10, 100, 1000, 10_000, 100_000)
MAX_ARRAY_BODIES = 10_000
RATE, T_END, STEPS = 1.0, 10.0, 200


def run(quick: bool) -> Report:
    """Two tables."""
    steps, rounds, together, apart = (2000, 1, (2,), (10,)) if quick else (200_000, 3, COUPLED_COUNTS, ENSEMBLE_COUNTS)
    caption = (
        f"Bodies on the direct sum of so(3)s, as one system: runs of {steps:,} steps of size {growth.STEP}, each in a "
        "new process on one core with an empty cache."
    )
    one_system = growth.growth_table(caption, [f"bodies {n}" for n in together], steps, rounds, "Bodies")
    rows: list[list] = []
    skipped: dict[str, str] = {}
    for bodies in apart:
        row, skipped = _ensemble_row(bodies, rounds)
        rows.append(row)
    columns = {"Bodies": "count"} | dict.fromkeys(["Compiled", "Array", "C with SIMD"], "seconds")
    caption = (
        f"Bodies as an ensemble: the time of a step of a body, in calls of {STEPS} steps. Few bodies show what a call "
        f"costs. (The array engine is left out beyond {MAX_ARRAY_BODIES} bodies, to save time.)"
    )
    ensembles = Table(caption, columns | {"Compiled / C": "ratio"}, rows)
    text = f"Rigid bodies that do not interact, on {available_cores()} cores."
    return Report("Number of bodies", text, [one_system, ensembles], skipped=skipped)


def _ensemble_row(bodies: int, rounds: int) -> tuple[list, dict[str, str]]:
    x0s, system = random_states(bodies), quadratic_body(RATE)
    engines = [e for e in growth.ENGINES if e == "compiled" or bodies <= MAX_ARRAY_BODIES]
    works: dict[str, Callable] = {e: library_ensemble(system, x0s, T_END, STEPS, e) for e in engines}
    others, skipped = build_available({"C": lambda: EnsembleProgram(body_parameters(RATE))})
    if "C" in others:
        works["C"] = lambda: others["C"].integrate(x0s, T_END / STEPS, STEPS, available_cores())
    times = {name: outcome.wall_seconds for name, outcome in race(works, rounds=rounds, max_seconds=5.0).items()}
    each = [times[name] / (bodies * STEPS) if name in times else None for name in ("compiled", "array", "C")]
    return [bodies, *each, ratio(each[0], each[2])], skipped
