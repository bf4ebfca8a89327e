"""The driver: ``python -m benchmarks [names] [--quick | --kept] [--page FILE]``."""

from __future__ import annotations

import argparse
import datetime
import importlib
import time
from collections.abc import Sequence
from pathlib import Path

from . import page
from .machine import load_average, machine_description
from .measurements import MEASUREMENT_NAMES
from .report import targets_table

RESULT_FOLDER = Path(__file__).parent / "results"
"""Folder of the results that the page shows."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the named measurements, print their tables, and save each as JSON."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=main.__doc__)
    parser.add_argument("names", nargs="*", metavar="name", help=f"all by default: {', '.join(MEASUREMENT_NAMES)}")
    parser.add_argument("--quick", action="store_true", help="see that everything runs; the figures mean nothing")
    parser.add_argument("--out", type=Path, default=RESULT_FOLDER, help="folder for the results")
    parser.add_argument("--kept", action="store_true", help="measure nothing: write the page from what is kept")
    parser.add_argument("--page", type=Path, help="write this page, and benchmarks/runs.md, from what is kept")
    options = parser.parse_args(arguments)
    unknown = set(options.names) - set(MEASUREMENT_NAMES)
    if unknown:
        parser.error(f"no measurement {', '.join(sorted(unknown))}; there are {', '.join(MEASUREMENT_NAMES)}")
    if options.quick and options.page:
        parser.error("quick results mean nothing on a page")
    for name in [] if options.kept else options.names or MEASUREMENT_NAMES:
        print(f"-- {name}", flush=True)
        about = {"date": datetime.date.today().isoformat(), "load": load_average(), "machine": machine_description()}
        start = time.perf_counter()
        report = importlib.import_module(f"{__package__}.measurements.{name}").run(options.quick)
        report.save(options.out / f"{name}.json", name=name, quick=options.quick, **about)
        print(report.markdown())
        if report.targets:
            print(targets_table(report.targets).markdown())
        warning = "; quick: the figures mean nothing" if options.quick else ""
        print(f"\n({time.perf_counter() - start:.0f} s{warning})\n", flush=True)
    if options.page:
        page.write_pages(options.out, options.page)


if __name__ == "__main__":
    main()
