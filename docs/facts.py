"""The line of the first page with version, licence, citation and repository; the citation in BibTeX."""

from __future__ import annotations

import os
import re
import subprocess
import textwrap
from importlib import metadata
from pathlib import Path
from typing import Any

import yaml
from check_text import MAX_COLUMNS

ROOT = Path(__file__).resolve().parent.parent


def write_facts(path: Path) -> None:
    """Write the line, with a link to the repository where its address is known, and the citation beside it."""
    version, address = metadata.version("liethermo"), repository()
    facts = [
        f"Version {version}",
        "{doc}`what is new <reference/changelog>`",
        "{doc}`install <start/install>`",
        "{doc}`MIT licence, how to cite, roadmap, help <start/adopt>`",
    ]
    facts += [f"[repository]({address})"] if address else []
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(" · ".join(facts) + "\n")
    path.with_name("citation.bib").write_text(bibtex(yaml.safe_load((ROOT / "CITATION.cff").read_text())))


def bibtex(citation: dict[str, Any]) -> str:
    """The software and the papers of a ``CITATION.cff`` as entries of BibTeX."""
    software = {**citation, "year": citation.get("year") or _year_of(citation["version"]), "journal": None}
    entries = [_entry("software", "liethermo", software)]
    for paper in citation["references"]:
        name = paper["authors"][0]["family-names"].split()[0].lower()
        entries.append(_entry("article", f"{name}{paper['year']}", paper))
    return "\n".join(entries)


def _wrap(line: str) -> str:
    """Return the line in parts that a page shows without a scroll bar."""
    return textwrap.fill(line, MAX_COLUMNS, subsequent_indent="    ", break_long_words=False, break_on_hyphens=False)


def _entry(kind: str, key: str, source: dict[str, Any]) -> str:
    pages = f"{source['start']}--{source['end']}" if "start" in source else None
    preprint = next((i["value"] for i in source.get("identifiers", []) if i["value"].startswith("arXiv:")), None)
    fields = {
        "author": " and ".join(map(_name, source["authors"])),
        "title": f"{{{source['title']}}}",
        "journal": source.get("journal"),
        "volume": source.get("volume"),
        "number": source.get("issue"),
        "pages": pages,
        "year": source["year"],
        "version": source.get("version"),
        "license": source.get("license"),
        "doi": source.get("doi"),
        "eprint": preprint and preprint.removeprefix("arXiv:"),
        "archiveprefix": preprint and "arXiv",
    }
    lines = [_wrap(f"  {name} = {{{value}}},") for name, value in fields.items() if value is not None]
    return "\n".join([f"@{kind}{{{key},", *lines, "}", ""])


def _name(author: dict[str, str]) -> str:
    """A person as family and given names; a group in braces, so that it stays one name."""
    return f"{{{author['name']}}}" if "name" in author else f"{author['family-names']}, {author['given-names']}"


def _year_of(version: str) -> str:
    """The year of a version in the change log; that of the newest dated version if it has no date yet."""
    dates = dict(re.findall(r"^## \[([\d.]+)\] - (\d{4})", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE))
    return dates.get(version) or next(iter(dates.values()))


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
