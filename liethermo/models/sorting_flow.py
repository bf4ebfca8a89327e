"""Gradient flows on adjoint orbits: Brockett's flow, which sorts eigenvalues, and the Toda lattice."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

import manifolds as mf

from ..dissipation.brackets import DoubleBracket
from ..dissipation.checks import checked_rate
from ..errors import InputError
from ..functions.energy import Linear
from ..systems import LiePoissonSystem


def sorting_flow(target, rate=1.0) -> LiePoissonSystem:
    """Brockett's flow ``L' = rate [L, [L, N]]`` of a Hermitian matrix, with N = diag(target), on the dual of u(n).

    The eigenvalues of L are constant, tr(L N) grows, and L becomes diagonal, with its eigenvalues in the order of the
    target [Brockett 1991]. The system is Lie-Poisson with the energy ``-tr(L N)`` and a double bracket, so L turns as
    well: ``L' = -i [L, N] + rate [L, [L, N]]``. The turn multiplies L_jk by ``exp(i (N_j - N_k) t)`` and nothing else,
    since N is diagonal: the diagonal and the moduli of the entries are those of Brockett's flow.

    Parameters
    ----------
    target : array, shape (n,)
        Diagonal of N, all entries different (1 / (energy of L * time), with a rate of 1).
    rate : float, >= 0
        Rate of the flow relative to the turn.

    Returns
    -------
    LiePoissonSystem
        Its states are those of :func:`hermitian_state`.

    Raises
    ------
    InputError
        If the target is not an array of at least 2 different finite numbers.

    Examples
    --------
    >>> flow = lt.models.sorting_flow([1.0, 2.0, 3.0])
    >>> x0 = lt.models.hermitian_state([[3.0, 0.5, 0.1], [0.5, 2.0, 0.4], [0.1, 0.4, 1.0]])
    >>> x = lt.integrate(flow, x0, (0.0, 20.0), 0.02, method=lt.MetriplecticGauss(2)).x[-1]
    >>> bool((np.diff(np.diag(lt.models.hermitian_matrix(x).real)) > 0.0).all())
    True
    """
    entries = np.asarray(target, dtype=np.float64)
    if (
        entries.ndim != 1
        or len(np.unique(entries)) != entries.size
        or entries.size < 2
        or not np.isfinite(entries).all()
    ):
        raise InputError(f"target must be an array of at least 2 different finite numbers, got {target!r}")
    algebra = mf.u(len(entries))
    gradient = algebra.vee(-1j * np.diag(entries))
    return LiePoissonSystem(
        algebra, Linear(gradient), dissipation=DoubleBracket(checked_rate(rate), 1.0 / _basis_squared_norms(algebra))
    )


def toda_flow(n: int) -> LiePoissonSystem:
    """Toda's lattice of n particles in Moser's variables: the sorting flow with the target (n, n - 1, …, 1).

    A tridiagonal L stays tridiagonal up to the phases of :func:`sorting_flow`. On its diagonal it becomes what the
    steps of the QR algorithm make of it: ``L(t) = Q^T L(0) Q`` with ``exp(t L(0)) = Q R``
    [Bloch, Brockett & Ratiu 1992].

    Parameters
    ----------
    n : int, >= 2
        Number of particles.

    Returns
    -------
    LiePoissonSystem
        Its states are those of :func:`hermitian_state`.
    """
    return sorting_flow(np.arange(n, 0, -1.0))


def hermitian_state(L) -> jax.Array:
    """Return the state of a Hermitian matrix, shape (n, n), on the dual of u(n), shape (n**2,).

    Parameters
    ----------
    L : array, shape (n, n)
        A Hermitian matrix.

    Raises
    ------
    InputError
        If the matrix is not square and Hermitian.
    """
    matrix = np.asarray(L)
    if matrix.ndim != 2 or matrix.shape[0] != matrix.shape[1] or not np.allclose(matrix, matrix.conj().T, atol=1e-12):
        raise InputError(f"L must be a Hermitian matrix, got an array of shape {matrix.shape}. Use (L + L^H) / 2")
    basis = mf.u(len(matrix)).basis
    return jnp.asarray(np.einsum("ij,aji->a", -1j * matrix, basis).real)


def hermitian_matrix(x) -> jax.Array:
    """Return the Hermitian matrices of states, shape (..., n**2) to (..., n, n): the inverse of
    :func:`hermitian_state`.

    Parameters
    ----------
    x : array, shape (..., n**2)
        States of a flow on the dual of u(n).
    """
    state = jnp.asarray(x)
    algebra = mf.u(round(state.shape[-1] ** 0.5))
    return -1j * jnp.einsum("...a,aij->...ij", state / _basis_squared_norms(algebra), algebra.basis)


def _basis_squared_norms(algebra: mf.LieAlgebra) -> np.ndarray:
    """Return ``tr(e_a^H e_a)`` of each element of the orthogonal basis of u(n), shape (n**2,)."""
    basis = algebra._require_basis()
    gram = np.einsum("aij,bij->ab", basis.conj(), basis).real
    assert np.allclose(gram, np.diag(np.diag(gram))), "the basis of u(n) is orthogonal"
    return np.diag(gram)
