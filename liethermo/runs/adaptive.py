"""Adaptive step control: the user's request, and its form for the engines."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ..engines.step_control import StepControl
from ..errors import InputError
from ..integrators import OneStepMethod
from ..integrators.base import has_error_estimate
from .events import EventSet

MIN_STEP_FRACTION = 1e-14
"""Smallest step size, as a fraction of the span."""


@dataclass(frozen=True)
class Adaptive:
    """Adaptive step sizes, chosen so that the estimated errors of the steps add up to the tolerance.

    Take the time in which the state changes by its own size, at its greatest speed so far. In this time the estimated
    errors of the steps add up to at most ``atol + rtol * max|x|``: a step that spans a fraction f of this time is
    allowed a fraction f of the error. So the error of a run is about proportional to the tolerance, with every method.

    Steps also resolve every growing deviation, however small it is, so that it grows at its rate to a few thousandths:
    a body spinning about its middle axis leaves that axis at the right time. The laws hold at every step.

    Parameters
    ----------
    rtol, atol : float
        Relative tolerance (dimensionless) and absolute tolerance (in the units of the state), not both zero.
    first : float, optional
        The first step to try (time).
    largest : float, optional
        The longest step allowed (time).
    most_steps : int
        The run ends with the status "step_limit" after this number of steps, rejected ones included.

    Examples
    --------
    >>> body = lt.models.rigid_body((3.0, 2.0, 1.0), rate=0.2)
    >>> run = lt.integrate(
    ...     body,
    ...     [0.1, 0.2, 1.0],
    ...     (0.0, 1e3),
    ...     lt.Adaptive(rtol=1e-8),
    ...     lt.MetriplecticRungeKutta(8),
    ... )
    >>> float(run.t[-1]), run.stats.steps < 1000
    (1000.0, True)
    """

    rtol: float = 1e-8
    atol: float = 0.0
    first: float | None = None
    largest: float | None = None
    most_steps: int = 1_000_000

    def __post_init__(self):
        for name in ("rtol", "atol"):
            value = getattr(self, name)
            if not (isinstance(value, int | float) and math.isfinite(value) and value >= 0.0):
                raise InputError(f"{name} must be a number >= 0, got {value!r}")
        if max(self.rtol, self.atol) == 0.0:
            raise InputError(
                "rtol and atol are both zero, and one of them must be positive. Use, for example, rtol=1e-8"
            )
        if self.atol == 0.0 and self.rtol < 1e-14:
            raise InputError(f"rtol = {self.rtol:g} is below the rounding of double precision. Use 1e-14 or more")
        for name in ("first", "largest"):
            value = getattr(self, name)
            if value is not None and not (math.isfinite(value) and value > 0.0):
                raise InputError(f"the {name} step must be positive and finite, got {value!r}")
        if isinstance(self.most_steps, bool) or not isinstance(self.most_steps, int) or self.most_steps < 1:
            raise InputError(f"most_steps must be a positive integer, got {self.most_steps!r}")

    @property
    def tolerance(self) -> float:
        """The relative tolerance, or the absolute one if that is zero; methods of variable order choose their order by
        it."""
        return self.rtol or self.atol


def make_step_control(
    step: float | Adaptive, method: OneStepMethod, span_length: float, events: EventSet | None
) -> StepControl:
    """Return the settings of adaptive or fixed steps in the form of the engines, with the monitored event functions.

    Raises
    ------
    InputError
        If the method has no error estimate and so cannot take adaptive steps.
    """
    adaptive = isinstance(step, Adaptive)
    min_step = MIN_STEP_FRACTION * span_length if math.isfinite(span_length) else 0.0
    if isinstance(step, Adaptive):
        if not has_error_estimate(method):
            raise InputError(f"the steps of {method} cannot be adaptive: {method.why_fixed_step}")
        numbers = [step.rtol, step.atol, step.first or 0.0, step.largest or math.inf]
        numbers += [min_step, step.most_steps]
    else:
        numbers = [0.0, 0.0, step, math.inf, min_step, math.inf]
    functions, directions = ((), ()) if events is None else (events.functions, events.directions)
    rtol, atol, first_step, max_step, min_step_array, max_attempts = (np.asarray(float(number)) for number in numbers)
    return StepControl(rtol, atol, first_step, max_step, min_step_array, max_attempts, functions, directions, adaptive)
