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
from ..native import Ring
from ..report import Report, Table, Target, UnavailableError, ratio
from .lattice import AXIS, EXCHANGE, STEP, start
from .magnet import CRITICAL, RATE
from .magnet import STEP as NOISY_STEP

SIZES = (1_000, 10_000, 100_000, 1_000_000)
FEW, MANY, LEAST_WORK, ROUNDS = 2, 12, 200_000, 3

EDGES, SETTLING, TIMED = (4, 8, 16, 32), 100, 40

PLAIN, BY_HAND, BY_PLANES, NAMED, C = (
    "plain function",
    "by hand in JAX, (n, 3)",
    "by hand in JAX, (3, n)",
    "`spin_lattice`",
    "C, 1 threads",
)


def run(quick: bool) -> Report:
    """Two tables, each row in a process of its own."""
    sizes, edges = ((1_000,), (4,)) if quick else (SIZES, EDGES)
    found = {n: process.call("large", "functions", str(n)) for n in sizes}
    ways = (PLAIN, BY_HAND, BY_PLANES, NAMED, C)
    rows = [[n, *(found[n].get(way) for way in ways)] for n in sizes]
    columns = {"Sites": "count"} | {way[0].upper() + way[1:]: "seconds" for way in ways}
    functions = Table(
        f"A step of {STEP} of the midpoint scheme on a ring of spins with exchange and an easy axis; times of the "
        "processor, all threads together.",
        columns,
        rows,
    )
    noise = {n: process.call("large", "noise", str(n)) for n in edges}
    names = ("first", "with", "without", "ratio", "iterations", "iterations without")
    kinds = ("seconds", "seconds", "seconds", "ratio", "number", "number")
    headings = ("First answer", "A spin and step", "Without noise", "Ratio", "Iterations a step", "Without noise ")
    lattices = Table(
        f"Noise on cubes of spins in a bath of kT = {CRITICAL} J, in steps of {NOISY_STEP} with the rate {RATE:g}, "
        f"after {SETTLING} steps from disorder; the same steps without noise. Times of the processor.",
        {"Edge": "count"} | dict(zip(headings, kinds, strict=True)),
        [[n, *(noise[n][name] for name in names)] for n in edges],
    )
    at = 100_000 if 100_000 in found else sizes[0]
    targets = [
        Target("a plain function on 10⁵ sites, a step against the scheme by hand in JAX, (n, 3)", 1.0,
               None if quick else ratio(found[at][PLAIN], found[at][BY_HAND])),
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
    return functions_of(int(size)) if what == "functions" else noise_on(int(size))


def energy(s) -> jax.Array:
    """Of spins in an array, shape (n, 3)."""
    return -EXCHANGE * jnp.sum(s * jnp.roll(s, 1, axis=0)) - AXIS * jnp.sum(s[:, 2] ** 2)


def functions_of(n: int) -> dict[str, float]:
    """The time of a step by each way."""
    spins = start(n)[:-1].reshape(n, 3)
    plain = lt.LiePoissonSystem(mf.power(mf.so(3), n), energy, None, None)
    named = lt.models.spin_lattice(n, EXCHANGE, AXIS, rate=0.0, baths=False)

    def by_library(system: lt.System, steps: int) -> None:
        x0 = system.state(spins)
        lt.integrate(system, x0, (0.0, steps * STEP), STEP, lt.MetriplecticMidpoint(), save_every=steps, engine="array")

    works: dict[str, Callable[[int], object]] = {
        PLAIN: functools.partial(by_library, plain),
        BY_HAND: functools.partial(by_hand, jnp.asarray(spins), 0),
        BY_PLANES: functools.partial(by_hand, jnp.asarray(spins.T), 1),
        NAMED: functools.partial(by_library, named),
    }
    try:
        ring = Ring([EXCHANGE, AXIS, 0.0, n])
        works[C] = lambda steps: ring.integrate(np.append(spins.ravel(), 0.0), STEP, steps, 1)
    except UnavailableError:
        pass
    many = max(MANY, LEAST_WORK // n)
    best: dict[str, list[float]] = {name: [np.inf, np.inf] for name in works}
    for turn in range(ROUNDS + 1):  # the first one compiles
        for name, work in works.items():
            for i, steps in enumerate((FEW, many)):
                begun = time.process_time()
                work(steps)
                if turn:
                    best[name][i] = min(best[name][i], time.process_time() - begun)
    return {name: (long - short) / (many - FEW) for name, (short, long) in best.items()}


def by_hand(s, axis: int, steps: int) -> jax.Array:
    """Midpoint steps, their equation solved to the last digit; the vectors along the other axis."""
    return _steps(s, steps, axis).block_until_ready()


@functools.partial(jax.jit, static_argnames="axis")
def _steps(s, steps, axis: int) -> jax.Array:
    def own(s):
        return energy(s) if axis == 0 else energy(s.T)

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


def noise_on(edge: int) -> dict[str, float]:
    """First answer, and the time of a spin and step with noise and without, from one state."""
    sites, noise = (edge,) * 3, lt.Fluctuations(1.0, seed=1)
    begun = time.process_time()
    system = lt.models.spin_lattice(sites, rate=RATE, baths=lt.HeatBaths(np.inf, CRITICAL))
    spins = start(edge**3)[:-1].reshape(*sites, 3)

    def steps(x, count: int, noise=noise) -> lt.Solution:
        method, end = lt.MetriplecticMidpoint(), count * NOISY_STEP
        return lt.integrate(system, x, (0.0, end), NOISY_STEP, method, noise=noise, save_every=count, engine="array")

    settled = steps(system.state(spins), 1)
    first = time.process_time() - begun
    settled = steps(settled.x[-1], SETTLING).x[-1]
    many, found = max(TIMED, LEAST_WORK // edge**3 // 10), {}
    for name, own in (("with", noise), ("without", None)):
        times = []
        for _ in range(ROUNDS + 1):
            for count in (FEW, many):
                begun = time.process_time()
                done = steps(settled, count, own)
                times.append(time.process_time() - begun)
        short, long = min(times[2::2]), min(times[3::2])
        found[name] = (long - short) / (many - FEW) / edge**3
        found["iterations" if own else "iterations without"] = done.stats.iterations_per_step
    return found | {"first": first, "ratio": found["with"] / found["without"]}
