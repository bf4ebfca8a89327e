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
from ..functions.arguments import needed_arguments
from ..results.solution import Solution
from ..systems import AttitudeSystem, System
from ..tracing.index_check import result_shape
from ..tracing.trace_errors import TRACE_ERRORS, explain
from .quickly import quickly

ITERATIONS = 30
"""Steps by Levenberg and Marquardt, for a state in which a run begins."""

ATTITUDES = 16
"""From which the first state of a trajectory is looked for."""

DAMPING, EASED, RAISED = 1e-2, 0.3, 10.0
"""The damping at first, and what it is multiplied by after a step that was taken and one that was not."""


class Observation(NamedTuple):
    """What is compared with data.

    Attributes
    ----------
    function : function of x, shape (n,), or of x and the attitude, shape (m, m)
    shape : tuple of int
        Of one observation.
    places : array of int
        The components that are observed as they are, in the order of the observations; none of a function.
    group : manifolds.MatrixGroup or None
        Of the attitude that is observed.
    is_whole : bool
        Whether the state is observed, in the form that its system has it in.
    """

    function: Callable
    shape: tuple[int, ...]
    places: np.ndarray
    group: mf.MatrixGroup | None
    is_whole: bool

    def of(self, run: System, state) -> jax.Array:
        """The numbers that a state of a run shows, in a row."""
        parts = run.split(state) if isinstance(run, AttitudeSystem) else (state,)
        return jnp.ravel(jnp.asarray(self.function(*parts)))

    def content(self, run: System) -> list:
        """What tells one function from another."""
        found = jax.make_jaxpr(lambda state: self.of(run, state))(jnp.asarray(plain_states(self, run, self.none)[0]))
        return [str(found.jaxpr), *map(np.asarray, found.consts)]

    @property
    def none(self) -> np.ndarray:
        return np.zeros((1, int(np.prod(self.shape))))

    def of_solution(self, solution: Solution) -> jax.Array:
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

    def moved(self, run: System, state, z) -> jax.Array:
        """A state at coordinates z around another: ``x + z``, and ``g exp(hat(z))`` of the numbers behind that."""
        if not isinstance(run, AttitudeSystem):
            return state + z
        (x, g), n, group = run.split(state), own_size(run), run.group
        return run.join(x + z[:n], g @ group.exp_map(group.algebra, z[n:]))


def observation(system: System, observed: Sequence[int] | None, observe: Callable | None) -> Observation:
    """What a user says is in the data.

    Raises
    ------
    InputError, FunctionError
    """
    if observe is None:
        places = _places(observed, system.dim)
        return Observation(lambda x: x[places], (len(places),), places, None, observed is None)
    if observed is not None:
        raise InputError("give observed=, the numbers of components, or observe=, a function of the state, not both")
    number = needed_arguments(observe) if callable(observe) else 0
    if number not in (1, 2):
        raise InputError("observe is a function of the state, or of the state and the attitude, such as lambda x, R: R")
    group = system.matrix_group if number == 2 else None
    if number == 2 and group is None:
        raise InputError("observe is a function of the attitude: give the system a group, such as group=mf.SO(3)")
    parts = [jnp.zeros(system.dim)] if group is None else [jnp.zeros(system.dim), group.identity]
    try:
        found = result_shape(lambda *parts: jnp.asarray(observe(*parts)), *parts)
    except IndexOutOfRangeError as error:
        raise error.of(f"observe, at a state of shape ({system.dim},),") from None
    except TRACE_ERRORS as error:
        what = f"observe could not be evaluated on a state of shape ({system.dim},)"
        raise FunctionError(explain(what, error)) from error
    if not jnp.issubdtype(found.dtype, jnp.floating):
        raise FunctionError(f"observe must return real numbers, not {found.dtype}")
    return Observation(observe, found.shape, np.zeros(0, int), group, False)


def _places(observed: Sequence[int] | None, dim: int) -> np.ndarray:
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


def plain_states(own: Observation, run: System, shown: np.ndarray) -> np.ndarray:
    """States of a run, shape (m, N): what is observed as it is, zeros, and the attitude that is the identity."""
    x = np.zeros((len(shown), own_size(run)))
    if len(own.places):
        x[:, own.places] = shown
    return np.asarray(run.begin(x, batch=True)) if isinstance(run, AttitudeSystem) else x


def states_that_move(
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
    zero, scale = jnp.zeros(coordinates(run)), np.tile(size, 2)

    def missed(z, at, y, v):
        def of(state):
            return own.of(run, state)

        found, rate = jax.jvp(of, (x := own.moved(run, at, z),), (run._vector_field(x),))
        return jnp.concatenate([found - y, time * (rate - v)]) / scale

    def nearest(at, y, v):
        def step(carry, _):
            at, damping = carry
            r, J = missed(zero, at, y, v), jax.jacfwd(missed)(zero, at, y, v)
            square = J.T @ J
            weights = jnp.diag(square)
            weights = jnp.where(weights > 0.0, weights, 1.0)  # what shows nothing stays
            new = own.moved(run, at, -jnp.linalg.solve(square + damping * jnp.diag(weights), J.T @ r))
            better = jnp.sum(missed(zero, new, y, v) ** 2) < jnp.sum(r**2)
            return (jnp.where(better, new, at), damping * jnp.where(better, EASED, RAISED)), None

        return jax.lax.scan(step, (at, DAMPING), length=ITERATIONS)[0][0]

    def along(start, y, v):
        def step(at, both):
            at = nearest(at, *both)
            return at, at

        return jax.lax.scan(step, start, (y, v))[1]

    @functools.partial(jax.jit, compiler_options=quickly())
    def found(starts, y, v):
        firsts = jax.vmap(lambda at: nearest(at, y[0], v[0]))(starts)
        left = jax.vmap(lambda at: jnp.sum(missed(zero, at, y[0], v[0]) ** 2))(firsts)
        return along(firsts[jnp.argmin(left)], y, v)

    turns = np.random.default_rng(0).standard_normal((ATTITUDES, len(zero))) * (np.arange(len(zero)) >= own_size(run))
    turns[0] = 0.0
    turns = turns[: 1 if own.group is None else ATTITUDES]
    states = []
    for shown, rates in data:
        start = jnp.asarray(plain_states(own, run, shown[:1])[0])
        starts = jax.vmap(lambda z, start=start: own.moved(run, start, z))(jnp.asarray(turns))
        states.append(np.asarray(found(starts, jnp.asarray(shown), jnp.asarray(rates))))
    return states


def own_size(run: System) -> int:
    """How many numbers a state has without the attitude."""
    return run.body.dim if isinstance(run, AttitudeSystem) else run.dim


def coordinates(run: System) -> int:
    """How many numbers a state of a run is found by: those of :meth:`Observation.moved`."""
    return own_size(run) + (run.group.dim if isinstance(run, AttitudeSystem) else 0)
