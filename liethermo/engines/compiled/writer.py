"""Scalar programs as LLVM instructions."""

from __future__ import annotations

import contextlib
from collections import ChainMap, Counter
from collections.abc import Callable, Iterator, Sequence
from typing import Any, TypeAlias

import numpy as np
from llvmlite import ir

from ...tracing.branches import Branch, branched
from ...tracing.builder import Block, Instruction, Scalar
from ...tracing.program import Program
from ...tracing.scalarize import UnsupportedPrimitive
from .blocks import Results, Table, picked, table, write_block
from .exponential import exponential
from .lapack import SPECIAL, declared

NUMBER, TEST, WHOLE = ir.DoubleType(), ir.IntType(1), ir.IntType(64)

INTRINSICS = {name: name for name in "sqrt exp2 log sin cos floor ceil rint trunc pow".split()} | {"abs": "fabs"}
"""Operations that LLVM has functions for."""

LIBRARY = frozenset("cbrt expm1 log1p tan asin acos atan atan2 sinh cosh tanh asinh acosh atanh erf erfc".split())
"""Operations that are functions of the C library, by the same names."""

COMPARED = {"eq": "==", "lt": "<", "le": "<=", "gt": ">", "ge": ">="}
ARITHMETIC = {"add": ("fadd", "add"), "sub": ("fsub", "sub"), "mul": ("fmul", "mul"), "neg": ("fneg", "neg")}
ARITHMETIC |= {"div": ("fdiv", ""), "rem": ("frem", "")}
LOGICAL = {"and": "and_", "or": "or_", "xor": "xor", "not": "not_"}


Read: TypeAlias = Callable[[int, int], ir.Value]
Memory: TypeAlias = Callable[[int, range], Table | None]


