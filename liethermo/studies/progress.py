"""Progress of a study, shown during a run and reported to other processes."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from ..runs.progress import Progress
from .solve import STATUSES


@dataclass(frozen=True)
class StudyStatus:
    """Progress of a study, and the number of points by status.

    Attributes
    ----------
    points, done : int
        Total number of points, and number of finished ones.
    counts : dict from str to int
        Number of points by status; unfinished ones are "missing".
    running : dict or None
        The run that works on the store now: its host, process and start.
    seconds_left : float or None
        Estimated from the speed of that run.
    damaged : tuple of str
        Files that the last run found missing or damaged, and wrote again.
    interrupted : bool
        True if the user stopped the last run.
    """

    points: int
    done: int
    counts: Mapping[str, int]
    running: Mapping[str, Any] | None = None
    seconds_left: float | None = None
    damaged: tuple[str, ...] = ()
    interrupted: bool = False

    @property
    def complete(self) -> bool:
        """True if every point is finished."""
        return self.done == self.points

    @property
    def ok(self) -> bool:
        """True if every point is finished, reached its end and satisfied the laws."""
        return self.complete and not any(
            self.counts.get(name) for name in STATUSES if name not in ("completed", "event")
        )

    def __str__(self) -> str:
        percentage = 100.0 * self.done / self.points
        lines = [f"{self.done} of {self.points} points are done ({percentage:.3g} %)"]
        lines += [f"  {count} {name}" for name, count in self.counts.items() if name != "missing"]
        if self.running is not None:
            time_left = "" if self.seconds_left is None else f", {format_duration(self.seconds_left)} left"
            lines.append(
                f"process {self.running.get('pid', '?')} on {self.running.get('host', '?')} works on it{time_left}"
            )
        elif self.interrupted:
            lines.append("interrupted; run the study again to go on")
        elif not self.complete:
            lines.append("no run works on it; run the study again to continue")
        lines += [f"done again: {name}" for name in self.damaged]
        return "\n".join(lines)


def format_duration(seconds: float) -> str:
    """Return a duration in hours and minutes, or minutes and seconds, as text."""
    minutes = round(seconds) // 60
    return f"{minutes // 60} h {minutes % 60} min" if minutes >= 60 else f"{minutes} min {round(seconds) % 60} s"


def seconds_left(n_points: int, n_done: int, run_record: Mapping[str, Any]) -> float | None:
    """Return an estimate of the remaining time of a run in seconds, or None if the run has finished no point yet."""
    n_done_by_run = n_done - int(run_record.get("done", n_done))
    return (time.time() - run_record["started"]) * (n_points - n_done) / n_done_by_run if n_done_by_run > 0 else None


class StudyProgressBar(Progress):
    """A progress bar of finished points with the remaining time, in a terminal or notebook."""

    def __init__(self, total: int, n_done: int, is_visible: bool | None):
        from rich.console import Console

        self.n_done = n_done
        super().__init__(
            (0, total), Console().is_jupyter or None if is_visible is None else is_visible, f"{{}}/{total} points"
        )

    def __enter__(self) -> StudyProgressBar:
        super().__enter__()
        self.advance(0)
        return self

    def advance(self, n_points: int) -> None:
        self.n_done += n_points
        self.update(self.n_done)
