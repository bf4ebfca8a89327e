"""The loops of time of all runs: one trajectory or many, fixed or adaptive steps, in every engine.

Lanes are trajectories that advance together. A driver lets them advance, and a recorder takes what they reach.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any, Protocol

from ..engines.adaptive_runs import PauseHandler
from .schedule import EngineCall


class FixedStepLanes(Protocol):
    """Lanes that take steps of given sizes: see :class:`..engines.array_engine.ArrayBatch`."""

    def advance(self, h: float, n_saves: int, steps_per_save: int, noise: Any = None) -> Any:
        """Take ``n_saves * steps_per_save`` steps of size h, and return the saved states."""


def drive_fixed(
    lanes: FixedStepLanes,
    calls: Iterable[EngineCall],
    record: Callable[[EngineCall, int, Any], bool],
    noise: Callable[[int, int, float], Any] | None = None,
) -> None:
    """Take the steps of a schedule, one call of the engine after another.

    Parameters
    ----------
    lanes : FixedStepLanes
    calls : iterable of EngineCall
    record : function of (call, first_step, saved states)
        Takes the states that a call has saved; it returns False if the run ends early.
    noise : function of (first_step, n_steps, h), optional
        Returns the increments of the noise in the steps of a call.
    """
    n_steps = 0
    for call in calls:
        n_steps_of_call = call.n_saves * call.steps_per_save
        increments = None if noise is None else noise(n_steps, n_steps_of_call, call.h)
        saved = lanes.advance(call.h, call.n_saves, call.steps_per_save, increments)
        if not record(call, n_steps, saved):
            break
        n_steps += n_steps_of_call


class AdaptiveRecorder(Protocol):
    """Recorder of runs with adaptive steps or events."""

    def continues(self) -> bool:
        """Return whether a trajectory goes on."""

    def attempt(self) -> None:
        """Let the trajectories attempt steps, until they pause, and record the accepted ones."""

    def record_pauses(self) -> None:
        """Record events, and states at times at which steps have to end; the trajectories resume afterwards."""

    def record_ended_trajectories(self) -> None:
        """Record the trajectories that have ended."""


def drive_adaptive(pause_handler: PauseHandler, recorder: AdaptiveRecorder) -> None:
    """Attempt steps until all trajectories have ended."""
    pause_handler.resume_paused()
    while recorder.continues():
        recorder.attempt()
        pause_handler.end_or_resume_at_sign_changes()
        recorder.record_pauses()
        pause_handler.resume_paused()
        recorder.record_ended_trajectories()
