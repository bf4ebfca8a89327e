"""LAPACK in machine code, by the pointers that SciPy exports, and products of matrices as loops.

Machine code holds the names of the functions, so it can be kept on disk; each process binds them when it loads code
that calls one. A call takes small matrices of one lane, on the thread that makes it.
"""

from __future__ import annotations

import ctypes
import functools
import math
from collections.abc import Sequence
from typing import Any

import llvmlite.binding as llvm
from llvmlite import ir

from ...tracing.calls import LapackCall

FLOAT64, INT64, INT32, INT8 = ir.DoubleType(), ir.IntType(64), ir.IntType(32), ir.IntType(8)
FLOAT64_POINTER = FLOAT64.as_pointer()

SYMBOL_PREFIX = "liethermo_"
"""How the names of functions begin that are bound here."""

LAPACK_ROUTINES = "dsyev zheev dgetrf zgetrf dgetri zgetri dgeqrf zgeqrf dorgqr zungqr dgesdd zgesdd".split()

SPECIAL_FUNCTIONS = {
    "lgamma": ("gammaln", 1),
    "digamma": ("__pyx_fuse_1psi", 1),
    "erf_inv": ("__pyx_fuse_0erfinv", 1),
    "bessel_i0e": ("i0e", 1),
    "bessel_i1e": ("i1e", 1),
    "igamma": ("gammainc", 2),
    "igammac": ("gammaincc", 2),
    "regularized_incomplete_beta": ("__pyx_fuse_0betainc", 3),
}
"""SciPy's names of special functions, and of how many numbers they are."""


@functools.cache
def bind_symbols() -> None:
    """Make known to LLVM what SciPy exports."""
    import scipy.linalg.cython_lapack
    import scipy.special.cython_special

    name = ctypes.pythonapi.PyCapsule_GetName
    name.restype, name.argtypes = ctypes.c_char_p, [ctypes.py_object]
    pointer = ctypes.pythonapi.PyCapsule_GetPointer
    pointer.restype, pointer.argtypes = ctypes.c_void_p, [ctypes.py_object, ctypes.c_char_p]
    found = {routine: scipy.linalg.cython_lapack.__pyx_capi__[routine] for routine in LAPACK_ROUTINES}
    for op, (exported, _) in SPECIAL_FUNCTIONS.items():
        found[op] = scipy.special.cython_special.__pyx_capi__[exported]
    for own, capsule in found.items():
        llvm.add_symbol(SYMBOL_PREFIX + own, pointer(capsule, name(capsule)))


def lapack_kernel(writer: Any, call: LapackCall) -> ir.Function:
    """The function ``f(given, found)`` of a call for one lane, of arrays with a number for each.

    Parameters
    ----------
    writer : Writer
    """
    name = "_".join(["call", call.name, "z" if call.is_complex else "d", *map(str, call.sizes)])
    if name in writer.builder.module.globals:
        return writer.builder.module.globals[name]
    function, inside = writer.new_function(name, [FLOAT64_POINTER, FLOAT64_POINTER])
    _KernelWriter(inside, function.args, call).write()
    return function


