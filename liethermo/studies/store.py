"""The store of a study: a Zarr v3 group that can be read at any time.

Each chunk of points has a file in each array. The file in ``status`` is written last and marks the chunk as finished.
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
from .solve import EMPTY_POINT_STATUS, LAW_QUANTITIES, STATUSES, SUCCESS_CODES
from .store_metadata import MAX_CHUNKS, parse_group_metadata, with_checksum

STORE_FORMAT = "liethermo-study-1"
"""Value of the attribute ``format`` of a store."""

RERUN_ADVICE = "Run the study again to compute the damaged parts anew"
"""End of the error messages about damaged files."""


@dataclass(frozen=True)
class StoreSurvey:
    """Result of checking all files of a store.

    Attributes
    ----------
    remaining_chunks : list of (int, bool)
        Numbers of the unfinished chunks; True if some points of the chunk are finished.
    n_done : int
        Number of finished points.
    damaged : tuple of str
        Files that are missing or damaged, so that their chunks are computed again.
    """

    remaining_chunks: list[tuple[int, bool]]
    n_done: int
    damaged: tuple[str, ...] = ()


@dataclass(frozen=True)
class StudyStore:
    """A store, with the operations that read and write its chunks.

    Attributes
    ----------
    root : Path
    arrays : dict of ZarrArray
    attributes : dict
        Attributes of the group; ``attributes["study"]`` describes the study.
    """

    root: Path
    arrays: Mapping[str, ZarrArray]
    attributes: dict[str, Any] = field(default_factory=dict)

    # -- create and open ------------------------------------------------------------------------------------------

    @classmethod
    def create(
        cls,
        root: Path,
        axes: Axes,
        chunk: int,
        measures: Mapping[str, tuple],
        array_attributes: Mapping[str, Mapping[str, Any]],
        attributes: dict[str, Any],
    ) -> StudyStore:
        """Create a store atomically: it appears complete or not at all.

        Parameters
        ----------
        axes : Axes
        chunk : int
            Approximate number of points of a chunk.
        measures : dict from str to (shape, dtype)
            Shape and type of each measure at one point.
        array_attributes : dict from str to dict
            Attributes of the arrays.
        attributes : dict
            Attributes of the group.
        """
        chunks = _chunk_shape(axes.shape, chunk)
        if (n_chunks := math.prod(-(-m // c) for m, c in zip(axes.shape, chunks, strict=True))) > MAX_CHUNKS:
            raise InputError(
                f"{axes.size} points in chunks of {chunk} need {n_chunks} files, which are too many. Use a larger chunk"
            )

        def array(name: str, trailing_dims: Sequence[tuple[str, int]], dtype: str) -> ZarrArray:
            dims, sizes = (tuple(part) for part in zip(*trailing_dims, strict=True)) if trailing_dims else ((), ())
            shape = axes.shape + sizes
            return ZarrArray(
                name, axes.names + dims, shape, chunks + sizes, dtype, dict(array_attributes.get(name, {}))
            )

        arrays = [array("status", [], "int8"), array("message", [], "string")]
        arrays.append(array("laws", [("quantity", len(LAW_QUANTITIES))], "float64"))
        for name, (shape, dtype) in measures.items():
            arrays.append(array(name, [(_component_dim_name(name, k, shape), m) for k, m in enumerate(shape)], dtype))
        arrays.append(ZarrArray("quantity", ("quantity",), (len(LAW_QUANTITIES),), (len(LAW_QUANTITIES),), "string"))
        coordinates = [array for array, _ in _coordinate_arrays(axes, array_attributes)]
        store = cls(root, {a.name: a for a in [*arrays, *coordinates]}, attributes)
        partial_root = root.with_name(disk.partial_file_name(root.name))
        try:
            partial_root.mkdir(parents=True)
            partial_store = replace(store, root=partial_root)
            partial_store._write_metadata(axes)
            os.rename(partial_root, root)
        except OSError as error:
            shutil.rmtree(partial_root, ignore_errors=True)
            if isinstance(error.__cause__, OSError):  # a FileError of write_file
                error = error.__cause__
            if error.errno in (errno.ENOTEMPTY, errno.EEXIST):  # another run has created the store
                return cls.open(root)
            raise FileError(f"cannot make the store {root}: {disk.describe_os_error(error)}") from error
        return store

    @classmethod
    def open(cls, root: Path) -> StudyStore:
        """Open a store.

        Raises
        ------
        FileError
            If the folder does not exist or is not the store of a study.
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
            store = cls(root, *parse_group_metadata(root, content))
        except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
            raise FileError(f"{root} is the store of a study, but damaged or changed: {error}") from error
        files.require_plain_files(root)
        return store

    @property
    def study_description(self) -> dict[str, Any]:
        """The description of the study, see :func:`.identity.study_as_json`."""
        return self.attributes["study"]

    @property
    def measure_names(self) -> list[str]:
        return list(self.attributes["measures"])

    def extend(self, axes: Axes) -> StudyStore:
        """Write metadata for longer axes, which begin with the present values, and return the extended store."""
        shape = axes.shape
        arrays = {
            name: replace(array, shape=shape + array.shape[len(shape) :]) if name in self.chunked_array_names else array
            for name, array in self.arrays.items()
        }
        about = {name: array.attributes for name, array in arrays.items()}
        for array, _ in _coordinate_arrays(axes, about):
            arrays[array.name] = replace(array, chunks=self.arrays[array.name].chunks)
        store = replace(self, arrays=arrays)
        store._write_metadata(axes)
        return store

    def repair_axes(self, axes: Axes) -> Axes:
        """Return the axes of the store, after writing lost or damaged coordinate files again from ``axes``.

        Raises
        ------
        FileError
            If a file is lost and ``axes`` differ from the axes of the store in values or order.
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
        """Write the coordinates, then the metadata of the arrays, and finally the group's, which readers open first."""
        self.attributes["coordinates"] = _coordinates_checksum(axes)
        self._write_chunk_file("quantity", (0,), np.array(LAW_QUANTITIES, dtype=object))
        for array, values in _coordinate_arrays(axes, {}):
            stored_array = self.arrays[array.name]
            for index in np.ndindex(*_chunk_grid(stored_array)):
                chunk_values = values[
                    tuple(slice(i * c, (i + 1) * c) for i, c in zip(index, stored_array.chunks, strict=True))
                ]
                block = stored_array.empty_chunk()
                block[tuple(map(slice, chunk_values.shape))] = chunk_values
                self._write_chunk_file(array.name, index, block)
        metadata = {name: array.metadata() for name, array in self.arrays.items()}
        for name, content in metadata.items():
            files.write_json(self.root / name / "zarr.json", content)
        consolidated_metadata = {"kind": "inline", "must_understand": False, "metadata": metadata}
        group = {
            "zarr_format": 3,
            "node_type": "group",
            "attributes": self.attributes,
            "consolidated_metadata": consolidated_metadata,
        }
        files.write_json(self.root / "zarr.json", with_checksum(group))

    def read_axes(self) -> Axes:
        """Return the axes of the store with their values."""
        axes = []
        for name, columns in self.attributes["axes"].items():
            state_array = f"{name}_state"
            column_values = {column: self._read_array(column) for column in columns}
            axes.append(
                Axis(
                    name,
                    self._read_array(name),
                    column_values,
                    self._read_array(state_array) if state_array in self.arrays else None,
                )
            )
        return Axes(tuple(axes))

    def _read_array(self, name: str) -> np.ndarray:
        """Return a whole array of the store."""
        array = self.arrays[name]
        values = np.empty(array.shape, dtype=array.numpy_dtype)
        for index in np.ndindex(*_chunk_grid(array)):
            slices = tuple(
                slice(i * c, min((i + 1) * c, m)) for i, c, m in zip(index, array.chunks, array.shape, strict=True)
            )
            block = self._read_chunk_file(name, index)
            values[slices] = block[tuple(slice(0, s.stop - s.start) for s in slices)]
        return values.astype(str) if array.dtype == "string" else values

    # -- chunks of points -------------------------------------------------------------------------------------------

    @property
    def chunked_array_names(self) -> list[str]:
        """Names of the arrays with one chunk per chunk of points; ``status``, which marks it as finished, is the
        last."""
        return [*self.measure_names, "laws", "message", "status"]

    @property
    def shape(self) -> tuple[int, ...]:
        return self.arrays["status"].shape

    @property
    def chunk_grid(self) -> tuple[int, ...]:
        """Number of chunks along each axis."""
        return _chunk_grid(self.arrays["status"])

    @property
    def n_points(self) -> int:
        return math.prod(self.shape)

    def chunk_index(self, number: int) -> tuple[int, ...]:
        """Return the index of a chunk along each axis from its number."""
        return tuple(map(int, np.unravel_index(number, self.chunk_grid)))

    def chunk_bounds(self, index: Sequence[int]) -> tuple[tuple[int, int], ...]:
        """Return the range (start, stop) of the points of a chunk along each axis."""
        status = self.arrays["status"]
        return tuple((i * c, min((i + 1) * c, m)) for i, c, m in zip(index, status.chunks, status.shape, strict=True))

    def point_indices(self, index: Sequence[int], mask: np.ndarray | None = None) -> tuple[np.ndarray, ...]:
        """Return the indices along each axis of the points of a chunk, restricted to ``mask`` if that is given."""
        bounds = self.chunk_bounds(index)
        local_indices = np.indices([stop - start for start, stop in bounds]).reshape(len(bounds), -1)
        if mask is not None:
            local_indices = local_indices[:, mask[tuple(slice(0, stop - start) for start, stop in bounds)].ravel()]
        return tuple(local_index + start for local_index, (start, _) in zip(local_indices, bounds, strict=True))

    def write_chunk(
        self,
        chunk_index: Sequence[int],
        point_indices: tuple[np.ndarray, ...],
        arrays: Mapping[str, Any],
        is_partial: bool,
    ) -> None:
        """Write the values at some points of a chunk; its other points keep their values if the chunk is partial."""
        local_indices = tuple(
            axis_indices - start
            for axis_indices, (start, _) in zip(point_indices, self.chunk_bounds(chunk_index), strict=True)
        )
        for name in self.chunked_array_names:
            block = (
                self._read_chunk_file(name, chunk_index)
                if is_partial and self._has_chunk(name, chunk_index)
                else self.arrays[name].empty_chunk()
            )
            if name in arrays:  # a measure has no values where no point could be run
                block[local_indices] = arrays[name]
            if name != "message" or (block != "").any():
                self._write_chunk_file(name, chunk_index, block)
            elif self._has_chunk(name, chunk_index):  # a chunk without messages has no file of them
                (self.root / self.arrays[name].chunk_path(chunk_index)).unlink()

    def read_chunk(self, name: str, index: Sequence[int]) -> np.ndarray:
        """Return the values of an array in a chunk; fill values if its file is missing."""
        block = self._read_chunk_file(name, index) if self._has_chunk(name, index) else self.arrays[name].empty_chunk()
        slices = tuple(slice(0, stop - start) for start, stop in self.chunk_bounds(index))
        return block[slices]

    def _has_chunk(self, name: str, index: Sequence[int]) -> bool:
        return os.path.lexists(self.root / self.arrays[name].chunk_path(self._padded_chunk_index(name, index)))

    def _padded_chunk_index(self, name: str, index: Sequence[int]) -> tuple[int, ...]:
        """Return the index of a chunk in an array with more dimensions than the axes, padded with zeros."""
        return (*index, *(0 for _ in range(len(self.arrays[name].dims) - len(index))))

    def _read_chunk_file(self, name: str, index: Sequence[int]) -> np.ndarray:
        """Read and check a chunk; raise FileError if it is missing or damaged."""
        path = self.root / self.arrays[name].chunk_path(self._padded_chunk_index(name, index))
        try:
            block = self.arrays[name].decode_chunk(files.read_plain_file(path))
            if name == "status" and not np.isin(block, (*STATUSES.values(), EMPTY_POINT_STATUS)).all():
                raise ValueError("it has a status that there is not")
            return block
        except FileError as error:
            raise FileError(f"{error}. {RERUN_ADVICE}") from error
        except (ValueError, struct.error) as error:
            raise FileError(f"{path} is damaged: {error}. {RERUN_ADVICE}") from error

    def require_chunk(self, name: str, index: tuple[int, ...]) -> None:
        """Raise FileError if a chunk is damaged, or missing although its points are marked as finished."""
        is_required = name not in self.chunked_array_names or (
            name != "message" and self._has_chunk("status", index[: len(self.shape)])
        )
        if (is_required and name != "status") or self._has_chunk(name, index):
            self._read_chunk_file(name, index)

    def _write_chunk_file(self, name: str, index: Sequence[int], block: np.ndarray) -> None:
        files.write_file(
            self.root / self.arrays[name].chunk_path(self._padded_chunk_index(name, index)),
            self.arrays[name].encode_chunk(block),
        )

    # -- survey -------------------------------------------------------------------------------------------------------

    def chunk_statuses(self) -> Iterator[tuple[int, np.ndarray | None]]:
        """Yield the number of each chunk and the status of its points, or None if that file is missing or damaged."""
        for number in range(math.prod(self.chunk_grid)):
            index = self.chunk_index(number)
            try:
                yield number, self.read_chunk("status", index) if self._has_chunk("status", index) else None
            except FileError:
                yield number, None

    def survey(self) -> StoreSurvey:
        """Check every file, and return the unfinished chunks, the number of finished points and the damaged files."""
        remaining_chunks: list[tuple[int, bool]] = []
        damaged_files: list[str] = []
        n_done = 0
        for number, status in self.chunk_statuses():
            index = self.chunk_index(number)
            faults = [] if status is None else self._file_fault_texts(index, status)
            if status is None and self._has_chunk("status", index):
                faults = [f"{self.arrays['status'].chunk_path(index)} is damaged"]
            damaged_files += faults
            if status is None or faults:
                remaining_chunks.append((number, False))
                continue
            n_missing = int((status == EMPTY_POINT_STATUS).sum())
            n_done += status.size - n_missing
            if n_missing:
                remaining_chunks.append((number, True))
        return StoreSurvey(remaining_chunks, n_done, tuple(damaged_files))

    def _file_fault_texts(self, index: tuple[int, ...], status: np.ndarray) -> list[str]:
        """Return a line for each file of a finished chunk that is missing or damaged."""
        has_no_messages = np.isin(status, (*SUCCESS_CODES, EMPTY_POINT_STATUS)).all()
        faults = []
        for name in self.chunked_array_names[:-1]:
            path = self.arrays[name].chunk_path(self._padded_chunk_index(name, index))
            if not (self.root / path).exists():
                faults += [] if name == "message" and has_no_messages else [f"{path} is missing"]
                continue
            try:
                self._read_chunk_file(name, index)
            except FileError:
                faults.append(f"{path} is damaged")
        return faults

    def status_counts(self) -> dict[str, int]:
        """Return the number of points by status name; unfinished points are "missing"."""
        names = {number: name for name, number in STATUSES.items()}
        counts: dict[str, int] = {}
        for number, status in self.chunk_statuses():
            if status is None:
                n_points = math.prod(stop - start for start, stop in self.chunk_bounds(self.chunk_index(number)))
                counts["missing"] = counts.get("missing", 0) + n_points
                continue
            for code, count in zip(*np.unique(status, return_counts=True), strict=True):
                counts[names[int(code)]] = counts.get(names[int(code)], 0) + int(count)
        return counts


