"""Transition temperatures of magnets from fluctuations of the magnetisation: Binder's cumulant and its crossings."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from ...errors import InputError
from ..conditions import checked_numbers, positive_condition
from .spin_energy import checked_finite_numbers

AUTOCORRELATION_WINDOW = 6.0
"""Window of an integrated autocorrelation time, in units of this time [Sokal 1997]."""

BLOCK_LENGTH = 8.0
"""Length of the blocks of a jackknife, in autocorrelation times."""

MIN_BLOCKS = 4
"""Smallest number of blocks of a jackknife."""

MAX_BLOCKS = 40
"""Largest number of blocks of a jackknife."""


class MagnetSamples(NamedTuple):
    """Samples of a magnet in equilibrium at one temperature, in the order of their times.

    Attributes
    ----------
    temperature : float
        k T, in the units of the energy.
    energy : array, shape (n,)
        Energies of all spins together.
    magnetisation : array, shape (n, 3)
        Means of the spins.
    """

    temperature: float
    energy: np.ndarray
    magnetisation: np.ndarray


class Estimate(NamedTuple):
    """A quantity with its standard error.

    Attributes
    ----------
    value, error : float
    """

    value: float
    error: float


def binder_cumulant(magnetisation) -> Estimate:
    """Return Binder's cumulant ``U = 1 - <m^4> / 3 <m^2>^2`` of a magnetisation, with its standard error.

    It is 2/3 in order, and 4/9 for vectors of three components without order. At the transition it hardly depends on
    the size of the lattice [Binder 1981]. The error is that of a jackknife with blocks of eight autocorrelation times
    of ``m^2``; it is too small for a run of fewer than 30 of these times.

    Parameters
    ----------
    magnetisation : array, shape (n, 3)
        Means of the spins along a run in equilibrium, in the order of their times.

    Returns
    -------
    Estimate

    Raises
    ------
    InputError

    Examples
    --------
    >>> m = np.random.default_rng(0).standard_normal((4000, 3))
    >>> found = lt.magnetism.binder_cumulant(m)
    >>> bool(abs(found.value - 4 / 9) < 4 * found.error)
    True
    """
    square = _checked_squared_magnetisation(magnetisation)
    rows = np.arange(len(square))

    def cumulant_of_rows(rows) -> float:
        return _cumulant_of_squares(square[rows])

    return Estimate(cumulant_of_rows(rows), float(np.sqrt(_jackknife_variance(cumulant_of_rows, square))))


def cumulant_crossing(a: MagnetSamples, b: MagnetSamples) -> Estimate:
    """Return the temperature at which Binder's cumulants of two lattices are equal, with its standard error.

    Both lattices are sampled at one temperature near the transition, from which each cumulant is extrapolated. Its
    slope follows from the fluctuations there: ``d<f> / dT = (<f E> - <f> <E>) / k T^2`` for every quantity f. The
    extrapolation is linear, so its error is of the order of the square of the distance to the transition.

    Parameters
    ----------
    a, b : MagnetSamples
        Of two lattices of different sizes, at the same temperature.

    Returns
    -------
    Estimate
        In the units of the temperature.

    Raises
    ------
    InputError
    """
    for samples in (a, b):
        if not isinstance(samples, MagnetSamples):
            raise InputError(f"samples must be lt.magnetism.MagnetSamples, got {type(samples).__name__}")
        positive_condition("the temperature of samples").require(
            checked_numbers(samples.temperature, "the temperature of samples", ())
        )
    if a.temperature != b.temperature:
        raise InputError(f"both lattices must have the same temperature, got {a.temperature:g} and {b.temperature:g}")
    squares = [_checked_squared_magnetisation(samples.magnetisation) for samples in (a, b)]
    energies = [np.asarray(checked_finite_numbers(samples.energy, "the energies of samples")) for samples in (a, b)]
    for square, energy in zip(squares, energies, strict=True):
        if energy.shape != square.shape:
            raise InputError(f"energies of {len(square)} samples must have shape ({len(square)},), got {energy.shape}")
    all_rows = [np.arange(len(square)) for square in squares]

    def crossing_temperature(rows: list[np.ndarray]) -> float:
        cumulants = [_cumulant_of_squares(square[r]) for square, r in zip(squares, rows, strict=True)]
        slopes = [
            _cumulant_temperature_derivative(square[r], energy[r], a.temperature)
            for square, energy, r in zip(squares, energies, rows, strict=True)
        ]
        return float(a.temperature - (cumulants[0] - cumulants[1]) / (slopes[0] - slopes[1]))

    variance = _jackknife_variance(lambda rows: crossing_temperature([rows, all_rows[1]]), squares[0])
    variance += _jackknife_variance(lambda rows: crossing_temperature([all_rows[0], rows]), squares[1])
    return Estimate(crossing_temperature(all_rows), float(np.sqrt(variance)))


def autocorrelation_time(values) -> float:
    """Return the integrated autocorrelation time of a series, shape (n,), in units of the time between two values."""
    x = np.asarray(values, dtype=float)
    x = x - x.mean()
    spectrum = np.fft.rfft(x, 2 * len(x))
    correlation = np.fft.irfft(spectrum * spectrum.conj())[: len(x)]
    if not correlation[0] > 0.0:
        return 0.5
    total = 0.5
    for lag, value in enumerate(correlation[1:] / correlation[0], start=1):
        total += value
        if lag > AUTOCORRELATION_WINDOW * total:
            break
    return float(total)


def _checked_squared_magnetisation(magnetisation) -> np.ndarray:
    """Return ``m^2`` of each sample, shape (n,); raise InputError unless the samples have shape (n, 3)."""
    m = np.asarray(checked_numbers(magnetisation, "a magnetisation"))
    if m.ndim != 2 or m.shape[1] != 3 or len(m) < MIN_BLOCKS or not np.isfinite(m).all():
        raise InputError(
            f"a magnetisation must be finite numbers of shape (n, 3) with n >= {MIN_BLOCKS}, got shape {m.shape}"
        )
    if not m.any():
        raise InputError("a magnetisation must not be zero in every sample")
    return (m**2).sum(axis=1)


def _cumulant_of_squares(squared_magnetisation) -> float:
    """Return Binder's cumulant ``1 - <m^4> / 3 <m^2>^2`` from samples of ``m^2``."""
    return float(1.0 - (squared_magnetisation**2).mean() / (3.0 * squared_magnetisation.mean() ** 2))


def _cumulant_temperature_derivative(squared_magnetisation, energy, temperature: float) -> float:
    """Return the derivative of Binder's cumulant by the temperature k T, from fluctuations of the energy."""
    second_moment, fourth_moment = squared_magnetisation.mean(), (squared_magnetisation**2).mean()
    changes = [
        ((x - x.mean()) * energy).mean() / temperature**2 for x in (squared_magnetisation, squared_magnetisation**2)
    ]
    return float((2.0 * fourth_moment * changes[0] / second_moment - changes[1]) / (3.0 * second_moment**2))


def _jackknife_variance(quantity: Callable, series: np.ndarray) -> float:
    """Return the jackknife variance of a function of a series; each block left out is several autocorrelation times."""
    rows = np.arange(len(series))
    count = int(np.clip(len(rows) / (BLOCK_LENGTH * autocorrelation_time(series)), MIN_BLOCKS, MAX_BLOCKS))
    estimates = [quantity(np.delete(rows, block)) for block in np.array_split(rows, count)]
    return float((count - 1) * np.var(estimates))
