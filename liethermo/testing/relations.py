"""The suite of relations: what must not change a result, or must change it in a known way.

No reference solution is needed: a run is compared with the same run written down in another way. A constant in an
energy, another unit, another basis, a span in two parts or another front end tells nothing new of the motion, so
whatever it changes is a fault [metamorphic testing: Chen, Cheung & Yiu 1998].
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

from ..engines.choice import is_worth_compiling
from ..errors import InputError
from ..functions.energy import Pullback
from ..functions.gradients import EPS
from ..integrators import DEFAULT_METHOD, MetriplecticMidpoint, OneStepMethod
from ..integrators.base import has_error_estimate, is_permutation_equivariant
from ..interop.scipy import solve_ivp
from ..results.load import load
from ..results.solution import Solution
from ..runs.adaptive import Adaptive
from ..runs.ensemble import Ensemble, ensemble
from ..runs.family import named_parameters
from ..runs.fluctuations import Fluctuations
from ..runs.integrate import integrate
from ..studies.axes import replicas
from ..studies.study import Study
from ..systems import LiePoissonSystem, System
from ..tracing.scalarize import UnsupportedPrimitive
from .runs import N_STEPS, check_completion, default_step, random_start
from .transformations import (
    CoordinateChange,
    UncoupledPair,
    add_constant,
    as_closure,
    replace_parts,
    restrict_near_states,
    split_in_halves,
    transform_system,
)

ROUNDING_RTOL = 1e-11
"""By how much states may differ that differ by rounding alone, relative to their size: steps of a short run make 1e-14
of it, and what grows near a state multiplies that."""

RESOLUTION_ERROR_FACTOR = 10.0
"""By how much two runs may differ whose steps divide the time in two ways, in errors of the method."""

ENERGY_SHIFTS = (1.0, -1.0, 1e4)
"""What is added to an energy, in units of its own size."""

SHIFT_ROUNDING_FACTOR = 100.0
"""Roundings of a large constant that the steps of a short run add up to: 20 were seen."""

UNIT_FACTORS = ((1e12, 1e-12), (1e-12, 1e12), (1e20, 1.0), (1e-20, 1e-20))
"""Units of the state and of time."""

N_KNOWN_STATES = 9
"""States of the motion that an entropy is known near."""

SkipReason = str | None
"""Why a relation is not asked of a case; None where it was."""


class RelationCase:
    """A run, and what other runs have to be like.

    Parameters
    ----------
    system, method, x0, step
        As of :func:`check_relations`.
    time : float
        How long it is.
    seed : int
        Of what is drawn: axes, and the state of a neighbour.
    """

    def __init__(self, system: System, method: OneStepMethod, x0, step: float | Adaptive, time: float, seed: int):
        self.system, self.method, self.x0 = system, method, np.asarray(x0, dtype=np.float64)
        self.step, self.time, self.seed = step, time, seed
        self.suite, self.name = Suite(f"{method} in a {system.kind}"), ""

    def run(self, system: System | None = None, x0=None, span=None, step=None, **options) -> Solution:
        """A run like this one but for what is given; one that fails is returned too."""
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
        return self.run()

    @property
    def state_scale(self) -> float:
        """The size of the states."""
        return float(np.abs(self.base_run.x).max())

    @functools.cached_property
    def method_error(self) -> float:
        """The error of the method, relative to the size, as half of the step or a hundredth of the tolerance tell."""
        if isinstance(self.step, Adaptive):
            finer: float | Adaptive = replace(self.step, rtol=0.01 * self.step.rtol, atol=0.01 * self.step.atol)
        else:
            finer = 0.5 * self.step
        return float(np.abs(self.run(step=finer).x[-1] - self.base_run.x[-1]).max()) / self.state_scale

    @property
    def rounding_tolerance(self) -> float:
        """What rounding may come to. It changes adaptive steps a little, and the state by a part of their error."""
        return max(ROUNDING_RTOL, 0.1 * self.step.rtol) if isinstance(self.step, Adaptive) else ROUNDING_RTOL

    @property
    def resolution_tolerance(self) -> float:
        """What another division into steps may come to."""
        return max(self.rounding_tolerance, RESOLUTION_ERROR_FACTOR * self.method_error)

    def compare_states(self, what: str, found, expected, tolerance: float) -> None:
        """A row that says how far states are from those expected, relative to their size."""
        self.suite.check_small(
            f"{self.name}: {what}", np.asarray(found) - np.asarray(expected), self.state_scale, tolerance
        )

    def compare_run(
        self,
        what: str,
        run: Solution,
        back: Callable = lambda x: x,
        tolerance: float | None = None,
        same_names: bool = True,
    ) -> None:
        """Rows for a run that is to be this one: how it ended, its states, what it keeps and its audit.

        The functions that it keeps have the same names, or, where these are found anew, the same number.
        """
        tolerance = self.rounding_tolerance if tolerance is None else tolerance
        label = f"{self.name}: {what}"
        status = (run.status.code, self.base_run.status.code)
        self.suite.check_true(
            f"{label} ends alike", status[0] == status[1], "" if status[0] == status[1] else run.status.message
        )
        if status[0] != status[1]:
            return
        whole = len(run.t) == len(self.base_run.t) and not isinstance(self.step, Adaptive)
        kept = slice(None) if whole else slice(-1, None)
        self.compare_states(what, back(run.x[kept]), self.base_run.x[kept], tolerance)
        if run.attitude is not None and self.base_run.attitude is not None:
            self.suite.check_equal(f"{label}, attitude", run.attitude[kept], self.base_run.attitude[kept], tolerance)
        ours, theirs = conserved_names(run), conserved_names(self.base_run)
        agree = ours == theirs if same_names else len(ours) == len(theirs)
        self.suite.check_true(
            f"{label}, same constants", agree, "" if agree else f"{sorted(ours)}, not {sorted(theirs)}"
        )
        passed = run.audit().passed == self.base_run.audit().passed
        self.suite.check_true(f"{label}, same verdict", passed, "" if passed else run.audit().verdict)


def conserved_names(run: Solution) -> set[str]:
    """The names of the functions that a run is said to conserve."""
    return {*run.laws.conserved, *run.laws.unpromised}


# -- the functions of a system --------------------------------------------------------------------------------------


def check_energy_shift(case: RelationCase) -> SkipReason:
    """A constant in the energy is seen in its rounding alone."""
    if case.system.is_driven:
        return "the energy depends on time"
    size = max(abs(float(case.base_run.energy[0])), float(case.system.energy.sensitivity(case.x0)))
    for factor in ENERGY_SHIFTS:
        run = case.run(replace_parts(case.system, energy=add_constant(case.system.energy, factor * size)))
        case.compare_run(
            f"{factor:+g} of the energy's size",
            run,
            tolerance=max(case.rounding_tolerance, SHIFT_ROUNDING_FACTOR * EPS * abs(factor)),
        )
    return None


def check_local_entropy(case: RelationCase) -> SkipReason:
    """What functions are where the motion does not come has no part in it."""
    system = case.system
    if system.entropy is None or system.space is not None or system.sites:
        return "there is no entropy on R^n"
    path = case.base_run.x
    places = path[np.unique(np.linspace(0, len(path) - 1, N_KNOWN_STATES).astype(int))]
    apart = np.linalg.norm(path[:, None] - places, axis=2).min(axis=1).max()
    stride = np.linalg.norm(np.diff(path, axis=0), axis=1).max(initial=0.0)
    known = restrict_near_states(system.entropy, places, 2.0 * float(apart + stride) + 1e-6 * case.state_scale)
    case.compare_run("an entropy that is known near the motion alone", case.run(replace_parts(system, entropy=known)))
    return None


def check_closure(case: RelationCase) -> SkipReason:
    """Parameters may be leaves of a system, or numbers that its functions close over."""
    if case.system.is_driven or case.system.space is not None:
        return "the energy is no plain function of the state"
    case.compare_run(
        "parameters closed over", case.run(replace_parts(case.system, energy=as_closure(case.system.energy)))
    )
    return None


def check_split_rate(case: RelationCase) -> SkipReason:
    """A rate may be shared by two dissipations."""
    if case.system.dissipation is None:
        return "there is no dissipation"
    run = case.run(replace_parts(case.system, dissipation=split_in_halves(case.system.dissipation)))
    case.compare_run("half of the rate, twice", run)
    rows, ours = ([row.law for row in s.audit().rows] for s in (case.base_run, run))
    case.suite.check_true(
        f"{case.name}: one row of the audit for each quantity", ours == rows, "" if ours == rows else f"{ours}"
    )
    return None


# -- coordinates and units ------------------------------------------------------------------------------------------


def why_not_vectors(case: RelationCase) -> SkipReason:
    """Why the state has no other coordinates."""
    system = case.system
    if system.is_driven or system.space is not None or system.sites:
        return "states are no vectors of R^n whose functions depend on them alone"
    return None


def check_units(case: RelationCase) -> SkipReason:
    """Other units of state, time, energy and entropy."""
    if reason := why_not_vectors(case):
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


def _step_in_units(step: Adaptive, state: float, time: float) -> Adaptive:
    own = {name: value * time for name in ("first", "largest") if (value := getattr(step, name)) is not None}
    return replace(step, atol=step.atol * state, **own)


def check_component_order(case: RelationCase) -> SkipReason:
    """Components may stand in another order."""
    n = case.system.dim
    return _check_linear_map(case, "components the other way round", np.eye(n)[::-1], True)


def check_rotated_axes(case: RelationCase) -> SkipReason:
    """Axes may be turned: another basis of the algebra, where there is one."""
    n = case.system.dim
    matrix = np.linalg.qr(np.random.default_rng(case.seed).standard_normal((n, n)))[0]
    adaptive = isinstance(case.step, Adaptive)  # these are judged by the largest component, which depends on axes
    return _check_linear_map(case, "axes turned", matrix, not adaptive)


def _check_linear_map(case: RelationCase, what: str, matrix: np.ndarray, same_steps: bool) -> SkipReason:
    if reason := why_not_vectors(case):
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
    named = not isinstance(system, LiePoissonSystem)  # another basis has other Casimirs
    case.compare_run(what, run, change.to_old, case.rounding_tolerance if exact else case.resolution_tolerance, named)
    return None


def check_uncoupled_pair(case: RelationCase) -> SkipReason:
    """A system beside itself, from two states."""
    if reason := why_not_vectors(case):
        return reason
    n, other = case.system.dim, nearby_state(case)
    pair = case.run(UncoupledPair(case.system), np.concatenate([case.x0, other]))
    alone = case.base_run, case.run(x0=other)
    check_completion(case.suite, f"{case.name}: the pair", pair)
    for run, part, name in zip(alone, (pair.x[-1][:n], pair.x[-1][n:]), ("one", "the other"), strict=True):
        case.compare_states(f"{name} of a pair", part, run.x[-1], case.resolution_tolerance)
    passed = pair.audit().passed == all(run.audit().passed for run in alone)
    case.suite.check_true(f"{case.name}: the verdict of a pair is that of both", passed)
    return None


def nearby_state(case: RelationCase) -> np.ndarray:
    """Another state, by a twentieth away; where not all vectors are states, a twentieth of the way to another one."""
    v = np.random.default_rng(case.seed + 1).standard_normal(case.x0.shape)
    found = case.x0 + 0.05 * case.state_scale * v / np.linalg.norm(v)
    if not case.system.outside(found.ravel()):
        return found
    return case.x0 + 0.05 * (random_start(case.system, case.seed + 1).reshape(case.x0.shape) - case.x0)


# -- time -----------------------------------------------------------------------------------------------------------


def check_reversal(case: RelationCase) -> SkipReason:
    """A reversible motion goes back the way that it came, where the energy is negative."""
    system = case.system
    if system.dissipation is not None or system.is_driven:
        return "the motion is not reversible"
    back = case.run(replace_parts(system, energy=-system.energy), case.base_run.x[-1])
    symmetric = not case.method.explicit and not isinstance(case.step, Adaptive)
    case.compare_states(
        "there and back", back.x[-1], case.x0, case.rounding_tolerance if symmetric else 2.0 * case.resolution_tolerance
    )
    return None


def check_split_span(case: RelationCase) -> SkipReason:
    """A span may be cut into parts, and states be kept seldom."""
    seldom = case.run(save_every=5)
    case.compare_states("every fifth state kept", seldom.x[-1], case.base_run.x[-1], 0.0)
    ends = cut_times(case)
    if not ends:
        return "there are too few steps"
    allowed = case.resolution_tolerance if isinstance(case.step, Adaptive) else case.rounding_tolerance
    last = run_in_parts(case, ends)
    case.compare_states(f"in {len(ends) + 1} parts", last.x[-1], case.base_run.x[-1], allowed)
    if last.attitude is not None and case.base_run.attitude is not None:
        case.suite.check_equal(f"{case.name}: their attitude", last.attitude[-1], case.base_run.attitude[-1], allowed)
    return None


def cut_times(case: RelationCase) -> list[float]:
    """Times at which a run is cut: ends of its steps, at an eighth and at a half of it."""
    count = len(case.base_run.t) - 1
    return [float(case.base_run.t[i]) for i in sorted({count // 8, count // 2}) if 0 < i < count]


def run_in_parts(case: RelationCase, ends: list[float], **options) -> Solution:
    """The last part of a run that is cut at some times: each part goes on from the state and attitude before it."""
    run: Solution | None = None
    attitude: dict[str, Any] = {}
    for span in itertools.pairwise([0.0, *ends, case.time]):
        run = case.run(x0=case.x0 if run is None else run.x[-1], span=span, **attitude, **options)
        attitude = {} if run.attitude is None else {"attitude": run.attitude[-1]}
    assert run is not None
    return run


def check_split_noise(case: RelationCase) -> SkipReason:
    """A run with noise in parts is the run, to the bit where nothing depends on time; other times have other noise."""
    if isinstance(case.step, Adaptive) or not isinstance(case.method, MetriplecticMidpoint):
        return "steps with noise are those of MetriplecticMidpoint, of one size"
    ends = cut_times(case)
    if not ends:
        return "there are too few steps"
    lowers = case.system.dissipation is not None and any(
        part.energy_law != "conserved" for part in case.system.dissipation.terms
    )
    own = Fluctuations(NOISE_BOLTZMANN, seed=case.seed, temperature=1.0 if lowers else None)
    try:
        whole = case.run(noise=own)
    except InputError as error:
        return str(error)
    if not whole.status.ok:
        return f"the run with noise ends: {whole.status.message}"
    last = run_in_parts(case, ends, noise=own)
    tail = whole.x[-len(last.x) :]
    case.compare_states("in parts", last.x, tail, case.rounding_tolerance if case.system.is_driven else 0.0)
    later = case.run(x0=case.x0, span=(case.time, 2.0 * case.time), noise=own)
    other = not np.array_equal(later.x[-1], whole.x[-1])
    case.suite.check_true(f"{case.name}: another time has other noise", other)
    return None


NOISE_BOLTZMANN = 1e-6
"""Boltzmann's constant of runs with noise, in the units of the entropy."""


