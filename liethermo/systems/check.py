"""The axioms of a metriplectic system, tested at points [BFM §2.3]."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from manifolds._tables import TableRow, Tabular

from ..dissipation.friction_operator import FRICTION_KERNEL_CHECK
from ..dissipation.potential import CONVEXITY_CHECK, MINIMUM_AT_ZERO_CHECK
from ..errors import InputError
from ..tracing.interpret import evaluate_at_points

AXIOM_TOLERANCE = 1e-10
"""Largest residual of an axiom, relative to the size of what should cancel: derivatives round at about 1e-13."""


MAX_MATRIX_DIM = 200
"""Components up to which the matrices Pi and K are formed; of larger systems only what they do to dH and dS is looked \
at."""


MAX_FULL_JACOBI_DIM = 40
"""Components up to which Jacobi's identity is tested for all coordinates at once, in arrays of n^3 numbers; of larger
systems for three functions."""


class CheckRow(TableRow):
    """One axiom: its worst relative residual over the points. ``passed`` is None for a report without a verdict."""

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
    """The axioms of a system and how far each is from holding. Printing it gives a table."""

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
    system: Any, points, samples: int, seed: int, scale: float, times=None, matrices: bool = True
) -> CheckReport:
    """See :meth:`liethermo.systems.base.System.check`; without ``matrices``, for what is not true of them by form."""
    system = system.drop_torque()
    if points is None:
        if samples < 1:
            raise InputError(f"samples must be a positive integer, not {samples}")
        points = system.samples(samples, seed, scale)
    else:
        points = np.asarray(system.state(points, batch=True))
    points = points.reshape(-1, system.dim)
    if system.is_driven:
        times = scale * np.random.default_rng(seed).standard_normal(len(points)) if times is None else times
        points = np.column_stack([points, np.broadcast_to(np.asarray(times, dtype=np.float64), len(points))])
    measured = evaluate_at_points(_axiom_residuals if matrices else _field_residuals, system, points)
    friction = measured.pop("friction", None)
    if friction is not None:
        measured["semidefinite"] = np.array([_indefiniteness(K) for K in friction])
    inside = np.isfinite(measured["domain"])
    if not inside.any():
        raise InputError(
            f"energy, entropy or dissipation is not finite at any of the {len(points)} test points: give points inside "
            "their domain to system.check(points=...), and validate=False to the constructor"
        )
    rows = [
        _axiom_row(system, name, measured[name][inside], axiom, note)
        for name, (axiom, note) in _AXIOMS.items()
        if name in measured
    ]
    for name, values in measured.items():
        if name.startswith("momentum map"):
            rows.append(_momentum_map_row(system, name, values[inside]))
        elif name not in _AXIOMS and name != "domain":
            rows.append(_axiom_row(system, name, values[inside], name, _SPECIFIC_AXIOM_NOTE))
    if not inside.all():
        rows.append(CheckRow("domain", float((~inside).sum()), 0.0, None, "points outside the domain, left out"))
    return CheckReport(tuple(rows), int(inside.sum()))


_AXIOMS = {
    "tangent": ("tangent", "Pi or K leads out of the space: what they return is not a tangent vector"),
    "classes": (
        "functions of classes",
        "energy, entropy or a momentum map changes along the stabilizer, where all points are one: write it by what "
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


def _axiom_row(system: Any, name: str, values: np.ndarray, axiom: str, note: str) -> CheckRow:
    worst = float(values.max())
    if name == "production":
        least = float(values.min())
        note = f"{note}: the entropy falls there" if least < 0.0 else note
        return CheckRow(f"{axiom} {system.production_name}", least, 0.0, None, note)
    passed = worst <= AXIOM_TOLERANCE
    return CheckRow(axiom, worst, AXIOM_TOLERANCE, passed, "" if passed else note)


def _momentum_map_row(system: Any, name: str, values: np.ndarray) -> CheckRow:
    """Return the row of a momentum map at the points inside its own domain, if there are any."""
    is_defined = np.isfinite(values)
    if not is_defined.any():
        return CheckRow(name, float("nan"), AXIOM_TOLERANCE, False, "it is not finite at any of the points")
    row = _axiom_row(system, name, values[is_defined], name, _MOMENTUM_MAP_NOTE)
    if is_defined.all() or not row.passed:
        return row
    return CheckRow(name, row.value, AXIOM_TOLERANCE, True, f"{int((~is_defined).sum())} points outside its domain")


def _indefiniteness(K: np.ndarray) -> float:
    """Minus the lowest eigenvalue where that is negative, relative to the size of K."""
    scale = np.abs(K).max()
    if not 0.0 < scale < np.inf:
        return 0.0 if scale == 0.0 else np.nan
    return max(0.0, -float(np.linalg.eigvalsh((K + K.T) / 2)[0])) / scale


def _field_residuals(system: Any, x: jax.Array) -> dict[str, jax.Array]:
    return _axiom_residuals(system, x, matrices=False)


def _axiom_residuals(system: Any, x: jax.Array, matrices: bool = True) -> dict[str, jax.Array]:
    """Residual of each axiom at a point, relative to the size of the terms that cancel; and the friction matrix.

    Where the energy depends on time, the point has the time behind it.
    """
    if system.is_driven:
        return _axiom_residuals(system.at_time(x[-1]), x[:-1], matrices)
    size: Callable = lambda a: jnp.max(jnp.abs(a), initial=0.0)  # noqa: E731
    relative: Callable = lambda a, b: a / jnp.where(b > 0.0, b, 1.0)  # noqa: E731
    found = _dissipation_residuals(system, x)
    given = around = system
    if system.space is not None:
        if matrices:  # else it is tangent by form
            velocity = system.vector_field(x)
            found["tangent"] = relative(size(velocity - system.project_tangent(x, velocity)), size(velocity))
        around, _ = system.local_system(x)
        if system.space.is_quotient:
            found["classes"] = _stabilizer_residual(system, around, x)
        system, x = system.local_system(x, is_centred=True)
    dH, rate = system.energy.gradient(x), system.vector_field(x)
    dS = jnp.zeros_like(x) if system.entropy is None else system.entropy.gradient(x)
    values = system.energy.value(x) + (0.0 if system.entropy is None else system.entropy.value(x))
    found["domain"] = values + jnp.sum(dH) + jnp.sum(dS) + jnp.sum(rate)
    if system.dim > MAX_MATRIX_DIM or not matrices:
        speed = size(system.poisson.sharp(x, dH)) + size(rate)
        if system.entropy is not None:
            found["casimir"] = relative(size(system.poisson.sharp(x, dS)), size(dS))
    else:
        of_matrices, speed = _matrix_residuals(system, None if around is given else around, x, dH, dS)
        found, speed = found | of_matrices, speed + size(rate)
    if system.energy_law is not None:
        flow = jnp.dot(dH, rate)
        flow = jnp.abs(flow) if system.energy_law == "conserved" else jnp.maximum(flow, 0.0)
        found["first law"] = relative(flow, size(dH) * speed)
    if system.entropy is not None:
        production = jnp.dot(dS, rate)
        if system.entropy_law is None:
            found["production"] = production
        else:
            wrong = jnp.abs(production) if system.entropy_law == "conserved" else jnp.maximum(-production, 0.0)
            found["second law"] = relative(wrong, size(dS) * speed)
    for name, J in system.momentum_maps.items():
        dJ = J.gradient(x)
        drift = relative(jnp.abs(jnp.dot(dJ, rate)), size(dJ) * speed)
        found[f"momentum map {name}"] = jnp.where(jnp.isfinite(J.value(x)), drift, jnp.nan)
    return found | system.specific_residuals(x)


def _stabilizer_residual(system: Any, around: Any, x) -> jax.Array:
    """What of the gradients is along the constraints but not the space: the largest, relative to its gradient."""
    size: Callable = lambda a: jnp.max(jnp.abs(a), initial=0.0)  # noqa: E731
    functions = [f for f in (system.energy, system.entropy, *system.momentum_maps.values()) if f is not None]
    found = []
    for gradient in (f.gradient(x) for f in functions):
        along, whole = around.raise_index(x, gradient), size(gradient)
        found.append(size(along - system.project_tangent(x, along)) / jnp.where(whole > 0.0, whole, 1.0))
    return jnp.max(jnp.stack(found))


def _dissipation_residuals(system: Any, x) -> dict[str, jax.Array]:
    """Residuals of what the dissipations were given, the largest of each name."""
    found: dict[str, jax.Array] = {}
    for part in () if system.dissipation is None else system.dissipation.terms:
        for name, residual in part.input_residuals(system, x).items():
            found[name] = jnp.maximum(found.get(name, 0.0), residual)
    return found


def _matrix_residuals(system: Any, around: Any, x, dH, dS):
    """Residuals of the axioms on the matrices Pi and K; and the size of the motion, for what cancels in it.

    The motion itself may vanish at every point. On a manifold ``around`` is the system in a chart that is not centred.
    """
    size: Callable = lambda a: jnp.max(jnp.abs(a), initial=0.0)  # noqa: E731
    relative: Callable = lambda a, b: a / jnp.where(b > 0.0, b, 1.0)  # noqa: E731
    tensor = system.poisson.tensor(x)
    found = {
        "skew": relative(size(tensor + tensor.T), size(tensor)),
    }
    if system.is_smooth and around is None and x.size > MAX_FULL_JACOBI_DIM:
        found["jacobi"] = _sampled_jacobi_residual(system.poisson, x)
    elif system.is_smooth:
        variation = size(jax.jacfwd((around or system).poisson.tensor)(x))
        if around is not None:  # in normal coordinates it may be rounding alone: as seen over a unit of length, then
            variation = variation + size(tensor)
        found["jacobi"] = relative((around or system).poisson.jacobi_residual(x), size(tensor) * variation)
    if system.entropy is not None:
        found["casimir"] = relative(size(tensor @ dS), size(tensor) * size(dS))
    dissipation = system.dissipation
    if dissipation is not None and dissipation.entropy_law == "nondecreasing" and dissipation.is_symmetric:
        K = system.friction_matrix(x)
        found["symmetric"] = relative(size(K - K.T), size(K))
        found["kernel"] = relative(size(K @ dH), size(K) * size(dH))
        found["friction"] = K
        for part in dissipation.terms:  # each keeps its own
            own = system.friction_matrix(x, dissipation=part) if part.preserve else K
            for L in part.preserve:
                dL = L.gradient(x)
                residual = relative(size(own @ dL), size(own) * size(dL))
                found["preserved"] = jnp.maximum(found.get("preserved", 0.0), residual)
    return found, size(tensor) * size(dH)


def _sampled_jacobi_residual(poisson: Any, x) -> jax.Array:
    """``{f, {g, h}}`` and its cyclic permutations for three random linear functions: their sum, beside the largest."""
    of_three = np.random.default_rng(0).standard_normal((3, x.size))

    def term(f, g, h):
        return jax.jvp(lambda y: jnp.dot(g, poisson.sharp(y, h)), (x,), (poisson.sharp(x, f),))[1]

    terms = jnp.stack([term(*np.roll(of_three, i, axis=0)) for i in range(3)])
    largest = jnp.max(jnp.abs(terms))
    return jnp.abs(jnp.sum(terms)) / jnp.where(largest > 0.0, largest, 1.0)
