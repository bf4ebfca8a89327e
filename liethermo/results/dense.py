"""Dense output: the states of a run between the ends of its steps."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ..errors import InputError


@dataclass(frozen=True)
class Dense:
    """``x(t)`` anywhere: to O(h^(s+1)) by the polynomial of collocation with s stages, to O(h^4) by Runge-Kutta steps.

    That is less than the order of the states at the ends of steps; Taylor steps have theirs between too. The laws are
    exact at the ends alone.

    Attributes
    ----------
    start, h : ndarray, shape (steps,)
    x : ndarray, shape (steps, n)
        States at the starts.
    k : ndarray, shape (steps, s, n)
        Slopes at the stages.
    weights : function
        From shares of a step to weights of the slopes: :meth:`liethermo.integrators.OneStepMethod.weights`.
    along : function or None
        On a manifold, from states and displacements, shapes (m, n), to states.
    """

    start: np.ndarray
    h: np.ndarray
    x: np.ndarray
    k: np.ndarray
    weights: Callable[..., np.ndarray]
    along: Callable | None = None

    def __call__(self, t) -> np.ndarray:
        t = np.asarray(t, dtype=np.float64)
        first, last = self.start[0], self.start[-1] + self.h[-1]
        slack = 1e-12 * (last - first)
        if not np.all((t >= first - slack) & (t <= last + slack)):
            raise InputError(f"the solution is known from t = {first:g} to {last:g}, not at {t}")
        i = np.clip(np.searchsorted(self.start, t, side="right") - 1, 0, len(self.start) - 1)
        weights = self.weights((t - self.start[i]) / self.h[i])
        x, v = self.x[i], self.h[i][..., None] * np.einsum("...s,...sn->...n", weights, self.k[i])
        if self.along is None:
            return x + v
        n = x.shape[-1]
        return np.asarray(self.along(x.reshape(-1, n), v.reshape(-1, n))).reshape(*x.shape[:-1], -1)
