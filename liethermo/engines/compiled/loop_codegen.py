"""Step loop of the compiled engine: the array engine's own steps, as scalar programs, on lanes that advance together.

A *block* is a group of trajectories that advance together, one SIMD lane each; a single trajectory is a block of one
lane. The programs are traced from the functions of the array engine (:mod:`..array_engine`), so both engines take the
same steps; this module writes the loops around them. The fields of a block are held in registers, as far as there are
enough, and written back when the loop is left.
"""

from __future__ import annotations

import ctypes
import itertools
import math
import threading
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from llvmlite import ir

from ...tracing.program import Program
from ...tracing.scalarize import report_compiler_faults
from .llvm_writer import FLOAT64, INT64, ProgramWriter
from .loops_and_calls import Table
from .machine_code import MachineCode

BYTE_POINTER = ir.IntType(8).as_pointer()
FLOAT64_POINTER = FLOAT64.as_pointer()
INT64_POINTER = INT64.as_pointer()


class NamedProgram(NamedTuple):
    """A program with names for the arrays that it reads and writes."""

    program: Program
    arguments: tuple[str, ...]
    results: tuple[str, ...]


class BlockLayout:
    """The rows of a block that hold each array: the first row and their number, by name."""

    def __init__(self, shapes: Mapping[str, tuple[int, ...]]):
        self.row_counts = {name: math.prod(shape) for name, shape in shapes.items()}
        ends = list(itertools.accumulate(self.row_counts.values(), initial=0))
        self.first_rows, self.n_rows = dict(zip(self.row_counts, ends, strict=False)), ends[-1]


def write_step_loop(
    programs: Mapping[str, NamedProgram],
    layout: BlockLayout,
    state_names: Sequence[str],
    is_per_trajectory: np.ndarray,
    lanes: int,
    saved_names: Sequence[str],
) -> ir.Module:
    """Write the functions ``advance`` and ``begin`` of :class:`_StepLoopWriter` for LLVM.

    Parameters
    ----------
    programs : mapping
        ``begin``, which computes the initial state of a run, and ``step``, the state after a step.
    layout : BlockLayout
        Layout of a block; each row has a number for each lane.
    state_names : sequence of str
        Arrays that are carried from step to step.
    is_per_trajectory : array of bool, shape (p,)
        Parameters that lie in the block, under the name "p"; the others are common to all trajectories.
    saved_names : sequence of str
        Arrays that are written out at each save.
    """
    module = ir.Module("steps")
    function = ir.Function(module, ADVANCE_TYPE, "advance")
    function.args[0].add_attribute("noalias")
    _StepLoopWriter(function, programs, layout, state_names, is_per_trajectory, lanes, saved_names).write_loops()
    begin = ir.Function(module, BEGIN_TYPE, "begin")
    _StepLoopWriter(begin, programs, layout, state_names, is_per_trajectory, lanes, saved_names).write_start_function()
    return module


class CompiledLoops:
    """Compiled functions of :func:`write_step_loop`, optimised only once many steps are taken.

    Parameters
    ----------
    write_module : function that returns the module of :func:`write_step_loop`
    key : str
        See :class:`.machine_code.MachineCode`.
    can_skip_optimisation : bool
        Whether code may stay unoptimised: such code takes a place on the stack for each of its operations.
    """

    def __init__(self, write_module: Callable[[], ir.Module], key: str, can_skip_optimisation: bool):
        self._write_module, self._key = write_module, key
        self._can_skip_optimisation = can_skip_optimisation
        self._steps_so_far = 0
        self._lock = threading.Lock()
        self._loaded: list[
            tuple[MachineCode, Any, Any]
        ] = []  # kept loaded, because a thread may be running any of them

    def loop_functions(self, n_steps: int, planned_steps: int = 0) -> tuple[Any, Any]:
        """Return the functions ``begin`` and ``advance``, optimised if the numbers of steps are worth it."""
        if self._loaded and not self._loaded[-1][0].skip_optimisation:
            return self._loaded[-1][1:]
        with self._lock, report_compiler_faults():
            self._steps_so_far += n_steps
            skip_optimisation = (
                self._can_skip_optimisation and self._steps_so_far + planned_steps <= MAX_UNOPTIMISED_STEPS
            )
            if not self._loaded:
                self._append_loop_functions(MachineCode(self._write_module, skip_optimisation, self._key))
            elif not skip_optimisation and self._loaded[-1][0].skip_optimisation:
                self._append_loop_functions(self._loaded[-1][0].optimised())
            return self._loaded[-1][1:]

    def _append_loop_functions(self, machine_code: MachineCode) -> None:
        """Append the functions of machine code to those in memory."""
        self._loaded.append(
            (
                machine_code,
                BEGIN_SIGNATURE(machine_code.function_address("begin")),
                ADVANCE_SIGNATURE(machine_code.function_address("advance")),
            )
        )


