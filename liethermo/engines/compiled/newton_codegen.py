"""Newton's method for one trajectory of a block, which the step loop calls if fixed-point iteration fails."""

from __future__ import annotations

import itertools

import numpy as np
from llvmlite import ir

from ...tracing.program import Program
from .llvm_writer import FLOAT64, INT64, ProgramWriter
from .loop_codegen import FLOAT64_POINTER, NEWTON_BUFFER, BlockLayout
from .loops_and_calls import Table
from .machine_code import MachineCode


def compile_newton_solver(
    program: Program, layout: BlockLayout, is_per_trajectory: np.ndarray, lanes: int
) -> MachineCode:
    """Compile the function ``solve(p, block, lane)``, which runs ``program`` on the arrays of one lane.

    Parameters
    ----------
    program : Program
        :func:`..stage_solver.solve_newton`, of the parameters p and the rows :data:`.loop_codegen.NEWTON_BUFFER`; the
        results overwrite the first of these rows.
    layout : BlockLayout
    is_per_trajectory : array of bool, shape (p,)
        Parameters that lie in the block; the others are common to all trajectories.
    """
    module = ir.Module("newton")
    function = ir.Function(module, ir.FunctionType(ir.VoidType(), [FLOAT64_POINTER, FLOAT64_POINTER, INT64]), "solve")
    build = ir.IRBuilder(function.append_basic_block())
    (p, block, lane) = function.args
    parameter_row = np.cumsum(is_per_trajectory) - 1
    writer, first_row = ProgramWriter(build, 1), layout.first_rows[NEWTON_BUFFER]

    def row_pointer(row: int) -> ir.Value:
        return build.gep(block, [build.add(writer.int64(row * lanes), lane)])

    def read_argument(i: int, j: int) -> ir.Value:
        if i:
            return build.load(row_pointer(first_row + j))
        return build.load(
            row_pointer(layout.first_rows["p"] + int(parameter_row[j]))
            if is_per_trajectory[j]
            else build.gep(p, [writer.int64(j)])
        )

    def find_table(i: int, entries: range) -> Table | None:
        if i or is_per_trajectory[entries].any():
            return None
        start = build.gep(p, [writer.int64(entries[0])])
        return Table(writer, FLOAT64, start=start, length=len(entries), stride=entries.step)

    for i, value in enumerate(
        itertools.chain.from_iterable(writer.write_as_doubles(program, read_argument, find_table))
    ):
        build.store(value, row_pointer(first_row + i))
    build.ret_void()
    return MachineCode(module)
