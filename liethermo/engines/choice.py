"""Which engine runs a method on a system, and what takes over where it cannot."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from manifolds.errors import warn

from ..errors import InputError
from ..integrators import OneStepMethod
from ..systems import System
from ..tracing.scalarize import UnsupportedPrimitive
from .array import ArrayEngine
from .compiled.paced import LanePaces
from .compiled.stepper import CompiledEngine
from .paced import OnePace, SinglePaces
from .pacing import Pacing
from .sparse.newton import SparseEngine
from .stepping import State

ENGINES = ("auto", "array", "compiled", "sparse")

COMPILED_DIM = 40
"""Components up to which unrolled scalar code is a good idea."""

SMALL_PROGRAM = 30_000
"""Operations of a step up to which it is compiled in no more time than XLA takes, so that "auto" always takes it. On a
step of 8,000 operations XLA spends three times as long, on one of 28,000 as long."""

COMPILED_STEPS = 20_000
"""Steps from which it is worth compiling for some seconds more."""

SPARSE_DIM = 200
"""Components from which a system that knows its sparsity is solved by it."""


class Engine(Protocol):
    """Takes the steps of one method on one system."""

    name: str
    portion: int  # saves that one call takes at most

    def begin(self, x) -> State:
        """The state of a run about to start at x."""
        ...

    def advance(self, state: State, h, saves: int, every: int, noise=None) -> tuple[State, tuple]:
        """Up to ``saves <= portion`` times ``every`` steps of size h; stops where a step fails.

        Returns the new state and, for each save, the state vector, energy and entropy, and whether it was reached.
        ``noise`` has the increments that drive each step, an array of shape (steps, increments), where there are any.
        """
        ...

    def step(self, state: State, h, noise=None) -> State:
        """The state after one step, or as it was with the status of a failure."""
        ...

    def ends(self, x: np.ndarray, h: np.ndarray) -> np.ndarray:
        """Where steps of sizes h, shape (m,), end that begin at states x, shape (m, n); NaN where one cannot be taken.

        Each is the first step of a run of its own.
        """
        ...


class Noise(Protocol):
    """Where the increments of a trajectory come from."""

    def rows(self, first: int, steps: int, h) -> np.ndarray:
        """Those of so many steps of size h from a step on, shape (steps, increments)."""
        ...


class CompiledEngineWarning(UserWarning):
    """A system that the compiled engine cannot run, so that the array engine does."""


class Chosen:
    """The engine of a run, an :class:`Engine` itself: chosen when the run begins.

    Where "auto" has taken the compiled engine and it meets what it cannot unroll, at the start or where a step first
    needs Newton's method, the array engine goes on from the last good state, and says so.

    Parameters
    ----------
    asked : one of ENGINES
    steps : int
        How many are to be taken.
    noise : Noise, optional
        What drives the steps: those with the same number are driven by the same.
    """

    def __init__(self, system: System, method: OneStepMethod, asked: str, steps: int, noise: Noise | None = None):
        self.system, self.method, self.asked, self.steps, self.noise = system, method, asked, steps, noise
        self._engine: Engine = ArrayEngine(system, method)
        self._chosen = False

    @property
    def name(self) -> str:
        return self._engine.name

    @property
    def portion(self) -> int:
        return self._engine.portion

    def begin(self, x) -> State:
        self._choose(lambda compiled: compiled.operations)
        return self._attempt(lambda engine, _: engine.begin(x))

    def advance(self, state: State, h, saves: int, every: int) -> tuple[State, tuple]:
        noise = self._noise(state, int(saves) * int(every), h)
        return self._attempt(lambda engine, state: engine.advance(state, h, saves, every, noise), state)

    def step(self, state: State, h) -> State:
        noise = self._noise(state, 1, h)
        return self._attempt(lambda engine, state: engine.step(state, h, noise), state)

    def ends(self, x: np.ndarray, h: np.ndarray) -> np.ndarray:
        return self._attempt(lambda engine, _: engine.ends(x, h))

    def _noise(self, state: State, steps: int, h) -> np.ndarray | None:
        return None if self.noise is None else self.noise.rows(int(state.step), steps, h)

    def paces(self, pacing: Pacing, x, t: float, stop: float, length: float) -> OnePace:
        """The run with a pace, about to start at x at a time; see :func:`.pacing.begun`."""
        self._choose(lambda compiled: compiled.paced(pacing)[0].operations)
        if isinstance(self._engine, CompiledEngine):
            return _Compiled(self, self._engine, pacing, x, t, stop, length)
        return self._single(pacing).begin(x, t, stop, length)

    def _single(self, pacing: Pacing) -> SinglePaces:
        step = self._engine.step if self._engine.name == "sparse" else None
        return SinglePaces(self.system, self.method, pacing, step)

    def _choose(self, operations: Callable[[CompiledEngine], int]) -> None:
        """Choose an engine when the run begins; ``operations`` counts those of a step of the compiled one."""
        if not self._chosen:
            self._engine = self._choice(operations)
            self._chosen = True

    def _choice(self, operations: Callable[[CompiledEngine], int]) -> Engine:
        system, method, auto = self.system, self.method, self.asked == "auto"
        if self.asked == "sparse" and self.noise is not None:
            raise InputError("the sparse engine takes no steps with noise: leave out engine")
        if self.asked == "sparse" and method.explicit:
            raise InputError(
                f"{method} has no equations to solve, so the sparse engine is not for it: leave out engine"
            )
        if self.asked == "sparse" or (auto and system.dim >= SPARSE_DIM and not method.explicit and self.noise is None):
            if system.sparsity() is not None:
                return SparseEngine(system, method)
            if not auto:
                raise InputError(
                    f"the sparse engine cannot run a {system.kind} that does not know its sparsity: a "
                    "ComposedSystem of lt.Copies joined by lt.Each does"
                )
        long = self.steps >= COMPILED_STEPS or system.spectral
        if self.asked == "compiled" or (auto and is_small(system)):
            compiled = CompiledEngine(system, method, planned=self.steps)
            try:
                if operations(compiled) <= SMALL_PROGRAM or not auto or long:
                    return compiled
            except UnsupportedPrimitive as error:
                if not (auto and error.too_large):  # as little of a surprise as one that is too long to be worth it
                    self._fall_back(error)
        return ArrayEngine(system, method)

    def _attempt(self, call: Callable[[Engine, Any], Any], state: State | None = None) -> Any:
        """What an engine makes of a state; the array engine where the compiled one cannot."""
        try:
            return call(self._engine, state)
        except UnsupportedPrimitive as error:
            self._fall_back(error)
            if state is not None:
                like = self._engine.begin(jnp.asarray(state.x))
                state = jax.tree_util.tree_map(lambda a, b: jnp.asarray(a, b.dtype), state, like)
            return call(self._engine, state)

    def _fall_back(self, error: UnsupportedPrimitive) -> None:
        if self.asked != "auto":
            raise error
        warn_of_fallback(error)
        self._engine = ArrayEngine(self.system, self.method)


class _Compiled:
    """A compiled run with a pace, that the array engine takes over where it meets what cannot be unrolled."""

    def __init__(self, chosen: Chosen, engine: CompiledEngine, pacing: Pacing, x, t: float, stop: float, length: float):
        self._chosen, self._pacing, self._start = chosen, pacing, (x, t, stop, length)
        try:
            stepper, whole = engine.paced(pacing)
            x = np.asarray(x, dtype=np.float64)[None]
            self._paces: OnePace = LanePaces(stepper, whole, whole, x, t, stop, length)
        except UnsupportedPrimitive as error:
            self._take_over(error)

    def _take_over(self, error: UnsupportedPrimitive) -> None:
        self._chosen._fall_back(error)
        self._paces = self._chosen._single(self._pacing).begin(*self._start)

    def state(self) -> State:
        return self._paces.state()

    def attempts(self, most: int) -> dict[str, np.ndarray]:
        try:
            return self._paces.attempts(most)
        except UnsupportedPrimitive as error:
            before = self._paces
            self._take_over(error)
            assert isinstance(self._paces, SinglePaces)
            return self._paces.continued(before).attempts(most)

    def read(self, name: str, chosen: Any = slice(None)):
        return self._paces.read(name, chosen)

    def write(self, name: str, chosen, values) -> None:
        self._paces.write(name, chosen, values)


def is_small(system: System) -> bool:
    """Whether a system is worth trying to compile: unrolled code, on the CPU, for few components."""
    return system.unrollable and system.dim <= COMPILED_DIM and jax.default_backend() == "cpu"


def warn_of_fallback(error: UnsupportedPrimitive) -> None:
    """Say that the array engine takes over."""
    warn(f"{error}; the array engine runs it instead", CompiledEngineWarning)
