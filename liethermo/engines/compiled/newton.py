"""Newton's method for one trajectory of a block, which the step loop calls where fixed-point iteration fails."""

from __future__ import annotations

import itertools

import numpy as np
from llvmlite import ir

from ...tracing.program import Program
from .blocks import Table
from .loop import FLOAT64_POINTER, NEWTON_BUFFER, BlockLayout
from .machine_code import MachineCode
from .writer import FLOAT64, INT64, ProgramWriter


def compile_newton_solver(program: Program, block: BlockLayout, varies: np.ndarray, lanes: int) -> MachineCode:
    """The function ``solve(p, block, lane)``: a program on the arrays of one lane, as machine code.

    Parameters
    ----------
    program : Program
        :func:`..stages.by_newton`, of the parameters p and of what is :data:`.loop.DEFERRED`, whose first rows it
        replaces.
    block : Layout
    varies : array of bool, shape (p,)
        Which parameters lie in the block; the others are the same for all.
    """
    module = ir.Module("newton")
    function = ir.Function(module, ir.FunctionType(ir.VoidType(), [FLOAT64_POINTER, FLOAT64_POINTER, INT64]), "solve")
    build, (p, w, lane), own = ir.IRBuilder(function.append_basic_block()), function.args, np.cumsum(varies) - 1
    writer, first = ProgramWriter(build, 1), block.first_rows[NEWTON_BUFFER]

    def place(row: int) -> ir.Value:
        return build.gep(w, [build.add(writer.int64(row * lanes), lane)])

    def read(i: int, j: int) -> ir.Value:
        if i:
            return build.load(place(first + j))
        return build.load(place(block.first_rows["p"] + int(own[j])) if varies[j] else build.gep(p, [writer.int64(j)]))

    def memory(i: int, places: range) -> Table | None:
        if i or varies[places].any():
            return None
        start = build.gep(p, [writer.int64(places[0])])
        return Table(writer, FLOAT64, start=start, length=len(places), stride=places.step)

    for i, value in enumerate(itertools.chain.from_iterable(writer.write_as_doubles(program, read, memory))):
        build.store(value, place(first + i))
    build.ret_void()
    return MachineCode(module)