# -- by other ways --------------------------------------------------------------------------------------------------


def check_engines(case: RelationCase) -> SkipReason:
    """Every engine takes the same steps."""
    case.compare_run("array engine", case.run(engine="array"))
    if not is_worth_compiling(case.system):
        return None
    try:
        case.compare_run("compiled engine", case.run(engine="compiled"))
    except UnsupportedPrimitive as error:
        case.suite.skip_check(f"{case.name}: compiled engine", str(error)[:60])
    return None


def check_ensemble(case: RelationCase) -> SkipReason:
    """A trajectory among others is the one alone."""
    starts = np.stack([nearby_state(case).ravel(), case.x0.ravel(), nearby_state(case).ravel()])
    found = ensemble(case.system, starts, (0.0, case.time), case.step, case.method, progress=False)
    assert found.x is not None
    case.compare_states("among three", found.x[1], case.base_run.x[-1].ravel(), case.rounding_tolerance)
    return None


def check_family(case: RelationCase) -> SkipReason:
    """What other members of a family are, and in which order they stand, is nothing to one of them: to the bit.

    The others have the parameters of the system made equal, made zero in part, and of the other sign.
    """
    names = {name: value for name, value in named_parameters(case.system).items() if value.size}
    if not names:
        return "the system has no parameters"
    rows = {name: np.stack([value, *degenerate_parameters(value)]) for name, value in names.items()}
    (name, value), *_ = names.items()
    entry = (0,) * value.ndim
    path = name + "".join(f"[{i}]" for i in entry)
    values = np.unique([value[entry], 0.0, -value[entry], 2.0 * value[entry] + 1.0])
    place = int(np.flatnonzero(values == value[entry])[0])
    span = (0.0, case.time)

    def among(order: list[int]) -> np.ndarray:
        members = {name: row[order] for name, row in rows.items()}
        found = ensemble(case.system, case.x0, span, case.step, case.method, parameters=members, progress=False)
        return final_state(found, order.index(0))

    def in_study(order: np.ndarray) -> np.ndarray:
        points = {path: values[order]}
        described = Study(
            case.system, points, x0=case.x0, t_span=span, step=case.step, method=case.method, measure={"x": "final"}
        )
        described.run(progress=False)
        return described.results.x.values[int(np.flatnonzero(order == place)[0])]

    alone = ensemble(case.system, case.x0[None], span, case.step, case.method, progress=False)
    case.compare_states("in company", among([0, 1, 2, 3]), final_state(alone, 0), case.rounding_tolerance)
    first = among([0, 1, 2, 3])
    for order in ([1, 2, 3, 0], [3, 1, 0, 2], [2, 0]):
        case.compare_states(f"in the order {order}", among(order), first, 0.0)
    forwards = np.arange(len(values))
    first = in_study(forwards)
    case.compare_states("in a study", first, final_state(alone, 0), case.rounding_tolerance)
    case.compare_states("in a study backwards", in_study(forwards[::-1]), first, 0.0)
    return None


