"""The store of a study: a Zarr v3 group that can be read at any time, also by ``zarr`` and ``xarray``.

Each chunk of points has a file in each array. The file in ``status`` is written last and marks the chunk as finished.
"""

from __future__ import annotations

import errno
import hashlib
import json
import math
import os
import shutil
import struct
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from .. import disk
from ..errors import FileError, InputError
from . import store_metadata
from .axes import Axes, Axis
from .solve import EMPTY_POINT_STATUS, LAW_QUANTITIES, STATUSES, SUCCESS_CODES
from .store_metadata import (
    MAX_CHUNKS,
    ZarrArray,
    coordinate_arrays_and_values,
    describe_point_arrays,
    parse_group_metadata,
    with_checksum,
)

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
    """The store of a study on disk, with the operations that read and write its chunks.

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

    @classmethod
    def create(
        cls,
        root: Path,
        axes: Axes,
        points_per_chunk: int,
        measures: Mapping[str, tuple[tuple[int, ...], str]],
        array_attributes: Mapping[str, Mapping[str, Any]],
        attributes: dict[str, Any],
    ) -> StudyStore:
        """Create and return a store atomically: its folder appears complete or not at all.

        Parameters
        ----------
        axes : Axes
        points_per_chunk : int
            Approximate number of points of a chunk.
        measures : dict from str to (shape, dtype)
            Shape and type of each measure at one point.
        array_attributes : dict from str to dict
            Attributes of the arrays.
        attributes : dict
            Attributes of the group.
        """
        chunk_shape = _chunk_shape(axes.shape, points_per_chunk)
        arrays = describe_point_arrays(axes.names, axes.shape, chunk_shape, measures, array_attributes)
        if (n_chunks := math.prod(arrays["status"].chunk_grid)) > MAX_CHUNKS:
            raise InputError(
                f"{axes.size} points in chunks of {points_per_chunk} need {n_chunks} files, which are too many. "
                "Use a larger chunk"
            )
        arrays |= {array.name: array for array, _ in coordinate_arrays_and_values(axes, array_attributes)}
        store = cls(root, arrays, attributes)
        partial_root = root.with_name(disk.partial_file_name(root.name))
        try:
            partial_root.mkdir(parents=True)
            replace(store, root=partial_root)._write_metadata(axes)
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
        """Open the store in a folder and return it.

        Raises
        ------
        FileError
            If the folder does not exist or is not the store of a study.
        """
        if not root.exists():
            raise FileError(f"there is no store {root!s:.200}")
        kind = "folder" if root.is_dir() else "file"
        try:
            content = json.loads(store_metadata.read_plain_file(root / "zarr.json"))
            assert content["attributes"]["format"] == STORE_FORMAT
        except (FileError, ValueError, KeyError, TypeError, AssertionError, RecursionError) as error:
            raise FileError(f"{root} is a {kind}, but not the store of a study. Use another name") from error
        try:
            store = cls(root, *parse_group_metadata(root, content))
        except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
            raise FileError(f"{root} is the store of a study, but damaged or changed: {error}") from error
        store_metadata.require_plain_files(root)
        return store

    @property
    def study_description(self) -> dict[str, Any]:
        """The description of the study, see :func:`.identity.study_as_json`."""
        return self.attributes["study"]

    def extend(self, axes: Axes) -> StudyStore:
        """Extend the store to longer axes, which begin with the stored values; write its metadata and return it."""
        arrays = dict(self.arrays)
        for name in self.chunked_array_names:
            arrays[name] = replace(arrays[name], shape=axes.shape + arrays[name].shape[len(axes.shape) :])
        for array, _ in coordinate_arrays_and_values(axes, {}):
            arrays[array.name] = replace(arrays[array.name], shape=array.shape, dtype=array.dtype)
        store = replace(self, arrays=arrays)
        store._write_metadata(axes)
        return store

    def read_or_repair_axes(self, axes: Axes) -> Axes:
        """Return the axes of the store; if coordinate files are lost or damaged, write them again from ``axes``.

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
                    f"{error}. To write the file again, run a study with the axes of the store, in their order"
                ) from error
        self._write_metadata(axes)
        return self.read_axes()

    def _write_metadata(self, axes: Axes) -> None:
        """Write the coordinate files, then the metadata of the arrays, and finally the group metadata, which readers
        open first."""
        self.attributes["coordinates"] = _coordinates_checksum(axes)
        coordinates = {array.name: values for array, values in coordinate_arrays_and_values(axes, {})}
        for name, values in {"quantity": np.array(LAW_QUANTITIES), **coordinates}.items():
            array = self.arrays[name]
            for index in np.ndindex(*array.chunk_grid):
                slices, block = array.chunk_slices(index), array.empty_chunk()
                block[_slices_within_chunk(slices)] = values[slices]
                self._write_padded_chunk(name, index, block)
        metadata = {name: array.metadata() for name, array in self.arrays.items()}
        group = {
            "zarr_format": 3,
            "node_type": "group",
            "attributes": self.attributes,
            "consolidated_metadata": {"kind": "inline", "must_understand": False, "metadata": metadata},
        }
        contents = {f"{name}/zarr.json": content for name, content in metadata.items()}
        for path, content in {**contents, "zarr.json": with_checksum(group)}.items():
            store_metadata.write_file(self.root / path, json.dumps(content, indent=1, allow_nan=False).encode())

    def read_axes(self) -> Axes:
        """Read and return the axes of the store with their values."""
        axes = []
        for name, columns in self.attributes["axes"].items():
            state_array = f"{name}_state"
            states = self._read_array(state_array) if state_array in self.arrays else None
            column_values = {column: self._read_array(column) for column in columns}
            axes.append(Axis(name, self._read_array(name), column_values, states))
        return Axes(tuple(axes))

    def _read_array(self, array_name: str) -> np.ndarray:
        """Return an array of the store, of all its chunks; raise FileError if one is missing or damaged."""
        array = self.arrays[array_name]
        values = np.empty(array.shape, dtype=array.numpy_dtype)
        for index in np.ndindex(*array.chunk_grid):
            slices = array.chunk_slices(index)
            values[slices] = self.read_required_chunk(array_name, index)[_slices_within_chunk(slices)]
        return values.astype(str) if array.dtype == "string" else values

    # -- chunks of points -------------------------------------------------------------------------------------------

    @property
    def chunked_array_names(self) -> list[str]:
        """Names of the arrays with one chunk per chunk of points; ``status``, which marks it as finished, is the
        last."""
        return [*self.attributes["measures"], "laws", "message", "status"]

    @property
    def shape(self) -> tuple[int, ...]:
        return self.arrays["status"].shape

    @property
    def n_points(self) -> int:
        return math.prod(self.shape)

    def chunk_index(self, chunk_number: int) -> tuple[int, ...]:
        """Return the index of a chunk along each axis of the chunk grid, from the number of the chunk."""
        return tuple(map(int, np.unravel_index(chunk_number, self.arrays["status"].chunk_grid)))

    def point_indices(self, chunk_index: Sequence[int], mask: np.ndarray | None = None) -> tuple[np.ndarray, ...]:
        """Return the indices, along each axis of the study, of the points of a chunk, or of those in ``mask``."""
        slices = self.arrays["status"].chunk_slices(chunk_index)
        local_indices = np.indices([s.stop - s.start for s in slices]).reshape(len(slices), -1)
        if mask is not None:
            local_indices = local_indices[:, mask.ravel()]
        return tuple(local_index + s.start for local_index, s in zip(local_indices, slices, strict=True))

    def write_chunk(
        self,
        chunk_index: Sequence[int],
        point_indices: tuple[np.ndarray, ...],
        arrays: Mapping[str, Any],
        is_partial: bool,
    ) -> None:
        """Write the values at some points of a chunk; its other points keep their values if the chunk is partial."""
        slices = self.arrays["status"].chunk_slices(chunk_index)
        local_indices = tuple(indices - s.start for indices, s in zip(point_indices, slices, strict=True))
        for name in self.chunked_array_names:
            block = self.read_padded_chunk(name, chunk_index) if is_partial else None
            block = self.arrays[name].empty_chunk() if block is None else block
            if name in arrays:  # a measure has no values where no point could be run
                block[local_indices] = arrays[name]
            if name != "message" or (block != "").any():
                self._write_padded_chunk(name, chunk_index, block)
            else:  # a chunk without messages has no file of them
                (self.root / self._chunk_key(name, chunk_index)).unlink(missing_ok=True)

    def read_chunk(self, array_name: str, chunk_index: Sequence[int]) -> np.ndarray:
        """Return the values of an array in a chunk, without the padding of the chunk; fill values if its file is
        missing."""
        block = self.read_padded_chunk(array_name, chunk_index)
        slices = _slices_within_chunk(self.arrays["status"].chunk_slices(chunk_index))
        return (self.arrays[array_name].empty_chunk() if block is None else block)[slices]

    def read_padded_chunk(self, array_name: str, chunk_index: Sequence[int]) -> np.ndarray | None:
        """Return the values of an array in a chunk, padded to the chunk shape, or None if the chunk has no file; raise
        FileError if the file is damaged."""
        path = self.root / self._chunk_key(array_name, chunk_index)
        if not os.path.lexists(path):
            return None
        try:
            block = self.arrays[array_name].decode_chunk(store_metadata.read_plain_file(path))
            if array_name == "status" and not np.isin(block, (*STATUSES.values(), EMPTY_POINT_STATUS)).all():
                raise ValueError("it has a status that there is not")
            return block
        except FileError as error:
            raise FileError(f"{error}. {RERUN_ADVICE}") from error
        except (ValueError, struct.error) as error:
            raise FileError(f"{path} is damaged: {error}. {RERUN_ADVICE}") from error

    def read_required_chunk(self, array_name: str, chunk_index: Sequence[int]) -> np.ndarray:
        """Return the values of an array in a chunk, padded to the chunk shape; raise FileError if its file is damaged
        or missing."""
        block = self.read_padded_chunk(array_name, chunk_index)
        if block is None:
            raise FileError(f"{self.root / self._chunk_key(array_name, chunk_index)} is missing. {RERUN_ADVICE}")
        return block

    def check_chunk_file(self, array_name: str, chunk_index: Sequence[int]) -> None:
        """Raise FileError if the file of a chunk is damaged, or missing although the points of the chunk are
        finished."""
        is_of_points = array_name in self.chunked_array_names
        can_be_missing = (
            array_name in ("message", "status")
            or self.read_padded_chunk("status", chunk_index[: len(self.shape)]) is None
        )
        (self.read_padded_chunk if is_of_points and can_be_missing else self.read_required_chunk)(
            array_name, chunk_index
        )

    def _chunk_key(self, array_name: str, chunk_index: Sequence[int]) -> str:
        """Return the path of a chunk's file inside the store, with index 0 along the dimensions that are no axes of the
        study."""
        padding = [0] * (len(self.arrays[array_name].dims) - len(chunk_index))
        return "/".join([array_name, "c", *map(str, chunk_index), *map(str, padding)])

    def _write_padded_chunk(self, array_name: str, chunk_index: Sequence[int], block: np.ndarray) -> None:
        store_metadata.write_file(
            self.root / self._chunk_key(array_name, chunk_index), self.arrays[array_name].encode_chunk(block)
        )

    # -- survey -------------------------------------------------------------------------------------------------------

    def chunk_statuses(self) -> Iterator[tuple[int, np.ndarray]]:
        """Yield the number of each chunk and the status codes of its points; points without a readable file count as
        unfinished."""
        for number in range(math.prod(self.arrays["status"].chunk_grid)):
            index = self.chunk_index(number)
            try:
                yield number, self.read_chunk("status", index)
            except FileError:
                slices = _slices_within_chunk(self.arrays["status"].chunk_slices(index))
                yield number, self.arrays["status"].empty_chunk()[slices]

    def survey(self) -> StoreSurvey:
        """Check every file of the store; return the unfinished chunks, the number of finished points and the damaged
        files."""
        remaining_chunks: list[tuple[int, bool]] = []
        damaged_files: list[str] = []
        n_done = 0
        for number, status in self.chunk_statuses():
            index = self.chunk_index(number)
            is_begun = os.path.lexists(self.root / self._chunk_key("status", index))
            faults = self._chunk_file_faults(index, status) if is_begun else []
            is_missing = status == EMPTY_POINT_STATUS
            damaged_files += faults
            if faults or is_missing.any():
                remaining_chunks.append((number, is_begun and not faults))
            n_done += 0 if faults else int((~is_missing).sum())
        return StoreSurvey(remaining_chunks, n_done, tuple(damaged_files))

    def _chunk_file_faults(self, chunk_index: Sequence[int], status: np.ndarray) -> list[str]:
        """Return a message for each file of a finished chunk that is missing or damaged."""
        has_no_messages = np.isin(status, (*SUCCESS_CODES, EMPTY_POINT_STATUS)).all()
        faults = []
        for name in self.chunked_array_names:
            try:
                if self.read_padded_chunk(name, chunk_index) is None and not (name == "message" and has_no_messages):
                    faults.append(f"{self._chunk_key(name, chunk_index)} is missing")
            except FileError:
                faults.append(f"{self._chunk_key(name, chunk_index)} is damaged")
        return faults

    def status_counts(self) -> dict[str, int]:
        """Return the number of points by status name; unfinished points are "missing"."""
        names = {number: name for name, number in STATUSES.items()}
        counts: Counter[str] = Counter()
        for _, status in self.chunk_statuses():
            codes, code_counts = np.unique(status, return_counts=True)
            counts.update({names[int(code)]: int(n) for code, n in zip(codes, code_counts, strict=True)})
        return dict(counts)


def _slices_within_chunk(array_slices: Sequence[slice]) -> tuple[slice, ...]:
    """Return the slices of a padded chunk that hold values, from the slices of the array that the chunk covers."""
    return tuple(slice(0, s.stop - s.start) for s in array_slices)


def _coordinates_checksum(axes: Axes) -> str:
    """Return the SHA-256 digest of the coordinates of all axes, in order."""
    digest = hashlib.sha256()
    for array, values in coordinate_arrays_and_values(axes, {}):
        digest.update(json.dumps([array.name, values.shape, values.tolist()]).encode())
    return digest.hexdigest()


def _chunk_shape(grid_shape: tuple[int, ...], points_per_chunk: int) -> tuple[int, ...]:
    """Return the shape of a chunk of about ``points_per_chunk`` points of a grid, as long as possible along the last
    axes."""
    reversed_shape: list[int] = []
    for length in reversed(grid_shape):
        reversed_shape.append(max(1, min(length, points_per_chunk)))
        points_per_chunk //= reversed_shape[-1]
    return tuple(reversed(reversed_shape))
