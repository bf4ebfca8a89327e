"""Many spins: steps against C programs, with noise and with dipoles; growth of time and memory."""

from __future__ import annotations

import functools
import time
from collections.abc import Callable

import numpy as np

import liethermo as lt

from .. import child as process
from .. import laws
from ..contest import require_same_scheme
from ..native import HeunProgram, SpinRingProgram
from ..report import Report, Table, Target, UnavailableError, build_available, ratio
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
CUBE_EDGES = (10, 32)
"""Spins along an edge of the cubes that are compared with the algorithm of VAMPIRE."""
TEMPERATURE = 1.3
"""Temperature of the bath of the cubes with noise, in units of the exchange."""
DIPOLE_EDGES = (16, 32)
"""Spins along an edge of the cubes with dipoles."""
DIPOLE_STRENGTH = 0.1
"""Strength of the dipoles, in units of the exchange."""
MIN_CUBE_SPIN_STEPS = 800_000
"""Minimum number of steps times spins of a timed run of a cube."""
CUBE_ROUNDS = 4
"""Number of timed rounds of a cube."""


def run(is_quick: bool) -> Report:
    """Compare with C, and measure the growth with the number of spins."""
    count, rounds = (1_000, 1) if is_quick else (N_SPINS, 5)
    system, x0 = spin_ring(count), random_spins(count)

    def run_c_program(threads: int, steps: int):
        return SpinRingProgram([EXCHANGE, AXIS, RATE, count]).integrate(x0, STEP, steps, threads)

    candidates = {
        f"C, {threads} threads": lambda threads=threads: functools.partial(run_c_program, threads)
        for threads in THREADS
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
        library_states = outcomes["array engine"].result.x[-1]
        difference = np.abs(outcomes["C, 1 threads"].result[0] - library_states).max() / np.abs(library_states).max()
        text += (
            f" After {LONG_STEPS} steps the states differ by {require_same_scheme(float(difference), LONG_STEPS):.0e}."
        )
    dipoles = dipole_table((4,) if is_quick else DIPOLE_EDGES)
    tables = [
        Table(caption, columns | laws.COLUMNS, rows),
        heun_table((4,) if is_quick else CUBE_EDGES),
        dipoles,
        growth_table((1_000,) if is_quick else SIZES),
    ]
    c_row = f"C, {THREADS[-1]} threads"  # as many as the array engine may use
    time_ratio = ratio(seconds["array engine"], seconds.get(c_row))
    targets = [
        Target("10⁵ coupled spins on two cores, a step against C on both", 3.0, time_ratio),
        *(
            Target(f"dipoles on {edge}³ spins, {borders}, a step against one without", 3.0, dipole_ratio)
            for edge, borders, _, _, dipole_ratio in dipoles.rows
        ),
    ]
    return Report("Many spins", text, tables, targets, skip_reasons)


def heun_table(edges) -> Table:
    """Return the times of steps on cubes beside the algorithm of VAMPIRE in C, with and without noise."""
    rows = []
    for edge in edges:
        for temperature in (0.0, TEMPERATURE):
            spins = random_spins(edge**3)[:-1].reshape(edge, edge, edge, 3)
            baths = lt.HeatBaths(np.inf, TEMPERATURE)
            system = lt.models.spin_lattice((edge,) * 3, EXCHANGE, AXIS, rate=RATE, baths=baths)
            noise = lt.Fluctuations(seed=1) if temperature else None
            works: dict[str, Callable] = {
                name: functools.partial(library_run, system, system.state(spins), method=METHODS[name], noise=noise)
                for name in (("midpoint",) if temperature else ("midpoint", "explicit 4"))
            }
            try:
                program = HeunProgram(edge, EXCHANGE, AXIS, RATE)
                works["C"] = functools.partial(program.integrate, spins, STEP, temperature=temperature)
            except UnavailableError:
                pass
            seconds = seconds_per_step(works, max(LONG_STEPS, MIN_CUBE_SPIN_STEPS // edge**3))
            times = [seconds[name] / edge**3 if name in seconds else None for name in ("C", "explicit 4", "midpoint")]
            rows.append([edge, "yes" if temperature else "no", *times])
    columns = {"Edge": "count", "Noise": "text", "Heun in C": "seconds", "Explicit 4": "seconds", "Midpoint": "seconds"}
    caption = (
        f"A spin and step on periodic cubes with exchange and an easy axis, in a bath, steps of {STEP}. *Heun in C* is "
        "the algorithm of VAMPIRE in one thread, of order 2, with two fields a step, and without a bath's energy. The "
        "explicit method has order 4, and four fields a step besides those of the laws. Times of the processor."
    )
    return Table(caption, columns, rows)


def dipole_table(edges) -> Table:
    """Return the times of explicit steps on cubes with and without dipoles, and their ratio."""
    rows = []
    for edge in edges:
        spins = random_spins(edge**3)[:-1].reshape(edge, edge, edge, 3)
        for borders, is_periodic in (("open", False), ("periodic", True)):
            lattice = lt.magnetism.lattice("sc", (edge,) * 3, periodic=is_periodic)
            exchange = lt.magnetism.exchange(lattice, EXCHANGE)
            exchange_and_dipoles = exchange + lt.magnetism.dipoles(lattice, 1.0, DIPOLE_STRENGTH)
            works = {}
            for name, energy in (("without", exchange), ("with", exchange_and_dipoles)):
                system = lt.SpinSystem(lattice, energy, lt.LandauLifshitz(RATE))
                x0 = system.state(spins)
                works[name] = functools.partial(library_run, system, x0, method=METHODS["explicit 4"])
            seconds = seconds_per_step(works, max(LONG_STEPS, MIN_CUBE_SPIN_STEPS // edge**3))
            without, with_dipoles = (seconds[name] / edge**3 for name in ("without", "with"))
            rows.append([edge, borders, without, with_dipoles, with_dipoles / without])
    columns = {"Edge": "count", "Borders": "text", "Without": "seconds", "With dipoles": "seconds", "Ratio": "ratio"}
    caption = f"A spin and step with exchange, with and without dipoles, explicit steps of {STEP} of order 4."
    return Table(caption, columns, rows)


def seconds_per_step(works: dict, steps: int) -> dict[str, float]:
    """Return the processor seconds of a step of each work, a function of ``steps``, without the call itself."""
    runs = {(name, n): functools.partial(work, steps=n) for name, work in works.items() for n in (SHORT_STEPS, steps)}
    seconds = {run: timed_result.cpu_seconds for run, timed_result in race(runs, rounds=CUBE_ROUNDS).items()}
    return {name: (seconds[name, steps] - seconds[name, SHORT_STEPS]) / (steps - SHORT_STEPS) for name in works}


def growth_table(sizes) -> Table:
    """Return time and memory of a step by the number of spins, each row from a process of its own."""
    rows = []
    for method in METHODS:
        for count in sizes:
            results = process.run_in_child_process("lattice", method, str(count))
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


def library_run(
    system: lt.SpinSystem, x0, steps: int, method: lt.OneStepMethod = METHODS["midpoint"], noise=None
) -> lt.Solution:
    """Take ``steps`` steps and save the last state."""
    return lt.integrate(system, x0, (0.0, steps * STEP), STEP, method, noise=noise, save_every=steps, engine="array")


def stats_laws(solution: lt.Solution) -> laws.Laws:
    """Return the laws from the run's statistics; an audit would repeat some steps."""
    stats, entropy, first_energy = solution.stats, solution.entropy, float(solution.energy[0])
    assert stats.energy_range is not None
    assert stats.least_entropy_increment is not None
    assert entropy is not None
    drift = max(abs(energy - first_energy) for energy in stats.energy_range) / abs(first_energy)
    return laws.Laws(drift, stats.least_entropy_increment / float(np.abs(entropy).max()))
