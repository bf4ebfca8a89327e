"""Files of a store: Zarr v3 arrays in a folder, with atomic writes and a checksum in every chunk.

The chunks are written here and not by the ``zarr`` package, which is slow for small chunks and reads a missing chunk as
fill values. The files are plain Zarr v3 with the codecs "bytes" or "vlen-utf8" and "crc32c"; ``zarr`` and ``xarray``
can read them.
"""

from __future__ import annotations

import contextlib
import fcntl
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
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from .. import disk
from ..errors import FileError

ZARR_DTYPES = ("int8", "int64", "float64", "complex128", "bool", "string")
"""Zarr data types that a store may contain."""

MAX_CHUNK_VALUES = 2**27
"""Maximum number of values in a chunk, a limit on the memory that a foreign store can claim."""


@dataclass(frozen=True)
class ZarrArray:
    """Metadata of one array of a store, with the encoding of its chunks.

    Attributes
    ----------
    name : str
    dims : tuple of str
    shape, chunks : tuple of int
    dtype : str
        A type of Zarr: "int8", "int64", "float64", "complex128", "bool" or "string".
    attributes : dict
    """

    name: str
    dims: tuple[str, ...]
    shape: tuple[int, ...]
    chunks: tuple[int, ...]
    dtype: str
    attributes: dict[str, Any] = field(default_factory=dict)

    @property
    def fill_value(self) -> Any:
        """The fill value of missing values, as JSON."""
        return {"float64": "NaN", "complex128": ["NaN", "NaN"], "int8": -1, "string": "", "bool": False}.get(
            self.dtype, 0
        )

    @property
    def numpy_dtype(self) -> np.dtype:
        return np.dtype(object if self.dtype == "string" else self.dtype).newbyteorder("<")

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
            "fill_value": self.fill_value,
            "codecs": [{"name": "vlen-utf8"} if self.dtype == "string" else bytes_codec, {"name": "crc32c"}],
            "attributes": self.attributes,
            "dimension_names": list(self.dims),
            "storage_transformers": [],
        }

    @classmethod
    def from_metadata(cls, name: str, metadata: dict[str, Any]) -> ZarrArray:
        """Make an array from its metadata; raise ValueError, KeyError or TypeError if a study cannot have written
        them."""
        chunks, attributes = metadata["chunk_grid"]["configuration"]["chunk_shape"], metadata["attributes"]
        dims, shape, dtype = metadata["dimension_names"], metadata["shape"], metadata["data_type"]
        lengths = [*shape, *chunks]
        is_valid_shape = all(type(n) is int and 0 <= n < 2**48 for n in lengths) and all(n > 0 for n in chunks)
        if not (is_valid_shape and len(shape) == len(chunks) == len(dims) and math.prod(chunks) <= MAX_CHUNK_VALUES):
            raise ValueError(f"the array {name!r} has shape {shape} in chunks {chunks}")
        if dtype not in ZARR_DTYPES or not isinstance(attributes, dict) or not all(isinstance(d, str) for d in dims):
            raise ValueError(f"the array {name!r} is none that a study writes")
        return cls(name, tuple(dims), tuple(shape), tuple(chunks), dtype, attributes)

    def chunk_path(self, index: Sequence[int]) -> str:
        """Return the path of a chunk, relative to the store."""
        return "/".join([self.name, "c", *map(str, index)])

    # -- chunks ---------------------------------------------------------------------------------------------------

    def empty_chunk(self) -> np.ndarray:
        """Return a chunk of fill values, shape ``chunks``."""
        if self.dtype == "string":
            return np.full(self.chunks, "", dtype=object)
        return np.full(
            self.chunks, {"int8": -1, "bool": False, "int64": 0}.get(self.dtype, np.nan), dtype=self.numpy_dtype
        )

    def encode_chunk(self, block: np.ndarray) -> bytes:
        """Return the bytes of a chunk's file: the encoded values and a CRC-32C checksum."""
        import google_crc32c

        data = (
            _encode_texts(block.ravel())
            if self.dtype == "string"
            else np.asarray(block, dtype=self.numpy_dtype).tobytes()
        )
        return data + struct.pack("<I", google_crc32c.value(data))

    def decode_chunk(self, data: bytes) -> np.ndarray:
        """Return the values of a chunk from the bytes of its file; raise ValueError or ``struct.error`` if they are
        damaged."""
        import google_crc32c

        content = data[:-4]
        if len(data) < 4 or struct.pack("<I", google_crc32c.value(content)) != data[-4:]:
            raise ValueError("it does not have its checksum")
        if self.dtype == "string":
            values = np.array([*_decode_texts(content), None], dtype=object)[:-1]
        else:
            values = np.frombuffer(content, dtype=self.numpy_dtype).copy()
        if values.size != math.prod(self.chunks):
            raise ValueError(f"it has {values.size} values, and should have {math.prod(self.chunks)}")
        return values.reshape(self.chunks)


