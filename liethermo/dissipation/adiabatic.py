"""Jumps between the instantaneous levels of a Hamiltonian whose eigenvectors depend on time."""

from __future__ import annotations

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import manifolds as mf
from manifolds._arrays import is_traced
from manifolds._pytree_module import replace_fields
from manifolds.matrices.linear import adjoint
from manifolds.matrices.spectral import ordered_eigenvectors

from ..errors import InputError
from ..functions.bath_energy import BodyBathsEnergy
from ..functions.density import matrix_logarithm
from ..functions.indices import Indices
from .operators import ENERGY_RTOL, commutator, is_hermitian, level_gap_rounding_bound, subtract_common_energy
from .quantum import ThermalJumps, apply_jump_friction, cluster_labels

ADIABATIC_LIMIT = 0.1
"""Largest adiabatic parameter at which jumps between instantaneous levels count as valid (dimensionless)."""


class InstantaneousJumps(NamedTuple):
    """The jumps at a state and a time, in the eigenvectors of the Hamiltonian.

    Attributes
    ----------
    levels : array, shape (N,)
        Eigenvalues of the Hamiltonian in increasing order.
    vectors : array, shape (N, N)
        Eigenvectors, as columns.
    operators : array, shape (jumps, N, N)
        Jumps V that take energy out of the system; the adjoints belong to them.
    frequencies : array, shape (jumps,)
        The energies omega.
    rates : array, shape (jumps,)
        Rate times weight.
    """

    levels: jax.Array
    vectors: jax.Array
    operators: jax.Array
    frequencies: jax.Array
    rates: jax.Array


