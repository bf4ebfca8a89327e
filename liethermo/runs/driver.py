"""The time loops of all runs: one trajectory or many, fixed or adaptive steps, in every engine.

Lanes are trajectories that advance together. A loop lets them advance, and a recorder stores the states that they
reach.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any, Protocol

from ..engines.adaptive_runs import PauseHandler
from .schedule import EngineCall


class FixedStepLanes(Protocol):
    """Trajectories that advance together by steps of given sizes: see :class:`..engines.array_engine.ArrayBatch`."""

    def advance(self, h: float, n_saves: int, steps_per_save: int, noise: Any = None) -> Any:
        """Take ``n_saves * steps_per_save`` steps of size h, and return the saved states."""


def take_scheduled_steps(
    lanes: FixedStepLanes,
    engine_calls: Iterable[EngineCall],
    record_saved_states: Callable[[EngineCall, int, Any], bool],
    noise_increments: Callable[[int, int, float], Any] | None = None,
) -> None:
    """Take the steps of a schedule, one call of the engine after another.

    Parameters
    ----------
    lanes : FixedStepLanes
    engine_calls : iterable of EngineCall
    record_saved_states : function of (call, first_step, saved states)
        Stores the states that a call has saved; it returns False if the run ends early.
    noise_increments : function of (first_step, n_steps, h), optional
        Returns the increments of the noise in the steps of a call.
    """
    n_steps = 0
    for call in engine_calls:
        n_steps_of_call = call.n_saves * call.steps_per_save
        increments = None if noise_increments is None else noise_increments(n_steps, n_steps_of_call, call.h)
        saved_states = lanes.advance(call.h, call.n_saves, call.steps_per_save, increments)
        if not record_saved_states(call, n_steps, saved_states):
            break
        n_steps += n_steps_of_call


class AdaptiveRecorder(Protocol):
    """Recorder of runs with adaptive steps or events."""

    def can_continue(self) -> bool:
        """Return whether any trajectory has further steps to attempt."""

    def attempt_steps(self) -> None:
        """Let the trajectories attempt steps, until they pause, and record the accepted ones."""

    def handle_pauses(self) -> None:
        """Record the events and the saved states of paused trajectories, which resume afterwards."""

    def record_ended_trajectories(self) -> None:
        """Record the final states of the trajectories that have ended."""


def advance_until_all_end(pause_handler: PauseHandler, recorder: AdaptiveRecorder) -> None:
    """Attempt steps until all trajectories have ended."""
    pause_handler.resume_paused()
    while recorder.can_continue():
        recorder.attempt_steps()
        pause_handler.end_or_resume_at_sign_changes()
        recorder.handle_pauses()
        pause_handler.resume_paused()
        recorder.record_ended_trajectories()
