"""Random functions of every primitive that the scalar compiler claims, composed, beside JAX.

``python -m tests.fuzz --seconds 60`` (``make fuzz SECONDS=60``) draws functions until the time is over. It compares
values, gradients, second derivatives and lanes, at random points and at special ones: zeros of both signs, infinity,
subnormal numbers, equal entries. What differs is printed with the seed that makes the same function again.
"""

from __future__ import annotations

import argparse
import time
import traceback
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import jaxprs_in_params

from liethermo.tracing.scalarize import CompilerFault, UnsupportedPrimitive, scalarize
from tests.fuzz_operations import DTYPES, INTEGERS, OPERATIONS, cut
from tests.machine_code import compiled
from tests.scalar_programs import check

SUMMARIES: dict[str, Callable] = {
    "value": lambda f: f,
    "gradient": lambda f: jax.grad(lambda x, y: jnp.sum(f(x, y)[-1]), argnums=(0, 1)),
    "derivative": lambda f: (
        lambda x, y: jax.jvp(f, (x, y), (jnp.ones_like(x), jnp.cos(jnp.arange(y.size, dtype=float))))
    ),
    "second derivative": lambda f: jax.jacfwd(jax.jacfwd(lambda x, y: f(x, y)[-1])),
    "gradient of sine": lambda f: jax.grad(lambda x, y: jnp.sum(jnp.sin(f(x, y)[-1])), argnums=(0, 1)),
    "batch": lambda f: lambda x, y: jax.vmap(lambda s: f(s * x, y))(jnp.array([1.0, 0.5])),
}

SIZES = 3, 2
"""Entries of the two arguments of a function."""

# XLA's complex abs is 0 where squares underflow, so nothing normal is smaller than 1e-140
SPECIAL_NUMBERS = np.array(
    [
        0.0,
        -0.0,
        1.0,
        -1.0,
        0.5,
        -0.5,
        2.0,
        -2.0,
        3.0,
        -2.5,
        np.inf,
        -np.inf,
        5e-310,
        -5e-324,
        1e-140,
        1e300,
        127.5,
        -129.0,
    ]
)


class Function(NamedTuple):
    """A random function of two vectors.

    ``text`` says what it is made of, a step a line.
    """

    call: Callable
    text: str


def function_of(seed: int, names: Sequence[str] | None = None, steps: int = 5) -> Function:
    """A random function of the operations of these names, each step of which uses what the steps before it made."""
    random = np.random.default_rng(seed)
    names = list(OPERATIONS) if names is None else list(names)
    x = [jax.ShapeDtypeStruct((n,), jnp.float64) for n in SIZES]
    program: list[tuple[Callable, tuple[int, ...], int]] = []
    known, text = list(x), []

    def applied(values):
        values = list(values)
        for function, places, k in program:
            values.append(function(*(values[i] for i in places), k))
        return values

    def of_kind(kind: str) -> int:
        """The place of a value of a kind; one that is converted where there is none."""
        if kind == "i":
            fitting = [i for i, a in enumerate(known) if jnp.issubdtype(a.dtype, jnp.integer)]
        else:
            fitting = [i for i, a in enumerate(known) if a.dtype == DTYPES[kind]]
        if fitting and (kind == "f" or random.random() < 0.7):
            newest = [i for i in fitting if i >= len(SIZES)]
            return int(random.choice(newest if newest and random.random() < 0.8 else fitting))
        source = of_kind("f")
        number = float(np.round(random.uniform(-1.0, 1.0), 1))
        if kind == "b":
            convert, said = (lambda a, k: a > number), f"> {number}"
        elif kind == "i":
            t = random.choice(list(INTEGERS))
            convert, said = (lambda a, k: (3.0 * a).astype(INTEGERS[t])), f"3 * . as {t}"
        else:
            convert, said = (lambda a, k: a.astype(DTYPES[kind])), str(np.dtype(DTYPES[kind]))
        return added(convert, (source,), 0, said)

    def added(function, places: tuple[int, ...], k: int, name: str) -> int:
        result = jax.eval_shape(lambda *values: function(*values, k), *(known[i] for i in places))
        program.append((function, places, k))
        known.append(result)
        arguments = ", ".join(f"v{i}" for i in places)
        text.append(f"v{len(known) - 1} = {name}({arguments}; {k})  # {result.dtype}{list(result.shape)}")
        return len(known) - 1

    for _ in range(steps):
        name = str(random.choice(names))
        kinds, function = OPERATIONS[name]
        places = tuple(of_kind(kind) for kind in kinds)
        added(lambda *a, f=function: cut(f(*a)), places, int(random.integers(6)), name)
    if known[-1].dtype != jnp.float64:
        convert = jnp.abs if known[-1].dtype == jnp.complex128 else lambda a: a.astype(jnp.float64)
        added(lambda a, k: convert(a), (len(known) - 1,), 0, "as a number")
    results = [i for i, a in enumerate(known) if i >= len(SIZES)]

    def call(x, y):
        values = applied((x, y))
        outputs = []
        for i in results:
            a = values[i]
            outputs += [jnp.real(a), jnp.imag(a)] if a.dtype == jnp.complex128 else [a.astype(jnp.float64)]
        return outputs

    return Function(call, "\n".join(text))


def points_of(random, count: int) -> list[list[np.ndarray]]:
    """Arguments: ordinary ones, then with special numbers among them, and equal entries."""
    points = []
    for i in range(count):
        arrays = [random.normal(0.0, 1.5, n) for n in SIZES]
        if i % 3:
            arrays = [
                np.where(random.random(a.shape) < 0.5, random.choice(SPECIAL_NUMBERS, a.shape), a) for a in arrays
            ]
        if i % 3 == 2:
            for a in arrays:
                a[-1] = a[0]
        points.append(arrays)
    return points


