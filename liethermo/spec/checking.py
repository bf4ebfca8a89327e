"""Tables of a spec file checked against the fields of a section or the signature of a function."""

from __future__ import annotations

import inspect
import json
import re
from collections.abc import Callable, Mapping, Sequence
from types import NoneType, UnionType
from typing import Any, Literal, NotRequired, Required, Union, get_args, get_origin, get_type_hints

from pydantic import ConfigDict, TypeAdapter, ValidationError, with_config
from typing_extensions import TypedDict

from .messages import format_value, suggest_match
from .schema import AdaptiveStep, EvenlySpacedAxis, MeasureTable, SampledAxis

SCHEMA_BY_TAG: dict[str, type] = {
    "table": AdaptiveStep,
    "points": EvenlySpacedAxis,
    "sample": SampledAxis,
    "measure": MeasureTable,
}


MAX_REPORTED_FAULTS = 100
"""Faults of a section, reported one by one."""


def validate_table(key: str, schema: type, table, problems: list[str], taker: str) -> Any:
    """The table in the types of the schema; or None, after noting what is wrong with it."""
    try:
        return TypeAdapter(schema).validate_json(json.dumps(table), strict=True)
    except ValidationError as error:
        found = error.errors()
        problems += [_describe_fault(key, one, schema, taker) for one in found[:MAX_REPORTED_FAULTS]]
        problems += [f"{key or 'the file'} has {len(found) - MAX_REPORTED_FAULTS} faults more"] * (
            len(found) > MAX_REPORTED_FAULTS
        )
        return None


def _describe_fault(key: str, found: Mapping[str, Any], schema: type, taker: str) -> str:
    """One error of pydantic's as a sentence that begins with the key."""
    name = ".".join(filter(None, [key, *(str(part) for part in _untagged_location(found["loc"]))]))
    name = re.sub(r"\.(\d+)\b", r"[\1]", name)
    if found["type"] == "extra_forbidden":
        keys = _allowed_keys(schema, found["loc"])
        return f"{name}: no such key{suggest_match(found['loc'][-1], keys)}; {taker} takes {', '.join(keys) or 'none'}"
    if found["type"] == "missing":
        field = getattr(schema, "model_fields", {}).get(found["loc"][-1])
        return f"{name} is missing" + (f": {field.description}" if field else f"; {taker} needs it")
    if found["type"] in ("model_type", "dict_type"):
        return f"{name} = {format_value(found['input'])}: must be a section [{name}]"
    message = re.sub(r"^Input should|^(List|Tuple) should", "must", found["msg"])
    return f"{name} = {format_value(found['input'])}: {message}"


UNION_TAGS = ("number", "table", "list", "points", "sample", "word", "measure")
"""By which pydantic names the alternatives of a key in its errors."""


def _untagged_location(parts: tuple) -> list:
    """Where an error is, without the alternatives; those stand behind the key whose alternatives they are."""
    return [part for i, part in enumerate(parts) if i == 0 or part not in UNION_TAGS]


def _allowed_keys(schema: type, place: tuple) -> list[str]:
    """The keys that the table has in which one was found that does not belong there."""
    for part in place[:-1]:
        if isinstance(part, str) and part in SCHEMA_BY_TAG:
            schema = SCHEMA_BY_TAG[part]
        elif (field := getattr(schema, "model_fields", {}).get(part)) is not None:
            nested = [kind for kind in (field.annotation, *get_args(field.annotation)) if hasattr(kind, "model_fields")]
            schema = nested[0] if nested else schema
    return list(getattr(schema, "model_fields", None) or schema.__annotations__)


def validate_arguments(key: str, function: Callable, table: dict, problems: list[str]) -> dict[str, Any] | None:
    """The table as keyword arguments of a function, checked against its signature and annotations."""
    try:
        hints = get_type_hints(function.__init__ if inspect.isclass(function) else function)
    except Exception:  # annotations with names that exist only for type checkers
        hints = {}
    fields: dict[str, Any] = {}
    extra: Literal["allow", "forbid"] = "forbid"
    for name, parameter in inspect.signature(function).parameters.items():
        if parameter.kind in (parameter.POSITIONAL_OR_KEYWORD, parameter.KEYWORD_ONLY):
            needed = Required if parameter.default is parameter.empty else NotRequired
            fields[name] = needed[_toml_hint(hints.get(name, Any))]
        elif parameter.kind is parameter.VAR_KEYWORD:
            extra = "allow"
    name = getattr(function, "__name__", "the function")
    schema = with_config(ConfigDict(extra=extra))(TypedDict(name, fields))  # type: ignore[operator]
    return validate_table(key, schema, table, problems, name)


def _toml_hint(hint) -> Any:
    """The part of a type hint that a value from TOML can meet; Any where there is no such part, or more than one."""
    if get_origin(hint) in (Union, UnionType):
        parts = [part for part in get_args(hint) if part is not NoneType and _is_toml_hint(part)]
        return parts[0] if len(parts) == 1 else Any
    return hint if _is_toml_hint(hint) else Any


def _is_toml_hint(hint) -> bool:
    if get_origin(hint) in (list, tuple, Sequence, dict, Mapping):
        return all(part is Ellipsis or _is_toml_hint(part) for part in get_args(hint))
    return get_origin(hint) is Literal or hint in (bool, int, float, str, list, tuple, dict, Any)
