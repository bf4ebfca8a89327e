"""Many relaxed rigid bodies at once: the time of a body, against C with SIMD and, at equal accuracy, the peers."""

from __future__ import annotations

import functools
from collections.abc import Callable

import numpy as np

import liethermo as lt

from .. import laws, peers, reference
from ..ensembles import by_library, error, loosest
from ..ensembles import laws as ensemble_laws
from ..machine import cores
from ..native import SUMMARY, Bodies
from ..problems import body, body_parameters, random_states
from ..report import Report, Table, Target, ratio, take_part
from ..timing import race

RATE, T_END = 1.0, 10.0

SAMPLE = 32
"""Bodies whose errors are taken; the worst counts."""

SCIPY, C, COMPILED = "SciPy DOP853, one by one", "C with SIMD", "compiled engine"

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
    SCIPY: peers.scipy_loop,
    "diffrax Tsit5, `vmap`": functools.partial(peers.diffrax_ensemble, "Tsit5"),
    "diffrax Dopri8, `vmap`": functools.partial(peers.diffrax_ensemble, "Dopri8"),
    "heyoka, batches over threads": peers.heyoka_batches,
    "heyoka, ensemble mode": peers.heyoka_ensemble,
}


def run(quick: bool) -> Report:
    """One table for each of the library's methods."""
    bodies, rounds = (64, 1) if quick else (10_000, 5)
    x0s = random_states(bodies)
    exact = np.array([reference.states(x0, RATE, T_END) for x0 in x0s[: 2 if quick else SAMPLE]])
    methods = {"midpoint": METHODS["midpoint"]} if quick else METHODS
    contests = {name: _contest(name, method, steps, x0s, exact, rounds) for name, (method, steps) in methods.items()}
    times, _, skipped = contests["midpoint"]
    against_c = ratio(times[COMPILED], times.get(C))
    targets = [Target(f"{bodies:,} relaxed bodies, 200 steps, against C with SIMD", 1.7, against_c)]
    for name, (times, _, _) in contests.items():
        diffrax = min((times[title] for title in PEERS if title in times and "vmap" in title), default=None)
        explicit, work = methods[name][0].explicit, f"{bodies:,} relaxed bodies ({name})"
        wanted = 20.0 if explicit else 10.0
        by_diffrax = ratio(diffrax, times[COMPILED])
        targets.append(
            Target(f"{work}, against diffrax under vmap at equal accuracy", wanted, by_diffrax, at_least=True)
        )
        if explicit:
            heyoka = min((times[title] for title in PEERS if title in times and "heyoka" in title), default=None)
            most = 1.3 if name.endswith("1e-12") else 1.0
            targets.append(Target(f"{work}, against heyoka at equal accuracy", most, ratio(times[COMPILED], heyoka)))
    text = (
        f"{bodies:,} bodies from random states of norm one to t = {T_END:g}, on {cores()} cores. The error is the "
        f"worst of {len(exact)} bodies against Taylor series of {reference.DIGITS} digits. Each peer has the loosest "
        "tolerance with which it is at least as accurate as the library's method."
    )
    return Report("Many bodies", text, [table for _, table, _ in contests.values()], targets, skipped)


def _contest(name: str, method: lt.OneStepMethod, steps: int, x0s: np.ndarray, exact: np.ndarray, rounds: int):
    """Seconds a body by contestant, the table, and who was left out."""
    system = body(RATE)
    works = {
        COMPILED: by_library(system, x0s, T_END, steps, "compiled", method),
        "array engine": by_library(system, x0s, T_END, steps, "array", method),
    }
    reached = error(by_library(system, x0s[: len(exact)], T_END, steps, "compiled", method)().x, exact)
    builders: dict[str, Callable] = {
        title: functools.partial(_peer, build, x0s[:SAMPLE] if title == SCIPY else x0s, exact, reached)
        for title, build in PEERS.items()
    }
    if name == "midpoint":
        builders |= {
            C: lambda: (_c(x0s, steps, cores()), f"{steps} steps"),
            f"{C}, one core": lambda: (_c(x0s, steps, 1), f"{steps} steps"),
        }
    others, skipped = take_part(builders)
    works |= {title: work for title, (work, _) in others.items()}
    outcomes = race(works, rounds=rounds)
    times: dict[str, float] = {}
    rows: list[list] = []
    for title, outcome in outcomes.items():
        found = outcome.result
        if isinstance(found, lt.Ensemble):
            ends, kept = np.asarray(found.x), ensemble_laws(found)
        elif found.dtype == SUMMARY:
            ends, kept = found["x"], laws.of_runs(found)
        else:
            ends, kept = found, laws.of_ends(x0s[: len(found)], found, system)
        times[title] = outcome.seconds / len(ends)
        setting = others[title][1] if title in others else f"{steps} steps"
        rows.append([title, setting, error(ends, exact), times[title], None, *kept.cells()])
    for row in rows:
        row[4] = ratio(row[3], times.get(C))
    rows.sort(key=lambda row: row[3])
    columns = {"": "text", "Setting": "text", "Error": "error", "Time a body": "seconds", "Relative to C": "ratio"}
    caption = f"The library: {name}, {steps} steps; peers at its accuracy, whose laws are taken at the ends alone."
    return times, Table(caption, columns | laws.COLUMNS, rows), skipped


def _peer(build: Callable, x0s: np.ndarray, exact: np.ndarray, wanted: float) -> tuple[Callable, str]:
    """A peer's work with the loosest tolerance that reaches an error, and that tolerance as text."""
    work, tolerance, _ = loosest(lambda tolerance, some: build(tolerance, some, T_END, RATE), x0s, exact, wanted)
    return work, f"tolerance {tolerance:.1e}"


def _c(x0s: np.ndarray, steps: int, threads: int) -> Callable[[], np.ndarray]:
    program = Bodies(body_parameters(RATE))
    return lambda: program.integrate(x0s, T_END / steps, steps, threads)
