"""Spins on sites, alone or with the baths that they heat."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import manifolds as mf
from manifolds._pytree_module import replace_fields
from manifolds.structures.poisson import ProductPoisson
from manifolds.structures.spins import add_vectors, cross, cross_vectors, dot_vectors, scale_vectors, split_vectors

from ..dissipation.base import Dissipation
from ..dissipation.geometry import HeatingSites
from ..dissipation.heating import BathConduction, Heating
from ..dissipation.landau_lifshitz import LandauLifshitz
from ..errors import InputError
from ..functions.checks import traced_function_and_shape
from ..functions.conditions import checked_numbers, nonnegative_condition, positive_condition
from ..functions.energy import Energy
from ..functions.flat_states import functions_of_flat_states
from ..functions.magnetism.spin_energy import checked_finite_numbers, checked_site_values, lattice_shape
from ..functions.magnetism.spin_torques import checked_spin_torque
from ..functions.on_spaces import (
    HalfSquareOfSpin,
    HalfSumOfSquares,
    SphereLengths,
    energy_in_component_order,
    interaction_range,
    spins_to_component_order,
    spins_to_site_order,
)
from .base import System
from .baths import HeatBaths, checked_baths, poisson_with_baths
from .interface import TorqueLaws
from .torque import TorqueSystem, torque_name

SPIN_LENGTHS_NAME = "sum |s|^2 / 2"
"""Name of the Casimir of spins."""

MIN_DAMPING_FACTOR = 0.5
"""Smallest factor of a spin in the equations that are solved spin by spin.

