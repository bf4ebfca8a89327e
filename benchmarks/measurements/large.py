"""Any function at any size: plain functions beside the scheme by hand, a named model and C; noise on lattices."""

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
SHORT_STEPS, LONG_STEPS, MIN_SITE_STEPS, ROUNDS = 2, 12, 200_000, 3

EDGES, SETTLING_STEPS, TIMED_STEPS = (4, 8, 16, 32), 100, 40

PLAIN_ROW, HAND_WRITTEN_ROW, COLUMN_MAJOR_ROW, MODEL_ROW, C_ROW = (
    "plain function",
    "by hand in JAX, (n, 3)",
    "by hand in JAX, (3, n)",
    "`spin_lattice`",
    "C, 1 threads",
)


def run(quick: bool) -> Report:
    """Two tables, each row in a process of its own."""
    sizes, edges = ((1_000,), (4,)) if quick else (SIZES, EDGES)
    found = {n: process.run_child("large", "functions", str(n)) for n in sizes}
    ways = (PLAIN_ROW, HAND_WRITTEN_ROW, COLUMN_MAJOR_ROW, MODEL_ROW, C_ROW)
    rows = [[n, *(found[n].get(way) for way in ways)] for n in sizes]
    columns = {"Sites": "count"} | {way[0].upper() + way[1:]: "seconds" for way in ways}
    functions = Table(
        f"A step of {STEP} of the midpoint scheme on a ring of spins with exchange and an easy axis; times of the "
        "processor, all threads together.",
        columns,
        rows,
    )
    noise = {n: process.run_child("large", "noise", str(n)) for n in edges}
    names = ("first", "with", "without", "ratio", "iterations", "iterations without")
    kinds = ("seconds", "seconds", "seconds", "ratio", "number", "number")
    headings = ("First answer", "A spin and step", "Without noise", "Ratio", "Iterations a step", "Without noise ")
    lattices = Table(
        f"Noise on cubes of spins in a bath of kT = {CRITICAL_TEMPERATURE} J, in steps of {NOISY_STEP} with the rate {RATE:g}, "
        f"after {SETTLING_STEPS} steps from disorder; the same steps without noise. Times of the processor.",
        {"Edge": "count"} | dict(zip(headings, kinds, strict=True)),
        [[n, *(noise[n][name] for name in names)] for n in edges],
    )
    at = 100_000 if 100_000 in found else sizes[0]
    targets = [
        Target("a plain function on 10⁵ sites, a step against the scheme by hand in JAX, (n, 3)", 1.0,
               None if quick else ratio(found[at][PLAIN_ROW], found[at][HAND_WRITTEN_ROW])),
        *(Target(f"noise on {n}³ spins, first answer", 5.0, noise[n]["first"], "seconds") for n in edges),
        *(Target(f"noise on {n}³ spins, a step against one without", 4.0, noise[n]["ratio"]) for n in edges),
    ]  # fmt: skip
    text = (
        "A plain function is one of an array of all sites, on `mf.power(mf.so(3), n)`; *by hand* is the midpoint "
        "scheme for this energy in some lines of JAX, its layout chosen by hand too; C has a bath besides."
    )
    return Report("Any function at any size", text, [functions, lattices], targets)


def child(what: str, size: str) -> dict:
    """The part that runs in a process of its own."""
    return time_functions(int(size)) if what == "functions" else time_noise(int(size))


def spin_energy(s) -> jax.Array:
    """Of spins in an array, shape (n, 3)."""
    return -EXCHANGE * jnp.sum(s * jnp.roll(s, 1, axis=0)) - AXIS * jnp.sum(s[:, 2] ** 2)


