"""Simplified Newton iteration on the stage equations of one trajectory, for the step loop to call.

By the rules of the array engine: whole steps first, then halved ones. What is judged, and what the equations are, are
scalar programs; here are the loops around them and the factorisation.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from llvmlite import ir

from .loop import NUMBERS, Layout, Piece
from .machine_code import NUMBER, WHOLE, MachineCode, Writer

GIVEN = ("x", "low", "h", "k", "before")
"""What is taken from a block, beside the trajectory's own parameters."""

FOUND = ("guess", "update", "converged", "defined", "newtons", "noise")
"""What is left in it."""


def solver(
    pieces: Mapping[str, Piece], shapes: Mapping[str, tuple[int, ...]], block: Layout, varies: np.ndarray, lanes: int
) -> MachineCode:
    """The function ``solve(p, block, lane)``, which solves the equations of a lane, as machine code.

    Parameters
    ----------
    pieces : mapping
        ``begin``, a guess from the slopes of the steps before, and ``rest``, a step of nothing; ``misfit``, what the
        equations miss there; ``linearise``, what their derivative needs in every direction, and ``along``, the
        derivative in one; ``moved``, the guess after a step; ``halved``, after half of it is taken back; ``judge`` and,
        with the ``sound`` of the motion, ``settle``, whether it goes on; ``count``, what it took.
    shapes : mapping
        Of the arrays that they read and write.
    block : Layout
    varies : array of bool, shape (p,)
    """
    unknowns = int(np.prod(shapes["guess"]))
    layout = Layout({**shapes, "p": (int(varies.sum()),), "matrix": (unknowns, unknowns), "order": (unknowns,)})
    module = ir.Module("newton")
    for name, piece in pieces.items():
        _Piece(module, name, layout, varies).write_piece(piece)
    _Solve(module, layout, block, lanes, unknowns).write_loops()
    return MachineCode(module)


class _Piece(Writer):
    """Writes a piece as a function ``f(p, s)`` of arrays that lie one after another in s."""

    def __init__(self, module: ir.Module, name: str, layout: Layout, varies: np.ndarray):
        function = ir.Function(module, ir.FunctionType(ir.VoidType(), [NUMBERS, NUMBERS]), name)
        function.linkage = "internal"
        super().__init__(ir.IRBuilder(function.append_basic_block()), 1)
        self.p, self.s = function.args
        self.layout, self.varies, self.own = layout, varies, np.cumsum(varies) - 1

    def write_piece(self, piece: Piece) -> None:
        build, rows = self.builder, self.layout.rows

        def at(base: ir.Value, place: int) -> ir.Value:
            return build.gep(base, [self.whole_number(int(place))])

        def read(i: int, j: int) -> ir.Value:
            array = piece.arguments[i]
            if array != "p":
                return build.load(at(self.s, rows[array] + j))
            return build.load(at(self.s, rows["p"] + self.own[j]) if self.varies[j] else at(self.p, j))

        for array, values in zip(piece.results, self.write(piece.program, read), strict=True):
            for j, value in enumerate(values):
                build.store(value, at(self.s, rows[array] + j))
        build.ret_void()


