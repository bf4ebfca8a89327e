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
from ...tracing.scalarize import report_compiler_faults
from .blocks import Table
from .machine_code import MachineCode
from .writer import FLOAT64, INT64, ProgramWriter

BYTE_POINTER, FLOAT64_POINTER, INT64_POINTER = ir.IntType(8).as_pointer(), FLOAT64.as_pointer(), INT64.as_pointer()


class NamedProgram(NamedTuple):
    """A program, and the names of the arrays that it reads and writes."""

    program: Program
    arguments: tuple[str, ...]
    results: tuple[str, ...]


class BlockLayout:
    """Where arrays of some shapes lie one after another: their first rows by name, and how many rows there are."""

    def __init__(self, shapes: Mapping[str, tuple[int, ...]]):
        self.row_counts = {name: math.prod(shape) for name, shape in shapes.items()}
        ends = list(itertools.accumulate(self.row_counts.values(), initial=0))
        self.first_rows, self.n_rows = dict(zip(self.row_counts, ends, strict=False)), ends[-1]


def compile_step_loop(
    pieces: Mapping[str, NamedProgram],
    layout: BlockLayout,
    state: Sequence[str],
    varies: np.ndarray,
    lanes: int,
    kept: Sequence[str],
    hasty: bool,
) -> MachineCode:
    """The functions ``advance`` and ``begin`` of :class:`_StepLoopWriter` as machine code.

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
    kinds = [
        FLOAT64_POINTER,
        FLOAT64_POINTER,
        INT64_POINTER,
        INT64,
        INT64,
        INT64,
        FLOAT64_POINTER,
        INT64,
        FLOAT64_POINTER,
        BYTE_POINTER,
    ]
    function = ir.Function(module, ir.FunctionType(INT64, kinds), "advance")
    function.args[0].add_attribute("noalias")
    _StepLoopWriter(function, pieces, layout, state, varies, lanes, kept).write_loops()
    begin = ir.Function(module, ir.FunctionType(ir.VoidType(), [FLOAT64_POINTER, FLOAT64_POINTER, INT64]), "begin")
    _StepLoopWriter(begin, pieces, layout, state, varies, lanes, kept).write_begin()
    return MachineCode(module, hasty)


class CompiledLoops:
    """The functions of :func:`compile_step_loop`: optimised once many steps are taken.

    Parameters
    ----------
    make : function from ``hasty`` to MachineCode
    small : bool
        Whether there is a choice: code that is not optimised takes a place on the stack for each of its operations.
    """

    def __init__(self, make: Callable[[bool], MachineCode], small: bool):
        self._compile, self._can_skip_optimisation, self._steps_so_far, self._lock = make, small, 0, threading.Lock()
        self._loaded: list[tuple[MachineCode, Callable, Callable]] = []  # all of them: a thread may be in any

    def loop_functions(self, steps: int, planned: int = 0) -> Sequence[Callable]:
        """``begin`` and ``advance`` for so many steps more, and others that are planned: compiled, or found so."""
        with self._lock, report_compiler_faults():
            self._steps_so_far += steps
            hasty = self._can_skip_optimisation and self._steps_so_far + planned <= MAX_UNOPTIMISED_STEPS
            if not self._loaded:
                self._load(self._compile(hasty))
            elif not hasty and self._loaded[-1][0].skip_optimisation:
                self._load(MachineCode(self._loaded[-1][0].ir_text))
            return self._loaded[-1][1:]

    def _load(self, code: MachineCode) -> None:
        self._loaded.append(
            (code, BEGIN_SIGNATURE(code.function_address("begin")), ADVANCE_SIGNATURE(code.function_address("advance")))
        )


MAX_UNOPTIMISED_STEPS, MAX_UNOPTIMISED_OPERATIONS = 1_000, 30_000
"""Steps up to which the loop is not optimised, and operations."""

ADVANCE_SIGNATURE = ctypes.CFUNCTYPE(ctypes.c_int64, *[ctypes.c_void_p] * 3, *[ctypes.c_int64] * 3, ctypes.c_void_p,
                           ctypes.c_int64, *[ctypes.c_void_p] * 2)  # fmt: skip

BEGIN_SIGNATURE = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_int64)


class _StepLoopWriter(ProgramWriter):
    """Writes ``advance(p, blocks, done, count, saves, every, out, most, noise, newton)``.

    It advances each block from its step ``done`` to step ``saves * every`` and keeps states in ``out``, one in
    ``every``. It reads the increments that drive the steps from ``noise``, block by block. A call takes ``most`` steps
    at most, and ends where a block needs Newton's method and ``newton`` is null. It then returns the number of that
    block, and another call goes on there; otherwise it returns the number of blocks.
    """

    def __init__(self, function: ir.Function, pieces, layout: BlockLayout, state, varies, lanes: int, kept):
        super().__init__(ir.IRBuilder(function.append_basic_block("entry")), lanes)
        self.programs, self.layout, self.state_names, self.saved_names = pieces, layout, state, kept
        names = "p blocks done count saves every out most noise newton" if len(function.args) > 3 else "p blocks count"
        self.arguments = dict(zip(names.split(), function.args, strict=True))
        own = np.cumsum(varies) - 1
        self.parameter_rows = [int(own[i]) if v else None for i, v in enumerate(varies)]
        self.slots = {
            name: self._allocate_slots(name) for name in layout.row_counts if name not in ("p", NEWTON_BUFFER)
        }
        self.block, self.block_index = self.builder.alloca(FLOAT64_POINTER), self.builder.alloca(INT64)

    def _allocate_slots(self, name: str) -> list[ir.Value]:
        return [self.builder.alloca(self.double_type, name=f"{name}_{i}") for i in range(self.layout.row_counts[name])]

    # -- the loops ----------------------------------------------------------------------------------------------------

    def write_loops(self) -> None:
        build, argument = self.builder, self.arguments
        for slot in itertools.chain.from_iterable(self.slots.values()):
            build.store(self.constant(0.0), slot)
        with self.loop_range(argument["count"]) as i:
            self.select_block(i)
            done = build.gep(argument["done"], [i])
            total = build.mul(argument["saves"], argument["every"])
            limit = build.add(build.load(done), argument["most"])
            end = build.select(build.icmp_signed("<", total, limit), total, limit)
            self.load_rows(self.state_names)

            def running() -> ir.Value:
                return build.fcmp_ordered("==", build.load(self.slots["status"][0]), self.constant(0.0))

            with self.loop_while(
                lambda: build.and_(self.has_true_lane(running()), build.icmp_signed("<", build.load(done), end))
            ):
                self.load_noise_increments(build.add(build.mul(i, total), build.load(done)))
                self.active_lanes = running()
                self.run_program("step")
                self.active_lanes = None
                build.store(build.add(build.load(done), self.int64(1)), done)
                with build.if_then(
                    build.icmp_signed("==", build.srem(build.load(done), argument["every"]), self.int64(0))
                ):
                    self.store_output(i, build.sdiv(build.load(done), argument["every"]))
            self.store_rows(self.state_names)
        build.ret(argument["count"])

    def write_begin(self) -> None:
        """``begin(p, blocks, count)``: from the x of each trajectory the state of a run about to start there."""
        with self.loop_range(self.arguments["count"]) as i:
            self.select_block(i)
            self.load_rows([name for name in self.programs["begin"].arguments if name != "p"])
            self.run_program("begin")
            self.store_rows([name for name in self.state_names if name in self.programs["begin"].results])
        self.builder.ret_void()

    def select_block(self, i: ir.Value) -> None:
        """Work on block i from here on."""
        size = self.builder.mul(i, self.int64(self.layout.n_rows * self.lanes))
        self.builder.store(self.builder.gep(self.arguments["blocks"], [size]), self.block)
        self.builder.store(i, self.block_index)

    def load_noise_increments(self, number: ir.Value) -> None:
        """The increments of a step, from the row of ``noise`` with this number."""
        build, slots = self.builder, self.slots["dW"]
        row = build.mul(number, self.int64(len(slots) * self.lanes))
        for j, slot in enumerate(slots):
            start = build.gep(self.arguments["noise"], [build.add(row, self.int64(j * self.lanes))])
            build.store(build.load(build.bitcast(start, self.double_type.as_pointer()), align=8), slot)

    def call_newton(self, args: Sequence[ir.Value], results: int) -> list[ir.Value]:
        """Newton's method for the lanes that have not converged; the loop is left where there is none.

        It finds its arguments in the block, and leaves its results there.
        """
        build, argument = self.builder, self.arguments
        unsolved = build.fcmp_ordered("==", args[CONVERGED_INDEX], self.constant(0.0))
        hard = unsolved if self.active_lanes is None else build.and_(self.active_lanes, unsolved)
        with build.goto_entry_block():
            found = [build.alloca(self.double_type) for _ in range(results)]
        for slot, value in zip(found, args, strict=False):
            build.store(value, slot)
        with build.if_then(self.has_true_lane(hard), likely=False):
            with build.if_then(build.icmp_unsigned("==", argument["newton"], ir.Constant(BYTE_POINTER, None))):
                self.store_rows(self.state_names)
                build.ret(build.load(self.block_index))
            solve = ir.FunctionType(ir.VoidType(), [FLOAT64_POINTER, FLOAT64_POINTER, INT64])
            function = build.bitcast(argument["newton"], solve.as_pointer())
            places = [self.row_pointer(self.layout.first_rows[NEWTON_BUFFER] + i) for i in range(len(args))]
            for place, value in zip(places, args, strict=True):
                build.store(value, place, align=8)
            for lane in range(self.lanes):
                needed = hard if self.lanes == 1 else build.extract_element(hard, ir.Constant(ir.IntType(32), lane))
                with build.if_then(needed):
                    build.call(function, [argument["p"], build.load(self.block), self.int64(lane)])
            for slot, place in zip(found, places, strict=False):
                build.store(build.load(place, align=8), slot)
        return [build.load(slot) for slot in found]

    # -- rows and slots -----------------------------------------------------------------------------------------------

    def run_program(self, name: str) -> None:
        """Run a piece; its results take the place of what there was, in the lanes that are active."""
        piece, build, where = self.programs[name], self.builder, self.active_lanes

        def read(i: int, j: int) -> ir.Value:
            array = piece.arguments[i]
            return self.load_parameter(j) if array == "p" else build.load(self.slots[array][j])

        def memory(i: int, places: range) -> Table | None:
            own = [self.parameter_rows[j] for j in places] if piece.arguments[i] == "p" else []
            if not own or own.count(None) not in (0, len(own)):
                return None
            if own[0] is None:
                start, kind = build.gep(self.arguments["p"], [self.int64(places[0])]), FLOAT64
            else:  # those of an array are all each lane's own, in the same order
                start, kind = self.row_pointer(self.layout.first_rows["p"] + own[0]), self.double_type
            return Table(self, kind, start=start, length=len(places), stride=places.step)

        for array, values in zip(piece.results, self.write_as_doubles(piece.program, read, memory), strict=True):
            for slot, value in zip(self.slots[array], values, strict=True):
                build.store(value if where is None else build.select(where, value, build.load(slot)), slot)

    def load_parameter(self, i: int) -> ir.Value:
        own, build = self.parameter_rows[i], self.builder
        if own is not None:
            return build.load(self.row_pointer(self.layout.first_rows["p"] + own), align=8)
        found = build.load(build.gep(self.arguments["p"], [self.int64(i)]))
        found.set_metadata("invariant.load", build.module.add_metadata([]))
        return self.splat(found)

    def row_pointer(self, row: int) -> ir.Value:
        start = self.builder.gep(self.builder.load(self.block), [self.int64(row * self.lanes)])
        return self.builder.bitcast(start, self.double_type.as_pointer())

    def load_rows(self, names: Sequence[str]) -> None:
        for name in names:
            for i, slot in enumerate(self.slots[name]):
                self.builder.store(self.builder.load(self.row_pointer(self.layout.first_rows[name] + i), align=8), slot)

    def store_rows(self, names: Sequence[str]) -> None:
        for name in names:
            for i, slot in enumerate(self.slots[name]):
                self.builder.store(self.builder.load(slot), self.row_pointer(self.layout.first_rows[name] + i), align=8)

    def store_output(self, i: ir.Value, number: ir.Value) -> None:
        """Write down what is kept, as the row of block i in ``out`` with this number."""
        build, argument = self.builder, self.arguments
        kept = [slot for name in self.saved_names for slot in self.slots[name]]
        row = build.add(build.mul(i, argument["saves"]), build.sub(number, self.int64(1)))
        start = build.gep(argument["out"], [build.mul(row, self.int64(len(kept) * self.lanes))])
        for j, slot in enumerate(kept):
            place = build.bitcast(build.gep(start, [self.int64(j * self.lanes)]), self.double_type.as_pointer())
            build.store(build.load(slot), place, align=8)


NEWTON_BUFFER = "deferred"
"""Rows of a block that hold what Newton's method is given, and what it leaves: the latter is what the former begins
with."""

CONVERGED_INDEX = 0
"""Which of them says whether the equations are solved."""
