"""A progress bar for long runs."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.progress import Progress as Bar


class Progress:
    """A progress bar on the standard error, shown only where someone is there to see it."""

    def __init__(self, span: tuple[float, float], wanted: bool | None):
        self.span = span
        self.bar: Bar | None = None
        self.wanted = sys.stderr.isatty() if wanted is None else wanted

    def __enter__(self):
        if self.wanted:
            from rich.console import Console
            from rich.progress import BarColumn, TextColumn, TimeRemainingColumn
            from rich.progress import Progress as Bar

            columns = (TextColumn("t = {task.fields[t]:.4g}"), BarColumn(), TimeRemainingColumn())
            self.bar = bar = Bar(*columns, console=Console(stderr=True, force_terminal=True), transient=True)
            bar.start()
            self.task = bar.add_task("", total=self.span[1] - self.span[0], t=self.span[0])
        return self

    def update(self, t: float) -> None:
        if self.bar is not None:
            self.bar.update(self.task, completed=t - self.span[0], t=t)

    def __exit__(self, *_):
        if self.bar is not None:
            self.bar.stop()
