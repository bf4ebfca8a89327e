"""Caches of programs: those compiled by XLA, found by their content, and machine code on disk.

A compiled program takes several hundred memory maps of the 65,530 that Linux grants a process, and ``jax.jit`` keeps
thousands of programs, so the least recently used are unloaded. What takes long to compile is also kept on disk for
other processes, in files and folders that only this user can have written.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import os
import stat
import time
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlib
import numpy as np
from jax.experimental import serialize_executable

from manifolds._arrays import is_traced
from manifolds.errors import warn

from .. import disk
from .blas_threads import needs_one_blas_thread, with_one_blas_thread
from .caching import LRUCache


class CacheWarning(UserWarning):
    """Warning that machine code cannot be cached safely, so that every process compiles it again."""


CHECKSUM_BYTES = 32
"""Length in bytes of the checksum at the start of a file, which shows that a file was cut short."""

MAX_FILE_BYTES = 2**28
"""Largest size in bytes of a file that is read."""

SAFE_OPEN_FLAGS = disk.SAFE_OPEN_FLAGS | getattr(os, "O_NONBLOCK", 0)
"""Flags that refuse to open a link and do not wait for the other end of a pipe."""


def cache_folder() -> Path | None:
    """Return the folder ``$LIETHERMO_CACHE`` or one in the user's cache directory; None if there is none."""
    if user_folder := os.environ.get("LIETHERMO_CACHE"):
        return Path(user_folder)
    try:
        return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "liethermo"
    except RuntimeError:  # no HOME, and no entry for the user
        return None


@functools.cache
def host_triple_cpu_and_features() -> tuple[str, str, str]:
    """Return the target triple, the CPU and its features, by their names in LLVM, of this machine."""
    import llvmlite.binding as llvm

    return llvm.get_process_triple(), llvm.get_host_cpu_name(), llvm.get_host_cpu_features().flatten()


def read_machine_code(name: str, suffix: str = ".o") -> bytes | None:
    """Return the machine code written under ``name``; None if it is missing, damaged, or may be another user's."""
    folder = _trusted_cache_folder()
    if folder is None:
        return None
    try:
        with open(
            folder / f"{name}{suffix}", "rb", opener=lambda path, flags: os.open(path, flags | SAFE_OPEN_FLAGS)
        ) as file:
            file_status = os.fstat(file.fileno())
            if not stat.S_ISREG(file_status.st_mode) or file_status.st_size > MAX_FILE_BYTES:
                return None
            if reason := _why_untrusted(file_status):
                _warn_untrusted(str(folder / f"{name}{suffix}"), reason)
                return None
            content = file.read()
    except (OSError, ValueError):
        return None
    checksum, code = content[:CHECKSUM_BYTES], content[CHECKSUM_BYTES:]
    return code if code and checksum == hashlib.sha256(code).digest() else None


def write_machine_code(name: str, code: bytes, suffix: str = ".o") -> None:
    """Write machine code to the cache under ``name``, if there is a folder that can be used."""
    folder = _trusted_cache_folder()
    if folder is not None:
        with contextlib.suppress(OSError):
            disk.write_atomically(folder / f"{name}{suffix}", hashlib.sha256(code).digest() + code, mode=0o600)
            disk.remove_abandoned_files(folder, f"{name}{suffix}")


def _trusted_cache_folder() -> Path | None:
    """Return the cache folder, created if necessary; None if it cannot be used or others might write to it."""
    folder = cache_folder()
    if folder is None:
        return None
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        with contextlib.suppress(FileExistsError):
            folder.mkdir(mode=0o700)
        folder_status = os.lstat(folder)
    except (OSError, ValueError):
        return None
    if stat.S_ISLNK(folder_status.st_mode):
        _warn_untrusted(str(folder), "it is a link")
    elif not stat.S_ISDIR(folder_status.st_mode):
        _warn_untrusted(str(folder), "it is not a folder")
    elif reason := _why_untrusted(folder_status):
        _warn_untrusted(str(folder), reason)
    else:
        return folder
    return None


def _why_untrusted(status: os.stat_result) -> str:
    """Return why a file or folder cannot be trusted, as a text; "" if only this user owns and writes it."""
    if not hasattr(os, "geteuid"):
        return ""
    if status.st_uid != os.geteuid():
        return "it belongs to another user"
    return "others may write to it" if status.st_mode & (stat.S_IWGRP | stat.S_IWOTH) else ""


@functools.cache
def _warn_untrusted(path: str, reason: str) -> None:
    """Warn, once for each path, that machine code is not cached there."""
    warn(
        f"machine code is not kept in {path}: {reason}, and the code there could do anything in your name. It is "
        "compiled in memory instead. Set LIETHERMO_CACHE to a folder of your own (chmod 700)",
        CacheWarning,
    )


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


