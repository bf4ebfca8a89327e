"""Check the page of renamed names against the code: every new name exists, and no old one is left where it was."""

from __future__ import annotations

import ast
import csv
import functools
import importlib.util
import re
import tokenize
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
FOLDERS = ("liethermo", "manifolds", "benchmarks", "tests")
PAGE = ROOT / "docs" / "reference" / "renames.md"
ROWS = list(csv.DictReader((ROOT / "docs" / "reference" / "renamed_in_0.3.csv").read_text().splitlines()))


@functools.cache
def _names() -> frozenset[str]:
    """Return the names in the code, and the strings that are names, such as keys and fields."""
    names: set[str] = set()
    for path in (file for folder in FOLDERS for file in (ROOT / folder).rglob("*.py")):
        with tokenize.open(path) as file:
            for token in tokenize.generate_tokens(file.readline):
                if token.type in (tokenize.NAME, tokenize.STRING):
                    names.add(token.string.strip("'\""))
    return frozenset(names)


@functools.cache
def _modules() -> frozenset[str]:
    """Return the names of the modules, which a new name may begin with."""
    return frozenset(path.stem for folder in FOLDERS for path in (ROOT / folder).rglob("*.py"))


def _top_level_names(module: str) -> set[str]:
    """Return the names that a module defines, without those that it imports; none if there is no such module."""
    path = ROOT / f"{module.replace('.', '/')}.py"
    if not path.is_file():
        return set()
    names = set()
    for node in ast.parse(path.read_text()).body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            names.add(node.name)
        elif isinstance(node, ast.Assign):
            names |= {target.id for target in node.targets if isinstance(target, ast.Name)}
    return names


def _faults(rows: list[dict[str, str]]) -> Iterator[str]:
    """Yield the rows whose new name does not exist, or whose old name still does at the top of its module."""
    new_names = {(row["module"], row["new name"]) for row in rows}
    for row in rows:
        module, old, new = row["module"], row["old name"], row["new name"]
        if not {*new.split(".")} <= _names() | _modules():
            yield f"{module} {row['scope']}: {old} -> {new}: no such name; correct the line, or delete it"
        elif module == "*" and old in _names():
            yield f"{old} -> {new}: the old name is still in the code"
        elif not row["scope"] and (module, old) not in new_names and old in _top_level_names(module):
            yield f"{module}: {old} -> {new}: the module still has the old name"


def test_the_list_of_renamed_names_is_that_of_the_code():
    assert len(ROWS) > 3500
    assert list(_faults(ROWS)) == []


def test_a_line_that_is_not_true_is_found():
    row = {"module": "liethermo.errors", "scope": "", "old name": "Wrong", "new name": "InputError"}
    assert list(_faults([row])) == []
    (fault,) = _faults([{**row, "new name": "_no_such" + "_name"}])
    assert "no such name" in fault
    (fault,) = _faults([{**row, "old name": "ConvergenceError"}])
    assert "still has the old name" in fault
    (fault,) = _faults([{**row, "module": "*", "scope": "*", "old name": "ConvergenceError"}])
    assert "still in the code" in fault


def test_the_renamed_modules_exist_and_their_old_names_do_not():
    table = re.search(r"```text\n(.*?)```", PAGE.read_text(), re.DOTALL)[1].splitlines()[1:]
    assert len(table) > 5
    for line in table:
        old_cell, new_cell = re.split(r"\s{2,}", line.strip())
        package = old_cell.split(",")[0].rpartition(".")[0]
        for cell, exists in ((old_cell, False), (new_cell, True)):
            names = [name if "." in name else f"{package}.{name}" for name in re.split(r", ", cell)]
            assert {name: importlib.util.find_spec(name) is not None for name in names} == dict.fromkeys(names, exists)
