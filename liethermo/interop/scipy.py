"""SciPy's function ``solve_ivp`` for a system instead of a function: ``lt.scipy.solve_ivp``."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from manifolds._arguments import module_dir_function
from manifolds.errors import warn

from ..errors import InputError
from ..functions.conditions import host_number
from ..integrators import MetriplecticRungeKutta, OneStepMethod
from ..results.solution import Solution
from ..runs.adaptive import Adaptive
from ..runs.events import (
    EventSpecification,
    check_result_is_scalar,
    direction_attribute_of_event,
    terminal_attribute_of_event,
)
from ..runs.integrate import integrate, solution_without_steps
from ..runs.schedule import backward_span_message, clip_times_to_span
from ..systems import System
from ..systems.kind_checks import require_system
from ..tracing.short_form import callable_name

__all__ = ["OdeResult", "solve_ivp"]
__dir__ = module_dir_function(__all__)

SCIPY_STATUS = {"completed": 0, "event": 1}
"""SciPy's status codes by status name; every other status is -1."""

UNSUPPORTED_OPTIONS = {"jac", "jac_sparsity", "lband", "uband", "min_step"}
"""Options of SciPy's solvers that are refused, because the methods obtain this information from the system."""


@dataclass(frozen=True)
class OdeResult:
    """The result of :func:`solve_ivp`: the fields of SciPy's, and a :class:`Solution`.

    Attributes
    ----------
    t : ndarray, shape (times,)
    y : ndarray, shape (n, times)
        States in columns, as in SciPy.
    sol : function from times, shape (m,), to states, shape (n, m); or None
        With ``dense_output``: takes a step of the method to each time, so that the laws hold there.
    t_events, y_events : list of ndarray, or None
        For each event function the times and the states, shape (k, n), of its zeros, which are ends of steps too.
    nfev : int
        Evaluations of the vector field, by the stages and iterations of the steps.
    njev, nlu : int
        Iterations of Newton's method: each has a Jacobian matrix or reuses one.
    status : int
        0 if the end was reached, 1 if a terminal event stopped the run, -1 if a step failed.
    message : str
    success : bool
    solution : Solution
        The run with energies, entropies and ``audit()``.
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
    vectorized: bool = False,
    args: tuple | None = None,
    *,
    rtol=1e-3,
    atol=1e-6,
    first_step: float | None = None,
    max_step: float | None = None,
    **options,
) -> OdeResult:
    """Integrate a system as SciPy's ``solve_ivp`` integrates a function, with the laws exact.

    Parameters
    ----------
    fun : System
    t_span : (float, float)
        Time runs forwards. The end may be infinite if an event is terminal. The result over a span of length zero is
        the initial state, at the start and at the end.
    y0 : array, shape (n,)
    method : OneStepMethod, optional
        ``MetriplecticRungeKutta(order=8)`` by default; take ``MetriplecticGauss(3)`` for stiff systems.
    t_eval : array of times, increasing, optional
        Return the states at these times only. Steps end there, so the laws hold there.
    dense_output : bool
        Give ``sol``, the state at any time.
    events : function of t, y and the ``args``, or several, optional
        Their zeros are located, all of them, by steps that end there. The attributes ``terminal`` (True, or the number
        of zeros after which to stop) and ``direction`` mean what they mean in SciPy. A change of sign counts, as in
        SciPy, even where the function jumps; one across states where it is NaN does not, and ``message`` says where.
        If a state that is needed cannot be found, the run ends there with status -1 and the reason.
    vectorized : bool
        Without effect: a system takes states of any shape.
    args : tuple, optional
        Passed to the events. The system has its parameters in itself.
    rtol, atol : float or array, shape (n,)
        SciPy's defaults. What they mean: :class:`.Adaptive`. One error is estimated for all components, so the smallest
        entry of an array holds for all of them.
    first_step, max_step : float, optional
        ``first_step`` is no longer than the span; ``max_step`` may be infinite.

    Returns
    -------
    OdeResult

    Raises
    ------
    InputError
        If an argument cannot be used. A step that fails does not raise: ``success`` is False, as in SciPy.
    """
    require_system(fun, "fun must be a system such as lt.LiePoissonSystem")
    for name in options:
        reason = (
            "the methods take it from the system" if name in UNSUPPORTED_OPTIONS else "solve_ivp has no such option"
        )
        raise InputError(f"leave out {name}: {reason}")
    event_functions = [] if events is None else [events] if callable(events) else list(events)
    if args is not None and not event_functions:
        raise InputError("args are passed to the events, but there are none. A system contains its parameters")
    start, end = _checked_t_span(t_span)
    saved_times = None if t_eval is None else _checked_t_eval(t_eval, start, end)
    _check_first_step(first_step, end - start)
    arguments = _checked_event_args(args)
    is_terminal = any(terminal_attribute_of_event(function) for function in event_functions)
    if math.isinf(end) and not is_terminal:
        raise InputError("an infinite end needs an event that ends the run. Set event.terminal = True, or a finite end")
    method = MetriplecticRungeKutta(order=8) if method is None else method
    step = Adaptive(
        _smallest_tolerance("rtol", rtol, y0),
        _smallest_tolerance("atol", atol, y0),
        first_step,
        None if max_step == math.inf else max_step,
    )
    has_initial_event = [
        _has_event_at_start(function, arguments, fun, (start, end), y0, step, method) for function in event_functions
    ]
    if end == start or any(map(_is_terminal_at_start, event_functions, has_initial_event)):
        return _empty_span_result(fun, y0, start, method, saved_times, dense_output, event_functions, has_initial_event)
    solution = integrate(
        fun,
        y0,
        (start, end),
        step,
        method,
        save_at=None if saved_times is None else [start, *saved_times, *([end] if math.isfinite(end) else [])],
        until=EventSpecification(event_functions, arguments, has_initial_event) if event_functions else None,
        dense=dense_output,
        on_failure="return",
        progress=False,
    )
    is_saved = np.ones(len(solution.t), bool) if saved_times is None else np.isin(solution.t, saved_times)
    return _to_ode_result(solution, solution.t[is_saved], solution.x[is_saved], method, has_initial_event, dense_output)


def _to_ode_result(
    solution: Solution,
    saved_times: np.ndarray,
    saved_states: np.ndarray,
    method: OneStepMethod,
    has_initial_event: list[bool],
    has_dense_output: bool,
) -> OdeResult:
    """Convert a solution to SciPy's result, with the states at the requested times, shape (times, n).

    ``has_initial_event`` is True for each event function with an event at the start, where the run does not look for
    events.
    """
    stats, status = solution.stats, SCIPY_STATUS.get(str(solution.status.code), -1)
    iterations = stats.fixed_point_iterations + stats.newton_iterations

    def sol(t):
        return np.moveaxis(solution(t), -1, 0)

    events = solution.events or [None] * len(has_initial_event)
    no_events = np.empty(0), np.empty((0, *solution.x.shape[1:]))
    t_events, y_events = [], []
    for has_event, series in zip(has_initial_event, events, strict=True):
        times, states = no_events if series is None else (series.t, series.x)
        t_events.append(np.append(solution.t[: int(has_event)], times))
        y_events.append(np.append(solution.x[: int(has_event)], states, axis=0))
    return OdeResult(
        t=saved_times,
        y=saved_states.T,
        sol=sol if has_dense_output else None,
        t_events=t_events or None,
        y_events=y_events or None,
        nfev=iterations * method.evaluations_per_iteration,
        njev=stats.newton_iterations,
        nlu=stats.newton_iterations,
        status=status,
        message="A termination event occurred." if status == 1 else solution.status.message,
        success=status >= 0,
        solution=solution,
    )


FIRST_STRETCH = 1e-4
"""Part of the span after which the sign of an event function that is zero at the start is evaluated."""


def _has_event_at_start(
    event_function: Callable,
    arguments: tuple,
    system: System,
    span: tuple[float, float],
    x0,
    step: Adaptive,
    method: OneStepMethod,
) -> bool:
    """Return True if an event function has an event at the start of a run: it is zero and then changes in its
    direction."""
    (start, end), x = span, np.asarray(system.state(x0)).reshape(np.shape(x0))
    direction = direction_attribute_of_event(event_function)
    if _event_value(event_function, start, x, arguments) != 0.0:
        return False
    if direction == 0 or end == start:
        return True
    max_length = FIRST_STRETCH * (end - start) if math.isfinite(end) else 1.0
    length = min(max_length, step.first or math.inf, step.largest or math.inf)
    short_run = integrate(system, x0, (start, start + length), step, method, on_failure="return", progress=False)
    return direction * _event_value(event_function, short_run.t[-1], short_run.x[-1], arguments) >= 0.0


def _event_value(event_function: Callable, t: float, x: np.ndarray, arguments: tuple) -> float:
    """Return the value of an event function; FunctionError unless it is one number."""
    value = event_function(t, x, *arguments)
    check_result_is_scalar(None if value is None else np.asarray(value), f"the event {callable_name(event_function)}")
    return float(value)


def _is_terminal_at_start(event_function: Callable, has_initial_event: bool) -> bool:
    """Return True if an event at the start of a run ends it."""
    return has_initial_event and terminal_attribute_of_event(event_function) == 1


def _empty_span_result(
    system: System,
    x0,
    t: float,
    method: OneStepMethod,
    saved_times: np.ndarray | None,
    has_dense_output: bool,
    event_functions: list[Callable],
    has_initial_event: list[bool],
) -> OdeResult:
    """Return the result of a run without steps: as in SciPy, the initial state at the start and at the end."""
    solution = solution_without_steps(system, x0, t, method)
    times = np.array([t, t]) if saved_times is None else saved_times[saved_times <= t]
    result = _to_ode_result(
        solution, times, np.repeat(solution.x, len(times), axis=0), method, has_initial_event, has_dense_output
    )
    is_terminated = any(map(_is_terminal_at_start, event_functions, has_initial_event))
    return replace(result, status=1, message="A termination event occurred.") if is_terminated else result


def _check_first_step(first_step: float | None, span_length: float) -> None:
    if first_step is not None and not 0.0 < first_step <= span_length:
        raise InputError(
            f"first_step must be positive and at most the length of t_span, {span_length:g}, got {first_step:g}. "
            "Leave it out, and it is chosen"
        )


MIN_RTOL = 100.0 * float(np.finfo(np.float64).eps)
"""Minimum relative tolerance in an array, as in SciPy; smaller values are raised to it."""


def _smallest_tolerance(name: str, tolerance, x0) -> float:
    """Return the smallest entry of a tolerance, of shape () or (n,); entries of rtol below MIN_RTOL are raised."""
    if np.ndim(tolerance) == 0:
        return tolerance.item() if isinstance(tolerance, np.ndarray) else tolerance
    values = np.asarray(tolerance, dtype=np.float64)
    if values.shape != np.shape(x0):
        raise InputError(f"{name} must be a number or an array of shape {np.shape(x0)}, as y0, got {values.shape}")
    if name == "rtol" and (values < MIN_RTOL).any():
        warn(f"At least one element of rtol is too small. Setting rtol = np.maximum(rtol, {MIN_RTOL:.3g})")
        values = np.maximum(values, MIN_RTOL)
    return float(values.min())


def _checked_t_span(t_span) -> tuple[float, float]:
    try:
        start, end = (host_number(t, "t_span") for t in t_span)
    except (TypeError, ValueError):
        raise InputError(f"t_span must be two numbers (start, end), got {t_span!r}") from None
    if math.isnan(start) or math.isnan(end) or math.isinf(start):
        raise InputError(f"t_span must start at a finite time, got ({start:g}, {end:g})")
    if end < start:
        raise InputError(backward_span_message(start, end))
    return start, end


def _checked_t_eval(t_eval, start: float, end: float) -> np.ndarray:
    times = np.asarray(t_eval, dtype=np.float64)
    if times.ndim != 1 or np.any(np.diff(times) <= 0.0):
        raise InputError("t_eval must be a list of increasing times")
    return clip_times_to_span(times, start, end, "t_eval")


def _checked_event_args(args) -> tuple:
    if args is None:
        return ()
    try:
        return (*args,)
    except TypeError:
        raise InputError(f"args must be a tuple, even of one. Write args=({args!r},)") from None
