"""The array engine: any one-step method on any system, in JAX."""

from __future__ import annotations

import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from ..integrators import OneStepMethod
from ..integrators.fluctuating import set_noise_increments
from ..systems import System
from ..tracing.programs import jit_program
from .codes import FAILED_STEP_CODES, StatusCode
from .rules import DEFAULT_OPTIONS, SolverOptions
from .stages import keep_fixed_point_result
from .stepping import State, initial_run_state, initial_run_state_program, reorder_components, take_step


@jit_program
def advance(
    system: System,
    method: OneStepMethod,
    state: State,
    h,
    saves,
    every,
    capacity: int,
    rules: SolverOptions = DEFAULT_OPTIONS,
    noise=None,
    newton: bool = True,
    first=None,
):
    """Up to ``saves <= capacity`` times ``every`` steps of size h; stops where a step fails.

    The three are arrays, so that one program serves all. Returns the new state and, for each of ``capacity`` saves, the
    state vector, energy and entropy, and whether it was reached. ``noise`` has the increments of each step, shape
    (steps, increments); steps without any where it is None. Without ``newton`` a step fails where fixed-point iteration
    does not solve its equations. A call that goes on with another is given the number of the first step of that: it
    takes the steps that are left, and keeps what is not kept.
    """
    first, second = state.step if first is None else first, None if newton else keep_fixed_point_result
    system, method, state, back = reorder_components(system, method, state, rules)

    def step(s: State) -> State:
        own = method if noise is None else set_noise_increments(method, noise[s.step - first])
        return take_step(system, own, s, h, rules, second)

    def one_save(index, carry: tuple[State, tuple]):
        state, kept = carry
        target = first + (index + 1) * every

        def goes_on(s: State):
            return (s.status == StatusCode.COMPLETED) & (s.step < target)

        state = jax.lax.while_loop(goes_on, step, state)
        saved = back(state).x, state.energy, state.entropy, state.status == StatusCode.COMPLETED
        return state, jax.tree_util.tree_map(lambda all_of, one: all_of.at[index].set(one), kept, saved)

    one = state.x, state.energy, state.entropy, jnp.zeros((), bool)
    kept = tuple(jnp.zeros((capacity, *a.shape), a.dtype) for a in one)
    state, kept = jax.lax.fori_loop(0, saves, one_save, (state, kept))  # as many passes as saves, not as the capacity
    return back(state), kept


MAX_SAVES_PER_CALL, MAX_SAVED_VALUES_PER_CALL = 1024, 2**16
"""States that one call keeps at most, and their components: enough to hide the cost of a call, few enough to show
progress."""


def max_saves_per_call(system: System) -> int:
    """The states that one call keeps at most: one number for all runs of a system, so that one program serves them."""
    return min(MAX_SAVES_PER_CALL, max(1, MAX_SAVED_VALUES_PER_CALL // system.dim))


class LazyNewton:
    """Calls of programs that take steps, without Newton's method until a step needs it: the call goes on from there.

    It is two thirds of what there is to compile.
    """

    def __init__(self, method: OneStepMethod):
        # Where there are no equations it makes no difference; a reference solver has none of its own.
        self.has_newton = not isinstance(method, OneStepMethod) or method.explicit

    def advance(self, call: Callable, state: State, every) -> tuple[State, tuple]:
        """The state after ``call(state, newton, first)``, that of one trajectory or of many, and what is kept."""
        first = state.step
        state, kept = call(state, self.has_newton, first)
        lacking = np.isin(state.status, FAILED_STEP_CODES)
        if self.has_newton or not lacking.any():
            return state, kept
        self.has_newton = True
        done = np.arange(kept[-1].shape[-1]) < (np.asarray(state.step - first) // every)[..., None]
        state, more = call(state._replace(status=jnp.where(lacking, 0, state.status)), True, first)
        old = [done.reshape(*done.shape, *[1] * (a.ndim - done.ndim)) for a in kept]
        return state, tuple(jnp.where(where, a, b) for where, a, b in zip(old, kept, more, strict=True))

    def advance_adaptive(self, call: Callable, pace):
        """The pace after ``call(pace, newton)``, of one trajectory or of many."""
        pace = call(pace, self.has_newton)
        if self.has_newton or not np.isin(pace.last_attempt_status, FAILED_STEP_CODES).any():
            return pace
        self.has_newton = True
        return call(pace, True)


class ArrayEngine:
    """The array engine for one system and method.

    Attributes
    ----------
    max_saves_per_call : int
        Saves that one call takes at most.
    """

    name = "array"

    def __init__(self, system: System, method: OneStepMethod, options: SolverOptions = DEFAULT_OPTIONS):
        self.system, self.method, self.options = system, method, options
        self.max_saves_per_call = max_saves_per_call(system)
        self._lazy_newton = LazyNewton(method)

    def initial_run_state(self, x) -> State:
        """The state of a run about to start at x."""
        return initial_run_state_program(self.system, self.method, x)

    def advance(self, state: State, h, saves: int, every: int, noise=None):
        """Up to ``saves <= portion`` times ``every`` steps of size h: see :func:`advance`."""
        given = (
            jnp.asarray(h),
            jnp.asarray(saves),
            jnp.asarray(every),
            self.max_saves_per_call,
            self.options,
            padded_increments(noise),
        )
        return self._lazy_newton.advance(
            lambda s, *how: advance(self.system, self.method, s, *given, *how), state, every
        )

    def step(self, state: State, h, noise=None) -> State:
        """The state after one step, or as it was with the status of a failure."""
        return self.advance(state, h, 1, 1, noise)[0]

    def step_ends(self, x: np.ndarray, h: np.ndarray) -> np.ndarray:
        """Where steps of these sizes end that begin at these states, shape (m, n); NaN where one cannot be taken.

        Each is the first step of a run of its own.
        """
        found, block = np.empty_like(x), min(STEP_ENDS_PER_CALL, self.max_saves_per_call)
        for first in range(0, len(x), block):
            some = np.minimum(np.arange(first, first + block), len(x) - 1)  # of one length, for one program
            ends = _step_ends_program(
                self.system, self.method, jnp.asarray(x[some]), jnp.asarray(h[some]), self.options
            )
            found[some] = np.asarray(ends)
        return found


STEP_ENDS_PER_CALL = 64
"""Steps from states of their own that one call takes."""


@jit_program
def _step_ends_program(system: System, method: OneStepMethod, x, h, rules: SolverOptions):
    def end(given):
        start, size = given
        after = take_step(system, method, initial_run_state(system, method, start), size, rules)
        return jnp.where(after.status == StatusCode.COMPLETED, after.x, jnp.nan)

    return jax.lax.map(end, (x, h))


def padded_increments(noise) -> jax.Array | None:
    """Increments, shape (..., steps, increments), with as many steps as a power of two: few shapes, few programs.

    Short calls share one program: as many steps as :data:`MAX_SAVED_VALUES_PER_CALL` increments are for cost nothing.
    """
    if noise is None:
        return None
    *members, steps, increments = noise.shape
    short = MAX_SAVED_VALUES_PER_CALL // max(1, math.prod(members) * increments)
    missing = (1 << max(0, max(steps, short) - 1).bit_length()) - steps
    return jnp.asarray(np.pad(noise, [(0, 0)] * (noise.ndim - 2) + [(0, missing), (0, 0)]))