class Writer:
    """Writes programs where a builder stands, on numbers, or on vectors with a number for each lane.

    Truth values are bits, integers have 64. Sums are never reassociated. A product that is only added to something is
    fused with the sum, and rounded once, on processors that can. The choice of these products does not depend on the
    number of lanes. Instructions for one side of a branch are skipped where no lane takes that side. Each lane chooses
    for itself, so that its numbers do not depend on the others.

    Attributes
    ----------
    active : value or None
        The lanes that what is being written is for; None where it is for all.
    """

    def __init__(self, builder: ir.IRBuilder, lanes: int):
        self.builder, self.lanes = builder, lanes
        self.number, self.test, self.whole = (
            kind if lanes == 1 else ir.VectorType(kind, lanes) for kind in (NUMBER, TEST, WHOLE)
        )
        self.kinds = {"f": self.number, "b": self.test, "i": self.whole}
        self.active: ir.Value | None = None

    def function(self, name: str, kinds: Sequence[ir.Type]) -> tuple[ir.Function, Writer]:
        """A function of the module that returns nothing, and what writes it, for as many lanes."""
        function = ir.Function(self.builder.module, ir.FunctionType(ir.VoidType(), list(kinds)), name)
        function.linkage = "internal"
        function.attributes.add("noinline")
        return function, Writer(ir.IRBuilder(function.append_basic_block("entry")), self.lanes)

    def write(self, program: Program, read: Read, memory: Memory | None = None) -> list[list[ir.Value]]:
        """The values of the outputs, array by array.

        Parameters
        ----------
        read : function from the places of an array among the inputs, and of an entry in it, to its value
            Asked for what the program uses.
        memory : function from the place of an array among the inputs, and those of entries in it, to a table, optional
            None where they do not lie in memory at equal distances.
        """
        return [[self._as_number(value) for value in entries] for entries in self.values(program, read, memory)]

    def values(self, program: Program, read: Read, memory: Memory | None = None) -> list[list[ir.Value]]:
        """The same, integers and truth values as they are."""
        written = _Written(self, program, read, memory)
        written.all(branched(program))
        return [[written.value(a) for a in entries] for entries in program.outputs]

    def cast(self, value: ir.Value, kind: str) -> ir.Value:
        """A value as one of a kind, a key of ``kinds``."""
        if value.type == self.kinds[kind]:
            return value
        if kind == "f":
            return self._as_number(value)
        if kind == "i" and value.type == self.test:
            return self.builder.zext(value, self.whole)
        raise UnsupportedPrimitive("convert_element_type", "of unknown origin", f"from {value.type}")

    def constant(self, number: bool | int | float) -> ir.Value:
        kind = {bool: self.test, int: self.whole}.get(type(number), self.number)
        plain = int(number) if isinstance(number, bool) else number
        return ir.Constant(kind, plain if self.lanes == 1 else [plain] * self.lanes)

    def operation(self, op: str, args: Sequence[ir.Value]) -> ir.Value:
        """The result of one operation, a key of :data:`liethermo.tracing.builder.OPERATIONS`."""
        build, (x, *rest) = self.builder, args
        real = x.type == self.number
        if op in ARITHMETIC:
            name = ARITHMETIC[op][0 if real else 1]
            return getattr(build, name)(*args)
        if op in LOGICAL and not real:
            return getattr(build, LOGICAL[op])(*args)
        if op in COMPARED:
            of_whole = build.icmp_unsigned if x.type == self.test else build.icmp_signed  # true, one bit, is no -1
            return (build.fcmp_ordered if real else of_whole)(COMPARED[op], *args)
        if op == "ne":
            return build.fcmp_unordered("!=", *args) if real else build.icmp_signed("!=", *args)
        if op == "select":
            return build.select(x, *rest)
        if op in ("max", "min"):  # like XLA's, NaN if either is
            better = self.operation("gt" if op == "max" else "lt", args)
            if real:
                better = build.or_(better, build.fcmp_unordered("uno", x, x))
            return build.select(better, x, rest[0])
        if op == "branch":
            return x
        if op == "pick":
            return picked(self, x, rest)
        if op == "quotient":
            return self._quotient(x, *rest)
        if real and op == "single":
            short = ir.FloatType() if self.lanes == 1 else ir.VectorType(ir.FloatType(), self.lanes)
            return build.fpext(build.fptrunc(x, short), self.number)
        if real and op in SPECIAL:
            return self._special(op, args)
        if op == "float":
            return self._as_number(x)
        if op == "int":
            return build.zext(x, self.whole) if x.type == self.test else x
        if real and op == "exp":
            return exponential(self, x)
        if real and op in INTRINSICS:
            return self.intrinsic(f"llvm.{INTRINSICS[op]}", args, self.number)
        if real and op in LIBRARY:
            return self.of_each_lane(op, args)
        if real and op == "truncate":  # NaN to 0, and what is too large to the nearest integer
            return self.intrinsic("llvm.fptosi.sat", args, self.whole)
        if real and op == "is_finite":
            return build.fcmp_ordered("<", self.operation("abs", args), self.constant(np.inf))
        if real and op == "sign":  # NaN of NaN, a zero of a zero
            signed = self.intrinsic("llvm.copysign", [self.constant(1.0), x], self.number)
            return build.select(build.fcmp_ordered("one", x, self.constant(0.0)), signed, x)
        if op in ("abs", "sign") and x.type == self.whole:
            negative = build.icmp_signed("<", x, self.constant(0))
            if op == "abs":
                return build.select(negative, build.neg(x), x)
            positive = build.zext(build.icmp_signed(">", x, self.constant(0)), self.whole)
            return build.select(negative, self.constant(-1), positive)
        raise UnsupportedPrimitive(op, "of unknown origin", f"on {x.type}")

    def _quotient(self, x: ir.Value, n: ir.Value) -> ir.Value:
        """The quotient of integers, towards zero; by zero -1, and by -1 without a trap."""
        build, one = self.builder, self.constant(1)
        zero, minus = (build.icmp_signed("==", n, self.constant(c)) for c in (0, -1))
        found = build.sdiv(x, build.select(build.or_(zero, minus), one, n))
        return build.select(zero, self.constant(-1), build.select(minus, build.neg(x), found))

    def deferred(self, args: Sequence[ir.Value], results: int) -> list[ir.Value]:
        """What takes the place of the first arguments: see :class:`...tracing.calls.Deferred`."""
        raise NotImplementedError(f"nothing fills in {results} of {len(args)} values here")

    def wrapped(self, x: ir.Value, bits: int, signed: bool) -> ir.Value:
        """An integer as so many bits hold it."""
        short = ir.IntType(bits) if self.lanes == 1 else ir.VectorType(ir.IntType(bits), self.lanes)
        widen = self.builder.sext if signed else self.builder.zext
        return widen(self.builder.trunc(x, short), self.whole)

    def _special(self, op: str, args: Sequence[ir.Value]) -> ir.Value:
        """SciPy's, one lane after another; its last argument is none of the mathematics."""
        skip = ir.Constant(ir.IntType(32), 0)
        kinds = [NUMBER] * SPECIAL[op][1] + [skip.type]
        function = declared(self.builder.module, op, NUMBER, kinds)
        return self._by_lanes(lambda own: self.builder.call(function, [*own, skip]), args)

    def fused(self, op: str, place: int, factors: Sequence[ir.Value], terms: Sequence[ir.Value]) -> ir.Value:
        """A sum or difference whose term at a place is a product."""
        (x, y), other = factors, terms[1 - place]
        if op == "sub":
            x, other = (x, self.builder.fneg(other)) if place == 0 else (self.builder.fneg(x), other)
        return self.intrinsic("llvm.fmuladd", (x, y, other), self.number)

    def larger(self, x: ir.Value, y: ir.Value) -> ir.Value:
        """The larger of two numbers without a sign, NaN if either is: their bits are in the order of the numbers."""
        build, count = self.builder, max(self.lanes, 2)
        number, whole = ir.VectorType(NUMBER, count), ir.VectorType(WHOLE, count)
        first = ir.Constant(ir.IntType(32), 0)
        if self.lanes == 1:
            x, y = (build.insert_element(ir.Constant(number, ir.Undefined), v, first) for v in (x, y))
        bits = [build.bitcast(v, whole) for v in (x, y)]
        found = build.bitcast(build.call(self._declared(f"llvm.smax.v{count}i64", whole, bits), bits), number)
        return build.extract_element(found, first) if self.lanes == 1 else found

    def splat(self, number: ir.Value) -> ir.Value:
        """A number in every lane."""
        if self.lanes == 1:
            return number
        build, zero = self.builder, ir.Constant(ir.IntType(32), 0)
        one = build.insert_element(ir.Constant(self.number, ir.Undefined), number, zero)
        order = ir.Constant(ir.VectorType(ir.IntType(32), self.lanes), [0] * self.lanes)
        return build.shuffle_vector(one, ir.Constant(self.number, ir.Undefined), order)

    def any(self, tests: ir.Value) -> ir.Value:
        """Whether a truth value holds in any lane, as one bit."""
        if self.lanes == 1:
            return tests
        bits = ir.IntType(self.lanes)
        return self.builder.icmp_unsigned("!=", self.builder.bitcast(tests, bits), ir.Constant(bits, 0))

    @staticmethod
    def whole_number(n: int) -> ir.Constant:
        return ir.Constant(WHOLE, n)

    @contextlib.contextmanager
    def repeated(self, goes_on: Callable[[], ir.Value]) -> Iterator[None]:
        """While a test holds."""
        build = self.builder
        head, body, after = (build.append_basic_block(name) for name in ("head", "body", "after"))
        build.branch(head)
        build.position_at_end(head)
        build.cbranch(goes_on(), body, after)
        build.position_at_end(body)
        yield
        build.branch(head)
        build.position_at_end(after)

    @contextlib.contextmanager
    def counted(self, count: ir.Value) -> Iterator[ir.Value]:
        """For each number from zero to before ``count``."""
        build = self.builder
        with build.goto_entry_block():  # else each pass would take more of the stack
            counter = build.alloca(WHOLE)
        build.store(self.whole_number(0), counter)
        with self.repeated(lambda: build.icmp_signed("<", build.load(counter), count)):
            yield build.load(counter)
            build.store(build.add(build.load(counter), self.whole_number(1)), counter)

    def alike(self, op: str | Block, values: list[ir.Value], args: Sequence[Scalar]) -> list[ir.Value]:
        """Constants as numbers of the type of what stands beside them."""
        chosen = slice(1, None) if op in ("select", "pick") else slice(None)
        types = [v.type for v, a in zip(values[chosen], args[chosen], strict=True) if isinstance(a, str)]
        for i in range(len(values))[chosen]:
            if not isinstance(args[i], str) and types and values[i].type != types[0] and types[0] == self.number:
                values[i] = self.constant(float(args[i]))
        return values

    def _as_number(self, value: ir.Value) -> ir.Value:
        if value.type == self.number:
            return value
        convert = self.builder.uitofp if value.type == self.test else self.builder.sitofp
        return convert(value, self.number)

    def intrinsic(self, name: str, args: Sequence[ir.Value], result: ir.Type) -> ir.Value:
        suffix = "" if self.lanes == 1 else f"v{self.lanes}"
        kinds = [f"{suffix}i64"] if result == self.whole else []
        name = ".".join([name, *kinds, f"{suffix}f64"])
        return self.builder.call(self._declared(name, result, args), args)

    def of_each_lane(self, name: str, args: Sequence[ir.Value]) -> ir.Value:
        return self._by_lanes(lambda own: self.builder.call(self._declared(name, NUMBER, own), own), args)

    def _by_lanes(self, call: Callable[[Sequence[ir.Value]], ir.Value], args: Sequence[ir.Value]) -> ir.Value:
        """What a call for one number makes of each lane."""
        if self.lanes == 1:
            return call(args)
        result = ir.Constant(self.number, ir.Undefined)
        for lane in range(self.lanes):
            place = ir.Constant(ir.IntType(32), lane)
            found = call([self.builder.extract_element(a, place) for a in args])
            result = self.builder.insert_element(result, found, place)
        return result

    def _declared(self, name: str, result: ir.Type, args: Sequence[ir.Value]) -> ir.Function:
        module = self.builder.module
        if name in module.globals:
            return module.globals[name]
        function = ir.Function(module, ir.FunctionType(result, [a.type for a in args]), name)
        if not name.startswith("llvm."):
            for attribute in ("nounwind", "readnone"):
                function.attributes.add(attribute)
        return function


