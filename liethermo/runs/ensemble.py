"""``ensemble``: many trajectories at once, with broadcast initial states and parameters and a status for each."""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np

from manifolds._precision import with_library_settings

from ..engines.select_engine import is_worth_compiling, warn_of_fallback
from ..errors import InputError
from ..functions.time_span import DeclaredTimes
from ..integrators import OneStepMethod
from ..integrators.fluctuating import noise_dimension
from ..results.ensemble import Ensemble
from ..systems import System
from ..systems.rotations import attitude_array
from ..tracing.scalarize import UnsupportedPrimitive
from .adaptive import Adaptive, make_step_control
from .adaptive_ensemble import AdaptiveEnsembleRun
from .ensemble_lanes import MAX_THREADS, FixedEnsembleRun, ProgressCounter
from .events import EventSet, Until
from .member_groups import common_inertia, group_members_by_invariants, members_outside_domain
from .noise import Fluctuations, NoisePaths, check_noise
from .preparation import (
    check_choice,
    checked_or_default_method,
    limit_time_functions_of_family,
    limit_time_functions_to_span,
    refuse_incompatible_options,
    refuse_tracers,
    why_not_startable,
    wrap_family_like_member,
)
from .problem import Problem
from .progress import Progress
from .record import EnsembleRecord, GroupRecord, TrajectoryGroup
from .schedule import StepSchedule, make_schedule
from .solution_builder import run_provenance
from .system_family import Family, broadcast_size, error_message_or_empty
from .time_features import add_breaks_at_features_or_warn

__all__ = ["MAX_THREADS", "Ensemble", "ensemble"]

DOMAIN_CHECK_BATCH_SIZE = 8192
"""Largest number of initial states that are checked together, which bounds memory."""


