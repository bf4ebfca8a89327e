"""Spec files: a run described in TOML, checked as a whole before anything is computed. Only the CLI imports this."""

from __future__ import annotations

import difflib
import importlib
import inspect
import json
import os
import re
import sys
import tomllib
import traceback
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, NotRequired, Required, Union, get_args, get_origin, get_type_hints

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    FiniteFloat,
    TypeAdapter,
    ValidationError,
    with_config,
)
from pydantic_core import PydanticCustomError
from typing_extensions import TypedDict

from . import models
from .errors import AxiomError, FileError, InputError, SpecError
from .integrators import DEFAULT_METHOD, METHODS
from .systems import System

FIGURES = ("momentum_sphere", "laws")
FORMATS = ("png", "pdf", "svg")


# -- what a spec file may say ---------------------------------------------------------------------------------------


def _one_of(options: Iterable[str]) -> BeforeValidator:
    allowed = list(options)

    def check(value):
        if value not in allowed:
            raise _refusal(f"must be one of {', '.join(map(_shown, allowed))}{_suggestion(str(value), allowed)}")
        return value

    return BeforeValidator(check)


def _increasing(span: tuple[float, float]) -> tuple[float, float]:
    if span[1] <= span[0]:
        raise _refusal("must increase: time runs forwards, since entropy grows")
    return span


def _netcdf_name(name: str) -> str:
    if not re.fullmatch(r"[^/\\]+\.nc", name):
        raise _refusal('must be a file name that ends in .nc, without a folder, such as "solution.nc"')
    return name


class _Section(BaseModel):
    model_config = ConfigDict(extra="forbid")


class _File(_Section):
    model: Any = None
    run: Any = None
    method: Any = None
    outputs: Any = None


class _Model(_Section):
    name: Annotated[str, _one_of(models.__all__)] | None = None
    function: str | None = None
    parameters: dict[str, Any] = {}


class Run(_Section):
    """The section ``[run]``."""

    initial: list[FiniteFloat] = Field(min_length=1, description="the state to start from, a list of numbers")
    t_span: Annotated[tuple[FiniteFloat, FiniteFloat], AfterValidator(_increasing)] = Field(
        description="start and end, for example [0.0, 100.0]"
    )
    step: FiniteFloat = Field(gt=0, description="the step size, a number greater than 0")
    save_every: int = Field(1, ge=1)


class _Method(BaseModel):
    model_config = ConfigDict(extra="allow")  # the parameters of the method, checked by its signature
    name: Annotated[str, _one_of(METHODS)] | None = None  # options without a name are those of the midpoint scheme


class Outputs(_Section):
    """The section ``[outputs]``."""

    netcdf: Annotated[str, AfterValidator(_netcdf_name)] = "solution.nc"
    figures: list[Annotated[str, _one_of(FIGURES)]] = ["laws"]
    figure_format: Annotated[str, _one_of(FORMATS)] = "png"


# -- reading --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Spec:
    """A run, ready to start.

    Attributes
    ----------
    path : Path
    table : dict
        The whole file, as JSON data.
    build : function
        Returns the system when called with ``parameters``.
    parameters : dict
    method : OneStepMethod or Reference
    run : Run
    outputs : Outputs
    """

    path: Path
    table: dict[str, Any]
    build: Callable[..., System]
    parameters: dict[str, Any]
    method: Any
    run: Run
    outputs: Outputs

    def system(self) -> System:
        """The system, which the initial state has been seen to fit.

        Raises
        ------
        SpecError
            If the system cannot be built from the parameters.
        AxiomError
            If it is not metriplectic.
        """
        try:
            system = self.build(**self.parameters)
        except AxiomError:
            raise
        except Exception as error:  # the function may be anyone's
            raise self._refused(_raised(error, self.build)) from error
        if not isinstance(system, System):
            raise self._refused(f"it returned {system!r:.60}, not a system such as lt.LiePoissonSystem")
        try:
            system.state(self.run.initial)
        except InputError as error:
            raise SpecError(self.path, [f"run.initial = {_shown(self.run.initial)}: {error}"]) from error
        if "momentum_sphere" in self.outputs.figures and system.dim != 3:
            problem = f"momentum_sphere needs states of 3 components, and these have {system.dim}"
            raise SpecError(self.path, [f"outputs.figures = {_shown(self.outputs.figures)}: {problem}"])
        return system

    @property
    def model(self) -> str:
        """The name of the model, or ``module:function``."""
        return self.table["model"].get("name") or self.table["model"]["function"]

    def _refused(self, why: str) -> SpecError:
        return SpecError(self.path, [f"{_given('model', self.table['model'])}: {why}"])


