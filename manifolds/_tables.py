"""Tables of measured numbers with verdicts, as they are printed to a user."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

VERDICT = {True: "ok", False: "FAILS", None: "-"}


@dataclass(frozen=True)
class Row:
    """What was measured, what is allowed, and the verdict (None where nothing is asked)."""

    name: str
    value: float
    allowed: float | None
    passed: bool | None
    note: str = ""


def table(rows: Iterable[Row], headings: tuple[str, str, str], last: str) -> str:
    """The rows under their headings, and a last line."""
    rows = list(rows)
    width = max([len(headings[0]), *(len(row.name) for row in rows)])
    lines = [f"{headings[0]:<{width}}  {headings[1]:>10}  {headings[2]:>9}"]
    for row in rows:
        allowed = " " * 9 if row.allowed is None else f"{row.allowed:9.1e}"
        lines.append(f"{row.name:<{width}}  {row.value:10.2e}  {allowed}  {VERDICT[row.passed]:<5} {row.note}".rstrip())
    return "\n".join([*lines, last])
