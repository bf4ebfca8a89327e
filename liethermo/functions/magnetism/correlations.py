"""Correlations of spins: structure factors in wave number and frequency, and the charge of a texture."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from manifolds._arguments import is_integer

from ...errors import InputError
from ..conditions import checked_numbers
from .lattices import Lattice
from .spin_energy import checked_finite_numbers


class StructureFactor(NamedTuple):
    """Structure factor of spins.

    Attributes
    ----------
    wave_vectors : array, shape (..., 3)
        Wave vectors (1 / length).
    values : array, shape (..., 3, 3), or (frequencies, ..., 3, 3)
        Correlations of the components of the spins; for each frequency if the structure factor is dynamic.
    frequencies : array, shape (frequencies,), or None
        Angular frequencies (radian / time), in ascending order.
    """

    wave_vectors: np.ndarray
    values: np.ndarray
    frequencies: np.ndarray | None = None

    @property
    def trace(self) -> np.ndarray:
        """Sum over the three components, shape (...) or (frequencies, ...)."""
        return np.real(np.trace(self.values, axis1=-2, axis2=-1))

    @property
    def scattering(self) -> np.ndarray:
        """Sum over the components across the wave vector, which neutrons see, ``sum (1 - q q / q^2)_ab S_ab``."""
        length = np.linalg.norm(self.wave_vectors, axis=-1, keepdims=True)
        e = np.where(length > 0.0, self.wave_vectors / np.where(length > 0.0, length, 1.0), 0.0)
        longitudinal = np.einsum("...a,...ab,...b->...", e, self.values, e)
        return np.real(np.trace(self.values, axis1=-2, axis2=-1) - longitudinal)


def structure_factor(spins, lattice: Lattice, wave_vectors=None) -> StructureFactor:
    """Return the static structure factor ``S_ab(q) = <s_a(q) s_b(q)*> / N``, ``s(q) = sum s_i exp(-i q . r_i)``.

    Parameters
    ----------
    spins : array, shape ``(..., *sites, 3)``
        One state, or samples to average over.
    lattice : Lattice
        The lattice of the sites.
    wave_vectors : array, shape (..., 3), optional
        Wave vectors (1 / length); by default those of the periodic lattice, shape ``(*cells, 3)``, computed by a fast
        Fourier transform.

    Returns
    -------
    StructureFactor

    Raises
    ------
    InputError

    Examples
    --------
    >>> chain = lt.magnetism.lattice("chain", 4)
    >>> S = lt.magnetism.structure_factor(np.tile([0.0, 0.0, 1.0], (4, 1)), chain)
    >>> S.trace.round(6).tolist()  # ordered: all weight N at q = 0
    [4.0, 0.0, 0.0, 0.0]
    """
    samples = _checked_samples(spins, lattice)
    q, modes = _wave_vectors_and_fourier_modes(samples, lattice, wave_vectors)
    values = np.mean(modes[..., :, None] * np.conj(modes[..., None, :]), axis=0) / lattice.site_count
    return StructureFactor(q, values)


def dynamic_structure_factor(
    spins, times, lattice: Lattice, wave_vectors=None, window: str = "hann", segments: int = 1
) -> StructureFactor:
    """Return the dynamic structure factor, the power spectrum of ``s(q, t)``, at wave vectors and frequencies.

    ``S_ab(q, w) = <s_a(q, w) s_b(q, w)*> / (2 pi N T)`` with ``s(q, w) = int s(q, t) exp(i w t) dt`` over a time T: its
    integral over w is the static structure factor. A wave ``exp(i (q . r - w t))`` has its peak at (q, w).

    Parameters
    ----------
    spins : array, shape ``(times, *sites, 3)``
        Such as ``system.spins(run.x)`` with ``save_every=``.
    times : array, shape (times,)
        Evenly spaced times.
    lattice : Lattice
        The lattice of the sites.
    wave_vectors : array, shape (..., 3), optional
        See :func:`structure_factor`.
    window : str
        "hann", which suppresses the spectral leakage, or "none".
    segments : int
        Number of segments, overlapping by half, whose spectra are averaged [Welch 1967].

    Returns
    -------
    StructureFactor

    Raises
    ------
    InputError
    """
    samples, t = _checked_samples(spins, lattice), np.asarray(checked_numbers(times, "times"))
    if t.shape != (len(samples),) or len(t) < 4:
        raise InputError(f"times must have shape ({len(samples)},), at least 4 of them, got {t.shape}")
    step = (t[-1] - t[0]) / (len(t) - 1)
    if step <= 0.0 or np.abs(np.diff(t) - step).max() > SPACING_TOLERANCE * step:
        raise InputError("times must be ascending and evenly spaced. Save states with save_every=")
    if window not in ("hann", "none"):
        raise InputError(f'window must be "hann" or "none", got {window!r}')
    if not is_integer(segments) or segments < 1 or len(t) // segments < 2:
        raise InputError(f"segments must be a positive integer, at most half of the times, got {segments!r}")
    length = 2 * len(t) // (segments + 1)
    weights = np.ones(length) if window == "none" else 0.5 - 0.5 * np.cos(2.0 * np.pi * np.arange(length) / length)
    weights = weights / math.sqrt(np.mean(weights**2))
    q, modes = _wave_vectors_and_fourier_modes(samples, lattice, wave_vectors)
    starts = np.linspace(0, len(t) - length, segments).round().astype(int)
    total = 0.0
    for start in starts:
        windowed_segment = modes[start : start + length] * weights.reshape(-1, *(1,) * (modes.ndim - 1))
        spectrum = step * length * np.fft.fftshift(np.fft.ifft(windowed_segment, axis=0), axes=0)
        total = total + spectrum[..., :, None] * np.conj(spectrum[..., None, :])
    frequencies = 2.0 * np.pi * np.fft.fftshift(np.fft.fftfreq(length, step))
    scale = 2.0 * np.pi * lattice.site_count * length * step * segments
    return StructureFactor(q, total / scale, frequencies)


SPACING_TOLERANCE = 1e-6
"""Relative deviation of the spacing of times that is rounding."""


def _checked_samples(spins, lattice: Lattice) -> np.ndarray:
    """Return spins with one axis of samples, shape ``(samples, *cells, atoms, 3)``."""
    if not isinstance(lattice, Lattice):
        raise InputError(f"lattice must be one of lt.magnetism.lattice, got {type(lattice).__name__}")
    s = np.asarray(checked_finite_numbers(spins, "spins"))
    shape = (*lattice.sites, 3)
    if s.shape[-len(shape) :] != shape:
        raise InputError(f"spins must have shape (..., {', '.join(map(str, shape))}), got {s.shape}")
    return s.reshape(-1, *lattice.cells, len(lattice.basis), 3)


def _wave_vectors_and_fourier_modes(
    samples: np.ndarray, lattice: Lattice, wave_vectors
) -> tuple[np.ndarray, np.ndarray]:
    """Return wave vectors q, shape (..., 3), and the modes ``sum s_i exp(-i q . r_i)``, shape (samples, ..., 3).

    The wave vectors are those of the periodic lattice if ``wave_vectors`` is None.
    """
    axes = tuple(range(1, 1 + len(lattice.cells)))
    if wave_vectors is None:
        fractions = np.meshgrid(*(np.fft.fftfreq(n) for n in lattice.cells), indexing="ij")
        q = np.stack(fractions, axis=-1) @ lattice.reciprocal_vectors
        atom_transforms = np.fft.fftn(samples, axes=axes)
        phases = np.exp(-1j * np.einsum("...c,ac->...a", q, lattice.basis))
        return q, np.einsum("...ac,...a->...c", atom_transforms, phases)
    q = np.asarray(checked_finite_numbers(wave_vectors, "wave vectors"))
    if q.shape[-1:] != (3,):
        raise InputError(f"wave vectors must have shape (..., 3), got {q.shape}")
    phases = np.exp(-1j * q.reshape(-1, 3) @ lattice.positions.reshape(-1, 3).T)
    modes = np.einsum("qi,sic->sqc", phases, samples.reshape(len(samples), -1, 3))
    return q, modes.reshape(len(samples), *q.shape)


def topological_charge(spins, periodic=False) -> np.ndarray | float:
    """Return the topological charge of a plane of spins, ``1 / 4 pi int m . (dm/dx x dm/dy)`` [Berg & Luescher 1981].

    It is the sum of the areas, on the sphere, of the triangles of neighbours. On a periodic plane it is an integer to
    rounding, -1 for a skyrmion with its core down in a background up.

    Parameters
    ----------
    spins : array, shape (..., nx, ny, 3)
        Spins on a plane with axes x and y that are right-handed with its normal; their lengths do not matter.
    periodic : bool or tuple of bool
        Whether the plane is periodic, along each axis.

    Returns
    -------
    float, or array, shape (...)

    Raises
    ------
    InputError
    """
    s = np.asarray(checked_numbers(spins, "spins"))
    if s.ndim < 3 or s.shape[-1] != 3:
        raise InputError(f"spins of a plane must have shape (..., nx, ny, 3), got {s.shape}")
    lengths = np.linalg.norm(s, axis=-1, keepdims=True)
    if not (np.isfinite(lengths) & (lengths > 0.0)).all():
        raise InputError("every spin must have a finite length greater than 0")
    m = s / lengths
    for axis, is_periodic in zip((-3, -2), np.broadcast_to(periodic, (2,)), strict=True):
        if is_periodic:
            m = np.concatenate([m, np.take(m, [0], axis=axis)], axis=axis)
    a, b, c, d = m[..., :-1, :-1, :], m[..., 1:, :-1, :], m[..., 1:, 1:, :], m[..., :-1, 1:, :]
    areas = _signed_spherical_triangle_area(a, b, c) + _signed_spherical_triangle_area(a, c, d)
    charge = np.sum(areas, axis=(-1, -2)) / (4.0 * np.pi)
    return float(charge) if charge.ndim == 0 else charge


def _signed_spherical_triangle_area(a, b, c) -> np.ndarray:
    """Return the signed areas of spherical triangles, ``2 atan2(a . (b x c), 1 + a . b + b . c + c . a)``."""
    volume = np.sum(a * np.cross(b, c), axis=-1)
    return 2.0 * np.arctan2(volume, 1.0 + np.sum(a * b, axis=-1) + np.sum(b * c, axis=-1) + np.sum(c * a, axis=-1))
