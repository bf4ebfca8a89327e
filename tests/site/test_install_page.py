"""Check the pages on installation and adoption against the files they describe."""

from __future__ import annotations

import ast
import re
import tomllib
from pathlib import Path

import pytest

yaml = pytest.importorskip("yaml")

ROOT = Path(__file__).resolve().parents[2]
INSTALL = (ROOT / "docs" / "start" / "install.md").read_text()
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
PAGES = [
    *(ROOT / name for name in ("README.md", "CONTRIBUTING.md")),
    *(page for page in sorted((ROOT / "docs").rglob("*.md")) if "_build" not in page.parts),
]
MODULES = [path for package in ("liethermo", "manifolds") for path in sorted((ROOT / package).rglob("*.py"))]

COMMAND = re.compile(r"pip install ((?:-\S+ )*(?:\"[^\"]*\"|'[^']*'|[^\s`'\"),;]+))")
"""A line of installation and what it installs."""


def _requirement(name: str) -> str:
    return next(line for line in PROJECT["dependencies"] if re.match(rf"{name}\b", line))


@pytest.mark.parametrize(
    ("name", "row"),
    [
        ("jax>=0.10,<0.11", "| JAX | 0.10 |"),
        ("numpy>=2.0,<2.4", "| NumPy | 2.0 to 2.3 |"),
        ("llvmlite>=0.45,<0.52", "| llvmlite | 0.45 to 0.51 |"),
    ],
)
def test_the_page_has_the_versions_of_the_package(name, row):
    assert _requirement(re.match(r"\w+", name)[0]) == name
    assert row in INSTALL


def test_the_page_has_the_oldest_python_and_those_that_are_tested():
    oldest = PROJECT["requires-python"].removeprefix(">=")
    tested = [c.rpartition(" ")[2] for c in PROJECT["classifiers"] if re.search(r"Python :: 3\.\d+$", c)]
    assert f"| Python | {oldest} or newer; {', '.join(tested[:-1])} and {tested[-1]} are tested |" in INSTALL


def test_the_page_has_the_number_of_packages():
    packages = re.findall(r"^[\w.-]+==", (ROOT / "requirements.lock").read_text(), re.MULTILINE)
    assert f"{len(packages)} packages" in INSTALL
    assert f"{len(packages)} dependencies" in (ROOT / "docs" / "start" / "adopt.md").read_text()


def test_the_page_has_every_extra_of_users():
    extras = {
        extra for line in re.findall(r"^\| `pip install \"\.\[(\w+)\]\"`", INSTALL, re.MULTILINE) for extra in [line]
    }
    assert extras == PROJECT["optional-dependencies"].keys() - {"docs", "bench"}


def _texts():
    for page in PAGES:
        yield page, page.read_text()
    for module in MODULES:
        strings = [
            node.value
            for node in ast.walk(ast.parse(module.read_text()))
            if isinstance(node, ast.Constant) and isinstance(node.value, str)
        ]
        yield module, "\n\n".join(strings)


def _fault_of_command(target: str) -> str | None:
    """Say what is wrong with what a line installs: the package is on no index, and an extra must exist."""
    target = target.strip("\"'")
    name, _, extras = target.rstrip("]").partition("[")
    if name == "liethermo":
        return "the package is on no index"
    unknown = set(filter(None, extras.split(","))) - PROJECT["optional-dependencies"].keys()
    return (
        f"no extra {', '.join(sorted(unknown))}"
        if unknown and name in (".", "./liethermo-VERSION-py3-none-any.whl")
        else None
    )


def test_lines_of_installation_work():
    found = [(path, target) for path, text in _texts() for target in COMMAND.findall(text)]
    assert len(found) > 10
    faults = [
        f"{path.relative_to(ROOT)}: {target}: {fault}" for path, target in found if (fault := _fault_of_command(target))
    ]
    assert faults == []


@pytest.mark.parametrize("target", ["'liethermo[learn]'", "liethermo", '".[learned]"'])
def test_a_line_that_does_not_work_is_found(target):
    (found,) = COMMAND.findall(f"It needs optax: pip install {target}")
    assert _fault_of_command(found)


def test_the_citation_has_what_the_file_has(import_from_docs):
    facts = import_from_docs("facts")
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    bibtex = facts.bibtex(citation)
    one_line_each = " ".join(bibtex.split())
    assert f"version = {{{citation['version']}}}" in bibtex
    assert max(map(len, bibtex.splitlines())) <= facts.MAX_COLUMNS
    assert re.search(r"year = \{20\d\d\}", bibtex)
    for paper in citation["references"]:
        assert f"title = {{{{{paper['title']}}}}}" in one_line_each
        assert paper.get("doi", "") in bibtex
    assert bibtex.count("{") == bibtex.count("}")
    assert len(re.findall(r"^@\w+\{", bibtex, re.MULTILINE)) == 1 + len(citation["references"])
