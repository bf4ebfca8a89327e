"""Schema of spec files: the sections, their keys and descriptions, and messages about faults, which name the key."""

from __future__ import annotations

import difflib
import inspect
import json
import re
import traceback
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Discriminator, Field, FiniteFloat, Tag
from pydantic_core import PydanticCustomError

from .. import models
from ..integrators import METHODS


def pydantic_error(message: str) -> PydanticCustomError:
    return PydanticCustomError("refused", "{message}", {"message": message})


def format_value(value) -> str:
    """Return a value as text, nearly as in TOML, shortened to at most 60 characters."""
    text = json.dumps(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def format_table_entries(key: str, table: Mapping[str, Any]) -> str:
    """Return all entries of a table as a text of "key = value" pairs with full keys."""
    return ", ".join(
        format_table_entries(f"{key}.{name}", value)
        if isinstance(value, dict) and value
        else f"{key}.{name} = {format_value(value)}"
        for name, value in table.items()
    )


def did_you_mean_text(word: str, options: Iterable[str]) -> str:
    matches = difflib.get_close_matches(word, options, n=1)
    return f" (did you mean {matches[0]}?)" if matches else ""


def describe_user_error(error: Exception, function: Callable) -> str:
    """Return the text of an error; if user code raised it, with its type and the line of the function."""
    if type(error).__module__.split(".")[0] in ("liethermo", "manifolds"):
        return str(error)
    source_file = inspect.getsourcefile(inspect.unwrap(function)) if inspect.isroutine(function) else None
    lines = [frame.lineno for frame in traceback.extract_tb(error.__traceback__) if frame.filename == source_file]
    location = f" ({Path(source_file).name}, line {lines[-1]})" if source_file and lines else ""
    return f"{type(error).__name__}: {error}{location}"


FIGURES = ("momentum_sphere", "laws")
"""Names of the figures that ``liethermo run`` can draw."""

FORMATS = ("png", "pdf", "svg")
"""File formats of figures."""

MAX_AXIS_VALUES = 10**7
"""Maximum number of values of an axis."""


def one_of_validator(options: Iterable[str]) -> BeforeValidator:
    allowed_values = list(options)

    def require_allowed(value):
        if value not in allowed_values:
            hint = did_you_mean_text(str(value), allowed_values)
            raise pydantic_error(f"must be one of {', '.join(map(format_value, allowed_values))}{hint}")
        return value

    return BeforeValidator(require_allowed)


def _require_increasing(span: tuple[float, float]) -> tuple[float, float]:
    if span[1] <= span[0]:
        raise pydantic_error("must increase")
    return span


def _require_netcdf_name(name: str) -> str:
    if not re.fullmatch(r"[^/\\]+\.nc", name):
        raise pydantic_error('must be a file name that ends in .nc, without a folder, such as "solution.nc"')
    return name


class Section(BaseModel):
    model_config = ConfigDict(extra="forbid")


class SpecContents(Section):
    """Top level of a spec file."""

    model: Any = None
    run: Any = None
    method: Any = None
    outputs: Any = None
    study: Any = None


class Model(Section):
    """The model: one of the library, or a user's function that returns a system."""

    name: Annotated[str, one_of_validator(models.__all__)] | None = Field(
        None, description="a model of the library; `liethermo models` lists them"
    )
    function: str | None = Field(
        None,
        description='instead of a name: `"module:function"`, from a module beside the file or an allowed one',
    )
    parameters: dict[str, Any] = Field({}, description="the arguments of the model or the function")


class AdaptiveStep(Section):
    """Adaptive steps, chosen by the estimated error."""

    adaptive: FiniteFloat = Field(gt=0, description="the tolerance relative to the state: `lt.Adaptive(rtol)`")
    atol: FiniteFloat = Field(0.0, ge=0, description="the absolute tolerance")
    first: FiniteFloat | None = Field(None, gt=0, description="the first step to try")
    largest: FiniteFloat | None = Field(None, gt=0, description="the longest step")


class StopCondition(Section):
    """Condition that ends a run early."""

    relaxed: FiniteFloat = Field(gt=0, description="the rate of relaxation below which the run ends: `lt.Relaxed(tol)`")


def _step_union_tag(value: Any) -> str:
    return "table" if isinstance(value, dict) else "number"


Step = Annotated[
    Annotated[FiniteFloat, Field(gt=0), Tag("number")] | Annotated[AdaptiveStep, Tag("table")],
    Discriminator(_step_union_tag),
]


class Run(Section):
    """Initial state, time span and steps."""

    initial: list[FiniteFloat] = Field(min_length=1, description="the state to start from, a list of numbers")
    t_span: Annotated[tuple[FiniteFloat, FiniteFloat], AfterValidator(_require_increasing)] = Field(
        description="start and end, for example [0.0, 100.0]"
    )
    step: Step = Field(description="the step size, a number greater than 0, or {adaptive = 1e-8}")
    save_every: int = Field(1, ge=1, description="the number of steps between saved states")
    until: StopCondition | None = Field(
        None, description="a condition that ends the run early, for example {relaxed = 1e-8}"
    )
    attitude: list[list[FiniteFloat]] | None = Field(
        None, description="the element of the group at the start, a matrix, where the system has a group"
    )


class Method(BaseModel):
    """The integrator; all keys other than its name are its parameters."""

    model_config = ConfigDict(extra="allow")  # the parameters of the method, checked by its signature
    # options without a name belong to the midpoint scheme
    name: Annotated[str, one_of_validator(METHODS)] | None = Field(
        None, description=f"one of {', '.join(METHODS)}; the default is that of `integrate`"
    )


class Outputs(Section):
    """Files that `liethermo run` writes into its folder."""

    netcdf: Annotated[str, AfterValidator(_require_netcdf_name)] = Field(
        "solution.nc", description="the file of the solution"
    )
    figures: list[Annotated[str, one_of_validator(FIGURES)]] = Field(
        ["laws"], description=f"some of {', '.join(FIGURES)}"
    )
    figure_format: Annotated[str, one_of_validator(FORMATS)] = Field("png", description=f"one of {', '.join(FORMATS)}")


class EvenlySpacedAxis(Section):
    """Evenly spaced values of an axis."""

    first: FiniteFloat = Field(description="the first value")
    last: FiniteFloat = Field(description="the last value")
    points: int = Field(ge=1, le=MAX_AXIS_VALUES, description="the number of values")
    scale: Annotated[str, one_of_validator(("linear", "log"))] = Field("linear", description="linear, or log")


class SampledAxis(Section):
    """Several parameters that vary together along an axis."""

    zip: dict[str, list[FiniteFloat]] | None = Field(None, description="equally many values of each parameter")
    latin_hypercube: int | None = Field(
        None, ge=1, le=MAX_AXIS_VALUES, description="the number of points of a Latin hypercube, with `ranges`"
    )
    sobol: int | None = Field(
        None, ge=1, le=MAX_AXIS_VALUES, description="the number of points of a Sobol sequence, with `ranges`"
    )
    ranges: dict[str, list[FiniteFloat | str]] | None = Field(
        None, description='[low, high] or [low, high, "log"] of each parameter'
    )
    seed: int = Field(0, ge=0, description="the seed of the sample")


def _axis_union_tag(value: Any) -> str:
    return "list" if not isinstance(value, dict) else "points" if "points" in value else "sample"


AxisEntry = Annotated[
    Annotated[list[FiniteFloat | str], Field(min_length=1), Tag("list")]
    | Annotated[EvenlySpacedAxis, Tag("points")]
    | Annotated[SampledAxis, Tag("sample")],
    Discriminator(_axis_union_tag),
]


class MeasureTable(Section):
    """A measure with a parameter."""

    relaxed: FiniteFloat | None = Field(
        None, gt=0, description="the time of relaxation to a rate below this, where the run ends: `lt.Relaxed(tol)`"
    )
    at: list[FiniteFloat] | None = Field(None, min_length=1, description="the times at which values are measured")
    what: str = Field("x", description="the measured series: x, energy, entropy or attitude")


def _measure_union_tag(value: Any) -> str:
    return "measure" if isinstance(value, dict) else "word"


MeasureEntry = Annotated[
    Annotated[str, Tag("word")] | Annotated[MeasureTable, Tag("measure")], Discriminator(_measure_union_tag)
]


class StudySection(Section):
    """The parameter study that `liethermo study` runs: its axes and the measures of each point."""

    axes: dict[str, AxisEntry] = Field(
        min_length=1,
        description="by parameters of the model, entries of them or of the state (`rate`, `inertia[0]`, `initial[2]`): "
        "lists of values, {first, last, points, scale}, or {zip = ...}, {latin_hypercube, ranges, seed}, {sobol, ...}",
    )
    measure: dict[str, MeasureEntry] = Field(
        {"final": "final"},
        min_length=1,
        description='the measures, by names that you choose: `"final"`, `"relaxation_time"`, ..., {relaxed = 1e-8}, or '
        '{at = [1.0, 2.0], what = "x"}',
    )
    chunk: int | None = Field(None, ge=1, description="the approximate number of points of a chunk")
    units: dict[str, str] = Field({}, description="units of axes and measures")
    names: dict[str, str] = Field({}, description="long names of axes and measures")
    figure: str | None = Field(None, description="the measure to draw; by default the first that can be drawn")


SECTIONS = {"model": Model, "run": Run, "method": Method, "outputs": Outputs, "study": StudySection}
"""Schema of each section of a spec file."""


def list_spec_keys() -> list[tuple[str, str, str, str]]:
    """Return a row (section, key, default, description) for each key of a spec file, for the reference pages."""
    tables = {"run.step": AdaptiveStep, "run.until": StopCondition, "study.axes.NAME": (EvenlySpacedAxis, SampledAxis)}
    sections = [*SECTIONS.items(), *tables.items(), ("study.measure.NAME", MeasureTable)]
    rows = []
    for section, schemas in sections:
        for schema in schemas if isinstance(schemas, tuple) else (schemas,):
            for name, field in schema.model_fields.items():
                default = (
                    "needed" if field.is_required() else "" if field.default is None else format_value(field.default)
                )
                rows.append((section, name, default, field.description or ""))
    return rows
