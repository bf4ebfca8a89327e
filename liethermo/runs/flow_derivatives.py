"""Derivatives of any order of the states of a path, accumulated from the derivatives of its solved steps.

A step maps ``z = (x, p)``, the state and the parameters, to the next state by the slopes k that solve its equations:

    0 = residual(z, k),    x' = move(z, k).

Its derivative along directions ``a, b, ...`` follows from those of lower order by the implicit function theorem.
Without the highest derivative of k, the derivative of ``residual`` is not zero; the inverse of ``D_k residual`` gives
the derivative of k that cancels it. All steps and all directions are points at which one function is evaluated, with
its derivatives along a few directions as arguments. This function is only a few times as long as a step, and its length
does not grow with the number of directions.
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
from jax.extend.core import Primitive
from jax.flatten_util import ravel_pytree
from jax.interpreters import ad, batching, mlir

from manifolds.matrices.linear import inverse

from ..systems.clock import system_between_breaks
from ..tracing.interpret import evaluate_at_points


def solve_with_implicit_derivative(solve: Callable, residual: Callable, parameters: Any, guess: jax.Array) -> jax.Array:
    """Return the solution k of ``residual(parameters, k) = 0`` that ``solve`` computes, as a differentiable array.

    The derivative is ``-(D_k residual)^-1 D residual``, whatever ``solve`` does. Neither function may close over
    tracers.

    Parameters
    ----------
    solve, residual : function
    parameters : pytree of arrays
    guess : array, of the shape of k
    """
    leaves, structure = jax.tree_util.tree_flatten(parameters)
    return _implicit_solution.bind(*leaves, guess, solve=solve, residual=residual, structure=structure, vmap_axes=())


_implicit_solution = Primitive("solution")


def _run_solver(*arguments, solve: Callable, residual: Callable, structure, vmap_axes: tuple) -> jax.Array:
    """Run ``solve`` under one ``jax.vmap`` for each entry of ``vmap_axes``, innermost first, and return the solution.

    An entry holds the axes of the arguments that an enclosing ``vmap`` maps over.
    """
    del residual

    def solve_one(*arguments):
        *leaves, guess = arguments
        return solve(jax.tree_util.tree_unflatten(structure, leaves), guess)

    return _nest_vmaps(solve_one, vmap_axes)(*arguments)


def _nest_vmaps(function: Callable, vmap_axes: Sequence[tuple]) -> Callable:
    for axes_of_level in vmap_axes:
        function = jax.vmap(function, in_axes=axes_of_level)
    return function


def _solution_shape_dtype(*arguments, vmap_axes: tuple, **_):
    """Return shape and type of the solution: the axes of all enclosing ``vmap``, then those of the guess."""
    shape, guess = arguments[-1].shape, arguments[-1]
    sizes = []
    for axes_of_level in reversed(vmap_axes):
        sizes.append(next(a.shape[axis] for a, axis in zip(arguments, axes_of_level, strict=True) if axis is not None))
        arguments = tuple(_shape_without_axis(a, axis) for a, axis in zip(arguments, axes_of_level, strict=True))
        shape = arguments[-1].shape
    return jax.core.ShapedArray((*sizes, *shape), guess.dtype)


def _shape_without_axis(a, axis: int | None):
    """Return an array's shape without one axis, as ``vmap`` over this axis sees it; None removes no axis."""
    if axis is None:
        return a
    return jax.ShapeDtypeStruct(a.shape[:axis] + a.shape[axis + 1 :], a.dtype)


def _batching_rule(arguments, dims, *, vmap_axes: tuple, **other_parameters):
    return _implicit_solution.bind(*arguments, vmap_axes=(*vmap_axes, tuple(dims)), **other_parameters), 0


