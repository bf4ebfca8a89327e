"""What builds the site: blocks run as in a notebook, and notebooks are well formed."""

from __future__ import annotations

import importlib
import json
from pathlib import Path
from types import SimpleNamespace

import matplotlib
import pytest

DOCS = Path(__file__).resolve().parent.parent / "docs"

PAGE = """# Title

Words.

```python
x = 2
print("two")
x + 1
```

```python
import matplotlib.pyplot as plt

plt.plot([0, 1])
plt.figure()
plt.plot([1, 0])
```

<!-- picture: a line -->

The end.
"""


@pytest.fixture
def executed(monkeypatch):
    monkeypatch.syspath_prepend(str(DOCS / "_ext"))
    matplotlib.use("Agg")
    return importlib.import_module("executed")


@pytest.fixture
def made_by(monkeypatch):
    monkeypatch.syspath_prepend(str(DOCS / "_ext"))
    return importlib.import_module("made_by")


def build(executed, text, folder):
    config = SimpleNamespace(execute_pages=True, never_executed=(), notebook_folders=("tutorials/",))
    source = [text]
    executed.Pages().insert(SimpleNamespace(srcdir=folder, config=config), "tutorials/page", source)
    return source[0], folder / "generated" / "executed"


def test_a_page_shows_what_its_blocks_print_and_draw(executed, tmp_path):
    page, made = build(executed, PAGE, tmp_path)
    assert "two\n3\n" in page
    assert "![a line](../generated/executed/tutorials-page-3-1.png)" in page
    assert "picture:" not in page
    assert "{download}" in page
    assert (made / "tutorials-page-3-1.png").read_bytes().startswith(b"\x89PNG")


def test_its_notebook_has_the_same(executed, tmp_path):
    _, made = build(executed, PAGE, tmp_path)
    notebook = json.loads((made / "page.ipynb").read_text())
    assert notebook["nbformat"] == 4
    kinds = [cell["cell_type"] for cell in notebook["cells"]]
    assert kinds == ["markdown", "code", "code", "markdown"]
    first, second = notebook["cells"][1]["outputs"], notebook["cells"][2]["outputs"]
    assert first[0]["text"] == "two\n3\n"
    assert [list(output["data"]) for output in second] == [["image/png"], ["image/png"]]
    assert second[0] != second[1]


def test_a_block_that_fails_and_a_picture_without_words_are_warnings(executed, tmp_path, monkeypatch):
    told = []
    monkeypatch.setattr(executed.logger, "warning", lambda text, *more, **_: told.append(text % more))
    build(executed, "```python\n1 / 0\n```\n", tmp_path)
    build(executed, PAGE.replace("<!-- picture: a line -->", ""), tmp_path)
    assert len(told) == 2
    assert "ZeroDivisionError" in told[0]
    assert "no words" in told[1]


def test_a_page_runs_again_where_its_code_or_what_runs_it_has_changed(executed, tmp_path, monkeypatch):
    ran = []
    monkeypatch.setattr(
        executed, "run_page", lambda name, text, really=executed.run_page: ran.append(1) or really(name, text)
    )
    first, folder = build(executed, PAGE, tmp_path)
    pictures = [file.read_bytes() for file in sorted(folder.glob("*.png"))]
    assert build(executed, PAGE, tmp_path)[0] == first
    assert [file.read_bytes() for file in sorted(folder.glob("*.png"))] == pictures
    assert "Other words." in build(executed, PAGE.replace("Words.", "Other words."), tmp_path)[0]
    assert len(ran) == 1
    assert "two\n4\n" in build(executed, PAGE.replace("x = 2", "x = 3"), tmp_path)[0]
    assert len(ran) == 2
    monkeypatch.setattr(executed, "digest", lambda: "of another library")
    assert "two\n3\n" in build(executed, PAGE, tmp_path)[0]
    assert len(ran) == 3


def test_pages_are_read_again_until_a_build_with_their_results_has_finished(executed, tmp_path, monkeypatch):
    (tmp_path / "page.md").write_text(PAGE)
    config = SimpleNamespace(execute_pages=True, never_executed=(), notebook_folders=())
    app, env = SimpleNamespace(srcdir=tmp_path, doctreedir=tmp_path, config=config), SimpleNamespace()
    env.found_docs = {"page", "plain"}
    executed._keep(app, "page", PAGE, executed.run_page("page", PAGE))

    def outdated(ends):
        pages = executed.Pages()
        pages.begin(app)
        assert pages.pool is None  # all is kept
        found = pages.outdated(app, env)
        pages.end(app, None if ends else RuntimeError())
        return found

    assert outdated(ends=False) == {"page", "plain"}
    assert outdated(ends=True) == {"page", "plain"}
    assert outdated(ends=True) == set()
    monkeypatch.setattr(executed, "digest", lambda: "of another library")
    executed._keep(app, "page", PAGE, executed.run_page("page", PAGE))
    assert outdated(ends=True) == {"page", "plain"}
    changed = PAGE.replace("x = 2", "x = 3")
    (tmp_path / "page.md").write_text(changed)
    executed._keep(app, "page", changed, executed.run_page("page", changed))
    assert outdated(ends=True) == {"page"}


def test_what_fails_is_not_kept(executed, tmp_path, monkeypatch):
    told = []
    monkeypatch.setattr(executed.logger, "warning", lambda text, *more, **_: told.append(text % more))
    for _ in range(2):
        build(executed, "```python\n1 / 0\n```\n", tmp_path)
    assert len(told) == 2


def test_what_was_made_by_something_else_is_forgotten(made_by, tmp_path):
    folder, note = tmp_path / "gallery", tmp_path / "_build" / "gallery.txt"
    for maker, left in (("first", False), ("first", True), ("second", False)):
        made_by.forget_others(folder, note, maker)
        assert (folder / "index.rst").is_file() == left
        folder.mkdir(exist_ok=True)
        (folder / "index.rst").touch()


def test_the_digest_follows_the_sources(made_by, tmp_path, monkeypatch):
    monkeypatch.setattr(made_by, "ROOT", tmp_path)
    (tmp_path / "liethermo").mkdir()
    found = set()
    for text in ("x = 1", "x = 2", "x = 1"):
        (tmp_path / "liethermo" / "a.py").write_text(text)
        found.add(made_by.digest.__wrapped__())
    assert len(found) == 2
