"""Base class of all pytrees of the library, and attributes forwarded to a wrapped object."""

from __future__ import annotations

from copy import copy
from types import MethodType
from typing import TYPE_CHECKING, Any, TypeVar

import equinox as eqx
import jax

from ._class_members import ListedType

Copied = TypeVar("Copied", bound=eqx.Module)


if TYPE_CHECKING:
    from equinox._module._module import _ModuleMeta as ListedModuleType
else:

    class ListedModuleType(ListedType, type(eqx.Module)):
        """Type of the classes of pytrees, whose ``dir`` lists the members that users call."""


class Module(eqx.Module, metaclass=ListedModuleType):
    """Equinox module whose methods are ordinary bound methods, except when they become fields of another module.

    Equinox makes a pytree of each method that is looked up, which takes a good part of the time to trace a step and of
    a short run. A pytree is needed only when a method becomes a field of another module, so that the parameters of its
    object are parameters there.
    """

    if not TYPE_CHECKING:
        __getattribute__ = object.__getattribute__

    def __check_init__(self) -> None:
        leaves, structure = jax.tree_util.tree_flatten(self)
        if any(map(_is_module_method, leaves)):
            rebuilt_module = jax.tree_util.tree_unflatten(structure, [_method_to_partial(leaf) for leaf in leaves])
            for name, value in vars(rebuilt_module).items():
                object.__setattr__(self, name, value)


def _is_module_method(leaf: Any) -> bool:
    return isinstance(leaf, MethodType) and isinstance(leaf.__self__, eqx.Module)


def _method_to_partial(leaf: Any) -> Any:
    return eqx.Partial(leaf.__func__, leaf.__self__) if _is_module_method(leaf) else leaf


def replace_fields(module: Copied, **fields: Any) -> Copied:
    """Return a copy of a module with other values of some fields; its constructor is not called.

    What the module has cached is copied too, so the fields must not affect it.
    """
    copied_module = copy(module)
    for name, value in fields.items():
        object.__setattr__(copied_module, name, value)
    return copied_module


class _ForwardedMember:
    """Descriptor of :func:`forward_to`."""

    def __init__(self, attribute: str, name: str | None):
        self.attribute, self.name = attribute, name

    def __set_name__(self, owner: type, name: str) -> None:
        self.name = self.name or name

    def __get__(self, instance: Any, owner: type | None = None) -> Any:
        return self if instance is None else getattr(getattr(instance, self.attribute), str(self.name))


def forward_to(attribute: str, name: str | None = None) -> Any:
    """Return a descriptor that reads a member of the wrapped object ``self.<attribute>``.

    The member is called ``name``, by default like the descriptor.
    """
    return _ForwardedMember(attribute, name)
