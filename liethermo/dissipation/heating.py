"""Dissipation that heats baths, which receive as entropy the energy that a body loses, and conduction between baths."""

from __future__ import annotations

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ..errors import InputError
from ..functions.bath_energy import temperature_derivatives_by_entropy
from ..functions.edges import graph_edges
from ..functions.energy import Energy
from ..functions.frames import sqrt_or_zero
from ..functions.indices import Indices
from .base import Dissipation, DissipationSum, LiftedDissipation, LiftedGeometry
from .bodies import HeatConduction
from .geometry import Geometry


class Heating(LiftedDissipation):
    """A dissipation ``-K0 dH`` of a body, with baths of entropies y and temperatures ``T = U'(y)`` that it heats.

    It is ``K dS`` on states (x, y) with ``K = B B^T`` and, for ``K0 = B0 B0^T`` and a single bath,

        B = sqrt(T) [B0; -dH^T B0 / T],

    so that ``x' = … - K0 dH`` and ``T y' = dH . K0 dH``. ``K (dH, T) = 0`` and ``K >= 0`` by form, for discrete
    gradients too: both laws are exact. What K0 conserves of the body is conserved, for example every Casimir by a
    double bracket. If each site has its own bath, K0 acts site by site, and so does K.

    For a negative temperature the sign of T is left out of K: the entropy grows there too.

    Attributes
    ----------
    bath : Indices, of shape () or that of the sites
        The number of the bath that takes the heat, from 0; for all sites, or for each.
    has_positive_temperatures : bool
        True if the temperatures are positive in every state. Then the motion of the body does not depend on them.
    """

    bath: Indices = eqx.field(static=True)
    has_positive_temperatures: bool = eqx.field(static=True)

    energy_law = "conserved"
    entropy_law = "nondecreasing"
    is_symmetric = True
    needs_entropy = False
    has_generator = False

    def force(self, system, x, dH, dS, dL):
        body, n = system.drop_baths(), system.body_dim
        force = self.inner.force(
            body, x[:n], self._effective_energy_gradient(body, dH, dS, n), None, tuple(L[:n] for L in dL)
        )
        return self._append_entropy_rates(body, force, dH, n)

    def added_attitude_velocity(self, system, x, dH, dS, dL):
        body, n = system.drop_baths(), system.body_dim
        return self.inner.added_attitude_velocity(
            body, x[:n], self._effective_energy_gradient(body, dH, dS, n), None, tuple(L[:n] for L in dL)
        )

    def factor(self, system, x, dH, dL):
        body, n = system.drop_baths(), system.body_dim
        B = self.inner.factor(body, x[:n], dH[:n], tuple(L[:n] for L in dL))
        if B is None:
            return None
        T = self.bath_values_at_sites(dH[n:])
        scale = sqrt_or_zero(self.temperature_signs(dH[n:]) * T)

        def times(w):
            return self._append_entropy_rates(body, body.heating_sites.scale_at_sites(scale, B.times(w)), dH, n)

        velocity_map, scale_at_sites = B.added_attitude_velocity, body.heating_sites.scale_at_sites
        scaled_map = None if velocity_map is None else lambda w: scale_at_sites(scale, velocity_map(w))
        spin_coefficients = None if B.spin_coefficients is None else scale * B.spin_coefficients
        return B._replace(
            times=times,
            added_attitude_velocity=scaled_map,
            spin_coefficients=spin_coefficients,
            solenoidal=False,
        )

    def factor_divergence(self, system, x):
        """Return the divergence of each column of B: ``sqrt(T) div B0 + T' B0^T dH / (2 T^3/2)``, T' = dT/dy."""
        body, n = system.drop_baths(), system.body_dim
        dH, dL = system.energy.gradient(x), tuple(L.gradient(x) for L in self.preserve)
        B = self.inner.factor(body, x[:n], dH[:n], tuple(L[:n] for L in dL))
        assert B is not None
        if self.has_site_baths and not B.solenoidal:  # each site has a temperature of its own
            return super().factor_divergence(system, x)
        T = jnp.abs(self.bath_values_at_sites(dH[n:]))
        body_divergence = jnp.zeros(B.size) if B.solenoidal else jnp.sqrt(T) * self.inner.factor_divergence(body, x[:n])
        slopes = temperature_derivatives_by_entropy(system.energy, x, n)
        if slopes is None:
            return body_divergence
        ratio = jnp.where(T > 0.0, 0.5 * self.bath_values_at_sites(slopes) / jnp.where(T > 0.0, T, 1.0) ** 1.5, 0.0)
        return body_divergence + B.transpose_times(body.heating_sites.scale_at_sites(ratio, dH[:n]))

    def lifted_geometry(self, system, x) -> LiftedGeometry:
        return _body_inner_geometry(system, x)

    @property
    def has_site_baths(self) -> bool:
        """True if each site has its own bath."""
        return bool(self.bath.shape)

    def temperature_signs(self, T) -> jax.Array:
        """Return 1 or -1 for the temperature of the bath, shape (), or of the bath of each site, shape (sites,).

        No temperature changes its sign in any state, so the sign is a constant; ``jnp.sign`` would have no Taylor
        series.
        """
        if self.has_positive_temperatures:
            return jnp.ones(np.shape(self.bath)).ravel() if self.has_site_baths else jnp.ones(())
        return jnp.where(self.bath_values_at_sites(T) < 0.0, -1.0, 1.0)

    def entropy_rates(self, energy_loss, T) -> jax.Array:
        """Return the growth rates of the bath entropies, shape (m,), from the energy lost, shape () or (sites,)."""
        if self.has_site_baths:
            return jax.ops.segment_sum(energy_loss, np.asarray(self.bath).ravel(), len(T)) / T
        return jnp.where(np.arange(len(T)) == int(np.asarray(self.bath)), energy_loss / T, 0.0)

    def _effective_energy_gradient(self, body: Geometry, dH, dS, body_dim: int) -> jax.Array:
        """Return the gradient that replaces dH in the force on the body, shape (n,); dH if S is the bath entropy."""
        T, dS_y, sign = (
            self.bath_values_at_sites(dH[body_dim:]),
            self.bath_values_at_sites(dS[body_dim:]),
            self.temperature_signs(dH[body_dim:]),
        )
        scale_at_sites = body.heating_sites.scale_at_sites
        return scale_at_sites(sign, scale_at_sites(dS_y, dH[:body_dim]) - scale_at_sites(T, dS[:body_dim]))

    def bath_values_at_sites(self, bath_values) -> jax.Array:
        """Return for each site, shape () or (sites,), the value of the bath that it heats, from those of all (m,)."""
        return (
            bath_values[np.asarray(self.bath).ravel()]
            if self.has_site_baths
            else bath_values[int(np.asarray(self.bath))]
        )

    def _append_entropy_rates(self, body: Geometry, v, dH, body_dim: int) -> jax.Array:
        """Return the velocity v of the body, shape (n,), followed by the entropy rates from the energy it loses."""
        energy_gain = (
            body.heating_sites.dot_at_sites(dH[:body_dim], v) if self.has_site_baths else jnp.dot(dH[:body_dim], v)
        )
        return jnp.concatenate([v, self.entropy_rates(-energy_gain, dH[body_dim:])])


