"""The Lagrangian side of contact systems: Herglotz' equations on TQ x R, and the Legendre transform to T*Q x R."""

from __future__ import annotations

from collections.abc import Callable
from typing import ClassVar, cast

import jax
import jax.numpy as jnp
import numpy as np

import manifolds as mf
from manifolds._arrays import is_traced
from manifolds._pytree_module import Module
from manifolds.matrices.linear import inverse

from ..errors import InputError
from ..functions.checks import checked_energy, with_polynomial_degrees
from ..functions.energy import Energy, Quadratic, make_energy
from ..functions.mechanics import Kinetic, is_independent_of_momenta
from ..functions.newton import inverse_gradient
from ..tracing.programs import jit_cached
from .euler_poincare import require_regular
from .evolution import (
    ContactManifoldSystem,
    ContactSystem,
    EvolutionSystem,
    join_arguments,
    n_degrees_of_freedom,
    state_dim,
    tangent_bundle_of,
)

SINGULAR_LAGRANGIAN_MESSAGE = (
    "the Lagrangian is singular: its Hessian L_vv has no inverse, so eta_L is not a contact form and the momentum "
    "does not determine the velocity"
)
"""Error message for a Lagrangian whose momentum does not determine the velocity."""


class VelocityContactSystem(ContactManifoldSystem):
    """Base class of contact systems that a Lagrangian determines, with states (q, v, S)."""

    lagrangian: Energy

    @property
    def contact(self) -> mf.LagrangianContact:
        """The contact structure of the Lagrangian, with the form ``dS - L_v dq`` [SML §3.1]."""
        return cast(mf.LagrangianContact, self.poisson.contact)

    def _build_contact_structure(
        self, lagrangian, dim: int | None, space: mf.Space | None = None
    ) -> tuple[mf.Cosymplectic, int, Energy]:
        """Return the Poisson structure, the dimension and the energy of a Lagrangian after checking it."""
        L = make_energy(lagrangian, "the Lagrangian")
        if dim is None and space is None and isinstance(L, Quadratic):
            dim = L.A.shape[0]
        if dim is None and space is None:
            raise InputError("the dimension of the state (q, v, S) is not known. Give dim=2n+1 beside the Lagrangian")
        dim = state_dim(dim, space)
        n = n_degrees_of_freedom(dim)
        self.lagrangian = L = with_polynomial_degrees(checked_energy(L, dim, "the Lagrangian"), dim)
        contact = mf.LagrangianContact(_EnergyValue(L), n, tangent_bundle_of(space))
        require_regular(_hessian, contact, random_velocity_states(contact, 4), SINGULAR_LAGRANGIAN_MESSAGE)
        return mf.Cosymplectic(contact), dim, _lagrangian_energy(L, dim)

    def _hamiltonian(self) -> Energy:
        """Return the Hamiltonian as a function of (q, p, S); InputError if q is not in R^n."""
        if self.configurations is not None:
            raise InputError(
                f"the Legendre transform is inverted on R^n only, but positions are in {self.configurations.name}. "
                "Give lt.EvolutionSystem or lt.ContactSystem the Hamiltonian, with space="
            )
        return _legendre_hamiltonian(self.lagrangian, self.dim)

    def legendre(self, x) -> jax.Array:
        """Return states (q, L_v, S) of :meth:`hamiltonian_system` from states (q, v, S), shape (..., dim)."""
        return jnp.vectorize(self.contact.legendre, signature="(n)->(n)")(self.state(x, batch=True))


class LagrangianSystem(VelocityContactSystem):
    """Base class of systems that a Lagrangian determines without further forces."""

    def __init__(
        self,
        lagrangian,
        dim: int | None = None,
        momentum_maps=(),
        validate: bool = True,
        space: mf.Space | None = None,
    ):
        structure, dim, energy = self._build_contact_structure(join_arguments(lagrangian, space), dim, space)
        self._build_field(structure, dim, energy, self.lagrangian, momentum_maps, validate, space)


