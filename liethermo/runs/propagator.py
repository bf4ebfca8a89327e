"""``Propagator``: a system, a method and a step, prepared once and called many times."""

from __future__ import annotations

import functools
import os
import threading
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal, TypeAlias

import numpy as np

from manifolds._class_members import ListedType
from manifolds._precision import with_library_settings

from ..engines.select_engine import ENGINES
from ..engines.status_codes import StatusCode
from ..errors import ConvergenceError, FileError, InputError, NonFiniteError
from ..functions.conditions import checked_host_numbers
from ..functions.time_span import TIMES_OF_SMOOTH_FUNCTIONS, DeclaredTimes
from ..integrators import OneStepMethod, Reference
from ..results.ensemble import Ensemble
from ..results.solution import Solution
from ..systems import System
from ..systems.kind_checks import require_system
from ..tracing.caching import LRUCache
from ..tracing.scalarize import UnsupportedPrimitive
from .adaptive import Adaptive
from .ensemble import ensemble
from .events import Until
from .named_parameters import checked_parameters, replace_parameters
from .noise import Fluctuations, check_noise
from .preparation import (
    check_choice,
    checked_or_default_method,
    has_undecided_invariants,
    refuse_incompatible_options,
    refuse_tracers,
)
from .problem import Problem
from .progress import Progress
from .run import Run
from .schedule import (
    CHUNK_STEPS,
    ScheduleSegment,
    StepSchedule,
    checked_resolvable_step,
    checked_span,
    checked_step_size,
    make_schedule,
)
from .time_features import add_breaks_at_features_or_warn
from .varied_parameters import VariedParameters

CONVERGENCE_FAILURES = tuple(
    code.status_name for code in (StatusCode.NOT_CONVERGED, StatusCode.STEP_UNDERFLOW, StatusCode.STEP_LIMIT)
)

FinalStateFunction: TypeAlias = Callable[[Any], np.ndarray | None]
"""A function from an initial state to the last state, or to None if the state has to be computed by a run."""

MAX_CACHED_PARAMETER_SETS = 32
"""Largest number of parameter sets whose propagators are cached; the least recently used are dropped."""


MAX_CACHED_SCHEDULES = 32
"""Largest number of step schedules that are cached; the least recently used are dropped."""

MAX_CACHED_SCHEDULE_STEPS = 10_000
"""Largest number of steps of a schedule that is cached."""

_cached_schedules: LRUCache[StepSchedule] = LRUCache(MAX_CACHED_SCHEDULES)


