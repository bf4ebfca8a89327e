"""The damped oscillator as an isolated system [SML Examples 1, 5, 7; Figs. 1, 2, 5, 6]."""

from __future__ import annotations

import numpy as np
import scipy

from ..functions.energy import Quadratic
from ..systems import EvolutionSystem
from .parameters import checked_positive


def damped_oscillator(mass: float = 1.0, stiffness: float = 1.0, friction: float = 0.1) -> EvolutionSystem:
    """An oscillator whose friction heats a bath: ``H = p^2 / (2 m) + k q^2 / 2 + gamma S`` in the state (q, p, S).

    ``q' = p / m``, ``p' = -k q - gamma p``, ``S' = p^2 / m``; the bath has the temperature gamma. All energy becomes
    heat: S grows to ``H / gamma``. The midpoint scheme is SML (39). Figs. 1 and 2 start at (0, 10, 0), with h = 0.1 and
    gamma = 0.1; one step leads to (0.99255583, 9.85111663, 9.85167078).

    Parameters
    ----------
    mass, stiffness : float, > 0
        m and k (mass; mass / time**2).
    friction : float, > 0
        gamma (1 / time).

    Examples
    --------
    >>> oscillator = lt.models.damped_oscillator()
    >>> oscillator.dim
    3
    """
    m, k, gamma = (
        checked_positive(mass, "mass"),
        checked_positive(stiffness, "stiffness"),
        checked_positive(friction, "friction"),
    )
    return EvolutionSystem(Quadratic([k, 1.0 / m, 0.0], [0.0, 0.0, gamma]), 3)


def damped_oscillator_solution(t, x0, mass: float = 1.0, stiffness: float = 1.0, friction: float = 0.1) -> np.ndarray:
    """Return the exact states at times t after x0 = (q, p, S), shape (..., 3), for any damping."""
    times, (q, p, S) = np.asarray(t, dtype=float), np.asarray(x0, dtype=float)
    rates = np.array([[0.0, 1.0 / mass], [-stiffness, -friction]])
    oscillation = scipy.linalg.expm(times[..., None, None] * rates) @ np.array([q, p])

    def mechanical_energy(q, p):
        return p**2 / (2 * mass) + stiffness * q**2 / 2

    heat = (mechanical_energy(q, p) - mechanical_energy(oscillation[..., 0], oscillation[..., 1])) / friction
    return np.concatenate([oscillation, (S + heat)[..., None]], axis=-1)
