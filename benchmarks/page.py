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
LEARNING_PAGE_NAME = "benchmarks_learning.md"
"""Name of the page on learned systems, in the folder of the main page."""

INTRODUCTION = """\
# Benchmarks

This page compares the speed of this library with that of other programs, and shows the tasks in which it is slower. A
point left of the line is a task in which this library is faster. {{doc}}`benchmarks_learning` has the errors of learned
systems.

![Time of this library over the time of another program, task by task, on a logarithmic axis](benchmarks.svg)

{summary}
"""
"""Beginning of the main page."""

LEARNING_INTRODUCTION = """\
# Benchmarks of learned systems

How accurate the forecasts of learned systems are, and how well they conserve the energy. The forecasts start from the
first states of trajectories that were not used for training; the errors are means over all components and times.
*Energy drift* and *least entropy increment* belong to one long forecast, and to the energy and the entropy that were
learned. T is the duration of the data.

GFINN and NMS are reimplementations from the papers. All models have the same data, loss, optimizer, learning rate,
batches and network sizes. GFINN and NMS forecast with RK4, and `lt.learn` with a method of the same order that obeys
both laws in every step. The learning rate and the loss of `lt.learn` were chosen on other trajectories. The page quotes
no figures of the authors, because their tables could not be looked up."""
"""Beginning of the page on learned systems."""

METHODOLOGY = """\
## How it was measured

Each time belongs to the unit of work in the column *Time of*. The programs take turns, and the best time of each
counts. Both times of a row come from one session on one machine. Work in one thread is timed by the processor clock;
work in threads or processes is timed by the wall clock. *Equal accuracy* means that the other program has the loosest
tolerance with which it is at least as accurate. *Drift* is the largest relative change of the energy, unless the text
above the table says otherwise. {missed}. The file `benchmarks/runs.md` has the machine, the targets and the figures of
every run. `make bench` repeats all measurements and writes this page and that file; the programs are in
`benchmarks/`."""
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
    """Write the page with its figures, the page on learned systems beside it, and the file of every run.

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
    methodology = METHODOLOGY.format(missed=first_page.missed_targets_text(targets))
    _write_page(page, [INTRODUCTION.format(summary=summary), *themes, methodology])
    learning_sections = list(first_page.learning_sections(reports))
    if learning_sections:
        _write_page(page.with_name(LEARNING_PAGE_NAME), [LEARNING_INTRODUCTION, *learning_sections])

    machines, differing = _machine_section(result_files)
    parts = [RUNS_INTRODUCTION, machines, _target_section(targets)]
    for name, report in reports.items():
        has_its_page = name in first_page.LEARNING_MEASUREMENTS
        parts.append(f"## {report.title}\n\nOn the page of learned systems." if has_its_page else report.markdown())
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
            f"{part} {_items_missing_in_usual_text(text, usual.get(part))}"
            for part, text in machine.items()
            if usual.get(part) != text
        )
        for name, machine in other_machines.items()
    }
    return "## Machine" + table.markdown(), differing


def _items_missing_in_usual_text(text: str, usual: str | None) -> str:
    """Return the items of an enumeration that are missing in the usual one, as text."""
    return ", ".join(part for part in text.split(", ") if part not in (usual or "").split(", "))


def _target_section(targets: list[Target]) -> str:
    """Return the section on targets, missed ones first."""
    order = sorted(targets, key=lambda target: target.verdict != "missed")
    return "## Targets" + targets_table(order).markdown()