def _jvp_rule(primals, tangents, *, residual: Callable, structure, vmap_axes: tuple, **other_parameters):
    """Return the solution and its tangent, by the implicit function theorem."""
    k = _implicit_solution.bind(
        *primals, residual=residual, structure=structure, vmap_axes=vmap_axes, **other_parameters
    )
    active = [i for i, tangent in enumerate(tangents[:-1]) if type(tangent) is not ad.Zero]
    if not active:
        return k, jnp.zeros_like(k)
    leaves, active_tangents = primals[:-1], [tangents[i] for i in active]

    def solution_tangent(k, *arguments):
        leaves, active_tangents = list(arguments[: -len(active)]), arguments[-len(active) :]

        def active_residual(k, *values):
            leaf_values = list(leaves)
            for i, leaf_value in zip(active, values, strict=True):
                leaf_values[i] = leaf_value
            return residual(jax.tree_util.tree_unflatten(structure, leaf_values), k)

        _, residual_jvp = jax.linearize(active_residual, k, *(leaves[i] for i in active))
        constant_jvp = jax.lax.stop_gradient(residual_jvp)
        zero_tangents = [jnp.zeros_like(dot) for dot in active_tangents]
        matrix = jax.vmap(lambda d: constant_jvp(d.reshape(k.shape), *zero_tangents).ravel(), out_axes=1)(
            jnp.eye(k.size)
        )
        matrix_inverse = inverse(matrix)
        return jax.lax.custom_linear_solve(
            lambda d: residual_jvp(d, *zero_tangents),
            -residual_jvp(jnp.zeros_like(k), *active_tangents),
            solve=lambda _, b: (matrix_inverse @ b.ravel()).reshape(k.shape),
            transpose_solve=lambda _, b: (b.ravel() @ matrix_inverse).reshape(k.shape),
        )

    levels = [(0, *axes_of_level[:-1], *(axes_of_level[i] for i in active)) for axes_of_level in vmap_axes]
    return k, _nest_vmaps(solution_tangent, levels)(k, *leaves, *active_tangents)


_implicit_solution.def_impl(lambda *arguments, **rest: jax.jit(lambda *a: _run_solver(*a, **rest))(*arguments))
_implicit_solution.def_abstract_eval(_solution_shape_dtype)
batching.primitive_batchers[_implicit_solution] = _batching_rule
ad.primitive_jvps[_implicit_solution] = _jvp_rule
mlir.register_lowering(_implicit_solution, mlir.lower_fun(_run_solver, multiple_results=False))


MAX_VALUES_PER_CALL = 1_000_000
"""Largest number of values in the points of one evaluation, which bounds memory."""


class _StepFunction(eqx.Module):
    """Function from state, parameters and slopes of a step, in one row, to its stage residual and end state.

    Attributes
    ----------
    system_method_state : tuple
        The system, the method, and the initial state.
    is_differentiated : tuple of bool
        For each leaf of ``system_method_state``, whether it is differentiated by; in system and method these are the
        parameters.
    slopes_shape : tuple of int
        The shape of k.
    order : int
        Order of the derivative, the number of its directions.
    """

    system_method_state: tuple
    is_differentiated: tuple[bool, ...] = eqx.field(static=True)
    slopes_shape: tuple[int, int] = eqx.field(static=True)
    order: int = eqx.field(static=True)

    def unpack_method_state_slopes(self, z) -> tuple[Any, Any, jax.Array, jax.Array]:
        """Return system, method, state and slopes from z, shape (n + q + m,): state, parameters and slopes."""
        leaves, structure = jax.tree_util.tree_flatten(self.system_method_state)
        *other_leaves, x = leaves
        _, unravel_parameters = ravel_pytree(
            [leaf for leaf, is_parameter in zip(other_leaves, self.is_differentiated[:-1], strict=True) if is_parameter]
        )
        n, m = np.size(x), self.slopes_shape[0] * self.slopes_shape[1]
        parameters = iter(unravel_parameters(z[n : len(z) - m]))
        other_leaves = [
            next(parameters) if is_parameter else leaf
            for leaf, is_parameter in zip(other_leaves, self.is_differentiated[:-1], strict=True)
        ]
        system, method, _ = jax.tree_util.tree_unflatten(structure, [*other_leaves, x])
        return system_between_breaks(system, z[:n]), method, z[:n], z[len(z) - m :].reshape(self.slopes_shape)

    def __call__(self, h, compensation, z) -> jax.Array:
        """Return the residual of the stage equations, followed by the next state."""
        system, method, x, k = self.unpack_method_state_slopes(z)
        residual = method.slopes(system, x, compensation, h, k) - k
        return jnp.concatenate([residual.ravel(), method.move(system, x, compensation, h, k)[0]])


