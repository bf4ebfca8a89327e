"""The section ``[study]`` of a spec file as a study."""

from __future__ import annotations

import copy
import os
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np

from ..errors import InputError, SpecError
from ..runs.events import Relaxed
from ..studies.axes import Zipped, latin_hypercube, sobol, zipped
from ..studies.measures import At
from ..studies.study import Study
from ..systems import System
from .messages import format_value, suggest_match
from .reading import Spec
from .schema import EvenlySpacedAxis, MeasureTable, SampledAxis

INITIAL_STATE_KEY = "initial"
"""The name of the initial state among the parameters of axes."""


@dataclass(frozen=True)
class SystemBuilder:
    """The function from a point to the system of a spec file with the parameters of the point."""

    build: Callable[..., System]
    parameters: Mapping[str, Any]
    varied_names: tuple[str, ...]

    def __call__(self, point: Mapping[str, Any]) -> System:
        found = copy.deepcopy(dict(self.parameters))
        for name in self.varied_names:
            _set_entry(found, name, point[name])
        return self.build(**found)


@dataclass(frozen=True)
class InitialStateBuilder:
    """The function from a point to its initial state."""

    initial: tuple[float, ...]
    varied_names: tuple[str, ...]

    def __call__(self, point: Mapping[str, Any]):
        found = {INITIAL_STATE_KEY: list(self.initial)}
        for name in self.varied_names:
            _set_entry(found, name, point[name])
        return jnp.stack([jnp.asarray(value, dtype=jnp.float64) for value in found[INITIAL_STATE_KEY]])


def _set_entry(table: dict[str, Any], name: str, value: Any) -> None:
    """Set ``inertia[0]``, or ``rate``, in a table."""
    whole, *index = _parse_entry_name(name)
    if not index:
        table[whole] = value
        return
    place = table[whole] = list(table[whole])
    for i in index[:-1]:
        place[i] = list(place[i])
        place = place[i]
    place[index[-1]] = value


def _parse_entry_name(name: str) -> list[Any]:
    whole, *index = re.split(r"[\[\]]+", name.rstrip("]")) if "[" in name else [name]
    return [whole, *map(int, index)]


def build_study(plan: Spec, store: str | os.PathLike) -> Study:
    """The study that a spec file describes.

    Raises
    ------
    SpecError
        With all that is wrong in the section.
    """
    section = plan.study
    if section is None:
        raise SpecError(plan.path, ["study is missing: a section [study] with axes"])
    problems: list[str] = []
    axes = {name: _parse_axis(f"study.axes.{name}", axis, problems) for name, axis in section.axes.items()}
    measures = {
        name: _parse_measure(f"study.measure.{name}", given, problems) for name, given in section.measure.items()
    }
    names = [
        name
        for axis, values in axes.items()
        for name in (values.columns if isinstance(values, Zipped) and values.columns else [axis])
    ]
    for name in names:
        _check_settable(name, plan, problems)
    if problems:
        raise SpecError(plan.path, problems)
    own, start = (
        [n for n in names if (_parse_entry_name(n)[0] == INITIAL_STATE_KEY) == initial] for initial in (False, True)
    )
    initial = tuple(plan.run.initial)
    entries = {_parse_entry_name(name)[0] for name in own if "[" in name}  # of arguments that may not be in the file
    parameters = {**{name: plan.model_arguments[name] for name in entries}, **plan.parameters}
    try:
        return Study(
            SystemBuilder(plan.build, parameters, tuple(own)),
            axes,
            x0=InitialStateBuilder(initial, tuple(start)) if start else np.array(initial),
            t_span=plan.run.t_span,
            step=plan.step,
            method=plan.method,
            measure=measures,
            store=store,
            until=plan.until,
            attitude=None if plan.run.attitude is None else np.array(plan.run.attitude),
            chunk=section.chunk,
            units=section.units,
            names=section.names,
            spec=plan.table,
        )
    except InputError as error:
        raise SpecError(plan.path, [f"study: {error}"]) from error


def _parse_axis(key: str, axis: Any, problems: list[str]) -> Any:
    """An axis as :class:`Study` takes it."""
    try:
        if isinstance(axis, EvenlySpacedAxis):
            spread = np.geomspace if axis.scale == "log" else np.linspace
            if axis.scale == "log" and min(axis.first, axis.last) <= 0.0:
                raise InputError("the values of a logarithmic axis are positive")
            return spread(axis.first, axis.last, axis.points)
        if not isinstance(axis, SampledAxis):
            return axis
        given = [name for name in ("zip", "latin_hypercube", "sobol") if getattr(axis, name) is not None]
        if len(given) != 1:
            raise InputError("must have one of zip, latin_hypercube and sobol, or first, last and points")
        if axis.zip is not None:
            return zipped(**axis.zip)
        sampler = sobol if axis.sobol is not None else latin_hypercube
        return sampler(getattr(axis, given[0]), seed=axis.seed, **(axis.ranges or {}))
    except InputError as error:
        problems.append(f"{key}: {error}")
        return None


def _parse_measure(key: str, given: Any, problems: list[str]) -> Any:
    """A measure as :class:`Study` takes it."""
    if not isinstance(given, MeasureTable):
        return given
    if (given.relaxed is None) == (given.at is None):
        problems.append(f"{key}: must have one of relaxed and at")
        return None
    try:
        return Relaxed(given.relaxed) if given.relaxed is not None else At(given.at, given.what)
    except InputError as error:
        problems.append(f"{key}: {error}")
        return None


def _check_settable(name: str, plan: Spec, problems: list[str]) -> None:
    """Whether a parameter of an axis can be set."""
    if not re.fullmatch(r"\w+(\[\d{1,9}\])*", name):
        problems.append(
            f"study.axes: {format_value(name)} must be the name of a parameter, or an entry such as inertia[0]"
        )
        return
    whole, *index = _parse_entry_name(name)
    known = {**plan.model_arguments, INITIAL_STATE_KEY: list(plan.run.initial)}
    if whole not in known:
        options = [*known]
        hint = suggest_match(whole, options)
        problems.append(f"study.axes: {plan.model_name} has no parameter {whole}{hint}; it has {', '.join(options)}")
        return
    value = known[whole]
    for i in index:
        if not isinstance(value, list | tuple) or i >= len(value):
            problems.append(f"study.axes: {name} is no entry of {whole} = {format_value(known[whole])}")
            return
        value = value[i]
    if isinstance(value, list | tuple):
        problems.append(
            f"study.axes: {name} = {format_value(value)} is a list; an axis is one entry of it, such as {name}[0]"
        )
