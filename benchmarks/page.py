"""The page of the site with wins and losses, and the file of every run, made from the results saved as JSON."""

from __future__ import annotations

import json
import os
from collections import Counter
from pathlib import Path

from . import first_page
from .measurements import MEASUREMENT_NAMES
from .report import Report, Table, Target, targets_table

RUNS_FILE = Path(__file__).parent / "runs.md"
"""File with every run, which the site does not show."""

INTRODUCTION = """\
# Benchmarks

How fast this library is beside other programs, and where it loses. Bars to the left of the line are wins.

![Time of this library over the time of another program, work by work, on a logarithmic axis](benchmarks.svg)
"""
"""Beginning of the main page."""

METHODOLOGY = """\
## How it was measured

Contestants take turns, and the best time of each counts. Both times of a row come from one run on one machine. Work in
one thread is timed by the clock of the processor; where threads or processes are compared, the clock on the wall is
used. *Equal accuracy* means that the other program has the loosest tolerance with which it is at least as accurate.
*Laws* compares the drift of the energy and the least increment of the entropy in a step with the tolerances of the
tests. {missed}. The file `benchmarks/runs.md` has the machine, the targets and the figures of every run. `make bench`
measures everything anew and writes this page and that file; the programs are in `benchmarks/`."""
"""Section of the main page on the measurements."""

RUNS_INTRODUCTION = """\
# Benchmarks: every run

The figures behind the page of benchmarks (`docs/reference/benchmarks.md`): the machine, the targets, and each
measurement with all of its rows. Contestants take turns, and the best time of each counts; ratios are between times of
one run. The load average says how far to trust times by the clock on the wall. *Laws* compares the relative drift of
the energy and the least increment of the entropy in a step, relative to its maximum, with the tolerances of the
tests."""
"""Beginning of the file with every run."""


def write_pages(results: Path, page: Path, runs: Path = RUNS_FILE) -> None:
    """Write the page with its figures, and the file of every run, from all results in the folder.

    Raises
    ------
    ValueError
        If there is no result.
    """
    files = [file for name in MEASUREMENT_NAMES if (file := results / f"{name}.json").is_file()]
    result_files = [result for file in files if not (result := json.loads(file.read_text()))["quick"]]
    if not result_files:
        raise ValueError(f"{results} holds no results; run the measurements first")
    figures = os.path.relpath(page.parent, runs.parent)
    reports = {result["name"]: Report.from_dict(result["report"]) for result in result_files}
    targets = [target for report in reports.values() for target in report.targets]
    from .figures import draw_magnet, draw_time_ratios, draw_work_precision

    draw_time_ratios(first_page.compare_themes(reports), page.parent / "benchmarks.svg")
    summary, *themes = first_page.page_sections(reports)
    _write_page(
        page,
        [INTRODUCTION + "\n" + summary, *themes, METHODOLOGY.format(missed=first_page.missed_targets_text(targets))],
    )

    machines, differing = _machine_section(result_files)
    parts = [RUNS_INTRODUCTION, machines, _target_section(targets)]
    full_reports = [name for names in first_page.FULL_REPORT_THEMES.values() for name in names]
    for name, report in reports.items():
        parts.append(f"## {report.title}\n\nOn the page of benchmarks." if name in full_reports else report.markdown())
        if name in differing:
            parts.append(f"Measured elsewhere: {differing[name]}.")
        if report.series:
            draw_work_precision(report.series, figure := page.parent / f"{name}.svg")
            parts.append(f"![Time against error]({figures}/{figure.name})")
        if name == "magnet":
            draw_magnet(report.tables[0], page.parent / "magnet.svg")
            words = "Magnetisation, specific heat and Binder's cumulant against the temperature"
            parts.append(f"![{words}]({figures}/magnet.svg)")
    _write_page(runs, parts)


def _write_page(page: Path, parts: list[str]) -> None:
    page.write_text("\n\n".join(part.strip("\n") for part in parts) + "\n")


def _machine_section(results: list[dict]) -> tuple[str, dict[str, str]]:
    """Return the section on the machine of most measurements, and the differences of other machines by measurement."""
    machine_counts = Counter(json.dumps(result["machine"]) for result in results)
    usual = json.loads(machine_counts.most_common(1)[0][0])
    dates = sorted({result["date"] for result in results})
    rows = [*usual.items(), ("Measured", " to ".join(dict.fromkeys([dates[0], dates[-1]])))]
    rows.append(("Load average before each measurement", ", ".join(result["load"] for result in results)))
    table = Table("", {"Part": "text", "Here": "text"}, [list(row) for row in rows])
    other_machines = {result["name"]: result["machine"] for result in results if result["machine"] != usual}
    differing = {
        name: "; ".join(
            f"{part} {_additions(text, usual.get(part))}" for part, text in machine.items() if usual.get(part) != text
        )
        for name, machine in other_machines.items()
    }
    return "## Machine" + table.markdown(), differing


def _additions(text: str, usual: str | None) -> str:
    """Return the items of an enumeration that the usual one lacks."""
    return ", ".join(part for part in text.split(", ") if part not in (usual or "").split(", "))


def _target_section(targets: list[Target]) -> str:
    """Return the section on targets, missed ones first."""
    order = sorted(targets, key=lambda target: target.verdict != "missed")
    return "## Targets" + targets_table(order).markdown()
