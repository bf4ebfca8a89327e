"""A Sphinx extension: the Python blocks of a page run when the site is built; the page shows what they print and draw.

A page and its blocks are plain Markdown. After a block the page gets the text that it printed, the value of its last
line, and its figures. A line ``<!-- picture: ... -->`` after the block says in words what a figure shows. Of each page
under ``notebook_folders`` a notebook with the same outputs is written, and linked at the end of the page.

Outputs are kept in ``_build/executed``, so a build runs those pages alone whose code, or whose library, has changed.
They run in processes of their own, while the examples of the gallery run in this one.
"""

from __future__ import annotations

import ast
import base64
import contextlib
import hashlib
import io
import json
import multiprocessing
import os
import re
import tempfile
from concurrent.futures import Future, ProcessPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from made_by import digest
from sphinx.application import Sphinx
from sphinx.environment import BuildEnvironment
from sphinx.util import logging

BLOCK = re.compile(
    r"^```python\n(?P<code>.*?)^```\n(?P<shown>\nprints\n\n```text\n.*?^```\n)?"
    r"(?:\n?<!-- picture: (?P<alt>.*?) -->\n)?",
    re.MULTILINE | re.DOTALL,
)
"""A block; an output that the page writes down itself is not shown twice."""

logger = logging.getLogger(__name__)


@dataclass
class Output:
    """What one block left behind."""

    text: str = ""
    html: str | None = None
    figures: list[bytes] = field(default_factory=list)

    def to_json(self) -> dict[str, Any]:
        return {
            "text": self.text,
            "html": self.html,
            "figures": [base64.b64encode(png).decode() for png in self.figures],
        }

    @classmethod
    def from_json(cls, kept: dict[str, Any]) -> Output:
        return cls(kept["text"], kept["html"], [base64.b64decode(png) for png in kept["figures"]])


@dataclass
class Results:
    """The outputs of the blocks of a page, and how those ended that failed."""

    outputs: list[Output]
    failures: list[str]


def run(code: str, namespace: dict[str, Any], name: str, line: int) -> Output:
    """Run one block as a notebook would: the value of its last expression is shown."""
    import matplotlib.pyplot as plt

    tree = ast.parse("\n" * line + code, name)
    last = tree.body.pop() if tree.body and isinstance(tree.body[-1], ast.Expr) else None
    printed, output = io.StringIO(), Output()
    with contextlib.redirect_stdout(printed):
        exec(compile(tree, name, "exec"), namespace)
        value = None if last is None else eval(compile(ast.Expression(last.value), name, "eval"), namespace)
    output.text = printed.getvalue()
    figures = [plt.figure(number) for number in plt.get_fignums()]
    if value is not None and not figures:
        output.html = getattr(value, "_repr_html_", lambda: None)()
        if output.html is None and hasattr(value, "_repr_latex_"):
            output.html = f'<div class="math notranslate nohighlight">\\({value._repr_latex_().strip("$")}\\)</div>'
        if output.html is None:
            output.text += f"{value!r}\n"
    for figure in figures:
        file = io.BytesIO()
        figure.savefig(file, format="png", dpi=150, bbox_inches="tight")
        output.figures.append(file.getvalue())
        plt.close(figure)
    return output


def _notebook(cells: list[dict[str, Any]]) -> str:
    kernel = {"display_name": "Python 3", "language": "python", "name": "python3"}
    return json.dumps(
        {"cells": cells, "metadata": {"kernelspec": kernel}, "nbformat": 4, "nbformat_minor": 5}, indent=1
    )


def _code_cell(identity: str, code: str, output: Output) -> dict[str, Any]:
    outputs: list[dict[str, Any]] = []
    if output.text:
        outputs.append({"output_type": "stream", "name": "stdout", "text": output.text})
    shown = [{"text/html": output.html}] if output.html else []
    shown += [{"image/png": base64.b64encode(png).decode()} for png in output.figures]
    outputs += [{"output_type": "display_data", "data": data, "metadata": {}} for data in shown]
    return {
        "cell_type": "code",
        "id": identity,
        "execution_count": None,
        "metadata": {},
        "source": code.rstrip("\n"),
        "outputs": outputs,
    }


def run_page(docname: str, text: str) -> Results:
    """Run the blocks of a page in order, in an empty folder for the files that they write and read again."""
    import matplotlib.pyplot as plt

    plt.close("all")  # figures that something else in this process left open are not the page's
    results, namespace = Results([], []), {"__name__": "__main__"}
    with tempfile.TemporaryDirectory() as place, contextlib.chdir(place):
        for block in BLOCK.finditer(text):
            try:
                line = text.count("\n", 0, block.start("code"))
                results.outputs.append(run(block["code"], namespace, f"{docname}.md", line))
            except Exception as error:
                results.outputs.append(Output())
                results.failures.append(f"{type(error).__name__}: {error}")
    return results


def key(text: str) -> str:
    """Of the code of a page, and of all that runs it."""
    code = "\0".join(block["code"] for block in BLOCK.finditer(text))
    return hashlib.sha256(f"{digest()}\0{code}".encode()).hexdigest()