@with_library_settings
@refuse_tracers
def ensemble(
    system: System | Callable[[Any], System] | Family,
    x0s,
    t_span: tuple[float, float],
    step: float | Adaptive,
    method: OneStepMethod | None = None,
    *,
    parameters=None,
    outputs: Literal["final", "trajectory", "summary"] | None = None,
    save_every: int = 1,
    save_at=None,
    until: Until | None = None,
    engine: Literal["auto", "array", "compiled"] = "auto",
    attitude=None,
    progress: bool | None = None,
    noise: Fluctuations | None = None,
    breaks: Sequence[float] = (),
) -> Ensemble:
    """Integrate many trajectories of one system, or of a family of systems.

    A trajectory that fails has its own status and does not stop the others. A trajectory with invalid parameters or an
    invalid initial state does not start, and its status is "inadmissible". After Ctrl-C the unfinished trajectories
    have the status "interrupted".

    Parameters
    ----------
    system : System, or function from one set of parameters to a System
        The system of all trajectories, or a function that builds the system of each. It fixes the units.
    x0s : array, shape (n,) or (B, n)
        Initial states, in the units of the system; one for all, or one each. For a system on sites, ``(*sites, d)``
        may replace n. The states of an ensemble are flat, and ``system.points`` shows them on the sites.
    t_span, step, method, save_every, save_at, until
        As for :func:`integrate`, times in the unit of time of the system. With ``lt.Adaptive(rtol, atol)`` every
        trajectory has its own steps, the same as in a single run, and with ``until`` its own end: ``e.end_time`` and
        ``e.event_time``; ``e.events`` has the events of all.
    parameters : optional
        One set for each trajectory, in the units of the system: arrays whose first axis is that of the trajectories.
        For a function, its argument (an array, a dict of arrays, …). For a system, a dict from the names of its
        parameters, such as ``{"dissipation.rate": rates}``, to their values.
    outputs : {"final", "trajectory", "summary"}
        Final states; every ``save_every``-th state, or those at ``save_at``; or no states, which saves memory. By
        default final states, or trajectories with ``save_at`` or another ``save_every`` than 1.
    engine : {"auto", "array", "compiled"}
        SIMD lanes over all cores for small systems ("compiled"), or ``vmap`` for any ("array"). "auto" compiles what
        can be compiled, unless JAX has an accelerator.
    attitude : array, shape (m, m) or (B, m, m), or scipy.spatial.transform.Rotation; optional
        As for :func:`integrate` (dimensionless); one for all, or one each.
    progress : bool, optional
        Show a progress bar; by default where the standard error is a terminal.
    noise : Fluctuations, optional
        As for :func:`integrate`. Every trajectory has noise of its own, by its number and the times of its steps.
    breaks : sequence of float
        Times (in the unit of ``t_span``) at which functions of time jump; see :func:`integrate`.

    Returns
    -------
    Ensemble
        ``e[i]`` is one trajectory as a :class:`Solution`.

    Raises
    ------
    InputError
        If an argument cannot be used, or no trajectory can be started. The parameters with the smallest and largest
        values are tried one by one, and the next where these are inadmissible.

    Examples
    --------
    >>> starts = np.random.default_rng(0).standard_normal((100, 3))
    >>> many = lt.ensemble(
    ...     lt.models.rigid_body(rate=0.2), starts, (0.0, 5.0), 0.05, outputs="summary"
    ... )
    >>> many.energy.shape, bool(many.ok.all())
    ((100,), True)
    """
    start_time = time.perf_counter()
    method = checked_or_default_method(method, noise)
    outputs = outputs or ("final" if save_at is None and save_every == 1 else "trajectory")
    check_choice("outputs", outputs, ("final", "trajectory", "summary"))
    check_choice("engine", engine, ("auto", "array", "compiled"))
    if save_at is not None and outputs != "trajectory":
        raise InputError(f'save_at needs outputs="trajectory", got {outputs!r}')
    if (isinstance(step, Adaptive) or until is not None) and outputs == "trajectory" and save_at is None:
        raise InputError('outputs="trajectory" with adaptive steps or events needs save_at, common times to save')
    refuse_incompatible_options(method, step, noise, until)
    family = Family.from_arguments(system, parameters)
    save_every_step = save_every if outputs == "trajectory" and save_at is None else None
    declared_times = DeclaredTimes.from_tree(family.member_with_unknown_parameters())
    schedule = make_schedule(t_span, step, save_every_step, save_at, breaks=breaks, declared_times=declared_times)
    attitude = attitude_array(attitude, None)
    states, reasons = _checked_initial_states(family, x0s, len(attitude) if np.ndim(attitude) == 3 else 1)
    check_noise(noise, len(states))
    n_trajectories = len(states)
    started_numbers = np.arange(n_trajectories)
    if reasons:
        started_numbers = np.setdiff1d(started_numbers, list(reasons))
        family, states = family.select(started_numbers), states[started_numbers]
    options = _EnsembleOptions(method, step, schedule, engine, until, noise)
    provenance = run_provenance(
        family.representative,
        method,
        step if isinstance(step, Adaptive) else schedule.h,
        (schedule.start, schedule.end),
        schedule.save_every,
        noise=None if noise is None else noise.to_provenance(),
    )
    inertia = common_inertia(family)
    provenance["inertia"] = None if inertia is None else inertia.tolist()
    member_groups, refusal_reasons = group_members_by_invariants(family, method, states)
    reasons = dict(reasons) | {int(started_numbers[i]): text for i, text in refusal_reasons.items()}
    groups: list[TrajectoryGroup] = []
    for member_indices, group_family in member_groups:
        numbers = started_numbers[member_indices]
        group_attitude = np.asarray(attitude)[numbers] if np.ndim(attitude) == 3 and len(attitude) > 1 else attitude
        group, group_reasons = options.prepare_group(group_family, states[member_indices], numbers, group_attitude)
        groups += [] if group is None else [group]
        reasons |= group_reasons
    if not groups:
        raise InputError(f"no trajectory can be started; trajectory {min(reasons)}: {reasons[min(reasons)]}")
    record, n_done = EnsembleRecord(groups, n_trajectories, outputs), 0
    with Progress((0, len(started_numbers)), progress, "{:.0f} trajectories") as bar:
        for group_record in record.groups:
            options.run_group(group_record, functools.partial(_update_progress, bar, n_done))
            if group_record.is_interrupted:
                break
            n_done += len(group_record.trajectory_numbers)
    return record.to_ensemble(reasons, provenance, wall_time=time.perf_counter() - start_time)


