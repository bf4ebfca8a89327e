"""Conversion of the section ``[study]`` of a spec file to a :class:`.Study`."""

from __future__ import annotations

import copy
import os
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np

from ..errors import InputError, SpecError
from ..runs.events import Relaxed
from ..studies.axes import Zipped, latin_hypercube, sobol, zipped
from ..studies.measures import At
from ..studies.study import Study
from .reading import Spec
from .schema import EvenlySpacedAxis, MeasureTable, SampledAxis, format_value, suggest_match

INITIAL_STATE_KEY = "initial"
"""Name of the initial state among the parameters that an axis can vary."""


@dataclass(frozen=True)
class PointBuilder:
    """Picklable function of the parameters of a point: it calls ``build`` with a table in which these are set."""

    build: Callable[..., Any]
    table: Mapping[str, Any]
    varied_names: tuple[str, ...]

    def __call__(self, point: Mapping[str, Any]) -> Any:
        table = copy.deepcopy(dict(self.table))
        for name in self.varied_names:
            _set_entry(table, name, point[name])
        return self.build(**table)


def _initial_state(initial: Sequence[Any]) -> jnp.ndarray:
    """Return the initial state, shape (n,), some of whose entries may be traced."""
    return jnp.stack([jnp.asarray(value, dtype=jnp.float64) for value in initial])


def _set_entry(table: dict[str, Any], name: str, value: Any) -> None:
    """Set ``rate`` or an entry such as ``inertia[0]`` in a table, copying the lists on the way."""
    key, *index = _parse_entry_name(name)
    if not index:
        table[key] = value
        return
    container = table[key] = list(table[key])
    for i in index[:-1]:
        container[i] = list(container[i])
        container = container[i]
    container[index[-1]] = value


def _parse_entry_name(name: str) -> list[Any]:
    key, *index = re.split(r"[\[\]]+", name.rstrip("]")) if "[" in name else [name]
    return [key, *map(int, index)]


def build_study(spec: Spec, store: str | os.PathLike) -> Study:
    """Return the study that a spec file describes.

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
        _report_if_not_settable(name, spec, problems)
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
            x0=PointBuilder(_initial_state, {INITIAL_STATE_KEY: initial}, tuple(state_names))
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
    """Return an axis as an argument of :class:`Study`, or None after appending a fault to ``problems``."""
    try:
        if isinstance(axis, EvenlySpacedAxis):
            grid_function = np.geomspace if axis.scale == "log" else np.linspace
            if axis.scale == "log" and min(axis.first, axis.last) <= 0.0:
                raise InputError("the values of a logarithmic axis are positive")
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
    """Return a measure as an argument of :class:`Study`, or None after appending a fault to ``problems``."""
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


def _report_if_not_settable(name: str, plan: Spec, problems: list[str]) -> None:
    """Append a fault to ``problems`` unless an axis can vary the parameter of this name."""
    if not re.fullmatch(r"\w+(\[\d{1,9}\])*", name):
        problems.append(
            f"study.axes: {format_value(name)} must be the name of a parameter, or an entry such as inertia[0]"
        )
        return
    key, *index = _parse_entry_name(name)
    arguments = {**plan.model_arguments, INITIAL_STATE_KEY: list(plan.run.initial)}
    if key not in arguments:
        options = [*arguments]
        hint = suggest_match(key, options)
        problems.append(f"study.axes: {plan.model_name} has no parameter {key}{hint}; it has {', '.join(options)}")
        return
    value = arguments[key]
    for i in index:
        if not isinstance(value, list | tuple) or i >= len(value):
            problems.append(f"study.axes: {name} is not an entry of {key} = {format_value(arguments[key])}")
            return
        value = value[i]
    if isinstance(value, list | tuple):
        problems.append(
            f"study.axes: {name} = {format_value(value)} is a list; an axis is one entry of it, such as {name}[0]"
        )
