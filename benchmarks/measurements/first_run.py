"""The first trajectory and the first flow of a new process: import, trace, compile, run."""

from __future__ import annotations

import json
import tempfile
import time

from .. import child
from ..report import Report, Table, Target

BODY_CODE = "lt.models.rigid_body((10, 5, 1))"
"""Code of the rigid body."""

FUNCTIONS_CODE = """lt.LiePoissonSystem(
    mf.so(3),
    energy=lambda mu: 0.5 * jnp.sum(mu**2 / jnp.array([10.0, 5.0, 1.0])) + 0.01 * mu[0] ** 4,
    entropy=lambda mu: 0.5 * jnp.sum(mu**2),
    dissipation=lt.KillingDissipation(rate=0.5),
)"""
"""Code of a system with plain functions."""

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
"""Script of a user's first trajectory."""

SECOND_PROCESS_SCRIPT = """
import time
import numpy as np, jax.numpy as jnp
import liethermo as lt
import manifolds as mf

{run}
print(time.monotonic())
"""
"""Script of a first trajectory whose programs another process may have left on disk."""

SECOND_PROCESS_RUNS = {
    "64 spins": """
spins = np.random.default_rng(0).standard_normal((4, 4, 4, 3))
spins /= np.linalg.norm(spins, axis=3, keepdims=True)
lt.integrate(lt.models.spin_lattice((4, 4, 4)), spins, (0.0, 1.0), 0.05, lt.MetriplecticRungeKutta(4))
""",
    "su(3)": """
g = mf.su(3)
sizes = jnp.arange(1.0, 9.0)
entropy = lambda m: jnp.log(1 + m @ m)
system = lt.LiePoissonSystem(g, lambda m: 0.5 * m @ (sizes * m), entropy, lt.KillingDissipation(0.3))
lt.integrate(system, np.linspace(0.1, 0.8, 8), (0.0, 1.0), 0.05, lt.MetriplecticGauss(2))
""",
    "S^2": """
from benchmarks.measurements.manifolds import relaxing
lt.integrate(relaxing(mf.Sphere(2)), mf.Sphere(2).random(3), (0.0, 1.0), 0.05, lt.MetriplecticGauss(2))
""",
    "oscillator of 20 levels": """
from benchmarks.measurements.quantum import thermal_system
system = thermal_system(20)
lt.integrate(system, system.state(np.eye(20) / 20), (0.0, 1.0), 0.05, lt.MetriplecticGauss(2))
""",
}
"""Runs by name, and their code."""

SPIN_COUNTS = (10, 1_000, 10_000, 100_000, 1_000_000)
"""Numbers of spins of the first answers of magnets."""

SPIN_METHODS = {
    "explicit 4": "lt.MetriplecticRungeKutta(4)",
    "midpoint": "lt.MetriplecticMidpoint()",
    "midpoint, noise": "lt.MetriplecticMidpoint(), noise=lt.Fluctuations(seed=1)",
}
"""Methods of the first answers of magnets, and their code."""

SPIN_CODE = """
count, mag = {count}, lt.magnetism
u = mag.units("meV")
ring, mu = mag.lattice("chain", count, constant=2.5), u.moment(2.2)
motion = u.gilbert(0.1, mu)
energy = [mag.exchange(ring, 10.0), mag.anisotropy(ring, 0.1), mag.zeeman(ring, (0.0, 0.0, 1.0), mu)]
bath = lt.HeatBaths(np.inf, u.thermal_energy(300.0))
system = lt.SpinSystem(ring, energy, lt.LandauLifshitz(motion.rate), bath, ratio=motion.ratio)
spins = np.random.default_rng(0).standard_normal((count, 3)) + np.array([0.0, 0.0, 2.0])
spins /= np.linalg.norm(spins, axis=1, keepdims=True)
lt.integrate(system, spins, (0.0, 0.005), 0.0005, {method}, save_every=10)
"""
"""Code of ten steps of a magnet in units of meV and ps."""

