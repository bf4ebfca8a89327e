"""``linearise``: the linear motion near an equilibrium, on the leaf of the functions that the system conserves."""

from __future__ import annotations

import enum
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy

from manifolds._arrays import is_traced
from manifolds._class_members import ListedEnumType
from manifolds._precision import with_library_settings

from ..errors import InputError
from ..functions.bath_energy import BathEnergy
from ..functions.energy import Energy
from ..functions.gradients import EPS
from ..tracing.interpret import evaluate_at_points
from .base import System
from .conservation import dissipation_keeps_casimirs
from .invariants import resolve_invariants_near, stack_gradients, systems_at_test_times
from .kind_checks import require_system
from .leaf_stability import has_lyapunov_function, retract

REST_RTOL = 1e-7
"""Largest velocity at an equilibrium, relative to the Jacobian times the norm of the state. An equilibrium with six
digits is accepted; Newton's method leaves about 1e-15."""

GRADIENT_RTOL = 1e-8
"""Length of a gradient, relative to its length at random states of the same norm, below which it counts as zero. The
leaves are singular there, and the direction of the gradient is rounding."""

EIGENVALUE_RTOL = 1e3 * EPS
"""Rounding error of an eigenvalue, relative to the norm of the matrix and to the condition of the eigenvalue."""

MAX_EIGENVALUE_RTOL = 1e-5
"""Largest error of an eigenvalue that is assumed, relative to the norm of the matrix: that of a threefold eigenvalue
with one eigenvector."""

UNKNOWN_CASIMIRS = "Casimirs without a formula"
"""Name of the level sets of Casimirs that are not known as functions; their tangent space is the range of Pi."""


PRINTED_NAMES = 2
"""Number of names at each end of a long list that are printed."""


class Stability(enum.StrEnum, metaclass=ListedEnumType):
    """Stability of an equilibrium on its leaf."""

    ASYMPTOTIC = "asymptotically stable"
    """Every eigenvalue on the leaf decays."""
    STABLE = "stable"
    """No eigenvalue grows, and a conserved or monotone function has a strict extremum on the leaf (Lyapunov)."""
    SPECTRAL = "spectrally stable"
    """No eigenvalue grows, some do not decay, and no known function decides about the nonlinear motion."""
    UNSTABLE = "unstable"
    """An eigenvalue grows."""


class FieldDerivatives(NamedTuple):
    """Values and derivatives of the vector field and of functions at a state, in coordinates of a tangent frame.

    Attributes
    ----------
    velocity : array, shape (n,)
    values : array, shape (functions,)
    jacobian : array, shape (n, m)
        Derivative of the velocity by the coordinates.
    gradients : array, shape (functions, m)
    frame : array, shape (m, n)
        Tangent vectors of the coordinates.
    """

    velocity: Any
    values: Any
    jacobian: Any
    gradients: Any
    frame: Any


def tangent_frame(system: System, x) -> jax.Array:
    """Return a basis of the tangent space at the state x, shape (m, n); the unit vectors on R^n."""
    if system.space is None:
        return jnp.eye(system.dim)
    return system.space.to_vector(system.space._frame(system.points(x)))


def field_derivatives(system_and_functions: tuple[System, tuple[Energy, ...]], x) -> FieldDerivatives:
    """Return the vector field of a system, values of functions, and the derivatives of both at a state x."""
    system, functions = system_and_functions
    frame = jax.lax.stop_gradient(tangent_frame(system, x))

    def values_near(coordinates):
        y = retract(system, x, coordinates @ frame)
        values = jnp.stack([g.value(y) for g in functions]) if functions else jnp.zeros(0)
        return system._vector_field(y), values

    zero = jnp.zeros(frame.shape[0])
    (velocity, values), (jacobian, gradients) = values_near(zero), jax.jacfwd(values_near)(zero)
    return FieldDerivatives(velocity, values, jacobian, gradients, frame)


def _poisson_tensor(system: System, x) -> jax.Array:
    """Return the Poisson tensor at a state as a matrix, shape (n, n)."""
    return jax.jacfwd(lambda alpha: system.poisson.sharp(x, alpha))(jnp.zeros(system.dim))


