"""Check the tools that build the site: blocks run as in a notebook, and notebooks are well formed."""

from __future__ import annotations

import json
from types import SimpleNamespace

import matplotlib
import pytest

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
def page_runner(import_from_docs):
    matplotlib.use("Agg")
    return import_from_docs("executed", "_ext")


@pytest.fixture
def build_note(import_from_docs):
    return import_from_docs("made_by", "_ext")


def build(page_runner, text, folder):
    config = SimpleNamespace(execute_pages=True, never_executed=(), notebook_folders=("tutorials/",))
    source = [text]
    page_runner.Pages().insert(SimpleNamespace(srcdir=folder, config=config), "tutorials/page", source)
    return source[0], folder / "generated" / "executed"


def test_a_page_shows_what_its_blocks_print_and_draw(page_runner, tmp_path):
    page, folder = build(page_runner, PAGE, tmp_path)
    assert "two\n3\n" in page
    assert "![a line](../generated/executed/tutorials-page-3-1.png)" in page
    assert "picture:" not in page
    assert "{download}" in page
    assert (folder / "tutorials-page-3-1.png").read_bytes().startswith(b"\x89PNG")


def test_figures_left_open_before_a_page_are_not_its_figures(page_runner, tmp_path):
    import matplotlib.pyplot as plt

    plt.figure()
    page, folder = build(page_runner, PAGE, tmp_path)
    assert "two\n3\n" in page
    assert len(list(folder.glob("*.png"))) == 2
    assert plt.get_fignums() == []


def test_its_notebook_has_the_same(page_runner, tmp_path):
    _, folder = build(page_runner, PAGE, tmp_path)
    notebook = json.loads((folder / "page.ipynb").read_text())
    assert notebook["nbformat"] == 4
    kinds = [cell["cell_type"] for cell in notebook["cells"]]
    assert kinds == ["markdown", "code", "code", "markdown"]
    text_outputs, picture_outputs = notebook["cells"][1]["outputs"], notebook["cells"][2]["outputs"]
    assert text_outputs[0]["text"] == "two\n3\n"
    assert [list(output["data"]) for output in picture_outputs] == [["image/png"], ["image/png"]]
    assert picture_outputs[0] != picture_outputs[1]


def test_a_block_that_fails_and_a_picture_without_words_are_warnings(page_runner, tmp_path, monkeypatch):
    warnings = []
    monkeypatch.setattr(page_runner.logger, "warning", lambda text, *arguments, **_: warnings.append(text % arguments))
    build(page_runner, "```python\n1 / 0\n```\n", tmp_path)
    build(page_runner, PAGE.replace("<!-- picture: a line -->", ""), tmp_path)
    assert len(warnings) == 2
    assert "ZeroDivisionError" in warnings[0]
    assert "no words" in warnings[1]


def test_a_page_runs_again_where_its_code_or_what_runs_it_has_changed(page_runner, tmp_path, monkeypatch):
    runs = []
    monkeypatch.setattr(
        page_runner, "run_page", lambda name, text, really=page_runner.run_page: runs.append(1) or really(name, text)
    )
    built_page, folder = build(page_runner, PAGE, tmp_path)
    pictures = [file.read_bytes() for file in sorted(folder.glob("*.png"))]
    assert build(page_runner, PAGE, tmp_path)[0] == built_page
    assert [file.read_bytes() for file in sorted(folder.glob("*.png"))] == pictures
    assert "Other words." in build(page_runner, PAGE.replace("Words.", "Other words."), tmp_path)[0]
    assert len(runs) == 1
    assert "two\n4\n" in build(page_runner, PAGE.replace("x = 2", "x = 3"), tmp_path)[0]
    assert len(runs) == 2
    monkeypatch.setattr(page_runner, "digest", lambda: "of another library")
    assert "two\n3\n" in build(page_runner, PAGE, tmp_path)[0]
    assert len(runs) == 3


def test_pages_are_read_again_until_a_build_with_their_results_has_finished(page_runner, tmp_path, monkeypatch):
    (tmp_path / "page.md").write_text(PAGE)
    config = SimpleNamespace(execute_pages=True, never_executed=(), notebook_folders=())
    app, env = SimpleNamespace(srcdir=tmp_path, doctreedir=tmp_path, config=config), SimpleNamespace()
    env.found_docs = {"page", "plain"}
    page_runner._keep(app, "page", PAGE, page_runner.run_page("page", PAGE))

    def find_outdated(build_finishes):
        pages = page_runner.Pages()
        pages.begin(app)
        assert pages.pool is None  # all is kept
        outdated_pages = pages.outdated(app, env)
        pages.end(app, None if build_finishes else RuntimeError())
        return outdated_pages

    assert find_outdated(build_finishes=False) == {"page", "plain"}
    assert find_outdated(build_finishes=True) == {"page", "plain"}
    assert find_outdated(build_finishes=True) == set()
    monkeypatch.setattr(page_runner, "digest", lambda: "of another library")
    page_runner._keep(app, "page", PAGE, page_runner.run_page("page", PAGE))
    assert find_outdated(build_finishes=True) == {"page", "plain"}
    changed_page = PAGE.replace("x = 2", "x = 3")
    (tmp_path / "page.md").write_text(changed_page)
    page_runner._keep(app, "page", changed_page, page_runner.run_page("page", changed_page))
    assert find_outdated(build_finishes=True) == {"page"}


def test_what_fails_is_not_kept(page_runner, tmp_path, monkeypatch):
    warnings = []
    monkeypatch.setattr(page_runner.logger, "warning", lambda text, *arguments, **_: warnings.append(text % arguments))
    for _ in range(2):
        build(page_runner, "```python\n1 / 0\n```\n", tmp_path)
    assert len(warnings) == 2


def test_what_was_made_by_something_else_is_forgotten(build_note, tmp_path):
    folder, note = tmp_path / "gallery", tmp_path / "_build" / "gallery.txt"
    for maker, file_exists in (("first", False), ("first", True), ("second", False)):
        build_note.forget_others(folder, note, maker)
        assert (folder / "index.rst").is_file() == file_exists
        folder.mkdir(exist_ok=True)
        (folder / "index.rst").touch()


def test_the_digest_follows_the_sources(build_note, tmp_path, monkeypatch):
    monkeypatch.setattr(build_note, "ROOT", tmp_path)
    (tmp_path / "liethermo").mkdir()
    digests = set()
    for text in ("x = 1", "x = 2", "x = 1"):
        (tmp_path / "liethermo" / "a.py").write_text(text)
        digests.add(build_note.digest.__wrapped__())
    assert len(digests) == 2
