"""The page of the documentation, from the results that are kept as JSON."""

from __future__ import annotations

import json
from pathlib import Path

from .measurements import NAMES
from .report import Report, Target, targets_table

INTRODUCTION = """\
# Benchmarks

The library against hand-written C (`-O3 -march=native`), SciPy, diffrax and heyoka.py. Contestants take turns and the
best time of each counts; ratios are between times of one run. Work in one thread is timed by the processor's clock, so
that a busy machine does not count; where threads or processes are compared the wall's clock is used, and the load
average below says how far to trust it. *Laws* compares the relative drift of the energy and the least increment of the
entropy in a step, relative to its maximum, with the tolerances of the tests. `make bench` measures everything anew and
writes this page; the programs are in `benchmarks/`."""


def write(results: Path, page: Path) -> None:
    """Write the page from every result in the folder.

    Raises
    ------
    ValueError
        If there is none, or they are of different machines.
    """
    files = [file for name in NAMES if (file := results / f"{name}.json").is_file()]
    found = [result for file in files if not (result := json.loads(file.read_text()))["quick"]]
    if not found:
        raise ValueError(f"{results} holds no results; run the measurements first")
    machines = [result["machine"] for result in found]
    if any(machine != machines[0] for machine in machines):
        raise ValueError("the results are of different machines or versions; run all measurements again")
    reports = {result["name"]: Report.from_dict(result["report"]) for result in found}
    sections = [INTRODUCTION, _machine(found), _targets(reports)]
    for name, report in reports.items():
        sections.append(report.markdown())
        if report.series:
            from .figures import work_precision

            figure = page.parent / f"{name}.svg"
            work_precision(report.series, figure)
            sections.append(f"![Time against error]({figure.name})")
    page.write_text("\n\n".join(sections) + "\n")


def _machine(found: list[dict]) -> str:
    dates = sorted({result["date"] for result in found})
    rows = dict(found[0]["machine"])
    rows["Measured"] = " to ".join(dict.fromkeys([dates[0], dates[-1]]))
    rows["Load average before each measurement"] = ", ".join(result["load"] for result in found)
    return "## Machine\n\n| | |\n| --- | --- |\n" + "\n".join(f"| {name} | {text} |" for name, text in rows.items())


def _targets(reports: dict[str, Report]) -> str:
    targets: list[Target] = [target for report in reports.values() for target in report.targets]
    return "## Targets" + targets_table(targets).markdown()
