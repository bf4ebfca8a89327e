"""Compiled engine: a user's plain functions as machine code, for small systems on the CPU.

The steps of the array engine, for one system and method, are traced, unrolled to scalar programs (:mod:`liethermo.
tracing.scalarize`) and placed in a loop over steps (:mod:`.step_loop`) that LLVM compiles. The system's parameters (the
arrays among its leaves) stay arguments: a sweep compiles once. Machine code is cached on disk for other processes.
"""

from __future__ import annotations

import ctypes
import functools
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from llvmlite import ir

from ...integrators import OneStepMethod
from ...systems import System
from ...tracing.scalarize import UnsupportedPrimitive
from ..array_engine import max_saves_per_call
from ..solver_options import DEFAULT_OPTIONS, SolverOptions
from ..step import SavedStates, State
from ..step_control import StepControl
from .llvm_writer import FLOAT64, INT64, ProgramWriter
from .loop_codegen import ADVANCE_TYPE, BEGIN_TYPE, FLOAT64_POINTER, INT64_POINTER
from .machine_code import MachineCode
from .parameters import ProgramStructure, flat_parameters
from .step_loop import CompiledStepLoop, cached_step_loop

FIELD_TYPES = {
    "begin": BEGIN_TYPE.as_pointer(),
    "advance": ADVANCE_TYPE.as_pointer(),
    "parameters": FLOAT64_POINTER,
    "block": FLOAT64_POINTER,
    "n_done": INT64_POINTER,
    "status": FLOAT64_POINTER,
    "h": FLOAT64_POINTER,
    "saved": FLOAT64_POINTER,
    "newton": ADVANCE_TYPE.args[-1],
    "sizes": FLOAT64_POINTER,
    "counts": INT64_POINTER,
    "increments": FLOAT64_POINTER.as_pointer(),
    "n_segments": INT64,
}
"""Fields of the description of a run: the arguments of ``begin`` and ``advance``, and arrays with an entry for each
segment of equal steps."""

RUN_SIGNATURE = ctypes.CFUNCTYPE(ctypes.c_int64, ctypes.c_void_p)
"""C signature of ``run(description)``."""


class RunInOneCall:
    """All steps of a run of one trajectory, taken by one call of machine code.

    Parameters
    ----------
    addresses : dict from str to int
        The fields ``parameters``, ``block``, ``n_done``, ``status``, ``h`` and ``saved`` of :data:`FIELD_TYPES`.
    segments : sequence of (h, n_steps)
    noise_increments : sequence of array
        Increments of noise for each segment.
    """

    def __init__(
        self, addresses: dict[str, int], segments: Sequence[tuple[float, int]], noise_increments: Sequence[np.ndarray]
    ):
        sizes, counts = np.array([h for h, _ in segments]), np.array([n_steps for _, n_steps in segments])
        pointers = np.array([array.ctypes.data for array in noise_increments])
        self._arrays = sizes, counts, noise_increments, pointers
        arrays = {"sizes": sizes, "counts": counts, "increments": pointers}
        self._fields = np.zeros(len(FIELD_TYPES), dtype=np.int64)
        field_values = (
            addresses | {name: array.ctypes.data for name, array in arrays.items()} | {"n_segments": len(sizes)}
        )
        for name, value in field_values.items():
            self._fields[list(FIELD_TYPES).index(name)] = value
        self._newton = list(FIELD_TYPES).index("newton")
        self._functions: tuple[Any, ...] = ()
        self._address = self._fields.ctypes.data
        self._run = RUN_SIGNATURE(_compile_run_in_one_call().function_address("run"))

    def __call__(self, loop_functions: tuple[Any, Any], newton_address: int) -> bool:
        """Take all steps of the run, and return whether every step was taken without Newton's method."""
        if loop_functions != self._functions:
            self._functions = loop_functions
            self._fields[:2] = [ctypes.cast(function, ctypes.c_void_p).value or 0 for function in loop_functions]
        if newton_address:
            self._fields[self._newton] = newton_address
        return not self._run(self._address)


