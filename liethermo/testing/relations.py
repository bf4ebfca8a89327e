"""Property suite of relations: changes of a run that must leave its result unchanged, or change it in a known way.

No reference solution is needed: a run is compared with an equivalent run [metamorphic testing: Chen, Cheung & Yiu
1998]. A constant in the energy, other units, another basis, a split span or another front end do not change the motion,
so any other difference is a fault.
"""

from __future__ import annotations

import functools
import gc
import importlib.util
import itertools
import tempfile
from collections.abc import Callable, Collection
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from manifolds.testing import Report, Suite

from ..engines.select_engine import is_worth_compiling
from ..errors import InputError
from ..functions.energy import Pullback
from ..functions.gradients import EPS
from ..integrators import DEFAULT_METHOD, MetriplecticMidpoint, MetriplecticTaylor, OneStepMethod
from ..integrators.base import has_error_estimate, is_permutation_equivariant
from ..interop.scipy import solve_ivp
from ..results.load import load
from ..results.solution import Solution
from ..runs.adaptive import Adaptive
from ..runs.ensemble import Ensemble, ensemble
from ..runs.integrate import integrate
from ..runs.named_parameters import named_parameters
from ..runs.noise import Fluctuations
from ..studies.axes import replicas
from ..studies.study import Study
from ..systems import LiePoissonSystem, System
from ..tracing.scalarize import UnsupportedPrimitive
from .runs import N_STEPS, check_completion, default_step, random_start
from .transformations import (
    CoordinateChange,
    UncoupledPair,
    add_constant,
    close_over_parameters,
    replace_parts,
    restrict_near_states,
    sum_of_two_halves,
    transform_system,
)

ROUNDING_RTOL = 1e-11
"""Largest difference of states that should differ by rounding alone, relative to the largest state component.

The steps of a short run accumulate 1e-14, which growing modes of the motion multiply.
"""

RESOLUTION_ERROR_FACTOR = 10.0
"""Largest difference, in errors of the method, of two runs that divide the time into different steps."""

ENERGY_SHIFTS = (1.0, -1.0, 1e4)
"""Constants added to an energy, in units of the energy's magnitude."""

SHIFT_ROUNDING_FACTOR = 100.0
"""Largest accumulated rounding error of a short run, in roundings of the added constant; 20 were observed."""

UNIT_FACTORS = ((1e12, 1e-12), (1e-12, 1e12), (1e20, 1.0), (1e-20, 1e-20))
"""Factors by which the state and the time are rescaled."""

N_KNOWN_STATES = 9
"""Number of states of the run near which the restricted entropy is defined."""

SkipReason = str | None
"""The reason why a relation does not apply to a case, or None if it was checked."""