class _KernelWriter:
    """Writes a kernel. Matrices lie column by column inside, complex numbers as their two parts."""

    def __init__(self, writer: Any, arguments: Sequence[ir.Value], call: LapackCall):
        self.writer, self.call, self.builder = writer, call, writer.builder
        self.parts_per_entry = 2 if call.is_complex else 1
        self.input_pointer, self.output_pointer = arguments

    def write(self) -> None:
        build, shapes = self.builder, self.call.argument_shapes
        total = sum(map(math.prod, shapes)) * self.parts_per_entry
        finite = build.alloca(ir.IntType(1))
        build.store(ir.Constant(ir.IntType(1), 1), finite)
        for i in self._loop(total):
            value = build.load(self._lane_entry(self.input_pointer, i))
            sound = build.fcmp_ordered("==", build.fsub(value, value), ir.Constant(FLOAT64, 0.0))  # not of infinity
            build.store(build.and_(build.load(finite), sound), finite)
        with build.if_else(build.load(finite)) as (sound, not_sound):
            with sound:
                getattr(self, f"_{self.call.name}")(*self.call.sizes)
            with not_sound:
                self._write_nan()
        build.ret_void()

    # -- the calls ----------------------------------------------------------------------------------------------------

    def _eigh(self, n: int) -> None:
        a, w = self._copy_input(0, n, n), self._allocate_doubles(n)
        z, work = self.call.is_complex, 34 * n  # as much as a blocked reduction to tridiagonal form wants
        arguments = [
            self._char_argument("V"),
            self._char_argument("L"),
            self._integer_argument(n),
            a,
            self._integer_argument(n),
            w,
        ]
        arguments += [self._allocate_doubles(work * self.parts_per_entry), self._integer_argument(work)]
        arguments += [self._allocate_doubles(3 * n)] if z else []

        def leave() -> None:
            self._copy_output(0, a, n, n)
            self._copy_output_vector(1, w, n)

        self._call_with_info("zheev" if z else "dsyev", arguments, leave)

    def _lu(self, m: int, n: int) -> None:
        a, least = self._copy_input(0, m, n), min(m, n)
        pivots = self._allocate_integers(least)
        routine = "zgetrf" if self.call.is_complex else "dgetrf"
        self._call_routine(
            routine,
            [
                self._integer_argument(m),
                self._integer_argument(n),
                a,
                self._integer_argument(m),
                pivots,
                self._allocate_integers(1),
            ],
        )
        self._copy_output(0, a, m, n)
        for i in self._loop(least):  # LAPACK counts from one
            place = self.builder.sub(self.builder.load(self.builder.gep(pivots, [i])), ir.Constant(INT32, 1))
            self.builder.store(self.builder.sitofp(place, FLOAT64), self._output_entry(1, i))

    def _inverse(self, n: int) -> None:
        z, a, rows, pivots = (
            self.call.is_complex,
            self._copy_input(0, n, n),
            self._integer_argument(n),
            self._allocate_integers(n),
        )
        size = 64 * n
        first = [rows, rows, a, rows, pivots]

        def invert() -> None:
            rest = [
                rows,
                a,
                rows,
                pivots,
                self._allocate_doubles(size * self.parts_per_entry),
                self._integer_argument(size),
            ]
            self._call_with_info("zgetri" if z else "dgetri", rest, lambda: self._copy_output(0, a, n, n))

        self._call_with_info("zgetrf" if z else "dgetrf", first, invert)

    def _qr(self, m: int, n: int, columns: int) -> None:
        least, width, z = min(m, n), max(n, columns), self.call.is_complex
        a, tau, size = (
            self._copy_input(0, m, n, width),
            self._allocate_doubles(least * self.parts_per_entry),
            64 * width,
        )
        work, rows, info = (
            self._allocate_doubles(size * self.parts_per_entry),
            self._integer_argument(m),
            self._allocate_integers(1),
        )
        first = [rows, self._integer_argument(n), a, rows, tau, work, self._integer_argument(size), info]
        self._call_routine("zgeqrf" if z else "dgeqrf", first)
        r = self._allocate_doubles(columns * n * self.parts_per_entry)
        build = self.builder
        for j in self._loop(n):
            for i in self._loop(columns):
                source = self._matrix_entry(a, i, j, m)
                for part in range(self.parts_per_entry):
                    value = build.load(build.gep(source, [ir.Constant(INT64, part)]))
                    upper = build.icmp_signed("<=", i, j)
                    target = build.gep(self._matrix_entry(r, i, j, columns), [ir.Constant(INT64, part)])
                    build.store(build.select(upper, value, ir.Constant(FLOAT64, 0.0)), target)
        rest = [
            rows,
            self._integer_argument(columns),
            self._integer_argument(least),
            a,
            rows,
            tau,
            work,
            self._integer_argument(size),
            info,
        ]
        self._call_routine("zungqr" if z else "dorgqr", rest)
        self._copy_output(0, a, m, columns)
        self._copy_output(1, r, columns, n)

    def _svd(self, m: int, n: int, full: int) -> None:
        least, most, z = min(m, n), max(m, n), self.call.is_complex
        left, right = (m, n) if full else (least, least)
        a, s = self._copy_input(0, m, n), self._allocate_doubles(least)
        u, v = (
            self._allocate_doubles(m * left * self.parts_per_entry),
            self._allocate_doubles(right * n * self.parts_per_entry),
        )
        size = 8 * most * most + 64 * most
        arguments = [
            self._char_argument("A" if full else "S"),
            self._integer_argument(m),
            self._integer_argument(n),
            a,
            self._integer_argument(m),
            s,
        ]
        arguments += [u, self._integer_argument(m), v, self._integer_argument(right)]
        arguments += [self._allocate_doubles(size * self.parts_per_entry), self._integer_argument(size)]
        if z:
            arguments.append(self._allocate_doubles(8 * most * most + 8 * most))
        arguments.append(self._allocate_integers(8 * least))

        def leave() -> None:
            self._copy_output_vector(0, s, least)
            self._copy_output(1, u, m, left)
            self._copy_output(2, v, right, n)

        self._call_with_info("zgesdd" if z else "dgesdd", arguments, leave)

    # -- arrays -------------------------------------------------------------------------------------------------------

    def _lane_entry(self, base: ir.Value, i: ir.Value) -> ir.Value:
        return self.builder.gep(base, [self.builder.mul(i, ir.Constant(INT64, self.writer.lanes))])

    def _output_entry(self, which: int, i: ir.Value) -> ir.Value:
        """Entry i of a result."""
        start = sum(self.call.entry_counts(self.call.result_specs)[:which])
        return self._lane_entry(self.output_pointer, self.builder.add(i, ir.Constant(INT64, start)))

    def _matrix_entry(self, a: ir.Value, i: ir.Value, j: ir.Value, rows: int) -> ir.Value:
        build = self.builder
        place = build.add(build.mul(j, ir.Constant(INT64, rows)), i)
        return build.gep(a, [build.mul(place, ir.Constant(INT64, self.parts_per_entry))])

    def _copy_input(self, start: int, m: int, n: int, width: int | None = None) -> ir.Value:
        """An argument as LAPACK has it, with room for ``width`` columns."""
        build, a = self.builder, self._allocate_doubles(m * (width or n) * self.parts_per_entry)
        for i in self._loop(m):
            for j in self._loop(n):
                place = build.add(build.mul(i, ir.Constant(INT64, n)), j)
                for part in range(self.parts_per_entry):
                    source = self._lane_entry(
                        self.input_pointer, build.add(place, ir.Constant(INT64, start + part * m * n))
                    )
                    target = build.gep(self._matrix_entry(a, i, j, m), [ir.Constant(INT64, part)])
                    build.store(build.load(source), target)
        return a

    def _copy_output(self, which: int, a: ir.Value, m: int, n: int) -> None:
        build = self.builder
        for i in self._loop(m):
            for j in self._loop(n):
                place = build.add(build.mul(i, ir.Constant(INT64, n)), j)
                for part in range(self.parts_per_entry):
                    value = build.load(build.gep(self._matrix_entry(a, i, j, m), [ir.Constant(INT64, part)]))
                    build.store(value, self._output_entry(which, build.add(place, ir.Constant(INT64, part * m * n))))

    def _copy_output_vector(self, which: int, w: ir.Value, n: int) -> None:
        for i in self._loop(n):
            self.builder.store(self.builder.load(self.builder.gep(w, [i])), self._output_entry(which, i))

    def _write_nan(self) -> None:
        for i in self._loop(len(self.call.kinds)):
            self.builder.store(ir.Constant(FLOAT64, math.nan), self._lane_entry(self.output_pointer, i))

    # -- what LAPACK is told ------------------------------------------------------------------------------------------

    def _allocate(self, kind: ir.Type, count: int) -> ir.Value:
        with self.builder.goto_entry_block():
            return self.builder.alloca(kind, max(count, 1))

    def _allocate_doubles(self, count: int) -> ir.Value:
        return self._allocate(FLOAT64, count)

    def _allocate_integers(self, count: int) -> ir.Value:
        return self._allocate(INT32, count)

    def _integer_argument(self, value: int) -> ir.Value:
        place = self._allocate_integers(1)
        self.builder.store(ir.Constant(INT32, value), place)
        return place

    def _char_argument(self, letter: str) -> ir.Value:
        place = self._allocate(INT8, 1)
        self.builder.store(ir.Constant(INT8, ord(letter)), place)
        return place

    def _call_routine(self, name: str, arguments: Sequence[ir.Value]) -> None:
        self.builder.call(
            declare_symbol(self.builder.module, name, ir.VoidType(), [a.type for a in arguments]), arguments
        )

    def _call_with_info(self, name: str, arguments: Sequence[ir.Value], leave) -> None:
        """A routine that may fail, its last argument saying so."""
        info = self._allocate_integers(1)
        self._call_routine(name, [*arguments, info])
        fine = self.builder.icmp_signed("==", self.builder.load(info), ir.Constant(INT32, 0))
        with self.builder.if_else(fine) as (done, failed):
            with done:
                leave()
            with failed:
                self._write_nan()

    def _loop(self, count: int):
        """A loop: the body of the ``for`` is written once, with its counter."""
        with self.writer.loop_range(ir.Constant(INT64, count)) as i:
            yield i


def declare_symbol(module: ir.Module, name: str, result: ir.Type, kinds: Sequence[ir.Type]) -> ir.Function:
    """A function that is bound when the code is loaded."""
    name = SYMBOL_PREFIX + name
    if name in module.globals:
        return module.globals[name]
    return ir.Function(module, ir.FunctionType(result, list(kinds)), name)
