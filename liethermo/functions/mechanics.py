"""Energies of many bodies, and of mechanical systems with states (q, p, S), discretised term by term."""

from __future__ import annotations

import math
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy

import manifolds as mf
from manifolds._arrays import is_traced
from manifolds._pytree_module import Module

from ..errors import FunctionError, InputError
from ..tracing.interpret import evaluate_at_points, polynomial_degree_bound
from ..tracing.traced import trace_callables
from .checks import checked_energy, with_polynomial_degrees
from .conditions import checked_numbers
from .energy import Energy, Function, Pullback, Quadratic, float64_array
from .indices import Indices, clique_pattern
from .path import CollocationPath


class Each(Energy):
    """A sum of one function over many places of the state, ``sum_e phi(x[places_e], a_e)``, a_e parameters.

    It describes springs between bodies, or the bodies themselves. The function is written once and evaluated at all
    places together, at a cost proportional to their number, not to the square of the dimension of the state. Every
    summand has its own discrete gradient, corrected along its own components. The Jacobian is therefore as sparse as
    that of the exact gradient, so stiff systems of any size can be solved by sparse Newton iteration.

    Parameters
    ----------
    phi : function or Energy
        From the components at one place, shape (r,), and the parameters there, to a scalar; or an Energy of these
        components, equal at every place.
    places : array of int, shape (m, r)
        Indices into the state.
    *parameters : arrays, shape (m, ...)
        One entry for each place.

    Raises
    ------
    FunctionError, InputError
    """

    phi: Energy | Callable
    parameters: tuple[jax.Array, ...]
    places: Indices = eqx.field(static=True)
    degree: float = eqx.field(static=True, default=math.inf)

    def __init__(self, phi, places, *parameters):
        self.places = places if isinstance(places, Indices) else _checked_places(places)
        self.parameters = tuple(checked_numbers(a, "a parameter") for a in parameters)
        m, r = self.places.shape
        for a in self.parameters:
            if a.shape[:1] != (m,):
                raise InputError(
                    f"parameters must have shape ({m}, ...), an entry for each of the {m} places, got {a.shape}"
                )
        if isinstance(phi, Energy):
            if parameters:
                raise InputError(
                    "parameters need a function phi(y, *parameters), got an Energy, which is equal at every place"
                )
            self.phi = with_polynomial_degrees(checked_energy(phi, r, "the energy at a place"), r)
            self.degree = self.phi.degree
            return
        if not callable(phi):
            raise FunctionError(f"phi must be a function or an Energy, got {type(phi).__name__}")
        zero_parameters = tuple(jnp.zeros(a.shape[1:]) for a in self.parameters)
        checked_energy(Function(lambda y: phi(y, *zero_parameters)), r, "the function at a place")
        self.phi = trace_callables(phi, lambda phi, *a: phi(*a), (r,), *(a.shape for a in zero_parameters))
        self.degree = polynomial_degree_bound(_summand_value, (self.phi, zero_parameters), r)

    @property
    def terms(self) -> tuple[Energy, ...]:
        if isinstance(self.phi, Energy) and len(self.phi.terms) > 1:
            return tuple(Each(term, self.places) for term in self.phi.terms)
        return (self,)

    @property
    def is_quadratic(self) -> bool:
        return self.degree <= 2

    def value(self, x) -> jax.Array:
        return jnp.sum(
            jax.vmap(lambda y, *a: self._summand_energy(a).value(y))(self._gather_components(x), *self.parameters)
        )

    def gradient(self, x) -> jax.Array:
        x = float64_array(x)
        gradients = jax.vmap(lambda y, *a: self._summand_energy(a).gradient(y))(
            self._gather_components(x), *self.parameters
        )
        return self._scatter_gradients(gradients, x.shape[0])

    def discrete_gradient(self, scheme, x, d, compensation) -> jax.Array:
        def summand_discrete_gradient(y, step, summand_compensation, *a):
            return self._summand_energy(a).discrete_gradient(scheme, y, step, summand_compensation)

        y, step, offset = map(self._gather_components, (x, d, jnp.zeros_like(x) + compensation))
        return self._scatter_gradients(
            jax.vmap(summand_discrete_gradient)(y, step, offset, *self.parameters), x.shape[0]
        )

    def stage_gradients(self, scheme, path) -> jax.Array:
        def summand_stage_gradients(summand_path: CollocationPath, *a):
            return self._summand_energy(a).stage_gradients(scheme, summand_path)

        compensation = jnp.zeros_like(path.start) + path.compensation
        summand_paths = CollocationPath(
            *jax.tree.map(self._gather_components, path._replace(compensation=compensation)[:7]), *path[7:]
        )
        kronrod_axis = None if path.kronrod_samples is None else 1
        symmetry_axis = None if path.symmetries is None else 2
        axes = CollocationPath(0, 0, 0, 1, 1, kronrod_axis, symmetry_axis, None, None, None)  # type: ignore[arg-type]
        mapped_axes = axes, *(0 for _ in self.parameters)
        gradients = jax.vmap(summand_stage_gradients, in_axes=mapped_axes, out_axes=1)(summand_paths, *self.parameters)
        return jax.vmap(lambda g: self._scatter_gradients(g, path.start.shape[0]))(gradients)

    def hessian_pattern(self, dim: int) -> scipy.sparse.csr_array:
        return clique_pattern(self.places, dim)

    def check_components(self, dim: int, role: str) -> None:
        indices = np.asarray(self.places)
        if indices.size and not (indices.min() >= 0 and indices.max() < dim):
            invalid_index = int(indices[(indices < 0) | (indices >= dim)][0])
            raise InputError(f"{role} has a term at component {invalid_index}, but the state has {dim} components")

    def _summand_energy(self, summand_parameters) -> Energy:
        """Return the energy of the summand that has these parameters."""
        if isinstance(self.phi, Energy):
            return self.phi
        return Function(lambda y: self.phi(y, *summand_parameters), degree=self.degree)

    def _gather_components(self, x) -> jax.Array:
        """Return the components at each place, from shape (..., n) to (..., m, r)."""
        if (contiguous_slice := self.places.contiguous_slice) is not None:
            return x[..., contiguous_slice].reshape(*x.shape[:-1], *self.places.shape)
        return x[..., np.asarray(self.places)]

    def _scatter_gradients(self, gradients, n: int) -> jax.Array:
        """Return the sum of the gradients at the places, from shape (m, r) to (n,)."""
        if (contiguous_slice := self.places.contiguous_slice) is not None:
            return jnp.zeros(n).at[contiguous_slice].add(gradients.ravel())
        return jnp.zeros(n).at[np.asarray(self.places)].add(gradients)