def _coordinates_checksum(axes: Axes) -> str:
    """Return the SHA-256 digest of the coordinates, in order."""
    digest = hashlib.sha256()
    for array, values in _coordinate_arrays(axes, {}):
        digest.update(json.dumps([array.name, values.shape, values.tolist()]).encode())
    return digest.hexdigest()


def _component_dim_name(name: str, k: int, shape: tuple[int, ...]) -> str:
    """Return the name of dimension k of one measured value."""
    return f"{name}_component" if len(shape) == 1 else f"{name}_component_{k}"


def _chunk_shape(shape: tuple[int, ...], n_points: int) -> tuple[int, ...]:
    """Return the shape of a chunk of about ``n_points`` points, filled along the last axes first."""
    reversed_shape: list[int] = []
    for length in reversed(shape):
        reversed_shape.append(max(1, min(length, n_points)))
        n_points //= reversed_shape[-1]
    return tuple(reversed(reversed_shape))


def _chunk_grid(array: ZarrArray) -> tuple[int, ...]:
    """Return the number of chunks along each dimension of an array."""
    return tuple(-(-m // c) for m, c in zip(array.shape, array.chunks, strict=True))


def _coordinate_arrays(
    axes: Axes, array_attributes: Mapping[str, Mapping[str, Any]]
) -> Iterator[tuple[ZarrArray, np.ndarray]]:
    """Yield the coordinate arrays of the axes, with their values."""
    for axis in axes.axes:
        coordinates = {axis.name: axis.labels, **axis.columns}
        if axis.states is not None:
            coordinates[f"{axis.name}_state"] = axis.states
        for name, values in coordinates.items():
            dims = (axis.name, "component")[: values.ndim]
            dtype = {"U": "string", "b": "bool", "i": "int64", "u": "int64"}.get(values.dtype.kind, "float64")
            chunks = (max(64, 1 << (len(values) - 1).bit_length()), *values.shape[1:])
            yield ZarrArray(name, dims, values.shape, chunks, dtype, dict(array_attributes.get(name, {}))), values


def axes_in_store_order(study_axes: Axes, stored_axes: Axes) -> Axes:
    """Return the study's axes in the order of a store: first the values that it has, then the new ones.

    Raises
    ------
    InputError
        If the axes have other names, or lack values that the store has.
    """
    if study_axes.names != stored_axes.names or [tuple(a.columns) for a in study_axes.axes] != [
        tuple(a.columns) for a in stored_axes.axes
    ]:
        names = [
            ", ".join(f"{a.name} ({', '.join(a.columns)})" for a in axes.axes) for axes in (study_axes, stored_axes)
        ]
        raise InputError(f"the axes are {names[0]}, but those of the store {names[1]}")
    matched_axes = []
    for axis, stored_axis in zip(study_axes.axes, stored_axes.axes, strict=True):
        if axis.has_same_values(stored_axis):  # skip the search, which takes microseconds per value
            matched_axes.append(axis)
            continue
        unmatched_indices: dict[Any, list[int]] = {}
        for i, row in enumerate(axis.value_keys()):
            unmatched_indices.setdefault(row, []).append(i)
        for i, row in enumerate(stored_axis.value_keys()):
            if not unmatched_indices.get(row):
                raise InputError(
                    f"the axis {axis.name!r} lacks {row[0] if len(row) == 1 else row!r}, which is value {i} in the "
                    "store; an axis can be extended, but must keep its values"
                )
            unmatched_indices[row].pop(0)
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