class _Written:
    """The variables of a program so far, as it is written: those of one side of a branch are known there alone."""

    def __init__(self, writer: Writer, program: Program, read: Read, memory: Memory | None):
        self.writer, self.read, self.memory = writer, read, memory
        self.places = {name: (i, j) for i, names in enumerate(program.inputs) for j, name in enumerate(names)}
        self.uses = Counter(a for _, _, args in program.instructions for a in args)
        self.uses.update(a for entries in program.outputs for a in entries)
        self.values: ChainMap[str, ir.Value] = ChainMap()
        self.products: dict[Scalar, list[ir.Value]] = {}  # that nothing else needs
        self.sizes: set[Scalar] = set()  # numbers without a sign
        self.blocks: dict[Scalar, Results] = {}
        self.tables: dict[Scalar, Table] = {}

    def value(self, a: Scalar) -> ir.Value:
        if not isinstance(a, str):
            return self.writer.constant(a)
        if a not in self.values:
            self.values[a] = self.read(*self.places[a])
        return self.values[a]

    def operand(self, a: Scalar) -> Any:
        """A value, or a table."""
        return self.tables.get(a) or self.value(a)

    def all(self, items: Sequence[Instruction | Branch]) -> None:
        for item in items:
            if isinstance(item, Branch):
                self.branch(item)
            else:
                self.instruction(item)

    def instruction(self, instruction: Instruction) -> None:
        writer, (target, op, args) = self.writer, instruction
        if isinstance(op, Block):
            self.blocks[target] = write_block(writer, op, [self.operand(a) for a in args])
            return
        if op == "item":
            self.values[target] = self.blocks[args[0]].item(int(args[1]))
            return
        if op in ("table", "column"):
            whole = op == "table"
            made = self.given(args) or table(writer, [self.value(a) for a in args]) if whole else None
            self.tables[target] = made or self.blocks[args[0]].column(int(args[1]))
            return
        if op == "lookup":
            self.values[target] = self.operand(args[1]).of_each_lane(self.value(args[0]))
            return
        if op == "wrap":
            self.values[target] = writer.wrapped(self.value(args[0]), int(args[1]), bool(args[2]))
            return
        given = writer.alike(op, [self.value(a) for a in args], args)
        unsigned = op == "max" and self.sizes.issuperset(args)
        fused = [i for i, a in enumerate(args) if a in self.products] if op in ("add", "sub") else []
        if fused:
            found = writer.fused(op, fused[-1], self.products[args[fused[-1]]], given)
        elif unsigned:
            found = writer.larger(*given)
        else:
            found = writer.operation(op, given)
        self.values[target] = found
        if op == "mul" and self.uses[target] == 1 and found.type == writer.number:
            self.products[target] = given
        if op == "abs" or unsigned:
            self.sizes.add(target)

    def given(self, names: Sequence[Scalar]) -> Table | None:
        """A table of inputs that lie in memory at equal distances: nothing is copied."""
        found = [self.places[a] for a in names if a in self.places]
        if self.memory is None or len(found) < max(len(names), 2):
            return None
        arrays, (first, second, *rest) = {i for i, _ in found}, [j for _, j in found]
        last = rest[-1] if rest else second
        places = range(first, last + 1, second - first) if second > first else range(0)
        return self.memory(found[0][0], places) if len(arrays) == 1 and [*places] == [first, second, *rest] else None

    def branch(self, branch: Branch) -> None:
        """Each side where any lane takes it, then what each lane chooses."""
        writer, build = self.writer, self.writer.builder
        self.instruction(branch.test)
        test = self.values[branch.test.target]
        for place, (side, taken) in enumerate(zip(branch.sides, (test, build.not_(test)), strict=True), start=1):
            if not side:
                continue
            before, outside = build.block, self.values
            inside, active = outside.new_child(), writer.active
            self.values, writer.active = inside, taken if active is None else build.and_(active, taken)
            with build.if_then(writer.any(writer.active)):
                self.all(side)
                after = build.block
            self.values, writer.active = outside, active
            for a in dict.fromkeys(choice.args[place] for choice in branch.choices):
                if isinstance(a, str) and a in inside.maps[0] and a not in self.places:
                    outside[a] = build.phi(inside[a].type)
                    outside[a].add_incoming(inside[a], after)
                    outside[a].add_incoming(ir.Constant(inside[a].type, None), before)  # which no lane chooses
        self.all(branch.choices)
