"""Test the axioms of a metriplectic system at given states [BFM §2.3]."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from manifolds._tables import TableRow, Tabular

from ..dissipation.friction import FRICTION_KERNEL_CHECK
from ..dissipation.geometry import project_tangent
from ..dissipation.potential import CONVEXITY_CHECK, MINIMUM_AT_ZERO_CHECK
from ..errors import AxiomError, CasimirError, InputError
from ..tracing.interpret import evaluate_at_points

AXIOM_TOLERANCE = 1e-10
"""Largest residual of an axiom, relative to the size of what should cancel: derivatives round at about 1e-13."""


MAX_MATRIX_DIM = 200
"""Number of components up to which the matrices Pi and K are formed; for larger systems only their products with dH
and dS are tested."""


MAX_FULL_JACOBI_DIM = 40
"""Number of components up to which Jacobi's identity is tested for all coordinates at once, in arrays of n^3 numbers;
for larger systems it is tested for three functions."""


class CheckRow(TableRow):
    """A row of a report: an axiom with its largest relative residual; ``passed`` is None if it has no verdict."""

    @property
    def axiom(self) -> str:
        return self.name

    @property
    def residual(self) -> float:
        return self.value

    @property
    def tolerance(self) -> float:
        assert self.allowed is not None
        return self.allowed


@dataclass(frozen=True)
class CheckReport(Tabular):
    """A report on the axioms of a system with their residuals, which prints as a table."""

    rows: tuple[CheckRow, ...]
    points: int

    @property
    def passed(self) -> bool:
        return all(row.passed is not False for row in self.rows)

    def __repr__(self) -> str:
        return f"<CheckReport of {len(self.rows)} axioms: {self._summary}>"

    def _table_content(self) -> tuple[tuple[CheckRow, ...], tuple[str, str, str], str]:
        return self.rows, ("axiom", "residual", "tolerance"), f"{self._summary} (at {self.points} points)"

    @property
    def _summary(self) -> str:
        return "all axioms hold" if self.passed else "NOT metriplectic"


def check_system(
    system: Any, points, samples: int, seed: int, scale: float, times=None, with_matrices: bool = True
) -> CheckReport:
    """Test the axioms of a system at states and return a report: see :meth:`liethermo.systems.base.System.check`.

    Without ``with_matrices`` the tests of Pi and K are left out, for systems that satisfy them by construction.
    """
    system = system.drop_torque()
    if points is None:
        if samples < 1:
            raise InputError(f"samples must be a positive integer, got {samples}")
        points = system.samples(samples, seed, scale)
    else:
        points = np.asarray(system.state(points, batch=True))
    points = points.reshape(-1, system.dim)
    if system.is_driven:
        times = scale * np.random.default_rng(seed).standard_normal(len(points)) if times is None else times
        points = np.column_stack([points, np.broadcast_to(np.asarray(times, dtype=np.float64), len(points))])
    residuals = evaluate_at_points(
        _axiom_residuals if with_matrices else _axiom_residuals_without_matrices, system, points
    )
    friction = residuals.pop("friction", None)
    if friction is not None:
        residuals["semidefinite"] = np.array([_indefiniteness(K) for K in friction])
    is_inside = np.isfinite(residuals["domain"])
    if not is_inside.any():
        raise InputError(
            f"energy, entropy or dissipation is not finite at any of the {len(points)} test points. Give points inside "
            "their domain to system.check(points=...), and validate=False to the constructor"
        )
    rows = [
        _axiom_row(system, name, residuals[name][is_inside], axiom, note)
        for name, (axiom, note) in _AXIOMS.items()
        if name in residuals
    ]
    for name, values in residuals.items():
        if name.startswith("momentum map"):
            rows.append(_momentum_map_row(system, name, values[is_inside]))
        elif name not in _AXIOMS and name != "domain":
            rows.append(_axiom_row(system, name, values[is_inside], name, _SPECIFIC_AXIOM_NOTE))
    if not is_inside.all():
        rows.append(CheckRow("domain", float((~is_inside).sum()), 0.0, None, "points outside the domain, left out"))
    return CheckReport(tuple(rows), int(is_inside.sum()))


def require_axioms(system: Any, with_matrices: bool) -> None:
    """Raise an error if an axiom fails at random states; the constructors call it."""
    for row in check_system(system, None, 4, 0, 1.0, with_matrices=with_matrices).rows:
        if row.passed is not False:
            continue
        kind = CasimirError if row.axiom == "Pi grad S = 0" else AxiomError
        raise kind(
            f"{row.axiom} fails: residual {row.residual:.3g}, tolerance {row.tolerance:.1g}. {row.note}".rstrip()
            + " (validate=False builds the system all the same)",
            residual=row.residual,
            tolerance=row.tolerance,
        )


_AXIOMS = {
    "tangent": ("tangent", "Pi or K leads out of the space: what they return is not a tangent vector"),
    "classes": (
        "functions of classes",
        "energy, entropy or a momentum map changes along the stabilizer, where all points are one. Write it by what "
        "the stabilizer leaves alone, as the projectors of a flag are",
    ),
    "skew": ("Pi skew", "the Poisson tensor must be antisymmetric"),
    "jacobi": ("Jacobi", "Pi is not a Poisson tensor"),
    "casimir": (
        "Pi grad S = 0",
        "The entropy is not a Casimir function; on a Lie algebra g, g.casimirs(degree) lists polynomial ones",
    ),
    FRICTION_KERNEL_CHECK: (
        FRICTION_KERNEL_CHECK,
        "the friction operator does not have grad H in its kernel, and only its projection off grad H would act: give "
        "project=True if that is meant",
    ),
    CONVEXITY_CHECK: (CONVEXITY_CHECK, "a dissipation potential has to be convex in the forces, or entropy could fall"),
    MINIMUM_AT_ZERO_CHECK: (
        MINIMUM_AT_ZERO_CHECK,
        "a dissipation potential drives nothing where there is no force: its slope at zero vanishes",
    ),
    "symmetric": ("K symmetric", "the friction matrix must be symmetric"),
    "kernel": ("K grad H = 0", "the dissipation would change the energy"),
    "semidefinite": ("K >= 0", "the friction matrix has a negative eigenvalue, so entropy could fall"),
    "preserved": ("K grad L = 0", "the dissipation does not keep the functions it has to preserve"),
    "first law": ("energy law", "dH/dt along the vector field has the wrong size or sign"),
    "second law": ("entropy law", "dS/dt along the vector field has the wrong sign"),
    "production": ("min", "smallest entropy production found (no guarantee asked)"),
}
_MOMENTUM_MAP_NOTE = "a momentum map has to commute with H and lie in the kernel of K"
_SPECIFIC_AXIOM_NOTE = "what sets this kind of system apart does not hold"


def _axiom_row(system: Any, name: str, residuals: np.ndarray, axiom: str, note: str) -> CheckRow:
    """Return the row of the report on an axiom, from its residuals at the points, shape (points,)."""
    if name == "production":
        min_production = float(residuals.min())
        note = f"{note}: the entropy falls there" if min_production < 0.0 else note
        return CheckRow(f"{axiom} {system.entropy_production_name}", min_production, 0.0, None, note)
    max_residual = float(residuals.max())
    holds = max_residual <= AXIOM_TOLERANCE
    return CheckRow(axiom, max_residual, AXIOM_TOLERANCE, holds, "" if holds else note)


def _momentum_map_row(system: Any, name: str, residuals: np.ndarray) -> CheckRow:
    """Return the row of the report on a momentum map, from its residuals at the points where it is defined."""
    is_defined = np.isfinite(residuals)
    if not is_defined.any():
        return CheckRow(name, float("nan"), AXIOM_TOLERANCE, False, "it is not finite at any of the points")
    row = _axiom_row(system, name, residuals[is_defined], name, _MOMENTUM_MAP_NOTE)
    if is_defined.all() or not row.passed:
        return row
    return CheckRow(name, row.value, AXIOM_TOLERANCE, True, f"{int((~is_defined).sum())} points outside its domain")


def _indefiniteness(K: np.ndarray) -> float:
    """Return the modulus of the lowest eigenvalue of K over its largest entry; 0 if no eigenvalue is negative."""
    scale = np.abs(K).max()
    if not 0.0 < scale < np.inf:
        return 0.0 if scale == 0.0 else np.nan
    return max(0.0, -float(np.linalg.eigvalsh((K + K.T) / 2)[0])) / scale


def _axiom_residuals_without_matrices(system: Any, x: jax.Array) -> dict[str, jax.Array]:
    """Return the residuals of the axioms at a point that need neither Pi nor K as a matrix, by name."""
    return _axiom_residuals(system, x, with_matrices=False)


def _axiom_residuals(system: Any, x: jax.Array, with_matrices: bool = True) -> dict[str, jax.Array]:
    """Return the residuals of the axioms at a point, by name, relative to the terms that cancel, and the matrix K.

    If the energy depends on time, the last component of the point is the time.
    """
    if system.is_driven:
        return _axiom_residuals(system.at_time(x[-1]), x[:-1], with_matrices)
    size: Callable = lambda a: jnp.max(jnp.abs(a), initial=0.0)  # noqa: E731
    relative: Callable = lambda a, b: a / jnp.where(b > 0.0, b, 1.0)  # noqa: E731
    residuals = _dissipation_input_residuals(system, x)
    original = chart_system = system
    if system.space is not None:
        if with_matrices:  # otherwise it is tangent by construction
            velocity = system.vector_field(x)
            residuals["tangent"] = relative(size(velocity - project_tangent(system, x, velocity)), size(velocity))
        chart_system, _ = system.local_system(x)
        if system.space.is_quotient:
            residuals["classes"] = _stabilizer_residual(system, chart_system, x)
        system, x = system.local_system(x, is_centred=True)
    dH, rate = system.energy.gradient(x), system.vector_field(x)
    dS = jnp.zeros_like(x) if system.entropy is None else system.entropy.gradient(x)
    values = system.energy.value(x) + (0.0 if system.entropy is None else system.entropy.value(x))
    residuals["domain"] = values + jnp.sum(dH) + jnp.sum(dS) + jnp.sum(rate)
    if system.dim > MAX_MATRIX_DIM or not with_matrices:
        speed = size(system.poisson.sharp(x, dH)) + size(rate)
        if system.entropy is not None:
            residuals["casimir"] = relative(size(system.poisson.sharp(x, dS)), size(dS))
    else:
        noncentred_chart_system = None if chart_system is original else chart_system
        matrix_residuals, speed = _matrix_residuals(system, noncentred_chart_system, x, dH, dS)
        residuals, speed = residuals | matrix_residuals, speed + size(rate)
    if system.energy_law is not None:
        flow = jnp.dot(dH, rate)
        flow = jnp.abs(flow) if system.energy_law == "conserved" else jnp.maximum(flow, 0.0)
        residuals["first law"] = relative(flow, size(dH) * speed)
    if system.entropy is not None:
        production = jnp.dot(dS, rate)
        if system.entropy_law is None:
            residuals["production"] = production
        else:
            violation = jnp.abs(production) if system.entropy_law == "conserved" else jnp.maximum(-production, 0.0)
            residuals["second law"] = relative(violation, size(dS) * speed)
    for name, J in system.momentum_maps.items():
        dJ = J.gradient(x)
        drift = relative(jnp.abs(jnp.dot(dJ, rate)), size(dJ) * speed)
        residuals[f"momentum map {name}"] = jnp.where(jnp.isfinite(J.value(x)), drift, jnp.nan)
    return residuals | system.specific_axiom_residuals(x)


def _stabilizer_residual(system: Any, chart_system: Any, x) -> jax.Array:
    """Return the largest part of a gradient along the stabilizer of a quotient space, relative to the gradient."""
    size: Callable = lambda a: jnp.max(jnp.abs(a), initial=0.0)  # noqa: E731
    functions = [f for f in (system.energy, system.entropy, *system.momentum_maps.values()) if f is not None]
    residuals = []
    for gradient in (f.gradient(x) for f in functions):
        vector, norm = chart_system.raise_index(x, gradient), size(gradient)
        residuals.append(size(vector - project_tangent(system, x, vector)) / jnp.where(norm > 0.0, norm, 1.0))
    return jnp.max(jnp.stack(residuals))


def _dissipation_input_residuals(system: Any, x) -> dict[str, jax.Array]:
    """Return the residuals of conditions on the functions given to dissipations, by name, the largest of each."""
    residuals: dict[str, jax.Array] = {}
    for term in system.total_dissipation.terms:
        for name, residual in term.input_residuals(system, x).items():
            residuals[name] = jnp.maximum(residuals.get(name, 0.0), residual)
    return residuals


def _matrix_residuals(system: Any, noncentred_chart_system: Any, x, dH, dS):
    """Return residuals of the axioms on the matrices Pi and K, by name, and a scale of the speed of the motion.

    On a manifold ``noncentred_chart_system`` is the system in a chart that is not centred at the point, otherwise None.
    """
    size: Callable = lambda a: jnp.max(jnp.abs(a), initial=0.0)  # noqa: E731
    relative: Callable = lambda a, b: a / jnp.where(b > 0.0, b, 1.0)  # noqa: E731
    tensor = system.poisson.tensor(x)
    residuals = {"skew": relative(size(tensor + tensor.T), size(tensor))}
    if system.engine_hints.is_smooth and noncentred_chart_system is None and x.size > MAX_FULL_JACOBI_DIM:
        residuals["jacobi"] = _sampled_jacobi_residual(system.poisson, x)
    elif system.engine_hints.is_smooth:
        poisson = (noncentred_chart_system or system).poisson
        variation = size(jax.jacfwd(poisson.tensor)(x))
        if noncentred_chart_system is not None:  # in normal coordinates the derivative may be rounding alone
            variation = variation + size(tensor)
        residuals["jacobi"] = relative(poisson.jacobi_residual(x), size(tensor) * variation)
    if system.entropy is not None:
        residuals["casimir"] = relative(size(tensor @ dS), size(tensor) * size(dS))
    dissipation = system.total_dissipation
    if dissipation.entropy_law == "nondecreasing" and dissipation.is_symmetric:
        K = system.friction_matrix(x)
        residuals["symmetric"] = relative(size(K - K.T), size(K))
        residuals["kernel"] = relative(size(K @ dH), size(K) * size(dH))
        residuals["friction"] = K
        for term in dissipation.terms:  # each preserves functions of its own
            K_term = system.friction_matrix(x, dissipation=term) if term.preserve else K
            for L in term.preserve:
                dL = L.gradient(x)
                residual = relative(size(K_term @ dL), size(K_term) * size(dL))
                residuals["preserved"] = jnp.maximum(residuals.get("preserved", 0.0), residual)
    return residuals, size(tensor) * size(dH)


def _sampled_jacobi_residual(poisson: Any, x) -> jax.Array:
    """Return the residual of Jacobi's identity for three random linear functions, relative to its largest term."""
    covectors = np.random.default_rng(0).standard_normal((3, x.size))

    def cyclic_term(f, g, h):
        return jax.jvp(lambda y: jnp.dot(g, poisson.sharp(y, h)), (x,), (poisson.sharp(x, f),))[1]

    terms = jnp.stack([cyclic_term(*np.roll(covectors, i, axis=0)) for i in range(3)])
    max_term = jnp.max(jnp.abs(terms))
    return jnp.abs(jnp.sum(terms)) / jnp.where(max_term > 0.0, max_term, 1.0)
