"""Frames that turn with a drive, in which a resonant Hamiltonian is constant."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import manifolds as mf
from manifolds._class_members import ListedType
from manifolds._pytree_module import Module
from manifolds.matrices.linear import adjoint

from ..dissipation.lindblad import LindbladJumps, OperatorFunction
from ..dissipation.operators import Operator, checked_hermitian, checked_square_matrix, level_gap_rounding
from ..dissipation.quantum import cluster_labels
from ..errors import InputError
from ..functions.energy import Energy
from .hamiltonian import hamiltonian_energy


class RotatingFrame(metaclass=ListedType):
    """A frame that turns by ``exp(-i G t)``: its density matrices are ``exp(i G t) rho exp(-i G t)`` (hbar = 1).

    There the Hamiltonian is ``exp(i G t) H(t) exp(-i G t) - G``. It is constant for a drive that turns with G. A linear
    drive, ``H0 + cos(omega t) D``, leaves terms that oscillate at ``2 omega``; the rotating-wave approximation drops
    them.

    Parameters
    ----------
    generator : array, shape (N, N)
        G, Hermitian (energy). For a drive of the frequency omega between two groups of levels it is omega times the
        projector onto the upper group.

    Raises
    ------
    InputError

    Examples
    --------
    The optical Bloch equations: an atom with the frequency 10, a laser of 9.8 with the Rabi frequency 0.4, decay 0.1.

    >>> excited, lower = np.diag([0.0, 1.0]), np.array([[0.0, 1.0], [0.0, 0.0]])
    >>> frame = lt.RotatingFrame(9.8 * excited)
    >>> H = frame.rotating_wave(10.0 * excited, 0.4 * (lower + lower.T), frequency=9.8)
    >>> np.round(H.real, 12).tolist()
    [[0.0, 0.2], [0.2, 0.2]]
    >>> atom = lt.QuantumSystem(H, frame.jumps([(lower, 0.1)]))
    >>> round(float(atom.density(atom.steady_state().x)[1, 1].real), 4)
    0.3265
    """

    generator: np.ndarray
    levels: np.ndarray
    vectors: np.ndarray

    def __init__(self, generator):
        self.generator = checked_hermitian(generator, "the generator of a frame")
        self.levels, self.vectors = np.linalg.eigh(self.generator)

    def __repr__(self) -> str:
        return f"<RotatingFrame of {len(self.levels)} levels, frequencies {self.levels.round(6).tolist()}>"

    def hamiltonian(self, hamiltonian, times=None) -> Callable:
        """Return the Hamiltonian in the frame, a function of t to an array, shape (N, N), without approximation.

        Parameters
        ----------
        hamiltonian, times
            As of :class:`QuantumSystem`.
        """
        size, energy = hamiltonian_energy(hamiltonian, times)
        self._check_size((size, size), "the Hamiltonian")
        return _FrameHamiltonian(energy, jnp.asarray(self.levels), Operator(self.vectors))

    def rotating_wave(self, constant, drive, frequency: float, phase: float = 0.0) -> np.ndarray:
        """Return the constant part, shape (N, N), of ``constant + cos(frequency t + phase) drive`` in the frame.

        The terms that are left out oscillate. They matter little if they are small beside their frequencies: for a
        drive of the strength Omega at ``2 frequency``, the shift of Bloch and Siegert is ``Omega^2 / (4 frequency)``.

        Parameters
        ----------
        constant, drive : array, shape (N, N)
            Hermitian (energy).
        frequency : float
            Of the drive (1 / time).
        phase : float
            Of the drive (rad).

        Raises
        ------
        InputError
            If no part of the drive is at rest in the frame.
        """
        H, D = checked_hermitian(constant, "the constant part"), checked_hermitian(drive, "the drive")
        for matrix, what in ((H, "the constant part"), (D, "the drive")):
            self._check_size(matrix.shape, what)
        tolerance = self._tolerance + 1e-12 * abs(frequency)
        resonant = np.zeros_like(H)
        # exp(i G t) V exp(-i G t) = V exp(-i omega t) for a component with [G, V] = -omega V
        for omega, component in self.components(D).items():
            if abs(omega - frequency) <= tolerance:
                resonant += 0.5 * np.exp(1j * phase) * component
            if abs(omega + frequency) <= tolerance:
                resonant += 0.5 * np.exp(-1j * phase) * component
        if D.any() and not resonant.any():
            found = ", ".join(f"{omega:.6g}" for omega in self.components(D) if omega >= 0.0)
            raise InputError(
                f"no part of the drive is at rest in the frame: its frequencies there are {found}, and that of the "
                f"drive is {frequency:.6g}. Give the frame a generator whose level distances contain that frequency"
            )
        at_rest = self.components(H)
        static = sum((V for omega, V in at_rest.items() if abs(omega) <= self._tolerance), np.zeros_like(H))
        H = static - self.generator + resonant
        return (H + adjoint(H)) / 2

    def components(self, operator) -> dict[float, np.ndarray]:
        """Return the components V of an operator with ``[G, V] = -omega V`` by their frequencies omega, ascending.

        Parameters
        ----------
        operator : array, shape (N, N)
        """
        V = checked_square_matrix(operator, "the operator")
        self._check_size(V.shape, "the operator")
        inside = adjoint(self.vectors) @ V @ self.vectors
        gaps = self.levels[None, :] - self.levels[:, None]
        labels = cluster_labels(gaps.ravel(), self._tolerance).reshape(gaps.shape)
        rounding = 1e-13 * np.abs(V).max()
        parts = {}
        for label in range(labels.max() + 1):
            part = np.where(labels == label, inside, 0.0)
            if np.abs(part).max() > rounding:
                parts[float(gaps[labels == label].mean())] = self.vectors @ part @ adjoint(self.vectors)
        return parts

    def jumps(self, couplings: Sequence[tuple[Any, Any]]) -> LindbladJumps:
        """Return :class:`LindbladJumps` in the frame, for operators that only get a phase there.

        Parameters
        ----------
        couplings : list of (V, rate)
            As of :class:`LindbladJumps`.

        Raises
        ------
        InputError
            If an operator has components of several frequencies: its jumps depend on time in the frame.
        """
        jumps = LindbladJumps(couplings)
        for i, V in enumerate(jumps.operators):
            if isinstance(V, OperatorFunction):
                raise InputError(f"the jump operator V[{i}] depends on time. Give it in the frame to LindbladJumps")
            frequencies = list(self.components(V))
            if len(frequencies) > 1:
                raise InputError(
                    f"the jump operator V[{i}] has components of the frequencies {frequencies} in the frame, so it "
                    "depends on time there. Give each of frame.components(V) a jump of its own, which is right if the "
                    "rates are small beside the differences of these frequencies"
                )
        return jumps

    def to_frame(self, matrix, t) -> np.ndarray:
        """Return density matrices or observables in the frame.

        Parameters
        ----------
        matrix : array, shape (..., N, N)
        t : float or array, shape (...)
            Times.
        """
        U = self._rotation(t)
        return U @ np.asarray(matrix) @ adjoint(U)

    def to_laboratory(self, matrix, t) -> np.ndarray:
        """Return density matrices or observables of the frame as the laboratory sees them.

        Parameters
        ----------
        matrix : array, shape (..., N, N)
        t : float or array, shape (...)
            Times.
        """
        U = self._rotation(t)
        return adjoint(U) @ np.asarray(matrix) @ U

    def _rotation(self, t) -> np.ndarray:
        """Return ``exp(i G t)``, shape (..., N, N)."""
        phases = np.exp(1j * np.asarray(t, dtype=np.float64)[..., None] * self.levels)
        return (self.vectors * phases[..., None, :]) @ adjoint(self.vectors)

    @property
    def _tolerance(self) -> float:
        return len(self.levels) * level_gap_rounding(self.generator)

    def _check_size(self, shape: tuple[int, ...], what: str) -> None:
        if shape != self.generator.shape:
            generator_shape = self.generator.shape
            raise InputError(f"{what} has shape {shape}, but the generator of the frame has shape {generator_shape}")


class _FrameHamiltonian(Module):
    """The Hamiltonian in a rotating frame, as a function of time."""

    energy: Energy
    levels: jax.Array
    vectors: Operator = eqx.field(static=True)

    def __call__(self, t):
        structure = mf.DensityMatrices(self.levels.shape[0])
        energy, origin = self.energy.at_time(t), jnp.zeros(structure.dim)
        H = structure.matrix(energy.gradient(origin)) + energy.value(origin) * np.eye(structure.size)
        phases, U = jnp.exp(1j * t * self.levels), np.asarray(self.vectors)
        turned = phases[:, None] * (adjoint(U) @ H @ U) * phases.conj() - jnp.diag(self.levels)
        return U @ turned @ adjoint(U)
