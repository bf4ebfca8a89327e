"""Many spins with a bath: a step against the same scheme in C, and how its time and memory grow."""

from __future__ import annotations

import functools
import time

import numpy as np

import liethermo as lt

from .. import child as process
from .. import laws
from ..contest import require_same_scheme
from ..native import SpinRingProgram
from ..report import Report, Table, Target, build_available, ratio
from ..timing import race
from .memory import PROCESS_STATUS_FILE, peak_resident_bytes

EXCHANGE, AXIS, RATE, STEP = 1.0, 0.1, 0.1, 0.02
N_SPINS, SHORT_STEPS, LONG_STEPS = 100_000, 2, 12
MIN_SPIN_STEPS = 1_000_000  # steps times spins, for the time of a step to stand out
SIZES = (1_000, 10_000, 100_000, 1_000_000)
METHODS = {
    "midpoint": lt.MetriplecticMidpoint(),
    "Gauss 4": lt.MetriplecticGauss(2),
    "explicit 4": lt.MetriplecticRungeKutta(4),
}
THREADS = (1, 2)


def run(quick: bool) -> Report:
    """Two tables: against C, and by size."""
    count, rounds = (1_000, 1) if quick else (N_SPINS, 5)
    system, x0 = spin_ring(count), random_spins(count)

    def theirs(threads: int, steps: int):
        return SpinRingProgram([EXCHANGE, AXIS, RATE, count]).integrate(x0, STEP, steps, threads)

    candidates = {
        f"C, {threads} threads": lambda threads=threads: functools.partial(theirs, threads) for threads in THREADS
    }
    found, skipped = build_available(candidates)
    works = {name: functools.partial(work, LONG_STEPS) for name, work in found.items()}
    few = {(name, SHORT_STEPS): functools.partial(work, SHORT_STEPS) for name, work in found.items()}
    works["array engine"] = functools.partial(library_run, system, x0, LONG_STEPS)
    few["array engine", SHORT_STEPS] = functools.partial(library_run, system, x0, SHORT_STEPS)
    outcomes = race(works | few, rounds=rounds)
    seconds, rows = {}, []
    for name in works:
        result = outcomes[name].result
        seconds[name] = (outcomes[name].wall_seconds - outcomes[name, SHORT_STEPS].wall_seconds) / (
            LONG_STEPS - SHORT_STEPS
        )
        if isinstance(result, lt.Solution):
            iterations, kept = result.stats.iterations_per_step, stats_laws(result)
        else:
            iterations, kept = float((result[1]["iterations"] / result[1]["steps"])[0]), laws.c_run_laws(result[1])
        rows.append(
            [name, seconds[name], ratio(seconds[name], seconds.get("C, 1 threads")), iterations, *kept.table_cells()]
        )
    columns = {"": "text", "Time a step": "seconds", "Relative to C": "ratio", "Iterations a step": "number"}
    caption = f"A ring of {count:,} spins with exchange and an easy axis; steps of {STEP} by the midpoint scheme."
    text = (
        "Damped spins that heat a bath, `lt.models.spin_lattice`. The program in C makes one pass over the memory in "
        "each iteration, its derivatives written by hand, with the same stopping rules."
    )
    if found:
        ours = outcomes["array engine"].result.x[-1]
        apart = np.abs(outcomes["C, 1 threads"].result[0] - ours).max() / np.abs(ours).max()
        text += f" After {LONG_STEPS} steps the states differ by {require_same_scheme(float(apart), LONG_STEPS):.0e}."
    tables = [Table(caption, columns | laws.COLUMNS, rows), growth_table((1_000,) if quick else SIZES)]
    most = f"C, {THREADS[-1]} threads"  # as many as the array engine may use
    against = ratio(seconds["array engine"], seconds.get(most))
    target = Target("10⁵ coupled spins on two cores, a step against C on both", 3.0, against)
    return Report("Many spins", text, tables, [target], skipped)


def growth_table(sizes) -> Table:
    """Time and memory of a step by the number of spins, each row in a process of its own."""
    rows = []
    for method in METHODS:
        for count in sizes:
            found = process.run_child("lattice", method, str(count))
            row = [method, count, found["first"], found["step"], found["step"] / count, found["iterations"]]
            rows.append([*row, found["peak"], found["lengths"], *laws.Laws(*found["laws"]).table_cells()])
    columns = {"Method": "text", "Spins": "count", "The first call": "seconds", "A step": "seconds"}
    columns |= {"A step, for each spin": "seconds", "Iterations a step": "number"}
    columns |= {"Peak memory": "gigabytes", "| |s| - 1 |": "error"}
    caption = (
        f"Steps of {STEP}; times of the processor, all threads together. The first call compiles; peak memory is "
        "that of the process, 0.4 GB of it the packages'."
    )
    return Table(caption, columns | laws.COLUMNS, rows)


def child(method: str, count: str) -> dict:
    """The part that runs in a process of its own."""
    system, x0 = spin_ring(int(count)), random_spins(int(count))
    work = functools.partial(library_run, system, x0, method=METHODS[method])
    steps = max(LONG_STEPS, MIN_SPIN_STEPS // int(count))
    times = [time.process_time()]  # of all threads: runs are long enough, and other work on the machine does not count
    for number in (SHORT_STEPS, SHORT_STEPS, steps):
        solution = work(number)
        times.append(time.process_time())
    first, few, many = np.diff(times)
    kept = stats_laws(solution)
    lengths = np.linalg.norm(system.spins(solution.x[-1]), axis=-1)
    return {
        "first": first,
        "step": (many - few) / (steps - SHORT_STEPS),
        "iterations": solution.stats.iterations_per_step,
        "peak": peak_resident_bytes() if PROCESS_STATUS_FILE.is_file() else None,
        "lengths": float(np.abs(lengths - 1.0).max()),
        "laws": [kept.energy_drift, kept.least_entropy_increment],
    }


def spin_ring(count: int) -> lt.SpinSystem:
    """A ring with a bath of its own size."""
    return lt.models.spin_lattice(count, EXCHANGE, AXIS, rate=RATE)


def random_spins(count: int) -> np.ndarray:
    """Spins in disorder, and the bath at entropy zero."""
    s = np.random.default_rng(0).standard_normal((count, 3))
    return np.append((s / np.linalg.norm(s, axis=1)[:, None]).ravel(), 0.0)


def library_run(system: lt.SpinSystem, x0, steps: int, method: lt.OneStepMethod = METHODS["midpoint"]) -> lt.Solution:
    """So many steps, the last state kept."""
    return lt.integrate(system, x0, (0.0, steps * STEP), STEP, method, save_every=steps, engine="array")


def stats_laws(solution: lt.Solution) -> laws.Laws:
    """The laws as they were followed at every step: an audit would take some of these again."""
    stats, entropy, first = solution.stats, solution.entropy, float(solution.energy[0])
    assert stats.energy_range is not None
    assert stats.least_entropy_increment is not None
    assert entropy is not None
    drift = max(abs(energy - first) for energy in stats.energy_range) / abs(first)
    return laws.Laws(drift, stats.least_entropy_increment / float(np.abs(entropy).max()))
