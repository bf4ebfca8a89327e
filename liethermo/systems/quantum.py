"""Open quantum systems: density matrices with a Hamiltonian, dissipation and heat baths."""

from __future__ import annotations

import math
from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import manifolds as mf
from manifolds._arrays import is_traced
from manifolds._pytree_module import replace_fields
from manifolds.matrices.linear import adjoint

from ..dissipation.adiabatic import ADIABATIC_LIMIT, AdiabaticJumps, adiabatic_parameter
from ..dissipation.base import Dissipation, dissipation_terms
from ..dissipation.lindblad import LindbladJumps
from ..dissipation.operators import HasMatrix, checked_hermitian, level_gap_rounding_bound
from ..dissipation.quantum import ThermalJumps
from ..dissipation.steepest_ascent import SteepestEntropyAscent
from ..errors import InputError
from ..functions.bath_energy import BodyBathsEnergy
from ..functions.density import (
    NEGATIVE_EIGENVALUE_LIMIT,
    IsolatedVonNeumann,
    MeanEnergy,
    VonNeumann,
)
from ..functions.energy import Energy, Quadratic, Sum
from ..functions.gradients import EPS
from .base import System
from .baths import BathEntropy, HeatBaths, checked_baths, poisson_with_baths
from .conditions import RunCondition
from .domain import Domain
from .equilibria import Equilibrium, steady_state
from .hamiltonian import (
    checked_density_matrices,
    checked_factor_dims_and_names,
    join_baths,
    make_hamiltonian_energy,
    tensor_with_identity,
)
from .interface import EngineHints, InvariantVerdicts
from .invariants import systems_at_test_times
from .states import checked_times
from .transport import has_generator

LINDBLAD_EIGENVALUE_LIMIT = 1e-6
"""Largest modulus of a negative eigenvalue under Lindblad's equation alone, whose steps have errors of their order. The
equation is linear, so that a small negative eigenvalue does no harm; a larger one is an error that a user would see."""

ZERO_EIGENVALUE_PER_LEVEL = 8.0 * EPS
"""Largest eigenvalue of a density matrix that is zero to rounding, divided by the number of levels."""


POSITIVITY_ROW = "least eigenvalue of rho"
"""Name of the row of an audit that shows whether density matrices are positive."""

ADIABATIC_ROW = "adiabatic parameter"
"""Name of the row of an audit that judges whether a drive is slow beside the level distances."""


