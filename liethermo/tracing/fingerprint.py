"""Fingerprints of traced programs, which are the same in every process."""

from __future__ import annotations

import dataclasses
import enum
import functools
import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jaxlib
import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal

IGNORED_PARAMETERS = {
    "jit": frozenset(
        """compiler_options_kvs ctx_mesh donated_invars in_layouts in_shardings inline keep_unused out_layouts
        out_shardings""".split()
    ),
    "custom_jvp_call": frozenset({"jvp_jaxpr_fun"}),
    "custom_vjp_call": frozenset({"bwd", "fwd_jaxpr_thunk", "out_trees"}),
}
"""Parameters of equations, by primitive, on which the results of a program do not depend: where and how it is compiled,
and derivatives, which have been taken when a program is traced."""


class _Unidentifiable(Exception):
    """A program holds an object, such as a user's function, that other processes cannot recognise."""


def program_fingerprint(closed_jaxpr: ClosedJaxpr) -> bytes | None:
    """Return a digest of all that the results of a traced program depend on; None if an object in it has no identity.

    Equal digests mean equal equations, constants to the last bit, shapes and types. The text of a jaxpr does not serve:
    it leaves out constants, and has addresses of functions.
    """
    digests: dict[int, bytes] = {}

    def digest_of(jaxpr: Jaxpr) -> bytes:
        if id(jaxpr) not in digests:
            hasher = hashlib.sha256()
            _write_jaxpr(hasher.update, jaxpr, digest_of)
            digests[id(jaxpr)] = hasher.digest()
        return digests[id(jaxpr)]

    hasher = hashlib.sha256()
    try:
        _write_value(hasher.update, closed_jaxpr, digest_of)
    except _Unidentifiable:
        return None
    return hasher.digest()


def _write_jaxpr(write: Callable[[bytes], Any], jaxpr: Jaxpr, digest_of: Callable[[Jaxpr], bytes]) -> None:
    """Write the equations of a jaxpr, with its variables numbered in the order in which they are defined."""
    numbers: dict[Any, int] = {}

    def define(variables) -> None:
        for variable in variables:
            numbers[variable] = len(numbers)
            write(_array_type_text(variable.aval))

    def use(variables) -> None:
        for variable in variables:
            if isinstance(variable, Literal):
                write(_array_type_text(variable.aval))
                _write_value(write, variable.val, digest_of)
            else:
                write(b"v%d;" % numbers[variable])

    define([*jaxpr.constvars, *jaxpr.invars])
    write(b"%d constants;" % len(jaxpr.constvars))
    for equation in jaxpr.eqns:
        name = equation.primitive.name
        write(f"{name} {len(equation.invars)} {len(equation.outvars)};".encode())
        use(equation.invars)
        ignored = IGNORED_PARAMETERS.get(name, frozenset())
        _write_value(write, {k: v for k, v in equation.params.items() if k not in ignored}, digest_of)
        define(equation.outvars)
    use(jaxpr.outvars)


def _array_type_text(aval: Any) -> bytes:
    """Return dtype, shape and weak type of an abstract array as a text; raise _Unidentifiable for any other value."""
    if not isinstance(aval, jax.core.ShapedArray):
        raise _Unidentifiable
    return f"{aval.dtype}{aval.shape}{aval.weak_type};".encode()


NUMBERS = (int, float, complex)
"""Numbers of Python, of which JAX has subclasses; their texts are exact."""


def _write_value(write: Callable[[bytes], Any], value: Any, digest_of: Callable[[Jaxpr], bytes]) -> None:
    """Write a constant, or a parameter of an equation, with its type.

    Raises
    ------
    _Unidentifiable
        If it is neither made of numbers, texts and jaxprs, nor an object of this library or of JAX with such fields.
    """
    kind = type(value)
    write(f"{kind.__module__}.{kind.__qualname__}:".encode())
    if isinstance(value, ClosedJaxpr):
        write(digest_of(value.jaxpr))
        _write_value(write, list(value.consts), digest_of)
    elif isinstance(value, Jaxpr):
        write(digest_of(value))
    elif value is None or kind in (bool, str, bytes):
        write(f"{value!r};".encode())
    elif isinstance(value, int | float | complex) and (kind in NUMBERS or _is_library_or_jax_type(kind)):
        write(f"{next(number for number in NUMBERS if isinstance(value, number)).__repr__(value)};".encode())
    elif isinstance(value, np.dtype | enum.Enum):
        write(f"{value};".encode())
    elif isinstance(value, np.ndarray | np.generic | jax.Array) and not isinstance(value, jax.core.Tracer):
        array = np.asarray(value)
        if array.dtype.hasobject:
            raise _Unidentifiable
        write(f"{array.dtype}{array.shape};".encode() + array.tobytes())
    elif isinstance(value, dict):
        _write_value(write, [item for key in sorted(value) for item in (key, value[key])], digest_of)
    elif kind in (tuple, list) or (isinstance(value, tuple) and _is_library_or_jax_type(kind)):
        write(b"%d;" % len(value))
        for item in value:
            _write_value(write, item, digest_of)
    elif dataclasses.is_dataclass(value) and _is_library_or_jax_type(kind):
        for field in dataclasses.fields(value):
            _write_value(write, getattr(value, field.name), digest_of)
    else:
        raise _Unidentifiable


def _is_library_or_jax_type(kind: type) -> bool:
    """Return whether a type is defined by this library or by JAX, whose versions are known."""
    return kind.__module__.split(".")[0] in ("manifolds", "liethermo", "jax")


SOURCE_ROOMS = ("liethermo/tracing", "liethermo/engines", "manifolds")
"""Folders whose code translates a traced program to machine code."""


@functools.cache
def compiler_source_fingerprint() -> bytes | None:
    """Return a digest of the code that translates traced programs, and of the versions of JAX and llvmlite.

    None if the source files cannot be read.
    """
    import llvmlite  # which the array engine does not need

    versions = {module.__name__: module.__version__ for module in (jax, jaxlib, llvmlite, np)}
    hasher, root = hashlib.sha256(f"{versions}".encode()), Path(__file__).parents[2]
    for room in SOURCE_ROOMS:
        try:
            files = sorted((root / room).rglob("*.py"))
            for file in files:
                hasher.update(f"{file.relative_to(root)};".encode() + file.read_bytes())
        except OSError:
            return None
        if not files:
            return None
    return hasher.digest()
