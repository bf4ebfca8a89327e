"""Reading of a spec file and of its section ``[study]``, validated completely before anything is computed."""

from __future__ import annotations

import copy
import inspect
import json
import os
import re
import tomllib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Literal, NotRequired, Required, Union, get_args, get_origin, get_type_hints

import jax.numpy as jnp
import numpy as np
from pydantic import ConfigDict, TypeAdapter, ValidationError, with_config
from typing_extensions import TypedDict

from .. import disk, models
from ..errors import AxiomError, InputError, SpecError
from ..integrators import DEFAULT_METHOD, METHODS
from ..runs.adaptive import Adaptive
from ..runs.events import Relaxed
from ..studies.axes import Zipped, latin_hypercube, sobol, zipped
from ..studies.measures import At
from ..studies.study import Study
from ..systems import System
from ..tracing.short_form import callable_name
from .schema import (
    SECTIONS,
    AdaptiveStep,
    EvenlySpacedAxis,
    MeasureTable,
    Method,
    Model,
    Outputs,
    Run,
    SampledAxis,
    SpecContents,
    StudySection,
    describe_user_error,
    did_you_mean_text,
    format_table_entries,
    format_value,
)
from .trust import import_function

SCHEMA_BY_TAG: dict[str, type] = {
    "table": AdaptiveStep,
    "points": EvenlySpacedAxis,
    "sample": SampledAxis,
    "measure": MeasureTable,
}
"""Schema of each table alternative of a key, by its tag."""

MAX_REPORTED_FAULTS = 100
"""Maximum number of faults of a section that are listed; the others are counted."""


def validate_table_by_schema(key: str, schema: type, table, problems: list[str], reader_name: str) -> Any:
    """Validate a TOML table by a schema: return it with converted types, or append its faults to ``problems`` and
    return None."""
    try:
        return TypeAdapter(schema).validate_json(json.dumps(table), strict=True)
    except ValidationError as error:
        faults = error.errors()
        problems += [_validation_fault_text(key, fault, schema, reader_name) for fault in faults[:MAX_REPORTED_FAULTS]]
        problems += [f"{key or 'the file'} has {len(faults) - MAX_REPORTED_FAULTS} faults more"] * (
            len(faults) > MAX_REPORTED_FAULTS
        )
        return None


def _validation_fault_text(key: str, fault: Mapping[str, Any], schema: type, reader_name: str) -> str:
    """Return an error of pydantic as a message that begins with the key of the faulty entry."""
    name = ".".join(filter(None, [key, *(str(key_part) for key_part in _location_without_union_tags(fault["loc"]))]))
    name = re.sub(r"\.(\d+)\b", r"[\1]", name)
    if fault["type"] == "extra_forbidden":
        keys = _allowed_keys(schema, fault["loc"])
        hint, allowed_text = did_you_mean_text(fault["loc"][-1], keys), ", ".join(keys) or "none"
        return f"{name}: no such key{hint}; {reader_name} takes {allowed_text}"
    if fault["type"] == "missing":
        field = _model_fields(schema).get(fault["loc"][-1])
        return f"{name} is missing" + (f": {field.description}" if field else f"; {reader_name} needs it")
    if fault["type"] in ("model_type", "dict_type"):
        return f"{name} = {format_value(fault['input'])}: must be a section [{name}]"
    message = re.sub(r"^Input should|^(List|Tuple) should", "must", fault["msg"])
    return f"{name} = {format_value(fault['input'])}: {message}"


UNION_TAG_NAMES = ("number", "table", "list", "points", "sample", "word", "measure")
"""Tags of the alternatives of a key, which pydantic inserts into the locations of its errors."""


def _location_without_union_tags(location: tuple) -> list:
    """Return the location of a pydantic error without the union tags that pydantic inserts after keys."""
    return [key_part for i, key_part in enumerate(location) if i == 0 or key_part not in UNION_TAG_NAMES]


def _allowed_keys(schema: type, location: tuple) -> list[str]:
    """Return the keys that the schema allows in the table at a location, for the message about an unknown key."""
    for key_part in location[:-1]:
        if isinstance(key_part, str) and key_part in SCHEMA_BY_TAG:
            schema = SCHEMA_BY_TAG[key_part]
        elif (field := _model_fields(schema).get(key_part)) is not None:
            nested_models = [kind for kind in (field.annotation, *get_args(field.annotation)) if _model_fields(kind)]
            schema = nested_models[0] if nested_models else schema
    return list(_model_fields(schema) or schema.__annotations__)


