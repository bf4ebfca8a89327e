"""Scalar programs as LLVM instructions, with the exponential function for all lanes at once."""

from __future__ import annotations

import contextlib
import math
from collections import ChainMap, Counter
from collections.abc import Callable, Iterator, Sequence
from typing import Any, TypeAlias

import numpy as np
from llvmlite import ir

from ...tracing.branches import Branch, sink_instructions_into_branches
from ...tracing.builder import Block, Instruction, Scalar
from ...tracing.program import Program
from ...tracing.scalarize import UnsupportedPrimitive
from .lapack import SPECIAL_FUNCTIONS, declare_external_function
from .loops_and_calls import BlockResults, Table, make_table, select_entry, write_block

FLOAT64 = ir.DoubleType()
BOOL = ir.IntType(1)
INT64 = ir.IntType(64)

LLVM_INTRINSICS = {name: name for name in "sqrt exp2 log sin cos floor ceil rint trunc pow".split()} | {"abs": "fabs"}
"""Operations that are LLVM intrinsics, with their LLVM names."""

C_LIBRARY_FUNCTIONS = frozenset(
    "cbrt expm1 log1p tan asin acos atan atan2 sinh cosh tanh asinh acosh atanh erf erfc".split()
)
"""Operations that are functions of the C library, with the same names."""

COMPARISONS = {"eq": "==", "lt": "<", "le": "<=", "gt": ">", "ge": ">="}
"""Comparisons, with their LLVM predicates."""

ARITHMETIC = {"add": ("fadd", "add"), "sub": ("fsub", "sub"), "mul": ("fmul", "mul"), "neg": ("fneg", "neg")}
ARITHMETIC |= {"div": ("fdiv", ""), "rem": ("frem", "")}
"""Arithmetic operations, with the builder's methods for doubles and for integers."""

LOGICAL = {"and": "and_", "or": "or_", "xor": "xor", "not": "not_"}
"""Operations on truth values and integers, with the builder's method for each."""


InputReader: TypeAlias = Callable[[int, int], ir.Value]
TableFinder: TypeAlias = Callable[[int, range], Table | None]