def constant_temperature_entropy_indices(system: System) -> np.ndarray:
    """Return the indices, shape (k,), of the entropies of baths of constant temperature, which only count heat.

    The motion of the other components does not depend on them, so they may grow in a steady state.
    """
    energy = system.baths.energy
    if isinstance(energy, BathEnergy):
        is_constant = np.isinf(np.asarray(energy.capacity))
    else:
        energy, y = energy.at_time(0.0), np.zeros(system.baths.number)
        is_constant = np.asarray(energy.gradient(y) == energy.gradient(y + 1.0))
    return system.body_dim + np.flatnonzero(is_constant)


def freeze_system(system: System, t: float | None) -> System:
    """Return the system frozen at the time t; unchanged if it does not depend on time.

    Raises
    ------
    InputError
        If the system depends on time and no time is given, or a torque needs an attitude.
    """
    require_system(system, "system must be a system such as lt.models.rigid_body()")
    if is_traced(system):
        raise InputError("the parameters of the system are traced values. Call this function outside of jax.jit")
    if system.torque_laws.needs_attitude:
        raise InputError(
            f"the torque {system.torque_laws.name} depends on the attitude, so a momentum alone is not an equilibrium. "
            "Remove the torque, or write the attitude as part of the state"
        )
    if not system.is_driven:
        return system
    if t is not None:
        return system.at_time(t)
    if clause := _describe_time_dependent_part(system):
        raise InputError(f"{clause}, so it has no equilibrium. Give t= to freeze it at one time")
    return system.at_time(0.0)


def _describe_time_dependent_part(system: System) -> str:
    """Return a clause for a message that names the part of a driven system that depends on time; "" if none does."""
    points = system.samples(3)
    velocities = np.stack(
        [evaluate_at_points(_vector_field_at_state, s, points) for s in systems_at_test_times(system)]
    )
    scale = np.abs(velocities).max()
    if np.abs(velocities - velocities[0]).max() <= EPS * 64 * scale:
        return ""
    what, torque = "a rate of the dissipation", system.torque_laws.name
    if system.energy.depends_on_time or torque:
        what = "the energy" if system.energy.depends_on_time else f"the torque {torque}"
    return f"{what} of this {system.kind} depends on time"


def _vector_field_at_state(system: System, x) -> jax.Array:
    """Return the vector field at one state, shape (n,)."""
    return system._vector_field(x)


def conserved_functions(system: System, x) -> dict[str, Energy]:
    """Return the functions that a frozen system conserves near the states x, by name, the energy last.

    Functions of the entropies of baths of constant temperature are left out.
    """
    system = resolve_invariants_near(system, system.state_array(x, batch=True))
    functions = system.functions()
    first_integrals, components = system.first_integrals(), system.casimir_terms()
    conserved_by_name = {}
    for name, g in functions.items():
        if name in first_integrals:
            conserved_by_name.update(components.get(name, {name: g}))
    if system.energy_law == "conserved" and not system.torque_laws.name:
        conserved_by_name["energy"] = system.energy
    counter_indices = constant_temperature_entropy_indices(system)
    if not counter_indices.size or not conserved_by_name:
        return conserved_by_name
    gradients = evaluate_at_points(stack_gradients, tuple(conserved_by_name.values()), np.atleast_2d(np.asarray(x)))
    keeps = ~gradients[:, :, counter_indices].any(axis=(0, 2))
    return {name: g for (name, g), keep in zip(conserved_by_name.items(), keeps, strict=True) if keep}


def abbreviate_names(names: Sequence[str]) -> str:
    """Return names joined in one text; of a long list only the first and the last ones."""
    if len(names) <= 2 * PRINTED_NAMES:
        return ", ".join(names)
    n_left_out = len(names) - 2 * PRINTED_NAMES
    return ", ".join([*names[:PRINTED_NAMES], f"{n_left_out} more", *names[-PRINTED_NAMES:]])


class Leaf(NamedTuple):
    """The tangent space, at a state, of the common level set of conserved functions.

    Attributes
    ----------
    basis : array, shape (m, p)
        Orthonormal columns, in coordinates of the tangent space of the state space.
    names : tuple of str
        The functions whose level sets meet in the leaf.
    codimension : int
        Number of directions that are taken out, m - p.
    """

    basis: np.ndarray
    names: tuple[str, ...]
    codimension: int


