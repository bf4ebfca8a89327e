"""Functions on the sphere as matrices: the quantised Laplacian, spherical harmonics and values on a grid.

A real function ``omega = sum a_lm Y_lm`` of degree below N is the anti-Hermitian matrix ``W = i sum a_lm T_lm``, where
T_lm, with entries on the m-th diagonal alone, are orthonormal in ``tr(A^H B)`` [Hoppe 1989]. So norms agree,
``tr(W^H W) = integral of omega**2``, and the constant, l = 0, is the trace, which vorticity does not have. With
``gamma = sqrt(N (N**2 - 1) / (16 pi))`` the commutator ``-gamma [A, B]`` is that of ``{a, b} = n . (grad a x grad b)``
up to O(1 / N**2) [Zeitlin 1991; Modin & Viviani 2020].

The Laplacian is ``Delta P = -sum_a [S_a, [S_a, P]]``, S_a the spin matrices of size N, [Hoppe & Yau 1998]. Its
eigenvalues are ``-l (l + 1)`` exactly, its eigenvectors are the T_lm, and it maps each diagonal to itself by a
tridiagonal matrix: it is inverted in O(N^2).
"""

from __future__ import annotations

import math
from functools import cached_property
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy

import manifolds as mf
from manifolds.matrices.linear import adjoint

from ..dissipation.base import Dissipation
from ..dissipation.brackets import DoubleBracket, KillingDissipation
from ..dissipation.checks import checked_rate
from ..errors import InputError
from ..functions.energy import Energy, Quadratic
from ..systems import LiePoissonSystem
from .parameters import checked_integer

TRACE_RTOL = 1e-12
"""Largest trace of a vorticity, and largest Hermitian part, relative to its norm, that count as rounding."""


