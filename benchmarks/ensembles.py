"""The library's ensembles as the measurements use them."""

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
    """A run of all bodies over so many steps."""
    span, step = (0.0, t_end), t_end / steps
    method = lt.MetriplecticMidpoint() if method is None else method
    return functools.partial(lt.ensemble, system, x0s, span, step, method, outputs=outputs, engine=engine)


TOLERANCES = tuple(10.0 ** (-n / 4) for n in range(4, 60))


def loosest_tolerance_work(
    build: Callable, x0s: np.ndarray, exact: np.ndarray, wanted: float
) -> tuple[Callable, float, float]:
    """A peer's work with the loosest tolerance that reaches an error; that tolerance, and its error.

    Parameters
    ----------
    build : function from a tolerance and initial states to a work
    exact : array, shape (m, n)
        The ends of the first states.
    """
    for tolerance in TOLERANCES:
        reached = max_relative_error(build(tolerance, x0s[: len(exact)])(), exact)
        if reached <= wanted:
            return build(tolerance, x0s), tolerance, reached
    raise RuntimeError(f"no tolerance reaches an error of {wanted:.1e}")


def max_relative_error(ends, exact: np.ndarray) -> float:
    """Largest error of the first ends, relative to their states."""
    errors = np.abs(np.asarray(ends)[: len(exact)] - exact).max(axis=1) / np.abs(exact).max(axis=1)
    return float(errors.max())


def ensemble_laws(result: lt.Ensemble) -> Laws:
    """The worst of all bodies, over every step.

    Raises
    ------
    RuntimeError
        If a body failed.
    """
    if not result.ok.all():
        raise RuntimeError(str(result))
    increment = result.least_entropy_increment / result.entropy_scale
    return Laws(float(result.energy_drift.max()), float(increment.min()))
