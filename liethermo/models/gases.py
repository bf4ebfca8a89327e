"""Gases: under pistons, in a cylinder, behind a mass on a spring [GBY §5.2-5.3], and open to their surroundings."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from manifolds._pytree_module import Module

from ..errors import InputError
from ..functions.conditions import checked_numbers, positive_condition, require_condition
from ..functions.energy import Function, Quadratic
from ..functions.mechanics import Kinetic
from ..systems import ComposedSystem, Membrane, Reaction, SimpleClosedSystem, Subsystem
from ..systems.ledger import add_time_argument
from .parameters import checked_finite, checked_positive
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

    moles: jax.Array = eqx.field(metadata=positive_condition("moles").metadata)
    volume: jax.Array = eqx.field(metadata=positive_condition("volume").metadata)
    temperature: float = eqx.field(default=300.0, metadata=positive_condition("temperature").metadata)
    c: float = eqx.field(default=1.5, metadata=positive_condition("c").metadata)

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
    area: jax.Array = eqx.field(metadata=positive_condition("area").metadata)
    length: jax.Array = eqx.field(metadata=positive_condition("length").metadata)
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


class _GasEnergy(Module):
    """The internal energy of the gas as a function of (q, S)."""

    gas: IdealGas
    area: jax.Array = eqx.field(metadata=positive_condition("area").metadata)

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
    heat_power : float, or function of (q, v, S) or (q, v, S, t) to a scalar; optional
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
    area: jax.Array = eqx.field(metadata=positive_condition("area").metadata)

    def __call__(self, q, v, S, t):
        return -self.area * jnp.reshape(self.pressure(q, v, S, t), 1)


MASS_SPRING_CASES = {
    1: {"mass": 5.0, "stiffness": 5.0, "moles": 1.0},
    2: {"mass": 10.0, "stiffness": 20.0, "moles": 2.0},
}
"""The parameters of Cases 1 and 2 of [GBY 5.5], for ``mass_spring_gas(**MASS_SPRING_CASES[1], friction=...)``."""

MASS_SPRING_STARTS = {1: 0.3, 2: 0.1}
"""Initial positions ``x_0 = x_1`` (m) of both cases, with S_0 = 0; the paper's step is 1e-3 s."""


class FixedVolumeGas(Module):
    """The energy ``U(S) = c N R T_0 exp(S / (c N R))`` of an ideal gas in a fixed volume, with S = 0 at T_0.

    Attributes
    ----------
    heat : heat capacity c N R (J / K)
    temperature : T_0 (K)
    """

    heat: jax.Array = eqx.field(metadata=positive_condition("the heat capacity").metadata)
    temperature: jax.Array = eqx.field(metadata=positive_condition("temperature").metadata)

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

    ``x = e^(-kappa t) (x_0 C + (v_0 + kappa x_0) D)`` with ``kappa = lambda / 2m`` and ``omega^2 = k/m - kappa^2``.
    Below critical damping ``C, D = cos(omega t), sin(omega t)/omega`` (5.6); at critical damping ``C, D = 1, t``; above
    it C and D are the hyperbolic functions of ``|omega| t``. The gas gains the energy f(t) that the mass loses,
    ``c N R (T - T(0)) = f(t)``, and its entropy is ``S = S(0) + c N R log(T / T(0))`` (5.8, 5.9).

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


