"""Comparisons over one trajectory: the library's engines against a C program that takes the same steps."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from typing import Literal

import numpy as np

import liethermo as lt

from . import laws
from .native import BodyProgram
from .problems import X0
from .report import Table, ratio
from .timing import race

Engine = Literal["array", "compiled"]

STEP_SIZE = 0.1
"""Step size of all runs."""

RATE_TIMES_DURATION = 10.0
"""Rate times duration: the body relaxes completely, but its last step still needs most of the work of the first."""

COMPARED_STEPS = 300
"""Number of steps after which the trajectories of two programs are compared."""


def library_run(
    system: lt.System, steps: int, engine: Engine, save_every: int | None = None
) -> Callable[[], lt.Solution]:
    """Return a function that runs the library from :data:`.suites.X0`; by default it saves only the final state."""
    span, midpoint = (0.0, STEP_SIZE * steps), lt.MetriplecticMidpoint()
    return functools.partial(
        lt.integrate, system, X0, span, STEP_SIZE, midpoint, save_every=save_every or steps, engine=engine
    )


def c_run(
    program: BodyProgram, steps: int, save_every: int | None = None
) -> Callable[[], tuple[np.ndarray, np.ndarray]]:
    """Return a function that runs a C program from :data:`.suites.X0`, as :func:`library_run` does."""
    return functools.partial(program.integrate, X0, STEP_SIZE, steps, save_every)


def race_runs_of_one_trajectory(caption: str, works: Mapping[str, Callable], steps: int, rounds: int, baseline: str):
    """Time runs of equal length against each other in one thread; return a table, and the processor seconds by name.

    Returns
    -------
    Table, dict of float
    """
    outcomes = race(works, rounds=rounds)
    times = {name: outcome.cpu_seconds for name, outcome in outcomes.items()}
    rows = []
    for name, outcome in outcomes.items():
        solution = outcome.result
        if isinstance(solution, lt.Solution):
            iterations, run_laws = solution.stats.iterations_per_step, laws.solution_laws(solution)
        else:
            c_record = solution[1]
            iterations, run_laws = float((c_record["iterations"] / c_record["steps"])[0]), laws.c_run_laws(c_record)
        rows.append([name, times[name] / steps, ratio(times[name], times.get(baseline)), iterations])
        rows[-1] += run_laws.table_cells()
    columns = {"": "text", "Time a step": "seconds", f"Relative to {baseline}": "ratio", "Iterations a step": "number"}
    return Table(caption, columns | laws.COLUMNS, rows), times


def max_difference_from_c(program: BodyProgram, system: lt.System) -> float:
    """Return the largest difference between the C program's trajectory and the compiled engine's, relative to the
    state.

    Raises
    ------
    RuntimeError
        As for :func:`require_same_scheme`.
    """
    library_states = library_run(system, COMPARED_STEPS, "compiled", 1)().x[1:]
    c_states, _ = program.integrate(X0, STEP_SIZE, COMPARED_STEPS, 1)
    return require_same_scheme(
        float(np.abs(library_states - c_states).max() / np.abs(library_states).max()), COMPARED_STEPS
    )


def require_same_scheme(difference: float, steps: int) -> float:
    """Return the difference of two trajectories after some steps; raise RuntimeError if it is not due to rounding.

    Raises
    ------
    RuntimeError
        If it exceeds 1e-12: the programs then use different schemes, and a comparison of their times is meaningless.
    """
    if not difference <= 1e-12:
        raise RuntimeError(f"after {steps} steps C and the compiled engine differ by {difference:.1e}")
    return difference
