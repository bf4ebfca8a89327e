"""A cache of programs compiled by XLA, found by their content; the least recently used are unloaded.

A compiled program takes several hundred memory maps of the 65,530 that Linux grants a process, and ``jax.jit`` keeps
thousands of programs.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from manifolds._arrays import is_traced

from .caching import LRUCache

MAX_CACHED_PROGRAMS = 48
"""Largest number of compiled programs in memory; each takes at most 500 memory maps."""

FunctionT = TypeVar("FunctionT", bound=Callable)

_program_cache: LRUCache[Callable] = LRUCache(MAX_CACHED_PROGRAMS)

MAX_CACHED_SUBPROGRAMS = 512
"""Largest number of traced, uncompiled subprograms in memory."""

_subprogram_cache: LRUCache[Callable] = LRUCache(MAX_CACHED_SUBPROGRAMS)


UNOPTIMISED_XLA_OPTIONS = {"xla_backend_optimization_level": 0, "xla_cpu_use_fusion_emitters": False}
"""Options for a program that runs once or twice: optimising it, or fusing its loops, takes longer than it saves."""


def jit_cached(function: FunctionT) -> FunctionT:
    """Decorator: compile a function of pytrees; arrays are its arguments, and other leaves are part of the program."""
    return _jit_with_options(function, None)


def jit_unoptimised(function: FunctionT) -> FunctionT:
    """Decorator: compile a function of pytrees without optimisation, for a function that a run calls once or twice."""
    return _jit_with_options(function, UNOPTIMISED_XLA_OPTIONS)


def subprogram(function: FunctionT) -> FunctionT:
    """Decorator: trace a function of pytrees once for all places where a program calls it.

    The function is called directly if no argument is traced, or if an argument cannot be hashed.
    """

    @functools.wraps(function)
    def call(*arguments):
        if not any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree_util.tree_leaves(arguments)):
            return function(*arguments)
        array_function, dynamic, key = _split_arguments(function, arguments)
        try:
            hash(key)
        except TypeError:
            return array_function(dynamic)
        return _subprogram_cache.get_or_compute(key, lambda: jax.jit(array_function))(dynamic)

    return call  # type: ignore[return-value]


def _jit_with_options(function: FunctionT, options: dict | None) -> FunctionT:
    @functools.wraps(function)
    def call(*arguments):
        array_function, dynamic, key = _split_arguments(function, arguments)
        compiler_options = None if options is None or _is_being_traced(dynamic) else options
        return _program_cache.get_or_compute(
            (key, compiler_options is None), lambda: jax.jit(array_function, compiler_options=compiler_options)
        )(dynamic)

    return call  # type: ignore[return-value]


def _is_being_traced(arrays: tuple) -> bool:
    """Return whether a call belongs to a program that is being traced, whose own options apply."""
    return is_traced(arrays, jnp.zeros(()))


def _strip_weak_type(array):
    """Return an array without JAX's weak type, which a Python number has and which would need another program."""
    is_weak = getattr(array, "weak_type", False) and not isinstance(array, jax.core.Tracer)
    return np.asarray(array) if is_weak else array


def _split_arguments(function: Callable, arguments: tuple) -> tuple[_ArrayFunction, tuple, tuple]:
    """Return a function of the arrays among the arguments, these arrays, and a key of all the rest."""
    leaves, structure = jax.tree_util.tree_flatten(arguments)
    dynamic = tuple(_strip_weak_type(leaf) if eqx.is_array(leaf) else None for leaf in leaves)
    static = tuple(None if eqx.is_array(leaf) else leaf for leaf in leaves)
    shapes = tuple(None if leaf is None else (np.shape(leaf), leaf.dtype) for leaf in dynamic)
    key = function, structure, tuple((type(leaf), leaf) for leaf in static), shapes
    return _ArrayFunction(function, structure, static), dynamic, key


class _ArrayFunction:
    """A function of the arrays among its arguments; the other arguments are fixed."""

    def __init__(self, function: Callable, structure, static: tuple):
        self.function, self.structure, self.static = function, structure, static
        self.__name__ = function.__name__

    def __call__(self, dynamic: tuple):
        leaves = [d if s is None else s for d, s in zip(dynamic, self.static, strict=True)]
        return self.function(*jax.tree_util.tree_unflatten(self.structure, leaves))
