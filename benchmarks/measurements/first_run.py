"""The first trajectory of a new process, and the first flow: import, trace, compile, run."""

from __future__ import annotations

import json
import tempfile
import time

from .. import child
from ..report import Report, Table, Target

BODY_CODE = "lt.models.rigid_body((10, 5, 1))"

FUNCTIONS_CODE = """lt.LiePoissonSystem(
    mf.so(3),
    energy=lambda mu: 0.5 * jnp.sum(mu**2 / jnp.array([10.0, 5.0, 1.0])) + 0.01 * mu[0] ** 4,
    entropy=lambda mu: 0.5 * jnp.sum(mu**2),
    dissipation=lt.KillingDissipation(rate=0.5),
)"""

RUN_SCRIPT = """
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

FLOW_SYSTEMS = {
    "so(3)": "lt.models.rigid_body(rate=0.5), jnp.array([0.1, 1.0, 0.1])",
    "S^2": "relaxing(mf.Sphere(2)), jnp.asarray(mf.Sphere(2).random(3))",
    "SPD(2)": "relaxing(mf.SPD(2)), jnp.asarray(mf.SPD(2).random(3))",
}
"""Systems, and states to start from."""

FLOW_QUERIES = {
    "value": ("end", 1.0),
    "jacfwd": ("jax.jacfwd(end)", 2.0),
    "grad": ("jax.grad(lambda x: jnp.sum(end(x) ** 3))", 2.5),
    "hessian": ("jax.hessian(lambda x: jnp.sum(end(x) ** 3))", 5.0),
}
"""What is asked of a flow, and the seconds that the first answer may take."""

LONG_RUN_QUERIES = ("value", "jacfwd")
"""What is asked of a long run too, whose programs are optimised."""

FLOW_SCRIPT = """
import json, time

import jax, jax.numpy as jnp
import liethermo as lt
import manifolds as mf
from benchmarks.measurements.manifolds import relaxing

began = time.process_time()
system, x = {system}
end = lambda x: lt.flow(system, x, (0.0, 0.1 * {steps}), 0.1).ravel()
asked = {asked}
jax.block_until_ready(asked(x))
first, calls = time.process_time() - began, []
for _ in range(20):
    began = time.perf_counter()
    jax.block_until_ready(asked(x))
    calls.append(time.perf_counter() - began)
print(json.dumps([first, min(calls)]))
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
    rounds, systems = (
        (1, {"rigid body": BODY_CODE}) if quick else (3, {"rigid body": BODY_CODE, "plain functions": FUNCTIONS_CODE})
    )
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
                    times = _script_times(RUN_SCRIPT.format(system=system, engine=engine), cache)
                    best[name] = min(best.get(name, times), times, key=lambda row: row[3])
        rows += [[f"{title}, {name}", *times] for name, times in best.items()]
        totals |= {(title, name): times[3] for name, times in best.items()}
    table = Table("1000 steps of size 0.1, the whole of it in a new process.", COLUMNS, rows)
    targets = []
    for name, bound in ("compiled engine, cold", 2.0), ("compiled engine, cached", 1.1):
        worst = max(total for (_, which), total in totals.items() if which == name)
        targets.append(Target(f"first trajectory in a new process, {name}", bound, worst, "seconds"))
    flows, found = _flow_table(quick)
    targets += found
    text = "From the start of the Python process to the end of its first trajectory; the slower system counts."
    return Report("First trajectory", text, [table, flows], targets)


def _flow_table(quick: bool) -> tuple[Table, list[Target]]:
    """What `lt.flow` and its derivatives take, each in a new process without a cache."""
    columns = {
        "": "text",
        "Steps": "count",
        "First answer": "seconds",
        "Target": "seconds",
        "A call afterwards": "seconds",
    }
    rows: list[list] = []
    for name, system in FLOW_SYSTEMS.items():
        for what, (asked, bound) in list(FLOW_QUERIES.items())[: 1 if quick else None]:
            for steps in (10, 1_000) if what in LONG_RUN_QUERIES and not quick else (10,):
                with tempfile.TemporaryDirectory() as cache:
                    script = FLOW_SCRIPT.format(system=system, asked=asked, steps=steps)
                    first, call = json.loads(child.run_python("-c", script, cache=cache))
                rows.append([f"{name}, {what}", steps, first, bound, call])
    caption = (
        "`lt.flow` by `MetriplecticGauss(1)`, outside of `jax.jit`, from the definition of the system to the first "
        "answer: time of the processor. The gradient and the Hessian are those of the sum of cubes of the end."
    )
    found = []
    for what, (_, bound) in FLOW_QUERIES.items():
        slowest = max((row for row in rows if row[0].endswith(what)), key=lambda row: row[2], default=None)
        if slowest is not None:
            found.append(
                Target(
                    f"first {what} of a flow, the slowest ({slowest[0].split(',')[0]})", bound, slowest[2], "seconds"
                )
            )
    return Table(caption, columns, rows), found


def _script_times(script: str, cache: str) -> list:
    """Seconds from the start to the import, on to the system, on to the end, and altogether; and the audit."""
    start = time.monotonic()  # one clock for all processes
    imported, built, done, passed = json.loads(child.run_python("-c", script, cache=cache))
    return [imported - start, built - imported, done - built, done - start, "passed" if passed else "failed"]
