"""Atomic writing of files, safe against killed processes and several writers."""

from __future__ import annotations

import contextlib
import errno
import hashlib
import os
import re
import secrets
import socket
import time
from collections.abc import Iterator
from pathlib import Path

from .errors import FileError, InputError

PART_SUFFIX = ".part"
"""Suffix of the name of a file that is being written."""

STALE_PART_SECONDS = 86_400.0
"""Age in seconds at which a partial file of another machine, whose process cannot be checked, counts as abandoned."""

PART_NAME_PATTERN = re.compile(r"\.[0-9a-f]{12}\.([0-9a-f]{8})\.(\d+)\.[0-9a-f]{16}\.part")
"""Names of partial files: digests of the final name and of the host, process id, and a random number."""

SAFE_OPEN_FLAGS = getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_CLOEXEC", 0)
"""Flags that refuse to open a link, and close the file in child processes; 0 where the operating system has none."""

EXCLUSIVE_WRITE_FLAGS = os.O_WRONLY | os.O_CREAT | os.O_EXCL | SAFE_OPEN_FLAGS
"""Flags that create a new file, and neither overwrite a file nor follow a link."""


def available_cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def checked_path(path, argument_name: str = "path") -> Path:
    """Return a user's path as a Path; raise InputError unless it is a string or a path."""
    try:
        return Path(path)
    except TypeError:
        raise InputError(f"{argument_name} must be a string or a path, got {path!r:.60}") from None


def write_atomically(path: Path, data: bytes | memoryview, mode: int = 0o666) -> None:
    """Write a file under a random name, then rename it, so that it appears complete or not at all.

    The last of several writers wins. Partial files of killed processes remain until :func:`remove_abandoned_files` is
    called.

    Raises
    ------
    OSError
        If the file cannot be written; the partial file is removed.
    """
    partial_file = path.with_name(partial_file_name(path.name))
    if path.exists() and not path.is_file():
        raise OSError(errno.EEXIST, "the path exists and is not a plain file")
    try:
        try:
            handle = os.open(partial_file, EXCLUSIVE_WRITE_FLAGS, mode)
        except FileNotFoundError:
            path.parent.mkdir(parents=True, exist_ok=True)
            handle = os.open(partial_file, EXCLUSIVE_WRITE_FLAGS, mode)
        with os.fdopen(handle, "wb") as file:
            file.write(data)
        os.replace(partial_file, path)
    except BaseException:
        with contextlib.suppress(OSError):
            partial_file.unlink(missing_ok=True)
        raise


def partial_file_name(name: str) -> str:
    """Return a name for a partial copy of the file or folder ``name``."""
    writer = f"{_name_digest(socket.gethostname(), 8)}.{os.getpid()}"
    return f".{_name_digest(name, 12)}.{writer}.{secrets.token_hex(8)}{PART_SUFFIX}"


def remove_abandoned_files(folder: Path, name: str) -> None:
    """Remove the partial copies of a file or folder that dead processes have left."""
    with contextlib.suppress(OSError):
        for entry in folder.glob(f".{_name_digest(name, 12)}.*{PART_SUFFIX}"):
            if is_abandoned(entry):
                with contextlib.suppress(OSError):
                    entry.unlink()


def is_abandoned(partial_file: Path) -> bool:
    """Return True if the process that wrote a partial file has ended, from the process id in its name."""
    match = PART_NAME_PATTERN.fullmatch(partial_file.name)
    if match is None:
        return False
    if match[1] != _name_digest(socket.gethostname(), 8):
        return time.time() - partial_file.lstat().st_mtime > STALE_PART_SECONDS
    try:
        os.kill(int(match[2]), 0)
    except ProcessLookupError:
        return True
    except (OSError, OverflowError):  # a process of another user
        return False
    return False


@contextlib.contextmanager
def file_errors(action: str, path: str | os.PathLike, advice: str = "") -> Iterator[None]:
    """Convert operating-system errors in a block to FileError, with the path and the cause.

    Parameters
    ----------
    action : str
        What cannot be done with the path, such as "read".
    path : path
    advice : str
        Sentence at the end of the message.
    """
    try:
        yield
    except FileError:
        raise
    except (OSError, ValueError) as error:  # ValueError for an invalid path
        end = f". {advice}" if advice else ""
        raise FileError(f"cannot {action} {path!s:.200}: {describe_os_error(error)}{end}") from error


def describe_os_error(error: OSError | ValueError) -> str:
    """Return the cause of an operating system error as text; a ValueError means that the path is invalid."""
    if not isinstance(error, OSError):
        return str(error)
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return f"the disk is full ({error.strerror})"
    return str(error.strerror or error)


def _name_digest(name: str, digits: int) -> str:
    return hashlib.sha256(name.encode("utf-8", "surrogateescape")).hexdigest()[:digits]
