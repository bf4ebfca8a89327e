"""Which engine runs a method on a system, and what takes over where it cannot."""

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
from .array import ArrayEngine
from .codes import StatusCode
from .compiled.paced import CompiledAdaptiveRuns
from .compiled.stepper import CompiledEngine, FinalStateRunner
from .paced import AdaptiveRuns, ArrayAdaptiveRuns, resume_on_array_engine, start_one
from .pacing import StepControl
from .sparse.newton import SparseEngine
from .stepping import State

ENGINES = ("auto", "array", "compiled", "sparse")

MAX_COMPILED_DIM = 40
"""Components up to which unrolled scalar code is a good idea."""

MAX_AUTO_COMPILED_OPERATIONS = 30_000
"""Operations of a step up to which it is compiled in no more time than XLA takes, so that "auto" always takes it. On a
step of 8,000 operations XLA spends three times as long, on one of 28,000 as long."""

SLOW_COMPILE_OPERATIONS = 50_000
"""Operations from which it is said that compiling takes minutes: the time grows with their square."""

MIN_STEPS_TO_COMPILE = 20_000
"""Steps from which it is worth compiling for some seconds more."""

MIN_SPARSE_DIM = 200
"""Components from which a system that knows its sparsity is solved by it."""


SUBSTEP_COUNTS = (1, 2, 4, 8, 16)
"""Into how many steps a part of a step is divided, one number after another, until it can be taken."""


Engine: TypeAlias = ArrayEngine | CompiledEngine | SparseEngine
"""Takes the steps of one method on one system: see :class:`.array.ArrayEngine`."""


class CompiledEngineWarning(UserWarning):
    """A system that the compiled engine cannot run, so that the array engine does, or that it compiles for minutes."""


