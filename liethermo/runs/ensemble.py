"""Many trajectories at once: initial states and parameters broadcast, one status for each."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any, Literal

import numpy as np

from manifolds._precision import by_own_settings

from ..engines.choice import is_small, warn_of_fallback
from ..errors import InputError
from ..integrators import DEFAULT_METHOD, OneStepMethod
from ..integrators.fluctuating import noise_dimension
from ..results.ensemble import Ensemble
from ..systems import System
from ..tracing.scalarize import UnsupportedPrimitive
from .adaptive import Adaptive, pacing_of
from .batches import THREADS, Tally, follow_array, follow_compiled, run_array, run_compiled
from .events import Event, Relaxed
from .family import Family, common_size, why_not
from .fluctuations import DEFAULT_WITH_NOISE, Fluctuations, Paths, check_noise
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
    within_span,
)
from .presented import provenance_of
from .progress import Progress
from .record import Alone, Followed, Record
from .timetable import course_of

__all__ = ["THREADS", "Ensemble", "ensemble"]

LOOKED_AT = 8192
"""States that are looked at together, at most: bounded memory."""

FOLLOWED = 256
"""Steps that an audit takes again of a trajectory by the array engine, whose steps are slow."""


@by_own_settings
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
        As for :func:`integrate`. Every trajectory has noise of its own, which depends on its number alone.

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
    given = member = decided(family.representative, states)
    one_body = _same_inertia(family, member)
    member, method = as_run(member, method, noise, step.tolerance if isinstance(step, Adaptive) else None)
    attitude = np.asarray(attitude)[run] if np.ndim(attitude) == 3 and len(attitude) > 1 else attitude
    family, states = as_family(family, member), np.asarray(begun(member, states, course.start, attitude, batch=True))
    method.check(member)
    span = course.start, course.end
    family, member = family_within_span(family, member, *span), within_span(member, *span)
    if off := _off(family, member, method, states):
        reasons = dict(reasons) | {int(run[i]): text for i, text in off.items()}
        if len(off) == len(run):
            raise InputError(f"no trajectory can be started; trajectory {min(reasons)}: {reasons[min(reasons)]}")
        kept = np.setdiff1d(np.arange(len(run)), list(off))
        run, family, states = run[kept], family.select(kept), states[kept]
    paths = None if noise is None or not noise_dimension(method) else Paths(noise, noise_dimension(method), run)
    record = Record(family, member, states, course, outputs, np.nan if isinstance(step, Adaptive) else course.h)
    event = None if until is None else Event(until, member)
    pacing = pacing_of(step, method, course.end - course.start, event) if own_ends else None

    def take(engine: str, tally: Tally) -> None:
        if pacing is not None:
            many = Many(family, method, pacing, record, tally)
            (many.run_compiled if engine == "compiled" else many.run_array)()
        else:
            (run_compiled if engine == "compiled" else run_array)(family, method, record, tally, paths)

    small = engine == "auto" and is_small(member)
    chosen = "compiled" if engine == "compiled" or small else "array"
    with Progress((0, len(run)), progress, "{:.0f} trajectories") as bar:
        if chosen == "compiled":
            try:
                take(chosen, Tally(bar.update))
            except UnsupportedPrimitive as error:
                if engine == "compiled":
                    raise
                warn_of_fallback(error)
                chosen = "array"
        if chosen == "array":
            take(chosen, Tally(bar.update))
    record.close()
    reasons = dict(reasons) | {int(run[j]): text for j, text in record.reasons.items()}
    again, most = (follow_compiled, course.steps) if chosen == "compiled" else (follow_array, FOLLOWED)
    followed = Followed(record, method, again, 1 if isinstance(step, Adaptive) else min(course.parts[0].full, most))
    return record.result(
        run,
        size,
        reasons=reasons,
        laws=laws_of(member, method, {}),
        engine=chosen,
        wall_time=time.perf_counter() - started,
        provenance={
            **provenance_of(
                given,
                method,
                step if isinstance(step, Adaptive) else course.h,
                (course.start, course.end),
                course.every,
            ),
            **({} if one_body else {"inertia": None}),
            "engine": chosen,
            "noise": None if noise is None else noise.listed(),
        },
        witness=None if noise_dimension(method) else followed,
        alone=Alone(record, method, run),
    )


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
    found = _by_halves(lambda part: no_start(member, method, states[part]), len(states))
    if family.size == 1:
        return found
    own = {i: no_start(family.member(i), method, states[i]) for i in {*found, *family.extremes()}}
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


def _same_inertia(family: Family, member: System) -> bool:
    """Whether all members have the inertia of this one, by those with the smallest and largest parameters."""
    inertia = member.inertia
    if inertia is None or family.alike is not None:
        return True
    others = (family.member(i).inertia for i in family.extremes())
    return all(other is not None and np.array_equal(other, inertia) for other in others)


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
