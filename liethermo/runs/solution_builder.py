"""The solution of a run: states in the user's form, recorded functions, provenance, and evidence."""

from __future__ import annotations

import dataclasses
import datetime
import functools
import time
from collections.abc import Callable, Mapping
from importlib import metadata
from typing import Any, NamedTuple

import jax
import numpy as np

from ..dissipation.base import dissipation_name
from ..engines.select_engine import EngineWithFallback
from ..functions.energy import Energy
from ..results.solution import Solution, defer
from ..results.status import Laws
from ..systems import System
from ..tracing.interpret import evaluate_at_points
from .adaptive import Adaptive
from .evidence import EngineReplay, RunEvidenceSource, values_by_function_name


class RecordedFunctions(NamedTuple):
    """The functions and velocities whose values along a run belong to its solution.

    Attributes
    ----------
    invariants : dict
        Functions that the system may conserve, by name.
    series_functions : dict
        The invariants and the entries of the ledger.
    has_user_states : bool
        Whether the states of a run already have the user's form.
    velocity_names : tuple of str
        Names of the velocities that the system has: see :attr:`liethermo.System.body_kinematics`.
    """

    invariants: dict[str, Energy]
    series_functions: dict[str, Energy]
    has_user_states: bool
    velocity_names: tuple[str, ...]

    @classmethod
    def from_system(cls, system: System, invariants: Mapping[str, tuple[Energy, bool | None]]) -> RecordedFunctions:
        """Return the recorded functions of a system, from the result of :func:`.preparation.invariants_and_laws`."""
        functions = {name: f for name, (f, _) in invariants.items()}
        has_user_states = type(system).to_user_solution is System.to_user_solution and not system.sites
        return cls(
            functions,
            {**functions, **system.ledger_functions},
            has_user_states,
            tuple(system.body_kinematics.velocities),
        )


def build_solution(
    system: System,
    method,
    states: np.ndarray,
    entropy: np.ndarray | None,
    step_sizes: Callable[[], np.ndarray],
    engine: EngineWithFallback,
    laws: Laws,
    functions: RecordedFunctions,
    **other_fields,
) -> Solution:
    """Return the solution of a run in the user's form, from its states, shape (times, n).

    Parameters
    ----------
    step_sizes : function without arguments to an array, shape (times - 1,)
        Size of a step that the run took after each state.
    engine : EngineWithFallback
        The engine of the run.
    laws : Laws
    functions : RecordedFunctions
    **other_fields
        Other fields of :class:`Solution`.
    """
    solution = Solution(
        x=states,
        entropy=None if system.entropy is None else entropy,
        casimirs=defer(functools.partial(values_by_function_name, functions.series_functions, states)),
        laws=laws,
        evidence_source=RunEvidenceSource(
            system,
            method,
            functions.invariants,
            states,
            np.asarray(other_fields["t"]),
            step_sizes,
            EngineReplay(engine),
        ),
        velocity_sources={
            name: functools.partial(velocities_at_states, name, system, states) for name in functions.velocity_names
        },
        **other_fields,
    )
    return solution if functions.has_user_states else system.to_user_solution(solution)


def velocities_at_states(velocity_name: str, system: System, states: np.ndarray) -> np.ndarray:
    """Return the velocities of a name, shape (..., k), at states, shape (..., n), of the system that is integrated."""
    rows = np.asarray(states).reshape(-1, states.shape[-1])
    return np.asarray(evaluate_at_points(_velocities_by_name, system, rows)[velocity_name]).reshape(
        *states.shape[:-1], -1
    )


def _velocities_by_name(system: System, x) -> dict[str, Any]:
    """Return all velocities of a system at a state, shape (n,), as a dict from names to arrays, shape (k,)."""
    return {name: velocity(x) for name, velocity in system.body_kinematics.velocities.items()}


def run_provenance(
    system: System,
    method: Any,
    step: float | Adaptive,
    span: tuple[float, float],
    save_every: int | None,
    end_time: float | None = None,
    **other_entries,
) -> dict[str, Any]:
    """Return the provenance of a run as JSON data: versions, date, method, step, span, system, ``other_entries``.

    ``end_time`` is the time at which the run ended, in seconds as of ``time.time()``; by default now.
    """
    joint_ranges = system.body_kinematics.joint_ranges
    algebra, group, inertia = system.lie_algebra, system.matrix_group, system.inertia
    return {
        "library": f"liethermo {_library_version()}",
        "jax": jax.__version__,
        "date": datetime.datetime.fromtimestamp(time.time() if end_time is None else end_time, datetime.UTC).isoformat(
            timespec="seconds"
        ),
        "method": str(method),
        "step": dataclasses.asdict(step) if isinstance(step, Adaptive) else step,
        "t_span": list(span),
        "save_every": save_every,
        "system": type(system).__name__,
        "algebra": None if algebra is None else algebra.name,
        "group": None if group is None else group.name,
        "inertia": None if inertia is None else inertia.tolist(),
        "dissipation": dissipation_name(system.dissipation),
        **({"torque": system.torque_laws.name} if system.torque_laws.name else {}),
        **({"joints": {name: [start, end] for name, start, end in joint_ranges}} if joint_ranges else {}),
        **other_entries,
    }


@functools.cache
def _library_version() -> str:
    try:
        return metadata.version("liethermo")
    except metadata.PackageNotFoundError:
        return "(not installed)"
