"""Time and memory by size: fields, spins, graphs and matrices from ten sites to ten million, by the engine "auto"."""

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
from liethermo.engines.choice import EngineWithFallback
from liethermo.runs.preparation import prepare_run

from .. import child as process
from ..report import Report, Table, Target
from .lattice import random_spins
from .memory import PROCESS_STATUS_FILE, peak_resident_bytes

SIZES = tuple(10**i for i in range(1, 8))
SHORT_STEPS, MIN_TIMED_SECONDS, MAX_STEPS = 2, 1.0, 200_000
"""Steps of a short run; seconds, and steps at most, that the long one takes longer."""

MAX_STEP_SECONDS, MAX_MEMORY_FRACTION = 20.0, 0.7
"""Seconds that a step may take, and the share of the memory that a process may: else a size is left out."""

MIDPOINT, EXPLICIT = lt.MetriplecticMidpoint(), lt.MetriplecticRungeKutta(4)


def wave_field(n: int) -> tuple[lt.System, Any]:
    """A wave equation with a cubic force: a plain function of all positions and momenta."""

    def energy(x):
        q, p = x[:n], x[n:]
        return 0.5 * jnp.sum(p**2) + 0.5 * jnp.sum((q - jnp.roll(q, 1)) ** 2) + 0.25 * jnp.sum(q**4)

    random = np.random.default_rng(0).standard_normal(2 * n)
    return lt.MetriplecticSystem(mf.Canonical(n), energy, validate=False), random


def spin_ring(n: int) -> tuple[lt.System, Any]:
    """A ring of spins that heat a bath."""
    return lt.models.spin_lattice(n, 1.0, 0.1, rate=0.1), random_spins(n)


def heat_graph(n: int) -> tuple[lt.System, Any]:
    """Heat on a square grid of bodies, nearly n of them."""
    edge = round(math.sqrt(n))
    temperatures = np.random.default_rng(0).uniform(0.8, 1.2, edge**2)
    return lt.models.heat_grid((edge, edge)), np.log(temperatures)


def sphere_fluid(n: int) -> tuple[lt.System, Any]:
    """A fluid on the sphere, its matrix of nearly n entries."""
    N = round(math.sqrt(n))
    sphere = lt.models.QuantisedSphere(N)
    return lt.models.zeitlin(N, "enstrophy", 1e-3), sphere.random(0, (1, min(N - 1, 12)), 1.0)


SYSTEM_KINDS: dict[str, tuple[Callable, lt.OneStepMethod, float]] = {
    "a field": (wave_field, MIDPOINT, 0.05),
    "spins": (spin_ring, MIDPOINT, 0.02),
    "a graph": (heat_graph, MIDPOINT, 0.1),
    "su(N)": (sphere_fluid, EXPLICIT, 1e-3),
}
"""What makes a system and a state of so many sites, the method and the step."""


def run(quick: bool) -> Report:
    """One table, each row in a process of its own."""
    rows: list[list] = []
    skipped: dict[str, str] = {}
    for kind in SYSTEM_KINDS:
        for n in SIZES[:2] if quick else SIZES:
            if reason := why_too_large(rows[-1] if rows and rows[-1][0] == kind else None):
                skipped[f"{kind}, {n:,} sites"] = reason
                break
            found = process.run_child("scaling", kind, str(n))
            row = [kind, found["sites"], found["engine"], found["first"], found["step"] / found["sites"]]
            rows.append([*row, found["step"], found["peak"]])
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
    return Report("Time and memory by size", text, [Table(caption, columns, rows)], targets, skipped)


def why_too_large(last: list | None) -> str:
    """Why a system of ten times the size of the last row is not tried; empty where it is."""
    if last is None:
        return ""
    seconds, peak = last[-2:]
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    if 10.0 * seconds > MAX_STEP_SECONDS:
        return f"a step would take more than {MAX_STEP_SECONDS:g} s"
    if peak is not None and 10.0 * (peak - PACKAGES_BYTES) > MAX_MEMORY_FRACTION * memory:
        return f"more than {MAX_MEMORY_FRACTION * memory / 1e9:.0f} GB would be needed"
    return ""


PACKAGES_BYTES = 0.5e9
"""Memory of a process that has compiled something small."""


def child(kind: str, n: str) -> dict:
    """The part that runs in a process of its own."""
    make, method, h = SYSTEM_KINDS[kind]
    times = [time.process_time()]
    system, x0 = make(int(n))

    def steps(count: int) -> lt.Solution:
        return lt.integrate(system, x0, (0.0, count * h), h, method, save_every=count)

    for _ in range(2):
        steps(SHORT_STEPS)
        times.append(time.process_time())
    first, short = np.diff(times)
    many = SHORT_STEPS + 1
    while (
        seconds := _processor_seconds(functools.partial(steps, many)) - short
    ) < MIN_TIMED_SECONDS and many < MAX_STEPS:
        many = min(MAX_STEPS, 2 * many)
    seconds = min(
        seconds, _processor_seconds(functools.partial(steps, many)) - short
    )  # Newton's method is compiled where needed
    chosen = EngineWithFallback(*prepare_run(system, method), "auto", many)
    chosen.initial_run_state(jnp.asarray(x0))
    return {
        "sites": len(np.ravel(x0)) // {"a field": 2, "spins": 3}.get(kind, 1) + (kind == "su(N)"),
        "engine": chosen.name,
        "first": first,
        "step": seconds / (many - SHORT_STEPS),
        "peak": peak_resident_bytes() if PROCESS_STATUS_FILE.is_file() else None,
    }


def _processor_seconds(work: Callable) -> float:
    begun = time.process_time()
    work()
    return time.process_time() - begun
