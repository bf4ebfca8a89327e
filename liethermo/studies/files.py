"""Plain files of a store: atomic writing, reading without following links, and a lock for one run at a time."""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import shutil
import socket
import stat
import tempfile
import time
import weakref
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from .. import disk
from ..errors import FileError


def write_file(path: Path, data: bytes) -> None:
    """Write a file atomically: it appears complete or not at all.

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
    """Return the content of a regular file; links are refused.

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
    """Raise FileError unless a store contains only files and folders: a link may lead outside, and a pipe may block."""
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

    Yields a function ``record_run(n_done)`` that writes the run's host, process id, start time and number of finished
    points for other processes.

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

    A process that asks whether a run is active (:func:`active_run_record`) holds the lock for a moment, hence several
    attempts.
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
