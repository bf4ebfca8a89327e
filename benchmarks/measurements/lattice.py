"""Many spins with a bath: a step against a C program of the scheme, and the growth of time and memory."""

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

EXCHANGE = 1.0
"""Exchange constant."""
AXIS = 0.1
"""Anisotropy constant."""
RATE = 0.1
"""Damping rate."""
STEP = 0.02
"""Step size."""
N_SPINS = 100_000
"""Number of spins in the comparison with C."""
SHORT_STEPS = 2
"""Steps of the short run, whose time is subtracted."""
LONG_STEPS = 12
"""Minimum number of steps of the long run."""
MIN_SPIN_STEPS = 1_000_000  # steps times spins, for the time of a step to stand out
"""Minimum number of steps times spins of the long run, so that the time of a step exceeds the noise."""
SIZES = (1_000, 10_000, 100_000, 1_000_000)
"""Numbers of spins in the growth table."""
METHODS = {
    "midpoint": lt.MetriplecticMidpoint(),
    "Gauss 4": lt.MetriplecticGauss(2),
    "explicit 4": lt.MetriplecticRungeKutta(4),
}
"""Methods of the growth table."""
THREADS = (1, 2)
"""Numbers of threads of the C program."""


def run(is_quick: bool) -> Report:
    """Compare with C, and measure the growth with the number of spins."""
    count, rounds = (1_000, 1) if is_quick else (N_SPINS, 5)
    system, x0 = spin_ring(count), random_spins(count)

    def theirs(threads: int, steps: int):
        return SpinRingProgram([EXCHANGE, AXIS, RATE, count]).integrate(x0, STEP, steps, threads)

    candidates = {
        f"C, {threads} threads": lambda threads=threads: functools.partial(theirs, threads) for threads in THREADS
    }
    c_works, skip_reasons = build_available(candidates)
    works = {name: functools.partial(work, LONG_STEPS) for name, work in c_works.items()}
    short_works = {(name, SHORT_STEPS): functools.partial(work, SHORT_STEPS) for name, work in c_works.items()}
    works["array engine"] = functools.partial(library_run, system, x0, LONG_STEPS)
    short_works["array engine", SHORT_STEPS] = functools.partial(library_run, system, x0, SHORT_STEPS)
    outcomes = race(works | short_works, rounds=rounds)
    seconds, rows = {}, []
    for name in works:
        result = outcomes[name].result
        seconds[name] = (outcomes[name].wall_seconds - outcomes[name, SHORT_STEPS].wall_seconds) / (
            LONG_STEPS - SHORT_STEPS
        )
        if isinstance(result, lt.Solution):
            iterations, run_laws = result.stats.iterations_per_step, stats_laws(result)
        else:
            iterations, run_laws = float((result[1]["iterations"] / result[1]["steps"])[0]), laws.c_run_laws(result[1])
        rows.append(
            [
                name,
                seconds[name],
                ratio(seconds[name], seconds.get("C, 1 threads")),
                iterations,
                *run_laws.table_cells(),
            ]
        )
    columns = {"": "text", "Time a step": "seconds", "Relative to C": "ratio", "Iterations a step": "number"}
    caption = f"A ring of {count:,} spins with exchange and an easy axis; steps of {STEP} by the midpoint scheme."
    text = (
        "Damped spins that heat a bath, `lt.models.spin_lattice`. The program in C makes one pass over the memory in "
        "each iteration, its derivatives written by hand, with the same stopping rules."
    )
    if c_works:
        ours = outcomes["array engine"].result.x[-1]
        difference = np.abs(outcomes["C, 1 threads"].result[0] - ours).max() / np.abs(ours).max()
        text += (
            f" After {LONG_STEPS} steps the states differ by {require_same_scheme(float(difference), LONG_STEPS):.0e}."
        )
    tables = [Table(caption, columns | laws.COLUMNS, rows), growth_table((1_000,) if is_quick else SIZES)]
    c_row = f"C, {THREADS[-1]} threads"  # as many as the array engine may use
    time_ratio = ratio(seconds["array engine"], seconds.get(c_row))
    target = Target("10⁵ coupled spins on two cores, a step against C on both", 3.0, time_ratio)
    return Report("Many spins", text, tables, [target], skip_reasons)


def growth_table(sizes) -> Table:
    """Return time and memory of a step by the number of spins, each row from a process of its own."""
    rows = []
    for method in METHODS:
        for count in sizes:
            results = process.run_child("lattice", method, str(count))
            row = [method, count, results["first"], results["step"], results["step"] / count, results["iterations"]]
            rows.append([*row, results["peak"], results["lengths"], *laws.Laws(*results["laws"]).table_cells()])
    columns = {"Method": "text", "Spins": "count", "The first call": "seconds", "A step": "seconds"}
    columns |= {"A step, for each spin": "seconds", "Iterations a step": "number"}
    columns |= {"Peak memory": "gigabytes", "| |s| - 1 |": "error"}
    caption = (
        f"Steps of {STEP}; times of the processor, all threads together. The first call compiles; peak memory is "
        "that of the process, 0.4 GB of it the packages'."
    )
    return Table(caption, columns | laws.COLUMNS, rows)


def child(method: str, count: str) -> dict:
    """Measure one method and size in the child process."""
    system, x0 = spin_ring(int(count)), random_spins(int(count))
    work = functools.partial(library_run, system, x0, method=METHODS[method])
    steps = max(LONG_STEPS, MIN_SPIN_STEPS // int(count))
    times = [time.process_time()]  # of all threads: runs are long enough, and other work on the machine does not count
    for number in (SHORT_STEPS, SHORT_STEPS, steps):
        solution = work(number)
        times.append(time.process_time())
    first_seconds, short_seconds, long_seconds = np.diff(times)
    run_laws = stats_laws(solution)
    lengths = np.linalg.norm(system.spins(solution.x[-1]), axis=-1)
    return {
        "first": first_seconds,
        "step": (long_seconds - short_seconds) / (steps - SHORT_STEPS),
        "iterations": solution.stats.iterations_per_step,
        "peak": peak_resident_bytes() if PROCESS_STATUS_FILE.is_file() else None,
        "lengths": float(np.abs(lengths - 1.0).max()),
        "laws": [run_laws.energy_drift, run_laws.least_entropy_increment],
    }


def spin_ring(count: int) -> lt.SpinSystem:
    """Return a ring of spins with a bath whose heat capacity is the number of spins."""
    return lt.models.spin_lattice(count, EXCHANGE, AXIS, rate=RATE)


def random_spins(count: int) -> np.ndarray:
    """Return random spins, and the bath at entropy zero, shape (3 count + 1,)."""
    s = np.random.default_rng(0).standard_normal((count, 3))
    return np.append((s / np.linalg.norm(s, axis=1)[:, None]).ravel(), 0.0)


def library_run(system: lt.SpinSystem, x0, steps: int, method: lt.OneStepMethod = METHODS["midpoint"]) -> lt.Solution:
    """Take ``steps`` steps and save the last state."""
    return lt.integrate(system, x0, (0.0, steps * STEP), STEP, method, save_every=steps, engine="array")


def stats_laws(solution: lt.Solution) -> laws.Laws:
    """Return the laws from the run's statistics; an audit would repeat some steps."""
    stats, entropy, first_energy = solution.stats, solution.entropy, float(solution.energy[0])
    assert stats.energy_range is not None
    assert stats.least_entropy_increment is not None
    assert entropy is not None
    drift = max(abs(energy - first_energy) for energy in stats.energy_range) / abs(first_energy)
    return laws.Laws(drift, stats.least_entropy_increment / float(np.abs(entropy).max()))