class ProgramWriter:
    """Writer of scalar programs as LLVM instructions, on numbers or on vectors with a number for each lane.

    Truth values are bits, integers have 64. Sums are never reassociated. A product whose only use is a sum is fused
    with it, and rounded once, on processors that can. The choice of these products does not depend on the number of
    lanes. Instructions for one side of a branch are skipped if no lane takes that side. Each lane chooses for itself,
    so its numbers do not depend on the others.

    Attributes
    ----------
    active_lanes : value or None
        Lanes for which instructions are being written; None for all.
    """

    def __init__(self, builder: ir.IRBuilder, lanes: int):
        self.builder, self.lanes = builder, lanes
        self.double_type, self.bool_type, self.int_type = (
            value_type if lanes == 1 else ir.VectorType(value_type, lanes) for value_type in (FLOAT64, BOOL, INT64)
        )
        self.type_of_kind = {"f": self.double_type, "b": self.bool_type, "i": self.int_type}
        self.active_lanes: ir.Value | None = None

    def new_function(self, name: str, argument_types: Sequence[ir.Type]) -> tuple[ir.Function, ProgramWriter]:
        """Return a new LLVM function without a result, and a writer of its body."""
        function = ir.Function(self.builder.module, ir.FunctionType(ir.VoidType(), list(argument_types)), name)
        function.linkage = "internal"
        function.attributes.add("noinline")
        return function, ProgramWriter(ir.IRBuilder(function.append_basic_block("entry")), self.lanes)

    def write_program_with_double_outputs(
        self, program: Program, read_input: InputReader, find_table: TableFinder | None = None
    ) -> list[list[ir.Value]]:
        """Write a program and return its outputs as doubles, a list for each output array.

        Parameters
        ----------
        read_input : function of (array, entry), the indices of an input array and of an entry in it, to a value
            Called for the inputs that the program uses.
        find_table : function of (array, entries), the index of an input array and a range of entries, to a table,
        optional
            Returns None if these entries are not equidistant in memory.
        """
        return [
            [self._to_double(value) for value in entries]
            for entries in self.write_program(program, read_input, find_table)
        ]

    def write_program(
        self, program: Program, read_input: InputReader, find_table: TableFinder | None = None
    ) -> list[list[ir.Value]]:
        """Write a program and return its outputs of their own types, a list for each output array."""
        emitter = _ProgramEmitter(self, program, read_input, find_table)
        emitter.write_instructions_and_branches(sink_instructions_into_branches(program))
        return [[emitter.value_of_operand(a) for a in entries] for entries in program.outputs]

    def cast(self, value: ir.Value, kind: str) -> ir.Value:
        """Return a value converted to the type of a kind: "f" double, "b" truth value, "i" integer."""
        if value.type == self.type_of_kind[kind]:
            return value
        if kind == "f":
            return self._to_double(value)
        if kind == "i" and value.type == self.bool_type:
            return self.builder.zext(value, self.int_type)
        raise UnsupportedPrimitive("convert_element_type", "of unknown origin", f"from {value.type}")

    def constant(self, number: bool | int | float) -> ir.Value:
        """Return a number as an LLVM constant, the same in every lane."""
        value_type = {bool: self.bool_type, int: self.int_type}.get(type(number), self.double_type)
        value = int(number) if isinstance(number, bool) else number
        return ir.Constant(value_type, value if self.lanes == 1 else [value] * self.lanes)

    def write_operation(self, op: str, args: Sequence[ir.Value]) -> ir.Value:
        """Write one operation, named as in :data:`liethermo.tracing.builder.SYMPY_OPERATIONS`; return its result."""
        build, (x, *rest) = self.builder, args
        is_real = x.type == self.double_type
        if op in ARITHMETIC:
            name = ARITHMETIC[op][0 if is_real else 1]
            return getattr(build, name)(*args)
        if op in LOGICAL and not is_real:
            return getattr(build, LOGICAL[op])(*args)
        if op in COMPARISONS:
            # as a signed bit, true would be -1
            compare_integers = build.icmp_unsigned if x.type == self.bool_type else build.icmp_signed
            return (build.fcmp_ordered if is_real else compare_integers)(COMPARISONS[op], *args)
        if op == "ne":
            return build.fcmp_unordered("!=", *args) if is_real else build.icmp_signed("!=", *args)
        if op == "select":
            return build.select(x, *rest)
        if op in ("max", "min"):  # NaN if either is NaN, as in XLA
            takes_x = self.write_operation("gt" if op == "max" else "lt", args)
            if is_real:
                takes_x = build.or_(takes_x, build.fcmp_unordered("uno", x, x))
            return build.select(takes_x, x, rest[0])
        if op == "branch":
            return x
        if op == "pick":
            return select_entry(self, x, rest)
        if op == "quotient":
            return self._truncated_quotient(x, *rest)
        if is_real and op == "single":
            float32_type = ir.FloatType() if self.lanes == 1 else ir.VectorType(ir.FloatType(), self.lanes)
            return build.fpext(build.fptrunc(x, float32_type), self.double_type)
        if is_real and op in SPECIAL_FUNCTIONS:
            return self._call_special_function(op, args)
        if op == "float":
            return self._to_double(x)
        if op == "int":
            return build.zext(x, self.int_type) if x.type == self.bool_type else x
        if is_real and op == "exp":
            return write_exponential(self, x)
        if is_real and op in LLVM_INTRINSICS:
            return self.call_intrinsic_on_lanes(f"llvm.{LLVM_INTRINSICS[op]}", args, self.double_type)
        if is_real and op in C_LIBRARY_FUNCTIONS:
            return self.call_per_lane(op, args)
        if is_real and op == "truncate":  # NaN becomes 0, and too large numbers the nearest integer
            return self.call_intrinsic_on_lanes("llvm.fptosi.sat", args, self.int_type)
        if is_real and op == "is_finite":
            return build.fcmp_ordered("<", self.write_operation("abs", args), self.constant(np.inf))
        if is_real and op == "sign":  # NaN for NaN, a signed zero for a zero
            signed_one = self.call_intrinsic_on_lanes("llvm.copysign", [self.constant(1.0), x], self.double_type)
            return build.select(build.fcmp_ordered("one", x, self.constant(0.0)), signed_one, x)
        if op in ("abs", "sign") and x.type == self.int_type:
            is_negative = build.icmp_signed("<", x, self.constant(0))
            if op == "abs":
                return build.select(is_negative, build.neg(x), x)
            is_positive = build.zext(build.icmp_signed(">", x, self.constant(0)), self.int_type)
            return build.select(is_negative, self.constant(-1), is_positive)
        raise UnsupportedPrimitive(op, "of unknown origin", f"on {x.type}")

    def _truncated_quotient(self, x: ir.Value, n: ir.Value) -> ir.Value:
        """Return the quotient of integers, rounded towards zero; -1 for the divisor 0."""
        build, one = self.builder, self.constant(1)
        is_zero, is_minus_one = (build.icmp_signed("==", n, self.constant(c)) for c in (0, -1))
        quotient = build.sdiv(x, build.select(build.or_(is_zero, is_minus_one), one, n))
        return build.select(is_zero, self.constant(-1), build.select(is_minus_one, build.neg(x), quotient))

    def call_newton(self, args: Sequence[ir.Value], n_results: int) -> list[ir.Value]:
        """Write the deferred Newton iteration and return its results: see :class:`...tracing.calls.DeferredBlock`."""
        raise NotImplementedError(f"nothing fills in {n_results} of {len(args)} values here")

    def wrap_integer(self, x: ir.Value, bits: int, is_signed: bool) -> ir.Value:
        """Return an integer wrapped around to ``bits`` bits, as narrow integers of JAX wrap."""
        narrow_type = ir.IntType(bits) if self.lanes == 1 else ir.VectorType(ir.IntType(bits), self.lanes)
        widen = self.builder.sext if is_signed else self.builder.zext
        return widen(self.builder.trunc(x, narrow_type), self.int_type)

    def _call_special_function(self, op: str, args: Sequence[ir.Value]) -> ir.Value:
        """Return the result of a special function of SciPy in each lane."""
        dispatch_flag = ir.Constant(ir.IntType(32), 0)
        argument_types = [FLOAT64] * SPECIAL_FUNCTIONS[op][1] + [dispatch_flag.type]
        function = declare_external_function(self.builder.module, op, FLOAT64, argument_types)
        return self._apply_per_lane(lambda lane_args: self.builder.call(function, [*lane_args, dispatch_flag]), args)

    def fused_multiply_add(
        self, op: str, product_index: int, factors: Sequence[ir.Value], terms: Sequence[ir.Value]
    ) -> ir.Value:
        """Return a sum or difference of a product and a term, rounded once."""
        (x, y), addend = factors, terms[1 - product_index]
        if op == "sub":
            x, addend = (x, self.builder.fneg(addend)) if product_index == 0 else (self.builder.fneg(x), addend)
        return self.call_intrinsic_on_lanes("llvm.fmuladd", (x, y, addend), self.double_type)

    def nonnegative_max(self, x: ir.Value, y: ir.Value) -> ir.Value:
        """Return the maximum of two nonnegative numbers, NaN if either is, by comparing their bits."""
        build, width = self.builder, max(self.lanes, 2)
        double_vector, int_vector = ir.VectorType(FLOAT64, width), ir.VectorType(INT64, width)
        lane_zero = ir.Constant(ir.IntType(32), 0)
        if self.lanes == 1:
            x, y = (build.insert_element(ir.Constant(double_vector, ir.Undefined), v, lane_zero) for v in (x, y))
        bits = [build.bitcast(v, int_vector) for v in (x, y)]
        maxima = build.bitcast(
            build.call(self._declare_function(f"llvm.smax.v{width}i64", int_vector, bits), bits), double_vector
        )
        return build.extract_element(maxima, lane_zero) if self.lanes == 1 else maxima

    def splat(self, number: ir.Value) -> ir.Value:
        """Return a vector with a number in every lane."""
        if self.lanes == 1:
            return number
        build, zero = self.builder, ir.Constant(ir.IntType(32), 0)
        first_lane = build.insert_element(ir.Constant(self.double_type, ir.Undefined), number, zero)
        lane_indices = ir.Constant(ir.VectorType(ir.IntType(32), self.lanes), [0] * self.lanes)
        return build.shuffle_vector(first_lane, ir.Constant(self.double_type, ir.Undefined), lane_indices)

    def has_true_lane(self, tests: ir.Value) -> ir.Value:
        """Return one truth value: whether a condition holds in any lane."""
        if self.lanes == 1:
            return tests
        bits = ir.IntType(self.lanes)
        return self.builder.icmp_unsigned("!=", self.builder.bitcast(tests, bits), ir.Constant(bits, 0))

    @staticmethod
    def int64(n: int) -> ir.Constant:
        """Return an integer as an LLVM constant of 64 bits."""
        return ir.Constant(INT64, n)

    @contextlib.contextmanager
    def loop_while(self, condition: Callable[[], ir.Value]) -> Iterator[None]:
        """Write a loop whose body is that of the ``with`` statement, and which runs while a condition holds."""
        build = self.builder
        head, body, exit_block = (build.append_basic_block(name) for name in ("head", "body", "after"))
        build.branch(head)
        build.position_at_end(head)
        build.cbranch(condition(), body, exit_block)
        build.position_at_end(body)
        yield
        build.branch(head)
        build.position_at_end(exit_block)

    @contextlib.contextmanager
    def loop_range(self, count: ir.Value) -> Iterator[ir.Value]:
        """Write a loop whose body is that of the ``with`` statement, with a counter from 0 to ``count - 1``."""
        build = self.builder
        with build.goto_entry_block():  # otherwise each pass would take more of the stack
            counter = build.alloca(INT64)
        build.store(self.int64(0), counter)
        with self.loop_while(lambda: build.icmp_signed("<", build.load(counter), count)):
            yield build.load(counter)
            build.store(build.add(build.load(counter), self.int64(1)), counter)

    def match_constant_types(self, op: str | Block, values: list[ir.Value], args: Sequence[Scalar]) -> list[ir.Value]:
        """Return operands with constants converted to the type of the other operands."""
        operands = slice(1, None) if op in ("select", "pick") else slice(None)
        types = [v.type for v, a in zip(values[operands], args[operands], strict=True) if isinstance(a, str)]
        for i in range(len(values))[operands]:
            if not isinstance(args[i], str) and types and values[i].type != types[0] and types[0] == self.double_type:
                values[i] = self.constant(float(args[i]))
        return values

    def _to_double(self, value: ir.Value) -> ir.Value:
        """Return an integer or a truth value converted to a double."""
        if value.type == self.double_type:
            return value
        convert = self.builder.uitofp if value.type == self.bool_type else self.builder.sitofp
        return convert(value, self.double_type)

    def call_intrinsic_on_lanes(self, name: str, args: Sequence[ir.Value], return_type: ir.Type) -> ir.Value:
        """Return the result of an LLVM intrinsic function on all lanes at once."""
        suffix = "" if self.lanes == 1 else f"v{self.lanes}"
        kinds = [f"{suffix}i64"] if return_type == self.int_type else []
        name = ".".join([name, *kinds, f"{suffix}f64"])
        return self.builder.call(self._declare_function(name, return_type, args), args)

    def call_per_lane(self, name: str, args: Sequence[ir.Value]) -> ir.Value:
        """Return the results of a scalar function, called once for each lane."""
        return self._apply_per_lane(
            lambda lane_args: self.builder.call(self._declare_function(name, FLOAT64, lane_args), lane_args), args
        )

    def _apply_per_lane(self, call: Callable[[Sequence[ir.Value]], ir.Value], args: Sequence[ir.Value]) -> ir.Value:
        """Return the results of ``call`` on the arguments of each lane."""
        if self.lanes == 1:
            return call(args)
        result = ir.Constant(self.double_type, ir.Undefined)
        for lane in range(self.lanes):
            lane_index = ir.Constant(ir.IntType(32), lane)
            lane_result = call([self.builder.extract_element(a, lane_index) for a in args])
            result = self.builder.insert_element(result, lane_result, lane_index)
        return result

    def _declare_function(self, name: str, return_type: ir.Type, args: Sequence[ir.Value]) -> ir.Function:
        """Return the LLVM declaration of a function without side effects."""
        module = self.builder.module
        if name in module.globals:
            return module.globals[name]
        function = ir.Function(module, ir.FunctionType(return_type, [a.type for a in args]), name)
        if not name.startswith("llvm."):
            for attribute in ("nounwind", "readnone"):
                function.attributes.add(attribute)
        return function


