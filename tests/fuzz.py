"""Compare random compositions of every primitive that the scalar compiler claims with JAX.

``python -m tests.fuzz --seconds 60`` (``make fuzz SECONDS=60``) draws functions until the time is over. It compares
values, gradients, second derivatives and lanes, at random points and at special ones: zeros of both signs, infinity,
subnormal numbers, equal entries. Each difference is printed with the seed that makes the same function again.
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
from tests.fuzz_operations import DTYPES, INTEGERS, OPERATIONS, limit_size
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
"""Numbers of entries of the two arguments of a function."""

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
    """Random function of two vectors.

    ``text`` lists its operations, one step a line.
    """

    call: Callable
    text: str


def function_of(seed: int, names: Sequence[str] | None = None, steps: int = 5) -> Function:
    """Return a random function of the named operations, each step of which uses results of earlier steps."""
    random = np.random.default_rng(seed)
    names = list(OPERATIONS) if names is None else list(names)
    x = [jax.ShapeDtypeStruct((n,), jnp.float64) for n in SIZES]
    steps_done: list[tuple[Callable, tuple[int, ...], int]] = []
    abstract_values, text = list(x), []

    def evaluate_steps(values):
        values = list(values)
        for function, places, k in steps_done:
            values.append(function(*(values[i] for i in places), k))
        return values

    def find_value(kind: str) -> int:
        """Return the index of a value of a kind; convert one where there is none."""
        if kind == "i":
            candidates = [i for i, a in enumerate(abstract_values) if jnp.issubdtype(a.dtype, jnp.integer)]
        else:
            candidates = [i for i, a in enumerate(abstract_values) if a.dtype == DTYPES[kind]]
        if candidates and (kind == "f" or random.random() < 0.7):
            results = [i for i in candidates if i >= len(SIZES)]
            return int(random.choice(results if results and random.random() < 0.8 else candidates))
        source = find_value("f")
        number = float(np.round(random.uniform(-1.0, 1.0), 1))
        if kind == "b":
            convert, label = (lambda a, k: a > number), f"> {number}"
        elif kind == "i":
            t = random.choice(list(INTEGERS))
            convert, label = (lambda a, k: (3.0 * a).astype(INTEGERS[t])), f"3 * . as {t}"
        else:
            convert, label = (lambda a, k: a.astype(DTYPES[kind])), str(np.dtype(DTYPES[kind]))
        return add_step(convert, (source,), 0, label)

    def add_step(function, places: tuple[int, ...], k: int, name: str) -> int:
        result = jax.eval_shape(lambda *values: function(*values, k), *(abstract_values[i] for i in places))
        steps_done.append((function, places, k))
        abstract_values.append(result)
        arguments = ", ".join(f"v{i}" for i in places)
        text.append(f"v{len(abstract_values) - 1} = {name}({arguments}; {k})  # {result.dtype}{list(result.shape)}")
        return len(abstract_values) - 1

    for _ in range(steps):
        name = str(random.choice(names))
        kinds, function = OPERATIONS[name]
        places = tuple(find_value(kind) for kind in kinds)
        add_step(lambda *a, f=function: limit_size(f(*a)), places, int(random.integers(6)), name)
    if abstract_values[-1].dtype != jnp.float64:
        convert = jnp.abs if abstract_values[-1].dtype == jnp.complex128 else lambda a: a.astype(jnp.float64)
        add_step(lambda a, k: convert(a), (len(abstract_values) - 1,), 0, "as a number")
    results = [i for i, a in enumerate(abstract_values) if i >= len(SIZES)]

    def call(x, y):
        values = evaluate_steps((x, y))
        outputs = []
        for i in results:
            a = values[i]
            outputs += [jnp.real(a), jnp.imag(a)] if a.dtype == jnp.complex128 else [a.astype(jnp.float64)]
        return outputs

    return Function(call, "\n".join(text))


def points_of(random, count: int) -> list[list[np.ndarray]]:
    """Return ``count`` pairs of arguments: ordinary numbers, then with special numbers among them, and with equal
    entries."""
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
    names: set[str] = set()

    def collect(jaxpr) -> None:
        for eqn in jaxpr.eqns:
            names.add(eqn.primitive.name)
            for inner in jaxprs_in_params(eqn.params):
                collect(inner)

    for kinds, function in OPERATIONS.values():
        arrays = [jax.ShapeDtypeStruct((3,), jnp.int16 if kind == "i" else DTYPES[kind]) for kind in kinds]
        for k in range(6):
            collect(jax.make_jaxpr(lambda *a, f=function, k=k: f(*a, k))(*arrays).jaxpr)
    for name, summary in (("solve", "gradient"), ("where", "gradient"), ("scatter set", "gradient")):
        make_jaxpr = jax.make_jaxpr(SUMMARIES[summary](function_of(0, [name], steps=1).call))
        collect(make_jaxpr(*[jax.ShapeDtypeStruct((n,), jnp.float64) for n in SIZES]).jaxpr)
    return names


class Outcome(NamedTuple):
    """Result of a comparison: ``kind`` is "agrees", "refused" or "differs"; ``text`` names the difference or the
    reason."""

    kind: str
    text: str


LANES = 4

TOLERANT: dict[str, Any] = {"hidden_nan": True, "composed": True, "slack": 64.0}


def _agrees_one_by_one(f: Callable, program, point, outputs) -> bool:
    """Return True if outputs equal JAX's with each operation compiled by itself.

    Compiled together, XLA simplifies NaN times a zero away.
    """
    with jax.disable_jit():
        expected = [np.asarray(leaf) for leaf in jax.tree_util.tree_leaves(f(*map(jnp.asarray, point)))]
    try:
        check(program, point, expected, outputs, **TOLERANT)
    except AssertionError:
        return False
    return True


def compared(function: Function, summary: str, seed: int, count: int = 6, machine_code: bool = True) -> Outcome:
    """Compare a function with JAX's at random points and return the outcome."""
    f, points = SUMMARIES[summary](function.call), points_of(np.random.default_rng(seed), count)
    structs = [jax.ShapeDtypeStruct((n,), jnp.float64) for n in SIZES]
    try:
        jaxpr = jax.make_jaxpr(f)(*structs)
    except (NotImplementedError, ValueError, TypeError) as error:  # JAX cannot differentiate it
        return Outcome("refused", f"by JAX: {type(error).__name__} {str(error)[:60]}")
    try:
        program = scalarize(jaxpr)
    except UnsupportedPrimitive as error:
        if isinstance(error, CompilerFault):
            return Outcome("differs", f"the compiler fails: {error}")
        return Outcome("refused", f"{error.primitive} {error.reason}")
    except Exception:
        return Outcome("differs", f"the compiler fails:\n{traceback.format_exc(limit=-3)}")
    reference = jax.jit(f)
    expected = [[np.asarray(leaf) for leaf in jax.tree_util.tree_leaves(reference(*point))] for point in points]
    try:
        interpreted_values = [program.evaluate(*point) for point in points]
        values_by_engine = {"interpreted": interpreted_values}
        if machine_code:
            run_one = compiled(program)
            values_by_engine["machine code"] = [run_one(*point) for point in points]
            run_lanes = compiled(program, LANES)
            for i in range(0, count, LANES):
                lane_points = [points[(i + j) % count] for j in range(LANES)]
                lane_outputs = run_lanes(*(np.stack(column) for column in zip(*lane_points, strict=True)))
                for j in range(LANES):
                    for lane_output, single_output in zip(
                        lane_outputs, values_by_engine["machine code"][(i + j) % count], strict=True
                    ):
                        if not np.array_equal(lane_output[j], single_output, equal_nan=True):
                            return Outcome(
                                "differs",
                                f"lane {j} has {lane_output[j]}, a single run {single_output} at {lane_points[j]}",
                            )
    except Exception:
        return Outcome("differs", f"fails at run time:\n{traceback.format_exc(limit=-3)}")
    for engine, values in values_by_engine.items():
        for point, expected_outputs, outputs in zip(points, expected, values, strict=True):
            try:
                check(program, point, expected_outputs, outputs, **TOLERANT)
            except AssertionError as error:
                if not _agrees_one_by_one(f, program, point, outputs):
                    return Outcome("differs", f"{engine}, at {[a.tolist() for a in point]}: {error}")
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
    """Compare functions as the command line asks, and return 1 if any differs, otherwise 0."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--seed", type=int, default=None, help="of the first function; by default one of the clock")
    parser.add_argument("--only", nargs="*", help="names of operations")
    parser.add_argument("--no-machine-code", action="store_true")
    arguments = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    seed = int(time.time()) if arguments.seed is None else arguments.seed
    counts = searched(arguments.seconds, seed, arguments.only, not arguments.no_machine_code)
    for name, count in counts.most_common():
        print(f"{count:6}  {name}")
    return int(counts["differs"] > 0)


if __name__ == "__main__":
    raise SystemExit(main())
