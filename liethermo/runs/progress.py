"""A progress bar for long runs."""

from __future__ import annotations

import math
import sys
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.progress import Progress as Bar


class Progress:
    """A progress bar on the standard error, shown only where someone is there to see it.

    Parameters
    ----------
    span : (float, float)
        What is shown at the start and at the end: a time, or how much is done.
    is_shown : bool or None
        None where the standard error tells.
    text_format : str
        Of the place between these.
    """

    def __init__(self, span: tuple[float, float], wanted: bool | None, text: str = "t = {:.4g}"):
        self.span, self.text_format = span, text
        self.bar: Bar | None = None
        self.is_shown = sys.stderr.isatty() if wanted is None else wanted

    def __enter__(self):
        if self.is_shown:
            from rich.console import Console
            from rich.progress import BarColumn, TextColumn, TimeRemainingColumn
            from rich.progress import Progress as Bar

            columns = (TextColumn("{task.description}"), BarColumn(), TimeRemainingColumn())
            self.bar = bar = Bar(*columns, console=Console(stderr=True, force_terminal=True), transient=True)
            bar.start()
            length = self.span[1] - self.span[0]
            total = length if math.isfinite(length) else None
            self.task = bar.add_task(self.text_format.format(self.span[0]), total=total)
        return self

    def update(self, t: float) -> None:
        if self.bar is not None:
            self.bar.update(self.task, completed=t - self.span[0], description=self.text_format.format(t))

    def __exit__(self, *_):
        if self.bar is not None:
            self.bar.stop()
