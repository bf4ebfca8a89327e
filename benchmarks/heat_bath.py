"""Monte Carlo of the classical Heisenberg magnet: a heat bath with over-relaxation, in NumPy alone."""

from __future__ import annotations

import numpy as np

OVERRELAXATION_PASSES = 2
"""Reflections of every spin about its field between two heat-bath passes; they decorrelate at constant energy."""


def simulate_heisenberg_heat_bath(length: int, temperatures, sweeps: int, seed: int = 0) -> np.ndarray:
    """Return energy per spin and magnetisation vector after each sweep, shape (temperatures, sweeps, 4).

    ``E = -sum s_i . s_j`` on ``length**3`` sites, ``length`` even, periodic. A tenth as many sweeps are made first and
    discarded. A spin in the field h of its neighbours has the density ``exp(h . s / T)``; its component along h is
    drawn by inverting the distribution [Miyatake et al. 1986].
    """
    random, T = np.random.default_rng(seed), np.asarray(temperatures, dtype=float)[:, None]
    site_indices = np.arange(length**3).reshape((length,) * 3)
    neighbours = np.stack([np.roll(site_indices, step, axis).ravel() for axis in range(3) for step in (1, -1)])
    parity = (np.indices(site_indices.shape).sum(axis=0) % 2).ravel()
    sublattices = [np.flatnonzero(parity == side) for side in (0, 1)]  # the spins of one do not see each other
    s = random.standard_normal((3, len(T), length**3))
    s /= np.linalg.norm(s, axis=0)
    samples = np.empty((len(T), sweeps, 4))
    for sweep in range(-(sweeps // 10), sweeps):
        for sweep_pass in range(OVERRELAXATION_PASSES + 1):
            for sites in sublattices:
                h = s[:, :, neighbours[:, sites]].sum(axis=2)
                field_norm = np.linalg.norm(h, axis=0)
                axis = h / field_norm
                if sweep_pass < OVERRELAXATION_PASSES:
                    old_spins = s[:, :, sites]
                    s[:, :, sites] = 2.0 * (axis * old_spins).sum(axis=0) * axis - old_spins
                else:
                    u = random.random(field_norm.shape)
                    parallel = 1.0 + np.log(u + (1.0 - u) * np.exp(-2.0 * field_norm / T)) * T / field_norm
                    perpendicular = random.standard_normal(h.shape)
                    perpendicular -= (perpendicular * axis).sum(axis=0) * axis
                    perpendicular *= np.sqrt(np.maximum(1.0 - parallel**2, 0.0)) / np.linalg.norm(perpendicular, axis=0)
                    s[:, :, sites] = parallel * axis + perpendicular
        if sweep >= 0:
            samples[:, sweep, 0] = (
                -sum((s * s[:, :, partners]).sum(axis=(0, 2)) for partners in neighbours[::2]) / length**3
            )
            samples[:, sweep, 1:] = s.mean(axis=2).T
    return samples
