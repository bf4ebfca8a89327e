"""Import of the functions that a spec file may name, from a module beside it or one that the user allows.

A spec file may come from a stranger. It must not run a function of the standard library or of an installed package,
such as ``os:system`` with a command as its parameter. Its author has to put code beside it, where the user can see it.
"""

from __future__ import annotations

import contextlib
import importlib
import importlib.util
import inspect
import re
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

from ..errors import InputError
from .schema import did_you_mean_text


def import_function(
    target: str, folder: Path, allowed_modules: Sequence[str] = (), report: Callable[[str], object] | None = None
) -> Callable[..., Any]:
    """Import and return the function that ``module:function`` names.

    Parameters
    ----------
    folder : Path
        Folder of the spec file.
    allowed_modules : sequence of str
        Names of modules that may be outside of the folder.
    report : function, optional
        Called with a text that names the file or module before it is imported.

    Raises
    ------
    InputError
        If there is no such module or function, or it must not be named.
    """
    if not re.fullmatch(r"[^\W\d]\w*(\.[^\W\d]\w*)*:[^\W\d]\w*", target, re.ASCII):
        raise InputError('must be "module:function", such as "mysystem:build" for the function build in mysystem.py')
    name, function = target.split(":")
    module_path = folder.joinpath(*name.split("."))
    file = next(
        (path for path in (module_path.with_suffix(".py"), module_path / "__init__.py") if path.is_file()), None
    )
    if file is None and name not in allowed_modules:
        raise InputError(
            f"there is no {name.replace('.', '/')}.py beside the spec file, and what is elsewhere is imported only if "
            f"you allow it by name: --allow {name}"
        )
    if report is not None:
        report(f"imports {name}{'' if file is None else f' from {file}'}")
    try:
        module = _import_by_name(name, folder) if file is None else _load_from_file(name, file, folder)
    except InputError:
        raise
    except Exception as error:
        raise InputError(f"importing {name!r} failed with {type(error).__name__}: {error}") from error
    defined_names = [key for key, value in vars(module).items() if _is_defined_in(value, module)]
    if function not in defined_names:
        explanation = "is only imported there" if hasattr(module, function) else "is not there"
        raise InputError(
            f"{name} defines no function {function!r}: it {explanation}{did_you_mean_text(function, defined_names)}"
        )
    return getattr(module, function)


def _is_defined_in(value: Any, module: ModuleType) -> bool:
    """Return True if a value is a function or class that the module defines itself."""
    return (inspect.isfunction(value) or inspect.isclass(value)) and value.__module__ == module.__name__


def _import_by_name(module_name: str, folder: Path) -> ModuleType:
    """Import a module by name, from the working directory or the folder of the spec file if it is not installed."""
    with _temporary_import_path(Path.cwd(), folder):
        return importlib.import_module(module_name)


def _load_from_file(module_name: str, file: Path, folder: Path) -> ModuleType:
    """Load a module from its file, unless it has been loaded already; raise InputError if another module has its
    name."""
    loaded_module = sys.modules.get(module_name)
    if loaded_module is not None and getattr(loaded_module, "__file__", None) == str(file):
        return loaded_module
    if module_name not in _spec_module_names and (
        loaded_module is not None or _is_module_elsewhere(module_name.partition(".")[0], folder)
    ):
        raise InputError(f"there is another module {module_name!r}. Call {file.name} something else")
    spec = importlib.util.spec_from_file_location(module_name, file)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[module_name] = module
    try:
        with _temporary_import_path(folder):
            spec.loader.exec_module(module)
    except BaseException:
        del sys.modules[module_name]
        raise
    _spec_module_names.add(module_name)
    return module


def _is_module_elsewhere(module_name: str, folder: Path) -> bool:
    """Return True if a module can be imported from outside the folder of the spec file."""
    original_path = list(sys.path)
    sys.path[:] = [path for path in original_path if Path(path or ".").resolve() not in (folder, Path.cwd())]
    try:
        module_spec = importlib.util.find_spec(module_name)
    except ValueError:  # a loaded module without a specification
        return True
    finally:
        sys.path[:] = original_path
    return module_spec is not None and not (
        module_spec.origin and Path(module_spec.origin).resolve().is_relative_to(folder)
    )


@contextlib.contextmanager
def pickle_spec_modules_by_value(folder: Path) -> Iterator[None]:
    """Make cloudpickle pickle the modules beside the spec file by value, as cluster workers cannot import them."""
    import cloudpickle

    local_modules = [
        m for name, m in list(sys.modules.items()) if name in _spec_module_names or _module_folder(m) == folder
    ]
    for module in local_modules:
        cloudpickle.register_pickle_by_value(module)
    try:
        yield
    finally:
        for module in local_modules:
            cloudpickle.unregister_pickle_by_value(module)


def _module_folder(module: ModuleType) -> Path | None:
    file = getattr(module, "__file__", None)
    return Path(file).parent if file else None


_spec_module_names: set[str] = set()
"""Names of the modules that were loaded from files beside a spec file."""


@contextlib.contextmanager
def _temporary_import_path(*folders: Path) -> Iterator[None]:
    """Append folders to ``sys.path`` for the duration of a block; installed modules keep precedence."""
    original_path = list(sys.path)
    sys.path += [str(folder) for folder in folders if str(folder) not in sys.path]
    importlib.invalidate_caches()
    try:
        yield
    finally:
        sys.path[:] = original_path
