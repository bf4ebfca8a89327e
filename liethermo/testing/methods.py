"""The suite of methods."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise

import numpy as np

from manifolds.testing import Report, Suite

from ..integrators import OneStepMethod, Reference
from ..runs.integrate import integrate
from .problems import Problem, problems_for
from .runs import check_laws_along_run

MIN_ORDER_ERROR = 1e-12
"""Errors below which an order is not measured."""


def check_method(method: OneStepMethod, systems: Mapping[str, Problem] | None = None, slack: float = 0.35) -> Report:
    """The order of a method against SciPy's, the laws that it claims, both engines, and that it holds no identities.

    Parameters
    ----------
    method : OneStepMethod
    systems : dict of (system, x0, time), optional
        What it is tried on: by default a body and a semidirect product with energies that are not quadratic, and an
        oscillator in R^n; a method for one kind of system, on those of ``liethermo.testing.problems`` that it accepts.
    slack : float
        By how much an observed order may be below the one stated.

    Raises
    ------
    PropertyError
        If one of the properties does not hold.
    InputError
        If there is no system to try the method on.
    """
    suite = Suite(str(method))
    for name, (system, x0, time) in (problems_for(method) if systems is None else systems).items():
        start = np.asarray(x0, dtype=np.float64)
        exact = integrate(system, start, (0.0, time), time, Reference(rtol=3e-14)).x[-1]
        few = 6 if method.order > 2 else 20
        errors = []
        for n in (few, 2 * few, 4 * few):
            run = integrate(system, start, (0.0, time), time / n, method, save_every=4 * few, engine="array")
            errors.append(float(np.abs(run.x[-1] - exact).max()))
        measured = [a / b for a, b in pairwise(errors) if b > MIN_ORDER_ERROR]
        if measured:
            observed = float(np.log2(max(measured)))
            suite.check_true(
                f"{name}: order {method.order}", observed > method.order - slack, f"observed {observed:.2f}"
            )
        else:
            suite.skip_check(f"{name}: order {method.order}", f"errors are rounding: {errors[-1]:.1g}")
        check_laws_along_run(suite, system, method, start, time / (4 * few), f"{name}: ")
    return suite.report()