class _ProgramEmitter:
    """Writer of the instructions of one program; each side of a branch has its own scope of values."""

    def __init__(
        self, writer: ProgramWriter, program: Program, read_input: InputReader, find_table: TableFinder | None
    ):
        self.writer, self.read_input, self.find_table = writer, read_input, find_table
        self.input_positions = {name: (i, j) for i, names in enumerate(program.inputs) for j, name in enumerate(names)}
        self.use_counts = Counter(a for _, _, args in program.instructions for a in args)
        self.use_counts.update(a for entries in program.outputs for a in entries)
        self.values: ChainMap[str, ir.Value] = ChainMap()
        self.fusible_products: dict[Scalar, list[ir.Value]] = {}  # factors of products with a single use
        self.nonnegative: set[Scalar] = set()  # variables that are known to be nonnegative
        self.block_results: dict[Scalar, BlockResults] = {}
        self.tables: dict[Scalar, Table] = {}

    def value_of_operand(self, operand: Scalar) -> ir.Value:
        """Return the LLVM value of a constant or a variable, which is read if it is an input."""
        if not isinstance(operand, str):
            return self.writer.constant(operand)
        if operand not in self.values:
            self.values[operand] = self.read_input(*self.input_positions[operand])
        return self.values[operand]

    def value_or_table_of_operand(self, operand: Scalar) -> Any:
        """Return the table with the name of an operand, or else its LLVM value."""
        return self.tables.get(operand) or self.value_of_operand(operand)

    def write_instructions_and_branches(self, items: Sequence[Instruction | Branch]) -> None:
        """Write instructions and branches in order."""
        for item in items:
            if isinstance(item, Branch):
                self.write_branch(item)
            else:
                self.write_instruction(item)

    def write_instruction(self, instruction: Instruction) -> None:
        """Write one instruction, and store its result under the name of its target."""
        writer, (target, op, args) = self.writer, instruction
        if isinstance(op, Block):
            self.block_results[target] = write_block(writer, op, [self.value_or_table_of_operand(a) for a in args])
            return
        if op == "item":
            self.values[target] = self.block_results[args[0]].item(int(args[1]))
            return
        if op in ("table", "column"):
            is_new_table = op == "table"
            new_table = (
                self.table_of_inputs(args) or make_table(writer, [self.value_of_operand(a) for a in args])
                if is_new_table
                else None
            )
            self.tables[target] = new_table or self.block_results[args[0]].table_at(int(args[1]))
            return
        if op == "lookup":
            self.values[target] = self.value_or_table_of_operand(args[1]).gather(self.value_of_operand(args[0]))
            return
        if op == "wrap":
            self.values[target] = writer.wrap_integer(self.value_of_operand(args[0]), int(args[1]), bool(args[2]))
            return
        operands = writer.match_constant_types(op, [self.value_of_operand(a) for a in args], args)
        is_unsigned_max = op == "max" and self.nonnegative.issuperset(args)
        product_indices = [i for i, a in enumerate(args) if a in self.fusible_products] if op in ("add", "sub") else []
        if product_indices:
            result = writer.fused_multiply_add(
                op, product_indices[-1], self.fusible_products[args[product_indices[-1]]], operands
            )
        elif is_unsigned_max:
            result = writer.nonnegative_max(*operands)
        else:
            result = writer.write_operation(op, operands)
        self.values[target] = result
        if op == "mul" and self.use_counts[target] == 1 and result.type == writer.double_type:
            self.fusible_products[target] = operands
        if op == "abs" or is_unsigned_max:
            self.nonnegative.add(target)

    def table_of_inputs(self, names: Sequence[Scalar]) -> Table | None:
        """Return inputs that are equidistant in memory as a table, without a copy; None for other inputs."""
        positions = [self.input_positions[a] for a in names if a in self.input_positions]
        if self.find_table is None or len(positions) < max(len(names), 2):
            return None
        arrays, (first, second, *rest) = {i for i, _ in positions}, [j for _, j in positions]
        last = rest[-1] if rest else second
        entries = range(first, last + 1, second - first) if second > first else range(0)
        return (
            self.find_table(positions[0][0], entries)
            if len(arrays) == 1 and [*entries] == [first, second, *rest]
            else None
        )

    def write_branch(self, branch: Branch) -> None:
        """Write both sides of a branch, each skipped if no lane takes it, and select results lane by lane."""
        writer, build = self.writer, self.writer.builder
        self.write_instruction(branch.test)
        test = self.values[branch.test.target]
        for choice_index, (side, is_taken) in enumerate(
            zip(branch.sides, (test, build.not_(test)), strict=True), start=1
        ):
            if not side:
                continue
            block_before, outer_values = build.block, self.values
            side_values, outer_lanes = outer_values.new_child(), writer.active_lanes
            self.values = side_values
            writer.active_lanes = is_taken if outer_lanes is None else build.and_(outer_lanes, is_taken)
            with build.if_then(writer.has_true_lane(writer.active_lanes)):
                self.write_instructions_and_branches(side)
                side_block = build.block
            self.values, writer.active_lanes = outer_values, outer_lanes
            for a in dict.fromkeys(choice.args[choice_index] for choice in branch.choices):
                if isinstance(a, str) and a in side_values.maps[0] and a not in self.input_positions:
                    outer_values[a] = build.phi(side_values[a].type)
                    outer_values[a].add_incoming(side_values[a], side_block)
                    unused = ir.Constant(side_values[a].type, None)  # no lane chooses it
                    outer_values[a].add_incoming(unused, block_before)
        self.write_instructions_and_branches(branch.choices)


