"""Small functions at a few points, without a compiler: unrolled, then interpreted with NumPy.

XLA would compile what is then run once, on four points, which takes far longer than to interpret the scalar program.
What is too large for that, or cannot be unrolled, is compiled after all.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from manifolds._arrays import is_traced

from .caching import LRUCache, fingerprint, memoize
from .degrees import array_degree_bound
from .programs import jit_unoptimised
from .scalarize import UnsupportedPrimitive, scalarize
from .traced import trace_callables

MAX_INTERPRETED_INSTRUCTIONS = 30_000
"""Instructions up to which unrolling and interpreting are faster than compiling."""

POINTS_PER_CHUNK = 1_000
"""Points that are taken at once: values in between stay in fast memory."""

MAX_UNROLLED_DIM = 2_000
"""Components of a point from which it is not tried to unroll a function, and points are taken one after another."""

MAX_DEGREE_INSTRUCTIONS = 8_000
"""The same for degrees, which are known of whole arrays too, if less sharply."""


def evaluate_at_points(function: Callable, model: Any, points: np.ndarray) -> Any:
    """``function(model, x)`` for each x of ``points``, shape (m, n): its arrays with the points in front.

    Parameters
    ----------
    function : function from a pytree and an array, shape (n,), to a pytree of float64 arrays
        Not a closure made anew for each call: compiled versions are kept by its identity.
    model : pytree
    points : array, shape (m, n)
    """
    return point_evaluator(function, model, np.shape(points)[1])(points)


@memoize
def point_evaluator(function: Callable, model: Any, dim: int) -> Callable[[np.ndarray], Any]:
    """The map from points, shape (m, dim), to :func:`evaluate_at_points` there, unrolled once."""
    if dim > MAX_UNROLLED_DIM:
        return lambda points: _evaluate_compiled(function, model, points)
    model = trace_callables(model, function, (dim,))
    leaves, form, rebuild = _split_parameters(model)
    values = [np.asarray(leaf, dtype=np.float64) for leaf in leaves]
    known = tuple((value == 0.0).tobytes() for value in values)  # what vanishes makes a program shorter

    def unroll():
        shapes = [jax.ShapeDtypeStruct(value.shape, np.float64) for value in values]
        closed, found = jax.make_jaxpr(lambda arrays, x: function(rebuild(arrays), x), return_shape=True)(
            shapes, jax.ShapeDtypeStruct((dim,), np.float64)
        )
        zeros = [np.where(value == 0.0, 0.0, np.nan) for value in values]
        return scalarize(
            closed, [*zeros, None], max_instructions=MAX_INTERPRETED_INSTRUCTIONS
        ), jax.tree_util.tree_structure(found)

    found = _cached_result("program", (function, form, known, dim), unroll)
    if found is None:
        return lambda points: _evaluate_compiled(function, model, points)
    program, structure = found

    def evaluate_chunk(points):
        own = [np.broadcast_to(value, (len(points), *value.shape)) for value in values]
        return program.evaluate(*own, points, batch=True)

    def evaluate(points):
        portions = np.array_split(points, max(1, -(-len(points) // POINTS_PER_CHUNK)))
        try:
            found = [np.concatenate(parts) for parts in zip(*map(evaluate_chunk, portions), strict=True)]
        except Exception:  # a fault of the interpreter: XLA is slower, and right
            return _evaluate_compiled(function, model, points)
        return jax.tree_util.tree_unflatten(structure, found)

    return evaluate


def polynomial_degree(function: Callable, model: Any, dim: int) -> float:
    """Degree of ``function(model, x)`` as a polynomial in x, shape (dim,), for any parameters; an upper bound.

    Infinity where it is not written as a polynomial. The arrays of the model are the parameters.
    """
    leaves, form, rebuild = _split_parameters(model)

    def degree() -> float:
        shapes = [jax.ShapeDtypeStruct(np.shape(leaf), np.float64) for leaf in leaves]
        closed = jax.make_jaxpr(lambda arrays, x: function(rebuild(arrays), x))(
            shapes, jax.ShapeDtypeStruct((dim,), np.float64)
        )
        if any(isinstance(constant, jax.core.Tracer) for constant in closed.consts):
            return math.inf  # a function that closes over what is being traced
        with jax.ensure_compile_time_eval():  # this may be asked while something else is traced
            try:
                return scalarize(closed, max_instructions=MAX_DEGREE_INSTRUCTIONS).degree(len(leaves))
            except UnsupportedPrimitive:
                return array_degree_bound(closed, len(leaves))

    return _cached_result("degree", (function, form, dim), degree)


def vanishing_entries(function: Callable, model: Any, *shapes: tuple[int, ...]) -> frozenset[int]:
    """Return the entries of ``function(model, *arrays)`` that are zero for any parameters and any arrays.

    The arrays of the model are the parameters. The entries are counted in row-major order; none is known of a function
    that cannot be unrolled, or that closes over what is being traced.
    """
    leaves, form, rebuild = _split_parameters(model)

    def entries() -> frozenset[int]:
        arrays = [jax.ShapeDtypeStruct(shape, np.float64) for shape in (*map(np.shape, leaves), *shapes)]
        closed = jax.make_jaxpr(lambda *a: function(rebuild(a[: len(leaves)]), *a[len(leaves) :]))(*arrays)
        if any(isinstance(constant, jax.core.Tracer) for constant in closed.consts):
            return frozenset()
        with jax.ensure_compile_time_eval():  # this may be asked while something else is traced
            (values,) = scalarize(closed, max_instructions=MAX_DEGREE_INSTRUCTIONS).outputs
        return frozenset(i for i, value in enumerate(values) if type(value) is not str and value == 0.0)

    return _cached_result("zeros", (function, form, shapes), entries) or frozenset()


def _split_parameters(model: Any) -> tuple[list, Any, Callable]:
    """The parameters of a model, which are real arrays; a key of its form; and how it is put together again."""
    dynamic, static = eqx.partition(model, _is_parameter)
    leaves, structure = jax.tree_util.tree_flatten(dynamic)
    form = fingerprint(static), structure, tuple(np.shape(leaf) for leaf in leaves)
    return leaves, form, lambda arrays: eqx.combine(jax.tree_util.tree_unflatten(structure, arrays), static)


def _is_parameter(leaf) -> bool:
    return eqx.is_inexact_array(leaf) and leaf.dtype == np.float64


_unrolled_cache: LRUCache[Any] = LRUCache(128)


def _cached_result(what: str, key: tuple, find: Callable) -> Any:
    """What is found for a function and models of one form, once; None where it cannot be unrolled."""

    def compute():
        try:
            return find()
        except UnsupportedPrimitive:
            return None

    _, form, *_ = key
    return compute() if form[0] is None else _unrolled_cache.get_or_compute((what, key), compute)


def _evaluate_compiled(function: Callable, model: Any, points: np.ndarray) -> Any:
    # this may be asked while something else is traced; where nothing is, constants need no programs of their own
    traced = is_traced(jnp.zeros(()))
    with jax.ensure_compile_time_eval() if traced else contextlib.nullcontext():
        return jax.tree_util.tree_map(np.asarray, _map_over_points(function, model, jnp.asarray(points)))


@jit_unoptimised
def _map_over_points(function, model, points):
    def one(x):
        return function(model, x)

    # products of many large matrices at once are slower than one after another
    return jax.lax.map(one, points) if points.shape[1] > MAX_UNROLLED_DIM else jax.vmap(one)(points)
