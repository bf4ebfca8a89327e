"""The axes of a study: grids, lists of samples, parameters that vary together, replicas."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from manifolds._arguments import is_integer

from ..errors import InputError

RESERVED_NAMES = ("status", "message", "laws", "quantity", "zarr.json")
"""Names of arrays and files that every store contains."""

MAX_NAME_LENGTH = 100
"""Maximum number of characters of a name; names become folder names in the store."""

MAX_POINTS = 10**9
"""Maximum number of points of a study."""


def is_valid_name(name: Any) -> bool:
    """Return True if ``name`` can name an axis, a parameter or a measure, and a folder in the store."""
    is_short_text = isinstance(name, str) and name.isprintable() and 0 < len(name) <= MAX_NAME_LENGTH
    return (
        is_short_text and not name.startswith(("_", ".")) and not {"/", "\\"} & set(name) and name not in RESERVED_NAMES
    )


@dataclass(frozen=True)
class Zipped:
    """Parameters that vary together along one axis, as :func:`zipped` and the samplers return them.

    Attributes
    ----------
    columns : dict from str to ndarray, shape (m,)
        Values of each parameter.
    states : ndarray, shape (m, n), or None
        Initial states along the axis.
    count : int
        Length of the axis if it has neither columns nor states.
    """

    columns: Mapping[str, np.ndarray]
    states: np.ndarray | None = None
    count: int = 0

    def __len__(self) -> int:
        if self.states is not None:
            return len(self.states)
        return len(next(iter(self.columns.values()))) if self.columns else self.count


def zipped(**columns) -> Zipped:
    """Return parameters that vary together along one axis of a :class:`Study`: ``axes={"pair": lt.zipped(a=...,
    b=...)}``.

    Parameters
    ----------
    **columns : arrays, shape (m,)
        Values of each parameter, by the name that the builder uses.

    Raises
    ------
    InputError
        If their lengths differ.
    """
    arrays = {name: _checked_column(name, values) for name, values in columns.items()}
    lengths = {name: len(values) for name, values in arrays.items()}
    if not arrays:
        raise InputError("zipped needs parameters: zipped(a=[1.0, 2.0], b=[3.0, 4.0])")
    if len(set(lengths.values())) > 1:
        counts = ", ".join(f"{name} has {length}" for name, length in lengths.items())
        raise InputError(f"parameters that vary together need equally many values: {counts}")
    return Zipped(arrays)


def replicas(states) -> Zipped:
    """Return an axis of a study over given initial states, or over repeated runs with noise.

    Parameters
    ----------
    states : array, shape (m, n), or int
        The initial state of each replica; in a study with noise, the number of replicas, each with its own seed.

    Raises
    ------
    InputError
        If the states are not an array of finite numbers of this shape.
    """
    if np.ndim(states) == 0:
        return Zipped({}, count=_checked_count(states))
    array = np.asarray(states, dtype=np.float64)
    if array.ndim != 2 or not array.size:
        raise InputError(f"states must have shape (replicas, n), got {array.shape}")
    if not np.isfinite(array).all():
        i = int(np.argwhere(~np.isfinite(array))[0, 0])
        raise InputError(f"the initial state of replica {i} is not finite: {array[i].tolist()}")
    return Zipped({}, array)


def latin_hypercube(count: int, *, seed: int, **ranges) -> Zipped:
    """Return a Latin hypercube sample of parameters along one axis [scipy.stats.qmc.LatinHypercube].

    Parameters
    ----------
    count : int
        Number of points.
    seed : int
        Seed of the random numbers.
    **ranges : (low, high) or (low, high, "log")
        Range of each parameter; with "log" the logarithm is sampled evenly.

    Raises
    ------
    InputError
        If a range cannot be used.

    Examples
    --------
    >>> points = lt.latin_hypercube(4, rate=(0.1, 1.0), ratio=(1.0, 2.0), seed=0)
    >>> type(points).__name__
    'Zipped'
    """
    from scipy.stats import qmc

    return _sample_from_ranges(
        lambda d: qmc.LatinHypercube(d, rng=np.random.default_rng(seed)).random(_checked_count(count)), ranges
    )


def sobol(count: int, *, seed: int, **ranges) -> Zipped:
    """Return a scrambled Sobol sequence of parameters along one axis [scipy.stats.qmc.Sobol].

    A longer sequence with an equal seed begins with the shorter one, so a study can be extended.

    Parameters
    ----------
    count : int
        Number of points; a power of two is best.
    seed : int
        Seed of the random numbers.
    **ranges : (low, high) or (low, high, "log")
        As for :func:`latin_hypercube`.

    Raises
    ------
    InputError
        If a range cannot be used.

    Examples
    --------
    >>> points = lt.sobol(4, rate=(0.1, 1.0), ratio=(1.0, 2.0), seed=0)
    >>> type(points).__name__
    'Zipped'
    """
    from scipy.stats import qmc

    log2_count = max(_checked_count(count) - 1, 0).bit_length()
    return _sample_from_ranges(
        lambda d: qmc.Sobol(d, rng=np.random.default_rng(seed)).random_base2(log2_count)[:count], ranges
    )


def _sample_from_ranges(draw_unit_sample, ranges: Mapping[str, Any]) -> Zipped:
    """Draw a sample in the unit cube and scale it to the ranges of the parameters.

    ``draw_unit_sample(d)`` returns an array of shape (count, d).

    Raises
    ------
    InputError
        If there is no range, or a range is not (low, high) or (low, high, "log") with finite low < high.
    """
    if not ranges:
        raise InputError("a sample needs at least one range of a parameter, such as rate=(0.1, 10.0, 'log')")
    for name, bounds in ranges.items():
        if not (
            isinstance(bounds, tuple | list) and len(bounds) in (2, 3) and bounds[2:] in ((), [], ("log",), ["log"])
        ):
            raise InputError(f"the range of {name} must be (low, high) or (low, high, 'log'), got {bounds!r}")
        low, high = map(float, bounds[:2])
        if not (np.isfinite([low, high]).all() and low < high and (len(bounds) == 2 or low > 0.0)):
            raise InputError(
                f"the range of {name} must be finite and increasing, and positive with 'log', got {bounds!r}"
            )
    unit = draw_unit_sample(len(ranges))
    columns = {}
    for u, (name, (low, high, *scale)) in zip(unit.T, ranges.items(), strict=True):
        columns[name] = low * (high / low) ** u if scale else low + (high - low) * u
    return Zipped(columns)


def _checked_count(count) -> int:
    """Return the number of points as an int; raise InputError unless it is a positive integer."""
    if not is_integer(count) or count < 1:
        raise InputError(f"the number of points must be a positive integer, got {count!r}")
    return int(count)


def _checked_column(name: str, values) -> np.ndarray:
    """Return the values of a parameter as an array of shape (m,), m > 0; raise InputError unless they are finite
    numbers or texts."""
    array = np.asarray(values)
    if array.dtype.kind == "U" and not all(isinstance(value, str) for value in np.asarray(values, dtype=object).flat):
        raise InputError(f"the values of {name!r} must be either numbers or texts, got both")
    if array.ndim != 1 or array.dtype.kind not in "fiubU" or not len(array):
        raise InputError(
            f"the values of {name!r} must be a list of numbers or texts, got {array.dtype} of shape {array.shape}. "
            "For several numbers at once use lt.zipped(a=..., b=...)"
        )
    if array.dtype.kind == "f" and not np.isfinite(array).all():
        i = int(np.flatnonzero(~np.isfinite(array))[0])
        raise InputError(f"value {i} of {name!r} is {array[i]}, but parameters must be finite")
    return array.astype(np.float64) if array.dtype.kind == "f" else array


@dataclass(frozen=True)
class Axis:
    """One axis of a study: its coordinate, the parameters and initial states along it.

    Attributes
    ----------
    name : str
    labels : ndarray, shape (m,)
        The coordinate: the values of a parameter, or the numbers 0, 1, ...
    columns : dict from str to ndarray, shape (m,)
        The parameters that vary along the axis.
    states : ndarray, shape (m, n), or None
        Initial states along the axis.
    """

    name: str
    labels: np.ndarray
    columns: Mapping[str, np.ndarray]
    states: np.ndarray | None = None

    @classmethod
    def from_values(cls, name: str, values_or_sample) -> Axis:
        """Return an axis made from a list of values, or from a :class:`Zipped`; raise InputError if a value occurs
        twice."""
        if isinstance(values_or_sample, Zipped):
            return cls(name, np.arange(len(values_or_sample)), values_or_sample.columns, values_or_sample.states)
        values = _checked_column(name, values_or_sample)
        unique, first_indices = np.unique(values, return_index=True)
        if len(unique) < len(values):
            i = int(np.setdiff1d(np.arange(len(values)), first_indices)[0])
            raise InputError(f"the axis {name!r} has {values[i]} more than once. For repeated runs use lt.replicas")
        return cls(name, values, {name: values})

    def __len__(self) -> int:
        return len(self.labels)

    def has_equal_values(self, other_axis: Axis) -> bool:
        """Return True if the labels, columns and states of another axis, with equal column names, are equal and in
        the same order."""
        pairs = [
            (self.labels, other_axis.labels),
            *((column, other_axis.columns[n]) for n, column in self.columns.items()),
        ]
        if self.states is not None or other_axis.states is not None:
            pairs.append((np.asarray(self.states), np.asarray(other_axis.states)))
        return all(np.array_equal(a, b) for a, b in pairs)

    def value_keys(self) -> list[tuple]:
        """Return one hashable key per point of the axis, from its values rounded to 13 digits."""
        states = [] if self.states is None else [[tuple(map(_rounded_key, row)) for row in self.states.tolist()]]
        columns = [list(map(_rounded_key, column.tolist())) for column in self.columns.values()]
        return list(zip(*(columns + states or [self.labels.tolist()]), strict=True))


def _rounded_key(value: Any) -> Any:
    return float(f"{value:.12e}") if isinstance(value, float) else value


@dataclass(frozen=True)
class Axes:
    """All axes of a study, in order; their product is the grid of points."""

    axes: tuple[Axis, ...]
    parameter_names: tuple[str, ...] = field(init=False)

    def __post_init__(self):
        names = [name for axis in self.axes for name in axis.columns]
        object.__setattr__(self, "parameter_names", tuple(names))
        duplicates = [name for i, name in enumerate(names) if name in names[:i]]
        clashes = [a.name for a in self.axes if a.name in names and a.name not in a.columns]
        if duplicates or clashes:
            raise InputError(
                f"{(duplicates or clashes)[0]!r} stands for more than one thing among the axes and their parameters"
            )

    @classmethod
    def from_mapping(cls, mapping: Mapping[str, Any]) -> Axes:
        """Return the axes of a study from a dict of values by name, the argument ``axes`` of :class:`Study`; raise
        InputError if a name or a value is invalid."""
        if not isinstance(mapping, Mapping) or not mapping:
            raise InputError(
                f'axes must be a dict from names to values, such as {{"rate": [0.1, 1.0]}}, got {mapping!r:.60}'
            )
        for name, values in mapping.items():
            for key in (name, *(values.columns if isinstance(values, Zipped) else ())):
                if not is_valid_name(key):
                    raise InputError(f"an axis cannot be called {key!r:.120}")
        axes = cls(tuple(Axis.from_values(name, values) for name, values in mapping.items()))
        if axes.size > MAX_POINTS:
            shape = " x ".join(map(str, axes.shape))
            raise InputError(
                f"a study has at most {MAX_POINTS:.0e} points, but these axes have {shape}. Use lt.sobol instead"
            )
        return axes

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(axis.name for axis in self.axes)

    @property
    def shape(self) -> tuple[int, ...]:
        return tuple(map(len, self.axes))

    @property
    def size(self) -> int:
        return math.prod(self.shape)

    def parameters_at(self, indices: tuple[np.ndarray, ...]) -> dict[str, np.ndarray]:
        """Return the parameter values, arrays of shape (n_points,) by name, of the points with these indices along each
        axis."""
        return {
            name: column[i] for axis, i in zip(self.axes, indices, strict=True) for name, column in axis.columns.items()
        }

    def states_at(self, indices: tuple[np.ndarray, ...]) -> np.ndarray | None:
        """Return the initial states, shape (n_points, n), of the points with these indices along each axis; None if no
        axis has states."""
        return next(
            (axis.states[i] for axis, i in zip(self.axes, indices, strict=True) if axis.states is not None), None
        )

    def describe_point(self, index: tuple[int, ...]) -> str:
        """Return the parameter values of a point as text, for messages."""
        return ", ".join(
            f"{name} = {column[i]:g}" if column.dtype.kind in "fiu" else f"{name} = {column[i]}"
            for axis, i in zip(self.axes, index, strict=True)
            for name, column in (axis.columns or {axis.name: axis.labels}).items()
        )


def axes_in_store_order(study_axes: Axes, stored_axes: Axes) -> Axes:
    """Return the axes of a study with their values reordered: the values that the store has come first, in its order.

    Raises
    ------
    InputError
        If the axes have other names, or lack values that the store has.
    """
    if study_axes.names != stored_axes.names or [tuple(a.columns) for a in study_axes.axes] != [
        tuple(a.columns) for a in stored_axes.axes
    ]:
        descriptions = [
            ", ".join(f"{a.name} ({', '.join(a.columns)})" for a in axes.axes) for axes in (study_axes, stored_axes)
        ]
        raise InputError(f"the axes are {descriptions[0]}, but those of the store {descriptions[1]}")
    matched_axes = []
    for axis, stored_axis in zip(study_axes.axes, stored_axes.axes, strict=True):
        if axis.has_equal_values(stored_axis):  # skip the search, which takes microseconds per value
            matched_axes.append(axis)
            continue
        unmatched_indices: dict[Any, list[int]] = {}
        for i, key in enumerate(axis.value_keys()):
            unmatched_indices.setdefault(key, []).append(i)
        for i, key in enumerate(stored_axis.value_keys()):
            if not unmatched_indices.get(key):
                raise InputError(
                    f"the axis {axis.name!r} lacks {key[0] if len(key) == 1 else key!r}, which is value {i} in the "
                    "store; an axis can be extended, but must keep its values"
                )
            unmatched_indices[key].pop(0)
        new_indices = sorted(itertools.chain.from_iterable(unmatched_indices.values()))
        columns = {
            name: np.append(stored_values, axis.columns[name][new_indices])
            for name, stored_values in stored_axis.columns.items()
        }
        labels = columns.get(axis.name, np.arange(len(stored_axis) + len(new_indices)))
        states = None
        if axis.states is not None and stored_axis.states is not None:
            states = np.concatenate([stored_axis.states, axis.states[new_indices]])
        matched_axes.append(Axis(axis.name, labels, columns, states))
    return Axes(tuple(matched_axes))
