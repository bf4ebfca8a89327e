"""Trajectories in the lanes of a compiled loop, with steps of given sizes or adaptive ones."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ...tracing.scalarize import UnsupportedPrimitive
from ..step import State
from .step_loop import CompiledStepLoop


class CompiledBatch:
    """Trajectories in lanes with steps of given sizes, the counterpart of :class:`..array_engine.ArrayBatch`.

    Parameters
    ----------
    step_loop : CompiledStepLoop
    first_parameters : array, shape (p,)
        Parameters of one trajectory: of its system and the method.
    parameters : array, shape (p,) or (trajectories, p)
    x : array, shape (trajectories, n)
    """

    def __init__(self, step_loop: CompiledStepLoop, first_parameters, parameters, x: np.ndarray):
        self._loop, self._first_parameters, self._n_trajectories = step_loop, first_parameters, len(x)
        self._blocks = step_loop.start_blocks(parameters, x)

    def advance(self, h, n_saves: int, steps_per_save: int, noise=None) -> np.ndarray:
        """Take ``n_saves * steps_per_save`` steps; return states, energies and entropies, shape (B, n_saves, n + 2)."""
        sizes = np.resize(h, len(self._blocks) * self._loop.lanes) if np.ndim(h) else h
        saved = self._loop.advance_blocks(self._first_parameters, self._blocks, sizes, n_saves, steps_per_save, noise)
        return np.asarray(saved)[: self._n_trajectories]

    def read(self, names: Sequence[str] | None = None) -> dict[str, np.ndarray]:
        """Return copies of fields of the trajectories by name, by default of all fields."""
        fields = self._loop.read_fields(self._blocks, names)
        return {name: values[: self._n_trajectories].copy("K") for name, values in fields.items()}


class CompiledAdaptiveRuns:
    """Adaptive runs of trajectories in lanes, the counterpart of :class:`..lanes.ArrayAdaptiveRuns`.

    Parameters
    ----------
    step_loop : CompiledStepLoop
    first_parameters : array, shape (p,)
        Parameters of one trajectory: of its system, the method and the step control.
    parameters : array, shape (p,) or (trajectories, p)
    x : array, shape (trajectories, n)
    t, stop_time, span_length : float
        See :func:`..adaptive_steps.initial_adaptive_state`.
    """

    def __init__(
        self, step_loop: CompiledStepLoop, first_parameters, parameters, x: np.ndarray, t, stop_time, span_length
    ):
        self.step_loop, self.first_parameters, self.n_trajectories = step_loop, first_parameters, len(x)
        initial_fields = {
            name: np.full((len(x), 1), value)
            for name, value in (("t", t), ("stop_time", stop_time), ("length", span_length))
        }
        self.blocks = step_loop.start_blocks(parameters, x, 0, **initial_fields)

    def advance(self, max_attempts: int) -> None:
        self.step_loop.advance_blocks(self.first_parameters, self.blocks, 0.0, 1, max_attempts)

    def state(self) -> State:
        return self.step_loop.state_from_block(self.blocks.copy())

    def attempt_and_record(self, max_attempts: int) -> dict[str, np.ndarray]:
        """Make up to ``max_attempts`` attempts of the only trajectory and return their records: see ATTEMPT_FIELDS."""
        n_before, out = self.read("n_attempts")[0], np.empty((1, max_attempts, self.step_loop.n_saved_values))
        try:
            self.step_loop.advance_blocks(self.first_parameters, self.blocks, 0.0, max_attempts, 1, out=out)
        except UnsupportedPrimitive:
            if self.read("n_attempts")[0] == n_before:
                raise
        return self.step_loop.saved_fields_of_one(out[0, : int(self.read("n_attempts")[0] - n_before)])

    def read(self, name: str, indices: np.ndarray | slice = slice(None)) -> np.ndarray:
        if isinstance(indices, slice):
            return self.step_loop.read_fields(self.blocks, (name,))[name][: self.n_trajectories][indices].copy()
        values = self._lane_values(indices, name)
        return values if name == "p" else values.reshape(len(indices), *self.step_loop.field_shape(name))

    def write(self, name: str, indices: np.ndarray, values) -> None:
        block, lane = np.divmod(indices, self.step_loop.lanes)
        values = np.reshape(values, (len(indices), -1)) if np.ndim(values) else values
        self.step_loop.block_rows(self.blocks, name)[block, :, lane] = values

    def _lane_values(self, indices: np.ndarray, name: str | None = None) -> np.ndarray:
        """Return a field of the chosen trajectories, or all their rows, shape (trajectories, rows)."""
        block, lane = np.divmod(indices, self.step_loop.lanes)
        return self.step_loop.block_rows(self.blocks, name)[block, :, lane]

    def keep_only(self, indices: np.ndarray) -> None:
        """Drop all trajectories except the chosen ones."""
        self.blocks, self.n_trajectories = self.step_loop.blocks_from_rows(self._lane_values(indices)), len(indices)