def _update_progress(bar: Progress, n_in_earlier_groups: int, n_in_this_group: float) -> None:
    bar.update(n_in_earlier_groups + n_in_this_group)


class _EnsembleOptions(NamedTuple):
    """Options of :func:`ensemble` that all groups of trajectories share."""

    method: OneStepMethod
    step: float | Adaptive
    schedule: StepSchedule
    engine: str
    until: Any
    noise: Fluctuations | None

    def prepare_group(
        self, family: Family, initial_states: np.ndarray, trajectory_numbers: np.ndarray, attitude
    ) -> tuple[TrajectoryGroup | None, dict[int, str]]:
        """Return a group of trajectories ready to run (None if none can start), and the reasons why some cannot start.

        The keys of the reasons are the numbers of the trajectories.

        Parameters
        ----------
        initial_states : array, shape (B, n)
            Initial states.
        trajectory_numbers : array of int, shape (B,)
            The numbers of the trajectories in the ensemble.
        attitude : array, shape (m, m) or (B, m, m), or None
        """
        step, schedule, noise = self.step, self.schedule, self.noise
        tolerance = step.tolerance if isinstance(step, Adaptive) else None
        problem = Problem.from_user(family.member(0), self.method, noise, tolerance, initial_states)
        method, family = problem.method, wrap_family_like_member(family, problem.system)
        initial_states = np.asarray(problem.system.initial_state(initial_states, schedule.start, attitude, batch=True))
        family_in_span = limit_time_functions_of_family(family, problem.system, schedule)
        member = problem.system_limited_to_span(schedule)
        reasons = {
            int(trajectory_numbers[i]): text
            for i, text in _reasons_of_unstartable_members(family_in_span, member, method, initial_states).items()
        }
        if reasons:
            startable = np.flatnonzero(~np.isin(trajectory_numbers, list(reasons)))
            trajectory_numbers, family, initial_states = (
                trajectory_numbers[startable],
                family.select(startable),
                initial_states[startable],
            )
            if not len(trajectory_numbers):
                return None, reasons
            family_in_span = family_in_span.select(startable)
        if problem.is_driven:
            members = family.members_with_extreme_parameters()[: len(initial_states)]
            systems = [limit_time_functions_to_span(family.member(i), schedule) for i in members]
            schedule = add_breaks_at_features_or_warn(schedule, systems, initial_states[members], step)
            if schedule is not self.schedule:
                family_in_span = limit_time_functions_of_family(family, problem.system, schedule)
                member = problem.system_limited_to_span(schedule)
        events = None if self.until is None else EventSet(self.until, member, schedule.start, initial_states[0])
        control = noise_paths = None
        if tolerance is not None or events is not None:
            control = make_step_control(step, method, schedule.end - schedule.start, events)
        if noise is not None and noise_dimension(method):
            noise_paths = NoisePaths(noise, noise_dimension(method), trajectory_numbers, schedule)
        h = schedule.h if tolerance is None else np.nan
        group = TrajectoryGroup(
            trajectory_numbers,
            problem,
            family_in_span,
            member,
            initial_states,
            schedule,
            h,
            control,
            events,
            noise_paths,
        )
        return group, reasons

    def run_group(self, group_record: GroupRecord, report_n_finished: Callable[[float], None]) -> None:
        """Run a group of trajectories and fill its record.

        ``report_n_finished`` is called with the number of finished trajectories whenever it changes.
        """

        def run_with_engine(engine: str) -> None:
            group_record.engine = engine
            run_class = FixedEnsembleRun if group.control is None else AdaptiveEnsembleRun
            run = run_class(group_record, ProgressCounter(report_n_finished))
            (run.run_on_compiled_engine if engine == "compiled" else run.run_on_array_engine)()

        group = group_record.group
        calls_python = group.events is not None and group.events.calls_python
        is_worthwhile = not calls_python and is_worth_compiling(group.member, group.method)
        prefers_compiled = self.engine == "auto" and is_worthwhile
        if self.engine == "compiled" or prefers_compiled:
            try:
                run_with_engine("compiled")
            except UnsupportedPrimitive as error:
                if self.engine == "compiled":
                    raise
                warn_of_fallback(error)
            else:
                return
        run_with_engine("array")


