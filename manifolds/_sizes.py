"""Sizes that catalogues are asked for."""

from __future__ import annotations

import os

import numpy as np

from .errors import ParameterError, SizeError


def checked_size(value: int, least: int, name: str, what: str = "n") -> int:
    if isinstance(value, bool) or not isinstance(value, int | np.integer):
        raise ParameterError(f"{name}: {what} must be an integer, not {value!r}")
    if value < least:
        raise ParameterError(f"{name}: {what} must be at least {least}, not {value}")
    return int(value)


def check_memory(numbers: float, what: str, instead: str, number_size: int = 8) -> None:
    """Raise SizeError where an array of so many numbers would not fit into half of this machine's memory."""
    needed, there = float(numbers) * number_size, memory_bytes()
    if needed > there / 2:
        raise SizeError(
            f"{what} would take {needed / 1e9:.3g} GB, and this machine has {there / 1e9:.3g} GB of memory; {instead}"
        )


def memory_bytes() -> float:
    """The bytes of memory of this machine; 16 GB where it does not say."""
    try:
        return float(os.sysconf("SC_PAGE_SIZE")) * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, ValueError, OSError):  # not on Windows
        return 16e9
