"""Choice of the engine that runs a method on a system, and the fallback if it cannot."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np

from manifolds.errors import warn

from ..errors import InputError
from ..integrators import OneStepMethod
from ..systems import System
from ..tracing.scalarize import UnsupportedPrimitive
from .adaptive_runs import AdaptiveRuns, ArrayAdaptiveRuns, resume_on_array_engine, start_adaptive_run
from .array_engine import ArrayEngine, EngineTrajectory
from .compiled.engine import CompiledAdaptiveRuns, CompiledEngine, CompiledTrajectory
from .sparse_engine import SparseEngine
from .step import SavedStates, State
from .step_control import StepControl

ENGINES = ("auto", "array", "compiled", "sparse")
"""Values of the option ``engine``."""

MAX_COMPILED_DIM = 40
"""Largest dimension for which the compiled engine, with its unrolled scalar code, is considered."""

MAX_AUTO_COMPILED_OPERATIONS = 30_000
"""Largest number of operations of a step for which "auto" always compiles it, in no more time than XLA takes.

On a step of 8,000 operations XLA spends three times as long, on one of 28,000 as long.
"""

SLOW_COMPILE_OPERATIONS = 50_000
"""Number of operations above which the user is warned that compiling takes minutes: the time grows quadratically."""

MIN_STEPS_TO_COMPILE = 20_000
"""Number of planned steps from which a compilation of some seconds pays off."""

MIN_SPARSE_DIM = 200
"""Smallest dimension for which "auto" picks the sparse engine for a system with a known sparsity pattern."""


SUBSTEP_COUNTS = (2, 4, 8, 16)
"""Numbers of substeps into which a partial step is divided, tried in this order until it succeeds."""


Engine: TypeAlias = ArrayEngine | CompiledEngine | SparseEngine
"""An engine takes the steps of one method on one system: see :class:`.array_engine.ArrayEngine`."""


class CompiledEngineWarning(UserWarning):
    """Warning that the array engine replaces the compiled engine, or that compiling takes minutes."""


class EngineWithFallback:
    """The engine of a run, chosen at its start, with the array engine as a fallback; see :class:`Engine`.

    With "auto", the array engine takes over if the compiled engine meets a primitive that it cannot unroll, or fails:
    at the start, or when a step first needs Newton's method. The run resumes from the last good state, with a warning.

    Parameters
    ----------
    requested_engine : one of ENGINES
    planned_steps : int
        Number of steps that the run will take.
    noise : function of (first, steps, h), optional
        Returns the increments of ``steps`` steps of size h from step ``first`` on, shape (steps, increments).

    Attributes
    ----------
    has_fallen_back : bool
        Whether the array engine has taken over.
    """

    def __init__(
        self,
        system: System,
        method: OneStepMethod,
        requested_engine: str,
        planned_steps: int,
        noise: Callable | None = None,
    ):
        self.system = system
        self.method = method
        self.requested_engine = requested_engine
        self.planned_steps = planned_steps
        self.noise = noise
        self._engine: Engine = ArrayEngine(system, method)
        self._is_engine_chosen = False
        self.has_fallen_back = False

    @property
    def name(self) -> str:
        """Name of the engine that runs."""
        return self._engine.name

    @property
    def max_saves_per_call(self) -> int:
        """Largest number of states that one call saves."""
        return self._engine.max_saves_per_call

    def initial_run_state(self, x) -> State:
        """Return the state of a run that starts at x, shape (n,), after choosing the engine."""
        self._choose_engine(lambda compiled: compiled.n_operations_per_step)
        return self._call_with_fallback(lambda engine, _: engine.initial_run_state(x))

    def start(self, x) -> TrajectoryWithFallback:
        """Return a trajectory that starts at x, shape (n,); a trajectory started before becomes invalid."""
        self._choose_engine(lambda compiled: compiled.n_operations_per_step)
        return TrajectoryWithFallback(self, self._call_with_fallback(lambda engine, _: engine.start(x)))

    def compiled_trajectory(self, is_new: bool = False) -> CompiledTrajectory | None:
        """Return the trajectory of the compiled engine, a new one if ``is_new``; None if another engine was chosen."""
        self._choose_engine(lambda compiled: compiled.n_operations_per_step)
        if not isinstance(self._engine, CompiledEngine):
            return None
        return self._engine.new_trajectory() if is_new else self._engine.trajectory

    def advance_trajectory(
        self, trajectory: CompiledTrajectory | EngineTrajectory, h: float, n_saves: int, steps_per_save: int
    ) -> tuple[CompiledTrajectory | EngineTrajectory, SavedStates]:
        """Return a trajectory after steps, or its replacement on the array engine, and the saved states."""
        noise = None if self.noise is None else self._noise_increments(trajectory.state, n_saves * steps_per_save, h)
        try:
            return trajectory, trajectory.advance(h, n_saves, steps_per_save, noise)
        except UnsupportedPrimitive as error:
            self._fall_back(error)
            trajectory = EngineTrajectory(self._engine, self._to_array_state(trajectory.state))
            return trajectory, trajectory.advance(h, n_saves, steps_per_save, noise)

    def advance(self, state: State, h, n_saves: int, save_every: int) -> tuple[State, tuple]:
        """Return the state after up to ``n_saves`` times ``save_every`` steps, and the saved arrays."""
        noise = self._noise_increments(state, int(n_saves) * int(save_every), h)
        return self._call_with_fallback(
            lambda engine, state: engine.advance(state, h, n_saves, save_every, noise), state
        )

    def step(self, state: State, h) -> State:
        """Return the state after one step of size h, or the old state with a failure status."""
        noise = self._noise_increments(state, 1, h)
        return self._call_with_fallback(lambda engine, state: engine.step(state, h, noise), state)

    def step_ends(self, x: np.ndarray, h: np.ndarray) -> np.ndarray:
        """Return the end states, shape (m, n), of partial steps of sizes h from states x.

        A partial step that fails is divided into substeps; the result is NaN if they fail too.
        """
        ends = np.array(self._engine_step_ends(x, h))
        for substeps in SUBSTEP_COUNTS:
            is_missing = np.isnan(ends).any(axis=1) & np.isfinite(x).all(axis=1)
            if not is_missing.any():
                break
            x_sub, substep_size = x[is_missing], h[is_missing] / substeps
            for _ in range(substeps):
                x_sub = self._engine_step_ends(x_sub, substep_size)
            ends[is_missing] = x_sub
        return ends

    def _engine_step_ends(self, x: np.ndarray, h: np.ndarray) -> np.ndarray:
        """Return the states, shape (m, n), after one step from each state of x; NaN if a step fails."""
        return self._call_with_fallback(lambda engine, _: engine.step_ends(x, h))

    def _noise_increments(self, state: State, n_steps: int, h) -> np.ndarray | None:
        """Return the noise increments of the next steps, shape (steps, increments); None without noise."""
        return None if self.noise is None else self.noise(int(state.step), n_steps, h)

    def start_adaptive(self, control: StepControl, x, t: float, stop_time: float, span_length: float) -> AdaptiveRuns:
        """Return an adaptive run from x at time t, on the engine that is chosen for it."""
        self._choose_engine(lambda compiled: compiled.adaptive_step_loop(control)[0].n_operations_per_step)

        def start_on_engine(engine: Engine, _) -> AdaptiveRuns:
            if isinstance(engine, CompiledEngine):
                step_loop, parameters = engine.adaptive_step_loop(control)
                return CompiledAdaptiveRuns(
                    step_loop, parameters, parameters, np.asarray(x, dtype=np.float64)[None], t, stop_time, span_length
                )
            step = engine.step if isinstance(engine, SparseEngine) else None
            return start_adaptive_run(self.system, self.method, control, x, t, stop_time, span_length, step)

        return self._call_with_fallback(start_on_engine)

    def resume_adaptive_on_array_engine(
        self, error: UnsupportedPrimitive, control: StepControl, adaptive_runs: AdaptiveRuns
    ) -> ArrayAdaptiveRuns:
        """Return an adaptive run resumed on the array engine, because the compiled engine met a primitive it lacks."""
        self._fall_back(error)
        return resume_on_array_engine(self.system, self.method, control, adaptive_runs)

    def _choose_engine(self, count_operations: Callable[[CompiledEngine], int]) -> None:
        """Choose the engine at the first call; ``count_operations`` counts the operations of a compiled step."""
        if not self._is_engine_chosen:
            self._engine = self._preferred_engine(count_operations)
            self._is_engine_chosen = True

    def _preferred_engine(self, count_operations: Callable[[CompiledEngine], int]) -> Engine:
        """Return the engine that suits the system, the method and the user's request."""
        system, method, is_auto = self.system, self.method, self.requested_engine == "auto"
        if self.requested_engine == "sparse" and self.noise is not None:
            raise InputError("the sparse engine cannot take steps with noise. Leave out engine=")
        if self.requested_engine == "sparse" and method.explicit:
            raise InputError(f"the sparse engine needs an implicit method, got {method}. Leave out engine=")
        if self.requested_engine == "sparse" or (
            is_auto and system.dim >= MIN_SPARSE_DIM and not method.explicit and self.noise is None
        ):
            if system.sparse_newton.find_pattern() is not None:
                return SparseEngine(system, method)
            if not is_auto:
                raise InputError(
                    f"the sparse engine cannot run a {system.kind} that does not know its sparsity. Build the system "
                    "as a ComposedSystem of lt.Copies joined by lt.Each"
                )
        repays_compiling = self.planned_steps >= MIN_STEPS_TO_COMPILE or system.engine_hints.has_matrix_functions
        if self.requested_engine == "compiled" or (is_auto and is_worth_compiling(system, method)):
            compiled = CompiledEngine(system, method, planned_steps=self.planned_steps)
            try:
                n_operations_per_step = count_operations(compiled)
                if not is_auto and n_operations_per_step > SLOW_COMPILE_OPERATIONS:
                    warn(
                        f"a step of {n_operations_per_step:,} operations takes minutes to compile. Leave out engine=, "
                        "or take engine='array', to start at once",
                        CompiledEngineWarning,
                    )
                if n_operations_per_step <= MAX_AUTO_COMPILED_OPERATIONS or not is_auto or repays_compiling:
                    return compiled
            except UnsupportedPrimitive as error:
                if not (is_auto and error.too_large):  # no warning: a program that is too large is expected with auto
                    self._fall_back(error)
        return ArrayEngine(system, method)

    def _call_with_fallback(self, call: Callable[[Engine, Any], Any], state: State | None = None) -> Any:
        """Return ``call(engine, state)``, repeated on the array engine if the compiled one lacks a primitive."""
        try:
            return call(self._engine, state)
        except UnsupportedPrimitive as error:
            self._fall_back(error)
            return call(self._engine, None if state is None else self._to_array_state(state))

    def _to_array_state(self, state: State) -> State:
        """Return a state of the compiled engine converted to one of the array engine."""
        template = self._engine.initial_run_state(jnp.asarray(state.x))
        return jax.tree_util.tree_map(lambda a, b: jnp.asarray(a, b.dtype), state, template)

    def _fall_back(self, error: UnsupportedPrimitive) -> None:
        """Replace the engine by the array engine with a warning; raise the error if the user asked for an engine."""
        if self.requested_engine != "auto":
            raise error
        warn_of_fallback(error)
        self.has_fallen_back = True
        self._engine = ArrayEngine(self.system, self.method)