def _model_fields(schema: Any) -> dict[str, Any]:
    """Return the fields of a model of pydantic; {} for a typed dictionary or any other type."""
    return getattr(schema, "model_fields", {})


def validate_function_arguments(
    key: str, function: Callable, table: dict, problems: list[str]
) -> dict[str, Any] | None:
    """Validate a table by the signature and annotations of a function: return it as keyword arguments, or append its
    faults to ``problems`` and return None."""
    try:
        hints = get_type_hints(function.__init__ if inspect.isclass(function) else function)
    except Exception:  # annotations with names that exist only for type checkers
        hints = {}
    fields: dict[str, Any] = {}
    extra_keys_rule: Literal["allow", "forbid"] = "forbid"
    for name, parameter in inspect.signature(function).parameters.items():
        if parameter.kind in (parameter.POSITIONAL_OR_KEYWORD, parameter.KEYWORD_ONLY):
            requirement = Required if parameter.default is parameter.empty else NotRequired
            fields[name] = requirement[_toml_value_type(hints.get(name, Any))]
        elif parameter.kind is parameter.VAR_KEYWORD:
            extra_keys_rule = "allow"
    name = callable_name(function, "the function")
    schema = with_config(ConfigDict(extra=extra_keys_rule))(TypedDict(name, fields))  # type: ignore[operator]
    return validate_table_by_schema(key, schema, table, problems, name)


def _toml_value_type(type_hint) -> Any:
    """Return the only member of a union type that a TOML value can have; Any if there is not exactly one."""
    if get_origin(type_hint) in (Union, UnionType):
        alternatives = [
            alternative
            for alternative in get_args(type_hint)
            if alternative is not NoneType and _is_toml_value_type(alternative)
        ]
        return alternatives[0] if len(alternatives) == 1 else Any
    return type_hint if _is_toml_value_type(type_hint) else Any


def _is_toml_value_type(type_hint) -> bool:
    """Return True if TOML values can be of this type: numbers, texts, lists and tables of these."""
    if get_origin(type_hint) in (list, tuple, Sequence, dict, Mapping):
        return all(argument is Ellipsis or _is_toml_value_type(argument) for argument in get_args(type_hint))
    return get_origin(type_hint) is Literal or type_hint in (bool, int, float, str, list, tuple, dict, Any)


@dataclass(frozen=True)
class Spec:
    """The validated content of a spec file, from which a run or a study is started.

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
    study : StudySection, optional
    """

    path: Path
    table: dict[str, Any]
    build: Callable[..., System]
    parameters: dict[str, Any]
    method: Any
    run: Run
    outputs: Outputs
    study: StudySection | None = None

    @property
    def step(self) -> float | Adaptive:
        """The step as an argument of :func:`liethermo.integrate`."""
        step = self.run.step
        if isinstance(step, AdaptiveStep):
            return Adaptive(step.adaptive, step.atol, step.first, step.largest)
        return step

    @property
    def until(self) -> Relaxed | None:
        """The event that ends the runs, or None."""
        return None if self.run.until is None else Relaxed(self.run.until.relaxed)

    @property
    def model_arguments(self) -> dict[str, Any]:
        """All arguments of the model, with the values in this file or the defaults."""
        signature_parameters = inspect.signature(self.build).parameters.values()
        defaults = {
            p.name: None if p.default is p.empty else p.default
            for p in signature_parameters
            if p.kind is not p.VAR_KEYWORD
        }
        return {**defaults, **self.parameters}

    @property
    def summary(self) -> str:
        """Model, method, step and time span in one line."""
        start, end = self.run.t_span
        step = self.step if isinstance(self.step, Adaptive) else f"step {self.step:g}"
        return f"{self.model_name}, {self.method}, {step}, t = {start:g} to {end:g}"

    def build_system(self) -> System:
        """Build and return the system, after checking that the initial state and the figures suit it.

        Raises
        ------
        SpecError
            If the parameters, the initial state or a figure do not suit the system.
        AxiomError
            If the system is not metriplectic.
        """
        try:
            system = self.build(**self.parameters)
        except AxiomError:
            raise
        except Exception as error:  # user code
            raise self._model_error(describe_user_error(error, self.build)) from error
        if not isinstance(system, System):
            raise self._model_error(f"it returned {system!r:.60}, not a system such as lt.LiePoissonSystem")
        try:
            system.state(self.run.initial)
        except InputError as error:
            raise SpecError(self.path, [f"run.initial = {format_value(self.run.initial)}: {error}"]) from error
        if "momentum_sphere" in self.outputs.figures and system.body_dim != 3:
            problem = f"momentum_sphere needs states of 3 components, and these have {system.body_dim}"
            raise SpecError(self.path, [f"outputs.figures = {format_value(self.outputs.figures)}: {problem}"])
        return system

    @property
    def model_name(self) -> str:
        """The name of the model, or ``module:function``."""
        return self.table["model"].get("name") or self.table["model"]["function"]

    def _model_error(self, reason: str) -> SpecError:
        """Return a SpecError about the section ``[model]``."""
        return SpecError(self.path, [f"{format_table_entries('model', self.table['model'])}: {reason}"])


