"""A spin on S^2 with a bath, on its manifold: the time of a step with and without charts, and heyoka."""

from __future__ import annotations

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

import liethermo as lt
import manifolds as mf

from .. import peers
from ..contest import Engine, race_runs_of_one_trajectory, require_same_scheme
from ..ensembles import TOLERANCES
from ..native import BodyProgram
from ..report import Report, Table, Target, UnavailableError, build_available, ratio
from ..timing import race

ANISOTROPY = 1.5
"""Anisotropy constant."""
FIELD = (0.6, 0.0, 0.2)
"""External field."""
X0 = (np.sin(1.45), 0.0, np.cos(1.45), 0.0)
"""Initial spin and entropy."""
STEP = 0.1
"""Step size."""

RATE_TIMES_DURATION = 2.0
"""Rate times duration; the spin still moves at the end of the run."""

C_ROW = "C"
"""Row of the C program."""
COMPILED_ROW = "compiled engine"
"""Row of the compiled engine."""

T_END = 500.0
"""Duration of the comparison with heyoka."""

SLOW_RATE = 1e-3
"""Rate of the comparison with heyoka, at which the spin still moves at the end."""

TARGET_ERROR = 1e-8
"""Maximum final error of the comparison with heyoka."""

EXACT_TOLERANCE = 1e-18
"""heyoka's tolerance for the exact state."""

RETRACTIONS = {"without charts": None, "in charts": "midpoint"}
"""Retractions of the midpoint scheme."""

C_SOURCES = {"without charts": "spin_around.c", "in charts": "spin.c"}
"""C sources of both schemes."""


def run(is_quick: bool) -> Report:
    """Time a step of the midpoint scheme in one thread, and runs of high order against heyoka."""
    steps, rounds = (2000, 1) if is_quick else (100_000, 5)
    rate, tables, text = RATE_TIMES_DURATION / (STEP * steps), [], [INTRODUCTION]
    ratios: dict[str, float | None] = {}
    skip_reasons: dict[str, str] = {}
    for way in RETRACTIONS:
        runs = functools.partial(_c_run, rate, steps, way), functools.partial(_compiled_run, rate, steps, way)
        works, unavailable = build_available(dict(zip((C_ROW, COMPILED_ROW), runs, strict=True)))
        skip_reasons |= unavailable
        caption = f"{steps:,} steps of size {STEP} {way}, relaxing all the way (rate {rate:g}); one state kept."
        table, times = race_runs_of_one_trajectory(caption, works, steps, rounds, C_ROW)
        tables.append(table)
        ratios[way] = ratio(times[COMPILED_ROW], times.get(C_ROW))
        if C_ROW in works:
            text.append(
                f"Over 300 steps {way} the trajectories of both differ by {max_difference_from_c(way=way):.0e}."
            )
    try:
        table, heyoka_ratio = _race_heyoka(rounds)
        tables.append(table)
    except UnavailableError as reason:
        heyoka_ratio, skip_reasons["heyoka"] = None, str(reason)
    targets = [
        Target("a spin on its sphere, same scheme without charts, against C", 1.5, ratios["without charts"]),
        Target(f"a spin on its sphere with an error of {TARGET_ERROR:g}, against heyoka", 1.0, heyoka_ratio),
    ]
    return Report("A spin on its sphere", " ".join(text), tables, targets, skip_reasons)


INTRODUCTION = """\
A spin with an easy axis in a tilted field, which heats a bath as it comes to rest: a system on S^2 x R, given to the \
library as functions of the state and its space. Without charts the midpoint scheme runs in the space around the \
sphere. In charts it is the paper's, with the midpoint map exp~: there *C* is written for this sphere, and needs the \
energy's derivative along a geodesic, where the library takes the gradient of the energy in a chart."""
"""Beginning of the report."""


def _c_run(rate: float, steps: int, way: str) -> Callable:
    return functools.partial(c_program(rate, way).integrate, X0, STEP, steps)


def _compiled_run(rate: float, steps: int, way: str) -> Callable:
    return library_run(rate, steps, steps, "compiled", way)


