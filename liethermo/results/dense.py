"""Dense output: the states of a run between the ends of its steps."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from ..errors import ConvergenceError, InputError


def _identity(x: np.ndarray) -> np.ndarray:
    return x


@dataclass(frozen=True)
class DenseOutput:
    """``x(t)`` anywhere: where a step of the method ends that begins at the last state before t.

    So states between have the order of the method and its laws: the energy and the invariants are those of the state
    that the step begins at, and the entropy is no less.

    Attributes
    ----------
    t : ndarray, shape (steps + 1,)
        When the steps of the run begin, and when the last one ends.
    x : ndarray, shape (steps + 1, n)
        The states then.
    step_ends : function from states, shape (m, n), and sizes of steps, shape (m,), to states
        NaN where a step cannot be taken.
    to_user_state : function from states, shape (m, n), to states
        What a user sees of them.
    """

    t: np.ndarray
    x: np.ndarray
    step_ends: Callable[[np.ndarray, np.ndarray], np.ndarray]
    to_user_state: Callable[[np.ndarray], np.ndarray] = _identity

    def __call__(self, t) -> np.ndarray:
        t = np.asarray(t, dtype=np.float64)
        first, last = self.t[0], self.t[-1]
        slack = 1e-12 * (last - first)
        if not np.all((t >= first - slack) & (t <= last + slack)):
            raise InputError(f"the solution is known from t = {first:g} to {last:g}, not at {t}")
        times = np.clip(t.ravel(), first, last)
        i = np.searchsorted(self.t, times, side="right") - 1
        h, found = times - self.t[i], self.x[i]
        between = np.flatnonzero(h > 0.0)
        if between.size:
            found[between] = self.step_ends(found[between], h[between])
            self._check_solved(times[between], found[between])
        found = self.to_user_state(found)
        return found.reshape(*t.shape, found.shape[-1])

    def _check_solved(self, t: np.ndarray, x: np.ndarray) -> None:
        """Raise where a part of a step cannot be taken, although the run has taken the whole."""
        unknown = np.isnan(x).any(axis=1)
        if unknown.any():
            raise ConvergenceError(
                f"the state at t = {t[unknown][0]:g}, between two steps, cannot be found: a part of the step is not "
                "solved. Ask for the states at the ends of the steps, or run with smaller steps",
                None,
            )

    def with_output_map(self, change: Callable[[np.ndarray], np.ndarray]) -> DenseOutput:
        """The same, of which a user sees what a function makes of it."""
        before = self.to_user_state
        return replace(self, to_user_state=lambda x: np.asarray(change(before(x))))