class TrajectoryWithFallback:
    """One trajectory of a run, continued on the array engine if the compiled engine cannot continue it."""

    def __init__(self, engine: EngineWithFallback, trajectory: CompiledTrajectory | EngineTrajectory):
        self._engine, self._trajectory = engine, trajectory

    def advance(self, h: float, n_saves: int, steps_per_save: int, noise: None = None) -> SavedStates:
        """Take ``n_saves * steps_per_save`` steps of size h, fewer if one fails, and return the saved states.

        The engine has the noise itself.
        """
        self._trajectory, saved_states = self._engine.advance_trajectory(self._trajectory, h, n_saves, steps_per_save)
        return saved_states

    def read(self, name: str) -> float:
        """Return a scalar field of the state reached so far, such as ``"energy"``."""
        return self._trajectory.read(name)

    @property
    def state(self) -> State:
        """The state reached so far."""
        return self._trajectory.state


def is_worth_compiling(system: System, method: OneStepMethod) -> bool:
    """Return whether compiling a step may pay off: it is unrollable, of few components, and on the CPU."""
    engine_hints = system.engine_hints
    can_unroll = engine_hints.can_unroll and (method.explicit or engine_hints.can_unroll_newton)
    return can_unroll and system.dim <= MAX_COMPILED_DIM and jax.default_backend() == "cpu"


def warn_of_fallback(error: UnsupportedPrimitive) -> None:
    """Warn that the array engine runs the system instead of the compiled engine."""
    warn(f"{error}; the array engine runs it instead", CompiledEngineWarning)
