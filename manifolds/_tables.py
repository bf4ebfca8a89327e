"""Tables of measured values with their limits and verdicts, as text and as HTML."""

from __future__ import annotations

import textwrap
from abc import abstractmethod
from collections.abc import Iterable
from dataclasses import dataclass
from html import escape

from ._class_members import ListedABCMeta

VERDICT_TEXTS = {True: "ok", False: "FAILS", None: "-"}
"""Text of each verdict; None means that the value has no limit."""


@dataclass(frozen=True)
class TableRow:
    """Row of a table: a measured value, its limit, and the verdict (None if the value is not judged)."""

    name: str
    value: float
    allowed: float | None
    passed: bool | None
    note: str = ""


class Tabular(metaclass=ListedABCMeta):
    """Base class of objects that print as a table of text, and show as an HTML table in a notebook."""

    @abstractmethod
    def _table_content(self) -> tuple[Iterable[TableRow], tuple[str, str, str], str]:
        """Return the rows, the three headings, and the footer."""

    def __str__(self) -> str:
        return text_table(*self._table_content())

    def _repr_html_(self) -> str:
        return html_table(*self._table_content())


PAGE_WIDTH = 80
"""Columns of a terminal, which tables do not exceed."""

NUMBER_COLUMNS_WIDTH = 30
"""Columns reserved for the value, the limit and the verdict after the name of a row."""


def text_table(rows: Iterable[TableRow], headings: tuple[str, str, str], footer: str) -> str:
    """Return the rows under their headings and above a footer, as text; long names and notes are wrapped."""
    rows = list(rows)
    width = min(max([len(headings[0]), *(len(row.name) for row in rows)]), PAGE_WIDTH - NUMBER_COLUMNS_WIDTH)
    lines = [f"{headings[0]:<{width}}  {headings[1]:>10}  {headings[2]:>9}"]
    for row in rows:
        *name_lines, name = wrap_lines(row.name, width, "  ")
        value_text, limit_text = value_and_limit_texts(row)
        line = f"{name:<{width}}  {value_text:>10}  {limit_text:>9}  {VERDICT_TEXTS[row.passed]:<5}"
        one_line = f"{line} {row.note}".rstrip()
        fits_on_page = len(one_line) <= PAGE_WIDTH
        lines += [
            *name_lines,
            one_line if fits_on_page else line.rstrip(),
            *([] if fits_on_page else wrap_lines(f"    {row.note}", PAGE_WIDTH, "    ")),
        ]
    return "\n".join([*lines, *wrap_lines(footer, PAGE_WIDTH)])


def value_and_limit_texts(row: TableRow) -> tuple[str, str]:
    """Return the texts of the measured value and of its limit; counts are whole numbers."""
    value_text = str(row.value) if isinstance(row.value, int) else f"{row.value:.2e}"
    if row.allowed is None or row.passed is None:
        return value_text, ""
    return value_text, str(row.allowed) if isinstance(row.allowed, int) else f"{row.allowed:.1e}"


def wrap_lines(text: str, width: int = PAGE_WIDTH, hang: str = "") -> list[str]:
    """Return ``text`` as lines of at most ``width`` columns, broken between words; a longer word has its own line."""
    wrapped_lines = [
        textwrap.wrap(line, width, subsequent_indent=hang, break_long_words=False, break_on_hyphens=False) or [""]
        for line in text.split("\n")
    ]
    return [line for lines in wrapped_lines for line in lines]


def html_table(rows: Iterable[TableRow], headings: tuple[str, str, str], footer: str) -> str:
    """Return the rows with their headings and footer as an HTML table for a notebook."""
    cells = [
        (
            row.name,
            *value_and_limit_texts(row),
            VERDICT_TEXTS[row.passed],
            row.note,
        )
        for row in rows
    ]
    return html_grid([*headings, "", ""], cells, footer)


def html_grid(headings: Iterable[str], rows: Iterable[Iterable[str]], footer: str = "") -> str:
    """Return an HTML table of escaped texts, with an optional footer below."""
    head = "".join(f"<th>{escape(text)}</th>" for text in headings)
    body = "".join("<tr>" + "".join(f"<td>{escape(text)}</td>" for text in row) + "</tr>" for row in rows)
    footer_html = f"<p><strong>{escape(footer)}</strong></p>" if footer else ""
    return f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>{footer_html}"
