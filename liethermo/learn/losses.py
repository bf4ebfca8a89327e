"""What a fit makes small: what the motion misses of the rates of change, or of the states after short runs."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from ..integrators import MetriplecticRungeKutta, OneStepMethod, WithAttitude
from ..runs.flow import differentiable_step, initial_carry
from ..runs.preparation import prepare_for_method
from ..systems import System
from .data import DataScales, Trajectory, Windows, spline_states_and_rates
from .model import tie_entropy
from .networks import learned_mask
from .observation import Observation
from .parts import Poisson

MEAN_SQUARE_RATE_FLOOR = 0.1
"""Mean square of the rates of change, in units of their usual size, below which they count as slow."""


class ParameterVector(NamedTuple):
    """The numbers of a system that are learned, as one vector.

    Attributes
    ----------
    initial_values : array, shape (p,)
        As they are; the logarithms of those that have to be positive.
    array_shapes : tuple of tuple of int
        Of the arrays that stand in it, one after another.
    build_system : function from such a vector to the system
    names : tuple of str, of length p
        Where each number stands in the system: ``"dissipation.rate"``, ``"energy.A[0]"``.
    is_log : array of bool, shape (p,)
        Which of them are logarithms.
    """

    initial_values: np.ndarray
    array_shapes: tuple[tuple[int, ...], ...]
    build_system: Callable[[Any], Any]
    names: tuple[str, ...] = ()
    is_log: np.ndarray = np.zeros(0, bool)


def parameter_vector(system: System, also: Callable | None = None, positive: Callable | None = None) -> ParameterVector:
    """What is learned of a system: the arrays inside of marks, and those that two functions choose."""
    mask = learned_mask(system)
    if isinstance(system.poisson, Poisson) and system.poisson.entropy is not None:
        mask = eqx.tree_at(lambda m: m.poisson.entropy, mask, False)  # the same weights as in the entropy
    for choose in (also, positive):
        if choose is not None:
            mask = eqx.tree_at(choose, mask, replace_fn=lambda part: jax.tree_util.tree_map(lambda _: True, part))
    none = jax.tree_util.tree_map(lambda _: False, mask)
    signs = none if positive is None else eqx.tree_at(positive, none, replace_fn=lambda _: True)
    varied, fixed = eqx.partition(system, mask)
    logs, plain = eqx.partition(varied, signs)
    both = jax.tree_util.tree_map(jnp.log, logs), plain
    first, back = ravel_pytree(both)

    def build_system(vector) -> System:
        logs, plain = back(vector)
        return tie_entropy(eqx.combine(jax.tree_util.tree_map(jnp.exp, logs), plain, fixed))

    shapes = tuple(np.shape(leaf) for leaf in jax.tree_util.tree_leaves(both))
    count = sum(np.size(leaf) for leaf in jax.tree_util.tree_leaves(logs))
    return ParameterVector(np.asarray(first), shapes, build_system, _entry_names(both), np.arange(first.size) < count)


def _entry_names(trees: tuple) -> tuple[str, ...]:
    """Where each number of some trees stands in its tree, in the order of the numbers."""
    found: list[str] = []
    for tree in trees:
        for path, leaf in jax.tree_util.tree_leaves_with_path(tree):
            name = jax.tree_util.keystr(path).lstrip(".")
            shape = np.shape(leaf)
            found += [name + (f"[{', '.join(map(str, i))}]" if shape else "") for i in np.ndindex(shape)]
    return tuple(found)


class Objective(NamedTuple):
    """What is to be made small.

    Attributes
    ----------
    loss : function from a vector, the arrays and indices of items, to a number
        The vector is that of the weights, with the free numbers behind it.
    arrays : tuple of arrays
    n_items : int
    initial_free : array, shape (f,)
        Numbers that are found beside the weights, as they are at first.
    """

    loss: Callable[[jax.Array, tuple, jax.Array], jax.Array]
    arrays: tuple
    n_items: int
    initial_free: np.ndarray


def matching_objective(own: ParameterVector, x: np.ndarray, rates: np.ndarray, size: np.ndarray) -> Objective:
    """The mean square of what ``x'`` misses of rates of change, in units of ``size``, shape (n,).

    Relative to how fast the state changes: else a loss is all about the few fastest moments, and the phase of a slow
    motion, which errors pile up in, counts for nothing.
    """

    def loss(vector, arrays, chosen):
        points, wanted = (values[chosen] for values in arrays)
        found = jax.vmap(own.build_system(vector)._vector_field)(points)
        speed = jnp.mean((wanted / size) ** 2, axis=1, keepdims=True)
        return jnp.mean(((found - wanted) / size) ** 2 / (MEAN_SQUARE_RATE_FLOOR + speed))

    return Objective(loss, (jnp.asarray(x), jnp.asarray(rates)), len(x), np.zeros(0))


def trajectory_matching(
    own: ParameterVector, data: list[Trajectory], noise: np.ndarray | None, found: DataScales
) -> Objective:
    """:func:`matching` at the points of trajectories, by splines through them or as near as the noise allows."""
    smooth = [spline_states_and_rates(trajectory, noise) for trajectory in data]
    inner = [slice(1, -1) if len(x) > 8 else slice(None) for x, _ in smooth]  # a spline is worst at its ends
    x, rates = (
        np.concatenate([values[i] for values, i in zip(each, inner, strict=True)]) for each in zip(*smooth, strict=True)
    )
    return matching_objective(own, x, rates, found.scale / found.time_scale)


def shooting_objective(
    own: ParameterVector,
    method: OneStepMethod,
    pieces: Windows,
    seen: Observation,
    units: tuple[np.ndarray, np.ndarray, np.ndarray],
    substeps: int,
    free: bool,
) -> Objective:
    """The mean square of what runs miss of the data at the ends of all intervals.

    With ``free`` the states where the runs begin are found too, and what they show of the data counts, and what a run
    misses of where the next one begins.

    Parameters
    ----------
    units : three arrays, shapes (k,), (coordinates of a state,), (numbers of a state,)
        Of what is observed, of the search for the states where runs begin, and of what a run misses of the next one.
    """
    p = len(own.initial_values)
    of_data, of_search, of_gaps = map(jnp.asarray, units)
    count, length = pieces.intervals.shape

    def loss(vector, arrays, chosen):
        starts, sizes, shown, following = arrays
        system = own.build_system(vector[:p])
        run, begin, advance, state_of = differentiable_stepper(system, method, substeps, seen.group is not None)

        def run_window(x, h):
            def interval(carry, h):
                carry = advance(carry, h)
                return carry, state_of(carry)

            return jax.lax.scan(interval, begin(x), h)[1]

        def observe_states(states):
            return jax.vmap(lambda x: seen.observe(run, x))(states)

        moves = vector[p:].reshape(count, -1) * of_search if free else None

        def initial_states(i):
            return starts[i] if moves is None else jax.vmap(lambda x, z: seen.displace(run, x, z))(starts[i], moves[i])

        at = initial_states(chosen)
        found = jax.vmap(run_window)(at, sizes[chosen])
        missed = jnp.mean(((jax.vmap(observe_states)(found) - shown[chosen, 1:]) / of_data) ** 2)
        if moves is None:
            return missed
        begun = jnp.mean(((observe_states(at) - shown[chosen, 0]) / of_data) ** 2) / length
        next_ = following[chosen]
        gaps = jnp.where(next_[:, None] >= 0, (found[:, -1] - initial_states(next_)) / of_gaps, 0.0)
        return missed + begun + jnp.mean(gaps**2)

    arrays = tuple(map(jnp.asarray, (pieces.initial_states, pieces.intervals, pieces.observations, pieces.next_window)))
    return Objective(loss, arrays, count, np.zeros(count * of_search.size if free else 0))


def differentiable_stepper(
    system: System, method: OneStepMethod, substeps: int, attitude: bool = False
) -> tuple[System, Callable, Callable, Callable]:
    """The system as it is run, what begins a run at a state, takes it over an interval, and what its state is then.

    For derivatives.
    """
    run, method = prepare_for_method(system, method, None, attitude)
    inner = method.method if isinstance(method, WithAttitude) else method
    plain = isinstance(inner, MetriplecticRungeKutta) and run.surface is None

    def step(carry, h):
        return method.step_without_compensation(run, carry, h) if plain else differentiable_step(run, method, carry, h)  # type: ignore[attr-defined]

    def advance(carry, h):
        if substeps == 1:
            return step(carry, h)
        return jax.lax.scan(lambda carry, _: (step(carry, h / substeps), None), carry, length=substeps)[0]

    if plain:
        return run, lambda x: x, advance, lambda x: x
    return run, lambda x: initial_carry(run, method, x), advance, lambda carry: carry[0][: run.dim]