MAX_UNOPTIMISED_STEPS = 1_000
"""Largest number of steps that a loop takes without being optimised, since optimising it would take longer."""

MAX_UNOPTIMISED_OPERATIONS = 30_000
"""Largest number of operations of a step that may stay unoptimised, since each takes a place on the stack."""

ADVANCE_SIGNATURE = ctypes.CFUNCTYPE(ctypes.c_int64, *[ctypes.c_void_p] * 3, *[ctypes.c_int64] * 3, ctypes.c_void_p,
                           ctypes.c_int64, *[ctypes.c_void_p] * 2)  # fmt: skip
"""C signature of ``advance``: see :class:`_StepLoopWriter`."""

ADVANCE_TYPE = ir.FunctionType(INT64, [FLOAT64_POINTER, FLOAT64_POINTER, INT64_POINTER, INT64, INT64, INT64,
                               FLOAT64_POINTER, INT64, FLOAT64_POINTER, BYTE_POINTER])  # fmt: skip
"""Type of ``advance`` for LLVM."""

BEGIN_TYPE = ir.FunctionType(ir.VoidType(), [FLOAT64_POINTER, FLOAT64_POINTER, INT64])
"""Type of ``begin`` for LLVM."""

BEGIN_SIGNATURE = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_int64)
"""C signature of ``begin(p, blocks, count)``."""


