"""The audit: did the laws hold along a run, at every step?"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from .errors import InputError

if TYPE_CHECKING:
    from .solution import Laws, Solution

EPS = float(np.finfo(np.float64).eps)


@dataclass(frozen=True)
class Tolerances:
    """What an audit accepts.

    Attributes
    ----------
    energy : float
        Relative drift. Exact schemes stay near 1e-15 for thousands of steps, below 2e-14 for a million.
    entropy : float
        Fall of the entropy in one step relative to ``max |S|``: four roundings of S itself.
    casimirs : float
        Relative drift of the functions that the system conserves.
    residual : float
        Of the stage equations: their rounding plateau.
    attitude : float
        Distance from the group, relative to the size of the attitude, as ``manifolds.MatrixGroup.belongs`` has it.
    """

    energy: float = 1e-13
    entropy: float = 4 * EPS
    casimirs: float = 1e-12
    residual: float = 1e-12
    attitude: float = 1e-10

    def __post_init__(self):
        for name, value in vars(self).items():
            if not value >= 0.0:
                raise InputError(f"the tolerance {name} must be >= 0, not {value}")


@dataclass(frozen=True)
class AuditRow:
    """One law: what was measured, what is allowed, and the verdict (None where nothing is promised)."""

    law: str
    value: float
    tolerance: float | None
    passed: bool | None
    note: str = ""


@dataclass(frozen=True)
class Audit:
    """The laws of a run. Printing it gives a table.

    Attributes
    ----------
    energy_drift : float
        ``max |H - H0| / |H0|`` over every step (over 1 where H0 = 0), H less the work done from outside.
    entropy_min_increment : float
        Smallest increment of the entropy in one step; NaN without an entropy.
    casimir_drift : float
        Largest relative drift of the functions that the system conserves; NaN where there is none.
    worst_residual : float
    passed : bool
    rows : tuple of AuditRow
    """

    energy_drift: float
    entropy_min_increment: float
    casimir_drift: float
    worst_residual: float
    rows: tuple[AuditRow, ...]

    @property
    def passed(self) -> bool:
        return all(row.passed is not False for row in self.rows)

    def __str__(self) -> str:
        width = max(len(row.law) for row in self.rows)
        verdict = {True: "ok", False: "FAILS", None: "-"}
        lines = [f"{'law':<{width}}  {'measured':>10}  {'allowed':>9}"]
        for row in self.rows:
            allowed = " " * 9 if row.tolerance is None else f"{row.tolerance:9.1e}"
            lines.append(
                f"{row.law:<{width}}  {row.value:10.2e}  {allowed}  {verdict[row.passed]:<5} {row.note}".rstrip()
            )
        lines.append("the laws hold" if self.passed else "A LAW FAILS")
        return "\n".join(lines)


def audit(solution: Solution, tolerances: Tolerances) -> Audit:
    """See :meth:`liethermo.Solution.audit`."""
    stats, laws, rows, energy = solution.stats, solution.laws, [], solution.energy_balance
    name = " minus ".join(["energy", *laws.balance])
    low, high = stats.energy_range or (np.inf, -np.inf)
    lowest, highest = min(low, float(energy.min())), max(high, float(energy.max()))
    first = float(energy[0])
    scale = abs(first) or 1.0
    drift = max(highest - first, first - lowest) / scale
    if laws.energy == "conserved":
        rows.append(_verdict(f"{name} drift", drift, tolerances.energy, _note(laws, "energy")))
    elif laws.energy is None:
        rows.append(AuditRow(f"{name} drift", drift, None, None, "no law promised"))
    else:
        increments = [*np.diff(energy), _or(stats.largest_energy_increment, -np.inf)]
        risen = float(max(increments)) / scale
        rows.append(_verdict(f"largest {name} increment", risen, tolerances.energy, _note(laws, "energy")))

    least = np.nan
    if solution.entropy is not None:
        least = float(min([*np.diff(solution.entropy), _or(stats.least_entropy_increment, np.inf)]))
        allowed = tolerances.entropy * float(np.abs(solution.entropy).max())
        if laws.entropy == "nondecreasing":
            held = bool(least >= -allowed)
            rows.append(AuditRow("least entropy increment", least, -allowed, held, _note(laws, "entropy")))
        elif laws.entropy == "conserved":
            change = _drift(solution.entropy)
            rows.append(_verdict("entropy drift", change, tolerances.casimirs, _note(laws, "entropy")))
        else:
            rows.append(AuditRow("least entropy increment", least, None, None, "no law promised"))

    drifts = {name: _drift(series) for name, series in solution.casimirs.items() if name not in laws.ledger}
    kept = [drifts[name] for name in laws.conserved if name in drifts]
    casimir_drift = max(kept, default=np.nan)
    for name, value in drifts.items():
        promised = name in laws.conserved
        rows.append(
            _verdict(f"drift of {name}", value, tolerances.casimirs)
            if promised
            else AuditRow(f"change of {name}", value, None, None, "not a constant of this system")
        )
    for name in laws.ledger:
        series = solution.casimirs[name]
        rows.append(
            AuditRow(name, float(series[-1] - series[0]), None, None, "from outside: the energy above is without")
        )
    rows.append(_verdict("stage residual", stats.worst_residual, tolerances.residual))
    if stats.attitude_residual is not None:
        rows.append(_verdict("attitude in group", stats.attitude_residual, tolerances.attitude))
    status = solution.status  # a run stopped by its user is short, but breaks no law
    failed = not status.ok and status.code != "interrupted"
    rows.append(
        AuditRow("steps taken", float(stats.steps), None, False if failed else None, "" if status.ok else status.code)
    )
    return Audit(drift, least, casimir_drift, stats.worst_residual, tuple(rows))


def _verdict(law: str, value: float, tolerance: float, note: str = "") -> AuditRow:
    return AuditRow(law, float(value), tolerance, bool(value <= tolerance), note)


def _note(laws: Laws, law: str) -> str:
    return "not kept exactly by this method" if law in laws.inexact else ""


def _drift(series: np.ndarray) -> float:
    """Largest deviation from the first value, relative to it, or to the largest where it begins near zero."""
    scale = max(abs(float(series[0])), EPS * float(np.abs(series).max())) or 1.0
    return float(np.abs(series - series[0]).max()) / scale


def _or(value: float | None, otherwise: float) -> float:
    return otherwise if value is None else value
