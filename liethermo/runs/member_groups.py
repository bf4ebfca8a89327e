"""Members of a family, grouped by what they conserve.

A program of a family takes the parameters of its members as arguments, but which functions a step holds is part of the
program. What a member conserves follows from its own parameters: an isotropic body conserves a Casimir that other
bodies do not. So every member is judged, at the states at which it would be judged alone, and members that conserve
the same functions are run together.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from copy import copy
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ..integrators import OneStepMethod
from ..integrators.preserved import casimir_residuals, is_momentum_map, why_not_preserved
from ..systems import System
from ..systems.base import first_multiple_indices, stack_gradients
from ..systems.baths import HeatBaths
from ..systems.conservation import judge_conservation, rates_of_change
from ..systems.interface import InvariantVerdicts
from ..tracing.interpret import evaluate_at_points
from .family import Family

MAX_VALUES_PER_CALL = 2**21
"""Largest number of parameters and state components, of all points together, at which a function is evaluated."""

VERDICT_UNKNOWN, VERDICT_NOT_CONSERVED, VERDICT_CONSERVED = -1, 0, 1
"""What is known of a function and a member."""


class InvariantFacts(NamedTuple):
    """What depends on the parameters of a member and belongs to the program that runs it.

    Attributes
    ----------
    preserved_labels : tuple of str or None
        The names of the functions that its dissipation has to preserve.
    invariant_verdicts : Decided
        Which functions it conserves.
    """

    preserved_labels: tuple[str, ...] | None
    invariant_verdicts: InvariantVerdicts


def with_invariant_facts(system: System, facts: InvariantFacts) -> System:
    """Return the system with what is known of it."""
    system = copy(system)
    for name, value in facts._asdict().items():
        object.__setattr__(system, name, value)
    return system


class MemberGroup(NamedTuple):
    """Members that one program can run.

    Attributes
    ----------
    indices : array of int
        Their numbers in the family.
    family : Family
    """

    indices: np.ndarray
    family: Family


def group_members(
    family: Family, method: OneStepMethod, states: np.ndarray
) -> tuple[list[MemberGroup], dict[int, str]]:
    """Return the groups of a family, and the members that a method cannot run with the reasons.

    Parameters
    ----------
    family : Family
    method : OneStepMethod
        The functions that it is asked to preserve are judged too.
    states : array, shape (B, n)
        The initial state of each trajectory. A function that cannot be evaluated at random states is judged near it.
    """
    everyone, member = np.arange(len(states)), family.representative
    if member.invariant_verdicts is not None:
        return [MemberGroup(everyone, family)], {}
    if not any(family.has_member_axis) and not member.undecided_functions():
        return [MemberGroup(everyone, family)], {}
    members = _MemberFunctions(family, member, method, states)
    if not (members.casimirs or member.preserved or members.requested_functions):
        return [MemberGroup(everyone, family)], {}
    multiples, named, asked = members.multiple_indices(), members.verdicts_of_named(), members.verdicts_of_requested()
    refused = {
        int(i): why_not_preserved(members.requested_functions[j])
        for i, j in np.argwhere(asked == VERDICT_NOT_CONSERVED)[::-1]
    }
    rows = np.concatenate([multiples, named, members.are_momentum_maps()], axis=1)
    groups = []
    kinds, kind_of = np.unique(rows, axis=0, return_inverse=True)
    for kind, row in enumerate(kinds):
        places = np.setdiff1d(np.flatnonzero(kind_of.ravel() == kind), list(refused))
        if places.size:
            facts = members.invariant_facts(*np.split(row[: multiples.shape[1] + named.shape[1]], [multiples.shape[1]]))
            groups.append(MemberGroup(places, family.select(places).annotate_members(with_invariant_facts, facts)))
    return sorted(groups, key=lambda group: int(group.indices[0])), refused


def common_inertia(family: Family) -> np.ndarray | None:
    """Return the tensor of inertia of a rigid body, shape (3, 3), if all members have the same; otherwise None."""
    member = family.member(0)
    inertia = member.inertia
    if inertia is None or not any(family.has_member_axis):
        return inertia
    own = family.parameter_matrix(slice(None), family.size)
    for rows in (own[[0, -1]], own):  # two are enough to see that they differ
        inverses = evaluate_at_points(_inverse_inertia, (family.form, own.shape[1]), rows)
        if not (inverses == inverses[0]).all():
            return None
    return inertia


def members_outside_domain(family: Family, states: np.ndarray) -> list[int]:
    """Return the members whose parameters do not allow their initial states, shape (B, n)."""
    if family.member(0).domain_margin(jnp.asarray(states[0])) is None:
        return []
    own = family.parameter_matrix(slice(None), len(states))
    margins = evaluate_at_points(_domain_margin, (family.form, own.shape[1]), np.concatenate([own, states], axis=1))
    return np.flatnonzero(~(margins > 0.0)).tolist()


class _MemberFunctions:
    """Functions of the members of a family, evaluated at states of each.

    Parameters
    ----------
    family : Family
    member : System
        One of them: all have functions of the same names.
    method : OneStepMethod
    states : array, shape (B, n)
    """

    def __init__(self, family: Family, member: System, method: OneStepMethod, states: np.ndarray):
        self.family, self.member, self.states = family, member, states
        self.requested_functions = method.requested_invariants(member)
        self.casimirs = tuple(name for name in member.casimirs() if name not in member.invariants_by_construction())

    # -- facts --------------------------------------------------------------------------------------------------------

    def multiple_indices(self) -> np.ndarray:
        """The place of the function of which each preserved one is a multiple, shape (B, preserved); -1 for none."""
        count = len(self.member.preserved)
        if not count:
            return np.zeros((len(self.states), 0), dtype=int)
        points = self.member.test_states(2)
        each = len(points) * len(self.member.functions_for_naming()) * self.member.dim
        return self._evaluate_in_batches(
            lambda rows: first_multiple_indices(
                self._evaluate_at(_nameable_gradients, rows, self._points_per_member(points, rows)), count
            ),
            each,
        )

    def verdicts_of_named(self) -> np.ndarray:
        """On each Casimir that is not conserved by form, then on what is preserved: shape (B, functions)."""
        count, member = len(self.casimirs) + len(self.member.preserved), self.member
        verdicts = self._judge_functions(_named_rates, count, self.casimirs, near=True)
        # a torque that is zero at some times tells nothing of others
        acted_on = [member.torque_name and name not in member.torque_invariant_casimirs for name in self.casimirs]
        acted_on += [bool(member.torque_name)] * len(member.preserved)
        return np.where(np.array(acted_on, dtype=bool), VERDICT_NOT_CONSERVED, verdicts)

    def verdicts_of_requested(self) -> np.ndarray:
        """On each function that the method is asked to preserve, shape (B, functions)."""
        return self._judge_functions(
            _requested_rates, len(self.requested_functions), self.requested_functions, near=False
        )

    def are_momentum_maps(self) -> np.ndarray:
        """Which of the functions that the method is asked to preserve are no Casimirs, shape (B, functions)."""
        if not self.requested_functions:
            return np.zeros((len(self.states), 0), dtype=int)
        points = self.member.samples(4)
        each = points.size * len(self.requested_functions)
        return self._evaluate_in_batches(
            lambda rows: is_momentum_map(
                self._evaluate_at(
                    _requested_moved_fractions, rows, self._points_per_member(points, rows), self.requested_functions
                )
            ),
            each,
        )

    def invariant_facts(self, multiples: np.ndarray, named: np.ndarray) -> InvariantFacts:
        """From what was found of one member."""
        member = self.member
        names = member.names_from_multiples(multiples.tolist())
        known = {VERDICT_UNKNOWN: None, VERDICT_NOT_CONSERVED: False, VERDICT_CONSERVED: True}
        verdicts: dict[str, bool | None] = {}
        for name, verdict in zip((*names, *self.casimirs), np.roll(named, len(names)).tolist(), strict=True):
            verdicts[name] = known[verdict]  # a Casimir after what is preserved, which may have its name
        verdicts |= dict.fromkeys(member.invariants_by_construction(), True)
        return InvariantFacts(
            names if names else member.preserved_labels, InvariantVerdicts.from_verdicts(verdicts, names)
        )

    # -- verdicts -----------------------------------------------------------------------------------------------------

    def _judge_functions(self, rates: Callable, count: int, functions: tuple, near: bool) -> np.ndarray:
        """What is known of some functions of each member, as :meth:`.System.conserves` finds it of one.

        With ``near``, states near the first of a trajectory are tried where random states have left a function open.
        """
        times = range(len(self.member.systems_at_test_times())) if self.member.is_driven else (None,)
        each = np.stack([self._judge_functions_at_time(rates, count, functions, time, near) for time in times])
        unknown = np.where((each == VERDICT_UNKNOWN).any(axis=0), VERDICT_UNKNOWN, VERDICT_CONSERVED)
        return np.where((each == VERDICT_NOT_CONSERVED).any(axis=0), VERDICT_NOT_CONSERVED, unknown)

    def _judge_functions_at_time(
        self, rates: Callable, count: int, functions: tuple, time: int | None, near: bool
    ) -> np.ndarray:
        size, member = len(self.states), self.member
        if not count:
            return np.zeros((size, 0), dtype=int)
        defined, broken = np.zeros((2, size, count), dtype=bool)

        def try_states(rows: np.ndarray, states_of: Callable[[np.ndarray], np.ndarray], number: int) -> None:
            def judge_rows(rows: np.ndarray) -> np.ndarray:
                found = judge_conservation(self._evaluate_at(rates, rows, states_of(rows), functions, time))
                return np.stack(
                    [found.is_defined.any(axis=1), (found.is_defined & ~found.is_conserved).any(axis=1)], axis=1
                )

            if rows.size:
                result = self._evaluate_in_batches(judge_rows, number * member.dim, rows)
                defined[rows] |= result[:, 0]
                broken[rows] |= result[:, 1]

        random = member.test_states(member.test_states_per_scale)
        for some in (random[:1], random[1:]):  # one state is enough to see that a function is not conserved
            left = np.flatnonzero(~broken.all(axis=1))
            try_states(left, functools.partial(self._points_per_member, some), len(some))
        if near:
            left = np.flatnonzero(~(defined | broken).all(axis=1))
            number = len(member.states_near(self.states[0]))
            try_states(left, lambda rows: np.stack([member.states_near(x) for x in self.states[rows]]), number)
        return np.where(broken, VERDICT_NOT_CONSERVED, np.where(defined, VERDICT_CONSERVED, VERDICT_UNKNOWN))

    # -- evaluation ---------------------------------------------------------------------------------------------------

    def _evaluate_at(self, function: Callable, rows: np.ndarray, points: np.ndarray, *model) -> Any:
        """What a function of members gives at points of each, shape (rows, points, n): with both axes in front."""
        own = self.family.parameter_matrix(rows, len(rows))
        at = np.concatenate([np.repeat(own, points.shape[1], axis=0), points.reshape(-1, points.shape[-1])], axis=1)
        with np.errstate(all="ignore"):
            found = evaluate_at_points(function, (self.family.form, own.shape[1], *model), at)
        leading = points.shape[:2]
        if isinstance(found, tuple):
            return type(found)(*(np.asarray(a).reshape(*leading, *np.shape(a)[1:]) for a in found))
        return np.asarray(found).reshape(*leading, *np.shape(found)[1:])

    def _points_per_member(self, points: np.ndarray, rows: np.ndarray) -> np.ndarray:
        """Random states of one member, shape (points, n), as those of others, shape (rows, points, n).

        The entropies of baths are random relative to the capacities, which are those of each member.
        """
        points = np.broadcast_to(points, (len(rows), *points.shape))
        baths = self.member.baths
        if baths is None or not any(self.family.has_member_axis):
            return points
        own = self.family.parameter_matrix(rows, len(rows))
        scales = evaluate_at_points(_bath_entropy_scales, (self.family.form, own.shape[1]), own)[:, None]
        points = points.copy()
        points[..., self.member.body_dim :] *= scales / baths.scale
        return points

    def _evaluate_in_batches(self, function: Callable, numbers: int, rows: np.ndarray | None = None) -> np.ndarray:
        """The values of a function of rows of members, a portion after another: bounded memory."""
        rows = np.arange(len(self.states)) if rows is None else rows
        portion = max(1, MAX_VALUES_PER_CALL // max(numbers, 1))
        found = [function(rows[i : i + portion]) for i in range(0, len(rows), portion)]
        return np.concatenate(found) if len(found) > 1 else found[0]


def _member_and_state(form, p: int, at, time: int | None = None) -> tuple[System, jnp.ndarray]:
    """The member with the parameters that a row begins with, as it is at one of some times; and the state behind."""
    system = form.build(at[:p])
    return (system if time is None else system.systems_at_test_times()[time]), at[p:]


def _nameable_gradients(model, at):
    form, p = model
    system, x = _member_and_state(form, p, at)
    return stack_gradients(system.functions_for_naming(), x)


def _named_rates(model, at):
    form, p, casimirs, time = model
    system, x = _member_and_state(form, p, at, time)
    known = system.casimirs()
    return rates_of_change((system, (*(known[name] for name in casimirs), *system.preserved)), x)


def _requested_rates(model, at):
    form, p, functions, time = model
    system, x = _member_and_state(form, p, at, time)
    return rates_of_change((system, functions), x)


def _requested_moved_fractions(model, at):
    form, p, functions = model
    system, x = _member_and_state(form, p, at)
    return casimir_residuals((system, functions), x)


def _bath_entropy_scales(model, at):
    form, p = model
    system, _ = _member_and_state(form, p, at)
    assert isinstance(system.baths, HeatBaths)
    return system.baths.entropy_scales()


def _domain_margin(model, at):
    form, p = model
    system, x = _member_and_state(form, p, at)
    return system.domain_margin(x)


def _inverse_inertia(model, at):
    form, p = model
    body = _member_and_state(form, p, at)[0].drop_baths()
    return jax.jacfwd(body.energy.gradient)(jnp.zeros(body.dim))
