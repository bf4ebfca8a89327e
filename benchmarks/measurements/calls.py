"""Time of a call for a short run: prepared by ``Propagator``, and by ``integrate``."""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Callable

import numpy as np

import liethermo as lt

from ..peers import equations_for_heyoka, heyoka_equations_run
from ..report import Report, Table, Target, build_available
from ..timing import race

SPAN = (0.0, 1.0)
"""Time span of a run."""

STEP_SIZE = 0.5
"""Size of a step: a run takes two."""

INERTIA = (3.0, 2.0, 1.0)
"""Moments of inertia of the body."""

RATE = 0.2
"""Rate of its friction."""

BODY_SPAN = (0.0, 10.0)
"""Time span of a run beside heyoka."""

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
        times = race(
            {name: _repeat_call(call) for name, call in _plain_and_prepared_call(body, x0, method).items()},
            rounds=rounds,
        )
        for name, timed_result in times.items():
            seconds = timed_result.cpu_seconds / CALLS_PER_TIMING
            rows.append([str(method), name, seconds])
            if name in MAX_SECONDS and method == lt.MetriplecticGauss(2):
                targets.append(Target(f"{name}, two steps of {method}", MAX_SECONDS[name], seconds, "seconds"))
    caption = "A call for two steps of one body, prepared or not. Times are of the processor."
    columns = {"Method": "text", "Call": "text", "Time": "seconds"}
    text = (
        "Optimisers, samplers and control loops integrate many short runs, one after another. The first call of each "
        "kind compiles, and is not counted. Parameters that are given in a call have new values in every call."
    )
    heyoka_table, heyoka_targets = _heyoka_table(is_quick)
    return Report("Calls for short runs", text, [Table(caption, columns, rows), heyoka_table], targets + heyoka_targets)


def _heyoka_table(is_quick: bool) -> tuple[Table, list[Target]]:
    """Return the times of one body beside heyoka, both prepared, at equal errors, and the targets."""
    body, x0 = lt.models.rigid_body(INERTIA, rate=RATE), np.array([0.1, 0.2, 1.0])
    exact = lt.Propagator(body, lt.MetriplecticGauss(4), 1e-3).final(x0, BODY_SPAN)
    rows, targets = [], []
    for error in (1e-5,) if is_quick else (1e-5, 1e-9):
        works, skip_reasons = build_available({"heyoka": functools.partial(_heyoka_call, body, x0, exact, error)})
        ours = {
            str(method): functools.partial(propagator.final, x0, BODY_SPAN)
            for method in (lt.MetriplecticRungeKutta(8), lt.MetriplecticTaylor(12))
            if (propagator := _coarsest_propagator(body, method, x0, exact, error)) is not None
        }
        times = race(
            {name: _repeat_call(call) for name, call in {**works, **ours}.items()}, rounds=1 if is_quick else 5
        )
        seconds = {name: timed_result.cpu_seconds / CALLS_PER_TIMING for name, timed_result in times.items()}
        peer_seconds, min_seconds = seconds.get("heyoka"), min(seconds[name] for name in ours)
        rows += [
            [f"to {error:.0e}, {name}", value, None if peer_seconds is None else value / peer_seconds]
            for name, value in seconds.items()
        ]
        if peer_seconds is not None:
            ratio = min_seconds / peer_seconds
            targets.append(Target(f"a body to {error:.0e}, beside heyoka, both prepared", 1.0, ratio, "ratio"))
    caption = (
        f"One body to t = {BODY_SPAN[1]:g}, from a state to the last state, in the longest steps with at most this "
        f"error. {' '.join(skip_reasons.values())}"
    ).strip()
    return Table(caption, {"": "text", "Time": "seconds", "Beside heyoka": "ratio"}, rows), targets


def _heyoka_call(body: lt.System, x0: np.ndarray, exact: np.ndarray, error: float) -> Callable[[], np.ndarray]:
    """Return the call of heyoka, prepared, with the loosest tolerance whose error is small enough."""
    equations = equations_for_heyoka(body.vector_field, 3)
    for tolerance in 10.0 ** np.arange(-3.0, -16.0, -0.5):
        call = heyoka_equations_run(equations, tolerance, x0, BODY_SPAN[1]).solve_end
        if np.abs(call() - exact).max() <= error:
            return call
    raise RuntimeError(f"heyoka does not reach an error of {error}")


def _coarsest_propagator(body, method, x0, exact, error) -> lt.Propagator | None:
    """Return the propagator with the fewest steps whose error is small enough."""
    for n_steps in range(4, 100):
        propagator = lt.Propagator(body, method, BODY_SPAN[1] / n_steps)
        with contextlib.suppress(lt.LiethermoError):
            if np.abs(propagator.final(x0, BODY_SPAN) - exact).max() <= error:
                return propagator
    return None


def _plain_and_prepared_call(
    body: lt.System, x0: np.ndarray, method: lt.OneStepMethod
) -> dict[str, Callable[[], object]]:
    """Return calls for one short run by name: prepared by ``Propagator``, and by ``integrate``."""
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


def _repeat_call(call: Callable[[], object]) -> Callable[[], None]:
    def repeat() -> None:
        for _ in range(CALLS_PER_TIMING):
            call()

    return repeat
