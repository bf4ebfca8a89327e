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
        (re, im), (size, sign), _ = _coordinate_indices(self.size)
        real, imaginary = (part.reshape(*part.shape[:-1], self.size, self.size) for part in (x[..., re], x[..., im]))
        real, imaginary = real * size, imaginary * sign
        return real + 1j * imaginary if isinstance(x, np.ndarray) else jax.lax.complex(real, imaginary)

    def vector(self, a) -> jax.Array:
        """The coordinates of the Hermitian parts of matrices a, shape (..., N, N): the inverse of :meth:`matrix`."""
        xp = np if isinstance(a, np.ndarray) else jnp
        turned, (_, (size, _), chosen) = a.swapaxes(-1, -2), _coordinate_indices(self.size)
        parts = xp.stack([(a.real + turned.real) * (0.5 / size), (a.imag - turned.imag) * (0.5 / size)], axis=-3)
        return parts.reshape(*a.shape[:-2], -1)[..., chosen]

    def sharp(self, x, alpha) -> jax.Array:
        product = self.matrix(alpha) @ self.matrix(x)
        return self.vector(-2j * product)  # whose Hermitian part has both terms of the commutator

    def stages_on_leaf(self, x, alpha, A) -> jax.Array:
        """``U_i rho U_i^H``, the U_i stages by A of ``U' = -i H U`` from the identity; the eigenvalues stay."""
        return self.vector(conjugate_by_stages(-1j * self.matrix(alpha), self.matrix(x), A))

    def leaf_covector_rate(self, covector, alpha) -> jax.Array:
        return self.vector(1j * cayley_rate(-1j * self.matrix(covector), -1j * self.matrix(alpha)))


@functools.lru_cache(maxsize=64)
def _coordinate_indices(n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where in the coordinates the parts of each entry stand, and their factors; where in the parts the coordinates."""
    (j, k), on, root = np.triu_indices(n, 1), np.arange(n), np.sqrt(0.5)
    pairs = n + np.arange(len(j))
    re, im = np.empty((2, n, n), np.uint32)  # without a sign: JAX then looks for no negative ones
    factors = np.full((2, n, n), root)
    re[on, on] = im[on, on] = on
    factors[0, on, on], factors[1, on, on] = 1.0, 0.0
    re[j, k] = re[k, j] = pairs
    im[j, k] = im[k, j] = pairs + len(j)
    factors[1, k, j] = -root
    chosen = np.concatenate([on * (n + 1), j * n + k, n * n + j * n + k])
    return np.stack([re.ravel(), im.ravel()]), factors, chosen.astype(np.uint32)