def leaf_at(
    system: System, x: np.ndarray, functions: dict[str, Energy], gradients: np.ndarray, frame: np.ndarray, scale: float
) -> Leaf:
    """Return the :class:`Leaf` through x, from the gradients of conserved functions there, shape (functions, m)."""
    rows, names = [], []
    if functions:
        samples = system.samples(3, scale=scale)
        typical = np.linalg.norm(evaluate_at_points(stack_gradients, tuple(functions.values()), samples), axis=2)
        typical_lengths = np.nanmedian(np.where(np.isfinite(typical), typical, np.nan), axis=0)
        for name, gradient, typical_length in zip(functions, gradients, typical_lengths, strict=True):
            length = np.linalg.norm(gradient)
            if np.isfinite(length) and length > GRADIENT_RTOL * (typical_length if typical_length > 0.0 else 0.0):
                rows.append(gradient / length)
                names.append(name)
    n_rows = len(rows)
    if (kernel := _poisson_kernel_on_regular_leaf(system, x, scale)) is not None:
        rows.extend(kernel @ frame.T)
    m = frame.shape[0]
    _, singular_values, vectors = np.linalg.svd(np.array(rows).reshape(-1, m), full_matrices=True)
    rank = int(np.sum(singular_values > GRADIENT_RTOL))
    if kernel is not None:
        rank_of_known = (
            np.linalg.matrix_rank(np.array(rows[:n_rows]).reshape(-1, m), tol=GRADIENT_RTOL) if n_rows else 0
        )
        names += [UNKNOWN_CASIMIRS] if rank > rank_of_known else []
    return Leaf(vectors[rank:].T, tuple(names), rank)


def _poisson_kernel_on_regular_leaf(system: System, x: np.ndarray, scale: float) -> np.ndarray | None:
    """Return a basis of the kernel of Pi(x), shape (k, n), if the motion stays on the symplectic leaf of x, else None.

    None if all Casimirs are known, if x lies on a leaf of lower dimension, or if the dissipation leaves the leaf.
    """
    keeps_casimirs = dissipation_keeps_casimirs(system)
    if not keeps_casimirs or system.torque_laws.name or system.space is not None or system.baths.number:
        return None
    if system.orbit_levels.has_all_casimirs or system.dim > MAX_TENSOR_DIM:
        return None
    points = np.concatenate([x[None], system.samples(3, scale=scale)])
    tensors = evaluate_at_points(_poisson_tensor, system, points)
    if not np.isfinite(tensors).all() or not tensors.any():
        return None
    _, singular_values, vectors = np.linalg.svd(tensors)
    ranks = np.sum(singular_values > GRADIENT_RTOL * singular_values.max(axis=1, initial=0.0)[:, None], axis=1)
    return vectors[0, ranks[0] :] if ranks[0] == ranks.max() < system.dim else None


MAX_TENSOR_DIM = 200
"""Largest number of components for which the Poisson tensor is computed as a matrix."""