class HeatlessDissipation(LiftedDissipation):
    """A dissipation of a body that produces no heat, in a system with baths."""

    def lifted_geometry(self, system, x) -> LiftedGeometry:
        return _body_inner_geometry(system, x)

    def added_attitude_velocity(self, system, x, dH, dS, dL):
        geometry = _body_inner_geometry(system, x)
        return self.inner.added_attitude_velocity(geometry.system, geometry.x, *geometry.inner_gradients(dH, dS, dL))


def _body_inner_geometry(system: Geometry, x) -> LiftedGeometry:
    """Return the geometry of the body alone, whose states are the leading components of those with baths."""
    return LiftedGeometry.from_leading_components(system.drop_baths(), x, system.body_dim)


def couple_to_baths(
    dissipation: Dissipation,
    body: Geometry,
    n_baths: int,
    has_positive_temperatures: bool,
    pull_back_function: Callable[[Energy], Energy],
) -> Dissipation:
    """Return the dissipation of a body with ``n_baths`` baths that take its heat.

    Raises
    ------
    InputError
        If no summand produces heat, or a summand names a bath that does not exist.
    """
    terms = dissipation.terms
    if not any(term.energy_law == "nonincreasing" for term in terms):
        reason = f"{type(terms[0]).__name__} does not lower the energy" if terms else "the system has no dissipation"
        raise InputError(
            f"{reason}, so there is no heat for baths=. Remove baths=, or use lt.DoubleBracket or lt.Friction"
        )
    coupled_terms = tuple(
        _couple_term_to_baths(term, body, n_baths, has_positive_temperatures, pull_back_function) for term in terms
    )
    return coupled_terms[0] if len(coupled_terms) == 1 else DissipationSum(coupled_terms)


