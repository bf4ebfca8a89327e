"""Jumps of open quantum systems that exchange heat with baths."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import manifolds as mf
from manifolds._arrays import is_traced
from manifolds._pytree_module import replace_fields
from manifolds.matrices.linear import adjoint
from manifolds.matrices.spectral import apply_log_mean

from ..errors import InputError
from ..functions.bath_energy import BathEnergy, BodyBathsEnergy, ReservoirEnergy
from ..functions.density import matrix_logarithm
from ..functions.gradients import EPS
from ..functions.time_span import required_argument_count
from .base import Dissipation
from .checks import RATE_CONDITION, checked_rate
from .operators import (
    ENERGY_RTOL,
    Operator,
    checked_square_matrix,
    commutator,
    get_density_structure,
    is_commuting,
    is_diagonal,
    is_hermitian,
    level_gap_rounding_bound,
    subtract_common_energy,
)


class Jump(NamedTuple):
    """A component of a coupling that takes the energy omega out of the system, ``[H, V] = -omega V``.

    Attributes
    ----------
    operator : Operator
        V in the frame of the jumps. Its adjoint, which puts the energy omega in, belongs to the jump too.
    coupling_index : int
        The number of the coupling.
    weight : float
        One half if V is its own adjoint: the two jumps are then one.
    """

    operator: Operator
    coupling_index: int
    weight: float


class ThermalJumps(Dissipation):
    """Jumps of an open quantum system that exchange heat with a bath [Carlen & Maas 2017; Mittnenzweig & Mielke 2017].

    A coupling V is split into components with ``[H, V] = -omega V``. With ``B(A, a) = [V, A] - (a / T) [V, dE]`` and L
    the logarithmic mean of ``e^(-omega / 2T) rho`` from the left and ``e^(omega / 2T) rho`` from the right, the
    friction is ``K = sum (rate / 2) B* L B`` over the components and their adjoints. ``K dE = 0`` and ``K >= 0`` by
    form, for discrete gradients too: the energy of system and bath is constant and the entropy cannot fall. While T is
    constant the motion is Lindblad's equation with detailed balance: jumps V at the rate ``rate * exp(omega / 2T)`` and
    V^H at ``rate * exp(-omega / 2T)``. The Hamiltonian may depend on time if its eigenvectors do not; otherwise use
    :class:`AdiabaticJumps`.

    In a system without baths the jumps exchange no heat. This is the limit of infinite temperature: the identity is at
    rest (the noise is unital), and the entropy cannot fall. The energy is constant if every V commutes with H, as in
    dephasing.

    Parameters
    ----------
    couplings : list of (V, rate)
        V is a dimensionless matrix, shape (N, N). A Hermitian V acts once, any other together with its adjoint. The
        rate is a number >= 0 (1 / time), or a function of omega >= 0 and T, such as ``g / (2 sinh(omega / 2T))`` for a
        bath of bosons, or of omega, T and the time t: a coupling ``c(t) V`` has the rate ``c(t)^2 * rate``. If a
        Hamiltonian that depends on time changes the sign of omega, the rate has to be even in omega.
    bath : int
        The number of the bath, from 0.

    Raises
    ------
    InputError
        If a coupling or a rate cannot be used.

    Examples
    --------
    >>> lower = np.array([[0, 1], [0, 0]])
    >>> bath = lt.HeatBaths(capacity=np.inf, temperature=0.5)
    >>> qubit = lt.QuantumSystem(
    ...     np.diag([0.0, 1.0]), lt.ThermalJumps([(lower, 0.5)]), baths=bath
    ... )
    >>> end = lt.integrate(
    ...     qubit, qubit.state([[0.2, 0.0], [0.0, 0.8]]), (0.0, 60.0), 0.1
    ... ).x[-1]
    >>> populations = np.diag(qubit.density(end)).real
    >>> bool(abs(populations[1] / populations[0] - np.exp(-1.0 / 0.5)) < 1e-6)
    True
    """

    operators: tuple[Operator, ...] = eqx.field(static=True)
    rates: tuple[Any, ...] = eqx.field(metadata=RATE_CONDITION.metadata)
    bath: int = eqx.field(static=True)
    jumps: tuple[Jump, ...] = eqx.field(static=True, repr=False)
    jump_frame: Operator | None = eqx.field(static=True, repr=False)
    level_order: tuple[int, ...] = eqx.field(static=True, repr=False)
    is_driven: bool = eqx.field(static=True)
    timed_rates: tuple[int, ...] = eqx.field(static=True, repr=False)
    is_isolated: bool = eqx.field(static=True)
    conserves_energy: bool = eqx.field(static=True)

    def __init__(self, couplings: Sequence[tuple[Any, Any]], bath: int = 0):
        pairs = list(couplings)
        if not pairs or not all(isinstance(pair, tuple | list) and len(pair) == 2 for pair in pairs):
            raise InputError("couplings must be a list of pairs (V, rate), such as [(V, 0.1)]")
        if isinstance(bath, bool) or not isinstance(bath, int) or bath < 0:
            raise InputError(f"bath must be the index of a bath, an integer >= 0, got {bath!r}")
        self.operators = tuple(
            Operator(checked_square_matrix(V, f"the coupling V[{i}]")) for i, (V, _) in enumerate(pairs)
        )
        for i, V in enumerate(self.operators):
            if not np.asarray(V).any():
                raise InputError(f"the coupling V[{i}] is zero. Leave it out")
        self.rates = tuple(
            _checked_rate_function(rate, i) if callable(rate) else checked_rate(rate)
            for i, (_, rate) in enumerate(pairs)
        )
        self.timed_rates = tuple(i for i, rate in enumerate(self.rates) if _rate_depends_on_time(rate))
        self.bath, self.jumps, self.jump_frame, self.level_order, self.is_driven = bath, (), None, (), False
        self.is_isolated, self.conserves_energy = False, True

    @property
    def energy_law(self):
        return "conserved" if self.conserves_energy else None

    @property
    def depends_on_time(self) -> bool:
        return bool(self.timed_rates)

    def bind_to(self, system):
        structure, baths = self._checked_structure(system), system.baths
        if is_traced(system.energy.body if isinstance(system.energy, BodyBathsEnergy) else system.energy):
            raise InputError(
                "ThermalJumps need the eigenvectors of the Hamiltonian, so it must not be a traced value. Build a "
                "system for each Hamiltonian, as lt.Study does. Rates, temperatures and capacities may be traced"
            )
        hamiltonians = system.hamiltonians_at_test_times()
        if not baths.number:
            jumps = tuple(Jump(V, i, 0.5 if is_hermitian(V) else 1.0) for i, V in enumerate(self.operators))
            conserves_energy = all(is_commuting(H, V) for H in hamiltonians for V in map(np.asarray, self.operators))
            return replace_fields(
                self, jumps=jumps, jump_frame=None, is_isolated=True, conserves_energy=conserves_energy
            )
        vectors = _common_eigenvectors(hamiltonians)
        jumps_by_coupling = [_jumps_of_coupling(V, i, hamiltonians, vectors) for i, V in enumerate(self.operators)]
        frame = None if np.array_equal(vectors, np.eye(structure.size)) else Operator(vectors)
        jumps = tuple(itertools.chain.from_iterable(jumps_by_coupling))
        levels = np.diag(adjoint(vectors) @ subtract_common_energy(hamiltonians[0]) @ vectors).real
        order, driven = tuple(int(i) for i in np.argsort(levels)), system.is_driven
        bound_jumps = replace_fields(
            self,
            jumps=jumps,
            jump_frame=frame,
            level_order=order,
            is_driven=driven,
            is_isolated=False,
            conserves_energy=True,
        )
        if not is_traced((self.rates, baths)):
            bound_jumps._check_rates(system, hamiltonians[0])
        return bound_jumps

    def _checked_structure(self, system) -> mf.DensityMatrices:
        """Return the structure of a system, after a check that the couplings and the bath fit it."""
        name = type(self).__name__
        structure, baths = get_density_structure(system, name), system.baths
        for i, V in enumerate(self.operators):
            if np.shape(V) != (structure.size,) * 2:
                raise InputError(
                    f"the coupling V[{i}] has shape {np.shape(V)}, but the Hamiltonian has shape ({structure.size}, "
                    f"{structure.size})"
                )
        if 0 < baths.number <= self.bath:
            raise InputError(
                f"{name} exchange heat with bath {self.bath}, but there are {baths.number} baths, numbered from 0"
            )
        return structure

    def replace_operators(self, matrices: Sequence[Any], bath: int) -> ThermalJumps:
        """Return these jumps, with their rates, for other matrices and another bath, as in a larger system."""
        return replace_fields(self, operators=tuple(map(Operator, matrices)), bath=bath, jumps=())

    def force(self, system, x, dH, dS, dL):
        """Return the force; for exact gradients it is Lindblad's equation, without the logarithm of rho.

        At the gradient of the entropy ``L B(dS)`` is ``e^(-omega / 2T) rho V - e^(omega / 2T) V rho``. L is applied
        only to the difference of a discrete gradient from it. So eigenvalues that are zero to rounding stay zero.
        """
        structure, n = system.structure, system.body_dim
        rho, H, A = (self._to_jump_frame(structure.matrix(a[:n])) for a in (x, dH, dS))
        # In the basis of the system, as in dS: the logarithms of eigenvalues near zero are rounded by up to 50, and
        # differently in another basis.
        logs = self._to_jump_frame(matrix_logarithm(structure.matrix(x[:n])))
        operators = _stack_jump_operators(self.jumps)
        V, V_adjoint, omega = (
            jnp.asarray(operators),
            jnp.asarray(adjoint(operators)),
            self._jump_frequencies(structure, dH[:n]),
        )
        T = jnp.asarray(jnp.inf) if self.is_isolated else dH[n + self.bath]
        bath_terms = None
        if not self.is_isolated:
            # Differences of levels lose no digits; the off-diagonal entries of H are mostly zero.
            levels, off_diagonal = self._energies_in_jump_frame(structure, dH[:n]), 1.0 - np.eye(structure.size)
            H_commutators = V * (levels[None, :] - levels[:, None]) + commutator(V, H * off_diagonal)
            bath_terms = (dS[n + self.bath] * H_commutators - omega[:, None, None] * V) / T
        image = apply_jump_friction(rho, logs, A, V, omega / (2.0 * T), bath_terms)
        drho = jnp.sum(
            commutator(V_adjoint, image * self._weighted_jump_rates(system, omega, T)[:, None, None]), axis=0
        )
        return self._append_bath_entropy_rates(system, dH, T, drho)  # jumps by adjoint operators add the adjoint

    has_generator = True

    def generator_field(self, system, x, dH):
        """Return the rate of rho by Lindblad's equation, which needs no logarithm, and then the bath entropy rates."""
        structure, n = system.structure, system.body_dim
        rho, omega = self._to_jump_frame(structure.matrix(x[:n])), self._jump_frequencies(structure, dH[:n])
        T = jnp.asarray(jnp.inf) if self.is_isolated else dH[n + self.bath]
        strengths, boltzmann_factors = self._weighted_jump_rates(system, omega, T), jnp.exp(omega / (2.0 * T))
        rates = jnp.concatenate([strengths * boltzmann_factors, strengths / boltzmann_factors])
        # the Hermitian part, taken later, has both terms of the loss
        drho = _jump_gain(self.jumps, rates, rho) - jnp.tensordot(rates, _adjoint_products(self.jumps), 1) @ rho
        return self._append_bath_entropy_rates(system, dH, T, drho)

    def _check_rates(self, system, H: np.ndarray) -> None:
        """Raise InputError if double precision cannot represent the rates at the first temperature of the bath.

        It is computed by NumPy: JAX would compile a program for each operation.
        """
        energy = system.baths.energy
        if isinstance(energy, BathEnergy | ReservoirEnergy):
            T = float(np.asarray(energy.temperature)[self.bath])
        else:
            T = float(energy.at_time(0.0).gradient(jnp.zeros(system.baths.number))[self.bath])
        levels = np.diag(self._to_jump_frame(subtract_common_energy(H))).real
        for jump in self.jumps:
            weights = np.abs(np.asarray(jump.operator)) ** 2
            omega = float(np.sum(weights * (levels[None, :] - levels[:, None])) / np.sum(weights))
            rate, w = self.rates[jump.coupling_index], abs(omega)
            with np.errstate(over="ignore", invalid="ignore"):
                arguments = (omega, T, 0.0)[: 3 if jump.coupling_index in self.timed_rates else 2]
                strength = jump.weight * np.asarray(rate(*arguments) if callable(rate) else rate, dtype=np.float64)
                exact_rate = float(strength * np.exp(np.float64(w) / (2.0 * T)))
            # the exponential overflows, not the rate
            if w > -2.0 * np.log(EPS) * T and not exact_rate * EPS <= w:
                raise InputError(
                    f"jumps of V[{jump.coupling_index}] with the energy {w:.3g} have, at T = {T:.3g}, "
                    f"rate * exp(omega / 2T) = {exact_rate:.3g}, too large for double precision. Give the rate as a "
                    "function, such as lambda omega, T: g * jnp.exp(-omega / (2 * T)), or a higher temperature"
                )

    def _to_jump_frame(self, matrix):
        """Return a matrix in the frame of the jumps, in which most of their entries are zero."""
        return (
            matrix
            if self.jump_frame is None
            else adjoint(np.asarray(self.jump_frame)) @ matrix @ np.asarray(self.jump_frame)
        )

    def _from_jump_frame(self, matrix):
        """Transform a matrix from the frame of the jumps to the basis of the system."""
        return (
            matrix
            if self.jump_frame is None
            else np.asarray(self.jump_frame) @ matrix @ adjoint(np.asarray(self.jump_frame))
        )

    def _jump_frequencies(self, structure: mf.DensityMatrices, dH) -> jax.Array:
        """Return the energies omega of the jumps, shape (jumps,): linear in H, from tables known at trace time.

        ``tr(H [V^H, V]) / tr(V^H V)``, with the diagonal of H by differences of levels, which lose no digits.
        """
        operators, off_diagonal, levels = (
            _stack_jump_operators(self.jumps),
            1.0 - np.eye(structure.size),
            self._energies_in_jump_frame(structure, dH),
        )
        weights = np.abs(operators) ** 2
        squares = np.sum(weights, axis=(-2, -1))
        k, j = np.nonzero(np.sum(weights * off_diagonal, axis=0))
        omega = (weights[:, k, j] / squares[:, None]) @ (levels[j] - levels[k])
        off_diagonal_weights = off_diagonal * commutator(adjoint(operators), operators) / squares[:, None, None]
        return (
            omega + structure.vector(self._from_jump_frame(off_diagonal_weights)) @ dH
            if off_diagonal_weights.any()
            else omega
        )

    def _energies_in_jump_frame(self, structure: mf.DensityMatrices, dH) -> jax.Array:
        """Return the diagonal of H in the frame of the jumps, shape (N,)."""
        if self.jump_frame is None:
            return dH[: structure.size]
        vectors = np.asarray(self.jump_frame).T
        return structure.vector(vectors[:, :, None] * vectors[:, None, :].conj()) @ dH

    def _append_bath_entropy_rates(self, system, dH, T, drho) -> jax.Array:
        """Return the coordinates of ``drho``, given in the frame of the jumps, followed by the bath entropy rates."""
        structure, n = system.structure, system.body_dim
        force = structure.vector(self._from_jump_frame(drho))
        if self.is_isolated:
            return force
        entropy_rate = -self._energy_rate(structure, dH[:n], drho, force) / T
        return jnp.concatenate([force, np.eye(system.dim - n)[self.bath] * entropy_rate])

    def _energy_rate(self, structure: mf.DensityMatrices, dH, drho, force) -> jax.Array:
        """Return ``tr(H drho)``, shape (), for drho of trace zero in the jump frame, with coordinates ``force``.

        It is summed by parts, from differences of neighbouring levels and the populations that cross between them. So
        levels that no jump connects do not matter, however large their energies are.
        """
        order, size = np.array(self.level_order), structure.size
        levels = self._energies_in_jump_frame(structure, dH)[order]
        populations = force[:size] if self.jump_frame is None else jnp.diagonal(drho).real
        rate = jnp.dot(levels[:-1] - levels[1:], np.tri(size - 1, size) @ populations[order])
        if self.jump_frame is None:
            return rate + jnp.dot(dH[size:], force[size:])
        if not self.is_driven:  # H is diagonal in the frame
            return rate
        H = self._to_jump_frame(structure.matrix(dH))
        return rate + jnp.sum(((1.0 - np.eye(size)) * H.conj() * drho).real)

    def _weighted_jump_rates(self, system, omega, T) -> jax.Array:
        """Return the rate of each jump at its transition frequency and the temperature of its bath, times its
        weight, shape (jumps,)."""
        weights = np.array([jump.weight for jump in self.jumps])
        jump_counts = np.bincount([jump.coupling_index for jump in self.jumps], minlength=len(self.rates))
        omega_by_coupling = jnp.split(omega, np.cumsum(jump_counts)[:-1])  # the jumps are in the order of the couplings
        rates = [
            self._rates_at(i, coupling_omega, T, system.time)
            for i, coupling_omega in enumerate(omega_by_coupling)
            if jump_counts[i]
        ]
        return jnp.concatenate(rates) * weights

    def _rates_at(self, i: int, omega, T, time) -> jax.Array:
        """Return the rates of the coupling i at frequencies, shape (k,), and a temperature; ``time`` may be None.

        The rate function is traced once for all of them.
        """
        rate = self.rates[i]
        if i in self.timed_rates and time is None:
            raise InputError(f"the rate of V[{i}] depends on time. Use system.at_time(t)")
        arguments = (T, time) if i in self.timed_rates else (T,)
        if not callable(rate):
            return jnp.broadcast_to(rate, omega.shape)
        return jax.vmap(lambda w: jnp.asarray(rate(w, *arguments)))(omega)


