"""Solutions of equations as functions of what the equations depend on, with derivatives of any order in both modes.

A primitive of its own: of ``jax.custom_jvp`` and ``jax.lax.custom_root``, a ``lax.scan`` that is differentiated
backwards forgets the rule (jax 0.10), so that the second derivative meets the loop inside.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

from manifolds.matrices.linear import inverse


def implicit_solution(solve: Callable, misfit: Callable, parameters: Any, guess: jax.Array) -> jax.Array:
    """The k with ``misfit(parameters, k) = 0`` that ``solve(parameters, guess)`` finds.

    Its derivative is ``-(D_k misfit)^-1 D misfit``, whatever ``solve`` does. Neither function may close over tracers.

    Parameters
    ----------
    solve, misfit : function
    parameters : pytree of arrays
    guess : array, of the shape of k
    """
    leaves, structure = jax.tree_util.tree_flatten(parameters)
    return _implicit_solution.bind(*leaves, guess, solve=solve, misfit=misfit, structure=structure, axes=())


_implicit_solution = Primitive("solution")


def _evaluate(*arguments, solve: Callable, misfit: Callable, structure, axes: tuple) -> jax.Array:
    """``axes`` has those of the arguments for each ``vmap`` that the primitive is under, the innermost first."""
    del misfit

    def one(*arguments):
        *leaves, guess = arguments
        return solve(jax.tree_util.tree_unflatten(structure, leaves), guess)

    return _nest_vmaps(one, axes)(*arguments)


def _nest_vmaps(function: Callable, axes: Sequence[tuple]) -> Callable:
    for level in axes:
        function = jax.vmap(function, in_axes=level)
    return function


def _abstract_shape(*arguments, axes: tuple, **_):
    shape, guess = arguments[-1].shape, arguments[-1]
    sizes = []
    for level in reversed(axes):
        sizes.append(next(a.shape[axis] for a, axis in zip(arguments, level, strict=True) if axis is not None))
        arguments = tuple(_drop_axis(a, axis) for a, axis in zip(arguments, level, strict=True))
        shape = arguments[-1].shape
    return jax.core.ShapedArray((*sizes, *shape), guess.dtype)


def _drop_axis(a, axis: int | None):
    """The shape that a function under ``vmap`` sees."""
    if axis is None:
        return a
    return jax.ShapeDtypeStruct(a.shape[:axis] + a.shape[axis + 1 :], a.dtype)


def _batching_rule(arguments, dims, *, axes: tuple, **rest):
    return _implicit_solution.bind(*arguments, axes=(*axes, tuple(dims)), **rest), 0


def _jvp_rule(primals, tangents, *, misfit: Callable, structure, axes: tuple, **rest):
    k = _implicit_solution.bind(*primals, misfit=misfit, structure=structure, axes=axes, **rest)
    moving = [i for i, tangent in enumerate(tangents[:-1]) if type(tangent) is not ad.Zero]
    if not moving:
        return k, jnp.zeros_like(k)
    leaves, dots = primals[:-1], [tangents[i] for i in moving]

    def one(k, *given):
        leaves, dots = list(given[: -len(moving)]), given[-len(moving) :]

        def active_residual(k, *values):
            whole = list(leaves)
            for i, value in zip(moving, values, strict=True):
                whole[i] = value
            return misfit(jax.tree_util.tree_unflatten(structure, whole), k)

        _, change = jax.linearize(active_residual, k, *(leaves[i] for i in moving))
        fixed, still = jax.lax.stop_gradient(change), [jnp.zeros_like(dot) for dot in dots]
        matrix = jax.vmap(lambda d: fixed(d.reshape(k.shape), *still).ravel(), out_axes=1)(jnp.eye(k.size))
        inverted = inverse(matrix)
        return jax.lax.custom_linear_solve(
            lambda d: change(d, *still),
            -change(jnp.zeros_like(k), *dots),
            solve=lambda _, b: (inverted @ b.ravel()).reshape(k.shape),
            transpose_solve=lambda _, b: (b.ravel() @ inverted).reshape(k.shape),
        )

    levels = [(0, *level[:-1], *(level[i] for i in moving)) for level in axes]
    return k, _nest_vmaps(one, levels)(k, *leaves, *dots)


_implicit_solution.def_impl(lambda *arguments, **rest: jax.jit(lambda *a: _evaluate(*a, **rest))(*arguments))
_implicit_solution.def_abstract_eval(_abstract_shape)
batching.primitive_batchers[_implicit_solution] = _batching_rule
ad.primitive_jvps[_implicit_solution] = _jvp_rule
mlir.register_lowering(_implicit_solution, mlir.lower_fun(_evaluate, multiple_results=False))
