"""Comparison of the scalar compiler with JAX, on random compositions of every primitive that it supports.

``python -m tests.fuzz --seconds 60`` (``make fuzz SECONDS=60``) draws functions until the time is over. It compares
values, gradients, second derivatives and lanes, at random points and at special ones: zeros of both signs, infinity,
subnormal numbers, equal entries. A difference is printed with the seed of its function.
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

from liethermo.tracing.scalarize import CompilerFault, UnsupportedPrimitive, scalarize
from liethermo.tracing.searches import iterate_equations
from tests.fuzz_operations import DTYPES, INTEGER_DTYPES, OPERATIONS, limit_size
from tests.machine_code import compile_program
from tests.scalar_programs import check_outputs

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

ARGUMENT_SIZES = 3, 2
"""Number of entries of the two arguments of a function."""

# no normal number below 1e-140, because XLA's complex abs is 0 where squares underflow
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
    """A random function of two vectors; ``text`` describes it, one step a line."""

    call: Callable
    text: str


def random_function(seed: int, names: Sequence[str] | None = None, steps: int = 5) -> Function:
    """Compose random operations of these names; each step uses the arguments and the results of previous steps."""
    rng = np.random.default_rng(seed)
    names = list(OPERATIONS) if names is None else list(names)
    program: list[tuple[Callable, tuple[int, ...], int]] = []
    values = [jax.ShapeDtypeStruct((n,), jnp.float64) for n in ARGUMENT_SIZES]
    lines: list[str] = []

    def evaluate(arrays):
        results = list(arrays)
        for function, indices, k in program:
            results.append(function(*(results[i] for i in indices), k))
        return results

    def value_of_kind(kind: str) -> int:
        """Return the index of a value of a kind, converting one if there is none."""
        if kind == "i":
            candidates = [i for i, a in enumerate(values) if jnp.issubdtype(a.dtype, jnp.integer)]
        else:
            candidates = [i for i, a in enumerate(values) if a.dtype == DTYPES[kind]]
        if candidates and (kind == "f" or rng.random() < 0.7):
            results_of_kind = [i for i in candidates if i >= len(ARGUMENT_SIZES)]
            return int(rng.choice(results_of_kind if results_of_kind and rng.random() < 0.8 else candidates))
        source = value_of_kind("f")
        number = float(np.round(rng.uniform(-1.0, 1.0), 1))
        if kind == "b":
            convert, description = (lambda a, k: a > number), f"> {number}"
        elif kind == "i":
            dtype_name = rng.choice(list(INTEGER_DTYPES))
            convert, description = (lambda a, k: (3.0 * a).astype(INTEGER_DTYPES[dtype_name])), f"3 * . as {dtype_name}"
        else:
            convert, description = (lambda a, k: a.astype(DTYPES[kind])), str(np.dtype(DTYPES[kind]))
        return add_step(convert, (source,), 0, description)

    def add_step(function, indices: tuple[int, ...], k: int, name: str) -> int:
        result = jax.eval_shape(lambda *arrays: function(*arrays, k), *(values[i] for i in indices))
        program.append((function, indices, k))
        values.append(result)
        arguments = ", ".join(f"v{i}" for i in indices)
        lines.append(f"v{len(values) - 1} = {name}({arguments}; {k})  # {result.dtype}{list(result.shape)}")
        return len(values) - 1

    for _ in range(steps):
        name = str(rng.choice(names))
        kinds, function = OPERATIONS[name]
        indices = tuple(value_of_kind(kind) for kind in kinds)
        add_step(lambda *a, f=function: limit_size(f(*a)), indices, int(rng.integers(6)), name)
    if values[-1].dtype != jnp.float64:
        convert = jnp.abs if values[-1].dtype == jnp.complex128 else lambda a: a.astype(jnp.float64)
        add_step(lambda a, k: convert(a), (len(values) - 1,), 0, "as a number")
    outputs = [i for i, a in enumerate(values) if i >= len(ARGUMENT_SIZES)]

    def call(x, y):
        results = evaluate((x, y))
        arrays = []
        for i in outputs:
            a = results[i]
            arrays += [jnp.real(a), jnp.imag(a)] if a.dtype == jnp.complex128 else [a.astype(jnp.float64)]
        return arrays

    return Function(call, "\n".join(lines))


def random_points(rng, count: int) -> list[list[np.ndarray]]:
    """Draw arguments: in turn ordinary ones, ones with special numbers, and ones with equal entries too."""
    points = []
    for i in range(count):
        arrays = [rng.normal(0.0, 1.5, n) for n in ARGUMENT_SIZES]
        if i % 3:
            arrays = [np.where(rng.random(a.shape) < 0.5, rng.choice(SPECIAL_NUMBERS, a.shape), a) for a in arrays]
        if i % 3 == 2:
            for a in arrays:
                a[-1] = a[0]
        points.append(arrays)
    return points


def drawn_primitives() -> set[str]:
    """Return the names of the primitives in all operations and in some of their derivatives."""
    names: set[str] = set()

    def collect(jaxpr) -> None:
        names.update(eqn.primitive.name for eqn, _ in iterate_equations(jaxpr))

    for kinds, function in OPERATIONS.values():
        arrays = [jax.ShapeDtypeStruct((3,), jnp.int16 if kind == "i" else DTYPES[kind]) for kind in kinds]
        for k in range(6):
            collect(jax.make_jaxpr(lambda *a, f=function, k=k: f(*a, k))(*arrays).jaxpr)
    for name, summary in (("solve", "gradient"), ("where", "gradient"), ("scatter set", "gradient")):
        trace = jax.make_jaxpr(SUMMARIES[summary](random_function(0, [name], steps=1).call))
        collect(trace(*[jax.ShapeDtypeStruct((n,), jnp.float64) for n in ARGUMENT_SIZES]).jaxpr)
    return names


class Outcome(NamedTuple):
    """The result of a comparison: ``kind`` is "agrees", "refused" or "differs"; ``text`` gives the reason."""

    kind: str
    text: str


LANES = 4
"""Number of lanes of the programs that are compared with single runs."""

CHECK_OPTIONS: dict[str, Any] = {"hidden_nan": True, "perturb_zeros": True, "slack": 64.0}
"""Options of :func:`check_outputs` for random functions, whose rounding errors accumulate."""


def _agrees_without_jit(f: Callable, program, point, outputs) -> bool:
    """Return whether outputs agree with JAX operation by operation; jitted, XLA may simplify NaN times zero to zero."""
    with jax.disable_jit():
        expected = [np.asarray(leaf) for leaf in jax.tree_util.tree_leaves(f(*map(jnp.asarray, point)))]
    try:
        check_outputs(program, point, expected, outputs, **CHECK_OPTIONS)
    except AssertionError:
        return False
    return True


def compare_with_jax(function: Function, summary: str, seed: int, count: int = 6, machine_code: bool = True) -> Outcome:
    """Compare a function, compiled to a scalar program, with JAX at random points."""
    f, points = SUMMARIES[summary](function.call), random_points(np.random.default_rng(seed), count)
    structs = [jax.ShapeDtypeStruct((n,), jnp.float64) for n in ARGUMENT_SIZES]
    try:
        closed_jaxpr = jax.make_jaxpr(f)(*structs)
    except (NotImplementedError, ValueError, TypeError) as error:  # JAX cannot differentiate it
        return Outcome("refused", f"by JAX: {type(error).__name__} {str(error)[:60]}")
    try:
        program = scalarize(closed_jaxpr)
    except UnsupportedPrimitive as error:
        if isinstance(error, CompilerFault):
            return Outcome("differs", f"the compiler fails: {error}")
        return Outcome("refused", f"{error.primitive} {error.reason}")
    except Exception:
        return Outcome("differs", f"the compiler fails:\n{traceback.format_exc(limit=-3)}")
    jax_function = jax.jit(f)
    expected = [[np.asarray(leaf) for leaf in jax.tree_util.tree_leaves(jax_function(*point))] for point in points]
    try:
        outputs_by_engine = {"interpreted": [program.evaluate(*point) for point in points]}
        if machine_code:
            run_single = compile_program(program)
            single_outputs = [run_single(*point) for point in points]
            outputs_by_engine["machine code"] = single_outputs
            run_lanes = compile_program(program, LANES)
            for i in range(0, count, LANES):
                lane_points = [points[(i + j) % count] for j in range(LANES)]
                lane_outputs = run_lanes(*(np.stack(column) for column in zip(*lane_points, strict=True)))
                for j in range(LANES):
                    for lane_output, single in zip(lane_outputs, single_outputs[(i + j) % count], strict=True):
                        if not np.array_equal(lane_output[j], single, equal_nan=True):
                            return Outcome(
                                "differs", f"lane {j} has {lane_output[j]}, a single run {single} at {lane_points[j]}"
                            )
    except Exception:
        return Outcome("differs", f"fails at run time:\n{traceback.format_exc(limit=-3)}")
    for engine, point_outputs in outputs_by_engine.items():
        for point, reference, outputs in zip(points, expected, point_outputs, strict=True):
            try:
                check_outputs(program, point, reference, outputs, **CHECK_OPTIONS)
            except AssertionError as error:
                if not _agrees_without_jit(f, program, point, outputs):
                    return Outcome("differs", f"{engine}, at {[a.tolist() for a in point]}: {error}")
    return Outcome("agrees", "")


def search_differences(
    seconds: float, seed: int, names: Sequence[str] | None = None, machine_code: bool = True
) -> Counter:
    """Draw functions and compare them until the time is over; print differences, and count the outcomes."""
    counts: Counter = Counter()
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        rng = np.random.default_rng(seed)
        summary = str(rng.choice(list(SUMMARIES)))
        function = random_function(seed, names, steps=int(rng.integers(1, 6)))
        outcome = compare_with_jax(function, summary, seed, machine_code=machine_code)
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
    """Run the search from the command line; return 1 if it found a difference."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--seed", type=int, default=None, help="seed of the first function; by default the time")
    parser.add_argument("--only", nargs="*", help="names of operations")
    parser.add_argument("--no-machine-code", action="store_true")
    args = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    seed = int(time.time()) if args.seed is None else args.seed
    counts = search_differences(args.seconds, seed, args.only, not args.no_machine_code)
    for name, count in counts.most_common():
        print(f"{count:6}  {name}")
    return int(counts["differs"] > 0)


if __name__ == "__main__":
    raise SystemExit(main())
