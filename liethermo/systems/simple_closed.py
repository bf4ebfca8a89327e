"""Simple closed systems: positions and one entropy, with friction, and with work and heat from outside [GBY §2]."""

from __future__ import annotations

from typing import ClassVar, cast

import jax
import jax.numpy as jnp

import manifolds as mf

from ..errors import InputError
from ..functions.arguments import required_argument_count
from ..functions.energy import Energy
from .evolution import join_arguments, state_space
from .herglotz import VelocityContactSystem
from .ledger import LEDGER_DIM, LedgerSystem


class SimpleClosedSystem(LedgerSystem, VelocityContactSystem):
    """A simple closed system: a Lagrangian L(q, v, S), friction, an external force and heat from outside [GBY 2.4].

    ``d/dt L_v - L_q = F_ext + F_fr`` and ``T S' = P_H - F_fr . v``, ``T = -L_S > 0``, on R^n or a manifold. The energy
    ``E = v . L_v - L`` changes by the work and heat received, ``E' = F_ext . v + P_H``, and the entropy production
    is ``-F_fr . v / T``: friction has to brake, which :meth:`check` tests.

    The state is (q, v, S), shape (2n + 1,). With an external force or a heat power it has three more components,
    the work W and the heat Q received so far and the time t: (q, v, S, W, Q, t), where the last three may be left
    out of an initial state and then are 0. The energy of such a system is ``E - W - Q``, that of system and
    surroundings: constant again, and what a run loses of it is the defect of its energy balance. The audit has
    both sides of the ledger.

    :class:`liethermo.VariationalIntegrator` discretises its variational principle; the metriplectic schemes run it too.

    With ``space=`` the positions are the points of a manifold Q, and states have the arrays of q and v in one row.
    Forces act along Q: what a function gives across it is what the constraint takes up.

    Parameters
    ----------
    lagrangian : function of (q, v, S), q and v of shape (n,), or of all in one array, to a scalar; or an Energy
        Regular: ``L_vv`` has an inverse. ``lt.Kinetic(mass) - lt.Potential(U)`` where that is its form (energy).
    dim : int
        Components of (q, v, S), 2n + 1; known by itself of an ``lt.Quadratic``.
    friction : function of (q, v, S) or (q, v, S, t), to shape (n,); or a coefficient; optional
        F_fr, with ``F_fr . v <= 0`` (force). A coefficient R means ``F_fr = -R v``: a number, an array of shape (n,)
        for a diagonal matrix, or (n, n), whose symmetric part is positive semidefinite (mass / time).
    external : function likewise, or an array of shape (n,); optional
        F_ext (force).
    heat_power : function likewise to a scalar, or a number; optional
        P_H, the heat received per time (power).
    momentum_maps : dict of functions, or a sequence of them
    validate : bool
        Test the axioms at a few random points, that friction brakes among them. Turn off where a function is not
        defined at normally distributed points, and use ``system.check(points=...)``.
    space : manifolds.Space, optional
        Q: a space of real arrays, of whose shape q, v and forces then are in all of these functions.

    Raises
    ------
    AxiomError, FunctionError, InputError
        InputError for a singular Lagrangian.

    Attributes
    ----------
    contact : manifolds.LagrangianContact
    lagrangian : Energy
    degrees_of_freedom : int
        Components of q.
    configurations : manifolds.Space or None
        Q, where it is not R^n.
    """

    production_name: ClassVar[str] = "dS/dt"

    def __init__(
        self,
        lagrangian,
        dim: int | None = None,
        friction=None,
        external=None,
        heat_power=None,
        momentum_maps=(),
        validate: bool = True,
        space: mf.Space | None = None,
    ):
        lagrangian = join_lagrangian_arguments(lagrangian, space)
        structure, dim, energy = self._build_contact_structure(lagrangian, dim, space)
        shape = (dim // 2,) if space is None else space.shape
        at = f"(q, v, S), q and v of shape {shape}"
        forces = self._set_forces(friction, external, heat_power, (shape, shape, ()), at)
        self._assemble(structure, dim, energy, forces, momentum_maps, validate, self._state_space(space))

    def _state_space(self, space: mf.Space | None) -> mf.Space | None:
        return state_space(space, LEDGER_DIM if self.has_ledger else 0)

    # -- the state --------------------------------------------------------------------------------------------------

    @property
    def contact(self) -> mf.LagrangianContact:
        return cast(mf.LagrangianContact, cast(mf.Cosymplectic, self.structure).contact)

    @property
    def degrees_of_freedom(self) -> int:
        return self.dim_without_ledger // 2

    @property
    def first_velocity_index(self) -> int:
        return self.degrees_of_freedom

    def tangential_part(self, q, v) -> jax.Array:
        return self.contact.tangential_part(q, v)

    def legendre(self, x) -> jax.Array:
        """Return the Legendre transform ``(q, L_v, S)`` of a state or a batch of states, shape (..., 2n + 1)."""
        return jnp.vectorize(self.contact.legendre, signature="(n)->(n)")(self.drop_ledger(x))

    def temperature_at(self, y) -> jax.Array:
        return -self.lagrangian.gradient(y)[-1]

    def mechanical_energy(self, x) -> jax.Array:
        """Return the energy ``E = v·L_v - L`` of states, without the ledger, shape (...)."""
        return jnp.vectorize(self.contact.energy, signature="(n)->()")(self.drop_ledger(x))

    own_energy = mechanical_energy  # its name in 0.2

    # -- the functions, at one point ----------------------------------------------------------------------------------

    def lagrangian_value(self, q, v, S) -> jax.Array:
        """Return the Lagrangian ``L(q, v, S)``, shape ()."""
        return self.lagrangian.value(jnp.concatenate([q, v, jnp.reshape(S, 1)]))

    def momentum(self, q, v, S) -> jax.Array:
        """Return the momentum ``L_v``, shape (n,)."""
        return jax.grad(self.lagrangian_value, argnums=1)(q, v, S)

    def momentum_jacobians(self, x) -> tuple[jax.Array, jax.Array]:
        _, W, S_derivative = self.contact.rates(x[: self.dim_without_ledger])
        return W, S_derivative[:, 0]


# -- arguments --------------------------------------------------------------------------------------------------------


def join_lagrangian_arguments(lagrangian, space: mf.Space | None = None):
    """Return a Lagrangian as a function of one array."""
    if callable(lagrangian) and not isinstance(lagrangian, Energy) and required_argument_count(lagrangian) == 4:
        raise InputError(
            "the Lagrangian of a simple closed system is one of (q, v, S); what depends on time is external"
        )
    return join_arguments(lagrangian, space)
