"""Functions of Hermitian matrices by their eigenvalues, and traces of them, with derivatives of every order.

Derivatives are by divided differences (:mod:`.chains`), so that they are finite and exact where eigenvalues meet.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from .chains import chain
from .divided_differences import ScalarFunction, scalar_function
from .linear import adjoint
from .symmetric import eigh

MAX_JACOBI_ROWS = 3
"""Largest number of rows for which Jacobi rotations compute eigenvectors; beyond, LAPACK does."""


def spectral(f: Callable | ScalarFunction, a) -> jax.Array:
    """Return ``f(A) = U f(p) U^H`` of a Hermitian matrix ``A = U p U^H``, with all its derivatives.

    Forward and reverse mode have derivatives of any order, finite and exact also where eigenvalues meet [Daleckii &
    Krein 1965]. A function that is defined anew has another identity, and is compiled again.

    Parameters
    ----------
    f : function of an array, entry by entry
        ``jnp.exp``, ``jnp.log``, ``jnp.log1p``, ``jnp.sqrt`` and ``jnp.reciprocal`` have divided differences in closed
        form. Those of another function are quotients, or means of its derivatives where those are more accurate.
    a : array, shape (..., n, n)
        Real symmetric or complex Hermitian matrices.

    Returns
    -------
    array, shape (..., n, n)
        NaN where f is not defined at an eigenvalue.
    """
    return chain(SpectralFunction(scalar_function(f)), [jnp.asarray(a)], (0,), np.zeros(1))


def spectral_trace(f: Callable | ScalarFunction, a) -> jax.Array:
    """Return ``tr f(A)``, shape (...), whose gradient is ``f'(A)``.

    Parameters
    ----------
    f, a
        As for :func:`spectral`.
    """
    return _spectral_trace(scalar_function(f), jnp.asarray(a))


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _spectral_trace(f: ScalarFunction, a):
    return jnp.trace(spectral(f, a), axis1=-2, axis2=-1).real


@_spectral_trace.defjvp
def _trace_derivative(f, primals, tangents):
    (a,), (da,) = primals, tangents
    slope = spectral(f.derivative_function, a)
    return _spectral_trace(f, a), jnp.sum(slope.swapaxes(-1, -2) * da, axis=(-2, -1)).real


def spectral_difference(f: Callable | ScalarFunction, a, b) -> jax.Array:
    """Return the Hermitian G with ``tr(G (b - a)) = tr f(b) - tr f(a)``, a discrete gradient of ``tr f``, shape (...,
    n, n).

    ``G = sum f[p_k, q_l] |k><k|l><l|``, or its Hermitian part, over the eigenvectors of a and of b. It is ``f'(a)`` if
    a
    and b are equal, it is symmetric in a and b, and its rounding error is relative: no difference of values is taken.

    Parameters
    ----------
    f
        As for :func:`spectral`.
    a, b : array, shape (..., n, n)
        Hermitian.
    """
    a, b = jnp.asarray(a), jnp.asarray(b)
    gradient = chain(
        SpectralFunction(scalar_function(f)), [a, b], (0, 1), np.zeros(2), [np.eye(a.shape[-1], dtype=a.dtype)]
    )
    return (gradient + adjoint(gradient)) / 2


def log_mean(logs, shift, x) -> jax.Array:
    """Return ``L X``, with the logarithmic mean of ``e^-s A`` from the left and ``e^s A`` from the right, ``A =
    exp(logs)``.

    In eigenvectors of A ``(L X)_kl = X_kl (u - v) / (ln u - ln v)`` with ``u = e^-s p_k`` and ``v = e^s p_l``. The mean
    is
    the divided difference of exp at the logarithms, and so has all its derivatives [Carlen & Maas 2017].

    Parameters
    ----------
    logs : array, shape (..., n, n)
        Hermitian.
    shift : float, or array, shape (...)
        s.
    x : array, shape (..., n, n)
    """
    shift = jnp.asarray(shift)
    return chain(SpectralFunction(scalar_function(jnp.exp)), [logs], (0, 0), jnp.stack([-shift, shift], axis=-1), [x])


@dataclass(frozen=True)
class SpectralFunction:
    """Function of Hermitian matrices by their eigenvalues, with its chains: see :class:`.chains.MatrixFunction`."""

    function: ScalarFunction

    def decompose(self, a, unrolled: bool) -> tuple[jax.Array, jax.Array]:
        return _eigenvectors(a)

    def chain(self, decompositions, slots, shifts, directions, unrolled: bool) -> jax.Array:
        eigensystems = decompositions
        vectors, k = [eigensystems[slot][1] for slot in slots], len(directions)
        points = [
            (eigensystems[slot][0] + shifts[..., j, None])[
                (..., *(slice(None) if i == j else None for i in range(k + 1)))
            ]
            for j, slot in enumerate(slots)
        ]
        weights, adjoints = self.function.divided_difference(*points), [adjoint(u) for u in vectors]
        inner = [adjoints[j] @ E @ vectors[j + 1] for j, E in enumerate(directions)]
        if k == 0:
            return (vectors[0] * weights[..., None, :]) @ adjoints[0]
        if k > 1:  # sum over all positions but the first and the last
            letters = "abcdefghijklm"[: k + 1]
            pairs = ",".join("..." + letters[j : j + 2] for j in range(k))
            middle = jnp.einsum(f"...{letters},{pairs}->...{letters[0]}{letters[-1]}", weights, *inner)
        else:
            middle = weights * inner[0]
        return vectors[0] @ middle @ adjoints[-1]


def _eigenvectors(a) -> tuple[jax.Array, jax.Array]:
    a = (a + adjoint(a)) / 2
    if a.shape[-1] > MAX_JACOBI_ROWS:
        vectors, values = jax.lax.linalg.eigh(a, symmetrize_input=False, sort_eigenvalues=False)
        return values, vectors
    return eigh(a)


DEGENERACY_RTOL = 64.0 * float(np.finfo(np.float64).eps)
"""Difference of two eigenvalues, relative to the norm of the matrix, up to which they count as equal in derivatives."""


@jax.custom_jvp
def ordered_eigenvectors(a) -> tuple[jax.Array, jax.Array]:
    """Return the eigenvalues of a Hermitian matrix in increasing order, shape (n,), and eigenvectors as columns.

    Derivatives are those of quantities that do not depend on the phases of the eigenvectors, nor on the basis of an
    eigenspace of more than one dimension. The eigenvectors of equal eigenvalues are not turned into each other.

    Parameters
    ----------
    a : array, shape (n, n)
    """
    values, vectors = _eigenvectors(a)
    if a.shape[-1] > MAX_JACOBI_ROWS:  # LAPACK sorts them
        return values, vectors
    index = np.arange(a.shape[-1])
    is_before = (values[:, None] < values) | ((values[:, None] == values) & (index[:, None] < index))
    places = (jnp.sum(is_before, axis=0)[:, None] == index).astype(values.dtype)  # a permutation matrix
    return values @ places, vectors @ places


@ordered_eigenvectors.defjvp
def _eigenvector_derivative(primals, tangents):
    (a,), (da,) = primals, tangents
    values, vectors = ordered_eigenvectors(a)
    inner = adjoint(vectors) @ ((da + adjoint(da)) / 2) @ vectors
    gaps = values - values[:, None]
    is_equal = jnp.abs(gaps) <= DEGENERACY_RTOL * jnp.max(jnp.abs(values))
    rotation = jnp.where(is_equal, 0.0, inner / jnp.where(is_equal, 1.0, gaps))
    return (values, vectors), (jnp.diagonal(inner).real, vectors @ rotation)
