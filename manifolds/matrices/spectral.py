"""Functions of Hermitian matrices by their eigenvalues, and traces of them, with derivatives of every order.

Derivatives are by divided differences (:mod:`.chains`), so that they are finite and exact where eigenvalues meet.
"""

from __future__ import annotations

import functools
import math
from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
import scipy.special

from .._pytree_module import forward_to
from .chains import matrix_function_chain
from .linear import adjoint
from .symmetric import eigh

MAX_SPREAD_FOR_MEAN = 1 / 16
"""Largest spread of points, relative to the width of a function, for which divided differences are means of
derivatives.

Beyond, a quotient of differences loses four bits. Up to it, the error of a mean over four nodes is rounding.
"""


class ScalarFunction:
    """Function of a number with its derivatives; instances must be hashable, and equal ones must be one function."""

    @abstractmethod
    def derivative(self, x, order: int) -> jax.Array:
        """Return the derivative of an order, entry by entry; order 0 is the function itself."""

    @abstractmethod
    def width(self, x) -> jax.Array:
        """Return the distance from x to the nearest singularity, or the length over which the function changes much."""

    def difference_quotient(self, x, y) -> jax.Array:
        """Return the first divided difference ``f[x, y]``."""
        return self._mean_or_quotient(x, y)

    @property
    def derivative_function(self) -> ScalarFunction:
        """Derivative as a :class:`ScalarFunction`."""
        return Derivative(self)

    def divided_difference(self, *points) -> jax.Array:
        """Return ``f[x0, …, xk]`` of arrays that broadcast; it does not depend on the order of the points."""
        if len(points) == 1:
            return self.derivative(points[0], 0)
        broadcast_points = jnp.broadcast_arrays(*points)
        return (
            self.difference_quotient(*broadcast_points)
            if len(broadcast_points) == 2
            else self._mean_or_quotient(*broadcast_points)
        )

    def _mean_or_quotient(self, *points) -> jax.Array:
        """Return a divided difference: by a mean of derivatives if the points are close, else by differences."""
        sorted_points = _sort_entrywise(points)
        width = jnp.stack([self.width(x) for x in sorted_points]).min(axis=0)
        gap = sorted_points[-1] - sorted_points[0]
        use_mean = gap <= MAX_SPREAD_FOR_MEAN * width
        difference = self.divided_difference(*sorted_points[1:]) - self.divided_difference(*sorted_points[:-1])
        return jnp.where(use_mean, self._simplex_mean(sorted_points, 4), difference / jnp.where(use_mean, 1.0, gap))

    def _simplex_mean(self, points, n_nodes: int) -> jax.Array:
        """Return the mean of the k-th derivative over the simplex of k + 1 points [Genocchi & Hermite], by Gauss
        quadrature."""
        k = len(points) - 1
        barycentric, weights = _simplex_quadrature(k, n_nodes)
        nodes = jnp.tensordot(barycentric, jnp.stack(points), 1)
        return jnp.tensordot(weights, self.derivative(nodes, k), 1)


def _sort_entrywise(points) -> list[jax.Array]:
    """Sort points in ascending order, entry by entry; NaN propagates."""
    points = list(points)
    for end in range(len(points) - 1, 0, -1):
        for i in range(end):
            points[i], points[i + 1] = jnp.minimum(points[i], points[i + 1]), jnp.maximum(points[i], points[i + 1])
    return points


def _simplex_quadrature(k: int, n_nodes: int) -> tuple[np.ndarray, np.ndarray]:
    """Return barycentric coordinates and weights of Gauss quadrature on a simplex; the weights sum to 1 / k!.

    The rule is a product rule in collapsed coordinates.
    """
    barycentric, weights = np.ones((1, 1)), np.ones(1)
    for i in range(k):
        x, w = scipy.special.roots_jacobi(n_nodes, k - 1 - i, 0)  # of the weight (1 - u)^(k - 1 - i)
        u, w = (x + 1) / 2, w / 2.0 ** (k - i)
        repeated_points = np.repeat(barycentric, n_nodes, axis=0)
        node_column = np.tile(u, len(barycentric))[:, None]
        barycentric = np.concatenate(
            [
                repeated_points[:, :-1],
                repeated_points[:, -1:] * node_column,
                repeated_points[:, -1:] * (1 - node_column),
            ],
            axis=1,
        )
        weights = np.repeat(weights, n_nodes) * np.tile(w, len(weights))
    return barycentric, weights


@dataclass(frozen=True)
class Exp(ScalarFunction):
    """Exponential function."""

    def derivative(self, x, order):
        return jnp.exp(x)

    def width(self, x):
        return jnp.ones_like(x)

    def difference_quotient(self, x, y):
        gap = jnp.abs(x - y)
        is_equal = gap == 0.0
        return jnp.exp(jnp.maximum(x, y)) * jnp.where(is_equal, 1.0, -jnp.expm1(-gap) / jnp.where(is_equal, 1.0, gap))

    @property
    def derivative_function(self):
        return self


@dataclass(frozen=True)
class Log(ScalarFunction):
    """Function ``log(offset + x)``."""

    offset: float = 0.0

    def derivative(self, x, order):
        if order == 0:
            return jnp.log1p(x) if self.offset == 1.0 else jnp.log(self.offset + x)
        return -math.factorial(order - 1) * (-1.0 / (self.offset + x)) ** order

    def width(self, x):
        return self.offset + x

    def difference_quotient(self, x, y):
        smaller_argument, gap = self.offset + jnp.minimum(x, y), jnp.abs(x - y)
        is_equal = gap == 0.0
        return jnp.where(
            is_equal, 1.0 / smaller_argument, jnp.log1p(gap / smaller_argument) / jnp.where(is_equal, 1.0, gap)
        )

    @property
    def derivative_function(self):
        return Reciprocal(self.offset)


