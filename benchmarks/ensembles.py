"""The library's ensembles as the measurements use them."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Literal

import numpy as np

import liethermo as lt

from .contest import Engine
from .laws import Laws


def by_library(
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


def laws(result: lt.Ensemble) -> Laws:
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
