"""The classical Heisenberg magnet by Monte Carlo: a heat bath with over-relaxation, in NumPy alone."""

from __future__ import annotations

import numpy as np

OVERRELAXATION_PASSES = 2
"""Reflections of every spin at its field between two passes of the heat bath: they decorrelate, at constant energy."""


def sample_heat_bath(length: int, temperatures, sweeps: int, seed: int = 0) -> np.ndarray:
    """Energy a spin and magnetisation vector after each sweep, shape (temperatures, sweeps, 4).

    ``E = -sum s_i . s_j`` on ``length**3`` sites, ``length`` even, periodic. A tenth as many sweeps come first and are
    not kept. A spin in a field h of its neighbours has ``exp(h . s / T)`` as its density; its component along h is
    found by inverting the distribution [Miyatake et al. 1986].
    """
    random, T = np.random.default_rng(seed), np.asarray(temperatures, dtype=float)[:, None]
    places = np.arange(length**3).reshape((length,) * 3)
    neighbours = np.stack([np.roll(places, step, axis).ravel() for axis in range(3) for step in (1, -1)])
    odd = (np.indices(places.shape).sum(axis=0) % 2).ravel()
    halves = [np.flatnonzero(odd == side) for side in (0, 1)]  # the spins of one do not see each other
    s = random.standard_normal((3, len(T), length**3))
    s /= np.linalg.norm(s, axis=0)
    kept = np.empty((len(T), sweeps, 4))
    for sweep in range(-(sweeps // 10), sweeps):
        for passing in range(OVERRELAXATION_PASSES + 1):
            for here in halves:
                h = s[:, :, neighbours[:, here]].sum(axis=2)
                size = np.linalg.norm(h, axis=0)
                axis = h / size
                if passing < OVERRELAXATION_PASSES:
                    old = s[:, :, here]
                    s[:, :, here] = 2.0 * (axis * old).sum(axis=0) * axis - old
                else:
                    u = random.random(size.shape)
                    along = 1.0 + np.log(u + (1.0 - u) * np.exp(-2.0 * size / T)) * T / size
                    across = random.standard_normal(h.shape)
                    across -= (across * axis).sum(axis=0) * axis
                    across *= np.sqrt(np.maximum(1.0 - along**2, 0.0)) / np.linalg.norm(across, axis=0)
                    s[:, :, here] = along * axis + across
        if sweep >= 0:
            kept[:, sweep, 0] = -sum((s * s[:, :, there]).sum(axis=(0, 2)) for there in neighbours[::2]) / length**3
            kept[:, sweep, 1:] = s.mean(axis=2).T
    return kept
