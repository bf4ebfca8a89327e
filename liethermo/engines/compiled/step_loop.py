"""Compiled loop of steps: a step of the array engine unrolled to scalar programs, in a loop that LLVM compiles.

The system's parameters (the arrays among its leaves) stay arguments, so that a sweep compiles once.
"""

from __future__ import annotations

import functools
import itertools
import math
import threading
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr

from ...integrators import OneStepMethod
from ...integrators.fluctuating import noise_dimension, with_noise_increments
from ...systems.clock import system_between_breaks
from ...tracing.caching import LRUCache
from ...tracing.calls import deferred_p
from ...tracing.fingerprint import compiler_source_fingerprint, program_fingerprint
from ...tracing.program import Program
from ...tracing.scalarize import report_compiler_faults, scalarize
from ..adaptive_steps import ATTEMPT_FIELDS, attempt_step, initial_adaptive_state
from ..root_bracket import packed_bracket_shape
from ..solver_options import DEFAULT_OPTIONS, SolverOptions
from ..stage_solver import StageSolution, solve_newton
from ..status_codes import StatusCode
from ..step import State, initial_run_state, stage_equations, take_step
from ..step_control import AdaptiveState, StepControl, jacobian_probe_shape
from .loop_codegen import (
    MAX_UNOPTIMISED_OPERATIONS,
    NEWTON_BUFFER,
    BlockLayout,
    CompiledLoops,
    NamedProgram,
    write_newton_solver,
    write_step_loop,
)
from .machine_code import MachineCode, read_operation_count, write_operation_count
from .parameters import ProgramStructure

STATE_FIELDS = State._fields
"""Fields of a state."""

ADAPTIVE_FIELDS = tuple(name for name in AdaptiveState._fields if name != "state")
"""Fields of an adaptive state besides the state."""


class NewtonInputs(NamedTuple):
    """Inputs of the Newton fallback, as they are packed into the Newton buffer."""

    dW: jax.Array
    x: jax.Array
    compensation: jax.Array
    h: jax.Array
    k: jax.Array
    previous_slopes: jax.Array


NEWTON_INPUTS = NewtonInputs._fields
"""Names of the inputs of the Newton fallback."""

NEWTON_OUTPUTS = ("converged", "is_finite", "residual", "newton_iterations", "slope_rounding", "k")
"""Fields of :class:`..stage_solver.StageSolution` that the Newton fallback replaces."""


EMPTY_INCREMENTS = np.zeros(0)
"""Noise increments of a method without noise."""


