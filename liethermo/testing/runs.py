"""Checks shared by the suites: rebuilt objects, and the laws along a run."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np

from manifolds.testing import Suite

from ..engines.select_engine import is_worth_compiling
from ..integrators import MetriplecticGauss, MetriplecticMidpoint, OneStepMethod
from ..results.audit import ACCURACY_ROW, INEXACT_LAW_NOTE, STEPS_TAKEN_ROW
from ..results.solution import Solution
from ..runs.integrate import integrate
from ..systems import System
from ..tracing.scalarize import UnsupportedPrimitive

N_STEPS = 40
"""Number of steps of the runs of a suite."""

SUITE_METHODS = (MetriplecticMidpoint(), MetriplecticGauss(2))
"""Methods that integrate the tested systems and dissipations."""


def rebuild_pytree(tree):
    """Return an equal tree built from copies of its leaves, so that no object keeps its identity."""
    leaves, structure = jax.tree_util.tree_flatten(tree)
    return jax.tree_util.tree_unflatten(structure, [jnp.array(a) if isinstance(a, jax.Array) else a for a in leaves])


def random_start(system: System, seed: int) -> np.ndarray:
    """Return a random state inside the domain of the system, shape (n,)."""
    for x in system.samples(20, seed):
        if not system.domain.why_outside(jnp.asarray(x)) and np.isfinite(_field_at_time_zero(system, x)).all():
            return np.asarray(x)
    raise ValueError(f"none of 20 random states is inside the domain of this {system.kind}: give x0")


def default_step(system: System, x0) -> float:
    """Return a step in which the state moves by a hundredth of its norm."""
    field_norm, norm = (float(np.linalg.norm(np.asarray(v))) for v in (_field_at_time_zero(system, x0), x0))
    return 0.01 * max(norm, 1e-3) / field_norm if field_norm > 0.0 else 0.01


def _field_at_time_zero(system: System, x) -> np.ndarray:
    """Return the vector field at a state, at time 0 if it depends on time."""
    return np.asarray(system.vector_field(x, 0.0) if system.is_driven else system.vector_field(x))


def check_completion(suite: Suite, label: str, run: Solution) -> None:
    """Add a row that says if a run reached its end."""
    suite.check_true(f"{label} completes", run.status.ok, "" if run.status.ok else run.status.message)


def check_laws_along_run(suite: Suite, system: System, method: OneStepMethod, x0, h: float, label: str = "") -> None:
    """Add rows for the audit of a run, the agreement of the engines, and the equality with a rebuilt system's run."""
    solution = integrate(system, x0, (0.0, N_STEPS * h), h, method, on_failure="return", engine="array")
    check_completion(suite, f"{label}run", solution)
    for row in solution.audit().rows:
        if row.passed is not None and row.law not in (STEPS_TAKEN_ROW, ACCURACY_ROW):
            passed = (
                None if row.note == INEXACT_LAW_NOTE else row.passed
            )  # what it does not claim to keep is not judged
            suite.rows.append(replace(row, name=f"{label}{row.law}", passed=passed))
    rebuilt_run = integrate(
        rebuild_pytree(system), x0, (0.0, N_STEPS * h), h, rebuild_pytree(method), on_failure="return", engine="array"
    )
    is_identical = np.array_equal(solution.x, rebuilt_run.x) and solution.laws == rebuilt_run.laws
    suite.check_true(f"{label}the same to the bit when taken apart and put together", is_identical)
    if is_worth_compiling(system):
        try:
            compiled_run = integrate(system, x0, (0.0, N_STEPS * h), h, method, on_failure="return", engine="compiled")
        except UnsupportedPrimitive as error:
            suite.skip_check(f"{label}engines agree", str(error)[:60])
        else:
            suite.check_equal(f"{label}engines agree", compiled_run.x[-1], solution.x[-1], 1e-11)
