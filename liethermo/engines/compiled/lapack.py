"""LAPACK kernels and special functions in machine code, by the pointers that SciPy exports.

Machine code contains the names of the functions, so it can be cached on disk; each process binds the names when it
loads code that calls them. A call takes small matrices of one lane, on the calling thread.
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

FLOAT64 = ir.DoubleType()
INT64 = ir.IntType(64)
INT32 = ir.IntType(32)
INT8 = ir.IntType(8)
FLOAT64_POINTER = FLOAT64.as_pointer()

SYMBOL_PREFIX = "liethermo_"
"""Prefix of the names of functions that are bound when code is loaded."""

LAPACK_ROUTINES = "dsyev zheev dgetrf zgetrf dgetri zgetri dgeqrf zgeqrf dorgqr zungqr dgesdd zgesdd".split()
"""LAPACK routines that kernels call."""

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
"""SciPy's name of each special function, and its number of arguments."""


@functools.cache
def bind_scipy_functions_in_llvm() -> None:
    """Bind the functions that SciPy exports to their names in LLVM, so that machine code can call them."""
    import scipy.linalg.cython_lapack
    import scipy.special.cython_special

    name = ctypes.pythonapi.PyCapsule_GetName
    name.restype, name.argtypes = ctypes.c_char_p, [ctypes.py_object]
    pointer = ctypes.pythonapi.PyCapsule_GetPointer
    pointer.restype, pointer.argtypes = ctypes.c_void_p, [ctypes.py_object, ctypes.c_char_p]
    capsules = {routine: scipy.linalg.cython_lapack.__pyx_capi__[routine] for routine in LAPACK_ROUTINES}
    for op, (exported, _) in SPECIAL_FUNCTIONS.items():
        capsules[op] = scipy.special.cython_special.__pyx_capi__[exported]
    for symbol, capsule in capsules.items():
        llvm.add_symbol(SYMBOL_PREFIX + symbol, pointer(capsule, name(capsule)))


def find_or_write_kernel(writer: Any, call: LapackCall) -> ir.Function:
    """Return the LLVM function ``kernel(inputs, outputs)`` of a LAPACK call in one lane, written at first use.

    The arrays interleave the lanes: consecutive entries are ``writer.lanes`` numbers apart.

    Parameters
    ----------
    writer : ProgramWriter
    """
    name = "_".join(["call", call.name, "z" if call.is_complex else "d", *map(str, call.sizes)])
    if name in writer.builder.module.globals:
        return writer.builder.module.globals[name]
    function, function_writer = writer.new_function(name, [FLOAT64_POINTER, FLOAT64_POINTER])
    _KernelWriter(function_writer, function.args, call).write_kernel()
    return function


