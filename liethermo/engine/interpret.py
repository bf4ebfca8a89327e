"""Small functions at a few points, without a compiler: unrolled, then interpreted with NumPy.

XLA takes a good part of a second to compile what is then run once, on four points. Interpreting the scalar program
takes milliseconds. What is too large for that, or cannot be unrolled, is compiled after all.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .remembered import fingerprint, remembered
from .scalarize import Program, UnsupportedPrimitive, scalarize

LIMIT = 8_000
"""Instructions up to which interpreting is faster than compiling."""


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
    try:
        program, structure = _unrolled(function, model, (dim,))
    except UnsupportedPrimitive:
        return lambda points: jax.tree_util.tree_map(np.asarray, _compiled(function, model, jnp.asarray(points)))
    return lambda points: jax.tree_util.tree_unflatten(structure, program.evaluate(points, batch=True))


def polynomial_degree(function: Callable, model: Any, dim: int) -> float:
    """Degree of ``function(model, x)`` as a polynomial in x, shape (dim,), for any parameters; an upper bound.

    Infinity where it is not written as a polynomial. The arrays of the model are the parameters.
    """
    dynamic, static = eqx.partition(model, eqx.is_inexact_array)
    leaves, structure = jax.tree_util.tree_flatten(dynamic)
    shapes = [jax.ShapeDtypeStruct(np.shape(leaf), np.float64) for leaf in leaves]
    closed = jax.make_jaxpr(
        lambda arrays, x: function(eqx.combine(jax.tree_util.tree_unflatten(structure, arrays), static), x)
    )(shapes, jax.ShapeDtypeStruct((dim,), np.float64))
    if any(isinstance(constant, jax.core.Tracer) for constant in closed.consts):
        return math.inf  # a function that closes over what is being traced
    try:
        with jax.ensure_compile_time_eval():  # this may be asked while something else is traced
            return scalarize(closed, limit=LIMIT).degree(len(leaves))
    except UnsupportedPrimitive:
        return math.inf


_known: dict[Any, tuple[Program, Any]] = {}

KNOWN = 256
"""Unrolled functions held in memory."""


def _unrolled(function: Callable, model: Any, shape: tuple[int, ...]) -> tuple[Program, Any]:
    """The program, and the structure of its results; the same model, array by array, is unrolled once."""
    model_key = fingerprint((function, model))
    key = None if model_key is None else (model_key, shape)
    if key is not None and key in _known:
        return _known[key]
    closed, found = jax.make_jaxpr(lambda x: function(model, x), return_shape=True)(
        jax.ShapeDtypeStruct(shape, np.float64)
    )
    unrolled = scalarize(closed, limit=LIMIT), jax.tree_util.tree_structure(found)
    if key is not None:
        while len(_known) >= KNOWN:
            del _known[next(iter(_known))]
        _known[key] = unrolled
    return unrolled


@eqx.filter_jit
def _compiled(function, model, points):
    return jax.vmap(lambda x: function(model, x))(points)