def _couple_term_to_baths(
    term: Dissipation,
    body: Geometry,
    n_baths: int,
    has_positive_temperatures: bool,
    pull_back_function: Callable[[Energy], Energy],
) -> Dissipation:
    """Return one summand of a body's dissipation in the system with baths; it heats a bath if it lowers the energy."""
    functions = tuple(map(pull_back_function, term.preserve))
    if term.energy_law != "nonincreasing":
        return HeatlessDissipation(term, functions)
    bath = Indices(0) if term.heated_bath_index is None else term.heated_bath_index
    numbers = np.asarray(bath)
    lattice = body.heating_sites.shape
    if numbers.shape not in ((), lattice):
        shape_text = f", or an array of the shape {lattice} of the sites" if lattice else ""
        raise InputError(f"bath must be the number of a bath{shape_text}, got shape {numbers.shape}")
    if not (numbers.min() >= 0 and numbers.max() < n_baths):
        bad_number = int(numbers[(numbers < 0) | (numbers >= n_baths)][0]) if numbers.shape else int(numbers)
        raise InputError(f"a dissipation heats bath {bad_number}, but there are {n_baths} baths, numbered from 0")
    return Heating(term, functions, bath, has_positive_temperatures)


class BathConduction(HeatConduction):
    """Heat conduction between baths, ``T_i y_i' = sum_j G_ij (T_j - T_i)`` for their entropies y and temperatures T.

    It is a summand beside the dissipation that heats the baths, and acts on the baths alone. The energy of all baths is
    constant, and their entropy grows by ``sum G_ij (T_i - T_j)^2 / (T_i T_j)`` over the pairs. The two-temperature
    model of electrons and phonons [Anisimov, Kapeliovich & Perelman 1974] is two baths and one conductance.

    Parameters
    ----------
    conductance : float, for two baths; sequence of (i, j, G), each pair once; or array, shape (number, number)
        G (power / temperature) between the baths i and j, numbered from 0.

    Raises
    ------
    InputError

    Examples
    --------
    >>> baths = lt.HeatBaths(capacity=[1.0, 20.0], temperature=[2.0, 0.5], number=2)
    >>> spin = lt.SpinSystem(
    ...     1,
    ...     lt.magnetism.zeeman(1, (0, 0, 1.0)),
    ...     [lt.LandauLifshitz(0.1), lt.BathConduction(0.3)],
    ...     baths,
    ... )
    >>> run = lt.integrate(spin, spin.state([[1.0, 0.0, 0.0]]), (0.0, 30.0), 0.1)
    >>> run.audit().passed, spin.temperatures(run.x[-1]).round(2).tolist()
    (True, [0.63, 0.62])
    """

    acts_on_baths_alone = True
    can_act_on_baths = True

    def __init__(self, conductance):
        n_baths = _count_baths(conductance)
        names = [f"bath {i}" for i in range(n_baths)]
        super().__init__(graph_edges(conductance, n_baths, "the conductance", names))

    def bind_to(self, system):
        n_baths = system.baths.number
        last_bath = int(np.max(np.asarray(self.second_bodies), initial=0))
        if last_bath >= n_baths:
            raise InputError(
                f"BathConduction joins bath {last_bath}, but there are {n_baths} baths, numbered from 0. Give the "
                f"system baths=lt.HeatBaths(..., number={last_bath + 1})"
            )
        return self

    def entropy_indices(self, system):
        return np.arange(system.body_dim, system.dim)

    def entropy_rates(self, T, dS) -> jax.Array:
        """Return the growth rates of the entropies of all baths, shape (number,), by conduction.

        Parameters
        ----------
        T, dS : array, shape (number,)
            Temperatures of the baths, and the gradient of the entropy by theirs.
        """
        first_rates, second_rates = self.edge_entropy_rates(T, T, dS, T)
        i, j = np.asarray(self.first_bodies), np.asarray(self.second_bodies)
        return jnp.zeros_like(T).at[i].add(first_rates).at[j].add(second_rates)

    def factor_divergence(self, system, x):
        """Return the divergence of each column of the factor B, shape (edges,).

        It is ``sqrt(G T_i / T_j) T_j' / (2 T_j) - sqrt(G T_j / T_i) T_i' / (2 T_i)``.

        T' is the derivative of a temperature by its entropy, at constant conductances.
        """
        slopes = temperature_derivatives_by_entropy(system.energy, x, system.body_dim)
        if slopes is None:
            return jnp.zeros(len(self.conductance))
        i, j = np.asarray(self.first_bodies), np.asarray(self.second_bodies)
        T = system.energy.gradient(x)[system.body_dim :]
        root, ratio = jnp.sqrt(self.conductance), jnp.sqrt(T[i] / T[j])
        return 0.5 * root * (ratio * slopes[j] / T[j] - slopes[i] / (ratio * T[i]))


def _count_baths(conductance) -> int:
    """Return the number of baths that conductances join: edges, a matrix, or a number for two baths."""
    if isinstance(conductance, list | tuple) and all(isinstance(edge, tuple) for edge in conductance):
        ends = [end for edge in conductance for end in edge[:2] if isinstance(end, int | np.integer)]
        return max(ends, default=0) + 1
    return 2 if np.ndim(conductance) == 0 else len(conductance)
