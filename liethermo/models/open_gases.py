"""Ideal gases that exchange particles: a porous piston, and a reaction in a heated vessel."""

from __future__ import annotations

import inspect
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from manifolds._pytree_module import Module

from ..errors import InputError
from ..functions.conditions import checked_numbers, require_condition
from ..functions.energy import Function
from ..functions.mechanics import Kinetic
from ..systems import ComposedSystem, Membrane, Reaction, Subsystem
from .parameters import checked_finite, checked_positive
from .thermo_particles import ThermalEnergy


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

    capacity: jax.Array
    energy: jax.Array
    entropy: jax.Array

    def temperature(self, S, N, V):
        mixing = jnp.sum(N * (self.entropy - jnp.log(N / V)))
        return jnp.exp((S - mixing) / jnp.sum(N * self.capacity))

    def internal_energy(self, S, N, V):
        return jnp.sum(N * (self.capacity * self.temperature(S, N, V) + self.energy))

    def entropy_at(self, T, N, V):
        """Return the entropy S at a temperature."""
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
    area: jax.Array
    length: jax.Array

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
    """Return the state of a porous piston at rest at q, with the piston at temperature T.

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
    volume: jax.Array

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
    rate : float, >= 0
        L of the :class:`liethermo.Reaction`.
    jacket : float, > 0
        Heat capacity of the jacket.
    conductance : float, >= 0
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
