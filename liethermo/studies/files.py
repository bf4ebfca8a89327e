"""The files of a store: arrays of Zarr v3 in a folder, every file written whole, every chunk with a checksum.

The chunks are written here and not by the ``zarr`` package, whose writer is slow where they are small, and which
reads a chunk that is missing as one of fill values. What is written is plain Zarr v3 with the codecs "bytes" or
"vlen-utf8" and "crc32c", and ``zarr`` and ``xarray`` read it.
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
"""Types of Zarr that a store has."""

MAX_CHUNK_VALUES = 2**27
"""Numbers of a chunk."""


@dataclass(frozen=True)
class ZarrArray:
    """An array of a store.

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
        """What stands for a value that is missing, as JSON."""
        return {"float64": "NaN", "complex128": ["NaN", "NaN"], "int8": -1, "string": "", "bool": False}.get(
            self.dtype, 0
        )

    @property
    def numpy_dtype(self) -> np.dtype:
        return np.dtype(object if self.dtype == "string" else self.dtype).newbyteorder("<")

    def metadata(self) -> dict[str, Any]:
        """As Zarr v3 has it."""
        plain = {"name": "bytes", "configuration": {"endian": "little"}}
        return {
            "zarr_format": 3,
            "node_type": "array",
            "shape": list(self.shape),
            "data_type": self.dtype,
            "chunk_grid": {"name": "regular", "configuration": {"chunk_shape": list(self.chunks)}},
            "chunk_key_encoding": {"name": "default", "configuration": {"separator": "/"}},
            "fill_value": self.fill_value,
            "codecs": [{"name": "vlen-utf8"} if self.dtype == "string" else plain, {"name": "crc32c"}],
            "attributes": self.attributes,
            "dimension_names": list(self.dims),
            "storage_transformers": [],
        }

    @classmethod
    def from_metadata(cls, name: str, metadata: dict[str, Any]) -> ZarrArray:
        """From its metadata; ValueError, KeyError or TypeError where these are of another thing."""
        chunks, attributes = metadata["chunk_grid"]["configuration"]["chunk_shape"], metadata["attributes"]
        dims, shape, dtype = metadata["dimension_names"], metadata["shape"], metadata["data_type"]
        sizes = [*shape, *chunks]
        whole = all(type(n) is int and 0 <= n < 2**48 for n in sizes) and all(n > 0 for n in chunks)
        if not (whole and len(shape) == len(chunks) == len(dims) and math.prod(chunks) <= MAX_CHUNK_VALUES):
            raise ValueError(f"the array {name!r} has shape {shape} in chunks {chunks}")
        if dtype not in ZARR_DTYPES or not isinstance(attributes, dict) or not all(isinstance(d, str) for d in dims):
            raise ValueError(f"the array {name!r} is none that a study writes")
        return cls(name, tuple(dims), tuple(shape), tuple(chunks), dtype, attributes)

    def chunk_path(self, index: Sequence[int]) -> str:
        """The path of a chunk within the store."""
        return "/".join([self.name, "c", *map(str, index)])

    # -- chunks ---------------------------------------------------------------------------------------------------

    def empty_chunk(self) -> np.ndarray:
        """A chunk of fill values."""
        if self.dtype == "string":
            return np.full(self.chunks, "", dtype=object)
        return np.full(
            self.chunks, {"int8": -1, "bool": False, "int64": 0}.get(self.dtype, np.nan), dtype=self.numpy_dtype
        )

    def encode_chunk(self, block: np.ndarray) -> bytes:
        """A chunk as it is in its file."""
        import google_crc32c

        data = (
            _encode_texts(block.ravel())
            if self.dtype == "string"
            else np.asarray(block, dtype=self.numpy_dtype).tobytes()
        )
        return data + struct.pack("<I", google_crc32c.value(data))

    def decode_chunk(self, data: bytes) -> np.ndarray:
        """A chunk from its file; ValueError or ``struct.error`` where it is damaged."""
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
    """As the codec "vlen-utf8" has them."""
    encoded = [str(value).encode() for value in values]
    return b"".join([struct.pack("<I", len(encoded)), *(struct.pack("<I", len(text)) + text for text in encoded)])