class Pages:
    """The pages of one build that have code: their keys, and the results of those that run in it."""

    def __init__(self) -> None:
        self.keys: dict[str, str] = {}
        self.running: dict[str, Future[Results]] = {}
        self.pool: ProcessPoolExecutor | None = None

    def begin(self, app: Sphinx) -> None:
        """Start what has changed since its results were kept."""
        source = Path(app.srcdir)
        for page in sorted(source.rglob("*.md")):
            docname, text = str(page.relative_to(source).with_suffix("")), page.read_text()
            if _has_code(app, docname, text):
                self.keys[docname] = key(text)
                if _kept(app, docname, text) is None:
                    if self.pool is None:  # new processes, since JAX runs threads in this one
                        spawn = multiprocessing.get_context("spawn")
                        self.pool = ProcessPoolExecutor(max((os.cpu_count() or 1) - 1, 1), mp_context=spawn)
                    self.running[docname] = self.pool.submit(run_page, docname, text)

    def outdated(self, app: Sphinx, env: BuildEnvironment, *changes: Any) -> set[str]:
        """Pages that Sphinx must read again, though their files are as they were when it last finished."""
        finished = {}
        with contextlib.suppress(OSError, ValueError):
            finished = json.loads(_finished(app).read_text())
        if finished.get("digest") != digest():  # docstrings come from anywhere in the packages
            return set(env.found_docs)
        return {docname for docname, now in self.keys.items() if finished["pages"].get(docname) != now} & env.found_docs

    def insert(self, app: Sphinx, docname: str, source: list[str]) -> None:
        """Put the outputs into the text of a page."""
        if not _has_code(app, docname, source[0]):
            return
        results = _kept(app, docname, source[0])
        if results is None:
            same = docname in self.running and self.keys[docname] == key(source[0])  # not edited since
            results = self.running[docname].result() if same else run_page(docname, source[0])
            if not results.failures:
                _keep(app, docname, source[0], results)
        for failure in results.failures:
            logger.warning("a block fails: %s", failure, location=docname)
        source[0] = shown(app, docname, source[0], results.outputs)

    def end(self, app: Sphinx, error: Exception | None) -> None:
        if self.pool is not None:
            self.pool.shutdown(cancel_futures=True)
        if error is None:
            _finished(app).write_text(json.dumps({"digest": digest(), "pages": self.keys}))


def _finished(app: Sphinx) -> Path:
    return Path(app.doctreedir) / "executed.json"


def _has_code(app: Sphinx, docname: str, text: str) -> bool:
    config = app.config
    built = docname.startswith(("_build/", "generated/", "gallery/", "reference/generated/"))
    return bool(config.execute_pages and not built and docname not in config.never_executed and BLOCK.search(text))


def _file(app: Sphinx, docname: str) -> Path:
    return Path(app.srcdir) / "_build" / "executed" / f"{docname.replace('/', '-')}.json"


def _kept(app: Sphinx, docname: str, text: str) -> Results | None:
    with contextlib.suppress(OSError, ValueError, KeyError):
        found = json.loads(_file(app, docname).read_text())
        if found["key"] == key(text):
            return Results([Output.from_json(output) for output in found["outputs"]], [])
    return None


def _keep(app: Sphinx, docname: str, text: str, results: Results) -> None:
    file = _file(app, docname)
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(json.dumps({"key": key(text), "outputs": [output.to_json() for output in results.outputs]}))


def shown(app: Sphinx, docname: str, text: str, outputs: list[Output]) -> str:
    """The page with its outputs; figures and the notebook are written beside."""
    folder = Path(app.srcdir) / "generated" / "executed"
    folder.mkdir(parents=True, exist_ok=True)
    stem, page, end = docname.replace("/", "-"), [], 0
    cells: list[dict[str, Any]] = []

    def words(markdown: str) -> None:
        page.append(markdown)
        if markdown.strip():
            cells.append(
                {"cell_type": "markdown", "id": f"cell-{len(cells)}", "metadata": {}, "source": markdown.strip()}
            )

    up = "../" * docname.count("/")
    for block, output in zip(BLOCK.finditer(text), outputs, strict=True):
        words(text[end : block.start()])
        end = block.end()
        cells.append(_code_cell(f"cell-{len(cells)}", block["code"], output))
        page.append(f"```python\n{block['code']}```\n")
        if block["shown"]:
            page.append(block["shown"])
        else:
            if output.text.strip():
                page.append(f"\n```{{code-block}} text\n:class: output\n\n{output.text.rstrip()}\n```\n")
            if output.html:
                page.append(f"\n```{{raw}} html\n{output.html}\n```\n")
        if output.figures and not block["alt"]:
            logger.warning("a figure has no words: add <!-- picture: ... --> after its block", location=docname)
        for i, png in enumerate(output.figures, 1):
            file = folder / f"{stem}-{len(cells)}-{i}.png"
            file.write_bytes(png)
            page.append(f"\n![{block['alt']}]({up}generated/executed/{file.name})\n")
    words(text[end:])
    if docname.startswith(app.config.notebook_folders):
        notebook = folder / f"{stem.partition('-')[2]}.ipynb"
        notebook.write_text(_notebook(cells))
        page.append(
            f"\n---\n\n{{download}}`Download this page as a notebook <{up}generated/executed/{notebook.name}>`,"
            " with its output and pictures.\n"
        )
    return "".join(page)


def setup(app: Sphinx) -> dict[str, bool]:
    app.add_config_value("execute_pages", True, "env", (bool, int, str))
    app.add_config_value("never_executed", (), "env", (list, tuple))
    app.add_config_value("notebook_folders", (), "env", (tuple,))
    pages = Pages()
    app.connect("builder-inited", pages.begin, priority=100)  # before the gallery
    app.connect("env-get-outdated", pages.outdated)
    app.connect("source-read", pages.insert)
    app.connect("build-finished", pages.end)
    return {"parallel_read_safe": False, "parallel_write_safe": True}
