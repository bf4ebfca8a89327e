"""Qubits, random states and Hamiltonians, and Lindblad's equation as a program of its own, for the tests."""

import functools

import numpy as np
import scipy.integrate
import scipy.linalg

import liethermo as lt

LOWER = np.array([[0.0, 1.0], [0.0, 0.0]], dtype=complex)


X = np.array([[0, 1], [1, 0]], dtype=complex)


Y = np.array([[0, -1j], [1j, 0]], dtype=complex)


Z = np.array([[1, 0], [0, -1]], dtype=complex)


QUBIT = np.diag([0.0, 1.3]).astype(complex)


RHO = np.array([[0.3, 0.2 - 0.1j], [0.2 + 0.1j, 0.7]])


T = 0.7


RATE = 0.2


def infinite(temperature=T):
    return lt.HeatBaths(capacity=np.inf, temperature=temperature)


@functools.cache
def qubit():
    return lt.QuantumSystem(QUBIT, lt.ThermalJumps([(LOWER, RATE)]), baths=infinite())


def random_density(n, seed=0):
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(n, n)) + 1j * rng.normal(size=(n, n))
    return root @ root.conj().T / np.trace(root @ root.conj().T).real


def lindblad(rho, H, jumps):
    """Jumps are pairs of an operator and its rate."""
    found = -1j * (H @ rho - rho @ H)
    for V, rate in jumps:
        n = V.conj().T @ V
        found = found + rate * (V @ rho @ V.conj().T - 0.5 * (n @ rho + rho @ n))
    return found


def motion(q, rho):
    return np.asarray(q.structure.matrix(q.vector_field(q.state(rho))[: q.body_dim]))


FULL = np.random.default_rng(7).normal(size=(3, 3, 2)) @ np.array([1.0, 1.0j])


def random_hermitian(n, seed=11):
    a = np.random.default_rng(seed).normal(size=(n, n, 2)) @ np.array([1.0, 1.0j])
    return (a + a.conj().T) / 2


def solve_by_scipy(rho, capacity, t):
    """A qubit in a finite bath, by a program of its own: the last state, as the matrix and the entropy of the bath."""

    def field(_, y):
        r, warm = (y[:4] + 1j * y[4:8]).reshape(2, 2), T * np.exp(y[8] / capacity)
        omega = QUBIT[1, 1].real
        jumps = [(LOWER, RATE * np.exp(omega / (2 * warm))), (LOWER.T, RATE * np.exp(-omega / (2 * warm)))]
        d = lindblad(r, QUBIT, jumps)
        return np.concatenate([d.ravel().real, d.ravel().imag, [-np.trace(QUBIT @ d).real / warm]])

    y0 = np.concatenate([rho.ravel().real, rho.ravel().imag, [0.0]])
    y = scipy.integrate.solve_ivp(field, (0.0, t), y0, method="DOP853", rtol=1e-13, atol=1e-15).y[:, -1]
    return (y[:4] + 1j * y[4:8]).reshape(2, 2), y[8]


def levels(n, couplings, baths=None):
    return lt.QuantumSystem(random_hermitian(n), couplings, baths)
