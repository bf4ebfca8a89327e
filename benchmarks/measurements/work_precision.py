"""Time against error for the relaxed rigid body, with every method at several settings."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

import liethermo as lt

from .. import laws, peers, reference
from ..native import BodyProgram
from ..problems import X0, body_parameters, quadratic_body
from ..report import Report, Table, Target, build_available
from ..timing import race

RATE = 0.1
"""Dissipation rate."""

T_END = 100.0
"""Duration of the run, at whose end the body has relaxed half way."""

MIDPOINT_STEPS = (500, 1000, 2000, 5000, 10_000, 20_000, 50_000, 100_000)
"""Numbers of steps of the midpoint scheme."""
GAUSS_STEPS = (100, 200, 500, 1000, 2000)
"""Numbers of steps of Gauss methods."""
EXPLICIT_STEPS = (100, 150, 200, 250, 300, 400, 500, 700)
"""Numbers of steps of the explicit method."""
TAYLOR_STEPS = (40, 50, 60, 70, 80, 100)
"""Numbers of steps of the Taylor method."""

TOLERANCES = tuple(10.0**-n for n in range(3, 14))
"""Tolerances of the peers."""

METHODS: dict[str, tuple[lt.OneStepMethod, tuple[int, ...]]] = {
    "midpoint": (lt.MetriplecticMidpoint(), MIDPOINT_STEPS),
    **{f"Gauss, order {2 * s}": (lt.MetriplecticGauss(stages=s), GAUSS_STEPS) for s in (2, 3, 4)},
    "explicit, order 8": (lt.MetriplecticRungeKutta(8), EXPLICIT_STEPS),
    "Taylor, order 16": (lt.MetriplecticTaylor(16), TAYLOR_STEPS),
}
"""The library's methods, with the numbers of steps to run; another method is one more line."""

PEERS: dict[str, tuple[Callable[..., peers.PeerRun], tuple[float, ...]]] = {
    "SciPy DOP853": (peers.scipy_run, TOLERANCES),
    "diffrax Tsit5": (lambda *arguments: peers.diffrax_run("Tsit5", *arguments), TOLERANCES),
    "diffrax Dopri8": (lambda *arguments: peers.diffrax_run("Dopri8", *arguments), TOLERANCES),
    "heyoka Taylor": (peers.heyoka_run, (*TOLERANCES, 1e-15, 1e-18)),
}
"""Functions that build a peer's run, with tolerances."""

TABLE_ERRORS = (1e-3, 1e-5, 1e-7, 1e-9, 1e-11, 1e-13)
"""Errors in the table of fastest times."""

TARGET_ERRORS = (1e-10, 1e-12)
"""Errors at which explicit methods are compared with heyoka."""

CALL_ROW = "a call of one step"
"""Row of a call of one step, whose time is subtracted."""