def degenerate_parameters(value: np.ndarray) -> list[np.ndarray]:
    """Parameters that are more symmetric, have zeros, and have the other sign."""
    square = value.ndim == 2 and value.shape[0] == value.shape[1]
    equal = np.eye(len(value)) * np.trace(value) / len(value) if square else np.full_like(value, value.mean())
    zeros = np.where(np.arange(value.size).reshape(value.shape) % 2 == 0, 0.0, value)
    return [equal, zeros, -value]


def final_state(many: Ensemble, i: int) -> np.ndarray:
    """The final state of a trajectory, shape (n,), as an array to compare; zeros if it was not started."""
    assert many.x is not None
    return np.nan_to_num(many.x[i]).ravel()


def check_study(case: RelationCase) -> SkipReason:
    """A point of a study is a run, and its values outlive the study."""
    described = Study(
        case.system,
        {"replica": replicas(np.stack([nearby_state(case).ravel(), case.x0.ravel()]))},
        t_span=(0.0, case.time),
        step=case.step,
        method=case.method,
        measure={"final": "final"},
    )
    described.run(progress=False)
    results = described.results
    del described
    gc.collect()
    case.compare_states(
        "a point, of a study that is gone",
        results.final.values[1],
        case.base_run.x[-1].ravel(),
        case.rounding_tolerance,
    )
    return None