@functools.cache
def _compile_run_in_one_call() -> MachineCode:
    """Return the machine code of ``run(description)``.

    Its result is 1 if a step fails or needs Newton's method, and otherwise 0.
    """
    module = ir.Module("run")
    description = ir.LiteralStructType(FIELD_TYPES.values()).as_pointer()
    function = ir.Function(module, ir.FunctionType(INT64, [description]), "run")
    writer = ProgramWriter(ir.IRBuilder(function.append_basic_block("entry")), 1)
    build, int32, one = writer.builder, ir.IntType(32), writer.int64(1)
    field = {name: build.load(build.gep(function.args[0], [int32(0), int32(i)])) for i, name in enumerate(FIELD_TYPES)}
    build.store(FLOAT64(0.0), field["status"])
    build.call(field["begin"], [field["parameters"], field["block"], one])
    with writer.loop_range(field["n_segments"]) as i:
        size, count, increments = (
            build.load(build.gep(field[name], [i])) for name in ("sizes", "counts", "increments")
        )
        build.store(size, field["h"])
        build.store(writer.int64(0), field["n_done"])
        state = field["parameters"], field["block"], field["n_done"]
        n_saves = build.call(
            field["advance"], [*state, one, one, count, field["saved"], count, increments, field["newton"]]
        )
        has_failed = build.fcmp_unordered("!=", build.load(field["status"]), FLOAT64(0.0))
        with build.if_then(build.or_(build.icmp_signed("<", n_saves, one), has_failed)):
            build.ret(one)
    build.ret(writer.int64(0))
    return MachineCode(module)


class CompiledEngine:
    """The compiled engine, which runs machine code on the CPU, for one system and method.

    Its steps are those of the array engine.

    Raises
    ------
    UnsupportedPrimitive
        If the system or the method uses a primitive that cannot be unrolled; if only Newton's method does, at the first
        step that needs it.
    """

    name = "compiled"

    def __init__(
        self, system: System, method: OneStepMethod, options: SolverOptions = DEFAULT_OPTIONS, planned_steps: int = 0
    ):
        self._parameters, self._planned_steps = flat_parameters(system, method), planned_steps
        self.max_saves_per_call = max_saves_per_call(system)
        self._structure, self._method, self._options = ProgramStructure.from_module(system), method, options

    @functools.cached_property
    def _step_loop(self) -> CompiledStepLoop:
        """The compiled loop of fixed steps of this system and method."""
        return cached_step_loop(self._structure, self._parameters, self._method, options=self._options)

    def adaptive_step_loop(self, control: StepControl) -> tuple[CompiledStepLoop, np.ndarray]:
        """Return the compiled loop of adaptive steps with a step control, and its parameters, shape (p,)."""
        parameters = np.append(self._parameters, flat_parameters(control))
        return cached_step_loop(self._structure, parameters, self._method, control, options=self._options), parameters

    @property
    def n_operations_per_step(self) -> int:
        """Number of scalar operations of a step, which measures the time to compile it."""
        return self._step_loop.n_operations_per_step

    @functools.cached_property
    def trajectory(self) -> CompiledTrajectory:
        """The trajectory that :meth:`start` restarts, in buffers that all runs share."""
        return self.new_trajectory()

    def new_trajectory(self) -> CompiledTrajectory:
        """Return a new trajectory with buffers of its own."""
        return CompiledTrajectory(self._step_loop, self._parameters)

    def start(self, x) -> CompiledTrajectory:
        """Return the trajectory of this engine, restarted at x, shape (n,)."""
        self.trajectory.start(x, self._planned_steps)
        return self.trajectory

    def initial_run_state(self, x) -> State:
        """Return the state of a run that starts at x, shape (n,)."""
        return self._state_from_block(
            self._step_loop.start_blocks(self._parameters, np.asarray(x, dtype=np.float64)[None], self._planned_steps)
        )

    def advance(self, state: State, h, n_saves: int, save_every: int, noise=None):
        """Return the state after up to ``n_saves`` times ``save_every`` steps, and the saved arrays."""
        new_state, saved_values = self._advance_from_state(state, h, n_saves, save_every, noise)
        is_reached = np.arange(n_saves) < (int(new_state.step) - int(state.step)) // save_every
        return new_state, (saved_values[:, :-2], saved_values[:, -2], saved_values[:, -1], is_reached)

    def step(self, state: State, h, noise=None) -> State:
        """Return the state after one step of size h, or the old state with a failure status."""
        return self._advance_from_state(state, h, 1, 1, noise)[0]

    def step_ends(self, x: np.ndarray, h: np.ndarray) -> np.ndarray:
        """Return the states, shape (m, n), after one step of size h from each state of x; NaN if a step fails."""
        blocks = self._step_loop.start_blocks(self._parameters, x)
        self._step_loop.advance_blocks(self._parameters, blocks, h, 1, 1)
        fields = self._step_loop.read_fields(blocks, ("x", "status"))
        return np.where(fields["status"].reshape(-1, 1) == 0.0, fields["x"], np.nan)

    def _advance_from_state(self, state: State, h, n_saves: int, save_every: int, noise) -> tuple[State, np.ndarray]:
        """Return the state after steps from a given state, and the values saved, shape (n_saves, n + 2)."""
        blocks = self._step_loop.block_from_state(state)
        saved_values = self._step_loop.advance_blocks(
            self._parameters, blocks, h, n_saves, save_every, None if noise is None else noise[None]
        )[0]
        return self._state_from_block(blocks), saved_values

    def _state_from_block(self, blocks: np.ndarray) -> State:
        """Return the state of a single trajectory from its block."""
        return self._step_loop.state_from_block(blocks)


