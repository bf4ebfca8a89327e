"""Poisson structures: a skew tensor Pi(x) with ``{f, g} = grad f . Pi grad g`` and ``x' = Pi grad H`` [BFM 2.1].

Among them are the dual of an algebra, density matrices (the dual of u(N)), and the phase space of several bodies with
an entropy each [SML §5].
"""

from __future__ import annotations

import functools
from abc import abstractmethod
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .._arrays import real_components
from .._pytree_module import Module, forward_to
from ..algebras.bracket_algebra import BracketAlgebra
from ..algebras.lie_algebra import LieAlgebra
from ..errors import ParameterError, ShapeError
from ..matrices.linear import adjoint, conjugate_by_collocation_stages, inverse_dcayley


class PoissonStructure(Module):
    """Poisson structure on R^n; subclasses implement :meth:`tensor`, and :meth:`sharp` if it is cheaper.

    Attributes
    ----------
    dim : int or None
        Number of coordinates; None where a user's function did not say.
    """

    @property
    @abstractmethod
    def dim(self) -> int | None: ...

    @abstractmethod
    def tensor(self, x) -> jax.Array:
        """Return the matrix Pi(x), shape (n, n), at one point x, shape (n,)."""

    def sharp(self, x, alpha) -> jax.Array:
        """Return ``Pi(x) alpha``, shape (n,), for a covector alpha, shape (n,)."""
        return self.tensor(x) @ alpha

    def stages_on_leaf(self, x, alpha, A) -> jax.Array | None:
        """Return stage points whose motions add up to one along the symplectic leaf of x, shape (s, n); None if not
        known.

        With the weights b of a symplectic Runge-Kutta method, ``x + sum_i b_i Pi(u_i) alpha_i`` is on the leaf, and has
        all Casimirs of x, even where their gradients are linearly dependent [Modin & Viviani 2020].

        Parameters
        ----------
        x : array, shape (n,)
        alpha : array, shape (s, n)
            Covectors at the stages.
        A : array, shape (s, s)
            The matrix of the method, times the step.
        """
        return None

    def leaf_displacement(self, x, covector) -> jax.Array:
        """Return the displacement of x along its leaf by a covector K, shape (n,): ``Pi(u) K``, u the middle of that
        step.

        Parameters
        ----------
        x : array, shape (n,)
        covector : array, shape (n,)
            K: a gradient times a time.
        """
        points = self.stages_on_leaf(x, covector[None], np.full((1, 1), 0.5))
        assert points is not None
        return self.sharp(points[0], covector)

    def leaf_covector_rate(self, covector, alpha) -> jax.Array | None:
        """Return ``K'`` for which x, displaced by K, moves by ``x' = Pi(x) alpha``, shape (n,); None if not known.

        The displacement is :meth:`leaf_displacement`. The rate is smooth, and alpha at K = 0: any method finds K, at
        its order, and the displaced point is on the leaf however K is rounded.

        Parameters
        ----------
        covector : array, shape (n,)
            K.
        alpha : array, shape (n,)
        """
        return None

    def bracket(self, f: Callable, g: Callable) -> Callable:
        """Return the function ``{f, g}``: ``x -> grad f @ Pi(x) @ grad g``."""

        def value(x):
            x = jnp.asarray(x, dtype=jnp.float64)
            return jnp.dot(jax.grad(f)(x), self.sharp(x, jax.grad(g)(x)))

        return value

    def hamiltonian_vector_field(self, H: Callable) -> Callable:
        """Return the vector field ``X_H = Pi grad H``, for which ``X_H(f) = {f, H}``."""

        def field(x):
            x = jnp.asarray(x, dtype=jnp.float64)
            return self.sharp(x, jax.grad(H)(x))

        return field

    def jacobi_residual(self, x) -> jax.Array:
        """Return the largest ``|Pi_il d_l Pi_jk + cyclic|`` at the point x: zero for a Poisson tensor [BFM §2.1]."""
        x = real_components(x, self._state_dim(x), "x")
        tensor, derivative = self.tensor(x), jax.jacfwd(self.tensor)(x)
        term = jnp.einsum("il,jkl->ijk", tensor, derivative)
        return jnp.max(jnp.abs(term + term.transpose(1, 2, 0) + term.transpose(2, 0, 1)))

    def rank(self, x) -> int:
        """Return the rank of Pi(x): the dimension of the symplectic leaf through x."""
        return int(np.linalg.matrix_rank(np.asarray(self.tensor(real_components(x, self._state_dim(x), "x")))))

    def _state_dim(self, x) -> int:
        """Return the dimension of the states; that of x if the structure has states of any dimension."""
        return jnp.shape(x)[-1] if self.dim is None else self.dim


