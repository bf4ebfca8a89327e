"""Status codes: how a step, a run, or a trajectory of an ensemble ended, and why a run pauses."""

from __future__ import annotations

import enum


class StatusCode(enum.IntEnum):
    """Status of a step or a run; COMPLETED while all is well.

    Codes below EMPTY_LANE are results, which users see by their names in small letters. The others are internal: they
    mark a lane without a trajectory, and the reasons why an adaptive run pauses.
    """

    COMPLETED = 0
    NOT_CONVERGED = 1
    NON_FINITE = 2
    INTERRUPTED = 3
    EVENT = 4
    STEP_UNDERFLOW = 5
    STEP_LIMIT = 6
    REFERENCE_FAILED = 7
    INADMISSIBLE = 8
    EMPTY_LANE = 9  # a lane of the compiled engine without a trajectory
    PAUSED_AT_STOP = 20  # the time is one at which a step has to end
    PAUSED_FOR_GROWTH_RATE = 21  # the growth rate at the state must be computed
    PAUSED_AT_EVENT = 22  # the event function changes its sign
    REACHED_END = 23  # the end of the span is reached

    @property
    def status_name(self) -> str:
        return self.name.lower()


RESULT_CODES = tuple(code for code in StatusCode if code < StatusCode.EMPTY_LANE)
"""Codes of the results that users see; each code is its index."""

FAILED_STEP_CODES = (StatusCode.NOT_CONVERGED, StatusCode.NON_FINITE)
"""Codes of a failed step."""

STATUS_NAMES = tuple(code.status_name for code in RESULT_CODES)
"""Names of the result codes; the index of a name is its code."""
