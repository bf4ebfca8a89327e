"""Validation of the tables of a spec file against a schema or the signature of a function."""

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
"""Schema of each table alternative of a key, by its tag."""

MAX_REPORTED_FAULTS = 100
"""Maximum number of faults of a section that are listed; the others are counted."""


def validate_table(key: str, schema: type, table, problems: list[str], reader_name: str) -> Any:
    """Return the table converted to the types of the schema, or None after appending its faults to ``problems``."""
    try:
        return TypeAdapter(schema).validate_json(json.dumps(table), strict=True)
    except ValidationError as error:
        faults = error.errors()
        problems += [_describe_fault(key, fault, schema, reader_name) for fault in faults[:MAX_REPORTED_FAULTS]]
        problems += [f"{key or 'the file'} has {len(faults) - MAX_REPORTED_FAULTS} faults more"] * (
            len(faults) > MAX_REPORTED_FAULTS
        )
        return None


def _describe_fault(key: str, fault: Mapping[str, Any], schema: type, consumer: str) -> str:
    """Return an error of pydantic as a sentence that begins with the key."""
    name = ".".join(filter(None, [key, *(str(part) for part in _untagged_location(fault["loc"]))]))
    name = re.sub(r"\.(\d+)\b", r"[\1]", name)
    if fault["type"] == "extra_forbidden":
        keys = _allowed_keys(schema, fault["loc"])
        return (
            f"{name}: no such key{suggest_match(fault['loc'][-1], keys)}; {consumer} takes {', '.join(keys) or 'none'}"
        )
    if fault["type"] == "missing":
        field = getattr(schema, "model_fields", {}).get(fault["loc"][-1])
        return f"{name} is missing" + (f": {field.description}" if field else f"; {consumer} needs it")
    if fault["type"] in ("model_type", "dict_type"):
        return f"{name} = {format_value(fault['input'])}: must be a section [{name}]"
    message = re.sub(r"^Input should|^(List|Tuple) should", "must", fault["msg"])
    return f"{name} = {format_value(fault['input'])}: {message}"


UNION_TAG_NAMES = ("number", "table", "list", "points", "sample", "word", "measure")
"""Tags of the alternatives of a key, which pydantic inserts into the locations of its errors."""


def _untagged_location(parts: tuple) -> list:
    """Return the location of an error without the tags of alternatives, which may follow any key but the first."""
    return [part for i, part in enumerate(parts) if i == 0 or part not in UNION_TAG_NAMES]


def _allowed_keys(schema: type, location: tuple) -> list[str]:
    """Return the keys allowed in the table at which an unknown key was found."""
    for part in location[:-1]:
        if isinstance(part, str) and part in SCHEMA_BY_TAG:
            schema = SCHEMA_BY_TAG[part]
        elif (field := getattr(schema, "model_fields", {}).get(part)) is not None:
            nested_models = [
                kind for kind in (field.annotation, *get_args(field.annotation)) if hasattr(kind, "model_fields")
            ]
            schema = nested_models[0] if nested_models else schema
    return list(getattr(schema, "model_fields", None) or schema.__annotations__)


def validate_arguments(key: str, function: Callable, table: dict, problems: list[str]) -> dict[str, Any] | None:
    """Return the table as keyword arguments of a function, validated by its signature and annotations."""
    try:
        hints = get_type_hints(function.__init__ if inspect.isclass(function) else function)
    except Exception:  # annotations with names that exist only for type checkers
        hints = {}
    fields: dict[str, Any] = {}
    extra: Literal["allow", "forbid"] = "forbid"
    for name, parameter in inspect.signature(function).parameters.items():
        if parameter.kind in (parameter.POSITIONAL_OR_KEYWORD, parameter.KEYWORD_ONLY):
            requirement = Required if parameter.default is parameter.empty else NotRequired
            fields[name] = requirement[_toml_value_type(hints.get(name, Any))]
        elif parameter.kind is parameter.VAR_KEYWORD:
            extra = "allow"
    name = getattr(function, "__name__", "the function")
    schema = with_config(ConfigDict(extra=extra))(TypedDict(name, fields))  # type: ignore[operator]
    return validate_table(key, schema, table, problems, name)


def _toml_value_type(hint) -> Any:
    """Return the alternative of a type hint that a TOML value can have; Any if there is not exactly one."""
    if get_origin(hint) in (Union, UnionType):
        alternatives = [part for part in get_args(hint) if part is not NoneType and _is_toml_value_type(part)]
        return alternatives[0] if len(alternatives) == 1 else Any
    return hint if _is_toml_value_type(hint) else Any


def _is_toml_value_type(hint) -> bool:
    if get_origin(hint) in (list, tuple, Sequence, dict, Mapping):
        return all(part is Ellipsis or _is_toml_value_type(part) for part in get_args(hint))
    return get_origin(hint) is Literal or hint in (bool, int, float, str, list, tuple, dict, Any)
