"""A Sphinx extension: the Python blocks of a page run when the site is built; the page shows what they print and draw.

A page and its blocks are plain Markdown. After a block the page gets the text that it printed, the value of its last
line, and its figures. A line ``<!-- picture: ... -->`` after the block says in words what a figure shows. Of each page
under ``notebook_folders`` a notebook with the same outputs is written, and linked at the end of the page.
"""

from __future__ import annotations

import ast
import base64
import contextlib
import io
import json
import re
import tempfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from sphinx.application import Sphinx
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


def _execute(app: Sphinx, docname: str, source: list[str]) -> None:
    if not app.config.execute_pages or not BLOCK.search(source[0]) or docname in app.config.never_executed:
        return
    text, namespace = source[0], {"__name__": "__main__"}
    folder = Path(app.srcdir) / "generated" / "executed"
    folder.mkdir(parents=True, exist_ok=True)
    stem, page, cells, end = docname.replace("/", "-"), [], [], 0

    def words(markdown: str) -> None:
        page.append(markdown)
        if markdown.strip():
            cells.append(
                {"cell_type": "markdown", "id": f"cell-{len(cells)}", "metadata": {}, "source": markdown.strip()}
            )

    up = "../" * docname.count("/")
    place = tempfile.TemporaryDirectory()  # of the files that the blocks of this page write and read again
    for block in BLOCK.finditer(text):
        words(text[end : block.start()])
        end = block.end()
        try:
            with contextlib.chdir(place.name):
                output = run(block["code"], namespace, f"{docname}.md", text.count("\n", 0, block.start("code")))
        except Exception as error:
            logger.warning("a block fails: %s: %s", type(error).__name__, error, location=docname)
            output = Output()
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
    place.cleanup()
    words(text[end:])
    if docname.startswith(app.config.notebook_folders):
        notebook = folder / f"{stem.partition('-')[2]}.ipynb"
        notebook.write_text(_notebook(cells))
        page.append(
            f"\n---\n\n{{download}}`Download this page as a notebook <{up}generated/executed/{notebook.name}>`,"
            " with its output and pictures.\n"
        )
    source[0] = "".join(page)


def setup(app: Sphinx) -> dict[str, bool]:
    app.add_config_value("execute_pages", True, "env", (bool, int, str))
    app.add_config_value("never_executed", (), "env", (list, tuple))
    app.add_config_value("notebook_folders", (), "env", (tuple,))
    app.connect("source-read", _execute)
    return {"parallel_read_safe": False, "parallel_write_safe": True}