def jit_if_traced(function: FunctionT) -> FunctionT:
    """Decorator: trace a function of pytrees once, as a jitted subprogram of every program that calls it.

    The function is called directly if no argument is traced, or if an argument cannot be hashed.
    """

    @functools.wraps(function)
    def call(*arguments):
        if not any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree_util.tree_leaves(arguments)):
            return function(*arguments)
        array_function, dynamic, key = _split_static_and_dynamic_arguments(function, arguments)
        try:
            hash(key)
        except TypeError:
            return array_function(dynamic)
        return _subprogram_cache.get_or_compute(key, lambda: jax.jit(array_function))(dynamic)

    return call  # type: ignore[return-value]


def _jit_with_options(function: FunctionT, options: dict | None) -> FunctionT:
    """Return a function that compiles itself with options of XLA, or becomes a part of a program that is traced."""

    @functools.wraps(function)
    def call(*arguments):
        array_function, dynamic, key = _split_static_and_dynamic_arguments(function, arguments)
        is_part_of_program = _is_being_traced(dynamic)
        program = _program_cache.get_or_compute(
            (key, is_part_of_program),
            lambda: (
                jax.jit(array_function)
                if is_part_of_program
                else _compile_array_function(array_function, dynamic, options)
            ),
        )
        return program(dynamic)

    return call  # type: ignore[return-value]


def _is_being_traced(arrays: tuple) -> bool:
    """Return whether a program is being traced, of which a call with these arrays becomes a part."""
    return is_traced(arrays, jnp.zeros(()))


# -- programs on disk -------------------------------------------------------------------------------------------------


MIN_STORED_COMPILE_SECONDS = 0.1
"""Shortest time in seconds of a compilation whose result is written to disk."""


def _compile_array_function(function: Callable, arguments: tuple, options: dict | None) -> Callable:
    """Return the compiled program of a function of arrays, loaded from the cache on disk or compiled by XLA.

    On the CPU it runs with one BLAS thread where it factorises small matrices. The cache is found by the text of the
    program, so it never returns the program of another function. The text has all arguments, also those that the
    program does not use: without them, programs that use different ones of their arguments, or have unused arguments of
    different shapes, would have the same text. Programs that call Python, or that run on accelerators or on several
    devices, are not cached, nor any if JAX's own cache is on: a program that comes from there cannot be written again.
    """
    devices = jax.devices()
    is_cpu = devices[0].platform == "cpu"
    jitted_function = jax.jit(function, keep_unused=True, compiler_options=options if is_cpu else None)
    if len(devices) > 1 or not is_cpu:
        return jitted_function
    traced_program = jitted_function.trace(arguments)
    has_jax_cache = getattr(jax.config, "jax_compilation_cache_dir")  # noqa: B009
    lowered_program = traced_program.lower()
    program = lowered_program.compile() if has_jax_cache else _load_or_compile_lowered(lowered_program, options)
    return with_one_blas_thread(program) if needs_one_blas_thread(traced_program.jaxpr.jaxpr) else program


def _load_or_compile_lowered(lowered_program: Any, options: dict | None) -> Callable:
    """Return the executable of a lowered program, loaded from the cache on disk or compiled.

    A program whose compilation takes long is written to the cache.
    """
    text = lowered_program.as_text()
    if "callback" in text:
        return lowered_program.compile()
    name = hashlib.sha256(f"{_compiler_identity()} {options}\n{text}".encode()).hexdigest()[:32]
    if (program := _load_stored_program(name, lowered_program)) is not None:
        return program
    start = time.perf_counter()
    compiled_program = lowered_program.compile()
    if time.perf_counter() - start >= MIN_STORED_COMPILE_SECONDS:
        write_machine_code(name, zlib.compress(serialize_executable.serialize(compiled_program)[0], 1), XLA_SUFFIX)
    return compiled_program


XLA_SUFFIX = ".xla"
"""Suffix of the files of programs that XLA compiled."""


def _load_stored_program(name: str, lowered_program: Any) -> Callable | None:
    """Return the compiled program that was written to disk under ``name``; None if none can be loaded."""
    code = read_machine_code(name, XLA_SUFFIX)
    if code is None:
        return None
    trees = lowered_program.in_tree, lowered_program.out_tree
    try:
        return serialize_executable.deserialize_and_load(zlib.decompress(code), *trees)
    except Exception:  # of any kind, from XLA's and JAX's insides: the program is compiled again
        return None


@functools.cache
def _compiler_identity() -> str:
    """Return a text that identifies this machine and its compiler; XLA divides work among the cores it sees."""
    cores = disk.available_cores()
    flags = os.environ.get("XLA_FLAGS", "")
    return f"{host_triple_cpu_and_features()} {cores} {jax.__version__} {jaxlib.__version__} {flags}"


def _strip_weak_type(array):
    """Return an array without JAX's weak type, which a Python number has and which would need another program."""
    is_weak = getattr(array, "weak_type", False) and not isinstance(array, jax.core.Tracer)
    return np.asarray(array) if is_weak else array


def _split_static_and_dynamic_arguments(function: Callable, arguments: tuple) -> tuple[_ArrayFunction, tuple, tuple]:
    """Return a function of the arrays among the arguments alone, these arrays, and a key of everything else.

    The key can be hashed if the other arguments can; it contains the shapes and dtypes of the arrays.
    """
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