class AdiabaticJumps(ThermalJumps):
    """Jumps between instantaneous energy levels, for a slow drive that turns eigenvectors [Albash et al. 2012].

    The jumps are those of :class:`ThermalJumps` for the Hamiltonian H(t) of each time: a coupling V is split into
    components with ``[H(t), V_omega(t)] = -omega(t) V_omega(t)``, which a bath of the temperature T drives at the rates
    ``rate * exp(omega / 2T)`` down and ``rate * exp(-omega / 2T)`` up. This is the adiabatic master equation of Davies'
    form, without the Lamb shift. Both laws hold exactly: the energy of system and baths changes by the work of the
    drive alone, which the ledger records, and the entropy cannot fall. The state at rest of a frozen H(t) is its Gibbs
    state.

    The equation is an approximation. It needs a drive that is slow beside the level distances, ``|<a| dH/dt |b>| <<
    (E_a - E_b)^2`` for all pairs of levels, rates that are small beside the differences of the frequencies omega, and a
    bath whose memory is shorter than all these times. An audit has a row *adiabatic parameter* with the largest
    ``|<a| dH/dt |b>| / (E_a - E_b)^2`` along the run, and says so where it exceeds 0.1:
    :meth:`liethermo.QuantumSystem.adiabatic_parameter`. A laser on an atom is not slow: for it use
    :class:`LindbladJumps` in a rotating frame (:class:`RotatingFrame`).

    Entries of V with the same level distance at all times form one component. Levels that are equal at all times are
    one level. The Hamiltonian may be a traced value; then every pair of levels has a component of its own.

    Parameters
    ----------
    couplings : list of (V, rate)
        V is a dimensionless matrix, shape (N, N). A Hermitian V acts once, any other together with its adjoint. The
        rate is a number >= 0 (1 / time), or a function of omega >= 0 and T, or of omega, T and the time.
    bath : int
        The number of the bath, from 0.

    Raises
    ------
    InputError
        If a coupling or a rate cannot be used, or the system has no baths.

    Examples
    --------
    A field turns from z to x within 40 units of time; the qubit follows its direction and ends in its Gibbs state:

    >>> sx, sz = np.array([[0.0, 1.0], [1.0, 0.0]]), np.diag([1.0, -1.0])
    >>> angle = lambda t: np.pi / 2 * t / 40.0
    >>> H = [
    ...     (sz, lambda t: 0.5 * jnp.cos(angle(t))),
    ...     (sx, lambda t: 0.5 * jnp.sin(angle(t))),
    ... ]
    >>> jumps = lt.AdiabaticJumps([(np.array([[0, -1j], [1j, 0]]), 0.2)])
    >>> qubit = lt.QuantumSystem(H, jumps, baths=lt.HeatBaths(np.inf, 0.5))
    >>> run = lt.integrate(qubit, np.eye(2) / 2, (0.0, 40.0), 0.1)
    >>> run.audit().passed, bool(abs(qubit.bloch(run.x[-1])[0] + np.tanh(1.0)) < 0.01)
    (True, True)
    """

    pair_groups: Indices | None = eqx.field(static=True)

    def __init__(self, couplings, bath: int = 0):
        super().__init__(couplings, bath)
        self.pair_groups = None

    def bind_to(self, system):
        structure = self._checked_structure(system)
        if not system.baths.number:
            raise InputError("AdiabaticJumps exchange heat with a bath. Give the system baths=lt.HeatBaths(...)")
        body_energy = system.energy.body if isinstance(system.energy, BodyBathsEnergy) else system.energy
        if is_traced(body_energy):
            groups = _distinct_level_pair_groups(structure.size)
        else:
            hamiltonians = system.hamiltonians_at_test_times()
            groups = _group_numbers_of_level_pairs(hamiltonians)
            self._check_rates_at_zero_frequency(hamiltonians)
        return replace_fields(self, pair_groups=Indices(groups))

    def _check_rates_at_zero_frequency(self, hamiltonians: list[np.ndarray]) -> None:
        """Raise InputError if a rate is infinite at omega = 0, and the coupling has a component of this frequency."""
        for i, (operator, rate) in enumerate(zip(self.operators, self.rates, strict=True)):
            if not callable(rate) or is_traced(rate):
                continue
            V = np.asarray(operator)
            frames = [np.linalg.eigh(H)[1] for H in hamiltonians]
            diagonals = np.array([np.abs(np.diag(adjoint(U) @ V @ U)).max() for U in frames])
            if not (diagonals > ENERGY_RTOL * len(V) * np.abs(V).max()).any():
                continue
            with jax.ensure_compile_time_eval():
                value = float(self._rates_at(i, jnp.zeros(1), jnp.ones(()), jnp.zeros(()))[0])
            if not np.isfinite(value):
                raise InputError(
                    f"the rate of V[{i}] at omega = 0 is {value}, and V[{i}] has a component of this frequency. Give a "
                    "rate that is finite there, such as lambda omega, T: g * jnp.where(omega == 0, 2 * T, omega / "
                    "jnp.sinh(omega / (2 * T)))"
                )

    def force(self, system, x, dH, dS, dL):
        structure, n = system.structure, system.body_dim
        T = dH[n + self.bath]
        levels, vectors, V, omega, rates = self._jumps_at(system, dH, T)
        # in the basis of the system, as dS: the logarithms of eigenvalues near zero are rounded differently in another
        logs = matrix_logarithm(structure.matrix(x[:n]))
        rho, A, logs = (adjoint(vectors) @ a @ vectors for a in (*map(structure.matrix, (x[:n], dS[:n])), logs))
        gaps = levels[None, :] - levels[:, None]
        bath_terms = (dS[n + self.bath] * V * gaps - omega[:, None, None] * V) / T
        image = apply_jump_friction(rho, logs, A, V, omega / (2.0 * T), bath_terms)
        drho = jnp.sum(commutator(adjoint(V), image * rates[:, None, None]), axis=0)
        return self._force_with_bath_entropy_rates(
            system, T, levels, vectors, drho
        )  # jumps by adjoint operators add the adjoint

    def generator_field(self, system, x, dH):
        """Return the force as Lindblad's equation, without a logarithm, followed by the bath entropy rates."""
        structure, n = system.structure, system.body_dim
        T = dH[n + self.bath]
        levels, vectors, V, omega, strengths = self._jumps_at(system, dH, T)
        rho = adjoint(vectors) @ structure.matrix(x[:n]) @ vectors
        V = jnp.concatenate([V, adjoint(V)])
        factors = jnp.exp(omega / (2.0 * T))
        rates = jnp.concatenate([strengths * factors, strengths / factors])[:, None, None]
        # the Hermitian part, taken later, has both terms of the loss
        drho = jnp.sum(rates * (V @ rho @ adjoint(V)), axis=0) - jnp.sum(rates * (adjoint(V) @ V), axis=0) @ rho
        return self._force_with_bath_entropy_rates(system, T, levels, vectors, drho)

    def _jumps_at(self, system, dH, T) -> InstantaneousJumps:
        """Return the jumps between the levels of the Hamiltonian dH, with their rates at the bath temperature T."""
        structure = system.structure
        levels, vectors = ordered_eigenvectors(structure.matrix(dH[: system.body_dim]))
        masks = _level_pair_group_masks(self.pair_groups)
        # the group of frequency zero comes first; its gaps cancel in pairs
        omega = jnp.sum(masks * (levels[None, :] - levels[:, None]), axis=(-2, -1)) / np.sum(masks, axis=(-2, -1))
        omega = jnp.where(np.arange(len(masks)) == 0, 0.0, omega)
        operators, frequencies, rates = [], [], []
        for i, operator in enumerate(self.operators):
            is_self_adjoint = is_hermitian(operator)
            V = adjoint(vectors) @ np.asarray(operator) @ vectors
            rounding = ENERGY_RTOL * structure.size * float(np.abs(np.asarray(operator)).max())
            matrices_and_groups = (
                [(V, slice(None))] if is_self_adjoint else [(V, slice(None)), (adjoint(V), slice(1, None))]
            )
            for matrix, group_slice in matrices_and_groups:
                components = masks[group_slice] * matrix
                # a rate may be infinite at omega = 0, where many couplings have no component
                is_zero = jnp.max(jnp.abs(components), axis=(-2, -1)) <= rounding
                weights = np.where((np.arange(len(masks)) == 0) & is_self_adjoint, 0.5, 1.0)[group_slice]
                used_omega = jnp.where(is_zero, 1.0, omega[group_slice])
                component_rates = self._rates_at(i, used_omega, T, system.time)
                operators.append(jnp.where(is_zero[:, None, None], 0.0, components))
                frequencies.append(omega[group_slice])
                rates.append(weights * component_rates)
        return InstantaneousJumps(
            levels, vectors, jnp.concatenate(operators), jnp.concatenate(frequencies), jnp.concatenate(rates)
        )

    def _force_with_bath_entropy_rates(self, system, T, levels, vectors, drho) -> jax.Array:
        """Return the force of ``drho``, given in the eigenvectors of H, followed by the bath entropy rates, shape (n,).

        ``tr(H drho)`` is summed by parts, from differences of neighbouring levels and the populations that cross.
        """
        n_levels = system.structure.size
        crossing = np.tri(n_levels - 1, n_levels) @ jnp.diagonal(drho).real
        entropy_rate = jnp.dot(levels[1:] - levels[:-1], crossing) / T
        force = system.structure.vector(vectors @ drho @ adjoint(vectors))
        return jnp.concatenate([force, np.eye(system.dim - system.body_dim)[self.bath] * entropy_rate])


