"""Sizes of steps: from an estimate of the local error, and from the growth that the linearised motion has."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ..engines import array
from ..engines.rules import RULES
from ..errors import InputError
from ..integrators import OneStepMethod
from ..systems import System

GROWTH = 3.0
"""Largest factor from one step to the next: more, and the prediction of the stages is worth nothing."""

SHRINKAGE = 0.2
UNSOLVED = 0.25
"""Smallest factor after a step of too large an error, and the factor after one that could not be solved."""

SAFETY = 0.8

DEADBAND = (0.9, 1.3)
"""Factors for which the step is kept: changes that small are not worth a worse prediction, and would chatter."""

UNDERFLOW = 1e-14
"""Smallest step, relative to the span."""

GROWTH_ERROR = 2e-3
"""Largest relative error of the rate at which a small deviation grows: what falls from an unstable rest does so in its
time, to a few thousandths. The error of the state does not show it, as the deviation is no part of the state yet."""

TURNING = 0.01
"""Rate of growth of an oscillation, relative to its frequency, from which it counts: the derivative of a motion that
goes on varies, and gives oscillations that nothing excites small rates of either sign."""

CHANGED = 0.05
"""Change of the derivative of the motion, relative to it, below which what grows is not looked for again."""


@dataclass(frozen=True)
class Adaptive:
    """Steps chosen by an estimate of the local error, relative to the size of the state.

    Each step's estimate is held below ``atol + rtol * max|x|``. Steps are short enough, too, for what grows near the
    state to grow at its rate, to :data:`GROWTH_ERROR`, however small it is yet: a body spinning about its middle axis
    falls when it has to. The laws hold at every step, whatever its size.

    Parameters
    ----------
    rtol, atol : float
        Not both zero.
    first : float, optional
        First step to try.
    largest : float, optional
        No step is longer.
    most_steps : int
        The run ends with the status "step_limit" after so many, tried ones among them.
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
                raise InputError(f"{name} must be a number >= 0, not {value!r}")
        if max(self.rtol, self.atol) == 0.0:
            raise InputError("rtol and atol are both zero: no step is that exact")
        if self.atol == 0.0 and self.rtol < 1e-14:
            raise InputError(f"rtol = {self.rtol:g} is below the rounding of double precision; take 1e-14 or more")
        for name in ("first", "largest"):
            value = getattr(self, name)
            if value is not None and not (math.isfinite(value) and value > 0.0):
                raise InputError(f"the {name} step must be positive and finite, not {value!r}")
        if isinstance(self.most_steps, bool) or not isinstance(self.most_steps, int) or self.most_steps < 1:
            raise InputError(f"most_steps must be a positive integer, not {self.most_steps!r}")


class Control:
    """The size of the next step, from the error of the last; small changes are left out, so that it does not chatter.

    Parameters
    ----------
    step : float or Adaptive
    order : int
        Of the method; its local error is O(h^(order + 1)).
    first : float
        First step to try.
    """

    def __init__(self, step: float | Adaptive, order: int, first: float):
        self.adaptive = isinstance(step, Adaptive)
        self.h = step.first or first if isinstance(step, Adaptive) else step
        self.largest = (step.largest or math.inf) if isinstance(step, Adaptive) else math.inf
        self.h = min(self.h, self.largest)
        self._power = 1.0 / (order + 1)

    def accept(self, error: float, h: float) -> None:
        """After a step of size h whose error is this fraction of the allowed one, at most 1."""
        factor = SAFETY * max(error, 1e-12) ** -self._power
        if h < 0.99 * self.h:  # cut short to end somewhere: it says little about the next
            factor = max(factor, self.h / h) if factor > 1.0 else 1.0
        factor = min(GROWTH, max(SHRINKAGE, factor))
        if not DEADBAND[0] < factor < DEADBAND[1]:
            self.h = min(h * factor, self.largest)

    def reject(self, error: float, h: float) -> None:
        """After a step with too large an error; infinity where its equations could not be solved."""
        factor = UNSOLVED if not math.isfinite(error) else max(SHRINKAGE, SAFETY * error**-self._power)
        self.h = h * min(factor, 0.9)


class Growth:
    """How long steps may be for what grows near the state to grow at its rate.

    A one-step method that solves a linear equation of rate r multiplies it by R(h r) in a step instead of exp(h r), and
    one that damps or keeps what it does not resolve, as implicit ones do, sleeps through an instability in long steps.

    Parameters
    ----------
    system : System
    method : OneStepMethod
        Its R is taken to be the diagonal Padé approximation of its order.
    """

    def __init__(self, system: System, method: OneStepMethod):
        self._system, self._method = system, method
        s = max(1, method.order // 2)
        constant = math.factorial(2 * s) * math.factorial(2 * s + 1) / math.factorial(s) ** 2
        self._reach = (GROWTH_ERROR * constant) ** (0.5 / s)  # ln R(z) / z = 1 +- z^2s / constant + ...
        self._seen, self._rate = np.full((1, 1), np.nan), 0.0

    def look(self, x, stretch: np.ndarray) -> None:
        """Note what lies around a state, as :func:`.array.error_and_stretch` sees it."""
        self._x, self._stretch = x, stretch
        self._size = math.sqrt(float((stretch * stretch).sum(axis=-1).max()))

    def longest(self, h: float) -> float:
        """The longest step from that state; infinity where a step of size h is short enough for certain."""
        whole, stretch = self._stretch.shape[1] <= array.FEW, self._stretch
        size = self._size * (math.sqrt(len(stretch)) if whole else 1.0)
        if not self._reach < size * h < math.inf:
            return math.inf
        seen = stretch if whole else stretch[:1]
        if not np.linalg.norm(seen - self._seen) <= CHANGED * np.linalg.norm(self._seen):
            matrix = stretch if whole else np.asarray(array.growing(self._system, self._method, self._x))
            self._seen, self._rate = seen, _fastest(matrix)
        return self._reach / self._rate if self._rate > 0.0 else math.inf


def _fastest(matrix: np.ndarray) -> float:
    """The size of the largest eigenvalue among those that grow."""
    if not np.isfinite(matrix).all():
        return 0.0
    rates = np.linalg.eigvals(matrix)
    return float(np.abs(rates[rates.real > TURNING * np.abs(rates)]).max(initial=0.0))


def judged(growth: Growth, system: System, method, state, new, h: float) -> tuple[float, float]:
    """The estimated local error of a step that was taken, and the longest step from its start for what grows there."""
    found, stretch = array.error_and_stretch(system, method, state.x, state.low, h, new.k)
    growth.look(state.x, np.asarray(stretch))
    return float(found), growth.longest(h)


def allowed_error(step: Adaptive, state, new) -> float:
    """The largest local error."""
    size = max(float(np.abs(state.x).max()), float(np.abs(new.x).max()))
    return max(step.atol + step.rtol * size, RULES.vanished)


def first_step(state, length: float) -> float:
    """A hundredth of the time in which the state would change by its size."""
    speed, size = float(np.abs(state.k).max()), float(np.abs(state.x).max())
    return min(length, 0.01 * size / speed) if speed > 0.0 and size > 0.0 else 1e-3 * length
