"""Learned systems: a thermoelastic double pendulum."""

from __future__ import annotations

from .. import learned
from ..report import Report


def run(is_quick: bool) -> Report:
    return learned.problem_report("pendulum", is_quick)
