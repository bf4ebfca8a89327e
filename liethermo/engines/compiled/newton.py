"""Newton's method for one trajectory of a block, which the step loop calls where fixed-point iteration fails."""

from __future__ import annotations

import numpy as np
from llvmlite import ir

from .loop import NUMBERS, Layout, Piece
from .machine_code import MachineCode
from .writer import WHOLE, Writer


def solver(piece: Piece, block: Layout, varies: np.ndarray, lanes: int) -> MachineCode:
    """The function ``solve(p, block, lane)``: a program on the arrays of one lane, as machine code.

    Parameters
    ----------
    piece : Piece
        Of :func:`..stages.by_newton`, on arrays in the block and the parameters p.
    block : Layout
    varies : array of bool, shape (p,)
        Which parameters lie in the block; the others are the same for all.
    """
    module = ir.Module("newton")
    function = ir.Function(module, ir.FunctionType(ir.VoidType(), [NUMBERS, NUMBERS, WHOLE]), "solve")
    build, (p, w, lane), own = ir.IRBuilder(function.append_basic_block()), function.args, np.cumsum(varies) - 1
    writer = Writer(build, 1)

    def place(row: int) -> ir.Value:
        return build.gep(w, [build.add(writer.whole_number(row * lanes), lane)])

    def read(i: int, j: int) -> ir.Value:
        name = piece.arguments[i]
        if name == "p" and not varies[j]:
            return build.load(build.gep(p, [writer.whole_number(j)]))
        return build.load(place(block.rows[name] + int(own[j] if name == "p" else j)))

    for name, values in zip(piece.results, writer.write(piece.program, read), strict=True):
        for j, value in enumerate(values):
            build.store(value, place(block.rows[name] + j))
    build.ret_void()
    return MachineCode(module)