class ThermodynamicHerglotz(LagrangianSystem):
    """An isolated system with the evolution field of a Lagrangian L(q, v, S), Herglotz' equations [SML 12].

    ``d/dt L_v - L_q = L_v L_S`` and ``S' = v . L_v``, in the state (q, v, S). It is the field ``Gamma_L`` of
    ``eta_L = dS - L_v dq`` and of the energy ``E_L = v . L_v - L``, which it conserves; its Legendre transform is the
    :class:`EvolutionSystem` of ``H = E_L o FL^-1``. The temperature is ``T = -L_S``.

    Q is R^n, or a ``space``, as for :class:`EvolutionSystem`; a state has the arrays of q and v in one row.

    For ``L = lt.Kinetic(g) - lt.Potential(V)``, g semidefinite, the entropy falls at no step of the metriplectic
    schemes, as there; otherwise :meth:`check` reports the sign of ``Delta(L) = v . L_v``.

    Parameters
    ----------
    lagrangian : function of (q, v, S), or of all in one array, shape (dim,), to a scalar, or an Energy
        Regular: ``L_vv`` has an inverse.
    dim : int
        Number of state components, 2n + 1; known by itself of an ``lt.Quadratic``, and with a space.
    momentum_maps, validate, space
        As for :class:`EvolutionSystem`.

    Raises
    ------
    AxiomError, FunctionError, InputError

    Attributes
    ----------
    contact : manifolds.LagrangianContact
    lagrangian : Energy
    """

    __init__ = LagrangianSystem.__init__  # explicit, because type checkers would generate one from the fields

    entropy_production_name: ClassVar[str] = "Delta(L)"

    def hamiltonian_system(self) -> EvolutionSystem:
        """Return the evolution system with states (q, p, S) of the Legendre transform; q must be in R^n."""
        return EvolutionSystem(self._hamiltonian(), self.dim, validate=False)


class Herglotz(LagrangianSystem):
    """A system with the contact field of a Lagrangian, Herglotz' equations of 1930, for comparison [SML 10].

    ``d/dt L_v - L_q = L_v L_S`` and ``S' = L``, in the state (q, v, S): S is the action, and ``E_L' = L_S E_L``.

    Parameters
    ----------
    lagrangian, dim, momentum_maps, validate, space
        As for :class:`ThermodynamicHerglotz`.
    """

    __init__ = LagrangianSystem.__init__

    is_isolated: ClassVar[bool] = False

    def hamiltonian_system(self) -> ContactSystem:
        """Return the contact system with states (q, p, S) of the Legendre transform; q must be in R^n."""
        return ContactSystem(self._hamiltonian(), self.dim, validate=False)


# -- the energy E_L ---------------------------------------------------------------------------------------------------


def _lagrangian_energy(L: Energy, dim: int) -> Energy:
    """Return the energy ``v . L_v - L`` of a Lagrangian, term by term, so that methods know the form of each."""
    points = np.random.default_rng(0).standard_normal((4, dim))
    terms = [_energy_of_term(term, points) for term in L.terms]
    return sum(terms[1:], terms[0])


def _energy_of_term(term: Energy, points: np.ndarray) -> Energy:
    """Return the energy ``v . L_v - L`` of one term of a Lagrangian."""
    if isinstance(term, Kinetic):
        return term
    if isinstance(term, Quadratic):
        return _energy_of_quadratic(term)
    return -term if not is_traced(term) and is_independent_of_momenta(term, points) else _LegendreEnergy(term)


