"""Growth of the cost of both engines with one system, in a new process on one core with an empty cache."""

from __future__ import annotations

import functools
import tempfile
from collections.abc import Iterable
from typing import Any

import numpy as np

import liethermo as lt
import manifolds as mf
from liethermo.systems.invariants import recorded_functions_with_verdicts

from . import child, laws
from .contest import RATE_TIMES_DURATION, Engine
from .problems import generalized_body, random_states
from .report import Table, ratio
from .timing import race, time_once

STEP = 0.05
"""Step size of all runs."""

CALL_STEPS = 10
"""Steps of the short run, whose time is that of a call and is subtracted from the time of a long run."""

ENGINES: tuple[Engine, ...] = ("array", "compiled")
"""The engines that are compared."""

COLUMNS = {
    "Dimension": "count",
    "Compiling, array": "seconds",
    "Compiling, compiled": "seconds",
    "A step, array": "seconds",
    "A step, compiled": "seconds",
    "Array / compiled": "ratio",
    "Iterations a step": "number",
} | laws.COLUMNS
"""Columns of the table, with the formats of their numbers."""


def growth_table(caption: str, names: Iterable[str], steps: int, rounds: int, heading: str = "") -> Table:
    """Measure both engines on each algebra and return a table with one row per algebra."""
    return Table(caption, {heading: "text"} | COLUMNS, [_row_of_algebra(name, steps, rounds) for name in names])


def algebra_by_name(name: str) -> mf.LieAlgebra:
    """Return an algebra by name: ``"so 4"``, ``"su 3"``, or ``"bodies 5"``, the direct sum of five so(3)."""
    kind, n = name.split()
    return mf.direct_sum(*[mf.so(3)] * int(n)) if kind == "bodies" else {"so": mf.so, "su": mf.su}[kind](int(n))


def measure_engines(name: str, steps: int, rounds: int) -> dict:
    """Compile and time both engines on one algebra; this runs in the child process."""
    g = algebra_by_name(name)
    strength = float(np.trace(-g.killing_form())) / g.dim
    system = generalized_body(g, RATE_TIMES_DURATION / (STEP * steps * strength))
    recorded_functions_with_verdicts(system)  # Casimirs are found once for an algebra, by either engine
    x0 = random_states(1, g.dim)[0]

    def run(engine: Engine, count: int) -> lt.Solution:
        return lt.integrate(system, x0, (0.0, STEP * count), STEP, save_every=count, engine=engine)

    works = {
        (engine, count): functools.partial(run, engine, count) for engine in ENGINES for count in (CALL_STEPS, steps)
    }
    first_call_seconds = {engine: time_once(works[engine, CALL_STEPS]).cpu_seconds for engine in ENGINES}
    outcomes = race(works, rounds=rounds, max_seconds=5.0)
    results: dict[str, Any] = {"dim": g.dim}
    for engine in ENGINES:
        call, long_run = outcomes[engine, CALL_STEPS].cpu_seconds, outcomes[engine, steps]
        run_laws = laws.solution_laws(long_run.result)
        results[engine] = {
            "compiling": first_call_seconds[engine] - call,
            # A difference smaller than the call itself would be mostly noise.
            "step": (long_run.cpu_seconds - call) / (steps - CALL_STEPS) if long_run.cpu_seconds > 2.0 * call else None,
            "iterations": long_run.result.stats.iterations_per_step,
            "laws": [run_laws.energy_drift, run_laws.least_entropy_increment],
        }
    return results


def _row_of_algebra(name: str, steps: int, rounds: int) -> list:
    with tempfile.TemporaryDirectory() as cache:
        results = child.run_in_child_process("dimension", name, str(steps), str(rounds), cache=cache, one_core=True)
    array_results, compiled_results = results["array"], results["compiled"]
    engine_laws = [laws.Laws(*results[engine]["laws"]) for engine in ENGINES]
    worst_laws = laws.Laws(
        max(engine_law.energy_drift for engine_law in engine_laws),
        min(engine_law.least_entropy_increment or 0.0 for engine_law in engine_laws),
    )
    kind, n = name.split()
    title = n if kind == "bodies" else f"{kind}({n})"
    row = [
        title,
        results["dim"],
        array_results["compiling"],
        compiled_results["compiling"],
        array_results["step"],
        compiled_results["step"],
    ]
    return [
        *row,
        ratio(array_results["step"], compiled_results["step"]),
        compiled_results["iterations"],
        *worst_laws.table_cells(),
    ]
