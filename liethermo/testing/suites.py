"""Property suites of systems, dissipations and methods, with their test problems."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np

import manifolds as mf
from manifolds.testing import Report, Suite

from ..dissipation.base import Dissipation
from ..dissipation.brackets import KillingDissipation
from ..dissipation.friction import FrictionOperator
from ..dissipation.lindblad import LindbladJumps
from ..dissipation.projected_metric import ProjectedMetric
from ..engines.select_engine import is_worth_compiling
from ..errors import InputError
from ..functions.energy import Quadratic
from ..integrators import MetriplecticGauss, MetriplecticMidpoint, OneStepMethod, Reference
from ..integrators.base import EVERY_SYSTEM
from ..results.audit import ACCURACY_ROW, INEXACT_LAW_NOTE, STEPS_TAKEN_ROW
from ..results.solution import Solution
from ..results.step_sampling import vector_field_at
from ..runs.integrate import integrate
from ..systems import (
    EulerPoincareClosedSystem,
    LiePoissonSystem,
    MetriplecticSystem,
    QuantumSystem,
    SimpleClosedSystem,
    System,
)
from ..tracing.scalarize import UnsupportedPrimitive

N_STEPS = 40
"""Number of steps of the runs of a suite."""

SUITE_METHODS = (MetriplecticMidpoint(), MetriplecticGauss(2))
"""Methods that integrate the tested systems and dissipations."""


def copy_pytree(tree):
    """Return a pytree that is equal but built from copies of the array leaves, so that no object is shared."""
    leaves, structure = jax.tree_util.tree_flatten(tree)
    return jax.tree_util.tree_unflatten(structure, [jnp.array(a) if isinstance(a, jax.Array) else a for a in leaves])


def random_initial_state(system: System, seed: int) -> np.ndarray:
    """Return a random state inside the domain of the system, shape (n,)."""
    for x in system.samples(20, seed):
        if not system.domain.why_outside(jnp.asarray(x)) and np.isfinite(_field_at_time_zero(system, x)).all():
            return np.asarray(x)
    raise ValueError(f"none of 20 random states is inside the domain of this {system.kind}. Give x0")


def default_step_size(system: System, x0) -> float:
    """Return a step size with which the state moves by a hundredth of its norm."""
    field_norm, norm = (float(np.linalg.norm(np.asarray(v))) for v in (_field_at_time_zero(system, x0), x0))
    return 0.01 * max(norm, 1e-3) / field_norm if field_norm > 0.0 else 0.01


def _field_at_time_zero(system: System, x) -> np.ndarray:
    """Return the vector field at a state, shape (n,), at time 0 if the system depends on time."""
    return np.asarray(system.vector_field(x, 0.0) if system.is_driven else system.vector_field(x))


def check_run_completes(suite: Suite, label: str, run: Solution) -> None:
    """Add a row to the suite that says whether a run reached its end."""
    suite.check_true(f"{label} completes", run.status.ok, "" if run.status.ok else run.status.message)


def check_laws_along_run(suite: Suite, system: System, method: OneStepMethod, x0, h: float, label: str = "") -> None:
    """Run a system and add rows for the audit, the agreement of the engines, and the run of a copied system."""
    solution = integrate(system, x0, (0.0, N_STEPS * h), h, method, on_failure="return", engine="array")
    check_run_completes(suite, f"{label}run", solution)
    for row in solution.audit().rows:
        if row.passed is not None and row.law not in (STEPS_TAKEN_ROW, ACCURACY_ROW):
            # what the method does not claim to keep is not judged
            passed = None if row.note == INEXACT_LAW_NOTE else row.passed
            suite.rows.append(replace(row, name=f"{label}{row.law}", passed=passed))
    rebuilt_run = integrate(
        copy_pytree(system), x0, (0.0, N_STEPS * h), h, copy_pytree(method), on_failure="return", engine="array"
    )
    is_identical = np.array_equal(solution.x, rebuilt_run.x) and solution.laws == rebuilt_run.laws
    suite.check_true(f"{label}the same to the bit when taken apart and put together", is_identical)
    if is_worth_compiling(system, method):
        try:
            compiled_run = integrate(system, x0, (0.0, N_STEPS * h), h, method, on_failure="return", engine="compiled")
        except UnsupportedPrimitive as error:
            suite.skip_check(f"{label}engines agree", str(error)[:60])
        else:
            suite.check_equal(f"{label}engines agree", compiled_run.x[-1], solution.x[-1], 1e-11)


Problem = tuple[System, object, float]
"""A system, its initial state and the duration of the run."""


def accepted_test_problems(method: OneStepMethod) -> dict[str, Problem]:
    """Return the test problems that a method accepts, by name."""
    if method.systems == EVERY_SYSTEM:
        return body_top_and_oscillator_problems()
    problems = {
        name: problem
        for name, problem in (mechanical_and_body_problems() | density_matrix_problems()).items()
        if _accepts_system(method, problem[0])
    }
    if not problems:
        raise InputError(f"{method} is for {method.systems}, but no test problem is one. Give systems=...")
    return problems


def _accepts_system(method: OneStepMethod, system: System) -> bool:
    """Return True if a method can integrate a system."""
    try:
        method.check(system)
    except InputError:
        return False
    return True


def mechanical_and_body_problems() -> dict[str, Problem]:
    """Return test problems by name: mechanical systems with heat, isolated and driven, and a rigid body with heat."""

    def lagrangian(q, v, S):
        kinetic = 0.5 * (1.5 + jnp.sin(q[1])) * v[0] ** 2 + 0.6 * v[1] ** 2 + 0.05 * jnp.sum(v**4)
        return kinetic - 0.25 * jnp.sum(q**4) - 3.0 * jnp.exp(S / 4 + 0.1 * q[0])

    def friction(q, v, S):
        return -(0.2 + 0.1 * S**2) * v

    def driving_force(q, v, S, t):
        return jnp.array([0.3 * jnp.cos(t), -0.2 * q[0]])

    def reduced_lagrangian(xi, S):
        moments = jnp.array([3.0, 2.0, 1.0])
        return 0.5 * jnp.sum(moments * xi**2) + 0.05 * jnp.dot(xi, xi) ** 2 - jnp.exp(S)

    def braking(xi, S):
        return -0.1 * (1.0 + S**2) * xi

    start = [0.4, -0.3, 0.5, 0.8, 0.2]
    return {
        "mechanical": (SimpleClosedSystem(lagrangian, 5, friction=friction), start, 1.0),
        "driven": (SimpleClosedSystem(lagrangian, 5, friction, driving_force), start, 1.0),
        "body with heat": (
            EulerPoincareClosedSystem(mf.so(3), reduced_lagrangian, braking),
            [0.5, -0.3, 0.4, 0.1],
            1.0,
        ),
    }


def density_matrix_problems() -> dict[str, Problem]:
    """Return two test problems of open quantum systems, by name: three levels with two jumps, and a driven qubit."""
    lowering_operator, sx = np.array([[0.0, 1.0], [0.0, 0.0]]), np.array([[0.0, 1.0], [1.0, 0.0]])
    H = np.array([[0.0, 0.3, 0.1j], [0.3, 0.8, 0.2], [-0.1j, 0.2, 1.5]])
    levels = QuantumSystem(H, LindbladJumps([(np.eye(3, k=1), 0.4), (np.diag([0.0, 1.0, -1.0]), 0.2)]))
    drive = [np.diag([0.0, 1.0]), [sx, lambda t: 0.6 * jnp.cos(1.3 * t)]]
    qubit = QuantumSystem(drive, LindbladJumps([(lowering_operator, lambda t: 0.3 + 0.2 * jnp.sin(t))]))
    return {
        "three levels": (levels, levels.state(np.diag([0.2, 0.3, 0.5])), 2.0),
        "driven qubit": (qubit, qubit.state([1.0, 0.0]), 2.0),
    }


def body_top_and_oscillator_problems() -> dict[str, Problem]:
    """Return general test problems by name: a relaxing body, a top with and without friction, a damped oscillator."""
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


def check_system(
    system: System,
    x0=None,
    step: float | None = None,
    methods: Sequence[OneStepMethod] = SUITE_METHODS,
    seed: int = 0,
) -> Report:
    """Check the axioms of a system at random points, and its laws along a run with each method.

    Parameters
    ----------
    system : System
        The system to test.
    x0 : array, optional
        Initial state of the runs; a random one by default.
    step : float, optional
        By default a step moves the state by a hundredth of its norm.
    methods : sequence of OneStepMethod
        The methods that are tried on it.
    seed : int
        Seed of the random points.

    Raises
    ------
    PropertyError
        If a property does not hold.
    """
    suite = Suite(system.kind)
    suite.rows += system.check(seed=seed).rows
    points = system.samples(3, seed)
    field, rebuilt_field = (vector_field_at(s, points) for s in (system, copy_pytree(system)))
    suite.check_true(
        "field to the bit when taken apart and put together", np.array_equal(field, rebuilt_field, equal_nan=True)
    )
    start = random_initial_state(system, seed) if x0 is None else np.asarray(x0, dtype=np.float64)
    h = default_step_size(system, start) if step is None else step
    for method in methods:
        check_laws_along_run(suite, system, method, start, h, f"{method}: ")
    return suite.report()


def check_dissipation(dissipation: Dissipation | System, algebra: mf.LieAlgebra | None = None, seed: int = 0) -> Report:
    """Check the laws of a dissipation at random points, with arbitrary vectors for gradients, and along runs.

    Parameters
    ----------
    dissipation : Dissipation or System
        A dissipation on the dual of a Lie algebra, or a system that contains it.
    algebra : LieAlgebra, optional
        The algebra of the test system, so(3) by default. Its energy is not quadratic, its entropy a quadratic Casimir.
    seed : int
        Seed of the random points.

    Raises
    ------
    PropertyError
        If it violates a law that it states, or changes a function that it must preserve.
    """
    system = (
        dissipation if isinstance(dissipation, System) else _system_with_dissipation(dissipation, algebra or mf.so(3))
    )
    if system.dissipation is None:
        raise ValueError("the system has no dissipation")
    suite = Suite(f"{type(system.dissipation).__name__} in a {system.kind}")
    random = np.random.default_rng(seed)
    points = [x for x in system.samples(8, seed) if np.isfinite(np.asarray(system.vector_field(x))).all()]
    tested_dissipation, max_energy_rate, min_entropy_rate, max_force = system.dissipation, 0.0, 0.0, 0.0
    for x in points:
        dH, dS, *dL = random.standard_normal((2 + len(tested_dissipation.preserve), system.dim))
        if system.baths.has_positive_temperatures:
            dH[system.body_dim :] = np.abs(dH[system.body_dim :])  # no gradient has temperatures below zero
        force = np.asarray(
            tested_dissipation.force(
                system, jnp.asarray(x), jnp.asarray(dH), jnp.asarray(dS), tuple(map(jnp.asarray, dL))
            )
        )
        scale = float(np.linalg.norm(force))
        max_energy_rate = max(max_energy_rate, float(abs(force @ dH) / max(scale * np.linalg.norm(dH), 1e-300)))
        min_entropy_rate = min(min_entropy_rate, float((force @ dS) / max(scale * np.linalg.norm(dS), 1e-300)))
        max_force = max(max_force, scale)
    if tested_dissipation.energy_law == "conserved" and system.space is None:
        suite.check_small("any vector instead of grad H is in the kernel", max_energy_rate, 1.0, 1e-12)
    if (
        tested_dissipation.entropy_law == "nondecreasing"
        and tested_dissipation.energy_law == "conserved"
        and system.space is None
    ):
        suite.check_small("the entropy cannot fall, whatever the vectors", min(min_entropy_rate, 0.0), 1.0, 1e-12)
    suite.check_true("it acts", max_force > 0.0)
    suite.rows += system.check(seed=seed).rows
    x0 = random_initial_state(system, seed)
    h = default_step_size(system, x0)
    for method in SUITE_METHODS:
        check_laws_along_run(suite, system, method, x0, h, f"{method}: ")
    return suite.report()


def _system_with_dissipation(dissipation: Dissipation, algebra: mf.LieAlgebra) -> LiePoissonSystem:
    quadratic = algebra.casimirs(2)
    if not quadratic:
        raise ValueError(f"{algebra.name} has no quadratic Casimir. Give a system that has the dissipation")
    weights = np.linspace(1.0, 2.0, algebra.dim)

    def energy(mu):
        return 0.5 * jnp.sum(weights * mu * mu) + 0.1 * jnp.cos(mu[0] + 0.5 * mu[-1])

    entropy = np.sum([jax.hessian(F)(jnp.zeros(algebra.dim)) for F in quadratic], axis=0)
    return LiePoissonSystem(algebra, energy, Quadratic(entropy), dissipation)


MIN_ORDER_ERROR = 1e-12
"""Smallest error from which an order is measured; smaller errors are mostly rounding."""


def check_method(method: OneStepMethod, systems: Mapping[str, Problem] | None = None, slack: float = 0.35) -> Report:
    """Check a method's order against SciPy, the laws that it claims, both engines, and its independence of identities.

    Parameters
    ----------
    method : OneStepMethod
        The method to test.
    systems : dict of (system, x0, time), optional
        Test problems. By default a body and a semidirect product with non-quadratic energies, and an oscillator in R^n;
        for a method for one kind of system, the matching ones of :func:`accepted_test_problems`.
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
    for name, (system, x0, time) in (accepted_test_problems(method) if systems is None else systems).items():
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
