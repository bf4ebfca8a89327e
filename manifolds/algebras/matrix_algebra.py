"""Classical matrix algebras of any size, computed by products of matrices in O(N^3) time and O(N^2) memory."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .._arguments import check_memory, is_integer
from .._arrays import is_traced, real_components, square_matrices
from .._pytree_module import forward_to
from ..errors import LieAlgebraError, ParameterError
from ..matrices.linear import Diagonal
from .bracket_algebra import BracketAlgebra
from .lie_algebra import LieAlgebra
from .matrix_bases import MatrixBasis

MAX_FOLLOWED_DEGREE = 4
"""Largest power whose trace is followed along a motion."""

MatrixParts = tuple[jax.Array, ...]
"""Real part of a matrix and, if it is complex, its imaginary part; the empty tuple stands for the identity."""


@dataclass(frozen=True)
class ClassicalData:
    """Facts about a classical algebra that need no computation.

    Attributes
    ----------
    rank : int
        Number of Casimirs.
    signature : tuple of int
        Numbers of positive, negative and zero eigenvalues of the Killing form.
    killing_coefficients : tuple of float
        (c, d) of the Killing form ``c tr(xy) - d tr(x) tr(y)``.
    is_compact : bool
        True if all matrices are anti-Hermitian.
    trace_degrees : tuple of int
        Degrees of the traces of powers that generate the Casimirs.
    pfaffian_degree : int or None
        Degree of the Pfaffian, if there is one besides.
    """

    rank: int
    signature: tuple[int, int, int]
    killing_coefficients: tuple[float, float]
    is_compact: bool
    trace_degrees: tuple[int, ...]
    pfaffian_degree: int | None = None


@jax.tree_util.register_static
class MatrixAlgebra(BracketAlgebra):
    """Classical algebra of large matrices, as made by ``manifolds.su(N)``, ``so``, ``sl``, ``sp``, ``u`` and ``gl``.

    ``[x, y]`` and ``ad*_x mu`` are computed from the matrices of x, y and mu: mu is the matrix M of the algebra with
    ``<mu, y> = Re tr(M^H y)``, so ``ad*_x mu`` is the covector of ``[x^H, M]``. A product of complex matrices takes
    three real ones, and a commutator of anti-Hermitian matrices takes one product.

    Attributes
    ----------
    matrix_size : int
        The size N.
    matrix_basis : MatrixBasis
    classical_data : ClassicalData
    """

    def __init__(self, name: str, matrix_basis: MatrixBasis, classical_data: ClassicalData):
        super().__init__(name, matrix_basis.dim)
        self.matrix_basis, self.classical_data, self.matrix_size = matrix_basis, classical_data, matrix_basis.size

    @property
    def _key(self):
        return self.name, self.dim

    # -- the operations -----------------------------------------------------------------------------------------------

    def bracket(self, x, y) -> jax.Array:
        x, y = self._element(x, "x"), self._element(y, "y")
        return self._bracket_of_matrices(self.matrix_basis.matrix(x), self.matrix_basis.matrix(y))

    def ad_star(self, x, mu) -> jax.Array:
        x, mu = self._element(x, "x"), self._element(mu, "mu")
        return self._ad_star_of_matrix(self.matrix_basis.matrix(x), mu)

    def action(self, x) -> MatrixAction:
        return MatrixAction(self, self.matrix_basis.matrix(self._element(x, "x")))

    def _bracket_of_matrices(self, X: MatrixParts, Y: MatrixParts) -> jax.Array:
        return self.matrix_basis.raise_index(self._commutator_inner_products(X, Y))

    def _ad_star_of_matrix(self, X: MatrixParts, mu) -> jax.Array:
        return self._commutator_inner_products(
            _conjugate_transpose(X), self.matrix_basis.matrix(self.matrix_basis.raise_index(mu))
        )

    def _commutator_inner_products(self, X: MatrixParts, Y: MatrixParts) -> jax.Array:
        """Return ``<[X, Y], e_a>`` for each a, shape (..., dim).

        For anti-Hermitian matrices ``[X, Y] = X Y - (X Y)^H``, and the two terms have equal products with each e_a.
        """
        products = self.matrix_basis.inner_products(_multiply_parts(X, Y))
        return (
            2.0 * products
            if self.classical_data.is_compact
            else products - self.matrix_basis.inner_products(_multiply_parts(Y, X))
        )

    def _components(self, X: MatrixParts) -> jax.Array:
        return self.matrix_basis.raise_index(self.matrix_basis.inner_products(X))

    def hat(self, x) -> jax.Array:
        """Return the matrix ``sum_a x_a e_a``, shape (..., N, N)."""
        return _combine_parts(self.matrix_basis.matrix(self._element(x, "x")))

    def vee(self, X) -> jax.Array:
        """Return the components of a matrix of the algebra, shape (..., dim): the inverse of :meth:`hat`.

        LieAlgebraError if ``X`` is not in the algebra (residual above 1e-8 relative), except under tracing.
        """
        matrix = square_matrices(X, self.matrix_size, "X")
        components = self._components(self._split_parts(matrix))
        if not is_traced(matrix):
            residual = float(
                jnp.max(jnp.abs(_combine_parts(self.matrix_basis.matrix(components)) - matrix), initial=0.0)
            )
            tolerance = 1e-8 * max(1.0, float(jnp.max(jnp.abs(matrix), initial=0.0)))
            if not residual <= tolerance:
                trace = float(jnp.max(jnp.abs(jnp.trace(matrix, axis1=-2, axis2=-1))))
                trace_text = f", and its trace is {trace:.3g}" if trace > tolerance else ""
                raise LieAlgebraError(
                    f"the matrix is not in {self.name}: it is {residual:.3g} away from it (tolerance {tolerance:.1g})"
                    + trace_text,
                    residual=residual,
                    tolerance=tolerance,
                )
        return components

    def dual_matrix(self, mu) -> jax.Array:
        """Return the matrix M of the algebra with ``<mu, y> = Re tr(M^H hat(y))`` for every y, shape (..., N, N)."""
        return _combine_parts(self.matrix_basis.matrix(self.matrix_basis.raise_index(self._element(mu, "mu"))))

    def from_dual_matrix(self, M) -> jax.Array:
        """Return mu of a matrix M, shape (..., dim): the inverse of :meth:`dual_matrix`; M is first projected onto the
        algebra."""
        return self.matrix_basis.inner_products(self._split_parts(square_matrices(M, self.matrix_size, "M")))

    def trace_covector(self, x) -> jax.Array:
        """Return the covector ``y -> Re tr(hat(x) hat(y))`` of x by the invariant trace form, shape (..., dim)."""
        x = self._element(x, "x")
        if self.classical_data.is_compact:
            return -self.matrix_basis.lower_index(x)
        return self.matrix_basis.inner_products(_conjugate_transpose(self.matrix_basis.matrix(x)))

    def _split_parts(self, matrix) -> MatrixParts:
        return (matrix.real, matrix.imag)[: self.matrix_basis.parts]

    # -- structure ----------------------------------------------------------------------------------------------------

    @property
    def basis(self) -> np.ndarray:
        numbers = float(self.dim) * self.matrix_size**2 * self.matrix_basis.parts
        check_memory(numbers, f"the matrices of the basis of {self.name}", "hat and vee need no list of them")
        return self._basis_matrices

    @cached_property
    def _basis_matrices(self) -> np.ndarray:
        return self.matrix_basis.basis_matrices()

    def _build_by_constants(self) -> LieAlgebra:
        one = jnp.eye(self.dim)
        constants = np.stack([np.asarray(self.bracket(e, one)) for e in one])
        constants[np.abs(constants) < 1e-15 * np.abs(constants).max()] = 0.0
        return LieAlgebra((constants - constants.swapaxes(0, 1)) / 2, name=self.name, basis=self.basis)

    def killing_form(self) -> np.ndarray:
        self._check_matrix_memory("the Killing form")
        return np.asarray(jax.vmap(self._killing_covector)(jnp.eye(self.dim)))

    def _killing_covector(self, x) -> jax.Array:
        """Return the covector ``kappa(x, .)``."""
        c, d = self.classical_data.killing_coefficients
        X = self.matrix_basis.matrix(x)
        traces = [jnp.trace(part, axis1=-2, axis2=-1)[..., None, None] * np.eye(self.matrix_size) for part in X]
        return self.matrix_basis.inner_products(
            tuple(
                c * a - d * sign * t for a, t, sign in zip(_conjugate_transpose(X), traces, (1.0, -1.0), strict=False)
            )
        )

    def killing_inner_product(self) -> Any:
        if self.is_semisimple() and self.matrix_basis.is_orthogonal:
            return Diagonal(jnp.asarray(self.classical_data.killing_coefficients[0] * self.matrix_basis.squared_norms))
        return TraceForm(self)

    def killing_signature(self) -> tuple[int, int, int]:
        return self.classical_data.signature

    def cartan_involution(self) -> np.ndarray:
        if not self.is_semisimple():
            raise LieAlgebraError(f"{self.name} is not semisimple, so it has no Cartan involution")
        self._check_matrix_memory("the Cartan involution")
        images = jax.vmap(
            lambda e: self._components(tuple(-a for a in _conjugate_transpose(self.matrix_basis.matrix(e))))
        )
        return np.asarray(images(jnp.eye(self.dim)).T)

    def is_abelian(self) -> bool:
        return False

    def is_unimodular(self) -> bool:
        return True

    def derived_series(self) -> list[int]:
        centre = self.classical_data.signature[2]
        return [self.dim, self.dim - centre] if centre else [self.dim]

    def lower_central_series(self) -> list[int]:
        return self.derived_series()

    # -- Casimirs -----------------------------------------------------------------------------------------------------

    def casimir_count(self) -> int:
        return self.classical_data.rank

    def _casimirs_of_degree(self, degree: int) -> list:
        """Return the trace of a power of the matrix of mu, if it is independent of the traces of lower degree.

        Raises
        ------
        LieAlgebraError
            If the degree is that of the Pfaffian, which is not formed for large matrices.
        """
        if not is_integer(degree) or degree < 1:
            raise ParameterError(f"the degree of a Casimir must be an integer >= 1, got {degree!r}")
        if degree == self.classical_data.pfaffian_degree:
            raise LieAlgebraError(
                f"{self.name} has a Casimir of degree {degree}, its Pfaffian, that is not formed for large matrices; "
                "its square is the determinant, a polynomial in the traces of the even powers"
            )
        return [MatrixTrace(self, int(degree))] if degree in self.classical_data.trace_degrees else []

    def leading_casimirs(self) -> list[tuple[str, Callable]]:
        return [
            (str(F), F)
            for d in self.classical_data.trace_degrees
            if d <= MAX_FOLLOWED_DEGREE
            for F in [MatrixTrace(self, d)]
        ]


class MatrixAction:
    """Action of one x by its matrix."""

    def __init__(self, g: MatrixAlgebra, X: MatrixParts):
        self.g, self.X = g, X

    def bracket(self, y) -> jax.Array:
        return self.g._bracket_of_matrices(self.X, self.g.matrix_basis.matrix(y))

    def ad_star(self, mu) -> jax.Array:
        return self.g._ad_star_of_matrix(self.X, mu)


@jax.tree_util.register_static
@dataclass(frozen=True)
class TraceForm:
    """Linear map of ``-kappa(x, theta y)`` or, if the algebra is not semisimple, of ``-kappa(x, y)``."""

    algebra: MatrixAlgebra

    def __matmul__(self, x) -> jax.Array:
        g = self.algebra
        if g.is_semisimple():
            return g.classical_data.killing_coefficients[0] * g.matrix_basis.lower_index(x)
        return -g._killing_covector(x)


@jax.tree_util.register_static
@dataclass(frozen=True)
class MatrixTrace:
    """Casimir ``tr(M(mu)**degree)``, for anti-Hermitian matrices ``tr((i M)**degree)``: shape (..., dim) to (...).

    M(mu) is :meth:`MatrixAlgebra.dual_matrix`.

    Parameters
    ----------
    algebra : MatrixAlgebra
        The algebra.
    degree : int
        The power of the matrix.
    """

    algebra: MatrixAlgebra
    degree: int

    dim = forward_to("algebra")

    def __call__(self, mu) -> jax.Array:
        g = self.algebra
        element = g.matrix_basis.raise_index(real_components(mu, g.dim, "mu"))
        if g.classical_data.is_compact and self.degree == 2:
            return jnp.sum(jnp.asarray(mu) * element, axis=-1)
        M = g.matrix_basis.matrix(element)
        if g.classical_data.is_compact:  # i (a + i b) = -b + i a
            M = (-M[1], M[0]) if len(M) == 2 else (jnp.zeros_like(M[0]), M[0])
        return _trace_of_power(self.degree, g.classical_data.is_compact, M)

    def __str__(self) -> str:
        return f"tr({'(i M)' if self.algebra.classical_data.is_compact else 'M'}**{self.degree})"


@functools.partial(jax.custom_jvp, nondiff_argnums=(0, 1))
def _trace_of_power(n: int, hermitian: bool, M: MatrixParts) -> jax.Array:
    """Return ``Re tr(M**n)``, shape (..., N, N) to (...); its derivatives take as few products as the value."""
    return _real_trace_of_product(_matrix_power(M, n - n // 2), _matrix_power(M, n // 2))


@_trace_of_power.defjvp
def _trace_of_power_jvp(n: int, hermitian: bool, primals, tangents):
    (M,), (dM,) = primals, tangents
    return _trace_of_power(n, hermitian, M), n * _trace_of_power_times_matrix(n - 1, hermitian, M, dM)


@functools.partial(jax.custom_jvp, nondiff_argnums=(0, 1))
def _trace_of_power_times_matrix(n: int, hermitian: bool, M: MatrixParts, D: MatrixParts) -> jax.Array:
    """Return ``Re tr(M**n D)``."""
    return _real_trace_of_product(_matrix_power(M, n), D)


@_trace_of_power_times_matrix.defjvp
def _trace_of_power_times_matrix_jvp(n: int, hermitian: bool, primals, tangents):
    """Return ``Re tr(M**n D)`` and its derivative along ``(dM, dD)``."""
    (M, D), (dM, dD) = primals, tangents
    derivative = _trace_of_power_times_matrix(n, hermitian, M, dD)
    for i in range(n if not hermitian else (n + 1) // 2):
        multiplicity = 2.0 if hermitian and 2 * i != n - 1 else 1.0
        derivative = derivative + multiplicity * _real_trace_of_product(
            _multiply_parts(_multiply_parts(_matrix_power(M, n - 1 - i), D), _matrix_power(M, i)), dM
        )
    return _trace_of_power_times_matrix(n, hermitian, M, D), derivative


def _matrix_power(M: MatrixParts, n: int) -> MatrixParts:
    """Return ``M**n``; the empty tuple stands for 1."""
    if n <= 1:
        return M if n else ()
    half = _matrix_power(M, n // 2)
    return _multiply_parts(_multiply_parts(half, half), M if n % 2 else ())


def _real_trace_of_product(X: MatrixParts, Y: MatrixParts) -> jax.Array:
    """Return ``Re tr(X Y)``."""
    if not (X and Y):
        return jnp.trace((X or Y)[0], axis1=-2, axis2=-1)
    traces = [jnp.sum(x * jnp.swapaxes(y, -1, -2), axis=(-2, -1)) for x, y in zip(X, Y, strict=True)]
    return traces[0] - sum(traces[1:])


def _multiply_parts(X: MatrixParts, Y: MatrixParts) -> MatrixParts:
    """Return the product X Y in real and imaginary parts; the empty tuple stands for 1."""
    if not (X and Y):
        return X or Y
    if len(X) == 1:
        return (X[0] @ Y[0],)
    (a, b), (c, d) = X, Y
    real, imaginary, combined = a @ c, b @ d, (a + b) @ (c + d)
    return real - imaginary, combined - real - imaginary


def _conjugate_transpose(X: MatrixParts) -> MatrixParts:
    """Return ``X^H`` in real and imaginary parts."""
    return tuple(sign * jnp.swapaxes(part, -1, -2) for sign, part in zip((1.0, -1.0), X, strict=False))


def _combine_parts(X: MatrixParts) -> jax.Array:
    """Return a matrix as one array, complex if it has an imaginary part."""
    return X[0] if len(X) == 1 else jax.lax.complex(X[0], X[1])