class CompiledStepLoop:
    """A compiled loop of steps of one method, for all systems of one structure.

    With a ``control`` a step is an attempt of an adaptive run, whose size the loop chooses.

    Parameters
    ----------
    structures : sequence of ProgramStructure
        Structures of the system, the method and, in an adaptive run, the step control.
    parameters : array, shape (p,)
        Example parameters of these, one after another. Zeros among them are compiled in, unless they vary.
    method : OneStepMethod
    control : StepControl or None
    lanes : int
        Number of trajectories in a block, which advance together.
    is_per_trajectory : array of bool, shape (p,)
        Parameters that differ between trajectories.

    Attributes
    ----------
    field_names : tuple of str
        Fields of a trajectory.
    initial_inputs, step_inputs : tuple of str
        Inputs of the initial state besides p and x; inputs of a step besides the fields.
    saved_fields : tuple of str
        Fields that are written out at each save.
    n_operations_per_step : int
        Number of scalar operations of a step with one iteration.
    """

    def __init__(
        self,
        structures: Sequence[ProgramStructure],
        parameters: np.ndarray,
        method: OneStepMethod,
        control: StepControl | None,
        lanes: int,
        is_per_trajectory: np.ndarray,
        options: SolverOptions,
    ):
        self.lanes, self._options, self._is_per_trajectory = lanes, options, is_per_trajectory
        self._constant_parameters = np.where((parameters == 0.0) & ~is_per_trajectory, 0.0, np.nan)
        self._lock = threading.Lock()
        self._newton_code: MachineCode | None = None
        self._structures = structures
        system = structures[0].build(parameters[: structures[0].n_parameters])
        n, state = system.dim, jax.ShapeDtypeStruct((system.dim,), np.float64)
        slopes_shape = jax.eval_shape(lambda x: method.start(system, x), state).shape
        self._shapes: dict[str, tuple[int, ...]] = {
            "x": (n,),
            "compensation": (n,),
            "k": slopes_shape,
            "p": parameters.shape,
        }
        self._shapes |= {
            "previous_slopes": (0 if method.explicit else method.stages, slopes_shape[1]),
            "dW": (noise_dimension(method),),
        }
        self.field_names: tuple[str, ...] = STATE_FIELDS if control is None else (*STATE_FIELDS, *ADAPTIVE_FIELDS)
        self.saved_fields = ("x", "energy", "entropy") if control is None else ATTEMPT_FIELDS
        self.initial_inputs = () if control is None else ("t", "stop_time", "length")
        self.step_inputs = ("p", "dW", "h") if control is None else ("p", "dW")
        if control is not None:
            self._shapes |= {
                "jacobian_probe": jacobian_probe_shape(system, method, control),
                "event_values": control.event_shape,
                "root_bracket": packed_bracket_shape(control.event_shape),
            }
        self._step_jaxpr = self._trace(self.fields_after_step, (*self.step_inputs, *self.field_names))
        self._initial_jaxpr = self._trace(self.initial_fields, ("p", "x", *self.initial_inputs))
        self._is_explicit = method.explicit
        buffer_size = (
            0
            if method.explicit
            else sum(math.prod(self.field_shape(name)) for name in (*NEWTON_OUTPUTS, *NEWTON_INPUTS))
        )
        names = (*self.field_names, *self.initial_inputs, *self.step_inputs[1:])
        shapes = {name: self.field_shape(name) for name in names} | {
            "p": (int(is_per_trajectory.sum()),),
            NEWTON_BUFFER: (buffer_size,),
        }
        self._layout = BlockLayout(shapes)
        first_rows, row_counts = self._layout.first_rows, self._layout.row_counts
        self._state_rows = [
            (first_rows[name], first_rows[name] + row_counts[name], self.field_shape(name)) for name in STATE_FIELDS
        ]
        state_names = [name for name in (*self.field_names, "h") if name in first_rows]
        self._key = self._cache_key(self._step_jaxpr, self._initial_jaxpr)
        self.n_operations_per_step = self._count_operations()
        self._loops = CompiledLoops(
            lambda: write_step_loop(
                self._programs, self._layout, state_names, is_per_trajectory, lanes, self.saved_fields
            ),
            self._key,
            lanes == 1 and self.n_operations_per_step <= MAX_UNOPTIMISED_OPERATIONS,
        )

    # -- what is compiled -----------------------------------------------------------------------------------------

    def build_modules(self, p) -> list[Any]:
        """Return the system, the method and, for an adaptive run, the step control, built from the parameters p."""
        ends = itertools.accumulate(structure.n_parameters for structure in self._structures)
        return [
            structure.build(p[end - structure.n_parameters : end])
            for structure, end in zip(self._structures, ends, strict=True)
        ]

    def initial_fields(self, p, x, *times) -> tuple:
        """Return the fields of the state, or of the adaptive state, of a run that starts at x."""
        system, method, *control = self.build_modules(p)
        if not control:
            return initial_run_state(system, method, x)
        adaptive_state = initial_adaptive_state(system, method, control[0], x, *times)
        return *adaptive_state.state, *adaptive_state[1:]

    def fields_after_step(self, p, dW, *inputs) -> tuple:
        """Return the fields of the state after a step; ``inputs`` are h (fixed steps only) and the old fields."""
        system, method, *control = self.build_modules(p)
        if not control:
            h, *fields = inputs
            return take_step(
                system,
                with_noise_increments(method, dW),
                State(*fields),
                h,
                self._options,
                self._make_newton_fallback(dW),
            )
        previous_state = AdaptiveState(State(*inputs[: len(STATE_FIELDS)]), *inputs[len(STATE_FIELDS) :])
        adaptive_state = attempt_step(
            system, method, control[0], previous_state, self._options, self._make_newton_fallback(dW)
        )
        return *adaptive_state.state, *adaptive_state[1:]

    def _make_newton_fallback(self, noise_increments) -> Callable:
        """Return the function that stands in for Newton's method in a step: it calls code compiled at first use."""

        def bind_deferred_newton(fixed_point_result: StageSolution, *stage_inputs) -> StageSolution:
            initial_outputs = [1.0 * getattr(fixed_point_result, name) for name in NEWTON_OUTPUTS]
            outputs = deferred_p.bind(
                *initial_outputs, noise_increments, *(jnp.asarray(a) for a in stage_inputs), results=len(NEWTON_OUTPUTS)
            )
            solution = fixed_point_result._replace(**dict(zip(NEWTON_OUTPUTS, outputs, strict=True)))
            return solution._replace(converged=solution.converged > 0.0, is_finite=solution.is_finite > 0.0)

        return bind_deferred_newton

    def _solve_packed_newton(self, p, packed_buffer) -> tuple:
        """Return the outputs of Newton's method, from its inputs packed in one array."""
        system, method, *_ = self.build_modules(p)
        shapes = [self.field_shape(name) for name in (*NEWTON_OUTPUTS, *NEWTON_INPUTS)]
        ends = itertools.accumulate(map(math.prod, shapes))
        arrays = [
            packed_buffer[end - math.prod(shape) : end].reshape(shape) for end, shape in zip(ends, shapes, strict=True)
        ]
        inputs = NewtonInputs(*arrays[len(NEWTON_OUTPUTS) :])
        equations = stage_equations(
            system_between_breaks(system, inputs.x),
            with_noise_increments(method, inputs.dW),
            inputs.x,
            inputs.compensation,
            inputs.h,
            inputs.k,
            inputs.previous_slopes,
            self._options,
            jax.lax.map,
        )
        solution = solve_newton(equations, self._options)
        return tuple(1.0 * getattr(solution, name) for name in NEWTON_OUTPUTS)

    # Unrolling a program and writing it for LLVM take most of the time before a first step, and are only done if the
    # machine code is not in the cache: it is found by the traced program.

    def _trace(self, function: Callable, names: Sequence[str]) -> ClosedJaxpr:
        shapes = [jax.ShapeDtypeStruct(self.field_shape(name), jnp.float64) for name in names]
        return jax.make_jaxpr(function)(*shapes)

    def _scalarize(self, jaxpr: ClosedJaxpr) -> Program:
        """Unroll a traced program, with the constant entries of its first argument, p, compiled in."""
        return scalarize(jaxpr, [self._constant_parameters, *[None] * (len(jaxpr.jaxpr.invars) - 1)])

    @functools.cached_property
    def _programs(self) -> dict[str, NamedProgram]:
        """Scalar programs of a step and of the initial state."""
        step_names, initial_names = (*self.step_inputs, *self.field_names), ("p", "x", *self.initial_inputs)
        step_program = self._scalarize(self._step_jaxpr)
        if self._is_explicit:
            variable_inputs = [i for i, name in enumerate(step_names) if name not in ("p", "h")]
            step_program = step_program.regroup_constant_factors(variable_inputs)
        initial_program = self._scalarize(self._initial_jaxpr)
        return {
            "step": NamedProgram(step_program, step_names, self.field_names),
            "begin": NamedProgram(initial_program, initial_names, self.field_names),
        }

    def _count_operations(self) -> int:
        """Return the number of operations of a step, from the cache if possible."""
        count = read_operation_count(self._key) if self._key else None
        if count is None:
            count = self._programs["step"].program.instruction_count
            if self._key:
                write_operation_count(self._key, count)
        return count

    def _cache_key(self, *jaxprs: ClosedJaxpr) -> str:
        """Return a text that identifies the machine code of these programs in all processes, or "" if none can."""
        fingerprints = [compiler_source_fingerprint(), *map(program_fingerprint, jaxprs)]
        if None in fingerprints:
            return ""
        layout = self._layout.row_counts, self.field_names, self.saved_fields, self.lanes, self._is_explicit
        masks = self._constant_parameters.tobytes(), self._is_per_trajectory.tobytes()
        return f"{fingerprints} {layout} {masks}"

    # -- trajectories in blocks -----------------------------------------------------------------------------------

    def start_blocks(self, parameters, x: np.ndarray, planned_steps: int = 0, **fields: np.ndarray) -> np.ndarray:
        """Return blocks, shape (blocks, rows * lanes), of trajectories at the start x, shape (trajectories, n).

        ``parameters`` has shape (p,), or (trajectories, p) if some differ; ``planned_steps`` decides on optimisation.
        """
        blocks = self.blocks_from_fields({"x": x, **fields}, parameters)
        first_parameters = np.ascontiguousarray(
            parameters if np.ndim(parameters) == 1 else parameters[0], dtype=np.float64
        )
        status = self.block_rows(blocks, "status")
        is_empty = status == StatusCode.EMPTY_LANE
        self._loops.loop_functions(0, planned_steps)[0](first_parameters.ctypes.data, blocks.ctypes.data, len(blocks))
        status[is_empty] = StatusCode.EMPTY_LANE
        return blocks

    def block_rows(self, blocks: np.ndarray, name: str | None = None) -> np.ndarray:
        """Return the rows of a field in blocks, as a view of shape (blocks, rows, lanes); all rows for no name."""
        rows = blocks.reshape(len(blocks), self.n_rows, self.lanes)
        return rows if name is None else rows[:, self.row_slice(name)]

    @property
    def n_rows(self) -> int:
        """Number of rows of a block."""
        return self._layout.n_rows

    def row_slice(self, name: str) -> slice:
        """Return the slice of the rows of a block that hold a field."""
        start = self._layout.first_rows[name]
        return slice(start, start + self._layout.row_counts[name])

    def field_shape(self, name: str) -> tuple[int, ...]:
        """Return the shape of a field of one trajectory."""
        return self._shapes.get(name, ())

    def blocks_from_fields(self, fields: dict[str, Any], parameters=None) -> np.ndarray:
        """Return blocks of trajectories with given fields and status 0; the other fields are undefined."""
        if self._is_per_trajectory.any() and "p" not in fields:
            fields = fields | {"p": parameters[:, self._is_per_trajectory]}
        n_trajectories = len(fields["x"])
        blocks = np.empty((-(-n_trajectories // self.lanes), self.n_rows, self.lanes))
        blocks[:, self.row_slice("status")] = 0.0
        for name, values in fields.items():
            blocks[:, self.row_slice(name)] = self._rows_to_lanes(np.reshape(values, (n_trajectories, -1)))
        return self._mark_empty_lanes(blocks, n_trajectories)

    def block_from_state(self, state: State) -> np.ndarray:
        """Return the block of a single trajectory with a given state."""
        block = np.zeros((1, self.n_rows))
        row = block[0]
        for (start, end, shape), value in zip(self._state_rows, state, strict=True):
            if shape:
                row[start:end].reshape(shape)[...] = value
            else:
                row[start] = value
        return block

    def state_from_block(self, blocks: np.ndarray) -> State:
        """Return the state of a single trajectory from its block."""
        row = blocks[0]
        return State(
            *(row[start:end].reshape(shape) if shape else row[start] for start, end, shape in self._state_rows)
        )

    def blocks_from_rows(self, rows: np.ndarray) -> np.ndarray:
        """Return blocks of trajectories from all their rows, shape (trajectories, rows)."""
        return self._mark_empty_lanes(np.ascontiguousarray(self._rows_to_lanes(rows)), len(rows))

    def _rows_to_lanes(self, rows: np.ndarray) -> np.ndarray:
        """Return rows, shape (trajectories, m), as blocks, shape (blocks, m, lanes), padded by the last trajectory."""
        n_blocks = -(-len(rows) // self.lanes)
        if n_empty := n_blocks * self.lanes - len(rows):
            rows = np.concatenate([rows, np.repeat(rows[-1:], n_empty, axis=0)])
        return rows.reshape(n_blocks, self.lanes, -1).swapaxes(1, 2)

    def _mark_empty_lanes(self, blocks: np.ndarray, n_trajectories: int) -> np.ndarray:
        """Set the status of the empty lanes of blocks, and return the blocks as (blocks, rows * lanes)."""
        n_used = n_trajectories - (len(blocks) - 1) * self.lanes
        blocks[-1, self._layout.first_rows["status"], n_used:] = StatusCode.EMPTY_LANE
        return blocks.reshape(len(blocks), -1)

    def read_fields(self, blocks: np.ndarray, names: Sequence[str] | None = None) -> dict[str, np.ndarray]:
        """Return fields of all lanes by name, lanes first, empty lanes included."""
        fields, n_lanes = {}, len(blocks) * self.lanes
        for name in self.field_names if names is None else names:
            values = self.block_rows(blocks, name).swapaxes(0, 1)
            fields[name] = values.reshape(-1, n_lanes).T.reshape(n_lanes, *self.field_shape(name))
        return fields

    def advance_blocks(
        self,
        parameters,
        blocks: np.ndarray,
        h: float | np.ndarray,
        n_saves: int,
        steps_per_save: int,
        noise=None,
        out=None,
    ) -> np.ndarray:
        """Take up to ``n_saves * steps_per_save`` steps of size h in blocks, in place; return the saved fields.

        h is one step size, or one for each lane, empty lanes included. ``noise`` holds the increments of a stochastic
        method, shape (trajectories, steps, increments).

        The result has shape (trajectories, n_saves, n_saved_values), including empty lanes, and is undefined after a
        failed step. It is written to ``out`` if that is given.
        """
        lanes, n_blocks, width = self.lanes, len(blocks), self.n_saved_values
        if "h" in self._layout.first_rows:
            self.block_rows(blocks, "h")[:, 0] = np.reshape(h, (-1, lanes)) if np.ndim(h) else h
        parameters = np.ascontiguousarray(parameters, dtype=np.float64)
        out = np.empty((n_blocks, n_saves, width * lanes)) if out is None else out
        steps_done = np.zeros(n_blocks, dtype=np.int64)
        n_saves, steps_per_save = int(n_saves), int(steps_per_save)
        arguments = [
            parameters.ctypes.data,
            blocks.ctypes.data,
            steps_done.ctypes.data,
            n_blocks,
            n_saves,
            steps_per_save,
        ]
        increments = self.noise_increments_by_lane_block(noise, n_blocks, n_saves * steps_per_save)
        arguments += [out.ctypes.data, n_saves * steps_per_save, increments.ctypes.data]
        newton_address = self.newton_address(is_needed=False)
        _, advance = self._loops.loop_functions(n_blocks * n_saves * steps_per_save)
        while advance(*arguments, newton_address) < n_blocks:
            newton_address = self.newton_address(is_needed=True)
        return (
            out.reshape(n_blocks, n_saves, width, lanes).transpose(0, 3, 1, 2).reshape(n_blocks * lanes, n_saves, width)
        )

    def saved_fields_of_single_trajectory(self, saved_rows: np.ndarray) -> dict[str, np.ndarray]:
        """Return the saved fields of a single trajectory by name, from rows of ``saved_rows``."""
        ends = np.cumsum([self._layout.row_counts[name] for name in self.saved_fields])
        arrays = np.split(saved_rows, ends[:-1], axis=-1)
        return {
            name: values.reshape(len(saved_rows), *self.field_shape(name))
            for name, values in zip(self.saved_fields, arrays, strict=True)
        }

    @property
    def n_saved_values(self) -> int:
        """Number of values of a trajectory at each save."""
        return sum(self._layout.row_counts[name] for name in self.saved_fields)

    def noise_increments_by_lane_block(self, noise: np.ndarray | None, n_blocks: int, n_steps: int) -> np.ndarray:
        """Return noise increments in the order of the loop, shape (blocks, steps, increments, lanes)."""
        n_increments = self._shapes["dW"][0]
        if not n_increments:
            return EMPTY_INCREMENTS
        if noise is None:
            return np.zeros((n_blocks, n_steps, n_increments, self.lanes))
        padded_noise = np.zeros((n_blocks * self.lanes, n_steps, n_increments))
        padded_noise[: len(noise)] = noise
        return np.ascontiguousarray(padded_noise.reshape(n_blocks, self.lanes, n_steps, -1).transpose(0, 2, 3, 1))

    # -- machine code -------------------------------------------------------------------------------------------------

    def loop_functions(self, n_steps: int, planned_steps: int = 0) -> tuple[Any, Any]:
        """Return the functions ``begin`` and ``advance`` of the loop, optimised if many steps are taken."""
        return self._loops.loop_functions(n_steps, planned_steps)

    def newton_address(self, is_needed: bool) -> int:
        """Return the address of Newton's method; 0 if it is not compiled yet and no step has needed it."""
        return self._compiled_newton_address() if is_needed or self._newton_code is not None else 0

    def _compiled_newton_address(self) -> int:
        """Return the address of Newton's method, compiled at the first call."""
        with self._lock, report_compiler_faults():
            if self._newton_code is None:
                self._shapes[NEWTON_BUFFER] = (self._layout.row_counts[NEWTON_BUFFER],)
                jaxpr = self._trace(self._solve_packed_newton, ("p", NEWTON_BUFFER))
                self._newton_code = MachineCode(
                    lambda: write_newton_solver(
                        self._scalarize(jaxpr), self._layout, self._is_per_trajectory, self.lanes
                    ),
                    key=self._cache_key(jaxpr),
                )
            return self._newton_code.function_address("solve")


MAX_CACHED_STEP_LOOPS = 128
"""Number of compiled step loops held in memory."""

_step_loop_cache: LRUCache[Any] = LRUCache(MAX_CACHED_STEP_LOOPS)


def cached_step_loop(
    structure: ProgramStructure,
    parameters: np.ndarray,
    method: OneStepMethod,
    control: StepControl | None = None,
    lanes: int = 1,
    is_per_trajectory: np.ndarray | None = None,
    options: SolverOptions = DEFAULT_OPTIONS,
) -> CompiledStepLoop:
    """Return the compiled step loop for a structure, a method and a step control, cached if possible.

    The cache key contains which parameters are zero: a diagonal matrix makes a shorter program.

    Parameters
    ----------
    parameters : array, shape (p,)
        Parameters of such a system, of the method, and of the step control: see :func:`flat_parameters`.
    """
    structures = [
        structure,
        ProgramStructure.from_module(method),
        *([] if control is None else [ProgramStructure.from_module(control)]),
    ]
    is_per_trajectory = np.zeros(len(parameters), dtype=bool) if is_per_trajectory is None else is_per_trajectory
    masks = ((parameters == 0.0) & ~is_per_trajectory).tobytes(), is_per_trajectory.tobytes()
    key = *((form.key, form.shapes) for form in structures), *masks, lanes, options
    return _step_loop_cache.get_or_compute(
        key, lambda: CompiledStepLoop(structures, parameters, method, control, lanes, is_per_trajectory, options)
    )
