"""The base of all pytrees here."""

from __future__ import annotations

from types import MethodType
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax


class Module(eqx.Module):
    """An equinox module whose methods are bound as Python binds them, unless they are given to another module to keep.

    Equinox makes a pytree of each method that is looked up, which is a good part of what it costs to trace a step, and
    of a short run. A pytree is needed only where a method becomes part of another module,
    so that the parameters of its object are parameters there.
    """

    if not TYPE_CHECKING:
        __getattribute__ = object.__getattribute__

    def __check_init__(self) -> None:
        leaves, structure = jax.tree_util.tree_flatten(self)
        if any(map(_is_module_method, leaves)):
            whole = jax.tree_util.tree_unflatten(structure, [_method_to_partial(leaf) for leaf in leaves])
            for name, value in vars(whole).items():
                object.__setattr__(self, name, value)


def _is_module_method(leaf: Any) -> bool:
    return isinstance(leaf, MethodType) and isinstance(leaf.__self__, eqx.Module)


def _method_to_partial(leaf: Any) -> Any:
    return eqx.Partial(leaf.__func__, leaf.__self__) if _is_module_method(leaf) else leaf


class _ForwardedMember:
    """See :func:`forwarded`."""

    def __init__(self, inside: str, name: str | None):
        self.attribute, self.name = inside, name

    def __set_name__(self, owner: type, name: str) -> None:
        self.name = self.name or name

    def __get__(self, instance: Any, owner: type | None = None) -> Any:
        return self if instance is None else getattr(getattr(instance, self.attribute), str(self.name))


def forward_to(inside: str, name: str | None = None) -> Any:
    """In the body of a class that wraps an object: a member of that object, which the attribute ``inside`` holds.

    The member of the same name, or of another one.
    """
    return _ForwardedMember(inside, name)
