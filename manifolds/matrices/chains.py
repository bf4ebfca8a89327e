"""Functions of matrices with all their derivatives: a primitive of JAX that is closed under both of its modes.

The derivative of order k of f at A, in the directions E1 … Ek, is a sum over their orders of *chains*

    T(A; E1, …, Ek) = U W U^H,   W_ab = sum f[p_a, p_i, …, p_b] (U^H E1 U)_ai … (U^H Ek U)_..b

with the eigenvalues p and eigenvectors U of A and the divided differences f[…] [Daleckii & Krein 1965; Higham 2008,
Theorem 3.11]. A chain is linear in each direction. Its derivative by A in the direction D is the sum of the
longer chains that have D at each place in between. Its adjoint in one direction is the chain of the others in cyclic
order. So derivatives of every order are chains again, and no eigenvector is differentiated: they are finite where
eigenvalues meet. For matrices that are not Hermitian the exponential has the same chains, as blocks of the
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
    """A function of matrices; equal ones are one function, and they can be hashed.

    ``unrolled`` says that every operation becomes scalar instructions.
    """

    def decompose(self, a, unrolled: bool) -> tuple[jax.Array, ...]:
        """What all chains have in common that one of the matrices is in, such as its eigenvectors."""
        ...

    def chain(self, prepared, slots: tuple[int, ...], shifts, directions, unrolled: bool) -> jax.Array:
        """The chain of some directions, from what is prepared of each matrix."""
        ...


chain_p = Primitive("matrix_chain")
"""The chain of matrices, shape (..., n, n), of shifts, shape (..., k + 1), and of k directions, shape (..., n, m).

At place j between directions stands the matrix of number ``slots[j]`` plus ``shifts[..., j]`` times the identity. There
are as many leading axes of all, and what has one of length 1 is the same along it.
"""


def chain(function: MatrixFunction, matrices, slots, shifts, directions=()) -> jax.Array:
    """The chain, for arrays whose types, and numbers of leading axes, are made alike."""
    arrays = [*matrices, *directions]
    dtype = jnp.result_type(*arrays)
    rank = max(*(np.ndim(a) - 2 for a in arrays), np.ndim(shifts) - 1)
    alike = [_with_rank(a.astype(dtype), rank + 2) for a in arrays]
    shifts = _with_rank(shifts, rank + 1)
    m = len(matrices)
    return chain_p.bind(*alike[:m], shifts, *alike[m:], function=function, slots=tuple(slots))


def _with_rank(a, rank: int):
    return a if a.ndim == rank else a.reshape((1,) * (rank - a.ndim) + a.shape)


def evaluate_chain(*arrays, function: MatrixFunction, slots: tuple[int, ...]) -> jax.Array:
    """What the primitive computes, in terms of others."""
    matrices, shifts, directions = _split_arguments(arrays, slots)
    prepared = [function.decompose(a, unrolled=False) for a in matrices]
    return function.chain(prepared, slots, shifts, directions, unrolled=False)


def _split_arguments(arrays, slots) -> tuple[list, Any, list]:
    m = len(arrays) - len(slots)
    return list(arrays[:m]), arrays[m], list(arrays[m + 1 :])


@functools.partial(jax.jit, static_argnames=("function", "slots"))
def _evaluate_compiled(*arrays, function, slots):
    return evaluate_chain(*arrays, function=function, slots=slots)


def _abstract_eval(*avals, function, slots):
    rank = avals[0].ndim - 2
    front = jnp.broadcast_shapes(*(a.shape[:rank] for a in avals))
    return jax.core.ShapedArray((*front, avals[slots[0]].shape[-1], avals[slots[-1]].shape[-1]), avals[0].dtype)


def _jvp(primals, tangents, *, function, slots):
    matrices, shifts, directions = _split_arguments(primals, slots)
    by_matrices, by_shifts, by_directions = _split_arguments(tangents, slots)
    bind = functools.partial(chain_p.bind, *matrices, function=function)
    terms = []
    for j, dE in enumerate(by_directions):
        if type(dE) is not ad.Zero:
            terms.append(bind(shifts, *directions[:j], dE, *directions[j + 1 :], slots=slots))
    for j, slot in enumerate(slots):
        D = None if type(by_matrices[slot]) is ad.Zero else by_matrices[slot]
        if type(by_shifts) is not ad.Zero:
            matrix = matrices[slot]
            identity = by_shifts[..., j, None, None].astype(matrix.dtype) * np.eye(matrix.shape[-1])
            D = identity if D is None else D + identity
        if D is not None:
            longer = jnp.concatenate([shifts[..., : j + 1], shifts[..., j:]], axis=-1)
            terms.append(bind(longer, *directions[:j], D, *directions[j:], slots=(*slots[: j + 1], *slots[j:])))
    found = bind(shifts, *directions, slots=slots)
    return found, functools.reduce(jnp.add, terms) if terms else jnp.zeros_like(found)


def _transpose(ct, *arrays, function, slots):
    matrices, shifts, directions = _split_arguments(arrays, slots)
    (j,) = (i for i, E in enumerate(directions) if ad.is_undefined_primal(E))
    if type(ct) is ad.Zero:
        return [None] * len(arrays)
    others = [*directions[j + 1 :], ct.swapaxes(-1, -2), *directions[:j]]
    turned = jnp.concatenate([shifts[..., j + 1 :], shifts[..., : j + 1]], axis=-1)
    around = (*slots[j + 1 :], *slots[: j + 1])
    found = chain_p.bind(*matrices, turned, *others, function=function, slots=around).swapaxes(-1, -2)
    shape = directions[j].aval.shape
    alike = [i for i in range(len(shape) - 2) if shape[i] == 1]
    found = jnp.sum(found, axis=alike, keepdims=True) if alike else found
    return [None] * (len(matrices) + 1 + j) + [found] + [None] * (len(directions) - j - 1)


def _batch(arrays, axes, *, function, slots):
    alike = [a[None] if axis is None else jnp.moveaxis(a, axis, 0) for a, axis in zip(arrays, axes, strict=True)]
    return chain_p.bind(*alike, function=function, slots=slots), 0


chain_p.def_impl(_evaluate_compiled)
chain_p.def_abstract_eval(_abstract_eval)
ad.primitive_jvps[chain_p] = _jvp
ad.primitive_transposes[chain_p] = _transpose
batching.primitive_batchers[chain_p] = _batch
mlir.register_lowering(chain_p, mlir.lower_fun(evaluate_chain, multiple_results=False))
