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
from .relation_case import RelationCase, SkipReason, state_near_initial_state
from .run_relations import (
    check_diffrax_matches_integrate,
    check_engines_agree,
    check_ensemble_member_equals_run,
    check_member_is_independent_of_others,
    check_noise_of_split_run,
    check_run_split_in_time,
    check_saved_run_equals_loaded,
    check_solve_ivp_matches_integrate,
    check_study_point_equals_run,
)
from .suites import N_STEPS, check_run_completes, default_step_size, random_initial_state
from .transformations import (
    CoordinateChange,
    UncoupledPair,
    add_constant,
    dissipation_in_two_halves,
    hide_parameters_in_closures,
    replace_system_attributes,
    restrict_function_to_neighbourhood,
    transform_coordinates_and_units,
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
    """Check that adding a constant to the energy changes a run by rounding alone."""
    if case.system.is_driven:
        return "the energy depends on time"
    energy_scale = max(abs(float(case.base_run.energy[0])), float(case.system.energy.sensitivity(case.x0)))
    for factor in ENERGY_SHIFTS:
        run = case.run(
            replace_system_attributes(case.system, energy=add_constant(case.system.energy, factor * energy_scale))
        )
        case.compare_with_base_run(
            f"{factor:+g} of the energy's size",
            run,
            tolerance=max(case.rounding_tolerance, SHIFT_ROUNDING_FACTOR * EPS * abs(factor)),
        )
    return None


def check_entropy_defined_near_motion_only(case: RelationCase) -> SkipReason:
    """Check that a run does not change if the entropy is NaN far from its states."""
    system = case.system
    if system.entropy is None or system.space is not None or system.sites:
        return "there is no entropy on R^n"
    if isinstance(case.method, MetriplecticTaylor):
        return "an entropy that is NaN far from the motion has no Taylor series"
    path = case.base_run.x
    centres = path[np.unique(np.linspace(0, len(path) - 1, N_KNOWN_STATES).astype(int))]
    max_distance = np.linalg.norm(path[:, None] - centres, axis=2).min(axis=1).max()
    stride = np.linalg.norm(np.diff(path, axis=0), axis=1).max(initial=0.0)
    local_entropy = restrict_function_to_neighbourhood(
        system.entropy, centres, 2.0 * float(max_distance + stride) + 1e-6 * case.state_scale
    )
    case.compare_with_base_run(
        "an entropy that is known near the motion alone",
        case.run(replace_system_attributes(system, entropy=local_entropy)),
    )
    return None


def check_parameters_in_closures(case: RelationCase) -> SkipReason:
    """Check that a run does not change if the parameters of the energy are constants in closures, not leaves."""
    if case.system.is_driven or case.system.space is not None:
        return "the energy is not a plain function of the state"
    case.compare_with_base_run(
        "parameters closed over",
        case.run(replace_system_attributes(case.system, energy=hide_parameters_in_closures(case.system.energy))),
    )
    return None


def check_dissipation_split_into_halves(case: RelationCase) -> SkipReason:
    """Check that a run does not change if the dissipation is a sum of two with half of the rate each."""
    if case.system.dissipation is None:
        return "there is no dissipation"
    run = case.run(replace_system_attributes(case.system, dissipation=dissipation_in_two_halves(case.system)))
    case.compare_with_base_run("half of the rate, twice", run)
    rows, split_rows = ([row.law for row in s.audit().rows] for s in (case.base_run, run))
    case.suite.check_true(
        f"{case.name}: one row of the audit for each quantity",
        split_rows == rows,
        "" if split_rows == rows else f"{split_rows}",
    )
    return None


# -- coordinates and units ------------------------------------------------------------------------------------------


def why_state_is_not_a_plain_vector(case: RelationCase) -> SkipReason:
    """Return why the states of a system cannot be transformed linearly, as a text, or None if they can."""
    system = case.system
    if system.is_driven or system.space is not None or system.sites:
        return "states are not vectors of R^n whose functions depend on them alone"
    return None


def check_change_of_units(case: RelationCase) -> SkipReason:
    """Check that a run in other units of state, time, energy and entropy has equal results."""
    if reason := why_state_is_not_a_plain_vector(case):
        return reason
    for state_factor, time_factor in UNIT_FACTORS:
        change = CoordinateChange(
            state_factor * np.eye(case.system.dim), time_factor, state_factor / time_factor, state_factor**0.5
        )
        options = (
            {"step": case.step * time_factor}
            if isinstance(case.step, float)
            else {"step": _rescale_adaptive_step(case.step, state_factor, time_factor)}
        )
        run = case.run(
            transform_coordinates_and_units(case.system, change),
            change.to_new(case.x0),
            (0.0, case.time * time_factor),
            **options,
        )
        case.compare_with_base_run(f"states times {state_factor:g}, times times {time_factor:g}", run, change.to_old)
    return None


def _rescale_adaptive_step(step: Adaptive, state_factor: float, time_factor: float) -> Adaptive:
    """Return adaptive steps with the tolerance and the step limits in other units of state and time."""
    step_limits = {
        name: value * time_factor for name in ("first", "largest") if (value := getattr(step, name)) is not None
    }
    return replace(step, atol=step.atol * state_factor, **step_limits)


def check_reversed_component_order(case: RelationCase) -> SkipReason:
    """Check that a run with the components of the state in reverse order has equal results."""
    n = case.system.dim
    return _check_linear_map(case, "components the other way round", np.eye(n)[::-1], True)


def check_rotated_axes(case: RelationCase) -> SkipReason:
    """Check that a run with rotated axes, or in another basis of the algebra, has equal results."""
    n = case.system.dim
    matrix = np.linalg.qr(np.random.default_rng(case.seed).standard_normal((n, n)))[0]
    is_adaptive = isinstance(
        case.step, Adaptive
    )  # their error norm is the largest component, which depends on the axes
    return _check_linear_map(case, "axes turned", matrix, not is_adaptive)


def _check_linear_map(case: RelationCase, description: str, matrix: np.ndarray, takes_equal_steps: bool) -> SkipReason:
    """Check that a run in linearly transformed coordinates has equal results."""
    if reason := why_state_is_not_a_plain_vector(case):
        return reason
    if case.system.matrix_group is not None:
        return "the attitude is of a group with a basis of its own"
    change, system = CoordinateChange(matrix), case.system
    run = case.run(transform_coordinates_and_units(system, change), change.to_new(case.x0))
    is_exact = (
        takes_equal_steps
        and is_permutation_equivariant(case.method)
        and not any(isinstance(term, Pullback) for term in system.energy.terms)
    )
    has_same_function_names = system.lie_algebra is None  # another basis has other Casimirs
    case.compare_with_base_run(
        description,
        run,
        change.to_old,
        case.rounding_tolerance if is_exact else case.discretisation_tolerance,
        has_same_function_names,
    )
    return None


def check_uncoupled_pair(case: RelationCase) -> SkipReason:
    """Check that a system of two uncoupled copies moves like the single systems."""
    if reason := why_state_is_not_a_plain_vector(case):
        return reason
    n, second_initial_state = case.system.dim, state_near_initial_state(case)
    pair = case.run(UncoupledPair(case.system), np.concatenate([case.x0, second_initial_state]))
    single_runs = case.base_run, case.run(x0=second_initial_state)
    check_run_completes(case.suite, f"{case.name}: the pair", pair)
    for run, component, name in zip(single_runs, (pair.x[-1][:n], pair.x[-1][n:]), ("one", "the other"), strict=True):
        case.compare_states_with_expected(f"{name} of a pair", component, run.x[-1], case.discretisation_tolerance)
    is_same_verdict = pair.audit().passed == all(run.audit().passed for run in single_runs)
    case.suite.check_true(f"{case.name}: the verdict of a pair is that of both", is_same_verdict)
    return None


# -- time -----------------------------------------------------------------------------------------------------------


def check_time_reversal(case: RelationCase) -> SkipReason:
    """Check that a motion without dissipation returns to its start if the sign of the energy is reversed."""
    system = case.system
    if system.total_dissipation.terms or system.is_driven:
        return "the motion is not reversible"
    reversed_run = case.run(replace_system_attributes(system, energy=-system.energy), case.base_run.x[-1])
    is_symmetric = not case.method.explicit and not isinstance(case.step, Adaptive)
    case.compare_states_with_expected(
        "there and back",
        reversed_run.x[-1],
        case.x0,
        case.rounding_tolerance if is_symmetric else 2.0 * case.discretisation_tolerance,
    )
    return None


RELATIONS: dict[str, Callable[[RelationCase], SkipReason]] = {
    "constant": check_energy_shift,
    "domain": check_entropy_defined_near_motion_only,
    "closure": check_parameters_in_closures,
    "shares": check_dissipation_split_into_halves,
    "units": check_change_of_units,
    "order": check_reversed_component_order,
    "axes": check_rotated_axes,
    "side by side": check_uncoupled_pair,
    "reversal": check_time_reversal,
    "split": check_run_split_in_time,
    "noise": check_noise_of_split_run,
    "engines": check_engines_agree,
    "ensemble": check_ensemble_member_equals_run,
    "company": check_member_is_independent_of_others,
    "study": check_study_point_equals_run,
    "file": check_saved_run_equals_loaded,
    "scipy": check_solve_ivp_matches_integrate,
    "diffrax": check_diffrax_matches_integrate,
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
    initial_state = random_initial_state(system, seed) if x0 is None else np.asarray(x0, dtype=np.float64)
    step = default_step_size(system, initial_state) if step is None else step
    if time is None:
        time = N_STEPS * (default_step_size(system, initial_state) if isinstance(step, Adaptive) else step)
    case = RelationCase(system, DEFAULT_METHOD if method is None else method, initial_state, step, time, seed)
    check_run_completes(case.suite, "the run", case.base_run)
    for name in relation_names:
        case.name = name
        if (reason := RELATIONS[name](case)) is not None:
            case.suite.skip_check(name, reason)
    return case.suite.report()
