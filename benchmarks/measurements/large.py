"""Functions at any size: plain functions against the scheme in JAX, a model and C; noise on lattices."""

from __future__ import annotations

import functools
import time
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

import liethermo as lt
import manifolds as mf

from .. import child as process
from ..native import SpinRingProgram
from ..report import Report, Table, Target, UnavailableError, ratio
from .lattice import AXIS, EXCHANGE, STEP, random_spins
from .magnet import CRITICAL_TEMPERATURE, RATE
from .magnet import STEP as NOISY_STEP

SIZES = (1_000, 10_000, 100_000, 1_000_000)
"""Numbers of sites."""
SHORT_STEPS = 2
"""Steps of the short run, whose time is subtracted."""
LONG_STEPS = 12
"""Minimum number of steps of the long run."""
MIN_SITE_STEPS = 200_000
"""Minimum number of steps times sites of the long run."""
ROUNDS = 3
"""Number of timed rounds."""

EDGES = (4, 8, 16, 32)
"""Sites along an edge of the cubes with noise."""
SETTLING_STEPS = 100
"""Steps from disorder before the timing."""
TIMED_STEPS = 40
"""Minimum number of timed steps with noise."""

PLAIN_ROW = "plain function"
"""Row of the plain function."""
HAND_WRITTEN_ROW = "by hand in JAX, (n, 3)"
"""Row of the hand-written scheme with arrays of shape (n, 3)."""
COLUMN_MAJOR_ROW = "by hand in JAX, (3, n)"
"""Row of the hand-written scheme with arrays of shape (3, n)."""
MODEL_ROW = "`spin_lattice`"
"""Row of the library's model."""
C_ROW = "C, 1 threads"
"""Row of the C program."""


def run(is_quick: bool) -> Report:
    """Measure functions and noise, each size in a process of its own."""
    sizes, edges = ((1_000,), (4,)) if is_quick else (SIZES, EDGES)
    seconds_by_size = {n: process.run_in_child_process("large", "functions", str(n)) for n in sizes}
    row_names = (PLAIN_ROW, HAND_WRITTEN_ROW, COLUMN_MAJOR_ROW, MODEL_ROW, C_ROW)
    rows = [[n, *(seconds_by_size[n].get(row_name) for row_name in row_names)] for n in sizes]
    columns = {"Sites": "count"} | {row_name[0].upper() + row_name[1:]: "seconds" for row_name in row_names}
    functions = Table(
        f"A step of {STEP} of the midpoint scheme on a ring of spins with exchange and an easy axis; times of the "
        "processor, all threads together.",
        columns,
        rows,
    )
    noise = {n: process.run_in_child_process("large", "noise", str(n)) for n in edges}
    names = ("first", "with", "without", "ratio", "iterations", "iterations without")
    kinds = ("seconds", "seconds", "seconds", "ratio", "number", "number")
    headings = ("First answer", "A spin and step", "Without noise", "Ratio", "Iterations a step", "Without noise ")
    lattices = Table(
        f"Noise on cubes of spins in a bath of kT = {CRITICAL_TEMPERATURE} J, in steps of {NOISY_STEP} with the "
        f"rate {RATE:g}, "
        f"after {SETTLING_STEPS} steps from disorder; the same steps without noise. Times of the processor.",
        {"Edge": "count"} | dict(zip(headings, kinds, strict=True)),
        [[n, *(noise[n][name] for name in names)] for n in edges],
    )
    target_size = 100_000 if 100_000 in seconds_by_size else sizes[0]
    target_seconds = seconds_by_size[target_size]
    targets = [
        Target("a plain function on 10⁵ sites, a step against the scheme by hand in JAX, (n, 3)", 1.0,
               None if is_quick else ratio(target_seconds[PLAIN_ROW], target_seconds[HAND_WRITTEN_ROW])),
        *(Target(f"noise on {n}³ spins, first answer", 5.0, noise[n]["first"], "seconds") for n in edges),
        *(Target(f"noise on {n}³ spins, a step against one without", 4.0, noise[n]["ratio"]) for n in edges),
    ]  # fmt: skip
    text = (
        "A plain function is one of an array of all sites, on `mf.power(mf.so(3), n)`; *by hand* is the midpoint "
        "scheme for this energy in some lines of JAX, its layout chosen by hand too; C has a bath besides."
    )
    return Report("Any function at any size", text, [functions, lattices], targets)


def child(part: str, size: str) -> dict:
    """Run one part of the measurement in the child process."""
    return time_functions(int(size)) if part == "functions" else time_noise(int(size))


def spin_energy(s) -> jax.Array:
    """Return the energy of spins, shape (n, 3)."""
    return -EXCHANGE * jnp.sum(s * jnp.roll(s, 1, axis=0)) - AXIS * jnp.sum(s[:, 2] ** 2)


