"""The functions that a spec file may name: those defined in a module beside it, or in one that its user allows.

A spec file comes from anywhere. It cannot make a function of the standard library or of an installed package run, such
as ``os:system`` with a command as its parameter: who writes one has to put code beside it, where its user can see it.
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
from .messages import suggest_match


def import_function(
    target: str, folder: Path, allow: Sequence[str] = (), tell: Callable[[str], object] | None = None
) -> Callable[..., Any]:
    """The function that ``module:function`` names.

    Parameters
    ----------
    folder : Path
        That of the spec file.
    allow : sequence of str
        Names of modules that may be found elsewhere.
    tell : function, optional
        Told what will be imported, before it is.

    Raises
    ------
    InputError
        If there is no such module or function, or it is not one that may be named.
    """
    if not re.fullmatch(r"[^\W\d]\w*(\.[^\W\d]\w*)*:[^\W\d]\w*", target, re.ASCII):
        raise InputError('must be "module:function", such as "mysystem:build" for the function build in mysystem.py')
    name, function = target.split(":")
    beside = folder.joinpath(*name.split("."))
    file = next((path for path in (beside.with_suffix(".py"), beside / "__init__.py") if path.is_file()), None)
    if file is None and name not in allow:
        raise InputError(
            f"there is no {name.replace('.', '/')}.py beside the spec file, and what is elsewhere is imported only if "
            f"you allow it by name: --allow {name}"
        )
    if tell is not None:
        tell(f"imports {name}{'' if file is None else f' from {file}'}")
    try:
        module = _import_installed(name, folder) if file is None else _load_from_file(name, file, folder)
    except InputError:
        raise
    except Exception as error:
        raise InputError(f"importing {name!r} failed with {type(error).__name__}: {error}") from error
    own = [key for key, value in vars(module).items() if _is_defined_in(value, module)]
    if function not in own:
        where = "is only imported there" if hasattr(module, function) else "is not there"
        raise InputError(f"{name} defines no function {function!r}: it {where}{suggest_match(function, own)}")
    return getattr(module, function)


def _is_defined_in(value: Any, module: ModuleType) -> bool:
    """Whether a module defines a function, and has it not from elsewhere."""
    return (inspect.isfunction(value) or inspect.isclass(value)) and value.__module__ == module.__name__


def _import_installed(name: str, folder: Path) -> ModuleType:
    with _extended_import_path(Path.cwd(), folder):
        return importlib.import_module(name)


def _load_from_file(name: str, file: Path, folder: Path) -> ModuleType:
    """The module in a file; it is the one of this name."""
    known = sys.modules.get(name)
    if known is not None and getattr(known, "__file__", None) == str(file):
        return known
    if name not in _spec_module_names and (known is not None or _is_installed(name.partition(".")[0], folder)):
        raise InputError(f"there is another module {name!r}: call {file.name} something else")
    spec = importlib.util.spec_from_file_location(name, file)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    try:
        with _extended_import_path(folder):
            spec.loader.exec_module(module)
    except BaseException:
        del sys.modules[name]
        raise
    _spec_module_names.add(name)
    return module


def _is_installed(name: str, folder: Path) -> bool:
    """Whether there is a module of this name elsewhere: one beside the spec would be taken for it from then on."""
    before = list(sys.path)
    sys.path[:] = [path for path in before if Path(path or ".").resolve() not in (folder, Path.cwd())]
    try:
        found = importlib.util.find_spec(name)
    except ValueError:  # of a module without a specification
        return True
    finally:
        sys.path[:] = before
    return found is not None and not (found.origin and Path(found.origin).resolve().is_relative_to(folder))


@contextlib.contextmanager
def pickle_by_value(folder: Path) -> Iterator[None]:
    """What is defined beside a spec is sent to the workers of a cluster as it is: they cannot import it."""
    import cloudpickle

    own = [m for name, m in list(sys.modules.items()) if name in _spec_module_names or _module_folder(m) == folder]
    for module in own:
        cloudpickle.register_pickle_by_value(module)
    try:
        yield
    finally:
        for module in own:
            cloudpickle.unregister_pickle_by_value(module)


def _module_folder(module: ModuleType) -> Path | None:
    file = getattr(module, "__file__", None)
    return Path(file).parent if file else None


_spec_module_names: set[str] = set()
"""Names of the modules that were beside spec files."""


@contextlib.contextmanager
def _extended_import_path(*folders: Path) -> Iterator[None]:
    """For the time of an import, and behind all that is installed: a file beside a spec shadows nothing."""
    before = list(sys.path)
    sys.path += [str(folder) for folder in folders if str(folder) not in sys.path]
    importlib.invalidate_caches()
    try:
        yield
    finally:
        sys.path[:] = before