class LiePoisson(PoissonStructure):
    """Lie-Poisson structure on g*: ``Pi(mu)[b, a] = sum_c C[a, b, c] mu_c``, so ``Pi(mu) xi = ad*_xi mu`` [BFM 3.1].

    Parameters
    ----------
    algebra : LieAlgebra
        The Lie algebra g.
    """

    algebra: LieAlgebra = eqx.field(static=True)

    dim = forward_to("algebra")

    def tensor(self, x) -> jax.Array:
        return self.algebra.poisson_tensor(x)

    def sharp(self, x, alpha) -> jax.Array:
        return self.algebra.ad_star(alpha, x)

    def stages_on_leaf(self, x, alpha, A) -> jax.Array | None:
        """Return stage points on the leaf of x, by the stages A; None but for the matrices of u(n), su(n) and so(n)."""
        skew_matrices = _unitary_basis_and_dual(self.algebra)
        if skew_matrices is None:
            return None
        basis, dual = skew_matrices
        conjugates = conjugate_by_collocation_stages(-jnp.tensordot(alpha, basis, 1), jnp.tensordot(x, dual, 1), A)
        return jnp.einsum("sij,aji->sa", conjugates, basis).real

    def leaf_covector_rate(self, covector, alpha) -> jax.Array | None:
        skew_matrices = _unitary_basis_and_dual(self.algebra)
        if skew_matrices is None:
            return None
        basis, dual = skew_matrices
        k, b = (-jnp.tensordot(v, basis, 1) for v in (covector, alpha))
        return -jnp.einsum("ij,aji->a", inverse_dcayley(k, b), dual).real


