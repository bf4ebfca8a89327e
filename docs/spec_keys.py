"""Writes the tables of the keys of a spec file, from the schema that checks them: run by the build of the site."""

from __future__ import annotations

from pathlib import Path

from liethermo.spec.schema import SECTIONS, list_spec_keys

FURTHER = {
    "run.step": "`run.step` as a table",
    "run.until": "`run.until`",
    "study.axes.NAME": "an axis as a table",
    "study.measure.NAME": "a measure as a table",
}


def write_table(path: Path) -> None:
    """One table a section."""
    listed = list_spec_keys()
    lines: list[str] = []
    for section in dict.fromkeys(section for section, *_ in listed):
        kind = SECTIONS.get(section)
        lines += [f"## {FURTHER.get(section, f'`[{section}]`')}", ""]
        lines += [(kind.__doc__ or "").strip(), ""] if kind else []
        lines += ["| key | default | what it is |", "|---|---|---|"]
        for of, name, default, what in listed:
            if of == section:
                shown = default if default in ("", "needed") else f"`{default}`"
                lines.append(f"| `{name}` | {shown} | {what} |".replace("||", "| |"))
        lines.append("")
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(lines))
