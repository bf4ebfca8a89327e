"""Open quantum systems: density matrices with a Hamiltonian, dissipation and heat baths."""

from __future__ import annotations

import inspect
import math
from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import manifolds as mf
from manifolds._arrays import is_traced
from manifolds.matrices.linear import adjoint

from ..dissipation.base import Dissipation, total
from ..dissipation.quantum import SteepestEntropyAscent, ThermalJumps, checked_hermitian, checked_matrix
from ..errors import InputError
from ..functions.density import Expectation, Modulated, VonNeumann
from ..functions.energy import Energy, Linear, Quadratic, Sum, TimeDependent
from ..functions.warmth import Reservoir, Warmth
from ..functions.with_baths import WithBaths
from .base import TIMES, System
from .baths import EntropyOfBaths, HeatBaths, beside_baths
from .kinds import Decided

WITHIN = 1e-12
"""How far a trace may be from one, and an eigenvalue below zero, in a density matrix that is given."""


class QuantumSystem(System):
    """A density matrix with a Hamiltonian, dissipation and heat baths: ``rho' = -i [H, rho] + ...`` (hbar = k_B = 1).

    The energy is ``tr(rho H) + U(y)`` and the entropy ``-tr(rho ln rho) + sum y``, with the entropies y of the baths. A
    state is a row of real numbers: the coordinates of rho (:class:`manifolds.DensityMatrices`) and then y.
    :meth:`state` converts a matrix to a state, and :meth:`density` a state to a matrix.

    Parameters
    ----------
    hamiltonian : array, shape (N, N), function from t to one, or list of terms
        H, Hermitian (energy; hbar = 1, so the unit of time is 1 / energy). It may be a ``Qobj`` of QuTiP. A term is a
        matrix, or a pair of a matrix and a real function of t: ``[H0, (H1, f)]`` is ``H0 + f(t) H1``.
    dissipation : ThermalJumps, SteepestEntropyAscent, or a list of them; optional
        The part of the motion that produces entropy.
    baths : HeatBaths, optional
        The baths with which jumps exchange heat (k_B = 1, so temperatures are energies and entropies dimensionless).
        ``HeatBaths(capacity=np.inf, temperature=T)`` keeps its temperature.
    entropy : VonNeumann, optional
        The entropy of rho (dimensionless, k_B = 1), with a floor for eigenvalues near zero; by default without one.
    parts : sequence of int, optional
        The dimensions of the factors of which this system is the product.
    names : sequence of str, optional
        The names of these factors.
    validate : bool
        Test the axioms at a few random points. They hold by form, whatever matrices are given.

    Raises
    ------
    InputError, AxiomError

    Attributes
    ----------
    structure : manifolds.DensityMatrices

    Examples
    --------
    >>> lower = np.array([[0, 1], [0, 0]])
    >>> bath = lt.HeatBaths(capacity=0.5, temperature=0.2)
    >>> qubit = lt.QuantumSystem(np.diag([0.0, 1.0]), lt.ThermalJumps([(lower, 0.05)]), baths=bath)
    >>> run = lt.integrate(qubit, qubit.state([[0.1, 0.25], [0.25, 0.9]]), (0.0, 10.0), 0.1)
    >>> qubit.density(run.x[-1]).shape, run.audit().passed
    ((2, 2), True)
    """

    structure: mf.DensityMatrices
    parts: tuple[int, ...] = eqx.field(static=True)
    names: tuple[str, ...] = eqx.field(static=True)

    def __init__(
        self,
        hamiltonian,
        dissipation: Dissipation | Sequence[Dissipation] | None = None,
        baths: HeatBaths | None = None,
        entropy: VonNeumann | None = None,
        parts: Sequence[int] | None = None,
        names: Sequence[str] = (),
        validate: bool = False,
    ):
        if not isinstance(baths, HeatBaths | None):
            raise InputError(f"baths are lt.HeatBaths(...), not {type(baths).__name__}")
        size, energy = _energy(hamiltonian)
        self.structure = structure = mf.DensityMatrices(size)
        self.parts, self.names = _checked_parts(parts, names, size)
        entropy = VonNeumann() if entropy is None else entropy
        if not isinstance(entropy, VonNeumann):
            raise InputError(f"the entropy of a density matrix is lt.VonNeumann(...), not {type(entropy).__name__}")
        terms = [_on_density(part, structure) for part in _terms(dissipation)]
        if baths is not None and not any(isinstance(part, ThermalJumps) for part in terms):
            raise InputError("baths exchange heat by lt.ThermalJumps, and there are none: leave out baths=")
        n, m = structure.dim, 0 if baths is None else baths.number
        poisson: mf.PoissonStructure = structure
        whole: Energy = entropy
        if baths is not None:
            self.baths = baths
            poisson, energy = beside_baths(structure, m), WithBaths(energy, baths.energy, n, n + m)
            whole = Sum((entropy.on(range(n)), EntropyOfBaths(m)))
        self._build(poisson, n + m, energy, whole, terms or None, {}, validate)
        if not self.preserved:  # whether an observable is kept by the motion is found out
            self.decided = Decided(frozenset(self.casimirs()), frozenset())

    # -- states -------------------------------------------------------------------------------------------------------

    def state(self, rho, batch: bool = False, entropies=None, mixed: float = 0.0) -> jax.Array:
        """A state from a density matrix, shape (N, N), or a batch of them, shape (..., N, N).

        Parameters
        ----------
        rho : array, shape (..., N, N), or a state already
            Hermitian, positive, of trace one. Or a vector of amplitudes, shape (N,), of a pure state.
        batch : bool
            Whether states that are given as such may be several.
        entropies : array, shape (..., number of baths), optional
            Those of the baths; by default zero.
        mixed : float
            Share of the identity that it is mixed with: a pure state has an infinite gradient of the entropy.

        Raises
        ------
        InputError
        """
        full = getattr(rho, "full", None)
        rho = full() if callable(full) else rho
        if isinstance(rho, jax.core.Tracer) or (np.shape(rho)[-1:] == (self.dim,) and not self._is_matrix(rho, batch)):
            return super().state(rho, batch)
        matrices = self._checked(np.asarray(rho), mixed)
        front, m = matrices.shape[:-2], self.dim - self.body_dim
        y = np.zeros((*front, m)) if entropies is None else np.asarray(entropies, dtype=np.float64)
        if y.shape[-1:] != (m,):
            raise InputError(f"the entropies of {m} baths have shape (..., {m}), not {y.shape}")
        x = np.asarray(self.structure.vector(matrices))
        return jnp.asarray(np.concatenate([x, np.broadcast_to(y, (*front, m))], axis=-1))

    def numbers(self, x, batch: bool = False):
        """What :meth:`state` makes of x; a density matrix stands for the state with every bath at entropy zero."""
        if not isinstance(x, jax.core.Tracer) and self._is_matrix(x, batch):
            x = np.asarray(self.state(x))
        return super().numbers(x, batch)

    def _is_matrix(self, x, batch: bool) -> bool:
        """Whether it is one density matrix or, with ``batch``, several; of one level a row of states looks like one."""
        size = self.structure.size
        return np.shape(x)[-2:] == (size, size) and (size > 1 or not batch)

    def density(self, x) -> jax.Array:
        """The density matrices of states, shape (..., n) to (..., N, N)."""
        x = jnp.asarray(x)
        if x.shape[-1:] not in ((self.dim,), (self.body_dim,)):
            raise InputError(f"a state of this system has shape (..., {self.dim}), not {x.shape}")
        return self.structure.matrix(x[..., : self.body_dim])

    def reduced(self, x, part: int | str) -> jax.Array:
        """The density matrix of one part of a product, the others traced out, shape (..., N_k, N_k).

        Parameters
        ----------
        x : array, shape (..., n)
        part : int or str
            Its number, from 0, or its name.
        """
        k = self.names.index(part) if part in self.names else part
        if isinstance(k, bool) or not isinstance(k, int) or not 0 <= k < len(self.parts):
            raise InputError(
                f"the parts are 0 to {len(self.parts) - 1}, or {self.names or 'without names'}, not {part!r}"
            )
        before, own = math.prod(self.parts[:k]), self.parts[k]
        rho = self.density(x)
        after = self.structure.size // (before * own)
        split = rho.reshape(*rho.shape[:-2], before, own, after, before, own, after)
        return jnp.einsum("...iajibj->...ab", split)

    def expectation(self, x, observable) -> jax.Array:
        """``tr(rho A)`` of states, shape (..., n) to (...), for an observable A, Hermitian, shape (N, N)."""
        observable = checked_hermitian(observable, "the observable")
        if observable.shape != (self.structure.size,) * 2:
            raise InputError(
                f"the observable has shape {observable.shape}, and the state that of {self.structure.size}"
            )
        return jnp.asarray(x)[..., : self.body_dim] @ self.structure.vector(observable)

    def bloch(self, x, part: int | str = 0) -> jax.Array:
        """The Bloch vector ``tr(rho sigma)`` of a qubit, shape (..., n) to (..., 3).

        Parameters
        ----------
        x : array, shape (..., n)
        part : int or str
            The qubit, in a product of systems.
        """
        rho = self.reduced(x, part)
        if rho.shape[-1] != 2:
            raise InputError(f"a Bloch vector belongs to a qubit, and part {part!r} has {rho.shape[-1]} levels")
        off = rho[..., 0, 1]
        return jnp.stack([2.0 * off.real, -2.0 * off.imag, (rho[..., 0, 0] - rho[..., 1, 1]).real], axis=-1)

    def _checked(self, rho: np.ndarray, mixed: float) -> np.ndarray:
        size = self.structure.size
        if rho.shape == (size,):
            norm = np.vdot(rho, rho).real
            rho = np.outer(rho, rho.conj()) / (norm if abs(norm - 1.0) <= WITHIN else 1.0)
        if rho.shape[-2:] != (size, size) or rho.dtype.kind not in "fiuc":
            raise InputError(f"a density matrix of this system has shape ({size}, {size}), not {rho.shape}")
        if not np.isfinite(rho).all():
            raise InputError("the density matrix is not finite")
        asymmetry = float(np.abs(rho - adjoint(rho)).max())
        if asymmetry > WITHIN:
            raise InputError(f"the density matrix is not Hermitian: it differs from its adjoint by {asymmetry:.3g}")
        trace = np.trace(rho, axis1=-2, axis2=-1).real
        worst = float(trace.ravel()[np.argmax(np.abs(trace - 1.0))])
        if abs(worst - 1.0) > WITHIN:
            raise InputError(f"the density matrix has the trace {worst:.15g}, not 1: divide it by that")
        least = float(np.linalg.eigvalsh(rho)[..., 0].min())
        if least < -WITHIN:
            raise InputError(f"the density matrix is not positive: its least eigenvalue is {least:.3g}")
        if not isinstance(mixed, int | float | np.number) or not 0.0 <= mixed <= 1.0:
            raise InputError(f"mixed is a share of the identity, from 0 to 1, not {mixed!r}")
        return (1.0 - mixed) * rho + mixed * np.eye(size) / size

    def samples(self, count: int, seed: int = 0, scale: float = 1.0) -> np.ndarray:
        """Random states, ``count`` of them: density matrices by Ginibre's ensemble, and entropies of baths."""
        rng, size = np.random.default_rng(seed), self.structure.size
        root = rng.standard_normal((count, size, size, 2)) @ np.array([1.0, 1.0j])
        rho = root @ adjoint(root)
        rho = rho / np.trace(rho, axis1=-2, axis2=-1)[:, None, None]
        x = np.asarray(self.structure.vector(rho))
        if self.baths is None:
            return x
        return np.concatenate([x, rng.standard_normal((count, self.baths.number)) * self.baths.scale], axis=-1)

    def outside(self, x) -> str:
        if is_traced(self):
            return ""
        rho = np.asarray(self.structure.matrix(np.atleast_2d(x)[:, : self.body_dim]))
        traces = np.trace(rho, axis1=-2, axis2=-1).real
        trace = traces[np.abs(traces - 1.0).argmax()]
        if not abs(trace - 1.0) <= 1e-9:
            return f"the trace of its density matrix is {trace:.12g}, not 1"
        p = np.linalg.eigvalsh(rho)
        least = p[:, 0].min()
        if least < -max(self._floor, 0.0):
            return (
                f"its density matrix has the eigenvalue {least:.3g}, outside the cone of positive matrices: a shorter "
                "step stays inside"
            )
        if least <= 0.0 and self._floor == 0.0:
            return (
                f"its density matrix has the eigenvalue {least:.3g}, where the gradient of the entropy is infinite: "
                "mix it, as in q.state(rho, mixed=1e-6), or with steepest ascent, which keeps the rank, give the "
                "system entropy=lt.VonNeumann(floor=1e-12)"
            )
        if not self._has(SteepestEntropyAscent) or not (p <= self._floor).any():
            return ""
        p, vectors = np.linalg.eigh(rho)
        gone = p <= self._floor
        kernel, inside = (((vectors * some[:, None]) @ adjoint(vectors)) for some in (gone, ~gone))
        if any(np.abs(kernel @ H @ inside).max() > WITHIN for H in self.hamiltonians()):
            return (
                "eigenvalues of its density matrix are zero, and the Hamiltonian turns their eigenvectors: the ends of "
                "steps have others, by the error of a step, which steepest ascent lets grow: mix it, as in "
                "q.state(rho, mixed=1e-6)"
            )
        return ""

    def singular(self, x) -> str:
        if is_traced(self) or not self._has(ThermalJumps):
            return ""
        least = np.linalg.eigvalsh(self.structure.matrix(np.atleast_2d(x)[:, : self.body_dim]))[:, 0].min()
        if least > self._floor:
            return ""
        return (
            f"its density matrix has the eigenvalue {least:.3g}, which jumps make larger, and the gradient of the "
            "entropy is infinite there: take lt.MetriplecticRungeKutta, whose stages are without it, or mix the state, "
            "as in q.state(rho, mixed=1e-6)"
        )

    @property
    def _floor(self) -> float:
        entropy = self.entropy.terms[0]  # type: ignore[union-attr]
        return getattr(entropy, "floor", getattr(getattr(entropy, "energy", None), "floor", 0.0))

    def _has(self, kind: type[Dissipation]) -> bool:
        return self.dissipation is not None and any(isinstance(part, kind) for part in self.dissipation.terms)

    spectral = True

    # -- laws ---------------------------------------------------------------------------------------------------------

    def hamiltonians(self) -> list[np.ndarray]:
        """The Hamiltonian, at a few times where it depends on one."""
        n, energies = self.body_dim, [s.energy for s in (self.at_some_times() if self.is_driven else [self])]
        energies = [E.body if isinstance(E, WithBaths) else E for E in energies]  # temperatures may be traced
        with jax.ensure_compile_time_eval():
            return [np.asarray(self.structure.matrix(E.gradient(jnp.zeros(n)))) for E in energies]

    def casimirs(self) -> dict[str, Energy]:
        """The trace, and of a system without dissipation the purity: what relaxes keeps none but the trace."""
        n = self.body_dim
        trace = Quadratic(np.zeros(n), np.where(np.arange(n) < self.structure.size, 1.0, 0.0))
        if self.dissipation is None:
            return {"tr(rho)": trace, "tr(rho^2)": Quadratic(np.full(n, 2.0))}
        return {"tr(rho)": trace if self.baths is None else trace.on(range(n))}

    # -- products -----------------------------------------------------------------------------------------------------

    def __mul__(self, other: QuantumSystem) -> QuantumSystem:
        """Two systems beside each other, each with its jumps and baths: see :meth:`coupled`."""
        if not isinstance(other, QuantumSystem):
            return NotImplemented
        systems, offset, terms = (self, other), 0, []
        sizes = [s.structure.size for s in systems]
        for k, s in enumerate(systems):
            for part in () if s.dissipation is None else s.dissipation.terms:
                if not isinstance(part, ThermalJumps):
                    raise InputError(
                        f"{type(part).__name__} of a part is none of a product: give it to the product as a whole"
                    )
                local = [_beside(np.asarray(V), k, sizes) for V in part.operators]
                terms.append(part.with_operators(local, part.bath + offset))
            offset += 0 if s.baths is None else s.baths.number
        if (self.baths is None) != (other.baths is None) and all(s.dissipation is not None for s in systems):
            raise InputError("jumps of one part have a bath and those of the other none: give both, or neither, baths")
        H = [s._constant_hamiltonian() for s in systems]
        whole = _beside(H[0], 0, sizes) + _beside(H[1], 1, sizes)
        parts = self.parts + other.parts
        names = self.names + other.names if len(self.names + other.names) == len(parts) else ()
        names = names if len(set(names)) == len(names) else ()
        baths, floor = _joined(self.baths, other.baths), max(self._floor, other._floor)
        return QuantumSystem(whole, terms or None, baths, VonNeumann(floor), parts, names)

    def coupled(self, interaction) -> QuantumSystem:
        """The system with ``H + interaction``, a Hermitian matrix, shape (N, N); the couplings are split anew."""
        interaction = checked_hermitian(interaction, "the interaction")
        if interaction.shape != (self.structure.size,) * 2:
            raise InputError(
                f"the interaction has shape {interaction.shape}, and the Hamiltonian ({self.structure.size}, "
                f"{self.structure.size})"
            )
        terms = () if self.dissipation is None else self.dissipation.terms
        H = self._constant_hamiltonian() + interaction
        return QuantumSystem(H, list(terms) or None, self.baths, VonNeumann(self._floor), self.parts, self.names)

    def _constant_hamiltonian(self) -> np.ndarray:
        if self.is_driven:
            raise InputError("products and couplings are of systems whose Hamiltonian does not depend on time")
        return self.hamiltonians()[0]


