"""Laws of an ensemble: the measured value and its limit for each trajectory."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from .audit import AuditRow, Tolerances
from .rounding_scale import RoundingScale
from .status import Laws


@dataclass(frozen=True)
class EnsembleLaw:
    """A law of an ensemble, as each trajectory obeys it.

    Attributes
    ----------
    law : str
    values, limits : ndarray, shape (B,)
        Measured value along each trajectory; largest value allowed.
    """

    law: str
    values: np.ndarray
    limits: np.ndarray

    @property
    def is_violated(self) -> np.ndarray:
        """True for each trajectory that violates the law, shape (B,)."""
        return ~(self.values <= self.limits)

    @property
    def worst_member(self) -> int:
        """Index of the trajectory whose value exceeds its limit by most, or comes nearest to it."""
        return int(np.argmax(self.values - self.limits))

    def audit_row(self, i: int, note: str = "") -> AuditRow:
        """Return the audit row of the law for trajectory i."""
        return AuditRow(self.law, float(self.values[i]), float(self.limits[i]), not self.is_violated[i], note)


def evaluate_ensemble_laws(
    ensemble: Any, laws: Laws, tolerances: Tolerances, energy_terms: Any = 0.0, entropy_terms: Any = 0.0
) -> list[EnsembleLaw]:
    """Return the laws of an ensemble as each trajectory obeys them; a trajectory without a step obeys all.

    Parameters
    ----------
    ensemble : Ensemble, or an object with its numeric arrays
    laws : Laws
        Laws promised of each trajectory.
    tolerances : Tolerances
    energy_terms, entropy_terms : float or array, shape (B,)
        Magnitudes of the largest terms of which energy and entropy are sums.
    """
    ensemble_laws, has_stepped, name = [], ensemble.steps > 0, " minus ".join(["energy", *laws.balance])

    def ensemble_law(law: str, values, limits) -> EnsembleLaw:
        return EnsembleLaw(law, np.where(has_stepped, values, 0.0), np.where(has_stepped, limits, 0.0))

    rounding = RoundingScale(ensemble.first_energy, ensemble.energy_sensitivity, energy_terms)
    if laws.energy == "conserved":
        ensemble_laws.append(
            ensemble_law(f"{name} drift", ensemble.energy_drift, rounding.allowed_change(tolerances.energy))
        )
    elif laws.energy == "nonincreasing":
        increment = ensemble.largest_energy_increment / rounding.scale
        ensemble_laws.append(
            ensemble_law(f"relative {name} increment", increment, rounding.allowed_change(tolerances.energy))
        )
    if laws.entropy == "conserved":
        rounding = RoundingScale(ensemble.entropy_scale, ensemble.entropy_sensitivity, entropy_terms)
        change = np.maximum(np.abs(ensemble.entropy_change), -ensemble.least_entropy_increment) / rounding.scale
        ensemble_laws.append(ensemble_law("entropy drift", change, rounding.allowed_change(tolerances.casimirs)))
    elif laws.entropy == "nondecreasing":
        rounding = RoundingScale(ensemble.entropy_scale, ensemble.entropy_sensitivity, entropy_terms)
        fall = -ensemble.least_entropy_increment / rounding.scale
        ensemble_laws.append(
            ensemble_law("relative fall of the entropy", fall, rounding.allowed_change(tolerances.entropy))
        )
        total_fall_law = ensemble_law(
            "relative fall of the entropy in all",
            -ensemble.entropy_change / rounding.scale,
            rounding.allowed_change(tolerances.casimirs),
        )
        if total_fall_law.is_violated.any():  # although each step is within the rounding
            ensemble_laws.append(total_fall_law)
    ensemble_laws.append(
        ensemble_law("stage residual", np.where(ensemble.ok, ensemble.residual, 0.0), tolerances.residual)
    )
    return ensemble_laws
