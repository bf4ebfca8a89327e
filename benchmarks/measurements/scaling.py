"""Time and memory by size: fields, spins, graphs and matrices from ten to ten million sites, with engine="auto"."""

from __future__ import annotations

import functools
import math
import os
import time
from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np

import liethermo as lt
import manifolds as mf
from liethermo.engines.select_engine import EngineWithFallback
from liethermo.runs.preparation import prepare_system_and_method

from .. import child as process
from ..report import Report, Table, Target
from .lattice import random_spins
from .memory import PROCESS_STATUS_FILE, peak_resident_bytes

SIZES = tuple(10**i for i in range(1, 8))
"""Numbers of sites."""
SHORT_STEPS = 2
"""Steps of the short run, whose time is subtracted."""

MIN_TIMED_SECONDS = 1.0
"""Seconds by which the long run must exceed the short one."""

MAX_STEPS = 200_000
"""Maximum number of steps of the long run."""

MAX_STEP_SECONDS = 20.0
"""Maximum seconds of a step; larger systems are left out."""

MAX_MEMORY_FRACTION = 0.7
"""Maximum fraction of the memory that a process may use; larger systems are left out."""

MIDPOINT = lt.MetriplecticMidpoint()
"""Method of most systems."""
EXPLICIT = lt.MetriplecticRungeKutta(4)
"""Method of the fluids."""


def wave_field(n: int) -> tuple[lt.System, Any]:
    """Return a wave equation with a cubic force, as a plain function of all positions and momenta, and a state."""

    def energy(x):
        q, p = x[:n], x[n:]
        return 0.5 * jnp.sum(p**2) + 0.5 * jnp.sum((q - jnp.roll(q, 1)) ** 2) + 0.25 * jnp.sum(q**4)

    random = np.random.default_rng(0).standard_normal(2 * n)
    return lt.MetriplecticSystem(mf.Canonical(n), energy, validate=False), random


def spin_ring(n: int) -> tuple[lt.System, Any]:
    """Return a ring of spins that heat a bath, and a state."""
    return lt.models.spin_lattice(n, 1.0, 0.1, rate=0.1), random_spins(n)


def heat_graph(n: int) -> tuple[lt.System, Any]:
    """Return heat conduction on a square grid of about n bodies, and a state."""
    edge = round(math.sqrt(n))
    temperatures = np.random.default_rng(0).uniform(0.8, 1.2, edge**2)
    return lt.models.heat_grid((edge, edge)), np.log(temperatures)


def sphere_fluid(n: int) -> tuple[lt.System, Any]:
    """Return a fluid on the sphere with a matrix of about n entries, and a state."""
    N = round(math.sqrt(n))
    sphere = lt.models.QuantisedSphere(N)
    return lt.models.zeitlin(N, "enstrophy", 1e-3), sphere.random(0, (1, min(N - 1, 12)), 1.0)


SYSTEM_KINDS: dict[str, tuple[Callable, lt.OneStepMethod, float]] = {
    "a field": (wave_field, MIDPOINT, 0.05),
    "spins": (spin_ring, MIDPOINT, 0.02),
    "a graph": (heat_graph, MIDPOINT, 0.1),
    "su(N)": (sphere_fluid, EXPLICIT, 1e-3),
}
"""Functions that make a system and a state with n sites, and the method and step, by kind."""


def run(is_quick: bool) -> Report:
    """Measure every kind and size, each in a process of its own."""
    rows: list[list] = []
    skip_reasons: dict[str, str] = {}
    for kind in SYSTEM_KINDS:
        for n in SIZES[:2] if is_quick else SIZES:
            if reason := why_too_large(rows[-1] if rows and rows[-1][0] == kind else None):
                skip_reasons[f"{kind}, {n:,} sites"] = reason
                break
            results = process.run_in_child_process("scaling", kind, str(n))
            row = [kind, results["sites"], results["engine"], results["first"], results["step"] / results["sites"]]
            rows.append([*row, results["step"], results["peak"]])
    columns = {"System": "text", "Sites": "count", "Engine": "text", "First answer": "seconds"}
    columns |= {"A step, for each site": "seconds", "A step": "seconds", "Peak memory": "gigabytes"}
    caption = (
        'Each row is a process of its own with `engine="auto"`. The first answer is that of two steps, the system made '
        "and the programs compiled. Times are those of the processor, all threads together; peak memory is that of the "
        "process, the packages among it."
    )
    text = (
        "A field is a plain function of positions and momenta on a ring; spins are a ring with a bath; a graph is a "
        "square grid of bodies that exchange heat; a site of su(N) is an entry of the matrix of a fluid on the sphere, "
        "in explicit steps of order 4. The others take midpoint steps."
    )
    targets = [
        Target(f"first answer with 10⁵ sites, {kind}", 5.0, next((r[3] for r in rows if r[0] == kind and
               0.9e5 < r[1] < 1.1e5), None), "seconds") for kind in SYSTEM_KINDS
    ]  # fmt: skip
    return Report("Time and memory by size", text, [Table(caption, columns, rows)], targets, skip_reasons)


def why_too_large(last_row: list | None) -> str:
    """Return the reason why a system ten times larger than the last row is not measured, or ""."""
    if last_row is None:
        return ""
    seconds, peak = last_row[-2:]
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    if 10.0 * seconds > MAX_STEP_SECONDS:
        return f"a step would take more than {MAX_STEP_SECONDS:g} s"
    if peak is not None and 10.0 * (peak - PACKAGES_BYTES) > MAX_MEMORY_FRACTION * memory:
        return f"more than {MAX_MEMORY_FRACTION * memory / 1e9:.0f} GB would be needed"
    return ""


PACKAGES_BYTES = 0.5e9
"""Memory of a process that has compiled something small, in bytes."""


def child(kind: str, n: str) -> dict:
    """Measure one kind and size in the child process."""
    make, method, h = SYSTEM_KINDS[kind]
    times = [time.process_time()]
    system, x0 = make(int(n))

    def steps(count: int) -> lt.Solution:
        return lt.integrate(system, x0, (0.0, count * h), h, method, save_every=count)

    for _ in range(2):
        steps(SHORT_STEPS)
        times.append(time.process_time())
    first_seconds, short_seconds = np.diff(times)
    long_steps = SHORT_STEPS + 1
    while (
        seconds := _processor_seconds(functools.partial(steps, long_steps)) - short_seconds
    ) < MIN_TIMED_SECONDS and long_steps < MAX_STEPS:
        long_steps = min(MAX_STEPS, 2 * long_steps)
    seconds = min(
        seconds, _processor_seconds(functools.partial(steps, long_steps)) - short_seconds
    )  # Newton's method is compiled where needed
    engine = EngineWithFallback(*prepare_system_and_method(system, method), "auto", long_steps)
    engine.initial_run_state(jnp.asarray(x0))
    return {
        "sites": len(np.ravel(x0)) // {"a field": 2, "spins": 3}.get(kind, 1) + (kind == "su(N)"),
        "engine": engine.name,
        "first": first_seconds,
        "step": seconds / (long_steps - SHORT_STEPS),
        "peak": peak_resident_bytes() if PROCESS_STATUS_FILE.is_file() else None,
    }


def _processor_seconds(work: Callable) -> float:
    start = time.process_time()
    work()
    return time.process_time() - start
