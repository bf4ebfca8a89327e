"""The line of the first page with version, licence, citation and repository."""

from __future__ import annotations

import os
import subprocess
from importlib import metadata
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent


def write_facts(path: Path) -> None:
    """Write the line, with a link to the repository where its address is known."""
    version, address = metadata.version("liethermo"), repository()
    facts = [
        f"Version {version}",
        "{doc}`what is new <reference/changelog>`",
        "{download}`MIT licence <../LICENSE>`",
        "{download}`how to cite <../CITATION.cff>`",
    ]
    facts += [f"[repository]({address})"] if address else []
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(" · ".join(facts) + "\n")


def repository() -> str | None:
    """The address of the repository: that of the package, of the server that builds the site, or of the clone."""
    urls = dict(url.split(", ", 1) for url in metadata.metadata("liethermo").get_all("Project-URL") or [])
    if "Repository" in urls:
        return urls["Repository"]
    if "GITHUB_REPOSITORY" in os.environ:
        return f"{os.environ.get('GITHUB_SERVER_URL', 'https://github.com')}/{os.environ['GITHUB_REPOSITORY']}"
    command = ["git", "-C", str(ROOT), "remote", "get-url", "origin"]
    try:
        found = subprocess.run(command, capture_output=True, text=True).stdout.strip().removesuffix(".git")
    except OSError:
        return None
    return found if found.startswith("https://") and "@" not in found else None
