"""Two containers of ideal gas with a moving piston between them."""

from __future__ import annotations

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from manifolds._pytree_module import Module

from ..functions.conditions import checked_numbers
from ..functions.energy import Function
from ..functions.mechanics import Kinetic
from ..systems import ComposedSystem, Subsystem
from .parameters import checked_positive
from .thermo_particles import ThermalEnergy

GAS_CONSTANT = 8.31446261815324
"""Molar gas constant R, J / (K mol)."""


class IdealGas(Module):
    """An ideal gas of energy ``U(S, V) = U_0 exp(S / (c n R)) (V / V_0)^(-1/c)``, ``U_0 = c n R T_0``.

    ``T = U / (c n R)``, ``P = n R T / V``.

    Attributes
    ----------
    moles : n
    volume, temperature : V_0 (m**3) and T_0 (K)
    c : heat capacity at constant volume over R
    """

    moles: jax.Array
    volume: jax.Array
    temperature: float = 300.0
    c: float = 1.5

    def energy(self, S, V):
        """Return the energy U (J) at an entropy (J / K) and a volume (m**3)."""
        heat = self.c * self.moles * GAS_CONSTANT
        return heat * self.temperature * jnp.exp(S / heat) * (V / self.volume) ** (-1.0 / self.c)

    def entropy(self, T, V):
        """Return the entropy S (J / K) at a temperature (K) and a volume (m**3)."""
        nR = self.moles * GAS_CONSTANT
        return self.c * nR * jnp.log(T / self.temperature) + nR * jnp.log(V / self.volume)


class _CylinderGasEnergy(Module):
    """The energy of a gas left or right of the piston as a function of (q, S)."""

    gas: IdealGas
    area: jax.Array
    length: jax.Array
    is_right: bool = eqx.field(static=True)

    def volume(self, q):
        return self.area * (self.length - q if self.is_right else q)

    def __call__(self, y):
        return self.gas.energy(y[1], self.volume(y[0]))


def gas_piston(
    moles: Sequence[float] = (1.0, 1.0),
    mass: float = 1.0,
    area: float = 0.01,
    length: float = 1.0,
    capacity: float = 10.0,
    conductance: Sequence[float] = (5.0, 5.0),
    friction: float = 20.0,
) -> ComposedSystem:
    """Two gases in a cylinder, separated by a piston with heat conduction and friction.

    ``H = p^2 / (2 m) + C exp(S_p / C) + U_l(S_l, A q) + U_r(S_r, A (L - q))``, 0 < q < L, in SI units, and in the state
    (S_l, q, p, S_p, S_r). It rests where the pressures agree, ``q = L n_l / (n_l + n_r)``, and all temperatures,
    at ``H / ((3/2) (n_l + n_r) R + C)``.

    Parameters
    ----------
    moles : two numbers > 0
        Amounts of the monatomic gases (c = 3/2); their entropies are 0 at 300 K in half of the cylinder.
    mass, area, length : float, > 0
        Mass and area of the piston, length of the cylinder (kg, m**2, m).
    capacity : float, > 0
        Heat capacity C of the piston (J / K).
    conductance : two numbers >= 0
        Heat conductance between the piston and each gas (W / K).
    friction : float, >= 0
        Friction coefficient of the piston in the cylinder (kg / s); the friction heats the piston.
    """
    n = checked_positive(moles, "moles", 2)
    A, L, m = checked_positive(area, "area"), checked_positive(length, "length"), checked_positive(mass, "mass")
    gases = [
        _CylinderGasEnergy(IdealGas(n_i, 0.5 * A * L), A, L, is_right)
        for n_i, is_right in zip(n, (False, True), strict=True)
    ]
    checked_numbers(conductance, "conductance", (2,))
    piston = Kinetic((1.0 / m)[None]) + Function(ThermalEnergy(checked_positive(capacity, "capacity"))).on([2])
    return ComposedSystem(
        {"left gas": Subsystem(None, 1), "piston": Subsystem(piston, 3, friction), "right gas": Subsystem(None, 1)},
        coupling=[Function(gas).on([1, entropy_index]) for gas, entropy_index in zip(gases, (0, 4), strict=True)],
        conductance=[(0, 1, conductance[0]), (1, 2, conductance[1])],
        connected=False,  # allow an adiabatic piston
        validate=False,  # most normally distributed q lie outside the cylinder
    )


def gas_piston_state(q, temperatures, moles=(1.0, 1.0), area=0.01, length=1.0, capacity=10.0, p=0.0) -> np.ndarray:
    """Return the state, shape (5,), with the piston at q and the temperatures (K) of left gas, piston and right gas."""
    left_gas, right_gas = (IdealGas(jnp.asarray(n), jnp.asarray(0.5 * area * length)) for n in moles)
    T_left, T_piston, T_right = temperatures
    S_left, S_right = left_gas.entropy(T_left, area * q), right_gas.entropy(T_right, area * (length - q))
    return np.array([S_left, q, p, capacity * np.log(T_piston), S_right], dtype=float)


def gas_piston_equilibrium(energy, moles=(1.0, 1.0), length=1.0, capacity=10.0) -> tuple[float, float]:
    """Return the equilibrium position q (m) of the piston and the common temperature (K), at a total energy (J)."""
    total_moles = float(sum(moles))
    return length * moles[0] / total_moles, float(energy) / (1.5 * total_moles * GAS_CONSTANT + capacity)