It is below 1 only where a spin is turned away from its field, and would vanish in very long steps."""


class SpinSystem(TorqueSystem):
    """Classical spins that precess and are damped, with or without baths that take their heat.

    They obey the Landau-Lifshitz equation: ``s_i' = gamma_i s_i x grad_i H`` at every site i, plus damping.

    A state is ``(s_1, s_2, …, y_1, …, y_m)`` in one row: the spins site by site in C order, then the entropy of each
    bath. Baths have the energy ``U(y)``, the temperatures ``T_b = dU/dy_b`` and the entropy ``sum y_b``. Every
    |s_i| is constant, to rounding, with every method. Memory and time of a step grow with the number of sites.

    Parameters
    ----------
    sites : int or tuple of int
        Number of spins, or the shape of their lattice.
    energy : Energy, function from s, shape ``(*sites, 3)``, to a scalar, or list of them
        Such as a sum of the terms in ``lt.magnetism``. May depend on time.
    dissipation : LandauLifshitz, or a list of dissipations that act together; optional
        The damping; without it the spins precess only.
    baths : HeatBaths, optional
        The baths that take the heat of the damping.
    ratio : float, or array of the shape of the sites
        gamma_i (1 / (energy * time), if s has no unit).
    momentum_maps, validate
        As for :class:`LiePoissonSystem`; functions of s, shape ``(*sites, 3)``.
    torque : function w of t, shape (), and s, shape ``(*sites, 3)``; or a list of them; optional
        Torques ``s x w`` (w in 1 / time) from outside, such as ``lt.magnetism.Slonczewski``. Each |s_i| stays constant.
        The torque does the work W, ``W' = sum grad_i H . (s_i x w_i)``, and the energy less the work is constant.
    power : function of the time to a number >= 0, for the first bath; or a sequence with one or None per bath; optional
        Power P that a device such as ``lt.magnetism.LaserPulse`` gives to a bath: ``y' = P / T`` for its entropy y and
        temperature T, and ``W' = P``. Light has no entropy, so P is work, all of which becomes heat.

    Raises
    ------
    InputError, FunctionError, AxiomError
        If an argument or a function does not fit, or an axiom fails.

    Examples
    --------
    A spin in a field along the third axis, damped towards it:

    >>> system = lt.SpinSystem(
    ...     1, lt.magnetism.zeeman(1, [0.0, 0.0, 1.0]), lt.LandauLifshitz(0.5)
    ... )
    >>> spin = lt.integrate(system, [[1.0, 0.0, 0.0]], (0.0, 20.0), 0.1)
    >>> bool(spin.x[-1, 2] > 0.999), spin.audit().passed
    (True, True)
    """

    lattice: tuple[int, ...] = eqx.field(static=True)
    power: tuple[Callable, ...]
    powered_baths: tuple[int, ...] = eqx.field(static=True)

    def __init__(
        self,
        sites,
        energy,
        dissipation: Dissipation | Sequence[Dissipation] | None = None,
        baths: HeatBaths | None = None,
        ratio=1.0,
        momentum_maps=(),
        validate: bool = True,
        torque=None,
        power=None,
    ):
        self.lattice = lattice_shape(sites)
        self.torque = None if torque is None else checked_spin_torque(torque, self.lattice)
        self.torque_arguments = None
        self.powered_baths, self.power = _checked_powers(power, checked_baths(baths))
        ratios = checked_site_values(ratio, self.lattice, (), "ratio")
        poisson = mf.Spins(self.lattice, ratio=ratios)
        self._build(poisson, poisson.dim, energy, None, dissipation, momentum_maps, validate, baths=baths)

    def energy_of_flat_states(self, energy: Energy) -> Energy:
        return functions_of_flat_states(energy, (*self.lattice, 3))

    @property
    def heating_sites(self) -> HeatingSites:
        assert self._spin_structure is not None
        return _HeatingSpins(self.lattice, self._spin_structure)

    def _field_without_torque(self, x, dH, dS, dL):
        # precession and damping of the spins are added before they are stored in a state
        parts, spins, n = _split_damping(self.total_dissipation), self._spin_structure, self.body_dim
        if parts is None or spins is None:
            return super()._field_without_torque(x, dH, dS, dL)
        force, lost_power = parts.damping.damping_force_and_energy_loss(
            spins, x, dH, parts.temperature_signs(dH[n:]), parts.has_site_baths
        )
        entropy_rates = parts.bath_entropy_rates(lost_power, dH, dS, n)
        return spins.join_state(add_vectors(spins.precession_rates(x, dH), force), entropy_rates)

    # -- the torque -----------------------------------------------------------------------------------------------

    @property
    def torque_laws(self) -> TorqueLaws:
        """Name and effects of torques and powers; every Casimir is kept, because a torque ``s x w`` keeps lengths."""
        name = torque_name((*(self.torque or ()), *self.power))
        return TorqueLaws(name, bool(name), entropy_law="nondecreasing" if self.power else "conserved")

    def _torque_at(self, x, t, attitude):
        s = x[: self.body_dim].reshape(*self.lattice, 3)
        total = sum((term(t, s) for term in self.torque or ()), jnp.zeros(3))
        return cross(s, jnp.broadcast_to(total, s.shape)).reshape(-1)

    def external_velocity(self, x, dH):
        velocity, n = super().external_velocity(x, dH), self.body_dim
        if not self.power or velocity is None:
            return velocity
        assert self.torque_arguments is not None
        for bath, power in zip(self.powered_baths, self.power, strict=True):
            P = jnp.asarray(power(self.torque_arguments[0]))
            velocity = velocity.at[n + bath].add(jnp.where(P >= 0.0, P, jnp.nan) / dH[n + bath])
        return velocity

    def drop_torque(self):
        return _drop_power(super().drop_torque())

    def drop_baths(self):
        return _drop_power(super().drop_baths())

    def solve_slopes_at_each_spin(self, x, dH, dS, noise_rates, other_noise_velocity, half_step, k) -> jax.Array | None:
        """Return the slopes of a step, shape (n,), from earlier slopes k, by solving at each spin in its field.

        Noise, precession and damping turn s at the angular velocity ``w - gamma dH - lambda s x dH``, w in
        ``noise_rates``, and damping has the factor ``lambda s . dH`` besides. The velocity ``other_noise_velocity`` is
        added. So ``c u - a x u = r`` with the angle a in the time ``half_step``. The solution is ``u = (c r + a x r +
        (a . r) a / c) / (c^2 + |a|^2)``, as ``c a . u = a . r``.
        """
        spins, parts, n = self._spin_structure, _split_damping(self.total_dissipation), self.body_dim
        if spins is None or parts is None:
            return None
        s, gradient = spins.split_covectors(x), spins.split_covectors(dH)
        rate = -parts.damping.rate.reshape(-1) * parts.temperature_signs(dH[n:])
        rates = add_vectors(split_vectors(noise_rates), scale_vectors(-spins.ratio.reshape(-1), gradient))
        rates = add_vectors(rates, scale_vectors(rate, cross_vectors(s, gradient)))
        v = cross_vectors(rates, s)
        lost_power = -dot_vectors(gradient, v)
        lost_power = lost_power if parts.has_site_baths else jnp.sum(lost_power)
        entropy_rates = other_noise_velocity[n:] + parts.bath_entropy_rates(lost_power, dH, dS, n)
        v = add_vectors(v, spins.split_covectors(other_noise_velocity))
        if (external_velocity := self.external_velocity(x, dH)) is not None:
            v = add_vectors(v, spins.split_covectors(external_velocity))
            entropy_rates = entropy_rates + external_velocity[n:]
        slopes = spins.split_covectors(k)
        r, a = add_vectors(v, scale_vectors(-1.0, slopes)), scale_vectors(half_step, rates)
        c = jnp.maximum(1.0 + half_step * rate * dot_vectors(s, gradient), MIN_DAMPING_FACTOR)
        u = add_vectors(add_vectors(scale_vectors(c, r), cross_vectors(a, r)), scale_vectors(dot_vectors(a, r) / c, a))
        u = scale_vectors(1.0 / (c * c + dot_vectors(a, a)), u)
        return spins.join_state(add_vectors(slopes, u), entropy_rates)

    def largest_step(
        self, x, angle: float = 0.3, boltzmann: float = 0.0, t: float = 0.0, temperature: float | None = None
    ) -> float:
        """Return the largest step (time) in which no spin turns by more than an ``angle``, in its field or by noise.

        A spin turns at the rate ``sqrt(ratio^2 + (rate |s|)^2) |grad_i H|`` at most, and torques ``s x w`` add
        ``|s x w| / |s|``. Noise turns it by angles of the variance ``2 k T rate h`` in each component, which is kept
        below the square of the angle.

        Parameters
        ----------
        x : array, shape (n,) or ``(*sites, 3)``
        angle : float > 0
            In radian. Steps with noise have a bias of about a per cent with 0.3 [:doc:`/explanation/fluctuations`].
        boltzmann, temperature : float >= 0, and float > 0
            k and T, as of ``lt.Fluctuations``, for steps with noise; T only for a system without baths.
        t : float
            The time. InputError if no spin turns, an argument is out of its range, or the temperature is missing.
        """
        positive_condition("the angle").require(checked_numbers(angle, "the angle", ()))
        nonnegative_condition("boltzmann").require(checked_numbers(boltzmann, "boltzmann", ()))
        checked_finite_numbers(t, "the time", ())
        state, spins, n = self.state(x), self._spin_structure, self.body_dim
        assert spins is not None
        system = self.at_time(t)
        gradient, s = system.energy.gradient(state), np.asarray(state[:n]).reshape(-1, 3)
        field = np.linalg.norm(np.asarray(gradient[:n]).reshape(-1, 3), axis=1)
        parts = _split_damping(self.total_dissipation)
        rate = np.zeros(()) if parts is None else np.abs(np.asarray(parts.damping.rate)).ravel()
        damping_rate = rate * np.linalg.norm(s, axis=1)
        turning_rates = np.hypot(np.ravel(spins.ratio), damping_rate) * field
        if self.torque:
            shape = (*self.lattice, 3)
            w = sum(
                np.broadcast_to(np.asarray(term(jnp.asarray(t, float), s.reshape(shape))), shape)
                for term in self.torque
            )
            lengths = np.linalg.norm(s, axis=1)
            torques = np.linalg.norm(np.cross(s, np.reshape(w, (-1, 3))), axis=1)
            turning_rates = turning_rates + torques / np.where(lengths > 0.0, lengths, 1.0)
        turning_rate = float(turning_rates.max())
        diffusion = 0.0
        if boltzmann and parts is not None:
            T = self._noise_temperatures(parts, gradient, temperature)
            diffusion = float((2.0 * boltzmann * np.abs(T) * rate).max())
        if not (turning_rate > 0.0 or diffusion > 0.0):
            raise InputError("no spin turns at this state, so any step will do. Give a state away from rest")
        return min(angle / turning_rate if turning_rate else np.inf, angle**2 / diffusion if diffusion else np.inf)

    def _noise_temperatures(self, parts: _DampingParts, gradient, temperature) -> np.ndarray:
        """Return the temperatures of the noise, of all spins or of each; InputError if they are missing or doubled."""
        if parts.heating is None:
            if temperature is None:
                raise InputError(
                    "the system has no baths, so the temperature of the noise is not known. Give temperature=, as to "
                    "lt.Fluctuations"
                )
            positive_condition("the temperature").require(checked_numbers(temperature, "the temperature", ()))
            return np.asarray(temperature, dtype=float)
        if temperature is not None:
            raise InputError("temperature= is for systems without baths; here the baths have the temperatures")
        return np.asarray(parts.heating.bath_values_at_sites(gradient[self.body_dim :]))

    def state_array(self, x, batch: bool = False):
        """Return x as a checked flat state; x may be the spins alone, shape ``(*sites, 3)``."""
        shape, x_shape = (*self.lattice, 3), np.shape(x)
        if x_shape != (self.dim,) and x_shape[-len(shape) :] == shape and (batch or len(x_shape) == len(shape)):
            x = (x if isinstance(x, jax.Array) else np.asarray(x)).reshape(*x_shape[: -len(shape)], -1)
        elif x_shape[-1:] not in ((self.dim,), (self.body_dim,)):
            raise InputError(
                f"a state must have shape {shape}, or ({self.dim},) with all components in one row, got {x_shape}"
            )
        return super().state_array(x, batch)

    def spins(self, x) -> jax.Array:
        """Return the spins, shape ``(..., *sites, 3)``, of states, shape (..., n)."""
        x = checked_numbers(x, "states")
        if x.shape[-1:] not in ((self.dim,), (self.body_dim,)):
            raise InputError(f"states must have shape (..., {self.dim}), got {x.shape}")
        return x[..., : self.body_dim].reshape(*x.shape[:-1], *self.lattice, 3)

    def casimirs(self) -> dict[str, Energy]:
        return {SPIN_LENGTHS_NAME: HalfSumOfSquares(math.prod(self.lattice))}

    def casimir_terms(self) -> dict[str, dict[str, Energy]]:
        count = math.prod(self.lattice)
        return {SPIN_LENGTHS_NAME: {f"|s|^2 / 2 at {i + 1}": HalfSquareOfSpin(i) for i in range(count)}}

    @property
    def constraint_surface(self) -> SphereLengths:
        assert self._spin_structure is not None
        return SphereLengths(math.prod(self.lattice), SPIN_LENGTHS_NAME, self._spin_structure.is_component_major)

    @property
    def _spin_structure(self) -> mf.Spins | None:
        """Poisson structure of the spins; None if the system runs in other coordinates."""
        poisson = self.poisson.first if isinstance(self.poisson, ProductPoisson) else self.poisson
        return poisson if isinstance(poisson, mf.Spins) else None


class _HeatingSpins(HeatingSites):
    """Sites that hold one spin each and heat baths, with components in the order of a Poisson structure."""

    def __init__(self, shape: tuple[int, ...], spins: mf.Spins):
        super().__init__(shape)
        self._spins = spins

    def _scale_each_site(self, values, v) -> jax.Array:
        return self._spins.join_state(scale_vectors(values, self._spins.split_covectors(v)), jnp.zeros(0))

    def dot_at_sites(self, alpha, v) -> jax.Array:
        return dot_vectors(self._spins.split_covectors(alpha), self._spins.split_covectors(v))


class ReorderedSystem(NamedTuple):
    """A system whose states have their components in another order, with the maps of states and functions.

    Attributes
    ----------
    system : System
    reorder_state, restore_state : functions of states, shape (..., n)
        Reorder the components, and restore their order.
    pullback : function from an Energy to an Energy
        Turns a function of states into a function of reordered states.
    """

    system: System
    reorder_state: Callable
    restore_state: Callable
    pullback: Callable


def reorder_spins(system: System) -> ReorderedSystem | None:
    """Return a spin system with states stored component by component, which is fastest for large states.

    None for other systems, and for dissipations that may use the order.
    """
    if type(system) is not SpinSystem:
        return None
    spins = system._spin_structure
    dissipation = system.total_dissipation
    is_reorderable = not dissipation.terms or _split_damping(dissipation) is not None
    if not is_reorderable or spins is None or spins.is_component_major or system.is_driven:
        return None
    count = spins.count
    planar = mf.Spins(spins.sites, 0, spins.ratio, interaction_range(system.energy, spins.sites))
    poisson = poisson_with_baths(planar, system.baths.number)
    maps = (
        functools.partial(f, n_spins=count)
        for f in (spins_to_component_order, spins_to_site_order, energy_in_component_order)
    )
    reorder, restore, pullback = maps
    functions = [pullback(f) for f in (system.energy, *system.momentum_maps.values())]
    reordered_system = eqx.tree_at(
        lambda s: [s.poisson, s.energy, *s.momentum_maps.values()], system, [poisson, *functions]
    )
    return ReorderedSystem(reordered_system, reorder, restore, pullback)


def _checked_powers(power, baths: HeatBaths) -> tuple[tuple[int, ...], tuple[Callable, ...]]:
    """Return the indices of the baths that receive power, and their powers as traced functions of time."""
    if power is None:
        return (), ()
    if not baths.number:
        raise InputError("power= heats baths, but this system has none. Give baths=lt.HeatBaths(...)")
    entries = list(power) if isinstance(power, list | tuple) else [power, *[None] * (baths.number - 1)]
    if len(entries) != baths.number:
        raise InputError(f"power must have {baths.number} entries, one per bath, got {len(entries)}")
    for i, entry in enumerate(entries):
        if not callable(entry) and entry is not None:
            raise InputError(
                f"the power of bath {i} must be a function of the time, such as lt.magnetism.LaserPulse, or None, got "
                f"{entry!r:.60}"
            )
    functions = {
        i: traced_function_and_shape(entry, ((),), [()], f"the power of bath {i}", "a time")[0]
        for i, entry in enumerate(entries)
        if entry is not None
    }
    return tuple(functions), tuple(functions.values())


def _drop_power(system: Any) -> Any:
    """Return a spin system without the power that heats its baths."""
    return replace_fields(system, power=(), powered_baths=()) if system.power else system


class _DampingParts(NamedTuple):
    """The parts of a dissipation of spins: damping, heating of baths by it, and conduction between baths."""

    damping: LandauLifshitz
    heating: Heating | None
    conduction: tuple[BathConduction, ...]

    @property
    def has_site_baths(self) -> bool:
        """True if every site heats a bath of its own."""
        return self.heating is not None and self.heating.has_site_baths

    def temperature_signs(self, T) -> jax.Array | float:
        """Return the sign of the temperature of the bath that each site heats, from temperatures T, shape (m,)."""
        return 1.0 if self.heating is None else self.heating.temperature_signs(T)

    def bath_entropy_rates(self, energy_loss, dH, dS, body_dim: int) -> jax.Array:
        """Return the growth rates of the entropies of the baths, shape (m,), from the power that the spins lose.

        Parameters
        ----------
        energy_loss : array, shape () or (sites,)
            Power that the spins lose: of all, or of each site if these have baths of their own.
        dH, dS : array, shape (body_dim + m,)
            Gradients of the energy and of the entropy; dS may be None without conduction.
        body_dim : int
            Index of the entropy of the first bath in a state.
        """
        T = dH[body_dim:]
        rates = jnp.zeros_like(T) if self.heating is None else self.heating.entropy_rates(energy_loss, T)
        for term in self.conduction:
            rates = rates + term.entropy_rates(T, dS[body_dim:])
        return rates


def _split_damping(dissipation: Dissipation) -> _DampingParts | None:
    """Return the parts of a dissipation of spins; None if it has other summands or classes.

    It is None for subclasses, whose force may differ.
    """
    conduction = tuple(term for term in dissipation.terms if type(term) is BathConduction)
    other_terms = [term for term in dissipation.terms if type(term) is not BathConduction]
    if len(other_terms) != 1:
        return None
    heating = other_terms[0] if type(other_terms[0]) is Heating else None
    damping = other_terms[0] if heating is None else heating.inner
    return _DampingParts(damping, heating, conduction) if type(damping) is LandauLifshitz else None