def read(
    path: str | os.PathLike,
    changes: Sequence[str] = (),
    allow: Sequence[str] = (),
    report: Callable[[str], object] | None = None,
) -> Spec:
    """Read a spec file and return its validated content; :meth:`Spec.build_system` validates the system.

    Parameters
    ----------
    path : path
    changes : sequence of str
        Texts "section.key=value" that override the file; values as in TOML.
    allow : sequence of str
        Modules that the file may name although they are not beside it: see :mod:`.trust`.
    report : function, optional
        Called with a text that names each file or module before it is imported.

    Raises
    ------
    FileError
        If the file cannot be read.
    SpecError
        With all faults of the file.
    """
    path = disk.checked_path(path)
    table = _parse_file(path)
    problems: list[str] = []
    for change in changes:
        _apply_command_line_change(table, change, problems)
    validate_table_by_schema("", SpecContents, table, problems, "a spec file")
    section_names = [name for name in SECTIONS if name != "study" or "study" in table]
    sections = {
        name: validate_table_by_schema(name, SECTIONS[name], table.get(name, {}), problems, f"[{name}]")
        for name in section_names
    }
    model, run, method, outputs = (sections[name] for name in ("model", "run", "method", "outputs"))
    build: Any = model and _import_model_function(model, path.resolve().parent, allow, report, problems)
    parameters: Any = build and validate_function_arguments("model.parameters", build, model.parameters, problems)
    integrator = method and _build_method(method, problems)
    if problems:
        raise SpecError(path, problems)
    return Spec(path, table, build, parameters, integrator, run, outputs, sections.get("study"))


MAX_SPEC_BYTES = 2**20
"""Maximum size of a spec file in bytes."""

MAX_KEY_PARTS = 100
"""Maximum number of parts of a dotted key."""


def _parse_file(path: Path) -> dict[str, Any]:
    """Read a TOML file as JSON data; raise FileError if it cannot be read, SpecError if it is too large or invalid."""
    with disk.file_errors("read the spec file", path), open(path, "rb") as file:
        content = file.read(MAX_SPEC_BYTES + 1)
    if len(content) > MAX_SPEC_BYTES:
        raise SpecError(path, [f"it is larger than the {MAX_SPEC_BYTES // 2**20} MB that a spec file has at most"])
    try:
        return _parse_toml(content.decode("utf-8"))
    except ValueError as error:
        raise SpecError(path, [f"it is not valid TOML: {error}"]) from error


def _parse_toml(text: str) -> dict[str, Any]:
    """Parse TOML text and return it as JSON data; raise ValueError if it is invalid or nested too deeply."""
    for number, line in enumerate(text.splitlines(), start=1):
        if line.partition("=")[0].count(".") > MAX_KEY_PARTS and not line.lstrip().startswith("#"):
            raise ValueError(f"a key of more than {MAX_KEY_PARTS} parts (at line {number})")
    try:
        return json.loads(
            json.dumps(tomllib.loads(text), default=str)
        )  # dates and times become texts, which no key accepts
    except RecursionError:
        raise ValueError("it has lists or tables inside each other, too many") from None


