"""A spin on S^2 with a bath, on its manifold: the time of a step without charts and with them; heyoka."""

from __future__ import annotations

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

import liethermo as lt
import manifolds as mf

from .. import peers
from ..contest import Engine, contest, of_one_scheme
from ..ensembles import TOLERANCES
from ..native import Body
from ..report import Report, Table, Target, UnavailableError, ratio, take_part
from ..timing import race

AXIS, FIELD = 1.5, (0.6, 0.0, 0.2)
X0, STEP = (np.sin(1.45), 0.0, np.cos(1.45), 0.0), 0.1

RELAXATION = 2.0
"""Rate times duration: the spin is on its way to the end of the run."""

C, COMPILED = "C", "compiled engine"

T_END, SLOWLY, WANTED, EXACT = 500.0, 1e-3, 1e-8, 1e-18
"""Of the race with heyoka: the time, the rate, with which the spin still moves then, the error at the end, and heyoka's
tolerance for what counts as exact."""

METHODS = {"without charts": None, "in charts": "midpoint"}
"""The retraction of the midpoint scheme."""

PROGRAMS = {"without charts": "spin_around.c", "in charts": "spin.c"}


def run(quick: bool) -> Report:
    """Time a step of the midpoint scheme in one thread, and runs of high order beside heyoka's."""
    steps, rounds = (2000, 1) if quick else (100_000, 5)
    rate, tables, text = RELAXATION / (STEP * steps), [], [INTRODUCTION]
    ratios: dict[str, float | None] = {}
    skipped: dict[str, str] = {}
    for way in METHODS:
        runs = functools.partial(_by_c, rate, steps, way), functools.partial(_compiled, rate, steps, way)
        works, missing = take_part(dict(zip((C, COMPILED), runs, strict=True)))
        skipped |= missing
        caption = f"{steps:,} steps of size {STEP} {way}, relaxing all the way (rate {rate:g}); one state kept."
        table, times = contest(caption, works, steps, rounds, C)
        tables.append(table)
        ratios[way] = ratio(times[COMPILED], times.get(C))
        if C in works:
            text.append(f"Over 300 steps {way} the trajectories of both differ by {difference(way=way):.0e}.")
    try:
        table, against = _beside_heyoka(rounds)
        tables.append(table)
    except UnavailableError as reason:
        against, skipped["heyoka"] = None, str(reason)
    targets = [
        Target("a spin on its sphere, same scheme without charts, against C", 1.5, ratios["without charts"]),
        Target(f"a spin on its sphere with an error of {WANTED:g}, against heyoka", 1.0, against),
    ]
    return Report("A spin on its sphere", " ".join(text), tables, targets, skipped)


INTRODUCTION = """\
A spin with an easy axis in a tilted field, which heats a bath as it comes to rest: a system on S^2 x R, given to the \
library as functions of the state and its space. Without charts the midpoint scheme runs in the space around the \
sphere. In charts it is the paper's, with the midpoint map exp~: there *C* is written for this sphere, and needs the \
energy's derivative along a geodesic, where the library takes the gradient of the energy in a chart."""


def _by_c(rate: float, steps: int, way: str) -> Callable:
    return functools.partial(program(rate, way).integrate, X0, STEP, steps)


def _compiled(rate: float, steps: int, way: str) -> Callable:
    return by_library(rate, steps, steps, "compiled", way)


def _beside_heyoka(rounds: int) -> tuple[Table, float]:
    """Runs to one time with the wanted error: the fewest steps of each method, heyoka's loosest tolerance."""
    relaxing = system(SLOWLY)
    equations = peers.heyoka_equations(functools.partial(field, SLOWLY), len(X0))
    build = functools.partial(peers.heyoka_of, equations, x0=X0, t_end=T_END)
    exact = build(EXACT).end()

    def missed(end) -> float:
        return float(np.abs(np.asarray(end) - exact).max())

    def ours(method: lt.OneStepMethod, steps: int) -> Callable[[], np.ndarray]:
        span, step = (0.0, T_END), T_END / steps
        return lambda: lt.integrate(
            relaxing, X0, span, step, method, save_every=steps, engine="compiled", on_failure="return"
        ).x[-1]

    tolerance = next(t for t in TOLERANCES if missed(build(t).end()) <= WANTED)
    works, settings = {"heyoka": build(tolerance).end}, {"heyoka": f"tolerance {tolerance:.1e}"}
    for title, method in RACED.items():
        steps = next(n for n in (int(FEWEST * 1.1**i) for i in range(40)) if missed(ours(method, n)()) <= WANTED)
        works[title], settings[title] = ours(method, steps), f"{steps} steps"
    raced = race({title: _repeated(work) for title, work in works.items()}, rounds=rounds)
    times = {title: outcome.processor / REPEATED for title, outcome in raced.items()}
    rows = [[title, settings[title], missed(works[title]()), times[title]] for title in [*RACED, "heyoka"]]
    columns = {"": "text", "Setting": "text", "Error": "error", "Time": "seconds"}
    return Table(f"A run to t = {T_END:g}, from its call to its last state.", columns, rows), (
        min(times[title] for title in RACED) / times["heyoka"]
    )


RACED = {"RK8": lt.MetriplecticRungeKutta(8), "Taylor(12)": lt.MetriplecticTaylor(12)}

FEWEST = 1000
"""Steps that are tried first; those that are longer end a run."""

REPEATED = 20
"""Runs that are timed together: one takes a few milliseconds."""


def _repeated(work: Callable) -> Callable:
    def many():
        for _ in range(REPEATED):
            work()

    return many


def energy(x):
    return -AXIS * (x[2] ** 2 / 2 + x[2] ** 4 / 4) - x[:3] @ jnp.array(FIELD) + jnp.exp(x[3])


def field(rate: float, x) -> jax.Array:
    """The velocity of spin and entropy near the sphere, as other solvers are given it."""
    spin, slope = x[:3], jax.grad(energy)(x)
    raised = (spin @ spin) * slope[:3] - (spin @ slope[:3]) * spin
    return jnp.append(jnp.cross(spin, slope[:3]) - rate * slope[3] * raised, rate * (slope[:3] @ raised))


def system(rate: float) -> lt.MetriplecticSystem:
    return lt.MetriplecticSystem(
        poisson=mf.LiePoisson(mf.direct_sum(mf.so(3), mf.abelian(1))),
        energy=energy,
        entropy=lambda x: x[3],
        dissipation=lt.ProjectedMetric(rate=rate),
        space=mf.Sphere(2) * mf.Euclidean(1),
    )


def program(rate: float, way: str) -> Body:
    return Body(PROGRAMS[way], [AXIS, *FIELD, rate])


def by_library(rate: float, steps: int, every: int, engine: Engine, way: str) -> Callable[[], lt.Solution]:
    span, midpoint = (0.0, STEP * steps), lt.MetriplecticMidpoint(retraction=METHODS[way])
    return functools.partial(lt.integrate, system(rate), X0, span, STEP, midpoint, save_every=every, engine=engine)


def difference(way: str, rate: float = 0.03) -> float:
    """Largest difference between the trajectories of C, at some rate, and of the library at 0.03, over 300 steps.

    Raises
    ------
    RuntimeError
        As :func:`..contest.of_one_scheme`.
    """
    ours, (theirs, _) = (
        by_library(0.03, 300, 1, "compiled", way)().x[1:],
        program(rate, way).integrate(X0, STEP, 300, 1),
    )
    return of_one_scheme(float(np.abs(ours - theirs).max()), 300)
