"""Simple closed systems: positions and one entropy, with friction, and with work and heat from outside [GBY §2]."""

from __future__ import annotations

from collections.abc import Callable
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np

import manifolds as mf
from manifolds._module import Module
from manifolds.matrices.linear import solve

from ..dissipation.base import Law, SkewFriction
from ..dissipation.checks import semidefinite
from ..errors import InputError
from ..functions.arguments import needed_arguments
from ..functions.checks import check_shape
from ..functions.conditions import require
from ..functions.energy import Energy, Quadratic
from ..tracing.interpret import at_points
from .evolution import entropy_component
from .herglotz import OnVelocities

LEDGER = 3
"""Components of the ledger of a system that is not isolated: work and heat received, and the time."""


class Forces(SkewFriction):
    """Friction, external force and heat power, as they act on (q, v, S) [GBY 2.4].

    ``d/dt L_v = … + F_fr + F_ext`` and ``T S' = P_H - F_fr . v``. With the ledger W' = F_ext . v, Q' = P_H the
    energy ``v . L_v - L - W - Q`` of system and surroundings is constant, for discrete gradients too.
    """

    friction: Callable | None
    external: Callable | None
    heat_power: Callable | None

    @property
    def entropy_law(self) -> Law | None:
        if self.heat_power is not None:
            return None
        return "conserved" if self.friction is None else "nondecreasing"

    def force(self, system, x, dH, dS, dL):
        n = system.degrees_of_freedom
        q, _, S, t = system.parts(x)
        rates = jax.jacfwd(system.contact.momentum)(x[: 2 * n + 1])
        W, by_S = rates[:, n : 2 * n], rates[:, 2 * n]
        v = solve(W, dH[n : 2 * n, None])[:, 0]  # the velocity and the temperature that the gradient stands for
        T = dH[2 * n] - jnp.dot(by_S, v)
        friction, push = system.friction_force(q, v, S, t), system.external_force(q, v, S, t)
        power = system.heating(q, v, S, t)
        S_dot = (power - jnp.dot(friction, v)) / jnp.where(T > 0.0, T, jnp.nan)
        v_dot = solve(W, (friction + push - by_S * S_dot)[:, None])[:, 0]
        ledger = jnp.stack([jnp.dot(push, v), power, jnp.ones(())])[: system.dim - (2 * n + 1)]
        return jnp.concatenate([jnp.zeros(n), v_dot, S_dot[None], ledger])


