"""Many states of other systems: explicit methods against heyoka at equal accuracy."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable

import numpy as np

import liethermo as lt
import manifolds as mf

from .. import laws, peers
from ..ensembles import ensemble_laws, find_loosest_tolerance_run, library_ensemble, max_relative_error
from ..machine import available_cores
from ..problems import general_body
from ..report import Report, Table, build_available, ratio
from ..timing import race
from . import spin

T_END = 10.0
"""Duration of the runs."""
N_SAMPLED_STATES = 32
"""Number of states whose errors are measured."""
EXACT_TOLERANCE = 1e-18
"""heyoka's tolerance for the exact states."""
RATE = 0.1
"""Damping rate of the spin."""
METHOD = lt.MetriplecticRungeKutta(8)
"""Method of the library."""


def _su3_system() -> lt.System:
    g = mf.su(3)
    energy = lt.Quadratic(1.0 / np.linspace(1.0, 4.0, g.dim))
    return lt.LiePoissonSystem(g, energy, g.casimirs(2)[0], lt.KillingDissipation(0.1))


SYSTEMS: dict[str, tuple[Callable[[], lt.System], tuple[int, ...]]] = {
    "Quartic energy, logarithmic entropy": (lambda: general_body(1.0), (32, 64, 128)),
    "su(3)": (_su3_system, (8, 16, 32)),
    "A spin on its sphere, with a bath": (lambda: spin.spin_system(RATE), (32, 64, 128)),
}
"""Systems, each with numbers of steps."""


def run(is_quick: bool) -> Report:
    """Compare with heyoka on each system."""
    tables: list[Table] = []
    skip_reasons: dict[str, str] = {}
    for name, (build, counts) in SYSTEMS.items():
        table, unavailable = _race_heyoka(
            name, build(), 64 if is_quick else 10_000, counts[:1] if is_quick else counts, is_quick
        )
        tables.append(table)
        skip_reasons |= unavailable
    text = (
        f"10,000 states of norm one to t = {T_END:g}, on {available_cores()} cores: explicit steps of order 8 and "
        "heyoka in "
        "batches over threads, whose equations are the scalar program of the vector field. The error is the "
        f"worst of {N_SAMPLED_STATES} states, against heyoka at a tolerance of {EXACT_TOLERANCE:g}; heyoka has "
        "the loosest tolerance with "
        "which it is at least as accurate. heyoka's spin leaves its sphere by its error. There is no target."
    )
    return Report("Other systems", text, tables, skipped=skip_reasons)


def _race_heyoka(
    name: str, system: lt.System, number: int, counts: tuple[int, ...], is_quick: bool
) -> tuple[Table, dict]:
    random = np.random.default_rng(0).standard_normal((number, system.dim))
    if system.space is not None:
        random[:, 3] = 0.0  # of the bath
    x0s = random / np.linalg.norm(random, axis=1)[:, None]
    rows: list[list] = []
    heyoka_work, skip_reasons = build_available({"heyoka": lambda: _heyoka_builder(system, x0s[:N_SAMPLED_STATES])})
    for steps in counts:
        ours = library_ensemble(system, x0s, T_END, steps, "compiled", METHOD)
        works, method_error = {"compiled engine": ours}, math.nan
        if "heyoka" in heyoka_work:
            build, exact = heyoka_work["heyoka"]
            method_error = max_relative_error(ours().x, exact)
            works["heyoka"], tolerance, heyoka_error = find_loosest_tolerance_run(build, x0s, exact, method_error)
        outcomes = race(works, rounds=1 if is_quick else 5)
        seconds = {title: outcome.wall_seconds / number for title, outcome in outcomes.items()}
        run_laws = ensemble_laws(outcomes["compiled engine"].result)
        rows.append(["compiled engine", f"{steps} steps", method_error, seconds["compiled engine"],
                     ratio(seconds["compiled engine"], seconds.get("heyoka")), *run_laws.table_cells()])  # fmt: skip
        if "heyoka" in heyoka_work:
            ends = laws.end_state_laws(x0s, outcomes["heyoka"].result, system)
            rows.append(
                ["heyoka", f"tolerance {tolerance:.1e}", heyoka_error, seconds["heyoka"], 1.0, *ends.table_cells()]
            )
    columns = {"": "text", "Setting": "text", "Error": "error", "Time a state": "seconds", "Relative": "ratio"}
    return Table(f"{name}.", columns | laws.COLUMNS, rows), skip_reasons


def _heyoka_builder(system: lt.System, states: np.ndarray) -> tuple[Callable, np.ndarray]:
    """Return a function that builds heyoka's run from a tolerance and states, and exact final states."""
    field = system.vector_field if system.space is None else functools.partial(spin.spin_field, RATE)
    build = functools.partial(
        peers.heyoka_equations_threads, peers.equations_for_heyoka(field, system.dim), t_end=T_END
    )
    return build, build(EXACT_TOLERANCE, states)()
