"""The audit: did the laws hold along a run, at every step, and is it a run of the system at all?"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from manifolds._tables import TableRow, Tabular

from ..engines.codes import StatusCode
from ..errors import InputError
from ..functions.gradients import EPS

if TYPE_CHECKING:
    from .evidence import Evidence
    from .status import Laws, Stats, Status


class AuditedRun(Protocol):
    """What an audit looks at: see :class:`liethermo.Solution`."""

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


VALUE_ROUNDING_RTOL = 8 * EPS
"""Change of a function, relative to its value, that its own rounding can account for, whatever it varies by: as much as
the engines leave uncorrected of the energy, and as much again for the values at both ends."""


@dataclass(frozen=True)
class Tolerances:
    """What an audit accepts.

    A change of a function is judged against the size at which rounding sees the function, its *sensitivity*
    ``max |grad f(x)| |x|`` along the run (:meth:`liethermo.Energy.sensitivity`), whatever its value is at the start.
    Eight roundings of the value itself are allowed besides, and of the terms that cancel in it: nothing smaller can be
    seen where a constant is added, or in ``1 - cos q`` near q = 0.

    Attributes
    ----------
    energy : float
        Drift. Exact schemes stay near 1e-15 for thousands of steps, below 2e-14 for a million.
    entropy : float
        Fall of the entropy in one step: four roundings of the state.
    casimirs : float
        Drift of the functions that the system conserves, and of the momentum in space; the fall of the entropy in all.
    residual : float
        Of the stage equations: their rounding plateau.
    attitude : float
        Distance from the group, relative to the size of the attitude, as ``manifolds.MatrixGroup.belongs`` has it.
    accuracy : float
        Local error of a step, measured against short ones, relative to the distance that it goes (or to a hundredth
        of the whole motion, where that is more): a second-order method has 0.05 where it takes eight steps to a period.
    consistency : float
        How far the slope of a step is from the vector field, relative to that, as the step gets shorter.
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
                raise InputError(f"the tolerance {name} must be >= 0, not {value}")

    @classmethod
    def with_defaults(cls, **given: float) -> Tolerances:
        """Those given by name, and the defaults of the others; InputError where there is none of a name."""
        names = [field.name for field in fields(cls)]
        unknown = [name for name in given if name not in names]
        if unknown:
            raise InputError(f"an audit has no tolerance {unknown[0]!r}; those that it has are {', '.join(names)}")
        return cls(**given)


class AuditRow(TableRow):
    """One law: what was measured, what is allowed, and the verdict (None where nothing is promised)."""

    @property
    def law(self) -> str:
        return self.name

    @property
    def tolerance(self) -> float | None:
        return self.allowed


ACCURACY_ROW, CONSISTENCY_ROW, STEPS_TAKEN_ROW, FAILED_TRAJECTORIES_ROW = (
    "accuracy",
    "consistency",
    "steps taken",
    "trajectories that failed",
)
"""The rows that are not about laws."""

LAW_FAILURE_VERDICT = "A LAW FAILS"


