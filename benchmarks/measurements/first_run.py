"""The first trajectory of a new process: import, trace, compile, run."""

from __future__ import annotations

import json
import tempfile
import time

from .. import child
from ..report import Report, Table, Target

BODY = "lt.models.rigid_body((10, 5, 1))"

FUNCTIONS = """lt.LiePoissonSystem(
    mf.so(3),
    energy=lambda mu: 0.5 * jnp.sum(mu**2 / jnp.array([10.0, 5.0, 1.0])) + 0.01 * mu[0] ** 4,
    entropy=lambda mu: 0.5 * jnp.sum(mu**2),
    dissipation=lt.KillingDissipation(rate=0.5),
)"""

SCRIPT = """
import json, sys, time

import jax.numpy as jnp
import liethermo as lt
import manifolds as mf

imported = time.monotonic()
system = {system}
built = time.monotonic()
solution = lt.integrate(system, [0.001, 1.0, 0.001], (0.0, 100.0), 0.1, engine="{engine}")
print(json.dumps([imported, built, time.monotonic(), solution.audit().passed]))
"""

COLUMNS = {
    "": "text",
    "Start and import": "seconds",
    "System": "seconds",
    "`integrate`": "seconds",
    "Total": "seconds",
    "Audit": "text",
}


def run(quick: bool) -> Report:
    """Run a user's script in new processes, with an empty cache and with the one that it left."""
    rounds, systems = (1, {"rigid body": BODY}) if quick else (3, {"rigid body": BODY, "plain functions": FUNCTIONS})
    rows: list[list] = []
    totals: dict[tuple[str, str], float] = {}
    for title, system in systems.items():
        best: dict[str, list] = {}
        for _ in range(rounds):
            with tempfile.TemporaryDirectory() as cache:
                for name, engine in (
                    ("array engine", "array"),
                    ("compiled engine, cold", "compiled"),
                    ("compiled engine, cached", "compiled"),
                ):
                    times = _times(SCRIPT.format(system=system, engine=engine), cache)
                    best[name] = min(best.get(name, times), times, key=lambda row: row[3])
        rows += [[f"{title}, {name}", *times] for name, times in best.items()]
        totals |= {(title, name): times[3] for name, times in best.items()}
    table = Table("1000 steps of size 0.1, the whole of it in a new process.", COLUMNS, rows)
    targets = []
    for name, bound in ("compiled engine, cold", 2.0), ("compiled engine, cached", 1.1):
        worst = max(total for (_, which), total in totals.items() if which == name)
        targets.append(Target(f"first trajectory in a new process, {name}", bound, worst, "seconds"))
    text = "From the start of the Python process to the end of its first trajectory; the slower system counts."
    return Report("First trajectory", text, [table], targets)


def _times(script: str, cache: str) -> list:
    """Seconds from the start to the import, on to the system, on to the end, and altogether; and the audit."""
    start = time.monotonic()  # one clock for all processes
    imported, built, done, passed = json.loads(child.python("-c", script, cache=cache))
    return [imported - start, built - imported, done - built, done - start, "passed" if passed else "failed"]
