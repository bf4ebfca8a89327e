"""Check that the pages of classes show what users call, and that summaries of public names are words."""

from __future__ import annotations

import importlib
import inspect
import pydoc
import re
import sys
from pathlib import Path

import pytest
from jinja2 import FileSystemLoader
from jinja2.sandbox import SandboxedEnvironment

import liethermo
import manifolds
from manifolds._class_members import ListedEnumType, ListedType

DOCS = Path(__file__).resolve().parent.parent / "docs"
sys.path.insert(0, str(DOCS))
api_members = importlib.import_module("api_members")
sys.path.remove(str(DOCS))

CLASSES = api_members.public_classes()
FORMULA = re.compile(r"``|:math:|\$|\W*\w*'? = ")


def _public_names():
    """Return the public classes and functions, by their full names."""
    found = dict(CLASSES)
    for package in (liethermo, manifolds):
        for module in (
            package,
            *(value for value in map(vars(package).get, package.__all__) if inspect.ismodule(value)),
        ):
            for name in module.__all__:
                if inspect.isfunction(value := getattr(module, name)):
                    found[f"{module.__name__}.{name}"] = value
    return found


def _lines_of_page(name: str) -> list[str]:
    """Return the lines of the source of a class page."""
    templates = SandboxedEnvironment(loader=FileSystemLoader(DOCS / "_templates" / "autosummary"))
    templates.filters |= {"underline": lambda text: f"{text}\n{'=' * len(text)}", "escape": str}
    module, _, objname = name.rpartition(".")
    page = templates.get_template("class.rst")
    return page.render(objname=objname, module=module, fullname=name, class_pages=api_members.pages()).splitlines()


def test_each_member_of_the_table_exists_and_is_described():
    learned_first = sorted(CLASSES.values(), key=lambda owner: not owner.__module__.startswith("liethermo.learn"))
    owners = {  # base classes replace those of liethermo.learn with equal names
        base.__qualname__: base
        for owner in learned_first
        for base in reversed(owner.__mro__)
        if base.__module__.startswith(api_members.LIBRARY)
    }
    assert set(api_members.CLASS_MEMBERS) <= set(owners)
    absent = [
        f"{name}.{member}"
        for name, members in api_members.CLASS_MEMBERS.items()
        for member in members
        if not hasattr(owners[name], member) or not api_members.is_documented(owners[name], member)
    ]
    assert absent == []


def test_a_class_has_an_entry_or_few_members():
    counts = {
        name: len(api_members.public_members(owner))
        for name, owner in CLASSES.items()
        if not api_members.has_entry(owner)
    }
    assert len(counts) > 50
    assert [name for name, count in counts.items() if count > api_members.MAX_MEMBERS_WITHOUT_ENTRY] == []


def test_the_page_of_a_lie_poisson_system_shows_what_users_call():
    shown = api_members.shown_members(liethermo.LiePoissonSystem)
    assert {"state", "vector_field", "entropy_production", "temperatures", "casimirs", "check"} <= set(shown)
    assert len(shown) <= 8
    all_members = api_members.public_members(liethermo.LiePoissonSystem)  # what it would show without the table
    assert 5 * len(shown) < len(all_members)


def test_the_template_lists_the_members_of_a_page():
    lines = _lines_of_page("liethermo.LiePoissonSystem")
    members = ", ".join(api_members.shown_members(liethermo.LiePoissonSystem))
    start = lines.index(".. autoclass:: LiePoissonSystem")
    assert lines[start - 1] == ""
    assert lines[start + 1 : start + 3] == ["   :show-inheritance:", f"   :members: {members}"]


def test_what_all_spaces_have_is_described_once():
    lines = _lines_of_page("manifolds.Product")
    assert "   :members: split, join" in lines
    assert ":meth:`~manifolds.Space.exp`, " in lines
    assert any(line.startswith("   :members: point, random") for line in _lines_of_page("manifolds.Space"))


def test_the_page_for_authors_describes_members_that_no_class_page_shows():
    directive = re.compile(r"^\.\. (?:currentmodule:: (\w+)|auto(method|property):: (\w+)\.(\w+))$", re.MULTILINE)
    described, package = [], None
    for module, kind, owner_name, member in directive.findall((DOCS / "reference" / "api_authors.md").read_text()):
        if module:
            package = {"liethermo": liethermo, "manifolds": manifolds}[module]
            continue
        owner = getattr(package, owner_name)
        value = inspect.getattr_static(owner, member)
        is_method = inspect.isfunction(value) or isinstance(value, classmethod | staticmethod)
        assert api_members.is_documented(owner, member), f"{owner_name}.{member}"
        assert is_method == (kind == "method"), f"{owner_name}.{member}"
        assert member not in api_members.shown_members(owner), f"{owner_name}.{member}"
        described.append(f"{owner_name}.{member}")
    assert len(described) == len(set(described)) > 50


