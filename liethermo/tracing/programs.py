"""A cache of programs compiled by XLA, found by their content; the least recently used are unloaded.

A compiled program takes several hundred memory maps of the 65,530 that Linux grants a process, and ``jax.jit`` keeps
thousands of programs. Programs that take long to compile are also kept on disk, for other processes
(:mod:`.code_cache`).
"""

from __future__ import annotations

import functools
import hashlib
import os
import time
import zlib
from collections.abc import Callable
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlib
import numpy as np
from jax.experimental import serialize_executable

from manifolds._arrays import is_traced

from .caching import LRUCache
from .code_cache import host_processor, read_machine_code, write_machine_code

MAX_CACHED_PROGRAMS = 48
"""Largest number of compiled programs in memory; each takes at most 500 memory maps."""

FunctionT = TypeVar("FunctionT", bound=Callable)

_program_cache: LRUCache[Callable] = LRUCache(MAX_CACHED_PROGRAMS)

MAX_CACHED_SUBPROGRAMS = 512
"""Largest number of traced, uncompiled subprograms in memory."""

_subprogram_cache: LRUCache[Callable] = LRUCache(MAX_CACHED_SUBPROGRAMS)


LOOP_XLA_OPTIONS = {
    "xla_disable_hlo_passes": "cse_barrier_expander",
    "xla_cpu_enable_concurrency_optimized_scheduler": False,
}
"""Options for a program that runs often, such as the loop of the steps.

XLA drops optimisation barriers on the CPU before it fuses loops, and then computes a field once for each place that
uses it; without this pass they hold. Loops over some thousand numbers are shorter than it takes to start one on another
core, so they run one after another. Each loop over a large array still uses all cores.
"""

UNOPTIMISED_XLA_OPTIONS = {"xla_backend_optimization_level": 0, "xla_cpu_use_fusion_emitters": False}
"""Options for a program that runs once or twice: optimising it, or fusing its loops, takes longer than it saves."""


def jit_cached(function: FunctionT) -> FunctionT:
    """Decorator: compile a function of pytrees; arrays are its arguments, and other leaves are part of the program."""
    return _jit_with_options(function, LOOP_XLA_OPTIONS)


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
        is_part_of_program = _is_being_traced(dynamic)
        program = _program_cache.get_or_compute(
            (key, is_part_of_program),
            lambda: jax.jit(array_function) if is_part_of_program else _compile(array_function, dynamic, options),
        )
        return program(dynamic)

    return call  # type: ignore[return-value]


def _is_being_traced(arrays: tuple) -> bool:
    """Return whether a call belongs to a program that is being traced, whose own options apply."""
    return is_traced(arrays, jnp.zeros(()))


# -- programs on disk -------------------------------------------------------------------------------------------------


MIN_STORED_COMPILE_SECONDS = 0.1
"""Shortest time in seconds of a compilation whose result is written to disk."""


def _compile(function: Callable, arguments: tuple, options: dict | None) -> Callable:
    """Return the program of a function of arrays, from the cache on disk or compiled by XLA.

    The cache is found by the text of the program, so it never returns the program of another function. Programs that
    call Python, or that run on accelerators or on several devices, are not cached, nor any if JAX's own cache is on:
    a program that comes from there cannot be written again.
    """
    devices = jax.devices()
    is_cpu = devices[0].platform == "cpu"
    jitted = jax.jit(function, compiler_options=options if is_cpu else None)
    if len(devices) > 1 or not is_cpu or getattr(jax.config, "jax_compilation_cache_dir"):  # noqa: B009
        return jitted
    lowered = jitted.lower(arguments)
    text = lowered.as_text()
    if "callback" in text:
        return lowered.compile()
    name = hashlib.sha256(f"{_compiler_identity()} {options}\n{text}".encode()).hexdigest()[:32]
    if (program := _stored_program(name, lowered)) is not None:
        return program
    start = time.perf_counter()
    compiled = lowered.compile()
    if time.perf_counter() - start >= MIN_STORED_COMPILE_SECONDS:
        write_machine_code(name, zlib.compress(serialize_executable.serialize(compiled)[0], 1), XLA_SUFFIX)
    return compiled


XLA_SUFFIX = ".xla"
"""Suffix of the files of programs that XLA compiled."""


def _stored_program(name: str, lowered: Any) -> Callable | None:
    """Return the program written to disk under ``name``; None if there is none that can be loaded."""
    code = read_machine_code(name, XLA_SUFFIX)
    if code is None:
        return None
    trees = lowered.in_tree, lowered.out_tree
    try:
        return serialize_executable.deserialize_and_load(zlib.decompress(code), *trees)
    except Exception:  # of any kind, from XLA's and JAX's insides: the program is compiled again
        return None


@functools.cache
def _compiler_identity() -> str:
    """Return a text that identifies this machine and its compiler; XLA divides work among the cores it sees."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    flags = os.environ.get("XLA_FLAGS", "")
    return f"{host_processor()} {cores} {jax.__version__} {jaxlib.__version__} {flags}"


def _strip_weak_type(array):
    """Return an array without JAX's weak type, which a Python number has and which would need another program."""
    is_weak = getattr(array, "weak_type", False) and not isinstance(array, jax.core.Tracer)
    return np.asarray(array) if is_weak else array


def _split_arguments(function: Callable, arguments: tuple) -> tuple[_ArrayFunction, tuple, tuple]:
    """Split arguments into a function of their arrays alone, these arrays, and a hashable key of all the rest."""
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
