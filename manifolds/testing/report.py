"""What a property suite measures, and how it is reported."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .._tables import TableRow, Tabular
from ..errors import ManifoldsError


@dataclass(frozen=True)
class Report(Tabular):
    """The properties of an object and how far each is from holding. Printing it gives a table."""

    of: str
    rows: tuple[TableRow, ...]

    @property
    def passed(self) -> bool:
        return all(row.passed is not False for row in self.rows)

    def _table_content(self) -> tuple[tuple[TableRow, ...], tuple[str, str, str], str]:
        last = "all of them hold" if self.passed else "NOT ALL OF THEM HOLD"
        return self.rows, (f"properties of {self.of}", "residual", "allowed"), last


class PropertyError(ManifoldsError, AssertionError):
    """An object lacks a property that all of its kind have.

    Attributes
    ----------
    report : Report
    """

    def __init__(self, report: Report):
        self.report = report
        super().__init__(f"\n{report}")


class Suite:
    """Collects rows; :meth:`report` raises where one of them fails."""

    def __init__(self, of: str):
        self.of = of
        self.rows: list[TableRow] = []

    def check_small(self, name: str, residual, size=1.0, allowed: float = 1e-12, note: str = "") -> None:
        """The largest of a residual is no more than ``allowed``, relative to a size."""
        value = float(np.abs(np.asarray(residual)).max(initial=0.0)) / max(float(np.max(size)), 1e-300)
        self.rows.append(TableRow(name, value, allowed, bool(value <= allowed), note))

    def check_equal(self, name: str, a, b, allowed: float = 1e-12, note: str = "") -> None:
        """Two arrays are the same, relative to the larger of their entries and 1."""
        a, b = np.asarray(a), np.asarray(b)
        if a.shape != b.shape:
            self.check_true(name, False, f"shapes {a.shape} and {b.shape}")
            return
        size = max(1.0, *(float(np.abs(v).max(initial=0.0)) for v in (a, b)))
        self.check_small(name, a - b, size, allowed, note)

    def check_true(self, name: str, holds, note: str = "") -> None:
        """What holds or does not."""
        self.rows.append(TableRow(name, 0.0 if holds else 1.0, 0.0, bool(holds), note))

    def skip_check(self, name: str, reason: str) -> None:
        """A property that is not asked of this object, and why."""
        self.rows.append(TableRow(name, float("nan"), None, None, reason))

    def report(self) -> Report:
        """The report; PropertyError unless everything holds."""
        report = Report(self.of, tuple(self.rows))
        if not report.passed:
            raise PropertyError(report)
        return report
