"""Messages about the faults of a spec file, each beginning with the key."""

from __future__ import annotations

import difflib
import inspect
import json
import traceback
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

from pydantic_core import PydanticCustomError


def validation_error(message: str) -> PydanticCustomError:
    return PydanticCustomError("refused", "{message}", {"message": message})


def format_value(value) -> str:
    """Return a value as JSON text, at most 60 characters long, which is nearly its TOML text."""
    text = json.dumps(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def format_table(key: str, table: Mapping[str, Any]) -> str:
    """Return all entries of a table as "key = value" with full keys."""
    return ", ".join(
        format_table(f"{key}.{name}", value)
        if isinstance(value, dict) and value
        else f"{key}.{name} = {format_value(value)}"
        for name, value in table.items()
    )


def suggest_match(word: str, options: Iterable[str]) -> str:
    matches = difflib.get_close_matches(word, options, n=1)
    return f" (did you mean {matches[0]}?)" if matches else ""


def describe_exception(error: Exception, function: Callable) -> str:
    """Return the error's text; for an error of user code also its type and the line of the function."""
    if type(error).__module__.split(".")[0] in ("liethermo", "manifolds"):
        return str(error)
    source_file = inspect.getsourcefile(inspect.unwrap(function)) if inspect.isroutine(function) else None
    lines = [frame.lineno for frame in traceback.extract_tb(error.__traceback__) if frame.filename == source_file]
    location = f" ({Path(source_file).name}, line {lines[-1]})" if source_file and lines else ""
    return f"{type(error).__name__}: {error}{location}"
