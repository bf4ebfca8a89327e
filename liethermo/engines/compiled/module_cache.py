"""Modules of generated code that numba compiles, kept on disk under the hash of their text."""

from __future__ import annotations

import contextlib
import hashlib
import importlib.util
import os
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

from ...tracing.scalarize import UnsupportedPrimitive


def cache_folder() -> Path:
    """Where compiled modules are kept: ``$LIETHERMO_CACHE``, or a folder under the user's cache directory."""
    named = os.environ.get("LIETHERMO_CACHE")
    return Path(named) if named else Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "liethermo"


def load(text: str, try_out: Callable[[ModuleType], None]) -> ModuleType:
    """The module with this text, compiled by ``try_out`` or found so on disk; from memory alone where that fails."""
    name = "liethermo_step_" + hashlib.sha256(text.encode()).hexdigest()[:24]
    _count(name)
    try:
        module = _imported(name, _written(name, text.replace("CACHE", "True")))
        try_out(module)
        return module
    except Exception:  # a folder that cannot be written, a file that was damaged: numba raises what it meets
        sys.modules.pop(name, None)
        with contextlib.suppress(OSError):
            for file in cache_folder().glob(f"**/{name}*"):
                file.unlink()
    module = ModuleType(name)
    exec(compile(text.replace("CACHE", "False"), f"<{name}>", "exec"), module.__dict__)
    try_out(module)  # an error that is not the disk's shows here
    return module


MOST_MODULES = 2_500
"""Modules that a process may have: numba never unloads one, each takes ten memory maps and more, and there are 65,530.
"""

_names: set[str] = set()


def _count(name: str) -> None:
    if name not in _names and len(_names) >= MOST_MODULES:
        raise TooManyModulesError(len(_names))
    _names.add(name)


class TooManyModulesError(UnsupportedPrimitive):
    """A process that has compiled so many different programs that no more can be loaded safely."""

    def __init__(self, count: int):
        super().__init__("", "")
        self.args = (
            f"this process holds {count} modules of machine code, which cannot be unloaded, and another might exhaust "
            "its memory maps: run systems of so many kinds in several processes, or with engine='array'",
        )


def _written(name: str, text: str) -> Path:
    """The file of a module, which appears whole or not at all, so that a killed process leaves nothing broken."""
    folder = cache_folder()
    path = folder / f"{name}.py"
    if not (path.is_file() and path.read_text() == text):
        folder.mkdir(parents=True, exist_ok=True)
        handle, temporary = tempfile.mkstemp(dir=folder, suffix=".part")
        try:
            with os.fdopen(handle, "w") as file:
                file.write(text)
            os.replace(temporary, path)
        finally:
            Path(temporary).unlink(missing_ok=True)
    return path


def _imported(name: str, path: Path) -> ModuleType:
    if name in sys.modules:
        return sys.modules[name]
    specification = importlib.util.spec_from_file_location(name, path)
    assert specification is not None
    assert specification.loader is not None
    module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
    sys.modules[name] = module
    return module