class RelationCase:
    """A run, and the comparisons of equivalent runs with it.

    Parameters
    ----------
    system, method, x0, step
        As for :func:`check_relations`.
    time : float
        Duration of the run.
    seed : int
        Seed of the random axes and of the neighbouring state.
    """

    def __init__(self, system: System, method: OneStepMethod, x0, step: float | Adaptive, time: float, seed: int):
        self.system, self.method, self.x0 = system, method, np.asarray(x0, dtype=np.float64)
        self.step, self.time, self.seed = step, time, seed
        self.suite, self.name = Suite(f"{method} in a {system.kind}"), ""

    def run(self, system: System | None = None, x0=None, span=None, step=None, **options) -> Solution:
        """Integrate like the base run, except for the given arguments; a failed run is returned too."""
        return integrate(
            self.system if system is None else system,
            self.x0 if x0 is None else x0,
            (0.0, self.time) if span is None else span,
            self.step if step is None else step,
            self.method,
            on_failure="return",
            progress=False,
            **options,
        )

    @functools.cached_property
    def base_run(self) -> Solution:
        """The run with which all others are compared."""
        return self.run()

    @property
    def state_scale(self) -> float:
        """The largest absolute component of the states of the base run."""
        return float(np.abs(self.base_run.x).max())

    @functools.cached_property
    def method_error(self) -> float:
        """The error of the method relative to the state scale, measured with half the step or a hundredth of the
        tolerance."""
        if isinstance(self.step, Adaptive):
            finer: float | Adaptive = replace(self.step, rtol=0.01 * self.step.rtol, atol=0.01 * self.step.atol)
        else:
            finer = 0.5 * self.step
        return float(np.abs(self.run(step=finer).x[-1] - self.base_run.x[-1]).max()) / self.state_scale

    @property
    def rounding_tolerance(self) -> float:
        """The allowed rounding error. It also affects adaptive steps, hence the state by a fraction of their
        tolerance."""
        return max(ROUNDING_RTOL, 0.1 * self.step.rtol) if isinstance(self.step, Adaptive) else ROUNDING_RTOL

    @property
    def resolution_tolerance(self) -> float:
        """The allowed difference of runs that divide the time into different steps."""
        return max(self.rounding_tolerance, RESOLUTION_ERROR_FACTOR * self.method_error)

    def compare_states(self, label: str, states, expected_states, tolerance: float) -> None:
        """Add a row with the difference of states from the expected ones, relative to the state scale."""
        self.suite.check_small(
            f"{self.name}: {label}", np.asarray(states) - np.asarray(expected_states), self.state_scale, tolerance
        )

    def compare_run(
        self,
        description: str,
        run: Solution,
        to_base: Callable = lambda x: x,
        tolerance: float | None = None,
        same_names: bool = True,
    ) -> None:
        """Add rows that compare a run with the base run: status, states, attitude, conserved functions and audit.

        With ``same_names`` the conserved functions must have equal names, otherwise only their number must agree.
        """
        tolerance = self.rounding_tolerance if tolerance is None else tolerance
        label = f"{self.name}: {description}"
        status = (run.status.code, self.base_run.status.code)
        self.suite.check_true(
            f"{label} ends alike", status[0] == status[1], "" if status[0] == status[1] else run.status.message
        )
        if status[0] != status[1]:
            return
        has_equal_times = len(run.t) == len(self.base_run.t) and not isinstance(self.step, Adaptive)
        compared = slice(None) if has_equal_times else slice(-1, None)
        self.compare_states(description, to_base(run.x[compared]), self.base_run.x[compared], tolerance)
        if run.attitude is not None and self.base_run.attitude is not None:
            self.suite.check_equal(
                f"{label}, attitude", run.attitude[compared], self.base_run.attitude[compared], tolerance
            )
        names, base_names = conserved_names(run), conserved_names(self.base_run)
        agree = names == base_names if same_names else len(names) == len(base_names)
        self.suite.check_true(
            f"{label}, same constants", agree, "" if agree else f"{sorted(names)}, not {sorted(base_names)}"
        )
        is_same_verdict = run.audit().passed == self.base_run.audit().passed
        self.suite.check_true(f"{label}, same verdict", is_same_verdict, "" if is_same_verdict else run.audit().verdict)


def conserved_names(run: Solution) -> set[str]:
    """Return the names of the functions that a run conserves, promised or not."""
    return {*run.laws.conserved, *run.laws.unpromised}


# -- the functions of a system --------------------------------------------------------------------------------------


def check_energy_shift(case: RelationCase) -> SkipReason:
    """Check that a constant in the energy changes a run by rounding alone."""
    if case.system.is_driven:
        return "the energy depends on time"
    energy_scale = max(abs(float(case.base_run.energy[0])), float(case.system.energy.sensitivity(case.x0)))
    for factor in ENERGY_SHIFTS:
        run = case.run(replace_parts(case.system, energy=add_constant(case.system.energy, factor * energy_scale)))
        case.compare_run(
            f"{factor:+g} of the energy's size",
            run,
            tolerance=max(case.rounding_tolerance, SHIFT_ROUNDING_FACTOR * EPS * abs(factor)),
        )
    return None


def check_entropy_near_motion(case: RelationCase) -> SkipReason:
    """Check that the values of the entropy far from the motion do not matter."""
    system = case.system
    if system.entropy is None or system.space is not None or system.sites:
        return "there is no entropy on R^n"
    if isinstance(case.method, MetriplecticTaylor):
        return "an entropy that is NaN far from the motion has no Taylor series"
    path = case.base_run.x
    centres = path[np.unique(np.linspace(0, len(path) - 1, N_KNOWN_STATES).astype(int))]
    max_distance = np.linalg.norm(path[:, None] - centres, axis=2).min(axis=1).max()
    stride = np.linalg.norm(np.diff(path, axis=0), axis=1).max(initial=0.0)
    local_entropy = restrict_near_states(
        system.entropy, centres, 2.0 * float(max_distance + stride) + 1e-6 * case.state_scale
    )
    case.compare_run(
        "an entropy that is known near the motion alone", case.run(replace_parts(system, entropy=local_entropy))
    )
    return None