MAX_NORMAL_ARGUMENT = 700.0
"""Largest magnitude of an argument whose exponential is not subnormal; the C library computes the others."""

LOG2_HIGH = float.fromhex("0x1.62e42fee00000p-1")
"""log(2) without its last bits, so that its product with an integer up to 2^11 is exact."""

LOG2_LOW = float.fromhex("0x1.a39ef35793c76p-33")
"""log(2) - LOG2_HIGH."""

ROUND_TO_INT_SHIFT = 1.5 * 2.0**52
"""Shift that rounds a number to the nearest integer, which is then in the last bits of the sum."""

SERIES_DEGREE = 13
"""Degree of the power series of exp on arguments below log(2) / 2; its truncation error is 4e-18."""


def write_exponential(writer: Any, x: ir.Value) -> ir.Value:
    """Return ``exp(x)``, computed as ``2^k exp(r)`` with ``x = k log 2 + r`` to one unit in the last place.

    Parameters
    ----------
    writer : ProgramWriter
    """
    build = writer.builder
    is_normal = build.fcmp_ordered("<", writer.write_operation("abs", [x]), writer.constant(MAX_NORMAL_ARGUMENT))
    fast_result = _write_fast_exponential(writer, x)
    fast_block = build.block
    with build.if_then(writer.has_true_lane(build.not_(is_normal)), likely=False):
        exact_result = build.select(is_normal, fast_result, writer.call_per_lane("exp", [x]))
        exact_block = build.block
    result = build.phi(writer.double_type)
    result.add_incoming(fast_result, fast_block)
    result.add_incoming(exact_result, exact_block)
    return result


