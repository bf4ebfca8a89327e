"""Small motions about a state of rest: frequencies of spin waves, and the temperature of spins."""

from __future__ import annotations

import math
from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from manifolds._precision import with_library_settings

from ...errors import InputError
from ..energy import Energy
from .lattices import Lattice
from .spin_energy import check_spin_lengths, checked_finite_numbers, energy_of_spins, lattice_shape

REST_TOLERANCE = 1e-5
"""Largest torque of a state of rest, relative to the largest gradient."""


@with_library_settings
def spin_wave_frequencies(
    energy, lattice: Lattice, spins, wave_vectors, ratio=1.0, magnetic_cell: Sequence[int] | None = None
) -> np.ndarray:
    """Return the angular frequencies of small waves about a state of rest, by linear response.

    The motion ``s' = ratio s x grad H`` is linearised about a periodic state. The matrix of a wave vector is the
    Fourier transform of the second derivatives of the energy, so any energy will do. Wave vectors between those of the
    lattice need interactions that are shorter than half of the lattice.

    Parameters
    ----------
    energy : Energy, list of energies, or function from the spins, shape ``(*sites, 3)``, to a scalar
        The energy of the spins of a periodic lattice.
    lattice : Lattice
        The lattice of the sites.
    spins : array, shape ``(*sites, 3)``
        A state of rest, such as the spins of :func:`minimise`.
    wave_vectors : array, shape (..., 3)
        Wave vectors (1 / length).
    ratio : float
        Ratio of the precession; ``gamma / mu`` for unit vectors.
    magnetic_cell : sequence of int, optional
        Number of cells of the lattice, along each vector, that the state repeats after; one by default.

    Returns
    -------
    array, shape (..., modes)
        Angular frequencies (radian / time) in ascending order, one for each spin of the magnetic cell. A frequency is
        NaN where the state is unstable.

    Raises
    ------
    InputError, FunctionError
        If the state is not at rest, or does not repeat.

    Examples
    --------
    >>> chain = lt.magnetism.lattice("chain", 8)
    >>> up = np.tile([0.0, 0.0, 1.0], (8, 1))
    >>> q = [(0.5 * np.pi, 0.0, 0.0)]
    >>> lt.magnetism.spin_wave_frequencies(
    ...     lt.magnetism.exchange(chain, 1.0), chain, up, q
    ... ).round(6).tolist()
    [[2.0]]
    """
    if not isinstance(lattice, Lattice):
        raise InputError(f"lattice must be one of lt.magnetism.lattice, got {type(lattice).__name__}")
    function = energy_of_spins(energy, lattice.sites)
    s = np.asarray(checked_finite_numbers(spins, "spins", (*lattice.sites, 3)))
    check_spin_lengths(s)
    q = np.asarray(checked_finite_numbers(wave_vectors, "wave vectors"))
    if q.shape[-1:] != (3,):
        raise InputError(f"wave vectors must have shape (..., 3), got {q.shape}")
    gamma = float(checked_finite_numbers(ratio, "ratio", ()))
    repeat = _checked_magnetic_cell(magnetic_cell, lattice)
    _check_spins_repeat(s, lattice, repeat)
    gradient = np.asarray(function.gradient(s.ravel())).reshape(-1, 3)
    flat_spins = s.reshape(-1, 3)
    torques = np.linalg.norm(np.cross(flat_spins, gradient), axis=1) / np.linalg.norm(flat_spins, axis=1)
    if torques.max() > REST_TOLERANCE * max(np.linalg.norm(gradient, axis=1).max(), 1e-300):
        raise InputError(
            "spins must be a state of rest, but their torques do not vanish. Use lt.magnetism.minimise first"
        )
    numbers, members, offsets = _magnetic_cell_sites_and_offsets(lattice, repeat)
    frames = np.empty((len(flat_spins), 2, 3))
    frames[numbers] = _local_frames(flat_spins[members])
    lengths = np.linalg.norm(flat_spins[members], axis=1)
    rows = _hessian_rows(function, flat_spins, members, frames)
    radial_slopes = np.sum(gradient[members] * flat_spins[members], axis=1) / lengths**2
    count = len(members)
    for k, i in enumerate(members):  # a spin moves on a sphere, whose curvature adds the slope along the spin
        rows[2 * k : 2 * k + 2, i] -= radial_slopes[k] * np.eye(2)
    positions = offsets @ lattice.vectors
    rotation = np.kron(np.diag(gamma * lengths), [[0.0, -1.0], [1.0, 0.0]])
    frequencies = []
    for wave in q.reshape(-1, 3):
        phases = np.exp(1j * positions @ wave)
        blocks = np.einsum("rcms,c->rms", rows[:, numbers], phases)
        values = np.linalg.eigvals(1j * rotation @ blocks.reshape(2 * count, 2 * count))
        frequencies.append(_positive_frequencies(values, count))
    return np.stack(frequencies).reshape(*q.shape[:-1], count)


