"""Power of a laser pulse that electrons absorb."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp

from manifolds._pytree_module import Module

from ..conditions import checked_numbers, require_condition

GAUSSIAN_EXPONENT = 4.0 * math.log(2.0)
"""``4 log 2``: a Gaussian ``exp(-4 log 2 (t / w)^2)`` has the full width w at half its maximum."""


class LaserPulse(Module):
    """The power of a Gaussian laser pulse, ``P(t) = E sqrt(4 log 2 / pi) / w exp(-4 log 2 ((t - t_0) / w)^2)``.

    It is an argument ``power`` of ``lt.SpinSystem``, which gives it to a bath, such as that of the electrons.

    Parameters
    ----------
    energy : float >= 0
        E, the energy absorbed. The fluence absorbed times the area, in the units of the energy of the system.
    duration : float > 0
        w, the full width at half maximum (time).
    centre : float
        t_0, the time of the largest power.

    Raises
    ------
    InputError

    Examples
    --------
    >>> pulse = lt.magnetism.LaserPulse(energy=2.0, duration=0.1, centre=0.5)
    >>> round(float(pulse(0.5)), 2), round(float(pulse(0.55) / pulse(0.5)), 3)
    (18.79, 0.5)
    """

    energy: jax.Array
    duration: jax.Array
    centre: jax.Array

    def __init__(self, energy, duration, centre=0.0):
        self.energy = checked_numbers(energy, "the energy of a pulse", ())
        self.duration = checked_numbers(duration, "the duration of a pulse", ())
        self.centre = checked_numbers(centre, "the centre of a pulse", ())
        require_condition(self.energy, lambda e: e >= 0.0, "the energy of a pulse must be >= 0, got {value:g}")
        require_condition(self.duration, lambda w: w > 0.0, "the duration of a pulse must be positive, got {value:g}")

    def __call__(self, t) -> jax.Array:
        height = self.energy * math.sqrt(GAUSSIAN_EXPONENT / math.pi) / self.duration
        return height * jnp.exp(-GAUSSIAN_EXPONENT * ((t - self.centre) / self.duration) ** 2)