class _Solve(Writer):
    """Writes ``solve(p, block, lane)``."""

    def __init__(self, module: ir.Module, layout: Layout, block: Layout, lanes: int, unknowns: int):
        function = ir.Function(module, ir.FunctionType(ir.VoidType(), [NUMBERS, NUMBERS, WHOLE]), "solve")
        super().__init__(ir.IRBuilder(function.append_basic_block()), 1)
        self.p, self.w, self.lane = function.args
        self.module, self.layout, self.block, self.all, self.unknowns = module, layout, block, lanes, unknowns
        self.s = self.builder.alloca(NUMBER, layout.height)

    def write_loops(self) -> None:
        build = self.builder
        with self.counted(self.whole_number(self.layout.height)) as i:
            build.store(self.constant(0.0), build.gep(self.s, [i]))
        self._exchange(("p", *GIVEN), out=False)
        with self.counted(self.whole_number(2)) as attempt, build.if_then(self._is("converged", "!=", 1.0)):
            build.store(build.sitofp(attempt, NUMBER), self._at("damped"))
            self._attempt()
        self._exchange(FOUND, out=True)
        build.ret_void()

    def _attempt(self) -> None:
        """Newton's method with whole steps, or with halved ones."""
        build = self.builder
        # From the prediction, or from a step of nothing where that solves the equations better: far out Newton may
        # wander.
        self._call("begin", "misfit")
        predicted = build.load(self._at("found"))
        self._call("rest", "misfit")
        with build.if_then(build.fcmp_ordered("<=", predicted, build.load(self._at("found")))):
            self._call("begin", "misfit")
        with self.repeated(lambda: self._is("goes_on", "==", 1.0)):
            with build.if_then(self._is("renew", "==", 1.0)):
                self._factorise()
            self._call("direct")
            self._substitute(self._array("direction"))
            self._call("moved", "misfit")
            with self.repeated(lambda: self._holds("worse")):
                self._call("halved", "misfit")
            self._call("judge")
            with build.if_then(self._is("uncertain", "==", 1.0)):
                self._call("sound", "settle")
        self._call("count")

    def _factorise(self) -> None:
        """The Jacobian matrix column by column, and its LU factors in its place; ``goes_on`` is 0 where it has none."""
        build, m, matrix = self.builder, self.whole_number(self.unknowns), self._array("matrix")
        direction, changes, order = (self._array(name) for name in ("direction", "changes", "order"))

        def entry(i, j):
            return build.gep(matrix, [build.add(build.mul(i, m), j)])

        def size(i, j):
            return self.operation("abs", [build.load(entry(i, j))])

        self._call("linearise")
        with self.counted(m) as j:
            build.store(self.constant(0.0), build.gep(direction, [j]))
        with self.counted(m) as j:
            build.store(self.constant(1.0), build.gep(direction, [j]))
            self._call("along")
            build.store(self.constant(0.0), build.gep(direction, [j]))
            with self.counted(m) as i:
                build.store(build.load(build.gep(changes, [i])), entry(i, j))
        build.store(self.constant(1.0), self._at("regular"))
        with build.goto_entry_block():
            pivot = build.alloca(WHOLE)
        with self.counted(m) as j:
            below = build.sub(m, j)
            build.store(j, pivot)
            with self.counted(below) as n:
                i = build.add(j, n)
                larger = build.fcmp_ordered(">", size(i, j), size(build.load(pivot), j))
                build.store(build.select(larger, i, build.load(pivot)), pivot)
            chosen = build.load(pivot)
            build.store(build.sitofp(chosen, NUMBER), build.gep(order, [j]))
            largest = size(chosen, j)
            usable = build.and_(
                build.fcmp_ordered("<", self.constant(0.0), largest),
                build.fcmp_ordered("<", largest, self.constant(np.inf)),
            )
            regular = build.select(usable, build.load(self._at("regular")), self.constant(0.0))
            build.store(regular, self._at("regular"))
            with self.counted(m) as c:
                one, other = build.load(entry(j, c)), build.load(entry(chosen, c))
                build.store(other, entry(j, c))
                build.store(one, entry(chosen, c))
            with self.counted(build.sub(below, self.whole_number(1))) as n:
                i = build.add(build.add(j, n), self.whole_number(1))
                factor = build.fdiv(build.load(entry(i, j)), build.load(entry(j, j)))
                build.store(factor, entry(i, j))
                with self.counted(build.sub(below, self.whole_number(1))) as l:
                    c = build.add(build.add(j, l), self.whole_number(1))
                    build.store(
                        build.fsub(build.load(entry(i, c)), build.fmul(factor, build.load(entry(j, c)))), entry(i, c)
                    )

    def _substitute(self, b: ir.Value) -> None:
        """The solution of ``A y = b``, in the place of b, from the factors."""
        build, m, matrix, order = (
            self.builder,
            self.whole_number(self.unknowns),
            self._array("matrix"),
            self._array("order"),
        )

        def entry(i, j):
            return build.load(build.gep(matrix, [build.add(build.mul(i, m), j)]))

        def subtract(i, j):
            place = build.gep(b, [i])
            build.store(build.fsub(build.load(place), build.fmul(entry(i, j), build.load(build.gep(b, [j])))), place)

        with self.counted(m) as i:
            own = build.gep(b, [i])
            other = build.gep(b, [build.fptosi(build.load(build.gep(order, [i])), WHOLE)])
            one, two = build.load(own), build.load(other)
            build.store(two, own)
            build.store(one, other)
        with self.counted(m) as i, self.counted(i) as j:
            subtract(i, j)
        with self.counted(m) as n:
            i = build.sub(build.sub(m, self.whole_number(1)), n)
            with self.counted(n) as l:
                subtract(i, build.add(build.add(i, l), self.whole_number(1)))
            place = build.gep(b, [i])
            build.store(build.fdiv(build.load(place), entry(i, i)), place)

    # -- arrays -------------------------------------------------------------------------------------------------------

    def _call(self, *names: str) -> None:
        for name in names:
            self.builder.call(self.module.globals[name], [self.p, self.s])

    def _array(self, name: str) -> ir.Value:
        return self.builder.gep(self.s, [self.whole_number(self.layout.rows[name])])

    _at = _array

    def _is(self, name: str, relation: str, number: float) -> ir.Value:
        compare = self.builder.fcmp_unordered if relation == "!=" else self.builder.fcmp_ordered
        return compare(relation, self.builder.load(self._at(name)), self.constant(number))

    def _holds(self, name: str) -> ir.Value:
        """Whether a piece, asked anew, finds that what it is named after is so."""
        self._call(name)
        return self._is(name, "==", 1.0)

    def _exchange(self, names: Sequence[str], out: bool) -> None:
        """Arrays between the block and s."""
        build = self.builder
        for name in names:
            if not self.layout.sizes[name]:
                continue
            with self.counted(self.whole_number(self.layout.sizes[name])) as i:
                row = build.mul(build.add(self.whole_number(self.block.rows[name]), i), self.whole_number(self.all))
                there, here = build.gep(self.w, [build.add(row, self.lane)]), build.gep(self._array(name), [i])
                build.store(build.load(here if out else there), there if out else here)