def time_functions(n: int) -> dict[str, float]:
    """Return the seconds of a step for each implementation."""
    spins = random_spins(n)[:-1].reshape(n, 3)
    plain_system = lt.LiePoissonSystem(mf.power(mf.so(3), n), spin_energy, None, None)
    model_system = lt.models.spin_lattice(n, EXCHANGE, AXIS, rate=0.0, baths=False)

    def library_steps(system: lt.System, steps: int) -> None:
        x0 = system.state(spins)
        lt.integrate(system, x0, (0.0, steps * STEP), STEP, lt.MetriplecticMidpoint(), save_every=steps, engine="array")

    works: dict[str, Callable[[int], object]] = {
        PLAIN_ROW: functools.partial(library_steps, plain_system),
        HAND_WRITTEN_ROW: functools.partial(hand_written_steps, jnp.asarray(spins), 0),
        COLUMN_MAJOR_ROW: functools.partial(hand_written_steps, jnp.asarray(spins.T), 1),
        MODEL_ROW: functools.partial(library_steps, model_system),
    }
    try:
        ring = SpinRingProgram([EXCHANGE, AXIS, 0.0, n])
        works[C_ROW] = lambda steps: ring.integrate(np.append(spins.ravel(), 0.0), STEP, steps, 1)
    except UnavailableError:
        pass
    long_steps = max(LONG_STEPS, MIN_SITE_STEPS // n)
    best_times: dict[str, list[float]] = {name: [np.inf, np.inf] for name in works}
    for turn in range(ROUNDS + 1):  # the first one compiles
        for name, work in works.items():
            for i, steps in enumerate((SHORT_STEPS, long_steps)):
                start = time.process_time()
                work(steps)
                if turn:
                    best_times[name][i] = min(best_times[name][i], time.process_time() - start)
    return {
        name: (long_time - short_time) / (long_steps - SHORT_STEPS)
        for name, (short_time, long_time) in best_times.items()
    }


def hand_written_steps(s, axis: int, steps: int) -> jax.Array:
    """Take midpoint steps, solved to the last digit; ``axis`` numbers the sites."""
    return _midpoint_steps(s, steps, axis).block_until_ready()


@functools.partial(jax.jit, static_argnames="axis")
def _midpoint_steps(s, steps, axis: int) -> jax.Array:
    def energy(s):
        return spin_energy(s) if axis == 0 else spin_energy(s.T)

    def step(_, s):
        def slopes(k):
            middle = s + 0.5 * STEP * k
            slope = jax.grad(energy)(middle)
            if axis == 0:
                return jnp.cross(middle, slope)
            (a, b, c), (u, v, w) = middle, slope
            return jnp.stack([b * w - c * v, c * u - a * w, a * v - b * u])

        def iterate(carry):
            k, _, count = carry
            new_slopes = slopes(k)
            return new_slopes, jnp.max(jnp.abs(new_slopes - k)), count + 1

        first_slopes = slopes(jnp.zeros_like(s))
        k, *_ = jax.lax.while_loop(lambda c: (c[1] > 1e-15) & (c[2] < 50), iterate, (first_slopes, 1.0, 0))
        return s + STEP * k

    return jax.lax.fori_loop(0, steps, step, s)


def time_noise(edge: int) -> dict[str, float]:
    """Return the seconds of the first result, and per spin and step with and without noise, from one state."""
    sites, noise = (edge,) * 3, lt.Fluctuations(1.0, seed=1)
    start = time.process_time()
    system = lt.models.spin_lattice(sites, rate=RATE, baths=lt.HeatBaths(np.inf, CRITICAL_TEMPERATURE))
    spins = random_spins(edge**3)[:-1].reshape(*sites, 3)

    def steps(x, count: int, noise=noise) -> lt.Solution:
        method, end = lt.MetriplecticMidpoint(), count * NOISY_STEP
        return lt.integrate(system, x, (0.0, end), NOISY_STEP, method, noise=noise, save_every=count, engine="array")

    settled_state = steps(system.state(spins), 1)
    first_seconds = time.process_time() - start
    settled_state = steps(settled_state.x[-1], SETTLING_STEPS).x[-1]
    long_steps, results = max(TIMED_STEPS, MIN_SITE_STEPS // edge**3 // 10), {}
    for name, run_noise in (("with", noise), ("without", None)):
        times = []
        for _ in range(ROUNDS + 1):
            for count in (SHORT_STEPS, long_steps):
                start = time.process_time()
                solution = steps(settled_state, count, run_noise)
                times.append(time.process_time() - start)
        short_time, long_time = min(times[2::2]), min(times[3::2])
        results[name] = (long_time - short_time) / (long_steps - SHORT_STEPS) / edge**3
        results["iterations" if run_noise else "iterations without"] = solution.stats.iterations_per_step
    return results | {"first": first_seconds, "ratio": results["with"] / results["without"]}
