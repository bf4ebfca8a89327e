"""What decides the results of a build besides its pages: whatever is kept for the next build has it in its key."""

from __future__ import annotations

import functools
import hashlib
import shutil
import sys
from importlib import metadata
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PARTS = ("liethermo", "manifolds", "docs/_ext")


@functools.cache
def digest() -> str:
    """One for the sources of both packages, what builds the site, the installed distributions and the interpreter."""
    found = hashlib.sha256(sys.version.encode())
    for path in sorted(file for part in PARTS for file in (ROOT / part).rglob("*") if file.is_file()):
        if "__pycache__" not in path.parts:
            found.update(str(path.relative_to(ROOT)).encode() + b"\0" + path.read_bytes() + b"\0")
    installed = {f"{package.metadata['Name']}=={package.version}" for package in metadata.distributions()}
    found.update("\n".join(sorted(installed)).encode())
    return found.hexdigest()


def forget_others(folder: Path, note: Path, made_by: str) -> None:
    """Delete a folder that something else has made, by a note on its maker; the note now has this one."""
    if not note.is_file() or note.read_text() != made_by:
        shutil.rmtree(folder, ignore_errors=True)
        note.parent.mkdir(parents=True, exist_ok=True)
        note.write_text(made_by)
