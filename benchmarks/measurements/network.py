"""Heat between many bodies: the growth of time and memory with their number, also for stiff steps."""

from __future__ import annotations

import functools
import time

import numpy as np
import scipy.sparse

import liethermo as lt
from liethermo.models.thermo_particles import grid_adjacency_matrix

from .. import child as process
from .. import laws
from ..report import Report, Table, Target, ratio
from .memory import PROCESS_STATUS_FILE, peak_resident_bytes

SIZES = (1_000, 10_000, 100_000)
"""Numbers of bodies."""
MILD_STEP = 0.02
"""Step solved by fixed-point iteration, in units of the time in which two neighbours exchange their heat."""

STIFF_STEP = 100.0
"""Step solved by Newton's method, in units of the time in which two neighbours exchange their heat."""

STEPS = 5
"""Number of steps."""
GRAPHS = ("plane grid", "grid in space", "random, 4 neighbours")
"""Kinds of graphs."""


def run(is_quick: bool) -> Report:
    """Measure all graphs, sizes and steps."""
    graphs, sizes = (GRAPHS[:1], (100,)) if is_quick else (GRAPHS, SIZES)
    rows: list[list] = []
    seconds: dict[tuple[str, int, float], float] = {}
    for graph in graphs:
        for nodes in sizes:
            for h in (MILD_STEP, STIFF_STEP):
                results = process.run_in_child_process("network", graph, str(nodes), str(h), one_core=True)
                seconds[graph, nodes, h] = results["step"]
                row = [
                    graph,
                    results["nodes"],
                    h,
                    results["first"],
                    results["step"],
                    results["iterations"],
                    results["peak"],
                ]
                rows.append([*row, *laws.Laws(*results["laws"]).table_cells()])
    columns = {
        "Graph": "text",
        "Bodies": "count",
        "Step": "number",
        "The first call": "seconds",
        "A step": "seconds",
        "Iterations a step": "number",
        "Peak memory": "gigabytes",
    }
    caption = (
        f"Runs of {STEPS} steps on one core, each row in a new process. The first call compiles; the time of a step is "
        "that of a later one. Steps are in units of c/k."
    )
    text = (
        "Bodies with c = 1 and random temperatures, k = 1 along the edges, by the midpoint scheme with Gonzalez's "
        "gradient. The short steps are solved by fixed-point iteration, the long ones by Newton's method with a sparse "
        "Jacobian matrix, factorised for plane grids and used by Krylov iteration for the others."
    )
    small_seconds, large_seconds = (seconds.get((GRAPHS[0], nodes, STIFF_STEP)) for nodes in SIZES[1:])
    targets = [
        Target("stiff step of a plane grid of 10⁵ bodies", 10.0, large_seconds, "seconds"),
        Target("growth of its time from 10⁴ to 10⁵ bodies", 20.0, ratio(large_seconds, small_seconds)),
    ]
    return Report("Networks", text, [Table(caption, columns | laws.COLUMNS, rows)], targets)


def child(graph: str, nodes: str, h: str) -> dict:
    """Measure one graph, size and step in the child process."""
    matrix = _make_graph(graph, int(nodes))
    count = matrix.shape[0]
    system = lt.models.thermo_particles([1.0] * count, matrix)
    x0 = np.log(np.random.default_rng(0).uniform(250.0, 350.0, count))
    work = functools.partial(
        lt.integrate, system, x0, (0.0, STEPS * float(h)), float(h), save_every=STEPS, engine="sparse"
    )
    times, solution = [time.perf_counter()], work()
    for _ in range(2):
        times.append(time.perf_counter())
        solution = work()
    times.append(time.perf_counter())
    run_laws = laws.solution_laws(solution)
    return {
        "nodes": count,
        "first": times[1] - times[0],
        "step": (times[3] - times[2]) / STEPS,
        "iterations": solution.stats.iterations_per_step,
        "peak": peak_resident_bytes() if PROCESS_STATUS_FILE.is_file() else None,
        "laws": [run_laws.energy_drift, run_laws.least_entropy_increment],
    }


def _make_graph(kind: str, nodes: int) -> scipy.sparse.csr_array:
    if kind == "random, 4 neighbours":
        rng = np.random.default_rng(1)
        ends = np.concatenate([np.arange(nodes), rng.permutation(nodes)])  # a ring, so that it is connected, and more
        starts = np.concatenate([np.roll(np.arange(nodes), 1), rng.permutation(nodes)])
        upper = scipy.sparse.coo_array((np.ones(2 * nodes), (ends, starts)), (nodes, nodes)).tocsr()
        graph = scipy.sparse.csr_array(upper + upper.T)
        graph.setdiag(0.0)
        graph.eliminate_zeros()
        return graph
    axes = 2 if kind == "plane grid" else 3
    return grid_adjacency_matrix((round(nodes ** (1 / axes)),) * axes)
