"""What a user is shown runs: the Python blocks of the README and of the documentation, and the gallery's examples."""

from __future__ import annotations

import re
import runpy
from pathlib import Path

import matplotlib
import matplotlib.pyplot as plt
import pytest

import liethermo
import manifolds

ROOT = Path(__file__).resolve().parent.parent
PAGES = [*ROOT.glob("README.md"), *sorted((ROOT / "docs").glob("*.md"))]
EXAMPLES = sorted((ROOT / "examples").glob("plot_*.py"))
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


COSTLY = ("on_manifolds", "own_space", "friction_heat_work")
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
    (reference,) = (ROOT / "docs").glob("api.*")
    listed = re.findall(r"^ {3}([\w.]+)$", reference.read_text(), re.MULTILINE)
    assert sorted(set(package.__all__) - {part for name in listed for part in name.split(".")}) == []
