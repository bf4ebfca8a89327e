"""Loss functions of a fit: residuals of rates of change (matching), and of states after short runs (shooting)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from ..errors import InputError
from ..functions.time_span import DeclaredTimes
from ..integrators import MetriplecticRungeKutta, OneStepMethod, WithAttitude
from ..runs.flow import differentiable_step, initial_carry
from ..runs.preparation import prepare_for_method
from ..systems import System
from .data import DataScales, Trajectory, Windows, spline_states_and_rates
from .observation import Observation, entry_names
from .parts import Poisson, copy_entropy_to_poisson, learned_mask

MEAN_SQUARE_RATE_FLOOR = 0.1
"""Mean square of the rates of change, in units of their scale, that is added to the denominator of the matching loss,
so that slow states do not dominate."""


class ParameterVector(NamedTuple):
    """The learned parameters of a system as one vector.

    Attributes
    ----------
    initial_values : array, shape (p,)
        Initial values; logarithms for parameters that stay positive.
    array_shapes : tuple of tuple of int
        Shapes of the arrays in the vector, in order.
    build_system : function from such a vector to the system
    names : tuple of str, of length p
        Name of each number in the system: ``"dissipation.rate"``, ``"energy.A[0]"``.
    is_log : array of bool, shape (p,)
        True for logarithms.
    parameters_of : function from such a vector to the parameters that an observation depends on, a dict or None
    """

    initial_values: np.ndarray
    array_shapes: tuple[tuple[int, ...], ...]
    build_system: Callable[[Any], Any]
    names: tuple[str, ...] = ()
    is_log: np.ndarray = np.zeros(0, bool)
    parameters_of: Callable[[Any], dict[str, Any] | None] = lambda vector: None


def learned_parameter_vector(
    system: System, also: Callable | None = None, positive: Callable | None = None
) -> ParameterVector:
    """Return the learned parameters of a system: arrays marked by :class:`Learned`, or chosen by two functions."""
    mask = learned_mask(system)
    if isinstance(system.poisson, Poisson) and system.poisson.entropy is not None:
        mask = eqx.tree_at(lambda m: m.poisson.entropy, mask, False)  # the same weights as in the entropy
    for choose in (also, positive):
        if choose is not None:
            mask = eqx.tree_at(choose, mask, replace_fn=lambda part: jax.tree_util.tree_map(lambda _: True, part))
    all_false_mask = jax.tree_util.tree_map(lambda _: False, mask)
    positive_mask = (
        all_false_mask if positive is None else eqx.tree_at(positive, all_false_mask, replace_fn=lambda _: True)
    )
    learned_part, fixed_part = eqx.partition(system, mask)
    logs, values = eqx.partition(learned_part, positive_mask)
    logs_and_values = jax.tree_util.tree_map(jnp.log, logs), values
    initial_values, unravel = ravel_pytree(logs_and_values)

    def build_system(vector) -> System:
        logs, values = unravel(vector)
        return copy_entropy_to_poisson(eqx.combine(jax.tree_util.tree_map(jnp.exp, logs), values, fixed_part))

    shapes = tuple(np.shape(leaf) for leaf in jax.tree_util.tree_leaves(logs_and_values))
    n_logs = sum(np.size(leaf) for leaf in jax.tree_util.tree_leaves(logs))
    return ParameterVector(
        np.asarray(initial_values),
        shapes,
        build_system,
        _entry_names_of_pytrees(logs_and_values),
        np.arange(initial_values.size) < n_logs,
    )


def _entry_names_of_pytrees(trees: tuple) -> tuple[str, ...]:
    """Return the name of each array entry in some pytrees, such as ``energy.A[0]``, in order."""
    leaves = [leaf for tree in trees for leaf in jax.tree_util.tree_leaves_with_path(tree)]
    return tuple(name for path, leaf in leaves for name in entry_names({jax.tree_util.keystr(path).lstrip("."): leaf}))


class Objective(NamedTuple):
    """A loss function and its data.

    Attributes
    ----------
    loss : function from a vector, the arrays and indices of items, to a number
        The vector holds the weights, followed by the free numbers.
    arrays : tuple of arrays
    n_items : int
    initial_free : array, shape (f,)
        Initial values of the free numbers, which are fitted with the weights.
    """

    loss: Callable[[jax.Array, tuple, jax.Array], jax.Array]
    arrays: tuple
    n_items: int
    initial_free: np.ndarray


def rate_matching_objective(
    params: ParameterVector, states: np.ndarray, rates: np.ndarray, rate_scale: np.ndarray
) -> Objective:
    """Return an objective whose loss is the mean square difference between the vector field at states and given rates.

    The residual is relative to the speed of the state. Otherwise the few fastest moments would dominate the loss, and
    the phase of a slow motion, in which errors accumulate, would not count.
    """

    def loss(vector, arrays, indices):
        batch_states, rates = (values[indices] for values in arrays)
        field = jax.vmap(params.build_system(vector)._vector_field)(batch_states)
        speed = jnp.mean((rates / rate_scale) ** 2, axis=1, keepdims=True)
        return jnp.mean(((field - rates) / rate_scale) ** 2 / (MEAN_SQUARE_RATE_FLOOR + speed))

    return Objective(loss, (jnp.asarray(states), jnp.asarray(rates)), len(states), np.zeros(0))


def spline_matching_objective(
    params: ParameterVector, trajectories: list[Trajectory], noise: np.ndarray | None, scales: DataScales
) -> Objective:
    """Return the rate-matching objective for trajectories, whose states and rates come from splines."""
    smoothed_trajectories = [spline_states_and_rates(trajectory, noise) for trajectory in trajectories]
    used_rows = [
        slice(1, -1) if len(x) > 8 else slice(None) for x, _ in smoothed_trajectories
    ]  # a spline is worst at its ends
    x, rates = (
        np.concatenate([values[i] for values, i in zip(arrays, used_rows, strict=True)])
        for arrays in zip(*smoothed_trajectories, strict=True)
    )
    return rate_matching_objective(params, x, rates, scales.scale / scales.time_scale)


def shooting_objective(
    params: ParameterVector,
    method: OneStepMethod,
    windows: Windows,
    observation: Observation,
    units: tuple[np.ndarray, np.ndarray, np.ndarray],
    substeps: int,
    finds_initial_states: bool,
) -> Objective:
    """Return an objective whose loss is the mean square difference between short runs and the observations.

    With ``finds_initial_states`` the initial states of the runs are fitted too. Then the loss includes their
    differences to the data, and the gaps between the end of a run and the start of the next one.

    Parameters
    ----------
    units : three arrays, shapes (k,), (coordinates of a state,), (numbers of a state,)
        Units of the observations, of the search for initial states, and of the gaps.
    """
    p = len(params.initial_values)
    data_unit, search_unit, gap_unit = map(jnp.asarray, units)
    count, length = windows.intervals.shape

    def loss(vector, arrays, indices):
        initial_guess, intervals, observations, times, next_window = arrays
        system, values = params.build_system(vector[:p]), params.parameters_of(vector[:p])
        prepared_system, init, advance, get_state = prepare_differentiable_stepper(
            system, method, substeps, observation.group is not None
        )

        def run_window(x, h):
            def advance_over_interval(carry, h):
                carry = advance(carry, h)
                return carry, get_state(carry)

            return jax.lax.scan(advance_over_interval, init(x), h)[1]

        def mean_square_residual(states, i, j):
            """Return the mean square residual of states, observed at times j of the windows i; missing values do not
            count."""
            predictions = jax.vmap(lambda x, t: observation.observe(prepared_system, x, t, values))
            predictions = predictions if states.ndim == 2 else jax.vmap(predictions)
            values_of_windows = observations[i, j]
            residuals = (predictions(states, times[i, j]) - jnp.nan_to_num(values_of_windows)) / data_unit
            is_present = ~jnp.isnan(values_of_windows)
            return jnp.sum(jnp.where(is_present, residuals, 0.0) ** 2) / jnp.maximum(jnp.sum(is_present), 1)

        displacements = vector[p:].reshape(count, -1) * search_unit if finds_initial_states else None

        def initial_states(i):
            return (
                initial_guess[i]
                if displacements is None
                else jax.vmap(lambda x, z: observation.displace(prepared_system, x, z))(
                    initial_guess[i], displacements[i]
                )
            )

        start_states = initial_states(indices)
        path = jax.vmap(run_window)(start_states, intervals[indices])
        path_loss = mean_square_residual(path, indices, slice(1, None))
        if displacements is None:
            return path_loss
        initial_loss = mean_square_residual(start_states, indices, 0) / length
        next_indices = next_window[indices]
        gaps = jnp.where(next_indices[:, None] >= 0, (path[:, -1] - initial_states(next_indices)) / gap_unit, 0.0)
        return path_loss + initial_loss + jnp.mean(gaps**2)

    arrays = windows.initial_states, windows.intervals, windows.observations, windows.times, windows.next_window
    return Objective(
        loss, tuple(map(jnp.asarray, arrays)), count, np.zeros(count * search_unit.size if finds_initial_states else 0)
    )


class DifferentiableStepper(NamedTuple):
    """A prepared system with functions that start, advance and read a differentiable run.

    Attributes
    ----------
    system : System
    init : function from a state to a carry
    advance : function from a carry and the length of an interval to the next carry
    get_state : function from a carry to its state
    """

    system: System
    init: Callable
    advance: Callable
    get_state: Callable


def prepare_differentiable_stepper(
    system: System, method: OneStepMethod, substeps: int | jax.Array, has_attitude: bool = False
) -> DifferentiableStepper:
    """Prepare a system for differentiable runs; return it with functions that start, advance and read a run.

    A traced number of substeps permits derivatives in forward mode only.

    Raises
    ------
    InputError
        If functions of time of the system jump: the steps end at the times of the data.
    """
    if breaks := DeclaredTimes.from_tree(system).jumps:
        raise InputError(
            f"the system has functions of time that jump, at t = {breaks[0]:g} and other times, where the steps of a "
            "fit do not end. Use functions of time that are continuous"
        )
    prepared_system, method = prepare_for_method(system, method, None, has_attitude)
    base_method = method.method if isinstance(method, WithAttitude) else method
    needs_no_compensation = (
        isinstance(base_method, MetriplecticRungeKutta) and prepared_system.constraint_surface is None
    )

    def step(carry, h):
        if needs_no_compensation:
            return method.step_without_compensation(prepared_system, carry, h)  # type: ignore[attr-defined]
        return differentiable_step(prepared_system, method, carry, h)

    def advance(carry, h):
        if isinstance(substeps, jax.Array):
            return jax.lax.fori_loop(0, substeps, lambda _, carry: step(carry, h / substeps), carry)
        if substeps == 1:
            return step(carry, h)
        return jax.lax.scan(lambda carry, _: (step(carry, h / substeps), None), carry, length=substeps)[0]

    if needs_no_compensation:
        return DifferentiableStepper(prepared_system, lambda x: x, advance, lambda x: x)
    return DifferentiableStepper(
        prepared_system,
        lambda x: initial_carry(prepared_system, method, x),
        advance,
        lambda carry: carry[0][: prepared_system.dim],
    )