class _KernelWriter:
    """Writer of the LLVM function of one LAPACK call, whose matrices are stored by columns.

    A complex number is stored as its real and its imaginary part.
    """

    def __init__(self, writer: Any, arguments: Sequence[ir.Value], call: LapackCall):
        self.writer, self.call, self.builder = writer, call, writer.builder
        self.parts_per_entry = 2 if call.is_complex else 1
        self.input_pointer, self.output_pointer = arguments

    def write_kernel(self) -> None:
        """Write the body of the kernel: call LAPACK if all inputs are finite, otherwise return NaN."""
        build, shapes = self.builder, self.call.argument_shapes
        total = sum(map(math.prod, shapes)) * self.parts_per_entry
        all_finite = build.alloca(ir.IntType(1))
        build.store(ir.Constant(ir.IntType(1), 1), all_finite)
        for i in self._loop_range(total):
            value = build.load(self._lane_entry_pointer(self.input_pointer, i))
            difference = build.fsub(value, value)  # NaN for infinity
            is_finite = build.fcmp_ordered("==", difference, ir.Constant(FLOAT64, 0.0))
            build.store(build.and_(build.load(all_finite), is_finite), all_finite)
        with build.if_else(build.load(all_finite)) as (finite_branch, other_branch):
            with finite_branch:
                getattr(self, f"_write_{self.call.name}")(*self.call.sizes)
            with other_branch:
                self._write_nan()
        build.ret_void()

    # -- the calls ----------------------------------------------------------------------------------------------------

    def _write_eigh(self, n: int) -> None:
        """Write eigenvectors and eigenvalues of a Hermitian matrix of size n."""
        a, w = self._copy_input(0, n, n), self._allocate_doubles(n)
        is_complex, work_size = self.call.is_complex, 34 * n  # workspace of a blocked reduction to tridiagonal form
        arguments = [
            self._new_char_slot("V"),
            self._new_char_slot("L"),
            self._new_integer_slot(n),
            a,
            self._new_integer_slot(n),
            w,
        ]
        arguments += [self._allocate_doubles(work_size * self.parts_per_entry), self._new_integer_slot(work_size)]
        arguments += [self._allocate_doubles(3 * n)] if is_complex else []

        def write_results() -> None:
            self._copy_output(0, a, n, n)
            self._copy_output_vector(1, w, n)

        self._call_and_write_results_or_nan("zheev" if is_complex else "dsyev", arguments, write_results)

    def _write_lu(self, m: int, n: int) -> None:
        """Write the LU factors and the pivots of an m by n matrix."""
        a, n_pivots = self._copy_input(0, m, n), min(m, n)
        pivots = self._allocate_integers(n_pivots)
        routine = "zgetrf" if self.call.is_complex else "dgetrf"
        self._call_routine(
            routine,
            [
                self._new_integer_slot(m),
                self._new_integer_slot(n),
                a,
                self._new_integer_slot(m),
                pivots,
                self._allocate_integers(1),
            ],
        )
        self._copy_output(0, a, m, n)
        for i in self._loop_range(n_pivots):  # LAPACK counts from 1
            pivot_index = self.builder.sub(self.builder.load(self.builder.gep(pivots, [i])), ir.Constant(INT32, 1))
            self.builder.store(self.builder.sitofp(pivot_index, FLOAT64), self._output_entry_pointer(1, i))

    def _write_inverse(self, n: int) -> None:
        """Write the inverse of a matrix of size n."""
        is_complex = self.call.is_complex
        a = self._copy_input(0, n, n)
        rows = self._new_integer_slot(n)
        pivots = self._allocate_integers(n)
        work_size = 64 * n
        factorise_arguments = [rows, rows, a, rows, pivots]

        def invert() -> None:
            invert_arguments = [
                rows,
                a,
                rows,
                pivots,
                self._allocate_doubles(work_size * self.parts_per_entry),
                self._new_integer_slot(work_size),
            ]
            self._call_and_write_results_or_nan(
                "zgetri" if is_complex else "dgetri", invert_arguments, lambda: self._copy_output(0, a, n, n)
            )

        self._call_and_write_results_or_nan("zgetrf" if is_complex else "dgetrf", factorise_arguments, invert)

    def _write_qr(self, m: int, n: int, columns: int) -> None:
        """Write the QR factors of an m by n matrix, with the given number of columns of Q."""
        n_reflectors, width, is_complex = min(m, n), max(n, columns), self.call.is_complex
        a = self._copy_input(0, m, n, width)
        tau = self._allocate_doubles(n_reflectors * self.parts_per_entry)
        work_size = 64 * width
        work = self._allocate_doubles(work_size * self.parts_per_entry)
        rows = self._new_integer_slot(m)
        info = self._allocate_integers(1)
        factorise_arguments = [
            rows,
            self._new_integer_slot(n),
            a,
            rows,
            tau,
            work,
            self._new_integer_slot(work_size),
            info,
        ]
        self._call_routine("zgeqrf" if is_complex else "dgeqrf", factorise_arguments)
        r = self._allocate_doubles(columns * n * self.parts_per_entry)
        build = self.builder
        for j in self._loop_range(n):
            for i in self._loop_range(columns):
                source = self._matrix_entry_pointer(a, i, j, m)
                for part in range(self.parts_per_entry):
                    value = build.load(build.gep(source, [ir.Constant(INT64, part)]))
                    is_upper = build.icmp_signed("<=", i, j)
                    target = build.gep(self._matrix_entry_pointer(r, i, j, columns), [ir.Constant(INT64, part)])
                    build.store(build.select(is_upper, value, ir.Constant(FLOAT64, 0.0)), target)
        form_q_arguments = [
            rows,
            self._new_integer_slot(columns),
            self._new_integer_slot(n_reflectors),
            a,
            rows,
            tau,
            work,
            self._new_integer_slot(work_size),
            info,
        ]
        self._call_routine("zungqr" if is_complex else "dorgqr", form_q_arguments)
        self._copy_output(0, a, m, columns)
        self._copy_output(1, r, columns, n)

    def _write_svd(self, m: int, n: int, full: int) -> None:
        """Write the singular value decomposition of an m by n matrix, with square factors if ``full``."""
        n_singular, max_dim, is_complex = min(m, n), max(m, n), self.call.is_complex
        n_left, n_right = (m, n) if full else (n_singular, n_singular)
        a, s = self._copy_input(0, m, n), self._allocate_doubles(n_singular)
        u = self._allocate_doubles(m * n_left * self.parts_per_entry)
        v = self._allocate_doubles(n_right * n * self.parts_per_entry)
        work_size = 8 * max_dim * max_dim + 64 * max_dim
        arguments = [
            self._new_char_slot("A" if full else "S"),
            self._new_integer_slot(m),
            self._new_integer_slot(n),
            a,
            self._new_integer_slot(m),
            s,
        ]
        arguments += [u, self._new_integer_slot(m), v, self._new_integer_slot(n_right)]
        arguments += [self._allocate_doubles(work_size * self.parts_per_entry), self._new_integer_slot(work_size)]
        if is_complex:
            arguments.append(self._allocate_doubles(8 * max_dim * max_dim + 8 * max_dim))
        arguments.append(self._allocate_integers(8 * n_singular))

        def write_results() -> None:
            self._copy_output_vector(0, s, n_singular)
            self._copy_output(1, u, m, n_left)
            self._copy_output(2, v, n_right, n)

        self._call_and_write_results_or_nan("zgesdd" if is_complex else "dgesdd", arguments, write_results)

    # -- arrays -------------------------------------------------------------------------------------------------------

    def _lane_entry_pointer(self, base: ir.Value, i: ir.Value) -> ir.Value:
        """Return the pointer to entry i of an array with one number for each lane."""
        return self.builder.gep(base, [self.builder.mul(i, ir.Constant(INT64, self.writer.lanes))])

    def _output_entry_pointer(self, result_index: int, i: ir.Value) -> ir.Value:
        """Return the pointer to entry i of a result of the kernel."""
        start = sum(self.call.real_entry_counts(self.call.result_specs)[:result_index])
        return self._lane_entry_pointer(self.output_pointer, self.builder.add(i, ir.Constant(INT64, start)))

    def _matrix_entry_pointer(self, a: ir.Value, i: ir.Value, j: ir.Value, rows: int) -> ir.Value:
        """Return the pointer to entry (i, j) of a matrix a in LAPACK's storage, by columns."""
        build = self.builder
        offset = build.add(build.mul(j, ir.Constant(INT64, rows)), i)
        return build.gep(a, [build.mul(offset, ir.Constant(INT64, self.parts_per_entry))])

    def _copy_input(self, start: int, m: int, n: int, width: int | None = None) -> ir.Value:
        """Copy an m by n input to new LAPACK storage, with room for ``width`` columns; return its pointer."""
        build, a = self.builder, self._allocate_doubles(m * (width or n) * self.parts_per_entry)
        for i in self._loop_range(m):
            for j in self._loop_range(n):
                offset = build.add(build.mul(i, ir.Constant(INT64, n)), j)
                for part in range(self.parts_per_entry):
                    source = self._lane_entry_pointer(
                        self.input_pointer, build.add(offset, ir.Constant(INT64, start + part * m * n))
                    )
                    target = build.gep(self._matrix_entry_pointer(a, i, j, m), [ir.Constant(INT64, part)])
                    build.store(build.load(source), target)
        return a

    def _copy_output(self, result_index: int, a: ir.Value, m: int, n: int) -> None:
        """Copy an m by n matrix from LAPACK's storage to a result of the kernel."""
        build = self.builder
        for i in self._loop_range(m):
            for j in self._loop_range(n):
                offset = build.add(build.mul(i, ir.Constant(INT64, n)), j)
                for part in range(self.parts_per_entry):
                    value = build.load(build.gep(self._matrix_entry_pointer(a, i, j, m), [ir.Constant(INT64, part)]))
                    build.store(
                        value,
                        self._output_entry_pointer(result_index, build.add(offset, ir.Constant(INT64, part * m * n))),
                    )

    def _copy_output_vector(self, result_index: int, w: ir.Value, n: int) -> None:
        """Copy a vector of n doubles to a result of the kernel."""
        for i in self._loop_range(n):
            self.builder.store(self.builder.load(self.builder.gep(w, [i])), self._output_entry_pointer(result_index, i))

    def _write_nan(self) -> None:
        """Write NaN to all results of the kernel."""
        for i in self._loop_range(len(self.call.result_kinds)):
            self.builder.store(ir.Constant(FLOAT64, math.nan), self._lane_entry_pointer(self.output_pointer, i))

    # -- what LAPACK is told ------------------------------------------------------------------------------------------

    def _allocate(self, value_type: ir.Type, count: int) -> ir.Value:
        """Return the pointer to new stack memory for ``count`` values of a type."""
        with self.builder.goto_entry_block():
            return self.builder.alloca(value_type, max(count, 1))

    def _allocate_doubles(self, count: int) -> ir.Value:
        """Return the pointer to new stack memory for ``count`` doubles."""
        return self._allocate(FLOAT64, count)

    def _allocate_integers(self, count: int) -> ir.Value:
        """Return the pointer to new stack memory for ``count`` 32-bit integers."""
        return self._allocate(INT32, count)

    def _new_integer_slot(self, value: int) -> ir.Value:
        """Return the pointer to an integer in memory, as Fortran passes arguments."""
        pointer = self._allocate_integers(1)
        self.builder.store(ir.Constant(INT32, value), pointer)
        return pointer

    def _new_char_slot(self, letter: str) -> ir.Value:
        """Return the pointer to a character in memory, as Fortran passes arguments."""
        pointer = self._allocate(INT8, 1)
        self.builder.store(ir.Constant(INT8, ord(letter)), pointer)
        return pointer

    def _call_routine(self, name: str, arguments: Sequence[ir.Value]) -> None:
        """Call a LAPACK routine by name."""
        self.builder.call(
            declare_external_function(self.builder.module, name, ir.VoidType(), [a.type for a in arguments]), arguments
        )

    def _call_and_write_results_or_nan(self, name: str, arguments: Sequence[ir.Value], write_results) -> None:
        """Call a LAPACK routine, and write its results if it succeeds, otherwise NaN."""
        info = self._allocate_integers(1)
        self._call_routine(name, [*arguments, info])
        is_successful = self.builder.icmp_signed("==", self.builder.load(info), ir.Constant(INT32, 0))
        with self.builder.if_else(is_successful) as (success_branch, failure_branch):
            with success_branch:
                write_results()
            with failure_branch:
                self._write_nan()

    def _loop_range(self, count: int):
        """Write a loop whose body is that of the Python ``for``; yield its counter."""
        with self.writer.loop_range(ir.Constant(INT64, count)) as i:
            yield i


def declare_external_function(
    module: ir.Module, name: str, return_type: ir.Type, argument_types: Sequence[ir.Type]
) -> ir.Function:
    """Return the LLVM declaration of a function that is bound when the machine code is loaded."""
    name = SYMBOL_PREFIX + name
    if name in module.globals:
        return module.globals[name]
    return ir.Function(module, ir.FunctionType(return_type, list(argument_types)), name)