def check_saved_run(case: RelationCase) -> SkipReason:
    """A loaded run equals the saved one."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "run.nc"
        case.base_run.save(path)
        found = load(path)
    assert isinstance(found, Solution)
    alike = np.array_equal(found.x, case.base_run.x) and np.array_equal(found.t, case.base_run.t)
    case.suite.check_true(f"{case.name}: loaded to the bit", alike and found.status == case.base_run.status)
    same = str(found.audit()) == str(case.base_run.audit())
    case.suite.check_true(f"{case.name}: the audit is that of the run", same)
    if ends := cut_times(case)[-1:]:
        middle = int(np.searchsorted(found.t, ends[0]))
        rests = [
            case.run(
                x0=run.x[middle],
                span=(run.t[middle], case.time),
                **({} if run.attitude is None else {"attitude": run.attitude[middle]}),
            )
            for run in (case.base_run, found)
        ]
        case.suite.check_true(f"{case.name}: goes on to the bit", np.array_equal(rests[0].x, rests[1].x))
    return None


def check_scipy(case: RelationCase) -> SkipReason:
    """SciPy's call takes the steps of ``integrate``, and finds the event that ``until`` finds."""
    if case.system.sites or case.system.space is not None:
        return "SciPy's states are vectors"
    if not has_error_estimate(case.method):
        return "the method has no estimate of its error"
    step = case.step if isinstance(case.step, Adaptive) else Adaptive(1e-8)

    def solved(**options):
        span = (0.0, case.time)
        return solve_ivp(case.system, span, case.x0, case.method, rtol=step.rtol, atol=step.atol, **options)

    ours = case.run(step=step)
    case.compare_states("solve_ivp", solved().y[:, -1], ours.x[-1], case.rounding_tolerance)
    i = int(np.argmax(np.abs(ours.x[-1] - ours.x[0])))
    crossing = _LevelCrossing(i, float(0.5 * (ours.x[0, i] + ours.x[-1, i])))
    if crossing.level == ours.x[0, i]:
        return None
    until = case.run(step=step, until=lambda x: x[i] - crossing.level)
    found = solved(events=crossing)
    there = found.status == 1 and until.event_time is not None
    case.suite.check_true(f"{case.name}: both find the event", there, found.message)
    if there:
        assert found.t_events is not None
        assert found.y_events is not None
        when = found.t_events[0][0] - until.event_time
        case.suite.check_small(f"{case.name}: when it is", when, case.time, case.rounding_tolerance)
        case.compare_states("where it is", found.y_events[0][0], until.x[-1], case.rounding_tolerance)
    return None