def test_no_summary_begins_with_a_formula():
    things = _public_names()
    things |= {
        f"{name}.{member}": getattr(owner, member)
        for name, owner in CLASSES.items()
        for member in api_members.public_members(owner)
    }
    summaries = {name: (inspect.getdoc(thing) or "").partition("\n")[0] for name, thing in things.items()}
    assert [f"{name}: {line}" for name, line in summaries.items() if FORMULA.match(line) or not line] == []


@pytest.mark.parametrize("line", ["``x' = f(x)`` on R^n.", ":math:`x`, a state.", "x' = f(x) on R^n."])
def test_a_summary_that_begins_with_a_formula_is_found(line):
    assert FORMULA.match(line)


# -- help() -----------------------------------------------------------------------------------------------------------

TWO_SCREENS = 100
"""Largest number of lines of the help of a class."""

FIRST_CLASSES = (
    liethermo.LiePoissonSystem,
    liethermo.MetriplecticSystem,
    liethermo.EulerPoincareSystem,
    liethermo.SpinSystem,
    liethermo.QuantumSystem,
    liethermo.MetriplecticGauss,
    liethermo.MetriplecticRungeKutta,
    liethermo.Quadratic,
    liethermo.KillingDissipation,
    liethermo.DoubleBracket,
    liethermo.Solution,
    liethermo.Ensemble,
    liethermo.Propagator,
    liethermo.bodies.Tree,
    manifolds.LieAlgebra,
    manifolds.MatrixGroup,
    manifolds.Sphere,
)
"""Classes that users meet first."""


@pytest.mark.parametrize("owner", FIRST_CLASSES, ids=lambda owner: owner.__name__)
def test_help_lists_what_users_call(owner):
    text = pydoc.render_doc(owner, renderer=pydoc.plaintext)
    values = {name for name in dir(owner) if api_members.is_value(owner, name)}  # such as ``explicit = True``
    described = {*api_members.shown_members(owner), *api_members.common_members(owner)[1]}
    assert set(dir(owner)) - values <= described
    for name in dir(owner):
        assert f" {name}" in text


INTERNAL_NAME = re.compile(r"^ \|  _\w+", re.MULTILINE)
"""Name of an internal member in the text of ``help()``, such as ``__eq__`` or ``__dataclass_fields__``."""


def test_help_lists_no_internals():
    """Only named tuples and exceptions, whose type Python fixes, and small classes list their internals."""

    def is_too_long(owner):
        text = pydoc.render_doc(owner, renderer=pydoc.plaintext)
        if isinstance(owner, ListedType | ListedEnumType):
            return INTERNAL_NAME.search(text) or text.count("\n") > TWO_SCREENS
        return not issubclass(owner, tuple | Exception) and text.count("\n") > TWO_SCREENS

    assert [name for name, owner in CLASSES.items() if is_too_long(owner)] == []


def test_help_of_an_enumeration_lists_its_members():
    stabilities = dir(liethermo.Stability)
    assert set(stabilities) == set(liethermo.Stability.__members__)
    text = pydoc.render_doc(liethermo.Stability, renderer=pydoc.plaintext)
    assert text.count("\n") <= 40
    assert all(f" {stability}" in text for stability in stabilities)
    assert "capitalize" in dir(str(liethermo.Stability.STABLE))


def test_help_of_an_instance_is_complete():
    """Only the lists of classes are shortened: an instance lists all it has, and attributes are read as before."""
    method = liethermo.MetriplecticGauss(2)
    assert {"stages", "slopes", "order"} <= set(dir(method))
    assert liethermo.MetriplecticGauss.slopes is type.__getattribute__(liethermo.MetriplecticGauss, "slopes")


def test_help_of_a_class_of_a_user_lists_its_own_members():
    class Pendulum(liethermo.MetriplecticSystem):
        def length(self):
            """Return its length."""

        def _internal(self):
            """Return something."""

    assert {"length", "vector_field"} <= set(dir(Pendulum))
    assert "_internal" not in dir(Pendulum)
