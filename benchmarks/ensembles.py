"""Ensemble runs of the library, and peers at equal accuracy."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Literal

import numpy as np

import liethermo as lt

from .contest import Engine
from .laws import Laws


def library_ensemble(
    system: lt.System,
    x0s: np.ndarray,
    t_end: float,
    steps: int,
    engine: Engine,
    method: lt.OneStepMethod | None = None,
    outputs: Literal["final", "summary"] = "final",
) -> Callable[[], lt.Ensemble]:
    """Return a function that runs the library from all initial states over some steps."""
    span, step = (0.0, t_end), t_end / steps
    method = lt.MetriplecticMidpoint() if method is None else method
    return functools.partial(lt.ensemble, system, x0s, span, step, method, outputs=outputs, engine=engine)


TOLERANCES = tuple(10.0 ** (-n / 4) for n in range(4, 60))
"""Tolerances that are tried, four per decade, beginning with the loosest."""


def find_loosest_tolerance_run(
    build: Callable, x0s: np.ndarray, exact: np.ndarray, max_error: float
) -> tuple[Callable, float, float]:
    """Find the loosest tolerance of a peer whose error is at most ``max_error``; return its run, tolerance and error.

    Parameters
    ----------
    build : function from a tolerance and initial states to a run
    exact : array, shape (m, n)
        Final states of the first m initial states.
    """
    for tolerance in TOLERANCES:
        error = max_relative_error(build(tolerance, x0s[: len(exact)])(), exact)
        if error <= max_error:
            return build(tolerance, x0s), tolerance, error
    raise RuntimeError(f"no tolerance reaches an error of {max_error:.1e}")


def max_relative_error(ends, exact: np.ndarray) -> float:
    """Return the largest relative error of the final states for which the exact states are given."""
    errors = np.abs(np.asarray(ends)[: len(exact)] - exact).max(axis=1) / np.abs(exact).max(axis=1)
    return float(errors.max())


def ensemble_laws(result: lt.Ensemble) -> Laws:
    """Return the largest energy drift and the least entropy increment of an ensemble, over every step.

    Raises
    ------
    RuntimeError
        If a body failed.
    """
    if not result.ok.all():
        raise RuntimeError(str(result))
    increment = result.least_entropy_increment / result.entropy_scale
    return Laws(float(result.energy_drift.max()), float(increment.min()))
