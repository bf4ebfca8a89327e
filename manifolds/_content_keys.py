"""Keys of jaxprs: equal for equal operations, whatever objects they are made of."""

from __future__ import annotations

from collections.abc import Hashable
from typing import Any

import jax
import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal, Var


def content_key(thing: Any) -> Hashable:
    """A key that is equal for equal operations; where something has none, its identity."""
    if isinstance(thing, ClosedJaxpr):
        return ("closed", _jaxpr_key(thing.jaxpr), tuple(map(content_key, thing.consts)))
    if isinstance(thing, Jaxpr):
        return _jaxpr_key(thing)
    if isinstance(thing, Literal):
        return ("literal", str(thing.aval), np.asarray(thing.val).tobytes())
    if isinstance(thing, jax.core.Tracer):
        return ("is", _IdentityKey(thing))
    if isinstance(thing, jax.Array | np.ndarray | np.generic) or hasattr(thing, "__array__"):
        array = np.asarray(thing)
        return ("array", str(array.dtype), array.shape, array.tobytes())
    if isinstance(thing, tuple | list):
        return (type(thing), *map(content_key, thing))
    if isinstance(thing, dict):
        return (dict, *((name, content_key(value)) for name, value in sorted(thing.items())))
    if type(thing).__name__ == "WrappedFun":
        return _derivative_rule_key(thing)
    try:
        hash(thing)
    except TypeError:
        return ("is", _IdentityKey(thing))
    return (type(thing), thing)


def _jaxpr_key(jaxpr: Jaxpr) -> Hashable:
    numbering: dict[Var, int] = {}

    def name(atom) -> Hashable:
        return content_key(atom) if isinstance(atom, Literal) else numbering.setdefault(atom, len(numbering))

    front = tuple((name(v), str(v.aval)) for v in (*jaxpr.constvars, *jaxpr.invars))
    body = tuple(
        (
            eqn.primitive,
            tuple((k, content_key(v)) for k, v in sorted(eqn.params.items())),
            tuple(map(name, eqn.invars)),
            tuple(map(name, eqn.outvars)),
        )
        for eqn in jaxpr.eqns
    )
    return (front, body, tuple(map(name, jaxpr.outvars)))


def _derivative_rule_key(rule) -> Hashable:
    """A derivative rule of someone's own: the function that was given, where it can be told and is there for good."""
    for _ in range(4):  # JAX wraps it in functions of its own, which are new in every trace
        found = _closure_values(rule.f)
        inner = next((c for c in found if type(c).__name__ == "WrappedFun"), None)
        if inner is None:
            inner = next((g for c in found if callable(c) for g in _closure_values(c) if type(g) is type(rule)), None)
        if inner is None:
            break
        rule = inner
    parameters = tuple(content_key(getattr(p, "val", p)) for _, ps in rule.transforms for p in ps if not callable(p))
    return ("rule", rule.f, parameters)


def _closure_values(function) -> list:
    return [cell.cell_contents for cell in getattr(function, "__closure__", None) or () if _has_contents(cell)]


def _has_contents(cell) -> bool:
    try:
        return cell.cell_contents is not None
    except ValueError:
        return False


class _IdentityKey:
    """A thing that equals itself alone, and is held on to."""

    def __init__(self, thing: Any):
        self.wrapped = thing

    def __eq__(self, other) -> bool:
        return isinstance(other, _IdentityKey) and self.wrapped is other.wrapped

    def __hash__(self) -> int:
        return id(self.wrapped)
