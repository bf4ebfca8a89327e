"""Property suite of methods."""

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
"""Smallest error from which an order is measured; smaller errors are mostly rounding."""


def check_method(method: OneStepMethod, systems: Mapping[str, Problem] | None = None, slack: float = 0.35) -> Report:
    """Check a method's order against SciPy, the laws that it claims, both engines, and its independence of identities.

    Parameters
    ----------
    method : OneStepMethod
    systems : dict of (system, x0, time), optional
        Test problems. By default a body and a semidirect product with non-quadratic energies, and an oscillator in R^n;
        for a method for one kind of system, the matching ones of ``liethermo.testing.problems``.
    slack : float
        Largest difference by which an observed order may be below the stated one.

    Raises
    ------
    PropertyError
        If a property does not hold.
    InputError
        If no test problem suits the method.
    """
    suite = Suite(str(method))
    for name, (system, x0, time) in (problems_for(method) if systems is None else systems).items():
        start = np.asarray(x0, dtype=np.float64)
        exact = integrate(system, start, (0.0, time), time, Reference(rtol=3e-14)).x[-1]
        n_coarse = 6 if method.order > 2 else 20
        errors = []
        for n in (n_coarse, 2 * n_coarse, 4 * n_coarse):
            run = integrate(system, start, (0.0, time), time / n, method, save_every=4 * n_coarse, engine="array")
            errors.append(float(np.abs(run.x[-1] - exact).max()))
        error_ratios = [a / b for a, b in pairwise(errors) if b > MIN_ORDER_ERROR]
        if error_ratios:
            observed_order = float(np.log2(max(error_ratios)))
            suite.check_true(
                f"{name}: order {method.order}", observed_order > method.order - slack, f"observed {observed_order:.2f}"
            )
        else:
            suite.skip_check(f"{name}: order {method.order}", f"errors are rounding: {errors[-1]:.1g}")
        check_laws_along_run(suite, system, method, start, time / (4 * n_coarse), f"{name}: ")
    return suite.report()
