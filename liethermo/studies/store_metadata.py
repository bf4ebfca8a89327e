"""Files of a store: Zarr v3 metadata with their validation, chunks, and a lock; stores may be foreign or damaged.

The chunks are encoded here, since the writer of the ``zarr`` package takes ten times as long for a small chunk and its
reader replaces a missing chunk by fill values. The codecs are "bytes" or "vlen-utf8", and "crc32c".
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import json
import math
import os
import shutil
import socket
import stat
import struct
import tempfile
import time
import weakref
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from manifolds.errors import warn

from .. import disk
from ..errors import FileError
from ..results.netcdf import dataclass_from_json
from ..results.status import Laws
from .axes import MAX_POINTS, Axes, is_valid_name
from .solve import EMPTY_POINT_STATUS, LAW_QUANTITIES

FILL_VALUES: dict[str, Any] = {
    "int8": EMPTY_POINT_STATUS,
    "int64": 0,
    "float64": "NaN",
    "complex128": ["NaN", "NaN"],
    "bool": False,
    "string": "",
}
"""Fill value, as JSON, of each Zarr data type that a store may contain."""

MAX_CHUNK_VALUES = 2**27
"""Maximum number of values in a chunk, a limit on the memory that a foreign store can claim."""

MAX_CHUNKS = 10**7
"""Maximum number of chunks of a store; each chunk is a file in each array."""

CHECKSUM_ATTRIBUTE = "sha256"
"""Attribute of the group with the SHA-256 digest of all other metadata."""


@dataclass(frozen=True)
class ZarrArray:
    """Metadata of one array of a store, with the encoding of its chunks.

    Attributes
    ----------
    name : str
    dims : tuple of str
    shape, chunks : tuple of int
    dtype : str
        A data type of Zarr, one of :data:`FILL_VALUES`.
    attributes : dict
    """

    name: str
    dims: tuple[str, ...]
    shape: tuple[int, ...]
    chunks: tuple[int, ...]
    dtype: str
    attributes: Mapping[str, Any] = field(default_factory=dict)

    def metadata(self) -> dict[str, Any]:
        """Return the content of the array's ``zarr.json``."""
        bytes_codec = {"name": "bytes", "configuration": {"endian": "little"}}
        return {
            "zarr_format": 3,
            "node_type": "array",
            "shape": list(self.shape),
            "data_type": self.dtype,
            "chunk_grid": {"name": "regular", "configuration": {"chunk_shape": list(self.chunks)}},
            "chunk_key_encoding": {"name": "default", "configuration": {"separator": "/"}},
            "fill_value": FILL_VALUES[self.dtype],
            "codecs": [{"name": "vlen-utf8"} if self.dtype == "string" else bytes_codec, {"name": "crc32c"}],
            "attributes": self.attributes,
            "dimension_names": list(self.dims),
            "storage_transformers": [],
        }

    @classmethod
    def from_metadata(cls, name: str, metadata: dict[str, Any]) -> ZarrArray:
        """Return an array description read from Zarr metadata; raise ValueError, KeyError or TypeError if no study can
        have written the metadata."""
        chunks, attributes = metadata["chunk_grid"]["configuration"]["chunk_shape"], metadata["attributes"]
        dims, shape, dtype = metadata["dimension_names"], metadata["shape"], metadata["data_type"]
        array = cls(name, tuple(dims), tuple(shape), tuple(chunks), dtype, attributes)
        is_valid_shape = all(type(n) is int and 0 <= n < 2**48 for n in [*shape, *chunks]) and 0 not in chunks
        if not (is_valid_shape and len(shape) == len(chunks) == len(dims) and math.prod(chunks) <= MAX_CHUNK_VALUES):
            raise ValueError(f"the array {name!r} has shape {shape} in chunks {chunks}")
        if not isinstance(attributes, dict) or array.metadata() != metadata:  # other readers use its codecs
            raise ValueError(f"a study writes no array {name!r}")
        return array

    @property
    def numpy_dtype(self) -> np.dtype:
        return np.dtype(object if self.dtype == "string" else self.dtype).newbyteorder("<")

    @property
    def chunk_grid(self) -> tuple[int, ...]:
        """Number of chunks along each dimension."""
        return tuple(-(-m // c) for m, c in zip(self.shape, self.chunks, strict=True))

    def chunk_slices(self, index: Sequence[int]) -> tuple[slice, ...]:
        """Return the slices of the array, along its first ``len(index)`` dimensions, that a chunk covers."""
        return tuple(slice(i * c, min((i + 1) * c, m)) for i, c, m in zip(index, self.chunks, self.shape, strict=False))

    def empty_chunk(self) -> np.ndarray:
        """Return a chunk of fill values, shape ``chunks``."""
        fill_value = np.nan if self.dtype in ("float64", "complex128") else FILL_VALUES[self.dtype]
        return np.full(self.chunks, fill_value, dtype=self.numpy_dtype)

    def encode_chunk(self, block: np.ndarray) -> bytes:
        """Return the content of a chunk's file: the encoded values and their CRC-32C checksum."""
        if self.dtype == "string":
            texts = [str(value).encode() for value in block.ravel()]
            data = b"".join([struct.pack("<I", len(texts)), *(struct.pack("<I", len(text)) + text for text in texts)])
        else:
            data = np.asarray(block, dtype=self.numpy_dtype).tobytes()
        return data + struct.pack("<I", _crc32c(data))

    def decode_chunk(self, data: bytes) -> np.ndarray:
        """Return the values of a chunk, decoded from the content of its file; raise ValueError or ``struct.error`` if
        the content is damaged."""
        content, size = data[:-4], math.prod(self.chunks)
        if len(data) < 4 or struct.pack("<I", _crc32c(content)) != data[-4:]:
            raise ValueError("it does not have its checksum")
        if self.dtype != "string":
            values = np.frombuffer(content, dtype=self.numpy_dtype).copy()
        elif struct.unpack_from("<I", content)[0] == size <= len(content) // 4:
            values, offset = np.full(size, "", dtype=object), 4
            for i in range(size):
                (length,) = struct.unpack_from("<I", content, offset)
                values[i] = content[offset + 4 : offset + 4 + length].decode()
                offset += 4 + length
        else:
            values = np.empty(0)
        if values.size != size:
            raise ValueError(f"it does not have {size} values")
        return values.reshape(self.chunks)


def _crc32c(data: bytes) -> int:
    import google_crc32c

    return google_crc32c.value(data)


def describe_point_arrays(
    axis_names: tuple[str, ...],
    shape: tuple[int, ...],
    chunks: tuple[int, ...],
    measures: Mapping[str, tuple[tuple[int, ...], str]],
    array_attributes: Mapping[str, Mapping[str, Any]],
) -> dict[str, ZarrArray]:
    """Return descriptions, by name, of the arrays with a value at each point: status, message, laws and measures; and
    of the coordinate ``quantity``.

    ``measures`` has the shape and data type of each measure at one point.
    """
    n_quantities = len(LAW_QUANTITIES)
    trailing: dict[str, tuple[tuple[str, ...], tuple[int, ...], str]]
    trailing = {"status": ((), (), "int8"), "message": ((), (), "string")}
    trailing["laws"] = ("quantity",), (n_quantities,), "float64"
    for name, (sizes, dtype) in measures.items():
        dims = (f"{name}_component",) if len(sizes) == 1 else tuple(f"{name}_component_{k}" for k in range(len(sizes)))
        trailing[name] = dims, sizes, dtype
    arrays = {
        name: ZarrArray(name, axis_names + dims, shape + sizes, chunks + sizes, dtype, array_attributes.get(name, {}))
        for name, (dims, sizes, dtype) in trailing.items()
    }
    return {**arrays, "quantity": ZarrArray("quantity", ("quantity",), (n_quantities,), (n_quantities,), "string")}


def coordinate_arrays_and_values(
    axes: Axes, array_attributes: Mapping[str, Mapping[str, Any]]
) -> Iterator[tuple[ZarrArray, np.ndarray]]:
    """Yield, for each coordinate of the axes, the description of its array and its values."""
    for axis in axes.axes:
        coordinates = {axis.name: axis.labels, **axis.columns}
        if axis.states is not None:
            coordinates[f"{axis.name}_state"] = axis.states
        for name, values in coordinates.items():
            dims = (axis.name, "component")[: values.ndim]
            dtype = {"U": "string", "b": "bool", "i": "int64", "u": "int64"}.get(values.dtype.kind, "float64")
            chunks = (max(64, 1 << (len(values) - 1).bit_length()), *values.shape[1:])
            yield ZarrArray(name, dims, values.shape, chunks, dtype, array_attributes.get(name, {})), values


def with_checksum(group_metadata: dict[str, Any]) -> dict[str, Any]:
    """Return the metadata of a Zarr group with their SHA-256 digest added to the attributes."""
    attributes = {name: value for name, value in group_metadata["attributes"].items() if name != CHECKSUM_ATTRIBUTE}
    group_metadata = {**group_metadata, "attributes": attributes}
    digest = hashlib.sha256(json.dumps(group_metadata, sort_keys=True).encode()).hexdigest()
    return {**group_metadata, "attributes": {**attributes, CHECKSUM_ATTRIBUTE: digest}}


def parse_group_metadata(root: Path, group_metadata: dict[str, Any]) -> tuple[dict[str, ZarrArray], dict[str, Any]]:
    """Check the metadata of a Zarr group, which may be foreign or damaged, and return its arrays and attributes.

    Raises
    ------
    ValueError, KeyError, TypeError, AttributeError
        If no study can have written the metadata.

    Warns
    -----
    UserWarning
        If an earlier version wrote the metadata, without a checksum.
    """
    attributes = group_metadata["attributes"]
    if CHECKSUM_ATTRIBUTE not in attributes:
        warn(f"{root} has no checksum of its metadata, as an earlier version made it: damage to them would not show")
    elif attributes[CHECKSUM_ATTRIBUTE] != with_checksum(group_metadata)["attributes"][CHECKSUM_ATTRIBUTE]:
        raise ValueError("its metadata do not have the checksum that they were written with")
    stored_metadata = group_metadata["consolidated_metadata"]["metadata"]
    arrays = {name: ZarrArray.from_metadata(name, metadata) for name, metadata in stored_metadata.items()}
    status, measures, axes = arrays["status"], list(attributes["measures"]), attributes["axes"]
    columns = [name for axis in axes.values() for name in axis]
    for name in (*measures, *axes, *columns):
        if not is_valid_name(name):
            raise ValueError(f"nothing in it can be called {name!r:.120}")
    if shared_names := {*measures} & {*axes, *columns}:
        raise ValueError(f"{shared_names.pop()!r} names a measure and an axis; rename one of them")
    if math.prod(status.shape) > MAX_POINTS or math.prod(status.chunk_grid) > MAX_CHUNKS:
        raise ValueError(f"no study has points in shape {status.shape} and chunks {status.chunks}")
    array_attributes = {name: array.attributes for name, array in arrays.items()}
    values = {name: (arrays[name].shape[len(axes) :], arrays[name].dtype) for name in measures}
    expected_arrays = describe_point_arrays(tuple(axes), status.shape, status.chunks, values, array_attributes)
    for (axis_name, column_names), length in zip(axes.items(), status.shape, strict=True):
        for name in (axis_name, *column_names, *({f"{axis_name}_state"} & set(arrays))):
            array = arrays[name]
            dims, sizes = (axis_name, "component")[: len(array.shape)], array.shape[1:]
            expected_arrays[name] = replace(array, dims=dims, shape=(length, *sizes), chunks=(array.chunks[0], *sizes))
    for name in {*arrays} | {*expected_arrays}:
        if arrays.get(name) != expected_arrays.get(name):
            raise ValueError(f"no study writes the array {name!r} of this shape and type beside its other arrays")
    if not {dtype for _, dtype in values.values()} <= {"float64", "complex128"}:
        raise ValueError("its measures are not numbers")
    _check_study_attributes(attributes, status.shape)
    return arrays, attributes


def _check_study_attributes(attributes: Mapping[str, Any], shape: tuple[int, ...]) -> None:
    """Raise ValueError unless the attributes of a store describe a study whose example point lies inside the axes."""
    dataclass_from_json(Laws, attributes["laws"])
    study = attributes["study"]
    if list(study["measures"]) != attributes["measures"]:
        raise ValueError("its measures are not those of its study")
    numbers = [study[name] for name in ("motion", "energy", "x0")]
    numbers += [study["values"][name] for name in study["measures"]]
    for entry in (*numbers, study["versions"], study["operations"]):
        if not isinstance(entry, list | dict | str):
            raise ValueError(f"its study cannot have the values {entry!r:.60}")
    for entry in numbers:
        np.asarray(entry, dtype=np.float64)
    if not all(type(i) is int and 0 <= i < n for i, n in zip(study["place"], shape, strict=True)):
        raise ValueError(f"its example is at {study['place']!r:.60}")


def write_file(path: Path, data: bytes) -> None:
    """Write a file of a store atomically: it appears complete or not at all.

    Raises
    ------
    FileError
        If it cannot be written.
    """
    with disk.file_errors("write", path, "Finished chunks are saved; run the study again to continue"):
        disk.write_atomically(path, data)


class TemporaryFolder:
    """A temporary folder that is deleted together with this object."""

    def __init__(self) -> None:
        self.path = Path(tempfile.mkdtemp(prefix="liethermo-study-"))
        weakref.finalize(self, shutil.rmtree, self.path, ignore_errors=True)


def read_plain_file(path: Path) -> bytes:
    """Return the content of a regular file; raise FileError for a link or a device.

    Raises
    ------
    FileError
        If it cannot be read.
    """
    with disk.file_errors("read", path), open(path, "rb", opener=_open_no_follow) as file:
        if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
            raise FileError(f"{path} is not a regular file")
        return file.read()


def _open_no_follow(path: str, flags: int) -> int:
    """Open a file without following links and without waiting for the other end of a pipe."""
    return os.open(path, flags | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC, 0o666)


def require_plain_files(root: Path) -> None:
    """Raise FileError unless a store contains only plain files and folders, as a link may lead outside and a pipe may
    block."""
    folders = [os.fspath(root)]
    while folders:
        with disk.file_errors("read", root), os.scandir(folders.pop()) as entries:
            for entry in entries:
                if entry.is_dir(follow_symlinks=False):
                    folders.append(entry.path)
                elif not entry.is_file(follow_symlinks=False):
                    kind = "a link" if entry.is_symlink() else "no file"
                    raise FileError(f"{entry.path} is {kind}, and all in the store of a study are plain files")


def remove_partial_files(root: Path) -> None:
    """Remove the partial files that killed runs have left; call it only while the store is locked."""
    for folder, _, files in os.walk(root):
        for name in files:
            if name.endswith(disk.PART_SUFFIX) and name.startswith("."):
                with contextlib.suppress(OSError):
                    os.unlink(os.path.join(folder, name))


# -- one run at a time ------------------------------------------------------------------------------------------------

LOCK_FILE = ".lock"
"""File in the store that a run locks, with its host, process id, start time and number of finished points."""


@contextlib.contextmanager
def lock_store(root: Path) -> Iterator[Callable[[int], None]]:
    """Lock a store for one run; the operating system releases the lock when the process ends.

    Yields a function ``record_run(n_done)`` that writes the run's host, process id, start time and number of
    finished points to the lock file, where other processes can read them.

    Raises
    ------
    FileError
        If another run holds the lock.
    """
    with disk.file_errors("write into", root):
        file = open(root / LOCK_FILE, "a+", opener=_open_no_follow)  # noqa: SIM115  (closed by the next block)
    with file:
        with disk.file_errors("lock", root, "Two runs at once would go unnoticed"):
            is_locked = _try_lock(file)
        if not is_locked:
            raise FileError(
                f"another run works on {root}: {describe_lock_holder(root)}. Wait for it, or take another store"
            )

        def record_run(n_done: int) -> None:
            run_record = {"host": socket.gethostname(), "pid": os.getpid(), "started": time.time(), "done": n_done}
            with contextlib.suppress(OSError):  # writing the results reports a full disk
                file.truncate(0)
                file.write(json.dumps(run_record))
                file.flush()

        yield record_run


LOCK_ATTEMPTS = 5
"""Number of attempts to lock a store."""


def _try_lock(file) -> bool:
    """Try to lock a file, and return True if that succeeded.

    A process that asks whether a run is active (:func:`active_run_record`) holds the lock for a moment, so this
    function tries several times.
    """
    for _ in range(LOCK_ATTEMPTS):
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return True
        except BlockingIOError:
            time.sleep(0.02)
    return False


def describe_lock_holder(root: Path) -> str:
    """Return the process id and host of the run that works on a store, as text."""
    run = active_run_record(root) or {}
    return f"process {run.get('pid', '?')} on {run.get('host', '?')}"


def active_run_record(root: Path) -> dict[str, Any] | None:
    """Return the record of the run that works on a store, or None if there is no such run."""
    try:
        with open(root / LOCK_FILE, opener=_open_no_follow) as file:
            try:
                fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
            except BlockingIOError:
                with contextlib.suppress(ValueError, TypeError, RecursionError):
                    return dict(json.loads(file.read()))
                return {}
    except OSError:
        pass
    return None
