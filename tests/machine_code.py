"""A scalar program as a function that LLVM compiles, for the tests."""

import ctypes
import itertools

import numpy as np
from llvmlite import ir

from liethermo.engines.compiled.machine_code import MachineCode
from liethermo.engines.compiled.writer import FLOAT64, INT64, ProgramWriter
from liethermo.tracing.scalarize import Program

CALL = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_void_p)


def compiled(program: Program, lanes: int = 1):
    """``f(*arrays)``, the outputs of a program; with the lanes as the first axis of each array where there are some."""
    sizes = [len(names) for names in program.inputs]
    starts = np.concatenate([[0], np.cumsum(sizes)])
    outputs = [len(entries) for entries in program.outputs]
    module = ir.Module()
    pointer = FLOAT64.as_pointer()
    function = ir.Function(module, ir.FunctionType(ir.VoidType(), [pointer, pointer]), "run")
    build = ir.IRBuilder(function.append_basic_block())
    writer = ProgramWriter(build, lanes)

    def place(base, row: int):
        return build.bitcast(build.gep(base, [ir.Constant(INT64, row * lanes)]), writer.double_type.as_pointer())

    found = writer.write_as_doubles(
        program, lambda i, j: build.load(place(function.args[0], int(starts[i]) + j), align=8)
    )
    for row, value in enumerate(itertools.chain.from_iterable(found)):
        build.store(value, place(function.args[1], row), align=8)
    build.ret_void()
    code = MachineCode(module)
    run = CALL(code.function_address("run"))

    def call(*arrays):
        columns = [np.asarray(a, dtype=np.float64).reshape(lanes, -1) for a in arrays]
        given = np.ascontiguousarray(np.concatenate(columns, axis=1).T)
        out = np.zeros((sum(outputs), lanes))
        run(given.ctypes.data, out.ctypes.data)
        results = np.split(out.T, np.cumsum(outputs)[:-1], axis=1)
        front = () if lanes == 1 else (lanes,)
        return [r.reshape((*front, *shape)) for r, shape in zip(results, program.shapes, strict=True)]

    call.code = code  # which is unloaded with the function
    return call


def memory_maps() -> int:
    """Of this process."""
    with open("/proc/self/maps") as file:
        return len(file.readlines())
