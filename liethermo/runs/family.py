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

from ..engines.compiled.form import Form, arrays_of
from ..errors import InputError, LiethermoError
from ..systems import System
from ..tracing.remembered import fingerprint
from ..tracing.traced import Traced, traced

PROBES = 8
"""Members of a family that are built, and so checked, one by one."""

HOPELESS = 32
"""Members that are tried before it is said that none can be run."""


@dataclass(frozen=True)
class Family:
    """Systems that differ in some of their parameters.

    Attributes
    ----------
    form : Form
        Builds a member from its parameters, a list of arrays.
    values : list of ndarray
        The parameters of all members, members first; one member where all have the same.
    alike : System, optional
        The one system that all members are: what has been found for it once need not be found again.
    example : System, optional
        The member that is shown for all, such as in what is said of where results come from, for whoever has checked
        the members. Nothing of a run is decided by it: see :mod:`liethermo.runs.member_groups`.
    given : int
        How many of the values, the first ones, are what a function that builds systems is given.
    refused : dict from int to str
        Members that cannot be built, and why.
    varying : tuple of bool
        Which of the values differ between members, so that they have one row for each. By default those that have more
        than one row; a selection of one member keeps what it was selected from, and is run by the same program.
    """

    form: Form
    values: list[np.ndarray]
    alike: System | None = None
    example: System | None = None
    given: int = 0
    refused: Mapping[int, str] = field(default_factory=dict)
    varying: tuple[bool, ...] = ()

    def __post_init__(self):
        if len(self.varying) != len(self.values):
            known = (*self.varying, *(len(value) > 1 for value in self.values[len(self.varying) :]))
            object.__setattr__(self, "varying", known[: len(self.values)])

    @classmethod
    def of(cls, system, parameters) -> Family:
        """From what :func:`liethermo.ensemble` is given."""
        if isinstance(system, Family):
            return system
        if isinstance(system, System):
            return cls._of_named(system, parameters)
        if not callable(system):
            raise InputError(f"the first argument is a system, or a function that builds one, not {system!r}")
        if parameters is None:
            raise InputError("a function that builds systems needs parameters=..., one set for each trajectory")
        family = cls.of_function(system, parameters)
        # the constructors of systems check what they are given; a program that is traced does not
        refused = family.found_wanting(lambda i: why_not(lambda: family.member(i)))
        return replace(family.traced(), refused=refused)

    @classmethod
    def _of_named(cls, system: System, parameters) -> Family:
        if parameters is None:
            return cls(Form.of(system), [array[None] for array in arrays_of(system)], system)
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
        return cls(Form.of(system), list(values.values()), None if parameters else system)

    @classmethod
    def of_function(cls, build: Callable, parameters) -> Family:
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
        return cls(Form((build, structure), shapes, rebuild), values, given=len(values))

    def traced(self) -> Family:
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
            program = traced(arrays_of, *(jax.ShapeDtypeStruct(shape, np.float64) for shape in self.form.shapes))
        except (jax.errors.ConcretizationTypeError, jax.errors.TracerArrayConversionError) as error:
            raise InputError(
                "the function that builds systems must accept traced JAX arrays, as under jax.vmap; or give a system "
                f"and parameters= by the names of its own: {str(error).splitlines()[0]}"
            ) from error
        if fingerprint(rest) is None:
            return self
        given = self.given

        def rebuild(arrays):
            return eqx.combine(Traced(tuple(arrays[given:]), program.content, program.label)(*arrays[:given]), rest)

        values = [*self.values, *(np.asarray(number)[None] for number in program.numbers)]
        form = Form((program.content, fingerprint(rest)), tuple(value.shape[1:] for value in values), rebuild)
        return replace(self, form=form, values=values)

    def with_values(self, given: list[np.ndarray]) -> Family:
        """The family of the same form whose members are built from other values."""
        return replace(self, values=[*given, *self.values[self.given :]], varying=())

    def through(self, change: Callable[..., System], *fixed: Hashable) -> Family:
        """The family of what a function, one that has an identity, makes of the members, with these arguments."""
        form = self.form
        key = form.key, change, fixed
        changed = Form(key, form.shapes, lambda arrays: change(form.rebuild(arrays), *fixed))
        return Family(changed, self.values, varying=self.varying)

    def known(self, tell: Callable[..., System], *fixed: Hashable) -> Family:
        """The same family, of whose members a function tells more."""
        if self.alike is not None:
            return Family.of(tell(self.alike, *fixed), None)
        return self.through(tell, *fixed)

    def with_numbers(self, change: Callable[..., System], *numbers: float) -> Family:
        """The family of what a function, one that has an identity, makes of the members with some numbers.

        Families with other numbers have the same form.
        """
        form, count = self.form, len(numbers)

        def rebuild(arrays):
            return change(form.rebuild(arrays[:-count]), *arrays[-count:])

        values = [*self.values, *(np.array([number]) for number in numbers)]
        return Family(
            Form((form.key, change, count), (*form.shapes, *[()] * count), rebuild), values, varying=self.varying
        )

    # -- members --------------------------------------------------------------------------------------------------

    @property
    def size(self) -> int:
        """How many members there are."""
        return common_size(*(len(value) for value, varies in self._columns if varies))

    def arrays(self, i: int) -> list[jax.Array]:
        """The parameters of one member."""
        return [jnp.asarray(value[i if varies else 0]) for value, varies in self._columns]

    @property
    def _columns(self) -> list[tuple[np.ndarray, bool]]:
        return list(zip(self.values, self.varying, strict=True))

    def member(self, i: int) -> System:
        return self.form.rebuild(self.arrays(i)) if self.alike is None else self.alike

    @property
    def representative(self) -> System:
        """The member that is shown for all: an example where there is one, the first otherwise."""
        return self.member(0) if self.example is None else self.example

    def extremes(self) -> list[int]:
        """The members with the smallest and the largest parameters: what is out of range shows there."""
        found = {0: None}
        for value in self.values:
            rows = value.reshape(len(value), -1)
            found |= dict.fromkeys(int(i) for i in (*rows.argmin(axis=0), *rows.argmax(axis=0)))
        return list(found)[:PROBES]

    def found_wanting(self, reason: Callable[[int], str], known: Mapping[int, str] | None = None) -> dict[int, str]:
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
        found = dict(known or {}) | self._not_numbers()
        left, tried = np.setdiff1d(np.arange(self.size), list(found)), dict[int, str]()
        while left.size:
            new = [i for i in map(int, left[self.select(left).extremes()]) if i not in tried]
            tried |= {i: reason(i) for i in new}
            wanting = {i: tried[i] for i in new if tried[i]}
            found |= wanting
            left = np.setdiff1d(left, list(wanting))
            if not wanting or (len(tried) >= HOPELESS and all(tried.values())):
                break
        if not left.size or (tried and all(tried.values())):
            first = min(found)
            raise InputError(f"no trajectory can be started; trajectory {first}: {found[first]}")
        return found

    def complaint(self, i: int, x: np.ndarray) -> str:
        """What the axioms say of a member at a state; an empty text where they hold."""
        report = None

        def check():
            nonlocal report
            report = self.member(i).check(points=x)

        return why_not(check) or ("" if report is None or report.passed else str(report))

    def _not_numbers(self) -> dict[int, str]:
        """Members that have parameters that are NaN."""
        bad = np.zeros(self.size, dtype=bool)
        # what all share may be the NaN that a function is written with, such as a table beyond its ends
        for value in self.values[: self.given] or [value for value in self.values if len(value) > 1]:
            bad |= np.isnan(value.reshape(len(value), -1)).any(axis=1)
        return {int(i): "one of its parameters is NaN" for i in np.flatnonzero(bad)}

    def select(self, chosen: np.ndarray) -> Family:
        """The family of some members."""
        values = [value[chosen] if varies else value for value, varies in self._columns]
        return replace(self, values=values, refused={})

    # -- as the engines take them -----------------------------------------------------------------------------------

    @property
    def varies(self) -> np.ndarray:
        """Which parameters differ, shape (p,), all arrays one after another."""
        return np.concatenate([np.zeros(0, bool), *(np.full(value[0].size, varies) for value, varies in self._columns)])

    def flat(self, chosen: slice | np.ndarray, number: int) -> np.ndarray:
        """The parameters of some members, shape (number, p)."""
        rows = [value[chosen] if varies else value for value, varies in self._columns]
        columns = [np.broadcast_to(row.reshape(len(row), -1), (number, row[0].size)) for row in rows]
        return np.concatenate([np.zeros((number, 0)), *columns], axis=1)

    def batched(self, chosen: slice | np.ndarray) -> tuple[list[jax.Array], list[Any]]:
        """The parameters of some members, in front where they differ, and the axes for ``vmap``."""
        arrays = [jnp.asarray(value[chosen] if varies else value[0]) for value, varies in self._columns]
        return arrays, [0 if varies else None for varies in self.varying]


def named_parameters(system: System) -> dict[str, np.ndarray]:
    """Return the parameters of a system by name, such as ``dissipation.rate``."""
    paths, _ = jax.tree_util.tree_flatten_with_path(eqx.filter(system, eqx.is_inexact_array))
    return {jax.tree_util.keystr(path).removeprefix("."): np.asarray(leaf) for path, leaf in paths}


def common_size(*sizes: int) -> int:
    """The number of trajectories, where one thing is for all of them or there is one for each."""
    several = {size for size in sizes if size != 1}
    if len(several) > 1:
        raise InputError(f"initial states and parameters are for different numbers of trajectories: {sorted(several)}")
    if 0 in several:
        raise InputError("an ensemble has at least one trajectory")
    return several.pop() if several else 1


def why_not(call: Callable[[], Any]) -> str:
    """What a call complains of; an empty text where it does not."""
    try:
        call()
    except (LiethermoError, ManifoldsError, ValueError, ArithmeticError) as error:
        return str(error) or type(error).__name__
    return ""