def _checked_initial_states(family: Family, x0s, n_attitudes: int) -> tuple[np.ndarray, Mapping[int, str]]:
    """Return the initial states of all trajectories, shape (B, n), and the reasons why some cannot start.

    Raises
    ------
    InputError
        If no trajectory can start.
    """
    if len(family.refusal_reasons) == family.size:
        raise InputError(f"no trajectory can be started; trajectory 0: {family.refusal_reasons[0]}")
    member = family.example
    if member is None:
        member = family.member(next(i for i in range(family.size) if i not in family.refusal_reasons))
    x0s, x0_reasons = _convert_or_replace_initial_states(member, x0s)
    if x0s.ndim > 2:
        raise InputError(f"initial states must have shape (n,) or (trajectories, n), got {x0s.shape}")
    n_trajectories = broadcast_size(len(x0s), family.size, n_attitudes)
    states = np.broadcast_to(x0s, (n_trajectories, x0s.shape[1]))
    if x0_reasons and len(x0s) == 1:
        raise InputError(x0_reasons[0])
    reasons = dict(family.refusal_reasons) | x0_reasons
    if family.size > 1 and family.example is None:
        reasons = family.find_rejection_reasons(lambda i: family.axiom_violation_text(i, states[i]), reasons)
    if len(reasons) == n_trajectories:
        raise InputError(f"no trajectory can be started; trajectory 0: {reasons[0]}")
    return states, reasons


def _reasons_of_unstartable_members(
    family: Family, example_system: System, method: OneStepMethod, initial_states: np.ndarray
) -> dict[int, str]:
    """Return the reasons why the method cannot start some members at their initial states, by member index."""
    reasons = _find_invalid_rows_by_bisection(
        lambda rows: why_not_startable(example_system, method, initial_states[rows]), len(initial_states)
    )
    if not any(family.has_member_axis):
        return reasons
    suspects = {*reasons, *family.members_with_extreme_parameters(), *members_outside_domain(family, initial_states)}
    member_reasons = {i: why_not_startable(family.member(i), method, initial_states[i]) for i in sorted(suspects)}
    return {i: text for i, text in member_reasons.items() if text}


def _find_invalid_rows_by_bisection(error_of_rows: Callable[[slice], str], n_rows: int) -> dict[int, str]:
    """Return the error texts of invalid rows, by row index, found by bisection of the slices that have an error."""
    reasons: dict[int, str] = {}

    def bisect_rows(start: int, stop: int) -> None:
        """Record the errors of the invalid rows from ``start`` up to ``stop``."""
        text = error_of_rows(slice(start, stop))
        if text and stop - start == 1:
            reasons[start] = text
        elif text:
            bisect_rows(start, (start + stop) // 2)
            bisect_rows((start + stop) // 2, stop)

    for batch_start in range(0, n_rows, DOMAIN_CHECK_BATCH_SIZE):
        bisect_rows(batch_start, min(batch_start + DOMAIN_CHECK_BATCH_SIZE, n_rows))
    return reasons


def _convert_or_replace_initial_states(example_system: System, x0s) -> tuple[np.ndarray, dict[int, str]]:
    """Return initial states, shape (trajectories, n), and the errors of the invalid rows of x0s, by row index.

    Invalid rows are replaced by a valid one.
    """
    try:
        return np.atleast_2d(np.asarray(example_system.state_array(x0s, batch=True))), {}
    except (InputError, ValueError):
        rows = np.asarray(x0s)
        if rows.ndim < 2 or rows.dtype.kind not in "fiubc" or not len(rows):
            raise
    reasons = _find_invalid_rows_by_bisection(
        lambda batch: error_message_or_empty(lambda: example_system.state_array(rows[batch], batch=True)), len(rows)
    )
    valid_rows = [i for i in range(len(rows)) if i not in reasons]
    if not valid_rows:
        raise InputError(f"no trajectory can be started; trajectory 0: {reasons[0]}")
    valid_x0s = rows.copy()
    valid_x0s[list(reasons)] = rows[valid_rows[0]]
    return np.asarray(example_system.state_array(valid_x0s, batch=True)), reasons
