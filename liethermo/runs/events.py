"""Where a run ends before its time: events, and the relaxation of the state."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ..engines.codes import Code
from ..errors import FunctionError, InputError
from ..systems import System
from ..tracing.interpret import evaluator


@dataclass(frozen=True)
class Relaxed:
    """The event that the entropy production falls below ``tol`` (per unit of time), for ``integrate(until=...)``.

    A state whose production is below it from the start, such as one near an unstable equilibrium, has to rise above it
    first.
    """

    tol: float

    def __post_init__(self):
        if not (math.isfinite(self.tol) and self.tol > 0.0):
            raise InputError(f"the entropy production to stop at must be positive and finite, not {self.tol!r}")


class Event:
    """A function of the state whose sign is watched.

    Parameters
    ----------
    until : Relaxed or function from a state, shape (n,), to a scalar
    """

    def __init__(self, until: Relaxed | Callable, system: System):
        self.falling = isinstance(until, Relaxed)
        self.name = f"entropy production below {until.tol:g}" if isinstance(until, Relaxed) else "the event function"
        if isinstance(until, Relaxed):
            if system.entropy_law != "nondecreasing":
                raise InputError("Relaxed(tol) watches the entropy production, and this system produces no entropy")
            self._function = evaluator(excess, (system, np.float64(until.tol)), system.dim)
        elif callable(until):
            self._function = evaluator(_of_points, (system, until), system.dim)
        else:
            raise InputError(f"until must be lt.Relaxed(tol) or a function of the state, not {until!r}")
        if np.shape(self(system.samples(1)[0])) != ():
            raise FunctionError("the event function must return one number")

    def __call__(self, x: np.ndarray) -> float:
        return self._function(x[None])[0]

    def happens(self, before: float, after: float) -> bool:
        """Whether it happens between two values."""
        return before > 0.0 >= after or (not self.falling and before < 0.0 <= after)


def excess(model, x):
    system, tol = model
    return system.entropy_production(x) - tol


def _of_points(model, x):
    system, function = model
    return function(system.seen(x))


def located(event: Event, advance: Callable, system, method, state, new, h: float, before: float, after: float):
    """The step that ends where the event happens, to rounding: its size and the state it leads to.

    Looked for among steps from the same state, so that the event is as accurate as the method and the laws hold there;
    one that fails is replaced by the collocation polynomial of the whole step.
    """
    from scipy.optimize import brentq  # here, as its import takes a tenth of a second, and few runs have events

    if after == 0.0:
        return h, new
    x, k = np.asarray(state.x), np.asarray(new.k)

    def value(theta: float) -> float:
        if theta in (0.0, 1.0):
            return after if theta else before
        end = advance(state, theta * h)
        found = event(np.asarray(end.x)) if int(end.status) == Code.COMPLETED else math.nan
        if math.isfinite(found):
            return found
        return event(np.asarray(method.along(system, x, h * method.weights(theta) @ k)))

    theta = float(brentq(value, 0.0, 1.0, xtol=1e-15, rtol=8.9e-16))
    return theta * h, advance(state, theta * h)
