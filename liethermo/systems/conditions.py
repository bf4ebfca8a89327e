"""Conditions of a run beside its laws, which an audit shows: positivity of a state, validity of a model."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass


@dataclass(frozen=True)
class RunCondition:
    """A condition of a run other than the laws of energy and entropy, shown as a row of its audit.

    Attributes
    ----------
    name : str
    value : float
        The measured number.
    limit : float or None
        The limit of the number; None if it is not judged.
    holds : bool or None
    note : str
        Explanation for the reader of the audit.
    concerns_model : bool
        True if the condition is one of the validity of the equations, and not of the run.
    is_minimum : bool
        True if the number is the least one along the run, and False if it is the largest.
    """

    name: str
    value: float
    limit: float | None = None
    holds: bool | None = None
    note: str = ""
    concerns_model: bool = False
    is_minimum: bool = False


def worst_conditions(conditions_of_runs: Iterable[Iterable[RunCondition]]) -> tuple[RunCondition, ...]:
    """Return for each name the condition with the worst value among several runs."""
    worst_by_name: dict[str, RunCondition] = {}
    for condition in (condition for conditions in conditions_of_runs for condition in conditions):
        current_worst = worst_by_name.setdefault(condition.name, condition)
        is_worse = (
            condition.value < current_worst.value if condition.is_minimum else condition.value > current_worst.value
        )
        if is_worse or not math.isfinite(condition.value):
            worst_by_name[condition.name] = condition
    return tuple(worst_by_name.values())
