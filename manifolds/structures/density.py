"""Density matrices: the dual of u(N), in real coordinates, with its Poisson bracket."""

from __future__ import annotations

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ..matrices.linear import cayley_rate, conjugate_by_stages
from .poisson import PoissonBySharp


class DensityMatrices(PoissonBySharp):
    """Lie-Poisson structure of u(N)* on Hermitian matrices: ``Pi dE = -i [dE, rho]``, in units where hbar is 1.

    A matrix has N^2 real coordinates in a basis that is orthonormal for ``tr(A B)``: its diagonal, then for each pair j
    < k ``sqrt(2)`` times the real part of ``rho_jk``, and in the order of these pairs ``sqrt(2)`` times the imaginary
    part. The gradient of ``tr(rho H)`` has the coordinates of H. It is :class:`LiePoisson` of ``u(N)`` where ``i rho``
    is the matrix of an element of the dual, and ``i H`` that of an element of the algebra.

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
        """Return the Hermitian matrices with coordinates x, shape (..., N^2) to (..., N, N)."""
        (re, im), (factor, sign), _ = _coordinate_indices(self.size)
        real, imaginary = (
            entries.reshape(*entries.shape[:-1], self.size, self.size) for entries in (x[..., re], x[..., im])
        )
        real, imaginary = real * factor, imaginary * sign
        return real + 1j * imaginary if isinstance(x, np.ndarray) else jax.lax.complex(real, imaginary)

    def vector(self, a) -> jax.Array:
        """Return the coordinates of the Hermitian parts of matrices a, shape (..., N, N): the inverse of
        :meth:`matrix`."""
        xp = np if isinstance(a, np.ndarray) else jnp
        transpose, (_, (factor, _), indices) = a.swapaxes(-1, -2), _coordinate_indices(self.size)
        entries = xp.stack(
            [(a.real + transpose.real) * (0.5 / factor), (a.imag - transpose.imag) * (0.5 / factor)], axis=-3
        )
        return entries.reshape(*a.shape[:-2], -1)[..., indices]

    def sharp(self, x, alpha) -> jax.Array:
        product = self.matrix(alpha) @ self.matrix(x)
        return self.vector(-2j * product)  # whose Hermitian part has both terms of the commutator

    def stages_on_leaf(self, x, alpha, A) -> jax.Array:
        """Return ``U_i rho U_i^H``, with stages U_i by A of ``U' = -i H U`` from the identity; eigenvalues are
        conserved."""
        return self.vector(conjugate_by_stages(-1j * self.matrix(alpha), self.matrix(x), A))

    def leaf_covector_rate(self, covector, alpha) -> jax.Array:
        return self.vector(1j * cayley_rate(-1j * self.matrix(covector), -1j * self.matrix(alpha)))


@functools.lru_cache(maxsize=64)
def _coordinate_indices(n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return index arrays between coordinates and matrix entries, with the factors.

    The first array has the coordinate of the real and the imaginary part of each entry, the second the factors of these
    parts, the third the position of each coordinate among the parts.
    """
    (j, k), diagonal, half_root = np.triu_indices(n, 1), np.arange(n), np.sqrt(0.5)
    pairs = n + np.arange(len(j))
    re, im = np.empty((2, n, n), np.uint32)  # without a sign: JAX then looks for no negative ones
    factors = np.full((2, n, n), half_root)
    re[diagonal, diagonal] = im[diagonal, diagonal] = diagonal
    factors[0, diagonal, diagonal], factors[1, diagonal, diagonal] = 1.0, 0.0
    re[j, k] = re[k, j] = pairs
    im[j, k] = im[k, j] = pairs + len(j)
    factors[1, k, j] = -half_root
    entry_indices = np.concatenate([diagonal * (n + 1), j * n + k, n * n + j * n + k])
    return np.stack([re.ravel(), im.ravel()]), factors, entry_indices.astype(np.uint32)
