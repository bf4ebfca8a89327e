"""Relations between equivalent runs: in parts, by other engines, in an ensemble or a study, by SciPy and diffrax."""

from __future__ import annotations

import gc
import importlib.util
import itertools
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from ..engines.select_engine import is_worth_compiling
from ..errors import InputError
from ..integrators import MetriplecticMidpoint
from ..integrators.base import has_error_estimate
from ..interop.scipy import solve_ivp
from ..results.files import load
from ..results.solution import Solution
from ..runs.adaptive import Adaptive
from ..runs.ensemble import Ensemble, ensemble
from ..runs.named_parameters import named_parameters
from ..runs.noise import Fluctuations
from ..studies.axes import replicas
from ..studies.study import Study
from ..tracing.scalarize import UnsupportedPrimitive
from .relation_case import RelationCase, SkipReason, nearby_state


def check_split_span(case: RelationCase) -> SkipReason:
    """Check that a split time span, or fewer saved states, do not change the final state."""
    sparse_run = case.run(save_every=5)
    case.compare_states("every fifth state kept", sparse_run.x[-1], case.base_run.x[-1], 0.0)
    ends = cut_times(case)
    if not ends:
        return "there are too few steps"
    tolerance = case.resolution_tolerance if isinstance(case.step, Adaptive) else case.rounding_tolerance
    last_segment = run_in_parts(case, ends)
    case.compare_states(f"in {len(ends) + 1} parts", last_segment.x[-1], case.base_run.x[-1], tolerance)
    if last_segment.attitude is not None and case.base_run.attitude is not None:
        case.suite.check_equal(
            f"{case.name}: their attitude", last_segment.attitude[-1], case.base_run.attitude[-1], tolerance
        )
    return None


