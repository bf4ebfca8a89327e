"""The axes of a study: grids, lists of samples, parameters that vary together, replicas."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ..errors import InputError

RESERVED_NAMES = ("status", "message", "laws", "quantity", "zarr.json")
"""Names of what every store of a study has."""

MAX_NAME_LENGTH = 100
"""Characters of a name, which is that of a folder."""

MAX_POINTS = 10**9
"""Points of a study: each is a file's share, and a run."""


def is_valid_name(name: Any) -> bool:
    """Whether an axis, a parameter or a measure can be called so, and a folder of the store with it."""
    plain = isinstance(name, str) and name.isprintable() and 0 < len(name) <= MAX_NAME_LENGTH
    return plain and not name.startswith(("_", ".")) and not {"/", "\\"} & set(name) and name not in RESERVED_NAMES


@dataclass(frozen=True)
class Zipped:
    """Parameters that vary together along one axis: what :func:`zipped` and the samplers return.

    Attributes
    ----------
    columns : dict from str to ndarray, shape (m,)
        The parameters.
    states : ndarray, shape (m, n), or None
        Initial states along the axis.
    count : int
        Of an axis that has neither.
    """

    columns: Mapping[str, np.ndarray]
    states: np.ndarray | None = None
    count: int = 0

    def __len__(self) -> int:
        if self.states is not None:
            return len(self.states)
        return len(next(iter(self.columns.values()))) if self.columns else self.count


def zipped(**columns) -> Zipped:
    """Parameters that vary together along one axis of a :class:`Study`: ``axes={"pair": lt.zipped(a=..., b=...)}``.

    Parameters
    ----------
    **columns : arrays, shape (m,)
        By the names that the builder knows them by.

    Raises
    ------
    InputError
        If their lengths differ.
    """
    found = {name: _checked_column(name, values) for name, values in columns.items()}
    lengths = {name: len(values) for name, values in found.items()}
    if not found:
        raise InputError("zipped needs parameters: zipped(a=[1.0, 2.0], b=[3.0, 4.0])")
    if len(set(lengths.values())) > 1:
        counts = ", ".join(f"{name} has {length}" for name, length in lengths.items())
        raise InputError(f"parameters that vary together need equally many values: {counts}")
    return Zipped(found)


def replicas(states) -> Zipped:
    """An axis of initial states, ``axes={"replica": lt.replicas(states)}``, or of runs that noise alone sets apart.

    Parameters
    ----------
    states : array, shape (m, n), or int
        The initial state of each replica; or, of a study with noise, how many there are, each with its own seed.

    Raises
    ------
    InputError
        If the states are not such an array of finite numbers.
    """
    if np.ndim(states) == 0:
        return Zipped({}, count=_checked_count(states))
    array = np.asarray(states, dtype=np.float64)
    if array.ndim != 2 or not array.size:
        raise InputError(f"replicas have initial states of shape (replicas, n), not {array.shape}")
    if not np.isfinite(array).all():
        i = int(np.argwhere(~np.isfinite(array))[0, 0])
        raise InputError(f"the initial state of replica {i} is not finite: {array[i].tolist()}")
    return Zipped({}, array)


def latin_hypercube(count: int, *, seed: int, **ranges) -> Zipped:
    """A Latin hypercube sample of parameters along one axis [scipy.stats.qmc.LatinHypercube].

    Parameters
    ----------
    count : int
    seed : int
    **ranges : (low, high) or (low, high, "log")
        Of each parameter; with "log" its logarithm is spread evenly.

    Raises
    ------
    InputError
        If a range cannot be used.
    """
    from scipy.stats import qmc

    return _scale_sample(
        lambda d: qmc.LatinHypercube(d, rng=np.random.default_rng(seed)).random(_checked_count(count)), ranges
    )


def sobol(count: int, *, seed: int, **ranges) -> Zipped:
    """A scrambled Sobol sequence of parameters along one axis [scipy.stats.qmc.Sobol].

    A longer sequence of the same seed begins with a shorter one, so that a study can be extended.

    Parameters
    ----------
    count : int
        A power of two is best.
    seed : int
    **ranges : (low, high) or (low, high, "log")
        As for :func:`latin_hypercube`.

    Raises
    ------
    InputError
        If a range cannot be used.
    """
    from scipy.stats import qmc

    whole = max(_checked_count(count) - 1, 0).bit_length()
    return _scale_sample(lambda d: qmc.Sobol(d, rng=np.random.default_rng(seed)).random_base2(whole)[:count], ranges)


def _scale_sample(draw, ranges: Mapping[str, Any]) -> Zipped:
    if not ranges:
        raise InputError("a sample needs the ranges of parameters: rate=(0.1, 10.0, 'log')")
    for name, given in ranges.items():
        if not (isinstance(given, tuple | list) and len(given) in (2, 3) and given[2:] in ((), [], ("log",), ["log"])):
            raise InputError(f"the range of {name} is (low, high) or (low, high, 'log'), not {given!r}")
        low, high = map(float, given[:2])
        if not (np.isfinite([low, high]).all() and low < high and (len(given) == 2 or low > 0.0)):
            raise InputError(
                f"the range of {name} must be finite and increasing, and positive with 'log': not {given!r}"
            )
    unit = draw(len(ranges))
    columns = {}
    for u, (name, (low, high, *scale)) in zip(unit.T, ranges.items(), strict=True):
        columns[name] = low * (high / low) ** u if scale else low + (high - low) * u
    return Zipped(columns)


def _checked_count(count) -> int:
    if isinstance(count, bool) or not isinstance(count, int | np.integer) or count < 1:
        raise InputError(f"a sample has a positive number of points, not {count!r}")
    return int(count)