class _StepLoopWriter(ProgramWriter):
    """Writer of ``advance(p, blocks, done, count, saves, every, out, most, noise, newton)`` and of ``begin``.

    ``advance`` takes each block from its step ``done`` to step ``saves * every`` and writes every ``every``-th state to
    ``out``. It reads the noise increments of the steps from ``noise``, block by block. A call takes at most ``most``
    steps. If a block needs Newton's method and ``newton`` is null, the call returns the number of that block, and
    another call resumes there; otherwise it returns the number of blocks.
    """

    def __init__(
        self,
        function: ir.Function,
        programs,
        layout: BlockLayout,
        state_names,
        is_per_trajectory,
        lanes: int,
        saved_names,
    ):
        super().__init__(ir.IRBuilder(function.append_basic_block("entry")), lanes)
        self.programs, self.layout, self.state_names, self.saved_names = programs, layout, state_names, saved_names
        names = "p blocks done count saves every out most noise newton" if len(function.args) > 3 else "p blocks count"
        self.arguments = dict(zip(names.split(), function.args, strict=True))
        parameter_row = np.cumsum(is_per_trajectory) - 1
        self.parameter_rows = [int(parameter_row[i]) if v else None for i, v in enumerate(is_per_trajectory)]
        self.slots = {
            name: self._allocate_slots(name) for name in layout.row_counts if name not in ("p", NEWTON_BUFFER)
        }
        self.block, self.block_index = self.builder.alloca(FLOAT64_POINTER), self.builder.alloca(INT64)

    def _allocate_slots(self, name: str) -> list[ir.Value]:
        """Return new stack slots for the entries of an array."""
        return [self.builder.alloca(self.double_type, name=f"{name}_{i}") for i in range(self.layout.row_counts[name])]

    # -- the loops ----------------------------------------------------------------------------------------------------

    def write_loops(self) -> None:
        """Write ``advance``: loops over blocks and steps with saves."""
        build, argument = self.builder, self.arguments
        for slot in itertools.chain.from_iterable(self.slots.values()):
            build.store(self.constant(0.0), slot)
        with self.loop_range(argument["count"]) as i:
            self.select_block(i)
            steps_done = build.gep(argument["done"], [i])
            total_steps = build.mul(argument["saves"], argument["every"])
            limit = build.add(build.load(steps_done), argument["most"])
            end_step = build.select(build.icmp_signed("<", total_steps, limit), total_steps, limit)
            self.load_fields_from_block(self.state_names)

            def is_running() -> ir.Value:
                return build.fcmp_ordered("==", build.load(self.slots["status"][0]), self.constant(0.0))

            with self.loop_while(
                lambda: build.and_(
                    self.has_true_lane(is_running()), build.icmp_signed("<", build.load(steps_done), end_step)
                )
            ):
                self.copy_noise_increments_to_slots(build.add(build.mul(i, total_steps), build.load(steps_done)))
                self.active_lanes = is_running()
                self.write_program_and_store_results("step")
                self.active_lanes = None
                build.store(build.add(build.load(steps_done), self.int64(1)), steps_done)
                with build.if_then(
                    build.icmp_signed("==", build.srem(build.load(steps_done), argument["every"]), self.int64(0))
                ):
                    self.store_saved_fields(i, build.sdiv(build.load(steps_done), argument["every"]))
            self.store_fields_in_block(self.state_names)
        build.ret(argument["count"])

    def write_start_function(self) -> None:
        """Write ``begin(p, blocks, count)``, which computes the initial engine state of each block from its x."""
        with self.loop_range(self.arguments["count"]) as i:
            self.select_block(i)
            self.load_fields_from_block([name for name in self.programs["begin"].arguments if name != "p"])
            self.write_program_and_store_results("begin")
            self.store_fields_in_block([name for name in self.state_names if name in self.programs["begin"].results])
        self.builder.ret_void()

    def select_block(self, block_number: ir.Value) -> None:
        """Make a block the one that the following instructions work on."""
        offset = self.builder.mul(block_number, self.int64(self.layout.n_rows * self.lanes))
        self.builder.store(self.builder.gep(self.arguments["blocks"], [offset]), self.block)
        self.builder.store(block_number, self.block_index)

    def copy_noise_increments_to_slots(self, step_number: ir.Value) -> None:
        """Copy the noise increments of a step to the slots of ``dW``."""
        build, slots = self.builder, self.slots["dW"]
        row = build.mul(step_number, self.int64(len(slots) * self.lanes))
        for j, slot in enumerate(slots):
            start = build.gep(self.arguments["noise"], [build.add(row, self.int64(j * self.lanes))])
            build.store(build.load(build.bitcast(start, self.double_type.as_pointer()), align=8), slot)

    def call_newton(self, args: Sequence[ir.Value], n_results: int) -> list[ir.Value]:
        """Call Newton's method for the lanes that have not converged; leave the loop if it is not compiled yet.

        Newton's method reads its arguments from the block and writes its results there.
        """
        build, argument = self.builder, self.arguments
        is_unsolved = build.fcmp_ordered("==", args[CONVERGED_INDEX], self.constant(0.0))
        needs_newton = is_unsolved if self.active_lanes is None else build.and_(self.active_lanes, is_unsolved)
        with build.goto_entry_block():
            result_slots = [build.alloca(self.double_type) for _ in range(n_results)]
        for slot, value in zip(result_slots, args, strict=False):
            build.store(value, slot)
        with build.if_then(self.has_true_lane(needs_newton), likely=False):
            with build.if_then(build.icmp_unsigned("==", argument["newton"], ir.Constant(BYTE_POINTER, None))):
                self.store_fields_in_block(self.state_names)
                build.ret(build.load(self.block_index))
            solve_type = ir.FunctionType(ir.VoidType(), [FLOAT64_POINTER, FLOAT64_POINTER, INT64])
            function = build.bitcast(argument["newton"], solve_type.as_pointer())
            buffer_rows = [self.row_pointer(self.layout.first_rows[NEWTON_BUFFER] + i) for i in range(len(args))]
            for buffer_row, value in zip(buffer_rows, args, strict=True):
                build.store(value, buffer_row, align=8)
            for lane in range(self.lanes):
                lane_needs_newton = (
                    needs_newton
                    if self.lanes == 1
                    else build.extract_element(needs_newton, ir.Constant(ir.IntType(32), lane))
                )
                with build.if_then(lane_needs_newton):
                    build.call(function, [argument["p"], build.load(self.block), self.int64(lane)])
            for slot, buffer_row in zip(result_slots, buffer_rows, strict=False):
                build.store(build.load(buffer_row, align=8), slot)
        return [build.load(slot) for slot in result_slots]

    # -- rows and slots -----------------------------------------------------------------------------------------------

    def write_program_and_store_results(self, name: str) -> None:
        """Write a program and store its results in slots, in the active lanes only."""
        named_program, build, active_lanes = self.programs[name], self.builder, self.active_lanes

        def read(i: int, j: int) -> ir.Value:
            array = named_program.arguments[i]
            return self.load_parameter(j) if array == "p" else build.load(self.slots[array][j])

        def find_table(i: int, entries: range) -> Table | None:
            rows = [self.parameter_rows[j] for j in entries] if named_program.arguments[i] == "p" else []
            if not rows or rows.count(None) not in (0, len(rows)):
                return None
            if rows[0] is None:
                start, value_type = build.gep(self.arguments["p"], [self.int64(entries[0])]), FLOAT64
            else:  # per-trajectory entries of an array are consecutive rows of the block
                start, value_type = self.row_pointer(self.layout.first_rows["p"] + rows[0]), self.double_type
            return Table(self, value_type, start=start, length=len(entries), stride=entries.step)

        for array, values in zip(
            named_program.results,
            self.write_program_with_double_outputs(named_program.program, read, find_table),
            strict=True,
        ):
            for slot, value in zip(self.slots[array], values, strict=True):
                build.store(
                    value if active_lanes is None else build.select(active_lanes, value, build.load(slot)), slot
                )

    def load_parameter(self, i: int) -> ir.Value:
        """Return parameter i, from the block if it differs between trajectories."""
        row, build = self.parameter_rows[i], self.builder
        if row is not None:
            return build.load(self.row_pointer(self.layout.first_rows["p"] + row), align=8)
        value = build.load(build.gep(self.arguments["p"], [self.int64(i)]))
        value.set_metadata("invariant.load", build.module.add_metadata([]))
        return self.splat(value)

    def row_pointer(self, row: int) -> ir.Value:
        """Return the pointer to a row of the current block."""
        start = self.builder.gep(self.builder.load(self.block), [self.int64(row * self.lanes)])
        return self.builder.bitcast(start, self.double_type.as_pointer())

    def load_fields_from_block(self, names: Sequence[str]) -> None:
        """Copy fields from the current block to slots."""
        for name in names:
            for i, slot in enumerate(self.slots[name]):
                self.builder.store(self.builder.load(self.row_pointer(self.layout.first_rows[name] + i), align=8), slot)

    def store_fields_in_block(self, names: Sequence[str]) -> None:
        """Copy fields from slots to the current block."""
        for name in names:
            for i, slot in enumerate(self.slots[name]):
                self.builder.store(self.builder.load(slot), self.row_pointer(self.layout.first_rows[name] + i), align=8)

    def store_saved_fields(self, block_number: ir.Value, save_number: ir.Value) -> None:
        """Write the saved fields of a block to ``out``, as save ``save_number``."""
        build, argument = self.builder, self.arguments
        saved_slots = [slot for name in self.saved_names for slot in self.slots[name]]
        row = build.add(build.mul(block_number, argument["saves"]), build.sub(save_number, self.int64(1)))
        start = build.gep(argument["out"], [build.mul(row, self.int64(len(saved_slots) * self.lanes))])
        for j, slot in enumerate(saved_slots):
            pointer = build.bitcast(build.gep(start, [self.int64(j * self.lanes)]), self.double_type.as_pointer())
            build.store(build.load(slot), pointer, align=8)


NEWTON_BUFFER = "deferred"
"""Name of the rows of a block that hold the arguments of Newton's method; its results overwrite the first of them."""

CONVERGED_INDEX = 0
"""Index among the arguments of Newton's method of the flag that the stage equations are solved."""


def write_newton_solver(program: Program, layout: BlockLayout, is_per_trajectory: np.ndarray, lanes: int) -> ir.Module:
    """Write for LLVM the function ``solve(p, block, lane)``, which runs ``program`` on the arrays of one lane.

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
        itertools.chain.from_iterable(writer.write_program_with_double_outputs(program, read_argument, find_table))
    ):
        build.store(value, row_pointer(first_row + i))
    build.ret_void()
    return module