class _LevelCrossing:
    """The event that a component crosses a level, as SciPy has it."""

    terminal = True

    def __init__(self, component: int, level: float):
        self.component, self.level = component, level

    def __call__(self, t, y):
        return y[self.component] - self.level


def check_diffrax(case: RelationCase) -> SkipReason:
    """Diffrax's loop takes the steps of ``integrate``; backwards it takes those of minus the field."""
    if importlib.util.find_spec("diffrax") is None:
        return "diffrax is not installed"
    if isinstance(case.step, Adaptive) or case.system.is_driven or case.system.space is not None or case.system.sites:
        return "steps of one size on R^n are compared"
    import diffrax as peer

    from ..interop.diffrax import Solver, Term

    term, solver, h = Term(case.system), Solver(case.method), case.step

    def solved(start: float, end: float, step: float, x):
        control = peer.ConstantStepSize()
        run = peer.diffeqsolve(
            term, solver, start, end, step, x, stepsize_controller=control, max_steps=100_000, throw=False
        )
        assert run.ys is not None
        return run.ys[-1], bool(run.result == peer.RESULTS.successful)

    x, ok = solved(0.0, case.time, h, case.x0)
    case.suite.check_true(f"{case.name}: diffeqsolve succeeds", ok)
    case.compare_states("diffeqsolve", x, case.base_run.x[-1], case.rounding_tolerance)
    x, ok = solved(case.time, 0.0, -h, x)
    case.suite.check_true(f"{case.name}: backwards it succeeds", ok)
    case.compare_states("there and back", x, case.x0, 2.0 * case.resolution_tolerance)
    return None


