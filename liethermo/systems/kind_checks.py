"""Checks of the kind of a system, and the user's system without the wrappers that a run adds."""

from __future__ import annotations

from typing import Any, TypeVar

from ..errors import InputError
from .base import System

KindOfSystem = TypeVar("KindOfSystem", bound=System)


def unwrap_user_system(system: System) -> System:
    """Return the user's system, without the clock, the attitude and the embedding that a run adds."""
    while system.wrapped_system is not None:
        system = system.wrapped_system.system
    return system


def kind_or_class_name(value: Any) -> str:
    """Return the kind of a system, or the class name of any other object."""
    return value.kind if isinstance(value, System) else type(value).__name__


def require_system(value: Any, error_prefix: str) -> System:
    """Return ``value`` if it is a system; raise InputError otherwise.

    Parameters
    ----------
    error_prefix : str
        What the message of the error begins with, such as "flow needs a system".

    Raises
    ------
    InputError
    """
    if not isinstance(value, System):
        description = f"the class {value.__name__}" if isinstance(value, type) else type(value).__name__
        raise InputError(f"{error_prefix}, got {description}")
    return value


def require_kind(system: Any, kind: type[KindOfSystem], user_name: str) -> KindOfSystem:
    """Return the system if it is of a kind, such as QuantumSystem, that ``user_name`` needs; InputError otherwise.

    Raises
    ------
    InputError
    """
    if not isinstance(system, kind):
        raise InputError(f"{user_name} needs an lt.{kind.__name__}, got a {kind_or_class_name(system)}")
    return system
