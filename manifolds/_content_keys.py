"""Hashable keys of jaxprs, equal for equal operations, and functions that are traced once and compared by such keys."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal, Var, jaxpr_as_fun

from ._index_check import check_indices


def content_key(obj: Any) -> Hashable:
    """Return a hashable key of an object, such as a traced program, that is equal for equal operations and numbers.

    An object that cannot be compared by content has its identity as its key.
    """
    if isinstance(obj, ClosedJaxpr):
        return ("closed", _jaxpr_key(obj.jaxpr), tuple(map(content_key, obj.consts)))
    if isinstance(obj, Jaxpr):
        return _jaxpr_key(obj)
    if isinstance(obj, Literal):
        return ("literal", str(obj.aval), np.asarray(obj.val).tobytes())
    if isinstance(obj, jax.core.Tracer):
        return ("is", _IdentityKey(obj))
    if isinstance(obj, jax.Array | np.ndarray | np.generic) or hasattr(obj, "__array__"):
        array = np.asarray(obj)
        return ("array", str(array.dtype), array.shape, array.tobytes())
    if isinstance(obj, tuple | list):
        return (type(obj), *map(content_key, obj))
    if isinstance(obj, dict):
        return (dict, *((name, content_key(value)) for name, value in sorted(obj.items())))
    if type(obj).__name__ == "WrappedFun":
        return _derivative_rule_key(obj)
    try:
        hash(obj)
    except TypeError:
        return ("is", _IdentityKey(obj))
    return (type(obj), obj)


def _jaxpr_key(jaxpr: Jaxpr) -> Hashable:
    numbering: dict[Var, int] = {}

    def atom_key(atom) -> Hashable:
        return content_key(atom) if isinstance(atom, Literal) else numbering.setdefault(atom, len(numbering))

    inputs = tuple((atom_key(v), str(v.aval)) for v in (*jaxpr.constvars, *jaxpr.invars))
    equations = tuple(
        (
            eqn.primitive,
            tuple((k, content_key(v)) for k, v in sorted(eqn.params.items())),
            tuple(map(atom_key, eqn.invars)),
            tuple(map(atom_key, eqn.outvars)),
        )
        for eqn in jaxpr.eqns
    )
    return (inputs, equations, tuple(map(atom_key, jaxpr.outvars)))


def _derivative_rule_key(rule) -> Hashable:
    """Return the key of a user's derivative rule: the user's own function, unwrapped, and the parameters of its
    transforms."""
    for _ in range(4):  # JAX wraps the rule in functions that are new in every trace
        cells = _closure_values(rule.f)
        inner = next((cell for cell in cells if type(cell).__name__ == "WrappedFun"), None)
        if inner is None:
            inner = next(
                (
                    function
                    for cell in cells
                    if callable(cell)
                    for function in _closure_values(cell)
                    if type(function) is type(rule)
                ),
                None,
            )
        if inner is None:
            break
        rule = inner
    parameters = tuple(
        content_key(getattr(param, "val", param))
        for _, params in rule.transforms
        for param in params
        if not callable(param)
    )
    return ("rule", rule.f, parameters)


def _closure_values(function) -> list:
    """Return the values of the variables that a function has captured."""
    return [cell.cell_contents for cell in getattr(function, "__closure__", None) or () if _has_contents(cell)]


def _has_contents(cell) -> bool:
    try:
        return cell.cell_contents is not None
    except ValueError:
        return False


class _IdentityKey:
    """Key that is equal only to keys of the same object, and keeps the object alive."""

    def __init__(self, obj: Any):
        self.wrapped = obj

    def __eq__(self, other) -> bool:
        return isinstance(other, _IdentityKey) and self.wrapped is other.wrapped

    def __hash__(self) -> int:
        return id(self.wrapped)


class FrozenFunction:
    """Function of one array, traced for a given shape; instances with equal operations and numbers are equal.

    Programs are kept by the spaces that they belong to. A space must therefore not equal another one whose function
    read other numbers when it was given, though both were given the same function object.

    Parameters
    ----------
    function : function from an array of the shape to an array
    shape : tuple of int

    Attributes
    ----------
    closed_jaxpr : ClosedJaxpr

    Raises
    ------
    IndexOutOfRangeError
        If the function has a constant index that is out of range.
    """

    def __init__(self, function: Callable, shape: tuple[int, ...]):
        self.function, self.shape = function, shape
        x = jax.ShapeDtypeStruct(shape, jnp.float64)
        # a new lambda, since JAX caches the trace of a function
        self.closed_jaxpr: ClosedJaxpr = jax.make_jaxpr(lambda x: jnp.asarray(function(x)))(x)
        check_indices(self.closed_jaxpr)
        self._key = content_key(self.closed_jaxpr)

    def __call__(self, x):
        return jaxpr_as_fun(self.closed_jaxpr)(jnp.asarray(x, dtype=jnp.float64))[0]

    def __eq__(self, other) -> bool:
        return isinstance(other, FrozenFunction) and self._key == other._key

    def __hash__(self) -> int:
        return hash(self._key)

    def __reduce__(self):
        return FrozenFunction, (self.function, self.shape)
