"""Straight-line programs as LLVM instructions, placed into functions that numba compiles.

Numba spends a millisecond on the types of each operation. Those of a scalar program are known, so its text, a sequence
of assignments, is translated here directly: an expression to the instruction that numba would choose for it, a choice
between two values to a select. Programs with operations that are not listed here are left to numba.
"""

from __future__ import annotations

import ast
from collections.abc import Callable

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from ...tracing.primitives import OF_TESTS, TESTS, Scalar
from ...tracing.scalarize import Program

NUMBER, TEST, WHOLE = ir.DoubleType(), ir.IntType(1), ir.IntType(64)

FUNCTIONS = {
    **{name: f"llvm.{name}" for name in ("sqrt", "exp", "log", "sin", "cos", "floor", "ceil", "rint", "trunc")},
    "abs": "llvm.fabs",
}
"""Functions of one number, and the intrinsics that numba calls for them too."""

BINARY = {ast.Add: "fadd", ast.Sub: "fsub", ast.Mult: "fmul", ast.Div: "fdiv"}
LOGICAL = {ast.BitAnd: "and_", ast.BitOr: "or_", ast.BitXor: "xor"}
COMPARED = {ast.Eq: "==", ast.Lt: "<", ast.LtE: "<=", ast.Gt: ">", ast.GtE: ">="}

OF_NUMBERS = {*FUNCTIONS, "add", "sub", "mul", "div", "neg", "pow", "rem", "max", "min", "sign"}


def is_plain(program: Program) -> bool:
    """Whether a program can be translated: of numbers and truth values, with the operations known here."""
    kinds: dict[Scalar, type] = {name: float for names in program.inputs for name in names}

    def kind(a: Scalar):
        return kinds[a] if isinstance(a, str) else type(a)

    for target, op, args in program.instructions:
        found = [kind(a) for a in args]
        if op in OF_NUMBERS or op in TESTS:
            wanted, kinds[target] = [float] * len(found), float if op in OF_NUMBERS else bool
        elif op in OF_TESTS:
            wanted, kinds[target] = [bool] * len(found), bool
        elif op == "select":
            wanted, kinds[target] = [bool, found[1], found[1]], found[1]
        elif op == "float":
            wanted, kinds[target] = [bool], float
        else:
            return False
        if found != wanted:
            return False
    return all(kind(a) is float for entries in program.outputs for a in entries)


def straight_line(text: str, looped: bool) -> Callable:
    """A function for numba's functions to call, made of assignments to names and to entries of arrays.

    Parameters
    ----------
    text : str
        Lines such as ``t = w[3 + l] * p[0]`` and ``w[8 + l] = t``.
    looped : bool
        The function is ``f(p, w, first, last)``, which runs the lines for each l from first to before last; else
        ``f(p, w, l, v)``, with one array more.
    """

    @intrinsic
    def program(_, p, w, third, fourth):
        def generate(context, builder, signature, arguments):
            arrays = {
                name: context.make_array(kind)(context, builder, value).data
                for name, kind, value in zip(("p", "w", "", "v"), signature.args, arguments, strict=True)
                if isinstance(kind, types.Array)
            }
            if looped:
                step = ir.Constant(WHOLE, 1)
                with cgutils.for_range_slice(builder, arguments[2], arguments[3], step) as (lane, _):
                    _Translation(builder, arrays, lane).run(text)
            else:
                _Translation(builder, arrays, arguments[2]).run(text)
            return context.get_dummy_value()

        return types.void(p, w, third, fourth), generate

    return program


class _Translation:
    """The instructions of a text, appended to a block of LLVM code."""

    def __init__(self, builder: ir.IRBuilder, arrays: dict[str, ir.Value], lane: ir.Value):
        self.builder, self.arrays, self.lane = builder, arrays, lane
        self.known: dict[str, ir.Value] = {}

    def run(self, text: str) -> None:
        for line in ast.parse(text).body:
            assert isinstance(line, ast.Assign)
            target, value = line.targets[0], self.value(line.value)
            if isinstance(target, ast.Name):
                self.known[target.id] = value
            else:
                self.builder.store(value, self.place(target))

    def place(self, node) -> ir.Value:
        """Where ``w[12 + l]`` or ``p[3]`` lies."""
        parts = [node.slice] if isinstance(node.slice, ast.Constant | ast.Name) else [node.slice.left, node.slice.right]
        index = [self.lane if isinstance(part, ast.Name) else ir.Constant(WHOLE, part.value) for part in parts]
        offset = index[0] if len(index) == 1 else self.builder.add(*index, flags=["nsw"])
        return self.builder.gep(self.arrays[node.value.id], [offset], inbounds=True)

    def value(self, node) -> ir.Value:
        build = self.builder
        match node:
            case ast.Name():
                return self.known[node.id]
            case ast.Constant(value=bool(truth)):
                return ir.Constant(TEST, int(truth))
            case ast.Constant(value=float(number)):
                return ir.Constant(NUMBER, number)
            case ast.Attribute():
                return ir.Constant(NUMBER, {"nan": np.nan, "inf": np.inf}[node.attr])
            case ast.Subscript(value=ast.Name(id=array)):
                found = build.load(self.place(node))
                if array == "p":  # parameters stay: no store to the other arrays changes them
                    found.set_metadata("invariant.load", build.module.add_metadata([]))
                return found
            case ast.UnaryOp(op=ast.USub()):
                return build.fneg(self.value(node.operand))
            case ast.UnaryOp():
                return build.not_(self.value(node.operand))
            case ast.BinOp(op=ast.Pow()):
                return self.call("llvm.pow", node.left, node.right)
            case ast.BinOp():
                name = BINARY.get(type(node.op)) or LOGICAL[type(node.op)]
                return getattr(build, name)(self.value(node.left), self.value(node.right))
            case ast.BoolOp():  # only "or" occurs, of two
                return build.or_(*map(self.value, node.values))
            case ast.Compare(ops=[op], comparators=[right]):
                left = self.value(node.left)
                if isinstance(op, ast.NotEq):
                    return build.fcmp_unordered("!=", left, self.value(right))
                return build.fcmp_ordered(COMPARED[type(op)], left, self.value(right))
            case ast.IfExp():
                return build.select(self.value(node.test), self.value(node.body), self.value(node.orelse))
            case ast.Call(func=ast.Name(id=name) | ast.Attribute(attr=name), args=arguments):
                return self.function(name, arguments)
        raise NotImplementedError(ast.dump(node))

    def function(self, name: str, arguments: list[ast.expr]) -> ir.Value:
        build = self.builder
        if name in FUNCTIONS:
            return self.call(FUNCTIONS[name], *arguments)
        if name == "fmod":
            return build.frem(*map(self.value, arguments))
        x, zero = self.value(arguments[0]), ir.Constant(NUMBER, 0.0)
        if name == "float64":
            return build.uitofp(x, NUMBER) if x.type == TEST else x
        if name == "isfinite":
            return build.fcmp_ordered("<", self.call("llvm.fabs", *arguments), ir.Constant(NUMBER, np.inf))
        if name == "sign":  # NaN of NaN
            signed = build.select(build.fcmp_ordered("<", x, zero), ir.Constant(NUMBER, -1.0), x)
            signed = build.select(build.fcmp_ordered(">", x, zero), ir.Constant(NUMBER, 1.0), signed)
            return build.select(build.fcmp_ordered("==", x, zero), zero, signed)
        raise NotImplementedError(name)

    def call(self, name: str, *nodes) -> ir.Value:
        declared = self.builder.module.declare_intrinsic(name, [NUMBER])
        return self.builder.call(declared, [self.value(node) for node in nodes])
