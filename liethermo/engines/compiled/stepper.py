"""The compiled engine: a user's plain functions as machine code, for small systems on the CPU.

The steps of the array engine, for one system and method, are traced, unrolled to scalar programs (:mod:`liethermo.
tracing.scalarize`) and placed in a loop over steps (:mod:`.loop`) that LLVM compiles. The system's parameters (the
arrays among its leaves) stay arguments: a sweep compiles once. Machine code is kept on disk, so that another process
finds it.
"""

from __future__ import annotations

import functools
import itertools
import math
import threading
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ...integrators import OneStepMethod
from ...integrators.fluctuating import noise_dimension, set_noise_increments
from ...systems import System
from ...tracing.caching import LRUCache
from ...tracing.calls import deferred_p
from ...tracing.scalarize import report_compiler_faults, scalarize
from ..array import max_saves_per_call
from ..pacing import (
    ATTEMPT_FIELDS,
    AdaptiveState,
    StepControl,
    attempt_step,
    initial_adaptive_state,
    jacobian_probe_shape,
)
from ..rules import DEFAULT_OPTIONS, SolverOptions
from ..searching import EMPTY_BRACKET
from ..stages import StageSolution, solve_newton
from ..stepping import State, initial_run_state, stage_equations, take_step
from .form import ProgramStructure, flat_parameters
from .loop import MAX_UNOPTIMISED_OPERATIONS, NEWTON_BUFFER, BlockLayout, CompiledLoops, NamedProgram, compile_step_loop
from .machine_code import MachineCode
from .newton import compile_newton_solver

STATE_FIELDS = State._fields
ADAPTIVE_FIELDS = tuple(name for name in AdaptiveState._fields if name != "state")
"""Those of a pace beside them."""
NEWTON_INPUTS = ("dW", "x", "compensation", "h", "k", "previous_slopes")
"""What it is given."""
NEWTON_OUTPUTS = ("converged", "is_finite", "residual", "newton_iterations", "slope_rounding", "k")
"""What Newton's method may make better of :class:`..stages.Solved`."""


class CompiledEngine:
    """The compiled engine for one system and method: its results are those of the array engine.

    Raises
    ------
    UnsupportedPrimitive
        If the system or the method uses what cannot be unrolled; of Newton's method, when a step first needs it.
    """

    name = "compiled"

    def __init__(
        self, system: System, method: OneStepMethod, rules: SolverOptions = DEFAULT_OPTIONS, planned_steps: int = 0
    ):
        self._parameters, self.max_saves_per_call, self._planned_steps = (
            flat_parameters(system, method),
            max_saves_per_call(system),
            planned_steps,
        )
        self._structure, self._method, self._options = ProgramStructure.from_module(system), method, rules

    @functools.cached_property
    def _step_loop(self) -> CompiledStepLoop:
        """Its loop of steps, made when it is first needed: a run with a pace has one of its own."""
        return cached_step_loop(self._structure, self._parameters, self._method, options=self._options)

    def adaptive_step_loop(self, pacing: StepControl) -> tuple[CompiledStepLoop, np.ndarray]:
        """The stepper of a run with a pace, and its parameters."""
        whole = np.append(self._parameters, flat_parameters(pacing))
        return cached_step_loop(self._structure, whole, self._method, pacing, options=self._options), whole

    @property
    def n_operations(self) -> int:
        """How many scalar operations a step takes."""
        return self._step_loop.n_operations

    def final_state_runner(self) -> FinalStateRunner:
        """Return a runner that returns final states alone, with buffers of its own; each thread needs one."""
        return FinalStateRunner(self._step_loop, self._parameters)

    def initial_run_state(self, x) -> State:
        return self._state_from_block(
            self._step_loop.start_blocks(self._parameters, np.asarray(x, dtype=np.float64)[None], self._planned_steps)
        )

    def advance(self, state: State, h, saves: int, every: int, noise=None):
        new, out = self._run(state, h, saves, every, noise)
        reached = np.arange(saves) < (int(new.step) - int(state.step)) // every
        return new, (out[:, :-2], out[:, -2], out[:, -1], reached)

    def step(self, state: State, h, noise=None) -> State:
        return self._run(state, h, 1, 1, noise)[0]

    def step_ends(self, x: np.ndarray, h: np.ndarray) -> np.ndarray:
        blocks = self._step_loop.start_blocks(self._parameters, x)
        self._step_loop.run(self._parameters, blocks, h, 1, 1)
        found = self._step_loop.read_fields(blocks, ("x", "status"))
        return np.where(found["status"].reshape(-1, 1) == 0.0, found["x"], np.nan)

    def _run(self, state: State, h, saves: int, every: int, noise) -> tuple[State, np.ndarray]:
        blocks = self._step_loop.block_from_state(state)
        out = self._step_loop.run(self._parameters, blocks, h, saves, every, None if noise is None else noise[None])[0]
        return self._state_from_block(blocks), out

    def _state_from_block(self, blocks: np.ndarray) -> State:
        return self._step_loop.state_from_block(blocks)


