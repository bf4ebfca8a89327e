"""What is wrong with a spec file, in words that begin with the key."""

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
    """A value nearly as the file has it."""
    text = json.dumps(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def format_table(key: str, table: Mapping[str, Any]) -> str:
    """All that a table says, with the full keys."""
    return ", ".join(
        format_table(f"{key}.{name}", value)
        if isinstance(value, dict) and value
        else f"{key}.{name} = {format_value(value)}"
        for name, value in table.items()
    )


def suggest_match(word: str, options: Iterable[str]) -> str:
    close = difflib.get_close_matches(word, options, n=1)
    return f" (did you mean {close[0]}?)" if close else ""


def describe_exception(error: Exception, function: Callable) -> str:
    """What a function raised and, unless it is the library's own message, in which of its lines."""
    if type(error).__module__.split(".")[0] in ("liethermo", "manifolds"):
        return str(error)
    own = inspect.getsourcefile(inspect.unwrap(function)) if inspect.isroutine(function) else None
    lines = [frame.lineno for frame in traceback.extract_tb(error.__traceback__) if frame.filename == own]
    where = f" ({Path(own).name}, line {lines[-1]})" if own and lines else ""
    return f"{type(error).__name__}: {error}{where}"
