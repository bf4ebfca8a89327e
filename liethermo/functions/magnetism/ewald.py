"""Dipolar tensors of lattices with one, two or three periodic axes, summed over all images by Ewald's method.

With ``1 / r = erfc(eta r) / r + erf(eta r) / r`` the first part is summed over images near by. The second part is
smooth, ``(1 / sqrt(pi)) int_0^{eta^2} u^{-1/2} exp(-u r^2) du``, and Poisson's formula turns its sum over p periodic
axes into one over wave vectors Q, with r = (r_par, rho) along and across the periodic axes:

    pi^{(p - 1) / 2} / V sum_Q exp(i Q . r_par) int_0^{eta^2} u^{-(1 + p) / 2} exp(-Q^2 / 4 u - u rho^2) du

[Ewald 1921 for p = 3; Parry 1975 for p = 2; de Leeuw & Perram 1979]. The tensor is minus its second derivative.
"""

from __future__ import annotations

import itertools
import math

import numpy as np
import scipy.special

from .lattices import Lattice

SPLITTING = 0.7
"""eta times the length of a cell: it balances the images in space with the wave vectors."""

MAX_EXPONENT = 40.0
"""Terms beyond exp(-MAX_EXPONENT) are left out: they are below 1e-17 of the sums."""

QUADRATURE_NODES = 64
"""Gauss nodes of the integrals of chains. Twice as many change no tensor by more than 1e-15 of the largest one."""

COMPONENTS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
"""Indices of the six components of a symmetric tensor: xx, xy, xz, yy, yz, zz."""


