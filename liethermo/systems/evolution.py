"""Evolution fields of contact manifolds: isolated systems with friction, and the plain contact fields beside them."""

from __future__ import annotations

from collections.abc import Callable
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp

import manifolds as mf
from manifolds._pytree_module import Module

from ..dissipation.base import SkewFriction, nondecreasing_law_if
from ..errors import InputError
from ..functions.checks import checked_energy, with_polynomial_degrees
from ..functions.energy import Energy, Quadratic, make_energy
from ..functions.mechanics import is_mechanical_energy
from ..functions.time_span import required_argument_count
from .base import System
from .embedded import EmbeddedSystem
from .states import evaluate_batch


class LiouvilleFriction(SkewFriction):
    """The friction of an evolution field, proportional to the temperature, and the heat it makes [SML 6, 30].

    On T*Q x R it is ``p' = -p H_S, S' = p . H_p``, the bracket ``{., H}_Delta`` of the single-generator form. It is
    skew with H, so H is conserved. The entropy cannot fall where ``Delta H >= 0`` [SML Prop. 4.3]; this
    is known of ``H = p . G(q) p / 2 + V(q, S)`` given in terms of that form, and then holds in a discretisation too.
    """

    def force(self, system, x, dH, dS, dL):
        return system.contact.liouville_sharp(x, dH)


class ReebDrift(LiouvilleFriction):
    """The force that turns an evolution field into the contact field ``X_H = E_H - H R`` [SML §2.2].

    The energy then changes by ``H' = -R(H) H``.
    """

    energy_law = None

    def force(self, system, x, dH, dS, dL):
        return system.contact.liouville_sharp(x, dH) - system.energy.value(x) * system.contact.reeb(x)


class ContactManifoldSystem(System):
    """Base class of evolution and contact systems on T*Q x R and on TQ x R."""

    poisson: mf.Cosymplectic

    is_isolated: ClassVar[bool] = True
    """True for the evolution field, which conserves the energy; False for the contact field."""

    def _build_field(self, structure, dim, energy, mechanics: Energy, momentum_maps, validate, space) -> None:
        """Build the evolution or contact field of an energy; ``mechanics`` is the Hamiltonian or Lagrangian."""
        entropy: Energy | None = None
        friction: LiouvilleFriction = ReebDrift()
        if self.is_isolated:
            law = nondecreasing_law_if(is_mechanical_energy(mechanics, dim, space))
            entropy, friction = entropy_component(dim), LiouvilleFriction(law=law)
        arguments = structure, dim, energy, entropy, friction, momentum_maps, validate
        self._build(*arguments, state_space(space), check_poisson=space is None)

    def specific_axiom_residuals(self, x) -> dict[str, jax.Array]:
        rate = self.vector_field(x)
        if self.is_isolated:  # the first law: the field lies in the kernel of the contact form [SML Remark 4.2]
            form = self.contact.form(x)
            return {"eta(x') = 0": _relative_residual(jnp.dot(form, rate), jnp.abs(form) @ jnp.abs(rate))}
        dH = self.energy.gradient(x)  # [SML Prop. 2.1]
        loss = jnp.dot(dH, self.contact.reeb(x)) * self.energy.value(x)
        size = jnp.abs(dH) @ jnp.abs(rate) + jnp.abs(loss)
        return {"dH/dt = -R(H) H": _relative_residual(jnp.dot(dH, rate) + loss, size)}

    @property
    def contact(self) -> mf.SplitContact:
        """The contact structure of the states."""
        return self.poisson.contact

    @property
    def configurations(self) -> mf.Space | None:
        """The space of positions Q; None for R^n."""
        return configuration_space(self.contact)

    def local_system(self, x, is_centred: bool = False) -> tuple[System, jax.Array]:
        """Return the embedded system, whose field is tangent to the level sets of the constraints, and x."""
        return (self if self.space is None else EmbeddedSystem(self, is_tangent=True)), x

    def _vector_field(self, x) -> jax.Array:
        """Return the field without projecting the gradients, whose normal components have no effect."""
        return self.field(x, self.energy.gradient(x), self.entropy_gradient(x))


