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

from .degrees import degree_by_arrays
from .programs import hasty_program
from .remembered import Latest, fingerprint, remembered
from .scalarize import UnsupportedPrimitive, scalarize
from .traced import settled

LIMIT = 30_000
"""Instructions up to which unrolling and interpreting are faster than compiling."""

PORTION = 1_000
"""Points that are taken at once: values in between stay in fast memory."""

LARGE = 2_000
"""Components of a point from which it is not tried to unroll a function, and points are taken one after another."""

LIMIT_FOR_DEGREES = 8_000
"""The same for degrees, which are known of whole arrays too, if less sharply."""


def at_points(function: Callable, model: Any, points: np.ndarray) -> Any:
    """``function(model, x)`` for each x of ``points``, shape (m, n): its arrays with the points in front.

    Parameters
    ----------
    function : function from a pytree and an array, shape (n,), to a pytree of float64 arrays
        Not a closure made anew for each call: compiled versions are kept by its identity.
    model : pytree
    points : array, shape (m, n)
    """
    return evaluator(function, model, np.shape(points)[1])(points)


@remembered
def evaluator(function: Callable, model: Any, dim: int) -> Callable[[np.ndarray], Any]:
    """The map from points, shape (m, dim), to :func:`at_points` there, unrolled once."""
    if dim > LARGE:
        return lambda points: _by_compiler(function, model, points)
    model = settled(model, function, (dim,))
    leaves, form, rebuild = _parts(model)
    values = [np.asarray(leaf, dtype=np.float64) for leaf in leaves]
    known = tuple((value == 0.0).tobytes() for value in values)  # what vanishes makes a program shorter

    def unrolled():
        shapes = [jax.ShapeDtypeStruct(value.shape, np.float64) for value in values]
        closed, found = jax.make_jaxpr(lambda arrays, x: function(rebuild(arrays), x), return_shape=True)(
            shapes, jax.ShapeDtypeStruct((dim,), np.float64)
        )
        zeros = [np.where(value == 0.0, 0.0, np.nan) for value in values]
        return scalarize(closed, [*zeros, None], limit=LIMIT), jax.tree_util.tree_structure(found)

    found = _known("program", (function, form, known, dim), unrolled)
    if found is None:
        return lambda points: _by_compiler(function, model, points)
    program, structure = found

    def evaluated(points):
        own = [np.broadcast_to(value, (len(points), *value.shape)) for value in values]
        return program.evaluate(*own, points, batch=True)

    def interpreted(points):
        portions = np.array_split(points, max(1, -(-len(points) // PORTION)))
        try:
            found = [np.concatenate(parts) for parts in zip(*map(evaluated, portions), strict=True)]
        except Exception:  # a fault of the interpreter: XLA is slower, and right
            return _by_compiler(function, model, points)
        return jax.tree_util.tree_unflatten(structure, found)

    return interpreted


def polynomial_degree(function: Callable, model: Any, dim: int) -> float:
    """Degree of ``function(model, x)`` as a polynomial in x, shape (dim,), for any parameters; an upper bound.

    Infinity where it is not written as a polynomial. The arrays of the model are the parameters.
    """
    leaves, form, rebuild = _parts(model)

    def degree() -> float:
        shapes = [jax.ShapeDtypeStruct(np.shape(leaf), np.float64) for leaf in leaves]
        closed = jax.make_jaxpr(lambda arrays, x: function(rebuild(arrays), x))(
            shapes, jax.ShapeDtypeStruct((dim,), np.float64)
        )
        if any(isinstance(constant, jax.core.Tracer) for constant in closed.consts):
            return math.inf  # a function that closes over what is being traced
        with jax.ensure_compile_time_eval():  # this may be asked while something else is traced
            try:
                return scalarize(closed, limit=LIMIT_FOR_DEGREES).degree(len(leaves))
            except UnsupportedPrimitive:
                return degree_by_arrays(closed, len(leaves))

    return _known("degree", (function, form, dim), degree)


def vanishing_entries(function: Callable, model: Any, *shapes: tuple[int, ...]) -> frozenset[int]:
    """Return the entries of ``function(model, *arrays)`` that are zero for any parameters and any arrays.

    The arrays of the model are the parameters. The entries are counted in row-major order; none is known of a function
    that cannot be unrolled, or that closes over what is being traced.
    """
    leaves, form, rebuild = _parts(model)

    def entries() -> frozenset[int]:
        arrays = [jax.ShapeDtypeStruct(shape, np.float64) for shape in (*map(np.shape, leaves), *shapes)]
        closed = jax.make_jaxpr(lambda *a: function(rebuild(a[: len(leaves)]), *a[len(leaves) :]))(*arrays)
        if any(isinstance(constant, jax.core.Tracer) for constant in closed.consts):
            return frozenset()
        with jax.ensure_compile_time_eval():  # this may be asked while something else is traced
            (values,) = scalarize(closed, limit=LIMIT_FOR_DEGREES).outputs
        return frozenset(i for i, value in enumerate(values) if type(value) is not str and value == 0.0)

    return _known("zeros", (function, form, shapes), entries) or frozenset()


def _parts(model: Any) -> tuple[list, Any, Callable]:
    """The parameters of a model, which are real arrays; a key of its form; and how it is put together again."""
    dynamic, static = eqx.partition(model, _is_parameter)
    leaves, structure = jax.tree_util.tree_flatten(dynamic)
    form = fingerprint(static), structure, tuple(np.shape(leaf) for leaf in leaves)
    return leaves, form, lambda arrays: eqx.combine(jax.tree_util.tree_unflatten(structure, arrays), static)


def _is_parameter(leaf) -> bool:
    return eqx.is_inexact_array(leaf) and leaf.dtype == np.float64


_unrolled: Latest[Any] = Latest(128)


def _known(what: str, key: tuple, find: Callable) -> Any:
    """What is found for a function and models of one form, once; None where it cannot be unrolled."""

    def found():
        try:
            return find()
        except UnsupportedPrimitive:
            return None

    _, form, *_ = key
    return found() if form[0] is None else _unrolled.find((what, key), found)


def _by_compiler(function: Callable, model: Any, points: np.ndarray) -> Any:
    # this may be asked while something else is traced; where nothing is, constants need no programs of their own
    traced = is_traced(jnp.zeros(()))
    with jax.ensure_compile_time_eval() if traced else contextlib.nullcontext():
        return jax.tree_util.tree_map(np.asarray, _compiled(function, model, jnp.asarray(points)))


@hasty_program
def _compiled(function, model, points):
    def one(x):
        return function(model, x)

    # products of many large matrices at once are slower than one after another
    return jax.lax.map(one, points) if points.shape[1] > LARGE else jax.vmap(one)(points)
