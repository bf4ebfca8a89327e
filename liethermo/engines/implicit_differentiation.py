"""Solutions of equations as differentiable functions of their parameters, to any order, in both modes.

The solution is a primitive of its own. In jax 0.10 the reverse mode of ``lax.scan`` drops the rules of
``jax.custom_jvp`` and ``jax.lax.custom_root``, so a second derivative would differentiate the loop of the solver.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

from manifolds.matrices.linear import inverse


def implicit_solution(solve: Callable, residual: Callable, parameters: Any, guess: jax.Array) -> jax.Array:
    """Return the k with ``residual(parameters, k) = 0`` that ``solve`` computes, as a differentiable array.

    Its derivative is ``-(D_k residual)^-1 D residual``, whatever ``solve`` does. Neither function may close over
    tracers.

    Parameters
    ----------
    solve, residual : function
    parameters : pytree of arrays
    guess : array, of the shape of k
    """
    leaves, structure = jax.tree_util.tree_flatten(parameters)
    return _implicit_solution.bind(*leaves, guess, solve=solve, residual=residual, structure=structure, axes=())


_implicit_solution = Primitive("solution")


def _run_solver(*arguments, solve: Callable, residual: Callable, structure, axes: tuple) -> jax.Array:
    """Run the solver; ``axes`` holds the argument axes of each enclosing ``vmap``, innermost first."""
    del residual

    def solve_one(*arguments):
        *leaves, guess = arguments
        return solve(jax.tree_util.tree_unflatten(structure, leaves), guess)

    return _nest_vmaps(solve_one, axes)(*arguments)


def _nest_vmaps(function: Callable, axes: Sequence[tuple]) -> Callable:
    for axes_of_level in axes:
        function = jax.vmap(function, in_axes=axes_of_level)
    return function


def _abstract_eval(*arguments, axes: tuple, **_):
    shape, guess = arguments[-1].shape, arguments[-1]
    sizes = []
    for axes_of_level in reversed(axes):
        sizes.append(next(a.shape[axis] for a, axis in zip(arguments, axes_of_level, strict=True) if axis is not None))
        arguments = tuple(_shape_without_axis(a, axis) for a, axis in zip(arguments, axes_of_level, strict=True))
        shape = arguments[-1].shape
    return jax.core.ShapedArray((*sizes, *shape), guess.dtype)


def _shape_without_axis(a, axis: int | None):
    """Return the shape of an argument inside ``vmap``."""
    if axis is None:
        return a
    return jax.ShapeDtypeStruct(a.shape[:axis] + a.shape[axis + 1 :], a.dtype)


def _batching_rule(arguments, dims, *, axes: tuple, **rest):
    return _implicit_solution.bind(*arguments, axes=(*axes, tuple(dims)), **rest), 0


def _jvp_rule(primals, tangents, *, residual: Callable, structure, axes: tuple, **rest):
    k = _implicit_solution.bind(*primals, residual=residual, structure=structure, axes=axes, **rest)
    active = [i for i, tangent in enumerate(tangents[:-1]) if type(tangent) is not ad.Zero]
    if not active:
        return k, jnp.zeros_like(k)
    leaves, active_tangents = primals[:-1], [tangents[i] for i in active]

    def solution_tangent(k, *arguments):
        leaves, active_tangents = list(arguments[: -len(active)]), arguments[-len(active) :]

        def active_residual(k, *values):
            leaf_values = list(leaves)
            for i, value in zip(active, values, strict=True):
                leaf_values[i] = value
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

    levels = [(0, *axes_of_level[:-1], *(axes_of_level[i] for i in active)) for axes_of_level in axes]
    return k, _nest_vmaps(solution_tangent, levels)(k, *leaves, *active_tangents)


_implicit_solution.def_impl(lambda *arguments, **rest: jax.jit(lambda *a: _run_solver(*a, **rest))(*arguments))
_implicit_solution.def_abstract_eval(_abstract_eval)
batching.primitive_batchers[_implicit_solution] = _batching_rule
ad.primitive_jvps[_implicit_solution] = _jvp_rule
mlir.register_lowering(_implicit_solution, mlir.lower_fun(_run_solver, multiple_results=False))
