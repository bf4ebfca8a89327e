"""The laws of many trajectories at once: what was measured along each, and what is allowed there."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from .audit import AuditRow, RoundingScale, Tolerances
from .status import Laws


@dataclass(frozen=True)
class EnsembleLaw:
    """One law.

    Attributes
    ----------
    law : str
    values, limits : ndarray, shape (B,)
        What was measured of it along each trajectory; what is allowed.
    """

    law: str
    values: np.ndarray
    limits: np.ndarray

    @property
    def is_violated(self) -> np.ndarray:
        """By which trajectories, shape (B,)."""
        return ~(self.values <= self.limits)

    @property
    def worst_member(self) -> int:
        """The trajectory that kept it worst."""
        return int(np.argmax(self.values - self.limits))

    def audit_row(self, i: int, note: str = "") -> AuditRow:
        """The law as trajectory i kept it."""
        return AuditRow(self.law, float(self.values[i]), float(self.limits[i]), not self.is_violated[i], note)


def evaluate_ensemble_laws(
    many: Any, laws: Laws, accepted: Tolerances, energy_terms: Any = 0.0, entropy_terms: Any = 0.0
) -> list[EnsembleLaw]:
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

    def ensemble_law(law: str, values, allowed) -> EnsembleLaw:
        return EnsembleLaw(law, np.where(moved, values, 0.0), np.where(moved, allowed, 0.0))

    rounding = RoundingScale(many.first_energy, many.energy_sensitivity, energy_terms)
    if laws.energy == "conserved":
        found.append(ensemble_law(f"{name} drift", many.energy_drift, rounding.allowed_change(accepted.energy)))
    elif laws.energy == "nonincreasing":
        increment = many.largest_energy_increment / rounding.scale
        found.append(ensemble_law(f"relative {name} increment", increment, rounding.allowed_change(accepted.energy)))
    if laws.entropy == "nondecreasing":
        rounding = RoundingScale(many.entropy_scale, many.entropy_sensitivity, entropy_terms)
        fall = -many.least_entropy_increment / rounding.scale
        found.append(ensemble_law("relative fall of the entropy", fall, rounding.allowed_change(accepted.entropy)))
        in_all = ensemble_law(
            "the same in all", -many.entropy_change / rounding.scale, rounding.allowed_change(accepted.casimirs)
        )
        found += [in_all] if in_all.is_violated.any() else []  # each step below what rounding hides
    found.append(ensemble_law("stage residual", np.where(many.ok, many.residual, 0.0), accepted.residual))
    return found