def _energy(hamiltonian) -> tuple[int, Energy]:
    """The size of a Hamiltonian, and ``tr(rho H)`` of coordinates."""
    if isinstance(hamiltonian, list | tuple) and any(map(_is_term, hamiltonian)):
        return _sum_of_terms(hamiltonian)
    if callable(hamiltonian) and not callable(getattr(hamiltonian, "full", None)):
        for t in TIMES:
            found = checked_hermitian(_at(hamiltonian, t, "the Hamiltonian"), f"the Hamiltonian at t = {t:.3g}")
        structure = mf.DensityMatrices(len(found))
        return len(found), TimeDependent(Expectation(hamiltonian, structure))
    if isinstance(hamiltonian, jax.core.Tracer):
        structure = mf.DensityMatrices(hamiltonian.shape[-1])
        return structure.size, Linear(structure.vector(hamiltonian))
    H = checked_hermitian(checked_matrix(hamiltonian, "the Hamiltonian"), "the Hamiltonian")
    with jax.ensure_compile_time_eval():  # numbers, while a family of systems is traced
        return len(H), Linear(jnp.asarray(mf.DensityMatrices(len(H)).vector(H)))


def _at(function, t: float, what: str):
    """What a function gives at a time; refused where it is none of one argument."""
    try:
        inspect.signature(function).bind(t)
    except TypeError as error:
        raise InputError(f"{what}, where it is a function, is one of the time t alone: {error}") from None
    except ValueError:  # it does not tell
        pass
    return function(t)


