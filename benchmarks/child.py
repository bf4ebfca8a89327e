"""Parts of measurements that run in a process of their own: ``python -m benchmarks.child MEASUREMENT ARGUMENTS``."""

from __future__ import annotations

import importlib
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

REPOSITORY_ROOT = Path(__file__).parent.parent


def run_in_child_process(measurement: str, *arguments: str, cache: str | None = None, one_core: bool = False) -> Any:
    """Call ``child(*arguments)`` of a measurement in a new process and return its result; LIETHERMO_CACHE is
    ``cache``."""
    options = ["--one-core"] if one_core else []
    return json.loads(
        run_python("-m", "benchmarks.child", *options, measurement, *arguments, cache=cache).splitlines()[-1]
    )


def run_python(*arguments: str, cache: str | None = None) -> str:
    """Run Python in the repository's root, and return its standard output.

    Raises
    ------
    RuntimeError
        If it fails; with the end of its standard error.
    """
    environment = dict(os.environ) if cache is None else os.environ | {"LIETHERMO_CACHE": cache}
    process = subprocess.run(
        [sys.executable, *arguments], cwd=REPOSITORY_ROOT, env=environment, capture_output=True, text=True, check=False
    )
    if process.returncode != 0:
        raise RuntimeError(f"python {' '.join(arguments[:3])} failed:\n{process.stderr[-2000:]}")
    return process.stdout


def main(arguments: list[str]) -> None:
    """Run a child function and print its result as JSON."""
    if arguments[0] == "--one-core":
        if hasattr(os, "sched_setaffinity"):  # before JAX is imported, which starts a thread for each core it may use
            os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
        arguments = arguments[1:]
    module = importlib.import_module(f"{__package__}.measurements.{arguments[0]}")
    print(json.dumps(module.child(*arguments[1:])))


if __name__ == "__main__":
    main(sys.argv[1:])