def _encode_texts(values: np.ndarray) -> bytes:
    """Encode texts by the codec "vlen-utf8"."""
    encoded_texts = [str(value).encode() for value in values]
    return b"".join(
        [struct.pack("<I", len(encoded_texts)), *(struct.pack("<I", len(text)) + text for text in encoded_texts)]
    )


def _decode_texts(data: bytes) -> Iterator[str]:
    """Yield the texts that the codec "vlen-utf8" has encoded."""
    (count,), offset = struct.unpack_from("<I", data), 4
    if count > len(data) // 4:
        raise ValueError(f"it says that it has {count} texts")
    for _ in range(count):
        (length,) = struct.unpack_from("<I", data, offset)
        yield data[offset + 4 : offset + 4 + length].decode()
        offset += 4 + length


# -- files ------------------------------------------------------------------------------------------------------------


def write_file(path: Path, data: bytes) -> None:
    """Write a file atomically: it appears complete or not at all.

    Raises
    ------
    FileError
        If it cannot be written.
    """
    try:
        disk.write_atomically(path, data)
    except OSError as error:
        advice = "Finished chunks are saved; run the study again to continue"
        raise FileError(f"cannot write {path}: {disk.describe_os_error(error)}. {advice}") from error


class TemporaryFolder:
    """A temporary folder that is deleted together with this object."""

    def __init__(self) -> None:
        self.path = Path(tempfile.mkdtemp(prefix="liethermo-study-"))
        weakref.finalize(self, shutil.rmtree, self.path, ignore_errors=True)


def read_plain_file(path: Path) -> bytes:
    """Return the content of a regular file; links are refused.

    Raises
    ------
    FileError
        If it cannot be read.
    """
    try:
        with open(path, "rb", opener=_open_no_follow) as file:
            if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
                raise FileError(f"{path} is not a regular file")
            return file.read()
    except FileError:
        raise
    except OSError as error:
        raise FileError(f"cannot read {path}: {disk.describe_os_error(error)}") from error


def _open_no_follow(path: str, flags: int) -> int:
    """Open a file without following links and without waiting for the other end of a pipe."""
    return os.open(path, flags | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC, 0o666)


def require_plain_files(root: Path) -> None:
    """Raise FileError unless a store contains only files and folders: a link may lead outside, and a pipe may block."""
    folders = [os.fspath(root)]
    while folders:
        try:
            with os.scandir(folders.pop()) as entries:
                for entry in entries:
                    if entry.is_dir(follow_symlinks=False):
                        folders.append(entry.path)
                    elif not entry.is_file(follow_symlinks=False):
                        kind = "a link" if entry.is_symlink() else "no file"
                        raise FileError(f"{entry.path} is {kind}, and all in the store of a study are plain files")
        except FileError:
            raise
        except OSError as error:
            raise FileError(f"cannot read {root}: {disk.describe_os_error(error)}") from error


def write_json(path: Path, content: Any) -> None:
    """Write JSON data to a file atomically."""
    write_file(path, json.dumps(content, indent=1, allow_nan=False).encode())


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

    Yields a function ``record_run(n_done)`` that writes the run's host, process id, start time and number of finished
    points for other processes.

    Raises
    ------
    FileError
        If another run holds the lock.
    """
    try:
        file = open(root / LOCK_FILE, "a+", opener=_open_no_follow)  # noqa: SIM115  (the with block below handles other errors)
    except OSError as error:
        raise FileError(f"cannot write into {root}: {disk.describe_os_error(error)}") from error
    with file:
        try:
            if not _try_lock(file):
                raise FileError(
                    f"another run works on {root}: {describe_lock_holder(root)}. Wait for it, or take another store"
                )
        except OSError as error:
            if isinstance(error, FileError):
                raise
            reason = disk.describe_os_error(error)
            raise FileError(f"{root} cannot be locked ({reason}), so two runs at once would go unnoticed") from error

        def record_run(n_done: int) -> None:
            run_record = {"host": socket.gethostname(), "pid": os.getpid(), "started": time.time(), "done": n_done}
            with contextlib.suppress(OSError):  # writing the results reports a full disk
                file.truncate(0)
                file.write(json.dumps(run_record))
                file.flush()

        yield record_run


def _try_lock(file, n_attempts: int = 5) -> bool:
    """Try to lock a file, and return True if that succeeded.

    A process that asks whether a run is active (:func:`active_run_record`) holds the lock for a moment, hence several
    attempts.
    """
    for _ in range(n_attempts):
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