class SimpleClosedSystem(OnVelocities):
    """A simple closed system: a Lagrangian L(q, v, S), friction, an external force and heat from outside [GBY 2.4].

    ``d/dt L_v - L_q = F_ext + F_fr`` and ``T S' = P_H - F_fr . v``, ``T = -L_S > 0``, on R^n. The energy
    ``E = v . L_v - L`` changes by the work and heat received, ``E' = F_ext . v + P_H``, and the entropy production
    is ``-F_fr . v / T``: friction has to brake, which :meth:`check` tests.

    The state is (q, v, S), shape (2n + 1,). With an external force or a heat power it has three more components,
    the work W and the heat Q received so far and the time t: (q, v, S, W, Q, t), where the last three may be left
    out of an initial state and then are 0. The energy of such a system is ``E - W - Q``, that of system and
    surroundings: constant again, and what a run loses of it is the defect of its energy balance. The audit has
    both sides of the ledger.

    :class:`liethermo.VariationalIntegrator` discretises its variational principle; the metriplectic schemes run it too.

    Parameters
    ----------
    lagrangian : function of (q, v, S), q and v of shape (n,), or of all in one array, to a scalar; or an Energy
        Regular: ``L_vv`` has an inverse. ``lt.Kinetic(mass) - lt.Potential(U)`` where that is its form (energy).
    dim : int
        Components of (q, v, S), 2n + 1; known by itself of an ``lt.Quadratic``.
    friction : function of (q, v, S) or (q, v, S, t), to shape (n,); or a coefficient; optional
        F_fr, with ``F_fr . v <= 0`` (force). A coefficient R, positive semidefinite, means ``F_fr = -R v``: a number,
        an array of shape (n,) for a diagonal matrix, or (n, n) (mass / time).
    external : function likewise, or an array of shape (n,); optional
        F_ext (force).
    heat_power : function likewise to a scalar, or a number; optional
        P_H, the heat received per time (power).
    momentum_maps : dict of functions, or a sequence of them
    validate : bool
        Test the axioms at a few random points, that friction brakes among them. Turn off where a function is not
        defined at normally distributed points, and use ``system.check(points=...)``.

    Raises
    ------
    AxiomError, FunctionError, InputError
        InputError for a singular Lagrangian.

    Attributes
    ----------
    contact : manifolds.LagrangianContact
    lagrangian : Energy
    degrees_of_freedom : int
    """

    friction: Callable | None
    external: Callable | None
    heat_power: Callable | None

    domain: ClassVar[str] = "a positive temperature"
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
    ):
        structure, size, energy = self._prepare(_in_one_array(lagrangian), dim)
        n = size // 2
        self.friction = _force(friction, n, "friction")
        self.external = None if external is None else _field(external, n, (n,), "the external force")
        self.heat_power = None if heat_power is None else _field(heat_power, n, (), "the heat power")
        total = size + (LEDGER if self.receives else 0)
        if self.receives:
            received = Quadratic(jnp.zeros(total), jnp.zeros(total).at[size : size + 2].set(-1.0))
            energy = energy.on(range(size)) + received
        entropy = entropy_component(total, size - 1)
        given = (self.friction, self.external, self.heat_power)
        forces = None if given == (None, None, None) else Forces(*given)
        self._build(
            _WithLedger(structure) if self.receives else structure,
            total,
            energy,
            entropy,
            forces,
            momentum_maps,
            validate,
        )

    # -- the state --------------------------------------------------------------------------------------------------

    @property
    def degrees_of_freedom(self) -> int:
        return self.contact.degrees_of_freedom

    @property
    def receives(self) -> bool:
        """Whether work or heat comes from outside, so that the state has a ledger."""
        return self.external is not None or self.heat_power is not None

    def numbers(self, x, batch: bool = False):
        if self.receives and np.ndim(x) > 0 and np.shape(x)[-1] == 2 * self.degrees_of_freedom + 1:
            x = jnp.concatenate([jnp.asarray(x), jnp.zeros((*np.shape(x)[:-1], LEDGER))], axis=-1)
        return super().numbers(x, batch)

    def parts(self, x) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
        """q, v, S and t of one state; t = 0 where it has none."""
        n = self.degrees_of_freedom
        return x[:n], x[n : 2 * n], x[2 * n], x[-1] if len(x) > 2 * n + 1 else jnp.zeros(())

    def legendre(self, x) -> jax.Array:
        """``FL(q, v, S) = (q, L_v, S)`` at a state or a batch of states, shape (..., 2n + 1)."""
        return jnp.vectorize(self.contact.legendre, signature="(n)->(n)")(self._mechanical(x))

    def temperature(self, x) -> jax.Array:
        """``T = -L_S``, shape (...)."""
        return jnp.vectorize(lambda y: -self.lagrangian.gradient(y)[-1], signature="(n)->()")(self._mechanical(x))

    def own_energy(self, x) -> jax.Array:
        """``E = v·L_v - L``, without the ledger, shape (...)."""
        return jnp.vectorize(self.contact.energy, signature="(n)->()")(self._mechanical(x))

    def _mechanical(self, x) -> jax.Array:
        return self.state(x, batch=True)[..., : 2 * self.degrees_of_freedom + 1]

    @property
    def ledger(self) -> dict[str, Energy]:
        size = 2 * self.degrees_of_freedom + 1
        names = ("work received", "heat received") if self.receives else ()
        return {name: Quadratic(jnp.zeros(self.dim), jnp.eye(self.dim)[size + i]) for i, name in enumerate(names)}

    # -- the functions, at one point ----------------------------------------------------------------------------------

    def action(self, q, v, S) -> jax.Array:
        """``L(q, v, S)``."""
        return self.lagrangian.value(jnp.concatenate([q, v, jnp.reshape(S, 1)]))

    def momentum(self, q, v, S) -> jax.Array:
        """``L_v``, shape (n,)."""
        return jax.grad(self.action, argnums=1)(q, v, S)

    def friction_force(self, q, v, S, t) -> jax.Array:
        """F_fr, shape (n,)."""
        return jnp.zeros_like(v) if self.friction is None else jnp.asarray(self.friction(q, v, S, t))

    def external_force(self, q, v, S, t) -> jax.Array:
        """F_ext, shape (n,)."""
        return jnp.zeros_like(v) if self.external is None else jnp.asarray(self.external(q, v, S, t))

    def heating(self, q, v, S, t) -> jax.Array:
        """P_H."""
        return jnp.zeros(()) if self.heat_power is None else jnp.asarray(self.heat_power(q, v, S, t))

    # -- checks -----------------------------------------------------------------------------------------------------

    def outside(self, x) -> str:
        T = float(at_points(_temperature, self, np.asarray(x)[None])[0])
        return "" if T > 0.0 else f"the temperature -dL/dS is {T:.4g}: it has to be positive"

    def own_residuals(self, x) -> dict[str, jax.Array]:
        q, v, S, t = self.parts(x)
        force = self.friction_force(q, v, S, t)
        size = jnp.linalg.norm(force) * jnp.linalg.norm(v)
        injected = jnp.maximum(jnp.dot(force, v), 0.0)
        return {"F_fr . v <= 0": injected / jnp.where(size > 0.0, size, 1.0)}