@functools.lru_cache(maxsize=64)
def _unitary_basis_and_dual(algebra: LieAlgebra) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the basis of all skew-Hermitian matrices of a size, or the traceless or the real ones, and its dual basis.

    None for other algebras: their groups are not all of the matrices that preserve a form.
    """
    basis = None if isinstance(algebra, BracketAlgebra) else algebra.basis  # which may be too large to be made
    if basis is None or np.abs(basis + adjoint(basis)).max() > 1e-14 * np.abs(basis).max():
        return None
    n = basis.shape[-1]
    if algebra.dim not in ((n**2, n**2 - 1) if np.iscomplexobj(basis) else (n * (n - 1) // 2,)):
        return None
    products = np.einsum("aij,bji->ab", basis, basis).real
    return basis, np.tensordot(np.linalg.inv(products), basis, 1)


class Canonical(PoissonStructure):
    """Canonical structure on T*R^n, coordinates (q_1 … q_n, p_1 … p_n): ``q' = H_p``, ``p' = -H_q``.

    Parameters
    ----------
    degrees_of_freedom : int
        n, the number of positions.
    """

    degrees_of_freedom: int = eqx.field(static=True)

    def __check_init__(self):
        if not isinstance(self.degrees_of_freedom, int) or self.degrees_of_freedom < 1:
            raise ParameterError(f"degrees_of_freedom must be a positive integer, got {self.degrees_of_freedom!r}")

    @property
    def dim(self) -> int:
        return 2 * self.degrees_of_freedom

    def tensor(self, x) -> jax.Array:
        del x  # the tensor is constant
        identity, zero = np.eye(self.degrees_of_freedom), np.zeros((self.degrees_of_freedom,) * 2)
        return jnp.asarray(np.block([[zero, identity], [-identity, zero]]))

    def sharp(self, x, alpha) -> jax.Array:
        position, momentum = jnp.split(alpha, 2)
        return jnp.concatenate([momentum, -position])


class PoissonTensor(PoissonStructure):
    """Poisson structure given by its tensor: a constant (n, n) matrix, or a function from x, shape (n,), to one.

    The tensor is not checked: ``jacobi_residual`` measures the Jacobi identity at a point, and a dynamical system
    built on the structure checks skewness and Jacobi at random points.

    Parameters
    ----------
    matrix : array, shape (n, n), or function from x, shape (n,), to one
        Pi, skew.
    dim : int, optional
        n. A function without it has states of any length.

    Examples
    --------
    >>> rotations = mf.PoissonTensor(lambda x: jnp.cross(jnp.eye(3), x), 3)
    >>> print(
    ...     rotations.rank(np.array([0.0, 0.0, 1.0])),
    ...     bool(rotations.jacobi_residual(np.ones(3)) < 1e-14),
    ... )
    2 True
    """

    matrix: Callable | jax.Array
    size: int | None = eqx.field(static=True)

    def __init__(self, matrix, dim: int | None = None):
        if not callable(matrix):
            matrix = jnp.asarray(matrix, dtype=jnp.float64)
            if matrix.ndim != 2 or matrix.shape[0] != matrix.shape[1]:
                raise ShapeError(f"a Poisson tensor must be a square matrix, got an array of shape {matrix.shape}")
            dim = matrix.shape[0]
        self.matrix, self.size = matrix, dim

    @property
    def dim(self) -> int | None:
        return self.size

    def tensor(self, x) -> jax.Array:
        return jnp.asarray(self.matrix(x)) if callable(self.matrix) else self.matrix


class PoissonBySharp(PoissonStructure):
    """Poisson structure that is defined by :meth:`sharp`."""

    @abstractmethod
    def sharp(self, x, alpha) -> jax.Array: ...

    def tensor(self, x) -> jax.Array:
        return jax.vmap(lambda axis: self.sharp(x, axis), out_axes=1)(jnp.eye(self._state_dim(x)))


class PoissonMap(PoissonBySharp):
    """Poisson structure given by a function from x and a covector alpha, shapes (n,), to ``Pi(x) alpha``.

    It serves large n, where the matrix would be mostly zeros. It is not checked, as in :class:`PoissonTensor`.

    Parameters
    ----------
    function : callable
        From (x, alpha), two arrays of shape (n,), to ``Pi(x) alpha``, shape (n,); linear in alpha.
    size : int
        n, the number of state components.
    """

    function: Callable
    size: int = eqx.field(static=True)

    @property
    def dim(self) -> int:
        return self.size

    def sharp(self, x, alpha) -> jax.Array:
        return jnp.asarray(self.function(x, alpha))


class ProductPoisson(PoissonStructure):
    """Product of two structures on states (x, y), each of which concerns its own components only."""

    first: PoissonStructure
    second: PoissonStructure

    @property
    def dim(self) -> int:
        assert self.first.dim is not None
        assert self.second.dim is not None
        return self.first.dim + self.second.dim

    def tensor(self, x) -> jax.Array:
        n = self.first.dim
        return jax.scipy.linalg.block_diag(self.first.tensor(x[:n]), self.second.tensor(x[n:]))

    def sharp(self, x, alpha) -> jax.Array:
        n = self.first.dim
        return jnp.concatenate([self.first.sharp(x[:n], alpha[:n]), self.second.sharp(x[n:], alpha[n:])])

    def stages_on_leaf(self, x, alpha, A) -> jax.Array | None:
        n = self.first.dim
        x_stages = self.first.stages_on_leaf(x[:n], alpha[:, :n], A)
        y_stages = self.second.stages_on_leaf(x[n:], alpha[:, n:], A)
        return None if x_stages is None or y_stages is None else jnp.concatenate([x_stages, y_stages], axis=-1)

    def leaf_covector_rate(self, covector, alpha) -> jax.Array | None:
        n = self.first.dim
        x_rate = self.first.leaf_covector_rate(covector[:n], alpha[:n])
        y_rate = self.second.leaf_covector_rate(covector[n:], alpha[n:])
        return None if x_rate is None or y_rate is None else jnp.concatenate([x_rate, y_rate])


class NoPoisson(PoissonStructure):
    """Trivial structure ``Pi = 0``: no reversible motion, and every function is a Casimir.

    Parameters
    ----------
    size : int
        The number of state components.
    """

    size: int = eqx.field(static=True)

    @property
    def dim(self) -> int:
        return self.size

    def tensor(self, x) -> jax.Array:
        return jnp.zeros((self.size, self.size))

    def sharp(self, x, alpha) -> jax.Array:
        return jnp.zeros_like(alpha)

    def stages_on_leaf(self, x, alpha, A) -> jax.Array:
        return jnp.broadcast_to(x, alpha.shape)

    def jacobi_residual(self, x) -> jax.Array:
        return jnp.zeros(())


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
        (re, im), (factor, sign), _ = _entry_coordinates_and_factors(self.size)
        real, imaginary = (
            entries.reshape(*entries.shape[:-1], self.size, self.size) for entries in (x[..., re], x[..., im])
        )
        real, imaginary = real * factor, imaginary * sign
        return real + 1j * imaginary if isinstance(x, np.ndarray) else jax.lax.complex(real, imaginary)

    def vector(self, a) -> jax.Array:
        """Return the coordinates of the Hermitian parts of matrices a, shape (..., N, N): the inverse of
        :meth:`matrix`."""
        xp = np if isinstance(a, np.ndarray) else jnp
        transpose, (_, (factor, _), indices) = a.swapaxes(-1, -2), _entry_coordinates_and_factors(self.size)
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
        return self.vector(conjugate_by_collocation_stages(-1j * self.matrix(alpha), self.matrix(x), A))

    def leaf_covector_rate(self, covector, alpha) -> jax.Array:
        return self.vector(1j * inverse_dcayley(-1j * self.matrix(covector), -1j * self.matrix(alpha)))


@functools.lru_cache(maxsize=64)
def _entry_coordinates_and_factors(n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the index arrays, with factors, that convert between coordinates and matrix entries.

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


class StateIndices(NamedTuple):
    """Indices of all q, p and S in a state of several (q_a, p_a, S_a), and the body a that owns each q."""

    q: np.ndarray
    p: np.ndarray
    S: np.ndarray
    owner: np.ndarray


class ParticleIndices(NamedTuple):
    """Indices of the particle numbers in a state, and the body that owns each."""

    N: np.ndarray
    owner: np.ndarray


class ExtendedPhaseSpace(PoissonStructure):
    """Poisson structure on ``T*R^n_1 x R x … x T*R^n_N x R``, coordinates (q_1, p_1, S_1, q_2, …): canonical [SML §5].

    Every S_a is a Casimir function. With n_a = 0 a body has S_a alone. ``species`` gives the number of particle numbers
    that follow the S_a of each body; they are Casimir functions too.

    Parameters
    ----------
    degrees_of_freedom : tuple of int
        n_a, the number of positions of each body.
    species : tuple of int
        The number of particle numbers of each body; by default none.
    """

    degrees_of_freedom: tuple[int, ...] = eqx.field(static=True)
    species: tuple[int, ...] = eqx.field(static=True, default=())

    def __check_init__(self):
        for numbers, label in ((self.degrees_of_freedom, "degrees of freedom"), (self.species or (0,), "species")):
            if not (isinstance(numbers, tuple) and numbers and all(isinstance(n, int) and n >= 0 for n in numbers)):
                raise ParameterError(f"{label} must be a tuple of integers >= 0, got {numbers!r}")
        if self.species and len(self.species) != len(self.degrees_of_freedom):
            raise ParameterError(f"species are given for {len(self.species)} of {len(self.degrees_of_freedom)} bodies")

    @property
    def dim(self) -> int:
        return 2 * sum(self.degrees_of_freedom) + len(self.degrees_of_freedom) + sum(self.species)

    @property
    def state_indices(self) -> StateIndices:
        """Indices of all q, p and S in a state."""
        return _build_indices(self.degrees_of_freedom, self.species)[0]

    @property
    def particle_indices(self) -> ParticleIndices:
        """Indices of the particle numbers in a state."""
        return _build_indices(self.degrees_of_freedom, self.species)[1]

    def tensor(self, x) -> jax.Array:
        del x  # constant
        return jnp.asarray(np.eye(self.dim)[self._conjugate_indices] * self._conjugate_signs[:, None])

    def sharp(self, x, alpha) -> jax.Array:
        del x
        return self._conjugate_signs * alpha[self._conjugate_indices]

    @property
    def _conjugate_indices(self) -> np.ndarray:
        q, p, _, _ = self.state_indices
        partner = np.arange(self.dim)
        partner[q], partner[p] = p, q
        return partner

    @property
    def _conjugate_signs(self) -> np.ndarray:
        q, p, _, _ = self.state_indices
        sign = np.zeros(self.dim)
        sign[q], sign[p] = 1.0, -1.0
        return sign


@functools.lru_cache(maxsize=64)
def _build_indices(
    degrees_of_freedom: tuple[int, ...], species: tuple[int, ...]
) -> tuple[StateIndices, ParticleIndices]:
    """Return the indices of q, p and S, and of the particle numbers, in a state of several bodies."""
    n, m = np.array(degrees_of_freedom), np.array(species or (0,) * len(degrees_of_freedom))
    starts = np.cumsum(2 * n + 1 + m) - (2 * n + 1 + m)
    owner, holder = np.repeat(np.arange(len(n)), n), np.repeat(np.arange(len(n)), m)
    q = starts[owner] + np.arange(n.sum()) - np.repeat(np.cumsum(n) - n, n)
    S = starts + 2 * n
    N = S[holder] + 1 + np.arange(m.sum()) - np.repeat(np.cumsum(m) - m, m)
    return StateIndices(q, q + n[owner], S, owner), ParticleIndices(N, holder)