def _summand_value(phi_and_parameters, y):
    """Return the value of a summand at its components y; the first argument is the function and its parameters."""
    phi, parameters = phi_and_parameters
    return jnp.asarray(phi(y, *parameters))


def _checked_places(places) -> Indices:
    """Return places as indices; raise InputError unless they are integers of shape (m, r)."""
    indices = np.asarray(places)
    if indices.ndim != 2 or indices.dtype.kind not in "iu" or 0 in indices.shape:
        raise InputError(
            f"places must be integers of shape (m, r), the r components of each of m summands, got {places!r}"
        )
    return Indices(indices)


class Kinetic(Energy):
    """The kinetic energy ``p·G(q) p / 2`` of a state (q, p) or (q, p, S), or ``v·G(q) v / 2`` of (q, v, S) [SML 28].

    G is the inverse of the metric (of the mass matrix) in a Hamiltonian, and the metric in a Lagrangian. In every
    scheme its discrete gradient by p is a mean of G times a mean of p: ``(G(q) + G(q')) (p + p') / 4`` for discrete
    gradients, ``G(q_i) p_i`` at the stages of a collocation method; the correction changes only the components of q.
    For a semidefinite G this ensures that the entropy of an evolution field does not fall at any step.

    Parameters
    ----------
    G : array, shape (n, n) symmetric, or (n,) for a diagonal matrix; or function from q, shape (n,), to one
        The mass matrix (mass).
    """

    G: jax.Array | Callable

    def __init__(self, G):
        self.G = G if callable(G) else Quadratic(G).A  # checked there

    @property
    def is_quadratic(self) -> bool:
        return not callable(self.G)

    def at(self, q) -> jax.Array:
        """Return the matrix ``G(q)`` of the kinetic energy at q, shape (n, n), or its diagonal, shape (n,)."""
        return jnp.asarray(self.G(q)) if callable(self.G) else self.G

    def value(self, x) -> jax.Array:
        q, p = _positions_and_momenta(x)
        return 0.5 * jnp.dot(p, _apply_metric(self.at(q), p))

    def discrete_gradient(self, scheme, x, d, compensation) -> jax.Array:
        (q, p), (dq, dp), (compensation_q, compensation_p) = map(
            _positions_and_momenta, (x, d, jnp.zeros_like(x) + compensation)
        )
        p_middle, zeros = p + (compensation_p + 0.5 * dp), jnp.zeros(len(x) - 2 * len(p))
        if not callable(self.G):
            return jnp.concatenate([jnp.zeros_like(q), _apply_metric(self.G, p_middle), zeros])
        p_start, p_end = p + compensation_p, p + (compensation_p + dp)

        def mean_kinetic_energy(q):  # of the kinetic energy at q, over both ends in p
            G = self.at(q)
            return 0.25 * (jnp.dot(p_start, _apply_metric(G, p_start)) + jnp.dot(p_end, _apply_metric(G, p_end)))

        p_gradient = 0.5 * (
            _apply_metric(self.at(q + compensation_q), p_middle)
            + _apply_metric(self.at(q + (compensation_q + dq)), p_middle)
        )
        return jnp.concatenate(
            [scheme.general(Function(mean_kinetic_energy), q, dq, compensation_q), p_gradient, zeros]
        )

    def stage_gradients(self, scheme, path) -> jax.Array:
        dim = len(path.start)
        return scheme(self, path, correction_weights=np.arange(dim) < dim // 2)


class Potential(Pullback):
    """A potential ``V(q, S)`` of a state (q, p, S): internal energy, or springs that heat up [SML 28].

    Parameters
    ----------
    V : function from q, shape (n,), and S, a scalar, to a scalar
        The potential (energy).
    """

    def __init__(self, V: Callable):
        super().__init__(Function(_PotentialOfVector(V)), _drop_momenta)


class _PotentialOfVector(Module):
    """A potential V(q, S), as a function of the array (q, S)."""

    V: Callable

    def __call__(self, y):
        return self.V(y[:-1], y[-1])


def is_mechanical_energy(energy: Energy, dim: int, space: mf.Space | None = None) -> bool:
    """Return whether each term of an energy is known to be ``p . G(q) p / 2``, with G semidefinite, or ``V(q, S)``.

    These are the energies of [SML 28]. On a space of positions, the symmetric part of ``P(q) G(q)`` must be
    semidefinite near the space, P the projector onto its tangent space.

    Then ``p . (dgrad H)_p >= 0`` with p the midpoint, for the discrete gradients of every scheme that takes the
    midpoint gradient of a quadratic term. A plain function of the whole state is not known to be of any kind, unless it
    is quadratic.
    """
    if is_traced(energy):
        return False
    points = np.random.default_rng(0).standard_normal((4, dim))
    projectors = (
        None if space is None else evaluate_at_points(_tangent_projector_matrix, space, points[:, : space.size])
    )
    return all(
        _is_kinetic_with_potential(term, points, projectors) or is_independent_of_momenta(term, points)
        for term in energy.terms
    )


def is_independent_of_momenta(term: Energy, points: np.ndarray) -> bool:
    """Return whether a term is known not to depend on p (or v)."""
    n = points.shape[1] // 2
    return is_independent_of(term, points, np.arange(n, 2 * n))


def is_independent_of(term: Energy, points: np.ndarray, components: np.ndarray) -> bool:
    """Return whether a term is known not to depend on some components, by the Jacobian of its coordinates."""
    if isinstance(term, Each):
        return not np.isin(components, term.places).any()
    return (
        isinstance(term, Pullback)
        and not evaluate_at_points(_coordinate_jacobian, term, points)[:, :, components].any()
    )


def _is_kinetic_with_potential(term: Energy, points: np.ndarray, projectors: np.ndarray | None) -> bool:
    """Return whether a term is a semidefinite form in p plus a function of q and S."""
    n = points.shape[1] // 2
    if isinstance(term, Kinetic):
        return _is_semidefinite(evaluate_at_points(_metric_matrix_at_state, term, points), projectors)
    if not term.is_quadratic:
        return False
    slope, hessian = evaluate_at_points(_gradient_and_hessian_by_momenta, term, np.zeros_like(points[:1]))
    mixed_block = np.delete(hessian, np.s_[n : 2 * n], axis=-1)
    return not slope.any() and not mixed_block.any() and _is_semidefinite(hessian[..., n : 2 * n], projectors)


def _is_semidefinite(G: np.ndarray, projectors: np.ndarray | None) -> bool:
    """Return whether all matrices, shape (..., n, n), are positive semidefinite, multiplied by projectors if given."""
    G = G if projectors is None else projectors @ G
    eigenvalues = np.linalg.eigvalsh(0.5 * (G + G.swapaxes(-1, -2)))
    return bool(eigenvalues.min() >= -1e-14 * np.abs(eigenvalues).max())


def _tangent_projector_matrix(space: mf.Space, q):
    """Return the matrix of the projector onto the tangent space of a space at q, shape (n, n)."""
    point = space.from_vector(q)
    project = lambda w: space.to_vector(space._tangential_part(point, space.from_vector(w)))  # noqa: E731
    return jax.vmap(project, out_axes=1)(jnp.eye(space.size))


def _metric_matrix_at_state(term: Kinetic, x):
    """Return the matrix ``G(q)`` of a kinetic energy at the positions q of a state, shape (n, n)."""
    G = term.at(_positions_and_momenta(x)[0])
    return jnp.diag(G) if G.ndim == 1 else G


def _gradient_and_hessian_by_momenta(term: Energy, x):
    """Return the rows of the gradient, shape (n,), and of the Hessian that belong to the momenta."""
    n = len(x) // 2
    return term.gradient(x)[n : 2 * n], jax.jacfwd(term.gradient)(x)[n : 2 * n]


def _coordinate_jacobian(term: Pullback, x):
    """Return the Jacobian of the coordinates of a term at a state."""
    return jax.jacfwd(term.coordinates)(x)


def _positions_and_momenta(x):
    """Return q and p of a state (q, p) or (q, p, S)."""
    n = len(x) // 2
    return x[:n], x[n : 2 * n]


def _apply_metric(G, p):
    """Return ``G p`` for a matrix G, or for the diagonal of a diagonal matrix."""
    return G * p if G.ndim == 1 else G @ p


def _drop_momenta(x):
    """Return (q, S) of a state (q, p, S)."""
    n = len(x) // 2
    return jnp.concatenate([x[:n], x[2 * n :]])
