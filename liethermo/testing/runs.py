"""What the suites have in common: an object taken apart and put together again, and the laws along a run."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np

from manifolds.testing import Suite

from ..engines.choice import is_worth_compiling
from ..integrators import MetriplecticGauss, MetriplecticMidpoint, OneStepMethod
from ..results.audit import ACCURACY_ROW, INEXACT_LAW_NOTE, STEPS_TAKEN_ROW
from ..results.solution import Solution
from ..runs.integrate import integrate
from ..systems import System
from ..tracing.scalarize import UnsupportedPrimitive

N_STEPS = 40

SUITE_METHODS = (MetriplecticMidpoint(), MetriplecticGauss(2))
"""What systems and dissipations are run with."""


def rebuild_pytree(tree):
    """The same tree from copies of its leaves, so that no object is the one it was."""
    leaves, structure = jax.tree_util.tree_flatten(tree)
    return jax.tree_util.tree_unflatten(structure, [jnp.array(a) if isinstance(a, jax.Array) else a for a in leaves])


def random_start(system: System, seed: int) -> np.ndarray:
    """A random state inside the domain of the system."""
    for x in system.samples(20, seed):
        if not system.outside(jnp.asarray(x)) and np.isfinite(_field_at_start(system, x)).all():
            return np.asarray(x)
    raise ValueError(f"none of 20 random states is inside the domain of this {system.kind}: give x0")


def default_step(system: System, x0) -> float:
    """A step in which the state moves by a hundredth of its size."""
    speed, size = (float(np.linalg.norm(np.asarray(v))) for v in (_field_at_start(system, x0), x0))
    return 0.01 * max(size, 1e-3) / speed if speed > 0.0 else 0.01


def _field_at_start(system: System, x) -> np.ndarray:
    """The vector field at a state, at the time 0 where it depends on time."""
    return np.asarray(system.vector_field(x, 0.0) if system.is_driven else system.vector_field(x))


def check_completion(suite: Suite, what: str, run: Solution) -> None:
    """A row that says whether a run came to its end."""
    suite.check_true(f"{what} completes", run.status.ok, "" if run.status.ok else run.status.message)


def check_laws_along_run(suite: Suite, system: System, method: OneStepMethod, x0, h: float, label: str = "") -> None:
    """Rows of the audit of a run, of the engines' agreement and of a system that was put together again."""
    solution = integrate(system, x0, (0.0, N_STEPS * h), h, method, on_failure="return", engine="array")
    check_completion(suite, f"{label}run", solution)
    for row in solution.audit().rows:
        if row.passed is not None and row.law not in (STEPS_TAKEN_ROW, ACCURACY_ROW):
            passed = (
                None if row.note == INEXACT_LAW_NOTE else row.passed
            )  # what it does not claim to keep is not judged
            suite.rows.append(replace(row, name=f"{label}{row.law}", passed=passed))
    again = integrate(
        rebuild_pytree(system), x0, (0.0, N_STEPS * h), h, rebuild_pytree(method), on_failure="return", engine="array"
    )
    same = np.array_equal(solution.x, again.x) and solution.laws == again.laws
    suite.check_true(f"{label}the same to the bit when taken apart and put together", same)
    if is_worth_compiling(system):
        try:
            compiled = integrate(system, x0, (0.0, N_STEPS * h), h, method, on_failure="return", engine="compiled")
        except UnsupportedPrimitive as error:
            suite.skip_check(f"{label}engines agree", str(error)[:60])
        else:
            suite.check_equal(f"{label}engines agree", compiled.x[-1], solution.x[-1], 1e-11)
