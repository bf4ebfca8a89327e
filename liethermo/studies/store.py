"""The store of a study: a group of Zarr v3 that can be read at any time.

Each chunk of points has a file in each array. The file in ``status`` is written last: it marks the chunk as done.
"""

from __future__ import annotations

import errno
import hashlib
import itertools
import json
import math
import os
import shutil
import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from .. import disk
from ..errors import FileError, InputError
from . import files
from .axes import Axes, Axis
from .files import ZarrArray
from .solve import LAW_QUANTITIES, NOT_COMPUTED, STATUSES, SUCCESS_CODES
from .store_metadata import MAX_CHUNKS, read_group, with_checksum

STORE_FORMAT = "liethermo-study-1"

RERUN_ADVICE = "Run the study again: what is damaged is done again"


@dataclass(frozen=True)
class StoreSurvey:
    """What a store has.

    Attributes
    ----------
    remaining_chunks : list of (int, bool)
        The chunks that are not done, and whether a part of them is.
    n_done : int
        Points.
    damaged : tuple of str
        Files that are missing or damaged, and so done again.
    """

    remaining_chunks: list[tuple[int, bool]]
    n_done: int
    damaged: tuple[str, ...] = ()


@dataclass(frozen=True)
class StudyStore:
    """A store.

    Attributes
    ----------
    root : Path
    arrays : dict of Array
    attributes : dict
        Of the group; ``attributes["study"]`` describes the study.
    """

    root: Path
    arrays: Mapping[str, ZarrArray]
    attributes: dict[str, Any] = field(default_factory=dict)

    # -- making and opening ---------------------------------------------------------------------------------------

    @classmethod
    def create(
        cls,
        root: Path,
        axes: Axes,
        chunk: int,
        measures: Mapping[str, tuple],
        about: Mapping[str, Mapping[str, Any]],
        attributes: dict[str, Any],
    ) -> StudyStore:
        """Make a store; it appears whole or not at all.

        Parameters
        ----------
        axes : Axes
        chunk : int
            Points of a chunk, about.
        measures : dict from str to (shape, dtype)
            Of what is kept of a point.
        about : dict from str to dict
            Attributes of the arrays.
        attributes : dict
            Of the group.
        """
        chunks = _chunk_shape(axes.shape, chunk)
        if (number := math.prod(-(-m // c) for m, c in zip(axes.shape, chunks, strict=True))) > MAX_CHUNKS:
            raise InputError(f"{axes.size} points in chunks of {chunk} are {number} files: give a larger chunk")

        def array(name: str, more: Sequence[tuple[str, int]], dtype: str) -> ZarrArray:
            dims, sizes = (tuple(part) for part in zip(*more, strict=True)) if more else ((), ())
            shape = axes.shape + sizes
            return ZarrArray(name, axes.names + dims, shape, chunks + sizes, dtype, dict(about.get(name, {})))

        arrays = [array("status", [], "int8"), array("message", [], "string")]
        arrays.append(array("laws", [("quantity", len(LAW_QUANTITIES))], "float64"))
        for name, (shape, dtype) in measures.items():
            arrays.append(array(name, [(_component_dim_name(name, k, shape), m) for k, m in enumerate(shape)], dtype))
        arrays.append(ZarrArray("quantity", ("quantity",), (len(LAW_QUANTITIES),), (len(LAW_QUANTITIES),), "string"))
        coordinates = [array for array, _ in _coordinate_arrays(axes, about)]
        store = cls(root, {a.name: a for a in [*arrays, *coordinates]}, attributes)
        part = root.with_name(disk.part_name(root.name))
        try:
            part.mkdir(parents=True)
            made = replace(store, root=part)
            made._write_metadata(axes)
            os.rename(part, root)
        except OSError as error:
            shutil.rmtree(part, ignore_errors=True)
            if isinstance(error.__cause__, OSError):  # of a file in it
                error = error.__cause__
            if error.errno in (errno.ENOTEMPTY, errno.EEXIST):  # another run was faster
                return cls.open(root)
            raise FileError(f"cannot make the store {root}: {disk.why_os_failed(error)}") from error
        return store

    @classmethod
    def open(cls, root: Path) -> StudyStore:
        """Open a store.

        Raises
        ------
        FileError
            If there is none, or the folder is another thing.
        """
        if not root.exists():
            raise FileError(f"there is no store {root!s:.200}")
        kind = "folder" if root.is_dir() else "file"
        try:
            content = json.loads(files.read_plain_file(root / "zarr.json"))
            assert content["attributes"]["format"] == STORE_FORMAT
        except (FileError, ValueError, KeyError, TypeError, AssertionError, RecursionError) as error:
            raise FileError(f"{root} is a {kind}, but not the store of a study; take another name") from error
        try:
            store = cls(root, *read_group(root, content))
        except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
            raise FileError(f"{root} is the store of a study, but damaged or changed: {error}") from error
        files.require_plain_files(root)
        return store

    @property
    def study_description(self) -> dict[str, Any]:
        """What describes the study."""
        return self.attributes["study"]

    @property
    def measure_names(self) -> list[str]:
        return list(self.attributes["measures"])

    def extend(self, axes: Axes) -> StudyStore:
        """The store with longer axes, whose values begin with those that it has."""
        shape = axes.shape
        arrays = {
            name: replace(array, shape=shape + array.shape[len(shape) :]) if name in self.chunked_arrays else array
            for name, array in self.arrays.items()
        }
        about = {name: array.attributes for name, array in arrays.items()}
        for array, _ in _coordinate_arrays(axes, about):
            arrays[array.name] = replace(array, chunks=self.arrays[array.name].chunks)
        store = replace(self, arrays=arrays)
        store._write_metadata(axes)
        return store

    def repaired_axes(self, axes: Axes) -> Axes:
        """The axes of the store; where a file of its coordinates is lost or damaged, it is written again from these.

        Raises
        ------
        FileError
            If these are not in the order of the store: what was lost is not known then.
        """
        try:
            self._read_array("quantity")
            return self.read_axes()
        except FileError as error:
            if self.attributes.get("coordinates") != _coordinates_checksum(axes) or axes.shape != self.shape:
                raise FileError(
                    f"{error}. A study with the axes that the store was made with, in their order, writes it again"
                ) from error
        self._write_metadata(axes)
        return self.read_axes()

    def _write_metadata(self, axes: Axes) -> None:
        """Write the coordinates, then the metadata; those of the group last, which readers look at first."""
        self.attributes["coordinates"] = _coordinates_checksum(axes)
        self._write_chunk_file("quantity", (0,), np.array(LAW_QUANTITIES, dtype=object))
        for array, values in _coordinate_arrays(axes, {}):
            whole = self.arrays[array.name]
            for index in np.ndindex(*_chunk_grid(whole)):
                part = values[tuple(slice(i * c, (i + 1) * c) for i, c in zip(index, whole.chunks, strict=True))]
                block = whole.empty_chunk()
                block[tuple(map(slice, part.shape))] = part
                self._write_chunk_file(array.name, index, block)
        metadata = {name: array.metadata() for name, array in self.arrays.items()}
        for name, content in metadata.items():
            files.write_json(self.root / name / "zarr.json", content)
        every = {"kind": "inline", "must_understand": False, "metadata": metadata}
        group = {"zarr_format": 3, "node_type": "group", "attributes": self.attributes, "consolidated_metadata": every}
        files.write_json(self.root / "zarr.json", with_checksum(group))

    def read_axes(self) -> Axes:
        """The axes, with the values that they have."""
        found = []
        for name, columns in self.attributes["axes"].items():
            states = f"{name}_state"
            given = {column: self._read_array(column) for column in columns}
            found.append(
                Axis(name, self._read_array(name), given, self._read_array(states) if states in self.arrays else None)
            )
        return Axes(tuple(found))

    def _read_array(self, name: str) -> np.ndarray:
        array = self.arrays[name]
        values = np.empty(array.shape, dtype=array.numpy_dtype)
        for index in np.ndindex(*_chunk_grid(array)):
            here = tuple(
                slice(i * c, min((i + 1) * c, m)) for i, c, m in zip(index, array.chunks, array.shape, strict=True)
            )
            block = self._read_chunk_file(name, index)
            values[here] = block[tuple(slice(0, s.stop - s.start) for s in here)]
        return values.astype(str) if array.dtype == "string" else values

    # -- chunks of points -------------------------------------------------------------------------------------------

    @property
    def chunked_arrays(self) -> list[str]:
        """The arrays with a chunk of each chunk of points, the mark last."""
        return [*self.measure_names, "laws", "message", "status"]

    @property
    def shape(self) -> tuple[int, ...]:
        return self.arrays["status"].shape

    @property
    def chunk_grid(self) -> tuple[int, ...]:
        """How many chunks there are along each axis."""
        return _chunk_grid(self.arrays["status"])

    @property
    def n_points(self) -> int:
        return math.prod(self.shape)

    def chunk_index(self, number: int) -> tuple[int, ...]:
        return tuple(map(int, np.unravel_index(number, self.chunk_grid)))

    def chunk_bounds(self, index: Sequence[int]) -> tuple[tuple[int, int], ...]:
        """Where a chunk begins and ends along each axis."""
        status = self.arrays["status"]
        return tuple((i * c, min((i + 1) * c, m)) for i, c, m in zip(index, status.chunks, status.shape, strict=True))

    def point_indices(self, index: Sequence[int], wanted: np.ndarray | None = None) -> tuple[np.ndarray, ...]:
        """The places of the points of a chunk along the axes; of those wanted, where that is given."""
        block = self.chunk_bounds(index)
        inside = np.indices([stop - start for start, stop in block]).reshape(len(block), -1)
        if wanted is not None:
            inside = inside[:, wanted[tuple(slice(0, stop - start) for start, stop in block)].ravel()]
        return tuple(place + start for place, (start, _) in zip(inside, block, strict=True))

    def write_chunk(
        self, index: Sequence[int], places: tuple[np.ndarray, ...], arrays: Mapping[str, Any], keep: bool
    ) -> None:
        """Write a chunk: values at some of its points, the others as they were where they are to be kept."""
        inside = tuple(place - start for place, (start, _) in zip(places, self.chunk_bounds(index), strict=True))
        for name in self.chunked_arrays:
            block = (
                self._read_chunk_file(name, index)
                if keep and self._has_chunk(name, index)
                else self.arrays[name].empty_chunk()
            )
            if name in arrays:  # a measure has no values where no point could be run
                block[inside] = arrays[name]
            if name != "message" or (block != "").any():
                self._write_chunk_file(name, index, block)
            elif self._has_chunk(name, index):  # a chunk without messages has no file of them
                (self.root / self.arrays[name].chunk_path(index)).unlink()

    def read_chunk(self, name: str, index: Sequence[int]) -> np.ndarray:
        """The values of an array at the points of a chunk, fill values where there are none."""
        block = self._read_chunk_file(name, index) if self._has_chunk(name, index) else self.arrays[name].empty_chunk()
        inside = tuple(slice(0, stop - start) for start, stop in self.chunk_bounds(index))
        return block[inside]

    def _has_chunk(self, name: str, index: Sequence[int]) -> bool:
        return os.path.lexists(self.root / self.arrays[name].chunk_path(self._file_index(name, index)))

    def _file_index(self, name: str, index: Sequence[int]) -> tuple[int, ...]:
        """The index of the chunk of an array that has more dimensions than the axes."""
        return (*index, *(0 for _ in range(len(self.arrays[name].dims) - len(index))))

    def _read_chunk_file(self, name: str, index: Sequence[int]) -> np.ndarray:
        path = self.root / self.arrays[name].chunk_path(self._file_index(name, index))
        try:
            block = self.arrays[name].decode_chunk(files.read_plain_file(path))
            if name == "status" and not np.isin(block, (*STATUSES.values(), NOT_COMPUTED)).all():
                raise ValueError("it has a status that there is not")
            return block
        except FileError as error:
            raise FileError(f"{error}. {RERUN_ADVICE}") from error
        except (ValueError, struct.error) as error:
            raise FileError(f"{path} is damaged: {error}. {RERUN_ADVICE}") from error

    def require_chunk(self, name: str, index: tuple[int, ...]) -> None:
        """Raise FileError where a chunk is damaged, or missing though the mark of its points is there."""
        marked = name not in self.chunked_arrays or (
            name != "message" and self._has_chunk("status", index[: len(self.shape)])
        )
        if (marked and name != "status") or self._has_chunk(name, index):
            self._read_chunk_file(name, index)

    def _write_chunk_file(self, name: str, index: Sequence[int], block: np.ndarray) -> None:
        files.write_file(
            self.root / self.arrays[name].chunk_path(self._file_index(name, index)),
            self.arrays[name].encode_chunk(block),
        )

    # -- what there is ------------------------------------------------------------------------------------------------

    def chunk_statuses(self) -> Iterator[tuple[int, np.ndarray | None]]:
        """The number of each chunk and the status of its points; None where its mark is missing or damaged."""
        for number in range(math.prod(self.chunk_grid)):
            index = self.chunk_index(number)
            try:
                yield number, self.read_chunk("status", index) if self._has_chunk("status", index) else None
            except FileError:
                yield number, None

    def survey(self) -> StoreSurvey:
        """Look at every file: what is done, what is not, what is damaged."""
        todo: list[tuple[int, bool]] = []
        damaged: list[str] = []
        done = 0
        for number, status in self.chunk_statuses():
            index = self.chunk_index(number)
            faults = [] if status is None else self._damaged_files(index, status)
            if status is None and self._has_chunk("status", index):
                faults = [f"{self.arrays['status'].chunk_path(index)} is damaged"]
            damaged += faults
            if status is None or faults:
                todo.append((number, False))
                continue
            missing = int((status == NOT_COMPUTED).sum())
            done += status.size - missing
            if missing:
                todo.append((number, True))
        return StoreSurvey(todo, done, tuple(damaged))

    def _damaged_files(self, index: tuple[int, ...], status: np.ndarray) -> list[str]:
        """The files of a chunk that should be there and are not, or are damaged."""
        silent = np.isin(status, (*SUCCESS_CODES, NOT_COMPUTED)).all()
        found = []
        for name in self.chunked_arrays[:-1]:
            path = self.arrays[name].chunk_path(self._file_index(name, index))
            if not (self.root / path).exists():
                found += [] if name == "message" and silent else [f"{path} is missing"]
                continue
            try:
                self._read_chunk_file(name, index)
            except FileError:
                found.append(f"{path} is damaged")
        return found

    def status_counts(self) -> dict[str, int]:
        """How many points ended how; those that are not done are "missing"."""
        names = {number: name for name, number in STATUSES.items()}
        found: dict[str, int] = {}
        for number, status in self.chunk_statuses():
            if status is None:
                size = math.prod(stop - start for start, stop in self.chunk_bounds(self.chunk_index(number)))
                found["missing"] = found.get("missing", 0) + size
                continue
            for code, count in zip(*np.unique(status, return_counts=True), strict=True):
                found[names[int(code)]] = found.get(names[int(code)], 0) + int(count)
        return found


def _coordinates_checksum(axes: Axes) -> str:
    """A checksum of the coordinates, which their order belongs to."""
    found = hashlib.sha256()
    for array, values in _coordinate_arrays(axes, {}):
        found.update(json.dumps([array.name, values.shape, values.tolist()]).encode())
    return found.hexdigest()


def _component_dim_name(name: str, k: int, shape: tuple[int, ...]) -> str:
    """The name of a dimension of a measure that is not an axis."""
    return f"{name}_component" if len(shape) == 1 else f"{name}_component_{k}"


def _chunk_shape(shape: tuple[int, ...], points: int) -> tuple[int, ...]:
    """The shape of a chunk of about so many points, whole along the last axes."""
    found: list[int] = []
    for length in reversed(shape):
        found.append(max(1, min(length, points)))
        points //= found[-1]
    return tuple(reversed(found))


def _chunk_grid(array: ZarrArray) -> tuple[int, ...]:
    return tuple(-(-m // c) for m, c in zip(array.shape, array.chunks, strict=True))


def _coordinate_arrays(axes: Axes, about: Mapping[str, Mapping[str, Any]]) -> Iterator[tuple[ZarrArray, np.ndarray]]:
    """The coordinates of axes, with their values."""
    for axis in axes.axes:
        named = {axis.name: axis.labels, **axis.columns}
        if axis.states is not None:
            named[f"{axis.name}_state"] = axis.states
        for name, values in named.items():
            dims = (axis.name, "component")[: values.ndim]
            dtype = {"U": "string", "b": "bool", "i": "int64", "u": "int64"}.get(values.dtype.kind, "float64")
            chunks = (max(64, 1 << (len(values) - 1).bit_length()), *values.shape[1:])
            yield ZarrArray(name, dims, values.shape, chunks, dtype, dict(about.get(name, {}))), values


def match_axes(mine: Axes, theirs: Axes) -> Axes:
    """My axes with their values in the order of a store: first those that it has, then the new ones.

    Raises
    ------
    InputError
        If the axes are others, or mine lack values that the store has.
    """
    if mine.names != theirs.names or [tuple(a.columns) for a in mine.axes] != [tuple(a.columns) for a in theirs.axes]:
        names = [", ".join(f"{a.name} ({', '.join(a.columns)})" for a in axes.axes) for axes in (mine, theirs)]
        raise InputError(f"the axes are {names[0]}, and those of the store {names[1]}")
    found = []
    for axis, other in zip(mine.axes, theirs.axes, strict=True):
        if axis.has_same_values(other):  # what follows takes microseconds a value
            found.append(axis)
            continue
        free: dict[Any, list[int]] = {}
        for i, row in enumerate(axis.value_keys()):
            free.setdefault(row, []).append(i)
        for i, row in enumerate(other.value_keys()):
            if not free.get(row):
                raise InputError(
                    f"the axis {axis.name!r} lacks {row[0] if len(row) == 1 else row!r}, which is value {i} in the "
                    "store; an axis can be made longer, and keeps the values that it has"
                )
            free[row].pop(0)
        new = sorted(itertools.chain.from_iterable(free.values()))
        columns = {name: np.append(kept, axis.columns[name][new]) for name, kept in other.columns.items()}
        labels = columns.get(axis.name, np.arange(len(other) + len(new)))
        states = None
        if axis.states is not None and other.states is not None:
            states = np.concatenate([other.states, axis.states[new]])
        found.append(Axis(axis.name, labels, columns, states))
    return Axes(tuple(found))