GENERIC_WEIGHTS = (1.0, 0.7548776662466927, 0.5698402909980532)
"""Weights in a sum of commuting Hamiltonians, chosen so that its eigenvectors are common to all of them."""


def _common_eigenvectors(hamiltonians: Sequence[np.ndarray]) -> np.ndarray:
    """Return the common eigenvectors of Hamiltonians that commute; for diagonal matrices the axes."""
    scales = [np.abs(H).max() for H in hamiltonians]
    # There may be fewer Hamiltonians than weights.
    triples = zip(GENERIC_WEIGHTS, map(subtract_common_energy, hamiltonians), scales, strict=False)
    H = sum((w * H / (scale or 1.0) for w, H, scale in triples), np.zeros_like(hamiltonians[0]))
    return np.eye(len(H)) if is_diagonal(H) else np.linalg.eigh(H)[1]


def apply_jump_friction(rho, log_rho, dS, V, shift, bath_terms) -> jax.Array:
    """Apply the friction operator L of each jump to ``[V, dS]`` less the bath terms; return shape (jumps, N, N).

    All matrices are given in one frame. The logarithm of rho is taken out of the gradient dS of the entropy: if dS is
    -ln rho, and without ``bath_terms``, the result is that of Lindblad's equation.

    Parameters
    ----------
    rho, log_rho, dS : array, shape (N, N)
        The density matrix, its logarithm, and the gradient of the entropy of rho.
    V : array, shape (jumps, N, N)
    shift : array, shape (jumps,)
        ``omega / 2T``.
    bath_terms : array, shape (jumps, N, N), or None
        ``(dS_bath [V, H] - omega V) / T``.
    """
    commutators = commutator(V, dS + log_rho)
    if bath_terms is not None:
        commutators = commutators - bath_terms
    boltzmann_factors = jnp.exp(shift)[:, None, None]
    return rho @ V / boltzmann_factors - boltzmann_factors * (V @ rho) + apply_log_mean(log_rho, shift, commutators)


