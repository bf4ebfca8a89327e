"""The isolated body with internal friction against the relaxed body: a step, and the first trajectory."""

from __future__ import annotations

import json
import tempfile
import time

import liethermo as lt

from .. import child, laws
from ..contest import RATE_TIMES_DURATION, STEP_SIZE
from ..report import Report, Table, Target, ratio
from ..timing import race

INERTIA = (3.0, 2.0, 1.5)
"""Moments of inertia of the bodies."""
INITIAL_STATE = (0.06, 0.1, 1.0)
"""Initial angular momentum."""

METHODS = (lt.MetriplecticMidpoint(), lt.MetriplecticGauss(2), lt.MetriplecticRungeKutta(6))
"""Methods that are timed."""

RUN_SCRIPT = """
import json, time

import liethermo as lt

body = lt.models.tumbling_body({inertia}, rate=0.1)
solution = lt.integrate(body, {start}, (0.0, 100.0), 0.1, lt.{method}, engine="compiled")
print(json.dumps([time.monotonic(), solution.audit().passed]))
"""
"""Script of a user's first trajectory."""


def run(is_quick: bool) -> Report:
    """Race the relaxed and the isolated body, and time the first trajectory with and without a cache."""
    steps, rounds = (2000, 1) if is_quick else (300_000, 7)
    rate = RATE_TIMES_DURATION / (STEP_SIZE * steps)
    bodies = {
        "relaxed body": lt.models.rigid_body(INERTIA, rate),
        "isolated body": lt.models.tumbling_body(INERTIA, rate=rate, attitude=False),
        "isolated body, attitude": lt.models.tumbling_body(INERTIA, rate=rate),
    }
    rows, targets = [], []
    for method in METHODS[: 1 if is_quick else None]:
        works = {
            name: lambda body=body, method=method: lt.integrate(
                body, INITIAL_STATE, (0.0, STEP_SIZE * steps), STEP_SIZE, method, save_every=steps, engine="compiled"
            )
            for name, body in bodies.items()
        }
        outcomes = race(works, rounds=rounds)
        reference_seconds = outcomes["relaxed body"].cpu_seconds
        for name, outcome in outcomes.items():
            relative_time = ratio(outcome.cpu_seconds, reference_seconds)
            cells = laws.solution_laws(outcome.result).table_cells()
            rows.append([f"{name}, {method}", outcome.cpu_seconds / steps, relative_time, *cells])
            if name == "isolated body":
                targets.append(
                    Target(f"a step of the isolated body beside the relaxed one, {method}", 1.5, relative_time)
                )
    columns = {"": "text", "Time a step": "seconds", "Relative to the relaxed body": "ratio"} | laws.COLUMNS
    table = Table(f"A run of {steps:,} steps of size {STEP_SIZE}; one state kept.", columns, rows)

    script_rows, calls = (
        [],
        ("MetriplecticMidpoint()",) if is_quick else ("MetriplecticMidpoint()", "MetriplecticRungeKutta(8)"),
    )
    for call in calls:
        script = RUN_SCRIPT.format(inertia=INERTIA, start=INITIAL_STATE, method=call)
        with tempfile.TemporaryDirectory() as cache:
            cold_seconds, *cached_seconds = [_script_seconds(script, cache) for _ in range(2 if is_quick else 4)]
        script_rows.append([call, cold_seconds, min(cached_seconds)])
        targets.append(Target(f"first trajectory with attitude, cached, {call}", 1.5, min(cached_seconds), "seconds"))
    calls_table = Table(
        "1000 steps with attitudes in a new process, from its start to its end.",
        {"": "text", "Empty cache": "seconds", "Cached": "seconds"},
        script_rows,
    )
    text = "Friction inside a body, its heat in a bath and its attitude, beside Morrison's body. Processor times."
    return Report("The isolated body", text, [table, calls_table], targets)


def _script_seconds(script: str, cache: str) -> float:
    start = time.monotonic()  # one clock for all processes
    end_time, laws_hold = json.loads(child.run_python("-c", script, cache=cache))
    if not laws_hold:
        raise RuntimeError("the audit of the isolated body failed")
    return end_time - start
