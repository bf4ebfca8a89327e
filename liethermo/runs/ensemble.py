"""Many trajectories at once: initial states and parameters broadcast, one status for each."""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Mapping
from typing import Any, Literal, NamedTuple

import numpy as np

from manifolds._precision import with_library_settings

from ..engines.choice import is_worth_compiling, warn_of_fallback
from ..engines.codes import StatusCode
from ..errors import InputError
from ..integrators import DEFAULT_METHOD, OneStepMethod
from ..integrators.fluctuating import noise_dimension
from ..results.ensemble import Ensemble, Subset, join_subsets
from ..systems import System
from ..tracing.scalarize import UnsupportedPrimitive
from .adaptive import Adaptive, make_step_control
from .batches import MAX_THREADS, ProgressCounter, replay_array, replay_compiled, run_fixed_array, run_fixed_compiled
from .events import Event, Relaxed
from .family import Family, broadcast_size, error_message_of
from .fluctuations import DEFAULT_NOISE_METHOD, Fluctuations, NoisePaths, check_noise
from .member_groups import common_inertia, group_members, members_outside_domain
from .paced import AdaptiveEnsembleRun
from .preparation import (
    check_choice,
    initial_state,
    limit_family_to_span,
    limit_to_span,
    prepare_run,
    promised_laws,
    refuse_tracers,
    resolve_invariants,
    why_not_startable,
    wrap_family,
)
from .presented import run_provenance
from .progress import Progress
from .record import EnsembleEvidenceCollector, EnsembleRecord, MemberSolutionBuilder
from .timetable import StepSchedule, make_schedule

__all__ = ["MAX_THREADS", "Ensemble", "ensemble"]

DOMAIN_CHECK_BATCH_SIZE = 8192
"""States that are looked at together, at most: bounded memory."""