def _is_term(part) -> bool:
    """Whether it is a matrix, or begins with one, and not a row of numbers."""
    if isinstance(part, list | tuple):
        return bool(part) and (isinstance(part[0], list | tuple) or _is_term(part[0]))
    return hasattr(part, "full") or np.ndim(part) == 2


def _sum_of_terms(given: Sequence) -> tuple[int, Energy]:
    """The same for ``[H0, (H1, f), ...]``."""
    constant: list[np.ndarray] = []
    moved: list[np.ndarray] = []
    functions = []
    for i, part in enumerate(given):
        pair = isinstance(part, list | tuple) and len(part) == 2 and callable(part[1])
        H, f = part if pair else (part, None)
        if isinstance(H, list | tuple) and H and _is_term(H[0]):
            raise InputError(f"term {i} of the Hamiltonian is a matrix, or a pair of a matrix and a function of t")
        H = checked_hermitian(H, f"term {i} of the Hamiltonian")
        if H.shape != (first := (constant + moved + [H])[0]).shape:
            raise InputError(f"term {i} of the Hamiltonian has shape {H.shape}, and another one {first.shape}")
        if f is None:
            constant.append(H)
            continue
        value = _at(f, TIMES[0], f"the second of term {i} of the Hamiltonian")
        if np.shape(value) or jnp.result_type(value).kind not in "fiu":
            raise InputError(f"the function of term {i} of the Hamiltonian gives a real number, not {value!r}")
        moved.append(H)
        functions.append(f)
    structure = mf.DensityMatrices(len(H))
    with jax.ensure_compile_time_eval():  # numbers, while a family of systems is traced
        still, *rows = (jnp.asarray(structure.vector(a)) for a in (sum(constant, np.zeros_like(H)), *moved))
    energy = TimeDependent(Modulated(still, tuple(rows), tuple(functions))) if moved else Linear(still)
    return structure.size, energy