@dataclass(frozen=True, eq=False)
class Linearisation:
    """The linear motion near an equilibrium, as :func:`linearise` returns it.

    On the leaf a small displacement is a sum of modes ``eigenvectors[:, i] * exp(eigenvalues[i] * t)``.

    Attributes
    ----------
    x : array, shape (n,)
        The equilibrium.
    jacobian : array, shape (n, n)
        Derivative of the vector field along the state space (1 / time).
    eigenvalues : array of complex, shape (p,)
        Eigenvalues of the Jacobian on the leaf (1 / time), the fastest growth first.
    eigenvectors : array of complex, shape (n, p)
        Their directions, as displacements of the state.
    basis : array, shape (n, p)
        Basis of the tangent space of the leaf.
    leaf_names : tuple of str
        The conserved functions whose level sets meet in the leaf, such as Casimirs and the energy. A function whose
        gradient vanishes at x is left out: the leaf is singular there.
    codimension : int
        Number of directions that these functions take out. It is smaller than their number if their gradients are
        linearly dependent, as those of the energy and the Casimirs at an equilibrium of a Lie-Poisson system.
    stability : Stability
        The verdict on the equilibrium.
    eigenvalue_errors : array, shape (p,)
        Bounds of the rounding error of the eigenvalues; a rate below its bound counts as zero.
    """

    x: np.ndarray
    jacobian: np.ndarray
    eigenvalues: np.ndarray
    eigenvectors: np.ndarray
    basis: np.ndarray
    leaf_names: tuple[str, ...]
    codimension: int
    stability: Stability
    eigenvalue_errors: np.ndarray

    @property
    def rates(self) -> np.ndarray:
        """Rates of decay of the modes, shape (p,) (1 / time); negative for a mode that grows."""
        return -self.eigenvalues.real

    @property
    def frequencies(self) -> np.ndarray:
        """Angular frequencies of the modes, shape (p,) (1 / time); zero for a mode that does not oscillate."""
        return np.abs(self.eigenvalues.imag)

    @property
    def stable(self) -> bool | None:
        """True if the equilibrium is stable on its leaf, False if not; None if the linear motion does not decide."""
        if self.stability is Stability.SPECTRAL:
            return None
        return self.stability is not Stability.UNSTABLE

    @property
    def is_isolated(self) -> bool:
        """True if no eigenvalue on the leaf is zero, so that the leaf has no other equilibrium nearby."""
        return bool((np.abs(self.eigenvalues) > self.eigenvalue_errors).all())

    def __str__(self) -> str:
        leaf = abbreviate_names(self.leaf_names) or "no conserved function"
        head = (
            f"Equilibrium, {self.stability}, {len(self.eigenvalues)} modes on the leaf of: {leaf}\n"
            f"{'rate of decay':>16} {'angular frequency':>19}\n"
        )
        rows = zip(self._round_to_zero(self.rates), self._round_to_zero(self.frequencies), strict=True)
        return head + "\n".join(f"{rate:16.6g} {frequency:19.6g}" for rate, frequency in rows)

    def _round_to_zero(self, numbers: np.ndarray) -> np.ndarray:
        """Return numbers, shape (p,), with zeros in place of those below the rounding error of the eigenvalues."""
        return np.where(np.abs(numbers) <= self.eigenvalue_errors, 0.0, numbers)


@with_library_settings
def linearise(system: System, x, t: float | None = None) -> Linearisation:
    """Return the linear motion near an equilibrium on its leaf, with decay rates, frequencies and stability.

    A system conserves its Casimirs and, if it is closed, its energy. A displacement that changes one of them does not
    decay, so these directions say nothing about stability. They are taken out: the Jacobian is restricted to the
    tangent space of the common level sets of all functions that the system conserves. A Casimir that is not known as a
    function is taken out by the range of the Poisson tensor. The entropies of baths of constant temperature only count
    heat, and are left out too.

    If no mode grows and some do not decay, the equilibrium is stable if a combination of the conserved functions and
    of those that the laws make monotone has a strict extremum on the leaf [Arnold 1966; Holm, Marsden, Ratiu &
    Weinstein 1985]. This test decides about the nonlinear motion too.

    Parameters
    ----------
    system : System
        The system; its functions fix the units.
    x : array, shape (n,)
        An equilibrium in the units of the system: a state at which the vector field vanishes, as :func:`equilibria` and
        :func:`steady_state` return it.
    t : float, optional
        The time, in the unit of the system, at which a system that depends on time is frozen.

    Returns
    -------
    Linearisation

    Raises
    ------
    InputError
        If x is not an equilibrium, or the system depends on time and t is missing.

    Examples
    --------
    A free rigid body is unstable about its middle axis:

    >>> body = lt.models.free_rigid_body((3.0, 2.0, 1.0))
    >>> (
    ...     lt.linearise(body, [0.0, 1.0, 0.0]).stable,
    ...     lt.linearise(body, [0.0, 0.0, 1.0]).stable,
    ... )
    (False, True)
    """
    system = freeze_system(system, t)
    x = np.asarray(system.state(x))
    derivatives, functions = field_derivatives_and_invariants(system, x)
    size = float(np.linalg.norm(x))
    limit = REST_RTOL * np.linalg.norm(derivatives.jacobian) * (size or 1.0)
    velocity = np.delete(derivatives.velocity, constant_temperature_entropy_indices(system))
    if not np.linalg.norm(velocity) <= limit:
        raise InputError(
            f"x is not an equilibrium: the vector field there has the norm {np.linalg.norm(velocity):.3g}. Find one "
            "with lt.equilibria(system, x) or lt.steady_state(system, x)"
        )
    return linearise_at(system, x, derivatives, functions, size or 1.0)


