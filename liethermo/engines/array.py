"""The array engine: any one-step method on any system, in JAX."""

from __future__ import annotations

import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from ..integrators import OneStepMethod
from ..integrators.fluctuating import driven_by
from ..systems import System
from ..tracing.programs import program
from .codes import UNTAKEN, Code
from .rules import RULES, Rules
from .stages import given_up
from .stepping import State, begin, first_state, in_order, take_step


@program
def advance(
    system: System,
    method: OneStepMethod,
    state: State,
    h,
    saves,
    every,
    capacity: int,
    rules: Rules = RULES,
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
    first, second = state.step if first is None else first, None if newton else given_up
    system, method, state, back = in_order(system, method, state, rules)

    def step(s: State) -> State:
        own = method if noise is None else driven_by(method, noise[s.step - first])
        return take_step(system, own, s, h, rules, second)

    def one_save(index, carry: tuple[State, tuple]):
        state, kept = carry
        target = first + (index + 1) * every

        def goes_on(s: State):
            return (s.status == Code.COMPLETED) & (s.step < target)

        state = jax.lax.while_loop(goes_on, step, state)
        saved = back(state).x, state.energy, state.entropy, state.status == Code.COMPLETED
        return state, jax.tree_util.tree_map(lambda all_of, one: all_of.at[index].set(one), kept, saved)

    one = state.x, state.energy, state.entropy, jnp.zeros((), bool)
    kept = tuple(jnp.zeros((capacity, *a.shape), a.dtype) for a in one)
    state, kept = jax.lax.fori_loop(0, saves, one_save, (state, kept))  # as many passes as saves, not as the capacity
    return back(state), kept


KEPT_STATES, KEPT_NUMBERS = 1024, 2**16
"""States that one call keeps at most, and their components: enough to hide the cost of a call, few enough to show
progress."""


def portion_of(system: System) -> int:
    """The states that one call keeps at most: one number for all runs of a system, so that one program serves them."""
    return min(KEPT_STATES, max(1, KEPT_NUMBERS // system.dim))


class OnDemand:
    """Calls of programs that take steps, without Newton's method until a step needs it: the call goes on from there.

    It is two thirds of what there is to compile.
    """

    def __init__(self, method: OneStepMethod):
        # Where there are no equations it makes no difference; a reference solver has none of its own.
        self.newton = not isinstance(method, OneStepMethod) or method.explicit

    def advance(self, call: Callable, state: State, every) -> tuple[State, tuple]:
        """The state after ``call(state, newton, first)``, that of one trajectory or of many, and what is kept."""
        first = state.step
        state, kept = call(state, self.newton, first)
        lacking = np.isin(state.status, UNTAKEN)
        if self.newton or not lacking.any():
            return state, kept
        self.newton = True
        done = np.arange(kept[-1].shape[-1]) < (np.asarray(state.step - first) // every)[..., None]
        state, more = call(state._replace(status=jnp.where(lacking, 0, state.status)), True, first)
        old = [done.reshape(*done.shape, *[1] * (a.ndim - done.ndim)) for a in kept]
        return state, tuple(jnp.where(where, a, b) for where, a, b in zip(old, kept, more, strict=True))

    def follow(self, call: Callable, pace):
        """The pace after ``call(pace, newton)``, of one trajectory or of many."""
        pace = call(pace, self.newton)
        if self.newton or not np.isin(pace.cause, UNTAKEN).any():
            return pace
        self.newton = True
        return call(pace, True)


class ArrayEngine:
    """The array engine for one system and method.

    Attributes
    ----------
    portion : int
        Saves that one call takes at most.
    """

    name = "array"

    def __init__(self, system: System, method: OneStepMethod, rules: Rules = RULES):
        self.system, self.method, self.rules = system, method, rules
        self.portion = portion_of(system)
        self._on_demand = OnDemand(method)

    def begin(self, x) -> State:
        """The state of a run about to start at x."""
        return begin(self.system, self.method, x)

    def advance(self, state: State, h, saves: int, every: int, noise=None):
        """Up to ``saves <= portion`` times ``every`` steps of size h: see :func:`advance`."""
        given = jnp.asarray(h), jnp.asarray(saves), jnp.asarray(every), self.portion, self.rules, rows(noise)
        return self._on_demand.advance(lambda s, *how: advance(self.system, self.method, s, *given, *how), state, every)

    def step(self, state: State, h, noise=None) -> State:
        """The state after one step, or as it was with the status of a failure."""
        return self.advance(state, h, 1, 1, noise)[0]

    def ends(self, x: np.ndarray, h: np.ndarray) -> np.ndarray:
        """Where steps of these sizes end that begin at these states, shape (m, n); NaN where one cannot be taken.

        Each is the first step of a run of its own.
        """
        found, block = np.empty_like(x), min(TOGETHER, self.portion)
        for first in range(0, len(x), block):
            some = np.minimum(np.arange(first, first + block), len(x) - 1)  # of one length, for one program
            ends = _ends(self.system, self.method, jnp.asarray(x[some]), jnp.asarray(h[some]), self.rules)
            found[some] = np.asarray(ends)
        return found


TOGETHER = 64
"""Steps from states of their own that one call takes."""


@program
def _ends(system: System, method: OneStepMethod, x, h, rules: Rules):
    def end(given):
        start, size = given
        after = take_step(system, method, first_state(system, method, start), size, rules)
        return jnp.where(after.status == Code.COMPLETED, after.x, jnp.nan)

    return jax.lax.map(end, (x, h))


def rows(noise) -> jax.Array | None:
    """Increments, shape (..., steps, increments), with as many steps as a power of two: few shapes, few programs.

    Short calls share one program: as many steps as :data:`KEPT_NUMBERS` increments are for cost nothing.
    """
    if noise is None:
        return None
    *members, steps, increments = noise.shape
    short = KEPT_NUMBERS // max(1, math.prod(members) * increments)
    missing = (1 << max(0, max(steps, short) - 1).bit_length()) - steps
    return jnp.asarray(np.pad(noise, [(0, 0)] * (noise.ndim - 2) + [(0, missing), (0, 0)]))
