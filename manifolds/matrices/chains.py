"""Functions of matrices with all their derivatives: a primitive of JAX that is closed under both of its modes.

The derivative of order k of f at A, in the directions E1 … Ek, is a sum over their orders of *chains*

    T(A; E1, …, Ek) = U W U^H,   W_ab = sum f[p_a, p_i, …, p_b] (U^H E1 U)_ai … (U^H Ek U)_..b

with the eigenvalues p and eigenvectors U of A and the divided differences f[…] [Daleckii & Krein 1965; Higham 2008,
Theorem 3.11]. A chain is linear in each direction. Its derivative by A in the direction D is the sum of the
longer chains with D inserted at each position. Its adjoint in one direction is the chain of the other directions in
cyclic order. Derivatives of every order are therefore chains again, and no eigenvector is differentiated: they are
finite where eigenvalues meet. For matrices that are not Hermitian the exponential has equal chains, as blocks of the
exponential of a larger matrix [Najfeld & Havel 1995].
"""

from __future__ import annotations

import functools
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir


class MatrixFunction(Protocol):
    """Function of matrices with its chains; instances must be hashable, and equal ones must be one function.

    ``unrolled`` is True if every operation becomes scalar instructions.
    """

    def decompose(self, a, unrolled: bool) -> tuple[jax.Array, ...]:
        """Return the arrays that all chains of one matrix share, such as its eigenvalues and eigenvectors."""
        ...

    def chain(self, decompositions, slots: tuple[int, ...], shifts, directions, unrolled: bool) -> jax.Array:
        """Return the chain of the directions, a term of a derivative of f, from the decompositions of the matrices."""
        ...


chain_p = Primitive("matrix_chain")
"""Primitive of the chain of matrices, shape (..., n, n), shifts, shape (..., k + 1), and k directions, shape (..., n,
m).

The j-th position between directions holds the matrix of index ``slots[j]`` plus ``shifts[..., j]`` times the identity.
All arguments have equally many leading axes, and broadcast along axes of length 1.
"""


def matrix_function_chain(function: MatrixFunction, matrices, slots, shifts, directions=()) -> jax.Array:
    """Return the chain of a matrix function in the directions: a term of its derivative, or its value without any.

    The arrays are converted to one type and one number of leading axes for the primitive :data:`chain_p`.
    """
    arrays = [*matrices, *directions]
    dtype = jnp.result_type(*arrays)
    rank = max(*(np.ndim(a) - 2 for a in arrays), np.ndim(shifts) - 1)
    equal_rank_arrays = [_with_rank(a.astype(dtype), rank + 2) for a in arrays]
    shifts = _with_rank(shifts, rank + 1)
    m = len(matrices)
    return chain_p.bind(*equal_rank_arrays[:m], shifts, *equal_rank_arrays[m:], function=function, slots=tuple(slots))


def _with_rank(a, rank: int):
    """Return an array with leading axes of length 1, so that it has ``rank`` axes."""
    return a if a.ndim == rank else a.reshape((1,) * (rank - a.ndim) + a.shape)


def evaluate_chain(*arrays, function: MatrixFunction, slots: tuple[int, ...]) -> jax.Array:
    """Evaluate the chain of a matrix function from the arguments of its primitive, by other JAX operations."""
    matrices, shifts, directions = _split_arguments(arrays, slots)
    decompositions = [function.decompose(a, unrolled=False) for a in matrices]
    return function.chain(decompositions, slots, shifts, directions, unrolled=False)


def _split_arguments(arrays, slots) -> tuple[list, Any, list]:
    """Return the matrices, the shifts and the directions among the arguments of the primitive."""
    m = len(arrays) - len(slots)
    return list(arrays[:m]), arrays[m], list(arrays[m + 1 :])


@functools.partial(jax.jit, static_argnames=("function", "slots"))
def _evaluate_compiled(*arrays, function, slots):
    return evaluate_chain(*arrays, function=function, slots=slots)


def _abstract_eval(*avals, function, slots):
    rank = avals[0].ndim - 2
    batch = jnp.broadcast_shapes(*(a.shape[:rank] for a in avals))
    return jax.core.ShapedArray((*batch, avals[slots[0]].shape[-1], avals[slots[-1]].shape[-1]), avals[0].dtype)


def _jvp(primals, tangents, *, function, slots):
    matrices, shifts, directions = _split_arguments(primals, slots)
    matrix_tangents, shift_tangent, direction_tangents = _split_arguments(tangents, slots)
    bind = functools.partial(chain_p.bind, *matrices, function=function)
    terms = []
    for j, dE in enumerate(direction_tangents):
        if type(dE) is not ad.Zero:
            terms.append(bind(shifts, *directions[:j], dE, *directions[j + 1 :], slots=slots))
    for j, slot in enumerate(slots):
        D = None if type(matrix_tangents[slot]) is ad.Zero else matrix_tangents[slot]
        if type(shift_tangent) is not ad.Zero:
            matrix = matrices[slot]
            identity = shift_tangent[..., j, None, None].astype(matrix.dtype) * np.eye(matrix.shape[-1])
            D = identity if D is None else D + identity
        if D is not None:
            longer_shifts = jnp.concatenate([shifts[..., : j + 1], shifts[..., j:]], axis=-1)
            terms.append(bind(longer_shifts, *directions[:j], D, *directions[j:], slots=(*slots[: j + 1], *slots[j:])))
    value = bind(shifts, *directions, slots=slots)
    return value, functools.reduce(jnp.add, terms) if terms else jnp.zeros_like(value)


def _transpose(ct, *arrays, function, slots):
    matrices, shifts, directions = _split_arguments(arrays, slots)
    (j,) = (i for i, E in enumerate(directions) if ad.is_undefined_primal(E))
    if type(ct) is ad.Zero:
        return [None] * len(arrays)
    other_directions = [*directions[j + 1 :], ct.swapaxes(-1, -2), *directions[:j]]
    cyclic_shifts = jnp.concatenate([shifts[..., j + 1 :], shifts[..., : j + 1]], axis=-1)
    cyclic_slots = (*slots[j + 1 :], *slots[: j + 1])
    cotangent = chain_p.bind(
        *matrices, cyclic_shifts, *other_directions, function=function, slots=cyclic_slots
    ).swapaxes(-1, -2)
    shape = directions[j].aval.shape
    broadcast_axes = [i for i in range(len(shape) - 2) if shape[i] == 1]
    cotangent = jnp.sum(cotangent, axis=broadcast_axes, keepdims=True) if broadcast_axes else cotangent
    return [None] * (len(matrices) + 1 + j) + [cotangent] + [None] * (len(directions) - j - 1)


def _batch(arrays, axes, *, function, slots):
    batch_first = [a[None] if axis is None else jnp.moveaxis(a, axis, 0) for a, axis in zip(arrays, axes, strict=True)]
    return chain_p.bind(*batch_first, function=function, slots=slots), 0


chain_p.def_impl(_evaluate_compiled)
chain_p.def_abstract_eval(_abstract_eval)
ad.primitive_jvps[chain_p] = _jvp
ad.primitive_transposes[chain_p] = _transpose
batching.primitive_batchers[chain_p] = _batch
mlir.register_lowering(chain_p, mlir.lower_fun(evaluate_chain, multiple_results=False))
