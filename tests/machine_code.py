"""Compilation of a scalar program by LLVM, for the tests."""

import ctypes
import itertools

import numpy as np
from llvmlite import ir

from liethermo.engines.compiled.llvm_writer import FLOAT64, INT64, ProgramWriter
from liethermo.engines.compiled.loops_and_calls import Table
from liethermo.engines.compiled.machine_code import MachineCode
from liethermo.tracing.scalarize import Program

RUN_SIGNATURE = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_void_p)
"""Signature ``run(inputs, outputs)`` of the compiled function."""


def compile_program(program: Program, lanes: int = 1):
    """Return ``f(*arrays)``, the outputs of a program; with several lanes, each array has them as its first axis.

    The inputs are stored ``offset`` numbers behind a multiple of 64 bytes, and tables are read from there.
    """
    sizes = [len(names) for names in program.inputs]
    starts = np.concatenate([[0], np.cumsum(sizes)])
    outputs = [len(entries) for entries in program.outputs]
    module = ir.Module()
    pointer = FLOAT64.as_pointer()
    function = ir.Function(module, ir.FunctionType(ir.VoidType(), [pointer, pointer]), "run")
    build = ir.IRBuilder(function.append_basic_block())
    writer = ProgramWriter(build, lanes)

    def row_pointer(base, row: int):
        return build.bitcast(build.gep(base, [ir.Constant(INT64, row * lanes)]), writer.double_type.as_pointer())

    def read_input(i: int, j: int):
        return build.load(row_pointer(function.args[0], int(starts[i]) + j), align=8)

    def find_table(i: int, indices: range) -> Table:
        start = row_pointer(function.args[0], int(starts[i]) + indices[0])
        return Table(writer, writer.double_type, start=start, length=len(indices), stride=indices.step)

    values = writer.write_program_with_double_outputs(program, read_input, find_table)
    for row, value in enumerate(itertools.chain.from_iterable(values)):
        build.store(value, row_pointer(function.args[1], row), align=8)
    build.ret_void()
    code = MachineCode(module)
    run = RUN_SIGNATURE(code.function_address("run"))

    def call(*arrays, offset: int = 0):
        columns = [np.asarray(a, dtype=np.float64).reshape(lanes, -1) for a in arrays]
        inputs = copy_at_offset(np.concatenate(columns, axis=1).T, offset)
        output = np.zeros((sum(outputs), lanes))
        run(inputs.ctypes.data, output.ctypes.data)
        results = np.split(output.T, np.cumsum(outputs)[:-1], axis=1)
        lane_shape = () if lanes == 1 else (lanes,)
        return [r.reshape((*lane_shape, *shape)) for r, shape in zip(results, program.shapes, strict=True)]

    call.code = code  # keeps the machine code loaded as long as the function
    return call


def copy_at_offset(array: np.ndarray, offset: int) -> np.ndarray:
    """Return a copy of an array of doubles that begins ``offset`` numbers behind a multiple of 64 bytes."""
    buffer = np.empty(array.size + 15)
    start = -buffer.ctypes.data // buffer.itemsize % 8 + offset
    copy = buffer[start : start + array.size].reshape(array.shape)
    copy[...] = array
    assert copy.ctypes.data % 64 == 8 * offset
    return copy


def count_memory_maps() -> int:
    """Return the number of memory maps of this process."""
    with open("/proc/self/maps") as file:
        return len(file.readlines())