def _stack_jump_operators(jumps: tuple[Jump, ...]) -> np.ndarray:
    """Return the matrices of the jumps, shape (jumps, N, N), as real ones if possible."""
    operators = np.stack([np.asarray(jump.operator) for jump in jumps])
    return operators if operators.imag.any() else operators.real


def _operators_and_adjoints(jumps: tuple[Jump, ...]) -> np.ndarray:
    """Return the matrices of the jumps, followed by their adjoints, shape (2 jumps, N, N)."""
    operators = _stack_jump_operators(jumps)
    return np.concatenate([operators, adjoint(operators)])


@functools.lru_cache(maxsize=64)
def _adjoint_products(jumps: tuple[Jump, ...]) -> np.ndarray:
    """Return ``V^H V`` of each jump, followed by that of each adjoint."""
    matrices = _operators_and_adjoints(jumps)
    return adjoint(matrices) @ matrices


def _jump_gain(jumps: tuple[Jump, ...], rates, rho) -> jax.Array:
    """Return the gain term ``sum rate V rho V^H`` of Lindblad's equation, over the jumps and then their adjoints."""
    table = _sparse_gain_terms(jumps)
    if table is None:
        matrices = _operators_and_adjoints(jumps)
        return jnp.sum((rates[:, None, None] * matrices) @ rho @ adjoint(matrices), axis=0)
    jump_numbers, rho_entries, factors = table
    return jnp.sum(rho.ravel()[rho_entries] * (rates[jump_numbers] * factors), axis=-1).reshape(rho.shape)


