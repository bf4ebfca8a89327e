"""Checks of sizes and names that users give, and the listing of a module's public names."""

from __future__ import annotations

import os
from collections.abc import Callable

import numpy as np

from .errors import ParameterError, SizeError


def is_integer(value) -> bool:
    """Return whether a value is an integer of Python or NumPy, and not a truth value."""
    return isinstance(value, int | np.integer) and not isinstance(value, bool)


def checked_size(value: int, minimum: int, name: str, label: str = "n") -> int:
    """Return ``value`` as an int, after checking that it is an integer and at least ``minimum``."""
    if not is_integer(value):
        raise ParameterError(f"{name}: {label} must be an integer, got {value!r}")
    if value < minimum:
        raise ParameterError(f"{name}: {label} must be at least {minimum}, got {value}")
    return int(value)


def check_memory(n_numbers: float, label: str, advice: str) -> None:
    """Raise SizeError if ``n_numbers`` numbers of 8 bytes would take more than half of this machine's memory."""
    n_bytes, memory = 8.0 * float(n_numbers), memory_bytes()
    if n_bytes > memory / 2:
        raise SizeError(
            f"{label} would take {n_bytes / 1e9:.3g} GB, more than half of this machine's {memory / 1e9:.3g} GB of "
            f"memory: {advice}"
        )


def memory_bytes() -> float:
    """Return the memory of this machine in bytes; 16 GB if the system does not report it."""
    try:
        return float(os.sysconf("SC_PAGE_SIZE")) * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, ValueError, OSError):  # not on Windows
        return 16e9


def checked_names(names, dim: int) -> tuple[str, ...]:
    """Return ``names`` as a tuple, after checking that they are ``dim`` different identifiers."""
    labels = (names,) if isinstance(names, str) else tuple(names)
    are_identifiers = all(isinstance(name, str) and name.isidentifier() for name in labels)
    if not are_identifiers or len(labels) != dim or len(set(labels)) != dim:
        raise ParameterError(f"{dim} basis elements need {dim} different names such as 'Jx', got {labels!r}")
    return labels


def component_names(names: tuple[str, ...] | None, dim: int) -> tuple[str, ...]:
    """Return ``names``, by default ``mu1``, ``mu2``, …"""
    return tuple(f"mu{i + 1}" for i in range(dim)) if names is None else names


def module_dir_function(names, *extra: str) -> Callable[[], list[str]]:
    """Return the ``__dir__`` function of a module: it lists public names only, without imported modules."""
    return lambda: sorted({*names, *extra, "__doc__", "__name__"})
