"""Families of systems: one program structure, with parameters that differ between trajectories."""

from __future__ import annotations

import functools
from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from manifolds import ManifoldsError

from ..engines.compiled.parameters import ProgramStructure, parameter_arrays
from ..errors import InputError, LiethermoError
from ..functions.conditions import checked_host_numbers
from ..models.inertia import are_inertia_tensors
from ..systems import System
from ..systems.kind_checks import require_system
from ..tracing.caching import pytree_key_or_none
from ..tracing.interpret import evaluate_at_points
from ..tracing.traced import TracedFunction, trace_function
from .named_parameters import checked_parameters, reasons_of_refused_members, require_parameter, stack_member_arrays

MAX_CHECKED_MEMBERS = 8
"""Largest number of members that are built and checked one by one at a time."""

MAX_FAILED_MEMBERS = 32
"""Number of members to try before concluding that none can be run."""


@dataclass(frozen=True)
class Family:
    """A family of systems that differ in some of their parameters.

    Attributes
    ----------
    program_structure : ProgramStructure
        Builds a member from its parameters, a list of arrays.
    parameter_arrays : list of ndarray
        The parameters of all members along the first axis, which has length 1 if all members share them.
    common_system : System, optional
        The system, if all members are equal; its cached properties are used again.
    example : System, optional
        The member that is reported for all, such as in the provenance. A caller that gives it has checked the members.
        It decides nothing about a run: see :mod:`liethermo.runs.member_groups`.
    n_builder_arrays : int
        Number of leading parameter arrays that are arguments of the function that builds systems.
    refusal_reasons : dict from int to str
        Members that cannot be built, with the reasons.
    has_member_axis : tuple of bool
        For each parameter array, whether it has one row for each member. By default True for arrays with more than one
        row. A selection of one member keeps these flags, so the same program runs it.
    """

    program_structure: ProgramStructure
    parameter_arrays: list[np.ndarray]
    common_system: System | None = None
    example: System | None = None
    n_builder_arrays: int = 0
    refusal_reasons: Mapping[int, str] = field(default_factory=dict)
    has_member_axis: tuple[bool, ...] = ()

    def __post_init__(self):
        if len(self.has_member_axis) != len(self.parameter_arrays):
            axis_flags = (
                *self.has_member_axis,
                *(len(value) > 1 for value in self.parameter_arrays[len(self.has_member_axis) :]),
            )
            object.__setattr__(self, "has_member_axis", axis_flags[: len(self.parameter_arrays)])

    @classmethod
    def from_arguments(cls, system, parameters) -> Family:
        """Return the family for the arguments ``system`` and ``parameters`` of :func:`liethermo.ensemble`."""
        if isinstance(system, Family):
            return system
        if isinstance(system, System):
            return cls._from_named_parameters(system, parameters)
        if not callable(system):
            raise InputError(f"the first argument must be a system or a function that builds one, got {system!r}")
        if parameters is None:
            raise InputError("a function that builds systems needs parameters=..., one set for each trajectory")
        family = cls.from_function(system, parameters)
        # constructors of systems check their arguments, but a traced program does not
        refusal_reasons = family.find_rejection_reasons(lambda i: error_message_or_empty(lambda: family.member(i)))
        return replace(family.trace_builder(), refusal_reasons=refusal_reasons)

    @classmethod
    def _from_named_parameters(cls, system: System, parameters) -> Family:
        """Return the family of a system with values of named parameters for each member; None means one member."""
        if parameters is None:
            return cls(
                ProgramStructure.from_module(system), [array[None] for array in parameter_arrays(system)], system
            )
        for name, values in checked_parameters(parameters).items():
            has_moments = name.endswith("inertia") and require_parameter(system, name).value.shape == (3,)
            if has_moments and are_inertia_tensors(checked_host_numbers(values, name)):
                raise InputError(
                    f"the values of {name} are the tensor of inertia of one body, but three sets of principal moments "
                    "are expected. Give the moments of each trajectory as a row, or a system with a tensor"
                )
        arrays = stack_member_arrays(system, parameters)
        reasons = reasons_of_refused_members(system, parameters)
        return cls(
            ProgramStructure.from_module(system), arrays, None if parameters else system, refusal_reasons=reasons
        )

    @classmethod
    def from_function(cls, build: Callable, parameters) -> Family:
        """Return the family whose members are built by a function, one from each set of parameters."""
        leaves, structure = jax.tree_util.tree_flatten(parameters)
        values = [np.asarray(value, dtype=np.float64) for value in leaves]
        if not values or any(value.ndim == 0 for value in values):
            raise InputError("parameters must be arrays with one entry, or row, for each trajectory")

        def rebuild(arrays):
            system = build(jax.tree_util.tree_unflatten(structure, arrays))
            return require_system(system, "the function must return a system")

        shapes = tuple(value.shape[1:] for value in values)
        return cls(ProgramStructure((build, structure), shapes, rebuild), values, n_builder_arrays=len(values))

    def trace_builder(self) -> Family:
        """Return the family with its builder traced into one program, whose constants become parameters that all
        members share.

        Raises
        ------
        InputError
            If the builder needs the values of its parameters.
        """
        static_part = None

        def arrays_of_built_system(*arrays):
            nonlocal static_part
            arrays, static_part = eqx.partition(self.program_structure.rebuild(list(arrays)), eqx.is_array)
            return arrays

        try:
            program = trace_function(
                arrays_of_built_system,
                *(jax.ShapeDtypeStruct(shape, np.float64) for shape in self.program_structure.shapes),
            )
        except (jax.errors.ConcretizationTypeError, jax.errors.TracerArrayConversionError) as error:
            raise InputError(
                "the function that builds systems must accept traced JAX arrays, as under jax.vmap; or give a system "
                f"and parameters= by the names of its own: {str(error).splitlines()[0]}"
            ) from error
        if pytree_key_or_none(static_part) is None:
            return self
        n_builder_arrays = self.n_builder_arrays

        def rebuild(arrays):
            return eqx.combine(
                TracedFunction(tuple(arrays[n_builder_arrays:]), program.program, program.label)(
                    *arrays[:n_builder_arrays]
                ),
                static_part,
            )

        values = [*self.parameter_arrays, *(np.asarray(number)[None] for number in program.numbers)]
        form = ProgramStructure(
            (program.program, pytree_key_or_none(static_part)), tuple(value.shape[1:] for value in values), rebuild
        )
        return replace(self, program_structure=form, parameter_arrays=values)

    def with_builder_arrays(self, builder_arrays: list[np.ndarray]) -> Family:
        """Return the family with these arrays as the arguments of the function that builds its members."""
        return replace(
            self,
            parameter_arrays=[*builder_arrays, *self.parameter_arrays[self.n_builder_arrays :]],
            has_member_axis=(),
        )

    def map_members(self, change_member: Callable[..., System], *arguments: Hashable) -> Family:
        """Return the family whose members are ``change_member(member, *arguments)``; the function must be hashable."""
        form = self.program_structure
        key = form.key, change_member, arguments
        form_of_changed = ProgramStructure(
            key, form.shapes, lambda arrays: change_member(form.rebuild(arrays), *arguments)
        )
        return Family(form_of_changed, self.parameter_arrays, has_member_axis=self.has_member_axis)

    def annotate_members(self, annotate_member: Callable[..., System], *arguments: Hashable) -> Family:
        """Return the family of the systems ``annotate_member(member, *arguments)``; a common system remains common."""
        if self.common_system is not None:
            return Family.from_arguments(annotate_member(self.common_system, *arguments), None)
        return self.map_members(annotate_member, *arguments)

    def map_members_with_shared_numbers(self, change_member: Callable[..., System], *numbers: float) -> Family:
        """Return the family whose members are ``change_member(member, *numbers)``; the function must be hashable.

        The numbers become parameters, so families with other numbers share the compiled program.
        """
        form, count = self.program_structure, len(numbers)

        def rebuild(arrays):
            return change_member(form.rebuild(arrays[:-count]), *arrays[-count:])

        values = [*self.parameter_arrays, *(np.array([number]) for number in numbers)]
        return Family(
            ProgramStructure((form.key, change_member, count), (*form.shapes, *[()] * count), rebuild),
            values,
            has_member_axis=self.has_member_axis,
        )

    # -- members --------------------------------------------------------------------------------------------------

    @property
    def size(self) -> int:
        """Number of members."""
        return broadcast_size(*(len(value) for value, has_axis in self._arrays_with_axis_flags if has_axis))

    def member_arrays(self, member_index: int) -> list[jax.Array]:
        """Return the list of the parameter arrays of one member, without the axis of members."""
        return [jnp.asarray(value[member_index if has_axis else 0]) for value, has_axis in self._arrays_with_axis_flags]

    @property
    def _arrays_with_axis_flags(self) -> list[tuple[np.ndarray, bool]]:
        return list(zip(self.parameter_arrays, self.has_member_axis, strict=True))

    def member(self, member_index: int) -> System:
        """Return one member as a system."""
        return (
            self.program_structure.rebuild(self.member_arrays(member_index))
            if self.common_system is None
            else self.common_system
        )

    @property
    def representative(self) -> System:
        """The member that provenance and messages describe: the example if there is one, otherwise the first."""
        return self.member(0) if self.example is None else self.example

    def member_with_unknown_parameters(self) -> System:
        """Return a system with the parameters that all members share, and NaN for those that differ."""
        arrays = zip(self.parameter_arrays, self.has_member_axis, strict=True)
        return self.program_structure.rebuild(
            [np.full(a.shape[1:], np.nan) if differ else a[0] for a, differ in arrays]
        )

    def members_with_extreme_parameters(self) -> list[int]:
        """Return the indices of members with the smallest and largest parameters, the likeliest to be out of range."""
        indices = {0: None}
        for value in self.parameter_arrays:
            rows = value.reshape(len(value), -1)
            indices |= dict.fromkeys(int(i) for i in (*rows.argmin(axis=0), *rows.argmax(axis=0)))
        return list(indices)[:MAX_CHECKED_MEMBERS]

    def find_rejection_reasons(
        self, reason_of_member: Callable[[int], str], known_reasons: Mapping[int, str] | None = None
    ) -> dict[int, str]:
        """Return the reasons why some members cannot be run, by member index.

        Members with extreme parameters are tried; if some fail, the most extreme of the remaining ones are tried next.

        Parameters
        ----------
        reason_of_member : function of a member index
            Returns why the member cannot be run, or "".
        known_reasons : dict, optional
            Reasons of members that are already rejected.

        Raises
        ------
        InputError
            If all members are rejected, or the first :data:`MAX_FAILED_MEMBERS` that are tried.
        """
        reasons = dict(known_reasons or {}) | self._reasons_of_members_with_nan()
        candidates, tried_reasons = np.setdiff1d(np.arange(self.size), list(reasons)), dict[int, str]()
        while candidates.size:
            new_members = [
                i
                for i in map(int, candidates[self.select(candidates).members_with_extreme_parameters()])
                if i not in tried_reasons
            ]
            tried_reasons |= {i: reason_of_member(i) for i in new_members}
            failures = {i: tried_reasons[i] for i in new_members if tried_reasons[i]}
            reasons |= failures
            candidates = np.setdiff1d(candidates, list(failures))
            if not failures or (len(tried_reasons) >= MAX_FAILED_MEMBERS and all(tried_reasons.values())):
                break
        if not candidates.size or (tried_reasons and all(tried_reasons.values())):
            first_member = min(reasons)
            raise InputError(f"no trajectory can be started; trajectory {first_member}: {reasons[first_member]}")
        return reasons

    def axiom_violation_text(self, member_index: int, x: np.ndarray) -> str:
        """Return the report or error of the axiom check of a member at x, or "" if the check passes."""
        report = None

        def check():
            nonlocal report
            report = self.member(member_index).check(points=x)

        return error_message_or_empty(check) or ("" if report is None or report.passed else str(report))

    def _reasons_of_members_with_nan(self) -> dict[int, str]:
        """Return a reason for each member that has NaN among its parameters, by member index."""
        is_nan = np.zeros(self.size, dtype=bool)
        # a NaN that all members share may be a constant of a function, such as a table beyond its ends
        for value in self.parameter_arrays[: self.n_builder_arrays] or [
            value for value in self.parameter_arrays if len(value) > 1
        ]:
            is_nan |= np.isnan(value.reshape(len(value), -1)).any(axis=1)
        return {int(i): "one of its parameters is NaN" for i in np.flatnonzero(is_nan)}

    def select(self, member_indices: np.ndarray) -> Family:
        """Return the family of the members with these indices."""
        values = [value[member_indices] if has_axis else value for value, has_axis in self._arrays_with_axis_flags]
        return replace(self, parameter_arrays=values, refusal_reasons={})

    # -- parameters in the form of the engines ----------------------------------------------------------------------

    @property
    def is_per_trajectory(self) -> np.ndarray:
        """Mask, shape (p,), of the parameter entries that differ between trajectories."""
        return np.concatenate(
            [np.zeros(0, bool), *(np.full(value[0].size, has_axis) for value, has_axis in self._arrays_with_axis_flags)]
        )

    def parameter_matrix(self, members: slice | np.ndarray, n_members: int) -> np.ndarray:
        """Return the parameters of the selected members as rows, shape (n_members, p)."""
        rows = [value[members] if has_axis else value for value, has_axis in self._arrays_with_axis_flags]
        columns = [np.broadcast_to(row.reshape(len(row), -1), (n_members, row[0].size)) for row in rows]
        return np.concatenate([np.zeros((n_members, 0)), *columns], axis=1)

    def evaluate(self, function: Callable, members: slice | np.ndarray, states: np.ndarray) -> Any:
        """Return ``function(member, state)`` for each of the selected members, with members along the first axis.

        Parameters
        ----------
        function : function from a System and an array, shape (n,), to a pytree of float64 arrays
            The function must not be a closure that is created for each call, because compiled versions are cached by
            its identity.
        members : slice, or array of int, shape (m,)
        states : array, shape (m, n)
        """
        parameters = self.parameter_matrix(members, len(states))
        rows = np.concatenate([parameters, states], axis=1)
        return evaluate_at_points(
            _function_of_parameter_and_state_row(function), (self.program_structure, parameters.shape[1]), rows
        )

    def vmap_arguments(self, members: slice | np.ndarray) -> tuple[list[jax.Array], list[Any]]:
        """Return the parameter arrays of the selected members, and their axes for ``jax.vmap``."""
        arrays = [
            jnp.asarray(value[members] if has_axis else value[0]) for value, has_axis in self._arrays_with_axis_flags
        ]
        return arrays, [0 if has_axis else None for has_axis in self.has_member_axis]


