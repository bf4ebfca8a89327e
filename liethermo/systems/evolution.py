"""Evolution fields of contact manifolds: isolated systems with friction, and the plain contact fields beside them."""

from __future__ import annotations

from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp

import manifolds as mf

from ..dissipation.base import Law, SkewFriction
from ..errors import InputError
from ..functions.checks import check_scalar, recognised
from ..functions.energy import Energy, Quadratic, as_energy
from ..functions.mechanics import is_mechanical
from .base import System


class LiouvilleFriction(SkewFriction):
    """The thermodynamic part of an evolution field, ``{., H}_Delta`` of the single-generator form [SML 6, 30].

    On T*Q x R it is ``p' = -p H_S, S' = p . H_p``: friction proportional to the temperature H_S, and the heat it makes.
    It is a skew bracket with H, so H is conserved. The entropy cannot fall where ``Delta H >= 0`` [SML Prop. 4.3]; this
    is known of ``H = p . G(q) p / 2 + V(q, S)`` given in terms of that form, and then holds in a discretisation too.
    """

    nondecreasing: bool = eqx.field(static=True, default=False)

    @property
    def entropy_law(self) -> Law | None:
        return "nondecreasing" if self.nondecreasing else None

    def force(self, system, x, dH, dS, dL):
        return system.contact.liouville_sharp(x, dH)


class ReebDrift(LiouvilleFriction):
    """What makes an evolution field the contact field ``X_H = E_H - H R``: along it ``H' = -R(H) H`` [SML §2.2]."""

    @property
    def energy_law(self) -> Law | None:
        return None

    def force(self, system, x, dH, dS, dL):
        return system.contact.liouville_sharp(x, dH) - system.energy.value(x) * system.contact.reeb(x)


class OnContactManifold(System):
    """What evolution and contact systems share, on T*Q x R and on TQ x R."""

    poisson: mf.Cosymplectic

    @property
    def contact(self) -> mf.SplitContact:
        """The contact structure."""
        return self.poisson.contact


class EvolutionSystem(OnContactManifold):
    """The evolution field of an energy on T*R^n x R: an isolated system with friction [SML 7, §4].

    ``q' = H_p, p' = -H_q - p H_S, S' = p . H_p``, with the temperature ``T = H_S``. The energy is constant and the path
    is tangent to the kernel of ``eta = dS - p dq``, which is the first law. The second holds where
    ``Delta_Q H = p . H_p >= 0``; :meth:`check` reports its sign at points.

    For ``H = lt.Kinetic(G) + lt.Potential(V)``, that is ``p . G(q) p / 2 + V(q, S)`` with G semidefinite, it holds, and
    the metriplectic schemes keep it exactly: ``S' - S = h sum b_i p_i . G p_i >= 0`` at every step, for every V and h
    (not with the coordinate increment as printed, unless G is diagonal). Where the same H is written as one
    plain function, they keep the energy exactly too, but the entropy may fall at a coarse step.

    Parameters
    ----------
    energy : function from (q, p, S) in one array, shape (dim,), to a scalar, or an Energy
        Or of that and the time t: see :class:`liethermo.TimeDependent`.
    dim : int
        Number of state components, 2n + 1.
    momentum_maps : dict of functions, or a sequence of them
        Conserved quantities of a symmetry: checked by :meth:`check`, recorded and audited along runs.
    validate : bool
        Test the axioms at a few random points. Turn off where the energy is not defined at normally distributed
        points, and use ``system.check(points=...)``.

    Raises
    ------
    AxiomError, FunctionError, InputError

    Attributes
    ----------
    contact : manifolds.CanonicalContact
        ``contact.evolution_vector_field(energy)`` is the vector field.
    """

    production_name: ClassVar[str] = "Delta_Q H"

    def __init__(self, energy, dim: int, momentum_maps=(), validate: bool = True):
        structure = canonical(dim)
        energy = check_scalar(as_energy(energy, "the energy"), dim, "the energy", timed=True)
        friction = LiouvilleFriction(is_mechanical(recognised(energy, dim), dim))
        self._build(structure, dim, energy, entropy_component(dim), friction, momentum_maps, validate)

    def temperature(self, x, t=None) -> jax.Array:
        """``T = H_S`` at a state or a batch of states, shape (...); at a time, where the energy depends on one."""
        return self.evaluated(lambda system, y: system.energy.gradient(y)[-1], x, t, "()")

    def own_residuals(self, x) -> dict[str, jax.Array]:
        return tangency(self, x)


class ContactSystem(OnContactManifold):
    """The plain contact field X_H of an energy on T*R^n x R, for comparison [SML §2.2].

    ``q' = H_p, p' = -H_q - p H_S, S' = p . H_p - H``. It describes no isolated system: ``H' = -H_S H``, and S is the
    action. The metriplectic midpoint scheme keeps that law in the form ``H(x') - H(x) = -h (dgrad H)_S H(z)``.

    Parameters
    ----------
    energy, dim, momentum_maps, validate
        As for :class:`EvolutionSystem`.
    """

    def __init__(self, energy, dim: int, momentum_maps=(), validate: bool = True):
        self._build(canonical(dim), dim, energy, None, ReebDrift(), momentum_maps, validate)

    def own_residuals(self, x) -> dict[str, jax.Array]:
        return decay(self, x)


# -- shared with the Lagrangian side ----------------------------------------------------------------------------------


def canonical(dim: int) -> mf.Cosymplectic:
    """The structure of T*R^n x R, on dim = 2n + 1 coordinates."""
    return mf.Cosymplectic(mf.CanonicalContact(degrees_of_freedom(dim)))


def degrees_of_freedom(dim: int) -> int:
    """n of a state with 2n + 1 components (q, p, S)."""
    if isinstance(dim, bool) or not isinstance(dim, int) or dim < 3 or dim % 2 == 0:
        raise InputError(
            f"dim counts the components of a state (q, p, S): 2n + 1 for n degrees of freedom, 3 at least, not {dim!r}"
        )
    return dim // 2


def entropy_component(dim: int, at=-1) -> Energy:
    """The last component of a state, or the sum of those ``at`` some places."""
    return Quadratic(jnp.zeros(dim), jnp.zeros(dim).at[at].set(1.0))


def tangency(system: OnContactManifold, x) -> dict[str, jax.Array]:
    """The first law: the field lies in the kernel of the contact form [SML Remark 4.2]."""
    form, rate = system.contact.form(x), system.vector_field(x)
    return {"eta(x') = 0": _relative(jnp.dot(form, rate), jnp.abs(form) @ jnp.abs(rate))}


def decay(system: OnContactManifold, x) -> dict[str, jax.Array]:
    """``H' = -R(H) H`` along a contact field [SML Prop. 2.1]."""
    dH, rate = system.energy.gradient(x), system.vector_field(x)
    loss = jnp.dot(dH, system.contact.reeb(x)) * system.energy.value(x)
    return {"dH/dt = -R(H) H": _relative(jnp.dot(dH, rate) + loss, jnp.abs(dH) @ jnp.abs(rate) + jnp.abs(loss))}


def _relative(residual, size):
    return jnp.abs(residual) / jnp.where(size > 0.0, size, 1.0)
