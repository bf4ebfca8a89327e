"""Scalar programs as LLVM instructions, and modules of them as machine code: kept on disk, unloaded when unused."""

from __future__ import annotations

import contextlib
import ctypes.util
import functools
import hashlib
import os
import tempfile
import threading
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import llvmlite.binding as llvm
import numpy as np
from llvmlite import ir

from ...tracing.builder import Scalar
from ...tracing.scalarize import Program, UnsupportedPrimitive

NUMBER, TEST, WHOLE = ir.DoubleType(), ir.IntType(1), ir.IntType(64)

INTRINSICS = {name: name for name in "sqrt exp exp2 log sin cos floor ceil rint trunc pow".split()} | {"abs": "fabs"}
"""Operations that LLVM has functions for."""

LIBRARY = frozenset("cbrt expm1 log1p tan asin acos atan atan2 sinh cosh tanh asinh acosh atanh erf erfc".split())
"""Operations that are functions of the C library, by the same names."""

COMPARED = {"eq": "==", "lt": "<", "le": "<=", "gt": ">", "ge": ">="}
ARITHMETIC = {"add": ("fadd", "add"), "sub": ("fsub", "sub"), "mul": ("fmul", "mul"), "neg": ("fneg", "neg")}
ARITHMETIC |= {"div": ("fdiv", ""), "rem": ("frem", "")}
LOGICAL = {"and": "and_", "or": "or_", "xor": "xor", "not": "not_"}


class Writer:
    """Writes programs where a builder stands, on numbers, or on vectors with a number for each lane.

    Truth values are bits, integers have 64. Nothing is reordered. A product that is only added to something is fused
    with the sum, and rounded once, on processors that can; which ones are does not depend on the lanes.
    """

    def __init__(self, builder: ir.IRBuilder, lanes: int):
        self.builder, self.lanes = builder, lanes
        self.number, self.test, self.whole = (
            kind if lanes == 1 else ir.VectorType(kind, lanes) for kind in (NUMBER, TEST, WHOLE)
        )

    def write(self, program: Program, read: Callable[[int, int], ir.Value]) -> list[list[ir.Value]]:
        """The values of the outputs, array by array.

        Parameters
        ----------
        read : function from the places of an array among the inputs, and of an entry in it, to its value
            Asked for what the program uses.
        """
        places = {name: (i, j) for i, names in enumerate(program.inputs) for j, name in enumerate(names)}
        uses = Counter(a for _, _, args in program.instructions for a in args)
        uses.update(a for entries in program.outputs for a in entries)
        values: dict[Scalar, ir.Value] = {}
        products: dict[Scalar, list[ir.Value]] = {}  # that nothing else needs
        sizes: set[Scalar] = set()  # numbers without a sign

        def value(a: Scalar) -> ir.Value:
            if not isinstance(a, str):
                return self.constant(a)
            if a not in values:
                values[a] = read(*places[a])
            return values[a]

        for target, op, args in program.instructions:
            given = self._alike(op, [value(a) for a in args], args)
            unsigned = op == "max" and sizes.issuperset(args)
            fused = [i for i, a in enumerate(args) if a in products] if op in ("add", "sub") else []
            if fused:
                values[target] = self._fused(op, fused[-1], products[args[fused[-1]]], given)
            elif unsigned:
                values[target] = self._larger(*given)
            else:
                values[target] = self.operation(op, given)
            if op == "mul" and uses[target] == 1 and values[target].type == self.number:
                products[target] = given
            if op == "abs" or unsigned:
                sizes.add(target)
        return [[self._as_number(value(a)) for a in entries] for entries in program.outputs]

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
        if op in LOGICAL and x.type == self.test:
            return getattr(build, LOGICAL[op])(*args)
        if op in COMPARED:
            compare = build.fcmp_ordered if real else build.icmp_signed
            return compare(COMPARED[op], *args)
        if op == "ne":
            return build.fcmp_unordered("!=", *args) if real else build.icmp_signed("!=", *args)
        if op == "select":
            return build.select(x, *rest)
        if op in ("max", "min"):  # like XLA's, NaN if either is
            better = self.operation("gt" if op == "max" else "lt", args)
            if real:
                better = build.or_(better, build.fcmp_unordered("uno", x, x))
            return build.select(better, x, rest[0])
        if op == "float":
            return self._as_number(x)
        if op == "int":
            return build.zext(x, self.whole) if x.type == self.test else x
        if real and op in INTRINSICS:
            return self._intrinsic(f"llvm.{INTRINSICS[op]}", args, self.number)
        if real and op in LIBRARY:
            return self._of_each_lane(op, args)
        if real and op == "truncate":  # NaN to 0, and what is too large to the nearest integer
            return self._intrinsic("llvm.fptosi.sat", args, self.whole)
        if real and op == "is_finite":
            return build.fcmp_ordered("<", self.operation("abs", args), self.constant(np.inf))
        if real and op == "sign":  # NaN of NaN, a zero of a zero
            signed = self._intrinsic("llvm.copysign", [self.constant(1.0), x], self.number)
            return build.select(build.fcmp_ordered("one", x, self.constant(0.0)), signed, x)
        raise UnsupportedPrimitive(op, "of unknown origin", f"on {x.type}")

    def _fused(self, op: str, place: int, factors: Sequence[ir.Value], terms: Sequence[ir.Value]) -> ir.Value:
        """A sum or difference whose term at a place is a product."""
        (x, y), other = factors, terms[1 - place]
        if op == "sub":
            x, other = (x, self.builder.fneg(other)) if place == 0 else (self.builder.fneg(x), other)
        return self._intrinsic("llvm.fmuladd", (x, y, other), self.number)

    def _larger(self, x: ir.Value, y: ir.Value) -> ir.Value:
        """The larger of two numbers without a sign, NaN if either is: their bits are in the order of the numbers."""
        build, count = self.builder, max(self.lanes, 2)
        number, whole = ir.VectorType(NUMBER, count), ir.VectorType(WHOLE, count)
        first = ir.Constant(ir.IntType(32), 0)
        if self.lanes == 1:
            x, y = (build.insert_element(ir.Constant(number, ir.Undefined), v, first) for v in (x, y))
        bits = [build.bitcast(v, whole) for v in (x, y)]
        found = build.bitcast(build.call(self._declared(f"llvm.smax.v{count}i64", whole, bits), bits), number)
        return build.extract_element(found, first) if self.lanes == 1 else found

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

    def _alike(self, op: str, values: list[ir.Value], args: Sequence[Scalar]) -> list[ir.Value]:
        """Constants as numbers of the type of what stands beside them."""
        chosen = slice(1, None) if op == "select" else slice(None)
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

    def _intrinsic(self, name: str, args: Sequence[ir.Value], result: ir.Type) -> ir.Value:
        suffix = "" if self.lanes == 1 else f"v{self.lanes}"
        kinds = [f"{suffix}i64"] if result == self.whole else []
        name = ".".join([name, *kinds, f"{suffix}f64"])
        return self.builder.call(self._declared(name, result, args), args)

    def _of_each_lane(self, name: str, args: Sequence[ir.Value]) -> ir.Value:
        if self.lanes == 1:
            return self.builder.call(self._declared(name, NUMBER, args), args)
        result = ir.Constant(self.number, ir.Undefined)
        for lane in range(self.lanes):
            place = ir.Constant(ir.IntType(32), lane)
            own = [self.builder.extract_element(a, place) for a in args]
            found = self.builder.call(self._declared(name, NUMBER, own), own)
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


