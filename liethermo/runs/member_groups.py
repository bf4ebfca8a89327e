"""Groups of members of a family that conserve the same functions.

A program of a family takes the parameters of its members as arguments, but which functions a step holds is part of the
program. The invariants of a member follow from its own parameters: an isotropic body conserves a Casimir that other
bodies do not. So every member is judged, at the states at which it would be judged alone, and members that conserve
the same functions are run together.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from manifolds._pytree_module import replace_fields

from ..integrators import OneStepMethod
from ..integrators.preserved import casimir_residuals, non_casimir_mask, nonconservation_message
from ..systems import System
from ..systems.conservation import function_rates_of_change, judge_conservation
from ..systems.interface import InvariantVerdicts
from ..systems.invariants import (
    first_proportional_indices,
    invariants_by_construction,
    n_test_states_per_scale,
    name_preserved_functions,
    named_then_preserved_functions,
    random_test_states,
    stack_gradients,
    states_near,
    systems_at_test_times,
    undecided_function_names,
)
from ..tracing.interpret import evaluate_at_points
from .system_family import Family

MAX_VALUES_PER_CALL = 2**21
"""Largest number of parameters and state components, summed over all points of one evaluation, which bounds memory."""

VERDICT_UNKNOWN = -1
"""Verdict on a function of a member whose conservation could not be decided."""

VERDICT_NOT_CONSERVED = 0
"""Verdict on a function that a member does not conserve."""

VERDICT_CONSERVED = 1
"""Verdict on a function that a member conserves."""


class InvariantFacts(NamedTuple):
    """Properties of a member that depend on its parameters and select the program that runs it.

    Attributes
    ----------
    preserved_labels : tuple of str or None
        Names of the functions that its dissipation must preserve.
    invariant_verdicts : InvariantVerdicts
        Verdicts on the functions that it conserves.
    """

    preserved_labels: tuple[str, ...] | None
    invariant_verdicts: InvariantVerdicts


def attach_invariant_facts(system: System, facts: InvariantFacts) -> System:
    """Return a copy of the system with the facts on its invariants as attributes."""
    return replace_fields(system, **facts._asdict())


class MemberGroup(NamedTuple):
    """Members of a family that one program can run.

    Attributes
    ----------
    indices : array of int
        Numbers of the members in the whole family.
    family : Family
        The family of these members.
    """

    indices: np.ndarray
    family: Family


def group_members_by_invariants(
    family: Family, method: OneStepMethod, initial_states: np.ndarray
) -> tuple[list[MemberGroup], dict[int, str]]:
    """Return groups of members that conserve the same functions, and the reasons why the method cannot run others.

    The keys of the second result are member indices.

    Parameters
    ----------
    family : Family
    method : OneStepMethod
        The functions that the method is asked to preserve are judged too.
    initial_states : array, shape (B, n)
        The initial state of each trajectory. If a function cannot be evaluated at random states, it is judged near the
        initial state.
    """
    member_indices, member = np.arange(len(initial_states)), family.representative
    if member.invariant_verdicts is not None:
        return [MemberGroup(member_indices, family)], {}
    if not any(family.has_member_axis) and not undecided_function_names(member):
        return [MemberGroup(member_indices, family)], {}
    invariant_tests = _MemberInvariantTests(family, member, method, initial_states)
    if not (invariant_tests.casimirs or member.preserved_functions or invariant_tests.requested_functions):
        return [MemberGroup(member_indices, family)], {}
    multiples, known_verdicts, requested_verdicts = (
        invariant_tests.proportional_function_indices(),
        invariant_tests.verdicts_of_casimirs_and_preserved(),
        invariant_tests.verdicts_of_requested_functions(),
    )
    refusal_reasons = {
        int(i): nonconservation_message(invariant_tests.requested_functions[j])
        for i, j in np.argwhere(requested_verdicts == VERDICT_NOT_CONSERVED)[::-1]
    }
    rows = np.concatenate([multiples, known_verdicts, invariant_tests.are_requested_functions_momentum_maps()], axis=1)
    groups = []
    unique_rows, row_kinds = np.unique(rows, axis=0, return_inverse=True)
    for kind, row in enumerate(unique_rows):
        indices = np.setdiff1d(np.flatnonzero(row_kinds.ravel() == kind), list(refusal_reasons))
        if indices.size:
            facts = invariant_tests.facts_from_multiples_and_verdicts(
                *np.split(row[: multiples.shape[1] + known_verdicts.shape[1]], [multiples.shape[1]])
            )
            groups.append(MemberGroup(indices, family.select(indices).annotate_members(attach_invariant_facts, facts)))
    return sorted(groups, key=lambda group: int(group.indices[0])), refusal_reasons


def common_inertia(family: Family) -> np.ndarray | None:
    """Return the tensor of inertia, shape (3, 3), of a family of rigid bodies; None unless all members share it."""
    member = family.member(0)
    inertia = member.inertia
    if inertia is None or not any(family.has_member_axis):
        return inertia
    parameters = family.parameter_matrix(slice(None), family.size)
    for rows in (parameters[[0, -1]], parameters):  # two are enough to see that they differ
        inverses = evaluate_at_points(_inverse_inertia, (family.program_structure, parameters.shape[1]), rows)
        if not (inverses == inverses[0]).all():
            return None
    return inertia


def members_outside_domain(family: Family, initial_states: np.ndarray) -> list[int]:
    """Return the indices of the members whose initial states are outside the domain that their parameters define."""
    if family.member(0).domain.margin is None:
        return []
    parameters = family.parameter_matrix(slice(None), len(initial_states))
    margins = evaluate_at_points(
        _domain_margin,
        (family.program_structure, parameters.shape[1]),
        np.concatenate([parameters, initial_states], axis=1),
    )
    return np.flatnonzero(~(margins > 0.0)).tolist()


class _MemberInvariantTests:
    """Tests of the functions that each member of a family conserves, at random states and near its initial state.

    Parameters
    ----------
    family : Family
    example_member : System
        One member; all members have functions of the same names.
    method : OneStepMethod
    initial_states : array, shape (B, n)
    """

    def __init__(self, family: Family, example_member: System, method: OneStepMethod, initial_states: np.ndarray):
        self.family, self.member, self.states = family, example_member, initial_states
        self.requested_functions = method.requested_invariants(example_member)
        self.casimirs = tuple(
            name for name in example_member.casimirs() if name not in invariants_by_construction(example_member)
        )

    # -- facts --------------------------------------------------------------------------------------------------------

    def proportional_function_indices(self) -> np.ndarray:
        """Return the index of a function proportional to each preserved function, or -1; shape (B, preserved)."""
        count = len(self.member.preserved_functions)
        if not count:
            return np.zeros((len(self.states), 0), dtype=int)
        points = random_test_states(self.member, 2)
        values_per_member = len(points) * len(named_then_preserved_functions(self.member)) * self.member.dim
        return self._evaluate_in_batches(
            lambda rows: first_proportional_indices(
                self._evaluate_at_member_points(
                    _gradients_of_named_and_preserved_functions, rows, self._rescaled_points_per_member(points, rows)
                ),
                count,
            ),
            values_per_member,
        )

    def verdicts_of_casimirs_and_preserved(self) -> np.ndarray:
        """Return verdicts on Casimirs that are not conserved by construction, and on preserved functions.

        The shape is (B, Casimirs + preserved functions).
        """
        count, member = len(self.casimirs) + len(self.member.preserved_functions), self.member
        verdicts = self._judge_functions(
            _rates_of_casimirs_and_preserved_functions, count, self.casimirs, use_nearby_states=True
        )
        # a torque may be zero at the test times only, so no function on which it acts counts as conserved
        torque = member.torque_laws
        has_torque = [name in torque.changed_casimirs for name in self.casimirs]
        has_torque += [torque.name != ""] * len(member.preserved_functions)
        return np.where(np.array(has_torque, dtype=bool), VERDICT_NOT_CONSERVED, verdicts)

    def verdicts_of_requested_functions(self) -> np.ndarray:
        """Return verdicts on the functions that the method is asked to preserve, shape (B, functions)."""
        return self._judge_functions(
            _rates_of_requested_functions,
            len(self.requested_functions),
            self.requested_functions,
            use_nearby_states=False,
        )

    def are_requested_functions_momentum_maps(self) -> np.ndarray:
        """Return whether each function that the method must preserve is a momentum map, not a Casimir.

        The shape is (B, functions).
        """
        if not self.requested_functions:
            return np.zeros((len(self.states), 0), dtype=int)
        points = self.member.samples(4)
        values_per_member = points.size * len(self.requested_functions)
        return self._evaluate_in_batches(
            lambda rows: non_casimir_mask(
                self._evaluate_at_member_points(
                    _casimir_residuals_of_requested_functions,
                    rows,
                    self._rescaled_points_per_member(points, rows),
                    self.requested_functions,
                )
            ),
            values_per_member,
        )

    def facts_from_multiples_and_verdicts(
        self, proportional_indices: np.ndarray, verdict_row: np.ndarray
    ) -> InvariantFacts:
        """Return the invariant facts of a member, from its row of indices of proportional functions and of verdicts."""
        member = self.member
        names = name_preserved_functions(member, proportional_indices.tolist())
        truth_values = {VERDICT_UNKNOWN: None, VERDICT_NOT_CONSERVED: False, VERDICT_CONSERVED: True}
        verdicts: dict[str, bool | None] = {}
        for name, verdict in zip((*names, *self.casimirs), np.roll(verdict_row, len(names)).tolist(), strict=True):
            verdicts[name] = truth_values[verdict]  # a Casimir overwrites a preserved function of the same name
        verdicts |= dict.fromkeys(invariants_by_construction(member), True)
        return InvariantFacts(
            names if names else member.preserved_labels, InvariantVerdicts.from_verdicts(verdicts, names)
        )

    # -- verdicts -----------------------------------------------------------------------------------------------------

    def _judge_functions(
        self, rates_of_functions: Callable, n_functions: int, functions: tuple, use_nearby_states: bool
    ) -> np.ndarray:
        """Return verdicts on functions of each member, shape (B, n_functions), by the rules of :func:`.are_conserved`.

        With ``use_nearby_states``, states near the initial state are tried where random states leave a function
        undecided.
        """
        times = range(len(systems_at_test_times(self.member))) if self.member.is_driven else (None,)
        verdicts_at_times = np.stack(
            [
                self._judge_functions_at_test_time(rates_of_functions, n_functions, functions, time, use_nearby_states)
                for time in times
            ]
        )
        unknown = np.where((verdicts_at_times == VERDICT_UNKNOWN).any(axis=0), VERDICT_UNKNOWN, VERDICT_CONSERVED)
        return np.where((verdicts_at_times == VERDICT_NOT_CONSERVED).any(axis=0), VERDICT_NOT_CONSERVED, unknown)

    def _judge_functions_at_test_time(
        self,
        rates_of_functions: Callable,
        n_functions: int,
        functions: tuple,
        test_time_index: int | None,
        use_nearby_states: bool,
    ) -> np.ndarray:
        """Return verdicts on functions of each member, shape (B, n_functions), at one test time of driven members."""
        n_members, member = len(self.states), self.member
        if not n_functions:
            return np.zeros((n_members, 0), dtype=int)
        is_defined, is_violated = np.zeros((2, n_members, n_functions), dtype=bool)

        def judge_at_states(
            member_indices: np.ndarray, states_of_members: Callable[[np.ndarray], np.ndarray], n_states: int
        ) -> None:
            """Mark the functions of these members that are defined, or not conserved, at one of ``n_states`` states."""

            def judge_members(member_indices: np.ndarray) -> np.ndarray:
                """Return whether each function is defined and whether it is violated; shape (members, 2, functions)."""
                judgement = judge_conservation(
                    self._evaluate_at_member_points(
                        rates_of_functions,
                        member_indices,
                        states_of_members(member_indices),
                        functions,
                        test_time_index,
                    )
                )
                return np.stack(
                    [judgement.is_defined.any(axis=1), (judgement.is_defined & ~judgement.is_conserved).any(axis=1)],
                    axis=1,
                )

            if member_indices.size:
                defined_and_violated = self._evaluate_in_batches(judge_members, n_states * member.dim, member_indices)
                is_defined[member_indices] |= defined_and_violated[:, 0]
                is_violated[member_indices] |= defined_and_violated[:, 1]

        sample_points = random_test_states(member, n_test_states_per_scale(member))
        # one state is enough to see that a function is not conserved
        for points in (sample_points[:1], sample_points[1:]):
            undecided_members = np.flatnonzero(~is_violated.all(axis=1))
            judge_at_states(undecided_members, functools.partial(self._rescaled_points_per_member, points), len(points))
        if use_nearby_states:
            undecided_members = np.flatnonzero(~(is_defined | is_violated).all(axis=1))
            n_states = len(states_near(member, self.states[0]))
            judge_at_states(
                undecided_members, lambda rows: np.stack([states_near(member, x) for x in self.states[rows]]), n_states
            )
        return np.where(is_violated, VERDICT_NOT_CONSERVED, np.where(is_defined, VERDICT_CONSERVED, VERDICT_UNKNOWN))

    # -- evaluation ---------------------------------------------------------------------------------------------------

    def _evaluate_at_member_points(
        self, function: Callable, member_indices: np.ndarray, points: np.ndarray, *function_arguments
    ) -> Any:
        """Return the values of a function at points of each member; shapes (members, points, n) to (members, points,
        ...)."""
        parameters = self.family.parameter_matrix(member_indices, len(member_indices))
        inputs = np.concatenate(
            [np.repeat(parameters, points.shape[1], axis=0), points.reshape(-1, points.shape[-1])], axis=1
        )
        with np.errstate(all="ignore"):
            values = evaluate_at_points(
                function, (self.family.program_structure, parameters.shape[1], *function_arguments), inputs
            )
        leading = points.shape[:2]
        if isinstance(values, tuple):
            return type(values)(*(np.asarray(a).reshape(*leading, *np.shape(a)[1:]) for a in values))
        return np.asarray(values).reshape(*leading, *np.shape(values)[1:])

    def _rescaled_points_per_member(self, points: np.ndarray, member_indices: np.ndarray) -> np.ndarray:
        """Return points for each member, shape (members, points, n), from those of one member, shape (points, n).

        Entropies of baths are rescaled by the heat capacities of each member.
        """
        points = np.broadcast_to(points, (len(member_indices), *points.shape))
        baths = self.member.baths
        if not baths.number or not any(self.family.has_member_axis):
            return points
        parameters = self.family.parameter_matrix(member_indices, len(member_indices))
        scales = evaluate_at_points(
            _bath_entropy_scales, (self.family.program_structure, parameters.shape[1]), parameters
        )[:, None]
        points = points.copy()
        points[..., self.member.body_dim :] *= scales / baths.constant_entropy_scales
        return points

    def _evaluate_in_batches(
        self, function_of_indices: Callable, values_per_member: int, member_indices: np.ndarray | None = None
    ) -> np.ndarray:
        """Return the values of a function of member indices, evaluated in batches to bound memory."""
        member_indices = np.arange(len(self.states)) if member_indices is None else member_indices
        batch_size = max(1, MAX_VALUES_PER_CALL // max(values_per_member, 1))
        values = [
            function_of_indices(member_indices[i : i + batch_size]) for i in range(0, len(member_indices), batch_size)
        ]
        return np.concatenate(values) if len(values) > 1 else values[0]


def _unpack_member_and_state(
    structure, n_parameters: int, row, test_time_index: int | None = None
) -> tuple[System, jnp.ndarray]:
    """Return the member and the state in a row of parameters and a state; a driven member is taken at a test time."""
    system = structure.build(row[:n_parameters])
    return (system if test_time_index is None else systems_at_test_times(system)[test_time_index]), row[n_parameters:]


def _gradients_of_named_and_preserved_functions(model, row):
    structure, n_parameters = model
    system, x = _unpack_member_and_state(structure, n_parameters, row)
    return stack_gradients(named_then_preserved_functions(system), x)


def _rates_of_casimirs_and_preserved_functions(model, row):
    structure, n_parameters, casimirs, time = model
    system, x = _unpack_member_and_state(structure, n_parameters, row, time)
    casimir_functions = system.casimirs()
    return function_rates_of_change(
        (system, (*(casimir_functions[name] for name in casimirs), *system.preserved_functions)), x
    )


def _rates_of_requested_functions(model, row):
    structure, n_parameters, functions, time = model
    system, x = _unpack_member_and_state(structure, n_parameters, row, time)
    return function_rates_of_change((system, functions), x)


def _casimir_residuals_of_requested_functions(model, row):
    structure, n_parameters, functions = model
    system, x = _unpack_member_and_state(structure, n_parameters, row)
    return casimir_residuals((system, functions), x)


def _bath_entropy_scales(model, row):
    structure, n_parameters = model
    system, _ = _unpack_member_and_state(structure, n_parameters, row)
    return system.baths.entropy_scales()


def _domain_margin(model, row):
    structure, n_parameters = model
    system, x = _unpack_member_and_state(structure, n_parameters, row)
    return system.domain.margin_at(x)


def _inverse_inertia(model, row):
    structure, n_parameters = model
    body = _unpack_member_and_state(structure, n_parameters, row)[0].drop_baths()
    return jax.jacfwd(body.energy.gradient)(jnp.zeros(body.dim))