def _temperature(system: SimpleClosedSystem, x):
    return system.temperature(x)


class _WithLedger(mf.PoissonStructure):
    """A structure beside components that it does not move."""

    inner: mf.Cosymplectic

    @property
    def contact(self) -> mf.SplitContact:
        return self.inner.contact

    @property
    def dim(self) -> int:
        return self.inner.dim + LEDGER

    def tensor(self, x) -> jax.Array:
        return jnp.pad(self.inner.tensor(x[:-LEDGER]), ((0, LEDGER), (0, LEDGER)))

    def sharp(self, x, alpha) -> jax.Array:
        return jnp.pad(self.inner.sharp(x[:-LEDGER], alpha[:-LEDGER]), (0, LEDGER))


# -- arguments --------------------------------------------------------------------------------------------------------


class _Joined(Module):
    """L(q, v, S) as a function of one array."""

    function: Callable

    def __call__(self, x):
        n = len(x) // 2
        return self.function(x[:n], x[n : 2 * n], x[2 * n])


class _Steady(Module):
    """A function of (q, v, S) as one of (q, v, S, t)."""

    function: Callable

    def __call__(self, q, v, S, t):
        del t
        return self.function(q, v, S)


class _Constant(Module):
    value: jax.Array

    def __call__(self, q, v, S, t):
        del q, v, S, t
        return self.value


class _Linear(Module):
    """``-R v``."""

    R: jax.Array

    def __call__(self, q, v, S, t):
        del q, S, t
        return -(self.R @ v if self.R.ndim == 2 else self.R * v)


def timed(function: Callable) -> Callable:
    """A function of (q, v, S) or (q, v, S, t) as one of (q, v, S, t)."""
    return _Steady(function) if needed_arguments(function) == 3 else function


def _in_one_array(lagrangian):
    if not callable(lagrangian) or isinstance(lagrangian, Energy):
        return lagrangian
    if needed_arguments(lagrangian) == 4:
        raise InputError(
            "the Lagrangian of a simple closed system is one of (q, v, S); what depends on time is external"
        )
    return _Joined(lagrangian) if needed_arguments(lagrangian) == 3 else lagrangian


def _force(friction, n: int, what: str) -> Callable | None:
    if friction is None or callable(friction):
        return None if friction is None else _field(friction, n, (n,), what)
    R = jnp.asarray(friction, dtype=jnp.float64)
    R = jnp.full(n, R) if R.ndim == 0 else R
    if R.shape not in ((n,), (n, n)):
        raise InputError(f"a coefficient of {what} has shape (), ({n},) or ({n}, {n}), not {R.shape}")
    if R.ndim == 2:
        return _Linear(semidefinite(R, f"the coefficient of {what}"))
    require(
        R.min(), lambda r: r >= 0.0, f"a coefficient of {what} must be >= 0, not {{value:g}}: it would inject energy"
    )
    return _Linear(R)


def _field(function, n: int, shape: tuple[int, ...], what: str) -> Callable:
    """As a function of (q, v, S, t), whose shape has been checked."""
    found = timed(function) if callable(function) else _Constant(jnp.asarray(function, dtype=jnp.float64))
    return check_shape(found, ((n,), (n,), (), ()), shape, what, f"(q, v, S), q and v of shape ({n},)")
