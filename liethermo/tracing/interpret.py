"""Evaluation of small functions at a few points without a compiler: they are unrolled, then interpreted with NumPy.

XLA would take far longer to compile a program that runs once, on four points. A function that is too large, or that
cannot be unrolled, is compiled.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal

from manifolds._arrays import is_traced

from .caching import LRUCache, memoize, pytree_key_or_none
from .index_check import check_indices
from .programs import jit_unoptimised
from .scalarize import UnsupportedPrimitive, scalarize
from .searches import count_scalar_operations
from .traced import has_plain_functions_or_floats, is_library_object, trace_callables

DEGREE_PRESERVING = frozenset(
    "add sub add_any neg copy reshape transpose squeeze broadcast_in_dim rev slice concatenate pad reduce_sum cumsum "
    "expand_dims split optimization_barrier".split()
)
"""Primitives that are linear in all arguments together: a result has the largest degree of an argument."""

INDEXED_PRIMITIVES = {"gather": 1, "dynamic_slice": 1, "dynamic_update_slice": 2}
"""Primitives that move entries by index, with the number of arguments that hold entries; the others hold indices."""

PRODUCT_PRIMITIVES = frozenset(["mul", "dot_general", "conv_general_dilated"])
"""Bilinear primitives, whose results have the sum of the degrees of their arguments."""

CALL_PRIMITIVES = frozenset(["jit", "pjit", "closed_call", "core_call", "checkpoint", "remat2", "custom_jvp_call"])
"""Primitives that call a jaxpr."""


def jaxpr_degree_bound(closed_jaxpr: ClosedJaxpr, input_index: int) -> float:
    """Return an upper bound of the degree of the outputs as polynomials in one of the inputs, or infinity.

    All entries of an array share the largest degree among them, so the cost does not depend on the size of arrays.
    """
    input_degrees = [1.0 if i == input_index else 0.0 for i in range(len(closed_jaxpr.jaxpr.invars))]
    return max(_output_degrees(closed_jaxpr.jaxpr, input_degrees), default=0.0)


def _output_degrees(jaxpr: Jaxpr, input_degrees: Sequence[float]) -> list[float]:
    """Return the degree of each output of a jaxpr, from the degrees of its inputs."""
    degrees = dict(zip(jaxpr.invars, input_degrees, strict=True))

    def degree(atom) -> float:
        return 0.0 if isinstance(atom, Literal) else degrees.get(atom, 0.0)

    for equation in jaxpr.eqns:
        argument_degrees = [degree(atom) for atom in equation.invars]
        results = _equation_degrees(equation, argument_degrees) if any(argument_degrees) else [0.0]
        results = results if len(results) > 1 else results * len(equation.outvars)
        degrees.update(zip(equation.outvars, results, strict=True))
    return [degree(atom) for atom in jaxpr.outvars]


def _equation_degrees(equation, argument_degrees: list[float]) -> list[float]:
    """Return the degrees of the results of one equation: one degree for all results, or one for each."""
    name, parameters = equation.primitive.name, equation.params
    if name in DEGREE_PRESERVING:
        return [max(argument_degrees)]
    if name in PRODUCT_PRIMITIVES:
        return [sum(argument_degrees)]
    if name in INDEXED_PRIMITIVES:
        entry_degrees, index_degrees = (
            argument_degrees[: INDEXED_PRIMITIVES[name]],
            argument_degrees[INDEXED_PRIMITIVES[name] :],
        )
        return [math.inf if any(index_degrees) else max(entry_degrees)]
    if name == "div" and not argument_degrees[1]:
        return [argument_degrees[0]]
    if name == "square":
        return [2.0 * argument_degrees[0]]
    if name == "integer_pow" and parameters["y"] >= 0:
        return [parameters["y"] * argument_degrees[0]]
    if name == "select_n" and not argument_degrees[0]:
        return [max(argument_degrees[1:])]
    if name in CALL_PRIMITIVES:
        inner = parameters.get("jaxpr", parameters.get("call_jaxpr"))
        return _output_degrees(inner.jaxpr if isinstance(inner, ClosedJaxpr) else inner, argument_degrees)
    return [math.inf]


MAX_INTERPRETED_INSTRUCTIONS = 30_000
"""Largest number of instructions of an interpreted program; a longer one is faster to compile."""

MAX_DENSE_OPERATIONS = 1_000_000
"""Largest number of operations, those on zeros included, of a function that is unrolled.