def _write_fast_exponential(writer: Any, x: ir.Value) -> ir.Value:
    """Return ``exp(x)`` for arguments whose exponential is a normal number."""
    build = writer.builder

    def multiply_add(a: ir.Value, b: ir.Value, c: ir.Value) -> ir.Value:
        return writer.call_intrinsic_on_lanes("llvm.fmuladd", (a, b, c), writer.double_type)

    rounding_shift = writer.constant(ROUND_TO_INT_SHIFT)
    shifted_k = multiply_add(x, writer.constant(1.0 / math.log(2.0)), rounding_shift)
    k = build.fsub(shifted_k, rounding_shift)
    r = multiply_add(k, writer.constant(-LOG2_LOW), multiply_add(k, writer.constant(-LOG2_HIGH), x))
    # exp(r) = 1 + (r + r^2 q(r)); q is summed by independent pairs
    terms = [writer.constant(1.0 / math.factorial(n)) for n in range(2, SERIES_DEGREE + 1)]
    power = r
    square = build.fmul(r, r)
    while len(terms) > 1:
        pairs = [multiply_add(power, high, low) for low, high in zip(terms[::2], terms[1::2], strict=False)]
        terms = pairs + terms[2 * len(pairs) :]
        power = square if power is r else build.fmul(power, power)
    bits = build.shl(build.bitcast(shifted_k, writer.int_type), writer.constant(52))  # only the bits of k are left
    scale = build.bitcast(build.add(bits, writer.constant(1023 << 52)), writer.double_type)
    return build.fmul(scale, build.fadd(writer.constant(1.0), multiply_add(square, terms[0], r)))
