"""Many states of other systems at once: explicit methods against heyoka at equal accuracy."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable

import numpy as np

import liethermo as lt
import manifolds as mf

from .. import laws, peers
from ..ensembles import by_library, error, loosest
from ..ensembles import laws as ensemble_laws
from ..machine import cores
from ..problems import general_body
from ..report import Report, Table, ratio, take_part
from ..timing import race
from . import spin

T_END, SAMPLE, EXACT, RATE = 10.0, 32, 1e-18, 0.1
METHOD = lt.MetriplecticRungeKutta(8)


def _su3() -> lt.System:
    g = mf.su(3)
    energy = lt.Quadratic(1.0 / np.linspace(1.0, 4.0, g.dim))
    return lt.LiePoissonSystem(g, energy, g.casimirs(2)[0], lt.KillingDissipation(0.1))


SYSTEMS: dict[str, tuple[Callable[[], lt.System], tuple[int, ...]]] = {
    "Quartic energy, logarithmic entropy": (lambda: general_body(1.0), (32, 64, 128)),
    "su(3)": (_su3, (8, 16, 32)),
    "A spin on its sphere, with a bath": (lambda: spin.system(RATE), (32, 64, 128)),
}
"""Systems, and numbers of steps."""


def run(quick: bool) -> Report:
    """One table for each system."""
    tables: list[Table] = []
    skipped: dict[str, str] = {}
    for name, (build, counts) in SYSTEMS.items():
        table, missing = _contest(name, build(), 64 if quick else 10_000, counts[:1] if quick else counts, quick)
        tables.append(table)
        skipped |= missing
    text = (
        f"10,000 states of norm one to t = {T_END:g}, on {cores()} cores: explicit steps of order 8 and heyoka in "
        "batches over threads, whose equations are the scalar program of the vector field. The error is the "
        f"worst of {SAMPLE} states, against heyoka at a tolerance of {EXACT:g}; heyoka has the loosest tolerance with "
        "which it is at least as accurate. heyoka's spin leaves its sphere by its error. There is no target."
    )
    return Report("Other systems", text, tables, skipped=skipped)


def _contest(name: str, system: lt.System, number: int, counts: tuple[int, ...], quick: bool) -> tuple[Table, dict]:
    random = np.random.default_rng(0).standard_normal((number, system.dim))
    if system.space is not None:
        random[:, 3] = 0.0  # of the bath
    x0s = random / np.linalg.norm(random, axis=1)[:, None]
    rows: list[list] = []
    prepared, skipped = take_part({"heyoka": lambda: _heyoka(system, x0s[:SAMPLE])})
    for steps in counts:
        ours = by_library(system, x0s, T_END, steps, "compiled", METHOD)
        works, missed = {"compiled engine": ours}, math.nan
        if "heyoka" in prepared:
            build, exact = prepared["heyoka"]
            missed = error(ours().x, exact)
            works["heyoka"], tolerance, reached = loosest(build, x0s, exact, missed)
        outcomes = race(works, rounds=1 if quick else 5)
        seconds = {title: outcome.seconds / number for title, outcome in outcomes.items()}
        kept = ensemble_laws(outcomes["compiled engine"].result)
        rows.append(["compiled engine", f"{steps} steps", missed, seconds["compiled engine"],
                     ratio(seconds["compiled engine"], seconds.get("heyoka")), *kept.cells()])  # fmt: skip
        if "heyoka" in prepared:
            ends = laws.of_ends(x0s, outcomes["heyoka"].result, system)
            rows.append(["heyoka", f"tolerance {tolerance:.1e}", reached, seconds["heyoka"], 1.0, *ends.cells()])
    columns = {"": "text", "Setting": "text", "Error": "error", "Time a state": "seconds", "Relative": "ratio"}
    return Table(f"{name}.", columns | laws.COLUMNS, rows), skipped


def _heyoka(system: lt.System, some: np.ndarray) -> tuple[Callable, np.ndarray]:
    """What makes a work of a tolerance and states, and where some states end."""
    field = system.vector_field if system.space is None else functools.partial(spin.field, RATE)
    build = functools.partial(peers.heyoka_batches_of, peers.heyoka_equations(field, system.dim), t_end=T_END)
    return build, build(EXACT, some)()
