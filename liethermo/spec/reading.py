"""Reading of a spec file, validated completely before anything is computed."""

from __future__ import annotations

import inspect
import json
import os
import re
import tomllib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from .. import disk, models
from ..errors import AxiomError, InputError, SpecError
from ..integrators import DEFAULT_METHOD, METHODS
from ..runs.adaptive import Adaptive
from ..runs.events import Relaxed
from ..systems import System
from .checking import validate_arguments, validate_table
from .messages import describe_exception, format_table, format_value, suggest_match
from .schema import SECTIONS, AdaptiveStep, Method, Model, Outputs, Run, SpecContents, StudySection
from .trust import import_function


@dataclass(frozen=True)
class Spec:
    """A validated spec file: a run that is ready to start.

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
        """Build the system, and check the initial state and the figures against it.

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
            raise self._model_error(describe_exception(error, self.build)) from error
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
        return SpecError(self.path, [f"{format_table('model', self.table['model'])}: {reason}"])


def read(
    path: str | os.PathLike,
    changes: Sequence[str] = (),
    allow: Sequence[str] = (),
    report: Callable[[str], object] | None = None,
) -> Spec:
    """Read a spec file and validate everything but the system, which :meth:`Spec.build_system` validates.

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
    path = Path(path)
    table = _parse_file(path)
    problems: list[str] = []
    for change in changes:
        _apply_change(table, change, problems)
    validate_table("", SpecContents, table, problems, "a spec file")
    section_names = [name for name in SECTIONS if name != "study" or "study" in table]
    sections = {
        name: validate_table(name, SECTIONS[name], table.get(name, {}), problems, f"[{name}]") for name in section_names
    }
    model, run, method, outputs = (sections[name] for name in ("model", "run", "method", "outputs"))
    build: Any = model and _model_function(model, path.resolve().parent, allow, report, problems)
    parameters: Any = build and validate_arguments("model.parameters", build, model.parameters, problems)
    integrator = method and _build_method(method, problems)
    if problems:
        raise SpecError(path, problems)
    return Spec(path, table, build, parameters, integrator, run, outputs, sections.get("study"))


MAX_SPEC_BYTES = 2**20
"""Maximum size of a spec file in bytes."""

MAX_KEY_PARTS = 100
"""Maximum number of parts of a dotted key."""


def _parse_file(path: Path) -> dict[str, Any]:
    with disk.file_errors("read the spec file", path), open(path, "rb") as file:
        content = file.read(MAX_SPEC_BYTES + 1)
    if len(content) > MAX_SPEC_BYTES:
        raise SpecError(path, [f"it is larger than the {MAX_SPEC_BYTES // 2**20} MB that a spec file has at most"])
    try:
        return _parse_toml(content.decode("utf-8"))
    except ValueError as error:
        raise SpecError(path, [f"it is not valid TOML: {error}"]) from error


def _parse_toml(text: str) -> dict[str, Any]:
    """Return TOML text as JSON data; raise ValueError if it is invalid or nested too deeply."""
    for number, line in enumerate(text.splitlines(), start=1):
        if line.partition("=")[0].count(".") > MAX_KEY_PARTS and not line.lstrip().startswith("#"):
            raise ValueError(f"a key of more than {MAX_KEY_PARTS} parts (at line {number})")
    try:
        return json.loads(
            json.dumps(tomllib.loads(text), default=str)
        )  # dates and times become texts, which no key accepts
    except RecursionError:
        raise ValueError("it has lists or tables inside each other, too many") from None


def _apply_change(table: dict[str, Any], change: str, problems: list[str]) -> None:
    """Apply one ``--set`` option to the content of a file."""
    key, equals, text = change.partition("=")
    parts = key.strip().split(".")
    if not equals or not all(parts):
        problems.append(f"--set {change}: must be section.key=value, such as run.step=0.01")
        return
    if len(parts) > MAX_KEY_PARTS:
        problems.append(f"--set {change:.60}...: a key of more than {MAX_KEY_PARTS} parts")
        return
    try:
        value = _parse_toml(f"value = {text}")["value"]
    except (ValueError, KeyError):
        value = text.strip()  # a text whose quotes the shell has removed
    for part in parts[:-1]:
        table = table.setdefault(part, {})
        if not isinstance(table, dict):
            problems.append(f"--set {change}: {part} is not a section")
            return
    table[parts[-1]] = value


def _model_function(
    model: Model,
    folder: Path,
    allowed_modules: Sequence[str],
    report: Callable[[str], object] | None,
    problems: list[str],
) -> Callable[..., System] | None:
    """Return the function that the section ``[model]`` names, or None after appending a fault to ``problems``."""
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
    if method.name is None and not method.model_extra:
        return DEFAULT_METHOD
    kind = METHODS[method.name or "MetriplecticMidpoint"]
    options = validate_arguments("method", kind, method.model_extra or {}, problems)
    if options is None:
        return None
    try:
        return kind(**options)
    except (TypeError, ValueError) as error:
        allowed_words = set(re.findall(r"\w+", str(error))).difference(
            map(str, options.values())
        )  # words of the message without the given values
        hints = [suggest_match(value, allowed_words) for value in options.values() if isinstance(value, str)]
        problems.append(f"{format_table('method', options)}: {error}{''.join(hints)}")
        return None