class MomentumContactSystem(ContactManifoldSystem):
    """Base class of contact systems that an energy determines, with states (q, p, S)."""

    def __init__(
        self,
        energy,
        dim: int | None = None,
        momentum_maps=(),
        validate: bool = True,
        space: mf.Space | None = None,
    ):
        dim = state_dim(dim, space)
        energy = make_energy(join_arguments(energy, space), "the energy")
        energy = checked_energy(energy, dim, "the energy", allow_time=True)
        mechanics = with_polynomial_degrees(energy, dim)
        self._build_field(canonical_structure(dim, space), dim, energy, mechanics, momentum_maps, validate, space)


class EvolutionSystem(MomentumContactSystem):
    """An isolated system with friction: the evolution field of an energy on T*Q x R [SML 7, §4].

    ``q' = H_p, p' = -H_q - p H_S, S' = p . H_p``, with the temperature ``T = H_S``. The energy is constant and the path
    is tangent to the kernel of ``eta = dS - p dq``, which is the first law. The second holds where
    ``Delta_Q H = p . H_p >= 0``; :meth:`check` reports its sign at points.

    For ``H = lt.Kinetic(G) + lt.Potential(V)``, that is ``p . G(q) p / 2 + V(q, S)`` with G semidefinite, it holds, and
    the metriplectic schemes keep it exactly: ``S' - S = h sum b_i p_i . G p_i >= 0`` at every step, for every V and h
    (not with the coordinate increment as printed, unless G is diagonal). Where the same H is written as one
    plain function, they conserve the energy exactly too, but the entropy may fall at a coarse step.

    Q is R^n, or a ``space``. There a state has the arrays of q and p in one row, and S behind them. The array p is that
    along Q which acts on velocities as the momentum does, ``sum(p * v)``. What energies are off Q counts for nothing.
    The methods run in the arrays around Q, whose equations hold to rounding. The second law holds to rounding there for
    the Gauss and the explicit methods where ``P(q) G(q)`` is semidefinite, P the projector along Q, as for one mass.

    Parameters
    ----------
    energy : function from (q, p, S), or from all in one array, shape (dim,), to a scalar; or an Energy
        Or of the one array and the time t: see :class:`liethermo.TimeDependent`.
    dim : int, optional
        Number of state components, 2n + 1; not needed with a space.
    momentum_maps : dict of functions, or a sequence of them
        Conserved quantities of a symmetry: checked by :meth:`check`, recorded and audited along runs.
    validate : bool
        Test the axioms at a few random points. Turn off where the energy is not defined at normally distributed
        points, and use ``system.check(points=...)``.
    space : manifolds.Space, optional
        Q: a space of real arrays. A function of (q, p, S) is then one of arrays of its shape.

    Raises
    ------
    AxiomError, FunctionError, InputError

    Attributes
    ----------
    contact : manifolds.CanonicalContact
        ``contact.evolution_vector_field(energy)`` is the vector field.
    configurations : manifolds.Space or None
    """

    __init__ = MomentumContactSystem.__init__  # explicit, because type checkers would generate one from the fields

    entropy_production_name: ClassVar[str] = "Delta_Q H"

    def temperature(self, x, t=None) -> jax.Array:
        """Return the temperature ``T = H_S`` of states, shape (...), at the time t if the energy depends on it."""
        return evaluate_batch(self, _temperature_at, x, t, "()")

    def temperatures(self, x, t=None) -> jax.Array:
        """Return the temperature with an axis of length 1, shape (..., 1): see :meth:`temperature`."""
        return self.temperature(x, t)[..., None]


def _temperature_at(system: EvolutionSystem, x) -> jax.Array:
    """Return the temperature at one state, shape ()."""
    return system.energy.gradient(x)[-1]


class ContactSystem(MomentumContactSystem):
    """A system with the contact field X_H of an energy on T*Q x R, for comparison [SML §2.2].

    ``q' = H_p, p' = -H_q - p H_S, S' = p . H_p - H``. It describes no isolated system: ``H' = -H_S H``, and S is the
    action. The metriplectic midpoint scheme keeps that law in the form ``H(x') - H(x) = -h (dgrad H)_S H(z)``.

    Parameters
    ----------
    energy, dim, momentum_maps, validate, space
        As for :class:`EvolutionSystem`.
    """

    __init__ = MomentumContactSystem.__init__

    is_isolated: ClassVar[bool] = False


