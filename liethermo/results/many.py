"""The laws of many trajectories at once: what was measured along each, and what is allowed there."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from .audit import AuditRow, Rounding, Tolerances
from .status import Laws


@dataclass(frozen=True)
class LawOfMany:
    """One law.

    Attributes
    ----------
    law : str
    values, allowed : ndarray, shape (B,)
        What was measured of it along each trajectory; what is allowed.
    """

    law: str
    values: np.ndarray
    allowed: np.ndarray

    @property
    def broken(self) -> np.ndarray:
        """By which trajectories, shape (B,)."""
        return ~(self.values <= self.allowed)

    @property
    def worst(self) -> int:
        """The trajectory that kept it worst."""
        return int(np.argmax(self.values - self.allowed))

    def as_row(self, i: int, note: str = "") -> AuditRow:
        """The law as trajectory i kept it."""
        return AuditRow(self.law, float(self.values[i]), float(self.allowed[i]), not self.broken[i], note)


def laws_of_many(
    many: Any, laws: Laws, accepted: Tolerances, energy_terms: Any = 0.0, entropy_terms: Any = 0.0
) -> list[LawOfMany]:
    """How each law was kept; a trajectory that took no step has kept them all.

    Parameters
    ----------
    many : Ensemble, or what has its arrays of numbers
    laws : Laws
        What is promised of each.
    accepted : Tolerances
    energy_terms, entropy_terms : float or array, shape (B,)
        Sizes of the largest terms that the values of energy and entropy are computed from.
    """
    found, moved, name = [], many.steps > 0, " minus ".join(["energy", *laws.balance])

    def judge(law: str, values, allowed) -> LawOfMany:
        return LawOfMany(law, np.where(moved, values, 0.0), np.where(moved, allowed, 0.0))

    rounding = Rounding(many.first_energy, many.energy_sensitivity, energy_terms)
    if laws.energy == "conserved":
        found.append(judge(f"{name} drift", many.energy_drift, rounding.allowed(accepted.energy)))
    elif laws.energy == "nonincreasing":
        increment = many.largest_energy_increment / rounding.size
        found.append(judge(f"relative {name} increment", increment, rounding.allowed(accepted.energy)))
    if laws.entropy == "nondecreasing":
        rounding = Rounding(many.entropy_scale, many.entropy_sensitivity, entropy_terms)
        fall = -many.least_entropy_increment / rounding.size
        found.append(judge("relative fall of the entropy", fall, rounding.allowed(accepted.entropy)))
        in_all = judge("the same in all", -many.entropy_change / rounding.size, rounding.allowed(accepted.casimirs))
        found += [in_all] if in_all.broken.any() else []  # each step below what rounding hides
    found.append(judge("stage residual", np.where(many.ok, many.residual, 0.0), accepted.residual))
    return found
