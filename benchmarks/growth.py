"""How the cost of both engines grows: one system, in a new process on one core with an empty cache."""

from __future__ import annotations

import functools
import tempfile
from collections.abc import Iterable
from typing import Any

import numpy as np

import liethermo as lt
import manifolds as mf

from . import child, laws
from .contest import RATE_TIMES_DURATION, Engine
from .problems import generalized_body, random_states
from .report import Table, ratio
from .timing import race, time_once

STEP = 0.05

CALL_STEPS = 10
"""Steps of a run whose time is that of the call: it is taken off the time of a long one."""

ENGINES: tuple[Engine, ...] = ("array", "compiled")

COLUMNS = {
    "Dimension": "count",
    "Compiling, array": "seconds",
    "Compiling, compiled": "seconds",
    "A step, array": "seconds",
    "A step, compiled": "seconds",
    "Array / compiled": "ratio",
    "Iterations a step": "number",
} | laws.COLUMNS


def growth_table(caption: str, names: Iterable[str], steps: int, rounds: int, heading: str = "") -> Table:
    """A row for each of the algebras, by name as in :func:`algebra`."""
    return Table(caption, {heading: "text"} | COLUMNS, [_algebra_row(name, steps, rounds) for name in names])


def algebra_by_name(name: str) -> mf.LieAlgebra:
    """``"so 4"``, ``"su 3"``, or ``"bodies 5"``: the direct sum of five so(3)."""
    kind, n = name.split()
    return mf.direct_sum(*[mf.so(3)] * int(n)) if kind == "bodies" else {"so": mf.so, "su": mf.su}[kind](int(n))


def measure_engines(name: str, steps: int, rounds: int) -> dict:
    """Compile and time both engines on one algebra; what the child process does."""
    g = algebra_by_name(name)
    strength = float(np.trace(-g.killing_form())) / g.dim
    system = generalized_body(g, RATE_TIMES_DURATION / (STEP * steps * strength))
    system.invariants()  # Casimirs are found once for an algebra, by either engine
    x0 = random_states(1, g.dim)[0]

    def run(engine: Engine, count: int) -> lt.Solution:
        return lt.integrate(system, x0, (0.0, STEP * count), STEP, save_every=count, engine=engine)

    works = {
        (engine, count): functools.partial(run, engine, count) for engine in ENGINES for count in (CALL_STEPS, steps)
    }
    firsts = {engine: time_once(works[engine, CALL_STEPS]).cpu_seconds for engine in ENGINES}
    outcomes = race(works, rounds=rounds, max_seconds=5.0)
    found: dict[str, Any] = {"dim": g.dim}
    for engine in ENGINES:
        call, long = outcomes[engine, CALL_STEPS].cpu_seconds, outcomes[engine, steps]
        kept = laws.solution_laws(long.result)
        found[engine] = {
            "compiling": firsts[engine] - call,
            # A difference smaller than the call itself would be mostly noise.
            "step": (long.cpu_seconds - call) / (steps - CALL_STEPS) if long.cpu_seconds > 2.0 * call else None,
            "iterations": long.result.stats.iterations_per_step,
            "laws": [kept.energy_drift, kept.least_entropy_increment],
        }
    return found


def _algebra_row(name: str, steps: int, rounds: int) -> list:
    with tempfile.TemporaryDirectory() as cache:
        found = child.run_child("dimension", name, str(steps), str(rounds), cache=cache, one_core=True)
    array, compiled = found["array"], found["compiled"]
    kept = [laws.Laws(*found[engine]["laws"]) for engine in ENGINES]
    worst = laws.Laws(max(one.energy_drift for one in kept), min(one.least_entropy_increment or 0.0 for one in kept))
    kind, n = name.split()
    title = n if kind == "bodies" else f"{kind}({n})"
    row = [title, found["dim"], array["compiling"], compiled["compiling"], array["step"], compiled["step"]]
    return [*row, ratio(array["step"], compiled["step"]), compiled["iterations"], *worst.table_cells()]
