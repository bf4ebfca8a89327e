"""Density matrices as users give them, and the parts of products of quantum systems."""

from __future__ import annotations

import math
from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np

from manifolds.matrices.linear import adjoint

from ..errors import InputError
from ..functions.bath_energy import BathEnergy, ReservoirEnergy
from ..functions.density import NEGATIVE_EIGENVALUE_LIMIT
from .baths import HeatBaths

DENSITY_MATRIX_TOLERANCE = 1e-12
"""Largest difference of a trace from one, and of a density matrix from its adjoint, that is accepted as input."""


def checked_density_matrices(rho: np.ndarray, size: int, mixed: float) -> np.ndarray:
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
        rho = _density_of_kets(rho[:, None] if rho.ndim == 1 else rho)
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
    if not isinstance(mixed, int | float | np.number) or not 0.0 <= mixed <= 1.0:
        raise InputError(f"mixed, the weight of the maximally mixed state, must be a number from 0 to 1, got {mixed!r}")
    return (1.0 - mixed) * rho + mixed * np.eye(size) / size


def _density_of_kets(ket: np.ndarray) -> np.ndarray:
    """Return the density matrices, shape (..., N, N), of pure states, shape (..., N, 1)."""
    norms = np.linalg.norm(ket, axis=-2)
    wrong_norm = float(norms.ravel()[np.argmax(np.abs(norms - 1.0))])
    if abs(wrong_norm - 1.0) > DENSITY_MATRIX_TOLERANCE:
        raise InputError(f"the ket must have norm 1, got {wrong_norm:.15g}. Divide the ket by its norm")
    ket = ket / norms[..., None]
    return ket @ adjoint(ket)


def checked_parts(parts, names, size: int) -> tuple[tuple[int, ...], tuple[str, ...]]:
    """Return the dimensions of the factors of a product, and their names."""
    parts = (size,) if parts is None else tuple(int(n) for n in parts)
    if math.prod(parts) != size or min(parts) < 1:
        raise InputError(f"the product of the sizes of the parts must be {size}, got the sizes {parts}")
    names = tuple(names)
    if names and (len(names) != len(parts) or len(set(names)) != len(names)):
        raise InputError(f"names must be {len(parts)} different names, one for each part, got {names!r}")
    return parts, names


def tensor_with_identity(matrix: np.ndarray, k: int, sizes: Sequence[int]) -> np.ndarray:
    """Return an operator of the k-th of two systems as an operator of their product."""
    return np.kron(matrix, np.eye(sizes[1])) if k == 0 else np.kron(np.eye(sizes[0]), matrix)


def join_baths(a: HeatBaths | None, b: HeatBaths | None) -> HeatBaths | None:
    """Return the baths of a product of two systems, those of the first one first."""
    if a is None or b is None:
        return a or b
    kinds = BathEnergy | ReservoirEnergy
    if not isinstance(a.energy, kinds) or not isinstance(b.energy, kinds):
        raise InputError("baths of a product have constant capacities: build the product with baths of its own")
    capacity, temperature = (
        jnp.concatenate([getattr(a.energy, name), getattr(b.energy, name)]) for name in ("capacity", "temperature")
    )
    return HeatBaths(capacity, temperature, a.number + b.number)
