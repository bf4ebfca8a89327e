"""Families of systems: one form, and parameters that differ from trajectory to trajectory."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ..engines.compiled.form import Form
from ..errors import InputError
from ..systems import System
from ..tracing.remembered import fingerprint
from ..tracing.traced import Traced, traced

PROBES = 8
"""Members of a family that are built, and so checked, one by one."""


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
    """

    form: Form
    values: list[np.ndarray]
    alike: System | None = None

    @classmethod
    def of(cls, system, parameters) -> Family:
        """From what :func:`liethermo.ensemble` is given."""
        if isinstance(system, System):
            return cls._of_named(system, {} if parameters is None else parameters)
        if not callable(system):
            raise InputError(f"the first argument is a system, or a function that builds one, not {system!r}")
        if parameters is None:
            raise InputError("a function that builds systems needs parameters=..., one set for each trajectory")
        return cls._of_function(system, parameters)

    @classmethod
    def _of_named(cls, system: System, parameters) -> Family:
        if not isinstance(parameters, Mapping):
            raise InputError(
                "parameters of a system are a dict from names to arrays; "
                "for another form give a function that builds the system in its place"
            )
        paths, _ = jax.tree_util.tree_flatten_with_path(eqx.filter(system, eqx.is_inexact_array))
        leaves = {jax.tree_util.keystr(path).removeprefix("."): np.asarray(leaf) for path, leaf in paths}
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
    def _of_function(cls, build: Callable, parameters) -> Family:
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
        family = cls(Form((build, structure), shapes, rebuild), values)
        for i in family.extremes():  # the constructors of systems check what they are given
            family.member(i)
        rest = None

        def arrays_of(*arrays):
            nonlocal rest
            arrays, rest = eqx.partition(rebuild(arrays), eqx.is_array)
            return arrays

        try:
            program = traced(arrays_of, *(jax.ShapeDtypeStruct(shape, np.float64) for shape in shapes))
        except jax.errors.ConcretizationTypeError as error:
            raise InputError(
                f"the function that builds systems must accept traced JAX arrays, as under jax.vmap: {error}"
            ) from error
        return family if fingerprint(rest) is None else cls._of_program(program, rest, values)

    @classmethod
    def _of_program(cls, program: Traced, rest, values: list[np.ndarray]) -> Family:
        """From a program that makes the arrays of a system; the numbers in it are parameters that all members share."""
        given = len(values)

        def rebuild(arrays):
            return eqx.combine(Traced(tuple(arrays[given:]), program.content, program.label)(*arrays[:given]), rest)

        values = [*values, *(np.asarray(number)[None] for number in program.numbers)]
        return cls(
            Form((program.content, fingerprint(rest)), tuple(value.shape[1:] for value in values), rebuild), values
        )

    def through(self, change: Callable[..., System]) -> Family:
        """The family of what a function, one that has an identity, makes of the members."""
        form = self.form
        return Family(Form((form.key, change), form.shapes, lambda arrays: change(form.rebuild(arrays))), self.values)

    # -- members --------------------------------------------------------------------------------------------------

    @property
    def size(self) -> int:
        """How many members there are."""
        return common_size(*map(len, self.values))

    def arrays(self, i: int) -> list[jax.Array]:
        """The parameters of one member."""
        return [jnp.asarray(value[i if len(value) > 1 else 0]) for value in self.values]

    def member(self, i: int) -> System:
        return self.form.rebuild(self.arrays(i)) if self.alike is None else self.alike

    def extremes(self) -> list[int]:
        """The members with the smallest and the largest parameters: what is out of range shows there."""
        found = {0: None}
        for value in self.values:
            rows = value.reshape(len(value), -1)
            found |= dict.fromkeys(int(i) for i in (*rows.argmin(axis=0), *rows.argmax(axis=0)))
        return list(found)[:PROBES]

    def check(self, states: np.ndarray) -> None:
        """Test the axioms for members with extreme parameters, each at its initial state.

        Raises
        ------
        InputError
            If one fails there.
        """
        for i in self.extremes() if self.size > 1 else ():
            report = self.member(i).check(points=states[i])
            if not report.passed:
                raise InputError(f"with the parameters of trajectory {i}:\n{report}")

    # -- as the engines take them -----------------------------------------------------------------------------------

    @property
    def varies(self) -> np.ndarray:
        """Which parameters differ, shape (p,), all arrays one after another."""
        return np.concatenate([np.zeros(0, bool), *(np.full(value[0].size, len(value) > 1) for value in self.values)])

    def flat(self, chosen: slice, number: int) -> np.ndarray:
        """The parameters of some members, shape (number, p)."""
        rows = [value[chosen] if len(value) > 1 else value for value in self.values]
        columns = [np.broadcast_to(row.reshape(len(row), -1), (number, row[0].size)) for row in rows]
        return np.concatenate([np.zeros((number, 0)), *columns], axis=1)

    def batched(self, chosen: slice) -> tuple[list[jax.Array], list[Any]]:
        """The parameters of some members, in front where they differ, and the axes for ``vmap``."""
        differ = [len(value) > 1 for value in self.values]
        arrays = [jnp.asarray(value[chosen] if d else value[0]) for value, d in zip(self.values, differ, strict=True)]
        return arrays, [0 if d else None for d in differ]


def common_size(*sizes: int) -> int:
    """The number of trajectories, where one thing is for all of them or there is one for each."""
    several = {size for size in sizes if size != 1}
    if len(several) > 1:
        raise InputError(f"initial states and parameters are for different numbers of trajectories: {sorted(several)}")
    if 0 in several:
        raise InputError("an ensemble has at least one trajectory")
    return several.pop() if several else 1