def primitives_drawn() -> set[str]:
    """Return the names of the primitives that the operations are made of, and their derivatives."""
    found: set[str] = set()

    def collect(jaxpr) -> None:
        for eqn in jaxpr.eqns:
            found.add(eqn.primitive.name)
            for inner in jaxprs_in_params(eqn.params):
                collect(inner)

    for kinds, function in OPERATIONS.values():
        arrays = [jax.ShapeDtypeStruct((3,), jnp.int16 if kind == "i" else DTYPES[kind]) for kind in kinds]
        for k in range(6):
            collect(jax.make_jaxpr(lambda *a, f=function, k=k: f(*a, k))(*arrays).jaxpr)
    for name, summary in (("solve", "gradient"), ("where", "gradient"), ("scatter set", "gradient")):
        closed = jax.make_jaxpr(SUMMARIES[summary](function_of(0, [name], steps=1).call))
        collect(closed(*[jax.ShapeDtypeStruct((n,), jnp.float64) for n in SIZES]).jaxpr)
    return found


class Outcome(NamedTuple):
    """What came of a comparison: ``kind`` is "agrees", "refused" or "differs"; ``text`` says what differs, or why."""

    kind: str
    text: str


LANES = 4

TOLERANT: dict[str, Any] = {"hidden_nan": True, "composed": True, "slack": 64.0}


def _agrees_one_by_one(f: Callable, program, point, found) -> bool:
    """Whether values are JAX's where each operation is compiled by itself: XLA simplifies NaN times a zero away."""
    with jax.disable_jit():
        right = [np.asarray(leaf) for leaf in jax.tree_util.tree_leaves(f(*map(jnp.asarray, point)))]
    try:
        check(program, point, right, found, **TOLERANT)
    except AssertionError:
        return False
    return True


def compared(function: Function, summary: str, seed: int, count: int = 6, machine_code: bool = True) -> Outcome:
    """Compare a function with JAX's at random points."""
    f, points = SUMMARIES[summary](function.call), points_of(np.random.default_rng(seed), count)
    structs = [jax.ShapeDtypeStruct((n,), jnp.float64) for n in SIZES]
    try:
        closed = jax.make_jaxpr(f)(*structs)
    except (NotImplementedError, ValueError, TypeError) as error:  # JAX cannot differentiate it
        return Outcome("refused", f"by JAX: {type(error).__name__} {str(error)[:60]}")
    try:
        program = scalarize(closed)
    except UnsupportedPrimitive as error:
        if isinstance(error, CompilerFault):
            return Outcome("differs", f"the compiler fails: {error}")
        return Outcome("refused", f"{error.primitive} {error.reason}")
    except Exception:
        return Outcome("differs", f"the compiler fails:\n{traceback.format_exc(limit=-3)}")
    right = jax.jit(f)
    expected = [[np.asarray(leaf) for leaf in jax.tree_util.tree_leaves(right(*point))] for point in points]
    try:
        interpreted = [program.evaluate(*point) for point in points]
        ways = {"interpreted": interpreted}
        if machine_code:
            alone = compiled(program)
            ways["machine code"] = [alone(*point) for point in points]
            lanes = compiled(program, LANES)
            for i in range(0, count, LANES):
                some = [points[(i + j) % count] for j in range(LANES)]
                found = lanes(*(np.stack(column) for column in zip(*some, strict=True)))
                for j in range(LANES):
                    for own, one in zip(found, ways["machine code"][(i + j) % count], strict=True):
                        if not np.array_equal(own[j], one, equal_nan=True):
                            return Outcome("differs", f"lane {j} has {own[j]}, a single run {one} at {some[j]}")
    except Exception:
        return Outcome("differs", f"fails at run time:\n{traceback.format_exc(limit=-3)}")
    for way, values in ways.items():
        for point, right, found in zip(points, expected, values, strict=True):
            try:
                check(program, point, right, found, **TOLERANT)
            except AssertionError as error:
                if not _agrees_one_by_one(f, program, point, found):
                    return Outcome("differs", f"{way}, at {[a.tolist() for a in point]}: {error}")
    return Outcome("agrees", "")


def searched(seconds: float, seed: int, names: Sequence[str] | None = None, machine_code: bool = True) -> Counter:
    """Draw functions and compare them until the time is over; print what differs, and count the outcomes."""
    counts: Counter = Counter()
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        random = np.random.default_rng(seed)
        summary = str(random.choice(list(SUMMARIES)))
        function = function_of(seed, names, steps=int(random.integers(1, 6)))
        outcome = compared(function, summary, seed, machine_code=machine_code)
        counts[outcome.kind] += 1
        if outcome.kind == "differs":
            print(f"--- seed {seed}, {summary}\n{function.text}\n{outcome.text}\n", flush=True)
        elif outcome.kind == "refused":
            counts[f"refused: {outcome.text}"] += 1
        if len(counts) and sum(counts[k] for k in ("agrees", "refused", "differs")) % 50 == 0:
            jax.clear_caches()
        seed += 1
    return counts


def main() -> int:
    """Return 1 where something differs."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--seed", type=int, default=None, help="of the first function; by default one of the clock")
    parser.add_argument("--only", nargs="*", help="names of operations")
    parser.add_argument("--no-machine-code", action="store_true")
    given = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    seed = int(time.time()) if given.seed is None else given.seed
    counts = searched(given.seconds, seed, given.only, not given.no_machine_code)
    for name, count in counts.most_common():
        print(f"{count:6}  {name}")
    return int(counts["differs"] > 0)


if __name__ == "__main__":
    raise SystemExit(main())
