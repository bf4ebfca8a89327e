"""Open quantum systems: jumps that exchange heat with baths, and steepest entropy ascent."""

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
from manifolds.matrices.linear import adjoint
from manifolds.matrices.spectral import log_mean

from ..errors import InputError
from ..functions.density import OfMatrix
from ..functions.energy import Energy, Function
from ..functions.frames import frame
from ..functions.gradients import EPS
from ..functions.indices import Fixed
from ..functions.with_baths import WithBaths
from .base import Dissipation
from .checks import checked_rate

EIGEN = 1e-9
"""Residual of ``[H, V] = -omega V``, and difference of frequencies, relative to the sizes of H and V, that is zero."""


class Operator(Fixed):
    """A complex matrix as a static field of a module."""

    dtype = complex


class Jump(NamedTuple):
    """A part of a coupling that takes the energy omega out of the system, ``[H, V] = -omega V``.

    Attributes
    ----------
    operator : Operator
        V in the frame of the jumps; together with its adjoint, which puts that energy in.
    source : int
        The number of the coupling.
    weight : float
        One half where V is its own adjoint: the two are then one.
    """

    operator: Operator
    source: int
    weight: float


class ThermalJumps(Dissipation):
    """Jumps of an open quantum system that exchange heat with a bath [Carlen & Maas 2017; Mittnenzweig & Mielke 2017].

    A coupling V is split into parts with ``[H, V] = -omega V``. With ``B(A, a) = [V, A] - (a / T) [V, dE]`` and L the
    logarithmic mean of ``e^(-omega / 2T) rho`` from the left and ``e^(omega / 2T) rho`` from the right, the friction is
    ``K = sum (rate / 2) B* L B`` over the parts and their adjoints. ``K dE = 0`` and ``K >= 0`` by form, for discrete
    gradients too: the energy of system and bath is constant and the entropy cannot fall. While T is constant the motion
    is Lindblad's equation with detailed balance: jumps V at the rate ``rate * exp(omega / 2T)`` and V^H at
    ``rate * exp(-omega / 2T)``. The Hamiltonian may change in time if its eigenvectors do not change.

    In a system without baths the jumps exchange no heat. This is the limit of infinite temperature: the identity is at
    rest (the noise is unital), and the entropy cannot fall. The energy is constant if every V commutes with H, as in
    dephasing.

    Parameters
    ----------
    couplings : list of (V, rate)
        V is a dimensionless matrix, shape (N, N). A Hermitian V acts once, any other together with its adjoint. The
        rate is a number >= 0 (1 / time), or a function of omega >= 0 and T, such as ``g / (2 sinh(omega / 2T))`` for a
        bath of bosons. Where a Hamiltonian that depends on time changes the sign of omega, it has to be even in omega.
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
    >>> qubit = lt.QuantumSystem(np.diag([0.0, 1.0]), lt.ThermalJumps([(lower, 0.5)]), baths=bath)
    >>> end = lt.integrate(qubit, qubit.state([[0.2, 0.0], [0.0, 0.8]]), (0.0, 60.0), 0.1).x[-1]
    >>> populations = np.diag(qubit.density(end)).real
    >>> bool(abs(populations[1] / populations[0] - np.exp(-1.0 / 0.5)) < 1e-6)
    True
    """

    operators: tuple[Operator, ...] = eqx.field(static=True)
    rates: tuple[Any, ...]
    bath: int = eqx.field(static=True)
    jumps: tuple[Jump, ...] = eqx.field(static=True)
    frame: Operator | None = eqx.field(static=True)
    isolated: bool = eqx.field(static=True)
    keeps_energy: bool = eqx.field(static=True)

    def __init__(self, couplings: Sequence[tuple[Any, Any]], bath: int = 0):
        given = list(couplings)
        if not given or not all(isinstance(pair, tuple | list) and len(pair) == 2 for pair in given):
            raise InputError("ThermalJumps takes a list of pairs (V, rate), such as [(V, 0.1)]")
        if isinstance(bath, bool) or not isinstance(bath, int) or bath < 0:
            raise InputError(f"bath is the number of a bath, from 0, not {bath!r}")
        self.operators = tuple(Operator(checked_matrix(V, f"the coupling V[{i}]")) for i, (V, _) in enumerate(given))
        for i, V in enumerate(self.operators):
            if not np.asarray(V).any():
                raise InputError(f"the coupling V[{i}] is zero: leave it out")
        self.rates = tuple(
            _checked_function(rate, i) if callable(rate) else checked_rate(rate) for i, (_, rate) in enumerate(given)
        )
        self.bath, self.jumps, self.frame, self.isolated, self.keeps_energy = bath, (), None, False, True

    @property
    def energy_law(self):
        return "conserved" if self.keeps_energy else None

    def prepared(self, system):
        structure, baths = needed_density(system, "ThermalJumps"), system.baths
        for i, V in enumerate(self.operators):
            if np.shape(V) != (structure.size,) * 2:
                raise InputError(
                    f"the coupling V[{i}] has shape {np.shape(V)}, and the Hamiltonian ({structure.size},"
                    f" {structure.size})"
                )
        if baths is not None and self.bath >= baths.number:
            raise InputError(f"ThermalJumps exchange heat with bath {self.bath}, but there are {baths.number}, from 0")
        if is_traced(system.energy.body if isinstance(system.energy, WithBaths) else system.energy):
            raise InputError(
                "ThermalJumps are split by the eigenvectors of the Hamiltonian, which has to be a known one: build a "
                "system for each, as lt.Study does. Rates, temperatures and capacities may be parameters of a function"
            )
        hamiltonians = system.hamiltonians()
        if baths is None:
            jumps = tuple(Jump(V, i, 0.5 if _hermitian(V) else 1.0) for i, V in enumerate(self.operators))
            kept = all(_small(_commutator(H, V), H, V) for H in hamiltonians for V in map(np.asarray, self.operators))
            return self._replaced(jumps=jumps, frame=None, isolated=True, keeps_energy=kept)
        vectors = _eigenvectors(hamiltonians[0])
        inside = [adjoint(vectors) @ H @ vectors for H in hamiltonians]
        parts = [_split(V, i, inside, vectors) for i, V in enumerate(self.operators)]
        frame = None if np.array_equal(vectors, np.eye(structure.size)) else Operator(vectors)
        jumps = tuple(itertools.chain.from_iterable(parts))
        found = self._replaced(jumps=jumps, frame=frame, isolated=False, keeps_energy=True)
        if not is_traced((self.rates, baths)):
            found._check_rates(system.at_some_times()[0] if system.is_driven else system)
        return found

    def _replaced(self, **fields) -> ThermalJumps:
        found = object.__new__(ThermalJumps)
        for name in ("operators", "rates", "bath", "jumps", "frame", "isolated", "keeps_energy"):
            object.__setattr__(found, name, fields.get(name, getattr(self, name)))
        return found

    def with_operators(self, matrices: Sequence[Any], bath: int) -> ThermalJumps:
        """The same rates with other matrices, such as those of a larger system, and another bath."""
        return self._replaced(operators=tuple(map(Operator, matrices)), bath=bath, jumps=())

    def force(self, system, x, dH, dS, dL):
        structure, n = system.structure, system.body_dim
        rho, H, A = (self._inside(structure.matrix(a[:n])) for a in (x, dH, dS))
        fixed = _stacked(self.jumps)
        V, back, omega = jnp.asarray(fixed), jnp.asarray(adjoint(fixed)), self._frequencies(structure, dH[:n])
        if self.isolated:
            T, shift = jnp.asarray(jnp.inf), jnp.zeros(len(self.jumps))
        else:
            T = dH[n + self.bath]
            shift, A = omega / (2.0 * T), A - (dS[n + self.bath] / T) * H
        image = log_mean(mf.spectral(jnp.log, rho), shift, _commutator(V, A)) * self._strengths(omega, T)[:, None, None]
        moved = jnp.sum(_commutator(back, image), axis=0)  # the adjoints add the adjoint
        return self._with_heat(system, dH, T, structure.vector(self._outside(moved)))

    has_generator = True

    def generated(self, system, x, dH):
        """Lindblad's equation, and the heat that the bath takes."""
        structure, n = system.structure, system.body_dim
        rho, omega = self._inside(structure.matrix(x[:n])), self._frequencies(structure, dH[:n])
        T = jnp.asarray(jnp.inf) if self.isolated else dH[n + self.bath]
        strengths, grown = self._strengths(omega, T), jnp.exp(omega / (2.0 * T))
        rates = jnp.concatenate([strengths * grown, strengths / grown])
        # the Hermitian part has both terms of what is lost
        moved = _jumped(self.jumps, rates, rho) - jnp.tensordot(rates, _left(self.jumps), 1) @ rho
        return self._with_heat(system, dH, T, structure.vector(self._outside(moved)))

    def _check_rates(self, system) -> None:
        """Raise InputError where rates at the first temperature of the bath cannot be computed with."""
        n, dH = system.body_dim, system.energy.gradient(jnp.zeros(system.dim))
        omega, T = self._frequencies(system.structure, dH[:n]), dH[n + self.bath]
        strengths, sizes = self._strengths(omega, T), np.abs(np.asarray(omega))
        rates = np.asarray(strengths * jnp.exp(jnp.abs(omega) / (2.0 * T)))
        for jump, rate, w in zip(self.jumps, rates, sizes, strict=True):
            if w > -2.0 * np.log(EPS) * T and not rate * EPS <= w:  # not so by the rate that was given
                raise InputError(
                    f"jumps of V[{jump.source}] that take the energy {w:.3g} from the system have, at T = {T:.3g}, "
                    f"rate * exp(omega / 2T) = {rate:.3g}: no rate that doubles hold beside that energy. Give the rate "
                    "as a function, such as lambda omega, T: g * jnp.exp(-omega / (2 * T)), or a higher temperature"
                )

    def _inside(self, matrix):
        """A matrix in the frame, in which most entries of the jumps are zero."""
        return matrix if self.frame is None else adjoint(np.asarray(self.frame)) @ matrix @ np.asarray(self.frame)

    def _outside(self, matrix):
        return matrix if self.frame is None else np.asarray(self.frame) @ matrix @ adjoint(np.asarray(self.frame))

    def _frequencies(self, structure: mf.DensityMatrices, dH) -> jax.Array:
        """The energies that the jumps take: linear in H, by a table that is known when programs are written."""
        fixed = _stacked(self.jumps)
        along = _commutator(adjoint(fixed), fixed) / np.sum(np.abs(fixed) ** 2, axis=(-2, -1))[:, None, None]
        return structure.vector(self._outside(along)) @ dH

    def _with_heat(self, system, dH, T, force) -> jax.Array:
        """The force with the entropy that the bath takes."""
        if self.isolated:
            return force
        taken = -jnp.dot(dH[: system.body_dim], force) / T
        return jnp.concatenate([force, np.eye(system.dim - system.body_dim)[self.bath] * taken])

    def _strengths(self, omega, T) -> jax.Array:
        rates = [self.rates[jump.source] for jump in self.jumps]
        return jnp.stack(
            [
                jump.weight * jnp.asarray(rate(omega[i], T) if callable(rate) else rate)
                for i, (jump, rate) in enumerate(zip(self.jumps, rates, strict=True))
            ]
        )


