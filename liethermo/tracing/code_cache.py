"""Cache of machine code on disk, of LLVM and of XLA, in files and folders that only this user can have written."""

from __future__ import annotations

import contextlib
import functools
import hashlib
import os
import stat
from pathlib import Path

from manifolds.errors import warn

from .. import disk


class CacheWarning(UserWarning):
    """Warning that machine code cannot be cached safely, so that every process compiles it again."""


CHECKSUM_BYTES = 32
"""Length in bytes of the checksum at the start of a file, which shows that a file was cut short."""

MAX_FILE_BYTES = 2**28
"""Largest size in bytes of a file that is read."""

SAFE_OPEN_FLAGS = getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_CLOEXEC", 0)
"""Flags that refuse to open a link and do not wait for the other end of a pipe."""


def cache_folder() -> Path | None:
    """Return the folder ``$LIETHERMO_CACHE`` or one in the user's cache directory; None if there is none."""
    if user_folder := os.environ.get("LIETHERMO_CACHE"):
        return Path(user_folder)
    try:
        return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "liethermo"
    except RuntimeError:  # no HOME, and no entry for the user
        return None


@functools.cache
def host_processor() -> tuple[str, str, str]:
    """Return the LLVM names of this machine: target triple, CPU and features."""
    import llvmlite.binding as llvm

    return llvm.get_process_triple(), llvm.get_host_cpu_name(), llvm.get_host_cpu_features().flatten()


def read_machine_code(name: str, suffix: str = ".o") -> bytes | None:
    """Return the machine code written under ``name``; None if it is missing, damaged, or may be another user's."""
    folder = _trusted_folder()
    if folder is None:
        return None
    try:
        with open(
            folder / f"{name}{suffix}", "rb", opener=lambda path, flags: os.open(path, flags | SAFE_OPEN_FLAGS)
        ) as file:
            file_status = os.fstat(file.fileno())
            if not stat.S_ISREG(file_status.st_mode) or file_status.st_size > MAX_FILE_BYTES:
                return None
            if reason := _why_untrusted(file_status):
                _warn_untrusted(str(folder / f"{name}{suffix}"), reason)
                return None
            content = file.read()
    except (OSError, ValueError):
        return None
    checksum, code = content[:CHECKSUM_BYTES], content[CHECKSUM_BYTES:]
    return code if code and checksum == hashlib.sha256(code).digest() else None


def write_machine_code(name: str, code: bytes, suffix: str = ".o") -> None:
    """Write machine code to the cache under ``name``, if there is a folder that can be used."""
    folder = _trusted_folder()
    if folder is not None:
        with contextlib.suppress(OSError):
            disk.write_atomically(folder / f"{name}{suffix}", hashlib.sha256(code).digest() + code, mode=0o600)
            disk.remove_abandoned_files(folder, f"{name}{suffix}")


def _trusted_folder() -> Path | None:
    """Return the cache folder, created if necessary; None if it cannot be used or others might write to it."""
    folder = cache_folder()
    if folder is None:
        return None
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        with contextlib.suppress(FileExistsError):
            folder.mkdir(mode=0o700)
        folder_status = os.lstat(folder)
    except (OSError, ValueError):
        return None
    if stat.S_ISLNK(folder_status.st_mode):
        _warn_untrusted(str(folder), "it is a link")
    elif not stat.S_ISDIR(folder_status.st_mode):
        _warn_untrusted(str(folder), "it is not a folder")
    elif reason := _why_untrusted(folder_status):
        _warn_untrusted(str(folder), reason)
    else:
        return folder
    return None


def _why_untrusted(status: os.stat_result) -> str:
    """Return why a file or folder may be another user's; empty if it is this user's alone."""
    if not hasattr(os, "geteuid"):
        return ""
    if status.st_uid != os.geteuid():
        return "it belongs to another user"
    return "others may write to it" if status.st_mode & (stat.S_IWGRP | stat.S_IWOTH) else ""


@functools.cache
def _warn_untrusted(path: str, reason: str) -> None:
    """Warn, once for each path, that machine code is not cached there."""
    warn(
        f"machine code is not kept in {path}: {reason}, and the code there could do anything in your name. It is "
        "compiled in memory instead. Set LIETHERMO_CACHE to a folder of your own (chmod 700)",
        CacheWarning,
    )