def _terms(dissipation) -> tuple[Dissipation, ...]:
    found = total(dissipation)
    terms = () if found is None else found.terms
    for part in terms:
        if not isinstance(part, ThermalJumps | SteepestEntropyAscent):
            raise InputError(
                f"the dissipation of density matrices is lt.ThermalJumps or lt.SteepestEntropyAscent, not "
                f"{type(part).__name__}"
            )
    return terms


def _on_density(part: Dissipation, structure: mf.DensityMatrices) -> Dissipation:
    return part.on_density(structure) if isinstance(part, SteepestEntropyAscent) else part


def _checked_parts(parts, names, size: int) -> tuple[tuple[int, ...], tuple[str, ...]]:
    parts = (size,) if parts is None else tuple(int(n) for n in parts)
    if math.prod(parts) != size or min(parts) < 1:
        raise InputError(f"the parts have the sizes {parts}, whose product is not {size}")
    names = tuple(names)
    if names and (len(names) != len(parts) or len(set(names)) != len(names)):
        raise InputError(f"there are {len(parts)} parts, each with a name of its own, not {names!r}")
    return parts, names


def _beside(matrix: np.ndarray, k: int, sizes: Sequence[int]) -> np.ndarray:
    """An operator of one of two systems as one of both."""
    return np.kron(matrix, np.eye(sizes[1])) if k == 0 else np.kron(np.eye(sizes[0]), matrix)


def _joined(one: HeatBaths | None, other: HeatBaths | None) -> HeatBaths | None:
    if one is None or other is None:
        return one or other
    kinds = Warmth | Reservoir
    if not isinstance(one.energy, kinds) or not isinstance(other.energy, kinds):
        raise InputError("baths of a product have constant capacities: build the product with baths of its own")
    capacity, temperature = (
        jnp.concatenate([getattr(one.energy, name), getattr(other.energy, name)])
        for name in ("capacity", "temperature")
    )
    return HeatBaths(capacity, temperature, one.number + other.number)