SPIN_SCRIPT = """
import time
import numpy as np
import liethermo as lt
{run}
print(time.process_time())
"""
"""Script of the first answer of a magnet, timed by the processor from the start of the process."""

MAX_FIRST_SPIN_SECONDS = (3.0, 1.5)
"""Maximum seconds of the first answer of a magnet, in a first and in a second process."""

MAX_SECOND_PROCESS_SECONDS = 2.0
"""Maximum seconds of a second process."""

FLOW_SYSTEMS = {
    "so(3)": "lt.models.rigid_body(rate=0.5), jnp.array([0.1, 1.0, 0.1])",
    "S^2": "relaxing(mf.Sphere(2)), jnp.asarray(mf.Sphere(2).random(3))",
    "SPD(2)": "relaxing(mf.SPD(2)), jnp.asarray(mf.SPD(2).random(3))",
}
"""Code of systems and initial states."""

FLOW_QUERIES = {
    "value": ("end", 1.0),
    "jacfwd": ("jax.jacfwd(end)", 2.0),
    "grad": ("jax.grad(lambda x: jnp.sum(end(x) ** 3))", 2.5),
    "hessian": ("jax.hessian(lambda x: jnp.sum(end(x) ** 3))", 5.0),
}
"""Functions of a flow, and the maximum seconds of their first result."""

LONG_RUN_QUERIES = ("value", "jacfwd")
"""Functions that are also computed for a long run, whose programs are optimised."""

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
"""Script of a user's first flow."""

COLUMNS = {
    "": "text",
    "Start and import": "seconds",
    "System": "seconds",
    "`integrate`": "seconds",
    "Total": "seconds",
    "Audit": "text",
}
"""Columns of the table of first trajectories."""


def run(is_quick: bool) -> Report:
    """Run a user's script in new processes, with an empty cache and then with the cache that it left."""
    rounds, systems = (
        (1, {"rigid body": BODY_CODE})
        if is_quick
        else (3, {"rigid body": BODY_CODE, "plain functions": FUNCTIONS_CODE})
    )
    rows: list[list] = []
    totals: dict[tuple[str, str], float] = {}
    for title, system in systems.items():
        best_times: dict[str, list] = {}
        for _ in range(rounds):
            with tempfile.TemporaryDirectory() as cache:
                for name, engine in (
                    ("array engine", "array"),
                    ("compiled engine, cold", "compiled"),
                    ("compiled engine, cached", "compiled"),
                ):
                    times = _script_times(RUN_SCRIPT.format(system=system, engine=engine), cache)
                    best_times[name] = min(best_times.get(name, times), times, key=lambda row: row[3])
        rows += [[f"{title}, {name}", *times] for name, times in best_times.items()]
        totals |= {(title, name): times[3] for name, times in best_times.items()}
    table = Table("1000 steps of size 0.1, the whole of it in a new process.", COLUMNS, rows)
    targets = []
    for name, max_seconds in ("compiled engine, cold", 2.0), ("compiled engine, cached", 1.1):
        slowest_total = max(total for (_, which), total in totals.items() if which == name)
        targets.append(Target(f"first trajectory in a new process, {name}", max_seconds, slowest_total, "seconds"))
    processes, process_targets = _second_process_table(is_quick)
    magnets, magnet_targets = _magnet_table(is_quick)
    flows, flow_targets = _flow_table(is_quick)
    targets += process_targets + magnet_targets + flow_targets
    text = "From the start of the Python process to the end of its first trajectory; the slower system counts."
    return Report("First trajectory", text, [table, processes, magnets, flows], targets)


def _second_process_table(is_quick: bool) -> tuple[Table, list[Target]]:
    """Return the times of a first and a second process with the same run and one cache, and the targets."""
    rows: list[list] = []
    for name, code in list(SECOND_PROCESS_RUNS.items())[: 1 if is_quick else None]:
        with tempfile.TemporaryDirectory() as cache:
            seconds = [_process_seconds(SECOND_PROCESS_SCRIPT.format(run=code), cache) for _ in range(4)]
        rows.append([name, seconds[0], min(seconds[1:])])
    caption = (
        "20 steps of size 0.05, the whole of it in a new process, first with an empty cache and then with its files."
    )
    targets = [
        Target(f"first trajectory of {name}, second process", MAX_SECOND_PROCESS_SECONDS, second, "seconds")
        for name, _, second in rows
    ]
    return Table(caption, {"": "text", "First process": "seconds", "Second process": "seconds"}, rows), targets