def _mixed_directional_derivative(step_function: _StepFunction, point_row) -> jax.Array:
    """Return the derivative of a step along ``step_function.order`` directions, by nested forward mode.

    The point holds the step size, the compensation, and 2**order rows: the values of state, parameters and slopes, and
    their derivatives along subsets of the directions. The bits of a row's number select its subset.
    """
    n = np.size(step_function.system_method_state[-1])
    h, compensation, rows = point_row[0], point_row[1 : 1 + n], point_row[1 + n :].reshape(2**step_function.order, -1)

    def step_of_first_row(rows):
        return step_function(h, compensation, rows[0])[None]

    def differentiate(function):
        def value_and_tangent(rows):
            primals, tangents = jnp.split(rows, 2)
            return jnp.concatenate(jax.jvp(function, (primals,), (tangents,)))

        return value_and_tangent

    function = step_of_first_row
    for _ in range(step_function.order):
        function = differentiate(function)
    return function(rows)[-1]


def state_derivatives(
    system_method_state: tuple,
    leaf_is_traced: Sequence[bool],
    order: int,
    step_sizes: np.ndarray,
    solved_steps: tuple[np.ndarray, np.ndarray, np.ndarray],
) -> list[np.ndarray]:
    """Return the derivatives of all states of a path by parameters and initial state, of orders 1 to ``order``.

    Parameters
    ----------
    system_method_state : (System, OneStepMethod, array)
        Concrete values, nothing traced. The array is the initial state.
    leaf_is_traced : sequence of bool
        For each leaf of ``system_method_state``, whether it is differentiated by.
    order : int
    step_sizes : array, shape (steps,)
    solved_steps : (array, array, array)
        For each step its state, shape (n,), the compensation of the state, and the slopes that solve its equations,
        shape (stages, n).

    Returns
    -------
    list of array
        Shapes (steps + 1, n, p), (steps + 1, n, p, p) and so on; p is the number of entries of all leaves that are
        differentiated by, in one row.
    """
    x, compensation, k = solved_steps
    n_steps, n, m = len(x), x.shape[1], k[0].size
    parameters, initial_state = _differentiated_parameters_and_state(system_method_state, leaf_is_traced)
    q, p = len(parameters), len(parameters) + len(initial_state)
    base_rows = np.concatenate([x, np.broadcast_to(parameters, (n_steps, q)), k.reshape(n_steps, m)], axis=1)

    def evaluate_derivatives_along(
        rows_of_chunk: Callable[[slice], np.ndarray], n_direction_sets: int, rank: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the derivatives of stage residuals and end states along direction sets of ``rank`` directions.

        Their shapes are (steps, m, n_direction_sets) and (steps, n, n_direction_sets).

        ``rows_of_chunk`` returns the rows of a chunk of steps, shape (steps, n_direction_sets, 2**rank, n + q + m); the
        rows of all steps would fill the memory.
        """
        step, derivatives = (
            _StepFunction(system_method_state, tuple(leaf_is_traced), k.shape[1:], rank),
            np.empty((n_steps, n_direction_sets, m + n)),
        )
        chunk_size = max(1, MAX_VALUES_PER_CALL // (n_direction_sets * 2**rank * (n + q + m)))
        for chunk in (slice(i, i + chunk_size) for i in range(0, n_steps, chunk_size)):
            leading_columns = np.concatenate([step_sizes[chunk, None], compensation[chunk]], axis=1)[:, None].repeat(
                n_direction_sets, axis=1
            )
            points = np.concatenate(
                [leading_columns, rows_of_chunk(chunk).reshape(*leading_columns.shape[:2], -1)], axis=2
            )
            values = evaluate_at_points(_mixed_directional_derivative, step, points.reshape(-1, points.shape[-1]))
            derivatives[chunk] = values.reshape(*leading_columns.shape[:2], m + n)
        return derivatives[..., :m].swapaxes(1, 2), derivatives[..., m:].swapaxes(1, 2)

    def unit_direction_rows(chunk: slice) -> np.ndarray:
        units = np.broadcast_to(np.eye(n + q + m), (len(base_rows[chunk]), n + q + m, n + q + m))
        return np.stack([np.broadcast_to(base_rows[chunk, None], units.shape), units], axis=2)

    residual_jacobian, state_jacobian = evaluate_derivatives_along(unit_direction_rows, n + q + m, 1)
    slopes_of_residual = -_inverse_or_nan(
        residual_jacobian[..., n + q :]
    )  # from a residual to the k that makes up for it
    step_jacobian = (
        state_jacobian[..., : n + q]
        + state_jacobian[..., n + q :] @ slopes_of_residual @ residual_jacobian[..., : n + q]
    )
    states, row_derivatives = (
        [],
        [base_rows],
    )  # derivatives of each order: of the states, and of z and k, (steps, n + q + m, p, ...)
    for rank in range(1, order + 1):
        direction_sets, entry_index = _symmetric_index_sets_and_positions(p, rank)
        if rank == 1:
            parameter_derivative = np.eye(q, p)  # parameters move in the directions of their own
            residual, forcing = (
                residual_jacobian[..., n : n + q] @ parameter_derivative,
                step_jacobian[..., n:] @ parameter_derivative,
            )
        else:
            parameter_derivative = np.zeros((q, len(direction_sets)))
            residual, forcing = evaluate_derivatives_along(
                functools.partial(_lower_order_rows, row_derivatives, direction_sets), len(direction_sets), rank
            )
            forcing = forcing + state_jacobian[..., n + q :] @ slopes_of_residual @ residual
        state_derivative = np.zeros((n_steps + 1, n, len(direction_sets)))
        if rank == 1:
            state_derivative[0, :, q:] = np.eye(n, len(initial_state))
        for j in range(n_steps):
            state_derivative[j + 1] = step_jacobian[j, :, :n] @ state_derivative[j] + forcing[j]
        states.append(state_derivative[..., entry_index])
        if rank < order:
            slopes = slopes_of_residual @ (residual_jacobian[..., :n] @ state_derivative[:-1] + residual)
            row_derivative = np.concatenate(
                [
                    state_derivative[:-1],
                    np.broadcast_to(parameter_derivative, (n_steps, *parameter_derivative.shape)),
                    slopes,
                ],
                axis=1,
            )
            row_derivatives.append(row_derivative[..., entry_index])
    return states


def _lower_order_rows(
    row_derivatives: Sequence[np.ndarray], direction_sets: Sequence[tuple[int, ...]], step_slice: slice
) -> np.ndarray:
    """Return the derivatives along each proper subset of each direction set, shape (steps, sets, 2**rank, n + q + m).

    The rank is the number of directions in a set. The bits of an index of the third axis select the subset; its last
    entry, for the whole set, is zero.
    """
    chunk_derivatives, rank = [a[step_slice] for a in row_derivatives], len(direction_sets[0])
    rows = np.zeros((len(chunk_derivatives[0]), len(direction_sets), 2**rank, chunk_derivatives[0].shape[1]))
    for i, directions in enumerate(direction_sets):
        for subset in range(2**rank - 1):
            subset_directions: tuple = tuple(d for bit, d in enumerate(directions) if subset >> bit & 1)
            rows[:, i, subset] = chunk_derivatives[len(subset_directions)][(..., *subset_directions)]
    return rows


def _differentiated_parameters_and_state(
    system_method_state: tuple, leaf_is_traced: Sequence[bool]
) -> tuple[np.ndarray, np.ndarray]:
    """Return the parameters and the initial state that are differentiated by, one row each; empty if there are none."""
    leaves = jax.tree_util.tree_leaves(system_method_state)
    *parameters, initial_state = (
        np.ravel(leaf) if is_differentiated else np.zeros(0)
        for leaf, is_differentiated in zip(leaves, leaf_is_traced, strict=True)
    )
    return np.concatenate([np.zeros(0), *parameters]), initial_state


def _symmetric_index_sets_and_positions(n_variables: int, rank: int) -> tuple[list[tuple[int, ...]], np.ndarray]:
    """Return the distinct index sets of a symmetric tensor over ``n_variables``, and each entry's position among them.

    The positions have ``rank`` axes of length ``n_variables``.
    """
    index_sets = list(itertools.combinations_with_replacement(range(n_variables), rank))
    entry_index = np.empty((n_variables,) * rank, dtype=int)
    for i, directions in enumerate(index_sets):
        for permutation in itertools.permutations(directions):
            entry_index[permutation] = i
    return index_sets, entry_index


def _inverse_or_nan(matrices: np.ndarray) -> np.ndarray:
    """Return the inverses of matrices, NaN for singular ones, where the derivative does not exist."""
    try:
        return np.linalg.inv(matrices)
    except np.linalg.LinAlgError:
        return np.stack([np.linalg.inv(a) if np.linalg.det(a) else np.full_like(a, np.nan) for a in matrices])