class IdealMixture(Module):
    """A mixture of ideal gases, ``U = sum_k N_k (c_k T + e_k)``, ``S = sum_k N_k (c_k ln T + s_k - ln(N_k / V))``, k_B
    = 1.

    So T is an explicit function of (S, N, V), ``mu_k = e_k + (c_k + 1) T - T (c_k ln T + s_k - ln(N_k / V))`` and
    ``P = sum_k N_k T / V``.

    Attributes
    ----------
    capacity : array, shape (K,)
        c_k, the heat capacity of a particle at constant volume.
    energy : array, shape (K,)
        e_k, the energy of a particle at T = 0.
    entropy : array, shape (K,)
        s_k, the entropy of a particle at T = 1 in the volume 1.
    """

    capacity: jax.Array = eqx.field(metadata=positive_condition("capacity").metadata)
    energy: jax.Array
    entropy: jax.Array

    def temperature(self, S, N, V):
        mixing = jnp.sum(N * (self.entropy - jnp.log(N / V)))
        return jnp.exp((S - mixing) / jnp.sum(N * self.capacity))

    def internal_energy(self, S, N, V):
        return jnp.sum(N * (self.capacity * self.temperature(S, N, V) + self.energy))

    def entropy_at(self, T, N, V):
        """Return the entropy S of N particles, shape (species,), at a temperature T in a volume V."""
        return jnp.sum(N * (self.capacity * jnp.log(T) + self.entropy - jnp.log(N / V)))

    def equilibrium_constant(self, T, stoichiometry) -> jax.Array:
        """Return the equilibrium constant of densities at T, ``prod (N_k / V)^nu_k`` where ``nu . mu = 0``."""
        standard = self.energy + (self.capacity + 1.0) * T - T * (self.capacity * jnp.log(T) + self.entropy)
        return jnp.exp(-jnp.dot(jnp.asarray(stoichiometry), standard) / T)


def _single_species_gas(heat_capacity) -> IdealMixture:
    """Return a gas of one species with zero energy and entropy constants."""
    return IdealMixture(checked_positive(heat_capacity, "heat_capacity")[None], jnp.zeros(1), jnp.zeros(1))


class _TwoGasEnergy(Module):
    """The energy of two gases left and right of a piston at q, in the volumes ``A q`` and ``A (L - q)``."""

    gas: IdealMixture
    area: jax.Array = eqx.field(metadata=positive_condition("area").metadata)
    length: jax.Array = eqx.field(metadata=positive_condition("length").metadata)

    def __call__(self, q, S, N):
        left_volume, right_volume = self.area * q[0], self.area * (self.length - q[0])
        return self.gas.internal_energy(S[0], N[:1], left_volume) + self.gas.internal_energy(S[2], N[1:], right_volume)


def porous_piston(
    permeability: float = 0.05,
    conductance: Sequence[float] = (0.5, 0.5),
    friction: float = 0.5,
    mass: float = 1.0,
    area: float = 1.0,
    length: float = 2.0,
    capacity: float = 1.0,
    heat_capacity: float = 1.5,
) -> ComposedSystem:
    """Two gases separated by a porous piston, with flow of particles, heat conduction and friction.

    ``H = p^2 / (2 m) + C exp(S_p / C) + U(S_l, N_l, A q) + U(S_r, N_r, A (L - q))``, Boltzmann's constant 1, in the
    state (S_l, N_l, q, p, S_p, S_r, N_r). It rests where temperatures, pressures and chemical potentials agree, so at
    equal densities; where the piston is then depends on how it came there. ``N_l + N_r`` is constant.

    Parameters
    ----------
    permeability : float, >= 0
        L of the :class:`liethermo.Membrane`.
    conductance : two floats, >= 0
        Heat conductance between the left gas and the piston, and between the piston and the right gas.
    friction : float, >= 0
        Friction coefficient of the piston (mass / time).
    mass, area, length : float, > 0
        Mass and area of the piston, length of the cylinder (kg, m**2, m).
    capacity : float, > 0
        C, the heat capacity of the piston.
    heat_capacity : float, > 0
        Heat capacity of a particle at constant volume.
    """
    gas = _single_species_gas(heat_capacity)
    checked_numbers(conductance, "conductance", (2,))
    bodies = {
        "left": Subsystem(None, 2, species=1),
        "piston": Subsystem(
            Kinetic(1.0 / checked_positive(mass, "mass")[None])
            + Function(ThermalEnergy(checked_positive(capacity, "capacity"))).on([2]),
            3,
            friction=friction,
        ),
        "right": Subsystem(None, 2, species=1),
    }
    return ComposedSystem(
        bodies,
        _TwoGasEnergy(gas, checked_positive(area, "area"), checked_positive(length, "length")),
        [(0, 1, conductance[0]), (1, 2, conductance[1])],
        membranes=[Membrane("left", "right", permeability)],
        validate=False,
    )


