"""The call of SciPy's ``solve_ivp`` with a system instead of a function: ``lt.scipy.solve_ivp``."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ..errors import InputError
from ..integrators import MetriplecticRungeKutta, OneStepMethod
from ..results.solution import Solution
from ..runs.adaptive import Adaptive
from ..runs.integrate import integrate
from ..systems import System

STATUSES = {"completed": 0, "event": 1}
"""SciPy's numbers for how a run ended; -1 for every failure."""

XTOL, RTOL = 1e-14, 8.9e-16
"""How closely the zeros of event functions are located in the dense output."""


@dataclass(frozen=True)
class OdeResult:
    """What SciPy's ``solve_ivp`` returns, and our own solution.

    Attributes
    ----------
    t : ndarray, shape (times,)
    y : ndarray, shape (n, times)
        States in columns, as SciPy has them.
    sol : function from times, shape (m,), to states, shape (n, m); or None
        Where ``dense_output`` was asked for.
    t_events, y_events : list of ndarray, or None
        For each event function the times and the states, shape (k, n), of its zeros.
    nfev : int
        Evaluations of the vector field, by the stages and iterations of the steps.
    njev, nlu : int
        Iterations of Newton's method: each has a Jacobian matrix or reuses one.
    status : int
        0 where the end was reached, 1 where a terminal event stopped the run, -1 where a step failed.
    message : str
    success : bool
    solution : Solution
        With ``audit()``, energies and entropies.
    """

    t: np.ndarray
    y: np.ndarray
    sol: Callable[[Any], np.ndarray] | None
    t_events: list[np.ndarray] | None
    y_events: list[np.ndarray] | None
    nfev: int
    njev: int
    nlu: int
    status: int
    message: str
    success: bool
    solution: Solution = field(repr=False)


def solve_ivp(
    fun: System,
    t_span: tuple[float, float],
    y0,
    method: OneStepMethod | None = None,
    t_eval=None,
    dense_output: bool = False,
    events: Callable | Sequence[Callable] | None = None,
    *,
    rtol: float = 1e-3,
    atol: float = 1e-6,
    first_step: float | None = None,
    max_step: float | None = None,
) -> OdeResult:
    """Integrate a system as SciPy's ``solve_ivp`` integrates a function, with the laws exact.

    Parameters
    ----------
    fun : System
    t_span : (float, float)
        Time runs forwards.
    y0 : array, shape (n,)
    method : OneStepMethod, optional
        ``MetriplecticRungeKutta(order=8)`` by default; take ``MetriplecticGauss(3)`` for stiff systems.
    t_eval : array of times, increasing, optional
        Keep the states there, and no others. Steps end there, so the laws hold there.
    dense_output : bool
        Give ``sol``, the state at any time.
    events : function of (t, y), or several, optional
        Their zeros are located. The attributes ``terminal`` (True, or the number of zeros after which to stop) and
        ``direction`` mean what they mean in SciPy.
    rtol, atol : float
        SciPy's defaults. What they mean: :class:`.Adaptive`.
    first_step, max_step : float, optional

    Returns
    -------
    OdeResult

    Raises
    ------
    InputError
        If an argument cannot be used. A step that fails does not raise: ``success`` is False, as in SciPy.
    """
    if not isinstance(fun, System):
        raise InputError(
            f"the first argument must be a system such as lt.LiePoissonSystem, not {type(fun).__name__}: "
            "the laws are those of its energy and entropy"
        )
    functions = [] if events is None else [events] if callable(events) else list(events)
    method = MetriplecticRungeKutta(order=8) if method is None else method
    step = Adaptive(rtol, atol, first_step, max_step)
    looked = dense_output or bool(functions)

    def run(end: float) -> Solution:
        wanted = None if t_eval is None else [t for t in _increasing(t_eval) if t_span[0] < t <= end]
        return integrate(
            fun, y0, (t_span[0], end), step, method, save_at=wanted, dense=looked, on_failure="return", progress=False
        )

    solution = run(t_span[1])
    found = _zeros(functions, solution)
    stop = _stop(functions, found, solution)
    if stop is not None and stop < solution.status.time:
        solution = run(stop)
        found = [times[times <= stop] for times in found]
    keep = np.ones(len(solution.t), bool) if t_eval is None else np.isin(solution.t, np.asarray(t_eval))
    stats, sol = solution.stats, None
    if dense_output:

        def sol(t):
            return np.moveaxis(solution(t), -1, 0)

    status = 1 if stop is not None else STATUSES.get(str(solution.status.code), -1)
    iterations = stats.fixed_point_iterations + stats.newton_iterations
    return OdeResult(
        t=solution.t[keep],
        y=solution.x[keep].T,
        sol=sol,
        t_events=found if functions else None,
        y_events=[solution(times) if len(times) else np.empty((0, fun.dim)) for times in found] if functions else None,
        nfev=iterations * method.evaluations,
        njev=stats.newton_iterations,
        nlu=stats.newton_iterations,
        status=status,
        message="A termination event occurred." if stop is not None else solution.status.message,
        success=status >= 0,
        solution=solution,
    )


def _increasing(times) -> np.ndarray:
    times = np.asarray(times, dtype=np.float64)
    if times.ndim != 1 or np.any(np.diff(times) <= 0.0):
        raise InputError("t_eval must be a list of increasing times")
    return times


def _zeros(functions: list[Callable], solution: Solution) -> list[np.ndarray]:
    """The times at which each function vanishes in the direction that it asks for, located between steps."""
    from scipy.optimize import brentq

    if not functions:
        return []
    assert solution.dense is not None
    nodes = np.append(solution.dense.start, solution.dense.start[-1] + solution.dense.h[-1])
    found = []
    for function in functions:
        values = np.array([float(function(t, solution(t))) for t in nodes])
        direction = getattr(function, "direction", 0)
        up, down = (values[:-1] <= 0) & (values[1:] > 0), (values[:-1] >= 0) & (values[1:] < 0)
        crossed = (up & (direction >= 0)) | (down & (direction <= 0))
        found.append(
            np.array(
                [
                    brentq(lambda t, f=function: float(f(t, solution(t))), nodes[i], nodes[i + 1], xtol=XTOL, rtol=RTOL)
                    for i in np.flatnonzero(crossed)
                ]
            )
        )
    return found


def _stop(functions: list[Callable], found: list[np.ndarray], solution: Solution) -> float | None:
    """When the first terminal event ends the run."""
    stops = []
    for function, times in zip(functions, found, strict=True):
        count = int(getattr(function, "terminal", 0) or 0)
        if 0 < count <= len(times):
            stops.append(float(times[count - 1]))
    return min(stops, default=None)
