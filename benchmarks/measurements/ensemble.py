"""Many relaxed rigid bodies at once: the time per body against C with SIMD and, at equal accuracy, against peers."""

from __future__ import annotations

import functools
from collections.abc import Callable

import numpy as np

import liethermo as lt

from .. import laws, peers, reference
from ..ensembles import ensemble_laws, find_loosest_tolerance_run, library_ensemble, max_relative_error
from ..machine import available_cores
from ..native import SUMMARY_DTYPE, EnsembleProgram
from ..problems import body_parameters, quadratic_body, random_states
from ..report import Report, Table, Target, build_available, ratio
from ..timing import race

RATE = 1.0
"""Dissipation rate."""
T_END = 10.0
"""Duration of the runs."""

N_SAMPLED_BODIES = 32
"""Number of bodies whose errors are measured; the worst counts."""

SCIPY_ROW = "SciPy DOP853, one by one"
C_ROW = "C with SIMD"
COMPILED_ROW = "compiled engine"

METHODS: dict[str, tuple[lt.OneStepMethod, int]] = {
    "midpoint": (lt.MetriplecticMidpoint(), 200),
    "Gauss, order 4": (lt.MetriplecticGauss(stages=2), 50),
    "Gauss, order 6": (lt.MetriplecticGauss(stages=3), 40),
    "explicit, order 6, to 1e-3": (lt.MetriplecticRungeKutta(6), 8),
    "explicit, order 8, to 1e-5": (lt.MetriplecticRungeKutta(8), 14),
    "explicit, order 8, to 1e-8": (lt.MetriplecticRungeKutta(8), 32),
    "explicit, order 8, to 1e-12": (lt.MetriplecticRungeKutta(8), 96),
    "Taylor, order 16, to 1e-12": (lt.MetriplecticTaylor(16), 26),
}
"""The library's methods, each with a number of steps; the peers get the accuracy that it reaches."""

PEERS: dict[str, Callable] = {
    SCIPY_ROW: peers.scipy_ensemble,
    "diffrax Tsit5, `vmap`": functools.partial(peers.diffrax_ensemble, "Tsit5"),
    "diffrax Dopri8, `vmap`": functools.partial(peers.diffrax_ensemble, "Dopri8"),
    "heyoka, batches over threads": peers.heyoka_threads,
    "heyoka, ensemble mode": peers.heyoka_ensemble,
}
"""Functions that build a peer's run."""


def run(is_quick: bool) -> Report:
    """Compare each of the library's methods with C and the peers."""
    bodies, rounds = (64, 1) if is_quick else (10_000, 5)
    x0s = random_states(bodies)
    exact = np.array([reference.exact_state(x0, RATE, T_END) for x0 in x0s[: 2 if is_quick else N_SAMPLED_BODIES]])
    methods = {"midpoint": METHODS["midpoint"]} if is_quick else METHODS
    contests = {
        name: _race_method(name, method, steps, x0s, exact, rounds) for name, (method, steps) in methods.items()
    }
    times, _, skip_reasons = contests["midpoint"]
    against_c = ratio(times[COMPILED_ROW], times.get(C_ROW))
    targets = [Target(f"{bodies:,} relaxed bodies, 200 steps, against C with SIMD", 1.7, against_c)]
    for name, (times, _, _) in contests.items():
        diffrax = min((times[title] for title in PEERS if title in times and "vmap" in title), default=None)
        explicit, work = methods[name][0].explicit, f"{bodies:,} relaxed bodies ({name})"
        min_speedup = 20.0 if explicit else 10.0
        speedup = ratio(diffrax, times[COMPILED_ROW])
        targets.append(
            Target(f"{work}, against diffrax under vmap at equal accuracy", min_speedup, speedup, at_least=True)
        )
        if explicit:
            heyoka = min((times[title] for title in PEERS if title in times and "heyoka" in title), default=None)
            max_ratio = 1.3 if name.endswith("1e-12") else 1.0
            targets.append(
                Target(f"{work}, against heyoka at equal accuracy", max_ratio, ratio(times[COMPILED_ROW], heyoka))
            )
    text = (
        f"{bodies:,} bodies from random states of norm one to t = {T_END:g}, on {available_cores()} cores. The "
        "error is the "
        f"worst of {len(exact)} bodies against Taylor series of {reference.DECIMAL_DIGITS} digits. Each peer has "
        "the loosest "
        "tolerance with which it is at least as accurate as the library's method."
    )
    return Report("Many bodies", text, [table for _, table, _ in contests.values()], targets, skip_reasons)


def _race_method(name: str, method: lt.OneStepMethod, steps: int, x0s: np.ndarray, exact: np.ndarray, rounds: int):
    """Return the seconds per body of each contestant, the table, and the contestants that are left out."""
    system = quadratic_body(RATE)
    works = {
        COMPILED_ROW: library_ensemble(system, x0s, T_END, steps, "compiled", method),
        "array engine": library_ensemble(system, x0s, T_END, steps, "array", method),
    }
    method_error = max_relative_error(
        library_ensemble(system, x0s[: len(exact)], T_END, steps, "compiled", method)().x, exact
    )
    builders: dict[str, Callable] = {
        title: functools.partial(
            _peer_work, build, x0s[:N_SAMPLED_BODIES] if title == SCIPY_ROW else x0s, exact, method_error
        )
        for title, build in PEERS.items()
    }
    if name == "midpoint":
        builders |= {
            C_ROW: lambda: (_c_work(x0s, steps, available_cores()), f"{steps} steps"),
            f"{C_ROW}, one core": lambda: (_c_work(x0s, steps, 1), f"{steps} steps"),
        }
    peer_works, skip_reasons = build_available(builders)
    works |= {title: work for title, (work, _) in peer_works.items()}
    outcomes = race(works, rounds=rounds)
    times: dict[str, float] = {}
    rows: list[list] = []
    for title, outcome in outcomes.items():
        result = outcome.result
        if isinstance(result, lt.Ensemble):
            ends, run_laws = np.asarray(result.x), ensemble_laws(result)
        elif result.dtype == SUMMARY_DTYPE:
            ends, run_laws = result["x"], laws.c_run_laws(result)
        else:
            ends, run_laws = result, laws.end_state_laws(x0s[: len(result)], result, system)
        times[title] = outcome.wall_seconds / len(ends)
        setting = peer_works[title][1] if title in peer_works else f"{steps} steps"
        rows.append([title, setting, max_relative_error(ends, exact), times[title], None, *run_laws.table_cells()])
    for row in rows:
        row[4] = ratio(row[3], times.get(C_ROW))
    rows.sort(key=lambda row: row[3])
    columns = {"": "text", "Setting": "text", "Error": "error", "Time a body": "seconds", "Relative to C": "ratio"}
    caption = f"The library: {name}, {steps} steps; peers at its accuracy, whose laws are taken at the ends alone."
    return times, Table(caption, columns | laws.COLUMNS, rows), skip_reasons


def _peer_work(build: Callable, x0s: np.ndarray, exact: np.ndarray, max_error: float) -> tuple[Callable, str]:
    """Return a peer's run with the loosest tolerance whose error is at most ``max_error``, and that tolerance as
    text."""
    work, tolerance, _ = find_loosest_tolerance_run(
        lambda tolerance, states: build(tolerance, states, T_END, RATE), x0s, exact, max_error
    )
    return work, f"tolerance {tolerance:.1e}"


def _c_work(x0s: np.ndarray, steps: int, threads: int) -> Callable[[], np.ndarray]:
    program = EnsembleProgram(body_parameters(RATE))
    return lambda: program.integrate(x0s, T_END / steps, steps, threads)
