"""Description of a study by content, so that another process recognises the store of an equal study."""

from __future__ import annotations

import hashlib
import math
import re
from collections.abc import Mapping
from dataclasses import asdict, is_dataclass
from importlib import metadata
from typing import Any

import equinox as eqx
import jax
import numpy as np

from ..tracing.short_form import qualified_name
from .solve import PointResults, PointSolver

VALUE_RTOL = 1e-10
"""Relative difference up to which numbers count as equal, since JAX versions differ in rounding."""

N_PROBE_STATES = 3
"""Number of sampled states, besides the initial state, at which the vector field is recorded."""


def study_as_json(solver: PointSolver, example_results: PointResults, example_x0: np.ndarray) -> dict[str, Any]:
    """Return JSON data that describe a study: its arguments, and values of its system and measures at one point.

    Parameters
    ----------
    solver : PointSolver
    example_results : PointResults
        Results of the example point.
    example_x0 : array, shape (n,)
        Initial state of the example point.
    """
    task, system = solver.task, solver.systems.example_system
    states = np.concatenate([example_x0[None], system.samples(N_PROBE_STATES, seed=1)])
    with np.errstate(all="ignore"):
        vector_fields = [_to_json_numbers(_system_at_time(system, task.t_span[0]).vector_field(x)) for x in states]
        energies = [_to_json_numbers(system.energy.at_time(task.t_span[0]).value(x)) for x in states]
    return {
        "versions": {name: metadata.version(name) for name in ("liethermo", "jax")},
        "system": f"{type(system).__name__}, {system.dim} components",
        "motion": vector_fields,
        "energy": energies,
        "operations": _program_digest(solver),
        "x0": _to_json_numbers(example_x0),
        "t_span": list(map(float, task.t_span)),
        "step": _step_as_json(task.step),
        "method": eqx.tree_pformat(task.method),
        "until": _event_as_json(task.until),
        "noise": None if task.noise is None else task.noise.to_provenance(),
        "measures": {name: measure.description() for name, measure in task.measures.items()},
        "values": {name: _to_json_numbers(example_results.measures[name][0]) for name in task.measures},
    }


def provenance(study_description: Mapping[str, Any], engine: str) -> dict[str, Any]:
    """Return the settings, package versions and engine that produced the results, as a dict of store attributes."""
    settings = {key: study_description[key] for key in ("system", "method", "step", "t_span", "until", "noise")}
    return {
        **settings,
        **{f"{name}_version": version for name, version in study_description["versions"].items()},
        "engine": engine,
    }


def study_differences(study_description: Mapping[str, Any], stored_description: Mapping[str, Any]) -> list[str]:
    """Return the differences between the descriptions of a study and of a stored study, one line each; none if they
    are equal."""
    same_versions = study_description["versions"] == stored_description["versions"]
    differences = [
        f"{key} is {study_description[key]!r:.120}, and {stored_description.get(key)!r:.120} in the store"
        for key in ("system", "t_span", "step", "method", "until", "noise", "measures")
        if study_description[key] != stored_description.get(key)
    ]
    if differences:
        return differences
    numbers = {
        "motion": "the vector field",
        "energy": "the energy",
        "x0": "the initial state",
    }
    differences += [
        _value_difference_text(label, study_description[key], stored_description[key]) for key, label in numbers.items()
    ]
    for name in set(study_description["values"]) & set(stored_description["values"]):
        differences.append(
            _value_difference_text(
                f"the measure {name!r}", study_description["values"][name], stored_description["values"][name]
            )
        )
    differences = [line for line in differences if line]
    if not differences and same_versions and study_description["operations"] != stored_description["operations"]:
        differences.append(
            "the system has the same values at some states, and is computed by other operations than in the store: "
            "it differs elsewhere, or in rounding"
        )
    return differences


def _system_at_time(system: Any, t: float) -> Any:
    """Return the system with its energy and torque evaluated at time t, and at the identity attitude if one is
    needed."""
    return system.at_time(t, system.group.identity) if system.torque_laws.needs_attitude else system.at_time(t)


def _value_difference_text(label: str, study_values: list, stored_values: list) -> str:
    """Return a line with the first number that differs between two lists, or "" if all agree within ``VALUE_RTOL``."""
    a, b = (np.asarray(values, dtype=np.float64).ravel() for values in (study_values, stored_values))
    if a.shape != b.shape:
        return f"{label} has {a.size} numbers at the first point, and {b.size} in the store"
    scale = max(float(np.nanmax(np.abs(b), initial=0.0)), 1e-300)
    is_unequal = ~((np.abs(a - b) <= VALUE_RTOL * scale) | (a == b) | (np.isnan(a) & np.isnan(b)))
    if not is_unequal.any():
        return ""
    k = int(np.flatnonzero(is_unequal)[0])
    return f"{label} is {a[k]:.15g} where the store has {b[k]:.15g} (at the first point)"


def _to_json_numbers(values) -> list:
    """Return the values as a flat list of finite floats, with None for NaN and infinities, which JSON lacks."""
    array = np.asarray(values)
    if array.dtype.kind == "c":
        array = np.stack([array.real, array.imag], axis=-1)
    return [v if math.isfinite(v) else None for v in map(float, array.ravel())]


def _step_as_json(step: Any) -> Any:
    return asdict(step) if is_dataclass(step) and not isinstance(step, type) else float(step)


def _event_as_json(until: Any) -> Any:
    if until is None:
        return None
    return repr(until) if is_dataclass(until) else f"function {qualified_name(until)}"


ADDRESS_PATTERN = re.compile(r" at 0x[0-9a-f]+|\bid=\d+")
"""Memory addresses in the text of a JAX program, which differ between processes."""


def _program_digest(solver: PointSolver) -> str:
    """Return the SHA-256 digest of the JAX programs of the system and the event, and of their constants."""
    task, study_systems = solver.task, solver.systems
    x = jax.ShapeDtypeStruct((study_systems.example_system.dim,), np.float64)

    def energy_and_vector_field(system, x):
        return system.energy.at_time(task.t_span[0]).value(x), _system_at_time(system, task.t_span[0]).vector_field(x)

    jaxprs, constants = [], []
    if study_systems.family is None or not task.parameter_names:
        jaxprs.append(jax.make_jaxpr(lambda x: energy_and_vector_field(study_systems.example_system, x))(x))
    else:
        family = study_systems.family.with_builder_arrays([np.zeros(2) for _ in task.parameter_names])
        shapes = [jax.ShapeDtypeStruct(np.shape(value)[1:], np.float64) for value in family.parameter_arrays]
        jaxprs.append(
            jax.make_jaxpr(lambda arrays, x: energy_and_vector_field(family.program_structure.rebuild(arrays), x))(
                shapes, x
            )
        )
        constants = family.parameter_arrays[family.n_builder_arrays :]
    if callable(task.until):
        jaxprs.append(jax.make_jaxpr(task.until)(x))
    digest = hashlib.sha256()
    for jaxpr in jaxprs:
        digest.update(ADDRESS_PATTERN.sub("", str(jaxpr.jaxpr)).encode())
        constants += jaxpr.consts
    for constant in constants:
        digest.update(np.asarray(constant).tobytes())
    return digest.hexdigest()
