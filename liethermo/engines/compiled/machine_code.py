"""Compilation of LLVM modules to machine code, cached on disk and unloaded when unused; functions at many points."""

from __future__ import annotations

import ctypes
import ctypes.util
import functools
import hashlib
import os
import struct
import threading
from collections.abc import Callable

import jax
import llvmlite.binding as llvm
import numpy as np
from llvmlite import ir

from ...tracing.program import Program
from ...tracing.programs import host_triple_cpu_and_features, read_machine_code, write_machine_code
from ...tracing.scalarize import UnsupportedPrimitive, report_compiler_faults, scalarize
from . import lapack
from .llvm_writer import FLOAT64, INT64, ProgramWriter


class MachineCode:
    """Machine code of an LLVM module, which is unloaded when this object is deleted.

    Parameters
    ----------
    module : ir.Module, or a function that returns one or its text
        A function is called if the code is not in the cache.
    skip_optimisation : bool
        Do not optimise the code, which takes longer than a short run. Its results are the same.
    key : str, optional
        Text that identifies the module in all processes, and finds its code in the cache; by default the module's text.

    Attributes
    ----------
    skip_optimisation : bool
        Whether the code is not optimised; code from the cache may be, even if it was not asked for.
    """

    def __init__(self, module: ir.Module | Callable, skip_optimisation: bool = False, key: str = ""):
        self._module_text = functools.cache(lambda: str(module() if callable(module) else module))
        self._key = key
        with _lock:
            for self.skip_optimisation in (False, True) if skip_optimisation else (False,):
                name = _cache_name(f"{self.skip_optimisation}\n{key or self._module_text()}")
                code = read_machine_code(name)
                object_file = _parse_object_file(code)
                if code is not None and object_file is not None:
                    break
            else:
                code = _compile_module(self._module_text(), skip_optimisation)
                write_machine_code(name, code)
                object_file = _parse_object_file(code)
            if lapack.SYMBOL_PREFIX.encode() in code:
                lapack.bind_scipy_functions_in_llvm()
            self._engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), _new_target_machine())
            self._engine.add_object_file(object_file)
            self._engine.finalize_object()

    def compile_optimised(self) -> MachineCode:
        """Return optimised machine code of the same module."""
        return MachineCode(self._module_text, key=self._key)

    def function_address(self, name: str) -> int:
        """Return the address of the function ``name``."""
        return self._engine.get_function_address(name)


_lock = threading.Lock()


def _cache_name(text: str) -> str:
    """Return the name in the cache of machine code that is identified by a text, on this machine."""
    return hashlib.sha256(f"{_host_target_cpu_features_and_text()[-1]} {text}".encode()).hexdigest()[:32]


COUNT_SUFFIX = ".count"
"""Suffix of the files with the number of operations of a program."""


def read_operation_count(key: str) -> int | None:
    """Return the number of operations that was written for a key; None if there is none."""
    content = read_machine_code(_cache_name(key), COUNT_SUFFIX)
    return int(content) if content is not None and content.isdigit() else None


def write_operation_count(key: str, count: int) -> None:
    """Write the number of operations of the program with a key to the cache."""
    write_machine_code(_cache_name(key), str(count).encode(), COUNT_SUFFIX)


@functools.cache
def _host_target_cpu_features_and_text() -> tuple[llvm.Target, str, str, str]:
    """Return the LLVM target, CPU and features of this machine, and a text that identifies them.

    ``$LIETHERMO_CPU`` selects another CPU whose instructions this machine supports, by its LLVM name, such as
    ``x86-64-v3``, which has AVX2 and no AVX-512.
    """
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    math_library = ctypes.util.find_library("m")
    if math_library:
        llvm.load_library_permanently(math_library)
    triple, cpu, features = host_triple_cpu_and_features()
    if cpu_variable := os.environ.get("LIETHERMO_CPU", ""):
        cpu, features = cpu_variable, ""
    version = ".".join(map(str, llvm.llvm_version_info))
    return llvm.Target.from_triple(triple), cpu, features, f"{triple} {cpu} {features} {version}"


def _new_target_machine(skip_optimisation: bool = False) -> llvm.TargetMachine:
    """Return a new LLVM compiler for this machine, optimising unless ``skip_optimisation``."""
    target, cpu, features, _ = _host_target_cpu_features_and_text()
    return target.create_target_machine(cpu, features, opt=0 if skip_optimisation else 3, jit=True, reloc="pic")


def _parse_object_file(code: bytes | None) -> llvm.ObjectFileRef | None:
    """Return machine code as an object file for LLVM's linker; None if it is invalid, which would crash LLVM."""
    if code is None or not (code.startswith(OBJECT_FILE_MAGICS) or _is_valid_elf(code)):
        return None
    try:
        return llvm.ObjectFileRef.from_data(code)
    except RuntimeError:
        return None


