"""Density matrices: the dual of u(N), in real coordinates, with its Poisson bracket."""

from __future__ import annotations

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .poisson import PoissonBySharp


class DensityMatrices(PoissonBySharp):
    """The Lie-Poisson structure of u(N)* on Hermitian matrices: ``Pi dE = -i [dE, rho]``, in units where hbar is 1.

    A matrix has N^2 real coordinates in a basis that is orthonormal for ``tr(A B)``: its diagonal, then for each pair
    j < k ``sqrt(2)`` times the real part of ``rho_jk``, and in the same order ``sqrt(2)`` times the imaginary part. The
    gradient of ``tr(rho H)`` has the coordinates of H. It is :class:`LiePoisson` of ``u(N)`` where ``i rho`` is the
    matrix of an element of the dual, and ``i H`` that of an element of the algebra.

    Attributes
    ----------
    size : int
        N.
    """

    size: int = eqx.field(static=True)

    @property
    def dim(self) -> int:
        return self.size**2

    def matrix(self, x) -> jax.Array:
        """The Hermitian matrices with coordinates x, shape (..., N^2) to (..., N, N)."""
        parts = (x @ table for table in _tables(self.size))
        real, imaginary = (part.reshape(*part.shape[:-1], self.size, self.size) for part in parts)
        return real + 1j * imaginary if isinstance(x, np.ndarray) else jax.lax.complex(real, imaginary)

    def vector(self, a) -> jax.Array:
        """The coordinates of the Hermitian parts of matrices a, shape (..., N, N): the inverse of :meth:`matrix`."""
        a = jnp.asarray(a)
        real, imaginary = (part.reshape(*part.shape[:-2], -1) for part in (a.real, a.imag))
        first, second = _tables(self.size)
        return real @ first.T + imaginary @ second.T

    def sharp(self, x, alpha) -> jax.Array:
        product = self.matrix(alpha) @ self.matrix(x)
        return self.vector(-2j * product)  # whose Hermitian part has both terms of the commutator


@functools.lru_cache(maxsize=64)
def _tables(n: int) -> tuple[np.ndarray, np.ndarray]:
    """Real and imaginary parts of the basis, shape (N^2, N^2) each: mostly zeros, which a program leaves out."""
    (j, k), on, root = np.triu_indices(n, 1), np.arange(n), np.sqrt(0.5)
    real, imaginary = np.zeros((2, n * n, n, n))
    real[on, on, on] = 1.0
    re = n + np.arange(len(j))
    im = re + len(j)
    real[re, j, k] = real[re, k, j] = imaginary[im, j, k] = root
    imaginary[im, k, j] = -root
    return real.reshape(n * n, -1), imaginary.reshape(n * n, -1)
