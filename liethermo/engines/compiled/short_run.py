"""Machine code that takes all steps of a short run in one call, since a call from Python takes longer than a step."""

from __future__ import annotations

import ctypes
import functools
from collections.abc import Sequence
from typing import Any

import numpy as np
from llvmlite import ir

from .llvm_writer import FLOAT64, INT64, ProgramWriter
from .loop_codegen import ADVANCE_TYPE, BEGIN_TYPE, FLOAT64_POINTER, INT64_POINTER
from .machine_code import MachineCode

FIELD_TYPES = {
    "begin": BEGIN_TYPE.as_pointer(),
    "advance": ADVANCE_TYPE.as_pointer(),
    "parameters": FLOAT64_POINTER,
    "block": FLOAT64_POINTER,
    "n_done": INT64_POINTER,
    "status": FLOAT64_POINTER,
    "h": FLOAT64_POINTER,
    "saved": FLOAT64_POINTER,
    "newton": ADVANCE_TYPE.args[-1],
    "sizes": FLOAT64_POINTER,
    "counts": INT64_POINTER,
    "increments": FLOAT64_POINTER.as_pointer(),
    "n_segments": INT64,
}
"""Fields of the description of a run: the arguments of ``begin`` and ``advance``, and arrays with an entry for each
segment of equal steps."""

RUN_SIGNATURE = ctypes.CFUNCTYPE(ctypes.c_int64, ctypes.c_void_p)
"""C signature of ``run(description)``."""


class ShortRun:
    """All steps of a run of one trajectory by one call, which returns whether they were taken.

    Parameters
    ----------
    addresses : dict from str to int
        The fields ``parameters``, ``block``, ``n_done``, ``status``, ``h`` and ``saved`` of :data:`FIELD_TYPES`.
    segments : sequence of (h, n_steps)
    increments : sequence of array
        Increments of noise for each segment.
    """

    def __init__(
        self, addresses: dict[str, int], segments: Sequence[tuple[float, int]], increments: Sequence[np.ndarray]
    ):
        sizes, counts = np.array([h for h, _ in segments]), np.array([n_steps for _, n_steps in segments])
        pointers = np.array([array.ctypes.data for array in increments])
        self._arrays = sizes, counts, increments, pointers
        arrays = {"sizes": sizes, "counts": counts, "increments": pointers}
        self._fields = np.zeros(len(FIELD_TYPES), dtype=np.int64)
        known = addresses | {name: array.ctypes.data for name, array in arrays.items()} | {"n_segments": len(sizes)}
        for name, value in known.items():
            self._fields[list(FIELD_TYPES).index(name)] = value
        self._newton = list(FIELD_TYPES).index("newton")
        self._functions: tuple[Any, ...] = ()
        self._address, self._run = self._fields.ctypes.data, RUN_SIGNATURE(_run_code().function_address("run"))

    def __call__(self, functions: tuple[Any, Any], newton_address: int) -> bool:
        """Take all steps by ``begin`` and ``advance``; return False if one fails or needs Newton's method."""
        if functions != self._functions:
            self._functions = functions
            self._fields[:2] = [ctypes.cast(function, ctypes.c_void_p).value or 0 for function in functions]
        if newton_address:
            self._fields[self._newton] = newton_address
        return not self._run(self._address)


@functools.cache
def _run_code() -> MachineCode:
    """Compile ``run(description)``, which returns 1 if a step fails or needs Newton's method, and otherwise 0."""
    module = ir.Module("run")
    description = ir.LiteralStructType(FIELD_TYPES.values()).as_pointer()
    function = ir.Function(module, ir.FunctionType(INT64, [description]), "run")
    writer = ProgramWriter(ir.IRBuilder(function.append_basic_block("entry")), 1)
    build, int32, one = writer.builder, ir.IntType(32), writer.int64(1)
    field = {name: build.load(build.gep(function.args[0], [int32(0), int32(i)])) for i, name in enumerate(FIELD_TYPES)}
    build.store(FLOAT64(0.0), field["status"])
    build.call(field["begin"], [field["parameters"], field["block"], one])
    with writer.loop_range(field["n_segments"]) as i:
        size, count, increments = (
            build.load(build.gep(field[name], [i])) for name in ("sizes", "counts", "increments")
        )
        build.store(size, field["h"])
        build.store(writer.int64(0), field["n_done"])
        state = field["parameters"], field["block"], field["n_done"]
        n_saves = build.call(
            field["advance"], [*state, one, one, count, field["saved"], count, increments, field["newton"]]
        )
        has_failed = build.fcmp_unordered("!=", build.load(field["status"]), FLOAT64(0.0))
        with build.if_then(build.or_(build.icmp_signed("<", n_saves, one), has_failed)):
            build.ret(one)
    build.ret(writer.int64(0))
    return MachineCode(module)
