"""Loops and calls as LLVM instructions, for all lanes at once."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from llvmlite import ir

from ...tracing.builder import Block
from ...tracing.calls import Call, Deferred, Product
from ...tracing.program import Routine, Scan, While
from .lapack import kernel

PLACE = ir.IntType(32)


def write_block(writer: Any, block: Block, args: Sequence[Any]) -> Results:
    """Write a block, of values and tables.

    Parameters
    ----------
    writer : Writer
    """
    if isinstance(block, While):
        return _while(writer, block, args)
    if isinstance(block, Scan):
        return _scan(writer, block, args)
    if isinstance(block, Deferred):
        return Results(writer.deferred(args, len(block.kinds)))
    if isinstance(block, Routine):
        return _routine(writer, block, args)
    if isinstance(block, Product):
        return _product(writer, block, args)
    assert isinstance(block, Call)
    return _call(writer, block, args)


def inside(writer: Any, place: ir.Value, length: int) -> ir.Value:
    """A place, or the nearest one of a table of some length."""
    build, last = writer.builder, writer.constant(length - 1)
    place = build.select(build.icmp_signed("<", place, writer.constant(0)), writer.constant(0), place)
    return build.select(build.icmp_signed(">", place, last), last, place)


def picked(writer: Any, place: ir.Value, entries: Sequence[ir.Value]) -> ir.Value:
    """The entry at a place, by the bits of its number: of one that lies outside the nearest."""
    build, place = writer.builder, inside(writer, place, len(entries))
    entries, bit = list(entries), 0
    while len(entries) > 1:
        odd = build.trunc(build.lshr(place, writer.constant(bit)), writer.test)
        pairs = [build.select(odd, b, a) for a, b in zip(entries[::2], entries[1::2], strict=False)]
        entries, bit = pairs + entries[2 * len(pairs) :], bit + 1
    return entries[0]


def _slots(writer: Any, kinds: Sequence[str], values: Sequence[ir.Value]) -> list[ir.Value]:
    """Memory for values of some kinds, that holds them."""
    build, slots = writer.builder, []
    for kind, value in zip(kinds, values, strict=True):
        with build.goto_entry_block():  # else each pass of a loop around would take more of the stack
            slot = build.alloca(writer.kinds[kind])
        build.store(writer.cast(value, kind), slot)
        slots.append(slot)
    return slots


def _reader(*arrays: Sequence[ir.Value]) -> Callable[[int, int], ir.Value]:
    return lambda i, j: arrays[i][j]


def _while(writer: Any, loop: While, args: Sequence[ir.Value]) -> Results:
    """Until the test fails in every lane that is :attr:`.Writer.active`.

    A pass need not wait for the test of which lanes the one before has left: those go on too, and what they
    come to is not kept. They wait where a loop inside might not end for them.
    """
    build, fixed = writer.builder, len(loop.test.inputs[0])
    constants, slots = args[:fixed], _slots(writer, loop.kinds, args[fixed:])
    apart = writer.lanes > 1 and not any(isinstance(i.op, Block) for i in loop.body.instructions)
    kept = _slots(writer, loop.kinds, args[fixed:]) if apart else slots
    outer = writer.active
    (going,) = _slots(writer, "b", [writer.constant(True) if outer is None else outer])

    def goes_on() -> ir.Value:
        carried = [build.load(slot) for slot in slots]
        ((test,),) = writer.values(loop.test, _reader(constants, carried))
        build.store(build.and_(build.load(going), writer.cast(test, "b")), going)
        return writer.any(build.load(going))

    with writer.repeated(goes_on):
        before = [build.load(slot) for slot in slots]
        writer.active = build.load(going)
        (new,) = writer.values(loop.body, _reader(constants, before))
        for slot, out, kind, after in zip(slots, kept, loop.kinds, new, strict=True):
            value = writer.cast(after, kind)
            if writer.lanes > 1:
                build.store(build.select(writer.active, value, build.load(out)), out)
            if apart or writer.lanes == 1:
                build.store(value, slot)
        writer.active = outer
    return Results([build.load(slot) for slot in kept])


def _scan(writer: Any, loop: Scan, args: Sequence[Any]) -> Results:
    build, fixed = writer.builder, len(loop.body.inputs[0])
    start = fixed + len(loop.carried)
    constants, slots, tables = args[:fixed], _slots(writer, loop.carried, args[fixed:start]), args[start:]
    stacked = [Table(writer, writer.kinds[kind], length=loop.length) for kind in loop.stacked]
    with writer.counted(writer.whole_number(loop.length)) as count:
        i = build.sub(writer.whole_number(loop.length - 1), count) if loop.reverse else count
        carried, row = [build.load(slot) for slot in slots], [table.read(i) for table in tables]
        new, out = writer.values(loop.body, _reader(constants, carried, row))
        for slot, kind, value in zip(slots, loop.carried, new, strict=True):
            build.store(writer.cast(value, kind), slot)
        for table, kind, value in zip(stacked, loop.stacked, out, strict=True):
            table.write(i, writer.cast(value, kind))
    return Results([build.load(slot) for slot in slots], stacked, loop.length)


class Table:
    """Values of one kind in memory, by their numbers.

    Parameters
    ----------
    kind : ir.Type
        A number, where lanes have several, is the same for all.
    values : sequence of values, optional
        What it holds; written there, or a constant.
    length, start, step : int, value, int
        How many there are, without values; where the first lies, and how far apart they are, if they lie somewhere.
    """

    def __init__(
        self,
        writer: Any,
        kind: ir.Type,
        values: Sequence[ir.Value] = (),
        length: int = 0,
        start: ir.Value | None = None,
        step: int = 1,
    ):
        self.build, self.kind, self.writer, self.step = writer.builder, kind, writer, step
        self.length = max(len(values), length)
        self.widened = writer.kinds["i"] if kind == writer.kinds["b"] else None  # bits are awkward in memory
        if start is not None:
            self.start = start
            return
        if values and not self.widened and all(isinstance(value, ir.Constant) for value in values):
            rows, module = ir.ArrayType(self.kind, len(values)), self.build.module
            fixed = ir.GlobalVariable(module, rows, module.get_unique_name("table"))
            fixed.initializer, fixed.global_constant, fixed.linkage = ir.Constant(rows, list(values)), True, "internal"
            self.start = self.build.bitcast(fixed, self.kind.as_pointer())
            return
        with self.build.goto_entry_block():
            self.start = self.build.alloca(self.widened or self.kind, self.length)
        for i, value in enumerate(values):
            self.write(writer.whole_number(i), value)

    def elsewhere(self, writer: Any, start: ir.Value) -> Table:
        """The same in another function, at an address of its own."""
        return Table(writer, self.kind, length=self.length, start=start, step=self.step)

    @property
    def form(self) -> tuple:
        """What a function that is given it has to know."""
        return str(self.start.type), self.length, self.step

    def _place(self, i: ir.Value) -> ir.Value:
        if self.step != 1:
            i = self.build.mul(i, self.writer.whole_number(self.step))
        return self.build.gep(self.start, [i])

    def read(self, i: ir.Value) -> ir.Value:
        found = self.build.load(self._place(i))
        if isinstance(self.kind, ir.DoubleType):
            return self.writer.splat(found)
        return self.build.trunc(found, self.kind) if self.widened else found

    def of_each_lane(self, places: ir.Value) -> ir.Value:
        """What each lane has at a place of its own, or at the nearest."""
        build, lanes, places = self.build, self.writer.lanes, inside(self.writer, places, self.length)
        if lanes == 1:
            return self.read(places)
        found: Any = None
        for lane in range(lanes):
            at = ir.Constant(PLACE, lane)
            value = build.load(self._place(build.extract_element(places, at)))
            if isinstance(value.type, ir.VectorType):
                value = build.extract_element(value, at)
            kind = ir.VectorType(value.type, lanes)
            found = build.insert_element(ir.Constant(kind, ir.Undefined) if found is None else found, value, at)
        return build.trunc(found, self.kind) if self.widened else found

    def write(self, i: ir.Value, value: ir.Value) -> None:
        value = self.build.zext(value, self.widened) if self.widened else value
        self.build.store(value, self._place(i))


class Results:
    """The results of a block: values, then tables of one length. What is in those is read where it is used."""

    def __init__(self, values: Sequence[ir.Value], tables: Sequence[Table] = (), length: int = 1):
        self.values, self.tables, self.length = values, tables, length

    def item(self, i: int) -> ir.Value:
        if i < len(self.values):
            return self.values[i]
        table, row = divmod(i - len(self.values), self.length)
        return self.tables[table].read(ir.Constant(ir.IntType(64), row))

    def column(self, start: int) -> Table:
        return self.tables[(start - len(self.values)) // self.length]


def table(writer: Any, values: Sequence[ir.Value]) -> Table:
    """Values as a table; they are numbers where one of them is."""
    kind = writer.number if any(value.type == writer.number for value in values) else values[0].type
    return Table(writer, kind, [writer.cast(v, "f") if kind == writer.number else v for v in values])


def _routine(writer: Any, routine: Routine, args: Sequence[Any]) -> Results:
    """By a function of its own, which all that need it call: numbers are handed over in memory, tables stay there."""
    build, count = writer.builder, len(routine.kinds)
    tables = {i: a for i, a in enumerate(args) if isinstance(a, Table)}
    numbers = [writer.cast(a, "f") for i, a in enumerate(args) if i not in tables]
    given, found = Table(writer, writer.number, numbers, length=1), Table(writer, writer.number, length=count)
    said = repr((routine, *((i, a.form) for i, a in tables.items())))
    name = "routine_" + hashlib.sha256(said.encode()).hexdigest()[:16]
    function = build.module.globals.get(name) or _written(writer, routine, name, tables)
    build.call(function, [given.start, found.start, *(a.start for a in tables.values())])
    return Results([], [found], count)


def _written(writer: Any, routine: Routine, name: str, tables: Mapping[int, Table]) -> ir.Function:
    kinds = [writer.number.as_pointer()] * 2 + [a.start.type for a in tables.values()]
    function, inside = writer.function(name, kinds)
    build, (given, found, *starts) = inside.builder, function.args
    own = {i: a.elsewhere(inside, start) for (i, a), start in zip(tables.items(), starts, strict=True)}
    order = {j: i for i, j in enumerate(j for j in range(len(routine.program.inputs[0])) if j not in tables)}

    def read(i: int, j: int) -> Any:
        return own[j] if j in own else build.load(build.gep(given, [inside.whole_number(order[j])]))

    for i, value in enumerate(inside.write(routine.program, read)[0]):
        build.store(value, build.gep(found, [inside.whole_number(i)]))
    build.ret_void()
    return function


BESIDE = 8
"""Sums of a product of matrices that are made at a time: each waits for its own last term alone."""


def _product(writer: Any, block: Product, args: Sequence[Table]) -> Results:
    """By a function of its own for these sizes; its sums are in the order of their terms."""
    build, (m, _, n) = writer.builder, block.sizes
    found = Table(writer, writer.number, length=m * n)
    said = repr((block.sizes, block.steps, *(a.form for a in args)))
    name = "product_" + hashlib.sha256(said.encode()).hexdigest()[:16]
    function = build.module.globals.get(name) or _product_function(writer, block, args, name)
    build.call(function, [*(a.start for a in args), found.start])
    return Results([], [found], m * n)


def _product_function(writer: Any, block: Product, tables: Sequence[Table], name: str) -> ir.Function:
    m, k, n = block.sizes
    function, inside = writer.function(name, [*(a.start.type for a in tables), writer.number.as_pointer()])
    build, number = inside.builder, inside.whole_number
    *starts, out = function.args
    given = [a.elsewhere(inside, start) for a, start in zip(tables, starts, strict=True)]
    by_rows = m >= n  # which sums stand beside each other

    def entry(which: int, i: ir.Value, j: ir.Value) -> ir.Value:
        rows, columns = block.steps[which]
        place = build.add(build.mul(i, number(rows)), build.mul(j, number(columns)))
        return given[which].read(place)

    def sums(first: ir.Value, other: ir.Value, width: int) -> None:
        places = [build.add(first, number(w)) for w in range(width)]
        places = [(place, other) if by_rows else (other, place) for place in places]
        totals = _slots(inside, "f" * width, [inside.constant(0.0)] * width)
        with inside.counted(number(k)) as l:
            common = entry(1, l, other) if by_rows else entry(0, other, l)
            for (i, j), total in zip(places, totals, strict=True):
                own = entry(0, i, l) if by_rows else entry(1, l, j)
                build.store(inside.intrinsic("llvm.fmuladd", (own, common, build.load(total)), inside.number), total)
        for (i, j), total in zip(places, totals, strict=True):
            build.store(build.load(total), build.gep(out, [build.add(build.mul(i, number(n)), j)]))

    count, others = (m, n) if by_rows else (n, m)
    with inside.counted(number(others)) as other:
        if count >= BESIDE:
            with inside.counted(number(count // BESIDE)) as chunk:
                sums(build.mul(chunk, number(BESIDE)), other, BESIDE)
        if count % BESIDE:
            sums(number(count - count % BESIDE), other, count % BESIDE)
    build.ret_void()
    return function


def _call(writer: Any, call: Call, args: Sequence[ir.Value]) -> Results:
    """By a function of its own, lane by lane: what it makes of one does not depend on the others."""
    build, count = writer.builder, len(call.kinds)
    given = Table(writer, writer.number, [writer.cast(a, "f") for a in args])
    found = Table(writer, writer.number, length=count)
    pointers = [build.bitcast(table.start, ir.DoubleType().as_pointer()) for table in (given, found)]
    function = kernel(writer, call)
    with writer.counted(writer.whole_number(writer.lanes)) as lane:
        build.call(function, [build.gep(pointer, [lane]) for pointer in pointers])
    return Results([], [found], count)
