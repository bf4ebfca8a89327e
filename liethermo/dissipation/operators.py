"""Operators of density matrices: matrices as users give them, checked, and the differences of their levels."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

import numpy as np

import manifolds as mf
from manifolds.matrices.linear import adjoint
from manifolds.structures.poisson import ProductPoisson

from ..errors import InputError
from ..functions.density import lower_level_of_smallest_gap
from ..functions.gradients import EPS
from ..functions.indices import StaticArray
from .geometry import Geometry

ENERGY_RTOL = 8.0 * EPS
"""Error of an energy, relative to the largest one; times the number of levels if energies are eigenvalues."""


@runtime_checkable
class HasMatrix(Protocol):
    """An operator, such as a ``Qobj`` of QuTiP, whose matrix is returned by ``full()``."""

    def full(self) -> np.ndarray: ...


class Operator(StaticArray):
    """A complex matrix as a static field of a module."""

    dtype = complex


def get_density_structure(system: Geometry, name: str) -> mf.DensityMatrices:
    """Return the map between density matrices and state vectors of a quantum system; InputError for other systems."""
    structure = system.poisson.first if isinstance(system.poisson, ProductPoisson) else system.poisson
    if not isinstance(structure, mf.DensityMatrices):
        raise InputError(f"{name} needs density matrices. Use it in an lt.QuantumSystem")
    return structure


def checked_square_matrix(matrix, label: str) -> np.ndarray:
    """Return a square complex matrix, from an array or from the ``full()`` of a ``Qobj``."""
    array = np.asarray(matrix.full() if isinstance(matrix, HasMatrix) else matrix)
    if array.dtype.kind not in "fiuc" or array.ndim != 2 or array.shape[0] != array.shape[1] or not array.size:
        raise InputError(
            f"{label} must be a square matrix of numbers, got an array of {array.dtype}, shape {array.shape}"
        )
    if not np.isfinite(array).all():
        raise InputError(f"{label} is not finite")
    return array.astype(complex)


def checked_hermitian(matrix, label: str) -> np.ndarray:
    """Return a matrix, made exactly Hermitian; InputError if it is not Hermitian to rounding."""
    array = checked_square_matrix(matrix, label)
    residual, scale = float(np.abs(array - adjoint(array)).max()), float(np.abs(array).max())
    if residual > 1e-12 * scale:
        raise InputError(
            f"{label} is not Hermitian: it differs from its adjoint by {residual:.3g}. Its Hermitian part is "
            "(A + A.conj().T) / 2"
        )
    return (array + adjoint(array)) / 2


def commutator(a, b):
    """Return ``a b - b a`` of matrices, shape (..., N, N)."""
    return a @ b - b @ a


def is_diagonal(H: np.ndarray) -> bool:
    """Return True if all entries off the diagonal are exactly zero."""
    return not (H - np.diag(np.diag(H))).any()


def is_hermitian(V) -> bool:
    """Return True if a matrix equals its adjoint to rounding."""
    V = np.asarray(V)
    return bool(np.abs(V - adjoint(V)).max() <= 1e-12 * np.abs(V).max())


def subtract_common_energy(H: np.ndarray) -> np.ndarray:
    """Return H minus a multiple of the identity: the lower of the two diagonal entries nearest to each other."""
    return H - lower_level_of_smallest_gap(np.diag(H).real) * np.eye(len(H))


def level_gap_rounding_bound(H: np.ndarray) -> float:
    """Return the largest amount by which rounding makes two equal gaps between levels of H differ."""
    return ENERGY_RTOL * (1 if is_diagonal(H) else len(H)) * float(np.linalg.norm(H, 2))


def is_commuting(H: np.ndarray, V: np.ndarray) -> bool:
    """Return True if two matrices commute to rounding; a constant added to H makes no difference."""
    H = subtract_common_energy(H)
    products = np.abs(H) @ np.abs(V) + np.abs(V) @ np.abs(H)
    return bool(np.abs(commutator(H, V)).max() <= ENERGY_RTOL * len(H) * products.max())
