"""Many relaxed rigid bodies at once: the time of a body, against C with SIMD and, at equal accuracy, the peers."""

from __future__ import annotations

import functools
from collections.abc import Callable

import numpy as np

import liethermo as lt

from .. import laws, peers, reference
from ..ensembles import ensemble_laws as ensemble_laws
from ..ensembles import library_ensemble, loosest_tolerance_work, max_relative_error
from ..machine import available_cores
from ..native import SUMMARY_DTYPE, EnsembleProgram
from ..problems import body_parameters, quadratic_body, random_states
from ..report import Report, Table, Target, build_available, ratio
from ..timing import race

RATE, T_END = 1.0, 10.0

N_SAMPLED_BODIES = 32
"""Bodies whose errors are taken; the worst counts."""

SCIPY_ROW, C_ROW, COMPILED_ROW = "SciPy DOP853, one by one", "C with SIMD", "compiled engine"

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
"""The library's methods, each with a number of steps; the peers are set to the accuracy that it reaches."""

PEERS: dict[str, Callable] = {
    SCIPY_ROW: peers.scipy_ensemble,
    "diffrax Tsit5, `vmap`": functools.partial(peers.diffrax_ensemble, "Tsit5"),
    "diffrax Dopri8, `vmap`": functools.partial(peers.diffrax_ensemble, "Dopri8"),
    "heyoka, batches over threads": peers.heyoka_threads,
    "heyoka, ensemble mode": peers.heyoka_ensemble,
}


def run(quick: bool) -> Report:
    """One table for each of the library's methods."""
    bodies, rounds = (64, 1) if quick else (10_000, 5)
    x0s = random_states(bodies)
    exact = np.array([reference.exact_state(x0, RATE, T_END) for x0 in x0s[: 2 if quick else N_SAMPLED_BODIES]])
    methods = {"midpoint": METHODS["midpoint"]} if quick else METHODS
    contests = {
        name: _race_method(name, method, steps, x0s, exact, rounds) for name, (method, steps) in methods.items()
    }
    times, _, skipped = contests["midpoint"]
    against_c = ratio(times[COMPILED_ROW], times.get(C_ROW))
    targets = [Target(f"{bodies:,} relaxed bodies, 200 steps, against C with SIMD", 1.7, against_c)]
    for name, (times, _, _) in contests.items():
        diffrax = min((times[title] for title in PEERS if title in times and "vmap" in title), default=None)
        explicit, work = methods[name][0].explicit, f"{bodies:,} relaxed bodies ({name})"
        wanted = 20.0 if explicit else 10.0
        by_diffrax = ratio(diffrax, times[COMPILED_ROW])
        targets.append(
            Target(f"{work}, against diffrax under vmap at equal accuracy", wanted, by_diffrax, at_least=True)
        )
        if explicit:
            heyoka = min((times[title] for title in PEERS if title in times and "heyoka" in title), default=None)
            most = 1.3 if name.endswith("1e-12") else 1.0
            targets.append(
                Target(f"{work}, against heyoka at equal accuracy", most, ratio(times[COMPILED_ROW], heyoka))
            )
    text = (
        f"{bodies:,} bodies from random states of norm one to t = {T_END:g}, on {available_cores()} cores. The error is the "
        f"worst of {len(exact)} bodies against Taylor series of {reference.DECIMAL_DIGITS} digits. Each peer has the loosest "
        "tolerance with which it is at least as accurate as the library's method."
    )
    return Report("Many bodies", text, [table for _, table, _ in contests.values()], targets, skipped)


def _race_method(name: str, method: lt.OneStepMethod, steps: int, x0s: np.ndarray, exact: np.ndarray, rounds: int):
    """Seconds a body by contestant, the table, and who was left out."""
    system = quadratic_body(RATE)
    works = {
        COMPILED_ROW: library_ensemble(system, x0s, T_END, steps, "compiled", method),
        "array engine": library_ensemble(system, x0s, T_END, steps, "array", method),
    }
    reached = max_relative_error(
        library_ensemble(system, x0s[: len(exact)], T_END, steps, "compiled", method)().x, exact
    )
    builders: dict[str, Callable] = {
        title: functools.partial(
            _peer_work, build, x0s[:N_SAMPLED_BODIES] if title == SCIPY_ROW else x0s, exact, reached
        )
        for title, build in PEERS.items()
    }
    if name == "midpoint":
        builders |= {
            C_ROW: lambda: (_c_work(x0s, steps, available_cores()), f"{steps} steps"),
            f"{C_ROW}, one core": lambda: (_c_work(x0s, steps, 1), f"{steps} steps"),
        }
    others, skipped = build_available(builders)
    works |= {title: work for title, (work, _) in others.items()}
    outcomes = race(works, rounds=rounds)
    times: dict[str, float] = {}
    rows: list[list] = []
    for title, outcome in outcomes.items():
        found = outcome.result
        if isinstance(found, lt.Ensemble):
            ends, kept = np.asarray(found.x), ensemble_laws(found)
        elif found.dtype == SUMMARY_DTYPE:
            ends, kept = found["x"], laws.c_run_laws(found)
        else:
            ends, kept = found, laws.end_state_laws(x0s[: len(found)], found, system)
        times[title] = outcome.wall_seconds / len(ends)
        setting = others[title][1] if title in others else f"{steps} steps"
        rows.append([title, setting, max_relative_error(ends, exact), times[title], None, *kept.table_cells()])
    for row in rows:
        row[4] = ratio(row[3], times.get(C_ROW))
    rows.sort(key=lambda row: row[3])
    columns = {"": "text", "Setting": "text", "Error": "error", "Time a body": "seconds", "Relative to C": "ratio"}
    caption = f"The library: {name}, {steps} steps; peers at its accuracy, whose laws are taken at the ends alone."
    return times, Table(caption, columns | laws.COLUMNS, rows), skipped


def _peer_work(build: Callable, x0s: np.ndarray, exact: np.ndarray, wanted: float) -> tuple[Callable, str]:
    """A peer's work with the loosest tolerance that reaches an error, and that tolerance as text."""
    work, tolerance, _ = loosest_tolerance_work(
        lambda tolerance, some: build(tolerance, some, T_END, RATE), x0s, exact, wanted
    )
    return work, f"tolerance {tolerance:.1e}"


def _c_work(x0s: np.ndarray, steps: int, threads: int) -> Callable[[], np.ndarray]:
    program = EnsembleProgram(body_parameters(RATE))
    return lambda: program.integrate(x0s, T_END / steps, steps, threads)