def check_closed_over_parameters(case: RelationCase) -> SkipReason:
    """Check that parameters may be leaves of a system or constants in a closure."""
    if case.system.is_driven or case.system.space is not None:
        return "the energy is not a plain function of the state"
    case.compare_run(
        "parameters closed over", case.run(replace_parts(case.system, energy=close_over_parameters(case.system.energy)))
    )
    return None


def check_halved_dissipation(case: RelationCase) -> SkipReason:
    """Check that a dissipation may be split into two with half of the rate each."""
    if case.system.dissipation is None:
        return "there is no dissipation"
    run = case.run(replace_parts(case.system, dissipation=sum_of_two_halves(case.system)))
    case.compare_run("half of the rate, twice", run)
    rows, split_rows = ([row.law for row in s.audit().rows] for s in (case.base_run, run))
    case.suite.check_true(
        f"{case.name}: one row of the audit for each quantity",
        split_rows == rows,
        "" if split_rows == rows else f"{split_rows}",
    )
    return None


# -- coordinates and units ------------------------------------------------------------------------------------------


def why_not_linear_states(case: RelationCase) -> SkipReason:
    """Return why linear maps of the states do not apply to a case, as a text, or None if they do."""
    system = case.system
    if system.is_driven or system.space is not None or system.sites:
        return "states are no vectors of R^n whose functions depend on them alone"
    return None


def check_units(case: RelationCase) -> SkipReason:
    """Check that units of state, time, energy and entropy do not matter."""
    if reason := why_not_linear_states(case):
        return reason
    for state, time in UNIT_FACTORS:
        change = CoordinateChange(state * np.eye(case.system.dim), time, state / time, state**0.5)
        options = (
            {"step": case.step * time}
            if isinstance(case.step, float)
            else {"step": _step_in_units(case.step, state, time)}
        )
        run = case.run(
            transform_system(case.system, change), change.to_new(case.x0), (0.0, case.time * time), **options
        )
        case.compare_run(f"states times {state:g}, times times {time:g}", run, change.to_old)
    return None


def _step_in_units(step: Adaptive, state_factor: float, time_factor: float) -> Adaptive:
    step_limits = {
        name: value * time_factor for name in ("first", "largest") if (value := getattr(step, name)) is not None
    }
    return replace(step, atol=step.atol * state_factor, **step_limits)


def check_component_order(case: RelationCase) -> SkipReason:
    """Check that the order of the components does not matter."""
    n = case.system.dim
    return _check_linear_map(case, "components the other way round", np.eye(n)[::-1], True)


def check_rotated_axes(case: RelationCase) -> SkipReason:
    """Check that rotated axes, or another basis of the algebra, do not matter."""
    n = case.system.dim
    matrix = np.linalg.qr(np.random.default_rng(case.seed).standard_normal((n, n)))[0]
    adaptive = isinstance(case.step, Adaptive)  # their error norm is the largest component, which depends on the axes
    return _check_linear_map(case, "axes turned", matrix, not adaptive)


def _check_linear_map(case: RelationCase, description: str, matrix: np.ndarray, same_steps: bool) -> SkipReason:
    if reason := why_not_linear_states(case):
        return reason
    if case.system.matrix_group is not None:
        return "the attitude is of a group with a basis of its own"
    change, system = CoordinateChange(matrix), case.system
    run = case.run(transform_system(system, change), change.to_new(case.x0))
    exact = (
        same_steps
        and is_permutation_equivariant(case.method)
        and not any(isinstance(term, Pullback) for term in system.energy.terms)
    )
    has_same_names = not isinstance(system, LiePoissonSystem)  # another basis has other Casimirs
    case.compare_run(
        description, run, change.to_old, case.rounding_tolerance if exact else case.resolution_tolerance, has_same_names
    )
    return None


def check_uncoupled_pair(case: RelationCase) -> SkipReason:
    """Check that two uncoupled copies of a system move like single ones."""
    if reason := why_not_linear_states(case):
        return reason
    n, second_start = case.system.dim, nearby_state(case)
    pair = case.run(UncoupledPair(case.system), np.concatenate([case.x0, second_start]))
    single_runs = case.base_run, case.run(x0=second_start)
    check_completion(case.suite, f"{case.name}: the pair", pair)
    for run, component, name in zip(single_runs, (pair.x[-1][:n], pair.x[-1][n:]), ("one", "the other"), strict=True):
        case.compare_states(f"{name} of a pair", component, run.x[-1], case.resolution_tolerance)
    is_same_verdict = pair.audit().passed == all(run.audit().passed for run in single_runs)
    case.suite.check_true(f"{case.name}: the verdict of a pair is that of both", is_same_verdict)
    return None


