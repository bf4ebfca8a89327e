"""Checks and defaults for the names of basis elements, and the listing of a module's public names."""

from __future__ import annotations

from collections.abc import Callable

from .errors import ParameterError


def checked_names(names, dim: int) -> tuple[str, ...]:
    """Return ``names`` as a tuple, after checking that they are ``dim`` different identifiers."""
    labels = (names,) if isinstance(names, str) else tuple(names)
    are_identifiers = all(isinstance(name, str) and name.isidentifier() for name in labels)
    if not are_identifiers or len(labels) != dim or len(set(labels)) != dim:
        raise ParameterError(f"{dim} basis elements need {dim} different names such as 'Jx', not {labels!r}")
    return labels


def component_names(names: tuple[str, ...] | None, dim: int) -> tuple[str, ...]:
    """Return ``names``, by default ``mu1``, ``mu2``, …"""
    return tuple(f"mu{i + 1}" for i in range(dim)) if names is None else names


def public_dir(names, *extra: str) -> Callable[[], list[str]]:
    """Return the ``__dir__`` function of a module: it lists public names only, without imported modules."""
    return lambda: sorted({*names, *extra, "__doc__", "__name__"})