class EngineWithFallback:
    """The engine of a run, an :class:`Engine` itself: chosen when the run begins.

    With "auto", the array engine takes over where the compiled one meets what it cannot unroll, or fails: at the start,
    or where a step first needs Newton's method. It goes on from the last good state, and says so.

    Parameters
    ----------
    requested_engine : one of ENGINES
    planned_steps : int
        How many are to be taken.
    noise : function of (first, steps, h), optional
        The increments of so many steps of size h from a first one on, shape (steps, increments).
    """

    def __init__(self, system: System, method: OneStepMethod, asked: str, steps: int, noise: Callable | None = None):
        self.system, self.method, self.requested_engine, self.planned_steps, self.noise = (
            system,
            method,
            asked,
            steps,
            noise,
        )
        self._engine: Engine = ArrayEngine(system, method)
        self._is_engine_chosen = False

    @property
    def name(self) -> str:
        return self._engine.name

    @property
    def max_saves_per_call(self) -> int:
        return self._engine.max_saves_per_call

    def initial_run_state(self, x) -> State:
        self._choose_engine(lambda compiled: compiled.n_operations)
        return self._call_with_fallback(lambda engine, _: engine.initial_run_state(x))

    def final_state_runner(self) -> FinalStateRunner | None:
        """Return a runner that returns final states alone; None where the compiled engine does not run the system."""
        self._choose_engine(lambda compiled: compiled.n_operations)
        return self._engine.final_state_runner() if isinstance(self._engine, CompiledEngine) else None

    def advance(self, state: State, h, saves: int, every: int) -> tuple[State, tuple]:
        noise = self._noise_increments(state, int(saves) * int(every), h)
        return self._call_with_fallback(lambda engine, state: engine.advance(state, h, saves, every, noise), state)

    def step(self, state: State, h) -> State:
        noise = self._noise_increments(state, 1, h)
        return self._call_with_fallback(lambda engine, state: engine.step(state, h, noise), state)

    def partial_step(self, state: State, h: float) -> State:
        """Return the state after a part of a step that the run has taken whole, of size h.

        Where the part cannot be taken at once, it is divided. If that does not help either, the status says why.
        """
        for substeps in SUBSTEP_COUNTS:
            after = self.advance(state, h / substeps, 1, substeps)[0]
            if int(after.status) == StatusCode.COMPLETED:
                break
        return after

    def step_ends(self, x: np.ndarray, h: np.ndarray) -> np.ndarray:
        """Return where parts of steps end, of sizes h, that begin at states x, shape (m, n).

        Where a part cannot be taken at once, it is divided; NaN if that does not help either.
        """
        found = np.array(self._engine_step_ends(x, h))
        for substeps in SUBSTEP_COUNTS[1:]:
            missing = np.isnan(found).any(axis=1) & np.isfinite(x).all(axis=1)
            if not missing.any():
                break
            some, size = x[missing], h[missing] / substeps
            for _ in range(substeps):
                some = self._engine_step_ends(some, size)
            found[missing] = some
        return found

    def _engine_step_ends(self, x: np.ndarray, h: np.ndarray) -> np.ndarray:
        return self._call_with_fallback(lambda engine, _: engine.step_ends(x, h))

    def _noise_increments(self, state: State, steps: int, h) -> np.ndarray | None:
        return None if self.noise is None else self.noise(int(state.step), steps, h)

    def start_adaptive(self, pacing: StepControl, x, t: float, stop: float, length: float) -> AdaptiveRuns:
        """The run with a pace, about to start at x at a time; see :func:`.pacing.begun`."""
        self._choose_engine(lambda compiled: compiled.adaptive_step_loop(pacing)[0].n_operations)

        def start_on_engine(engine: Engine, _) -> AdaptiveRuns:
            if isinstance(engine, CompiledEngine):
                stepper, whole = engine.adaptive_step_loop(pacing)
                return CompiledAdaptiveRuns(
                    stepper, whole, whole, np.asarray(x, dtype=np.float64)[None], t, stop, length
                )
            step = engine.step if isinstance(engine, SparseEngine) else None
            return start_one(self.system, self.method, pacing, x, t, stop, length, step)

        return self._call_with_fallback(start_on_engine)

    def fall_back_adaptive(
        self, error: UnsupportedPrimitive, pacing: StepControl, paces: AdaptiveRuns
    ) -> ArrayAdaptiveRuns:
        """What goes on with a run with a pace, where the compiled engine meets what it cannot unroll."""
        self._fall_back(error)
        return resume_on_array_engine(self.system, self.method, pacing, paces)

    def _choose_engine(self, operations: Callable[[CompiledEngine], int]) -> None:
        """Choose an engine when the run begins; ``operations`` counts those of a step of the compiled one."""
        if not self._is_engine_chosen:
            self._engine = self._preferred_engine(operations)
            self._is_engine_chosen = True

    def _preferred_engine(self, operations: Callable[[CompiledEngine], int]) -> Engine:
        system, method, auto = self.system, self.method, self.requested_engine == "auto"
        if self.requested_engine == "sparse" and self.noise is not None:
            raise InputError("the sparse engine takes no steps with noise: leave out engine")
        if self.requested_engine == "sparse" and method.explicit:
            raise InputError(
                f"{method} has no equations to solve, so the sparse engine is not for it: leave out engine"
            )
        if self.requested_engine == "sparse" or (
            auto and system.dim >= MIN_SPARSE_DIM and not method.explicit and self.noise is None
        ):
            if system.sparsity_pattern() is not None:
                return SparseEngine(system, method)
            if not auto:
                raise InputError(
                    f"the sparse engine cannot run a {system.kind} that does not know its sparsity: a "
                    "ComposedSystem of lt.Copies joined by lt.Each does"
                )
        long = self.planned_steps >= MIN_STEPS_TO_COMPILE or system.has_matrix_functions
        if self.requested_engine == "compiled" or (auto and is_worth_compiling(system)):
            compiled = CompiledEngine(system, method, planned_steps=self.planned_steps)
            try:
                size = operations(compiled)
                if not auto and size > SLOW_COMPILE_OPERATIONS:
                    warn(
                        f"a step of {size:,} operations takes minutes to compile: leave out engine, or take "
                        "engine='array', to start at once",
                        CompiledEngineWarning,
                    )
                if size <= MAX_AUTO_COMPILED_OPERATIONS or not auto or long:
                    return compiled
            except UnsupportedPrimitive as error:
                if not (auto and error.too_large):  # as little of a surprise as one that is too long to be worth it
                    self._fall_back(error)
        return ArrayEngine(system, method)

    def _call_with_fallback(self, call: Callable[[Engine, Any], Any], state: State | None = None) -> Any:
        """What an engine makes of a state; the array engine where the compiled one cannot."""
        try:
            return call(self._engine, state)
        except UnsupportedPrimitive as error:
            self._fall_back(error)
            if state is not None:
                like = self._engine.initial_run_state(jnp.asarray(state.x))
                state = jax.tree_util.tree_map(lambda a, b: jnp.asarray(a, b.dtype), state, like)
            return call(self._engine, state)

    def _fall_back(self, error: UnsupportedPrimitive) -> None:
        if self.requested_engine != "auto":
            raise error
        warn_of_fallback(error)
        self._engine = ArrayEngine(self.system, self.method)


def is_worth_compiling(system: System) -> bool:
    """Whether a system is worth trying to compile: unrolled code, on the CPU, for few components."""
    return system.can_unroll and system.dim <= MAX_COMPILED_DIM and jax.default_backend() == "cpu"


def warn_of_fallback(error: UnsupportedPrimitive) -> None:
    """Say that the array engine takes over."""
    warn(f"{error}; the array engine runs it instead", CompiledEngineWarning)
