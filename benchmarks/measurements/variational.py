"""Time of a step of the variational schemes, for a mass on a spring in an ideal gas."""

from __future__ import annotations

import functools
from collections.abc import Callable

import numpy as np

import liethermo as lt
from liethermo.models.gases import MASS_SPRING_CASES

from ..contest import race_runs_of_one_trajectory, require_same_scheme
from ..native import BodyProgram
from ..report import Report, Target, build_available, ratio

SCHEMES = {
    1: lt.VariationalIntegrator.verlet(),
    2: lt.VariationalIntegrator.midpoint(),
    3: lt.VariationalIntegrator.symmetrised(),
}
"""The schemes, numbered as in the C program."""
X0 = (0.3, 0.0, 0.0)
"""Initial state."""
STEP = 1e-3
"""Step size in seconds."""
FRICTION = 0.2
"""Friction coefficient."""
STEPS = 100_000
"""Number of steps."""

C_ROW = "C"
"""Row of the C program."""
COMPILED_ROW = "compiled engine"
"""Row of the compiled engine."""


def run(is_quick: bool) -> Report:
    """Time each scheme on Case 1 of the paper, with one saved state."""
    steps, rounds = (2000, 1) if is_quick else (STEPS, 9)
    tables, targets, max_difference = [], [], 0.0
    skip_reasons: dict[str, str] = {}
    for number in SCHEMES:
        works, unavailable = build_available(
            {
                C_ROW: functools.partial(c_run, number, steps),
                COMPILED_ROW: functools.partial(library_run, number, steps, steps),
            }
        )
        table, times = race_runs_of_one_trajectory(f"Scheme {number}.", works, steps, rounds, C_ROW)
        tables.append(table)
        targets.append(
            Target(
                f"variational scheme {number}, mass and spring in a gas, against C",
                3.0,
                ratio(times[COMPILED_ROW], times.get(C_ROW)),
            )
        )
        skip_reasons |= unavailable
        if C_ROW in works:
            max_difference = max(max_difference, max_difference_from_c(number))
    text = (
        f"The three schemes of Gay-Balmaz and Yoshimura on their Case 1 with friction {FRICTION}: {steps:,} steps of "
        f"{STEP} s, one state kept. The programs in C are written for this system, the library has its Lagrangian and "
        "its friction; both iterate by the same rules and record energy and entropy at every step. That the energy "
        "drifts is in the nature of the schemes."
    )
    if max_difference:
        text += f" Over 1000 steps the trajectories differ by {max_difference:.0e} at most."
    return Report("Variational schemes", text, tables, targets, skip_reasons)


def c_program(number: int) -> BodyProgram:
    system = MASS_SPRING_CASES[1]
    parameters = [system["mass"], system["stiffness"], FRICTION, 1.5 * system["moles"] * 8.31446261815324, 300.0]
    return BodyProgram("variational.c", parameters, f"-DSCHEME={number}")


def c_run(number: int, steps: int) -> Callable:
    return functools.partial(c_program(number).integrate, X0, STEP, steps)


def library_run(number: int, steps: int, save_every: int) -> Callable[[], lt.Solution]:
    system = lt.models.mass_spring_gas(**MASS_SPRING_CASES[1], friction=FRICTION)
    span = (0.0, STEP * steps)
    return functools.partial(
        lt.integrate, system, X0, span, STEP, SCHEMES[number], save_every=save_every, engine="compiled"
    )


def max_difference_from_c(number: int) -> float:
    """Return the largest difference between the trajectories of C and of the library, over 1000 steps.

    Raises
    ------
    RuntimeError
        As for :func:`..contest.require_same_scheme`.
    """
    library_states, (c_states, _) = library_run(number, 1000, 1)().x[1:], c_program(number).integrate(X0, STEP, 1000, 1)
    return require_same_scheme(float(np.abs(library_states - c_states).max()), 1000)