def _apply_command_line_change(table: dict[str, Any], change: str, problems: list[str]) -> None:
    """Set the entry of the spec that a command-line option ``--set section.key=value`` changes.

    A fault of the option is appended to ``problems``.
    """
    key, equals, text = change.partition("=")
    key_parts = key.strip().split(".")
    if not equals or not all(key_parts):
        problems.append(f"--set {change}: must be section.key=value, such as run.step=0.01")
        return
    if len(key_parts) > MAX_KEY_PARTS:
        problems.append(f"--set {change:.60}...: a key of more than {MAX_KEY_PARTS} parts")
        return
    try:
        value = _parse_toml(f"value = {text}")["value"]
    except (ValueError, KeyError):
        value = text.strip()  # a text whose quotes the shell has removed
    for key_part in key_parts[:-1]:
        table = table.setdefault(key_part, {})
        if not isinstance(table, dict):
            problems.append(f"--set {change}: {key_part} is not a section")
            return
    table[key_parts[-1]] = value


def _import_model_function(
    model: Model,
    folder: Path,
    allowed_modules: Sequence[str],
    report: Callable[[str], object] | None,
    problems: list[str],
) -> Callable[..., System] | None:
    """Import the function that the section ``[model]`` names; append a fault to ``problems`` and return None if that
    fails."""
    if model.name is not None and model.function is None:
        return getattr(models, model.name)
    if model.function is not None and model.name is None:
        try:
            return import_function(model.function, folder, allowed_modules, report)
        except InputError as error:
            problems.append(f"model.function = {format_value(model.function)}: {error}")
            return None
    names = ", ".join(map(format_value, models.__all__))
    problems.append(f'model: give either name (one of {names}) or function = "module:function", not both')
    return None


def _build_method(method: Method, problems: list[str]):
    """Build the integrator that the section ``[method]`` describes; append a fault to ``problems`` and return None if
    that fails."""
    if method.name is None and not method.model_extra:
        return DEFAULT_METHOD
    method_class = METHODS[method.name or "MetriplecticMidpoint"]
    options = validate_function_arguments("method", method_class, method.model_extra or {}, problems)
    if options is None:
        return None
    try:
        return method_class(**options)
    except (TypeError, ValueError) as error:
        allowed_words = set(re.findall(r"\w+", str(error))).difference(
            map(str, options.values())
        )  # words of the message without the given values
        hints = [did_you_mean_text(value, allowed_words) for value in options.values() if isinstance(value, str)]
        problems.append(f"{format_table_entries('method', options)}: {error}{''.join(hints)}")
        return None


INITIAL_STATE_KEY = "initial"
"""Name of the initial state among the parameters that an axis can vary."""


@dataclass(frozen=True)
class PointBuilder:
    """Picklable function that calls ``build`` with a table of arguments in which the parameters of a point are set."""

    build: Callable[..., Any]
    table: Mapping[str, Any]
    varied_names: tuple[str, ...]

    def __call__(self, point: Mapping[str, Any]) -> Any:
        table = copy.deepcopy(dict(self.table))
        for name in self.varied_names:
            _set_table_entry(table, name, point[name])
        return self.build(**table)


def _stack_initial_state(initial: Sequence[Any]) -> jnp.ndarray:
    """Return an array of shape (n,) from the entries of an initial state, some of which may be traced."""
    return jnp.stack([jnp.asarray(value, dtype=jnp.float64) for value in initial])


def _set_table_entry(table: dict[str, Any], entry_name: str, value: Any) -> None:
    """Set a key such as ``rate``, or a list entry such as ``inertia[0]``, in a table; lists are copied before."""
    key, *index = _parse_entry_name(entry_name)
    if not index:
        table[key] = value
        return
    container = table[key] = list(table[key])
    for i in index[:-1]:
        container[i] = list(container[i])
        container = container[i]
    container[index[-1]] = value


def _parse_entry_name(entry_name: str) -> list[Any]:
    """Split a name such as ``inertia[0][1]`` into its key and indices, ``["inertia", 0, 1]``."""
    key, *index = re.split(r"[\[\]]+", entry_name.rstrip("]")) if "[" in entry_name else [entry_name]
    return [key, *map(int, index)]


