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
from .messages import shown, suggestion
from .reading import Spec
from .schema import MeasureOfFile, Points, Sample

INITIAL = "initial"
"""The name of the initial state among the parameters of axes."""


@dataclass(frozen=True)
class Builder:
    """The function from a point to the system of a spec file with the parameters of the point."""

    build: Callable[..., System]
    parameters: Mapping[str, Any]
    names: tuple[str, ...]

    def __call__(self, point: Mapping[str, Any]) -> System:
        found = copy.deepcopy(dict(self.parameters))
        for name in self.names:
            _put(found, name, point[name])
        return self.build(**found)


@dataclass(frozen=True)
class Start:
    """The function from a point to its initial state."""

    initial: tuple[float, ...]
    names: tuple[str, ...]

    def __call__(self, point: Mapping[str, Any]):
        found = {INITIAL: list(self.initial)}
        for name in self.names:
            _put(found, name, point[name])
        return jnp.stack([jnp.asarray(value, dtype=jnp.float64) for value in found[INITIAL]])


def _put(table: dict[str, Any], name: str, value: Any) -> None:
    """Set ``inertia[0]``, or ``rate``, in a table."""
    whole, *index = _parts(name)
    if not index:
        table[whole] = value
        return
    place = table[whole] = list(table[whole])
    for i in index[:-1]:
        place[i] = list(place[i])
        place = place[i]
    place[index[-1]] = value


def _parts(name: str) -> list[Any]:
    whole, *index = re.split(r"[\[\]]+", name.rstrip("]")) if "[" in name else [name]
    return [whole, *map(int, index)]


def study_of(plan: Spec, store: str | os.PathLike) -> Study:
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
    axes = {name: _axis(f"study.axes.{name}", axis, problems) for name, axis in section.axes.items()}
    measures = {name: _measure(f"study.measure.{name}", given, problems) for name, given in section.measure.items()}
    names = [
        name
        for axis, values in axes.items()
        for name in (values.columns if isinstance(values, Zipped) and values.columns else [axis])
    ]
    for name in names:
        _check_name(name, plan, problems)
    if problems:
        raise SpecError(plan.path, problems)
    own, start = ([n for n in names if (_parts(n)[0] == INITIAL) == initial] for initial in (False, True))
    initial = tuple(plan.run.initial)
    entries = {_parts(name)[0] for name in own if "[" in name}  # of arguments that may not be in the file
    parameters = {**{name: plan.allowed[name] for name in entries}, **plan.parameters}
    try:
        return Study(
            Builder(plan.build, parameters, tuple(own)),
            axes,
            x0=Start(initial, tuple(start)) if start else np.array(initial),
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


def _axis(key: str, axis: Any, problems: list[str]) -> Any:
    """An axis as :class:`Study` takes it."""
    try:
        if isinstance(axis, Points):
            spread = np.geomspace if axis.scale == "log" else np.linspace
            if axis.scale == "log" and min(axis.first, axis.last) <= 0.0:
                raise InputError("the values of a logarithmic axis are positive")
            return spread(axis.first, axis.last, axis.points)
        if not isinstance(axis, Sample):
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


def _measure(key: str, given: Any, problems: list[str]) -> Any:
    """A measure as :class:`Study` takes it."""
    if not isinstance(given, MeasureOfFile):
        return given
    if (given.relaxed is None) == (given.at is None):
        problems.append(f"{key}: must have one of relaxed and at")
        return None
    try:
        return Relaxed(given.relaxed) if given.relaxed is not None else At(given.at, given.what)
    except InputError as error:
        problems.append(f"{key}: {error}")
        return None


def _check_name(name: str, plan: Spec, problems: list[str]) -> None:
    """Whether a parameter of an axis can be set."""
    if not re.fullmatch(r"\w+(\[\d{1,9}\])*", name):
        problems.append(f"study.axes: {shown(name)} must be the name of a parameter, or an entry such as inertia[0]")
        return
    whole, *index = _parts(name)
    known = {**plan.allowed, INITIAL: list(plan.run.initial)}
    if whole not in known:
        options = [*known]
        hint = suggestion(whole, options)
        problems.append(f"study.axes: {plan.model} has no parameter {whole}{hint}; it has {', '.join(options)}")
        return
    value = known[whole]
    for i in index:
        if not isinstance(value, list | tuple) or i >= len(value):
            problems.append(f"study.axes: {name} is no entry of {whole} = {shown(known[whole])}")
            return
        value = value[i]
    if isinstance(value, list | tuple):
        problems.append(f"study.axes: {name} = {shown(value)} is a list; an axis is one entry of it, such as {name}[0]")