class Propagator(metaclass=ListedType):
    """Integrator of one system by one method and step, for many calls by optimisers, samplers and control loops.

    ``p(x0, t_span)`` returns what :func:`integrate` returns. ``p.final(x0, t_span)`` returns the last state alone,
    and goes straight to machine code where the compiled engine takes steps of one size. A propagator may be called from
    several threads, and pickled.

    Parameters
    ----------
    system : System
        It fixes the units.
    method : OneStepMethod, Reference or None
        None means ``MetriplecticGauss()``, and ``MetriplecticMidpoint()`` with noise.
    step : float or Adaptive
        Step size, in the unit of time of the system, or tolerances of adaptive steps.
    engine : {"auto", "array", "compiled", "sparse"}
        As for :func:`integrate`.
    noise : Fluctuations, optional
        As for :func:`integrate`.

    Raises
    ------
    InputError
        If the method cannot run the system.

    Examples
    --------
    >>> body = lt.models.rigid_body((3.0, 2.0, 1.0), rate=0.2)
    >>> p = lt.Propagator(body, lt.MetriplecticRungeKutta(8), step=0.5)
    >>> p.final([0.1, 0.2, 1.0], (0.0, 10.0)).shape
    (3,)
    >>> p([0.1, 0.2, 1.0], (0.0, 10.0)).audit().passed
    True
    """

    @with_library_settings
    @refuse_tracers
    def __init__(
        self,
        system: System,
        method: OneStepMethod | Reference | None,
        step: float | Adaptive,
        *,
        engine: Literal["auto", "array", "compiled", "sparse"] = "auto",
        noise: Fluctuations | None = None,
    ):
        if noise is not None:
            check_noise(noise)
        method = checked_or_default_method(method, noise, is_single_trajectory=True)
        require_system(system, "the first argument must be a system such as lt.LiePoissonSystem")
        check_choice("engine", engine, ENGINES)
        refuse_incompatible_options(method, step, noise)
        if not isinstance(step, Adaptive):
            checked_step_size(step)
        self.system, self.method, self.step, self.engine, self.noise = system, method, step, engine, noise
        self._variants: LRUCache[Propagator] = LRUCache(MAX_CACHED_PARAMETER_SETS)
        self._decided_problem: Problem | None = None
        self._thread = _ThreadFinalStateFunctions()

    def __getstate__(self) -> tuple:
        return self.system, self.method, self.step, self.engine, self.noise

    def __setstate__(self, state: tuple) -> None:
        system, method, step, engine, noise = state
        self.__init__(system, method, step, engine=engine, noise=noise)  # type: ignore[misc]

    def __repr__(self) -> str:
        return f"Propagator({type(self.system).__name__}, {self.method}, step={self.step})"

    # -- one trajectory -------------------------------------------------------------------------------------------

    @with_library_settings
    @refuse_tracers
    def __call__(
        self,
        x0,
        t_span: tuple[float, float],
        *,
        parameters: Mapping[str, Any] | None = None,
        save_every: int = 1,
        save_at=None,
        until: Until | None = None,
        dense: bool = False,
        on_failure: Literal["raise", "return"] = "raise",
        progress: bool | None = False,
        save_to: str | os.PathLike | None = None,
        attitude=None,
        breaks: Sequence[float] = (),
    ) -> Solution:
        """Integrate from the state x0 over a span of time, and return the solution.

        Parameters
        ----------
        x0, t_span, save_every, save_at, until, dense, on_failure, progress, save_to, attitude, breaks
            As for :func:`integrate`; without a progress bar by default.
        parameters : dict from str to array, optional
            New values of parameters of the system, by their names, such as ``{"dissipation.rate": 0.1}``.

        Raises
        ------
        InputError, ConvergenceError, NonFiniteError, FileError
            As :func:`integrate`.
        """
        if parameters:
            return self.with_parameters(parameters)(
                x0,
                t_span,
                save_every=save_every,
                save_at=save_at,
                until=until,
                dense=dense,
                on_failure=on_failure,
                progress=progress,
                save_to=save_to,
                attitude=attitude,
                breaks=breaks,
            )
        check_choice("on_failure", on_failure, ("raise", "return"))
        step, adaptive = self.step, isinstance(self.step, Adaptive)
        problem = self._problem_of_run_from(x0)
        refuse_incompatible_options(self.method, step, self.noise, until, dense, save_at)
        declared_times = self._declared_times if problem.is_driven else TIMES_OF_SMOOTH_FUNCTIONS
        allow_infinite_end = adaptive and until is not None
        schedule = self._cached_schedule(t_span, save_every, save_at, allow_infinite_end, breaks, declared_times)
        x = problem.initial_state(x0, schedule.start, attitude)
        if problem.is_driven and isinstance(self.method, OneStepMethod):
            schedule = add_breaks_at_features_or_warn(schedule, [problem.system_limited_to_span(schedule)], [x], step)
        run = Run(problem, x, schedule, save_to, self.engine, dense)
        with Progress((schedule.start, schedule.end), progress) as bar:
            if isinstance(self.method, Reference):
                run.run_with_scipy(bar)
            elif adaptive or until is not None:
                run.run_adaptive_or_until_event(bar, step if adaptive else schedule.h, until)
            else:
                run.run_fixed_steps(bar)
        solution = run.solution_so_far()
        if save_to is not None:
            try:
                solution.save(save_to)
            except FileError as error:
                raise FileError(f"{error}. The exception has this result as .solution", solution) from error
        if on_failure == "raise":
            raise_if_failed(solution)
        return solution

    def final(self, x0, t_span: tuple[float, float], *, parameters: Mapping[str, Any] | None = None) -> np.ndarray:
        """Return the last state of the trajectory from x0, equal to ``p(x0, t_span).x[-1]`` to the bit.

        Parameters
        ----------
        x0 : array, shape (n,), or ``(*sites, d)``
            The initial state.
        t_span : (float, float)
            The initial and the final time.
        parameters : dict from str to array, optional
            As in a call of the propagator.

        Raises
        ------
        InputError, ConvergenceError, NonFiniteError
            As :func:`integrate` does.
        """
        if parameters:
            x = self._compiled_final_state_with_parameters(x0, t_span, parameters)
            return self.with_parameters(parameters).final(x0, t_span) if x is None else x
        functions = self._thread.final_functions
        function = functions.get(t_span) if type(t_span) is tuple else None
        if function is None:
            function = self._compiled_final_state_function(t_span)
            if type(t_span) is tuple and function is not None:
                self._thread.add(t_span, function)
        if function is not None and (x := function(x0)) is not None:
            return x
        return self(x0, t_span, save_every=CHUNK_STEPS).x[-1]

    def many(self, x0s, t_span: tuple[float, float], *, parameters=None, **options) -> Ensemble:
        """Return an ensemble of trajectories, as :func:`ensemble` does.

        Parameters
        ----------
        x0s, t_span, parameters
            As for :func:`ensemble`.
        **options
            Other arguments of :func:`ensemble`, such as ``outputs="summary"``.
        """
        if self.engine == "sparse":
            raise InputError('a propagator with engine="sparse" cannot run ensembles. Leave out engine')
        return ensemble(
            self.system,
            x0s,
            t_span,
            self.step,
            self.method,
            parameters=parameters,
            engine=self.engine,
            noise=self.noise,
            **options,
        )

    # -- cached propagators, problems, schedules and programs -----------------------------------------------------

    def with_parameters(self, parameters: Mapping[str, Any]) -> Propagator:
        """Return the cached propagator of the system with new values of some parameters.

        Raises
        ------
        InputError
            If the system has no parameter of this name, or a value has another shape or is refused by the constructor
            of its object, as a negative rate is.
        """
        values = {name: checked_host_numbers(value, name) for name, value in checked_parameters(parameters).items()}
        key = tuple((name, value.shape, value.tobytes()) for name, value in sorted(values.items()))
        return self._variants.get_or_compute(
            key,
            lambda: Propagator(
                replace_parameters(self.system, values), self.method, self.step, engine=self.engine, noise=self.noise
            ),
        )

    def _problem_of_run_from(self, x0=None) -> Problem:
        """Return the problem of a run from x0, near which undecided conservation laws are tested."""
        if self._decided_problem is not None:
            return self._decided_problem
        tolerance = self.step.tolerance if isinstance(self.step, Adaptive) else None
        problem = Problem.from_user(self.system, self.method, self.noise, tolerance, x0)
        if not has_undecided_invariants(self.system):
            self._decided_problem = problem
        return problem

    @functools.cached_property
    def _declared_times(self) -> DeclaredTimes:
        """Times at which the functions of time in the system declare jumps and kinks."""
        return DeclaredTimes.from_tree(self.system)

    def _cached_schedule(
        self, t_span, save_every: int, save_at, allow_infinite_end: bool, breaks, declared_times: DeclaredTimes
    ) -> StepSchedule:
        """Return the schedule of a run; all propagators share a cache of short schedules."""
        kind, has_breaks = type(self.step), any(declared_times) or not isinstance(breaks, tuple) or breaks
        is_plain = save_at is None and not allow_infinite_end and not has_breaks and type(save_every) is int
        if not is_plain or kind not in (float, int, Adaptive):
            return make_schedule(t_span, self.step, save_every, save_at, allow_infinite_end, breaks, declared_times)
        key = *checked_span(t_span), save_every, kind if kind is Adaptive else self.step
        schedule = _cached_schedules.get(key)
        if schedule is None:
            schedule = make_schedule(key[:2], self.step, save_every)
            if schedule.n_steps <= MAX_CACHED_SCHEDULE_STEPS:
                _cached_schedules.get_or_compute(key, lambda: schedule)
        return schedule

    def _compiled_final_state_function(
        self, t_span, varied_parameters: VariedParameters | None = None
    ) -> FinalStateFunction | None:
        """Return a function from x0 to the last state over a span in machine code, or None if a run has to compute it.

        The function returns None if a step fails; a run then says why.

        Parameters
        ----------
        t_span : (float, float)
        varied_parameters : VariedParameters, optional
            Parameters whose current values the function reads at each call.
        """
        problem = self._problem_of_compiled_final_states
        if problem is None or (
            varied_parameters is not None and not varied_parameters.is_program_determined_by_key(problem)
        ):
            return None
        start, end = checked_span(t_span)
        h = checked_resolvable_step(self.step, start, end)
        segment = ScheduleSegment.from_span(start, end, h)
        if segment.n_full_steps > CHUNK_STEPS:
            return None  # a run in portions, which Ctrl-C can stop
        trajectory = problem.engine_of_run(self.engine, problem.system, segment.n_steps).compiled_trajectory(
            varied_parameters is not None
        )
        if trajectory is None:
            return None
        compute = trajectory.final_state_function(segment.step_sizes_and_counts(h))
        state_shape, flat_shape, starts_anywhere = problem.state_shape, (problem.system.dim,), problem.starts_anywhere

        def final_state(x0) -> np.ndarray | None:
            is_state = starts_anywhere and type(x0) is np.ndarray and x0.dtype == np.float64 and x0.shape == flat_shape
            x = compute(x0 if is_state else np.asarray(problem.initial_state(x0, start)))
            return x if x is None or state_shape == flat_shape else x.reshape(state_shape)

        if varied_parameters is None:
            return final_state

        def final_state_with_parameters(x0) -> np.ndarray | None:
            trajectory.parameters[varied_parameters.indices] = varied_parameters.entries
            return final_state(x0)

        return final_state_with_parameters

    def _compiled_final_state_with_parameters(self, x0, t_span, parameters: Mapping[str, Any]) -> np.ndarray | None:
        """Return the last state for new parameter values, by machine code that takes the parameters as arguments.

        The result is None if new values may change what the system conserves; a new propagator then has to compute the
        state.
        """
        if type(parameters) is not dict:  # the commonest type needs no check
            checked_parameters(parameters)
        names, thread = tuple(parameters), self._thread
        if names not in thread.varied_parameters:
            self.with_parameters(parameters)  # which checks the names
            thread.varied_parameters[names] = self._varied_parameters_or_none(names)
        varied_parameters = thread.varied_parameters[names]
        key = (
            None
            if varied_parameters is None or type(t_span) is not tuple
            else varied_parameters.set_values_and_get_program_key(parameters.values())
        )
        if varied_parameters is None or key is None:
            return None
        function = thread.final_functions.get((names, key, t_span))
        if function is None:
            function = (
                self.with_parameters(parameters)._compiled_final_state_function(t_span, varied_parameters)
                or _defer_final_state_to_run
            )
            thread.add((names, key, t_span), function)
        return function(x0)

    @with_library_settings
    def _varied_parameters_or_none(self, names: tuple[str, ...]) -> VariedParameters | None:
        """Return the named parameters as arguments of machine code, or None if their values may change the program."""
        problem = self._problem_of_compiled_final_states
        if problem is None or not problem.has_fixed_domain or self.system.preserved_functions:
            return None
        try:
            return VariedParameters(self.system, self.method, names)
        except UnsupportedPrimitive:
            return None

    @functools.cached_property
    @with_library_settings
    def _problem_of_compiled_final_states(self) -> Problem | None:
        """Problem whose final states machine code can compute, or None if every call needs a run."""
        if isinstance(self.step, Adaptive) or self.noise is not None or isinstance(self.method, Reference):
            return None
        if has_undecided_invariants(self.system):  # what is conserved may depend on the initial state
            return None
        problem = self._problem_of_run_from()
        return problem if problem.system.inner_system is None else None


