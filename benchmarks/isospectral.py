"""The isospectral midpoint scheme for Zeitlin's fluid, as published: the competitor of the library's explicit methods.

``W_n = V - h/2 [P, V] - h^2/4 P V P``, ``W_{n+1} = W_n + h [P, V]`` with ``P = Delta^{-1} V`` [Modin & Viviani 2020,
"A Casimir preserving scheme for long-time simulation of spherical ideal hydrodynamics", J. Fluid Mech. 884, A22, and
the package quflow]. V is found by fixed-point iteration, two products of complex matrices in each: ``P V`` and
``(P V) P``, the commutator being ``P V`` less its adjoint. Products are NumPy's, the Laplacian is inverted by
elimination along each diagonal, in machine code. It conserves the spectrum of W to rounding, and the energy nearly.
"""

from __future__ import annotations

import numba
import numpy as np

EPS = float(np.finfo(float).eps)
"""Machine epsilon of double precision."""


class IsospectralMidpoint:
    """The isospectral midpoint scheme for N by N matrices, in the time of ``W' = [P, W]``."""

    def __init__(self, N: int):
        s = (N - 1) / 2
        self.spin_z = s - np.arange(N)
        self.raising = np.sqrt(np.arange(1.0, N + 1) * (N - np.arange(1.0, N + 1)))
        self.diagonal = 2.0 * s * (s + 1.0)

    def stream_matrix(self, W: np.ndarray) -> np.ndarray:
        """Return the stream matrix P of a vorticity W: anti-Hermitian, traceless, with ``Delta P = W``."""
        P = np.zeros_like(W)
        _solve_laplacian(W, self.spin_z, self.raising, self.diagonal, P)
        return P

    def energy(self, W: np.ndarray) -> float:
        return -0.5 * float(np.vdot(self.stream_matrix(W), W).real)

    def integrate(self, W: np.ndarray, h: float, steps: int) -> tuple[np.ndarray, float]:
        """Take ``steps`` steps from W; return the final matrix and the mean number of iterations per step."""
        n_iterations, change = 0, np.zeros_like(W)
        for _ in range(steps):
            for _ in range(60):
                n_iterations += 1
                V = W + change
                P = (0.5 * h) * self.stream_matrix(V)
                PV = P @ V
                commutator = PV - PV.conj().T
                new_change = commutator + PV @ P
                residual, scale = np.abs(new_change - change).max(), np.abs(W).max()
                change = new_change
                if residual <= 4 * EPS * scale:
                    break
            else:
                raise RuntimeError("the fixed-point iteration of the isospectral midpoint does not converge")
            W = W + 2.0 * commutator
        return W, n_iterations / steps


@numba.njit
def _solve_laplacian(W, z, step, main, P):
    N = W.shape[0]
    ratio, y = np.empty(N), np.empty(N, dtype=np.complex128)
    for m in range(N):
        length = N - m
        pivot, previous_ratio = main - 2.0 * z[0] * z[m], 0.0
        for i in range(length):
            if i > 0:
                off_diagonal = -step[i - 1] * step[i + m - 1]
                pivot, previous_ratio = main - 2.0 * z[i] * z[i + m] - off_diagonal * ratio[i - 1], ratio[i - 1]
                y[i] = -W[i, i + m] - previous_ratio * y[i - 1]
            else:
                y[i] = -W[i, i + m]
            ratio[i] = -step[i] * step[i + m] / pivot if i + 1 < length else 0.0
            P[i, i + m] = y[i] / pivot if (m > 0 or i + 1 < length) else 0.0
        for i in range(length - 2, -1, -1):
            P[i, i + m] -= ratio[i] * P[i + 1, i + m + 1]
        if m > 0:
            for i in range(length):
                P[i + m, i] = -P[i, i + m].conjugate()
    mean = 0.0j
    for i in range(N):
        mean += P[i, i] / N
    for i in range(N):
        P[i, i] -= mean
