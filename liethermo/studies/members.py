"""From the points of a study to systems and initial states, all at once where one program builds them."""

from __future__ import annotations

import functools
import re
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ..errors import InputError
from ..functions.conditions import collect_conditions, refusal_message
from ..runs.family import Family, named_parameters
from ..systems import System

FIXED_BATCH_SIZE = 8192
"""Points that XLA's programs take at once, always as many: results must not depend on where in a batch a point is."""

UNKNOWN_PARAMETER_TEXT = "and no parameter of an axis is called so"

PointParameters = Mapping[str, np.ndarray]


class AccessRecorder(dict):
    """A dict that knows which of its entries have been looked at, and says which there are."""

    def __init__(self, entries: Mapping[str, Any]):
        super().__init__(entries)
        self.accessed_names: set[str] = set()

    def __getitem__(self, name):
        self.accessed_names.add(name)
        return super().__getitem__(name)

    def __missing__(self, name):
        raise InputError(f"the builder asks for {name!r}, {UNKNOWN_PARAMETER_TEXT}; the axes have {', '.join(self)}")

    def get(self, name, default=None):
        self.accessed_names.add(name)
        return super().get(name, default)

    def __iter__(self):  # so that ** does not go round __getitem__
        return super().__iter__()

    def keys(self):
        return super().keys()

    def items(self):
        self.accessed_names.update(self)
        return super().items()

    def values(self):
        self.accessed_names.update(self)
        return super().values()


def system_builder(build: System | Callable[[dict], System], parameters: tuple[str, ...]) -> Callable[[dict], System]:
    """The function from a point to its system; of a system, one that changes its parameters.

    Raises
    ------
    InputError
        If the system has no parameter of a name, or neither it nor a function was given.
    """
    if not isinstance(build, System):
        if not callable(build):
            raise InputError(f"a study takes a system, or a function that builds one, not {build!r:.60}")
        return build
    leaves = {name: value.shape for name, value in named_parameters(build).items()}
    places = {}
    for name in parameters:
        # the name of a leaf may end with an index too, such as numbers[0]
        entries = (re.fullmatch(re.escape(leaf) + r"((?:\[\d+\])*)", name) for leaf in leaves)
        matches = {entry.string[: entry.start(1)]: _parse_index(entry[1]) for entry in entries if entry is not None}
        whole, index = next(((w, i) for w, i in matches.items() if len(i) == len(leaves[w])), (name, ()))
        if whole not in leaves or len(index) != len(leaves[whole]) or any(map(int.__ge__, index, leaves[whole])):
            known = ", ".join(leaf + "".join(f"[0..{m - 1}]" for m in shape) for leaf, shape in leaves.items())
            raise InputError(f"the system has no parameter {name!r} that is one number; it has {known}")
        places[name] = whole, index
    return functools.partial(_with_parameters, build, places)


def _parse_index(text: str) -> tuple[int, ...]:
    return tuple(map(int, re.findall(r"\d+", text)))


def _with_parameters(
    system: System, places: Mapping[str, tuple[str, tuple[int, ...]]], point: Mapping[str, Any]
) -> System:
    """The system with the parameters of a point."""
    dynamic, static = eqx.partition(system, eqx.is_inexact_array)
    paths, structure = jax.tree_util.tree_flatten_with_path(dynamic)
    leaves = {jax.tree_util.keystr(path).removeprefix("."): leaf for path, leaf in paths}
    for name, (whole, index) in places.items():
        leaves[whole] = jnp.asarray(leaves[whole]).at[index].set(point[name])
    return eqx.combine(jax.tree_util.tree_unflatten(structure, list(leaves.values())), static)


class StudySystems:
    """The systems of a study.

    Parameters
    ----------
    build : function from the dict of a point to a System
    parameters : tuple of str
        The entries of the dict.
    example_system : dict
        A point at which the system can be built. What a method looks at in a system it looks at in this one, for all.

    Attributes
    ----------
    example_system : System
    family : Family or None
        Of all systems, where one traced program builds them. None where the builder has to see the values: a Python
        ``if``, an integer, a text. Each point is then built by itself.
    why_no_family : str
        Why there is no family.
    """

    def __init__(self, build: Callable[[dict], System], parameters: tuple[str, ...], example: Mapping[str, Any]):
        self._build, self._parameters = build, parameters
        self.example_system = self.system_at(example)
        self.family: Family | None = None
        self.why_no_family = ""
        try:
            given = {name: np.full(2, example[name], dtype=np.float64) for name in parameters}
            family = (
                Family.from_function(self._build_system, given)
                if given
                else Family.from_arguments(self.example_system, None)
            )
            if given:
                self._conditions = _ParameterConditions(self._build_system, parameters)
                family = family.trace_builder()
            self.family = replace(family, example=self.example_system)
        except Exception as error:  # whatever a builder does with a tracer; with numbers it will say what is wrong
            self.why_no_family = f"{type(error).__name__}: {error}".partition("\n")[0]

    def _build_system(self, point: Mapping[str, Any]) -> System:
        return self._build(AccessRecorder(point))

    def system_at(self, point: Mapping[str, Any]) -> System:
        """The system at a point, whose constructors check what they are given."""
        system = self._build_system(as_python_values(point))
        if not isinstance(system, System):
            raise InputError(f"the builder must return a system, not {type(system).__name__}")
        return system

    def inadmissible_points(self, points: PointParameters, size: int) -> dict[int, str]:
        """The points whose parameters are not admissible, and why; known where there is a family."""
        return self._conditions(points, size) if self._parameters else {}

    def family_at(self, points: PointParameters, chosen: np.ndarray) -> Family:
        """The family of some points."""
        assert self.family is not None
        names = sorted(self._parameters)  # as JAX has dicts
        return self.family.with_builder_arrays([np.asarray(points[name][chosen], dtype=np.float64) for name in names])


