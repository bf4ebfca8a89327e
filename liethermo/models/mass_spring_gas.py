"""A mass on a spring with friction in an ideal gas, with its exact solution [GBY §5.2-5.3; Ferrari & Gruber 2010]."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from manifolds._pytree_module import Module

from ..functions.energy import Function, Quadratic
from ..systems import SimpleClosedSystem
from .gas_piston import GAS_CONSTANT
from .parameters import checked_positive

CASES = {
    1: {"mass": 5.0, "stiffness": 5.0, "moles": 1.0},
    2: {"mass": 10.0, "stiffness": 20.0, "moles": 2.0},
}
"""The parameters of Cases 1 and 2 of the paper, for ``mass_spring_gas(**CASES[1], friction=...)``."""

STARTS = {1: 0.3, 2: 0.1}
"""Initial positions ``x_0 = x_1`` (m) of both cases, with S_0 = 0; the paper's step is 1e-3 s."""


class FixedVolumeGas(Module):
    """The energy ``U(S) = c N R T_0 exp(S / (c N R))`` of an ideal gas in a fixed volume, with S = 0 at T_0.

    Attributes
    ----------
    heat : heat capacity c N R (J / K)
    temperature : T_0 (K)
    """

    heat: jax.Array
    temperature: jax.Array

    def __call__(self, y):
        return self.heat * self.temperature * jnp.exp(y[0] / self.heat)


def mass_spring_gas(
    mass: float = 5.0,
    stiffness: float = 5.0,
    friction: float = 0.2,
    moles: float = 1.0,
    temperature: float = 300.0,
    c: float = 1.5,
    external=None,
) -> SimpleClosedSystem:
    """A mass on a spring in an ideal gas, which its friction heats: ``L = m v^2 / 2 - k x^2 / 2 - U(S)`` [GBY 5.5].

    ``m x'' = -k x - lambda x' + F_ext``, ``T S' = lambda x'^2``, in SI units and in the state (x, v, S), S counted
    from the temperature T_0. Without an external force :func:`mass_spring_gas_solution` is the exact solution. The
    default is Case 1 of the paper with lambda = 0.2; with lambda = 10 that case is critically damped.

    Parameters
    ----------
    mass, stiffness : float, > 0
        m and k (kg, kg / s**2).
    friction : float, >= 0
        lambda (kg / s).
    moles, temperature, c : float, > 0
        N, T_0 (K), and the heat capacity of the gas at constant volume over R.
    external : optional
        As for :class:`liethermo.SimpleClosedSystem` (N).
    """
    m, k, heat = checked_positive(mass, "mass"), checked_positive(stiffness, "stiffness"), _heat_capacity(moles, c)
    gas = Function(FixedVolumeGas(heat, checked_positive(temperature, "temperature")))
    lagrangian = Quadratic(jnp.stack([-k, m, jnp.zeros(())])) - gas.on([2])
    return SimpleClosedSystem(lagrangian, 3, friction=friction, external=external)


def mass_spring_gas_solution(
    t,
    x0,
    mass: float = 5.0,
    stiffness: float = 5.0,
    friction: float = 0.2,
    moles: float = 1.0,
    temperature: float = 300.0,
    c: float = 1.5,
) -> np.ndarray:
    """Return the exact states (x, v, S) at times t after x0, shape (..., 3), below, at and above critical damping.

    ``x = e^(-kappa t) (x_0 C + (v_0 + kappa x_0) D)`` with ``kappa = lambda / 2m``, ``omega^2 = k/m - kappa^2`` and
    ``C, D = cos(omega t), sin(omega t)/omega``, or ``1, t``, or the hyperbolic ones: (5.6) and its other branches. What
    the mass loses the gas gains, ``c N R (T - T(0)) = f(t)``, and ``S = S(0) + c N R log(T / T(0))`` (5.8, 5.9).

    Parameters
    ----------
    t : array
    x0 : array, shape (3,)
    mass, stiffness, friction, moles, temperature, c
        As for :func:`mass_spring_gas`.
    """
    t, (x0, v0, S0), heat = np.asarray(t, dtype=float), np.asarray(x0, dtype=float), float(_heat_capacity(moles, c))
    kappa = friction / (2 * mass)
    omega_squared = stiffness / mass - kappa**2
    omega = np.sqrt(abs(omega_squared))
    if 4 * mass * stiffness > friction**2:
        C, D = np.exp(-kappa * t) * np.cos(omega * t), np.exp(-kappa * t) * np.sin(omega * t) / omega
    elif 4 * mass * stiffness == friction**2:
        C, D = np.exp(-kappa * t), t * np.exp(-kappa * t)
    else:  # e^(-kappa t) inside: cosh alone overflows
        slow_decay, fast_decay = np.exp((omega - kappa) * t), np.exp(-2 * omega * t)
        C, D = 0.5 * slow_decay * (1 + fast_decay), -0.5 * slow_decay * np.expm1(-2 * omega * t) / omega
    x = x0 * C + (v0 + kappa * x0) * D
    v = v0 * C - (kappa * v0 + stiffness / mass * x0) * D
    lost_energy = 0.5 * mass * (v0**2 - v**2) + 0.5 * stiffness * (x0**2 - x**2)
    S = S0 + heat * np.log1p(lost_energy / (heat * temperature * np.exp(S0 / heat)))
    return np.stack([x, v, S], axis=-1)


def _heat_capacity(moles, c) -> jax.Array:
    return checked_positive(c, "c") * checked_positive(moles, "moles") * GAS_CONSTANT
