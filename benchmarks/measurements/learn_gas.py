"""Learned systems: two gas containers."""

from __future__ import annotations

from .. import learned
from ..report import Report


def run(is_quick: bool) -> Report:
    return learned.problem_report("gas", is_quick)