OBJECT_FILE_MAGICS = (b"\xcf\xfa\xed\xfe", b"\x64\x86", b"\x64\xaa")
"""First bytes of object files of macOS and Windows."""


def _is_valid_elf(code: bytes) -> bool:
    """Return whether code is a relocatable ELF object whose sections all lie within its bytes."""
    if len(code) < 64 or code[:5] != b"\x7fELF\x02" or struct.unpack_from("<H", code, 16) != (1,):
        return False
    (table_offset,) = struct.unpack_from("<Q", code, 40)
    header_size, n_sections, names_index = struct.unpack_from("<HHH", code, 58)
    if header_size != 64 or not 0 < names_index < n_sections or table_offset + header_size * n_sections > len(code):
        return False
    for i in range(n_sections):
        section_type, _, _, section_offset, section_size = struct.unpack_from(
            "<4xIQQQQ", code, table_offset + header_size * i
        )
        if section_type != SHT_NOBITS and section_offset + section_size > len(code):
            return False
    return True


SHT_NOBITS = 8
"""ELF section type of a section that occupies no space in its file."""


def _compile_module(text: str, skip_optimisation: bool) -> bytes:
    module, target = llvm.parse_assembly(text), _new_target_machine(skip_optimisation)
    module.verify()
    if skip_optimisation:
        return target.emit_object(module)
    options = llvm.create_pipeline_tuning_options(speed_level=3)
    options.slp_vectorization = False
    builder = llvm.create_pass_builder(target, options)
    builder.getModulePassManager().run(module, builder)
    return target.emit_object(module)


MAX_EVALUATOR_INSTRUCTIONS = 10_000
"""Largest number of instructions of a function that is compiled for a few points; LLVM takes about a second for it."""

EVALUATE_SIGNATURE = ctypes.CFUNCTYPE(None, *[ctypes.c_void_p] * 3, ctypes.c_int64)
"""C signature of ``evaluate(parameters, points, results, count)``."""


class PointEvaluator:
    """A compiled function of parameters and a point, which is evaluated at many points by one call.

    The results are written to the same array by every call, so each thread needs an evaluator of its own.

    Parameters
    ----------
    function : function of arrays of shapes (p,) and (n,) to an array of shape (k,)
        It must be one that JAX can trace.
    parameters : array, shape (p,)
        Those of the next call: a caller sets their values in place.
    points : array, shape (m, n)

    Raises
    ------
    UnsupportedPrimitive
        If the function cannot be unrolled, or is too large.
    """

    def __init__(self, function: Callable, parameters: np.ndarray, points: np.ndarray):
        points = np.array(points, dtype=np.float64)
        program = scalarize(
            jax.make_jaxpr(function)(parameters, points[0]), max_instructions=MAX_EVALUATOR_INSTRUCTIONS
        )
        if program.instruction_count > MAX_EVALUATOR_INSTRUCTIONS:
            raise UnsupportedPrimitive("a function", "", "within the size limit", too_large=True)
        with report_compiler_faults():
            self._code = _compile_evaluator(program)
        self._evaluate = EVALUATE_SIGNATURE(self._code.function_address("evaluate"))
        self._results = np.empty((len(points), len(program.outputs[0])))
        self._arrays = parameters, points, self._results
        self._arguments = *(array.ctypes.data for array in self._arrays), len(points)

    def __call__(self) -> np.ndarray:
        """Return the values at all points, shape (m, k); the next call overwrites them."""
        self._evaluate(*self._arguments)
        return self._results


class _SeparateRoundingWriter(ProgramWriter):
    """A writer of programs that rounds products before it adds them, as NumPy does."""

    def fused_multiply_add(self, op, product_index, factors, terms) -> ir.Value:
        product = self.write_operation("mul", factors)
        return self.write_operation(op, [product if i == product_index else term for i, term in enumerate(terms)])


def _compile_evaluator(program: Program) -> MachineCode:
    """Return the machine code of ``evaluate(parameters, points, results, count)``, a program at each point."""
    module = ir.Module("points")
    pointer = FLOAT64.as_pointer()
    function = ir.Function(module, ir.FunctionType(ir.VoidType(), [pointer, pointer, pointer, INT64]), "evaluate")
    parameters, points, results, count = function.args
    writer = _SeparateRoundingWriter(ir.IRBuilder(function.append_basic_block("entry")), 1)
    build, (_, point_names), (values,) = writer.builder, program.inputs, program.outputs
    with writer.loop_range(count) as i:
        starts = parameters, build.gep(points, [build.mul(i, writer.int64(len(point_names)))])
        result = build.gep(results, [build.mul(i, writer.int64(len(values)))])
        (row,) = writer.write_program_with_double_outputs(
            program, lambda array, entry: build.load(build.gep(starts[array], [writer.int64(entry)]))
        )
        for j, value in enumerate(row):
            build.store(value, build.gep(result, [writer.int64(j)]))
    build.ret_void()
    return MachineCode(module)
