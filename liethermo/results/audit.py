"""Audit of a run: whether its laws hold at every step, and whether it follows the vector field of the system."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import numpy as np

from manifolds._tables import TableRow, Tabular

from ..engines.status_codes import StatusCode
from ..errors import InputError
from ..functions.gradients import EPS
from .rounding_scale import InvariantDrift, RoundingScale

if TYPE_CHECKING:
    from .audit_evidence import Evidence
    from .status import Laws, Stats, Status


class AuditedRun(Protocol):
    """Run with the attributes that an audit reads, such as a :class:`liethermo.Solution`."""

    @property
    def energy_balance(self) -> np.ndarray: ...
    @property
    def entropy(self) -> np.ndarray | None: ...
    @property
    def casimirs(self) -> dict[str, np.ndarray]: ...
    @property
    def status(self) -> Status: ...
    @property
    def stats(self) -> Stats: ...
    @property
    def laws(self) -> Laws: ...
    @property
    def evidence(self) -> Evidence: ...


@dataclass(frozen=True)
class Tolerances:
    """Tolerances of an audit.

    A change of a function is judged relative to the scale at which rounding acts on it, its *sensitivity*
    ``max |grad f(x)| |x|`` along the run (:meth:`liethermo.Energy.sensitivity`), whatever its value is at the start.
    Eight roundings of the value, and of the terms that cancel in it, are added to the tolerance: smaller changes are
    lost if a constant is added to the function, or in ``1 - cos q`` near q = 0.

    Attributes
    ----------
    energy : float
        Drift. Exact schemes stay near 1e-15 for thousands of steps, below 2e-14 for a million.
    entropy : float
        Decrease of the entropy in one step: four roundings of the state. The residual of the stage equations is
        allowed besides, up to the tolerance ``residual``.
    casimirs : float
        Drift of the functions that the system conserves and of the spatial momentum; decrease of the entropy in total.
    residual : float
        Residual of the stage equations, which reaches their rounding plateau.
    attitude : float
        Distance from the group, relative to the norm of the attitude, as in ``manifolds.MatrixGroup.belongs``.
    accuracy : float
        Local error of a step, measured against short steps, relative to its length (or to a hundredth of the whole
        motion, if that is longer). A second-order method has 0.05 with eight steps per period.
    consistency : float
        Distance of the slope of a step from the vector field, relative to the field, as the step gets shorter.
    """

    energy: float = 1e-13
    entropy: float = 4 * EPS
    casimirs: float = 1e-12
    residual: float = 1e-12
    attitude: float = 1e-10
    accuracy: float = 0.05
    consistency: float = 1e-4

    def __post_init__(self):
        for name, value in vars(self).items():
            if not value >= 0.0:
                raise InputError(f"the tolerance {name} must be >= 0, got {value}")

    @classmethod
    def with_defaults(cls, **tolerances: float) -> Tolerances:
        """Return tolerances with the given values and defaults for the others; InputError for an unknown name."""
        names = [field.name for field in fields(cls)]
        unknown = [name for name in tolerances if name not in names]
        if unknown:
            raise InputError(f"there is no tolerance {unknown[0]!r}; an audit has {', '.join(names)}")
        return cls(**tolerances)


@dataclass(frozen=True)
class AuditRow(TableRow):
    """Row of an audit with law, measured value, tolerance, and verdict (None if nothing is promised).

    Attributes
    ----------
    concerns_model : bool
        True if the row judges the validity of the equations, and not the run.
    """

    concerns_model: bool = False

    @property
    def law(self) -> str:
        return self.name

    @property
    def tolerance(self) -> float | None:
        return self.allowed


ACCURACY_ROW = "accuracy"
"""Name of the row that judges the local errors."""

CONSISTENCY_ROW = "consistency"
"""Name of the row that compares short steps with the vector field."""

STEPS_TAKEN_ROW = "steps taken"
"""Name of the row that says whether a run reached its end."""

FAILED_TRAJECTORIES_ROW = "trajectories that failed"
"""Name of the row that counts the trajectories of an ensemble that did not reach their end."""

OUTSIDE_MODEL_VERDICT = "; THE EQUATIONS ARE USED WHERE THEY ARE NOT VALID"
"""End of the verdict of an audit in which a condition of the model does not hold."""

UNPROMISED_NOTE = "no law promised"
"""Note in the row of the energy or the entropy if the system or the method promises nothing about it."""

LAW_FAILURE_VERDICT = "A LAW FAILS"
"""Verdict of an audit in which a law is violated."""


@dataclass(frozen=True)
class Audit(Tabular):
    """The laws of a run, its accuracy, and its consistency with the vector field; printed as a table.

    Attributes
    ----------
    energy_drift : float
        ``max |H - H0|`` over all steps, H less the work done from outside, relative to the rounding scale of H: the
        larger of ``|H0|`` and ``max |grad H(x)| |x|`` along the run.
    entropy_min_increment : float
        Smallest increment of the entropy in one step; NaN without an entropy.
    casimir_drift : float
        Largest drift, relative to the rounding scale of each, of the functions that the system conserves and the method
        promises to keep; NaN if there are none.
    worst_residual : float
        Largest residual of the stage equations.
    passed : bool
        Whether the laws hold along the motion of the system. The accuracy of the steps is judged by ``resolved`` and
        ``verdict``.
    resolved : bool or None
        Whether the examined steps resolve the motion: the largest local error, compared with short steps, is within the
        tolerance ``accuracy``. It is about single steps and not about the accumulated error. None without information
        about the steps.
    rows : tuple of AuditRow
        The rows of the table.
    coverage : str
        Number of steps that were checked, if not all; the verdict says it too.

    Examples
    --------
    >>> body = lt.models.rigid_body((3.0, 2.0, 1.0), rate=0.2)
    >>> audit = lt.integrate(body, [0.1, 0.2, 1.0], (0.0, 5.0), 0.1).audit()
    >>> audit.passed, audit.resolved, audit.energy_drift < 1e-14
    (True, True, True)
    >>> audit.verdict
    'the laws hold, and the steps resolve the motion'
    """

    energy_drift: float
    entropy_min_increment: float
    casimir_drift: float
    worst_residual: float
    rows: tuple[AuditRow, ...]
    coverage: str = ""

    @property
    def passed(self) -> bool:
        judged_rows = [row for row in self.rows if row.law != ACCURACY_ROW and not row.concerns_model]
        return all(row.passed is not False for row in judged_rows)

    @property
    def resolved(self) -> bool | None:
        return next((row.passed for row in self.rows if row.law == ACCURACY_ROW), None)

    @property
    def verdict(self) -> str:
        """Summary of the audit in one line."""
        is_outside = any(row.passed is False and row.concerns_model for row in self.rows)
        return self._verdict_on_run + (OUTSIDE_MODEL_VERDICT if is_outside else "")

    @property
    def _verdict_on_run(self) -> str:
        """Summary of the rows that judge the run, without those that judge the validity of the model."""
        violated_rows = {row.law for row in self.rows if row.passed is False and not row.concerns_model}
        if violated_rows - {ACCURACY_ROW, CONSISTENCY_ROW, STEPS_TAKEN_ROW, FAILED_TRAJECTORIES_ROW}:
            return LAW_FAILURE_VERDICT
        laws = "the promised laws" if any(row.note == UNPROMISED_NOTE for row in self.rows) else "the laws"
        if STEPS_TAKEN_ROW in violated_rows:
            return f"THE RUN STOPPED before its end; {laws} hold until there"
        if FAILED_TRAJECTORIES_ROW in violated_rows:
            return f"SOME TRAJECTORIES STOPPED before their end; {laws} hold until there"
        if CONSISTENCY_ROW in violated_rows:
            return f"{laws} hold, but THE STEPS DO NOT FOLLOW THE VECTOR FIELD"
        if self.resolved is None:
            return f"{laws} hold"
        if self.resolved:
            return f"{laws} hold, and the steps resolve the motion{self.coverage and f' ({self.coverage})'}"
        return f"{laws} hold, but THE STEPS DO NOT RESOLVE THE MOTION"

    def __repr__(self) -> str:
        return f"<Audit of {len(self.rows)} rows: {self.verdict}>"

    def _table_content(self) -> tuple[tuple[AuditRow, ...], tuple[str, str, str], str]:
        return self.rows, ("law", "measured", "allowed"), self.verdict


class RunExtremes(NamedTuple):
    """Extremes over all steps of a single run, as arrays of an ensemble of one: see :class:`liethermo.Ensemble`.

    ``entropy_change`` is the largest change among the saved states; of an entropy that must not fall, its largest fall.
    """

    steps: np.ndarray
    ok: np.ndarray
    residual: np.ndarray
    first_energy: np.ndarray
    energy_drift: np.ndarray
    energy_sensitivity: np.ndarray
    largest_energy_increment: np.ndarray
    least_entropy_increment: np.ndarray
    entropy_change: np.ndarray
    entropy_scale: np.ndarray
    entropy_sensitivity: np.ndarray

    @classmethod
    def from_solution(cls, solution: AuditedRun) -> RunExtremes:
        """Return the extremes over all steps of a run, from its statistics and its saved states."""
        stats, energy, evidence = solution.stats, solution.energy_balance, solution.evidence
        smallest_energy, largest_energy = stats.energy_range or (np.inf, -np.inf)
        drift = max(
            largest_energy - energy[0], energy.max() - energy[0], energy[0] - smallest_energy, energy[0] - energy.min()
        )
        rounding = RoundingScale.from_series(energy, evidence.energy)
        increment = max([*np.diff(energy), _value_or_default(stats.largest_energy_increment, -np.inf)])
        entropy = np.full(1, np.nan) if solution.entropy is None else solution.entropy
        change = entropy - entropy[0]
        change = change[np.argmax(np.abs(change))]
        if solution.laws.entropy == "nondecreasing":
            change = -(np.maximum.accumulate(entropy) - entropy).max()
        least_increment = min([*np.diff(entropy), _value_or_default(stats.least_entropy_increment, np.inf)])
        entropy_scale = np.abs(entropy).max()
        values = (
            max(stats.steps, len(energy) - 1, 1),
            True,
            stats.worst_residual,
            energy[0],
            drift / rounding.scale,
            rounding.sensitivity,
            increment,
            np.nan if solution.entropy is None else least_increment,
            change,
            entropy_scale,
            _value_or_default(evidence.entropy, entropy_scale),
        )
        return cls(*(np.atleast_1d(value) for value in values))


@dataclass(frozen=True, eq=False)
class LawCheck:
    """Measured values and limits of a law along B trajectories.

    Attributes
    ----------
    law : str
    values : ndarray, shape (B,)
        Measured value along each trajectory, relative to its rounding scale.
    limits : ndarray, shape (B,), or None
        Largest value allowed; None if nothing is promised.
    note : str
    shown_values, shown_limits : ndarray, shape (B,), or None
        Values and limits that a row shows instead.
    total_falls : ndarray, shape (B,), or None
        Total fall of the entropy if it is too large although each step is within the rounding; otherwise zero.
    """

    law: str
    values: np.ndarray
    limits: np.ndarray | None
    note: str = ""
    shown_values: np.ndarray | None = None
    shown_limits: np.ndarray | None = None
    total_falls: np.ndarray | None = None

    @property
    def is_violated(self) -> np.ndarray:
        """True for each trajectory that violates the law, shape (B,)."""
        if self.limits is None:
            return np.zeros(len(self.values), dtype=bool)
        is_violated = ~(self.values <= self.limits)
        return is_violated if self.total_falls is None else is_violated | (self.total_falls > 0.0)

    @property
    def excess(self) -> np.ndarray:
        """Measured values minus limits, shape (B,), by which an audit selects the worst trajectory."""
        excess = self.values if self.limits is None else self.values - self.limits
        return excess if self.total_falls is None else np.where(self.total_falls > 0.0, self.total_falls, excess)

    def audit_row(self, trajectory_index: int, note: str = "") -> AuditRow:
        """Return the row of an audit that shows the law for one trajectory."""
        notes = [self.note, note]
        if self.total_falls is not None and self.total_falls[trajectory_index] > 0.0:
            notes.insert(0, f"in all it falls by {self.total_falls[trajectory_index]:.2g}")
        values = self.values if self.shown_values is None else self.shown_values
        limits = self.limits if self.shown_limits is None else self.shown_limits
        allowed_value, is_satisfied = (
            (None, None)
            if limits is None
            else (float(limits[trajectory_index]), not self.is_violated[trajectory_index])
        )
        return AuditRow(
            self.law,
            float(values[trajectory_index]),
            allowed_value,
            is_satisfied,
            "; ".join(text for text in notes if text),
        )


def check_laws(
    extremes: Any, laws: Laws, tolerances: Tolerances, term_magnitudes: Mapping[str, Any], has_entropy: bool
) -> list[LawCheck]:
    """Return a check of each law of energy and entropy along trajectories, then a check of the stage residual.

    Trajectories without a step satisfy all laws.

    Parameters
    ----------
    extremes : RunExtremes, or Ensemble
    laws : Laws
        Laws that are promised for each trajectory.
    tolerances : Tolerances
    term_magnitudes : mapping to float or array, shape (B,)
        Magnitudes of the largest terms of which "energy" and "entropy" are sums, if they are known.
    has_entropy : bool
        Whether the entropy has a check if nothing is promised about it.
    """
    checks, has_stepped, name = [], extremes.steps > 0, " minus ".join(["energy", *laws.balance])

    def make_check(law: str, values, limits, note: str = "", **other_arrays) -> LawCheck:
        limits = None if limits is None else np.where(has_stepped, limits, np.inf)
        other_arrays = {name: np.where(has_stepped, array, 0.0) for name, array in other_arrays.items()}
        return LawCheck(law, np.where(has_stepped, values, 0.0), limits, note, **other_arrays)

    rounding = RoundingScale(extremes.first_energy, extremes.energy_sensitivity, term_magnitudes.get("energy", 0.0))
    allowed_change, note = rounding.allowed_change(tolerances.energy), _inexact_law_note(laws, "energy")
    if laws.energy == "conserved":
        checks.append(make_check(f"{name} drift", extremes.energy_drift, allowed_change, note))
    elif laws.energy is None:
        checks.append(make_check(f"{name} drift", extremes.energy_drift, None, _note_without_law(laws, "energy")))
    else:
        checks.append(
            make_check(
                f"largest {name} increment",
                extremes.largest_energy_increment / rounding.scale,
                allowed_change,
                note,
            )
        )
    rounding = RoundingScale(extremes.entropy_scale, extremes.entropy_sensitivity, term_magnitudes.get("entropy", 0.0))
    least_increment, note = extremes.least_entropy_increment, _inexact_law_note(laws, "entropy")
    # A step is known up to its residual: while this is small enough, the entropy may fall by as much.
    step_tolerance = tolerances.entropy + np.minimum(np.nan_to_num(extremes.residual), tolerances.residual)
    allowed_change, allowed_total_change = (rounding.allowed_change(t) for t in (step_tolerance, tolerances.casimirs))
    if laws.entropy == "conserved":
        change = np.maximum(np.abs(extremes.entropy_change), -least_increment) / rounding.scale
        checks.append(make_check("entropy drift", change, allowed_total_change, note))
    elif laws.entropy == "nondecreasing":
        fall, is_step_allowed = -extremes.entropy_change, -least_increment / rounding.scale <= allowed_change
        falls_in_all = np.where(is_step_allowed & (fall > allowed_total_change * rounding.scale), fall, 0.0)
        shown_arrays = {
            "shown_values": least_increment,
            "shown_limits": -allowed_change * rounding.scale,
            "total_falls": falls_in_all,
        }
        checks.append(
            make_check(
                "least entropy increment", -least_increment / rounding.scale, allowed_change, note, **shown_arrays
            )
        )
    elif has_entropy:
        checks.append(
            make_check(
                "least entropy increment",
                -least_increment,
                None,
                _note_without_law(laws, "entropy"),
                shown_values=least_increment,
            )
        )
    return [
        *checks,
        make_check("stage residual", np.where(extremes.ok, extremes.residual, 0.0), tolerances.residual),
    ]


def audit_run(solution: AuditedRun, tolerances: Tolerances) -> Audit:
    """Return the audit of the laws, the accuracy and the status of a run: see :meth:`liethermo.Solution.audit`."""
    stats, laws, evidence = solution.stats, solution.laws, solution.evidence
    extremes = RunExtremes.from_solution(solution)
    checks = check_laws(extremes, laws, tolerances, evidence.terms, solution.entropy is not None)
    *rows, residual_row = (check.audit_row(0) for check in checks)
    drifts = []
    for name, series in solution.casimirs.items():
        if name in laws.ledger:
            continue
        invariant_drift = InvariantDrift.from_series(series, evidence.invariants.get(name), evidence.terms.get(name))
        change = invariant_drift.change
        if name in laws.conserved:
            drifts.append(change)
            rows.append(invariant_drift_row(name, invariant_drift, tolerances))
        elif name in laws.unpromised:
            rows.append(AuditRow(f"drift of {name}", change, None, None, UNPROMISED_CONSTANT_NOTE))
        else:
            note = UNKNOWN_CONSTANCY_NOTE if name in laws.unknown else "not a constant of this system"
            rows.append(AuditRow(f"change of {name}", change, None, None, note))
    for name in laws.ledger:
        series = solution.casimirs[name]
        law_name = "momentum in space" if name.startswith("impulse") else "energy"
        rows.append(
            AuditRow(
                name,
                float(series[-1] - series[0]),
                None,
                None,
                f"received from outside; already subtracted in the {law_name} row",
            )
        )
    rows.append(residual_row)
    if stats.attitude_residual is not None:
        rows.append(_judged_row("attitude in group", stats.attitude_residual, tolerances.attitude))
    if stats.spatial_momentum_change is not None:
        rows.append(_spatial_momentum_row(stats.spatial_momentum_change, laws, tolerances))
    rows += condition_rows(evidence)
    rows += accuracy_and_consistency_rows(evidence, tolerances)
    status = solution.status  # a run stopped by its user is short, but breaks no law
    has_failed = not status.ok and status.code != StatusCode.INTERRUPTED.status_name
    rows.append(
        AuditRow(
            STEPS_TAKEN_ROW,
            stats.steps,
            None,
            False if has_failed else None,
            "" if status.ok else str(status.code),
        )
    )
    coverage = coverage_text(evidence, stats.steps)
    return Audit(
        float(extremes.energy_drift[0]),
        float(extremes.least_entropy_increment[0]),
        max(drifts, default=np.nan),
        stats.worst_residual,
        tuple(rows),
        coverage,
    )


def invariant_drift_row(name: str, drift: InvariantDrift, tolerances: Tolerances) -> AuditRow:
    """Return the audit row that judges the drift of a conserved function."""
    return _judged_row(f"drift of {name}", drift.change, drift.allowed_change(tolerances.casimirs))


def _spatial_momentum_row(change: float, laws: Laws, tolerances: Tolerances) -> AuditRow:
    """Return the audit row of the spatial momentum, less the impulse of external torques if the ledger has it."""
    name = "momentum in space"
    if any(entry.startswith("impulse") for entry in laws.ledger):
        name += " less the impulse"
    if name in laws.conserved:
        return _judged_row(f"drift of {name}", change, tolerances.casimirs)
    if name in laws.unpromised:
        return AuditRow(f"drift of {name}", change, None, None, UNPROMISED_CONSTANT_NOTE)
    return AuditRow(f"change of {name}", change, None, None, "not a constant of this system, because a torque acts")


UNKNOWN_CONSTANCY_NOTE = (
    "whether the system conserves this function is unknown: it could not be evaluated at any point that was tried"
)
"""Note of a function for which no test could decide whether the system conserves it."""

UNPROMISED_CONSTANT_NOTE = "a constant of this system, but the method does not conserve it exactly"
"""Note of a conserved function that the method does not conserve exactly."""


def accuracy_and_consistency_rows(evidence: Evidence, tolerances: Tolerances) -> list[AuditRow]:
    """Return the audit rows of accuracy (local error) and of consistency (with the vector field), if measured."""
    rows, inconsistency = [_accuracy_row(evidence, tolerances)], evidence.inconsistency
    if inconsistency is not None:
        row = _judged_row(CONSISTENCY_ROW, inconsistency, tolerances.consistency)
        note = "" if row.passed else "short steps of this method do not follow the vector field of this system"
        rows.append(replace(row, note=note))
    return rows


def condition_rows(evidence: Evidence) -> list[AuditRow]:
    """Return the audit rows of conditions besides the laws, such as the positivity of a density matrix."""
    return [AuditRow(c.name, c.value, c.limit, c.holds, c.note, c.concerns_model) for c in evidence.conditions]


def _accuracy_row(evidence: Evidence, tolerances: Tolerances) -> AuditRow:
    """Return the audit row that judges by the largest local error whether the steps resolve the motion."""
    if evidence.local_error is None:
        return AuditRow(ACCURACY_ROW, np.nan, None, None, "the local errors were not estimated")
    row = _judged_row(ACCURACY_ROW, evidence.local_error, tolerances.accuracy)
    location = f"largest local error, relative to the length of the step; worst at t = {evidence.error_time:.4g}"
    return replace(
        row, note=location if row.passed else f"the steps do not resolve the motion. Try suggest_step; {location}"
    )


def coverage_text(evidence: Evidence, n_steps: int) -> str:
    """Return a text that says how many of the steps were checked, or "" if all were."""
    n_checked = evidence.looked
    return "" if n_checked is None or n_checked >= n_steps else f"checked {n_checked:,} of {n_steps:,} steps"


INEXACT_LAW_NOTE = "not kept exactly by this method"
"""Note of a law that the method does not promise to keep."""


def _judged_row(law: str, value: float, tolerance: float) -> AuditRow:
    return AuditRow(law, float(value), tolerance, bool(value <= tolerance), "")


def _inexact_law_note(laws: Laws, law: str) -> str:
    return INEXACT_LAW_NOTE if law in laws.inexact else ""


def _note_without_law(laws: Laws, law: str) -> str:
    return "a law of the mean: it fluctuates on paths" if law in laws.mean else UNPROMISED_NOTE


def _value_or_default(value: float | None, default: float) -> float:
    return default if value is None else value
