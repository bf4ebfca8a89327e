"""Machine code that evaluates a small function at many points, for parameters that change from call to call."""

from __future__ import annotations

import ctypes
from collections.abc import Callable

import jax
import numpy as np
from llvmlite import ir

from ...tracing.program import Program
from ...tracing.scalarize import UnsupportedPrimitive, report_compiler_faults, scalarize
from .llvm_writer import FLOAT64, INT64, ProgramWriter
from .machine_code import MachineCode

MAX_EVALUATOR_INSTRUCTIONS = 10_000
"""Largest number of instructions of a function that is compiled for a few points; LLVM takes about a second for it."""

EVALUATE_SIGNATURE = ctypes.CFUNCTYPE(None, *[ctypes.c_void_p] * 3, ctypes.c_int64)
"""C signature of ``evaluate(parameters, points, results, count)``."""


class PointEvaluator:
    """Compiled function of parameters and a point, evaluated at several points by one call.

    The results are written to the same array by every call, so each thread needs an evaluator of its own.

    Parameters
    ----------
    function : function of arrays of shapes (p,) and (n,) to an array of shape (k,)
        It must be one that JAX can trace.
    parameters : array, shape (p,)
        Those of the next call: a caller sets their values in place.
    points : array, shape (m, n)

    Raises
    ------
    UnsupportedPrimitive
        If the function cannot be unrolled, or is too large.
    """

    def __init__(self, function: Callable, parameters: np.ndarray, points: np.ndarray):
        points = np.array(points, dtype=np.float64)
        program = scalarize(
            jax.make_jaxpr(function)(parameters, points[0]), max_instructions=MAX_EVALUATOR_INSTRUCTIONS
        )
        if program.instruction_count > MAX_EVALUATOR_INSTRUCTIONS:
            raise UnsupportedPrimitive("a function", "", "within the size limit", too_large=True)
        with report_compiler_faults():
            self._code = _compile_evaluator(program)
        self._evaluate = EVALUATE_SIGNATURE(self._code.function_address("evaluate"))
        self._results = np.empty((len(points), len(program.outputs[0])))
        self._arrays = parameters, points, self._results
        self._arguments = *(array.ctypes.data for array in self._arrays), len(points)

    def __call__(self) -> np.ndarray:
        """Return the values at all points, shape (m, k); the next call overwrites them."""
        self._evaluate(*self._arguments)
        return self._results


class _SeparateRoundingWriter(ProgramWriter):
    """A writer that rounds products before it adds them, as NumPy does, so that equal products cancel."""

    def fused_multiply_add(self, op, product_index, factors, terms) -> ir.Value:
        product = self.write_operation("mul", factors)
        return self.write_operation(op, [product if i == product_index else term for i, term in enumerate(terms)])


def _compile_evaluator(program: Program) -> MachineCode:
    """Compile ``evaluate(parameters, points, results, count)``, which runs a program at each of ``count`` points."""
    module = ir.Module("points")
    pointer = FLOAT64.as_pointer()
    function = ir.Function(module, ir.FunctionType(ir.VoidType(), [pointer, pointer, pointer, INT64]), "evaluate")
    parameters, points, results, count = function.args
    writer = _SeparateRoundingWriter(ir.IRBuilder(function.append_basic_block("entry")), 1)
    build, (_, point_names), (values,) = writer.builder, program.inputs, program.outputs
    with writer.loop_range(count) as i:
        starts = parameters, build.gep(points, [build.mul(i, writer.int64(len(point_names)))])
        result = build.gep(results, [build.mul(i, writer.int64(len(values)))])
        (row,) = writer.write_as_doubles(
            program, lambda array, entry: build.load(build.gep(starts[array], [writer.int64(entry)]))
        )
        for j, value in enumerate(row):
            build.store(value, build.gep(result, [writer.int64(j)]))
    build.ret_void()
    return MachineCode(module)