# -- shared with the Lagrangian side ----------------------------------------------------------------------------------


def canonical_structure(dim: int, space: mf.Space | None = None) -> mf.Cosymplectic:
    """Return the Poisson structure with the contact form ``dS - p dq`` on states (q, p, S), dim = 2n + 1."""
    return mf.Cosymplectic(mf.CanonicalContact(n_degrees_of_freedom(dim), bundle=tangent_bundle_of(space)))


def tangent_bundle_of(space: mf.Space | None) -> mf.TangentBundle | None:
    """Return the tangent bundle of a space of positions, identified with the cotangent bundle; None for R^n."""
    if space is None:
        return None
    bundle = mf.TangentBundle(space)
    if not bundle.can_be_embedded:
        raise InputError(
            f"{space.name} is not a level set of equations for arrays, so it has no bundle of momenta here"
        )
    return bundle


def state_space(space: mf.Space | None, n_extra: int = 0) -> mf.Space | None:
    """Return the space of states (q, p, S) followed by ``n_extra`` components; None for R^n."""
    bundle = tangent_bundle_of(space)
    return None if bundle is None else mf.Product(bundle, mf.Euclidean(1 + n_extra))


def configuration_space(contact: mf.SplitContact) -> mf.Space | None:
    """Return the space Q of a contact structure on T*Q x R or TQ x R; None for R^n."""
    return contact.bundle.base if isinstance(contact.bundle, mf.TangentBundle) else None


def checked_space(space) -> mf.Space:
    """Return the space of positions, or raise an InputError if it is not a space."""
    if not isinstance(space, mf.Space):
        raise InputError(f"space must be a manifolds.Space, such as mf.Sphere(2), got {type(space).__name__}")
    return space


def state_dim(dim: int | None, space: mf.Space | None) -> int:
    """Return the number of components of a state (q, p, S), from dim or from the space of q."""
    if space is None:
        return 2 * n_degrees_of_freedom(dim) + 1
    if dim not in (None, n := 2 * checked_space(space).size + 1):
        raise InputError(f"on {space.name} a state (q, p, S) must have {n} components, got dim={dim}. Leave dim out")
    return n


class JoinedArguments(Module):
    """A function of a state in one array, computed from a function of (q, p, S) or (q, v, S)."""

    function: Callable
    shape: tuple[int, ...] | None = eqx.field(static=True)

    def __call__(self, x, *arguments):
        n = len(x) // 2
        q, v = (a if self.shape is None else a.reshape(self.shape) for a in (x[:n], x[n : 2 * n]))
        return self.function(q, v, x[2 * n], *arguments)


def join_arguments(function, space: mf.Space | None = None):
    """Return a function of (q, p, S) as a function of the state in one array; anything else unchanged."""
    if not callable(function) or isinstance(function, Energy) or required_argument_count(function) != 3:
        return function
    return JoinedArguments(function, None if space is None else checked_space(space).shape)


def n_degrees_of_freedom(dim: int | None) -> int:
    """Return the number n of degrees of freedom of a state (q, p, S) with dim = 2n + 1 components."""
    if isinstance(dim, bool) or not isinstance(dim, int) or dim < 3 or dim % 2 == 0:
        raise InputError(
            f"dim, the number of components of (q, p, S), must be 2n + 1 for n degrees of freedom, got {dim!r}"
        )
    return dim // 2


def entropy_component(dim: int, indices=-1) -> Energy:
    """Return the entropy as a function of the state: its last component, or the sum of components."""
    return Quadratic(jnp.zeros(dim), jnp.zeros(dim).at[indices].set(1.0))


def _relative_residual(residual, size):
    """Return the absolute value of a residual over a size; the absolute value itself if the size is zero."""
    return jnp.abs(residual) / jnp.where(size > 0.0, size, 1.0)