class CompiledTrajectory:
    """One trajectory of a compiled step loop, in buffers that machine code writes in place.

    The buffers are written in place by the machine code, so each thread needs a trajectory of its own.

    Parameters
    ----------
    step_loop : CompiledStepLoop
        A loop of one lane, with steps of given sizes.
    parameters : array, shape (p,)
        Parameters of the system and the method, one after another.

    Attributes
    ----------
    parameters : array, shape (p,)
        A copy, which may change in place before a start; which parameters are zero may not.
    """

    def __init__(self, step_loop: CompiledStepLoop, parameters: np.ndarray):
        self._loop, self.parameters = step_loop, np.array(parameters, dtype=np.float64)
        self._block = step_loop.blocks_from_fields({"x": np.zeros((1, *step_loop.field_shape("x")))})
        self._row = rows = step_loop.block_rows(self._block)[0, :, 0]
        self._x, self._status, self._step, self._h = (
            rows[step_loop.row_slice(name)] for name in ("x", "status", "step", "h")
        )
        self._n_saved_values, self._n_done = step_loop.n_saved_values, np.zeros(1, dtype=np.int64)
        self._addresses = [array.ctypes.data for array in (self.parameters, self._block, self._n_done)]

    def start(self, x, planned_steps: int = 0) -> None:
        """Start a trajectory at x, shape (n,); its machine code is optimised if ``planned_steps`` are many."""
        begin, _ = self._loop.loop_functions(0, planned_steps)
        self._status[0], self._x[:] = 0.0, x
        begin(self._addresses[0], self._addresses[1], 1)

    def advance(self, h: float, n_saves: int, steps_per_save: int, noise: np.ndarray | None = None) -> SavedStates:
        """Take ``n_saves * steps_per_save`` steps of size h, fewer if one fails, and return the saved states.

        Raises
        ------
        UnsupportedPrimitive
            If a step needs Newton's method, which cannot be compiled; the trajectory is then as it was before.
        """
        first_step, block = self._step[0], self._block.copy()
        saved_values = np.empty((n_saves, self._n_saved_values))
        try:
            self._take_steps(h, n_saves, steps_per_save, noise, saved_values)
        except BaseException:  # an interrupt too: what is not saved was not taken
            self._block[:] = block
            raise
        n_reached = int(self._step[0] - first_step) // steps_per_save
        return SavedStates(saved_values[:n_reached, :-2], saved_values[:n_reached, -2:])

    def final_state_function(self, segments: Sequence[tuple[float, int]]) -> Callable[[np.ndarray], np.ndarray | None]:
        """Return a fast function from an initial state, shape (n,), to the final state after all steps of ``segments``.

        Its result is None if a step fails, or needs Newton's method for the first time. A call overwrites this
        trajectory.

        Parameters
        ----------
        segments : sequence of (h, n_steps)
            Step sizes, and how many steps of each size follow one another.
        """
        saved_values, segments = np.empty(self._n_saved_values), tuple(segments)
        n_total, loop = sum(n_steps for _, n_steps in segments), self._loop
        increments = [loop.noise_increments_by_lane_block(None, 1, n_steps) for _, n_steps in segments]
        addresses = dict(zip(("parameters", "block", "n_done"), self._addresses, strict=True))
        fields = {"status": self._status, "h": self._h, "saved": saved_values}
        addresses |= {name: field.ctypes.data for name, field in fields.items()}
        take_steps, x_row = RunInOneCall(addresses, segments, increments), self._x

        def final_state(x: np.ndarray) -> np.ndarray | None:
            x_row[:] = x
            return x_row.copy() if take_steps(loop.loop_functions(n_total), loop.newton_address(False)) else None

        final_state.buffer = saved_values  # type: ignore[attr-defined]  # whose address the run has
        return final_state

    def read(self, name: str) -> float:
        """Return a scalar field of the current state by name."""
        return float(self._row[self._loop.row_slice(name).start])

    @property
    def state(self) -> State:
        """A copy of the current state."""
        return self._loop.state_from_block(self._block.copy())

    def _take_steps(self, h: float, n_saves: int, steps_per_save: int, noise: np.ndarray | None, saved_values) -> None:
        """Take ``n_saves * steps_per_save`` steps in place, fewer if one fails, and write the saves to an array."""
        n_steps = n_saves * steps_per_save
        increments = self._loop.noise_increments_by_lane_block(None if noise is None else noise[None], 1, n_steps)
        parameters, block, n_done = self._addresses
        self._h[0], self._n_done[0] = h, 0
        _, advance = self._loop.loop_functions(n_steps)
        newton, out_address, noise_address = (
            self._loop.newton_address(False),
            saved_values.ctypes.data,
            increments.ctypes.data,
        )
        while (
            advance(parameters, block, n_done, 1, n_saves, steps_per_save, out_address, n_steps, noise_address, newton)
            < 1
        ):
            newton = self._loop.newton_address(True)