def time_functions(n: int) -> dict[str, float]:
    """The time of a step by each way."""
    spins = random_spins(n)[:-1].reshape(n, 3)
    plain = lt.LiePoissonSystem(mf.power(mf.so(3), n), spin_energy, None, None)
    named = lt.models.spin_lattice(n, EXCHANGE, AXIS, rate=0.0, baths=False)

    def by_library(system: lt.System, steps: int) -> None:
        x0 = system.state(spins)
        lt.integrate(system, x0, (0.0, steps * STEP), STEP, lt.MetriplecticMidpoint(), save_every=steps, engine="array")

    works: dict[str, Callable[[int], object]] = {
        PLAIN_ROW: functools.partial(by_library, plain),
        HAND_WRITTEN_ROW: functools.partial(hand_written_steps, jnp.asarray(spins), 0),
        COLUMN_MAJOR_ROW: functools.partial(hand_written_steps, jnp.asarray(spins.T), 1),
        MODEL_ROW: functools.partial(by_library, named),
    }
    try:
        ring = SpinRingProgram([EXCHANGE, AXIS, 0.0, n])
        works[C_ROW] = lambda steps: ring.integrate(np.append(spins.ravel(), 0.0), STEP, steps, 1)
    except UnavailableError:
        pass
    many = max(LONG_STEPS, MIN_SITE_STEPS // n)
    best: dict[str, list[float]] = {name: [np.inf, np.inf] for name in works}
    for turn in range(ROUNDS + 1):  # the first one compiles
        for name, work in works.items():
            for i, steps in enumerate((SHORT_STEPS, many)):
                begun = time.process_time()
                work(steps)
                if turn:
                    best[name][i] = min(best[name][i], time.process_time() - begun)
    return {name: (long - short) / (many - SHORT_STEPS) for name, (short, long) in best.items()}


def hand_written_steps(s, axis: int, steps: int) -> jax.Array:
    """Midpoint steps, their equation solved to the last digit; the vectors along the other axis."""
    return _midpoint_steps(s, steps, axis).block_until_ready()


@functools.partial(jax.jit, static_argnames="axis")
def _midpoint_steps(s, steps, axis: int) -> jax.Array:
    def own(s):
        return spin_energy(s) if axis == 0 else spin_energy(s.T)

    def step(_, s):
        def slopes(k):
            middle = s + 0.5 * STEP * k
            slope = jax.grad(own)(middle)
            if axis == 0:
                return jnp.cross(middle, slope)
            (a, b, c), (u, v, w) = middle, slope
            return jnp.stack([b * w - c * v, c * u - a * w, a * v - b * u])

        def again(carry):
            k, _, count = carry
            new = slopes(k)
            return new, jnp.max(jnp.abs(new - k)), count + 1

        first = slopes(jnp.zeros_like(s))
        k, *_ = jax.lax.while_loop(lambda c: (c[1] > 1e-15) & (c[2] < 50), again, (first, 1.0, 0))
        return s + STEP * k

    return jax.lax.fori_loop(0, steps, step, s)


def time_noise(edge: int) -> dict[str, float]:
    """First answer, and the time of a spin and step with noise and without, from one state."""
    sites, noise = (edge,) * 3, lt.Fluctuations(1.0, seed=1)
    begun = time.process_time()
    system = lt.models.spin_lattice(sites, rate=RATE, baths=lt.HeatBaths(np.inf, CRITICAL_TEMPERATURE))
    spins = random_spins(edge**3)[:-1].reshape(*sites, 3)

    def steps(x, count: int, noise=noise) -> lt.Solution:
        method, end = lt.MetriplecticMidpoint(), count * NOISY_STEP
        return lt.integrate(system, x, (0.0, end), NOISY_STEP, method, noise=noise, save_every=count, engine="array")

    settled = steps(system.state(spins), 1)
    first = time.process_time() - begun
    settled = steps(settled.x[-1], SETTLING_STEPS).x[-1]
    many, found = max(TIMED_STEPS, MIN_SITE_STEPS // edge**3 // 10), {}
    for name, own in (("with", noise), ("without", None)):
        times = []
        for _ in range(ROUNDS + 1):
            for count in (SHORT_STEPS, many):
                begun = time.process_time()
                done = steps(settled, count, own)
                times.append(time.process_time() - begun)
        short, long = min(times[2::2]), min(times[3::2])
        found[name] = (long - short) / (many - SHORT_STEPS) / edge**3
        found["iterations" if own else "iterations without"] = done.stats.iterations_per_step
    return found | {"first": first, "ratio": found["with"] / found["without"]}
