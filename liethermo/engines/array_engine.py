"""Array engine: any one-step method on any system, in JAX."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np

from ..integrators import OneStepMethod
from ..integrators.fluctuating import with_noise_increments
from ..systems import System
from ..tracing.programs import jit_cached
from .solver_options import DEFAULT_OPTIONS, SolverOptions
from .stage_solver import keep_fixed_point_result
from .status_codes import FAILED_STEP_CODES, StatusCode
from .step import SavedStates, State, initial_run_state, initial_run_state_program, reorder_components, take_step


@jit_cached
def take_steps_and_save(
    system: System,
    method: OneStepMethod,
    state: State,
    h,
    n_saves,
    save_every,
    capacity: int,
    options: SolverOptions = DEFAULT_OPTIONS,
    noise=None,
    with_newton: bool = True,
    first_step=None,
):
    """Take ``save_every`` steps of size h, save the state, and repeat this ``n_saves`` times unless a step fails.

    ``h``, ``n_saves <= capacity`` and ``save_every`` are arrays, so one program serves all values. Returns the new
    state and four arrays with ``capacity`` rows: state vectors, energies, entropies, and whether the save was reached.
    ``noise`` has the increments of each step, shape (steps, increments), or is None. Without ``with_newton`` a step
    fails if fixed-point iteration does not solve its equations. A call that continues another one passes its
    ``first_step``, the number of the first step of that call: it takes the remaining steps and fills the remaining
    saves.
    """
    first_step = state.step if first_step is None else first_step
    newton_fallback = None if with_newton else keep_fixed_point_result
    system, method, state, restore_order = reorder_components(system, method, state, options)

    def step(s: State) -> State:
        driven_method = method if noise is None else with_noise_increments(method, noise[s.step - first_step])
        return take_step(system, driven_method, s, h, options, newton_fallback)

    def advance_to_save(index, carry: tuple[State, tuple]):
        state, saved_arrays = carry
        target_step = first_step + (index + 1) * save_every

        def should_continue(s: State):
            return (s.status == StatusCode.COMPLETED) & (s.step < target_step)

        state = jax.lax.while_loop(should_continue, step, state)
        values = restore_order(state).x, state.energy, state.entropy, state.status == StatusCode.COMPLETED
        return state, jax.tree_util.tree_map(lambda array, one: array.at[index].set(one), saved_arrays, values)

    initial_values = state.x, state.energy, state.entropy, jnp.zeros((), bool)
    saved_arrays = tuple(jnp.zeros((capacity, *a.shape), a.dtype) for a in initial_values)
    # saves passes, not capacity passes
    state, saved_arrays = jax.lax.fori_loop(0, n_saves, advance_to_save, (state, saved_arrays))
    return restore_order(state), saved_arrays


MAX_SAVES_PER_CALL = 1024
"""Largest number of states that one call saves: enough to hide the cost of a call, few enough to show progress."""

MAX_SAVED_VALUES_PER_CALL = 2**16
"""Largest number of components in all states that one call saves, which bounds its memory and its duration."""


def max_saves_per_call(system: System) -> int:
    """Return the largest number of states that one call saves, the same for all runs, which so share a program."""
    return min(MAX_SAVES_PER_CALL, max(1, MAX_SAVED_VALUES_PER_CALL // system.dim))


class LazyNewton:
    """Compiler of steps that leaves Newton's method out of the program until a step does not converge.

    The call resumes at the failed step. Newton's method is two thirds of what there is to compile.
    """

    def __init__(self, method: OneStepMethod):
        # Explicit methods have no equations, and a reference solver does not use Newton's method of this package.
        self.has_newton = not isinstance(method, OneStepMethod) or method.explicit

    def advance_fixed_steps(self, call: Callable, state: State, save_every) -> tuple[State, tuple]:
        """Return ``call(state, with_newton, first_step)``, repeated with Newton's method if a step needs it."""
        first_step = state.step
        state, saved_arrays = call(state, self.has_newton, first_step)
        needs_newton = np.isin(state.status, FAILED_STEP_CODES)
        if self.has_newton or not needs_newton.any():
            return state, saved_arrays
        self.has_newton = True
        is_saved = (
            np.arange(saved_arrays[-1].shape[-1]) < (np.asarray(state.step - first_step) // save_every)[..., None]
        )
        state, later_arrays = call(state._replace(status=jnp.where(needs_newton, 0, state.status)), True, first_step)
        masks = [is_saved.reshape(*is_saved.shape, *[1] * (a.ndim - is_saved.ndim)) for a in saved_arrays]
        return state, tuple(jnp.where(mask, a, b) for mask, a, b in zip(masks, saved_arrays, later_arrays, strict=True))

    def advance_adaptive(self, call: Callable, adaptive_state):
        """Return ``call(adaptive_state, with_newton)``, repeated with Newton's method if a step needs it."""
        adaptive_state = call(adaptive_state, self.has_newton)
        if self.has_newton or not np.isin(adaptive_state.last_attempt_status, FAILED_STEP_CODES).any():
            return adaptive_state
        self.has_newton = True
        return call(adaptive_state, True)


class ArrayEngine:
    """The array engine, which runs compiled JAX programs, for one system and method.

    Attributes
    ----------
    max_saves_per_call : int
        Largest number of saves in one call of :meth:`advance`.
    """

    name = "array"

    def __init__(self, system: System, method: OneStepMethod, options: SolverOptions = DEFAULT_OPTIONS):
        self.system, self.method, self.options = system, method, options
        self.max_saves_per_call = max_saves_per_call(system)
        self._lazy_newton = LazyNewton(method)

    def initial_run_state(self, x) -> State:
        """Return the state of a run that starts at x."""
        return initial_run_state_program(self.system, self.method, x)

    def advance(self, state: State, h, n_saves: int, save_every: int, noise=None):
        """Take ``n_saves`` times ``save_every`` steps, and return state and saves: see :func:`take_steps_and_save`."""
        arguments = (
            jnp.asarray(h),
            jnp.asarray(n_saves),
            jnp.asarray(save_every),
            self.max_saves_per_call,
            self.options,
            pad_noise_increments(noise),
        )
        return self._lazy_newton.advance_fixed_steps(
            lambda s, *how: take_steps_and_save(self.system, self.method, s, *arguments, *how), state, save_every
        )

    def start(self, x) -> EngineTrajectory:
        """Return a trajectory that starts at x."""
        return EngineTrajectory(self, self.initial_run_state(x))

    def step(self, state: State, h, noise=None) -> State:
        """Return the state after one step, or the old state with a failure status."""
        return self.advance(state, h, 1, 1, noise)[0]

    def step_ends(self, x: np.ndarray, h: np.ndarray) -> np.ndarray:
        """Return the states, shape (m, n), after one step of size h from each state of x; NaN if a step fails.

        Each is the first step of a run of its own.
        """
        ends, block = np.empty_like(x), min(STEP_ENDS_PER_CALL, self.max_saves_per_call)
        for start in range(0, len(x), block):
            # always of the same length, for one program
            indices = np.minimum(np.arange(start, start + block), len(x) - 1)
            block_ends = _step_ends_program(
                self.system, self.method, jnp.asarray(x[indices]), jnp.asarray(h[indices]), self.options
            )
            ends[indices] = np.asarray(block_ends)
        return ends


class EngineTrajectory:
    """One trajectory of an engine whose steps map a state to a new one.

    Attributes
    ----------
    state : State
        The state reached so far.
    """

    def __init__(self, engine, state: State):
        self._engine, self.state = engine, state

    def read(self, name: str) -> float:
        """Return a scalar field of the state reached so far."""
        return float(getattr(self.state, name))

    def advance(self, h: float, n_saves: int, steps_per_save: int, noise=None) -> SavedStates:
        """Take ``n_saves * steps_per_save`` steps of size h, fewer if one fails, and return the saved states."""
        self.state, (x, energy, entropy, is_reached) = self._engine.advance(
            self.state, h, n_saves, steps_per_save, noise
        )
        n_reached = int(np.asarray(is_reached).sum())
        return SavedStates(np.asarray(x)[:n_reached], np.stack([energy, entropy], axis=-1)[:n_reached])


STEP_ENDS_PER_CALL = 64
"""Number of single steps in one call of ``ArrayEngine.step_ends``."""


@jit_cached
def _step_ends_program(system: System, method: OneStepMethod, x, h, options: SolverOptions):
    """Return the states after one step from each state of x, NaN for failed steps, in one program."""

    def end_of_step(inputs):
        x_start, step_size = inputs
        new_state = take_step(system, method, initial_run_state(system, method, x_start), step_size, options)
        return jnp.where(new_state.status == StatusCode.COMPLETED, new_state.x, jnp.nan)

    return jax.lax.map(end_of_step, (x, h))


def pad_noise_increments(noise) -> jax.Array | None:
    """Return noise increments padded with zeros to a power of two of steps, so that few programs are compiled.

    Short calls share one program: padding up to :data:`MAX_SAVED_VALUES_PER_CALL` increments costs nothing.
    """
    if noise is None:
        return None
    *members, steps, n_increments = noise.shape
    short_call_steps = MAX_SAVED_VALUES_PER_CALL // max(1, math.prod(members) * n_increments)
    n_missing = (1 << max(0, max(steps, short_call_steps) - 1).bit_length()) - steps
    return jnp.asarray(np.pad(noise, [(0, 0)] * (noise.ndim - 2) + [(0, n_missing), (0, 0)]))


class ArrayBatch:
    """Trajectories of a family of systems, advanced in one vmapped program by steps of given sizes.

    Parameters
    ----------
    structure : ProgramStructure
    parameters, axes : list
        Parameters of the systems, and their axes for ``jax.vmap``.
    method : OneStepMethod
    x : array, shape (trajectories, n)
    min_capacity : int
        Smallest number of saves for which a program is compiled: few capacities, few programs.
    """

    def __init__(self, structure, parameters, axes, method: OneStepMethod, x: np.ndarray, min_capacity: int = 1):
        self._arguments, self._min_capacity = (structure, parameters, axes, method), min_capacity
        self._state = _initial_states_of_batch(*self._arguments, jnp.asarray(x))
        self._lazy_newton, self._n_trajectories = LazyNewton(method), len(x)

    def advance(self, h, n_saves: int, steps_per_save: int, noise=None) -> np.ndarray:
        """Take ``n_saves * steps_per_save`` steps; return states, energies and entropies, shape (B, n_saves, n + 2).

        The step sizes h are one number, or one for each trajectory.
        """
        capacity = 1 << (max(n_saves, self._min_capacity) - 1).bit_length()
        step_sizes = jnp.asarray(np.broadcast_to(np.asarray(h, dtype=np.float64), (self._n_trajectories,)))
        arguments = jnp.asarray(n_saves), jnp.asarray(steps_per_save), capacity, pad_noise_increments(noise)
        self._state, saved_fields = self._lazy_newton.advance_fixed_steps(
            lambda state, *how: _advance_batch(*self._arguments, state, step_sizes, *arguments, *how),
            self._state,
            steps_per_save,
        )
        x, energy, entropy = (np.asarray(values)[:, :n_saves] for values in saved_fields[:3])
        return np.concatenate([x, energy[..., None], entropy[..., None]], axis=-1)

    def read(self, names: Sequence[str] = State._fields) -> dict[str, np.ndarray]:
        """Return fields of the trajectories by name, by default of all fields."""
        return {name: np.asarray(getattr(self._state, name)) for name in names}


@jit_cached
def _initial_states_of_batch(structure, parameters, axes, method, x) -> State:
    """Return the states at the start of the runs of a batch, with a leading axis of trajectories."""

    def initial_state_of_one(p, x):
        return initial_run_state_program(structure.rebuild(p), method, x)

    return jax.vmap(initial_state_of_one, in_axes=(axes, 0))(parameters, x)


@jit_cached
def _advance_batch(
    structure,
    parameters,
    axes,
    method,
    state,
    h,
    n_saves,
    steps_per_save,
    capacity: int,
    noise,
    with_newton: bool,
    first_steps,
):
    """Return the states of a batch after steps, and its saves, as :func:`take_steps_and_save` does for one."""

    def advance_one(p, state, h, noise, first_step):
        arguments = h, n_saves, steps_per_save, capacity, DEFAULT_OPTIONS, noise, with_newton, first_step
        return take_steps_and_save(structure.rebuild(p), method, state, *arguments)

    return jax.vmap(advance_one, in_axes=(axes, 0, 0, 0, 0))(parameters, state, h, noise, first_steps)
