"""Scale at which a function is rounded along a run, relative to which its changes are judged."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ..functions.gradients import EPS

VALUE_ROUNDING_RTOL = 8 * EPS
"""Allowed change of a function, relative to its value, for the rounding of the value itself.

The engines leave half of it uncorrected in the energy; the other half is for the values at both ends.
"""


@dataclass(frozen=True)
class RoundingScale:
    """Rounding scale of a function along a run, and the change of the function that an audit allows.

    Attributes
    ----------
    value : float or ndarray
        Value of the function, at the start or the largest.
    sensitivity : float or ndarray
    term_size : float or ndarray
        Magnitude of the largest terms of which the value is the sum.
    """

    value: Any
    sensitivity: Any
    term_size: Any = 0.0

    @classmethod
    def from_series(
        cls, values: np.ndarray, sensitivity: float | None = None, term_size: float | None = None
    ) -> RoundingScale:
        """Return the rounding scale of a function from its values along a run; ``value`` is the first.

        The largest value replaces an unknown sensitivity.
        """
        known_sensitivity = float(np.abs(values).max()) if sensitivity is None else sensitivity
        return cls(abs(float(values[0])), known_sensitivity, 0.0 if term_size is None else term_size)

    @property
    def scale(self) -> Any:
        """Scale that changes of the function are divided by: the larger of value and sensitivity; 1 if both are 0."""
        magnitude = np.maximum(np.abs(self.value), self.sensitivity)
        return np.where(magnitude > 0.0, magnitude, 1.0)

    def allowed_change(self, tolerance: float) -> Any:
        """Return the largest accepted change of the function, relative to ``scale``."""
        scales = self.sensitivity, np.maximum(np.abs(self.value), self.term_size)
        with np.errstate(invalid="ignore"):  # after an overflow the fraction is 1
            fractions = (np.where(np.isinf(self.scale), 1.0, part_scale / self.scale) for part_scale in scales)
            return sum(
                fraction * allowed_part
                for fraction, allowed_part in zip(fractions, (tolerance, VALUE_ROUNDING_RTOL), strict=True)
            )


@dataclass(frozen=True)
class InvariantDrift:
    """Change of a conserved function along a trajectory, relative to its rounding scale.

    Attributes
    ----------
    change : float
        Largest distance of the values from the first, relative to the rounding scale.
    rounding : RoundingScale
    """

    change: float
    rounding: RoundingScale

    @classmethod
    def from_series(
        cls, values: np.ndarray, sensitivity: float | None = None, term_size: float | None = None
    ) -> InvariantDrift:
        """Return the drift of a function with these values along a run; see :meth:`RoundingScale.from_series`."""
        rounding = RoundingScale.from_series(values, sensitivity, term_size)
        return cls(float(np.abs(values - values[0]).max() / rounding.scale), rounding)

    def allowed_change(self, tolerance: float) -> float:
        """Return the largest accepted change, relative to the rounding scale."""
        return float(self.rounding.allowed_change(tolerance))