@dataclass(frozen=True)
class Reciprocal(ScalarFunction):
    """Function ``1 / (offset + x)``."""

    offset: float = 0.0

    def derivative(self, x, order):
        return (-1.0) ** order * math.factorial(order) / (self.offset + x) ** (order + 1)

    def width(self, x):
        return jnp.abs(self.offset + x)

    def divided_difference(self, *points):
        quotient = self.derivative(points[0], 0)
        for x in points[1:]:
            quotient = -quotient * self.derivative(x, 0)
        return quotient


@dataclass(frozen=True)
class Sqrt(ScalarFunction):
    """Square root."""

    def derivative(self, x, order):
        factor = math.prod(0.5 - i for i in range(order))
        return factor * jnp.sqrt(x) / x**order if order else jnp.sqrt(x)

    def width(self, x):
        return x

    def difference_quotient(self, x, y):
        return 1.0 / (jnp.sqrt(x) + jnp.sqrt(y))


@dataclass(frozen=True)
class Derivative(ScalarFunction):
    """Derivative of a :class:`ScalarFunction`."""

    function: ScalarFunction

    def derivative(self, x, order):
        return self.function.derivative(x, order + 1)

    width = forward_to("function")


@dataclass(frozen=True)
class GenericFunction(ScalarFunction):
    """Function without a known formula, with as many derivatives as JAX takes."""

    function: Callable

    def derivative(self, x, order):
        if order == 0:
            return self.function(x)
        return jax.jvp(lambda x: self.derivative(x, order - 1), (x,), (jnp.ones_like(x),))[1]

    def width(self, x):
        raise NotImplementedError

    def _mean_or_quotient(self, *points):
        """Return the more accurate of two estimates: a quotient of differences, or a mean of derivatives.

        The rounding error of the quotient is compared to the change of the mean from six nodes to eight.
        """
        sorted_points = _sort_entrywise(points)
        gap = sorted_points[-1] - sorted_points[0]
        upper_difference, lower_difference = (
            self.divided_difference(*sorted_points[1:]),
            self.divided_difference(*sorted_points[:-1]),
        )
        is_equal = gap == 0.0
        quotient = (upper_difference - lower_difference) / jnp.where(is_equal, 1.0, gap)
        rounding = (
            jnp.finfo(jnp.float64).eps
            * (jnp.abs(upper_difference) + jnp.abs(lower_difference))
            / jnp.where(is_equal, 1.0, gap)
        )
        mean = self._simplex_mean(sorted_points, 8)
        use_mean = is_equal | (jnp.abs(mean - self._simplex_mean(sorted_points, 6)) <= rounding)
        return jnp.where(use_mean, mean, quotient)


KNOWN_FUNCTIONS: dict[Callable, ScalarFunction] = {
    jnp.exp: Exp(),
    jnp.log: Log(),
    jnp.log1p: Log(1.0),
    jnp.sqrt: Sqrt(),
    jnp.reciprocal: Reciprocal(),
}
"""Functions of ``jax.numpy`` with divided differences in closed form."""


def scalar_function(f: Callable | ScalarFunction) -> ScalarFunction:
    """Return ``f`` as a :class:`ScalarFunction`."""
    return f if isinstance(f, ScalarFunction) else KNOWN_FUNCTIONS.get(f) or GenericFunction(f)


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
    return matrix_function_chain(SpectralFunction(scalar_function(f)), [jnp.asarray(a)], (0,), np.zeros(1))


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
    a and b are equal, it is symmetric in a and b, and its rounding error is relative: no difference of values is taken.

    Parameters
    ----------
    f
        As for :func:`spectral`.
    a, b : array, shape (..., n, n)
        Hermitian.
    """
    a, b = jnp.asarray(a), jnp.asarray(b)
    gradient = matrix_function_chain(
        SpectralFunction(scalar_function(f)), [a, b], (0, 1), np.zeros(2), [np.eye(a.shape[-1], dtype=a.dtype)]
    )
    return (gradient + adjoint(gradient)) / 2


def apply_log_mean(logs, shift, x) -> jax.Array:
    """Return ``L X``, with the logarithmic mean of ``e^-s A`` from the left and ``e^s A`` from the right, ``A =
    exp(logs)``.

    In eigenvectors of A ``(L X)_kl = X_kl (u - v) / (ln u - ln v)`` with ``u = e^-s p_k`` and ``v = e^s p_l``. The mean
    is the divided difference of exp at the logarithms, and so has all its derivatives [Carlen & Maas 2017].

    Parameters
    ----------
    logs : array, shape (..., n, n)
        Hermitian.
    shift : float, or array, shape (...)
        s.
    x : array, shape (..., n, n)
    """
    shift = jnp.asarray(shift)
    return matrix_function_chain(
        SpectralFunction(scalar_function(jnp.exp)), [logs], (0, 0), jnp.stack([-shift, shift], axis=-1), [x]
    )


@dataclass(frozen=True)
class SpectralFunction:
    """Function of Hermitian matrices by their eigenvalues, with its chains: see :class:`.chains.MatrixFunction`."""

    function: ScalarFunction

    def decompose(self, a, unrolled: bool) -> tuple[jax.Array, jax.Array]:
        return _eigenvalues_and_vectors(a)

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


def _eigenvalues_and_vectors(a) -> tuple[jax.Array, jax.Array]:
    """Return the eigenvalues of the Hermitian part of a, in no order, and orthonormal eigenvectors as columns."""
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
    values, vectors = _eigenvalues_and_vectors(a)
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