def adiabatic_parameter(structure: mf.DensityMatrices, hamiltonian_coordinates, t) -> jax.Array:
    """Return the largest ``|<a| dH/dt |b>| / (E_a - E_b)^2`` over pairs of levels at the time t, shape ().

    Parameters
    ----------
    structure : manifolds.DensityMatrices
    hamiltonian_coordinates : function from t, shape (), to the coordinates of H, shape (N^2,)
    """
    H, rate = jax.jvp(hamiltonian_coordinates, (t,), (jnp.ones_like(t),))
    levels, vectors = ordered_eigenvectors(structure.matrix(H))
    elements = jnp.abs(adjoint(vectors) @ structure.matrix(rate) @ vectors)
    gaps = jnp.abs(levels[None, :] - levels[:, None])
    # pairs that the drive does not mix do not count, however near they are
    rounding = 1e-13 * (jnp.max(elements) + jnp.max(jnp.abs(rate)))
    is_mixed = (elements > rounding) & ~np.eye(structure.size, dtype=bool)
    return jnp.max(jnp.where(is_mixed, elements / jnp.where(is_mixed & (gaps > 0.0), gaps, 1e-300) ** 2, 0.0))


def _level_pair_group_masks(pair_groups: Indices | None) -> np.ndarray:
    """Return the masks of the groups of pairs of levels, shape (groups, N, N); the first one has frequency zero."""
    assert pair_groups is not None
    groups = np.asarray(pair_groups)
    return (groups == np.arange(groups.max() + 1)[:, None, None]).astype(float)


def _distinct_level_pair_groups(n_levels: int) -> np.ndarray:
    """Return group numbers, shape (N, N), different for all pairs of levels j < k; 0 on the diagonal, -1 below it."""
    groups = np.where(np.tri(n_levels, k=-1, dtype=bool), -1, 0)
    j, k = np.triu_indices(n_levels, 1)
    groups[j, k] = np.arange(1, len(j) + 1)
    return groups


def _group_numbers_of_level_pairs(hamiltonians: list[np.ndarray]) -> np.ndarray:
    """Return the number of the group of each pair (j, k) of ordered levels, shape (N, N); -1 where ``E_k < E_j``.

    Pairs with the same distance under each of the Hamiltonians are in one group. Group 0 has the distance zero.
    """
    size = len(hamiltonians[0])
    levels = np.stack([np.linalg.eigvalsh(subtract_common_energy(H)) for H in hamiltonians])
    gaps = levels[:, None, :] - levels[:, :, None]
    # eigenvalues of matrices that are not diagonal are rounded like them
    tolerances = [size * level_gap_rounding_bound(H) for H in hamiltonians]
    labels = np.stack([cluster_labels(gap.ravel(), tolerance) for gap, tolerance in zip(gaps, tolerances, strict=True)])
    zero = (np.abs(gaps.reshape(len(gaps), -1)) <= np.array(tolerances)[:, None]).all(axis=0)
    _, group = np.unique(labels, axis=1, return_inverse=True)
    group = group.ravel()
    is_upper = np.triu(np.ones((size, size), dtype=bool), 1).ravel() & ~zero
    numbers = np.full(size**2, -1)
    numbers[zero] = 0
    numbers[is_upper] = np.unique(group[is_upper], return_inverse=True)[1].ravel() + 1
    return numbers.reshape(size, size)
