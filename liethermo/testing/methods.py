"""The suite of methods."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise

import jax.numpy as jnp
import numpy as np

import manifolds as mf
from manifolds.testing import Report, Suite

from ..dissipation.friction_operator import FrictionOperator
from ..dissipation.inner_product import KillingDissipation
from ..dissipation.projected_metric import ProjectedMetric
from ..functions.energy import Quadratic
from ..integrators import OneStepMethod, Reference
from ..runs.integrate import integrate
from ..systems import LiePoissonSystem, MetriplecticSystem, System
from .runs import follow_laws

ROUNDING = 1e-12
"""Errors below which an order is not measured."""


def check_method(
    method: OneStepMethod, systems: Mapping[str, tuple[System, object, float]] | None = None, slack: float = 0.35
) -> Report:
    """The order of a method against SciPy's, the laws that it claims, both engines, and that it holds no identities.

    Parameters
    ----------
    method : OneStepMethod
    systems : dict of (system, x0, time), optional
        What it is tried on: by default a body and a semidirect product with energies that are not quadratic, and an
        oscillator in R^n. Give others for a method that is for other systems.
    slack : float
        By how much an observed order may be below the one stated.

    Raises
    ------
    PropertyError
        If one of the properties does not hold.
    """
    suite = Suite(str(method))
    for name, (system, x0, time) in (reference_problems() if systems is None else systems).items():
        start = np.asarray(x0, dtype=np.float64)
        exact = integrate(system, start, (0.0, time), time, Reference(rtol=3e-14)).x[-1]
        few = max(4, round(16 / method.order)) if method.order > 2 else 20
        errors = []
        for n in (few, 2 * few, 4 * few):
            run = integrate(system, start, (0.0, time), time / n, method, save_every=4 * few, engine="array")
            errors.append(float(np.abs(run.x[-1] - exact).max()))
        measured = [a / b for a, b in pairwise(errors) if b > ROUNDING]
        if measured:
            observed = float(np.log2(max(measured)))
            suite.true(f"{name}: order {method.order}", observed > method.order - slack, f"observed {observed:.2f}")
        else:
            suite.without(f"{name}: order {method.order}", f"errors are rounding: {errors[-1]:.1g}")
        follow_laws(suite, system, method, start, time / (4 * few), f"{name}: ")
    return suite.report()


def reference_problems() -> dict[str, tuple[System, object, float]]:
    """A relaxing body, a semidirect product without friction, and a damped oscillator with a bath in R^3."""
    moments = jnp.array([3.0, 2.0, 1.0])

    def body(m):
        return 0.5 * jnp.sum(m * m / moments) + 0.1 * jnp.cos(2.0 * m[0])

    def top(m):
        return 0.5 * jnp.sum(m[:3] ** 2 / moments) + 0.3 * jnp.sin(m[5]) + 0.1 * m[3] ** 2

    def oscillator(x):
        return 0.5 * x[1] ** 2 + 0.25 * x[0] ** 4 + x[2]

    def friction(x):
        v = jnp.array([0.0, 1.0, -x[1]])
        return 0.3 * jnp.outer(v, v)

    tensor = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    return {
        "body": (
            LiePoissonSystem(mf.so(3), body, Quadratic(np.ones(3)), KillingDissipation(0.3)),
            [0.8, 0.5, 0.9],
            2.0,
        ),
        "top": (
            LiePoissonSystem(mf.se(3), top, None, None),
            [0.4, -0.2, 0.7, 0.5, 0.3, 0.6],
            1.0,
        ),
        "oscillator": (
            MetriplecticSystem(mf.PoissonTensor(tensor), oscillator, lambda x: x[2], FrictionOperator(friction), dim=3),
            [0.9, 0.3, 0.2],
            2.0,
        ),
        "relaxing top": (
            LiePoissonSystem(mf.se(3), top, _squared_force, ProjectedMetric(rate=0.2)),
            [0.4, -0.2, 0.7, 0.5, 0.3, 0.6],
            1.0,
        ),
    }


def _squared_force(m):
    return jnp.dot(m[3:], m[3:])
