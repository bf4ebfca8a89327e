"""Lanes (trajectories that advance together) of a family of systems, for ensembles and for audits that replay steps."""

from __future__ import annotations

import math

import numpy as np

from ..engines.array_engine import ArrayBatch
from ..engines.compiled.engine import CompiledBatch
from ..engines.compiled.parameters import flat_parameters
from ..engines.compiled.step_loop import cached_step_loop
from ..engines.select_engine import MAX_COMPILED_DIM
from ..engines.step_control import StepControl
from ..integrators import OneStepMethod
from .system_family import Family

LANES_PER_BLOCK = 8
"""Number of trajectories in a block of the compiled engine: one AVX-512 vector, or two of AVX2."""


class CompiledLanes:
    """Compiled step loop of a family and a method, with the parameters of its trajectories."""

    def __init__(self, family: Family, method: OneStepMethod, control: StepControl | None = None):
        self.family, self.shared_parameters = family, flat_parameters(method, *([] if control is None else [control]))
        self.first_lane_parameters = np.append(family.parameter_matrix(slice(0, 1), 1)[0], self.shared_parameters)
        self.is_per_trajectory = np.append(family.is_per_trajectory, np.zeros(len(self.shared_parameters), dtype=bool))
        self.step_loop = cached_step_loop(
            family.program_structure,
            self.first_lane_parameters,
            method,
            control,
            LANES_PER_BLOCK,
            self.is_per_trajectory,
        )

    def start_compiled_batch(self, members: slice, initial_states: np.ndarray) -> CompiledBatch:
        """Return a batch of members of the family that takes fixed steps from ``initial_states``, shape (B, n)."""
        return CompiledBatch(
            self.step_loop,
            self.first_lane_parameters,
            self.parameters_of_members(members, len(initial_states)),
            initial_states,
        )

    def parameters_of_members(self, members: slice, n_members: int) -> np.ndarray:
        """Return the parameters that lanes read, shape (n_members, p), or (p,) if all members have the same values."""
        if not self.is_per_trajectory.any():
            return self.first_lane_parameters
        return np.hstack(
            [
                self.family.parameter_matrix(members, n_members),
                np.broadcast_to(self.shared_parameters, (n_members, len(self.shared_parameters))),
            ]
        )


def padded_member_indices(start: int, stop: int, dim: int) -> np.ndarray:
    """Return the indices from ``start`` up to ``stop``, padded with the last one to whole SIMD vectors.

    A partly filled vector would round differently, so padding makes results independent of the number of trajectories.
    States of large ``dim`` fill vectors by themselves.
    """
    n_padded = (
        LANES_PER_BLOCK * math.ceil((stop - start) / LANES_PER_BLOCK) if dim <= MAX_COMPILED_DIM else stop - start
    )
    return np.minimum(np.arange(start, start + n_padded), stop - 1)


REPLAY_STEPS_PER_CALL = 32
"""Largest number of steps that one call of the array engine replays."""


def replay_steps(
    engine: str,
    family: Family,
    method: OneStepMethod,
    initial_states: np.ndarray,
    step_sizes: np.ndarray,
    n_steps: int = 1,
) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Take ``n_steps`` steps of size step_sizes[i] with each member i of a small family.

    Parameters
    ----------
    engine : {"compiled", "array"}
    family : Family
    method : OneStepMethod
    initial_states : array, shape (trajectories, n)
    step_sizes : array, shape (trajectories,)
    n_steps : int

    Returns
    -------
    dict of arrays
        Engine fields after the steps.
    array, shape (trajectories, n_steps, n)
        States after each step.
    """
    batch: CompiledBatch | ArrayBatch
    if engine == "compiled":
        batch, steps_per_call = (
            CompiledLanes(family, method).start_compiled_batch(slice(0, len(initial_states)), initial_states),
            max(1, n_steps),
        )
    else:
        # filled up with copies of the last member to a power of two: few numbers of lanes, few programs
        rows = np.minimum(np.arange(1 << (len(initial_states) - 1).bit_length()), len(initial_states) - 1)
        arguments = family.program_structure, *family.vmap_arguments(rows), method
        batch, step_sizes = (
            ArrayBatch(*arguments, initial_states[rows], min_capacity=REPLAY_STEPS_PER_CALL),
            step_sizes[rows],
        )
        steps_per_call = REPLAY_STEPS_PER_CALL
    counts = [min(steps_per_call, n_steps - n_done) for n_done in range(0, n_steps, steps_per_call)]
    states = [batch.advance(step_sizes, n_saves, 1)[: len(initial_states), :, :-2] for n_saves in counts]
    return {name: values[: len(initial_states)] for name, values in batch.read().items()}, np.concatenate(
        states, axis=1
    )
