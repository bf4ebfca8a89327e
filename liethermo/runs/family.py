"""Families of systems: one form, and parameters that differ from trajectory to trajectory."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from manifolds import ManifoldsError

from ..engines.compiled.form import ProgramStructure, parameter_arrays
from ..errors import InputError, LiethermoError
from ..systems import System
from ..tracing.caching import fingerprint
from ..tracing.traced import TracedFunction, trace_function

MAX_CHECKED_MEMBERS = 8
"""Members of a family that are built, and so checked, one by one."""

MAX_FAILED_MEMBERS = 32
"""Members that are tried before it is said that none can be run."""


@dataclass(frozen=True)
class Family:
    """Systems that differ in some of their parameters.

    Attributes
    ----------
    form : Form
        Builds a member from its parameters, a list of arrays.
    parameter_arrays : list of ndarray
        The parameters of all members, members first; one member where all have the same.
    common_system : System, optional
        The one system that all members are: what has been found for it once need not be found again.
    example : System, optional
        The member that is shown for all, such as in what is said of where results come from, for whoever has checked
        the members. Nothing of a run is decided by it: see :mod:`liethermo.runs.member_groups`.
    n_builder_arrays : int
        How many of the values, the first ones, are what a function that builds systems is given.
    refusal_reasons : dict from int to str
        Members that cannot be built, and why.
    has_member_axis : tuple of bool
        Which of the values differ between members, so that they have one row for each. By default those that have more
        than one row; a selection of one member keeps what it was selected from, and is run by the same program.
    """

    form: ProgramStructure
    parameter_arrays: list[np.ndarray]
    common_system: System | None = None
    example: System | None = None
    n_builder_arrays: int = 0
    refusal_reasons: Mapping[int, str] = field(default_factory=dict)
    has_member_axis: tuple[bool, ...] = ()

    def __post_init__(self):
        if len(self.has_member_axis) != len(self.parameter_arrays):
            known = (
                *self.has_member_axis,
                *(len(value) > 1 for value in self.parameter_arrays[len(self.has_member_axis) :]),
            )
            object.__setattr__(self, "has_member_axis", known[: len(self.parameter_arrays)])

    @classmethod
    def from_arguments(cls, system, parameters) -> Family:
        """From what :func:`liethermo.ensemble` is given."""
        if isinstance(system, Family):
            return system
        if isinstance(system, System):
            return cls._from_named_parameters(system, parameters)
        if not callable(system):
            raise InputError(f"the first argument is a system, or a function that builds one, not {system!r}")
        if parameters is None:
            raise InputError("a function that builds systems needs parameters=..., one set for each trajectory")
        family = cls.from_function(system, parameters)
        # the constructors of systems check what they are given; a program that is traced does not
        refused = family.rejected_members(lambda i: error_message_of(lambda: family.member(i)))
        return replace(family.as_traced_program(), refusal_reasons=refused)

    @classmethod
    def _from_named_parameters(cls, system: System, parameters) -> Family:
        if parameters is None:
            return cls(
                ProgramStructure.from_module(system), [array[None] for array in parameter_arrays(system)], system
            )
        if not isinstance(parameters, Mapping):
            raise InputError(
                "parameters of a system are a dict from names to arrays; "
                "for another form give a function that builds the system in its place"
            )
        leaves = named_parameters(system)
        values = {name: leaf[None] for name, leaf in leaves.items()}
        for name, value in parameters.items():
            if name not in leaves:
                raise InputError(f"the system has no parameter {name!r}; its parameters are {', '.join(leaves)}")
            values[name] = np.asarray(value, dtype=np.float64)
            if values[name].ndim == 0 or values[name].shape[1:] != leaves[name].shape:
                wanted = ", ".join(["trajectories", *map(str, leaves[name].shape)])
                raise InputError(f"the values of {name} have shape ({wanted}), not {values[name].shape}")
        return cls(ProgramStructure.from_module(system), list(values.values()), None if parameters else system)

    @classmethod
    def from_function(cls, build: Callable, parameters) -> Family:
        """The members as the function builds them."""
        found, structure = jax.tree_util.tree_flatten(parameters)
        values = [np.asarray(value, dtype=np.float64) for value in found]
        if not values or any(value.ndim == 0 for value in values):
            raise InputError("parameters are arrays with one entry, or row, for each trajectory")

        def rebuild(arrays):
            system = build(jax.tree_util.tree_unflatten(structure, arrays))
            if not isinstance(system, System):
                raise InputError(f"the function must return a system, not {type(system).__name__}")
            return system

        shapes = tuple(value.shape[1:] for value in values)
        return cls(ProgramStructure((build, structure), shapes, rebuild), values, n_builder_arrays=len(values))

    def as_traced_program(self) -> Family:
        """The same family, built by one program that is traced: its numbers are parameters that all members share.

        Raises
        ------
        InputError
            If the function that builds members has to see the values of its parameters.
        """
        rest = None

        def arrays_of(*arrays):
            nonlocal rest
            arrays, rest = eqx.partition(self.form.rebuild(list(arrays)), eqx.is_array)
            return arrays

        try:
            program = trace_function(
                arrays_of, *(jax.ShapeDtypeStruct(shape, np.float64) for shape in self.form.shapes)
            )
        except (jax.errors.ConcretizationTypeError, jax.errors.TracerArrayConversionError) as error:
            raise InputError(
                "the function that builds systems must accept traced JAX arrays, as under jax.vmap; or give a system "
                f"and parameters= by the names of its own: {str(error).splitlines()[0]}"
            ) from error
        if fingerprint(rest) is None:
            return self
        given = self.n_builder_arrays

        def rebuild(arrays):
            return eqx.combine(
                TracedFunction(tuple(arrays[given:]), program.program, program.label)(*arrays[:given]), rest
            )

        values = [*self.parameter_arrays, *(np.asarray(number)[None] for number in program.numbers)]
        form = ProgramStructure(
            (program.program, fingerprint(rest)), tuple(value.shape[1:] for value in values), rebuild
        )
        return replace(self, form=form, parameter_arrays=values)

    def with_builder_arrays(self, given: list[np.ndarray]) -> Family:
        """The family of the same form whose members are built from other values."""
        return replace(
            self, parameter_arrays=[*given, *self.parameter_arrays[self.n_builder_arrays :]], has_member_axis=()
        )

    def map_members(self, change: Callable[..., System], *fixed: Hashable) -> Family:
        """The family of what a function, one that has an identity, makes of the members, with these arguments."""
        form = self.form
        key = form.key, change, fixed
        changed = ProgramStructure(key, form.shapes, lambda arrays: change(form.rebuild(arrays), *fixed))
        return Family(changed, self.parameter_arrays, has_member_axis=self.has_member_axis)

    def annotate_members(self, tell: Callable[..., System], *fixed: Hashable) -> Family:
        """The same family, of whose members a function tells more."""
        if self.common_system is not None:
            return Family.from_arguments(tell(self.common_system, *fixed), None)
        return self.map_members(tell, *fixed)

    def map_members_with_numbers(self, change: Callable[..., System], *numbers: float) -> Family:
        """The family of what a function, one that has an identity, makes of the members with some numbers.

        Families with other numbers have the same form.
        """
        form, count = self.form, len(numbers)

        def rebuild(arrays):
            return change(form.rebuild(arrays[:-count]), *arrays[-count:])

        values = [*self.parameter_arrays, *(np.array([number]) for number in numbers)]
        return Family(
            ProgramStructure((form.key, change, count), (*form.shapes, *[()] * count), rebuild),
            values,
            has_member_axis=self.has_member_axis,
        )

    # -- members --------------------------------------------------------------------------------------------------

    @property
    def size(self) -> int:
        """How many members there are."""
        return broadcast_size(*(len(value) for value, varies in self._arrays_with_axis_flags if varies))

    def member_arrays(self, i: int) -> list[jax.Array]:
        """The parameters of one member."""
        return [jnp.asarray(value[i if varies else 0]) for value, varies in self._arrays_with_axis_flags]

    @property
    def _arrays_with_axis_flags(self) -> list[tuple[np.ndarray, bool]]:
        return list(zip(self.parameter_arrays, self.has_member_axis, strict=True))

    def member(self, i: int) -> System:
        return self.form.rebuild(self.member_arrays(i)) if self.common_system is None else self.common_system

    @property
    def representative(self) -> System:
        """The member that is shown for all: an example where there is one, the first otherwise."""
        return self.member(0) if self.example is None else self.example

    def extreme_members(self) -> list[int]:
        """The members with the smallest and the largest parameters: what is out of range shows there."""
        found = {0: None}
        for value in self.parameter_arrays:
            rows = value.reshape(len(value), -1)
            found |= dict.fromkeys(int(i) for i in (*rows.argmin(axis=0), *rows.argmax(axis=0)))
        return list(found)[:MAX_CHECKED_MEMBERS]

    def rejected_members(self, reason: Callable[[int], str], known: Mapping[int, str] | None = None) -> dict[int, str]:
        """Members that cannot be run, and why: those with extreme parameters are tried, and the next where one cannot.

        Parameters
        ----------
        reason : function from the number of a member to why it cannot be run, or an empty text
        known : dict, optional
            Members that are known to be such.

        Raises
        ------
        InputError
            If none can, or none of the first :data:`HOPELESS` that are tried.
        """
        found = dict(known or {}) | self._members_with_nan()
        left, tried = np.setdiff1d(np.arange(self.size), list(found)), dict[int, str]()
        while left.size:
            new = [i for i in map(int, left[self.select(left).extreme_members()]) if i not in tried]
            tried |= {i: reason(i) for i in new}
            wanting = {i: tried[i] for i in new if tried[i]}
            found |= wanting
            left = np.setdiff1d(left, list(wanting))
            if not wanting or (len(tried) >= MAX_FAILED_MEMBERS and all(tried.values())):
                break
        if not left.size or (tried and all(tried.values())):
            first = min(found)
            raise InputError(f"no trajectory can be started; trajectory {first}: {found[first]}")
        return found

    def axiom_violation(self, i: int, x: np.ndarray) -> str:
        """What the axioms say of a member at a state; an empty text where they hold."""
        report = None

        def check():
            nonlocal report
            report = self.member(i).check(points=x)

        return error_message_of(check) or ("" if report is None or report.passed else str(report))

    def _members_with_nan(self) -> dict[int, str]:
        """Members that have parameters that are NaN."""
        bad = np.zeros(self.size, dtype=bool)
        # what all share may be the NaN that a function is written with, such as a table beyond its ends
        for value in self.parameter_arrays[: self.n_builder_arrays] or [
            value for value in self.parameter_arrays if len(value) > 1
        ]:
            bad |= np.isnan(value.reshape(len(value), -1)).any(axis=1)
        return {int(i): "one of its parameters is NaN" for i in np.flatnonzero(bad)}

    def select(self, chosen: np.ndarray) -> Family:
        """The family of some members."""
        values = [value[chosen] if varies else value for value, varies in self._arrays_with_axis_flags]
        return replace(self, parameter_arrays=values, refusal_reasons={})

    # -- as the engines take them -----------------------------------------------------------------------------------

    @property
    def is_per_trajectory(self) -> np.ndarray:
        """Which parameters differ, shape (p,), all arrays one after another."""
        return np.concatenate(
            [np.zeros(0, bool), *(np.full(value[0].size, varies) for value, varies in self._arrays_with_axis_flags)]
        )

    def parameter_matrix(self, chosen: slice | np.ndarray, number: int) -> np.ndarray:
        """The parameters of some members, shape (number, p)."""
        rows = [value[chosen] if varies else value for value, varies in self._arrays_with_axis_flags]
        columns = [np.broadcast_to(row.reshape(len(row), -1), (number, row[0].size)) for row in rows]
        return np.concatenate([np.zeros((number, 0)), *columns], axis=1)

    def vmap_arguments(self, chosen: slice | np.ndarray) -> tuple[list[jax.Array], list[Any]]:
        """The parameters of some members, in front where they differ, and the axes for ``vmap``."""
        arrays = [jnp.asarray(value[chosen] if varies else value[0]) for value, varies in self._arrays_with_axis_flags]
        return arrays, [0 if varies else None for varies in self.has_member_axis]


def named_parameters(system: System) -> dict[str, np.ndarray]:
    """Return the parameters of a system by name, such as ``dissipation.rate``."""
    paths, _ = jax.tree_util.tree_flatten_with_path(eqx.filter(system, eqx.is_inexact_array))
    return {jax.tree_util.keystr(path).removeprefix("."): np.asarray(leaf) for path, leaf in paths}


def broadcast_size(*sizes: int) -> int:
    """The number of trajectories, where one thing is for all of them or there is one for each."""
    several = {size for size in sizes if size != 1}
    if len(several) > 1:
        raise InputError(f"initial states and parameters are for different numbers of trajectories: {sorted(several)}")
    if 0 in several:
        raise InputError("an ensemble has at least one trajectory")
    return several.pop() if several else 1


def error_message_of(call: Callable[[], Any]) -> str:
    """What a call complains of; an empty text where it does not."""
    try:
        call()
    except (LiethermoError, ManifoldsError, ValueError, ArithmeticError) as error:
        return str(error) or type(error).__name__
    return ""
