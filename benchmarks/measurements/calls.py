"""Time of a call for a short run: prepared by ``Propagator``, and by ``integrate``."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

import liethermo as lt

from ..report import Report, Table, Target
from ..timing import race

SPAN = (0.0, 1.0)
"""Time span of a run."""

STEP_SIZE = 0.5
"""Size of a step: a run takes two."""

CALLS_PER_TIMING = 200
"""Number of calls that are timed together."""

MAX_SECONDS = {
    "`Propagator.final`": 15e-6,
    "`Propagator`, a `Solution`": 60e-6,
    "`integrate`": 150e-6,
}
"""Largest processor time in seconds of each call."""


def run(is_quick: bool) -> Report:
    """Time calls for two steps of a body with friction, with two stages of Gauss and with a Runge-Kutta method."""
    rounds, rows, targets = 1 if is_quick else 5, [], []
    body, x0 = lt.models.rigid_body((3.0, 2.0, 1.0), rate=0.2), np.array([0.1, 0.2, 1.0])
    for method in (lt.MetriplecticGauss(2), lt.MetriplecticRungeKutta(8)):
        times = race({name: _repeat(call) for name, call in _calls(body, x0, method).items()}, rounds=rounds)
        for name, timed in times.items():
            seconds = timed.cpu_seconds / CALLS_PER_TIMING
            rows.append([str(method), name, seconds])
            if name in MAX_SECONDS and method == lt.MetriplecticGauss(2):
                targets.append(Target(f"{name}, two steps of {method}", MAX_SECONDS[name], seconds, "seconds"))
    caption = "A call for two steps of one body, prepared or not. Times are of the processor."
    columns = {"Method": "text", "Call": "text", "Time": "seconds"}
    text = (
        "Optimisers, samplers and control loops integrate many short runs, one after another. The first call of each "
        "kind compiles, and is not counted. Parameters that are given in a call have new values in every call."
    )
    return Report("Calls for short runs", text, [Table(caption, columns, rows)], targets)


def _calls(body: lt.System, x0: np.ndarray, method: lt.OneStepMethod) -> dict[str, Callable[[], object]]:
    propagator = lt.Propagator(body, method, STEP_SIZE)
    rates = iter(np.linspace(0.1, 0.3, 1_000_003))
    return {
        "`Propagator.final`": lambda: propagator.final(x0, SPAN),
        "`Propagator.final` with parameters": lambda: propagator.final(
            x0, SPAN, parameters={"dissipation.rate": next(rates)}
        ),
        "`Propagator`, a `Solution`": lambda: propagator(x0, SPAN),
        "`integrate`": lambda: lt.integrate(body, x0, SPAN, STEP_SIZE, method, progress=False),
    }


def _repeat(call: Callable[[], object]) -> Callable[[], None]:
    def repeat() -> None:
        for _ in range(CALLS_PER_TIMING):
            call()

    return repeat
