"""The step loop of the compiled engine: the array engine's own steps, as scalar programs, on lanes that go together.

A *block* of trajectories advances together, one SIMD lane each; a single one is a block of one lane. The programs are
traced from the functions that the array engine runs (:mod:`..array`), so its rules are these; here are the loops around
them. What a block knows stays in registers, as far as there are enough, and is written back when the loop is left.
"""

from __future__ import annotations

import ctypes
import itertools
import math
import threading
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from llvmlite import ir

from ...tracing.program import Program
from ...tracing.scalarize import faults_reported
from .blocks import Table
from .machine_code import MachineCode
from .writer import NUMBER, WHOLE, Writer

POINTER, NUMBERS, WHOLES = ir.IntType(8).as_pointer(), NUMBER.as_pointer(), WHOLE.as_pointer()


class Piece(NamedTuple):
    """A program, and the names of the arrays that it reads and writes."""

    program: Program
    arguments: tuple[str, ...]
    results: tuple[str, ...]


class Layout:
    """Where arrays of some shapes lie one after another: their first rows by name, and how many rows there are."""

    def __init__(self, shapes: Mapping[str, tuple[int, ...]]):
        self.sizes = {name: math.prod(shape) for name, shape in shapes.items()}
        ends = list(itertools.accumulate(self.sizes.values(), initial=0))
        self.rows, self.height = dict(zip(self.sizes, ends, strict=False)), ends[-1]


def step_loop(
    pieces: Mapping[str, Piece],
    layout: Layout,
    state: Sequence[str],
    varies: np.ndarray,
    lanes: int,
    kept: Sequence[str],
    hasty: bool,
) -> MachineCode:
    """The functions ``advance`` and ``begin`` of :class:`_Steps` as machine code.

    Parameters
    ----------
    pieces : mapping
        ``begin``, the state of a run about to start, and ``step``, the state after a step.
    layout : Layout
        Of a block, each row with a number for each lane.
    state : sequence of str
        The arrays that stay from step to step.
    varies : array of bool, shape (p,)
        Which parameters lie in the block, under the name "p"; the others are the same for all.
    kept : sequence of str
        The arrays that are written down at each save.
    hasty : bool
        See :class:`.machine_code.MachineCode`.
    """
    module = ir.Module("steps")
    kinds = [NUMBERS, NUMBERS, WHOLES, WHOLE, WHOLE, WHOLE, NUMBERS, WHOLE, NUMBERS, POINTER]
    function = ir.Function(module, ir.FunctionType(WHOLE, kinds), "advance")
    function.args[0].add_attribute("noalias")
    _Steps(function, pieces, layout, state, varies, lanes, kept).write_loops()
    begin = ir.Function(module, ir.FunctionType(ir.VoidType(), [NUMBERS, NUMBERS, WHOLE]), "begin")
    _Steps(begin, pieces, layout, state, varies, lanes, kept).write_begin()
    return MachineCode(module, hasty)


class Loops:
    """The functions of :func:`step_loop`: optimised once many steps are taken.

    Parameters
    ----------
    make : function from ``hasty`` to MachineCode
    small : bool
        Whether there is a choice: code that is not optimised takes a place on the stack for each of its operations.
    """

    def __init__(self, make: Callable[[bool], MachineCode], small: bool):
        self._make, self._small, self._taken, self._lock = make, small, 0, threading.Lock()
        self._loaded: list[tuple[MachineCode, Callable, Callable]] = []  # all of them: a thread may be in any

    def functions(self, steps: int, planned: int = 0) -> Sequence[Callable]:
        """``begin`` and ``advance`` for so many steps more, and others that are planned: compiled, or found so."""
        with self._lock, faults_reported():
            self._taken += steps
            hasty = self._small and self._taken + planned <= HASTY_STEPS
            if not self._loaded:
                self._load(self._make(hasty))
            elif not hasty and self._loaded[-1][0].hasty:
                self._load(MachineCode(self._loaded[-1][0].text))
            return self._loaded[-1][1:]

    def _load(self, code: MachineCode) -> None:
        self._loaded.append((code, BEGIN(code.address("begin")), ADVANCE(code.address("advance"))))


HASTY_STEPS, HASTY_SIZE = 1_000, 30_000
"""Steps up to which the loop is not optimised, and operations."""

