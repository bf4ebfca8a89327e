"""Dissipation in composed systems: heat conduction, and friction that heats [SML §5].

All classes act on states (q_1, p_1, S_1, q_2, …) of several bodies, see :class:`manifolds.ExtendedPhaseSpace`.
Temperatures and velocities are components of the energy gradient that they are passed. With a discrete gradient these
are discrete temperatures, and both laws hold exactly, for every energy, as long as the discrete temperatures are
positive.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy

from manifolds._pytree_module import Module
from manifolds.algebras._subspaces import row_echelon
from manifolds.matrices.symmetric import semidefinite_factor, semidefinite_root
from manifolds.structures.poisson import StateIndices

from ..functions.conditions import nonnegative_condition, semidefinite_condition
from ..functions.edges import Edges
from ..functions.indices import Indices, clique_pattern, pattern_of_matrix
from .base import Dissipation, LawName, SkewFriction
from .factor import Factor


class HeatConduction(Dissipation):
    """Fourier's law on a graph: ``S_i' = sum_j k_ij (T_j - T_i) / T_i``, ``T = H_S`` [SML 32].

    With the Fourier factors ``K_ij = k_ij (1/T_i - 1/T_j)``, which are skew, ``S_i' = sum_j K_ij T_j``. So the energy
    is constant, and the total entropy grows by ``sum k_ij (T_i - T_j)^2 / (T_i T_j)`` over the edges. In metriplectic
    form K is the sum of ``k_ij T_i T_j w w^T`` with ``w = e_i / T_i - e_j / T_j``.

    The temperatures are components of the gradient passed, so a discretisation uses discrete ones, which obey both laws
    for every energy. With ``factors="midpoint"`` only the Fourier factors are evaluated at the point x instead, as
    printed in SML §6.2. The energy is constant then too, but the entropy is known to grow only for quadratic energies
    [SML Lemma 6.2].

    Parameters
    ----------
    graph : Edges
        Edges between bodies, with their conductances (power / temperature).
    laws : tuple of functions of (T_i, T_j, x), optional
        The conductance of each edge, >= 0, in place of the weights.
    fourier_factors : {"discrete", "midpoint"}
    """

    first_bodies: Indices = eqx.field(static=True)
    second_bodies: Indices = eqx.field(static=True)
    conductance: jax.Array = eqx.field(metadata=nonnegative_condition("a conductance").metadata)
    laws: tuple[Callable, ...]
    fourier_factors: str = eqx.field(static=True)

    def __init__(self, graph: Edges, laws: tuple[Callable, ...] = (), factors: str = "discrete"):
        self.first_bodies, self.second_bodies = Indices(graph.first), Indices(graph.second)
        self.conductance, self.laws, self.fourier_factors = graph.weight, laws, factors

    @property
    def entropy_law(self) -> LawName | None:
        return "nondecreasing" if self.fourier_factors == "discrete" else None

    def entropy_indices(self, system) -> np.ndarray:
        """Return the index of each entropy in the state."""
        return _state_indices(system).S

    def conductances(self, x, T_i, T_j) -> jax.Array:
        """Return the conductances of the edges at these temperatures, shape (edges,); NaN where one is negative."""
        if not self.laws:
            return self.conductance
        values = jnp.stack([jnp.asarray(law(T_i[e], T_j[e], x)) for e, law in enumerate(self.laws)])
        return jnp.where(values >= 0.0, values, jnp.nan)

    def force(self, system, x, dH, dS, dL):
        S, i, j = self.entropy_indices(system), np.asarray(self.first_bodies), np.asarray(self.second_bodies)
        T_factors = dH[S] if self.fourier_factors == "discrete" else system.energy.gradient(x)[S]
        first_rates, second_rates = self.edge_entropy_rates(x, dH[S], dS[S], T_factors)
        return jnp.zeros_like(x).at[S[i]].add(first_rates).at[S[j]].add(second_rates)

    def edge_entropy_rates(self, x, T, dS, T_factors) -> tuple[jax.Array, jax.Array]:
        """Return the entropy rates of the first and the second body of each edge, shape (edges,).

        Parameters
        ----------
        x : array, shape (n,)
        T, dS, T_factors : array, shape (bodies,)
            Components of the gradients of energy and entropy, and the temperatures in the Fourier factors.
        """
        i, j = np.asarray(self.first_bodies), np.asarray(self.second_bodies)
        T, T_factors = _nan_unless_positive(T), _nan_unless_positive(T_factors)
        heat = self.conductances(x, T_factors[i], T_factors[j]) * (dS[i] * T_factors[j] - dS[j] * T_factors[i])
        ratio = heat / (T_factors[i] * T_factors[j])
        return ratio * T[j], -ratio * T[i]

    def factor(self, system, x, dH, dL):
        S, i, j = self.entropy_indices(system), np.asarray(self.first_bodies), np.asarray(self.second_bodies)
        T = _nan_unless_positive(dH[S])
        root = jnp.sqrt(self.conductances(x, T[i], T[j]) * T[i] * T[j])

        def times(w):
            return jnp.zeros_like(x).at[S[i]].add(root * w / T[i]).at[S[j]].add(-root * w / T[j])

        return Factor(len(i), times)

    def force_pattern(self, system):
        if self.laws:
            return None  # the laws may depend on all components
        S = self.entropy_indices(system)
        return clique_pattern(
            np.stack([S[np.asarray(self.first_bodies)], S[np.asarray(self.second_bodies)]], axis=1), system.dim
        )


class LinearFriction(Dissipation):
    """Friction against the surroundings that heats the body itself: ``p' = -R v``, ``S' = v . R v / T``, v = H_p.

    In metriplectic form K is ``z R z^T / T`` with ``z = -T d/dp + v d/dS``.

    Parameters
    ----------
    R : array, shape (m,) for a diagonal matrix, or (m, m); or function from the state of the body to one
        Positive semidefinite (mass / time).
    body_index : int, optional
        The body with these m momenta; by default R is diagonal with an entry for every momentum of the whole system.
    """

    R: jax.Array | Callable = eqx.field(metadata=semidefinite_condition("friction", symmetric=False).metadata)
    body_index: int | None = eqx.field(static=True, default=None)

    def force(self, system, x, dH, dS, dL):
        p, S, R, v, T = self._indices_friction_velocities_temperatures(system, x, dH)
        return self._force_from_flux(x, p, S, v, T, _apply_friction_matrix(R, (v * dS[S] - T * dS[p]) / T))

    def factor(self, system, x, dH, dL):
        p, S, R, v, T = self._indices_friction_velocities_temperatures(system, x, dH)
        matrix_root = semidefinite_root if callable(self.R) else semidefinite_factor
        root = jnp.sqrt(R) if jnp.ndim(R) < 2 else matrix_root(R)
        return Factor(
            len(p), lambda w: self._force_from_flux(x, p, S, v, T, _apply_friction_matrix(root, w) / jnp.sqrt(T))
        )

    @staticmethod
    def _force_from_flux(x, p, S, v, T, flux) -> jax.Array:
        """Return the force, shape (n,), of friction with fluxes: ``-T flux`` on momenta and ``v flux`` on entropies."""
        return jnp.zeros_like(x).at[p].add(-T * flux).at[S].add(v * flux)

    def _indices_friction_velocities_temperatures(self, system, x, dH):
        """Return the indices of momenta and entropies, R, the velocities and the temperatures: (p, S, R, v, T)."""
        indices = _state_indices(system)
        numbers = (
            np.arange(len(indices.p)) if self.body_index is None else np.flatnonzero(indices.owner == self.body_index)
        )
        R = self.R(x[_body_component_indices(indices, numbers)]) if callable(self.R) else self.R
        p, S = indices.p[numbers], indices.S[indices.owner[numbers]]
        return p, S, R, dH[p], _nan_unless_positive(dH[S])

    def force_pattern(self, system):
        return _same_body_pattern(_state_indices(system), system.dim)


class Drag(Dissipation):
    """Friction between bodies: the force ``-c_ij (v_i - v_j)`` on i, with half of the heat for each body.

    ``S_i' = sum_j c_ij |v_i - v_j|^2 / (2 T_i)``; the total momentum is conserved. In metriplectic form K is ``c_ij z
    z^T / theta`` with ``z = -d/dp_i + d/dp_j + (v_i - v_j) (d/dS_i / T_i + d/dS_j / T_j) / 2`` and ``theta = (1/T_i +
    1/T_j) / 2``, summed over edges and components.

    Parameters
    ----------
    graph : Edges
        Edges between bodies with equal numbers of degrees of freedom, with coefficients c (mass / time).
    """

    first_bodies: Indices = eqx.field(static=True)
    second_bodies: Indices = eqx.field(static=True)
    coefficient: jax.Array = eqx.field(metadata=nonnegative_condition("a drag").metadata)

    def __init__(self, graph: Edges):
        self.first_bodies, self.second_bodies = Indices(graph.first), Indices(graph.second)
        self.coefficient = graph.weight

    def force(self, system, x, dH, dS, dL):
        (p_i, p_j, S_i, S_j), (T_i, T_j, w), weight, force_from_flux = self._edge_indices_values_weights(system, x, dH)
        z_dot_dS = dS[p_j] - dS[p_i] + 0.5 * w * (dS[S_i] / T_i + dS[S_j] / T_j)
        return force_from_flux(weight * z_dot_dS)

    def factor(self, system, x, dH, dL):
        _, _, weight, force_from_flux = self._edge_indices_values_weights(system, x, dH)
        return Factor(len(weight), lambda w: force_from_flux(jnp.sqrt(weight) * w))

    def _edge_indices_values_weights(self, system, x, dH):
        """Return indices (p_i, p_j, S_i, S_j), values (T_i, T_j, v_i - v_j), ``c / theta``, and flux -> ``flux z``."""
        indices = _state_indices(system)
        i, j, edge = _momentum_and_edge_indices(self.first_bodies, self.second_bodies, indices)
        S_i, S_j, p_i, p_j = indices.S[indices.owner[i]], indices.S[indices.owner[j]], indices.p[i], indices.p[j]
        T_i, T_j, w = _nan_unless_positive(dH[S_i]), _nan_unless_positive(dH[S_j]), dH[p_i] - dH[p_j]

        def force_from_flux(flux):
            force = jnp.zeros_like(x).at[S_i].add(0.5 * w * flux / T_i).at[S_j].add(0.5 * w * flux / T_j)
            return force.at[p_i].add(-flux).at[p_j].add(flux)

        weight = self.coefficient[edge] * (2.0 * T_i * T_j / (T_i + T_j))
        return (p_i, p_j, S_i, S_j), (T_i, T_j, w), weight, force_from_flux

    def force_pattern(self, system):
        indices = _state_indices(system)
        i, j, _ = _momentum_and_edge_indices(self.first_bodies, self.second_bodies, indices)
        S_i, S_j = indices.S[indices.owner[i]], indices.S[indices.owner[j]]
        return clique_pattern(np.stack([indices.p[i], S_i, indices.p[j], S_j], axis=1), system.dim)


class ContactFriction(SkewFriction):
    """Friction of evolution fields in some of the bodies: ``p' = -p T``, ``S' = p . v`` [SML 7].

    It is a skew bracket with the energy. The entropy cannot fall if the energy of each of the bodies is ``p . G(q) p /
    2 + V(q, S)`` with a semidefinite G; for other energies nothing is guaranteed.

    Parameters
    ----------
    body_indices : tuple of int
    law : {"nondecreasing"}, optional
        Law of the entropy, if the energies are known to have that form.
    """

    body_indices: tuple[int, ...] = eqx.field(static=True)

    def force(self, system, x, dH, dS, dL):
        indices = _state_indices(system)
        numbers = np.flatnonzero(np.isin(indices.owner, self.body_indices))
        p, S = indices.p[numbers], indices.S[indices.owner[numbers]]
        return jnp.zeros_like(x).at[p].add(-x[p] * dH[S]).at[S].add(x[p] * dH[p])

    def force_pattern(self, system):
        return _same_body_pattern(_state_indices(system), system.dim)


# -- helpers ----------------------------------------------------------------------------------------------------------


def _state_indices(system) -> StateIndices:
    """Return the indices of all q, p and S in the states of a system."""
    return system.poisson.state_indices


def _nan_unless_positive(T):
    """Return the temperatures, with NaN for those that are not positive: the step is then rejected."""
    return jnp.where(T > 0.0, T, jnp.nan)


def _apply_friction_matrix(R, v):
    """Return ``R v`` for a matrix R, or for the diagonal of one."""
    return R * v if jnp.ndim(R) < 2 else R @ v


def _body_component_indices(indices: StateIndices, momentum_indices: np.ndarray) -> np.ndarray:
    """Return the indices of all state components of the body with these momenta."""
    return np.concatenate(
        [indices.q[momentum_indices], indices.p[momentum_indices], indices.S[indices.owner[momentum_indices[:1]]]]
    )


def _momentum_and_edge_indices(first_bodies: Indices, second_bodies: Indices, indices: StateIndices):
    """Return three index arrays, over edges and components: the momenta at the two ends of an edge, and the edge."""
    i, j = np.asarray(first_bodies), np.asarray(second_bodies)
    starts = np.searchsorted(indices.owner, np.arange(len(indices.S)))
    counts = np.bincount(indices.owner, minlength=len(indices.S))[i]
    edge = np.repeat(np.arange(len(i)), counts)
    offsets = np.arange(len(edge)) - np.repeat(np.cumsum(counts) - counts, counts)
    return starts[i][edge] + offsets, starts[j][edge] + offsets, edge


def _same_body_pattern(indices: StateIndices, dim: int) -> scipy.sparse.csr_array:
    """Return the pattern in which the components of a body depend on each other, and on no other body."""
    starts = np.concatenate([[0], indices.S[:-1] + 1])
    body = np.repeat(np.arange(len(starts)), indices.S + 1 - starts)
    member = pattern_of_matrix(
        scipy.sparse.coo_array((np.ones(dim, dtype=bool), (np.arange(dim), body)), (dim, len(starts)))
    )
    return pattern_of_matrix(member @ member.T)


class Process(Module):
    """A process that changes several particle numbers together, ``N' = nu J``.

    Attributes
    ----------
    stoichiometry : tuple of float
        The coefficients nu of all particle numbers of the system.
    heat_shares : tuple of float
        The fractions of the released energy ``A = -nu . mu`` that heat each body, of sum 1.
    entropy_transport : tuple of float
        1 for a body that receives entropy, -1 for one that gives entropy, otherwise 0.
    entropy : array, shape ()
        Entropy transported with a particle.
    coefficient : array, shape (), or function of the whole state
        L >= 0.
    """

    stoichiometry: tuple[float, ...] = eqx.field(static=True)
    heat_shares: tuple[float, ...] = eqx.field(static=True)
    entropy_transport: tuple[float, ...] = eqx.field(static=True)
    entropy: jax.Array
    coefficient: jax.Array | Callable = eqx.field(metadata=nonnegative_condition("a coefficient").metadata)


class MatterExchange(Dissipation):
    """Processes e with fluxes ``J_e = L_e z_e . dS`` along vectors z_e that hold the energy.

    ``z = nu d/dN + sum_b (w_b A + c_b s T_m) / T_b d/dS_b`` with the affinity ``A = -nu . mu``, ``mu = H_N`` and
    ``T_b = H_{S_b}``; w has sum 1 and c has sum 0, so ``z . dH = nu . mu + A = 0``, for discrete gradients too. The
    entropy grows by ``sum_e L_e (z_e . dS)^2``; in one body ``J = L A / T``, and through a membrane between equal
    temperatures ``J = L (mu_2 - mu_1) / T``. In metriplectic form K is ``sum_e L_e z_e z_e^T``.

    Parameters
    ----------
    processes : sequence of Process
    """

    processes: tuple[Process, ...]

    def __init__(self, processes: Sequence[Process]):
        self.processes = tuple(processes)

    def force(self, system, x, dH, dS, dL):
        affinities, apply_fluxes = self._affinity_and_force_maps(system, x, dH)
        return apply_fluxes(self._flux_coefficients(x) * affinities(dS))

    def factor(self, system, x, dH, dL):
        _, apply_fluxes = self._affinity_and_force_maps(system, x, dH)
        root = jnp.sqrt(self._flux_coefficients(x))
        return Factor(len(self.processes), lambda w: apply_fluxes(root * w))

    def _flux_coefficients(self, x) -> jax.Array:
        """Return the coefficient L of each process, shape (processes,); NaN where it is negative rejects the step."""
        coefficients = [e.coefficient(x) if callable(e.coefficient) else e.coefficient for e in self.processes]
        L = jnp.stack([jnp.asarray(value) for value in coefficients])
        return jnp.where(L >= 0.0, L, jnp.nan)

    def _affinity_and_force_maps(self, system, x, dH) -> tuple[Callable, Callable]:
        """Return two functions: from dS to ``z_e . dS`` of each process, and from fluxes to ``sum_e flux_e z_e``."""
        stoichiometry, heat_shares, entropy_transport = (
            np.array([getattr(e, name) for e in self.processes])
            for name in ("stoichiometry", "heat_shares", "entropy_transport")
        )
        N, S = system.poisson.particle_indices.N, system.poisson.state_indices.S
        mu, T = dH[N], dH[S]
        T, n_ends = jnp.where(T > 0.0, T, jnp.nan), np.abs(entropy_transport)
        affinity = -(stoichiometry @ mu)
        mean_temperature = n_ends @ T / np.maximum(n_ends.sum(axis=1), 1.0)
        transported_heat = jnp.stack([e.entropy for e in self.processes]) * mean_temperature
        entropies = (heat_shares * affinity[:, None] + entropy_transport * transported_heat[:, None]) / T
        return (
            lambda dS: stoichiometry @ dS[N] + entropies @ dS[S],
            lambda flux: jnp.zeros_like(x).at[N].add(flux @ stoichiometry).at[S].add(flux @ entropies),
        )


def conserved_number_combinations(processes: Sequence[Process], n_particle_numbers: int) -> np.ndarray:
    """Return combinations of particle numbers that no process changes, shape (combinations, count), row-reduced."""
    rows = np.array([e.stoichiometry for e in processes]).reshape(-1, n_particle_numbers)
    _, singular, basis = np.linalg.svd(rows, full_matrices=True)
    rank = int((singular > 1e-12 * max(1.0, singular.max(initial=0.0))).sum())
    kernel, _ = row_echelon(basis[rank:], tolerance=1e-9)
    return np.where(np.abs(kernel) < 1e-12, 0.0, kernel)