def read(path: str | os.PathLike) -> Spec:
    """Read a spec file and check everything but the system, which is left to :meth:`Spec.system`.

    For ``function = "module:function"``, the folder of the file and the current one become importable.

    Raises
    ------
    FileError
        If the file cannot be read.
    SpecError
        With all that is wrong in it.
    """
    path = Path(path)
    table = _parse(path)
    problems: list[str] = []
    _checked("", _File, table, problems, "a spec file")
    model, run, method, outputs = (
        _checked(key, section, table.get(key, {}), problems, f"[{key}]")
        for key, section in {"model": _Model, "run": Run, "method": _Method, "outputs": Outputs}.items()
    )
    build: Any = model and _builder(model, path.resolve().parent, problems)
    parameters: Any = build and _arguments("model.parameters", build, model.parameters, problems)
    integrator = method and _integrator(method, problems)
    if problems:
        raise SpecError(path, problems)
    return Spec(path, table, build, parameters, integrator, run, outputs)


def _parse(path: Path) -> dict[str, Any]:
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise FileError(f"cannot read the spec file {path}: {error.strerror}") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise SpecError(path, [f"it is not valid TOML: {error}"]) from error
    return json.loads(json.dumps(table, default=str))  # dates and times, which no key takes, become text


def _builder(model: _Model, folder: Path, problems: list[str]) -> Callable[..., System] | None:
    """The function that the section ``[model]`` names."""
    if model.name is not None and model.function is None:
        return getattr(models, model.name)
    if model.function is not None and model.name is None:
        try:
            return _imported(model.function, folder)
        except InputError as error:
            problems.append(f"model.function = {_shown(model.function)}: {error}")
            return None
    names = ", ".join(map(_shown, models.__all__))
    problems.append(f'model: give either name (one of {names}) or function = "module:function", not both')
    return None


def _imported(target: str, folder: Path) -> Callable[..., System]:
    if not re.fullmatch(r"[\w.]+:\w+", target):
        raise InputError('must be "module:function", such as "mysystem:build" for the function build in mysystem.py')
    module_name, name = target.split(":")
    for place in (str(Path.cwd()), str(folder)):
        if place not in sys.path:
            sys.path.insert(0, place)
    try:
        module = importlib.import_module(module_name)
    except Exception as error:
        if isinstance(error, ModuleNotFoundError) and error.name and f"{module_name}.".startswith(f"{error.name}."):
            raise InputError(f"no module {error.name!r} in {folder}, in the current folder or installed") from error
        raise InputError(f"importing {module_name!r} failed with {type(error).__name__}: {error}") from error
    function = getattr(module, name, None)
    if not callable(function):
        own = [key for key, value in vars(module).items() if getattr(value, "__module__", None) == module.__name__]
        raise InputError(f"{module.__file__} has no function {name!r}{_suggestion(name, own)}")
    return function


def _integrator(method: _Method, problems: list[str]):
    if method.name is None and not method.model_extra:
        return DEFAULT_METHOD
    kind = METHODS[method.name or "MetriplecticMidpoint"]
    options = _arguments("method", kind, method.model_extra or {}, problems)
    if options is None:
        return None
    try:
        return kind(**options)
    except (TypeError, ValueError) as error:
        listed = set(re.findall(r"\w+", str(error))).difference(map(str, options.values()))  # what the message allows
        hints = [_suggestion(value, listed) for value in options.values() if isinstance(value, str)]
        problems.append(f"{_given('method', options)}: {error}{''.join(hints)}")
        return None


