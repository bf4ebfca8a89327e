"""What a user is shown runs: the Python blocks of the README and of the documentation, and the gallery's examples."""

from __future__ import annotations

import importlib
import re
import runpy
from pathlib import Path

import matplotlib
import matplotlib.pyplot as plt
import pytest

import liethermo
import manifolds

ROOT = Path(__file__).resolve().parent.parent
BUILT = ("_build", "gallery", "generated")
PAGES = [
    ROOT / "README.md",
    *sorted(page for page in (ROOT / "docs").rglob("*.md") if not set(BUILT) & set(page.relative_to(ROOT).parts)),
]
EXAMPLES = sorted((ROOT / "examples").rglob("plot_*.py"))
BLOCK = re.compile(r"^```python\n(.*?)^```$", re.MULTILINE | re.DOTALL)


def _name(path: Path) -> str:
    return str(path.relative_to(ROOT))


@pytest.fixture
def scratch(tmp_path, monkeypatch):
    """An empty working directory and a backend without a screen; figures are closed afterwards."""
    monkeypatch.chdir(tmp_path)
    matplotlib.use("Agg")
    yield tmp_path
    plt.close("all")


COSTLY = (
    *("on_manifolds", "own_space", "friction_heat_work", "own_algebra", "heat_friction", "learn"),
    *("studies", "own_method", "coming_from", "choose_method", "own_loop", "exact_laws", "errors"),
)
"""Pages that compile much: in the slow tier."""


def _pages():
    for page in PAGES:
        if BLOCK.search(page.read_text()):
            yield pytest.param(page, id=_name(page), marks=pytest.mark.slow if page.stem in COSTLY else ())


@pytest.mark.sampled(3)
@pytest.mark.filterwarnings("ignore::manifolds.NoPolynomialCasimirWarning")  # a page shows it
@pytest.mark.parametrize("page", list(_pages()))
def test_the_python_blocks_of_a_page_run_in_order(page, scratch):
    text, namespace = page.read_text(), {"__name__": "__main__"}
    for block in BLOCK.finditer(text):
        above = text.count("\n", 0, block.start(1))  # a traceback then names the line of the page
        exec(compile("\n" * above + block[1], str(page), "exec"), namespace)


QUICK = ("plot_relaxed_rigid_body", "plot_own_lie_algebra", "plot_damped_oscillator", "plot_discrete_herglotz")
"""Examples that compile little; the others are in the slow tier."""


def _examples():
    for path in EXAMPLES:
        yield pytest.param(path, id=_name(path), marks=() if path.stem in QUICK else pytest.mark.slow)


@pytest.mark.sampled(1)
@pytest.mark.parametrize("example", list(_examples()))
def test_an_example_runs_and_draws(example, scratch):
    runpy.run_path(str(example), run_name="__main__")
    assert plt.get_fignums(), "a gallery example shows at least one figure"


@pytest.mark.parametrize("package", [liethermo, manifolds], ids=lambda package: package.__name__)
def test_the_reference_lists_every_public_name(package):
    (reference,) = (ROOT / "docs/reference").glob("api.*")
    listed = re.findall(r"^ {3}([\w.]+)$", reference.read_text(), re.MULTILINE)
    assert sorted(set(package.__all__) - {part for name in listed for part in name.split(".")}) == []


LINK = re.compile(
    r"(?<!`)\[[^\]]*\]\(([^)\s]+)\)|\{(?:doc|download)\}`(?:[^`<]*<)?([^`>]+)>?`|^:link: (\S+)$", re.MULTILINE
)
PICTURE = re.compile(r"!\[([^\]]*)\]\(([^)\s]+)\)")
FENCE = re.compile(r"^```.*?^```$", re.MULTILINE | re.DOTALL)


def _words(page: Path) -> str:
    """A page without its code."""
    return FENCE.sub("", page.read_text())


@pytest.mark.parametrize("page", PAGES, ids=_name)
def test_links_of_a_page_lead_somewhere(page):
    targets = [a or b or c for a, b, c in LINK.findall(_words(page))]
    local = [target.partition("#")[0] for target in targets if "://" not in target and not target.startswith("#")]
    missing = [
        target
        for target in local
        if target != "../gallery/index"  # made by the build
        and not any((page.parent / f"{target}{suffix}").is_file() for suffix in ("", ".md"))
    ]
    assert missing == []


@pytest.mark.parametrize("page", PAGES, ids=_name)
def test_pictures_are_told_in_words(page):
    assert [source for words, source in PICTURE.findall(page.read_text()) if not words.strip()] == []


def test_every_page_is_in_the_navigation():
    docs = ROOT / "docs"
    listed = {"index"}
    for page in PAGES[1:]:
        for tree in re.findall(r"^```\{toctree\}\n(.*?)^```$", page.read_text(), re.MULTILINE | re.DOTALL):
            for line in tree.splitlines():
                if line and not line.startswith(":"):
                    listed.add(str((page.parent / line).resolve().relative_to(docs)))
    assert {str(page.relative_to(docs).with_suffix("")) for page in PAGES[1:]} - listed == set()
    assert {entry for entry in listed if not (docs / f"{entry}.md").is_file()} == {"gallery/index"}


def test_names_in_code_font_exist(code_links):
    """A page may call on nothing that the packages do not have."""
    unknown = []
    for page in PAGES:
        for word in re.findall(r"(?<!`)`([^`\n]+)`(?!`)", _words(page)):
            try:
                code_links.resolve(word)
            except AttributeError as error:
                unknown.append(f"{_name(page)}: {word}: {error}")
    assert unknown == []


def test_a_name_that_does_not_exist_is_found(code_links):
    assert code_links.resolve("lt.integrate(...)") == "liethermo.integrate"
    assert code_links.resolve("LieAlgebra") == "manifolds.LieAlgebra"
    assert code_links.resolve("step") is None
    with pytest.raises(AttributeError, match="integrat"):
        code_links.resolve("lt.integrat")


@pytest.fixture
def code_links(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "docs" / "_ext"))
    return importlib.import_module("code_links")