def nearby_state(case: RelationCase) -> np.ndarray:
    """Return another state at a twentieth of the state scale, or if that is outside, on the way to a random state."""
    v = np.random.default_rng(case.seed + 1).standard_normal(case.x0.shape)
    nearby = case.x0 + 0.05 * case.state_scale * v / np.linalg.norm(v)
    if not case.system.domain.why_outside(nearby.ravel()):
        return nearby
    return case.x0 + 0.05 * (random_start(case.system, case.seed + 1).reshape(case.x0.shape) - case.x0)


# -- time -----------------------------------------------------------------------------------------------------------


def check_reversal(case: RelationCase) -> SkipReason:
    """Check that a reversible motion returns to its start with the negative energy."""
    system = case.system
    if system.total_dissipation.terms or system.is_driven:
        return "the motion is not reversible"
    reversed_run = case.run(replace_parts(system, energy=-system.energy), case.base_run.x[-1])
    symmetric = not case.method.explicit and not isinstance(case.step, Adaptive)
    case.compare_states(
        "there and back",
        reversed_run.x[-1],
        case.x0,
        case.rounding_tolerance if symmetric else 2.0 * case.resolution_tolerance,
    )
    return None


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


# -- other engines and interfaces -----------------------------------------------------------------------------------


def check_engines(case: RelationCase) -> SkipReason:
    """Check that all engines take equal steps."""
    case.compare_run("array engine", case.run(engine="array"))
    if not is_worth_compiling(case.system):
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


RELATIONS: dict[str, Callable[[RelationCase], SkipReason]] = {
    "constant": check_energy_shift,
    "domain": check_entropy_near_motion,
    "closure": check_closed_over_parameters,
    "shares": check_halved_dissipation,
    "units": check_units,
    "order": check_component_order,
    "axes": check_rotated_axes,
    "side by side": check_uncoupled_pair,
    "reversal": check_reversal,
    "split": check_split_span,
    "noise": check_split_noise,
    "engines": check_engines,
    "ensemble": check_ensemble,
    "company": check_family_members,
    "study": check_study,
    "file": check_saved_run,
    "scipy": check_solve_ivp_matches_integrate,
    "diffrax": check_diffrax,
}
"""The check of each relation, by name."""


def check_relations(
    system: System,
    method: OneStepMethod | None = None,
    x0=None,
    step: float | Adaptive | None = None,
    *,
    relations: Collection[str] | None = None,
    time: float | None = None,
    seed: int = 0,
) -> Report:
    """Compare a run with equivalent ones, whose results must be equal or differ in a known way.

    The relations are a constant in the energy; units of state and time by factors up to 1e20; reordered components and
    rotated axes (another basis of the algebra); a rate shared by two dissipations; parameters in a closure; an entropy
    defined only near the motion; an uncoupled pair; the reversed motion; a split span, with noise too; every engine;
    the run in an ensemble, beside members of other symmetry, in a study, from a file, by SciPy's and by diffrax's call.

    Parameters
    ----------
    system : System
    method : OneStepMethod, optional
        ``MetriplecticGauss(1)`` by default.
    x0 : array, optional
        Initial state of the runs; a random one by default.
    step : float or Adaptive, optional
        By default a step moves the state by a hundredth of its norm.
    relations : collection of str, optional
        Some of ``liethermo.testing.RELATIONS``; by default all.
    time : float, optional
        Duration of a run; by default forty steps, in which the state moves by two fifths of its norm.
    seed : int
        Seed of the state and of the axes.

    Returns
    -------
    Report
        The first row says if the run completes. A relation that does not apply to the system has a row with the reason.

    Raises
    ------
    PropertyError
        If a relation does not hold, or the run fails.
    InputError
        If a relation name is unknown.
    """
    relation_names = list(RELATIONS if relations is None else relations)
    if unknown := set(relation_names) - set(RELATIONS):
        raise InputError(f"there is no relation {unknown.pop()!r}; there are {', '.join(RELATIONS)}")
    start = random_start(system, seed) if x0 is None else np.asarray(x0, dtype=np.float64)
    step = default_step(system, start) if step is None else step
    if time is None:
        time = N_STEPS * (default_step(system, start) if isinstance(step, Adaptive) else step)
    case = RelationCase(system, DEFAULT_METHOD if method is None else method, start, step, time, seed)
    check_completion(case.suite, "the run", case.base_run)
    for name in relation_names:
        case.name = name
        if (reason := RELATIONS[name](case)) is not None:
            case.suite.skip_check(name, reason)
    return case.suite.report()
