"""A gas under a piston, with external pressure and heating."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from manifolds._pytree_module import Module

from ..functions.conditions import checked_numbers
from ..functions.energy import Function
from ..functions.mechanics import Kinetic
from ..systems import SimpleClosedSystem
from ..systems.ledger import add_time_argument
from .gas_piston import GAS_CONSTANT, IdealGas
from .parameters import checked_positive


class _GasEnergy(Module):
    """The internal energy of the gas as a function of (q, S)."""

    gas: IdealGas
    area: jax.Array

    def __call__(self, y):
        return self.gas.energy(y[1], self.area * y[0])


def cylinder(
    mass: float = 1.0,
    area: float = 0.01,
    friction: float = 20.0,
    moles: float = 1.0,
    height: float = 2.5,
    pressure=None,
    heat_power=None,
) -> SimpleClosedSystem:
    """A gas in a cylinder below a piston at height q, whose friction heats the gas.

    ``L = m v^2 / 2 - U(S, A q)``, q > 0, ``F_fr = -lambda v``, ``F_ext = -P A``, in SI units and in the state
    (q, v, S), or (q, v, S, W, Q, t) with external pressure or heating. ``m q'' = (P_gas - P) A - lambda q'``.

    Parameters
    ----------
    mass, area : float, > 0
        Mass and area of the piston (kg, m**2).
    friction : float, >= 0
        lambda (kg / s).
    moles, height : float, > 0
        Amount of the monatomic gas (mol), and the height of the piston (m) at which its entropy is 0 at 300 K.
    pressure : float, or function of (q, v, S) or (q, v, S, t) to a scalar; optional
        External pressure P (Pa).
    heat_power : float, or function likewise; optional
        External heating power of the gas (W).
    """
    n, m, A = checked_positive(moles, "moles"), checked_positive(mass, "mass"), checked_positive(area, "area")
    gas = IdealGas(n, A * checked_positive(height, "height"))
    external_force = pressure
    if pressure is not None:
        external_force = (
            _PressureForce(add_time_argument(pressure), A)
            if callable(pressure)
            else -A * checked_numbers(pressure, "pressure", ())[None]
        )
    return SimpleClosedSystem(
        Kinetic(m[None]) - Function(_GasEnergy(gas, A)).on([0, 2]),
        3,
        friction=friction,
        external=external_force,
        heat_power=heat_power,
        validate=False,  # half of the normally distributed q lie below the bottom
    )


def cylinder_rest(pressure, T, area: float = 0.01, moles: float = 1.0, height: float = 2.5) -> np.ndarray:
    """Return the equilibrium state (q, v, S), shape (3,), under a pressure (Pa) at a temperature (K): ``P A q = n R
    T``."""
    gas = IdealGas(jnp.asarray(moles), jnp.asarray(area * height))
    volume = moles * GAS_CONSTANT * T / pressure
    return np.array([volume / area, 0.0, gas.entropy(T, volume)], dtype=float)


class _PressureForce(Module):
    """The external force ``-P A``, shape (1,)."""

    pressure: Callable
    area: jax.Array

    def __call__(self, q, v, S, t):
        return -self.area * jnp.reshape(self.pressure(q, v, S, t), 1)
