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
    """Dense output ``x(t)``: the end of a step of the method that begins at the last state before t.

    Such states have the order of the method and obey its laws: the energy and the invariants equal those of the state
    at which the step begins, and the entropy is not smaller.

    Attributes
    ----------
    t : ndarray, shape (steps + 1,)
        Times at which the steps of the run begin, and the end of the last.
    x : ndarray, shape (steps + 1, n)
        States at these times.
    step_ends : function from states, shape (m, n), and step sizes, shape (m,), to states
        Returns NaN for a step that fails.
    to_user_state : function from states, shape (m, n), to states
        Converts internal states to those that the user sees.
    """

    t: np.ndarray
    x: np.ndarray
    step_ends: Callable[[np.ndarray, np.ndarray], np.ndarray]
    to_user_state: Callable[[np.ndarray], np.ndarray] = _identity

    def __call__(self, t) -> np.ndarray:
        t = np.asarray(t, dtype=np.float64)
        start, end = self.t[0], self.t[-1]
        slack = 1e-12 * (end - start)
        if not np.all((t >= start - slack) & (t <= end + slack)):
            raise InputError(f"t must be from {start:g} to {end:g}, the span of the solution, got {t}")
        times = np.clip(t.ravel(), start, end)
        i = np.searchsorted(self.t, times, side="right") - 1
        h, x = times - self.t[i], self.x[i]
        inside_steps = np.flatnonzero(h > 0.0)
        if inside_steps.size:
            x[inside_steps] = self.step_ends(x[inside_steps], h[inside_steps])
            self._check_solved(times[inside_steps], x[inside_steps])
        x = self.to_user_state(x)
        return x.reshape(*t.shape, x.shape[-1])

    def _check_solved(self, t: np.ndarray, x: np.ndarray) -> None:
        """Raise if a partial step failed, although the run has taken the full step."""
        is_unknown = np.isnan(x).any(axis=1)
        if is_unknown.any():
            raise ConvergenceError(
                f"the state at t = {t[is_unknown][0]:g}, between two steps, cannot be found: the equations of a "
                "partial step were not solved. Evaluate the solution at the ends of the steps, or take smaller steps",
                None,
            )

    def with_output_map(self, output_map: Callable[[np.ndarray], np.ndarray]) -> DenseOutput:
        """Return this dense output with ``output_map`` applied to the states that the user sees."""
        previous_map = self.to_user_state
        return replace(self, to_user_state=lambda x: np.asarray(output_map(previous_map(x))))