RELATIONS: dict[str, Callable[[RelationCase], SkipReason]] = {
    "constant": check_energy_shift,
    "domain": check_local_entropy,
    "closure": check_closure,
    "shares": check_split_rate,
    "units": check_units,
    "order": check_component_order,
    "axes": check_rotated_axes,
    "side by side": check_uncoupled_pair,
    "reversal": check_reversal,
    "split": check_split_span,
    "noise": check_split_noise,
    "engines": check_engines,
    "ensemble": check_ensemble,
    "company": check_family,
    "study": check_study,
    "file": check_saved_run,
    "scipy": check_scipy,
    "diffrax": check_diffrax,
}
"""By name."""


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
    """Compare a run with itself, written down in other ways: what must not change a result, or must change it so.

    A constant in the energy; units of state and time by factors up to 1e20; components in another order and axes
    turned (another basis of the algebra); a rate shared by two dissipations; parameters closed over; an entropy that is
    known near the motion alone; a system beside itself; the motion backwards; a span in parts, with noise too; every
    engine; the run in an ensemble, beside members of other symmetry, in a study, from a file, by SciPy's and by
    diffrax's call.

    Parameters
    ----------
    system : System
    method : OneStepMethod, optional
        ``MetriplecticGauss(1)`` by default.
    x0 : array, optional
        The state that runs start from; a random one by default.
    step : float or Adaptive, optional
        By default the state moves by a hundredth of its size in a step.
    relations : collection of str, optional
        Some of ``liethermo.testing.RELATIONS``; by default all.
    time : float, optional
        That a run takes; by default forty steps, the state moving by two fifths of its size.
    seed : int
        Of the state, and of the axes.

    Returns
    -------
    Report
        Its first row says whether the run completes. A relation that cannot be asked of the system has a row that says
        why.

    Raises
    ------
    PropertyError
        If a relation does not hold, or the run fails.
    InputError
        If there is no relation of a name.
    """
    wanted = list(RELATIONS if relations is None else relations)
    if unknown := set(wanted) - set(RELATIONS):
        raise InputError(f"there is no relation {unknown.pop()!r}; there are {', '.join(RELATIONS)}")
    start = random_start(system, seed) if x0 is None else np.asarray(x0, dtype=np.float64)
    step = default_step(system, start) if step is None else step
    if time is None:
        time = N_STEPS * (default_step(system, start) if isinstance(step, Adaptive) else step)
    case = RelationCase(system, DEFAULT_METHOD if method is None else method, start, step, time, seed)
    check_completion(case.suite, "the run", case.base_run)
    for name in wanted:
        case.name = name
        if (reason := RELATIONS[name](case)) is not None:
            case.suite.skip_check(name, reason)
    return case.suite.report()
