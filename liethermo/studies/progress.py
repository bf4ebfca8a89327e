"""How far a study is: told on the way, and to other processes."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from ..runs.progress import Progress
from .solve import STATUSES


@dataclass(frozen=True)
class StudyStatus:
    """How far a study is, and how its points ended.

    Attributes
    ----------
    points, done : int
    counts : dict from str to int
        Points by how they ended; those not done are "missing".
    running : dict or None
        The run that works on the store now: its host, process and start.
    seconds_left : float or None
        At the pace of that run.
    damaged : tuple of str
        Files that the last run found missing or damaged, and made again.
    interrupted : bool
        Whether the last run was stopped by its user.
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
        """Whether every point is done."""
        return self.done == self.points

    @property
    def ok(self) -> bool:
        """Whether every point is done and came to its end with its laws kept."""
        return self.complete and not any(
            self.counts.get(name) for name in STATUSES if name not in ("completed", "event")
        )

    def __str__(self) -> str:
        share = 100.0 * self.done / self.points
        lines = [f"{self.done} of {self.points} points are done ({share:.3g} %)"]
        lines += [f"  {count} {name}" for name, count in self.counts.items() if name != "missing"]
        if self.running is not None:
            left = "" if self.seconds_left is None else f", {format_duration(self.seconds_left)} left"
            lines.append(f"process {self.running.get('pid', '?')} on {self.running.get('host', '?')} works on it{left}")
        elif self.interrupted:
            lines.append("interrupted; run the study again to go on")
        elif not self.complete:
            lines.append("no run works on it; run the study again to continue")
        lines += [f"done again: {name}" for name in self.damaged]
        return "\n".join(lines)


def format_duration(seconds: float) -> str:
    """A time in words."""
    minutes = round(seconds) // 60
    return f"{minutes // 60} h {minutes % 60} min" if minutes >= 60 else f"{minutes} min {round(seconds) % 60} s"


def seconds_left(points: int, done: int, running: Mapping[str, Any]) -> float | None:
    """At the pace of a run since it began; None where nothing has been done since."""
    since = done - int(running.get("done", done))
    return (time.time() - running["started"]) * (points - done) / since if since > 0 else None


class StudyProgressBar(Progress):
    """A bar of the points that are done, with the time left, on a terminal or in a notebook."""

    def __init__(self, total: int, done: int, wanted: bool | None):
        from rich.console import Console

        self.n_done = done
        super().__init__((0, total), Console().is_jupyter or None if wanted is None else wanted, f"{{}}/{total} points")

    def __enter__(self) -> StudyProgressBar:
        super().__enter__()
        self.advance(0)
        return self

    def advance(self, points: int) -> None:
        self.n_done += points
        self.update(self.n_done)