def _checked_column(name: str, values) -> np.ndarray:
    """Numbers or texts, shape (m,), m > 0."""
    array = np.asarray(values)
    if array.dtype.kind == "U" and not all(isinstance(value, str) for value in np.asarray(values, dtype=object).flat):
        raise InputError(f"the values of {name!r} are numbers or texts, not both")
    if array.ndim != 1 or array.dtype.kind not in "fiubU" or not len(array):
        raise InputError(
            f"the values of {name!r} are a list of numbers or texts, not {array.dtype} of shape {array.shape}; "
            "several numbers at once are lt.zipped(a=..., b=...)"
        )
    if array.dtype.kind == "f" and not np.isfinite(array).all():
        i = int(np.flatnonzero(~np.isfinite(array))[0])
        raise InputError(f"value {i} of {name!r} is {array[i]}: parameters are finite")
    return array.astype(np.float64) if array.dtype.kind == "f" else array


@dataclass(frozen=True)
class Axis:
    """One axis.

    Attributes
    ----------
    name : str
    labels : ndarray, shape (m,)
        The coordinate: the values of a parameter, or numbers from 0 on.
    columns : dict from str to ndarray, shape (m,)
        The parameters that vary along it.
    states : ndarray, shape (m, n), or None
    """

    name: str
    labels: np.ndarray
    columns: Mapping[str, np.ndarray]
    states: np.ndarray | None = None

    @classmethod
    def from_values(cls, name: str, given) -> Axis:
        if isinstance(given, Zipped):
            return cls(name, np.arange(len(given)), given.columns, given.states)
        values = _checked_column(name, given)
        unique, first = np.unique(values, return_index=True)
        if len(unique) < len(values):
            i = int(np.setdiff1d(np.arange(len(values)), first)[0])
            raise InputError(f"the axis {name!r} has {values[i]} more than once; replicas are an axis of their own")
        return cls(name, values, {name: values})

    def __len__(self) -> int:
        return len(self.labels)

    def has_same_values(self, other: Axis) -> bool:
        """Whether the places of another axis, of the same columns, have the same distinct numbers in its order."""
        pairs = [(self.labels, other.labels), *((column, other.columns[n]) for n, column in self.columns.items())]
        if self.states is not None or other.states is not None:
            pairs.append((np.asarray(self.states), np.asarray(other.states)))
        return all(np.array_equal(one, another) for one, another in pairs)

    def value_keys(self) -> list[tuple]:
        """What tells the places along the axis apart; numbers that rounding alone tells apart are the same."""
        states = [] if self.states is None else [[tuple(map(_rounded_key, row)) for row in self.states.tolist()]]
        columns = [list(map(_rounded_key, column.tolist())) for column in self.columns.values()]
        return list(zip(*(columns + states or [self.labels.tolist()]), strict=True))


def _rounded_key(value: Any) -> Any:
    return float(f"{value:.12e}") if isinstance(value, float) else value


@dataclass(frozen=True)
class Axes:
    """The axes of a study, in their order."""

    axes: tuple[Axis, ...]
    parameter_names: tuple[str, ...] = field(init=False)

    def __post_init__(self):
        names = [name for axis in self.axes for name in axis.columns]
        object.__setattr__(self, "parameter_names", tuple(names))
        twice = [name for i, name in enumerate(names) if name in names[:i]]
        also = [a.name for a in self.axes if a.name in names and a.name not in a.columns]
        if twice or also:
            raise InputError(
                f"{(twice or also)[0]!r} stands for more than one thing among the axes and their parameters"
            )

    @classmethod
    def from_mapping(cls, given: Mapping[str, Any]) -> Axes:
        """From what :class:`Study` is given."""
        if not isinstance(given, Mapping) or not given:
            raise InputError(f'axes are a dict from names to values, such as {{"rate": [0.1, 1.0]}}, not {given!r:.60}')
        for name, values in given.items():
            for called in (name, *(values.columns if isinstance(values, Zipped) else ())):
                if not is_valid_name(called):
                    raise InputError(f"an axis cannot be called {called!r:.120}")
        found = cls(tuple(Axis.from_values(name, values) for name, values in given.items()))
        if found.size > MAX_POINTS:
            shape = " x ".join(map(str, found.shape))
            raise InputError(
                f"a study has at most {MAX_POINTS:.0e} points, and these axes have {shape}: sample them instead"
            )
        return found

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(axis.name for axis in self.axes)

    @property
    def shape(self) -> tuple[int, ...]:
        return tuple(map(len, self.axes))

    @property
    def size(self) -> int:
        return math.prod(self.shape)

    def parameters_at(self, places: tuple[np.ndarray, ...]) -> dict[str, np.ndarray]:
        """The parameters at some points, whose places along each axis are given."""
        return {
            name: column[i] for axis, i in zip(self.axes, places, strict=True) for name, column in axis.columns.items()
        }

    def states_at(self, places: tuple[np.ndarray, ...]) -> np.ndarray | None:
        """The initial states at some points, where an axis has some, shape (points, n)."""
        return next(
            (axis.states[i] for axis, i in zip(self.axes, places, strict=True) if axis.states is not None), None
        )

    def describe_point(self, place: tuple[int, ...]) -> str:
        """A point in words."""
        return ", ".join(
            f"{name} = {column[i]:g}" if column.dtype.kind in "fiu" else f"{name} = {column[i]}"
            for axis, i in zip(self.axes, place, strict=True)
            for name, column in (axis.columns or {axis.name: axis.labels}).items()
        )