def run(is_quick: bool) -> Report:
    """Race every method at every setting; errors are relative to a reference with forty digits."""
    builders: dict[tuple[str, str], Callable] = {}
    for name, (method, counts) in METHODS.items():
        if is_quick and name != "midpoint":
            continue
        for steps in counts[:1] if is_quick else counts:
            builders |= {
                (f"{name}, {engine} engine", f"{steps} steps"): _library_builder(method, steps, engine)
                for engine in ("compiled", "array")
            }
            if name == "midpoint":
                builders["midpoint, C", f"{steps} steps"] = _c_builder(steps)
        if method.explicit:
            builders[name, CALL_ROW] = _library_builder(method, 1, "compiled", T_END / counts[-1])
    for name, (solver, tolerances) in PEERS.items():
        for tolerance in tolerances[:1] if is_quick else tolerances:
            builders[name, f"tolerance {tolerance:.0e}"] = _peer_builder(solver, tolerance)
    contestants, skip_reasons = build_available(builders)
    outcomes = race({key: end for key, (end, _) in contestants.items()}, rounds=1 if is_quick else 5, max_seconds=2.0)

    exact = reference.exact_state(X0, RATE, T_END)
    rows: list[list] = []
    series: dict[str, list[list[float]]] = {}
    calls = {name: outcome.cpu_seconds for (name, setting), outcome in outcomes.items() if setting == CALL_ROW}
    for (name, setting), outcome in outcomes.items():
        if setting == CALL_ROW:
            continue
        state, run_laws = contestants[name, setting][1](outcome.result)
        error = float(np.abs(state - exact).max() / np.abs(exact).max())
        rows.append([name, setting, error, outcome.cpu_seconds, *run_laws.table_cells()])
        series.setdefault(name, []).append([error, outcome.cpu_seconds])
    rows.sort(key=lambda row: list(series).index(row[0]))
    columns = {"": "text", "Setting": "text", "Error": "error", "Time": "seconds"} | laws.COLUMNS
    text = (
        f"The relaxed rigid body (rate {RATE}) from {X0} to t = {T_END:g}: the error of the last state against Taylor "
        f"series of {reference.DECIMAL_DIGITS} digits. The times are the processor's, of whole calls from Python. "
        "For the "
        "peers the laws are taken over their own steps; nothing but accuracy keeps the laws there."
    )
    return Report(
        "Work and precision",
        text,
        [_fastest_table(series), Table("Every run.", columns, rows)],
        [] if is_quick else _explicit_targets(series, calls),
        skipped={name: reason for (name, _), reason in skip_reasons.items()},
        series=series,
    )


def _explicit_targets(series: dict[str, list[list[float]]], calls: dict[str, float]) -> list[Target]:
    """Return targets for the best explicit method at each error: its steps against heyoka, and its whole call."""

    def min_seconds(name: str, max_error: float) -> float:
        return min((seconds for error, seconds in series.get(name, []) if error <= max_error), default=math.inf)

    targets = []
    for max_error in TARGET_ERRORS:
        call_and_steps, call = min(
            (min_seconds(f"{name}, compiled engine", max_error), call) for name, call in calls.items()
        )
        work, heyoka = (
            f"one body to t = {T_END:g} at {max_error:.0e}, explicit",
            min_seconds("heyoka Taylor", max_error),
        )
        steps = (call_and_steps - call) / heyoka if math.isfinite(heyoka) else None
        targets.append(Target(f"{work}: steps against heyoka", 1.3, steps))
        targets.append(Target(f"{work}: a whole call", 2e-4, call_and_steps, "seconds"))
    return targets


def _fastest_table(series: dict[str, list[list[float]]]) -> Table:
    """Return a table of the least time in which each method reaches an error."""
    rows = [
        [
            name,
            *(
                min((seconds for error, seconds in points if error <= max_error), default=None)
                for max_error in TABLE_ERRORS
            ),
        ]
        for name, points in series.items()
    ]
    columns = {"": "text"} | {f"≤ {max_error:.0e}": "seconds" for max_error in TABLE_ERRORS}
    return Table("The least time in which an error was reached, over the settings tried.", columns, rows)


# Each builder returns what to time, and what makes of its result the last state and the laws.


def _library_builder(method, steps, engine, end_time=T_END):
    def build():
        system, span = quadratic_body(RATE), (0.0, end_time)
        end = lambda: lt.integrate(system, X0, span, end_time / steps, method, save_every=steps, engine=engine)  # noqa: E731
        return end, lambda solution: (solution.x[-1], laws.solution_laws(solution))

    return build


def _c_builder(steps):
    def build():
        program = BodyProgram("rigid_body.c", body_parameters(RATE))
        end = lambda: program.integrate(X0, T_END / steps, steps)  # noqa: E731
        return end, lambda result: (result[0][-1], laws.c_run_laws(result[1]))

    return build


def _peer_builder(solver, tolerance):
    def build():
        run, system = solver(tolerance, X0, T_END, RATE), quadratic_body(RATE)
        return run.solve_end, lambda state: (state, laws.path_laws(run.solve_path(), system))

    return build
