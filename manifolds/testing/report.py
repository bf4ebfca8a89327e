"""Results of a property suite, and their report."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .._tables import TableRow, Tabular
from ..errors import ManifoldsError


@dataclass(frozen=True)
class Report(Tabular):
    """Properties of an object with their residuals and limits. Printing it gives a table."""

    of: str
    rows: tuple[TableRow, ...]

    @property
    def passed(self) -> bool:
        return all(row.passed is not False for row in self.rows)

    def _table_content(self) -> tuple[tuple[TableRow, ...], tuple[str, str, str], str]:
        footer = "all of them hold" if self.passed else "NOT ALL OF THEM HOLD"
        return self.rows, (f"properties of {self.of}", "residual", "allowed"), footer


class PropertyError(ManifoldsError, AssertionError):
    """Raised when an object lacks a property that all of its kind have.

    Attributes
    ----------
    report : Report
    """

    def __init__(self, report: Report):
        self.report = report
        super().__init__(f"\n{report}")


class Suite:
    """Collector of the rows of a report; :meth:`report` raises PropertyError if one of them fails."""

    def __init__(self, of: str):
        self.of = of
        self.rows: list[TableRow] = []

    def check_small(self, name: str, residual, size=1.0, allowed: float = 1e-12, note: str = "") -> None:
        """Check that the largest entry of a residual is at most ``allowed``, relative to ``size``."""
        value = float(np.abs(np.asarray(residual)).max(initial=0.0)) / max(float(np.max(size)), 1e-300)
        self.rows.append(TableRow(name, value, allowed, bool(value <= allowed), note))

    def check_equal(self, name: str, a, b, allowed: float = 1e-12) -> None:
        """Check that two arrays are equal, relative to the largest of their entries and 1."""
        a, b = np.asarray(a), np.asarray(b)
        if a.shape != b.shape:
            self.check_true(name, False, f"shapes {a.shape} and {b.shape}")
            return
        scale = max(1.0, *(float(np.abs(v).max(initial=0.0)) for v in (a, b)))
        self.check_small(name, a - b, scale, allowed)

    def check_true(self, name: str, holds, note: str = "") -> None:
        """Check that a property holds."""
        self.rows.append(TableRow(name, 0.0 if holds else 1.0, 0.0, bool(holds), note))

    def skip_check(self, name: str, reason: str) -> None:
        """Record a property that is not checked for this object, with the reason."""
        self.rows.append(TableRow(name, float("nan"), None, None, reason))

    def report(self) -> Report:
        """Return the report; raise PropertyError unless every property holds."""
        report = Report(self.of, tuple(self.rows))
        if not report.passed:
            raise PropertyError(report)
        return report
