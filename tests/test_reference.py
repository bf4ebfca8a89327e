"""The reference is complete: every public class, function, method and argument is told on the site."""

from __future__ import annotations

import functools
import inspect
import re
from pathlib import Path

import pytest

import liethermo
import manifolds

TABLE = Path(__file__).resolve().parent.parent / "docs" / "reference" / "arguments.md"


def _told() -> tuple[set[str], set[str]]:
    """The arguments and the attributes that the table tells."""
    arguments, attributes = TABLE.read_text().split("## Attributes")
    return tuple(  # type: ignore[return-value]
        {name for row in re.findall(r"^\| (`.*?) \|", part, re.MULTILINE) for name in re.findall(r"`(\w+)`", row)}
        for part in (arguments, attributes)
    )


def _public(package):
    for name in package.__all__:
        thing = getattr(package, name)
        if inspect.isclass(thing):
            yield name, thing, inspect.getdoc(thing) or ""
            for member, value in vars(thing).items():
                if not member.startswith("_"):
                    yield f"{name}.{member}", value, inspect.getdoc(getattr(thing, member)) or ""
        elif inspect.isfunction(thing):
            yield name, thing, inspect.getdoc(thing) or ""


def _function(value):
    if isinstance(value, classmethod | staticmethod):
        value = value.__func__
    value = inspect.unwrap(value) if callable(value) else value
    return value if inspect.isfunction(value) else None


@pytest.mark.parametrize("package", [manifolds, liethermo], ids=lambda package: package.__name__)
def test_every_argument_is_told(package):
    arguments, _ = _told()
    untold = []
    for name, value, doc in _public(package):
        function = None if inspect.isclass(value) else _function(value)
        if function is not None:
            names = [
                parameter for parameter in inspect.signature(function).parameters if parameter not in ("self", "cls")
            ]
            missing = [n for n in names if not re.search(rf"\b{n}\b", doc) and n not in arguments]
            untold += [f"{name}: {', '.join(missing)}"] if missing else []
    assert untold == []


@pytest.mark.parametrize("package", [manifolds, liethermo], ids=lambda package: package.__name__)
def test_everything_public_is_described(package):
    """By a docstring of its own, or as an attribute by the table or the docstring of its class."""
    _, attributes = _told()
    silent = []
    for name, value, doc in _public(package):
        described = (
            inspect.isclass(value) or _function(value) or isinstance(value, property | functools.cached_property)
        )
        owner, _, member = name.partition(".")
        by_class = member and re.search(rf"\b{member}\b", inspect.getdoc(getattr(package, owner)) or "")
        if described and not doc and member not in attributes and not by_class:
            silent.append(name)
    assert silent == []


def test_an_argument_that_nobody_tells_is_found():
    arguments, attributes = _told()
    assert {"x", "system", "compensation"} <= arguments
    assert {"dim", "order"} <= attributes
    assert "colour" not in arguments | attributes
