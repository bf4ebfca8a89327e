"""Many trajectories at once: initial states and parameters broadcast, one status for each."""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Mapping
from typing import Any, Literal, NamedTuple

import numpy as np

from manifolds._precision import by_own_settings

from ..engines.choice import is_small, warn_of_fallback
from ..engines.codes import Code
from ..errors import InputError
from ..integrators import DEFAULT_METHOD, OneStepMethod
from ..integrators.fluctuating import noise_dimension
from ..results.ensemble import Ensemble, Subset, join_subsets
from ..systems import System
from ..tracing.scalarize import UnsupportedPrimitive
from .adaptive import Adaptive, pacing_of
from .batches import THREADS, Tally, follow_array, follow_compiled, run_array, run_compiled
from .events import Event, Relaxed
from .family import Family, common_size, why_not
from .fluctuations import DEFAULT_WITH_NOISE, Fluctuations, Paths, check_noise
from .member_groups import common_inertia, groups_of, outside_own_domain
from .paced import Many
from .preparation import (
    as_family,
    as_run,
    begun,
    check_choice,
    decided,
    family_within_span,
    laws_of,
    no_start,
    refuse_tracers,
    within_span,
)
from .presented import provenance_of
from .progress import Progress
from .record import Alone, Followed, Record
from .timetable import Course, course_of

__all__ = ["THREADS", "Ensemble", "ensemble"]

LOOKED_AT = 8192
"""States that are looked at together, at most: bounded memory."""

FOLLOWED = 256
"""Steps that an audit takes again of a trajectory by the array engine, whose steps are slow."""


@by_own_settings
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
    method = (DEFAULT_METHOD if noise is None else DEFAULT_WITH_NOISE) if method is None else method
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
    course = course_of(t_span, step, save_every if outputs == "trajectory" and save_at is None else None, save_at)

    family = Family.of(system, parameters)
    states, reasons = _admitted(family, x0s, len(attitude) if np.ndim(attitude) == 3 else 1)
    check_noise(noise, len(states))
    size = len(states)
    run = np.arange(size)
    if reasons:
        run = np.setdiff1d(run, list(reasons))
        family, states = family.select(run), states[run]
    plan = _Plan(method, step, course, outputs, engine, until, noise)
    described = provenance_of(
        family.representative,
        method,
        step if isinstance(step, Adaptive) else course.h,
        (course.start, course.end),
        course.every,
    )
    inertia = common_inertia(family)
    described["inertia"] = None if inertia is None else inertia.tolist()
    groups, refused = groups_of(family, method, states)
    reasons = dict(reasons) | {int(run[i]): text for i, text in refused.items()}
    parts: list[Subset] = []
    with Progress((0, len(run)), progress, "{:.0f} trajectories") as bar:
        for places, group in groups:
            own = np.asarray(attitude)[run[places]] if np.ndim(attitude) == 3 and len(attitude) > 1 else attitude
            done = sum(len(part.run) for part in parts)
            stopped = any((part.ensemble.status == Code.INTERRUPTED).any() for part in parts)
            tell = functools.partial(_advance, bar, done)
            part, why = plan.run(group, states[places], run[places], own, tell, stopped)
            parts += [] if part is None else [part]
            reasons |= why
    if not parts:
        raise InputError(f"no trajectory can be started; trajectory {min(reasons)}: {reasons[min(reasons)]}")
    return join_subsets(
        parts,
        size,
        reasons=reasons,
        wall_time=time.perf_counter() - started,
        provenance={**described, "noise": None if noise is None else noise.listed()},
    )


def _advance(bar: Progress, done: int, more: float) -> None:
    bar.update(done + more)


