"""Fields of results that are computed at their first use."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeVar

Class = TypeVar("Class", bound=type)


@dataclass(frozen=True, eq=False)
class Computation:
    """Value of a deferred field that is not computed yet.

    Attributes
    ----------
    function : function without arguments
        Returns the value; it is called once.
    """

    function: Callable[[], Any]


def defer(function: Callable[[], Any]) -> Any:
    """Return a value for a deferred field: ``function()`` is called at the first use of the field."""
    return Computation(function)


class _DeferredField:
    """Descriptor of a field whose value may be a :class:`Computation`."""

    def __init__(self, name: str):
        self._name = name

    def __get__(self, instance: Any, owner: type | None = None) -> Any:
        if instance is None:
            return self
        value = vars(instance)[self._name]
        if isinstance(value, Computation):
            value = vars(instance)[self._name] = value.function()
        return value

    def __set__(self, instance: Any, value: Any) -> None:
        vars(instance)[self._name] = value


def deferred_fields(*names: str) -> Callable[[Class], Class]:
    """Decorate a dataclass: the values of these fields may be given by :func:`defer`."""

    def add_descriptors(cls: Class) -> Class:
        for name in names:
            setattr(cls, name, _DeferredField(name))
        return cls

    return add_descriptors
