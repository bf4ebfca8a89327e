"""What data show of states: all of them, some components, or any function of the state and the attitude."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import manifolds as mf

from ..errors import FunctionError, IndexOutOfRangeError, InputError
from ..functions.arguments import required_argument_count
from ..results.solution import Solution
from ..systems import AttitudeSystem, System
from ..tracing.index_check import result_shape
from ..tracing.trace_errors import TRACE_ERRORS, explain_trace_error
from .compile_options import fast_compile_options

LEVENBERG_ITERATIONS = 30
"""Steps by Levenberg and Marquardt, for a state in which a run begins."""

N_INITIAL_ATTITUDES = 16
"""From which the first state of a trajectory is looked for."""

INITIAL_DAMPING, DAMPING_DECREASE, DAMPING_INCREASE = 1e-2, 0.3, 10.0
"""The damping at first, and what it is multiplied by after a step that was taken and one that was not."""


class Observation(NamedTuple):
    """What is compared with data.

    Attributes
    ----------
    function : function of x, shape (n,), or of x and the attitude, shape (m, m)
    shape : tuple of int
        Of one observation.
    component_indices : array of int
        The components that are observed as they are, in the order of the observations; none of a function.
    group : manifolds.MatrixGroup or None
        Of the attitude that is observed.
    is_full_state : bool
        Whether the state is observed, in the form that its system has it in.
    """

    function: Callable
    shape: tuple[int, ...]
    component_indices: np.ndarray
    group: mf.MatrixGroup | None
    is_full_state: bool

    def observe(self, run: System, state) -> jax.Array:
        """The numbers that a state of a run shows, in a row."""
        parts = run.split_state(state) if isinstance(run, AttitudeSystem) else (state,)
        return jnp.ravel(jnp.asarray(self.function(*parts)))

    def fingerprint_parts(self, run: System) -> list:
        """What tells one function from another."""
        found = jax.make_jaxpr(lambda state: self.observe(run, state))(
            jnp.asarray(default_states(self, run, self.zero_observation)[0])
        )
        return [str(found.jaxpr), *map(np.asarray, found.consts)]

    @property
    def zero_observation(self) -> np.ndarray:
        return np.zeros((1, int(np.prod(self.shape))))

    def observe_solution(self, solution: Solution) -> jax.Array:
        """What the states of a solution show, shape (m, ...).

        Raises
        ------
        InputError
            If it has no attitudes, and they are observed.
        """
        if self.group is None:
            return jax.vmap(self.function)(jnp.asarray(solution.x))
        if solution.attitude is None:
            raise InputError("observe is a function of the attitude, and a solution in the data has none")
        return jax.vmap(self.function)(jnp.asarray(solution.x), jnp.asarray(solution.attitude))

    def displace(self, run: System, state, z) -> jax.Array:
        """A state at coordinates z around another: ``x + z``, and ``g exp(hat(z))`` of the numbers behind that."""
        if not isinstance(run, AttitudeSystem):
            return state + z
        (x, g), n, group = run.split_state(state), dim_without_attitude(run), run.group
        return run.join_state(x + z[:n], g @ group.exp_map(group.algebra, z[n:]))


def make_observation(system: System, observed: Sequence[int] | None, observe: Callable | None) -> Observation:
    """What a user says is in the data.

    Raises
    ------
    InputError, FunctionError
    """
    if observe is None:
        places = _component_indices(observed, system.dim)
        return Observation(lambda x: x[places], (len(places),), places, None, observed is None)
    if observed is not None:
        raise InputError("give observed=, the numbers of components, or observe=, a function of the state, not both")
    number = required_argument_count(observe) if callable(observe) else 0
    if number not in (1, 2):
        raise InputError("observe is a function of the state, or of the state and the attitude, such as lambda x, R: R")
    group = system.matrix_group if number == 2 else None
    if number == 2 and group is None:
        raise InputError("observe is a function of the attitude: give the system a group, such as group=mf.SO(3)")
    parts = [jnp.zeros(system.dim)] if group is None else [jnp.zeros(system.dim), group.identity]
    try:
        found = result_shape(lambda *parts: jnp.asarray(observe(*parts)), *parts)
    except IndexOutOfRangeError as error:
        raise error.with_function(f"observe, at a state of shape ({system.dim},),") from None
    except TRACE_ERRORS as error:
        what = f"observe could not be evaluated on a state of shape ({system.dim},)"
        raise FunctionError(explain_trace_error(what, error)) from error
    if not jnp.issubdtype(found.dtype, jnp.floating):
        raise FunctionError(f"observe must return real numbers, not {found.dtype}")
    return Observation(observe, found.shape, np.zeros(0, int), group, False)


def _component_indices(observed: Sequence[int] | None, dim: int) -> np.ndarray:
    if observed is None:
        return np.arange(dim)
    try:
        places = np.asarray(observed)
    except ValueError:  # rows of different lengths
        places = np.zeros(0)
    if places.dtype.kind not in "iu" or places.ndim != 1 or not len(places) or len(set(places.tolist())) < len(places):
        raise InputError(f"observed is a sequence of different component numbers, not {observed!r}")
    outside = places[(places < 0) | (places >= dim)]
    if len(outside):
        raise InputError(f"observed has component {outside[0]}, but a state has the components 0 to {dim - 1}")
    return places


def default_states(own: Observation, run: System, shown: np.ndarray) -> np.ndarray:
    """States of a run, shape (m, N): what is observed as it is, zeros, and the attitude that is the identity."""
    x = np.zeros((len(shown), dim_without_attitude(run)))
    if len(own.component_indices):
        x[:, own.component_indices] = shown
    return np.asarray(run.initial_state(x, batch=True)) if isinstance(run, AttitudeSystem) else x


def states_matching_rates(
    own: Observation, run: System, data: list[tuple[np.ndarray, np.ndarray]], size: np.ndarray, time: float
) -> list[np.ndarray]:
    """States, shape (m, N), that show what is observed along trajectories, and move as it does, by least squares.

    Each is looked for from the one before it; the first from several attitudes, since the identity may be far away.

    Parameters
    ----------
    data : list of pairs of arrays, shape (m, k)
        What is observed, and its rates of change.
    size : array, shape (k,)
    time : float
        The sizes of observations, and the time in which they change by as much.
    """
    zero, scale = jnp.zeros(n_coordinates(run)), np.tile(size, 2)

    def residual(z, at, y, v):
        def observe(state):
            return own.observe(run, state)

        found, rate = jax.jvp(observe, (x := own.displace(run, at, z),), (run._vector_field(x),))
        return jnp.concatenate([found - y, time * (rate - v)]) / scale

    def solve_state(at, y, v):
        def step(carry, _):
            at, damping = carry
            r, J = residual(zero, at, y, v), jax.jacfwd(residual)(zero, at, y, v)
            square = J.T @ J
            weights = jnp.diag(square)
            weights = jnp.where(weights > 0.0, weights, 1.0)  # what shows nothing stays
            new = own.displace(run, at, -jnp.linalg.solve(square + damping * jnp.diag(weights), J.T @ r))
            better = jnp.sum(residual(zero, new, y, v) ** 2) < jnp.sum(r**2)
            return (jnp.where(better, new, at), damping * jnp.where(better, DAMPING_DECREASE, DAMPING_INCREASE)), None

        return jax.lax.scan(step, (at, INITIAL_DAMPING), length=LEVENBERG_ITERATIONS)[0][0]

    def solve_states_in_turn(start, y, v):
        def step(at, both):
            at = solve_state(at, *both)
            return at, at

        return jax.lax.scan(step, start, (y, v))[1]

    @functools.partial(jax.jit, compiler_options=fast_compile_options())
    def solve_trajectory(starts, y, v):
        firsts = jax.vmap(lambda at: solve_state(at, y[0], v[0]))(starts)
        left = jax.vmap(lambda at: jnp.sum(residual(zero, at, y[0], v[0]) ** 2))(firsts)
        return solve_states_in_turn(firsts[jnp.argmin(left)], y, v)

    turns = np.random.default_rng(0).standard_normal((N_INITIAL_ATTITUDES, len(zero))) * (
        np.arange(len(zero)) >= dim_without_attitude(run)
    )
    turns[0] = 0.0
    turns = turns[: 1 if own.group is None else N_INITIAL_ATTITUDES]
    states = []
    for shown, rates in data:
        start = jnp.asarray(default_states(own, run, shown[:1])[0])
        starts = jax.vmap(lambda z, start=start: own.displace(run, start, z))(jnp.asarray(turns))
        states.append(np.asarray(solve_trajectory(starts, jnp.asarray(shown), jnp.asarray(rates))))
    return states


def dim_without_attitude(run: System) -> int:
    """How many numbers a state has without the attitude."""
    return run.body.dim if isinstance(run, AttitudeSystem) else run.dim


def n_coordinates(run: System) -> int:
    """How many numbers a state of a run is found by: those of :meth:`Observation.moved`."""
    return dim_without_attitude(run) + (run.group.dim if isinstance(run, AttitudeSystem) else 0)
