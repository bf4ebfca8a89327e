"""Hamiltonians and density matrices of quantum systems as users give them, and systems in a rotating frame."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy

import manifolds as mf
from manifolds._class_members import ListedType
from manifolds._pytree_module import Module
from manifolds.matrices.linear import adjoint

from ..dissipation.lindblad import LindbladJumps, OperatorFunction
from ..dissipation.operators import (
    HasMatrix,
    Operator,
    checked_hermitian,
    checked_square_matrix,
    level_gap_rounding_bound,
)
from ..dissipation.quantum import cluster_labels
from ..errors import InputError
from ..functions.bath_energy import BathEnergy, ReservoirEnergy
from ..functions.density import (
    NEGATIVE_EIGENVALUE_LIMIT,
    ExpectationValue,
    MeanEnergy,
    ModulatedExpectationValue,
    lower_level_of_smallest_gap,
)
from ..functions.energy import Energy, TimeDependent
from ..functions.time_span import ContinuedSpline
from .baths import HeatBaths
from .invariants import TEST_TIMES


def make_hamiltonian_energy(hamiltonian, times=None) -> tuple[int, Energy]:
    """Return the number of levels of a Hamiltonian and its energy ``tr(rho H)`` as a function of the state."""
    if isinstance(hamiltonian, list | tuple) and any(map(_is_hamiltonian_term, hamiltonian)):
        return _energy_of_hamiltonian_terms(hamiltonian, times)
    if callable(hamiltonian) and not isinstance(hamiltonian, HasMatrix):
        if isinstance(_value_at_time(hamiltonian, TEST_TIMES[0], "the Hamiltonian"), HasMatrix):
            raise InputError(
                f"the Hamiltonian is a {type(hamiltonian).__name__} that returns a Qobj, which JAX cannot trace. Give "
                "its terms, [H0, [H1, f]], with a function f of jax.numpy, or with an array of its values and times="
            )
        matrices = [
            checked_hermitian(_value_at_time(hamiltonian, t, "the Hamiltonian"), f"the Hamiltonian at t = {t:.3g}")
            for t in TEST_TIMES
        ]
        structure = mf.DensityMatrices(len(matrices[0]))
        with jax.ensure_compile_time_eval():  # it stays a number while JAX traces a family of systems
            lowest = jnp.asarray(np.diag(matrices[0]).real.min())
        return structure.size, TimeDependent(ExpectationValue(hamiltonian, structure, lowest))
    if isinstance(hamiltonian, jax.core.Tracer):
        structure = mf.DensityMatrices(hamiltonian.shape[-1])
        return structure.size, MeanEnergy(structure.vector(hamiltonian), jnp.min(jnp.diag(hamiltonian).real))
    H = checked_hermitian(checked_square_matrix(hamiltonian, "the Hamiltonian"), "the Hamiltonian")
    with jax.ensure_compile_time_eval():  # they stay numbers while JAX traces a family of systems
        b = jnp.asarray(mf.DensityMatrices(len(H)).vector(H))
        reference = jnp.asarray(lower_level_of_smallest_gap(np.diag(H).real))
    return len(H), MeanEnergy(b, reference)


def _value_at_time(function, t: float, what: str):
    """Return the value of a function of time at the time t.

    Raises
    ------
    InputError
        If the function does not accept one argument.
    """
    try:
        inspect.signature(function).bind(t)
    except TypeError as error:
        raise InputError(f"the function for {what} must have one argument, the time t: {error}") from None
    except ValueError:  # the signature is not known
        pass
    return function(t)


def _is_hamiltonian_term(term) -> bool:
    """Return whether a term of a list is a matrix, or begins with one, and is not a row of numbers."""
    if isinstance(term, list | tuple):
        return bool(term) and (isinstance(term[0], list | tuple) or _is_hamiltonian_term(term[0]))
    return isinstance(term, HasMatrix) or np.ndim(term) == 2


def _energy_of_hamiltonian_terms(terms: Sequence, times) -> tuple[int, Energy]:
    """Return the number of levels of a Hamiltonian given as ``[H0, (H1, f), ...]``, and its energy ``tr(rho H)``.

    The terms are given as ``[H0, (H1, f), ...]``.
    """
    constant_matrices: list[np.ndarray] = []
    modulated_matrices: list[np.ndarray] = []
    functions = []
    for i, term in enumerate(terms):
        is_pair = isinstance(term, list | tuple) and len(term) == 2 and _is_hamiltonian_term(term[0])
        H, f = term if is_pair else (term, None)
        f = f if f is None or callable(f) else _coefficient_function(f, times, i)
        if isinstance(H, list | tuple) and H and _is_hamiltonian_term(H[0]):
            raise InputError(f"term {i} of the Hamiltonian must be a matrix, or a pair of a matrix and a function of t")
        H = checked_hermitian(H, f"term {i} of the Hamiltonian")
        if H.shape != (first_matrix := (constant_matrices + modulated_matrices + [H])[0]).shape:
            raise InputError(
                f"term {i} of the Hamiltonian has shape {H.shape}, but another term has shape {first_matrix.shape}"
            )
        if f is None:
            constant_matrices.append(H)
            continue
        value = _value_at_time(f, TEST_TIMES[0], f"the second of term {i} of the Hamiltonian")
        if np.shape(value) or jnp.result_type(value).kind not in "fiu":
            raise InputError(f"the function of term {i} of the Hamiltonian must return a real number, got {value!r}")
        modulated_matrices.append(H)
        functions.append(f)
    if times is not None and not any(isinstance(f, ContinuedSpline) for f in functions):
        raise InputError("times= belongs to coefficients that are arrays, and the Hamiltonian has none. Remove times=")
    structure = mf.DensityMatrices(len(H))
    with jax.ensure_compile_time_eval():  # they stay numbers while JAX traces a family of systems
        matrices = (sum(constant_matrices, np.zeros_like(H)), *modulated_matrices)
        static, *rows = (jnp.asarray(structure.vector(a)) for a in matrices)
        reference = jnp.asarray(lower_level_of_smallest_gap(np.asarray(static)[: structure.size]))
    if not modulated_matrices:
        return structure.size, MeanEnergy(static, reference)
    initial = static
    for f, row in zip(functions, rows, strict=True):
        initial = initial + f(TEST_TIMES[0]) * row
    lowest = jnp.min(initial[: structure.size])  # works for traced functions too
    return structure.size, TimeDependent(ModulatedExpectationValue(static, tuple(rows), tuple(functions), lowest))


def _coefficient_function(coefficient, times, term_index: int) -> Callable:
    """Return a spline of time through the values of a coefficient at ``times``."""
    if isinstance(coefficient, str):
        raise InputError(
            f"the coefficient of term {term_index} of the Hamiltonian is the string {coefficient!r}, which is not "
            "evaluated. Give a function of t, such as lambda t: jnp.cos(t)"
        )
    values = np.asarray(coefficient)
    if values.dtype.kind not in "fiu" or values.ndim != 1:
        raise InputError(
            f"term {term_index} of the Hamiltonian must be a matrix, or a pair of a matrix and a function of t or an "
            f"array of real numbers, got a second entry of type {type(coefficient).__name__}"
        )
    if times is None:
        raise InputError(f"the coefficient of term {term_index} of the Hamiltonian is an array, so it needs times=")
    knots = np.asarray(times, dtype=np.float64)
    if knots.shape != values.shape or knots.size < 4 or not (np.diff(knots) > 0.0).all():
        raise InputError(
            f"times must be at least 4 increasing numbers, one for each value of a coefficient, got the shapes "
            f"{knots.shape} and {values.shape}"
        )
    return ContinuedSpline(scipy.interpolate.CubicSpline(knots, values))  # as QuTiP interpolates it


DENSITY_MATRIX_TOLERANCE = 1e-12
"""Largest difference of a trace from one, and of a density matrix from its adjoint, that is accepted as input."""


def checked_density_matrices(rho: np.ndarray, size: int, mixing_weight: float) -> np.ndarray:
    """Return checked density matrices, shape (..., N, N), from matrices, kets, a bra or a stacked operator.

    Raises
    ------
    InputError
        If an array has another shape, or is not Hermitian, positive and of trace one.
    """
    if rho.dtype.kind not in "fiuc":
        raise InputError(f"a density matrix must be an array of numbers, got {rho.dtype}")
    if not np.isfinite(rho).all():
        raise InputError("the density matrix must be finite")
    if size > 1 and rho.shape == (1, size):  # a bra
        rho = adjoint(rho)
    if size > 1 and rho.shape == (size**2, 1):  # an operator as QuTiP stacks it, by columns
        rho = rho.reshape(size, size).T
    if rho.shape == (size,) or (size > 1 and rho.shape[-2:] == (size, 1)):
        rho = _density_matrices_of_kets(rho[:, None] if rho.ndim == 1 else rho)
    if rho.shape[-2:] != (size, size):
        raise InputError(
            f"a density matrix of this system must have shape ({size}, {size}), got {rho.shape}; a ket has the shape "
            f"({size},) or ({size}, 1)"
        )
    asymmetry = float(np.abs(rho - adjoint(rho)).max())
    if asymmetry > DENSITY_MATRIX_TOLERANCE:
        raise InputError(f"the density matrix must be Hermitian, but it differs from its adjoint by {asymmetry:.3g}")
    trace = np.trace(rho, axis1=-2, axis2=-1).real
    wrong_trace = float(trace.ravel()[np.argmax(np.abs(trace - 1.0))])
    if abs(wrong_trace - 1.0) > DENSITY_MATRIX_TOLERANCE:
        raise InputError(f"the density matrix must have trace 1, got {wrong_trace:.15g}. Divide it by its trace")
    min_eigenvalue = float(np.linalg.eigvalsh(rho)[..., 0].min())
    if min_eigenvalue < -NEGATIVE_EIGENVALUE_LIMIT:
        raise InputError(f"the density matrix must be positive, but its least eigenvalue is {min_eigenvalue:.3g}")
    if not isinstance(mixing_weight, int | float | np.number) or not 0.0 <= mixing_weight <= 1.0:
        raise InputError(
            f"mixed, the weight of the maximally mixed state, must be a number from 0 to 1, got {mixing_weight!r}"
        )
    return (1.0 - mixing_weight) * rho + mixing_weight * np.eye(size) / size


def _density_matrices_of_kets(kets: np.ndarray) -> np.ndarray:
    """Return the density matrices, shape (..., N, N), of pure states, shape (..., N, 1)."""
    norms = np.linalg.norm(kets, axis=-2)
    wrong_norm = float(norms.ravel()[np.argmax(np.abs(norms - 1.0))])
    if abs(wrong_norm - 1.0) > DENSITY_MATRIX_TOLERANCE:
        raise InputError(f"the ket must have norm 1, got {wrong_norm:.15g}. Divide the ket by its norm")
    kets = kets / norms[..., None]
    return kets @ adjoint(kets)


def checked_factor_dims_and_names(parts, names, size: int) -> tuple[tuple[int, ...], tuple[str, ...]]:
    """Return the checked dimensions and names of the factors of a composite quantum system."""
    parts = (size,) if parts is None else tuple(int(n) for n in parts)
    if math.prod(parts) != size or min(parts) < 1:
        raise InputError(f"the product of the sizes of the parts must be {size}, got the sizes {parts}")
    names = tuple(names)
    if names and (len(names) != len(parts) or len(set(names)) != len(names)):
        raise InputError(f"names must be {len(parts)} different names, one for each part, got {names!r}")
    return parts, names


def tensor_with_identity(matrix: np.ndarray, factor_index: int, factor_dims: Sequence[int]) -> np.ndarray:
    """Return the tensor product of an operator of one of two systems with the identity of the other."""
    return np.kron(matrix, np.eye(factor_dims[1])) if factor_index == 0 else np.kron(np.eye(factor_dims[0]), matrix)


def join_baths(first_baths: HeatBaths, second_baths: HeatBaths) -> HeatBaths:
    """Return the baths of two systems together, those of the first system first."""
    if not first_baths.number or not second_baths.number:
        return first_baths if first_baths.number else second_baths
    kinds = BathEnergy | ReservoirEnergy
    if not isinstance(first_baths.energy, kinds) or not isinstance(second_baths.energy, kinds):
        raise InputError(
            "the baths of a product must have constant capacities. Build the product with baths of its own"
        )
    capacity, temperature = (
        jnp.concatenate([getattr(first_baths.energy, name), getattr(second_baths.energy, name)])
        for name in ("capacity", "temperature")
    )
    return HeatBaths(capacity, temperature, first_baths.number + second_baths.number)


class RotatingFrame(metaclass=ListedType):
    """A frame that turns by ``exp(-i G t)``: its density matrices are ``exp(i G t) rho exp(-i G t)`` (hbar = 1).

    In the frame the Hamiltonian is ``exp(i G t) H(t) exp(-i G t) - G``, constant if a drive turns with G. A linear
    drive, ``H0 + cos(omega t) D``, leaves terms at the frequency 2 omega; the rotating-wave approximation drops them.

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
        """Return the exact Hamiltonian in the rotating frame as a function from t to an array, shape (N, N).

        Parameters
        ----------
        hamiltonian, times
            As of :class:`QuantumSystem`.
        """
        size, energy = make_hamiltonian_energy(hamiltonian, times)
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
            frequency_text = ", ".join(f"{omega:.6g}" for omega in self.components(D) if omega >= 0.0)
            raise InputError(
                "no component of the drive is constant in the frame: the frame turns its components at the frequencies "
                f"{frequency_text}, and the drive has the frequency {frequency:.6g}. Give the frame a generator with "
                "two levels whose difference is that frequency"
            )
        components_of_constant = self.components(H)
        static = sum(
            (V for omega, V in components_of_constant.items() if abs(omega) <= self._tolerance), np.zeros_like(H)
        )
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
        V_in_eigenbasis = adjoint(self.vectors) @ V @ self.vectors
        gaps = self.levels[None, :] - self.levels[:, None]
        labels = cluster_labels(gaps.ravel(), self._tolerance).reshape(gaps.shape)
        rounding = 1e-13 * np.abs(V).max()
        parts = {}
        for label in range(labels.max() + 1):
            part = np.where(labels == label, V_in_eigenbasis, 0.0)
            if np.abs(part).max() > rounding:
                parts[float(gaps[labels == label].mean())] = self.vectors @ part @ adjoint(self.vectors)
        return parts

    def jumps(self, couplings: Sequence[tuple[Any, Any]]) -> LindbladJumps:
        """Return :class:`LindbladJumps` in the frame, for jump operators that only get a phase there.

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
        """Return density matrices or observables of the laboratory as they are in the frame, shape (..., N, N).

        Parameters
        ----------
        matrix : array, shape (..., N, N)
        t : float or array, shape (...)
            Times.
        """
        U = self._rotation(t)
        return U @ np.asarray(matrix) @ adjoint(U)

    def to_laboratory(self, matrix, t) -> np.ndarray:
        """Return density matrices or observables of the frame as they are in the laboratory, shape (..., N, N).

        Parameters
        ----------
        matrix : array, shape (..., N, N)
        t : float or array, shape (...)
            Times.
        """
        U = self._rotation(t)
        return adjoint(U) @ np.asarray(matrix) @ U

    def _rotation(self, t) -> np.ndarray:
        """Return the rotation ``exp(i G t)`` of the frame, shape (..., N, N)."""
        phases = np.exp(1j * np.asarray(t, dtype=np.float64)[..., None] * self.levels)
        return (self.vectors * phases[..., None, :]) @ adjoint(self.vectors)

    @property
    def _tolerance(self) -> float:
        """Difference of frequencies in the frame up to which they count as equal."""
        return len(self.levels) * level_gap_rounding_bound(self.generator)

    def _check_size(self, shape: tuple[int, ...], what: str) -> None:
        """Raise InputError unless a matrix has the shape of the generator."""
        if shape != self.generator.shape:
            generator_shape = self.generator.shape
            raise InputError(
                f"{what} must have the shape of the generator of the frame, {generator_shape}, got {shape}"
            )


class _FrameHamiltonian(Module):
    """A Hamiltonian in a rotating frame as a function of time, with values of shape (N, N)."""

    energy: Energy
    levels: jax.Array
    vectors: Operator = eqx.field(static=True)

    def __call__(self, t):
        structure = mf.DensityMatrices(self.levels.shape[0])
        energy, origin = self.energy.at_time(t), jnp.zeros(structure.dim)
        H = structure.matrix(energy.gradient(origin)) + energy.value(origin) * np.eye(structure.size)
        phases, U = jnp.exp(1j * t * self.levels), np.asarray(self.vectors)
        rotated = phases[:, None] * (adjoint(U) @ H @ U) * phases.conj() - jnp.diag(self.levels)
        return U @ rotated @ adjoint(U)
