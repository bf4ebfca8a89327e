"""Check that the examples in the docstrings of the main names run, and print the output they show."""

import doctest
import inspect
import operator
import re
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import liethermo as lt
import manifolds as mf

ROOT = Path(__file__).resolve().parent.parent
LISTED_NAME = re.compile(r"currentmodule:: (\w+)|^ {3}([\w.]+)$", re.MULTILINE)


def _main_names():
    """Yield the names that the first page of the reference lists, each with its package."""
    package = lt
    for module, name in LISTED_NAME.findall((ROOT / "docs/reference/api.md").read_text()):
        if module:
            package = {"liethermo": lt, "manifolds": mf}[module]
        else:
            yield package, name


MAIN = list(_main_names())


def test_there_are_thirty_main_names():
    assert len(MAIN) >= 30


@pytest.mark.sampled(4)
@pytest.mark.parametrize(("package", "name"), MAIN, ids=[name for _, name in MAIN])
def test_the_example_of_a_main_name_is_true(package, name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert _run_doctest(inspect.getdoc(operator.attrgetter(name)(package)) or "", name) > 0, "no example"


NAMES_WITH_EXAMPLE = [
    (package, name)
    for package in (lt, mf, lt.bodies, lt.learn, lt.magnetism, lt.models, lt.torques)
    for name in package.__all__
    if (package, name) not in MAIN
    and callable(thing := getattr(package, name))
    and "\n>>> " in (inspect.getdoc(thing) or "")
]
"""Public names that have an example, besides the main ones."""


@pytest.mark.sampled(4)
@pytest.mark.parametrize(("package", "name"), NAMES_WITH_EXAMPLE, ids=[name for _, name in NAMES_WITH_EXAMPLE])
def test_the_example_of_another_public_name_is_true(package, name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert _run_doctest(inspect.getdoc(getattr(package, name)), name) > 0


def test_every_main_name_has_an_example():
    docstrings = {name: inspect.getdoc(operator.attrgetter(name)(package)) or "" for package, name in MAIN}
    assert [name for name, docstring in docstrings.items() if "\n>>> " not in docstring] == []


def test_an_example_that_is_wrong_is_found():
    assert _run_doctest(">>> mf.so(3).dim\n3\n", "right") == 1
    with pytest.raises(doctest.DocTestFailure):
        _run_doctest(">>> mf.so(3).dim\n4\n", "wrong")


def _run_doctest(text: str, name: str) -> int:
    """Run the examples of a docstring and return the number of lines that were run."""
    names = {"lt": lt, "mf": mf, "np": np, "jnp": jnp, "jax": jax}
    test = doctest.DocTestParser().get_doctest(text, names, name, None, None)
    runner = doctest.DebugRunner(optionflags=doctest.NORMALIZE_WHITESPACE | doctest.ELLIPSIS)
    return runner.run(test).attempted


@pytest.mark.parametrize("package", [lt, mf], ids=lambda package: package.__name__)
def test_what_a_package_lists_is_public(package):
    assert set(package.__all__) <= set(dir(package))
    assert not {"annotations", "importlib"} & set(dir(package))
    assert len(dir(package)) <= len(package.__all__) + 3