def build_study(spec: Spec, store: str | os.PathLike) -> Study:
    """Build the :class:`Study` that the section ``[study]`` of a spec file describes.

    Raises
    ------
    SpecError
        With all faults of the section.
    """
    section = spec.study
    if section is None:
        raise SpecError(spec.path, ["study is missing: a section [study] with axes"])
    problems: list[str] = []
    axes = {name: _parse_axis(f"study.axes.{name}", axis, problems) for name, axis in section.axes.items()}
    measures = {
        name: _parse_measure(f"study.measure.{name}", measure, problems) for name, measure in section.measure.items()
    }
    names = [
        name
        for axis, values in axes.items()
        for name in (values.columns if isinstance(values, Zipped) and values.columns else [axis])
    ]
    for name in names:
        _check_parameter_can_vary(name, spec, problems)
    if problems:
        raise SpecError(spec.path, problems)
    parameter_names, state_names = (
        [n for n in names if (_parse_entry_name(n)[0] == INITIAL_STATE_KEY) == initial] for initial in (False, True)
    )
    initial = list(spec.run.initial)
    entries = {
        _parse_entry_name(name)[0] for name in parameter_names if "[" in name
    }  # defaults of the model that only an axis mentions
    parameters = {**{name: spec.model_arguments[name] for name in entries}, **spec.parameters}
    try:
        return Study(
            PointBuilder(spec.build, parameters, tuple(parameter_names)),
            axes,
            x0=PointBuilder(_stack_initial_state, {INITIAL_STATE_KEY: initial}, tuple(state_names))
            if state_names
            else np.array(initial),
            t_span=spec.run.t_span,
            step=spec.step,
            method=spec.method,
            measure=measures,
            store=store,
            until=spec.until,
            attitude=None if spec.run.attitude is None else np.array(spec.run.attitude),
            chunk=section.chunk,
            units=section.units,
            names=section.names,
            spec=spec.table,
        )
    except InputError as error:
        raise SpecError(spec.path, [f"study: {error}"]) from error


def _parse_axis(key: str, axis: Any, problems: list[str]) -> Any:
    """Convert an axis of a spec file to the argument of :class:`Study`; append a fault to ``problems`` and return None
    if that fails."""
    try:
        if isinstance(axis, EvenlySpacedAxis):
            grid_function = np.geomspace if axis.scale == "log" else np.linspace
            if axis.scale == "log" and min(axis.first, axis.last) <= 0.0:
                raise InputError("the values of a logarithmic axis must be positive")
            return grid_function(axis.first, axis.last, axis.points)
        if not isinstance(axis, SampledAxis):
            return axis
        sample_kinds = [name for name in ("zip", "latin_hypercube", "sobol") if getattr(axis, name) is not None]
        if len(sample_kinds) != 1:
            raise InputError("must have one of zip, latin_hypercube and sobol, or first, last and points")
        if axis.zip is not None:
            return zipped(**axis.zip)
        sampler = sobol if axis.sobol is not None else latin_hypercube
        return sampler(getattr(axis, sample_kinds[0]), seed=axis.seed, **(axis.ranges or {}))
    except InputError as error:
        problems.append(f"{key}: {error}")
        return None


def _parse_measure(key: str, measure: Any, problems: list[str]) -> Any:
    """Convert a measure of a spec file to the argument of :class:`Study`; append a fault to ``problems`` and return
    None if that fails."""
    if not isinstance(measure, MeasureTable):
        return measure
    if (measure.relaxed is None) == (measure.at is None):
        problems.append(f"{key}: must have one of relaxed and at")
        return None
    try:
        return Relaxed(measure.relaxed) if measure.relaxed is not None else At(measure.at, measure.what)
    except InputError as error:
        problems.append(f"{key}: {error}")
        return None


def _check_parameter_can_vary(parameter_name: str, spec: Spec, problems: list[str]) -> None:
    """Append a fault to ``problems`` unless the axis of a study can vary the parameter: a number, or a list entry."""
    if not re.fullmatch(r"\w+(\[\d{1,9}\])*", parameter_name):
        problems.append(
            f"study.axes: {format_value(parameter_name)} must be the name of a parameter, or an entry such as "
            "inertia[0]"
        )
        return
    key, *index = _parse_entry_name(parameter_name)
    arguments = {**spec.model_arguments, INITIAL_STATE_KEY: list(spec.run.initial)}
    if key not in arguments:
        options = [*arguments]
        hint = did_you_mean_text(key, options)
        problems.append(f"study.axes: {spec.model_name} has no parameter {key}{hint}; it has {', '.join(options)}")
        return
    value = arguments[key]
    for i in index:
        if not isinstance(value, list | tuple) or i >= len(value):
            problems.append(f"study.axes: {parameter_name} is not an entry of {key} = {format_value(arguments[key])}")
            return
        value = value[i]
    if isinstance(value, list | tuple):
        problems.append(
            f"study.axes: {parameter_name} = {format_value(value)} is a list; an axis is one entry of it, "
            f"such as {parameter_name}[0]"
        )