class _Plan(NamedTuple):
    """What is done with each trajectory: the arguments of :func:`ensemble`."""

    method: OneStepMethod
    step: float | Adaptive
    course: Course
    outputs: str
    engine: str
    until: Any
    noise: Fluctuations | None

    def run(
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
        step, course, noise = self.step, self.course, self.noise
        member = decided(family.member(0), states)
        tolerance = step.tolerance if isinstance(step, Adaptive) else None
        member, method = as_run(member, self.method, noise, tolerance)
        family = as_family(family, member)
        states = np.asarray(begun(member, states, course.start, attitude, batch=True))
        method.check(member)
        span = course.start, course.end
        family, member = family_within_span(family, member, *span), within_span(member, *span)
        reasons = {int(run[i]): text for i, text in _off(family, member, method, states).items()}
        if reasons:
            left = np.flatnonzero(~np.isin(run, list(reasons)))
            run, family, states = run[left], family.select(left), states[left]
            if not len(run):
                return None, reasons
        paths = (
            None if noise is None or not noise_dimension(method) else Paths(noise, noise_dimension(method), run, course)
        )
        record = Record(family, member, states, course, self.outputs, np.nan if tolerance is not None else course.h)
        event = None if self.until is None else Event(self.until, member)
        own_ends = tolerance is not None or event is not None
        pacing = pacing_of(step, method, course.end - course.start, event) if own_ends else None

        def take(engine: str, tally: Tally) -> None:
            if stopped:
                return
            if pacing is not None:
                many = Many(family, method, pacing, record, tally)
                (many.run_compiled if engine == "compiled" else many.run_array)()
            else:
                (run_compiled if engine == "compiled" else run_array)(family, method, record, tally, paths)

        small = self.engine == "auto" and is_small(member)
        chosen = "compiled" if self.engine == "compiled" or small else "array"
        if chosen == "compiled":
            try:
                take(chosen, Tally(tell))
            except UnsupportedPrimitive as error:
                if self.engine == "compiled":
                    raise
                warn_of_fallback(error)
                chosen = "array"
        if chosen == "array":
            take(chosen, Tally(tell))
        record.close()
        again, most = (follow_compiled, course.steps) if chosen == "compiled" else (follow_array, FOLLOWED)
        equal = 1 if tolerance is not None else min(course.parts[0].full, most)
        found = record.result(
            reasons={},
            laws=laws_of(member, method, {}),
            engine=chosen,
            wall_time=0.0,
            witness=None if noise_dimension(method) else Followed(record, method, again, equal),
            alone=Alone(record, method, run),
        )
        return Subset(run, found), reasons | {int(run[j]): text for j, text in record.reasons.items()}


def _admitted(family: Family, x0s, attitudes: int) -> tuple[np.ndarray, Mapping[int, str]]:
    """An initial state for each trajectory, and which of them cannot be started, and why.

    Raises
    ------
    InputError
        If none can.
    """
    member = family.example
    if member is None:
        member = family.member(next(i for i in range(family.size) if i not in family.refused))
    x0s, bad = _states(member, x0s)
    if x0s.ndim > 2:
        raise InputError(f"initial states have shape (n,) or (trajectories, n), not {x0s.shape}")
    size = common_size(len(x0s), family.size, attitudes)
    states = np.broadcast_to(x0s, (size, x0s.shape[1]))
    if bad and len(x0s) == 1:
        raise InputError(bad[0])
    reasons = dict(family.refused) | bad
    if family.size > 1 and family.example is None:
        reasons = family.found_wanting(lambda i: family.complaint(i, states[i]), reasons)
    if len(reasons) == size:
        raise InputError(f"no trajectory can be started; trajectory 0: {reasons[0]}")
    return states, reasons


def _off(family: Family, member: System, method: OneStepMethod, states: np.ndarray) -> dict[int, str]:
    """The trajectories, as they are run, whose first states the method cannot start at, and why."""
    reasons = _by_halves(lambda part: no_start(member, method, states[part]), len(states))
    if not any(family.varying):
        return reasons
    suspects = {*reasons, *family.extremes(), *outside_own_domain(family, states)}
    own = {i: no_start(family.member(i), method, states[i]) for i in sorted(suspects)}
    return {i: text for i, text in own.items() if text}


def _by_halves(complaint: Callable[[slice], str], size: int) -> dict[int, str]:
    """Which of so many rows there is a complaint of, and which one: halves, as far as there is something to find."""
    found: dict[int, str] = {}

    def look(first: int, last: int) -> None:
        text = complaint(slice(first, last))
        if text and last - first == 1:
            found[first] = text
        elif text:
            look(first, (first + last) // 2)
            look((first + last) // 2, last)

    for first in range(0, size, LOOKED_AT):
        look(first, min(first + LOOKED_AT, size))
    return found


def _states(member: System, x0s) -> tuple[np.ndarray, dict[int, str]]:
    """Initial states, shape (trajectories, n), and those among them that are none, and why."""
    try:
        return np.atleast_2d(np.asarray(member.numbers(x0s, batch=True))), {}
    except (InputError, ValueError):
        rows = np.asarray(x0s)
        if rows.ndim < 2 or rows.dtype.kind not in "fiubc" or not len(rows):
            raise
    bad = _by_halves(lambda part: why_not(lambda: member.numbers(rows[part], batch=True)), len(rows))
    good = [i for i in range(len(rows)) if i not in bad]
    if not good:
        raise InputError(f"no trajectory can be started; trajectory 0: {bad[0]}")
    filled = rows.copy()
    filled[list(bad)] = rows[good[0]]
    return np.asarray(member.numbers(filled, batch=True)), bad
