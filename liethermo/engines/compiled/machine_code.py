"""Modules of LLVM instructions as machine code: kept on disk, unloaded when unused."""

from __future__ import annotations

import contextlib
import ctypes.util
import functools
import hashlib
import os
import tempfile
import threading
from pathlib import Path

import llvmlite.binding as llvm
from llvmlite import ir


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
    """This machine, and what tells its machine code, and the compiler's version, from others.

    ``$LIETHERMO_CPU`` names another processor whose instructions to use, one that this machine can stand in for: as
    LLVM names them, such as ``x86-64-v3``, which has AVX2 and no AVX-512.
    """
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    library = ctypes.util.find_library("m")
    if library:
        llvm.load_library_permanently(library)
    triple, named = llvm.get_process_triple(), os.environ.get("LIETHERMO_CPU", "")
    cpu = named or llvm.get_host_cpu_name()
    features = "" if named else llvm.get_host_cpu_features().flatten()
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