def porous_piston_state(
    left: tuple[float, float], right: tuple[float, float], q: float = 1.0, T: float = 1.0, **parameters
) -> np.ndarray:
    """Return the state, shape (7,), of a porous piston at rest at q, with the piston at temperature T.

    Parameters
    ----------
    left, right : (particles, temperature)
    q : float
        Between 0 and the length.
    T : float, > 0
    **parameters
        Parameters of :func:`porous_piston` that differ from its defaults.
    """
    defaults = {name: parameter.default for name, parameter in inspect.signature(porous_piston).parameters.items()}
    if unknown := [name for name in parameters if name not in defaults]:
        raise InputError(f"porous_piston has no parameter {unknown[0]!r}. Its parameters are {', '.join(defaults)}")
    area, length, capacity = (
        checked_positive((defaults | parameters)[name], name) for name in ("area", "length", "capacity")
    )
    position = checked_numbers(q, "q", ())
    require_condition(
        position, lambda q: (q > 0.0) & (q < length), f"q must be between 0 and {length:g}, got {{value:g}}"
    )
    gas, state = _single_species_gas((defaults | parameters)["heat_capacity"]), []
    for name, particles_and_temperature, width in (("left", left, position), ("right", right, length - position)):
        n, t = checked_positive(particles_and_temperature, f"{name}, (particles, temperature),", 2)
        state += [gas.entropy_at(t, n[None], area * width), n]
    return np.array([*state[:2], position, 0.0, capacity * jnp.log(checked_positive(T, "T")), *state[2:]])


class _VesselEnergy(Module):
    """The energy of a mixture in a fixed volume as a function of (S, N)."""

    gas: IdealMixture
    volume: jax.Array = eqx.field(metadata=positive_condition("volume").metadata)

    def __call__(self, x):
        return self.gas.internal_energy(x[0], x[1:], self.volume)


def reaction_vessel(
    stoichiometry: Sequence[float] = (-1.0, -1.0, 1.0),
    capacity: Sequence[float] = (1.5, 1.5, 2.5),
    energy: Sequence[float] = (0.0, 0.0, -2.0),
    entropy: Sequence[float] = (0.0, 0.0, 0.5),
    volume: float = 1.0,
    rate: float = 0.5,
    jacket: float = 20.0,
    conductance: float = 0.3,
) -> ComposedSystem:
    """A reaction among ideal gases, A + B <-> C by default, in a vessel with a jacket that gives and takes heat.

    The state is (S, N_1, …, N_K, S_j). It rests at one temperature, where the densities obey the law of mass action,
    ``prod (N_k / V)^nu_k = K(T)``: see ``IdealMixture.equilibrium_constant``.

    Parameters
    ----------
    stoichiometry : sequence of K floats
        nu, negative for reactants.
    capacity, energy, entropy : sequences of K floats
        c_k > 0, e_k and s_k of :class:`IdealMixture`, Boltzmann's constant 1.
    volume : float, > 0
        Volume of the vessel.
    rate : float, >= 0
        L of the :class:`liethermo.Reaction`.
    jacket : float, > 0
        Heat capacity of the jacket.
    conductance : float, >= 0
        Heat conductance between mixture and jacket (power / temperature).
    """
    reaction = Reaction("vessel", stoichiometry, rate)
    count = len(reaction.stoichiometry)
    gas = IdealMixture(
        checked_positive(capacity, "capacity", count),
        *(checked_finite(value, name, count) for value, name in ((energy, "energy"), (entropy, "entropy"))),
    )
    bodies = {
        "vessel": Subsystem(_VesselEnergy(gas, checked_positive(volume, "volume")), 1 + count, species=count),
        "jacket": Subsystem(ThermalEnergy(checked_positive(jacket, "jacket")), 1),
    }
    return ComposedSystem(
        bodies,
        conductance=conductance,
        reactions=[reaction],
        validate=False,
    )