class QuantumSystem(System):
    """A density matrix with Hamiltonian, dissipation and heat baths, ``rho' = -i [H, rho] + ...`` (hbar = k_B = 1).

    The energy is ``tr(rho H) + U(y)`` and the entropy ``-tr(rho ln rho) + sum y``, with the entropies y of the baths. A
    state is a row of real numbers: the coordinates of rho (:class:`manifolds.DensityMatrices`) and then y.
    :meth:`state` converts a matrix to a state, and :meth:`density` a state to a matrix.

    Parameters
    ----------
    hamiltonian : array, shape (N, N), function from t to one, or list of terms
        H, Hermitian (energy; hbar = 1, so the unit of time is 1 / energy). It may be a ``Qobj`` of QuTiP. A term is a
        matrix, or a pair of a matrix and a real function of t, or of its values at ``times``: ``[H0, [H1, f]]`` is
        ``H0 + f(t) H1``, as in QuTiP. A string is not evaluated.
    dissipation : ThermalJumps, SteepestEntropyAscent, LindbladJumps, or a list of them; optional
        The part of the motion that produces entropy, or Lindblad's equation without such a promise.
    baths : HeatBaths, optional
        The baths with which jumps exchange heat (k_B = 1, so temperatures are energies and entropies dimensionless).
        ``HeatBaths(capacity=np.inf, temperature=T)`` keeps its temperature.
    entropy : VonNeumann, optional
        The entropy of rho (dimensionless, k_B = 1), with a floor for eigenvalues near zero; by default without one.
    parts, names : sequence of int, sequence of str; optional
        The dimensions and the names of the factors of which this system is the product.
    validate : bool
        Test the axioms at a few random points. They hold by form, whatever matrices are given.
    times : array, shape (points,), optional
        Increasing times (1 / energy) of coefficients that are arrays, for a cubic spline. A run must stay within them.

    Raises
    ------
    InputError, AxiomError
        If an argument does not fit, or (with ``validate``) an axiom fails.

    Attributes
    ----------
    structure : manifolds.DensityMatrices
    floor, time : float, and array, shape (), or None
        Eigenvalues of rho up to ``floor`` have no part in the entropy. Rates that depend on time are taken at ``time``.

    Examples
    --------
    >>> lower = np.array([[0, 1], [0, 0]])
    >>> bath = lt.HeatBaths(capacity=0.5, temperature=0.2)
    >>> qubit = lt.QuantumSystem(
    ...     np.diag([0.0, 1.0]), lt.ThermalJumps([(lower, 0.05)]), baths=bath
    ... )
    >>> run = lt.integrate(qubit, qubit.state([[0.1, 0.25], [0.25, 0.9]]), (0.0, 10.0), 0.1)
    >>> qubit.density(run.x[-1]).shape, run.audit().passed
    ((2, 2), True)
    """

    structure: mf.DensityMatrices
    parts: tuple[int, ...] = eqx.field(static=True)
    names: tuple[str, ...] = eqx.field(static=True)
    floor: float = eqx.field(static=True)
    time: jax.Array | None

    def __init__(
        self,
        hamiltonian,
        dissipation: Dissipation | Sequence[Dissipation] | None = None,
        baths: HeatBaths | None = None,
        entropy: VonNeumann | None = None,
        parts: Sequence[int] | None = None,
        names: Sequence[str] = (),
        validate: bool = False,
        times=None,
    ):
        baths = checked_baths(baths)
        self.time = None
        size, energy = make_hamiltonian_energy(hamiltonian, times)
        self.structure = structure = mf.DensityMatrices(size)
        self.parts, self.names = checked_factor_dims_and_names(parts, names, size)
        entropy = VonNeumann() if entropy is None else entropy
        if not isinstance(entropy, VonNeumann):
            raise InputError(
                f"the entropy of a density matrix must be lt.VonNeumann(...), got {type(entropy).__name__}"
            )
        self.floor = entropy.floor
        terms = _checked_quantum_dissipations(dissipation)
        if all(isinstance(term, LindbladJumps) for term in terms):
            entropy = IsolatedVonNeumann(self.floor)  # the motion does not depend on it
        terms = tuple(_bind_to_density(term, structure) for term in terms)
        if baths.number and not any(isinstance(term, ThermalJumps) for term in terms):
            raise InputError(
                "baths= needs lt.ThermalJumps, which exchange heat with the baths. Add them, or remove baths="
            )
        n, m = structure.dim, baths.number
        poisson: mf.PoissonStructure = structure
        total_entropy: Energy = entropy
        if baths.number:
            self.baths = baths
            poisson, energy = poisson_with_baths(structure, m), BodyBathsEnergy(energy, baths.energy, n, n + m)
            total_entropy = Sum((entropy.on(range(n)), BathEntropy(m)))
        self._build(poisson, n + m, energy, total_entropy, terms or None, {}, validate)
        if not self.preserved_functions:  # preserved observables are tested instead
            self.invariant_verdicts = InvariantVerdicts(frozenset(self.casimirs()), frozenset())

    # -- time ---------------------------------------------------------------------------------------------------------

    @property
    def is_driven(self) -> bool:
        """True if the Hamiltonian, a rate or a jump operator depends on time."""
        return super().is_driven or (self.time is None and self.total_dissipation.depends_on_time)

    def at_time(self, t, attitude=None) -> QuantumSystem:
        """Return the system with its Hamiltonian and its rates frozen at the time t; the attitude is ignored."""
        if not self.is_driven:
            return self
        return replace_fields(super().at_time(t), time=jnp.asarray(t, dtype=jnp.float64))

    def _trace_dissipation(self, dissipation: Dissipation) -> Dissipation:
        frozen = replace_fields(self, time=jnp.zeros(()))  # rates are functions of time, which no state contains
        return super(QuantumSystem, frozen)._trace_dissipation(dissipation)

    # -- states -------------------------------------------------------------------------------------------------------

    def state(self, rho, batch: bool = False, entropies=None, mixed: float = 0.0) -> jax.Array:
        """Return the state, shape (..., n), of density matrices, shape (..., N, N), or of pure states.

        InputError if rho is no density matrix, or the shape of the entropies does not fit.

        Parameters
        ----------
        rho : array, shape (..., N, N), or a state already
            Hermitian, positive, of trace one. Or the amplitudes of a pure state, shape (N,) or (..., N, 1). A ``Qobj``
            of QuTiP may be a ket, a bra, an operator, or a stacked operator or its adjoint.
        batch, entropies : bool, and array, shape (..., number of baths); optional
            Whether an array of real states may have leading axes; the entropies of the baths, by default zero.
        mixed : float
            Share of the identity that it is mixed with: a pure state has an infinite gradient of the entropy.
        """
        rho = self._array_of_qobj(rho)
        if isinstance(rho, jax.core.Tracer) or (
            np.shape(rho)[-1:] == (self.dim,) and not self._has_shape_of_density_matrix(rho, batch)
        ):
            return super().state(rho, batch)
        matrices = checked_density_matrices(np.asarray(rho), self.structure.size, mixed)
        front, m = matrices.shape[:-2], self.dim - self.body_dim
        y = np.zeros((*front, m)) if entropies is None else np.asarray(entropies, dtype=np.float64)
        if y.shape[-1:] != (m,):
            raise InputError(f"the entropies of {m} baths must have shape (..., {m}), got {y.shape}")
        x = np.asarray(self.structure.vector(matrices))
        return jnp.asarray(np.concatenate([x, np.broadcast_to(y, (*front, m))], axis=-1))

    def state_array(self, x, batch: bool = False):
        """Return the state x, checked; a matrix or a ket becomes the state with all bath entropies zero."""
        x = self._array_of_qobj(x)
        if not isinstance(x, jax.core.Tracer) and (
            self._has_shape_of_density_matrix(x, batch) or self._has_shape_of_ket_or_stacked_operator(x)
        ):
            x = np.asarray(self.state(x))
        return super().state_array(x, batch)

    def _array_of_qobj(self, x):
        """Return the array of a ``Qobj``, with a stacked bra turned into a stacked operator; other x unchanged."""
        if not isinstance(x, HasMatrix):
            return x
        array = np.asarray(x.full())  # an array of shape (1, N^2) that is no Qobj is a batch of one state
        return adjoint(array) if array.shape == (1, self.structure.size**2) and self.structure.size > 1 else array

    def _has_shape_of_ket_or_stacked_operator(self, x) -> bool:
        """Return whether x has the shape of a ket, a bra or a stacked operator; False for one level."""
        size = self.structure.size
        return size > 1 and np.shape(x) in ((size,), (size, 1), (1, size), (size**2, 1))

    def _has_shape_of_density_matrix(self, x, batch: bool) -> bool:
        """Return whether x has the shape of a density matrix, or with ``batch`` of several."""
        size = self.structure.size
        return np.shape(x)[-2:] == (size, size) and (size > 1 or not batch)

    def density(self, x) -> jax.Array:
        """Return the density matrices, shape (..., N, N), of states, shape (..., n)."""
        x = jnp.asarray(x)
        if x.shape[-1:] not in ((self.dim,), (self.body_dim,)):
            raise InputError(f"a state of this system must have shape (..., {self.dim}), got {x.shape}")
        return self.structure.matrix(x[..., : self.body_dim])

    def reduced(self, x, part: int | str) -> jax.Array:
        """Return the reduced density matrix of one factor of a product, shape (..., N_k, N_k): a partial trace.

        Parameters
        ----------
        x : array, shape (..., n)
        part : int or str
            Its number, from 0, or its name.
        """
        k = self.names.index(part) if part in self.names else part
        if isinstance(k, bool) or not isinstance(k, int) or not 0 <= k < len(self.parts):
            raise InputError(
                f"part must be 0 to {len(self.parts) - 1}, or one of the names {self.names or '()'}, got {part!r}"
            )
        n_before, n_part = math.prod(self.parts[:k]), self.parts[k]
        rho = self.density(x)
        n_after = self.structure.size // (n_before * n_part)
        tensor = rho.reshape(*rho.shape[:-2], n_before, n_part, n_after, n_before, n_part, n_after)
        return jnp.einsum("...iajibj->...ab", tensor)

    def expectation(self, x, observable) -> jax.Array:
        """Return the expectation value ``tr(rho A)``, shape (...), of a Hermitian observable A in states x."""
        observable = checked_hermitian(observable, "the observable")
        if observable.shape != (self.structure.size,) * 2:
            raise InputError(f"the observable must have shape {(self.structure.size,) * 2}, got {observable.shape}")
        return jnp.asarray(x)[..., : self.body_dim] @ self.structure.vector(observable)

    def bloch(self, x, part: int | str = 0) -> jax.Array:
        """Return the Bloch vector ``tr(rho sigma)`` of a qubit, shape (..., 3), in states x.

        Parameters
        ----------
        x : array, shape (..., n)
        part : int or str
            The qubit, in a product of systems.
        """
        rho = self.reduced(x, part)
        if rho.shape[-1] != 2:
            raise InputError(f"a Bloch vector needs a qubit, but part {part!r} has {rho.shape[-1]} levels")
        coherence = rho[..., 0, 1]
        return jnp.stack([2.0 * coherence.real, -2.0 * coherence.imag, (rho[..., 0, 0] - rho[..., 1, 1]).real], axis=-1)

    def samples(self, count: int, seed: int = 0, scale: float = 1.0) -> np.ndarray:
        """Return random states, shape (count, n): density matrices of Ginibre's ensemble, and bath entropies."""
        rng, size = np.random.default_rng(seed), self.structure.size
        root = rng.standard_normal((count, size, size, 2)) @ np.array([1.0, 1.0j])
        rho = root @ adjoint(root)
        rho = rho / np.trace(rho, axis1=-2, axis2=-1)[:, None, None]
        x = np.asarray(self.structure.vector(rho))
        return np.concatenate(
            [x, rng.standard_normal((count, self.baths.number)) * self.baths.constant_entropy_scales], axis=-1
        )

    def steady_state_guess(self) -> np.ndarray:
        """Return the completely mixed state with all bath entropies zero, shape (n,)."""
        return np.asarray(self.state(np.eye(self.structure.size) / self.structure.size))

    @property
    def domain(self) -> Domain:
        return Domain(
            why_outside=self._why_outside_domain, why_entropy_gradient_infinite=self._why_entropy_gradient_infinite
        )

    def _why_outside_domain(self, x) -> str:
        """Return why states are outside of the cone of density matrices, as a text; "" if all are inside."""
        if is_traced(self):
            return ""
        rho = self._density_matrices(x)
        traces = np.trace(rho, axis1=-2, axis2=-1).real
        trace = traces[np.abs(traces - 1.0).argmax()]
        if not abs(trace - 1.0) <= 1e-9:
            return f"the trace of its density matrix is {trace:.12g}, not 1"
        min_eigenvalue = np.linalg.eigvalsh(rho)[:, 0].min()
        needs_logarithm = self._has_dissipation(ThermalJumps) or self._has_dissipation(SteepestEntropyAscent)
        limit = max(self.floor, NEGATIVE_EIGENVALUE_LIMIT if needs_logarithm else LINDBLAD_EIGENVALUE_LIMIT)
        if self.total_dissipation.terms and min_eigenvalue < -limit:
            return (
                f"its density matrix has the eigenvalue {min_eigenvalue:.3g}, outside the cone of positive matrices: "
                "a shorter step stays inside"
            )
        return self._why_rank_grows(np.atleast_2d(x), rho) if self._has_dissipation(SteepestEntropyAscent) else ""

    def run_conditions(self, x, t, guarantees):
        rho = self._density_matrices(x)
        min_eigenvalue = float(np.linalg.eigvalsh(rho)[:, 0].min())
        conditions = []
        if self._has_dissipation(LindbladJumps):
            note = "the method keeps the density matrix positive only to the error of its steps"
            row = RunCondition(POSITIVITY_ROW, min_eigenvalue, note=note, is_minimum=True)
            if "positivity" in guarantees:
                limit = -NEGATIVE_EIGENVALUE_LIMIT
                row = RunCondition(POSITIVITY_ROW, min_eigenvalue, limit, min_eigenvalue >= limit, is_minimum=True)
            conditions.append(row)
        if self._has_dissipation(AdiabaticJumps):
            parameter = float(np.max(np.asarray(self.adiabatic_parameter(np.unique(t)))))
            is_slow = parameter <= ADIABATIC_LIMIT
            note = "" if is_slow else "the drive is too fast for jumps between instantaneous levels"
            conditions.append(RunCondition(ADIABATIC_ROW, parameter, ADIABATIC_LIMIT, is_slow, note, True))
        return tuple(conditions)

    def _why_rank_grows(self, x: np.ndarray, rho: np.ndarray) -> str:
        """Return why zero eigenvalues would not stay zero under steepest ascent, as a text; "" if they stay zero."""
        kernels = self._kernel_bases(rho)
        rank_deficient = [i for i, kernel in enumerate(kernels) if kernel.size]
        is_rotated = [self._is_kernel_rotated(rho[i], kernels[i]) for i in rank_deficient]
        mix = "Use system.state(rho, mixed=1e-6)"
        if self.floor > 0.0:
            text = (
                "its density matrix has zero eigenvalues whose eigenvectors the Hamiltonian turns, so steepest ascent "
            )
            text += f"would amplify the error of a step. {mix}"
            return text if any(is_rotated) else ""
        grows = [self._equilibrium_population(x[i], kernels[i]) > self._zero_eigenvalue_limit for i in rank_deficient]
        if not any(grows):
            return ""
        growing_index = grows.index(True)
        eigenvalue = np.linalg.eigvalsh(rho[rank_deficient[growing_index]])[0]
        floor = ", or give the system entropy=lt.VonNeumann(floor=1e-12), which keeps this eigenvalue at zero"
        return (
            f"its density matrix has the eigenvalue {eigenvalue:.3g}, where the gradient of the entropy is infinite. "
            f"{mix}{'' if is_rotated[growing_index] else floor}"
        )

    def _is_kernel_rotated(self, rho: np.ndarray, kernel: np.ndarray) -> bool:
        """Return whether the Hamiltonian moves a kernel of rho, shape (N, r), by more than its rounding error."""
        complement = np.eye(len(rho)) - kernel @ adjoint(kernel)
        p = np.linalg.eigvalsh(rho)
        smallest_positive = p[p > self._zero_eigenvalue_limit].min()
        return any(
            np.abs(complement @ H @ kernel).max() > level_gap_rounding_bound(H) / smallest_positive
            for H in self.hamiltonians_at_test_times()
        )

    def _equilibrium_population(self, x: np.ndarray, kernel: np.ndarray) -> float:
        """Return an estimate of the largest population in a kernel, shape (N, r), at the end of steepest ascent.

        At the end ``-ln rho - 1`` is a combination of the preserved gradients, which is fitted outside the kernel.
        """
        ascent = next(term for term in self.total_dissipation.terms if isinstance(term, SteepestEntropyAscent))
        dS = VonNeumann(self._zero_eigenvalue_limit).gradient(x[: self.body_dim])
        dL = tuple(L.gradient(x) for L in ascent.preserve)
        affinity = np.asarray(self.structure.matrix(ascent.ascent_direction(self, x, self.energy.gradient(x), dS, dL)))
        return float(np.exp(np.linalg.eigvalsh(adjoint(kernel) @ affinity @ kernel)[-1] - 1.0))

    def _why_entropy_gradient_infinite(self, x) -> str:
        """Return why the gradient of the entropy is infinite at states, as a text; "" if it is finite."""
        if is_traced(self) or not self._has_dissipation(ThermalJumps):
            return ""
        x, rho = np.atleast_2d(x), self._density_matrices(x)
        kernels = self._kernel_bases(rho)
        rank_deficient = [i for i, kernel in enumerate(kernels) if kernel.size]
        if not rank_deficient:
            return ""
        fill_rates, rate_scales = self._kernel_fill_rates_and_scales(
            x[rank_deficient], [kernels[i] for i in rank_deficient]
        )
        # larger than the rounding of a population at rest
        grows = np.flatnonzero(fill_rates > self._zero_eigenvalue_limit * rate_scales)
        if not grows.size:
            return ""
        eigenvalue = np.linalg.eigvalsh(rho[rank_deficient[grows[0]]])[0]
        alternative = (
            ", or lt.MetriplecticRungeKutta, which does not evaluate this gradient" if has_generator(self) else ""
        )
        return (
            f"its density matrix has the eigenvalue {eigenvalue:.3g}, where the gradient of the entropy is infinite, "
            f"and jumps move the state off it. Use system.state(rho, mixed=1e-6){alternative}"
        )

    def _kernel_fill_rates_and_scales(self, x: np.ndarray, kernels: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """Return the rates at which jumps populate the kernels of states, and their scales, shapes (m,)."""
        assert self.dissipation is not None
        jumps = [term for term in self.dissipation.terms if isinstance(term, ThermalJumps)]

        def jump_rate(x, rho):  # at the temperatures of x
            y = jnp.concatenate([self.structure.vector(rho), x[self.body_dim :]])
            return sum(jump.generator_field(self, y, self.energy.gradient(x))[: self.body_dim] for jump in jumps)

        projectors = np.stack([kernel @ adjoint(kernel) for kernel in kernels])
        changes, kernel_changes = (
            np.asarray(self.structure.matrix(jax.vmap(jump_rate)(jnp.asarray(x), jnp.asarray(matrices))))
            for matrices in (self._density_matrices(x), projectors)
        )
        pairs = zip(changes, kernels, strict=True)
        fill_rates = np.array([np.linalg.eigvalsh(adjoint(kernel) @ change @ kernel)[-1] for change, kernel in pairs])
        return fill_rates, sum(np.linalg.norm(a, 2, axis=(-2, -1)) for a in (changes, kernel_changes))

    def _density_matrices(self, x) -> np.ndarray:
        """Return the density matrices of one or several states, shape (m, N, N)."""
        return np.asarray(self.structure.matrix(np.atleast_2d(x)[:, : self.body_dim]))

    @property
    def _zero_eigenvalue_limit(self) -> float:
        """Largest eigenvalue of a density matrix that counts as zero, by rounding or by the floor of the entropy."""
        return max(self.floor, ZERO_EIGENVALUE_PER_LEVEL * self.structure.size)

    def _kernel_bases(self, rho: np.ndarray) -> list[np.ndarray]:
        """Return the kernel of each density matrix, shape (m, N, N), as a list of bases, shape (N, r)."""
        return [vectors[:, p <= self._zero_eigenvalue_limit] for p, vectors in zip(*np.linalg.eigh(rho), strict=True)]

    def _has_dissipation(self, kind: type[Dissipation]) -> bool:
        """Return whether the dissipation has a summand of a given class."""
        return any(isinstance(term, kind) for term in self.total_dissipation.terms)

    @property
    def engine_hints(self) -> EngineHints:
        return super().engine_hints._replace(has_matrix_functions=True)

    # -- heat ---------------------------------------------------------------------------------------------------------

    def heat_currents(self, x, t=None) -> jax.Array:
        """Return the heat current from each bath into the system, shape (..., baths) (energy / time).

        It is ``-T y'`` with the temperature T and the entropy y of a bath. At a steady state the currents and the power
        of the drive add up to zero.

        Parameters
        ----------
        x : array, shape (..., n)
        t : float or array, shape (...), optional
            The time, if the Hamiltonian depends on it.
        """
        if not self.baths.number:
            raise InputError("this system has no baths. Give it baths=lt.HeatBaths(...) and lt.ThermalJumps")
        return -self.temperatures(x, t) * self.vector_field(x, t)[..., self.body_dim :]

    def entropy_production(self, x, t=None) -> jax.Array:
        """Return the growth rate of the entropy of system and baths, shape (...), at states x and the time t.

        It is >= 0 under thermal jumps: ``dS/dt - sum (heat current / temperature)``. At a steady state only the baths
        contribute. Under :class:`liethermo.LindbladJumps` it is the rate of the entropy of rho, of either sign.
        """
        return super().entropy_production(x, t)

    def steady_state(self, x0=None, t: float | None = None) -> Equilibrium:
        """Return the steady state that the system approaches from x0: see :func:`liethermo.steady_state`.

        Parameters
        ----------
        x0 : array, shape (n,), or a density matrix, shape (N, N); optional
            By default the completely mixed state.
        t : float, optional
            The time at which a Hamiltonian that depends on time is frozen.
        """
        return steady_state(self, x0, t)

    def power(self, x, t=None) -> jax.Array:
        """Return the power that the drive gives to the system, ``tr(rho dH/dt)``, shape (...) (energy / time).

        Parameters
        ----------
        x : array, shape (..., n)
        t : float or array, shape (...), optional
            The time, if the Hamiltonian depends on it.
        """
        states, times = self.state(x, batch=True), checked_times(self, t)
        if times is None:
            return jnp.zeros(states.shape[:-1])

        def power_at(y, time):
            return jax.jvp(
                lambda s: jnp.dot(self._hamiltonian_coordinates_at(s), y[: self.body_dim]), (time,), (jnp.ones(()),)
            )[1]

        evaluate = jnp.vectorize(power_at, signature="(n),()->()")
        return evaluate(states, times)

    def adiabatic_parameter(self, t) -> jax.Array:
        """Return ``max |<a| dH/dt |b>| / (E_a - E_b)^2`` over pairs of levels, shape (...) (dimensionless).

        Jumps between instantaneous levels (:class:`liethermo.AdiabaticJumps`) are valid where it is much smaller than
        one. Pairs of levels that the drive does not mix do not count.

        Parameters
        ----------
        t : float or array, shape (...)
            Times.
        """
        times = jnp.asarray(t, dtype=jnp.float64)
        if not self.energy.depends_on_time:
            return jnp.zeros(times.shape)
        return jnp.vectorize(lambda s: adiabatic_parameter(self.structure, self._hamiltonian_coordinates_at, s))(times)

    def _hamiltonian_coordinates_at(self, t) -> jax.Array:
        """Return the coordinates of the Hamiltonian at the time t, without a constant, shape (N^2,)."""
        return self.energy.at_time(t).gradient(jnp.zeros(self.dim))[: self.body_dim]

    # -- laws ---------------------------------------------------------------------------------------------------------

    def hamiltonians_at_test_times(self) -> list[np.ndarray]:
        """Return a list of the Hamiltonian, or of its values at the test times if it depends on time."""
        energies = [s.energy for s in (systems_at_test_times(self) if self.is_driven else [self])]
        energies = [E.body if isinstance(E, BodyBathsEnergy) else E for E in energies]  # temperatures may be traced
        return [self._hamiltonian_of(E) for E in energies]

    def _hamiltonian_of(self, energy: Energy) -> np.ndarray:
        """Return the Hamiltonian, shape (N, N), of an energy ``tr(rho H)``."""
        if isinstance(energy, MeanEnergy):  # without a call of JAX, which would compile a program
            return np.asarray(self.structure.matrix(np.asarray(energy.b)))
        with jax.ensure_compile_time_eval():
            origin, one = jnp.zeros(self.body_dim), np.eye(self.structure.size)
            return np.asarray(self.structure.matrix(energy.gradient(origin)) + energy.value(origin) * one)

    def casimirs(self) -> dict[str, Energy]:
        """Return the trace, and without dissipation the purity too, by name."""
        n = self.body_dim
        trace = Quadratic(np.zeros(n), np.where(np.arange(n) < self.structure.size, 1.0, 0.0))
        if not self.total_dissipation.terms:
            return {"tr(rho)": trace, "tr(rho^2)": Quadratic(np.full(n, 2.0))}
        return {"tr(rho)": trace.on(range(n)) if self.baths.number else trace}

    # -- products -----------------------------------------------------------------------------------------------------

    def __mul__(self, other: QuantumSystem) -> QuantumSystem:
        """Return the product of two systems, each with its jumps and baths; :meth:`coupled` adds an interaction."""
        if not isinstance(other, QuantumSystem):
            return NotImplemented
        systems, offset, terms = (self, other), 0, []
        sizes = [s.structure.size for s in systems]
        for k, s in enumerate(systems):
            for term in s.total_dissipation.terms:
                if not isinstance(term, ThermalJumps):
                    raise InputError(
                        f"{type(term).__name__} of a part does not act on a product. Give it to the product as a whole"
                    )
                operators = [tensor_with_identity(np.asarray(V), k, sizes) for V in term.operators]
                terms.append(term.replace_operators(operators, term.bath + offset))
            offset += s.dim - s.body_dim
        if (self.baths.number == 0) != (other.baths.number == 0) and all(s.total_dissipation.terms for s in systems):
            raise InputError(
                "the jumps of one part have a bath, but those of the other part have none. "
                "Give baths to both parts or to neither"
            )
        H = [s._constant_hamiltonian() for s in systems]
        total_H = tensor_with_identity(H[0], 0, sizes) + tensor_with_identity(H[1], 1, sizes)
        parts = self.parts + other.parts
        names = self.names + other.names if len(self.names + other.names) == len(parts) else ()
        names = names if len(set(names)) == len(names) else ()
        baths, floor = join_baths(self.baths, other.baths), max(self.floor, other.floor)
        return QuantumSystem(total_H, terms or None, baths, VonNeumann(floor), parts, names)

    def coupled(self, interaction) -> QuantumSystem:
        """Return the system with an interaction, shape (N, N), added to the Hamiltonian; its jumps are split anew."""
        interaction = checked_hermitian(interaction, "the interaction")
        if interaction.shape != (self.structure.size,) * 2:
            raise InputError(
                f"the interaction must have the shape of the Hamiltonian, ({self.structure.size}, "
                f"{self.structure.size}), got {interaction.shape}"
            )
        terms = self.total_dissipation.terms
        H = self._constant_hamiltonian() + interaction
        return QuantumSystem(H, list(terms) or None, self.baths, VonNeumann(self.floor), self.parts, self.names)

    def _constant_hamiltonian(self) -> np.ndarray:
        """Return the Hamiltonian, shape (N, N); InputError if it depends on time."""
        if self.is_driven:
            raise InputError("products and interactions need a Hamiltonian that does not depend on time")
        return self.hamiltonians_at_test_times()[0]


def _checked_quantum_dissipations(dissipation) -> tuple[Dissipation, ...]:
    """Return the summands of a dissipation; InputError for one that does not act on density matrices."""
    terms = dissipation_terms(dissipation)
    for term in terms:
        if not isinstance(term, ThermalJumps | SteepestEntropyAscent | LindbladJumps):
            raise InputError(
                "the dissipation of a density matrix must be lt.ThermalJumps, lt.SteepestEntropyAscent or "
                f"lt.LindbladJumps, got {type(term).__name__}"
            )
    return terms


def _bind_to_density(term: Dissipation, structure: mf.DensityMatrices) -> Dissipation:
    """Return a dissipation with its functions bound to the coordinates of density matrices, if it needs that."""
    return term.bind_to_structure(structure) if isinstance(term, SteepestEntropyAscent) else term