ADVANCE = ctypes.CFUNCTYPE(ctypes.c_int64, *[ctypes.c_void_p] * 3, *[ctypes.c_int64] * 3, ctypes.c_void_p,
                           ctypes.c_int64, *[ctypes.c_void_p] * 2)  # fmt: skip

BEGIN = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_int64)


class _Steps(Writer):
    """Writes ``advance(p, blocks, done, count, saves, every, out, most, noise, newton)``.

    It advances each block from its step ``done`` to step ``saves * every`` and keeps states in ``out``, one in
    ``every``. It reads the increments that drive the steps from ``noise``, block by block. A call takes ``most`` steps
    at most, and ends where a block needs Newton's method and ``newton`` is null. It then returns the number of that
    block, and another call goes on there; otherwise it returns the number of blocks.
    """

    def __init__(self, function: ir.Function, pieces, layout: Layout, state, varies, lanes: int, kept):
        super().__init__(ir.IRBuilder(function.append_basic_block("entry")), lanes)
        self.pieces, self.layout, self.state, self.kept = pieces, layout, state, kept
        names = "p blocks done count saves every out most noise newton" if len(function.args) > 3 else "p blocks count"
        self.argument = dict(zip(names.split(), function.args, strict=True))
        own = np.cumsum(varies) - 1
        self.own = [int(own[i]) if v else None for i, v in enumerate(varies)]
        self.slots = {name: self._slots(name) for name in layout.sizes if name not in ("p", DEFERRED)}
        self.block, self.number_of_block = self.builder.alloca(NUMBERS), self.builder.alloca(WHOLE)

    def _slots(self, name: str) -> list[ir.Value]:
        return [self.builder.alloca(self.number, name=f"{name}_{i}") for i in range(self.layout.sizes[name])]

    # -- the loops ----------------------------------------------------------------------------------------------------

    def write_loops(self) -> None:
        build, argument = self.builder, self.argument
        for slot in itertools.chain.from_iterable(self.slots.values()):
            build.store(self.constant(0.0), slot)
        with self.counted(argument["count"]) as i:
            self.enter(i)
            done = build.gep(argument["done"], [i])
            total = build.mul(argument["saves"], argument["every"])
            limit = build.add(build.load(done), argument["most"])
            end = build.select(build.icmp_signed("<", total, limit), total, limit)
            self.load(self.state)

            def running() -> ir.Value:
                return build.fcmp_ordered("==", build.load(self.slots["status"][0]), self.constant(0.0))

            with self.repeated(lambda: build.and_(self.any(running()), build.icmp_signed("<", build.load(done), end))):
                self.drive(build.add(build.mul(i, total), build.load(done)))
                self.active = running()
                self.run("step")
                self.active = None
                build.store(build.add(build.load(done), self.whole_number(1)), done)
                with build.if_then(
                    build.icmp_signed("==", build.srem(build.load(done), argument["every"]), self.whole_number(0))
                ):
                    self.keep(i, build.sdiv(build.load(done), argument["every"]))
            self.save(self.state)
        build.ret(argument["count"])

    def write_begin(self) -> None:
        """``begin(p, blocks, count)``: from the x of each trajectory the state of a run about to start there."""
        with self.counted(self.argument["count"]) as i:
            self.enter(i)
            self.load([name for name in self.pieces["begin"].arguments if name != "p"])
            self.run("begin")
            self.save([name for name in self.state if name in self.pieces["begin"].results])
        self.builder.ret_void()

    def enter(self, i: ir.Value) -> None:
        """Work on block i from here on."""
        size = self.builder.mul(i, self.whole_number(self.layout.height * self.lanes))
        self.builder.store(self.builder.gep(self.argument["blocks"], [size]), self.block)
        self.builder.store(i, self.number_of_block)

    def drive(self, number: ir.Value) -> None:
        """The increments of a step, from the row of ``noise`` with this number."""
        build, slots = self.builder, self.slots["dW"]
        row = build.mul(number, self.whole_number(len(slots) * self.lanes))
        for j, slot in enumerate(slots):
            start = build.gep(self.argument["noise"], [build.add(row, self.whole_number(j * self.lanes))])
            build.store(build.load(build.bitcast(start, self.number.as_pointer()), align=8), slot)

    def deferred(self, args: Sequence[ir.Value], results: int) -> list[ir.Value]:
        """Newton's method for the lanes that have not converged; the loop is left where there is none.

        It finds its arguments in the block, and leaves its results there.
        """
        build, argument = self.builder, self.argument
        unsolved = build.fcmp_ordered("==", args[CONVERGED], self.constant(0.0))
        hard = unsolved if self.active is None else build.and_(self.active, unsolved)
        with build.goto_entry_block():
            found = [build.alloca(self.number) for _ in range(results)]
        for slot, value in zip(found, args, strict=False):
            build.store(value, slot)
        with build.if_then(self.any(hard), likely=False):
            with build.if_then(build.icmp_unsigned("==", argument["newton"], ir.Constant(POINTER, None))):
                self.save(self.state)
                build.ret(build.load(self.number_of_block))
            solve = ir.FunctionType(ir.VoidType(), [NUMBERS, NUMBERS, WHOLE])
            function = build.bitcast(argument["newton"], solve.as_pointer())
            places = [self.place(self.layout.rows[DEFERRED] + i) for i in range(len(args))]
            for place, value in zip(places, args, strict=True):
                build.store(value, place, align=8)
            for lane in range(self.lanes):
                needed = hard if self.lanes == 1 else build.extract_element(hard, ir.Constant(ir.IntType(32), lane))
                with build.if_then(needed):
                    build.call(function, [argument["p"], build.load(self.block), self.whole_number(lane)])
            for slot, place in zip(found, places, strict=False):
                build.store(build.load(place, align=8), slot)
        return [build.load(slot) for slot in found]

    # -- rows and slots -----------------------------------------------------------------------------------------------

    def run(self, name: str) -> None:
        """Run a piece; its results take the place of what there was, in the lanes that are active."""
        piece, build, where = self.pieces[name], self.builder, self.active

        def read(i: int, j: int) -> ir.Value:
            array = piece.arguments[i]
            return self.parameter(j) if array == "p" else build.load(self.slots[array][j])

        def memory(i: int, places: range) -> Table | None:
            own = [self.own[j] for j in places] if piece.arguments[i] == "p" else []
            if not own or own.count(None) not in (0, len(own)):
                return None
            if own[0] is None:
                start, kind = build.gep(self.argument["p"], [self.whole_number(places[0])]), NUMBER
            else:  # those of an array are all each lane's own, in the same order
                start, kind = self.place(self.layout.rows["p"] + own[0]), self.number
            return Table(self, kind, start=start, length=len(places), step=places.step)

        for array, values in zip(piece.results, self.write(piece.program, read, memory), strict=True):
            for slot, value in zip(self.slots[array], values, strict=True):
                build.store(value if where is None else build.select(where, value, build.load(slot)), slot)

    def parameter(self, i: int) -> ir.Value:
        own, build = self.own[i], self.builder
        if own is not None:
            return build.load(self.place(self.layout.rows["p"] + own), align=8)
        found = build.load(build.gep(self.argument["p"], [self.whole_number(i)]))
        found.set_metadata("invariant.load", build.module.add_metadata([]))
        return self.splat(found)

    def place(self, row: int) -> ir.Value:
        start = self.builder.gep(self.builder.load(self.block), [self.whole_number(row * self.lanes)])
        return self.builder.bitcast(start, self.number.as_pointer())

    def load(self, names: Sequence[str]) -> None:
        for name in names:
            for i, slot in enumerate(self.slots[name]):
                self.builder.store(self.builder.load(self.place(self.layout.rows[name] + i), align=8), slot)

    def save(self, names: Sequence[str]) -> None:
        for name in names:
            for i, slot in enumerate(self.slots[name]):
                self.builder.store(self.builder.load(slot), self.place(self.layout.rows[name] + i), align=8)

    def keep(self, i: ir.Value, number: ir.Value) -> None:
        """Write down what is kept, as the row of block i in ``out`` with this number."""
        build, argument = self.builder, self.argument
        kept = [slot for name in self.kept for slot in self.slots[name]]
        row = build.add(build.mul(i, argument["saves"]), build.sub(number, self.whole_number(1)))
        start = build.gep(argument["out"], [build.mul(row, self.whole_number(len(kept) * self.lanes))])
        for j, slot in enumerate(kept):
            place = build.bitcast(build.gep(start, [self.whole_number(j * self.lanes)]), self.number.as_pointer())
            build.store(build.load(slot), place, align=8)


DEFERRED = "deferred"
"""Rows of a block that hold what Newton's method is given, and what it leaves: the latter is what the former begins
with."""

CONVERGED = 0
"""Which of them says whether the equations are solved."""