class FinalStateRunner:
    """Runs one trajectory at a time through a compiled loop of steps, in buffers that are allocated once.

    A call costs a few microseconds beside the steps. The buffers are written in place, so each thread needs a runner
    of its own.

    Parameters
    ----------
    step_loop : CompiledStepLoop
        A loop of one lane, with steps of given sizes.
    parameters : array, shape (p,)
        Parameters of the system and the method, one after another.
    """

    def __init__(self, step_loop: CompiledStepLoop, parameters: np.ndarray):
        self._loop, self._parameters = step_loop, np.ascontiguousarray(parameters, dtype=np.float64)
        self._block = step_loop.make_blocks({"x": np.zeros((1, *step_loop.field_shape("x")))})
        rows = step_loop.block_rows(self._block)[0, :, 0]
        self._x, self._status, self._h = (rows[step_loop.row_slice(name)] for name in ("x", "status", "h"))
        self._n_done, self._saved = np.zeros(1, dtype=np.int64), np.empty(step_loop.n_saved_values)
        arrays = self._parameters, self._block, self._n_done, self._saved, np.zeros(0)
        self._arrays, self._addresses = arrays, [array.ctypes.data for array in arrays]

    def run(self, x0: np.ndarray, segments: Sequence[tuple[float, int]]) -> tuple[np.ndarray, float]:
        """Take steps from a state, and return the last state, shape (n,), and its status code.

        Parameters
        ----------
        x0 : array, shape (n,)
        segments : sequence of (h, n_steps)
            Step sizes, and how many steps of each size follow one another.
        """
        parameters, block, n_done, saved, noise = self._addresses
        begin, advance = self._loop.machine_functions(sum(n_steps for _, n_steps in segments))
        self._status[0], self._x[:] = 0.0, x0
        begin(parameters, block, 1)
        newton = self._loop.newton_address(is_needed=False)
        for h, n_steps in segments:
            self._h[0], self._n_done[0] = h, 0
            while advance(parameters, block, n_done, 1, 1, n_steps, saved, n_steps, noise, newton) < 1:
                newton = self._loop.newton_address(is_needed=True)
            if self._status[0]:
                break
        return self._x.copy(), float(self._status[0])


