"""How a step, a run, or a trajectory of many ended: one list of numbers and names for all of them."""

from __future__ import annotations

import enum


class StatusCode(enum.IntEnum):
    """Zero while all is well. Engines know the first three; users see the names in small letters."""

    COMPLETED = 0
    NOT_CONVERGED = 1
    NON_FINITE = 2
    INTERRUPTED = 3
    EVENT = 4
    STEP_UNDERFLOW = 5
    STEP_LIMIT = 6
    REFERENCE_FAILED = 7
    INADMISSIBLE = 8

    @property
    def status_name(self) -> str:
        return self.name.lower()


FAILED_STEP_CODES = (StatusCode.NOT_CONVERGED, StatusCode.NON_FINITE)
"""How a step ends that could not be taken."""

STATUS_NAMES = tuple(code.status_name for code in StatusCode)
"""The names, each at the place of its number."""
