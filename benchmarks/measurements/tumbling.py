"""A tumbling body, free or with a damped wheel, beside the programs that others use for it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

import liethermo as lt

from ..report import Report, Table, Target, take_part
from ..simulators import Body, Record, basilisk, library, mujoco, scipy
from ..timing import race

FREE = Body(np.array([3.0, 2.0, 1.0]))
DAMPED = Body(np.array([3.3, 2.0, 1.3]), wheel=0.3, damping=0.2)
TIMES, EXACT = 100, 1e-13

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


def contestants(body: Body, t_end: float) -> dict[str, tuple[str, float | None, Callable[[], Callable]]]:
    """For each the setting, its step (None where it chooses), and what builds its work."""
    gauss, midpoint = lt.MetriplecticGauss(3), lt.MetriplecticMidpoint()
    return {
        "this library, midpoint": ("step 0.01", 0.01, lambda: library(body, midpoint, 0.01, t_end, TIMES)),
        "this library, Gauss, order 6": ("step 0.1", 0.1, lambda: library(body, gauss, 0.1, t_end, TIMES)),
        "SciPy DOP853": ("tolerance 1e-10", None, lambda: scipy(body, 1e-10, t_end, TIMES)),
        "MuJoCo, RK4": ("step 0.01", 0.01, lambda: mujoco(body, "RK4", 0.01, t_end, TIMES)),
        "MuJoCo, implicit": ("step 0.01", 0.01, lambda: mujoco(body, "implicit", 0.01, t_end, TIMES)),
        "MuJoCo, Euler (its default)": ("step 0.01", 0.01, lambda: mujoco(body, "Euler", 0.01, t_end, TIMES)),
        "Basilisk, RK4 (its default)": ("step 0.01", 0.01, lambda: basilisk(body, 0.01, t_end, TIMES)),
    }


def run(quick: bool) -> Report:
    """One table for the free body, one for the damped."""
    t_end, rounds = (10.0, 1) if quick else (1000.0, 3)
    tables: list[Table] = []
    skipped: dict[str, str] = {}
    worst = 0.0
    captions = {
        f"The free body, I = (3, 2, 1), to t = {t_end:g} s.": FREE,
        f"With a wheel about the middle axis that rubs in its bearing, to t = {t_end:g} s.": DAMPED,
    }
    for caption, body in captions.items():
        settings = contestants(body, t_end)
        works, missing = take_part({name: build for name, (_, _, build) in settings.items()})
        skipped |= missing
        exact = scipy(body, EXACT, t_end, TIMES)()
        rows: list[list[Any]] = []
        for name, outcome in race(works, rounds=rounds, patience=8.0).items():
            (setting, step, _), record = settings[name], outcome.result
            steps = record.steps or round(t_end / (step or t_end))
            seconds = outcome.processor if record.seconds is None else record.seconds
            found = _drifts(record, exact, exact.kinetic if body.wheel else exact.kinetic[:1])
            rows.append([name, setting, seconds / steps, seconds, *found])
            if name.startswith("this library"):
                worst = max(worst, *(drift for drift in found[1:4] if drift is not None))
        tables.append(Table(caption, COLUMNS, rows))
    text = (
        "A body that starts about its middle axis, and the same with a damped wheel inside, which brings it to the "
        "spin about the axis of greatest inertia. Nothing acts from outside: the angular momentum L in space is "
        "constant, in size and in direction, and so is the energy with the heat of the bearing. The table has the "
        "largest changes of these at 100 times, relative to their sizes. The columns of the kinetic energy and of the "
        f"momentum in the body are errors, against DOP853 at a tolerance of {EXACT:g}; the smallest of the momentum's "
        "are its own. MuJoCo and Basilisk do not follow the heat. Times are of the processor; every row has the "
        "attitude too."
    )
    targets = [Target("a tumbling body for 1000 s: momentum in space, energy with heat", 1e-12, worst, "error")]
    return Report("A tumbling body, beside MuJoCo and Basilisk", text, tables, targets, skipped)


def _drifts(record: Record, exact: Record, kinetic: np.ndarray) -> list[float | None]:
    """Error of the kinetic energy, drift of the total one, of the size of L and of its direction, error of mu."""
    size = np.linalg.norm(record.in_space, axis=1)
    direction = record.in_space / size[:, None]
    total = record.total
    return [
        float(np.abs(record.kinetic - kinetic).max() / kinetic[0]),
        None if total is None else float(np.abs(total - total[0]).max() / abs(exact.kinetic[0])),
        float(np.abs(size - size[0]).max() / size[0]),
        float(np.linalg.norm(direction - direction[0], axis=1).max()),
        float(np.abs(record.momentum - exact.momentum).max() / size[0]),
    ]
