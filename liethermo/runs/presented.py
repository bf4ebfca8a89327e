"""What a run is presented as: its states with what is recorded of them, where it comes from, its evidence."""

from __future__ import annotations

import dataclasses
import datetime
import functools
from importlib import metadata
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ..engines.choice import Chosen
from ..results.evidence import MEASURED, Witness, spread
from ..results.solution import Solution
from ..systems import System
from ..tracing.interpret import at_points
from .adaptive import Adaptive
from .preparation import prepared


def presented(
    system: System, method, x: np.ndarray, entropy: np.ndarray | None, steps: np.ndarray, again, **fields
) -> Solution:
    """The solution that a user sees of the states x, shape (times, n), of a run.

    Parameters
    ----------
    steps : array, shape (times - 1,)
        Sizes of steps that the run took from the states.
    again : function of (x, h) to the state of the engine after one step
    **fields
        The others of :class:`Solution`.
    """
    invariants, laws = prepared(system, method)
    functions = {name: f for name, (f, _) in invariants.items()}
    some = spread(len(x), MEASURED)
    at = np.asarray(fields["t"])[some]
    found = Solution(
        x=x,
        entropy=None if system.entropy is None else entropy,
        casimirs={name: at_points(_value, function, x) for name, function in {**functions, **system.ledger}.items()},
        laws=laws,
        witness=Witness(system, method, functions, x[some], at, steps[some[:-1]], again),
        **fields,
    )
    return system.presented(found)


def _value(function, x):
    return function.value(x)


@dataclasses.dataclass(frozen=True, eq=False)
class Again:
    """One step from any state, by the program that a run has compiled."""

    engine: Chosen

    def __call__(self, x: np.ndarray, h: float):
        return self.engine.step(self.engine.begin(jnp.asarray(x)), h)


def provenance_of(
    system: System, method: Any, step: float | Adaptive, span: tuple[float, float], every: int | None
) -> dict[str, Any]:
    """Where a run comes from: JSON data."""
    algebra = getattr(system, "algebra", None)
    return {
        "library": f"liethermo {_version()}",
        "jax": jax.__version__,
        "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "method": str(method),
        "step": dataclasses.asdict(step) if isinstance(step, Adaptive) else step,
        "t_span": list(span),
        "save_every": every,
        "system": type(system).__name__,
        "algebra": None if algebra is None else algebra.name,
        "dissipation": None if system.dissipation is None else type(system.dissipation).__name__,
    }


@functools.cache
def _version() -> str:
    try:
        return metadata.version("liethermo")
    except metadata.PackageNotFoundError:
        return "(not installed)"
