"""Systems and initial states at the points of a study, built by one traced program if possible."""

from __future__ import annotations

import functools
import re
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ..errors import InputError
from ..functions.conditions import collect_conditions, condition_message
from ..runs.named_parameters import find_parameter_or_none, named_parameters, replace_parameters, require_parameter
from ..runs.system_family import Family
from ..systems import System
from ..systems.kind_checks import require_system

FIXED_BATCH_SIZE = 8192
"""Points per call of a compiled program, constant so that results do not depend on the position in a batch."""

UNKNOWN_PARAMETER_TEXT = "and no parameter of an axis is called so"
"""Part of the error message by which an unknown parameter is recognised."""

TRAILING_INDICES = re.compile(r"(\[\d+\])*$")
"""The indices of an entry at the end of its name."""

PointParameters = Mapping[str, np.ndarray]
"""Parameters of several points: arrays of shape (n_points,) by name."""


class AccessRecorder(dict):
    """A dict that records which entries have been read, and names all entries in the error for a missing one."""

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

    def __iter__(self):  # without it, ** would bypass __getitem__
        return super().__iter__()

    def keys(self):
        return super().keys()

    def items(self):
        self.accessed_names.update(self)
        return super().items()

    def values(self):
        self.accessed_names.update(self)
        return super().values()


def system_builder(
    build: System | Callable[[dict], System], parameter_names: tuple[str, ...]
) -> Callable[[dict], System]:
    """Return a function that builds a system from a dict of parameters.

    If ``build`` is a system, the function replaces the named parameters in it.

    Raises
    ------
    InputError
        If the system has no parameter of this name, or ``build`` is neither a system nor a function.
    """
    if not isinstance(build, System):
        if not callable(build):
            raise InputError(f"build must be a system, or a function that returns one, got {build!r:.60}")
        return build
    return functools.partial(
        _replace_parameter_entries, build, {name: _split_entry_name(build, name) for name in parameter_names}
    )


def _split_entry_name(system: System, entry_name: str) -> tuple[str, tuple[int, ...]]:
    """Split a name such as ``energy.inertia[0]`` into the name of a parameter of the system and the index of an entry.

    Raises
    ------
    InputError
        If the system has no such entry.
    """
    indices = TRAILING_INDICES.search(entry_name)
    assert indices is not None
    index_starts = [indices.start() + match.start() for match in re.finditer(r"\[", indices[0])]
    for end in (*index_starts, len(entry_name)):  # the name itself may end with an index, such as parts[0]
        parameter = find_parameter_or_none(system, entry_name[:end])
        index = tuple(map(int, re.findall(r"\d+", entry_name[end:])))
        shape = () if parameter is None else parameter.value.shape
        if parameter is not None and len(index) == len(shape) and all(map(int.__lt__, index, shape)):
            return entry_name[:end], index
    shapes = {name: value.shape for name, value in named_parameters(system).items()}
    available = ", ".join(name + "".join(f"[0..{m - 1}]" for m in shape) for name, shape in shapes.items())
    raise InputError(f"the system has no parameter {entry_name!r} that is one number; it has {available}")


def _replace_parameter_entries(
    system: System, entries: Mapping[str, tuple[str, tuple[int, ...]]], point: Mapping[str, Any]
) -> System:
    """Return the system with entries of its parameters replaced by the values of a point.

    ``entries`` has the parameter name and the index of the entry for each name in ``point``.
    """
    values: dict[str, Any] = {}
    for axis_name, (name, index) in entries.items():
        value = values[name] if name in values else jnp.asarray(require_parameter(system, name).value)
        values[name] = value.at[index].set(point[axis_name])
    return replace_parameters(system, values)


class StudySystems:
    """Builder of the systems at the points of a study: one by one, or as a family.

    Parameters
    ----------
    build : function from the dict of a point to a System
    parameters : tuple of str
        Names of the entries of the dict.
    example : dict
        A point at which the system can be built. Properties that all systems share are read from this system.

    Attributes
    ----------
    example_system : System
    family : Family or None
        The family of all systems, if one traced program builds them. None if the builder needs the values, for example
        in a Python ``if``, as an integer or as a text; each system is then built separately.
    why_no_family : str
        The reason why there is no family.
    """

    def __init__(
        self, build: Callable[[dict], System], parameter_names: tuple[str, ...], example_point: Mapping[str, Any]
    ):
        self._build, self._parameters = build, parameter_names
        self.example_system = self.system_at(example_point)
        self.family: Family | None = None
        self.why_no_family = ""
        try:
            example_columns = {name: np.full(2, example_point[name], dtype=np.float64) for name in parameter_names}
            family = (
                Family.from_function(self._call_builder, example_columns)
                if example_columns
                else Family.from_arguments(self.example_system, None)
            )
            if example_columns:
                self._conditions = _ParameterConditions(self._call_builder, parameter_names)
                family = family.trace_builder()
            self.family = replace(family, example=self.example_system)
        except Exception as error:  # any error of a builder that cannot be traced; it is called with numbers instead
            self.why_no_family = f"{type(error).__name__}: {error}".partition("\n")[0]

    def _call_builder(self, point: Mapping[str, Any]) -> System:
        return self._build(AccessRecorder(point))

    def system_at(self, point: Mapping[str, Any]) -> System:
        """Build and return the system at one point; its constructors check the parameters."""
        return require_system(self._call_builder(to_python_values(point)), "the builder must return a system")

    def why_points_inadmissible(self, points: PointParameters, n_points: int) -> dict[int, str]:
        """Return an error message, by index, for each point whose parameters violate a condition of the constructors;
        needs a family."""
        return self._conditions(points, n_points) if self._parameters else {}

    def family_at(self, points: PointParameters, indices: np.ndarray) -> Family:
        """Return the family of the systems at the points with these indices."""
        assert self.family is not None
        names = sorted(self._parameters)  # the order in which JAX flattens a dict
        return self.family.with_builder_arrays([np.asarray(points[name][indices], dtype=np.float64) for name in names])


