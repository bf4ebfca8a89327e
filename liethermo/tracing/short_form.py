"""One line about an object for people: its class, and its parameters with their values."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import numpy as np

MAX_SHOWN_NUMBERS = 9
"""Largest number of entries of an array that are shown."""

MAX_SHOWN_ITEMS = 3
"""Largest number of objects of a list that are shown."""

MAX_DEPTH = 3
"""Depth of nested objects beyond which only the class is shown."""


SUM_FIELDS = frozenset({"summands", "parts"})
"""Fields with the parts of a sum."""

WRAPPED_FIELDS = frozenset({"part", "term"})
"""Fields of objects that wrap another one."""


def short_form(value: Any, depth: int = 0) -> str:
    """Return one line about a value: numbers with four digits, functions by name, objects by class and fields.

    Fields that are None, empty, zero, flags or declared with ``repr=False`` are left out. An array of many numbers is
    shown by its shape, a wrapper by the object that it wraps, and a sum by its parts.
    """
    if isinstance(value, jax.core.Tracer):
        return f"{value.dtype}{list(value.shape)}"
    if isinstance(value, jax.Array | np.ndarray | np.generic):
        array = np.asarray(value)
        if array.size > MAX_SHOWN_NUMBERS or array.dtype.kind not in "bifcu":
            return f"array{array.shape}"
        return _format_numbers(array.tolist())
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, eqx.Module) and not is_named_callable(value):
        return _format_object(value, depth)
    if is_named_callable(value):
        return str(value.__name__)
    if isinstance(value, Mapping):
        return join_first_items((f"{key}: {short_form(entry, depth + 1)}" for key, entry in value.items()), "{}")
    if isinstance(value, list | tuple):
        return join_first_items((short_form(entry, depth + 1) for entry in value), "[]")
    return str(value)


def _format_numbers(values: Any) -> str:
    """Return numbers in nested lists as text, with four significant digits."""
    if isinstance(values, list):
        return f"[{', '.join(map(_format_numbers, values))}]"
    return str(values) if isinstance(values, bool) else f"{values + 0.0:.4g}"  # without the sign of -0.0


def format_arguments(arguments: Mapping[str, Any], depth: int = 1) -> str:
    """Return ``name=value, …`` in short forms, without arguments that are None, empty, zero or flags."""
    return ", ".join(
        f"{name}={short_form(value, depth)}" for name, value in arguments.items() if not _is_omitted(value)
    )


def callable_name(function: Any, default: str | None = None) -> str:
    """Return the name of a function; for an object without a name ``default``, or else the name of its class."""
    return getattr(function, "__name__", type(function).__name__ if default is None else default)


def qualified_name(function: Any) -> str:
    """Return the name of a function with those of the classes and functions around it, or the name of its class."""
    return getattr(function, "__qualname__", type(function).__name__)


def is_named_callable(value: Any) -> bool:
    """Return whether a value is a function, or an object that stands for one and has its name."""
    return callable(value) and hasattr(value, "__name__")


def _format_object(value: eqx.Module, depth: int) -> str:
    """Return the class and fields of a module as text, or its own ``repr`` if its class defines one."""
    if type(value).__repr__ not in (eqx.Module.__repr__, short_form):
        return repr(value)
    shown_fields = [field.name for field in dataclasses.fields(value) if field.repr and field.name in vars(value)]
    fields = {name: vars(value)[name] for name in shown_fields}
    for name in SUM_FIELDS & fields.keys():
        return join_first_items((short_form(summand, depth + 1) for summand in fields[name]), ("", ""), " + ")
    for name in WRAPPED_FIELDS & fields.keys():
        return short_form(fields[name], depth)
    if depth >= MAX_DEPTH:
        return f"{type(value).__name__}(…)"
    return f"{type(value).__name__}({format_arguments(fields, depth + 1)})"


def _is_omitted(value: Any) -> bool:
    """Return whether a value is left out of short forms: None, empty, zero or a flag."""
    if value is None or isinstance(value, jax.core.Tracer):
        return value is None
    if isinstance(value, jax.Array | np.ndarray | np.generic):
        return not np.size(value) or (not np.shape(value) and not np.asarray(value).any())
    return isinstance(value, bool) or (isinstance(value, Mapping | list | tuple | frozenset | str) and not value)


def join_first_items(texts: Iterable[str], brackets: Sequence[str], separator: str = ", ") -> str:
    """Join the first :data:`MAX_SHOWN_ITEMS` texts in brackets, with the number of all if there are more."""
    text_list = list(texts)
    shown_texts = text_list[:MAX_SHOWN_ITEMS]
    if len(text_list) > len(shown_texts):
        shown_texts.append(f"… ({len(text_list)} in all)")
    return f"{brackets[0]}{separator.join(shown_texts)}{brackets[1]}"
