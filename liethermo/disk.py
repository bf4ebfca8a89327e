"""Files that appear whole or not at all, however a process ends and whoever else writes there."""

from __future__ import annotations

import contextlib
import errno
import hashlib
import os
import re
import secrets
import socket
import time
from pathlib import Path

PART_SUFFIX = ".part"
"""How the name of a file ends that is being written."""

STALE_PART_SECONDS = 86_400.0
"""Seconds after which a part that another machine has left is taken for that of a dead process."""

PART_NAME_PATTERN = re.compile(r"\.[0-9a-f]{12}\.([0-9a-f]{8})\.(\d+)\.[0-9a-f]{16}\.part")
"""Names of parts: what they are to become, the machine and the process that write them, and a random number."""

EXCLUSIVE_WRITE_FLAGS = (
    os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_CLOEXEC", 0)
)


def write_atomically(path: Path, data: bytes | memoryview, mode: int = 0o666) -> None:
    """Write a file whole: under a random name of its own, then renamed. The last of several writers wins.

    Parts that dead processes have left of the same file are removed.

    Raises
    ------
    OSError
        With nothing left behind.
    """
    part = path.with_name(part_name(path.name))
    if path.exists() and not path.is_file():
        raise OSError(errno.EEXIST, "what is there is no plain file")
    try:
        try:
            handle = os.open(part, EXCLUSIVE_WRITE_FLAGS, mode)
        except FileNotFoundError:
            path.parent.mkdir(parents=True, exist_ok=True)
            handle = os.open(part, EXCLUSIVE_WRITE_FLAGS, mode)
        with os.fdopen(handle, "wb") as file:
            file.write(data)
        os.replace(part, path)
    except BaseException:
        with contextlib.suppress(OSError):
            part.unlink(missing_ok=True)
        raise


def part_name(name: str) -> str:
    """A name for a part of a file or folder of this name."""
    return f".{_name_digest(name, 12)}.{_name_digest(socket.gethostname(), 8)}.{os.getpid()}.{secrets.token_hex(8)}{PART_SUFFIX}"


def remove_dead_parts(folder: Path, name: str) -> None:
    """Remove the parts of a file or folder of this name that dead processes have left."""
    with contextlib.suppress(OSError):
        for entry in folder.glob(f".{_name_digest(name, 12)}.*{PART_SUFFIX}"):
            if is_dead(entry):
                with contextlib.suppress(OSError):
                    entry.unlink()


def is_dead(part: Path) -> bool:
    """Whether no process writes this part any more."""
    named = PART_NAME_PATTERN.fullmatch(part.name)
    if named is None:
        return False
    if named[1] != _name_digest(socket.gethostname(), 8):
        return time.time() - part.lstat().st_mtime > STALE_PART_SECONDS
    try:
        os.kill(int(named[2]), 0)
    except ProcessLookupError:
        return True
    except (OSError, OverflowError):  # somebody else's
        return False
    return False


def why_os_failed(error: OSError | ValueError) -> str:
    """What went wrong, in words; a ValueError means that it is not a path."""
    if not isinstance(error, OSError):
        return str(error)
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return f"the disk is full ({error.strerror})"
    return str(error.strerror or error)


def _name_digest(name: str, digits: int) -> str:
    return hashlib.sha256(name.encode("utf-8", "surrogateescape")).hexdigest()[:digits]
