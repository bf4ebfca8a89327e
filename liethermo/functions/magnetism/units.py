"""Units of magnets: constants, gyromagnetic ratios and damping in SI units, in meV and ps, or in reduced units."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import scipy.constants

from ...errors import InputError
from ..conditions import checked_numbers, nonnegative_condition, positive_condition
from .spin_energy import checked_finite_numbers

ELECTRON_G_FACTOR = -scipy.constants.physical_constants["electron g factor"][0]
"""g of a free electron, 2.00232."""

BOHR_MAGNETON = scipy.constants.physical_constants["Bohr magneton"][0]
"""mu_B in J / T."""

MAGNETIC_CONSTANT = scipy.constants.physical_constants["vacuum mag. permeability"][0]
"""mu_0 in T m / A."""

JOULE_PER_MEV = 1e-3 * scipy.constants.elementary_charge
"""Joule in a meV."""

SECONDS_PER_PS = 1e-12
"""Seconds in a picosecond."""

METRES_PER_ANGSTROM = 1e-10
"""Metres in an angstrom."""


class SpinDynamics(NamedTuple):
    """Parameters of ``lt.SpinSystem`` and ``lt.LandauLifshitz``, for unit vectors.

    Attributes
    ----------
    ratio : array
        Of the precession (1 / (energy * time)); the argument ``ratio`` of ``lt.SpinSystem``.
    rate : array
        Of the damping (1 / (energy * time)); the argument of ``lt.LandauLifshitz``.
    """

    ratio: jnp.ndarray
    rate: jnp.ndarray


class Units(NamedTuple):
    """A system of units for magnets; see :func:`units`.

    Attributes
    ----------
    name : str
        The name of the unit system.
    energy, time, length : str
        Names of the units. Fields are in tesla and temperatures in kelvin, except in reduced units.
    bohr_magneton : float
        mu_B (energy / field).
    boltzmann : float
        k (energy / temperature).
    hbar : float
        Reduced constant of Planck (energy * time).
    dipole_constant : float
        ``mu_0 / 4 pi`` (energy * length**3 / moment**2), the argument ``strength`` of ``lt.magnetism.dipoles``.
    """

    name: str
    energy: str
    time: str
    length: str
    bohr_magneton: float
    boltzmann: float
    hbar: float
    dipole_constant: float

    def gamma(self, g=ELECTRON_G_FACTOR):
        """Return the gyromagnetic ratio ``g mu_B / hbar`` (radian / (time * field)), of a spin with the factor g."""
        factor = g if isinstance(g, int | float) else checked_numbers(g, "the factor g")
        return factor * self.bohr_magneton / self.hbar

    def moment(self, magnetons=1.0):
        """Return the magnetic moment, in these units (energy / field), of so many Bohr ``magnetons``."""
        return self.bohr_magneton * checked_numbers(magnetons, "a moment")

    def thermal_energy(self, temperature):
        """Return ``k T`` (energy) of a ``temperature``: the temperature of ``lt.HeatBaths``, whose entropy is S / k."""
        return self.boltzmann * checked_numbers(temperature, "a temperature")

    def frequency(self, field, g: float = ELECTRON_G_FACTOR):
        """Return the frequency ``gamma B / 2 pi`` (1 / time) of a spin with the factor g in a ``field``."""
        return self.gamma(g) * checked_numbers(field, "a field") / (2.0 * jnp.pi)

    def gilbert(self, alpha, moment=None, g: float = ELECTRON_G_FACTOR) -> SpinDynamics:
        """Return the parameters of spins whose motion is Gilbert's, ``s' = -gamma s x B + alpha s x s'``.

        Here ``B = -grad H / mu``, so that ``ratio = gamma / (mu (1 + alpha^2))`` and ``rate = alpha ratio``.

        Parameters
        ----------
        alpha : float >= 0, or array of the shape of the sites
        moment : float, or array of the shape of the sites, optional
            mu (energy / field); one Bohr magneton by default.
        g : float

        Returns
        -------
        SpinDynamics
        """
        alpha, ratio = _checked_damping(alpha), self._gyromagnetic_ratio(moment, g)
        return SpinDynamics(ratio / (1.0 + alpha**2), alpha * ratio / (1.0 + alpha**2))

    def landau_lifshitz(self, alpha, moment=None, g: float = ELECTRON_G_FACTOR) -> SpinDynamics:
        """Return the parameters of Landau and Lifshitz' form, ``s' = -gamma s x B - alpha gamma s x (s x B)``.

        Parameters
        ----------
        alpha : float >= 0, or array of the shape of the sites
        moment : float, or array of the shape of the sites, optional
            mu (energy / field); one Bohr magneton by default.
        g : float

        Returns
        -------
        SpinDynamics
        """
        alpha, ratio = _checked_damping(alpha), self._gyromagnetic_ratio(moment, g)
        return SpinDynamics(ratio, alpha * ratio)

    def _gyromagnetic_ratio(self, moment, g: float):
        """Return ``gamma / mu`` for spins of this moment, by default one Bohr magneton."""
        mu = self.moment() if moment is None else checked_numbers(moment, "a moment")
        positive_condition("a moment").require(mu)
        factor = checked_finite_numbers(g, "the factor g")
        return self.gamma(factor) / mu


def _checked_damping(alpha):
    """Return a damping constant; raise InputError if it is negative."""
    alpha = checked_numbers(alpha, "alpha")
    nonnegative_condition("alpha").require(alpha)
    return alpha


def units(name: str = "meV") -> Units:
    """Return a system of units for magnets, with constants, gyromagnetic ratios and damping.

    Parameters
    ----------
    name : str
        "SI": joule, second and metre. "meV": meV, picosecond and angstrom. In both, fields are in tesla, temperatures
        in kelvin and moments in energy / tesla. "reduced": every constant is 1, except the factor g.

    Returns
    -------
    Units

    Raises
    ------
    InputError

    Examples
    --------
    >>> si = lt.magnetism.units("SI")
    >>> round(float(si.frequency(1.0)) / 1e9, 2)  # GHz, of one spin in 1 T
    28.02
    >>> meV = lt.magnetism.units("meV")
    >>> motion = meV.gilbert(0.1, moment=meV.moment(2.2))
    >>> iron = lt.SpinSystem(
    ...     1,
    ...     lt.magnetism.zeeman(1, (0, 0, 1.0), meV.moment(2.2)),
    ...     lt.LandauLifshitz(motion.rate),
    ...     ratio=motion.ratio,
    ... )
    """
    k, hbar = scipy.constants.Boltzmann, scipy.constants.hbar
    dipole = MAGNETIC_CONSTANT / (4.0 * scipy.constants.pi)
    if name == "SI":
        return Units("SI", "J", "s", "m", BOHR_MAGNETON, k, hbar, dipole)
    if name == "meV":
        meV = JOULE_PER_MEV
        return Units(
            "meV",
            "meV",
            "ps",
            "angstrom",
            BOHR_MAGNETON / meV,
            k / meV,
            hbar / (meV * SECONDS_PER_PS),
            dipole * meV / METRES_PER_ANGSTROM**3,
        )
    if name == "reduced":
        return Units("reduced", "energy", "time", "length", 1.0, 1.0, 1.0, 1.0)
    raise InputError(f'the units of magnets must be "SI", "meV" or "reduced", got {name!r}')
