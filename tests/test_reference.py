"""Check that the reference is complete: it describes every public class, function, method and argument."""

from __future__ import annotations

import functools
import inspect
import re
import sys
from pathlib import Path

import pytest

import liethermo
import manifolds

ARGUMENT_NAMES = Path(__file__).with_name("argument_names.md")


def _table_names() -> tuple[set[str], set[str]]:
    """Return the names of the arguments and of the attributes that the table describes."""
    arguments, attributes = ARGUMENT_NAMES.read_text().split("## Attributes")
    return tuple(  # type: ignore[return-value]
        {name for row in re.findall(r"^\| (`.*?) \|", section, re.MULTILINE) for name in re.findall(r"`(\w+)`", row)}
        for section in (arguments, attributes)
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
    arguments, _ = _table_names()
    untold = []
    for name, value, doc in _public(package):
        function = None if inspect.isclass(value) else _function(value)
        if function is not None:
            names = [
                parameter for parameter in inspect.signature(function).parameters if parameter not in ("self", "cls")
            ]
            absent = [n for n in names if not re.search(rf"\b{n}\b", doc) and n not in arguments]
            untold += [f"{name}: {', '.join(absent)}"] if absent else []
    assert untold == []


@pytest.mark.parametrize("package", [manifolds, liethermo], ids=lambda package: package.__name__)
def test_everything_public_is_described(package):
    """A public name has a docstring, or is described as an attribute in the table or in the docstring of its class."""
    _, attributes = _table_names()
    failures = []
    for name, value, doc in _public(package):
        needs_docstring = (
            inspect.isclass(value) or _function(value) or isinstance(value, property | functools.cached_property)
        )
        owner, _, member = name.partition(".")
        class_mention = member and re.search(rf"\b{member}\b", inspect.getdoc(getattr(package, owner)) or "")
        if needs_docstring and not doc and member not in attributes and not class_mention:
            failures.append(name)
    assert failures == []


MODULES = ("bodies", "diffrax", "learn", "magnetism", "models", "plot", "scipy", "sympy", "testing", "torques")
GEOMETRY = ("manifolds", "manifolds.sympy", "manifolds.testing")


@pytest.mark.parametrize("name", ["liethermo", *(f"liethermo.{name}" for name in MODULES), *GEOMETRY])
def test_modules_show_what_is_public_and_nothing_else(name):
    """``dir`` of a module lists its public names, and other modules only where they are public too."""
    package, _, inner = name.partition(".")
    if inner in ("diffrax", "sympy"):
        pytest.importorskip(inner)
    module = sys.modules[package] if not inner else getattr(sys.modules[package], inner)
    version = {"__version__"} if name == "liethermo" else set()
    assert set(dir(module)) == {*module.__all__, "__doc__", "__name__"} | version
    public_modules = {public_name for public_name in module.__all__ if inspect.ismodule(getattr(module, public_name))}
    assert public_modules <= (set() if inner else {*MODULES})


@pytest.mark.parametrize("name", liethermo._DEPRECATED_TYPES)
def test_a_deprecated_type_is_told_its_new_place(name):
    with pytest.warns(DeprecationWarning, match=f"liethermo.{name} will be removed") as record:
        kind = getattr(liethermo, name)
    module, _, attribute = str(record[0].message).rpartition(" ")[2].rpartition(".")
    assert kind is getattr(sys.modules[module], attribute)
    assert name not in liethermo.__all__


def test_an_argument_that_nobody_tells_is_found():
    arguments, attributes = _table_names()
    assert {"x", "system", "compensation"} <= arguments
    assert {"dim", "order"} <= attributes
    assert "colour" not in arguments | attributes


API_PAGE = Path(__file__).resolve().parent.parent / "docs" / "reference" / "api.md"
OTHER_MAIN_NAMES = (
    "Solution.audit",
    "learn.fit",
    "Fluctuations",
    "FourBracket",
    "Friction",
    "FrictionOperator",
    "LandauLifshitz",
    "SteepestEntropyAscent",
)
"""Main names that the first page of the reference does not list."""

WRITTEN_BY_THE_LIBRARY = ("Solution", "Audit")
CLASSES_WITHOUT_INIT = ("LieAlgebra",)
"""Classes that nobody calls: their docstrings describe what they hold."""

UNITLESS_PARAMETERS = frozenset(
    """
    algebra algebras also attitude axes basis batch bath build by_matrices checkpoint chunk constraints dense dim
    dissipation engine first gradient group held kind matching measure method momentum_maps most_steps moving n
    name names noise normalized number observed on_failure order outputs p parts path patience preserve progress
    project projection q reconstruction retraction save_every save_to scheme seed shape shooting space spec stages
    store substeps units validate validation window
    """.split()
)
"""Parameters that need no unit: options, names, counts, and objects that have their own units."""

UNIT = re.compile(
    r"\bunits?\b|dimensionless|without a unit|"
    r"\((?:[^()]|\([^()]*\))*\b(?:time|energy|temperature|entropy|mass|length|kg|s|K|J|rad|mu)\b(?:[^()]|\([^()]*\))*\)"
)


def _main_names():
    package = liethermo
    for line in API_PAGE.read_text().partition("## By theme")[0].splitlines():
        if line.startswith(".. currentmodule:: "):
            package = {"liethermo": liethermo, "manifolds": manifolds}[line.split()[-1]]
        elif re.fullmatch(r" {3}[A-Za-z][\w.]*", line):
            yield package, line.strip()
    yield from ((liethermo, name) for name in OTHER_MAIN_NAMES)


def _description_faults(thing, doc: str) -> list[str]:
    """Return the parameters that lack words or a unit in a docstring, each with the fault."""
    descriptions: dict[str, str] = {}
    section = re.search(r"^Parameters\n-+\n(.*?)(?=^\S[^\n]*\n---|\Z)", doc, re.MULTILINE | re.DOTALL)
    for entry in re.split(r"\n(?=\S)", section[1]) if section else []:
        head, _, words = entry.partition("\n")
        names, _, kind = head.partition(" : ")
        descriptions |= {name.strip(): words.strip() and f"{kind} {words}" for name in names.split(",")}
    problems = []
    for name, parameter in inspect.signature(thing).parameters.items():
        keywords = parameter.kind is parameter.VAR_KEYWORD and descriptions
        text = descriptions.get(name, "given by name" if keywords else "")
        if name not in ("self", "cls"):
            problems += [] if text else [f"{name}: no words"]
            problems += (
                [] if keywords or not text or name in UNITLESS_PARAMETERS or UNIT.search(text) else [f"{name}: no unit"]
            )
    return problems


@pytest.mark.parametrize(
    ("package", "name"), [pytest.param(*main_name, id=main_name[1]) for main_name in _main_names()]
)
def test_parameters_of_the_main_names_have_words_and_units(package, name):
    if name in WRITTEN_BY_THE_LIBRARY + CLASSES_WITHOUT_INIT:
        pytest.skip("nobody calls it")
    thing = functools.reduce(getattr, name.split("."), package)
    assert _description_faults(thing, inspect.getdoc(thing)) == []


def test_there_are_some_thirty_main_names():
    assert len(list(_main_names())) > 30


def test_a_parameter_without_words_or_unit_is_found():
    def turn(rate, method, x0):
        """Turned.

        Parameters
        ----------
        rate : float
            Of turning.
        method : str
        x0 : array
            The start, in units of length.
        """

    assert _description_faults(turn, inspect.getdoc(turn)) == ["rate: no unit", "method: no words"]
    assert _description_faults(turn, "Turned.") == ["rate: no words", "method: no words", "x0: no words"]
