"""How a step, a run, or a trajectory of many ended: one list of numbers and names for all of them."""

from __future__ import annotations

import enum


class Code(enum.IntEnum):
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
    def text(self) -> str:
        return self.name.lower()


UNTAKEN = (Code.NOT_CONVERGED, Code.NON_FINITE)
"""How a step ends that could not be taken."""

TEXTS = tuple(code.text for code in Code)
"""The names, each at the place of its number."""