# -- machine code -----------------------------------------------------------------------------------------------------


class MachineCode:
    """A module as machine code: unloaded with this object."""

    def __init__(self, module: ir.Module):
        text = str(module)
        with _lock:
            name = hashlib.sha256(f"{_this_machine()[-1]}\n{text}".encode()).hexdigest()[:32]
            found = _read(name)
            if found is None:
                found = _compile(text)
                _write(name, found)
            self._engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), _machine())
            self._engine.add_object_file(llvm.ObjectFileRef.from_data(found))
            self._engine.finalize_object()

    def address(self, name: str) -> int:
        """The address of a function."""
        return self._engine.get_function_address(name)


_lock = threading.Lock()


@functools.cache
def _this_machine() -> tuple[llvm.Target, str, str, str]:
    """This machine, and what tells its machine code, and the compiler's version, from others."""
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    library = ctypes.util.find_library("m")
    if library:
        llvm.load_library_permanently(library)
    triple, cpu = llvm.get_process_triple(), llvm.get_host_cpu_name()
    features = llvm.get_host_cpu_features().flatten()
    version = ".".join(map(str, llvm.llvm_version_info))
    return llvm.Target.from_triple(triple), cpu, features, f"{triple} {cpu} {features} {version}"


def _machine() -> llvm.TargetMachine:
    """A compiler for this machine; an engine that is made with one owns it."""
    target, cpu, features, _ = _this_machine()
    return target.create_target_machine(cpu, features, opt=3, jit=True, reloc="pic")


def _compile(text: str) -> bytes:
    module, target = llvm.parse_assembly(text), _machine()
    module.verify()
    options = llvm.create_pipeline_tuning_options(speed_level=3)
    options.slp_vectorization = False
    builder = llvm.create_pass_builder(target, options)
    builder.getModulePassManager().run(module, builder)
    return target.emit_object(module)


# -- on disk ----------------------------------------------------------------------------------------------------------


def cache_folder() -> Path:
    """Where machine code is kept: ``$LIETHERMO_CACHE``, or a folder under the user's cache directory."""
    named = os.environ.get("LIETHERMO_CACHE")
    return Path(named) if named else Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "liethermo"


def _read(name: str) -> bytes | None:
    """What was written under a name; None where there is nothing, or it is damaged."""
    try:
        whole = (cache_folder() / f"{name}.o").read_bytes()
    except OSError:
        return None
    seal, found = whole[:SEAL], whole[SEAL:]
    return found if seal == hashlib.sha256(found).digest() else None


def _write(name: str, code: bytes) -> None:
    """Write a file, which appears whole or not at all; nothing where the folder cannot be written."""
    folder = cache_folder()
    with contextlib.suppress(OSError):
        folder.mkdir(parents=True, exist_ok=True)
        handle, temporary = tempfile.mkstemp(dir=folder, suffix=".part")
        try:
            with os.fdopen(handle, "wb") as file:
                file.write(hashlib.sha256(code).digest() + code)
            os.replace(temporary, folder / f"{name}.o")
        finally:
            Path(temporary).unlink(missing_ok=True)


SEAL = 32
"""Bytes of a file before the code: its checksum."""
