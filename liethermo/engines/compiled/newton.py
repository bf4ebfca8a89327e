"""Newton's method for one trajectory of a block, which the step loop calls where fixed-point iteration fails."""

from __future__ import annotations

import itertools

import numpy as np
from llvmlite import ir

from ...tracing.program import Program
from .blocks import Table
from .loop import DEFERRED, NUMBERS, Layout
from .machine_code import MachineCode
from .writer import NUMBER, WHOLE, Writer


def solver(program: Program, block: Layout, varies: np.ndarray, lanes: int) -> MachineCode:
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
    function = ir.Function(module, ir.FunctionType(ir.VoidType(), [NUMBERS, NUMBERS, WHOLE]), "solve")
    build, (p, w, lane), own = ir.IRBuilder(function.append_basic_block()), function.args, np.cumsum(varies) - 1
    writer, first = Writer(build, 1), block.rows[DEFERRED]

    def place(row: int) -> ir.Value:
        return build.gep(w, [build.add(writer.whole_number(row * lanes), lane)])

    def read(i: int, j: int) -> ir.Value:
        if i:
            return build.load(place(first + j))
        return build.load(place(block.rows["p"] + int(own[j])) if varies[j] else build.gep(p, [writer.whole_number(j)]))

    def memory(i: int, places: range) -> Table | None:
        if i or varies[places].any():
            return None
        start = build.gep(p, [writer.whole_number(places[0])])
        return Table(writer, NUMBER, start=start, length=len(places), step=places.step)

    for i, value in enumerate(itertools.chain.from_iterable(writer.write(program, read, memory))):
        build.store(value, place(first + i))
    build.ret_void()
    return MachineCode(module)