def _decode_texts(data: bytes) -> Iterator[str]:
    (count,), place = struct.unpack_from("<I", data), 4
    if count > len(data) // 4:
        raise ValueError(f"it says that it has {count} texts")
    for _ in range(count):
        (length,) = struct.unpack_from("<I", data, place)
        yield data[place + 4 : place + 4 + length].decode()
        place += 4 + length


# -- files ------------------------------------------------------------------------------------------------------------


def write_file(path: Path, data: bytes) -> None:
    """Write a file; it appears whole or not at all.

    Raises
    ------
    FileError
        If it cannot be written.
    """
    try:
        disk.write_atomically(path, data)
    except OSError as error:
        kept = "What is done is kept; run the study again to go on"
        raise FileError(f"cannot write {path}: {disk.why_os_failed(error)}. {kept}") from error


class TemporaryFolder:
    """A folder that is there as long as this object is."""

    def __init__(self) -> None:
        self.path = Path(tempfile.mkdtemp(prefix="liethermo-study-"))
        weakref.finalize(self, shutil.rmtree, self.path, ignore_errors=True)


def read_plain_file(path: Path) -> bytes:
    """The content of a plain file; a link is refused.

    Raises
    ------
    FileError
        If it cannot be read.
    """
    try:
        with open(path, "rb", opener=_open_no_follow) as file:
            if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
                raise FileError(f"{path} is no file")
            return file.read()
    except FileError:
        raise
    except OSError as error:
        raise FileError(f"cannot read {path}: {disk.why_os_failed(error)}") from error


def _open_no_follow(path: str, flags: int) -> int:
    """Open no link, and do not wait for the other end of a pipe."""
    return os.open(path, flags | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC, 0o666)


def require_plain_files(root: Path) -> None:
    """Raise FileError unless all in a store are files and folders: a link leads anywhere, and a pipe keeps waiting."""
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
            raise FileError(f"cannot read {root}: {disk.why_os_failed(error)}") from error


def write_json(path: Path, content: Any) -> None:
    write_file(path, json.dumps(content, indent=1, allow_nan=False).encode())


def remove_parts(root: Path) -> None:
    """Remove half-written files of killed runs: no other run works on the store."""
    for folder, _, files in os.walk(root):
        for name in files:
            if name.endswith(disk.PART_SUFFIX) and name.startswith("."):
                with contextlib.suppress(OSError):
                    os.unlink(os.path.join(folder, name))


# -- one run at a time ------------------------------------------------------------------------------------------------

LOCK_FILE = ".lock"


@contextlib.contextmanager
def lock_store(root: Path) -> Iterator[Callable[[int], None]]:
    """Be the only run that works on a store; the operating system releases it however a run ends.

    Yields a function that tells others how many points were done when the work began.

    Raises
    ------
    FileError
        If another run does.
    """
    try:
        file = open(root / LOCK_FILE, "a+", opener=_open_no_follow)  # noqa: SIM115  (what follows has errors of its own)
    except OSError as error:
        raise FileError(f"cannot write into {root}: {disk.why_os_failed(error)}") from error
    with file:
        try:
            if not _try_lock(file):
                raise FileError(
                    f"another run works on {root}: {describe_lock_holder(root)}. Wait for it, or take another store"
                )
        except OSError as error:
            if isinstance(error, FileError):
                raise
            reason = disk.why_os_failed(error)
            raise FileError(f"{root} cannot be locked ({reason}): two runs at once could not be told") from error

        def tell(done: int) -> None:
            now = {"host": socket.gethostname(), "pid": os.getpid(), "started": time.time(), "done": done}
            with contextlib.suppress(OSError):  # a full disk shows where results are written
                file.truncate(0)
                file.write(json.dumps(now))
                file.flush()

        yield tell


def _try_lock(file, tries: int = 5) -> bool:
    """Whether the lock was free; somebody who looks whether it is holds it for a moment too."""
    for _ in range(tries):
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return True
        except BlockingIOError:
            time.sleep(0.02)
    return False


def describe_lock_holder(root: Path) -> str:
    """Who works on a store, in words."""
    run = active_run(root) or {}
    return f"process {run.get('pid', '?')} on {run.get('host', '?')}"


def active_run(root: Path) -> dict[str, Any] | None:
    """The run that works on a store now, as it has told; None where there is none."""
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