def _checked_magnetic_cell(magnetic_cell, lattice: Lattice) -> tuple[int, ...]:
    """Return the numbers of cells of a magnetic cell; raise InputError unless they divide those of the lattice."""
    if magnetic_cell is None:
        return (1,) * len(lattice.cells)
    values: list = np.atleast_1d(np.asarray(magnetic_cell, dtype=object)).ravel().tolist()
    is_valid = len(values) == len(lattice.cells) and all(
        isinstance(m, int) and not isinstance(m, bool) and m > 0 and n % m == 0
        for n, m in zip(lattice.cells, values, strict=True)
    )
    if not is_valid:
        raise InputError(
            f"magnetic_cell must be positive integers that divide the cells {lattice.cells}, one for each axis, got "
            f"{magnetic_cell!r}"
        )
    return tuple(values)


def _positive_frequencies(eigenvalues: np.ndarray, n_frequencies: int) -> np.ndarray:
    """Return the ``n_frequencies`` largest real eigenvalues, in ascending order, with NaN in place of complex pairs."""
    scale = max(np.abs(eigenvalues).max(), 1e-300)
    is_real = np.abs(eigenvalues.imag) <= IMAGINARY_TOLERANCE * scale
    # two eigenvalues belong to a spin, and complex ones are pairs
    n_real = max(n_frequencies - int(np.count_nonzero(~is_real)) // 2, 0)
    real = np.sort(eigenvalues.real[is_real])
    upper = np.concatenate([real[len(real) - n_real :], np.full(n_frequencies - n_real, np.nan)])
    return np.where(np.abs(upper) <= IMAGINARY_TOLERANCE * scale, np.abs(upper), upper)


IMAGINARY_TOLERANCE = 1e-6
"""Imaginary part, relative to the largest frequency, that is rounding: a double zero splits by the root of rounding."""


def _check_spins_repeat(spins: np.ndarray, lattice: Lattice, magnetic_cell: tuple[int, ...]) -> None:
    """Raise InputError unless the lattice is periodic and the spins repeat after each magnetic cell."""
    if not all(lattice.periodic):
        raise InputError("waves need a lattice that is periodic along every axis")
    for axis, m in enumerate(magnetic_cell):
        if np.abs(np.roll(spins, m, axis=axis) - spins).max() > REST_TOLERANCE * np.abs(spins).max():
            raise InputError(
                f"the spins do not repeat after {m} cells along axis {axis}. Give magnetic_cell= with the period"
            )


def _magnetic_cell_sites_and_offsets(
    lattice: Lattice, magnetic_cell: tuple[int, ...]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the sites of each magnetic cell, shape (cells, members), those of the first cell, and the cells' offsets.

    Offsets are of least length, with the signs of a periodic lattice.
    """
    atoms = len(lattice.basis)
    axes = len(magnetic_cell)
    numbers = np.arange(lattice.site_count).reshape(*lattice.cells, atoms)
    counts = tuple(n // m for n, m in zip(lattice.cells, magnetic_cell, strict=True))
    split_numbers = numbers.reshape(
        *(length for pair in zip(counts, magnetic_cell, strict=True) for length in pair), atoms
    )
    numbers_by_cell = split_numbers.transpose(*range(0, 2 * axes, 2), *range(1, 2 * axes, 2), 2 * axes)
    table = numbers_by_cell.reshape(math.prod(counts), -1)
    grids = np.meshgrid(
        *(np.rint(np.fft.fftfreq(n, 1.0 / n)) * m for n, m in zip(counts, magnetic_cell, strict=True)), indexing="ij"
    )
    offsets = np.stack(grids, axis=-1).reshape(-1, axes)
    return table, table[0], offsets


def _local_frames(spins: np.ndarray) -> np.ndarray:
    """Return two unit vectors across each spin, right-handed with it, shape (n, 2, 3)."""
    e3 = spins / np.linalg.norm(spins, axis=1, keepdims=True)
    helper = np.eye(3)[np.argmin(np.abs(e3), axis=1)]
    e1 = np.cross(helper, e3)
    e1 = e1 / np.linalg.norm(e1, axis=1, keepdims=True)
    return np.stack([e1, np.cross(e3, e1)], axis=1)


def _hessian_rows(energy: Energy, spins: np.ndarray, members: np.ndarray, frames: np.ndarray) -> np.ndarray:
    """Return the rows of the Hessian of an energy that belong to some spins, in local frames across the spins.

    The rows are those of the members, for all n spins: shape (2 members, n, 2).
    """
    n = len(spins)
    directions = np.zeros((2 * len(members), n, 3))
    for k, i in enumerate(members):
        directions[2 * k : 2 * k + 2, i] = frames[i]
    x = jnp.asarray(spins.ravel())

    def hessian_product(v):
        return jax.jvp(energy.gradient, (x,), (v,))[1]

    products = jax.lax.map(hessian_product, jnp.asarray(directions.reshape(len(directions), -1)))
    return np.einsum("rnc,ntc->rnt", np.asarray(products).reshape(len(directions), n, 3), frames)


MAX_EXACT_SITES = 500
"""Number of spins up to which the Laplacian of the energy is computed exactly, by three products for each."""

TRACE_PROBES = 64
"""Random vectors that estimate the Laplacian of the energy of more spins [Hutchinson 1990]."""


@with_library_settings
def spin_temperature(energy, spins, sites) -> float:
    """Return the temperature k T (energy) of spins, estimated from their states as the ratio of two means.

    In equilibrium the mean of ``sum |s_i x grad_i H|^2 / |s_i|^2`` is kT times the mean of the Laplacian of H on the
    spheres of the spins. For bilinear energies that is ``kT = sum |s_i x B_i|^2 / 2 sum s_i . B_i`` with B = -grad H
    [Rugh 1997; Nurdin & Schotte 2000]; here anisotropies of any order are included. A state of N spins determines T to
    about N^{-1/2}. If there are more than 500 spins, 64 random vectors estimate the Laplacian with a smaller error.

    Parameters
    ----------
    energy : Energy, list of energies, or function from the spins, shape ``(*sites, 3)``, to a scalar
        The energy of the spins.
    spins : array, shape ``(..., *sites, 3)``
        One state, or samples of equilibrium, over which numerator and denominator are averaged.
    sites : int, tuple of int or Lattice
        Number of spins, or the shape of their lattice.

    Returns
    -------
    float

    Raises
    ------
    InputError, FunctionError
        If the shape is wrong, a spin is zero or not finite, or the Laplacian is not positive, as in states of negative
        temperature.
    """
    site_shape = lattice_shape(sites)
    function, shape = energy_of_spins(energy, site_shape), (*site_shape, 3)
    s = np.asarray(checked_finite_numbers(spins, "spins"))
    if s.shape[-len(shape) :] != shape or not s.size:
        raise InputError(f"spins must have shape (..., {', '.join(map(str, shape))}), got {s.shape}")
    check_spin_lengths(s)
    samples = jnp.asarray(s.reshape(-1, math.prod(shape)))
    count = samples.shape[1] // 3
    probes = (
        None if count <= MAX_EXACT_SITES else np.random.default_rng(0).choice([-1.0, 1.0], (TRACE_PROBES, 3 * count))
    )
    numerator, denominator = 0.0, 0.0
    for x in samples:
        squares, laplacian = _squared_torques_and_laplacian(function, x, probes)
        numerator, denominator = numerator + float(squares), denominator + float(laplacian)
    if not denominator > 0.0:
        raise InputError(
            "the Laplacian of the energy is not positive, so the states have no positive temperature. Give samples of "
            "equilibrium"
        )
    return numerator / denominator


@eqx.filter_jit
def _squared_torques_and_laplacian(energy: Energy, x, probes) -> tuple[jax.Array, jax.Array]:
    """Return the sum of squared tangential gradients, and the sum of the Laplacians of the energy on the spheres."""
    s, g = x.reshape(-1, 3), energy.gradient(x).reshape(-1, 3)
    squares = jnp.sum(s * s, axis=1)
    radial_slopes = jnp.sum(s * g, axis=1) / squares
    tangential = g - radial_slopes[:, None] * s

    def project_onto_tangent_space(v):
        v = v.reshape(-1, 3)
        return (v - (jnp.sum(v * s, axis=1) / squares)[:, None] * s).reshape(-1)

    def quadratic_form(v):
        return jnp.dot(
            project_onto_tangent_space(v), jax.jvp(energy.gradient, (x,), (project_onto_tangent_space(v),))[1]
        )

    if probes is None:
        forms = jnp.sum(jax.lax.map(lambda i: quadratic_form(jnp.zeros_like(x).at[i].set(1.0)), jnp.arange(x.size)))
    else:
        forms = jnp.mean(jax.lax.map(quadratic_form, probes))
    return jnp.sum(tangential**2), forms - 2.0 * jnp.sum(radial_slopes)