Zeros shorten an unrolled program, to a fifteenth for su(4); above this limit none was short enough to be interpreted.
"""

POINTS_PER_CHUNK = 1_000
"""Number of points evaluated together; their intermediate values stay in the processor's cache."""

MAX_UNROLLED_DIM = 2_000
"""Largest dimension of points at which a function is unrolled; for more it is compiled and mapped over the points."""

MAX_DEGREE_INSTRUCTIONS = 8_000
"""Largest number of instructions unrolled to find a degree; then :func:`jaxpr_degree_bound` gives a looser bound."""


def evaluate_at_points(function: Callable, pytree: Any, points: np.ndarray) -> Any:
    """Return ``function(pytree, x)`` for each x of ``points``, shape (m, n), as arrays whose first axis is the points.

    Parameters
    ----------
    function : function from a pytree and an array, shape (n,), to a pytree of float64 arrays
        It must not be a closure made anew for each call, because compiled versions are cached by its identity.
    pytree : pytree
    points : array, shape (m, n)
    """
    return make_batch_evaluator(function, pytree, np.shape(points)[1])(points)


@memoize
def make_batch_evaluator(function: Callable, pytree: Any, dim: int) -> Callable[[np.ndarray], Any]:
    """Return a function that evaluates an unrolled ``function(pytree, x)`` for each x of points, shape (m, dim)."""
    if dim > MAX_UNROLLED_DIM:
        return lambda points: _evaluate_compiled(function, pytree, points)
    if has_plain_functions_or_floats(pytree):
        pytree = trace_callables(pytree, function, (dim,))
    leaves, model_key, rebuild = _parameters_and_static_key_and_rebuilder(pytree)
    values = [np.asarray(leaf, dtype=np.float64) for leaf in leaves]
    zero_pattern = tuple((value == 0.0).tobytes() for value in values)  # zeros shorten the program

    def unroll_program_and_structure():
        shapes = [jax.ShapeDtypeStruct(value.shape, np.float64) for value in values]
        closed_jaxpr, result_shapes = jax.make_jaxpr(lambda arrays, x: function(rebuild(arrays), x), return_shape=True)(
            shapes, jax.ShapeDtypeStruct((dim,), np.float64)
        )
        if not is_library_object(pytree):
            check_indices(closed_jaxpr)
        if count_scalar_operations(closed_jaxpr.jaxpr) > MAX_DENSE_OPERATIONS:
            raise UnsupportedPrimitive(function.__name__, "", "within the size limit", too_large=True)
        zeros = [np.where(value == 0.0, 0.0, np.nan) for value in values]
        return scalarize(
            closed_jaxpr, [*zeros, None], max_instructions=MAX_INTERPRETED_INSTRUCTIONS
        ), jax.tree_util.tree_structure(result_shapes)

    program_and_structure = _cached_result_or_none(
        "program", (function, model_key, zero_pattern, dim), unroll_program_and_structure
    )
    if program_and_structure is None:
        return lambda points: _evaluate_compiled(function, pytree, points)
    program, structure = program_and_structure

    def evaluate_chunk(points):
        parameters = [np.broadcast_to(value, (len(points), *value.shape)) for value in values]
        return program.evaluate(*parameters, points, batch=True)

    def evaluate(points):
        chunks = np.array_split(points, max(1, -(-len(points) // POINTS_PER_CHUNK)))
        try:
            results = [
                np.concatenate(chunk_results) for chunk_results in zip(*map(evaluate_chunk, chunks), strict=True)
            ]
        except Exception:  # a fault of the interpreter; XLA is slower but right
            return _evaluate_compiled(function, pytree, points)
        return jax.tree_util.tree_unflatten(structure, results)

    return evaluate


def polynomial_degree_bound(function: Callable, pytree: Any, dim: int) -> float:
    """Return an upper bound of the degree of ``function(pytree, x)`` in x, shape (dim,), for any parameters.

    The bound is infinite if the function is not written as a polynomial. The float64 arrays of the pytree are the
    parameters.
    """
    leaves, model_key, rebuild = _parameters_and_static_key_and_rebuilder(pytree)

    def compute_degree() -> float:
        shapes = [jax.ShapeDtypeStruct(np.shape(leaf), np.float64) for leaf in leaves]
        closed_jaxpr = jax.make_jaxpr(lambda arrays, x: function(rebuild(arrays), x))(
            shapes, jax.ShapeDtypeStruct((dim,), np.float64)
        )
        if any(isinstance(constant, jax.core.Tracer) for constant in closed_jaxpr.consts):
            return math.inf  # the function closes over a tracer
        with jax.ensure_compile_time_eval():  # another function may be being traced
            try:
                return scalarize(closed_jaxpr, max_instructions=MAX_DEGREE_INSTRUCTIONS).degree_bound(len(leaves))
            except UnsupportedPrimitive:
                return jaxpr_degree_bound(closed_jaxpr, len(leaves))

    return _cached_result_or_none("degree", (function, model_key, dim), compute_degree)


def vanishing_entry_indices(function: Callable, pytree: Any, *shapes: tuple[int, ...]) -> frozenset[int]:
    """Return the indices of the entries of ``function(pytree, *arrays)`` that are zero for any values of arrays.

    The float64 arrays of the pytree are the parameters. Entries are counted in row-major order. The result is empty for
    a function that cannot be unrolled or that closes over a tracer.
    """
    leaves, model_key, rebuild = _parameters_and_static_key_and_rebuilder(pytree)

    def find_vanishing_entries() -> frozenset[int]:
        arrays = [jax.ShapeDtypeStruct(shape, np.float64) for shape in (*map(np.shape, leaves), *shapes)]
        closed_jaxpr = jax.make_jaxpr(lambda *a: function(rebuild(a[: len(leaves)]), *a[len(leaves) :]))(*arrays)
        if any(isinstance(constant, jax.core.Tracer) for constant in closed_jaxpr.consts):
            return frozenset()
        with jax.ensure_compile_time_eval():  # another function may be being traced
            (values,) = scalarize(closed_jaxpr, max_instructions=MAX_DEGREE_INSTRUCTIONS).outputs
        return frozenset(i for i, value in enumerate(values) if type(value) is not str and value == 0.0)

    return _cached_result_or_none("zeros", (function, model_key, shapes), find_vanishing_entries) or frozenset()


def _parameters_and_static_key_and_rebuilder(pytree: Any) -> tuple[list, Any, Callable]:
    """Return the parameters of a pytree (its float64 arrays), a key of all else, and a function that rebuilds it."""
    dynamic, static = eqx.partition(pytree, _is_float64_array)
    leaves, structure = jax.tree_util.tree_flatten(dynamic)
    model_key = pytree_key_or_none(static), structure, tuple(np.shape(leaf) for leaf in leaves)
    return leaves, model_key, lambda arrays: eqx.combine(jax.tree_util.tree_unflatten(structure, arrays), static)


def _is_float64_array(leaf) -> bool:
    """Return whether a leaf of a pytree is a float64 array."""
    return eqx.is_inexact_array(leaf) and leaf.dtype == np.float64


_unrolled_cache: LRUCache[Any] = LRUCache(128)


def _cached_result_or_none(result_name: str, key: tuple, compute: Callable) -> Any:
    """Return ``compute()``, cached by the name of the result and a key; None if the function cannot be unrolled.

    The key begins with a function and the key of a pytree, whose first entry is None if nothing is to be cached.
    """

    def compute_or_none():
        try:
            return compute()
        except UnsupportedPrimitive:
            return None

    _, model_key, *_ = key
    return (
        compute_or_none()
        if model_key[0] is None
        else _unrolled_cache.get_or_compute((result_name, key), compute_or_none)
    )


def _evaluate_compiled(function: Callable, pytree: Any, points: np.ndarray) -> Any:
    """Return ``function(pytree, x)`` for each x of points, shape (m, n), compiled by XLA."""
    # another function may be being traced; without one, compile-time evaluation would compile each constant
    is_tracing = is_traced(jnp.zeros(()))
    with jax.ensure_compile_time_eval() if is_tracing else contextlib.nullcontext():
        return jax.tree_util.tree_map(np.asarray, _map_over_points(function, pytree, jnp.asarray(points)))


@jit_unoptimised
def _map_over_points(function, pytree, points):
    def evaluate_point(x):
        return function(pytree, x)

    # products of many large matrices at once are slower than one after another
    return (
        jax.lax.map(evaluate_point, points) if points.shape[1] > MAX_UNROLLED_DIM else jax.vmap(evaluate_point)(points)
    )