# -- checking a table against the fields of a section or the signature of a function -----------------------------------


def _checked(key: str, schema: type, table, problems: list[str], taker: str) -> Any:
    """The table in the types of the schema; or None, after noting what is wrong with it."""
    try:
        return TypeAdapter(schema).validate_json(json.dumps(table), strict=True)
    except ValidationError as error:
        problems += [_problem(key, found, schema, taker) for found in error.errors()]
        return None


def _problem(key: str, found: Mapping[str, Any], schema: type, taker: str) -> str:
    """One error of pydantic's as a sentence that begins with the key."""
    name = ".".join(filter(None, [key, *map(str, found["loc"])]))
    name = re.sub(r"\.(\d+)\b", r"[\1]", name)
    if found["type"] == "extra_forbidden":
        keys = list(schema.__annotations__)
        return f"{name}: no such key{_suggestion(found['loc'][-1], keys)}; {taker} takes {', '.join(keys) or 'none'}"
    if found["type"] == "missing":
        field = getattr(schema, "model_fields", {}).get(found["loc"][-1])
        return f"{name} is missing" + (f": {field.description}" if field else f"; {taker} needs it")
    if found["type"] in ("model_type", "dict_type"):
        return f"{name} = {_shown(found['input'])}: must be a section [{name}]"
    message = re.sub(r"^Input should|^(List|Tuple) should", "must", found["msg"])
    return f"{name} = {_shown(found['input'])}: {message}"


def _arguments(key: str, function: Callable, table: dict, problems: list[str]) -> dict[str, Any] | None:
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
            fields[name] = needed[_from_toml(hints.get(name, Any))]
        elif parameter.kind is parameter.VAR_KEYWORD:
            extra = "allow"
    name = getattr(function, "__name__", "the function")
    schema = with_config(ConfigDict(extra=extra))(TypedDict(name, fields))  # type: ignore[operator]
    return _checked(key, schema, table, problems, name)


def _from_toml(hint) -> Any:
    """The part of a type hint that a value from TOML can meet; Any where there is no such part, or more than one."""
    if get_origin(hint) in (Union, UnionType):
        parts = [part for part in get_args(hint) if part is not NoneType and _is_toml(part)]
        return parts[0] if len(parts) == 1 else Any
    return hint if _is_toml(hint) else Any


def _is_toml(hint) -> bool:
    if get_origin(hint) in (list, tuple, Sequence, dict, Mapping):
        return all(part is Ellipsis or _is_toml(part) for part in get_args(hint))
    return get_origin(hint) is Literal or hint in (bool, int, float, str, list, tuple, dict, Any)


# -- messages -------------------------------------------------------------------------------------------------------


def _refusal(message: str) -> PydanticCustomError:
    return PydanticCustomError("refused", "{message}", {"message": message})


def _shown(value) -> str:
    """A value nearly as the file has it."""
    text = json.dumps(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def _given(key: str, table: Mapping[str, Any]) -> str:
    """All that a table says, with the full keys."""
    return ", ".join(
        _given(f"{key}.{name}", value) if isinstance(value, dict) and value else f"{key}.{name} = {_shown(value)}"
        for name, value in table.items()
    )


def _suggestion(word: str, options: Iterable[str]) -> str:
    close = difflib.get_close_matches(word, options, n=1)
    return f" (did you mean {close[0]}?)" if close else ""


def _raised(error: Exception, function: Callable) -> str:
    """What a function raised and, unless it is the library's own message, in which of its lines."""
    if type(error).__module__.split(".")[0] in ("liethermo", "manifolds"):
        return str(error)
    own = inspect.getsourcefile(inspect.unwrap(function)) if inspect.isroutine(function) else None
    lines = [frame.lineno for frame in traceback.extract_tb(error.__traceback__) if frame.filename == own]
    where = f" ({Path(own).name}, line {lines[-1]})" if own and lines else ""
    return f"{type(error).__name__}: {error}{where}"