class CompiledBatch:
    """Trajectories in the lanes of a compiled step loop, advanced by steps of given sizes.

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
        saved_values = self._loop.advance_blocks(
            self._first_parameters, self._blocks, sizes, n_saves, steps_per_save, noise
        )
        return np.asarray(saved_values)[: self._n_trajectories]

    def read(self, names: Sequence[str] | None = None) -> dict[str, np.ndarray]:
        """Return copies of fields of the trajectories by name, by default of all fields."""
        fields = self._loop.read_fields(self._blocks, names)
        return {name: values[: self._n_trajectories].copy("K") for name, values in fields.items()}


class CompiledAdaptiveRuns:
    """Adaptive runs of trajectories in the lanes of a compiled step loop.

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
        """Make up to ``max_attempts`` attempts of a step in each trajectory, fewer if it pauses."""
        self.step_loop.advance_blocks(self.first_parameters, self.blocks, 0.0, 1, max_attempts)

    def state_of_only_trajectory(self) -> State:
        """Return the state of the only trajectory."""
        return self.step_loop.state_from_block(self.blocks.copy())

    def record_attempts(self, max_attempts: int) -> dict[str, np.ndarray]:
        """Make up to ``max_attempts`` attempts of the only trajectory; return the records by ATTEMPT_FIELDS."""
        n_before, saved_values = self.read("n_attempts")[0], np.empty((1, max_attempts, self.step_loop.n_saved_values))
        try:
            self.step_loop.advance_blocks(self.first_parameters, self.blocks, 0.0, max_attempts, 1, out=saved_values)
        except UnsupportedPrimitive:
            if self.read("n_attempts")[0] == n_before:
                raise
        return self.step_loop.saved_fields_of_single_trajectory(
            saved_values[0, : int(self.read("n_attempts")[0] - n_before)]
        )

    def read(self, field_name: str, indices: np.ndarray | slice = slice(None)) -> np.ndarray:
        """Return a field of the chosen trajectories, trajectories first."""
        if isinstance(indices, slice):
            return self.step_loop.read_fields(self.blocks, (field_name,))[field_name][: self.n_trajectories][
                indices
            ].copy()
        values = self._lane_values(indices, field_name)
        return values if field_name == "p" else values.reshape(len(indices), *self.step_loop.field_shape(field_name))

    def write(self, field_name: str, indices: np.ndarray, values) -> None:
        """Set a field of the chosen trajectories to values, trajectories first."""
        block, lane = np.divmod(indices, self.step_loop.lanes)
        values = np.reshape(values, (len(indices), -1)) if np.ndim(values) else values
        self.step_loop.block_rows(self.blocks, field_name)[block, :, lane] = values

    def _lane_values(self, indices: np.ndarray, name: str | None = None) -> np.ndarray:
        """Return the rows of a field of the chosen trajectories, shape (trajectories, rows); all rows for no name."""
        block, lane = np.divmod(indices, self.step_loop.lanes)
        return self.step_loop.block_rows(self.blocks, name)[block, :, lane]

    def keep_trajectories(self, indices: np.ndarray) -> None:
        """Drop all trajectories except the chosen ones, and pack these into new blocks."""
        self.blocks, self.n_trajectories = self.step_loop.blocks_from_rows(self._lane_values(indices)), len(indices)
