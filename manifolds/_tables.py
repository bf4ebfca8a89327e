"""Tables of measured numbers with verdicts, as they are printed to a user."""

from __future__ import annotations

import textwrap
from abc import ABC, abstractmethod
from collections.abc import Iterable
from dataclasses import dataclass
from html import escape

VERDICT_TEXTS = {True: "ok", False: "FAILS", None: "-"}


@dataclass(frozen=True)
class TableRow:
    """What was measured, what is allowed, and the verdict (None where nothing is asked)."""

    name: str
    value: float
    allowed: float | None
    passed: bool | None
    note: str = ""


class Tabular(ABC):
    """What prints as a table, and shows as one in a notebook."""

    @abstractmethod
    def _table_content(self) -> tuple[Iterable[TableRow], tuple[str, str, str], str]:
        """The rows, their headings, and a last line."""

    def __str__(self) -> str:
        return text_table(*self._table_content())

    def _repr_html_(self) -> str:
        return html_table(*self._table_content())


PAGE_WIDTH = 80
"""Columns of a terminal, and of a page."""

NUMBER_COLUMNS_WIDTH = 30
"""Columns of what stands behind the name of a row."""


def text_table(rows: Iterable[TableRow], headings: tuple[str, str, str], last: str) -> str:
    """The rows under their headings, and a last line; names and notes that are too long go on in lines of their own."""
    rows = list(rows)
    width = min(max([len(headings[0]), *(len(row.name) for row in rows)]), PAGE_WIDTH - NUMBER_COLUMNS_WIDTH)
    lines = [f"{headings[0]:<{width}}  {headings[1]:>10}  {headings[2]:>9}"]
    for row in rows:
        *above, name = wrap_lines(row.name, width, "  ")
        allowed = " " * 9 if row.allowed is None or row.passed is None else f"{row.allowed:9.1e}"
        line = f"{name:<{width}}  {row.value:10.2e}  {allowed}  {VERDICT_TEXTS[row.passed]:<5}"
        short = f"{line} {row.note}".rstrip()
        fits = len(short) <= PAGE_WIDTH
        lines += [
            *above,
            short if fits else line.rstrip(),
            *([] if fits else wrap_lines(f"    {row.note}", PAGE_WIDTH, "    ")),
        ]
    return "\n".join([*lines, *wrap_lines(last, PAGE_WIDTH)])


def wrap_lines(text: str, width: int = PAGE_WIDTH, hang: str = "") -> list[str]:
    """Lines of at most so many columns, broken between words; a word that is longer stays whole."""
    found = [
        textwrap.wrap(line, width, subsequent_indent=hang, break_long_words=False, break_on_hyphens=False) or [""]
        for line in text.split("\n")
    ]
    return [line for lines in found for line in lines]


def html_table(rows: Iterable[TableRow], headings: tuple[str, str, str], last: str) -> str:
    """The same table for a notebook."""
    cells = [
        (
            row.name,
            f"{row.value:.2e}",
            "" if row.allowed is None or row.passed is None else f"{row.allowed:.1e}",
            VERDICT_TEXTS[row.passed],
            row.note,
        )
        for row in rows
    ]
    return html_grid([*headings, "", ""], cells, last)


def html_grid(headings: Iterable[str], rows: Iterable[Iterable[str]], last: str = "") -> str:
    """A table of texts for a notebook, with a line below it."""
    head = "".join(f"<th>{escape(text)}</th>" for text in headings)
    body = "".join("<tr>" + "".join(f"<td>{escape(text)}</td>" for text in row) + "</tr>" for row in rows)
    below = f"<p><strong>{escape(last)}</strong></p>" if last else ""
    return f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>{below}"
