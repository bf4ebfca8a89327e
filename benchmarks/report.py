"""Reports of measurements: tables of plain numbers, and targets, written as JSON and as Markdown."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any


class UnavailableError(Exception):
    """A contestant cannot take part on this machine; the message gives the reason."""


@dataclass(frozen=True)
class Table:
    """A table; ``columns`` maps each heading to the format of its numbers, a name in :data:`FORMATS`."""

    caption: str
    columns: dict[str, str]
    rows: list[list[Any]]

    def markdown(self) -> str:
        kinds = list(self.columns.values())
        cells = [[_format_cell(a, kind) for a, kind in zip(row, kinds, strict=True)] for row in self.rows]
        rule = ["---" if kind == "text" else "---:" for kind in kinds]
        for row in cells:  # a number and its unit are not torn apart
            row[:] = [
                text if kind == "text" else text.replace(" ", "\u00a0") for text, kind in zip(row, kinds, strict=True)
            ]
        lines = [
            " | ".join(row)
            for row in (map(_escape_bars, self.columns), rule, *(map(_escape_bars, row) for row in cells))
        ]
        return "\n".join([self.caption, "", *(f"| {line} |" for line in lines)])


@dataclass(frozen=True)
class Target:
    """A figure that the library should reach: at most ``bound``, or at least; None if it was not measured."""

    work: str
    bound: float
    measured: float | None
    kind: str = "ratio"
    at_least: bool = False

    @property
    def verdict(self) -> str:
        if self.measured is None:
            return "not measured"
        return "met" if (self.measured >= self.bound if self.at_least else self.measured <= self.bound) else "missed"

    def row(self) -> list[str]:
        limit = f"{'≥' if self.at_least else '≤'} {_format_cell(self.bound, self.kind)}"
        return [self.work, limit, _format_cell(self.measured, self.kind), self.verdict]


@dataclass(frozen=True)
class Report:
    """The report of one measurement.

    Attributes
    ----------
    title, text : str
        Description for a reader of the page.
    tables : list of Table
    targets : list of Target
    skipped : dict
        Contestants that did not take part, with the reason.
    series : dict
        Curves of a figure: for each name the points, as [x, y].
    """

    title: str
    text: str
    tables: list[Table]
    targets: list[Target] = field(default_factory=list)
    skipped: dict[str, str] = field(default_factory=dict)
    series: dict[str, list[list[float]]] = field(default_factory=dict)

    def markdown(self) -> str:
        parts = [f"## {self.title}", self.text, *(table.markdown() for table in self.tables)]
        if self.skipped:
            parts.append("\n".join(f"- Left out: {name} ({reason})." for name, reason in self.skipped.items()))
        return "\n\n".join(parts)

    def save(self, path: Path, **about) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(about | {"report": dataclasses.asdict(self)}, indent=1, allow_nan=True) + "\n")

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Report:
        tables = [Table(**table) for table in data["tables"]]
        targets = [Target(**target) for target in data["targets"]]
        return cls(**{**data, "tables": tables, "targets": targets})


def targets_table(targets: Sequence[Target]) -> Table:
    columns = dict.fromkeys(["Work", "Target", "Measured", "Verdict"], "text")
    return Table("", columns, [target.row() for target in targets])


def build_available(builders: Mapping[Any, Callable[[], Any]]) -> tuple[dict[Any, Any], dict[Any, str]]:
    """Call builders by name; return the results, and the reasons of those that raise :class:`UnavailableError`."""
    works, skip_reasons = {}, {}
    for name, build in builders.items():
        try:
            works[name] = build()
        except UnavailableError as reason:
            skip_reasons[name] = str(reason)
    return works, skip_reasons


def ratio(a: float | None, b: float | None) -> float | None:
    return None if a is None or b is None else a / b


def _escape_bars(text: str) -> str:
    """Return a text with escaped bars, which would separate the cells of a Markdown table."""
    return text.replace("|", r"\|")


def _format_seconds(s: float) -> str:
    for unit, unit_seconds in ("s", 1.0), ("ms", 1e-3), ("µs", 1e-6):
        if s >= unit_seconds:
            return f"{s / unit_seconds:.3g} {unit}"
    return f"{s / 1e-9:.3g} ns"


FORMATS: dict[str, Callable[[Any], str]] = {
    "text": str,
    "seconds": _format_seconds,
    "ratio": lambda a: f"{a:.3g} ×",
    "about": lambda a: f"{a:.2g} ×",
    "number": lambda a: f"{a:.3g}",
    "count": lambda a: f"{a:,}",
    "error": lambda a: f"{a:.1e}",
    "precise": lambda a: f"{a:.4f}",
    "gigabytes": lambda a: f"{a / 1e9:.2f} GB",
}
"""Functions that format a number, by name."""


def _format_cell(a: Any, kind: str) -> str:
    return "–" if a is None else FORMATS[kind](a)