def _defer_final_state_to_run(x0) -> None:
    """Return None in place of a last state, so that the caller computes it by a run, because no program does."""


class _ThreadFinalStateFunctions(threading.local):
    """Cache of functions that compute final states over spans, for the current thread, whose buffers they use.

    Attributes
    ----------
    final_functions : dict
        Keys are spans; for functions of parameters, the names, the key of the program, and the span.
    varied_parameters : dict from names to VariedParameters or None
        Parameters of earlier calls; None for those that machine code does not take as arguments.
    """

    def __init__(self):
        self.final_functions: dict[tuple, FinalStateFunction] = {}
        self.varied_parameters: dict[tuple[str, ...], VariedParameters | None] = {}

    def add(self, key: tuple, final_state_function: FinalStateFunction) -> None:
        if len(self.final_functions) >= MAX_CACHED_SCHEDULES:
            self.final_functions.clear()
        self.final_functions[key] = final_state_function


def raise_if_failed(solution: Solution) -> None:
    """Raise the error that belongs to the status of a failed run, with the run as its ``.solution``.

    Raises
    ------
    ConvergenceError, NonFiniteError
    """
    status = solution.status
    if status.code in CONVERGENCE_FAILURES:
        raise ConvergenceError(status.message, solution)
    if not status.ok and status.code != StatusCode.INTERRUPTED.status_name:
        raise NonFiniteError(status.message, solution)
