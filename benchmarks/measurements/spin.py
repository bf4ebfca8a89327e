"""A spin on S^2 with a bath, on its manifold: the time of a step."""

from __future__ import annotations

import functools
from collections.abc import Callable

import jax.numpy as jnp
import numpy as np

import liethermo as lt
import manifolds as mf

from ..contest import Engine, contest, of_one_scheme
from ..native import Body
from ..report import Report, Target, ratio, take_part

AXIS, FIELD = 1.5, (0.6, 0.0, 0.2)
X0, STEP = (np.sin(1.45), 0.0, np.cos(1.45), 0.0), 0.1

RELAXATION = 2.0
"""Rate times duration: the spin is on its way to the end of the run."""

C, COMPILED = "C", "compiled engine"


def run(quick: bool) -> Report:
    """Time a step of the midpoint scheme with exp~ in one thread."""
    steps, rounds = (2000, 1) if quick else (100_000, 5)
    rate = RELAXATION / (STEP * steps)
    works, skipped = take_part(
        {
            C: lambda: functools.partial(program(rate).integrate, X0, STEP, steps),
            COMPILED: lambda: by_library(rate, steps, steps, "compiled"),
            "array engine": lambda: by_library(rate, steps, steps, "array"),
        }
    )
    caption = f"{steps:,} steps of size {STEP}, relaxing all the way (rate {rate:g}); one state kept."
    table, times = contest(caption, works, steps, rounds, C)
    text = (
        "A spin with an easy axis in a tilted field, which heats a bath as it comes to rest: a system on S^2 x R, "
        "given to the library as functions of the state and its space. The scheme is the paper's, with the midpoint "
        "map exp~. *C* is written for this sphere: it needs the energy's derivative along a geodesic where the "
        "library, which knows of no sphere in its step, takes the gradient of the energy in a chart."
    )
    if C in works:
        text += f" Over 300 steps the trajectories differ by {difference():.0e}."
    target = Target("a spin on its sphere, same scheme, against C", 1.5, ratio(times[COMPILED], times.get(C)))
    return Report("A spin on its sphere", text, [table], [target], skipped)


def system(rate: float) -> lt.MetriplecticSystem:
    field = jnp.array(FIELD)

    def energy(x):
        return -AXIS * (x[2] ** 2 / 2 + x[2] ** 4 / 4) - x[:3] @ field + jnp.exp(x[3])

    return lt.MetriplecticSystem(
        poisson=mf.LiePoisson(mf.direct_sum(mf.so(3), mf.abelian(1))),
        energy=energy,
        entropy=lambda x: x[3],
        dissipation=lt.ProjectedMetric(rate=rate),
        space=mf.Sphere(2) * mf.Euclidean(1),
    )


def program(rate: float) -> Body:
    return Body("spin.c", [AXIS, *FIELD, rate])


def by_library(rate: float, steps: int, every: int, engine: Engine) -> Callable[[], lt.Solution]:
    span, midpoint = (0.0, STEP * steps), lt.MetriplecticMidpoint(retraction="midpoint")
    return functools.partial(lt.integrate, system(rate), X0, span, STEP, midpoint, save_every=every, engine=engine)


def difference(rate: float = 0.03) -> float:
    """Largest difference between the trajectories of C, at some rate, and of the library at 0.03, over 300 steps.

    Raises
    ------
    RuntimeError
        As :func:`..contest.of_one_scheme`.
    """
    ours, (theirs, _) = by_library(0.03, 300, 1, "compiled")().x[1:], program(rate).integrate(X0, STEP, 300, 1)
    return of_one_scheme(float(np.abs(ours - theirs).max()), 300)