class CompiledStepLoop:
    """The step loop of one method on systems of one form, compiled; parameters are arguments.

    With a pacing a step is an attempt, whose size the loop chooses.

    Parameters
    ----------
    forms : sequence of Form
        Of the system and of the method, and of the pacing where there is one.
    parameters : array, shape (p,)
        Those of one of each, one after another. Zeros among them hold for all, unless they vary.
    method : OneStepMethod
    pacing : Pacing or None
    lanes : int
        Trajectories that advance together, a block.
    varies : array of bool, shape (p,)
        Which parameters are each trajectory's own.

    Attributes
    ----------
    field_names : tuple of str
        The fields of a trajectory.
    initial_inputs, step_inputs : tuple of str
        The input of a run besides its x, and what a step is given besides the fields.
    saved_fields : tuple of str
        The fields that are written down at each save.
    """

    def __init__(
        self,
        forms: Sequence[ProgramStructure],
        parameters: np.ndarray,
        method: OneStepMethod,
        pacing: StepControl | None,
        lanes: int,
        varies: np.ndarray,
        rules: SolverOptions,
    ):
        self.lanes, self._options, self._is_per_trajectory = lanes, rules, varies
        self._constant_parameters = np.where((parameters == 0.0) & ~varies, 0.0, np.nan)
        self._lock = threading.Lock()
        self._newton_code: MachineCode | None = None
        self._structures = forms
        system = forms[0].build(parameters[: forms[0].n_parameters])
        n, slopes = system.dim, jax.eval_shape(lambda x: method.start(system, x), jnp.zeros(system.dim)).shape
        self._shapes: dict[str, tuple[int, ...]] = {"x": (n,), "compensation": (n,), "k": slopes, "p": parameters.shape}
        self._shapes |= {
            "previous_slopes": (0 if method.explicit else method.stages, slopes[1]),
            "dW": (noise_dimension(method),),
        }
        self.field_names: tuple[str, ...] = STATE_FIELDS if pacing is None else (*STATE_FIELDS, *ADAPTIVE_FIELDS)
        self.saved_fields = ("x", "energy", "entropy") if pacing is None else ATTEMPT_FIELDS
        self.initial_inputs = () if pacing is None else ("t", "stop_time", "length")
        self.step_inputs = ("p", "dW", "h") if pacing is None else ("p", "dW")
        if pacing is not None:
            self._shapes |= {
                "jacobian_probe": jacobian_probe_shape(system, method, pacing),
                "root_bracket": EMPTY_BRACKET.shape,
            }
        step = self._trace_program(self.fields_after_step, (*self.step_inputs, *self.field_names), self.field_names)
        if method.explicit:
            changing = [i for i, a in enumerate(step.arguments) if a not in ("p", "h")]
            step = step._replace(program=step.program.factor_constants(changing))
        begin = self._trace_program(self.initial_fields, ("p", "x", *self.initial_inputs), self.field_names)
        self._programs = {"step": step, "begin": begin}
        handed = (
            0
            if method.explicit
            else sum(math.prod(self.field_shape(name)) for name in (*NEWTON_OUTPUTS, *NEWTON_INPUTS))
        )
        names = (*self.field_names, *self.initial_inputs, *self.step_inputs[1:])
        shapes = {name: self.field_shape(name) for name in names} | {
            "p": (int(varies.sum()),),
            NEWTON_BUFFER: (handed,),
        }
        self._layout = BlockLayout(shapes)
        rows, sizes = self._layout.first_rows, self._layout.row_counts
        self._state_rows = [(rows[name], rows[name] + sizes[name], self.field_shape(name)) for name in STATE_FIELDS]
        state = [name for name in (*self.field_names, "h") if name in rows]
        make = functools.partial(
            compile_step_loop, self._programs, self._layout, state, varies, lanes, self.saved_fields
        )
        self._loops = CompiledLoops(make, lanes == 1 and self.n_operations <= MAX_UNOPTIMISED_OPERATIONS)

    # -- what is compiled -----------------------------------------------------------------------------------------

    def build_modules(self, p) -> list[Any]:
        """System and method, and pacing, with the parameters p."""
        ends = itertools.accumulate(form.n_parameters for form in self._structures)
        return [form.build(p[end - form.n_parameters : end]) for form, end in zip(self._structures, ends, strict=True)]

    def initial_fields(self, p, x, *times) -> tuple:
        """The fields of a run about to start at x."""
        system, method, *way = self.build_modules(p)
        if not way:
            return initial_run_state(system, method, x)
        pace = initial_adaptive_state(system, method, way[0], x, *times)
        return *pace.state, *pace[1:]

    def fields_after_step(self, p, dW, *given) -> tuple:
        """The fields after a step, or an attempt, from its size and those before, or these alone."""
        system, method, *way = self.build_modules(p)
        if not way:
            h, *fields = given
            return take_step(
                system, set_noise_increments(method, dW), State(*fields), h, self._options, self._newton_fallback(dW)
            )
        before = AdaptiveState(State(*given[: len(STATE_FIELDS)]), *given[len(STATE_FIELDS) :])
        pace = attempt_step(system, method, way[0], before, self._options, self._newton_fallback(dW))
        return *pace.state, *pace[1:]

    def _newton_fallback(self, dW) -> Callable:
        """Newton's method, for :func:`..stepping.take_step`: a program of its own, compiled when a step needs it."""

        def second(first: StageSolution, *given) -> StageSolution:
            handed = [1.0 * getattr(first, name) for name in NEWTON_OUTPUTS]
            found = deferred_p.bind(*handed, dW, *(jnp.asarray(a) for a in given), results=len(NEWTON_OUTPUTS))
            solved = first._replace(**dict(zip(NEWTON_OUTPUTS, found, strict=True)))
            return solved._replace(converged=solved.converged > 0.0, is_finite=solved.is_finite > 0.0)

        return second

    def _solve_packed_newton(self, p, handed) -> tuple:
        """What takes the place of what is handed over."""
        system, method, *_ = self.build_modules(p)
        shapes = [self.field_shape(name) for name in (*NEWTON_OUTPUTS, *NEWTON_INPUTS)]
        ends = itertools.accumulate(map(math.prod, shapes))
        parts = [handed[end - math.prod(shape) : end].reshape(shape) for end, shape in zip(ends, shapes, strict=True)]
        dW, x, compensation, h, k, before = parts[len(NEWTON_OUTPUTS) :]
        own = stage_equations(
            system, set_noise_increments(method, dW), x, compensation, h, k, before, self._options, jax.lax.map
        )
        found = solve_newton(own, self._options)
        return tuple(1.0 * getattr(found, name) for name in NEWTON_OUTPUTS)

    @property
    def n_operations(self) -> int:
        """Scalar operations of a step with one iteration."""
        return self._programs["step"].program.instruction_count

    def _trace_program(self, function: Callable, names: Sequence[str], results: Sequence[str] = ()) -> NamedProgram:
        shapes = [jax.ShapeDtypeStruct(self.field_shape(a), jnp.float64) for a in names]
        known = [self._constant_parameters if a == "p" else None for a in names]
        return NamedProgram(scalarize(jax.make_jaxpr(function)(*shapes), known), tuple(names), tuple(results))

    # -- trajectories in blocks -----------------------------------------------------------------------------------

    def start_blocks(self, parameters, x: np.ndarray, planned: int = 0, **fields: np.ndarray) -> np.ndarray:
        """Blocks, shape (blocks, rows * lanes), of trajectories about to start at x, shape (trajectories, n).

        ``parameters`` has shape (p,), or (trajectories, p) where some vary; so many steps are ``planned``.
        """
        blocks = self.make_blocks({"x": x, **fields}, parameters)
        first = np.ascontiguousarray(parameters if np.ndim(parameters) == 1 else parameters[0], dtype=np.float64)
        status = self.block_rows(blocks, "status")
        empty = status == EMPTY_LANE_STATUS
        self._loops.loop_functions(0, planned)[0](first.ctypes.data, blocks.ctypes.data, len(blocks))
        status[empty] = EMPTY_LANE_STATUS
        return blocks

    def block_rows(self, blocks: np.ndarray, name: str | None = None) -> np.ndarray:
        """A field of blocks, or all rows of them, shape (blocks, entries, lanes)."""
        whole = blocks.reshape(len(blocks), self.n_rows, self.lanes)
        return whole if name is None else whole[:, self.row_slice(name)]

    @property
    def n_rows(self) -> int:
        """How many rows a trajectory has."""
        return self._layout.n_rows

    def row_slice(self, name: str) -> slice:
        """Those of a field."""
        first = self._layout.first_rows[name]
        return slice(first, first + self._layout.row_counts[name])

    def field_shape(self, name: str) -> tuple[int, ...]:
        """The shape of a field of one trajectory."""
        return self._shapes.get(name, ())

    def make_blocks(self, fields: dict[str, Any], parameters=None) -> np.ndarray:
        """Blocks of trajectories with the given fields, trajectories first; nothing else is set but their status."""
        if self._is_per_trajectory.any() and "p" not in fields:
            fields = fields | {"p": parameters[:, self._is_per_trajectory]}
        number = len(fields["x"])
        whole = np.empty((-(-number // self.lanes), self.n_rows, self.lanes))
        whole[:, self.row_slice("status")] = 0.0
        for name, values in fields.items():
            whole[:, self.row_slice(name)] = self._rows_to_lanes(np.reshape(values, (number, -1)))
        return self._mark_empty_lanes(whole, number)

    def block_from_state(self, state: State) -> np.ndarray:
        """The only block of a trajectory by itself."""
        whole = np.zeros((1, self.n_rows))
        row = whole[0]
        for (first, end, shape), value in zip(self._state_rows, state, strict=True):
            if shape:
                row[first:end].reshape(shape)[...] = value
            else:
                row[first] = value
        return whole

    def state_from_block(self, blocks: np.ndarray) -> State:
        """The state in the only block of a trajectory by itself."""
        row = blocks[0]
        return State(
            *(row[first:end].reshape(shape) if shape else row[first] for first, end, shape in self._state_rows)
        )

    def blocks_from_rows(self, whole: np.ndarray) -> np.ndarray:
        """Blocks of trajectories from all their rows, shape (trajectories, rows)."""
        return self._mark_empty_lanes(np.ascontiguousarray(self._rows_to_lanes(whole)), len(whole))

    def _rows_to_lanes(self, rows: np.ndarray) -> np.ndarray:
        """Rows of trajectories, shape (trajectories, m), as (blocks, m, lanes); the last one fills empty lanes."""
        count = -(-len(rows) // self.lanes)
        if empty := count * self.lanes - len(rows):
            rows = np.concatenate([rows, np.repeat(rows[-1:], empty, axis=0)])
        return rows.reshape(count, self.lanes, -1).swapaxes(1, 2)

    def _mark_empty_lanes(self, whole: np.ndarray, number: int) -> np.ndarray:
        """Blocks, shape (blocks, rows, lanes), of so many trajectories, their empty lanes marked; each in one row."""
        used = number - (len(whole) - 1) * self.lanes
        whole[-1, self._layout.first_rows["status"], used:] = EMPTY_LANE_STATUS
        return whole.reshape(len(whole), -1)

    def read_fields(self, blocks: np.ndarray, names: Sequence[str] | None = None) -> dict[str, np.ndarray]:
        """Fields of trajectories, trajectories first, those of empty lanes among them."""
        found, number = {}, len(blocks) * self.lanes
        for name in self.field_names if names is None else names:
            values = self.block_rows(blocks, name).swapaxes(0, 1)
            found[name] = values.reshape(-1, number).T.reshape(number, *self.field_shape(name))
        return found

    def run(
        self, parameters, blocks: np.ndarray, h: float | np.ndarray, saves: int, every: int, noise=None, out=None
    ) -> np.ndarray:
        """Advance blocks in place by ``saves * every`` steps of size h, or less where steps fail.

        The size is one for all, or one for each lane, those of empty ones among them.
        ``noise`` has the increments, shape (trajectories, steps, increments), of a method that is driven by any.

        Returns, at each save, what is :attr:`kept` of every trajectory: shape (trajectories, saves, width), with those
        of empty lanes, and undefined after a failure. It is written to ``out``, if there is one.
        """
        lanes, count, width = self.lanes, len(blocks), self.n_saved_values
        if "h" in self._layout.first_rows:
            self.block_rows(blocks, "h")[:, 0] = np.reshape(h, (-1, lanes)) if np.ndim(h) else h
        parameters = np.ascontiguousarray(parameters, dtype=np.float64)
        out = np.empty((count, saves, width * lanes)) if out is None else out
        done = np.zeros(count, dtype=np.int64)
        saves, every = int(saves), int(every)
        arguments = [parameters.ctypes.data, blocks.ctypes.data, done.ctypes.data, count, saves, every]
        increments = self._noise_by_block(noise, count, saves * every)
        arguments += [out.ctypes.data, saves * every, increments.ctypes.data]
        solve = self.newton_address(is_needed=False)
        _, advance = self._loops.loop_functions(count * saves * every)
        while advance(*arguments, solve) < count:
            solve = self.newton_address(is_needed=True)
        return out.reshape(count, saves, width, lanes).transpose(0, 3, 1, 2).reshape(count * lanes, saves, width)

    def saved_fields_of_one(self, out: np.ndarray) -> dict[str, np.ndarray]:
        """By name what is kept of a trajectory that is a block by itself, from rows of ``out``."""
        ends = np.cumsum([self._layout.row_counts[name] for name in self.saved_fields])
        parts = np.split(out, ends[:-1], axis=-1)
        return {
            name: part.reshape(len(out), *self.field_shape(name))
            for name, part in zip(self.saved_fields, parts, strict=True)
        }

    @property
    def n_saved_values(self) -> int:
        """Numbers that are kept of a trajectory at each save."""
        return sum(self._layout.row_counts[name] for name in self.saved_fields)

    def _noise_by_block(self, noise: np.ndarray | None, count: int, steps: int) -> np.ndarray:
        """Increments as the loop reads them, shape (blocks, steps, increments, lanes)."""
        if noise is None or not self._shapes["dW"][0]:
            return np.zeros((count, steps, self._shapes["dW"][0], self.lanes))
        padded = np.zeros((count * self.lanes, steps, self._shapes["dW"][0]))
        padded[: len(noise)] = noise
        return np.ascontiguousarray(padded.reshape(count, self.lanes, steps, -1).transpose(0, 2, 3, 1))

    # -- machine code -------------------------------------------------------------------------------------------------

    def machine_functions(self, n_steps: int) -> Sequence[Callable]:
        """Return the functions ``begin`` and ``advance`` of the loop, optimised if many steps are taken in all."""
        return self._loops.loop_functions(n_steps)

    def newton_address(self, is_needed: bool) -> int:
        """Return the address of Newton's method; 0 if it is not compiled yet and no step has needed it."""
        return self._newton_address() if is_needed or self._newton_code is not None else 0

    def _newton_address(self) -> int:
        """The address of Newton's method, which is compiled when a step first needs it."""
        with self._lock, report_compiler_faults():
            if self._newton_code is None:
                self._shapes[NEWTON_BUFFER] = (self._layout.row_counts[NEWTON_BUFFER],)
                program = self._trace_program(self._solve_packed_newton, ("p", NEWTON_BUFFER)).program
                self._newton_code = compile_newton_solver(program, self._layout, self._is_per_trajectory, self.lanes)
            return self._newton_code.function_address("solve")


EMPTY_LANE_STATUS = 9.0
"""Status of a lane without a trajectory."""

MAX_CACHED_STEP_LOOPS = 128
"""Forms whose loops are held in memory."""

_step_loop_cache: LRUCache[Any] = LRUCache(MAX_CACHED_STEP_LOOPS)


def cached_step_loop(
    form: ProgramStructure,
    parameters: np.ndarray,
    method: OneStepMethod,
    pacing: StepControl | None = None,
    lanes: int = 1,
    varies: np.ndarray | None = None,
    options: SolverOptions = DEFAULT_OPTIONS,
) -> CompiledStepLoop:
    """The stepper for systems of a form, a method, and a pacing.

    Which of their parameters are zero belongs to it: a diagonal matrix makes a shorter program.

    Parameters
    ----------
    parameters : array, shape (p,)
        Of a system of that form, of the method, and of the pacing: see :func:`flat_parameters`.
    """
    forms = [
        form,
        ProgramStructure.from_module(method),
        *([] if pacing is None else [ProgramStructure.from_module(pacing)]),
    ]
    varies = np.zeros(len(parameters), dtype=bool) if varies is None else varies
    known = ((parameters == 0.0) & ~varies).tobytes(), varies.tobytes()
    key = *((form.key, form.shapes) for form in forms), *known, lanes, options
    return _step_loop_cache.get_or_compute(
        key, lambda: CompiledStepLoop(forms, parameters, method, pacing, lanes, varies, options)
    )