@jax.tree_util.register_static
class QuantisedSphere:
    """The N by N matrices that represent functions on the sphere, as states on the dual of su(N).

    A state mu represents the vorticity matrix W by ``mu_a = Re tr(W^H e_a)``, e_a the basis of :func:`manifolds.su`.

    Parameters
    ----------
    N : int, >= 2
        Size of the matrices.

    Attributes
    ----------
    algebra : manifolds.MatrixAlgebra
        The algebra su(N).
    gamma : float
        Factor of the bracket.
    """

    def __init__(self, N: int):
        self.N = checked_integer(N, "N", 2)
        algebra = mf.su(self.N, by_matrices=True)
        assert isinstance(algebra, mf.MatrixAlgebra)
        self.algebra = algebra
        self.gamma = math.sqrt(self.N * (self.N**2 - 1) / (16.0 * math.pi))

    def __eq__(self, other) -> bool:
        return isinstance(other, QuantisedSphere) and self.N == other.N

    def __hash__(self) -> int:
        return hash((QuantisedSphere, self.N))

    # -- the Laplacian ------------------------------------------------------------------------------------------------

    def laplacian(self, mu) -> jax.Array:
        """Return the state of the Laplacian ``Delta W`` of a vorticity, shape (..., N^2 - 1)."""
        return self._apply_to_diagonals(mu, self._laplacian_of_diagonals)

    def inverse_laplacian(self, mu) -> jax.Array:
        """Solve ``Delta P = W`` and return the state of the traceless P, shape (..., N^2 - 1)."""
        return self._apply_to_diagonals(mu, self._inverse_laplacian_of_diagonals)

    def _apply_to_diagonals(self, mu, function) -> jax.Array:
        """Apply a function to the main and upper diagonals of a state, and return the state of the result.

        The function maps arrays of shape (..., N, 2, N), with entry i of diagonal m at [..., i, :, m]."""
        entry_sources, entry_factors, component_sources, component_factors = self._diagonal_index_tables
        tables = self.algebra.matrix_basis
        diagonal = tables.diagonal
        assert diagonal is not None
        mu = jnp.asarray(mu)
        main = (mu[..., diagonal.components] / tables.squared_norms[diagonal.components]) @ diagonal.coefficients.T
        sources = jnp.concatenate([mu, jnp.zeros((*mu.shape[:-1], 1)), main], axis=-1)
        rows = function(sources[..., entry_sources] * entry_factors)
        entries = [rows.reshape(*rows.shape[:-3], -1), rows[..., diagonal.part, 0] @ diagonal.coefficients]
        return jnp.concatenate(entries, axis=-1)[..., component_sources] * component_factors

    @cached_property
    def _diagonal_index_tables(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return source indices and factors that turn a state into the entries [i, :, m] of diagonals, and the reverse.

        The entries of the diagonals below are those above with the sign of an anti-Hermitian matrix, so that they have
        the same products with the basis. What stands on the main diagonal follows the components, or the entries.
        """
        tables, N = self.algebra.matrix_basis, self.N
        i, part, m = np.indices((N, 2, N))
        is_above = (m > 0) & (i + m < N)
        flat_index = i * N + np.minimum(i + m, N - 1)
        entry_sources = np.where(is_above, tables.entry_components[part, flat_index], tables.dim).astype(np.int32)
        entry_factors = np.where(is_above, tables.values[part, flat_index], 0.0)
        component_sources, component_factors = np.zeros(tables.dim, dtype=np.int32), np.ones(tables.dim)
        component_sources[entry_sources[is_above]], component_factors[entry_sources[is_above]] = (
            np.flatnonzero(is_above),
            2.0 * entry_factors[is_above],
        )
        entry_factors /= np.append(tables.squared_norms, 1.0)[entry_sources]
        assert tables.diagonal is not None
        component_sources[tables.diagonal.components] = is_above.size + np.arange(len(tables.diagonal.components))
        entry_sources[:, tables.diagonal.part, 0], entry_factors[:, tables.diagonal.part, 0] = (
            tables.dim + 1 + np.arange(N),
            1.0,
        )
        return entry_sources, entry_factors, component_sources, component_factors

    def _laplacian_of_diagonals(self, diagonals) -> jax.Array:
        """Return the diagonals, shape (..., N, 2, N), of the Laplacian of the matrix with the given diagonals."""
        main, off_diagonal = self._tridiagonal_coefficients
        up = jnp.pad(diagonals[..., 1:, :, :], [(0, 0)] * (diagonals.ndim - 3) + [(0, 1), (0, 0), (0, 0)])
        down = jnp.pad(diagonals[..., :-1, :, :], [(0, 0)] * (diagonals.ndim - 3) + [(1, 0), (0, 0), (0, 0)])
        lower_diagonal = np.pad(off_diagonal[:-1], [(1, 0), (0, 0)])
        return -(main[:, None] * diagonals + off_diagonal[:, None] * up + lower_diagonal[:, None] * down)

    def _inverse_laplacian_of_diagonals(self, diagonals) -> jax.Array:
        """Return the diagonals, shape (..., N, 2, N), of the traceless matrix whose Laplacian has given diagonals."""
        ratio, inverse = self._ldl_factors
        diagonals = jnp.moveaxis(-diagonals, -3, 0)  # the scans run along all diagonals at once

        def eliminate(previous_row, row_and_factor):
            row, factor = row_and_factor
            reduced_row = row - factor * previous_row
            return reduced_row, reduced_row

        def substitute(next_row, row_and_factor):
            row, factor = row_and_factor
            solved_row = row - factor * next_row
            return solved_row, solved_row

        start = jnp.zeros(diagonals.shape[1:])
        _, diagonals = jax.lax.scan(eliminate, start, (diagonals, np.pad(ratio[:-1], [(1, 0), (0, 0)])))
        scaled_rows = diagonals * inverse.reshape(self.N, *[1] * (diagonals.ndim - 2), self.N)
        _, diagonals = jax.lax.scan(substitute, start, (scaled_rows, ratio), reverse=True)
        diagonals = jnp.moveaxis(diagonals, 0, -3)
        mean = jnp.mean(diagonals[..., 0], axis=-2, keepdims=True)  # the main diagonal is known up to a multiple of 1
        return diagonals.at[..., 0].add(-mean)

    @cached_property
    def _entry_mask(self) -> np.ndarray:
        """Array that is 1 at the entries [i, m] that diagonals have, ``i + m < N``, and 0 elsewhere."""
        i, m = np.indices((self.N, self.N))
        return (i + m < self.N).astype(np.float64)

    @cached_property
    def _tridiagonal_coefficients(self) -> tuple[np.ndarray, np.ndarray]:
        """Diagonal and off-diagonal entries of minus the Laplacian of each diagonal m, shapes (N, N) as [i, m]."""
        N, s = self.N, (self.N - 1) / 2.0
        i, m = np.indices((N, N))
        z = s - np.arange(N)  # eigenvalues of S_z
        step = np.sqrt(np.arange(1.0, N + 1) * (N - np.arange(1.0, N + 1)))  # entries of S_+, the last one zero
        j = np.minimum(i + m, N - 1)
        main = (2.0 * s * (s + 1.0) - 2.0 * z[i] * z[j]) * self._entry_mask
        off_diagonal = -step[i] * step[j] * (i + m + 1 < N)
        return main, off_diagonal

    @cached_property
    def _ldl_factors(self) -> tuple[np.ndarray, np.ndarray]:
        """Factors ``L D L^T`` of minus the Laplacian: the subdiagonal of L and the entries of 1 / D, zero outside."""
        main, off_diagonal = self._tridiagonal_coefficients
        inverse, ratio = np.zeros(main.shape), np.zeros(main.shape)
        pivot = main[0].copy()
        for i in range(self.N):
            has_pivot = self._entry_mask[i] > 0.0
            if i == self.N - 1:
                has_pivot = has_pivot & (np.arange(self.N) > 0)  # the last pivot of the main diagonal is zero
            inverse[i, has_pivot] = 1.0 / pivot[has_pivot]
            ratio[i] = off_diagonal[i] * inverse[i]
            if i + 1 < self.N:
                pivot = main[i + 1] - off_diagonal[i] * ratio[i]
        return ratio, inverse

    # -- matrices and spherical harmonics -----------------------------------------------------------------------------

    def state(self, vorticity) -> jax.Array:
        """Return the state of an anti-Hermitian, traceless vorticity matrix, shape (N, N).

        Raises
        ------
        InputError
            If the matrix is not anti-Hermitian, or has a trace: the integral of vorticity over the sphere vanishes.
        """
        W = np.asarray(vorticity)
        if W.shape != (self.N, self.N):
            raise InputError(f"vorticity must have shape ({self.N}, {self.N}), got {W.shape}")
        norm = max(float(np.linalg.norm(W)), np.finfo(float).tiny)
        skew, trace = float(np.linalg.norm(W + adjoint(W))) / norm, float(abs(np.trace(W))) / norm
        if not skew <= TRACE_RTOL:
            raise InputError(f"vorticity must be anti-Hermitian, but W + W^H is {skew:.3g} of its norm")
        if not trace <= TRACE_RTOL:
            raise InputError(
                f"the vorticity has a trace of {trace:.3g} of its norm: its integral over the sphere must be 0. "
                "Subtract np.trace(W) / N from its diagonal"
            )
        return self.algebra.from_dual_matrix(W)

    def matrix(self, mu) -> jax.Array:
        """Return the vorticity matrix W of a state, shape (..., N, N)."""
        return self.algebra.dual_matrix(mu)

    def magnetic_state(self, vorticity, potential) -> jax.Array:
        """Return the state of a :func:`magnetic_fluid` from vorticity and magnetic potential, each a state of this
        sphere."""
        dual_components = self.algebra.matrix_basis.raise_index(jnp.asarray(potential))
        return jnp.concatenate([jnp.asarray(vorticity), dual_components], axis=-1)

    def magnetic_fields(self, x) -> tuple[jax.Array, jax.Array]:
        """Return the states of vorticity and magnetic potential of a magnetic fluid, from its state."""
        x, n = jnp.asarray(x), self.algebra.dim
        return x[..., :n], self.algebra.matrix_basis.lower_index(x[..., n:])

    def from_coefficients(self, a) -> jax.Array:
        """Return the state of ``omega = sum_l a_l0 Y_l0 + sum_{m > 0} 2 Re(a_lm Y_lm)``, shape (N^2 - 1,).

        Parameters
        ----------
        a : array of complex, shape (L + 1, L + 1), L < N
            ``a[l, m]`` for m >= 0; entries with m > l count as nothing. Y_lm are orthonormal and have the phase of
            Condon and Shortley, as those of SciPy.

        Raises
        ------
        InputError
            If l reaches N, ``a[0, 0]`` is not zero or an ``a[l, 0]`` is not real.
        """
        a = np.asarray(a, dtype=np.complex128)
        if a.ndim != 2 or a.shape[0] != a.shape[1] or not 1 <= len(a) <= self.N:
            raise InputError(f"coefficients a[l, m] must have shape (L + 1, L + 1) with L < {self.N}, got {a.shape}")
        if a[0, 0] != 0.0:
            raise InputError(f"a[0, 0], the mean of the vorticity, must be 0, got {a[0, 0]}")
        if a[:, 0].imag.any():
            raise InputError("the coefficients a[l, 0] of a real function must be real")
        W = np.zeros((self.N, self.N), dtype=np.complex128)
        for m in range(len(a)):
            vectors = self.harmonics(m, len(a) - 1)
            rows = np.arange(self.N - m)
            W[rows, rows + m] = 1j * (vectors @ a[m:, m])
        return self.algebra.from_dual_matrix(W - adjoint(np.triu(W, 1)))

    def coefficients(self, mu, max_degree: int | None = None) -> np.ndarray:
        """Return the coefficients of a state up to degree L = ``max_degree``, shape (L + 1, L + 1).

        This is the inverse of :meth:`from_coefficients`.
        """
        L = self.N - 1 if max_degree is None else min(checked_integer(max_degree, "the largest degree"), self.N - 1)
        W, a = np.asarray(self.matrix(mu)), np.zeros((L + 1, L + 1), dtype=np.complex128)
        for m in range(L + 1):
            a[m:, m] = self.harmonics(m, L).T @ (-1j * np.diagonal(W, m))
        return a

    def harmonics(self, m: int, max_degree: int) -> np.ndarray:
        """Return the m-th diagonals of the matrix harmonics T_lm, l = m, …, ``max_degree``, as orthonormal columns."""
        main, off_diagonal = self._tridiagonal_coefficients
        length = self.N - m
        _, vectors = scipy.linalg.eigh_tridiagonal(
            main[:length, m], off_diagonal[: length - 1, m], select="i", select_range=(0, max_degree - m)
        )
        return (
            (-1.0) ** m
            * vectors
            * np.sign(vectors[np.argmax(np.abs(vectors) > 1e-8, axis=0), np.arange(max_degree - m + 1)])
        )

    def on_grid(self, mu, shape: tuple[int, int] = (128, 256), max_degree: int | None = None) -> np.ndarray:
        """Return the values of the function on a grid of colatitudes and longitudes, in the given shape."""
        a = self.coefficients(mu, max_degree)
        theta = math.pi * (np.arange(shape[0]) + 0.5) / shape[0]
        waves = np.zeros((shape[0], shape[1]), dtype=np.complex128)
        for m in range(len(a)):
            profile = normalised_associated_legendre(m, len(a) - 1, theta) @ a[m:, m]
            waves[:, m % shape[1]] += profile * (1.0 if m == 0 else 2.0)
        return np.fft.ifft(waves, axis=1).real * shape[1]

    def random(self, seed: int, degrees: tuple[int, int], enstrophy: float = 1.0) -> jax.Array:
        """Return the state of a random vorticity of given enstrophy, with equal expected amplitudes in a range of l."""
        min_degree, max_degree = degrees
        if not 1 <= min_degree <= max_degree < self.N:
            raise InputError(f"degrees must be an increasing pair from 1 to {self.N - 1}, got {degrees}")
        random = np.random.default_rng(seed)
        a = random.standard_normal((max_degree + 1, max_degree + 1)) + 1j * random.standard_normal(
            (max_degree + 1, max_degree + 1)
        )
        l, m = np.indices(a.shape)
        a = np.where((l >= min_degree) & (m <= l), a, 0.0)
        a[:, 0] = math.sqrt(2.0) * a[:, 0].real
        mu = self.from_coefficients(a)
        return mu * math.sqrt(enstrophy / float(jnp.sum(mu * mu)))


def normalised_associated_legendre(m: int, max_degree: int, theta: np.ndarray) -> np.ndarray:
    """Return ``Y_lm(theta, 0)`` for l = m, …, L = ``max_degree``, shape (thetas, L - m + 1), by the recurrence in l."""
    x, sine = np.cos(theta), np.sin(theta)
    k = np.arange(1, m + 1)
    log_norm = 0.5 * np.log((2.0 * k + 1.0) / (2.0 * k)).sum() - 0.5 * math.log(4.0 * math.pi)
    columns = [(-1.0) ** m * np.exp(log_norm + m * np.log(sine))]
    previous_column = np.zeros_like(x)
    for l in range(m + 1, max_degree + 1):
        a = math.sqrt((4.0 * l * l - 1.0) / (l * l - m * m))
        b = math.sqrt(((l - 1.0) ** 2 - m * m) / (4.0 * (l - 1.0) ** 2 - 1.0)) if l > m + 1 else 0.0
        previous_column, new_column = columns[-1], a * (x * columns[-1] - b * previous_column)
        columns.append(new_column)
    return np.stack(columns, axis=1)


class FluidKineticEnergy(Energy):
    """The kinetic energy of a fluid on the sphere times gamma, ``gamma / 2 tr(W^H (-Delta)^{-1} W)``."""

    sphere: QuantisedSphere = eqx.field(static=True)

    is_quadratic = True

    def gradient(self, x) -> jax.Array:
        psi = self.sphere.inverse_laplacian(x)
        return -self.sphere.gamma * self.sphere.algebra.matrix_basis.raise_index(psi)

    def value(self, x) -> jax.Array:
        return 0.5 * jnp.dot(x, self.gradient(x))


def zeitlin(N: int, decay: Literal["enstrophy", "energy"] | None = None, rate=0.0) -> LiePoissonSystem:
    """A two-dimensional ideal fluid on the unit sphere, its vorticity an N by N matrix: the dual of su(N).

    ``W' = gamma [P, W]``, ``Delta P = W``, is ``omega' = -{psi, omega}``, ``Delta psi = omega``, for functions of
    degree below N, in the time of the fluid. Coordinates, harmonics and pictures are those of
    :class:`liethermo.models.QuantisedSphere`. All ``tr W^k`` are conserved, as all integrals of powers of vorticity
    are. The entropy is minus the enstrophy ``integral omega^2 / 2 = tr(W^H W) / 2``, a Casimir. Decay is one of two
    mirror images:

    "enstrophy"
        ``W' = gamma [P, W] + rate gamma^2 [P, [P, W]]``: the energy is constant and the enstrophy falls, by
        ``rate tr|gamma [P, W]|^2``, until ``[P, W] = 0``, where vorticity is a function of the stream function. This is
        the selective decay of Gay-Balmaz and Holm [2013], and :class:`KillingDissipation` here.
    "energy"
        ``W' = gamma [P, W] + rate gamma^2 [W, [P, W]]``: every Casimir is constant and the energy falls, towards the
        same states [Vallis, Carnevale & Young 1989]; :class:`DoubleBracket` here.

    A step of an explicit method takes O(N^3) operations in products of matrices, and O(N^2) memory.

    Parameters
    ----------
    N : int, >= 2
        Size of the matrices.
    decay : {"enstrophy", "energy"}, optional
        The function that decays; by default none.
    rate : float, >= 0
        Rate of the decay, in units of time for "enstrophy" and 1 / time for "energy".

    Returns
    -------
    LiePoissonSystem
        Its energy is gamma times that of the fluid, so that its time is that of the fluid.

    Raises
    ------
    InputError
    manifolds.SizeError
        If N is so large that a step would not fit into memory.

    Examples
    --------
    >>> fluid = lt.models.zeitlin(8, decay="enstrophy", rate=0.1)
    >>> fluid.dim
    63
    """
    sphere, rate = QuantisedSphere(N), checked_rate(rate)
    if decay not in (None, "enstrophy", "energy"):
        raise InputError(f"decay must be 'enstrophy', 'energy' or None, got {decay!r}")
    dissipation: Dissipation | None = None
    if decay == "enstrophy":  # -kappa is N on components, 2N on matrices
        dissipation = KillingDissipation(rate / (2.0 * sphere.N))
    elif decay == "energy":  # a motion's components of mu are half of those of its matrix
        dissipation = DoubleBracket(2.0 * sphere.gamma * rate)
    return LiePoissonSystem(
        sphere.algebra,
        FluidKineticEnergy(sphere),
        Quadratic(np.full(sphere.algebra.dim, -2.0)),
        dissipation,
        validate=False,  # the axioms hold by construction, and testing Jacobi would take O(N^6)
    )


class MagneticEnergy(Energy):
    """Gamma times the energy of flow and magnetic field, ``gamma / 2 (tr W^H (-Delta)^{-1} W + tr B^H (-Delta) B)``."""

    sphere: QuantisedSphere = eqx.field(static=True)

    is_quadratic = True

    def gradient(self, x) -> jax.Array:
        sphere, n = self.sphere, self.sphere.algebra.dim
        tables = sphere.algebra.matrix_basis
        velocity = tables.raise_index(sphere.inverse_laplacian(x[:n]))
        current = sphere.laplacian(tables.lower_index(x[n:]))
        return -sphere.gamma * jnp.concatenate([velocity, current])

    def value(self, x) -> jax.Array:
        return 0.5 * jnp.dot(x, self.gradient(x))


def magnetic_fluid(N: int, rate=0.0) -> LiePoissonSystem:
    """A conducting fluid on the unit sphere, its vorticity W and magnetic potential B N by N matrices.

    ``W' = gamma ([P, W] + [J, B])``, ``B' = gamma [P, B]`` with ``Delta P = W``, ``J = Delta B`` is
    ``omega' = -{psi, omega} + {theta, Delta theta}``, ``theta' = -{psi, theta}`` for functions of degree below N: the
    potential theta is carried by the flow, and its field acts on the flow by the force of Lorentz. The system is that
    of :func:`manifolds.magnetic_extension` of su(N), a state the components of W in the dual of su(N) and those of B
    in su(N). Conserved are the energy, all ``tr B^k`` and all ``tr W B^k``: the integrals of functions of theta, and
    of vorticity times these. The first of the latter is the cross helicity.

    With a rate the motion ``(F, G) = (W', B')`` has the friction ``rate gamma ([W, F] + [B, G])`` in W and
    ``rate gamma [B, F]`` in B, a double bracket: the energy decays, and all these Casimirs are kept, so the flow tends
    to an equilibrium of less energy with the same integrals of theta.

    Parameters
    ----------
    N : int, >= 2
        Size of the matrices.
    rate : float, >= 0
        Rate of the decay (1 / time).

    Returns
    -------
    LiePoissonSystem
        Its energy is gamma times that of the fluid, so that its time is that of the fluid. States are made by
        :meth:`QuantisedSphere.magnetic_state`, and taken apart by :meth:`QuantisedSphere.magnetic_fields`.

    Raises
    ------
    InputError
    manifolds.SizeError
    """
    sphere, rate = QuantisedSphere(N), checked_rate(rate)
    algebra = mf.magnetic_extension(sphere.algebra, by_brackets=True)
    # a concrete zero leaves the double bracket out
    is_undamped = not isinstance(rate, jax.core.Tracer) and not float(rate)
    # components of a motion of W are half of those of its matrix, and those of B have twice its dual ones
    metric = np.repeat([1.0, 0.25], sphere.algebra.dim)
    dissipation: Dissipation | None = None if is_undamped else DoubleBracket(2.0 * sphere.gamma * rate, metric)
    return LiePoissonSystem(algebra, MagneticEnergy(sphere), None, dissipation, validate=False)
