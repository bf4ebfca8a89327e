"""Derivatives of a path whose steps are solved, of any order: of each step along directions, then from step to step.

A step maps ``z = (x, p)``, the state and the parameters, to the next state by the slopes k that solve its equations:

    0 = misfit(z, k),    x' = move(z, k).

Their derivative along directions ``a, b, ...`` follows from lower ones (implicit function theorem): with that of k
left out, ``misfit`` leaves a residual, and k makes up for it by the inverse of ``D_k misfit``. All steps and all
directions are points at which one function is computed, with its derivatives along a few directions as arguments. It
is no more than some times as long as a step, and does not grow with the number of directions.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from ..tracing.interpret import evaluate_at_points

MAX_VALUES_PER_CALL = 1_000_000
"""Numbers in the points that a function is computed at in one go."""


class _StepFunction(eqx.Module):
    """A step as a function of z and k in one row, and of what else it starts from.

    Attributes
    ----------
    system_method_state : tuple
        The system, the method, and the first state.
    is_differentiated : tuple of bool
        Which leaves of these are differentiated by: those of system and method are the parameters.
    slopes_shape : tuple of int
        The shape of k.
    order : int
        Of the derivative, that is how many directions it is taken along.
    """

    system_method_state: tuple
    is_differentiated: tuple[bool, ...] = eqx.field(static=True)
    slopes_shape: tuple[int, int] = eqx.field(static=True)
    order: int = eqx.field(static=True)

    def unpack(self, z) -> tuple[Any, Any, jax.Array, jax.Array]:
        """System, method, state and slopes that a row says."""
        leaves, structure = jax.tree_util.tree_flatten(self.system_method_state)
        *own, x = leaves
        _, rest = ravel_pytree([leaf for leaf, moving in zip(own, self.is_differentiated[:-1], strict=True) if moving])
        n, m = np.size(x), self.slopes_shape[0] * self.slopes_shape[1]
        moved = iter(rest(z[n : len(z) - m]))
        own = [next(moved) if moving else leaf for leaf, moving in zip(own, self.is_differentiated[:-1], strict=True)]
        system, method, _ = jax.tree_util.tree_unflatten(structure, [*own, x])
        return system, method, z[:n], z[len(z) - m :].reshape(self.slopes_shape)

    def __call__(self, h, compensation, z) -> jax.Array:
        """The misfit, then the next state."""
        system, method, x, k = self.unpack(z)
        misfit = method.slopes(system, x, compensation, h, k) - k
        return jnp.concatenate([misfit.ravel(), method.move(system, x, compensation, h, k)[0]])


def _directional_derivative(step: _StepFunction, point) -> jax.Array:
    """The derivative along as many directions as its order says; rows of the point are z and k, and their derivatives.

    The row of a set of directions has the bits of its number set at their places.
    """
    n = np.size(step.system_method_state[-1])
    h, compensation, rows = point[0], point[1 : 1 + n], point[1 + n :].reshape(2**step.order, -1)

    def value(rows):
        return step(h, compensation, rows[0])[None]

    def tangent(function):
        def value_and_tangent(rows):
            lower, upper = jnp.split(rows, 2)
            return jnp.concatenate(jax.jvp(function, (lower,), (upper,)))

        return value_and_tangent

    function = value
    for _ in range(step.order):
        function = tangent(function)
    return function(rows)[-1]


def state_derivatives(
    given: tuple, moves: Sequence[bool], order: int, sizes: np.ndarray, path: tuple[np.ndarray, np.ndarray, np.ndarray]
) -> list[np.ndarray]:
    """Those of the states of a path, from the first on, up to an order.

    Parameters
    ----------
    given : (System, OneStepMethod, array)
        With numbers only, nothing traced. The array is the first state.
    moves : sequence of bool
        Which of the leaves of ``given`` are differentiated by.
    order : int
    sizes : array, shape (steps,)
        Of each step (time).
    path : (array, array, array)
        For each step its state, shape (n,), the compensation of that, and the slopes that solve its equations, shape
        (stages, n).

    Returns
    -------
    list of array
        Shapes (steps + 1, n, p), (steps + 1, n, p, p) and so on; p is the number of entries of all leaves that move, in
        one row.
    """
    x, compensation, k = path
    count, n, m = len(x), x.shape[1], k[0].size
    parameters, start = _differentiated_values(given, moves)
    q, p = len(parameters), len(parameters) + len(start)
    place = np.concatenate([x, np.broadcast_to(parameters, (count, q)), k.reshape(count, m)], axis=1)

    def evaluate_along(rows: Callable[[slice], np.ndarray], many: int, rank: int) -> tuple[np.ndarray, np.ndarray]:
        """Derivatives of misfit and move, shapes (steps, m, many) and (steps, n, many).

        ``rows`` gives the rows of some steps, shape (steps, many, 2**rank, n + q + m): those of all steps are large.
        """
        step, found = _StepFunction(given, tuple(moves), k.shape[1:], rank), np.empty((count, many, m + n))
        portion = max(1, MAX_VALUES_PER_CALL // (many * 2**rank * (n + q + m)))
        for some in (slice(i, i + portion) for i in range(0, count, portion)):
            begin = np.concatenate([sizes[some, None], compensation[some]], axis=1)[:, None].repeat(many, axis=1)
            points = np.concatenate([begin, rows(some).reshape(*begin.shape[:2], -1)], axis=2)
            moved = evaluate_at_points(_directional_derivative, step, points.reshape(-1, points.shape[-1]))
            found[some] = moved.reshape(*begin.shape[:2], m + n)
        return found[..., :m].swapaxes(1, 2), found[..., m:].swapaxes(1, 2)

    def unit_directions(some: slice) -> np.ndarray:
        units = np.broadcast_to(np.eye(n + q + m), (len(place[some]), n + q + m, n + q + m))
        return np.stack([np.broadcast_to(place[some, None], units.shape), units], axis=2)

    misfit, move = evaluate_along(unit_directions, n + q + m, 1)
    back = -_inverse_or_nan(misfit[..., n + q :])  # from a residual to the k that makes up for it
    onward = move[..., : n + q] + move[..., n + q :] @ back @ misfit[..., : n + q]
    states, known = [], [place]  # derivatives of each order: of the states, and of z and k, (steps, n + q + m, p, ...)
    for rank in range(1, order + 1):
        chosen, where = _symmetric_indices(p, rank)
        if rank == 1:
            still = np.eye(q, p)  # parameters move in the directions of their own
            residual, forced = misfit[..., n : n + q] @ still, onward[..., n:] @ still
        else:
            still = np.zeros((q, len(chosen)))
            residual, forced = evaluate_along(functools.partial(_lower_order_rows, known, chosen), len(chosen), rank)
            forced = forced + move[..., n + q :] @ back @ residual
        own = np.zeros((count + 1, n, len(chosen)))
        if rank == 1:
            own[0, :, q:] = np.eye(n, len(start))
        for j in range(count):
            own[j + 1] = onward[j, :, :n] @ own[j] + forced[j]
        states.append(own[..., where])
        if rank < order:
            slopes = back @ (misfit[..., :n] @ own[:-1] + residual)
            whole = np.concatenate([own[:-1], np.broadcast_to(still, (count, *still.shape)), slopes], axis=1)
            known.append(whole[..., where])
    return states


def _lower_order_rows(known: Sequence[np.ndarray], chosen: Sequence[tuple[int, ...]], some: slice) -> np.ndarray:
    """Derivatives along all sets of some directions but the whole: shape (steps, many, 2**rank, n + q + m)."""
    own, rank = [a[some] for a in known], len(chosen[0])
    rows = np.zeros((len(own[0]), len(chosen), 2**rank, own[0].shape[1]))
    for i, directions in enumerate(chosen):
        for subset in range(2**rank - 1):
            inside: tuple = tuple(d for bit, d in enumerate(directions) if subset >> bit & 1)
            rows[:, i, subset] = own[len(inside)][(..., *inside)]
    return rows


def _differentiated_values(given: tuple, moves: Sequence[bool]) -> tuple[np.ndarray, np.ndarray]:
    """The parameters that are differentiated by, and the first state where it is: each in one row."""
    leaves = jax.tree_util.tree_leaves(given)
    *own, start = (np.ravel(leaf) if moving else np.zeros(0) for leaf, moving in zip(leaves, moves, strict=True))
    return np.concatenate([np.zeros(0), *own]), start


def _symmetric_indices(p: int, rank: int) -> tuple[list[tuple[int, ...]], np.ndarray]:
    """The derivatives of a rank by p variables that differ, and which of them an entry of the whole is."""
    chosen = list(itertools.combinations_with_replacement(range(p), rank))
    where = np.empty((p,) * rank, dtype=int)
    for i, directions in enumerate(chosen):
        for same in itertools.permutations(directions):
            where[same] = i
    return chosen, where


def _inverse_or_nan(matrices: np.ndarray) -> np.ndarray:
    """NaN where there is none: the derivative does not exist there."""
    try:
        return np.linalg.inv(matrices)
    except np.linalg.LinAlgError:
        return np.stack([np.linalg.inv(a) if np.linalg.det(a) else np.full_like(a, np.nan) for a in matrices])
