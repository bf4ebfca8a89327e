"""A tumbling body, free or with a damped wheel, against simulators of satellites and robots."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

import liethermo as lt

from ..report import Report, Table, Target, build_available
from ..simulators import MotionRecord, TumblingBody, basilisk_run, library_run, mujoco_run, scipy_run
from ..timing import race

FREE_BODY = TumblingBody(np.array([3.0, 2.0, 1.0]))
"""The body without a wheel."""
DAMPED_BODY = TumblingBody(np.array([3.3, 2.0, 1.3]), wheel=0.3, damping=0.2)
"""The body with a damped wheel."""
N_TIMES = 100
"""Number of recorded times."""
EXACT_TOLERANCE = 1e-13
"""Tolerance of DOP853 for the exact motion."""

COLUMNS = {
    "": "text",
    "Setting": "text",
    "Time a step": "seconds",
    "Time of the run": "seconds",
    "Kinetic energy": "error",
    "With the heat": "error",
    "Size of L": "error",
    "Direction of L": "error",
    "Momentum in the body": "error",
}
"""Columns of the tables."""


def contestants(body: TumblingBody, t_end: float) -> dict[str, tuple[str, float | None, Callable[[], Callable]]]:
    """Return for each contestant the setting, its step (None if it chooses), and a function that builds its run."""
    gauss, midpoint = lt.MetriplecticGauss(3), lt.MetriplecticMidpoint()
    return {
        "this library, midpoint": ("step 0.01", 0.01, lambda: library_run(body, midpoint, 0.01, t_end, N_TIMES)),
        "this library, Gauss, order 6": ("step 0.1", 0.1, lambda: library_run(body, gauss, 0.1, t_end, N_TIMES)),
        "SciPy DOP853": ("tolerance 1e-10", None, lambda: scipy_run(body, 1e-10, t_end, N_TIMES)),
        "MuJoCo, RK4": ("step 0.01", 0.01, lambda: mujoco_run(body, "RK4", 0.01, t_end, N_TIMES)),
        "MuJoCo, implicit": ("step 0.01", 0.01, lambda: mujoco_run(body, "implicit", 0.01, t_end, N_TIMES)),
        "MuJoCo, Euler (its default)": ("step 0.01", 0.01, lambda: mujoco_run(body, "Euler", 0.01, t_end, N_TIMES)),
        "Basilisk, RK4 (its default)": ("step 0.01", 0.01, lambda: basilisk_run(body, 0.01, t_end, N_TIMES)),
    }


def run(is_quick: bool) -> Report:
    """Compare all programs on the free and on the damped body."""
    t_end, rounds = (10.0, 1) if is_quick else (1000.0, 3)
    tables: list[Table] = []
    skip_reasons: dict[str, str] = {}
    max_drift = 0.0
    captions = {
        f"The free body, I = (3, 2, 1), to t = {t_end:g} s.": FREE_BODY,
        f"With a wheel about the middle axis that rubs in its bearing, to t = {t_end:g} s.": DAMPED_BODY,
    }
    for caption, body in captions.items():
        settings = contestants(body, t_end)
        works, unavailable = build_available({name: build for name, (_, _, build) in settings.items()})
        skip_reasons |= unavailable
        exact = scipy_run(body, EXACT_TOLERANCE, t_end, N_TIMES)()
        rows: list[list[Any]] = []
        for name, outcome in race(works, rounds=rounds, max_seconds=8.0).items():
            (setting, step, _), record = settings[name], outcome.result
            steps = record.steps or round(t_end / (step or t_end))
            seconds = outcome.cpu_seconds if record.seconds is None else record.seconds
            errors = _record_errors(record, exact, exact.kinetic_energy if body.wheel else exact.kinetic_energy[:1])
            rows.append([name, setting, seconds / steps, seconds, *errors])
            if name.startswith("this library"):
                max_drift = max(max_drift, *(drift for drift in errors[1:4] if drift is not None))
        tables.append(Table(caption, COLUMNS, rows))
    text = (
        "A body that starts about its middle axis, and the same with a damped wheel inside, which brings it to the "
        "spin about the axis of greatest inertia. Nothing acts from outside: the angular momentum L in space is "
        "constant, in size and in direction, and so is the energy with the heat of the bearing. The table has the "
        "largest changes of these at 100 times, relative to their sizes. The columns of the kinetic energy and of the "
        f"momentum in the body are errors, against DOP853 at a tolerance of {EXACT_TOLERANCE:g}; the smallest of "
        "the momentum's "
        "are its own. MuJoCo and Basilisk do not follow the heat. Times are of the processor; every row has the "
        "attitude too."
    )
    targets = [Target("a tumbling body for 1000 s: momentum in space, energy with heat", 1e-12, max_drift, "error")]
    return Report("A tumbling body, beside MuJoCo and Basilisk", text, tables, targets, skip_reasons)


def _record_errors(record: MotionRecord, exact: MotionRecord, kinetic: np.ndarray) -> list[float | None]:
    """Return the errors of kinetic and total energy, of norm and direction of L, and of mu."""
    norm = np.linalg.norm(record.spatial_momentum, axis=1)
    direction = record.spatial_momentum / norm[:, None]
    total = record.total_energy
    return [
        float(np.abs(record.kinetic_energy - kinetic).max() / kinetic[0]),
        None if total is None else float(np.abs(total - total[0]).max() / abs(exact.kinetic_energy[0])),
        float(np.abs(norm - norm[0]).max() / norm[0]),
        float(np.linalg.norm(direction - direction[0], axis=1).max()),
        float(np.abs(record.momentum - exact.momentum).max() / norm[0]),
    ]
