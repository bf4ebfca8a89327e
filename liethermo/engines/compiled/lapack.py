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

from ...tracing.calls import Call

NUMBER, WHOLE, INTEGER, LETTER = ir.DoubleType(), ir.IntType(64), ir.IntType(32), ir.IntType(8)
NUMBERS = NUMBER.as_pointer()

PREFIX = "liethermo_"
"""How the names of functions begin that are bound here."""

ROUTINES = "dsyev zheev dgetrf zgetrf dgetri zgetri dgeqrf zgeqrf dorgqr zungqr dgesdd zgesdd".split()

SPECIAL = {
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
def bind() -> None:
    """Make known to LLVM what SciPy exports."""
    import scipy.linalg.cython_lapack
    import scipy.special.cython_special

    name = ctypes.pythonapi.PyCapsule_GetName
    name.restype, name.argtypes = ctypes.c_char_p, [ctypes.py_object]
    pointer = ctypes.pythonapi.PyCapsule_GetPointer
    pointer.restype, pointer.argtypes = ctypes.c_void_p, [ctypes.py_object, ctypes.c_char_p]
    found = {routine: scipy.linalg.cython_lapack.__pyx_capi__[routine] for routine in ROUTINES}
    for op, (exported, _) in SPECIAL.items():
        found[op] = scipy.special.cython_special.__pyx_capi__[exported]
    for own, capsule in found.items():
        llvm.add_symbol(PREFIX + own, pointer(capsule, name(capsule)))


def kernel(writer: Any, call: Call) -> ir.Function:
    """The function ``f(given, found)`` of a call for one lane, of arrays with a number for each.

    Parameters
    ----------
    writer : Writer
    """
    name = "_".join(["call", call.name, "z" if call.is_complex else "d", *map(str, call.sizes)])
    if name in writer.builder.module.globals:
        return writer.builder.module.globals[name]
    function, inside = writer.function(name, [NUMBERS, NUMBERS])
    _Kernel(inside, function.args, call).write()
    return function


class _Kernel:
    """Writes a kernel. Matrices lie column by column inside, complex numbers as their two parts."""

    def __init__(self, writer: Any, arguments: Sequence[ir.Value], call: Call):
        self.writer, self.call, self.build = writer, call, writer.builder
        self.parts = 2 if call.is_complex else 1
        self.given, self.found = arguments

    def write(self) -> None:
        build, shapes = self.build, self.call.arguments
        total = sum(map(math.prod, shapes)) * self.parts
        finite = build.alloca(ir.IntType(1))
        build.store(ir.Constant(ir.IntType(1), 1), finite)
        for i in self._range(total):
            value = build.load(self._at(self.given, i))
            sound = build.fcmp_ordered("==", build.fsub(value, value), ir.Constant(NUMBER, 0.0))  # not of infinity
            build.store(build.and_(build.load(finite), sound), finite)
        with build.if_else(build.load(finite)) as (sound, not_sound):
            with sound:
                getattr(self, f"_{self.call.name}")(*self.call.sizes)
            with not_sound:
                self._fail()
        build.ret_void()

    # -- the calls ----------------------------------------------------------------------------------------------------

    def _eigh(self, n: int) -> None:
        a, w = self._entered(0, n, n), self._numbers(n)
        z, work = self.call.is_complex, 34 * n  # as much as a blocked reduction to tridiagonal form wants
        arguments = [self._letter("V"), self._letter("L"), self._integer(n), a, self._integer(n), w]
        arguments += [self._numbers(work * self.parts), self._integer(work)]
        arguments += [self._numbers(3 * n)] if z else []

        def leave() -> None:
            self._leave(0, a, n, n)
            self._leave_row(1, w, n)

        self._checked("zheev" if z else "dsyev", arguments, leave)

    def _lu(self, m: int, n: int) -> None:
        a, least = self._entered(0, m, n), min(m, n)
        pivots = self._integers(least)
        routine = "zgetrf" if self.call.is_complex else "dgetrf"
        self._routine(routine, [self._integer(m), self._integer(n), a, self._integer(m), pivots, self._integers(1)])
        self._leave(0, a, m, n)
        for i in self._range(least):  # LAPACK counts from one
            place = self.build.sub(self.build.load(self.build.gep(pivots, [i])), ir.Constant(INTEGER, 1))
            self.build.store(self.build.sitofp(place, NUMBER), self._out(1, i))

    def _inverse(self, n: int) -> None:
        z, a, rows, pivots = self.call.is_complex, self._entered(0, n, n), self._integer(n), self._integers(n)
        size = 64 * n
        first = [rows, rows, a, rows, pivots]

        def invert() -> None:
            rest = [rows, a, rows, pivots, self._numbers(size * self.parts), self._integer(size)]
            self._checked("zgetri" if z else "dgetri", rest, lambda: self._leave(0, a, n, n))

        self._checked("zgetrf" if z else "dgetrf", first, invert)

    def _qr(self, m: int, n: int, columns: int) -> None:
        least, width, z = min(m, n), max(n, columns), self.call.is_complex
        a, tau, size = self._entered(0, m, n, width), self._numbers(least * self.parts), 64 * width
        work, rows, info = self._numbers(size * self.parts), self._integer(m), self._integers(1)
        first = [rows, self._integer(n), a, rows, tau, work, self._integer(size), info]
        self._routine("zgeqrf" if z else "dgeqrf", first)
        r = self._numbers(columns * n * self.parts)
        build = self.build
        for j in self._range(n):
            for i in self._range(columns):
                source = self._entry(a, i, j, m)
                for part in range(self.parts):
                    value = build.load(build.gep(source, [ir.Constant(WHOLE, part)]))
                    upper = build.icmp_signed("<=", i, j)
                    target = build.gep(self._entry(r, i, j, columns), [ir.Constant(WHOLE, part)])
                    build.store(build.select(upper, value, ir.Constant(NUMBER, 0.0)), target)
        rest = [rows, self._integer(columns), self._integer(least), a, rows, tau, work, self._integer(size), info]
        self._routine("zungqr" if z else "dorgqr", rest)
        self._leave(0, a, m, columns)
        self._leave(1, r, columns, n)

    def _svd(self, m: int, n: int, full: int) -> None:
        least, most, z = min(m, n), max(m, n), self.call.is_complex
        left, right = (m, n) if full else (least, least)
        a, s = self._entered(0, m, n), self._numbers(least)
        u, v = self._numbers(m * left * self.parts), self._numbers(right * n * self.parts)
        size = 8 * most * most + 64 * most
        arguments = [self._letter("A" if full else "S"), self._integer(m), self._integer(n), a, self._integer(m), s]
        arguments += [u, self._integer(m), v, self._integer(right)]
        arguments += [self._numbers(size * self.parts), self._integer(size)]
        if z:
            arguments.append(self._numbers(8 * most * most + 8 * most))
        arguments.append(self._integers(8 * least))

        def leave() -> None:
            self._leave_row(0, s, least)
            self._leave(1, u, m, left)
            self._leave(2, v, right, n)

        self._checked("zgesdd" if z else "dgesdd", arguments, leave)

    # -- arrays -------------------------------------------------------------------------------------------------------

    def _at(self, base: ir.Value, i: ir.Value) -> ir.Value:
        return self.build.gep(base, [self.build.mul(i, ir.Constant(WHOLE, self.writer.lanes))])

    def _out(self, which: int, i: ir.Value) -> ir.Value:
        """Entry i of a result."""
        start = sum(self.call.lengths(self.call.results)[:which])
        return self._at(self.found, self.build.add(i, ir.Constant(WHOLE, start)))

    def _entry(self, a: ir.Value, i: ir.Value, j: ir.Value, rows: int) -> ir.Value:
        build = self.build
        place = build.add(build.mul(j, ir.Constant(WHOLE, rows)), i)
        return build.gep(a, [build.mul(place, ir.Constant(WHOLE, self.parts))])

    def _entered(self, start: int, m: int, n: int, width: int | None = None) -> ir.Value:
        """An argument as LAPACK has it, with room for ``width`` columns."""
        build, a = self.build, self._numbers(m * (width or n) * self.parts)
        for i in self._range(m):
            for j in self._range(n):
                place = build.add(build.mul(i, ir.Constant(WHOLE, n)), j)
                for part in range(self.parts):
                    source = self._at(self.given, build.add(place, ir.Constant(WHOLE, start + part * m * n)))
                    target = build.gep(self._entry(a, i, j, m), [ir.Constant(WHOLE, part)])
                    build.store(build.load(source), target)
        return a

    def _leave(self, which: int, a: ir.Value, m: int, n: int) -> None:
        build = self.build
        for i in self._range(m):
            for j in self._range(n):
                place = build.add(build.mul(i, ir.Constant(WHOLE, n)), j)
                for part in range(self.parts):
                    value = build.load(build.gep(self._entry(a, i, j, m), [ir.Constant(WHOLE, part)]))
                    build.store(value, self._out(which, build.add(place, ir.Constant(WHOLE, part * m * n))))

    def _leave_row(self, which: int, w: ir.Value, n: int) -> None:
        for i in self._range(n):
            self.build.store(self.build.load(self.build.gep(w, [i])), self._out(which, i))

    def _fail(self) -> None:
        for i in self._range(len(self.call.kinds)):
            self.build.store(ir.Constant(NUMBER, math.nan), self._at(self.found, i))

    # -- what LAPACK is told ------------------------------------------------------------------------------------------

    def _alloca(self, kind: ir.Type, count: int) -> ir.Value:
        with self.build.goto_entry_block():
            return self.build.alloca(kind, max(count, 1))

    def _numbers(self, count: int) -> ir.Value:
        return self._alloca(NUMBER, count)

    def _integers(self, count: int) -> ir.Value:
        return self._alloca(INTEGER, count)

    def _integer(self, value: int) -> ir.Value:
        place = self._integers(1)
        self.build.store(ir.Constant(INTEGER, value), place)
        return place

    def _letter(self, letter: str) -> ir.Value:
        place = self._alloca(LETTER, 1)
        self.build.store(ir.Constant(LETTER, ord(letter)), place)
        return place

    def _routine(self, name: str, arguments: Sequence[ir.Value]) -> None:
        self.build.call(declared(self.build.module, name, ir.VoidType(), [a.type for a in arguments]), arguments)

    def _checked(self, name: str, arguments: Sequence[ir.Value], leave) -> None:
        """A routine that may fail, its last argument saying so."""
        info = self._integers(1)
        self._routine(name, [*arguments, info])
        fine = self.build.icmp_signed("==", self.build.load(info), ir.Constant(INTEGER, 0))
        with self.build.if_else(fine) as (done, failed):
            with done:
                leave()
            with failed:
                self._fail()

    def _range(self, count: int):
        """A loop: the body of the ``for`` is written once, with its counter."""
        with self.writer.counted(ir.Constant(WHOLE, count)) as i:
            yield i


def declared(module: ir.Module, name: str, result: ir.Type, kinds: Sequence[ir.Type]) -> ir.Function:
    """A function that is bound when the code is loaded."""
    name = PREFIX + name
    if name in module.globals:
        return module.globals[name]
    return ir.Function(module, ir.FunctionType(result, list(kinds)), name)
