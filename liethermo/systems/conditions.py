"""Conditions of a run beside its laws, which an audit shows: positivity of a state, validity of a model."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class RunCondition:
    """A condition of a run beside the laws of energy and entropy, for a row of its audit.

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
    """

    name: str
    value: float
    limit: float | None = None
    holds: bool | None = None
    note: str = ""
    concerns_model: bool = False