class SteepestEntropyAscent(Dissipation):
    """Steepest entropy ascent of an isolated quantum system [Beretta 1984].

    ``K = rate P^T L P`` with the metric ``L A = (rho A + A rho) / 2`` and P the projector, orthogonal for L, off the
    energy, the trace and what else is preserved. An eigenvalue of rho that is zero stays zero: so a state keeps its
    rank, and a pure state moves by the Hamiltonian alone. For such states take ``lt.VonNeumann(floor=...)``, and
    ``lt.MetriplecticMidpoint``: it keeps the rank to rounding, the other methods to their order. A run does not start
    where the Hamiltonian turns the eigenvectors of the eigenvalue zero, as those of most pure states: the error of a
    step would grow there.

    Parameters
    ----------
    rate : float, >= 0
        The rate gamma of the ascent (1 / time).
    preserve : list of matrices, shape (N, N), or of functions from rho, shape (N, N), to a scalar; optional
        Observables ``tr(rho A)`` that are kept, or other functions.
    """

    rate: jax.Array
    functions: tuple[Any, ...]

    def __init__(self, rate=1.0, preserve=()):
        self.rate = checked_rate(rate)
        self.functions = tuple(
            f if callable(f) else Operator(checked_hermitian(f, f"preserve[{i}]")) for i, f in enumerate(preserve)
        )

    @property
    def preserve(self) -> tuple[Energy, ...]:
        return tuple(f for f in self.functions if isinstance(f, Energy))

    def prepared(self, system):
        needed_density(system, "SteepestEntropyAscent")
        return self

    def on_density(self, structure: mf.DensityMatrices) -> SteepestEntropyAscent:
        """What it preserves as functions of states, whose structure is given."""
        made = []
        for i, f in enumerate(self.functions):
            if isinstance(f, Operator):
                if np.shape(f) != (structure.size,) * 2:
                    raise InputError(
                        f"preserve[{i}] has shape {np.shape(f)}, and the Hamiltonian that of {structure.size}"
                    )
                f = Function(_Observable(jnp.asarray(structure.vector(np.asarray(f)))))
            elif not isinstance(f, Energy):
                f = Function(OfMatrix(f, structure))
            made.append(f)
        found = SteepestEntropyAscent(self.rate)
        object.__setattr__(found, "functions", tuple(made))
        return found

    def force(self, system, x, dH, dS, dL):
        structure, n = system.structure, system.body_dim
        rho = structure.matrix(x[:n])

        def raised(alpha):  # the Hermitian part of rho A has both terms
            return structure.vector(rho @ structure.matrix(alpha))

        one = jnp.asarray(np.where(np.arange(n) < structure.size, 1.0, 0.0))
        held = frame((one, dH[:n], *(L[:n] for L in dL)), form=raised)
        force = held.off_images(raised(held.off(dS[:n])))
        return jnp.pad(self.rate * force, (0, system.dim - n))


