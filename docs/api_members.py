"""What the reference shows of each class: the members that users call.

The page of a class shows the members that :data:`manifolds._class_members.CLASS_MEMBERS` names for it and for its base
classes, its own first; ``help()`` lists the same ones. A class that has no entry, and no base class with one, shows
every documented public member: such a class has few. What all spaces, algebras or structures have is described once, on
the page of their base class, to which the others link. The page ``api_authors`` describes what authors of methods,
dissipations and kinds of systems override.
"""

from __future__ import annotations

import functools
import inspect
from types import ModuleType
from typing import Any

import liethermo
import manifolds
from manifolds._class_members import CLASS_MEMBERS

LIBRARY = ("liethermo", "manifolds")
MAX_MEMBERS_WITHOUT_ENTRY = 12
"""Members that the page of a class without an entry may show; a class with more needs an entry."""

NAMED_TUPLE_FIELD = "Alias for field number"
"""What Python documents the fields of named tuples with; the docstring of the class describes them."""


def is_value(owner: type, name: str) -> bool:
    """Return True for an attribute that is a mere value, of which autodoc would print the documentation of its type."""
    value = inspect.getattr_static(owner, name)
    described = callable(value) or isinstance(value, (property, classmethod, staticmethod)) or hasattr(value, "__get__")
    return not described


def is_documented(owner: type, name: str) -> bool:
    """Return True if the member is a function or a property with a docstring of its own or of a base class."""
    doc = "" if is_value(owner, name) else inspect.getdoc(getattr(owner, name)) or ""
    return bool(doc) and not doc.startswith(NAMED_TUPLE_FIELD)


def public_members(owner: type) -> list[str]:
    """Return the documented public members that the library itself defines, in the order of the source."""
    names = [
        name
        for base in owner.__mro__
        if base.__module__.partition(".")[0] in LIBRARY
        for name in vars(base)
        if not name.startswith("_")
    ]
    return [name for name in dict.fromkeys(names) if is_documented(owner, name)]


def shown_members(owner: type) -> list[str]:
    """Return the members that the page of a class describes, its own first."""
    if not has_entry(owner):
        return public_members(owner)
    common = _common_base(owner)
    elsewhere = common.__mro__ if common else ()
    return _entry_members(owner, [base for base in owner.__mro__ if base not in elsewhere])


def common_members(owner: type) -> tuple[str, list[str]]:
    """Return the full name of the base class that describes the other members, and their names; "" without one."""
    common = _common_base(owner)
    if common is None:
        return "", []
    own = shown_members(owner)
    return f"manifolds.{common.__name__}", [name for name in shown_members(common) if name not in own]


def has_entry(owner: type) -> bool:
    """Return True if the class, or one of its base classes, has an entry."""
    return any(_has_entry(base) for base in owner.__mro__)


def _has_entry(base: type) -> bool:
    return base.__module__.partition(".")[0] in LIBRARY and base.__qualname__ in CLASS_MEMBERS


def _entry_members(owner: type, bases: list[type]) -> list[str]:
    entries = [CLASS_MEMBERS[base.__qualname__] for base in bases if _has_entry(base)]
    names = dict.fromkeys(name for entry in entries for name in entry)
    return [name for name in names if is_documented(owner, name)]


def _common_base(owner: type) -> type | None:
    """Return the base class of the geometry whose page describes what all of its kind have; None without one."""
    bases = (manifolds.LieAlgebra, manifolds.Space, manifolds.PoissonStructure, manifolds.ContactStructure)
    return next((base for base in bases if issubclass(owner, base) and owner is not base), None)


@functools.cache
def public_classes() -> dict[str, type]:
    """Return the public classes of both packages, and of their public modules, by their full names."""
    found: dict[str, type] = {}

    def collect(prefix: str, module: ModuleType, names: tuple[str, ...]) -> None:
        for name in names:
            value: Any = getattr(module, name)
            if inspect.isclass(value):
                found[f"{prefix}.{name}"] = value
            elif inspect.ismodule(value):
                collect(f"{prefix}.{name}", value, tuple(value.__all__))

    for package in (liethermo, manifolds):
        collect(package.__name__, package, tuple(package.__all__))
    return found


def pages() -> dict[str, dict[str, Any]]:
    """Return what the template of class pages needs, by the full name of the class."""
    result: dict[str, dict[str, Any]] = {}
    for name, owner in public_classes().items():
        base, common = common_members(owner)
        result[name] = {"shown": shown_members(owner), "base": base, "common": common}
    return result
