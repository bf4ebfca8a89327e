"""Loops, calls and tables of scalar programs as LLVM instructions, for all lanes at once."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from llvmlite import ir

from ...tracing.builder import Block
from ...tracing.calls import DeferredBlock, LapackCall, MatrixProduct
from ...tracing.program import Routine, ScanLoop, WhileLoop
from .lapack import find_or_write_kernel

INT32 = ir.IntType(32)

TABLE_ALIGNMENT_BYTES = 8
"""Alignment of the entries of tables. Some tables lie in NumPy arrays, which are not aligned to whole vectors."""


def write_block(writer: Any, block: Block, args: Sequence[Any]) -> BlockResults:
    """Write the instructions of a block (a loop, call or matrix product) and return its results.

    Parameters
    ----------
    writer : ProgramWriter
    """
    if isinstance(block, WhileLoop):
        return _write_while(writer, block, args)
    if isinstance(block, ScanLoop):
        return _write_scan(writer, block, args)
    if isinstance(block, DeferredBlock):
        return BlockResults(writer.call_newton(args, len(block.result_kinds)))
    if isinstance(block, Routine):
        return _call_routine(writer, block, args)
    if isinstance(block, MatrixProduct):
        return _write_matrix_product(writer, block, args)
    assert isinstance(block, LapackCall)
    return _call_kernel(writer, block, args)


def clamp_index(writer: Any, index: ir.Value, length: int) -> ir.Value:
    """Return an index clamped to the range of a table of ``length`` entries."""
    build, last_index = writer.builder, writer.constant(length - 1)
    index = build.select(build.icmp_signed("<", index, writer.constant(0)), writer.constant(0), index)
    return build.select(build.icmp_signed(">", index, last_index), last_index, index)


def select_entry(writer: Any, index: ir.Value, entries: Sequence[ir.Value]) -> ir.Value:
    """Return the entry at ``index``, clamped to the range, selected by the bits of the index."""
    build, index = writer.builder, clamp_index(writer, index, len(entries))
    entries, bit = list(entries), 0
    while len(entries) > 1:
        odd = build.trunc(build.lshr(index, writer.constant(bit)), writer.bool_type)
        pairs = [build.select(odd, b, a) for a, b in zip(entries[::2], entries[1::2], strict=False)]
        entries, bit = pairs + entries[2 * len(pairs) :], bit + 1
    return entries[0]


def _store_in_new_slots(writer: Any, kinds: Sequence[str], values: Sequence[ir.Value]) -> list[ir.Value]:
    """Return pointers to new stack slots that hold the values."""
    build, slots = writer.builder, []
    for kind, value in zip(kinds, values, strict=True):
        with build.goto_entry_block():  # otherwise each pass of an outer loop would take more of the stack
            slot = build.alloca(writer.type_of_kind[kind])
        build.store(writer.cast(value, kind), slot)
        slots.append(slot)
    return slots


def _make_argument_reader(*arrays: Sequence[ir.Value]) -> Callable[[int, int], ir.Value]:
    """Return a function that reads entry j of array i from lists of values."""
    return lambda i, j: arrays[i][j]


def _write_while(writer: Any, loop: WhileLoop, args: Sequence[ir.Value]) -> BlockResults:
    """Write a while loop, which runs until its test fails in every active lane, and return its results.

    A pass does not wait for the test of which lanes have left the loop: these lanes run on, and their results are
    discarded. They do wait if an inner loop might not end for them.
    """
    build, n_constants = writer.builder, len(loop.test.inputs[0])
    constants, slots = args[:n_constants], _store_in_new_slots(writer, loop.result_kinds, args[n_constants:])
    has_separate_slots = writer.lanes > 1 and not any(isinstance(i.op, Block) for i in loop.body.instructions)
    result_slots = _store_in_new_slots(writer, loop.result_kinds, args[n_constants:]) if has_separate_slots else slots
    outer_lanes = writer.active_lanes
    (running_lanes,) = _store_in_new_slots(writer, "b", [writer.constant(True) if outer_lanes is None else outer_lanes])

    def has_running_lane() -> ir.Value:
        carried = [build.load(slot) for slot in slots]
        ((test,),) = writer.write_program(loop.test, _make_argument_reader(constants, carried))
        build.store(build.and_(build.load(running_lanes), writer.cast(test, "b")), running_lanes)
        return writer.has_true_lane(build.load(running_lanes))

    with writer.loop_while(has_running_lane):
        previous_values = [build.load(slot) for slot in slots]
        writer.active_lanes = build.load(running_lanes)
        (new_values,) = writer.write_program(loop.body, _make_argument_reader(constants, previous_values))
        for slot, result_slot, kind, new_value in zip(slots, result_slots, loop.result_kinds, new_values, strict=True):
            value = writer.cast(new_value, kind)
            if writer.lanes > 1:
                build.store(build.select(writer.active_lanes, value, build.load(result_slot)), result_slot)
            if has_separate_slots or writer.lanes == 1:
                build.store(value, slot)
        writer.active_lanes = outer_lanes
    return BlockResults([build.load(slot) for slot in result_slots])


def _write_scan(writer: Any, loop: ScanLoop, args: Sequence[Any]) -> BlockResults:
    """Write a loop over the rows of tables with a carry, as ``jax.lax.scan``, and return its results."""
    build, n_constants = writer.builder, len(loop.body.inputs[0])
    start = n_constants + len(loop.carry_kinds)
    constants = args[:n_constants]
    slots = _store_in_new_slots(writer, loop.carry_kinds, args[n_constants:start])
    tables = args[start:]
    stacked_tables = [Table(writer, writer.type_of_kind[kind], length=loop.length) for kind in loop.stacked_kinds]
    with writer.loop_range(writer.int64(loop.length)) as count:
        i = build.sub(writer.int64(loop.length - 1), count) if loop.reverse else count
        carried, row = [build.load(slot) for slot in slots], [table.read(i) for table in tables]
        new_carry, stacked_values = writer.write_program(loop.body, _make_argument_reader(constants, carried, row))
        for slot, kind, value in zip(slots, loop.carry_kinds, new_carry, strict=True):
            build.store(writer.cast(value, kind), slot)
        for table, kind, value in zip(stacked_tables, loop.stacked_kinds, stacked_values, strict=True):
            table.write(i, writer.cast(value, kind))
    return BlockResults([build.load(slot) for slot in slots], stacked_tables, loop.length)


class Table:
    """Values of one type in memory, which the program reads and writes by index.

    Parameters
    ----------
    value_type : ir.Type
        Type of an entry; a scalar type while there are several lanes means that all lanes share the entry.
    values : sequence of values, optional
        Entries, stored in memory of the table, or a global constant if all are constant.
    length, start, stride : int, value, int
        Number of entries without ``values``; pointer to the first and distance of entries, for memory that exists.
    """

    def __init__(
        self,
        writer: Any,
        value_type: ir.Type,
        values: Sequence[ir.Value] = (),
        length: int = 0,
        start: ir.Value | None = None,
        stride: int = 1,
    ):
        self.builder, self.value_type, self.writer, self.stride = writer.builder, value_type, writer, stride
        self.length = max(len(values), length)
        # truth values are stored as integers
        self.memory_type = writer.type_of_kind["i"] if value_type == writer.type_of_kind["b"] else None
        if start is not None:
            self.start = start
            return
        if values and not self.memory_type and all(isinstance(value, ir.Constant) for value in values):
            array_type, module = ir.ArrayType(self.value_type, len(values)), self.builder.module
            global_table = ir.GlobalVariable(module, array_type, module.get_unique_name("table"))
            global_table.initializer = ir.Constant(array_type, list(values))
            global_table.global_constant = True
            global_table.linkage = "internal"
            self.start = self.builder.bitcast(global_table, self.value_type.as_pointer())
            return
        with self.builder.goto_entry_block():
            self.start = self.builder.alloca(self.memory_type or self.value_type, self.length)
        for i, value in enumerate(values):
            self.write(writer.int64(i), value)

    def view_at(self, writer: Any, start: ir.Value) -> Table:
        """Return this table as seen by another function, which gets its pointer as an argument."""
        return Table(writer, self.value_type, length=self.length, start=start, stride=self.stride)

    @property
    def signature(self) -> tuple:
        """Type, length and stride of the table, on which the code of a function that takes it depends."""
        return str(self.start.type), self.length, self.stride

    def _entry_pointer(self, i: ir.Value) -> ir.Value:
        """Return the pointer to entry i."""
        if self.stride != 1:
            i = self.builder.mul(i, self.writer.int64(self.stride))
        return self.builder.gep(self.start, [i])

    def read(self, i: ir.Value) -> ir.Value:
        """Return the entry at one index i, the same in all lanes."""
        value = self.builder.load(self._entry_pointer(i), align=TABLE_ALIGNMENT_BYTES)
        if isinstance(self.value_type, ir.DoubleType):
            return self.writer.splat(value)
        return self.builder.trunc(value, self.value_type) if self.memory_type else value

    def gather(self, indices: ir.Value) -> ir.Value:
        """Return the entry at an index of its own for each lane, clamped to the range."""
        build, lanes, indices = self.builder, self.writer.lanes, clamp_index(self.writer, indices, self.length)
        if lanes == 1:
            return self.read(indices)
        gathered: Any = None
        for lane in range(lanes):
            lane_index = ir.Constant(INT32, lane)
            pointer = self._entry_pointer(build.extract_element(indices, lane_index))
            value = build.load(pointer, align=TABLE_ALIGNMENT_BYTES)
            if isinstance(value.type, ir.VectorType):
                value = build.extract_element(value, lane_index)
            kind = ir.VectorType(value.type, lanes)
            gathered = build.insert_element(
                ir.Constant(kind, ir.Undefined) if gathered is None else gathered, value, lane_index
            )
        return build.trunc(gathered, self.value_type) if self.memory_type else gathered

    def write(self, i: ir.Value, value: ir.Value) -> None:
        """Store a value as entry i."""
        value = self.builder.zext(value, self.memory_type) if self.memory_type else value
        self.builder.store(value, self._entry_pointer(i), align=TABLE_ALIGNMENT_BYTES)


class BlockResults:
    """Results of a block: some values, followed by tables whose entries are read when they are used."""

    def __init__(self, values: Sequence[ir.Value], tables: Sequence[Table] = (), length: int = 1):
        self.values, self.tables, self.length = values, tables, length

    def item(self, i: int) -> ir.Value:
        """Return result i as a value."""
        if i < len(self.values):
            return self.values[i]
        table, row = divmod(i - len(self.values), self.length)
        return self.tables[table].read(ir.Constant(ir.IntType(64), row))

    def table_at(self, first_result_index: int) -> Table:
        """Return the table whose first entry is the given result."""
        return self.tables[(first_result_index - len(self.values)) // self.length]


def make_table(writer: Any, values: Sequence[ir.Value]) -> Table:
    """Return a new table of values, converted to doubles if one of them is a double."""
    value_type = writer.double_type if any(value.type == writer.double_type for value in values) else values[0].type
    return Table(writer, value_type, [writer.cast(v, "f") if value_type == writer.double_type else v for v in values])


def _call_routine(writer: Any, routine: Routine, args: Sequence[Any]) -> BlockResults:
    """Call a routine, compiled once as a function for all calls, and return its results."""
    build, n_results = writer.builder, len(routine.result_kinds)
    tables = {i: a for i, a in enumerate(args) if isinstance(a, Table)}
    numbers = [writer.cast(a, "f") for i, a in enumerate(args) if i not in tables]
    inputs = Table(writer, writer.double_type, numbers, length=1)
    results = Table(writer, writer.double_type, length=n_results)
    signature = repr((routine, *((i, a.signature) for i, a in tables.items())))
    name = "routine_" + hashlib.sha256(signature.encode()).hexdigest()[:16]
    function = build.module.globals.get(name) or _write_routine_function(writer, routine, name, tables)
    build.call(function, [inputs.start, results.start, *(a.start for a in tables.values())])
    return BlockResults([], [results], n_results)


def _write_routine_function(writer: Any, routine: Routine, name: str, tables: Mapping[int, Table]) -> ir.Function:
    """Return the LLVM function of a routine, for tables of given signatures."""
    argument_types = [writer.double_type.as_pointer()] * 2 + [a.start.type for a in tables.values()]
    function, function_writer = writer.new_function(name, argument_types)
    build, (inputs, results, *starts) = function_writer.builder, function.args
    table_views = {i: a.view_at(function_writer, start) for (i, a), start in zip(tables.items(), starts, strict=True)}
    number_positions = {j: i for i, j in enumerate(j for j in range(len(routine.program.inputs[0])) if j not in tables)}

    def read(i: int, j: int) -> Any:
        return (
            table_views[j]
            if j in table_views
            else build.load(build.gep(inputs, [function_writer.int64(number_positions[j])]))
        )

    for i, value in enumerate(function_writer.write_program_with_double_outputs(routine.program, read)[0]):
        build.store(value, build.gep(results, [function_writer.int64(i)]))
    build.ret_void()
    return function


PRODUCT_TILE_WIDTH = 8
"""Number of sums of a matrix product that are accumulated at once, so that none waits for the term of another."""


def _write_matrix_product(writer: Any, block: MatrixProduct, args: Sequence[Table]) -> BlockResults:
    """Call a function that multiplies two matrices, compiled once per shape, and return the product."""
    build, (m, _, n) = writer.builder, block.sizes
    product = Table(writer, writer.double_type, length=m * n)
    signature = repr((block.sizes, block.strides, *(a.signature for a in args)))
    name = "product_" + hashlib.sha256(signature.encode()).hexdigest()[:16]
    function = build.module.globals.get(name) or _write_matrix_product_function(writer, block, args, name)
    build.call(function, [*(a.start for a in args), product.start])
    return BlockResults([], [product], m * n)


def _write_matrix_product_function(
    writer: Any, block: MatrixProduct, tables: Sequence[Table], name: str
) -> ir.Function:
    """Return the LLVM function of a matrix product, which adds its terms in order."""
    m, k, n = block.sizes
    function, function_writer = writer.new_function(
        name, [*(a.start.type for a in tables), writer.double_type.as_pointer()]
    )
    build, int64 = function_writer.builder, function_writer.int64
    *starts, product_pointer = function.args
    factors = [a.view_at(function_writer, start) for a, start in zip(tables, starts, strict=True)]
    sums_run_over_rows = m >= n  # whether the sums of a tile are in one column

    def entry(factor: int, i: ir.Value, j: ir.Value) -> ir.Value:
        row_stride, column_stride = block.strides[factor]
        offset = build.add(build.mul(i, int64(row_stride)), build.mul(j, int64(column_stride)))
        return factors[factor].read(offset)

    def write_sums(start: ir.Value, outer: ir.Value, width: int) -> None:
        entries = [build.add(start, int64(w)) for w in range(width)]
        entries = [(index, outer) if sums_run_over_rows else (outer, index) for index in entries]
        totals = _store_in_new_slots(function_writer, "f" * width, [function_writer.constant(0.0)] * width)
        with function_writer.loop_range(int64(k)) as l:
            shared_factor = entry(1, l, outer) if sums_run_over_rows else entry(0, outer, l)
            for (i, j), total in zip(entries, totals, strict=True):
                own_factor = entry(0, i, l) if sums_run_over_rows else entry(1, l, j)
                build.store(
                    function_writer.call_intrinsic_on_lanes(
                        "llvm.fmuladd", (own_factor, shared_factor, build.load(total)), function_writer.double_type
                    ),
                    total,
                )
        for (i, j), total in zip(entries, totals, strict=True):
            build.store(build.load(total), build.gep(product_pointer, [build.add(build.mul(i, int64(n)), j)]))

    n_tiled, n_outer = (m, n) if sums_run_over_rows else (n, m)
    with function_writer.loop_range(int64(n_outer)) as outer_index:
        if n_tiled >= PRODUCT_TILE_WIDTH:
            with function_writer.loop_range(int64(n_tiled // PRODUCT_TILE_WIDTH)) as chunk:
                write_sums(build.mul(chunk, int64(PRODUCT_TILE_WIDTH)), outer_index, PRODUCT_TILE_WIDTH)
        if n_tiled % PRODUCT_TILE_WIDTH:
            write_sums(int64(n_tiled - n_tiled % PRODUCT_TILE_WIDTH), outer_index, n_tiled % PRODUCT_TILE_WIDTH)
    build.ret_void()
    return function


def _call_kernel(writer: Any, call: LapackCall, args: Sequence[ir.Value]) -> BlockResults:
    """Call a LAPACK kernel for each lane by itself, and return its results."""
    build, n_results = writer.builder, len(call.result_kinds)
    inputs = Table(writer, writer.double_type, [writer.cast(a, "f") for a in args])
    results = Table(writer, writer.double_type, length=n_results)
    pointers = [build.bitcast(table.start, ir.DoubleType().as_pointer()) for table in (inputs, results)]
    function = find_or_write_kernel(writer, call)
    with writer.loop_range(writer.int64(writer.lanes)) as lane:
        build.call(function, [build.gep(pointer, [lane]) for pointer in pointers])
    return BlockResults([], [results], n_results)