def _energy_of_quadratic(L: Quadratic) -> Quadratic:
    """Return the energy of a quadratic Lagrangian, in which terms of degree k in v are multiplied by k - 1."""
    dim = L.A.shape[0]
    degree = (np.arange(dim) // (dim // 2) == 1).astype(float)
    factor = 2.0 * degree - 1.0 if L.A.ndim == 1 else np.add.outer(degree, degree) - 1.0
    return Quadratic(L.A * factor, None if L.b is None else L.b * (degree - 1.0), -L.c)


class _LegendreEnergy(Energy):
    """The energy ``v . L_v - L`` of a Lagrangian as a function of (q, v, S)."""

    lagrangian: Energy

    def value(self, x) -> jax.Array:
        n = len(x) // 2
        return jnp.dot(x[n : 2 * n], self.lagrangian.gradient(x)[n : 2 * n]) - self.lagrangian.value(x)


class _EnergyValue(Module):
    """A callable module that returns the value of an energy at a state."""

    energy: Energy

    def __call__(self, x):
        return self.energy.value(x)


# -- the Hamiltonian --------------------------------------------------------------------------------------------------


def _legendre_hamiltonian(L: Energy, dim: int) -> Energy:
    """Return the Hamiltonian of a Lagrangian, in closed form for quadratic and kinetic minus potential ones."""
    if isinstance(L, Quadratic):
        return _hamiltonian_of_quadratic(L)
    points = np.random.default_rng(0).standard_normal((4, dim))
    kinetic = [term for term in L.terms if is_traced(term) or not is_independent_of_momenta(term, points)]
    if len(kinetic) == 1 and isinstance(kinetic[0], Kinetic):
        return sum((-term for term in L.terms if term is not kinetic[0]), Kinetic(_inverse_metric(kinetic[0].G)))
    return LegendreTransform(L)


@jit_cached
def _hamiltonian_of_quadratic(L: Quadratic) -> Quadratic:
    """Return the Hamiltonian of a quadratic Lagrangian with ``L_v = W v + B r + c``, where r = (q, S).

    It is ``H = (p - B r - c) . W^-1 (p - B r - c) / 2 - L(r)``.
    """
    dim = L.A.shape[0]
    v, r = np.split(np.roll(np.arange(dim), -(dim // 2)), [dim // 2])
    A, b = jnp.diag(L.A) if L.A.ndim == 1 else L.A, jnp.zeros(dim) if L.b is None else L.b
    W_inverse = inverse(A[np.ix_(v, v)])
    shift = jnp.zeros((dim // 2, dim)).at[:, v].set(jnp.eye(dim // 2)).at[:, r].set(-A[np.ix_(v, r)])
    A_r = jnp.zeros((dim, dim)).at[np.ix_(r, r)].set(A[np.ix_(r, r)])
    velocity = 0.5 * (W_inverse + W_inverse.T) @ shift
    c = b[v]
    return Quadratic(shift.T @ velocity - A_r, -c @ velocity - b.at[v].set(0.0), 0.5 * c @ W_inverse @ c - L.c)


class _InverseMetric(Module):
    """The inverse of a metric as a function of q."""

    metric: Callable

    def __call__(self, q):
        G = self.metric(q)
        return 1.0 / G if G.ndim == 1 else inverse(G)


def _inverse_metric(G):
    """Return the inverse of a metric: of a matrix, of the diagonal of one, or of a function of q."""
    if callable(G):
        return _InverseMetric(G)
    if G.ndim == 1:
        return 1.0 / G
    G_inverse = inverse(G)
    return 0.5 * (G_inverse + G_inverse.T)


class LegendreTransform(Energy):
    """The Hamiltonian ``p . v - L(q, v, S)`` at the v with ``L_v = p``, which damped Newton steps find; else NaN."""

    lagrangian: Energy

    def velocity(self, x) -> jax.Array:
        """Return the velocity v, shape (n,), that belongs to the momentum in a state (q, p, S)."""
        n = len(x) // 2
        return inverse_gradient(_VelocityLagrangian(self.lagrangian, x[:n], x[2 * n :]), x[n : 2 * n])

    def value(self, x) -> jax.Array:
        v, n = self.velocity(x), len(x) // 2
        return jnp.dot(x[n : 2 * n], v) - self.lagrangian.value(x.at[n : 2 * n].set(v))

    def gradient(self, x) -> jax.Array:
        v, n = self.velocity(x), len(x) // 2
        return (-self.lagrangian.gradient(x.at[n : 2 * n].set(v))).at[n : 2 * n].set(v)


class _VelocityLagrangian(Energy):
    """A Lagrangian as a function of v, with q and S fixed."""

    lagrangian: Energy
    q: jax.Array
    S: jax.Array

    def value(self, x) -> jax.Array:
        return self.lagrangian.value(jnp.concatenate([self.q, x, self.S]))


def random_velocity_states(contact: mf.SplitContact, count: int) -> np.ndarray:
    """Return random states (q, v, S), shape (count, dim); (q, v) is in the tangent bundle if there is one."""
    points = np.random.default_rng(0).standard_normal((count, contact.dim))
    if isinstance(contact.bundle, mf.TangentBundle):
        bundle = contact.bundle
        points[:, :-1] = bundle.to_vector(bundle.random(0, (count,)))
    return points


def _hessian(contact: mf.LagrangianContact, x):
    """Return the Hessian ``L_vv`` at a state (q, v, S), shape (n, n)."""
    return contact.hessian(x)