def cut_times(case: RelationCase) -> list[float]:
    """Return the times at which a run is split: ends of steps near an eighth and a half of it."""
    count = len(case.base_run.t) - 1
    return [float(case.base_run.t[i]) for i in sorted({count // 8, count // 2}) if 0 < i < count]


def run_in_parts(case: RelationCase, ends: list[float], **options) -> Solution:
    """Return the last segment of a split run; each segment starts from the final state and attitude of the previous
    one."""
    run: Solution | None = None
    attitude: dict[str, Any] = {}
    for span in itertools.pairwise([0.0, *ends, case.time]):
        run = case.run(x0=case.x0 if run is None else run.x[-1], span=span, **attitude, **options)
        attitude = {} if run.attitude is None else {"attitude": run.attitude[-1]}
    assert run is not None
    return run


def check_split_noise(case: RelationCase) -> SkipReason:
    """Check that a split run with noise equals the unsplit one, to the bit if nothing depends on time, and that noise
    differs at other times."""
    if isinstance(case.step, Adaptive) or not isinstance(case.method, MetriplecticMidpoint):
        return "steps with noise are those of MetriplecticMidpoint, of one size"
    ends = cut_times(case)
    if not ends:
        return "there are too few steps"
    loses_energy = any(part.energy_law != "conserved" for part in case.system.total_dissipation.terms)
    noise = Fluctuations(NOISE_BOLTZMANN, seed=case.seed, temperature=1.0 if loses_energy else None)
    try:
        unsplit_run = case.run(noise=noise)
    except InputError as error:
        return str(error)
    if not unsplit_run.status.ok:
        return f"the run with noise ends: {unsplit_run.status.message}"
    last_segment = run_in_parts(case, ends, noise=noise)
    tail = unsplit_run.x[-len(last_segment.x) :]
    case.compare_states("in parts", last_segment.x, tail, case.rounding_tolerance if case.system.is_driven else 0.0)
    later_run = case.run(x0=case.x0, span=(case.time, 2.0 * case.time), noise=noise)
    has_other_noise = not np.array_equal(later_run.x[-1], unsplit_run.x[-1])
    case.suite.check_true(f"{case.name}: another time has other noise", has_other_noise)
    return None


NOISE_BOLTZMANN = 1e-6
"""Boltzmann constant of the runs with noise, in the units of the entropy."""


def check_engines(case: RelationCase) -> SkipReason:
    """Check that all engines take equal steps."""
    case.compare_run("array engine", case.run(engine="array"))
    if not is_worth_compiling(case.system, case.method):
        return None
    try:
        case.compare_run("compiled engine", case.run(engine="compiled"))
    except UnsupportedPrimitive as error:
        case.suite.skip_check(f"{case.name}: compiled engine", str(error)[:60])
    return None


def check_ensemble(case: RelationCase) -> SkipReason:
    """Check that a trajectory in an ensemble equals the single run."""
    starts = np.stack([nearby_state(case).ravel(), case.x0.ravel(), nearby_state(case).ravel()])
    ensemble_run = ensemble(case.system, starts, (0.0, case.time), case.step, case.method, progress=False)
    assert ensemble_run.x is not None
    case.compare_states("among three", ensemble_run.x[1], case.base_run.x[-1].ravel(), case.rounding_tolerance)
    return None


def check_family_members(case: RelationCase) -> SkipReason:
    """Check that the parameters and order of other members do not change a member of a family, to the bit.

    The other members have the parameters of the system made equal, partly zero, and of opposite sign.
    """
    names = {name: value for name, value in named_parameters(case.system).items() if value.size}
    if not names:
        return "the system has no parameters"
    rows = {name: np.stack([value, *degenerate_parameters(value)]) for name, value in names.items()}
    (name, value), *_ = names.items()
    entry = (0,) * value.ndim
    path = name + "".join(f"[{i}]" for i in entry)
    values = np.unique([value[entry], 0.0, -value[entry], 2.0 * value[entry] + 1.0])
    base_index = int(np.flatnonzero(values == value[entry])[0])
    span = (0.0, case.time)

    def final_state_in_family(order: list[int]) -> np.ndarray:
        members = {name: row[order] for name, row in rows.items()}
        family_run = ensemble(case.system, case.x0, span, case.step, case.method, parameters=members, progress=False)
        return final_state(family_run, order.index(0))

    def final_state_in_study(order: np.ndarray) -> np.ndarray:
        points = {path: values[order]}
        study = Study(
            case.system, points, x0=case.x0, t_span=span, step=case.step, method=case.method, measure={"x": "final"}
        )
        study.run(progress=False)
        return study.results.x.values[int(np.flatnonzero(order == base_index)[0])]

    single_run = ensemble(case.system, case.x0[None], span, case.step, case.method, progress=False)
    case.compare_states(
        "in company", final_state_in_family([0, 1, 2, 3]), final_state(single_run, 0), case.rounding_tolerance
    )
    reference_state = final_state_in_family([0, 1, 2, 3])
    for order in ([1, 2, 3, 0], [3, 1, 0, 2], [2, 0]):
        case.compare_states(f"in the order {order}", final_state_in_family(order), reference_state, 0.0)
    forwards = np.arange(len(values))
    reference_state = final_state_in_study(forwards)
    case.compare_states("in a study", reference_state, final_state(single_run, 0), case.rounding_tolerance)
    case.compare_states("in a study backwards", final_state_in_study(forwards[::-1]), reference_state, 0.0)
    return None


def degenerate_parameters(value: np.ndarray) -> list[np.ndarray]:
    """Return parameters that are more symmetric, partly zero, and of opposite sign."""
    square = value.ndim == 2 and value.shape[0] == value.shape[1]
    symmetric = np.eye(len(value)) * np.trace(value) / len(value) if square else np.full_like(value, value.mean())
    zeros = np.where(np.arange(value.size).reshape(value.shape) % 2 == 0, 0.0, value)
    return [symmetric, zeros, -value]


def final_state(result: Ensemble, i: int) -> np.ndarray:
    """Return the final state of one trajectory of an ensemble, shape (n,); zeros if it was not started."""
    assert result.x is not None
    return np.nan_to_num(result.x[i]).ravel()


def check_study(case: RelationCase) -> SkipReason:
    """Check that a point of a study equals a run, and that its values remain after the study is deleted."""
    study = Study(
        case.system,
        {"replica": replicas(np.stack([nearby_state(case).ravel(), case.x0.ravel()]))},
        t_span=(0.0, case.time),
        step=case.step,
        method=case.method,
        measure={"final": "final"},
    )
    study.run(progress=False)
    results = study.results
    del study
    gc.collect()
    case.compare_states(
        "a point, of a study that is gone",
        results.final.values[1],
        case.base_run.x[-1].ravel(),
        case.rounding_tolerance,
    )
    return None


def check_saved_run(case: RelationCase) -> SkipReason:
    """Check that a loaded run equals the saved one, and that both can be continued alike."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "run.nc"
        case.base_run.save(path)
        loaded = load(path)
    assert isinstance(loaded, Solution)
    is_identical = np.array_equal(loaded.x, case.base_run.x) and np.array_equal(loaded.t, case.base_run.t)
    case.suite.check_true(f"{case.name}: loaded to the bit", is_identical and loaded.status == case.base_run.status)
    has_same_audit = str(loaded.audit()) == str(case.base_run.audit())
    case.suite.check_true(f"{case.name}: the audit is that of the run", has_same_audit)
    if ends := cut_times(case)[-1:]:
        middle = int(np.searchsorted(loaded.t, ends[0]))
        continued_runs = [
            case.run(
                x0=run.x[middle],
                span=(run.t[middle], case.time),
                **({} if run.attitude is None else {"attitude": run.attitude[middle]}),
            )
            for run in (case.base_run, loaded)
        ]
        case.suite.check_true(
            f"{case.name}: goes on to the bit", np.array_equal(continued_runs[0].x, continued_runs[1].x)
        )
    return None


def check_solve_ivp_matches_integrate(case: RelationCase) -> SkipReason:
    """Check that ``solve_ivp`` takes the steps of ``integrate``, and finds the event that ``until`` finds."""
    if case.system.sites or case.system.space is not None:
        return "SciPy's states are vectors"
    if not has_error_estimate(case.method):
        return "the method has no estimate of its error"
    step = case.step if isinstance(case.step, Adaptive) else Adaptive(1e-8)

    def run_solve_ivp(**options):
        span = (0.0, case.time)
        return solve_ivp(case.system, span, case.x0, case.method, rtol=step.rtol, atol=step.atol, **options)

    own_run = case.run(step=step)
    case.compare_states("solve_ivp", run_solve_ivp().y[:, -1], own_run.x[-1], case.rounding_tolerance)
    i = int(np.argmax(np.abs(own_run.x[-1] - own_run.x[0])))
    crossing = _LevelCrossing(i, float(0.5 * (own_run.x[0, i] + own_run.x[-1, i])))
    if crossing.level == own_run.x[0, i]:
        return None
    event_run = case.run(step=step, until=lambda x: x[i] - crossing.level)
    peer_result = run_solve_ivp(events=crossing)
    both_found = peer_result.status == 1 and event_run.event_time is not None
    case.suite.check_true(f"{case.name}: both find the event", both_found, peer_result.message)
    if both_found:
        assert peer_result.t_events is not None
        assert peer_result.y_events is not None
        time_difference = peer_result.t_events[0][0] - event_run.event_time
        case.suite.check_small(f"{case.name}: when it is", time_difference, case.time, case.rounding_tolerance)
        case.compare_states("where it is", peer_result.y_events[0][0], event_run.x[-1], case.rounding_tolerance)
    return None


class _LevelCrossing:
    """A SciPy event: a component crosses a level."""

    terminal = True

    def __init__(self, component: int, level: float):
        self.component, self.level = component, level

    def __call__(self, t, y):
        return y[self.component] - self.level


def check_diffrax(case: RelationCase) -> SkipReason:
    """Check that diffrax takes the steps of ``integrate``; backwards, those of the negative field."""
    if importlib.util.find_spec("diffrax") is None:
        return "diffrax is not installed"
    if isinstance(case.step, Adaptive) or case.system.is_driven or case.system.space is not None or case.system.sites:
        return "steps of one size on R^n are compared"
    import diffrax as peer

    from ..interop.diffrax import Solver, Term

    term, solver, h = Term(case.system), Solver(case.method), case.step

    def final_state_and_success(start: float, end: float, step: float, x):
        control = peer.ConstantStepSize()
        run = peer.diffeqsolve(
            term, solver, start, end, step, x, stepsize_controller=control, max_steps=100_000, throw=False
        )
        assert run.ys is not None
        return run.ys[-1], bool(run.result == peer.RESULTS.successful)

    x, ok = final_state_and_success(0.0, case.time, h, case.x0)
    case.suite.check_true(f"{case.name}: diffeqsolve succeeds", ok)
    case.compare_states("diffeqsolve", x, case.base_run.x[-1], case.rounding_tolerance)
    x, ok = final_state_and_success(case.time, 0.0, -h, x)
    case.suite.check_true(f"{case.name}: backwards it succeeds", ok)
    case.compare_states("there and back", x, case.x0, 2.0 * case.resolution_tolerance)
    return None
