"""What makes a study the one that it is: by content, so that the same study is known again in another process."""

from __future__ import annotations

import hashlib
import math
import re
from collections.abc import Mapping
from dataclasses import asdict, is_dataclass
from importlib import metadata
from typing import Any

import jax
import numpy as np

from .solve import PointResults, PointSolver

VALUE_RTOL = 1e-10
"""Relative difference of numbers that another version of JAX may compute."""

N_PROBE_STATES = 3
"""States at which the motion of the system is looked at."""


def describe_study(solver: PointSolver, columns: PointResults, x0: np.ndarray) -> dict[str, Any]:
    """A study as JSON data.

    Parameters
    ----------
    solver : Solver
    columns : Columns
        Of the example, which has been solved.
    x0 : array, shape (n,)
        Its initial state.
    """
    task, system = solver.task, solver.systems.example_system
    states = np.concatenate([x0[None], system.samples(N_PROBE_STATES, seed=1)])
    with np.errstate(all="ignore"):
        probe = [_as_json_numbers(_system_at(system, task.t_span[0]).vector_field(x)) for x in states]
        energies = [_as_json_numbers(system.energy.at_time(task.t_span[0]).value(x)) for x in states]
    return {
        "versions": {name: metadata.version(name) for name in ("liethermo", "jax")},
        "system": f"{type(system).__name__}, {system.dim} components",
        "motion": probe,
        "energy": energies,
        "operations": _program_digest(solver),
        "x0": _as_json_numbers(x0),
        "t_span": list(map(float, task.t_span)),
        "step": _step_as_json(task.step),
        "method": repr(task.method),
        "until": _event_as_json(task.until),
        "noise": None if task.noise is None else task.noise.to_provenance(),
        "measures": {name: measure.description() for name, measure in task.measures.items()},
        "values": {name: _as_json_numbers(columns.measures[name][0]) for name in task.measures},
    }


def provenance(described: Mapping[str, Any], engine: str) -> dict[str, Any]:
    """Where the results come from, for people."""
    chosen = {key: described[key] for key in ("system", "method", "step", "t_span", "until", "noise")}
    return {
        **chosen,
        **{f"{name}_version": version for name, version in described["versions"].items()},
        "engine": engine,
    }


def study_differences(mine: Mapping[str, Any], theirs: Mapping[str, Any]) -> list[str]:
    """In what two studies differ, a line each; empty for the same study."""
    same_versions = mine["versions"] == theirs["versions"]
    found = [
        f"{key} is {mine[key]!r:.120}, and {theirs.get(key)!r:.120} in the store"
        for key in ("system", "t_span", "step", "method", "until", "noise", "measures")
        if mine[key] != theirs.get(key)
    ]
    if found:
        return found
    numbers = {
        "motion": "the vector field",
        "energy": "the energy",
        "x0": "the initial state",
    }
    found += [_value_difference(what, mine[key], theirs[key]) for key, what in numbers.items()]
    for name in set(mine["values"]) & set(theirs["values"]):
        found.append(_value_difference(f"the measure {name!r}", mine["values"][name], theirs["values"][name]))
    found = [line for line in found if line]
    if not found and same_versions and mine["operations"] != theirs["operations"]:
        found.append(
            "the system has the same values at some states, and is computed by other operations than in the store: "
            "it differs elsewhere, or in rounding"
        )
    return found


def _system_at(system: Any, t: float) -> Any:
    """A system as it is when a study begins, where its energy depends on time or a torque acts."""
    return system.at_time(t, system.group.identity) if system.needs_attitude else system.at_time(t)


def _value_difference(what: str, mine: list, theirs: list) -> str:
    a, b = (np.asarray(values, dtype=np.float64).ravel() for values in (mine, theirs))
    if a.shape != b.shape:
        return f"{what} has {a.size} numbers at the first point, and {b.size} in the store"
    size = max(float(np.nanmax(np.abs(b), initial=0.0)), 1e-300)
    unequal = ~((np.abs(a - b) <= VALUE_RTOL * size) | (a == b) | (np.isnan(a) & np.isnan(b)))
    if not unequal.any():
        return ""
    k = int(np.flatnonzero(unequal)[0])
    return f"{what} is {a[k]:.15g} where the store has {b[k]:.15g} (at the first point)"


def _as_json_numbers(values) -> list:
    """As JSON, in which there is no NaN."""
    array = np.asarray(values)
    if array.dtype.kind == "c":
        array = np.stack([array.real, array.imag], axis=-1)
    return [v if math.isfinite(v) else None for v in map(float, array.ravel())]


def _step_as_json(step: Any) -> Any:
    return asdict(step) if is_dataclass(step) and not isinstance(step, type) else float(step)


def _event_as_json(until: Any) -> Any:
    if until is None:
        return None
    return repr(until) if is_dataclass(until) else f"function {getattr(until, '__qualname__', type(until).__name__)}"


ADDRESS_PATTERN = re.compile(r" at 0x[0-9a-f]+|\bid=\d+")


def _program_digest(solver: PointSolver) -> str:
    """A digest of the programs of the system and of the event, its parameters among their arguments where they are."""
    task, members = solver.task, solver.systems
    x = jax.ShapeDtypeStruct((members.example_system.dim,), np.float64)

    def laws(system, x):
        return system.energy.at_time(task.t_span[0]).value(x), _system_at(system, task.t_span[0]).vector_field(x)

    found, numbers = [], []
    if members.family is None or not task.parameter_names:
        found.append(jax.make_jaxpr(lambda x: laws(members.example_system, x))(x))
    else:
        family = members.family.with_builder_arrays([np.zeros(2) for _ in task.parameter_names])
        shapes = [jax.ShapeDtypeStruct(np.shape(value)[1:], np.float64) for value in family.parameter_arrays]
        found.append(jax.make_jaxpr(lambda arrays, x: laws(family.form.rebuild(arrays), x))(shapes, x))
        numbers = family.parameter_arrays[family.n_builder_arrays :]
    if callable(task.until):
        found.append(jax.make_jaxpr(task.until)(x))
    digest = hashlib.sha256()
    for closed in found:
        digest.update(ADDRESS_PATTERN.sub("", str(closed.jaxpr)).encode())
        numbers += closed.consts
    for number in numbers:
        digest.update(np.asarray(number).tobytes())
    return digest.hexdigest()
