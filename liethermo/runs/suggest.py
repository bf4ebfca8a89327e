"""A step for an accuracy that is asked for."""

from __future__ import annotations

import contextlib
import math
from itertools import pairwise

import numpy as np

from ..engines import array
from ..errors import InputError
from ..integrators import DEFAULT_METHOD, OneStepMethod
from ..systems import DrivenSystem, System, driven
from .adaptive import GROWTH, Adaptive
from .stepwise import run


def suggest_step(system: System, x0, rtol: float = 1e-8, method: OneStepMethod | None = None, t0: float = 0.0) -> float:
    """A step size for fixed steps whose local error is about ``rtol`` times the state, near x0.

    The smallest of the first thirty that adaptive steps take, once they no longer grow as fast as they are let,
    rounded down to two digits.

    Parameters
    ----------
    system : System
    x0 : array, shape (n,)
    rtol : float
    method : OneStepMethod
        ``MetriplecticGauss(1)`` by default, of order 2.
    t0 : float
        The time, for an energy that depends on it.

    Raises
    ------
    InputError
        Where nothing moves at x0, so that any step will do.
    """
    system = driven(system)
    method = (DEFAULT_METHOD if method is None else method).pulled(system).on(system)
    x = np.asarray(system.begin(x0, t0) if isinstance(system, DrivenSystem) else system.state(x0))
    speed, size = float(np.abs(np.asarray(system.vector_field(x))).max()), float(np.abs(x).max())
    if not speed > 0.0:
        raise InputError("nothing moves at this state, so there is no step to suggest: start elsewhere")
    taken: list[float] = []

    def keep(t, reached, h, before, after):
        taken.append(h)
        if len(taken) == 30:
            raise _EnoughError

    span = (0.0, 1e6 * max(size, 1e-300) / speed)
    with contextlib.suppress(_EnoughError):
        engine = array.ArrayEngine(system, method)
        state, advance = engine.begin(x), engine.step
        run(system, method, advance, state, span, Adaptive(rtol), np.array([span[1]]), None, keep)
    if len(taken) < 2:
        raise InputError(f"no step from this state has a local error of {rtol:g}: {len(taken)} steps were taken")
    settled = next((i for i, (a, b) in enumerate(pairwise(taken)) if b < 0.9 * GROWTH * a), len(taken) - 1)
    h = min(taken[settled:])
    digits = 1 - math.floor(math.log10(h))
    return math.floor(h * 10.0**digits) / 10.0**digits


class _EnoughError(Exception):
    """Ends a run that has served its purpose."""