@dataclass(frozen=True)
class Audit(Tabular):
    """The laws of a run, its accuracy, and its consistency with the vector field. Printing it gives a table.

    Attributes
    ----------
    energy_drift : float
        ``max |H - H0|`` over every step, H less the work done from outside, relative to the size at which H is rounded:
        the larger of ``|H0|`` and ``max |grad H(x)| |x|`` along the run.
    entropy_min_increment : float
        Smallest increment of the entropy in one step; NaN without an entropy.
    casimir_drift : float
        Largest drift, relative to the same of each, of the functions that the system conserves and the method promises
        to keep; NaN where there is none.
    worst_residual : float
    passed : bool
        Whether the laws hold along the motion of the system. ``resolved`` and ``verdict`` are about the accuracy of the
        steps.
    resolved : bool or None
        Whether the examined steps resolve the motion: whether the worst of them, compared with short steps, is within
        the tolerance ``accuracy``. It is about single steps and not about the accumulated error. None without
        information about the steps.
    rows : tuple of AuditRow
    coverage : str
        How many of the steps were looked at for that, where it was not all; the verdict says it too.

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
        return all(row.passed is not False for row in self.rows if row.law != ACCURACY_ROW)

    @property
    def resolved(self) -> bool | None:
        return next((row.passed for row in self.rows if row.law == ACCURACY_ROW), None)

    @property
    def verdict(self) -> str:
        """The whole in one line."""
        failing = {row.law for row in self.rows if row.passed is False}
        if failing - {ACCURACY_ROW, CONSISTENCY_ROW, STEPS_TAKEN_ROW, FAILED_TRAJECTORIES_ROW}:
            return LAW_FAILURE_VERDICT
        if STEPS_TAKEN_ROW in failing:
            return "THE RUN STOPPED before its end; the laws hold until there"
        if FAILED_TRAJECTORIES_ROW in failing:
            return "SOME TRAJECTORIES STOPPED before their end; the laws hold until there"
        if CONSISTENCY_ROW in failing:
            return "the laws hold, but THIS IS NOT THE MOTION of the system"
        if self.resolved is None:
            return "the laws hold"
        if self.resolved:
            return f"the laws hold, and the steps resolve the motion{self.coverage and f' ({self.coverage})'}"
        return "the laws hold, but THE STEPS DO NOT RESOLVE THE MOTION"

    def __repr__(self) -> str:
        return f"<Audit of {len(self.rows)} rows: {self.verdict}>"

    def _table_content(self) -> tuple[tuple[AuditRow, ...], tuple[str, str, str], str]:
        return self.rows, ("law", "measured", "allowed"), self.verdict


@dataclass(frozen=True)
class RoundingScale:
    """The size at which a function is rounded along a run, and what an audit allows it to change by.

    Attributes
    ----------
    value : float or ndarray
        Its size, at the start or the largest.
    sensitivity : float or ndarray
    term_size : float or ndarray
        The size of the largest terms that the value is computed from.
    """

    value: Any
    sensitivity: Any
    term_size: Any = 0.0

    @property
    def scale(self) -> Any:
        """What changes are given relative to."""
        size = np.maximum(np.abs(self.value), self.sensitivity)
        return np.where(size > 0.0, size, 1.0)

    def allowed_change(self, tolerance: float) -> Any:
        """The largest change accepted, relative to the size."""
        parts = self.sensitivity, np.maximum(np.abs(self.value), self.term_size)
        with np.errstate(invalid="ignore"):  # of what has overflowed all is as large as the size
            shares = (np.where(np.isinf(self.scale), 1.0, part / self.scale) for part in parts)
            return sum(share * allowed for share, allowed in zip(shares, (tolerance, VALUE_ROUNDING_RTOL), strict=True))


def audit_run(solution: AuditedRun, tolerances: Tolerances) -> Audit:
    """See :meth:`liethermo.Solution.audit`."""
    stats, laws, evidence, rows, energy = solution.stats, solution.laws, solution.evidence, [], solution.energy_balance
    name = " minus ".join(["energy", *laws.balance])
    low, high = stats.energy_range or (np.inf, -np.inf)
    lowest, highest = min(low, float(energy.min())), max(high, float(energy.max()))
    first = float(energy[0])
    rounding = _rounding_scale(energy, evidence.energy, evidence.terms.get("energy"))
    drift = float(max(highest - first, first - lowest) / rounding.scale)
    allowed = float(rounding.allowed_change(tolerances.energy))
    if laws.energy == "conserved":
        rows.append(_judged_row(f"{name} drift", drift, allowed, _inexact_law_note(laws, "energy")))
    elif laws.energy is None:
        rows.append(AuditRow(f"{name} drift", drift, None, None, _why_no_law(laws, "energy")))
    else:
        increments = [*np.diff(energy), _value_or(stats.largest_energy_increment, -np.inf)]
        risen = float(max(increments)) / rounding.scale
        rows.append(_judged_row(f"largest {name} increment", risen, allowed, _inexact_law_note(laws, "energy")))

    least = np.nan
    if solution.entropy is not None:
        least, row = _entropy_row(solution, tolerances)
        rows.append(row)

    kept = []
    for name, series in solution.casimirs.items():
        if name in laws.ledger:
            continue
        rounding = _rounding_scale(series, evidence.invariants.get(name), evidence.terms.get(name))
        change = float(np.abs(series - series[0]).max() / rounding.scale)
        if name in laws.conserved:
            kept.append(change)
            rows.append(_judged_row(f"drift of {name}", change, float(rounding.allowed_change(tolerances.casimirs))))
        elif name in laws.unpromised:
            rows.append(AuditRow(f"drift of {name}", change, None, None, UNPROMISED_CONSTANT_NOTE))
        else:
            note = UNKNOWN_CONSTANCY_NOTE if name in laws.unknown else "not a constant of this system"
            rows.append(AuditRow(f"change of {name}", change, None, None, note))
    for name in laws.ledger:
        series = solution.casimirs[name]
        what = "the momentum in space below" if name.startswith("impulse") else "the energy above"
        rows.append(AuditRow(name, float(series[-1] - series[0]), None, None, f"from outside: {what} is without"))
    rows.append(_judged_row("stage residual", stats.worst_residual, tolerances.residual))
    if stats.attitude_residual is not None:
        rows.append(_judged_row("attitude in group", stats.attitude_residual, tolerances.attitude))
    if stats.spatial_momentum_change is not None:
        rows.append(_spatial_momentum_row(stats.spatial_momentum_change, laws, tolerances))
    rows += _step_rows(evidence, tolerances)
    status = solution.status  # a run stopped by its user is short, but breaks no law
    failed = not status.ok and status.code != StatusCode.INTERRUPTED.status_name
    rows.append(
        AuditRow(
            STEPS_TAKEN_ROW, float(stats.steps), None, False if failed else None, "" if status.ok else str(status.code)
        )
    )
    coverage = coverage_text(evidence, stats.steps)
    return Audit(drift, least, max(kept, default=np.nan), stats.worst_residual, tuple(rows), coverage)


def _spatial_momentum_row(change: float, laws: Laws, tolerances: Tolerances) -> AuditRow:
    """The momentum in space is a constant where no torque acts from outside, or less the impulse of one."""
    name = "momentum in space"
    if any(entry.startswith("impulse") for entry in laws.ledger):
        name += " less the impulse"
    if name in laws.conserved:
        return _judged_row(f"drift of {name}", change, tolerances.casimirs)
    if name in laws.unpromised:
        return AuditRow(f"drift of {name}", change, None, None, UNPROMISED_CONSTANT_NOTE)
    return AuditRow(f"change of {name}", change, None, None, "a torque acts: not a constant of this system")


UNKNOWN_CONSTANCY_NOTE = (
    "whether this is a constant of this system is not known: it could be evaluated at no point that was tried"
)

UNPROMISED_CONSTANT_NOTE = "a constant of this system, which the method does not promise to keep exactly"


def _entropy_row(solution: AuditedRun, tolerances: Tolerances) -> tuple[float, AuditRow]:
    """The least increment of the entropy, and its law: at every step, and over all of the run."""
    S, law = solution.entropy, solution.laws.entropy
    assert S is not None
    note, evidence = _inexact_law_note(solution.laws, "entropy"), solution.evidence
    rounding = _rounding_scale(S, evidence.entropy, evidence.terms.get("entropy"))
    least = float(min([*np.diff(S), _value_or(solution.stats.least_entropy_increment, np.inf)]))
    if law == "conserved":
        change = float(np.abs(S - S[0]).max() / rounding.scale)
        return least, _judged_row("entropy drift", change, float(rounding.allowed_change(tolerances.casimirs)), note)
    if law is None:
        return least, AuditRow("least entropy increment", least, None, None, _why_no_law(solution.laws, "entropy"))
    rounding = replace(rounding, value=float(np.abs(S).max()))
    one, all_ = (float(rounding.allowed_change(t) * rounding.scale) for t in (tolerances.entropy, tolerances.casimirs))
    fall = float((np.maximum.accumulate(S) - S).max())
    if fall > all_ >= 0.0 and least >= -one:  # step by step below what rounding hides
        note = f"in all it falls by {fall:.2g}"
    return least, AuditRow("least entropy increment", least, -one, bool(least >= -one and fall <= all_), note)


def _step_rows(evidence: Evidence, tolerances: Tolerances) -> list[AuditRow]:
    """Whether the steps resolve the motion, and whether it is that of the system."""
    rows, defect = [accuracy_row(evidence, tolerances)], evidence.inconsistency
    if defect is not None:
        row = _judged_row(CONSISTENCY_ROW, defect, tolerances.consistency)
        note = "" if row.passed else "short steps of this method do not follow the vector field of this system"
        rows.append(replace(row, note=note))
    return rows


def accuracy_row(evidence: Evidence, tolerances: Tolerances) -> AuditRow:
    """Whether the steps resolve the motion."""
    if evidence.local_error is None:
        return AuditRow(ACCURACY_ROW, np.nan, None, None, "not estimated: how accurate the run is is not known")
    row = _judged_row(ACCURACY_ROW, evidence.local_error, tolerances.accuracy)
    where = f"local error of a step, of the distance it goes; worst at t = {evidence.error_time:.4g}"
    return replace(row, note=where if row.passed else f"the steps do not resolve the motion: try suggest_step; {where}")


def coverage_text(evidence: Evidence, steps: int) -> str:
    """How many of the steps were looked at, where it was not all of them."""
    looked = evidence.looked
    return "" if looked is None or looked >= steps else f"looked at: {looked:,} steps of {steps:,}"


def _rounding_scale(series: np.ndarray, sensitivity: float | None, terms: float | None) -> RoundingScale:
    """How a function with this series is rounded; its largest value replaces a sensitivity that is not known."""
    largest = float(np.abs(series).max()) if sensitivity is None else sensitivity
    return RoundingScale(abs(float(series[0])), largest, _value_or(terms, 0.0))


INEXACT_LAW_NOTE = "not kept exactly by this method"
"""Beside a law that a method does not claim to keep."""


def _judged_row(law: str, value: float, tolerance: float, note: str = "") -> AuditRow:
    return AuditRow(law, float(value), tolerance, bool(value <= tolerance), note)


def _inexact_law_note(laws: Laws, law: str) -> str:
    return INEXACT_LAW_NOTE if law in laws.inexact else ""


def _why_no_law(laws: Laws, law: str) -> str:
    return "a law of the mean: it fluctuates on paths" if law in laws.mean else "no law promised"


def _value_or(value: float | None, otherwise: float) -> float:
    return otherwise if value is None else value