def to_python_values(point: Mapping[str, Any]) -> dict[str, Any]:
    """Return the parameters of a point with NumPy scalars converted to Python numbers and texts."""
    return {name: value.item() if isinstance(value, np.generic) else value for name, value in point.items()}


def evaluate_in_batches(compiled_function: Callable, points: PointParameters, n_points: int) -> list[np.ndarray]:
    """Evaluate a compiled function at all points in batches of ``FIXED_BATCH_SIZE``; return its output arrays."""
    batches = []
    for start in range(0, n_points, FIXED_BATCH_SIZE):
        indices = np.minimum(np.arange(start, start + FIXED_BATCH_SIZE), n_points - 1)
        batch = {name: np.asarray(values, dtype=np.float64)[indices] for name, values in points.items()}
        batches.append(
            [np.asarray(array)[: n_points - start] for array in jax.tree_util.tree_leaves(compiled_function(batch))]
        )
    return [np.concatenate(columns) for columns in zip(*batches, strict=True)]


class _ParameterConditions:
    """The conditions that a builder imposes on its parameters, compiled for many points."""

    def __init__(self, build: Callable, parameter_names: tuple[str, ...]):
        self._messages: list[str] = []

        def evaluate_conditions(point):
            with collect_conditions() as conditions:
                build(point)
            self._messages = [condition.message for condition in conditions]
            return [(condition.holds, condition.value) for condition in conditions]

        jax.eval_shape(evaluate_conditions, {name: jax.ShapeDtypeStruct((), np.float64) for name in parameter_names})
        self._evaluate_batch = jax.jit(jax.vmap(evaluate_conditions))

    def __call__(self, points: PointParameters, n_points: int) -> dict[int, str]:
        """Return the message of the first violated condition, by index, for each point that violates one."""
        if not self._messages:
            return {}
        messages_by_index: dict[int, str] = {}
        results = evaluate_in_batches(self._evaluate_batch, points, n_points)
        for k, message in enumerate(self._messages):
            for i in map(int, np.flatnonzero(~results[2 * k])):
                messages_by_index.setdefault(i, condition_message(message, results[2 * k + 1][i]))
        return messages_by_index


class PointwiseArrays:
    """Function that evaluates the initial states, or the attitudes, at points of a study.

    Parameters
    ----------
    source : array, or function from the dict of a point to one
    parameters : tuple of str
    label : str
        Name of the quantity, for messages.
    example : dict
        A point. If it is empty or contains a text, the function is not traced.
    """

    def __init__(self, source: Any, parameter_names: tuple[str, ...], label: str, example_point: Mapping[str, Any]):
        self.source, self._parameters, self._label = source, parameter_names, label
        self._evaluate_batch = None
        if callable(source) and parameter_names and not any(isinstance(value, str) for value in example_point.values()):
            scalar = {name: jax.ShapeDtypeStruct((), np.float64) for name in parameter_names}
            try:
                jax.eval_shape(self._evaluate_point, scalar)
                self._evaluate_batch = jax.jit(jax.vmap(self._evaluate_point))
            except Exception:  # functions that use NumPy, random numbers or texts are called point by point
                pass

    def _evaluate_point(self, point):
        return jnp.asarray(self.source(AccessRecorder(point)))

    def __call__(self, points: PointParameters, n_points: int) -> tuple[np.ndarray, dict[int, str]]:
        """Return the arrays at some points, shape (n_points, ...), and an error message for each failed point, by
        index."""
        if not callable(self.source):
            return np.broadcast_to(np.asarray(self.source), (n_points, *np.shape(self.source))), {}
        if self._evaluate_batch is not None:
            (arrays_of_points,) = evaluate_in_batches(
                self._evaluate_batch, {name: points[name] for name in self._parameters}, n_points
            )
            return arrays_of_points, {}
        arrays: list[Any] = []
        failure_messages: dict[int, str] = {}
        for i in range(n_points):
            try:
                arrays.append(
                    np.asarray(self.source(AccessRecorder(to_python_values({n: v[i] for n, v in points.items()}))))
                )
            except Exception as error:  # user code; its error becomes the status of this point
                failure_messages[i] = f"{self._label} raised {type(error).__name__}: {error}"
                arrays.append(None)
        example = next((array for array in arrays if array is not None), np.zeros(0))
        for i, array in enumerate(arrays):
            if array is not None and array.shape != example.shape:
                failure_messages[i] = f"{self._label} has shape {array.shape}, but {example.shape} at other points"
        complete_arrays = [example if i in failure_messages else array for i, array in enumerate(arrays)]
        return np.array(complete_arrays, dtype=np.float64), failure_messages
