"""Names of basis elements and components, and those that a module shows."""

from __future__ import annotations

from collections.abc import Callable

from .errors import ParameterError


def checked_names(names, dim: int) -> tuple[str, ...]:
    """``names`` as a tuple of dim different identifiers."""
    given = (names,) if isinstance(names, str) else tuple(names)
    good = all(isinstance(name, str) and name.isidentifier() for name in given)
    if not good or len(given) != dim or len(set(given)) != dim:
        raise ParameterError(f"{dim} basis elements need {dim} different names such as 'Jx', not {given!r}")
    return given


def component_names(names: tuple[str, ...] | None, dim: int) -> tuple[str, ...]:
    """The names, or ``mu1``, ``mu2``, …"""
    return tuple(f"mu{i + 1}" for i in range(dim)) if names is None else names


def public_dir(names, *more: str) -> Callable[[], list[str]]:
    """``__dir__`` of a module: what is public, not the modules that are imported there."""
    return lambda: sorted({*names, *more, "__doc__", "__name__"})