class _Observable(eqx.Module):
    """``tr(rho A)``, of a state whose first coordinates are those of rho."""

    coordinates: jax.Array

    def __call__(self, x):
        return jnp.dot(self.coordinates, x[: self.coordinates.shape[0]])


def needed_density(system, name: str) -> mf.DensityMatrices:
    """The structure of a system of density matrices."""
    structure = getattr(system, "structure", None)
    if not isinstance(structure, mf.DensityMatrices):
        raise InputError(f"{name} acts on density matrices: use it in an lt.QuantumSystem")
    return structure


def checked_matrix(matrix, what: str) -> np.ndarray:
    """A square complex matrix; that of a ``Qobj`` too, which is read by its ``full()``."""
    full: Callable | None = getattr(matrix, "full", None)
    found = np.asarray(full() if callable(full) else matrix)
    if found.dtype.kind not in "fiuc" or found.ndim != 2 or found.shape[0] != found.shape[1] or not found.size:
        raise InputError(f"{what} is a square matrix of numbers, not an array of {found.dtype}, shape {found.shape}")
    if not np.isfinite(found).all():
        raise InputError(f"{what} is not finite")
    return found.astype(complex)


def checked_hermitian(matrix, what: str) -> np.ndarray:
    """A Hermitian matrix."""
    found = checked_matrix(matrix, what)
    residual, size = float(np.abs(found - adjoint(found)).max()), float(np.abs(found).max())
    if residual > 1e-12 * size:
        raise InputError(
            f"{what} is not Hermitian: it differs from its adjoint by {residual:.3g}; its Hermitian part is "
            "(A + A.conj().T) / 2"
        )
    return (found + adjoint(found)) / 2