def _magnet_table(is_quick: bool) -> tuple[Table, list[Target]]:
    """Return the times of the first answers of magnets in a first and a second process, and the targets."""
    rows: list[list] = []
    for method, code in list(SPIN_METHODS.items())[: 1 if is_quick else None]:
        for count in SPIN_COUNTS[: 1 if is_quick else None]:
            script = SPIN_SCRIPT.format(run=SPIN_CODE.format(count=count, method=code))
            with tempfile.TemporaryDirectory() as cache:
                first, *later = (float(child.run_python("-c", script, cache=cache)) for _ in range(3))
            rows.append([method, count, first, min(later)])
    columns = {"Method": "text", "Spins": "count", "First process": "seconds", "Second process": "seconds"}
    caption = (
        "Ten steps of a ring of spins with exchange, an easy axis and a field in a bath, in units of meV and ps: time "
        "of the processor from the start of the process, imports included."
    )
    targets = [
        Target(f"first answer of {SPIN_COUNTS[0]:,} to {rows[-1][1]:,} spins, {which} process", limit,
               max(row[column] for row in rows), "seconds")
        for which, limit, column in zip(("first", "second"), MAX_FIRST_SPIN_SECONDS, (2, 3), strict=True)
    ]  # fmt: skip
    return Table(caption, columns, rows), targets


def _process_seconds(script: str, cache: str) -> float:
    start = time.monotonic()  # one clock for all processes
    return float(child.run_python("-c", script, cache=cache)) - start


def _flow_table(is_quick: bool) -> tuple[Table, list[Target]]:
    """Return the times of `lt.flow` and its derivatives, each in a new process without a cache, and the targets."""
    columns = {
        "": "text",
        "Steps": "count",
        "First answer": "seconds",
        "Target": "seconds",
        "A call afterwards": "seconds",
    }
    rows: list[list] = []
    for name, system in FLOW_SYSTEMS.items():
        for query, (expression, max_seconds) in list(FLOW_QUERIES.items())[: 1 if is_quick else None]:
            for steps in (10, 1_000) if query in LONG_RUN_QUERIES and not is_quick else (10,):
                with tempfile.TemporaryDirectory() as cache:
                    script = FLOW_SCRIPT.format(system=system, asked=expression, steps=steps)
                    first_seconds, call = json.loads(child.run_python("-c", script, cache=cache))
                rows.append([f"{name}, {query}", steps, first_seconds, max_seconds, call])
    caption = (
        "`lt.flow` by `MetriplecticGauss(1)`, outside of `jax.jit`, from the definition of the system to the first "
        "answer: time of the processor. The gradient and the Hessian are those of the sum of cubes of the end."
    )
    targets = []
    for query, (_, max_seconds) in FLOW_QUERIES.items():
        slowest = max((row for row in rows if row[0].endswith(query)), key=lambda row: row[2], default=None)
        if slowest is not None:
            targets.append(
                Target(
                    f"first {query} of a flow, the slowest ({slowest[0].split(',')[0]})",
                    max_seconds,
                    slowest[2],
                    "seconds",
                )
            )
    return Table(caption, columns, rows), targets


def _script_times(script: str, cache: str) -> list:
    """Return the seconds of import, system, run and in total, measured from the start, and the audit's verdict."""
    start = time.monotonic()  # one clock for all processes
    import_end, build_end, run_end, laws_hold = json.loads(child.run_python("-c", script, cache=cache))
    return [
        import_end - start,
        build_end - import_end,
        run_end - build_end,
        run_end - start,
        "passed" if laws_hold else "failed",
    ]
