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
    """The functions that are recorded along the runs of a system.

    Attributes
    ----------
    invariants : dict
        Functions that the system may conserve, by name.
    of_series : dict
        These and the entries of the ledger, whose values along a run belong to its solution.
    has_user_states : bool
        Whether states of a run have the form that the user sees.
    velocity_names : tuple of str
        Names of the velocities that the system has: see :attr:`liethermo.System.motion_quantities`.
    """

    invariants: dict[str, Energy]
    of_series: dict[str, Energy]
    has_user_states: bool
    velocity_names: tuple[str, ...]

    @classmethod
    def from_system(cls, system: System, invariants: Mapping[str, tuple[Energy, bool | None]]) -> RecordedFunctions:
        """Return the recorded functions, with invariants as :func:`.preparation.invariants_and_laws` returns them."""
        functions = {name: f for name, (f, _) in invariants.items()}
        has_user_states = type(system).to_user_solution is System.to_user_solution and not system.sites
        return cls(
            functions, {**functions, **system.ledger}, has_user_states, tuple(system.motion_quantities.velocities)
        )


def build_solution(
    system: System,
    method,
    x: np.ndarray,
    entropy: np.ndarray | None,
    step_sizes: Callable[[], np.ndarray],
    engine: EngineWithFallback,
    laws: Laws,
    functions: RecordedFunctions,
    **fields,
) -> Solution:
    """Return the solution in the user's form from the states x, shape (times, n), of a run.

    Parameters
    ----------
    step_sizes : function without arguments to an array, shape (times - 1,)
        Size of a step that the run took after each state.
    engine : EngineWithFallback
        The engine of the run.
    laws : Laws
    functions : RecordedFunctions
    **fields
        Further fields of :class:`Solution`.
    """
    solution = Solution(
        x=x,
        entropy=None if system.entropy is None else entropy,
        casimirs=defer(functools.partial(values_by_function_name, functions.of_series, x)),
        laws=laws,
        evidence_source=RunEvidenceSource(
            system, method, functions.invariants, x, np.asarray(fields["t"]), step_sizes, EngineReplay(engine)
        ),
        velocity_sources={
            name: functools.partial(velocities_at_states, name, system, x) for name in functions.velocity_names
        },
        **fields,
    )
    return solution if functions.has_user_states else system.to_user_solution(solution)


def velocities_at_states(name: str, system: System, x: np.ndarray) -> np.ndarray:
    """Return the velocities of a name at states of a prepared system, shape (..., n); they have the shape (..., k)."""
    rows = np.asarray(x).reshape(-1, x.shape[-1])
    return np.asarray(evaluate_at_points(_velocities, system, rows)[name]).reshape(*x.shape[:-1], -1)


def _velocities(system: System, x) -> dict[str, Any]:
    """Return the velocities at a state, shape (n,), by their names, shape (k,) each."""
    return {name: velocity(x) for name, velocity in system.motion_quantities.velocities.items()}


def run_provenance(
    system: System,
    method: Any,
    step: float | Adaptive,
    span: tuple[float, float],
    save_every: int | None,
    end_time: float | None = None,
    **entries,
) -> dict[str, Any]:
    """Return the provenance of a run as JSON data: versions, date, method, step, span and system, and more entries.

    ``end_time`` is the time at which the run ended, in seconds as of ``time.time()``; by default now.
    """
    joint_ranges = system.motion_quantities.joint_ranges
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
        **entries,
    }


@functools.cache
def _library_version() -> str:
    try:
        return metadata.version("liethermo")
    except metadata.PackageNotFoundError:
        return "(not installed)"