def _commutator(a, b):
    return a @ b - b @ a


def _eigenvectors(H: np.ndarray) -> np.ndarray:
    """Those of a matrix that is diagonal are the axes."""
    return np.eye(len(H)) if not (H - np.diag(np.diag(H))).any() else np.linalg.eigh(H)[1]


def _stacked(jumps: tuple[Jump, ...]) -> np.ndarray:
    """The matrices of jumps, real ones where they are."""
    found = np.stack([np.asarray(jump.operator) for jump in jumps])
    return found if found.imag.any() else found.real


def _both(jumps: tuple[Jump, ...]) -> np.ndarray:
    """The matrices of jumps, and then their adjoints."""
    fixed = _stacked(jumps)
    return np.concatenate([fixed, adjoint(fixed)])


@functools.lru_cache(maxsize=64)
def _left(jumps: tuple[Jump, ...]) -> np.ndarray:
    """``V^H V`` of each jump, and then of each adjoint."""
    both = _both(jumps)
    return adjoint(both) @ both


def _jumped(jumps: tuple[Jump, ...], rates, rho) -> jax.Array:
    """``sum rate V rho V^H`` over the jumps and then their adjoints."""
    found = _table(jumps)
    if found is None:
        both = _both(jumps)
        return jnp.sum((rates[:, None, None] * both) @ rho @ adjoint(both), axis=0)
    which, source, factors = found
    return jnp.sum(rho.ravel()[source] * (rates[which] * factors), axis=-1).reshape(rho.shape)


