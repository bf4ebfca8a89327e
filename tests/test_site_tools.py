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


def build(executed, text, folder):
    config = SimpleNamespace(execute_pages=True, never_executed=(), notebook_folders=("tutorials/",))
    source = [text]
    executed._execute(SimpleNamespace(srcdir=folder, config=config), "tutorials/page", source)
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
