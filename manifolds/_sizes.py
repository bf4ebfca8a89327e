"""Sizes that catalogues are asked for."""

from __future__ import annotations

import numpy as np

from .errors import ParameterError


def checked_size(value: int, least: int, name: str, what: str = "n") -> int:
    if isinstance(value, bool) or not isinstance(value, int | np.integer):
        raise ParameterError(f"{name}: {what} must be an integer, not {value!r}")
    if value < least:
        raise ParameterError(f"{name}: {what} must be at least {least}, not {value}")
    return int(value)