@functools.lru_cache(maxsize=64)
def _table(jumps: tuple[Jump, ...]) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """The numbers of the jumps, the entries of rho and the factors that make up each entry of ``sum V rho V^H``.

    None where products of matrices are shorter, as with a few full matrices.
    """
    both = _both(jumps)
    size = both.shape[-1]
    jump, i, j = np.nonzero(both)
    if np.sum(np.bincount(jump) ** 2) > 2 * both.size * size:
        return None
    one, other = np.nonzero(jump[:, None] == jump)
    target = i[one] * size + i[other]
    order = np.argsort(target, kind="stable")
    one, other, target = one[order], other[order], target[order]
    counts = np.bincount(target, minlength=size**2)
    place = target, np.arange(len(target)) - np.repeat(np.cumsum(counts) - counts, counts)
    which, source = np.zeros((2, size**2, counts.max()), np.uint32)  # no sign: JAX then looks for no negative ones
    factors = np.zeros(which.shape, both.dtype)
    which[place], source[place] = jump[one], j[one] * size + j[other]
    factors[place] = both[jump[one], i[one], j[one]] * both[jump[other], i[other], j[other]].conj()
    return which, source, factors


def _checked_function(rate: Callable, i: int) -> Callable:
    """A rate as a function of omega and T, tried where both are one."""
    what = f"the rate of V[{i}] is a number, or a function of omega and T to a number >= 0"
    try:
        value = rate(1.0, 1.0)
    except TypeError as error:
        raise InputError(f"{what}: {error}") from None
    if np.shape(value) or jnp.result_type(value).kind not in "fiu":
        raise InputError(f"{what}, not to {value!r}")
    if not isinstance(value, jax.core.Tracer) and value < 0.0:
        raise InputError(f"{what}: at omega = 1 and T = 1 it is {float(value):.6g}")
    return rate


def _hermitian(V) -> bool:
    V = np.asarray(V)
    return bool(np.abs(V - adjoint(V)).max() <= 1e-12 * np.abs(V).max())


def _small(residual, H, V) -> bool:
    return bool(np.abs(residual).max() <= EIGEN * np.abs(H).max() * np.abs(V).max())


def _split(operator: Operator, source: int, hamiltonians: Sequence[np.ndarray], frame: np.ndarray) -> list[Jump]:
    """The eigenoperators of ``[H, .]`` that a coupling is the sum of; those of a Hermitian one up to adjoints.

    The Hamiltonians are those in the frame, in which the first one is diagonal.
    """
    V = np.asarray(operator)
    energies, inside = np.diag(hamiltonians[0]).real, adjoint(frame) @ V @ frame
    gaps = energies[None, :] - energies[:, None]
    present = np.abs(inside) > 1e-14 * np.abs(V).max()
    spread = EIGEN * max(float(np.abs(energies).max()), 1e-300)
    frequencies: list[float] = []
    for gap in np.sort(gaps[present]):
        if not frequencies or gap > frequencies[-1] + spread:
            frequencies.append(float(gap))
    own_adjoint, parts = _hermitian(V), []
    for omega in frequencies:
        if own_adjoint and omega < -spread:
            continue
        still = own_adjoint and abs(omega) <= spread
        part = np.where(present & (np.abs(gaps - omega) <= spread), inside, 0.0)
        for other in hamiltonians[1:]:
            turned = _commutator(other, part)
            along = np.vdot(part, turned) / np.vdot(part, part)
            if not _small(turned - along * part, other, part):
                raise InputError(
                    f"the coupling V[{source}] has no parts with [H, V] = -omega V at all times: the eigenvectors of "
                    "the Hamiltonian turn. Jumps are for Hamiltonians whose eigenvalues alone depend on time"
                )
        part = part if omega >= -spread else adjoint(part)  # both act, and a rate is asked at a positive omega
        parts.append(Jump(Operator(part), source, 0.5 if still else 1.0))
    return parts
