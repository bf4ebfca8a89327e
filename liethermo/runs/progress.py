"""A progress bar for long runs."""

from __future__ import annotations

import math
import sys
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.progress import Progress as Bar


class Progress:
    """A progress bar on the standard error, shown by default only in a terminal.

    Parameters
    ----------
    span : (float, float)
        Values at the start and at the end: times, or numbers of finished items.
    is_shown : bool or None
        With None, the bar is shown if the standard error is a terminal.
    text_format : str
        Format of the current value.
    """

    def __init__(self, span: tuple[float, float], is_shown: bool | None, text_format: str = "t = {:.4g}"):
        self.span, self.text_format = span, text_format
        self.bar: Bar | None = None
        self.is_shown = sys.stderr.isatty() if is_shown is None else is_shown

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

    def update(self, current_value: float) -> None:
        """Move the bar to a value between the ends of the span."""
        if self.bar is not None:
            self.bar.update(
                self.task, completed=current_value - self.span[0], description=self.text_format.format(current_value)
            )

    def __exit__(self, *_):
        if self.bar is not None:
            self.bar.stop()