def broadcast_size(*sizes: int) -> int:
    """Return the number of trajectories to which axes of these sizes broadcast; each is 1 or this number."""
    distinct_sizes = {size for size in sizes if size != 1}
    if len(distinct_sizes) > 1:
        raise InputError(
            "initial states, attitudes and parameters are for different numbers of trajectories, "
            f"{sorted(distinct_sizes)}. Give equal numbers, or one for all trajectories"
        )
    if 0 in distinct_sizes:
        raise InputError("an ensemble needs at least one trajectory, got 0 initial states or sets of parameters")
    return distinct_sizes.pop() if distinct_sizes else 1


def error_message_or_empty(call: Callable[[], Any]) -> str:
    """Return the message of the error that ``call()`` raises, or ""."""
    try:
        call()
    except (LiethermoError, ManifoldsError, ValueError, ArithmeticError) as error:
        return str(error) or type(error).__name__
    return ""


@functools.cache
def _function_of_parameter_and_state_row(function: Callable) -> Callable:
    """Return ``function(system, x)`` as a function of a program structure and of a row of parameters and state.

    The result is cached, because compiled versions are cached by its identity.
    """

    def evaluate_row(model: tuple[ProgramStructure, int], row):
        structure, n_parameters = model
        return function(structure.build(row[:n_parameters]), row[n_parameters:])

    return evaluate_row
