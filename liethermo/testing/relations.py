"""Property suite of relations: changes of a run that must leave its result unchanged, or change it in a known way.

No reference solution is needed: a run is compared with an equivalent run [metamorphic testing: Chen, Cheung & Yiu
1998]. A constant in the energy, other units, another basis, a split span or another front end do not change the motion,
so any other difference is a fault.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import replace

import numpy as np

from manifolds.testing import Report

from ..errors import InputError
from ..functions.energy import Pullback
from ..functions.gradients import EPS
from ..integrators import DEFAULT_METHOD, MetriplecticTaylor, OneStepMethod
from ..integrators.base import is_permutation_equivariant
from ..runs.adaptive import Adaptive
from ..systems import System
from .relation_case import RelationCase, SkipReason, nearby_state
from .run_relations import (
    check_diffrax,
    check_engines,
    check_ensemble,
    check_family_members,
    check_saved_run,
    check_solve_ivp_matches_integrate,
    check_split_noise,
    check_split_span,
    check_study,
)
from .suites import N_STEPS, check_completion, default_step, random_start
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

ENERGY_SHIFTS = (1.0, -1.0, 1e4)
"""Constants added to an energy, in units of the energy's magnitude."""

SHIFT_ROUNDING_FACTOR = 100.0
"""Largest accumulated rounding error of a short run, in roundings of the added constant; 20 were observed."""

UNIT_FACTORS = ((1e12, 1e-12), (1e-12, 1e12), (1e20, 1.0), (1e-20, 1e-20))
"""Factors by which the state and the time are rescaled."""

N_KNOWN_STATES = 9
"""Number of states of the run near which the restricted entropy is defined."""


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
        return "states are not vectors of R^n whose functions depend on them alone"
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
    has_same_names = system.lie_algebra is None  # another basis has other Casimirs
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
        The system to test.
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
