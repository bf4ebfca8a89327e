"""Property suite of systems."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from manifolds.testing import Report, Suite

from ..integrators import OneStepMethod
from ..results.step_sampling import vector_field_at
from ..systems import System
from .runs import SUITE_METHODS, check_laws_along_run, default_step, random_start, rebuild_pytree


def check_system(
    system: System,
    x0=None,
    step: float | None = None,
    methods: Sequence[OneStepMethod] = SUITE_METHODS,
    seed: int = 0,
) -> Report:
    """Check the axioms of a system at random points, and its laws along a run of each method.

    Parameters
    ----------
    system : System
    x0 : array, optional
        Initial state of the runs; a random one by default.
    step : float, optional
        By default a step moves the state by a hundredth of its norm.
    methods : sequence of OneStepMethod

    Raises
    ------
    PropertyError
        If a property does not hold.
    """
    suite = Suite(system.kind)
    suite.rows += system.check(seed=seed).rows
    points = system.samples(3, seed)
    field, rebuilt_field = (vector_field_at(s, points) for s in (system, rebuild_pytree(system)))
    suite.check_true(
        "field to the bit when taken apart and put together", np.array_equal(field, rebuilt_field, equal_nan=True)
    )
    start = random_start(system, seed) if x0 is None else np.asarray(x0, dtype=np.float64)
    h = default_step(system, start) if step is None else step
    for method in methods:
        check_laws_along_run(suite, system, method, start, h, f"{method}: ")
    return suite.report()