@functools.lru_cache(maxsize=64)
def _sparse_gain_terms(jumps: tuple[Jump, ...]) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Return, for each entry of ``sum V rho V^H``, the jump numbers, the entries of rho and the factors of its terms.

    None if products of matrices need fewer operations, as for a few full matrices.
    """
    matrices = _operators_and_adjoints(jumps)
    size = matrices.shape[-1]
    jump, i, j = np.nonzero(matrices)
    if np.sum(np.bincount(jump) ** 2) > 2 * matrices.size * size:
        return None
    first_entry, second_entry = np.nonzero(jump[:, None] == jump)
    target = i[first_entry] * size + i[second_entry]
    order = np.argsort(target, kind="stable")
    first_entry, second_entry, target = first_entry[order], second_entry[order], target[order]
    counts = np.bincount(target, minlength=size**2)
    table_position = target, np.arange(len(target)) - np.repeat(np.cumsum(counts) - counts, counts)
    # Unsigned, so that JAX does not test for negative indices.
    jump_numbers, rho_entries = np.zeros((2, size**2, counts.max()), np.uint32)
    factors = np.zeros(jump_numbers.shape, matrices.dtype)
    jump_numbers[table_position], rho_entries[table_position] = (
        jump[first_entry],
        j[first_entry] * size + j[second_entry],
    )
    factors[table_position] = (
        matrices[jump[first_entry], i[first_entry], j[first_entry]]
        * matrices[jump[second_entry], i[second_entry], j[second_entry]].conj()
    )
    return jump_numbers, rho_entries, factors


def _checked_rate_function(rate: Callable, i: int) -> Callable:
    """Return a rate function of omega and T, or of omega, T and t, tested at omega = T = 1 and t = 0."""
    what = f"the rate of V[{i}] must be a number, or a function of omega and T, or of omega, T and t, to a number >= 0"
    try:
        value = rate(*(1.0, 1.0, 0.0)[: 3 if _rate_depends_on_time(rate) else 2])
    except TypeError as error:
        raise InputError(f"{what}: {error}") from None
    if np.shape(value) or jnp.result_type(value).kind not in "fiu":
        raise InputError(f"{what}, got {value!r}")
    if not isinstance(value, jax.core.Tracer) and value < 0.0:
        raise InputError(f"{what}: at omega = 1 and T = 1 it is {float(value):.6g}")
    return rate


def _rate_depends_on_time(rate) -> bool:
    """Return whether a rate is a function of omega, T and the time."""
    return callable(rate) and required_argument_count(rate) == 3


def _jumps_of_coupling(
    operator: Operator, coupling_index: int, hamiltonians: Sequence[np.ndarray], frame: np.ndarray
) -> list[Jump]:
    """Return the jumps of a coupling, the eigenoperators of ``[H, .]`` whose sum it is.

    If the coupling is Hermitian, one eigenoperator of each adjoint pair is returned. The entries of an eigenoperator
    have the same difference of levels, in the frame, under each of the Hamiltonians.
    """
    V = np.asarray(operator)
    V_framed = adjoint(frame) @ V @ frame
    framed_hamiltonians = [adjoint(frame) @ subtract_common_energy(H) @ frame for H in hamiltonians]
    tolerances = [level_gap_rounding_bound(H) for H in hamiltonians]
    entries = np.nonzero(np.abs(V_framed) > _entry_rounding_bounds(V_framed, frame, framed_hamiltonians, tolerances))
    gaps = np.stack([np.diag(H).real[entries[1]] - np.diag(H).real[entries[0]] for H in framed_hamiltonians])
    labels = np.stack(
        [cluster_labels(*gaps_and_tolerance) for gaps_and_tolerance in zip(gaps, tolerances, strict=True)]
    )
    is_self_adjoint, jumps = is_hermitian(V), []
    for label in np.unique(labels, axis=1).T:
        is_member = (labels == label[:, None]).all(axis=0)
        omegas = gaps[:, is_member].mean(axis=1)
        sign = next((np.sign(w) for w, limit in zip(omegas, tolerances, strict=True) if abs(w) > limit), 0.0)
        if is_self_adjoint and sign < 0.0:
            continue
        component = np.zeros_like(V_framed)
        component[entries[0][is_member], entries[1][is_member]] = V_framed[entries][is_member]
        for H, omega, tolerance in zip(framed_hamiltonians, omegas, tolerances, strict=True):
            if (
                not np.abs(commutator(H, component) + omega * component).max()
                <= len(H) * tolerance * np.abs(component).max()
            ):
                raise InputError(
                    f"the coupling V[{coupling_index}] cannot be split into components with [H, V] = -omega V, "
                    "since the eigenvectors of the Hamiltonian depend on time. Only its eigenvalues may. For a slow "
                    "drive use lt.AdiabaticJumps, for a weak one lt.LindbladJumps with the jumps of the undriven "
                    "system"
                )
        component = (
            component if sign >= 0.0 else adjoint(component)
        )  # both act, and rates are evaluated at a positive omega
        jumps.append(Jump(Operator(component), coupling_index, 0.5 if is_self_adjoint and sign == 0.0 else 1.0))
    return jumps


def _entry_rounding_bounds(
    V_framed: np.ndarray, frame: np.ndarray, framed_hamiltonians: Sequence[np.ndarray], tolerances: Sequence[float]
) -> np.ndarray | float:
    """Return bounds, shape (N, N), of the rounding errors of the entries of a matrix in a frame; 0 if it is diagonal.

    An eigenvector contains another one by the rounding of the energies, relative to their difference.
    """
    if is_diagonal(frame):
        return 0.0
    sizes = np.abs(V_framed)
    rotation_bounds = np.ones_like(sizes)
    for H, tolerance in zip(framed_hamiltonians, tolerances, strict=True):
        levels = np.diag(H).real
        level_gaps = np.abs(levels[:, None] - levels)
        rotation_bounds = np.minimum(rotation_bounds, tolerance / np.maximum(level_gaps, tolerance or 1.0))
    rotation_bounds = np.where(rotation_bounds < 1.0, rotation_bounds, 0.0)  # eigenvectors of one level are arbitrary
    return ENERGY_RTOL * len(sizes) * sizes.max() + rotation_bounds @ sizes + sizes @ rotation_bounds


def cluster_labels(numbers: np.ndarray, tolerance: float) -> np.ndarray:
    """Return the label of the cluster of each number; numbers of a cluster differ by at most ``tolerance``."""
    labels, cluster_start, label = np.empty(len(numbers), int), -np.inf, -1
    for i in np.argsort(numbers):
        if numbers[i] > cluster_start + tolerance:
            cluster_start, label = numbers[i], label + 1
        labels[i] = label
    return labels