def as_python_values(point: Mapping[str, Any]) -> dict[str, Any]:
    """A point with Python's own numbers and texts."""
    return {name: value.item() if isinstance(value, np.generic) else value for name, value in point.items()}


def evaluate_in_batches(function: Callable, points: PointParameters, size: int) -> list[np.ndarray]:
    """What a compiled function of points gives, lot by lot: its arrays one after another."""
    found = []
    for start in range(0, size, FIXED_BATCH_SIZE):
        rows = np.minimum(np.arange(start, start + FIXED_BATCH_SIZE), size - 1)
        lot = {name: np.asarray(values, dtype=np.float64)[rows] for name, values in points.items()}
        found.append([np.asarray(array)[: size - start] for array in jax.tree_util.tree_leaves(function(lot))])
    return [np.concatenate(parts) for parts in zip(*found, strict=True)]


class _ParameterConditions:
    """The conditions that a builder states about its parameters, at any points."""

    def __init__(self, build: Callable, parameters: tuple[str, ...]):
        self._messages: list[str] = []

        def conditions(point):
            with collect_conditions() as noted:
                build(point)
            self._messages = [condition.message for condition in noted]
            return [(condition.holds, condition.value) for condition in noted]

        jax.eval_shape(conditions, {name: jax.ShapeDtypeStruct((), np.float64) for name in parameters})
        self._evaluate = jax.jit(jax.vmap(conditions))

    def __call__(self, points: PointParameters, size: int) -> dict[int, str]:
        if not self._messages:
            return {}
        found: dict[int, str] = {}
        results = evaluate_in_batches(self._evaluate, points, size)
        for k, message in enumerate(self._messages):
            for i in map(int, np.flatnonzero(~results[2 * k])):
                found.setdefault(i, refusal_message(message, results[2 * k + 1][i]))
        return found


class PointwiseArrays:
    """Initial states, or attitudes, at the points of a study.

    Parameters
    ----------
    source : array, or function from the dict of a point to one
    parameters : tuple of str
    what : str
        For messages.
    example : dict
        A point: where one of its entries is a text, or there are none, the function is not traced.
    """

    def __init__(self, given: Any, parameters: tuple[str, ...], what: str, example: Mapping[str, Any]):
        self.source, self._parameters, self._label = given, parameters, what
        self._evaluate_batch = None
        if callable(given) and parameters and not any(isinstance(value, str) for value in example.values()):
            scalar = {name: jax.ShapeDtypeStruct((), np.float64) for name in parameters}
            try:
                jax.eval_shape(self._evaluate_point, scalar)
                self._evaluate_batch = jax.jit(jax.vmap(self._evaluate_point))
            except Exception:  # NumPy, random numbers, texts: such a function is called with the numbers of each point
                pass

    def _evaluate_point(self, point):
        return jnp.asarray(self.source(AccessRecorder(point)))

    def __call__(self, points: PointParameters, size: int) -> tuple[np.ndarray, dict[int, str]]:
        """At some points, one row for each; and where there is none that can be used, and why."""
        if not callable(self.source):
            return np.broadcast_to(np.asarray(self.source), (size, *np.shape(self.source))), {}
        if self._evaluate_batch is not None:
            (rows,) = evaluate_in_batches(self._evaluate_batch, {name: points[name] for name in self._parameters}, size)
            return rows, {}
        found: list[Any] = []
        reasons: dict[int, str] = {}
        for i in range(size):
            try:
                found.append(
                    np.asarray(self.source(AccessRecorder(as_python_values({n: v[i] for n, v in points.items()}))))
                )
            except Exception as error:  # the function may be anyone's, and this is the status of one point
                reasons[i] = f"{self._label} raised {type(error).__name__}: {error}"
                found.append(None)
        good = next((row for row in found if row is not None), np.zeros(0))
        for i, row in enumerate(found):
            if row is not None and row.shape != good.shape:
                reasons[i] = f"{self._label} has shape {row.shape}, and {good.shape} at other points"
        filled = [good if i in reasons else row for i, row in enumerate(found)]
        return np.array(filled, dtype=np.float64), reasons