def _race_heyoka(rounds: int) -> tuple[Table, float]:
    """Race runs of equal error: each method with the fewest steps, heyoka with the loosest tolerance."""
    slow_system = spin_system(SLOW_RATE)
    equations = peers.equations_for_heyoka(functools.partial(spin_field, SLOW_RATE), len(X0))
    build = functools.partial(peers.heyoka_equations_run, equations, x0=X0, t_end=T_END)
    exact = build(EXACT_TOLERANCE).solve_end()

    def end_error(end) -> float:
        return float(np.abs(np.asarray(end) - exact).max())

    def ours(method: lt.OneStepMethod, steps: int) -> Callable[[], np.ndarray]:
        span, step = (0.0, T_END), T_END / steps
        return lambda: lt.integrate(
            slow_system, X0, span, step, method, save_every=steps, engine="compiled", on_failure="return"
        ).x[-1]

    tolerance = next(t for t in TOLERANCES if end_error(build(t).solve_end()) <= TARGET_ERROR)
    works, settings = {"heyoka": build(tolerance).solve_end}, {"heyoka": f"tolerance {tolerance:.1e}"}
    for title, method in RACED_METHODS.items():
        steps = next(
            n for n in (int(MIN_STEPS * 1.1**i) for i in range(40)) if end_error(ours(method, n)()) <= TARGET_ERROR
        )
        works[title], settings[title] = ours(method, steps), f"{steps} steps"
    outcomes = race({title: _repeat(work) for title, work in works.items()}, rounds=rounds)
    times = {title: outcome.cpu_seconds / RUNS_PER_TIMING for title, outcome in outcomes.items()}
    rows = [[title, settings[title], end_error(works[title]()), times[title]] for title in [*RACED_METHODS, "heyoka"]]
    columns = {"": "text", "Setting": "text", "Error": "error", "Time": "seconds"}
    return Table(f"A run to t = {T_END:g}, from its call to its last state.", columns, rows), (
        min(times[title] for title in RACED_METHODS) / times["heyoka"]
    )


RACED_METHODS = {"RK8": lt.MetriplecticRungeKutta(8), "Taylor(12)": lt.MetriplecticTaylor(12)}
"""Methods that are compared with heyoka."""

MIN_STEPS = 1000
"""Number of steps that is tried first; with fewer, a run fails."""

RUNS_PER_TIMING = 20
"""Number of runs that are timed together, since one takes a few milliseconds."""


def _repeat(work: Callable) -> Callable:
    def run_repeatedly():
        for _ in range(RUNS_PER_TIMING):
            work()

    return run_repeatedly


def spin_energy(x):
    return -ANISOTROPY * (x[2] ** 2 / 2 + x[2] ** 4 / 4) - x[:3] @ jnp.array(FIELD) + jnp.exp(x[3])


def spin_field(rate: float, x) -> jax.Array:
    """Return the velocity of spin and entropy near the sphere, as other solvers get it."""
    spin, slope = x[:3], jax.grad(spin_energy)(x)
    tangential_slope = (spin @ spin) * slope[:3] - (spin @ slope[:3]) * spin
    return jnp.append(
        jnp.cross(spin, slope[:3]) - rate * slope[3] * tangential_slope, rate * (slope[:3] @ tangential_slope)
    )


def spin_system(rate: float) -> lt.MetriplecticSystem:
    return lt.MetriplecticSystem(
        poisson=mf.LiePoisson(mf.direct_sum(mf.so(3), mf.abelian(1))),
        energy=spin_energy,
        entropy=lambda x: x[3],
        dissipation=lt.ProjectedMetric(rate=rate),
        space=mf.Sphere(2) * mf.Euclidean(1),
    )


def c_program(rate: float, way: str) -> BodyProgram:
    return BodyProgram(C_SOURCES[way], [ANISOTROPY, *FIELD, rate])


def library_run(rate: float, steps: int, save_every: int, engine: Engine, way: str) -> Callable[[], lt.Solution]:
    span, midpoint = (0.0, STEP * steps), lt.MetriplecticMidpoint(retraction=RETRACTIONS[way])
    return functools.partial(
        lt.integrate, spin_system(rate), X0, span, STEP, midpoint, save_every=save_every, engine=engine
    )


def max_difference_from_c(way: str, rate: float = 0.03) -> float:
    """Return the largest difference over 300 steps between C, at ``rate``, and the library at rate 0.03.

    Raises
    ------
    RuntimeError
        As for :func:`..contest.require_same_scheme`.
    """
    library_states, (c_states, _) = (
        library_run(0.03, 300, 1, "compiled", way)().x[1:],
        c_program(rate, way).integrate(X0, STEP, 300, 1),
    )
    return require_same_scheme(float(np.abs(library_states - c_states).max()), 300)