def field_derivatives_and_invariants(system: System, x: np.ndarray) -> tuple[FieldDerivatives, dict[str, Energy]]:
    """Return the vector field with its derivatives at x, and the functions conserved there by name."""
    functions = conserved_functions(system, x)
    derivatives = evaluate_at_points(field_derivatives, (system, tuple(functions.values())), x[None])
    return FieldDerivatives(*(a[0] for a in derivatives)), functions


def linearise_at(
    system: System, x: np.ndarray, derivatives: FieldDerivatives, functions: dict[str, Energy], scale: float
) -> Linearisation:
    """Return the linear motion near an equilibrium x of a frozen system, from derivatives computed there."""
    counter_indices = constant_temperature_entropy_indices(system)
    frame = derivatives.frame
    n = frame.shape[1]
    body = np.delete(np.arange(len(frame)), counter_indices) if counter_indices.size else np.arange(len(frame))
    # On R^n the frame is the identity; baths of constant temperature on a manifold are its last coordinates.
    if counter_indices.size and system.space is not None:
        body = np.flatnonzero(~np.abs(frame[:, counter_indices]).any(axis=1))
    frame, gradients = frame[body], derivatives.gradients[:, body]
    to_coordinates = np.linalg.pinv(frame.T)
    to_coordinates[:, counter_indices] = 0.0
    matrix = to_coordinates @ derivatives.jacobian[:, body]
    leaf = leaf_at(system, x, functions, gradients, frame, scale)
    leaf_matrix = leaf.basis.T @ matrix @ leaf.basis
    eigenvalues, eigenvectors, errors = _sorted_eigenvalues(leaf_matrix)
    growth = eigenvalues.real
    if (growth > errors).any():
        stability = Stability.UNSTABLE
    elif (growth < -errors).all() and len(growth):
        stability = Stability.ASYMPTOTIC
    else:
        definite = has_lyapunov_function(system, x, frame, leaf.basis, functions)
        stability = Stability.STABLE if definite else Stability.SPECTRAL
    basis = frame.T @ leaf.basis
    jacobian = derivatives.jacobian @ np.linalg.pinv(derivatives.frame.T)
    assert jacobian.shape == (n, n)
    return Linearisation(
        x, jacobian, eigenvalues, basis @ eigenvectors, basis, leaf.names, leaf.codimension, stability, errors
    )


def _sorted_eigenvalues(matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return eigenvalues by falling real part, eigenvectors as columns, and error bounds of the eigenvalues."""
    if not matrix.size:
        return np.zeros(0, complex), np.zeros((0, 0), complex), np.zeros(0)
    eigenvalues, left_vectors, right_vectors = scipy.linalg.eig(matrix, left=True, right=True)
    overlaps = np.abs(np.sum(left_vectors.conj() * right_vectors, axis=0))
    n, norm = len(matrix), float(np.linalg.norm(matrix, 2))
    with np.errstate(divide="ignore"):
        errors = np.minimum(EIGENVALUE_RTOL * n / overlaps, MAX_EIGENVALUE_RTOL) * norm
    order = np.lexsort((-eigenvalues.imag, -np.round(eigenvalues.real / (norm or 1.0), 12)))
    return eigenvalues[order], right_vectors[:, order], errors[order]


def evaluate_functions(functions: Sequence[Energy], states: np.ndarray) -> np.ndarray:
    """Return the values of functions at states, shape (m, n), as an array, shape (m, functions)."""
    if not functions:
        return np.zeros((len(states), 0))
    return evaluate_at_points(_values_at_state, tuple(functions), states)


def _values_at_state(functions: tuple[Energy, ...], x) -> jax.Array:
    """Return the values of functions at one state, shape (functions,)."""
    return jnp.stack([g.value(x) for g in functions])