def dipole_tensor(r: np.ndarray) -> np.ndarray:
    """Return ``(1 - 3 e e) / |r|^3`` with e = r / |r|, shape (..., 3, 3), of vectors r, shape (..., 3); 0 at r = 0."""
    distance = np.linalg.norm(r, axis=-1)[..., None, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        e = r / distance[..., 0]
        tensor = (np.eye(3) - 3.0 * e[..., :, None] * e[..., None, :]) / distance**3
    return np.where(distance > 0.0, tensor, 0.0)


def ewald_kernel(lattice: Lattice, padded_cells: tuple[int, ...], splitting: float = SPLITTING) -> np.ndarray:
    """Return the Fourier transform of the tensors of a lattice, images included, along :func:`transform_axes`.

    Parameters
    ----------
    lattice : Lattice
        With at least one periodic axis; without a depolarising field if three axes are periodic.
    padded_cells : tuple of int
        Lengths of the axes: those of periodic axes are the numbers of cells, and those of open axes at least twice as
        long.
    splitting : float
        eta in units of the inverse length of a cell; the result does not depend on it.

    Returns
    -------
    array, shape (6, atoms, atoms, ...), complex
        The components xx, xy, xz, yy, yz, zz; the atoms a and b of ``r_a - r_b``; the wave vectors.
    """
    periodic = [axis for axis, is_periodic in enumerate(lattice.periodic) if is_periodic]
    volume = _span_volume(lattice.vectors[periodic])
    eta = splitting / volume ** (1.0 / len(periodic))
    real_space_tensors = _real_space_tensors(lattice, padded_cells, eta)
    transform = np.fft.rfftn(real_space_tensors, axes=[3 + axis for axis in transform_axes(padded_cells)])
    return transform + _reciprocal_space_transform(lattice, padded_cells, periodic, volume, eta)


def transform_axes(padded_cells: tuple[int, ...]) -> tuple[int, ...]:
    """Return the axes to transform: those with more than one cell, or the last axis if there are none.

    Along the last of them a real transform stores half of the frequencies.
    """
    return tuple(axis for axis, n in enumerate(padded_cells) if n > 1) or (len(padded_cells) - 1,)


def _span_volume(vectors: np.ndarray) -> float:
    """Return the volume of the parallelepiped that vectors span: a length or an area for one or two vectors."""
    return float(np.sqrt(np.linalg.det(vectors @ vectors.T)))


def _real_space_tensors(lattice: Lattice, padded_cells: tuple[int, ...], eta: float) -> np.ndarray:
    """Return Ewald's real-space sums: the tensors of ``erfc(eta r) / r`` summed over images, less the self-energy.

    The self-energy is that of the smooth part.
    """
    atoms = len(lattice.basis)
    tensors = np.zeros((6, atoms, atoms, *padded_cells))
    cutoff = math.sqrt(MAX_EXPONENT) / eta
    extent = max(np.linalg.norm(a - b) for a in lattice.basis for b in lattice.basis)
    inverse = np.linalg.pinv(lattice.vectors)
    counts = np.ceil((cutoff + extent) * np.linalg.norm(inverse, axis=0)).astype(int)
    limits = [
        n_reach if is_periodic else min(n_reach, n - 1)
        for n_reach, n, is_periodic in zip(counts, lattice.cells, lattice.periodic, strict=True)
    ]
    offsets = np.stack(np.meshgrid(*(np.arange(-m, m + 1) for m in limits), indexing="ij"), axis=-1)
    offsets = offsets.reshape(-1, len(limits))
    wrapped_indices = np.ravel_multi_index(tuple((offsets % padded_cells).T), padded_cells)
    translations = offsets @ lattice.vectors
    for a, b in np.ndindex(atoms, atoms):
        r = translations + lattice.basis[a] - lattice.basis[b]
        distance = np.linalg.norm(r, axis=1)
        is_near = (distance <= cutoff) & (distance > 0.0)
        r, distance, index = r[is_near], distance[is_near], wrapped_indices[is_near]
        x = eta * distance
        gauss = 2.0 * eta / math.sqrt(math.pi) * np.exp(-(x**2))
        isotropic_part = scipy.special.erfc(x) / distance**3 + gauss / distance**2  # -f' / r
        anisotropic_part = (
            3.0 * isotropic_part / distance**2 + 2.0 * eta**2 * gauss / distance**2
        )  # (f'' - f' / r) / r^2
        for component, (i, j) in enumerate(COMPONENTS):
            values = (isotropic_part if i == j else 0.0) - anisotropic_part * r[:, i] * r[:, j]
            tensors[component, a, b] = np.bincount(index, values, minlength=math.prod(padded_cells)).reshape(
                padded_cells
            )
    origin = (0,) * len(padded_cells)
    self_tensor = 4.0 * eta**3 / (3.0 * math.sqrt(math.pi))
    for atom, component in itertools.product(range(atoms), (0, 3, 5)):
        tensors[(component, atom, atom, *origin)] -= self_tensor
    return tensors


def _reciprocal_space_transform(
    lattice: Lattice, padded_cells, periodic_axes: list[int], volume: float, eta: float
) -> np.ndarray:
    """Return the Fourier transform of Ewald's reciprocal-space sums, those of the smooth part of 1 / r."""
    axes, atoms = len(padded_cells), len(lattice.basis)
    vectors = lattice.vectors[periodic_axes]
    reciprocal = 2.0 * np.pi * np.linalg.pinv(vectors).T
    projector = np.linalg.pinv(vectors) @ vectors  # on the span of the periodic axes
    half_axis, shape = transform_axes(padded_cells)[-1], list(padded_cells)
    is_half = half_axis in periodic_axes
    if is_half:
        shape[half_axis] = padded_cells[half_axis] // 2 + 1
    # wave vectors and translations along open axes on a grid of all axes
    grid = np.indices(shape)
    fractions = [np.fft.fftfreq(padded_cells[axis])[grid[axis] % padded_cells[axis]] for axis in periodic_axes]
    translations, is_used = np.zeros((*shape, 3)), np.ones(shape, dtype=bool)
    for axis in set(range(axes)) - set(periodic_axes):
        offsets = np.rint(np.fft.fftfreq(padded_cells[axis], 1.0 / padded_cells[axis]))[grid[axis]]
        translations = translations + offsets[..., None] * lattice.vectors[axis]
        is_used = is_used & (np.abs(offsets) < lattice.cells[axis])
    result = np.zeros((6, atoms, atoms, *shape), dtype=complex)
    max_wave = 2.0 * eta * math.sqrt(MAX_EXPONENT)
    reach = [math.ceil(max_wave * np.linalg.norm(v) / (2.0 * np.pi) + 0.5) for v in vectors]
    for shift in itertools.product(*(range(-m, m + 1) for m in reach)):
        Q = sum((fraction + m)[..., None] * b for fraction, m, b in zip(fractions, shift, reciprocal, strict=True))
        is_near = is_used & (np.linalg.norm(Q, axis=-1) <= max_wave)
        if not is_near.any():
            continue
        waves, positions = Q[is_near], translations[is_near]
        for a, b in np.ndindex(atoms, atoms):
            r = positions + lattice.basis[a] - lattice.basis[b]
            transverse = r - r @ projector
            tensors = _reciprocal_space_tensors(waves, transverse, projector, len(periodic_axes), volume, eta)
            phases = np.exp(1j * np.sum(waves * r, axis=1))
            for component in range(6):
                result[component, a, b][is_near] += phases * tensors[component]
    open_axes = [3 + axis for axis in range(axes) if axis not in periodic_axes]
    result = np.fft.fftn(result, axes=open_axes) if open_axes else result
    return result if is_half else np.take(result, range(padded_cells[half_axis] // 2 + 1), axis=3 + half_axis)


def _reciprocal_space_tensors(
    wave_vectors, transverse, projector, n_periodic_axes: int, volume: float, eta: float
) -> np.ndarray:
    """Return the terms of Ewald's reciprocal-space sum at m wave vectors, shape (6, m), without their phases.

    ``transverse``, shape (m, 3), is the part of each distance across the periodic axes.
    """
    mean, slope, curvature = _integral_and_transverse_derivatives(
        wave_vectors, transverse, np.eye(3) - projector, n_periodic_axes, eta
    )
    factor = np.pi ** ((n_periodic_axes - 1) / 2.0) / volume
    return factor * np.stack(
        [
            wave_vectors[:, i] * wave_vectors[:, j] * mean
            + 2j * (wave_vectors[:, i] * slope[:, j] + slope[:, i] * wave_vectors[:, j])
            + curvature[k]
            for k, (i, j) in enumerate(COMPONENTS)
        ]
    )


def _integral_and_transverse_derivatives(
    wave_vectors, transverse, transverse_projector, n_periodic_axes: int, eta: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return Ewald's integral I(rho), -grad I / 2 and -grad grad I, shapes (m,), (m, 3) and (6, m).

    With p periodic axes, ``I(rho) = int_0^{eta^2} u^{-(1 + p) / 2} exp(-Q^2 / 4 u - u rho^2) du``. The gradients are
    those across the periodic axes. I is 0 for Q = 0, where it is multiplied by Q: without a depolarising field for
    p = 3.
    """
    Q, rho = np.linalg.norm(wave_vectors, axis=1), np.linalg.norm(transverse, axis=1)
    if n_periodic_axes == 3:
        with np.errstate(divide="ignore", invalid="ignore"):
            mean = np.where(Q > 0.0, 4.0 / Q**2 * np.exp(-(Q**2) / (4.0 * eta**2)), 0.0)
        return mean, np.zeros_like(transverse), np.zeros((6, len(Q)))
    if n_periodic_axes == 2:
        return _derivatives_for_two_periodic_axes(Q, transverse, rho, transverse_projector, eta)
    mean, I1, I2 = _integrals_for_one_periodic_axis(Q, rho, eta)
    curvature = [
        2.0 * transverse_projector[i, j] * I1 - 4.0 * transverse[:, i] * transverse[:, j] * I2 for i, j in COMPONENTS
    ]
    return mean, I1[:, None] * transverse, np.stack(curvature)


def _derivatives_for_two_periodic_axes(
    Q, transverse, rho, transverse_projector, eta: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return Ewald's integral and its derivatives for two periodic axes, by complementary error functions [Parry 1975].

    The result is that of :func:`_integral_and_transverse_derivatives`.
    """
    gauss = np.exp(-(Q**2) / (4.0 * eta**2) - (eta * rho) ** 2)
    plus = gauss * scipy.special.erfcx(Q / (2.0 * eta) + eta * rho)  # exp(Q rho) erfc(Q / 2 eta + eta rho)
    argument = Q / (2.0 * eta) - eta * rho
    minus = np.where(
        argument > 0.0,
        gauss * scipy.special.erfcx(np.maximum(argument, 0.0)),
        np.exp(-Q * rho) * scipy.special.erfc(np.minimum(argument, 0.0)),
    )
    root = math.sqrt(math.pi)
    with np.errstate(divide="ignore", invalid="ignore"):
        mean = np.where(Q > 0.0, root / Q * (plus + minus), 0.0)
        directions = np.where(rho[:, None] > 0.0, transverse / rho[:, None], 0.0)
    second_derivative = 4.0 * eta * gauss - root * Q * (plus + minus)
    curvature = np.stack([transverse_projector[i, j] * second_derivative for i, j in COMPONENTS])
    return mean, (0.5 * root * (minus - plus))[:, None] * directions, curvature


def _integrals_for_one_periodic_axis(Q, rho, eta: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return Ewald's integrals with factors u^0, u^1 and u^2 for one periodic axis, shape (m,) each.

    They are incomplete Bessel functions, computed by quadrature in the logarithm of u.
    """
    nodes, weights = np.polynomial.legendre.leggauss(QUADRATURE_NODES)
    start = -2.0 * math.log(eta)
    with np.errstate(divide="ignore"):
        end = np.log(4.0 * MAX_EXPONENT) - 2.0 * np.log(Q)
    is_wave = (Q > 0.0) & (end > start)
    half = np.where(is_wave, 0.5 * (np.where(is_wave, end, start) - start), 0.0)
    sums = [np.zeros_like(Q) for _ in range(3)]
    for node, weight in zip(nodes, weights, strict=True):
        u = np.exp(-(start + half * (1.0 + node)))
        value = weight * half * np.exp(-(Q**2) / (4.0 * u) - u * rho**2)
        for m in range(3):
            sums[m] += value * u**m
    x = (eta * rho) ** 2
    with np.errstate(divide="ignore", invalid="ignore"):
        zero_wave_limits = [
            np.where(x > 0.0, -np.expm1(-x) / rho**2, eta**2),
            np.where(x > SMALL_ARGUMENT, scipy.special.gammainc(2.0, x) / rho**4, 0.5 * eta**4),
        ]
    I0 = np.where(is_wave, sums[0], 0.0)
    I1, I2 = (np.where(Q > 0.0, np.where(is_wave, sums[m], 0.0), zero_wave_limits[m - 1]) for m in (1, 2))
    return I0, I1, I2


SMALL_ARGUMENT = 1e-12
"""Argument below which ``gamma(2, x) / x^2`` is its limit 1 / 2, to 1e-12; it is multiplied by rho^2."""
