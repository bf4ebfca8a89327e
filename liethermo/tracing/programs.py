"""Programs that XLA compiles, found again by what they do, and unloaded when too many others have been used since.

One takes some hundred memory maps of the 65,530 that Linux grants a process, and ``jax.jit`` keeps thousands.
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
"""Programs held in memory, those last used: of 500 maps each at most."""

FunctionT = TypeVar("FunctionT", bound=Callable)

_program_cache: LRUCache[Callable] = LRUCache(MAX_CACHED_PROGRAMS)

MAX_CACHED_SUBPROGRAMS = 512
"""Parts of programs held in memory, those last used: traced, and not compiled."""

_subprogram_cache: LRUCache[Callable] = LRUCache(MAX_CACHED_SUBPROGRAMS)


UNOPTIMISED_XLA_OPTIONS = {"xla_backend_optimization_level": 0, "xla_cpu_use_fusion_emitters": False}
"""How a program is compiled that is run once: to optimise it, or to join its loops, takes longer than it would save."""


def jit_program(function: FunctionT) -> FunctionT:
    """Decorator: compile a function of pytrees, arrays being its arguments and all else a part of the program."""
    return _jit_with_options(function, None)


def jit_unoptimised(function: FunctionT) -> FunctionT:
    """The same, for a function that a run calls once or twice."""
    return _jit_with_options(function, UNOPTIMISED_XLA_OPTIONS)


def subprogram(function: FunctionT) -> FunctionT:
    """Decorator: trace a function of pytrees once for all places of a program that it is a part of.

    Called outside of one, and with what cannot be told from others, it is as it was.
    """

    @functools.wraps(function)
    def call(*arguments):
        if not any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree_util.tree_leaves(arguments)):
            return function(*arguments)
        whole, dynamic, key = _split_arguments(function, arguments)
        try:
            hash(key)
        except TypeError:
            return whole(dynamic)
        return _subprogram_cache.get_or_compute(key, lambda: jax.jit(whole))(dynamic)

    return call  # type: ignore[return-value]


def _jit_with_options(function: FunctionT, options: dict | None) -> FunctionT:
    @functools.wraps(function)
    def call(*arguments):
        whole, dynamic, key = _split_arguments(function, arguments)
        own = None if options is None or _is_being_traced(dynamic) else options
        return _program_cache.get_or_compute((key, own is None), lambda: jax.jit(whole, compiler_options=own))(dynamic)

    return call  # type: ignore[return-value]


def _is_being_traced(dynamic: tuple) -> bool:
    """Whether a call is a part of another program, which is compiled in its own way; or may become one."""
    return is_traced(dynamic, jnp.zeros(()))


def _strip_weak_type(array):
    """An array of a type of its own: for one made from a Python number, JAX would compile another program."""
    weak = getattr(array, "weak_type", False) and not isinstance(array, jax.core.Tracer)
    return np.asarray(array) if weak else array


def _split_arguments(function: Callable, arguments: tuple) -> tuple[_ArrayFunction, tuple, tuple]:
    """A function of the arrays among its arguments, these, and a key that tells it from others."""
    leaves, structure = jax.tree_util.tree_flatten(arguments)
    dynamic = tuple(_strip_weak_type(leaf) if eqx.is_array(leaf) else None for leaf in leaves)
    static = tuple(None if eqx.is_array(leaf) else leaf for leaf in leaves)
    shapes = tuple(None if leaf is None else (np.shape(leaf), leaf.dtype) for leaf in dynamic)
    key = function, structure, tuple((type(leaf), leaf) for leaf in static), shapes
    return _ArrayFunction(function, structure, static), dynamic, key


class _ArrayFunction:
    """A function of the arrays among its arguments alone."""

    def __init__(self, function: Callable, structure, static: tuple):
        self.function, self.structure, self.static = function, structure, static
        self.__name__ = function.__name__

    def __call__(self, dynamic: tuple):
        leaves = [d if s is None else s for d, s in zip(dynamic, self.static, strict=True)]
        return self.function(*jax.tree_util.tree_unflatten(self.structure, leaves))
