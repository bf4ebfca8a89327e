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
from .relation_case import RelationCase, SkipReason, state_near_initial_state


def check_run_split_in_time(case: RelationCase) -> SkipReason:
    """Check that the final state does not change if the time span is split, or fewer states are saved."""
    sparse_run = case.run(save_every=5)
    case.compare_states_with_expected("every fifth state kept", sparse_run.x[-1], case.base_run.x[-1], 0.0)
    split_times = times_to_split_run(case)
    if not split_times:
        return "there are too few steps"
    tolerance = case.discretisation_tolerance if isinstance(case.step, Adaptive) else case.rounding_tolerance
    last_segment = last_segment_of_split_run(case, split_times)
    case.compare_states_with_expected(
        f"in {len(split_times) + 1} parts", last_segment.x[-1], case.base_run.x[-1], tolerance
    )
    if last_segment.attitude is not None and case.base_run.attitude is not None:
        case.suite.check_equal(
            f"{case.name}: their attitude", last_segment.attitude[-1], case.base_run.attitude[-1], tolerance
        )
    return None


def times_to_split_run(case: RelationCase) -> list[float]:
    """Return two times at which a run is split, the ends of steps near an eighth and a half of the span."""
    count = len(case.base_run.t) - 1
    return [float(case.base_run.t[i]) for i in sorted({count // 8, count // 2}) if 0 < i < count]


def last_segment_of_split_run(case: RelationCase, split_times: list[float], **options) -> Solution:
    """Integrate in consecutive time segments, each from the final state of the one before; return the last segment."""
    run: Solution | None = None
    attitude: dict[str, Any] = {}
    for span in itertools.pairwise([0.0, *split_times, case.time]):
        run = case.run(x0=case.x0 if run is None else run.x[-1], span=span, **attitude, **options)
        attitude = {} if run.attitude is None else {"attitude": run.attitude[-1]}
    assert run is not None
    return run


def check_noise_of_split_run(case: RelationCase) -> SkipReason:
    """Check that a run with noise equals one that is split in time, and that the noise differs at other times."""
    if isinstance(case.step, Adaptive) or not isinstance(case.method, MetriplecticMidpoint):
        return "steps with noise are those of MetriplecticMidpoint, of one size"
    split_times = times_to_split_run(case)
    if not split_times:
        return "there are too few steps"
    loses_energy = any(term.energy_law != "conserved" for term in case.system.total_dissipation.terms)
    noise = Fluctuations(NOISE_BOLTZMANN, seed=case.seed, temperature=1.0 if loses_energy else None)
    try:
        unsplit_run = case.run(noise=noise)
    except InputError as error:
        return str(error)
    if not unsplit_run.status.ok:
        return f"the run with noise ends: {unsplit_run.status.message}"
    last_segment = last_segment_of_split_run(case, split_times, noise=noise)
    unsplit_states = unsplit_run.x[-len(last_segment.x) :]
    case.compare_states_with_expected(
        "in parts", last_segment.x, unsplit_states, case.rounding_tolerance if case.system.is_driven else 0.0
    )
    later_run = case.run(x0=case.x0, span=(case.time, 2.0 * case.time), noise=noise)
    has_other_noise = not np.array_equal(later_run.x[-1], unsplit_run.x[-1])
    case.suite.check_true(f"{case.name}: another time has other noise", has_other_noise)
    return None


NOISE_BOLTZMANN = 1e-6
"""Boltzmann constant of the runs with noise, in the units of the entropy."""


def check_engines_agree(case: RelationCase) -> SkipReason:
    """Check that the array engine and the compiled engine return equal runs."""
    case.compare_with_base_run("array engine", case.run(engine="array"))
    if not is_worth_compiling(case.system, case.method):
        return None
    try:
        case.compare_with_base_run("compiled engine", case.run(engine="compiled"))
    except UnsupportedPrimitive as error:
        case.suite.skip_check(f"{case.name}: compiled engine", str(error)[:60])
    return None


def check_ensemble_member_equals_run(case: RelationCase) -> SkipReason:
    """Check that a trajectory of an ensemble equals the single run from its initial state."""
    starts = np.stack([state_near_initial_state(case).ravel(), case.x0.ravel(), state_near_initial_state(case).ravel()])
    ensemble_run = ensemble(case.system, starts, (0.0, case.time), case.step, case.method, progress=False)
    assert ensemble_run.x is not None
    case.compare_states_with_expected(
        "among three", ensemble_run.x[1], case.base_run.x[-1].ravel(), case.rounding_tolerance
    )
    return None


def check_member_is_independent_of_others(case: RelationCase) -> SkipReason:
    """Check that a member of an ensemble does not depend on the parameters and the order of the others, to the bit.

    The other members have the parameters of the system made equal, partly zero, and of opposite sign.
    """
    names = {name: value for name, value in named_parameters(case.system).items() if value.size}
    if not names:
        return "the system has no parameters"
    values_of_members = {name: np.stack([value, *special_values_of_parameter(value)]) for name, value in names.items()}
    (name, value), *_ = names.items()
    entry = (0,) * value.ndim
    path = name + "".join(f"[{i}]" for i in entry)
    values = np.unique([value[entry], 0.0, -value[entry], 2.0 * value[entry] + 1.0])
    base_index = int(np.flatnonzero(values == value[entry])[0])
    span = (0.0, case.time)

    def final_state_in_family(order: list[int]) -> np.ndarray:
        members = {name: row[order] for name, row in values_of_members.items()}
        family_run = ensemble(case.system, case.x0, span, case.step, case.method, parameters=members, progress=False)
        return final_state_of_member(family_run, order.index(0))

    def final_state_in_study(order: np.ndarray) -> np.ndarray:
        points = {path: values[order]}
        study = Study(
            case.system, points, x0=case.x0, t_span=span, step=case.step, method=case.method, measure={"x": "final"}
        )
        study.run(progress=False)
        return study.results.x.values[int(np.flatnonzero(order == base_index)[0])]

    single_run = ensemble(case.system, case.x0[None], span, case.step, case.method, progress=False)
    case.compare_states_with_expected(
        "in company", final_state_in_family([0, 1, 2, 3]), final_state_of_member(single_run, 0), case.rounding_tolerance
    )
    reference_state = final_state_in_family([0, 1, 2, 3])
    for order in ([1, 2, 3, 0], [3, 1, 0, 2], [2, 0]):
        case.compare_states_with_expected(f"in the order {order}", final_state_in_family(order), reference_state, 0.0)
    forwards = np.arange(len(values))
    reference_state = final_state_in_study(forwards)
    case.compare_states_with_expected(
        "in a study", reference_state, final_state_of_member(single_run, 0), case.rounding_tolerance
    )
    case.compare_states_with_expected(
        "in a study backwards", final_state_in_study(forwards[::-1]), reference_state, 0.0
    )
    return None


def special_values_of_parameter(value: np.ndarray) -> list[np.ndarray]:
    """Return three special values of a parameter: with equal entries, with zeros, and with the opposite sign."""
    is_square = value.ndim == 2 and value.shape[0] == value.shape[1]
    symmetric = np.eye(len(value)) * np.trace(value) / len(value) if is_square else np.full_like(value, value.mean())
    zeros = np.where(np.arange(value.size).reshape(value.shape) % 2 == 0, 0.0, value)
    return [symmetric, zeros, -value]


def final_state_of_member(ensemble_run: Ensemble, i: int) -> np.ndarray:
    """Return the final state of one trajectory of an ensemble, shape (n,); NaN, as of one not started, becomes 0."""
    assert ensemble_run.x is not None
    return np.nan_to_num(ensemble_run.x[i]).ravel()


def check_study_point_equals_run(case: RelationCase) -> SkipReason:
    """Check that a point of a study equals a single run, and that results remain after the study is deleted."""
    study = Study(
        case.system,
        {"replica": replicas(np.stack([state_near_initial_state(case).ravel(), case.x0.ravel()]))},
        t_span=(0.0, case.time),
        step=case.step,
        method=case.method,
        measure={"final": "final"},
    )
    study.run(progress=False)
    results = study.results
    del study
    gc.collect()
    case.compare_states_with_expected(
        "a point, of a study that is gone",
        results.final.values[1],
        case.base_run.x[-1].ravel(),
        case.rounding_tolerance,
    )
    return None


def check_saved_run_equals_loaded(case: RelationCase) -> SkipReason:
    """Check that a run loaded from a file equals the saved run, and continues to the same state."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "run.nc"
        case.base_run.save(path)
        loaded_run = load(path)
    assert isinstance(loaded_run, Solution)
    is_identical = np.array_equal(loaded_run.x, case.base_run.x) and np.array_equal(loaded_run.t, case.base_run.t)
    case.suite.check_true(f"{case.name}: loaded to the bit", is_identical and loaded_run.status == case.base_run.status)
    has_same_audit = str(loaded_run.audit()) == str(case.base_run.audit())
    case.suite.check_true(f"{case.name}: the audit is that of the run", has_same_audit)
    if ends := times_to_split_run(case)[-1:]:
        split_index = int(np.searchsorted(loaded_run.t, ends[0]))
        continued_runs = [
            case.run(
                x0=run.x[split_index],
                span=(run.t[split_index], case.time),
                **({} if run.attitude is None else {"attitude": run.attitude[split_index]}),
            )
            for run in (case.base_run, loaded_run)
        ]
        case.suite.check_true(
            f"{case.name}: goes on to the bit", np.array_equal(continued_runs[0].x, continued_runs[1].x)
        )
    return None


def check_solve_ivp_matches_integrate(case: RelationCase) -> SkipReason:
    """Check that ``solve_ivp`` returns the final state and the event of ``integrate``."""
    if case.system.sites or case.system.space is not None:
        return "SciPy's states are vectors"
    if not has_error_estimate(case.method):
        return "the method has no estimate of its error"
    step = case.step if isinstance(case.step, Adaptive) else Adaptive(1e-8)

    def run_solve_ivp(**options):
        span = (0.0, case.time)
        return solve_ivp(case.system, span, case.x0, case.method, rtol=step.rtol, atol=step.atol, **options)

    integrate_run = case.run(step=step)
    case.compare_states_with_expected(
        "solve_ivp", run_solve_ivp().y[:, -1], integrate_run.x[-1], case.rounding_tolerance
    )
    i = int(np.argmax(np.abs(integrate_run.x[-1] - integrate_run.x[0])))
    crossing = _LevelCrossing(i, float(0.5 * (integrate_run.x[0, i] + integrate_run.x[-1, i])))
    if crossing.level == integrate_run.x[0, i]:
        return None
    event_run = case.run(step=step, until=lambda x: x[i] - crossing.level)
    peer_result = run_solve_ivp(events=crossing)
    both_find_event = peer_result.status == 1 and event_run.event_time is not None
    case.suite.check_true(f"{case.name}: both find the event", both_find_event, peer_result.message)
    if both_find_event:
        assert peer_result.t_events is not None
        assert peer_result.y_events is not None
        time_difference = peer_result.t_events[0][0] - event_run.event_time
        case.suite.check_small(f"{case.name}: when it is", time_difference, case.time, case.rounding_tolerance)
        case.compare_states_with_expected(
            "where it is", peer_result.y_events[0][0], event_run.x[-1], case.rounding_tolerance
        )
    return None


class _LevelCrossing:
    """An event function for SciPy that is zero where a component of the state crosses a level."""

    terminal = True

    def __init__(self, component: int, level: float):
        self.component, self.level = component, level

    def __call__(self, t, y):
        return y[self.component] - self.level


def check_diffrax_matches_integrate(case: RelationCase) -> SkipReason:
    """Check that diffrax with :class:`.Solver` returns the final state of ``integrate``, and backwards the initial
    state."""
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

    x, is_successful = final_state_and_success(0.0, case.time, h, case.x0)
    case.suite.check_true(f"{case.name}: diffeqsolve succeeds", is_successful)
    case.compare_states_with_expected("diffeqsolve", x, case.base_run.x[-1], case.rounding_tolerance)
    x, is_successful = final_state_and_success(case.time, 0.0, -h, x)
    case.suite.check_true(f"{case.name}: backwards it succeeds", is_successful)
    case.compare_states_with_expected("there and back", x, case.x0, 2.0 * case.discretisation_tolerance)
    return None