MAX_REPLAYED_STEPS = 256
"""Steps that an audit takes again of a trajectory by the array engine, whose steps are slow."""


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
    until: Relaxed | Callable | None = None,
    engine: Literal["auto", "array", "compiled"] = "auto",
    attitude=None,
    progress: bool | None = None,
    noise: Fluctuations | None = None,
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
        ``e.event_time``.
    parameters : optional
        One set for each trajectory, in the units of the system: arrays whose first axis is that of the trajectories.
        For a function, its argument (an array, a dict of arrays, …). For a system, a dict from the names of its
        parameters, such as ``{"dissipation.rate": rates}``, to their values.
    outputs : {"final", "trajectory", "summary"}
        Final states; every ``save_every``-th state, or those at ``save_at``; or no states, which saves memory. By
        default final states, or trajectories with ``save_at``.
    engine : {"auto", "array", "compiled"}
        SIMD lanes over all cores for small systems ("compiled"), or ``vmap`` for any ("array"). "auto" compiles what
        can be compiled, unless JAX has an accelerator.
    attitude : array, shape (m, m) or (B, m, m), optional
        As for :func:`integrate` (dimensionless); one for all, or one each.
    progress : bool, optional
        Show a progress bar; by default where the standard error is a terminal.
    noise : Fluctuations, optional
        As for :func:`integrate`. Every trajectory has noise of its own, by its number and the times of its steps.

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
    >>> many = lt.ensemble(lt.models.rigid_body(rate=0.2), starts, (0.0, 5.0), 0.05, outputs="summary")
    >>> many.energy.shape, bool(many.ok.all())
    ((100,), True)
    """
    started = time.perf_counter()
    method = (DEFAULT_METHOD if noise is None else DEFAULT_NOISE_METHOD) if method is None else method
    if not isinstance(method, OneStepMethod):
        raise InputError(f"the method must be an integrator such as lt.MetriplecticGauss(), not {method!r}")
    outputs = outputs or ("final" if save_at is None else "trajectory")
    check_choice("outputs", outputs, ("final", "trajectory", "summary"))
    check_choice("engine", engine, ("auto", "array", "compiled"))
    if save_at is not None and outputs != "trajectory":
        raise InputError(f'save_at is for outputs="trajectory", not {outputs!r}')
    own_ends = isinstance(step, Adaptive) or until is not None
    if own_ends and outputs == "trajectory" and save_at is None:
        raise InputError(
            "trajectories with adaptive steps or events are kept at times that all have in common: give save_at"
        )
    if own_ends and noise is not None:
        raise InputError("steps with noise are of one size, and nothing is known of a path between them: give a step")
    course = make_schedule(t_span, step, save_every if outputs == "trajectory" and save_at is None else None, save_at)

    family = Family.from_arguments(system, parameters)
    states, reasons = _checked_initial_states(family, x0s, len(attitude) if np.ndim(attitude) == 3 else 1)
    check_noise(noise, len(states))
    size = len(states)
    run = np.arange(size)
    if reasons:
        run = np.setdiff1d(run, list(reasons))
        family, states = family.select(run), states[run]
    plan = _EnsembleOptions(method, step, course, outputs, engine, until, noise)
    described = run_provenance(
        family.representative,
        method,
        step if isinstance(step, Adaptive) else course.h,
        (course.start, course.end),
        course.save_every,
    )
    inertia = common_inertia(family)
    described["inertia"] = None if inertia is None else inertia.tolist()
    groups, refused = group_members(family, method, states)
    reasons = dict(reasons) | {int(run[i]): text for i, text in refused.items()}
    parts: list[Subset] = []
    with Progress((0, len(run)), progress, "{:.0f} trajectories") as bar:
        for places, group in groups:
            own = np.asarray(attitude)[run[places]] if np.ndim(attitude) == 3 and len(attitude) > 1 else attitude
            done = sum(len(part.trajectory_numbers) for part in parts)
            stopped = any((part.ensemble.status == StatusCode.INTERRUPTED).any() for part in parts)
            tell = functools.partial(_update_progress, bar, done)
            part, why = plan.run_group(group, states[places], run[places], own, tell, stopped)
            parts += [] if part is None else [part]
            reasons |= why
    if not parts:
        raise InputError(f"no trajectory can be started; trajectory {min(reasons)}: {reasons[min(reasons)]}")
    return join_subsets(
        parts,
        size,
        reasons=reasons,
        wall_time=time.perf_counter() - started,
        provenance={**described, "noise": None if noise is None else noise.as_provenance()},
    )


def _update_progress(bar: Progress, done: int, more: float) -> None:
    bar.update(done + more)


class _EnsembleOptions(NamedTuple):
    """What is done with each trajectory: the arguments of :func:`ensemble`."""

    method: OneStepMethod
    step: float | Adaptive
    schedule: StepSchedule
    outputs: str
    engine: str
    until: Any
    noise: Fluctuations | None

    def run_group(
        self,
        family: Family,
        states: np.ndarray,
        run: np.ndarray,
        attitude,
        tell: Callable[[float], None],
        stopped: bool,
    ) -> tuple[Subset | None, dict[int, str]]:
        """Run the members of a group from their initial states; None if none can be started.

        The second result says why trajectories could not be started, or have failed, by their numbers.

        Parameters
        ----------
        states : array, shape (B, n)
        run : array of int, shape (B,)
            The numbers of the trajectories in the ensemble.
        attitude : array, shape (m, m) or (B, m, m), or None
        tell : function
            Called with the number of trajectories that are done.
        stopped : bool
            Whether the user has interrupted the ensemble before: no step is taken then.
        """
        step, course, noise = self.step, self.schedule, self.noise
        member = resolve_invariants(family.member(0), states)
        tolerance = step.tolerance if isinstance(step, Adaptive) else None
        member, method = prepare_run(member, self.method, noise, tolerance)
        family = wrap_family(family, member)
        states = np.asarray(initial_state(member, states, course.start, attitude, batch=True))
        method.check(member)
        span = course.start, course.end
        family, member = limit_family_to_span(family, member, *span), limit_to_span(member, *span)
        reasons = {int(run[i]): text for i, text in _unstartable_members(family, member, method, states).items()}
        if reasons:
            left = np.flatnonzero(~np.isin(run, list(reasons)))
            run, family, states = run[left], family.select(left), states[left]
            if not len(run):
                return None, reasons
        paths = (
            None
            if noise is None or not noise_dimension(method)
            else NoisePaths(noise, noise_dimension(method), run, course)
        )
        record = EnsembleRecord(
            family, member, states, course, self.outputs, np.nan if tolerance is not None else course.h
        )
        event = None if self.until is None else Event(self.until, member)
        own_ends = tolerance is not None or event is not None
        pacing = make_step_control(step, method, course.end - course.start, event) if own_ends else None

        def run_with_engine(engine: str, tally: ProgressCounter) -> None:
            if stopped:
                return
            if pacing is not None:
                many = AdaptiveEnsembleRun(family, method, pacing, record, tally)
                (many.run_compiled if engine == "compiled" else many.run_array)()
            else:
                (run_fixed_compiled if engine == "compiled" else run_fixed_array)(family, method, record, tally, paths)

        small = self.engine == "auto" and is_worth_compiling(member)
        chosen = "compiled" if self.engine == "compiled" or small else "array"
        if chosen == "compiled":
            try:
                run_with_engine(chosen, ProgressCounter(tell))
            except UnsupportedPrimitive as error:
                if self.engine == "compiled":
                    raise
                warn_of_fallback(error)
                chosen = "array"
        if chosen == "array":
            run_with_engine(chosen, ProgressCounter(tell))
        record.set_unfinished_to_nan()
        again, most = (replay_compiled, course.n_steps) if chosen == "compiled" else (replay_array, MAX_REPLAYED_STEPS)
        equal = 1 if tolerance is not None else min(course.segments[0].n_full_steps, most)
        found = record.to_ensemble(
            reasons={},
            laws=promised_laws(member, method, {}),
            engine=chosen,
            wall_time=0.0,
            evidence_source=None
            if noise_dimension(method)
            else EnsembleEvidenceCollector(record, method, again, equal),
            solution_builder=MemberSolutionBuilder(record, method, run),
        )
        return Subset(run, found), reasons | {int(run[j]): text for j, text in record.failure_reasons.items()}


def _checked_initial_states(family: Family, x0s, attitudes: int) -> tuple[np.ndarray, Mapping[int, str]]:
    """An initial state for each trajectory, and which of them cannot be started, and why.

    Raises
    ------
    InputError
        If none can.
    """
    member = family.example
    if member is None:
        member = family.member(next(i for i in range(family.size) if i not in family.refusal_reasons))
    x0s, bad = _convert_initial_states(member, x0s)
    if x0s.ndim > 2:
        raise InputError(f"initial states have shape (n,) or (trajectories, n), not {x0s.shape}")
    size = broadcast_size(len(x0s), family.size, attitudes)
    states = np.broadcast_to(x0s, (size, x0s.shape[1]))
    if bad and len(x0s) == 1:
        raise InputError(bad[0])
    reasons = dict(family.refusal_reasons) | bad
    if family.size > 1 and family.example is None:
        reasons = family.rejected_members(lambda i: family.axiom_violation(i, states[i]), reasons)
    if len(reasons) == size:
        raise InputError(f"no trajectory can be started; trajectory 0: {reasons[0]}")
    return states, reasons


def _unstartable_members(family: Family, member: System, method: OneStepMethod, states: np.ndarray) -> dict[int, str]:
    """The trajectories, as they are run, whose first states the method cannot start at, and why."""
    reasons = _bisect_invalid_rows(lambda part: why_not_startable(member, method, states[part]), len(states))
    if not any(family.has_member_axis):
        return reasons
    suspects = {*reasons, *family.extreme_members(), *members_outside_domain(family, states)}
    own = {i: why_not_startable(family.member(i), method, states[i]) for i in sorted(suspects)}
    return {i: text for i, text in own.items() if text}


def _bisect_invalid_rows(complaint: Callable[[slice], str], size: int) -> dict[int, str]:
    """Which of so many rows there is a complaint of, and which one: halves, as far as there is something to find."""
    found: dict[int, str] = {}

    def search_rows(first: int, last: int) -> None:
        text = complaint(slice(first, last))
        if text and last - first == 1:
            found[first] = text
        elif text:
            search_rows(first, (first + last) // 2)
            search_rows((first + last) // 2, last)

    for first in range(0, size, DOMAIN_CHECK_BATCH_SIZE):
        search_rows(first, min(first + DOMAIN_CHECK_BATCH_SIZE, size))
    return found


def _convert_initial_states(member: System, x0s) -> tuple[np.ndarray, dict[int, str]]:
    """Initial states, shape (trajectories, n), and those among them that are none, and why."""
    try:
        return np.atleast_2d(np.asarray(member.numbers(x0s, batch=True))), {}
    except (InputError, ValueError):
        rows = np.asarray(x0s)
        if rows.ndim < 2 or rows.dtype.kind not in "fiubc" or not len(rows):
            raise
    bad = _bisect_invalid_rows(lambda part: error_message_of(lambda: member.numbers(rows[part], batch=True)), len(rows))
    good = [i for i in range(len(rows)) if i not in bad]
    if not good:
        raise InputError(f"no trajectory can be started; trajectory 0: {bad[0]}")
    filled = rows.copy()
    filled[list(bad)] = rows[good[0]]
    return np.asarray(member.numbers(filled, batch=True)), bad
